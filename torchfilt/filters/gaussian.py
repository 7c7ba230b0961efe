"""Gaussian filters: one square-root recursion, one moment rule; the named methods differ by the rule."""

import torch
from torch import Tensor

from torchfilt.gates import Gate, as_gate, by_sensor
from torchfilt.gaussian import Gaussian
from torchfilt.model import StateSpaceModel
from torchfilt.moments import (
    Rule,
    Update,
    check_rule_type,
    cubature,
    gauss_hermite,
    predict,
    taylor,
    unscented,
    update,
)
from torchfilt.run import Filter, check_model
from torchfilt.types import FilterState, Missing, Step, StepInfo, StepNoise


class GaussianFilter(Filter[Gaussian]):
    """Square-root recursion of a Gaussian belief.

    A covariance that no row's data, control or time step touches is carried once for the whole batch: with linear laws
    and measurements whose rows miss the same components, thousands of series cost one covariance recursion. Rows that
    fail hold NaN from then on and never influence others.

    Args:
        model: the three laws; laws that are not Gaussian enter by their first two moments.
        rule: how moments go through a law: `taylor()`, `unscented()`, `cubature()`, `gauss_hermite()`.
        iterations: linearisations of the measurement law, each about the posterior of the one before.
        gate: a `Gate`, or the probability with which a measurement that fits is taken in, such as 0.999; the others, by
            the chi-square test of their innovation, are treated as not measured. ``info.accepted`` and
            ``info.gate_nis`` are the log: (*batch), with `Sensors` (*batch, sensors). None takes all.

    Raises:
        ValueError: iterations below 1, gate outside (0, 1). TypeError: not a model, not a moment rule, not a gate.
    """

    carries = Gaussian

    def __init__(
        self, model: StateSpaceModel, rule: Rule, iterations: int = 1, gate: Gate | float | None = None
    ) -> None:
        super().__init__(model)
        check_rule_type(rule)
        if iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {iterations}")
        self.rule, self.iterations, self.gate = rule, iterations, as_gate(gate)
        self.evidence = "exact" if model.is_linear() else "linearized"
        if gate is not None:
            self.evidence = "approximate"  # what was shut out is not in it

    def init(self, batch_shape: tuple[int, ...] = (), seed: int = 0) -> FilterState[Gaussian]:
        """The prior's moments, the mean expanded to (*batch, d); ``seed`` is carried along unused.

        Raises:
            ValueError: the prior has a batch of its own, which is another one.
        """
        prior = self.model.prior(batch_shape)
        mean = prior.mean.expand(*batch_shape, prior.mean.shape[-1])
        return FilterState(Gaussian(mean, prior.factor(), prior.space), 0, seed)

    def predict(self, belief: Gaussian, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Belief after the motion; arguments as in `advance`."""
        return predict(self.model.moments("transition"), belief, self.rule, u, dt)

    def update(
        self, belief: Gaussian, y: Tensor, missing: Missing = "rows", u: Tensor | None = None, dt: Step = None
    ) -> Update:
        """Belief after a measurement y (*batch, m), with innovation and likelihood; arguments as in `advance`."""
        law = self.model.moments("observation")
        return update(law, belief, y, self.rule, missing, self.iterations, u, dt, self.gate)

    def advance(
        self,
        belief: Gaussian,
        y: Tensor,
        u: Tensor | None = None,
        dt: Step = None,
        noise: StepNoise | None = None,
        missing: Missing = "rows",
        predict: bool = True,
    ) -> tuple[Gaussian, StepInfo]:
        """See `Filter.advance`; noise is not used."""
        if predict:
            belief = self.predict(belief, u, dt)
        result = self.update(belief, y, missing, u, dt)
        posterior = result.belief
        # A factor made by a triangularisation cannot lose definiteness but by NaN; a failed downdate is NaN as well.
        # NaN and infinity survive a sum, and only what is neither leaves nothing when it is taken from itself.
        probe = result.log_likelihood + posterior.mean.sum(-1) + posterior.scale_tril.sum((-2, -1))
        ok = probe - probe == 0
        if getattr(self.model.observation, "exact", ()):  # one that is contradicted leaves a belief that looks healthy
            posterior = posterior._replace(mean=torch.where(ok.unsqueeze(-1), posterior.mean, torch.nan))
        info = StepInfo(
            result.log_likelihood,
            ok,
            result.innovation,
            result.innovation_scale_tril,
            result.nis,
            accepted=by_sensor(result.accepted, self.model),
            gate_nis=by_sensor(result.gate_nis, self.model),
            evidence=self.evidence,
        )
        return posterior, info


def KalmanFilter(model: StateSpaceModel, gate: Gate | float | None = None) -> GaussianFilter:
    """Exact filter for linear-Gaussian models, square-root form; ``gate`` as in `GaussianFilter`.

    Raises:
        TypeError: a law that does not give its `linear_form`.

    Source: Kailath, Sayed, Hassibi, Linear Estimation (2000), chapter 12.
    """
    check_model(model)
    for name in ("transition", "observation"):
        law = getattr(model, name)
        if not hasattr(law, "linear_form"):
            raise TypeError(
                f"KalmanFilter needs linear laws; {name} is a {type(law).__name__} without linear_form. "
                "Take ExtendedKalmanFilter or UnscentedKalmanFilter"
            )
    return GaussianFilter(model, taylor(), gate=gate)


def ExtendedKalmanFilter(
    model: StateSpaceModel, iterations: int = 1, gate: Gate | float | None = None
) -> GaussianFilter:
    """First-order linearisation with exact derivatives; ``iterations`` > 1 is the iterated form.

    Other arguments as in `GaussianFilter`.

    Source: Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE TAC 38 (1993).
    """
    return GaussianFilter(model, taylor(), iterations, gate)


def ErrorStateKalmanFilter(
    model: StateSpaceModel, feedback: bool = True, iterations: int = 1, gate: Gate | float | None = None
) -> GaussianFilter:
    """The indirect form: a reference that moves by the full law, and a Gaussian over its error in the tangent space.

    On a space the recursion is just that: the mean is the reference, the factor belongs to the error, ``retract`` feeds
    the estimated error back into the reference and leaves zero in its place. For a model whose *state* is the error of
    an inertial system, ``feedback`` corrects that system at each step, so that the law is expanded about the estimated
    error; without it the system runs open loop and the law is expanded about the prior's mean for ever, which is right
    as long as the error stays small. An attitude on `UnitQuaternion` makes this the multiplicative filter.

    Args:
        model: the three laws; the prior's mean is the reference's start.
        feedback: see above.
        iterations: linearisations of the measurement law, as in `ExtendedKalmanFilter`; with feedback only.
        gate: as in `GaussianFilter`.

    Raises:
        ValueError: iterations above 1 or a prior with a batch of its own, without feedback.

    Sources: Farrell, Aided Navigation (2008), section 5.10; Markley, Attitude error representations for Kalman
        filtering, JGCD 26 (2003).
    """
    if feedback:
        return GaussianFilter(model, taylor(), iterations, gate)
    check_model(model)
    if iterations != 1:
        raise ValueError(f"without feedback the law is linearised once: iterations must be 1, got {iterations}")
    mean = model.prior().mean
    if mean.dim() != 1:
        raise ValueError(f"without feedback the prior's mean must be one point for all rows, got {tuple(mean.shape)}")
    return GaussianFilter(model, taylor(mean), gate=gate)


def UnscentedKalmanFilter(
    model: StateSpaceModel,
    alpha: float = 1.0,
    beta: float = 0.0,
    kappa: float | None = None,
    iterations: int = 1,
    gate: Gate | float | None = None,
) -> GaussianFilter:
    """Statistical linearisation by 2e + 1 sigma points; parameters as in `torchfilt.moments.unscented`.

    On a space with a `UnitQuaternion` this is the quaternion filter: sigma points are turned by rotation vectors, their
    mean is intrinsic, and the covariance goes along to the new mean.

    Source: Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proc. IEEE 92 (2004).
    """
    return GaussianFilter(model, unscented(alpha, beta, kappa), iterations, gate)


def CubatureKalmanFilter(
    model: StateSpaceModel, iterations: int = 1, gate: Gate | float | None = None
) -> GaussianFilter:
    """Third-degree spherical-radial cubature, 2e points; arguments as in `GaussianFilter`.

    Source: Arasaratnam and Haykin, Cubature Kalman filters, IEEE TAC 54 (2009).
    """
    return GaussianFilter(model, cubature(), iterations, gate)


def GaussHermiteKalmanFilter(
    model: StateSpaceModel, order: int = 3, iterations: int = 1, gate: Gate | float | None = None
) -> GaussianFilter:
    """Product Gauss-Hermite quadrature, order ** e points; other arguments as in `GaussianFilter`.

    Source: Ito and Xiong, Gaussian filters for nonlinear filtering problems, IEEE TAC 45 (2000).
    """
    return GaussianFilter(model, gauss_hermite(order), iterations, gate)
