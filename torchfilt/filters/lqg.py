"""A controller that acts on an estimate: state feedback and an observer joined."""

from typing import Any, NamedTuple

from torch import Tensor, nn

from torchfilt.filters.observer import SteadyStateKalmanFilter
from torchfilt.gaussian import Gaussian
from torchfilt.laws import check_finite, hold
from torchfilt.models.control.continuous import linear_model
from torchfilt.models.control.design import blocks, check_weights, lqr
from torchfilt.models.control.systems import as_system, c2d, check_period, integrate_noise
from torchfilt.run import Filter
from torchfilt.types import FilterState, Step


class ControllerState(NamedTuple):
    """Belief of the observer and the control (*batch, k) that acts until the next measurement."""

    estimate: FilterState[Any]
    control: Tensor


class LQGController(nn.Module):
    """u = -K x of an observer's mean; each control enters the observer's next prediction.

    The state is a value, as everywhere: stepping, branching and resuming are operations on it.

    Args:
        observer: any filter of the plant's state, such as `SteadyStateKalmanFilter` or `LuenbergerObserver`.
        gain: K (k, d), such as of `torchfilt.models.control.lqr`.

    Raises:
        TypeError: the observer is not a filter, the gain no tensor of the dtype of its model.
        ValueError: a gain that is not finite, or no matrix that fits the model's state.

    Source: Anderson and Moore, Optimal Control: Linear Quadratic Methods (1990).
    """

    gain: Tensor

    def __init__(self, observer: Filter[Any], gain: Tensor) -> None:
        super().__init__()
        if not isinstance(observer, Filter):
            raise TypeError(f"observer must be a filter, got {type(observer).__name__}")
        mean = observer.model.prior().mean
        if not isinstance(gain, Tensor) or gain.dtype != mean.dtype:
            got = gain.dtype if isinstance(gain, Tensor) else type(gain).__name__
            raise TypeError(f"gain must be a tensor of the model's dtype {mean.dtype}, got {got}")
        if gain.dim() != 2 or gain.shape[-1] != mean.shape[-1]:
            raise ValueError(f"gain must be (k, d) with d = {mean.shape[-1]}, got shape {tuple(gain.shape)}")
        check_finite(gain, "gain")
        self.observer = observer
        hold(self, "gain", gain)

    @classmethod
    def design(
        cls,
        system: Any,
        state_weight: Tensor,
        control_weight: Tensor,
        process_noise: Tensor,
        measurement_noise: Tensor,
        initial: Gaussian,
        noise_input: Tensor | None = None,
        dt: float | None = None,
        cross: Tensor | None = None,
    ) -> "LQGController":
        """The controller of least expected cost, with a stationary Kalman filter.

        A continuous system is sampled with all that belongs to it: motion, noise, and the cost between the instants,
        which brings a cross weight along. Its controls are held over dt.

        Args:
            system, state_weight, control_weight, process_noise, noise_input, cross: as in
                `torchfilt.models.control.lqgr`; of a continuous system costs are per second and the process noise is a
                spectral density.
            measurement_noise: covariance of one measurement (m, m), of a continuous system too.
            initial: the prior.
            dt: time step of a continuous system, s.

        Returns:
            The controller, its observer a `SteadyStateKalmanFilter`.

        Raises:
            ValueError: a continuous system without dt, or a discrete one with another; D other than zero, where a
                control would be needed for the measurement that it is computed from; as `lqr` and `kalman`.
        """
        plant = as_system(system)
        if plant.d.numel() and bool(plant.d.any()):
            raise ValueError("d must be zero: the control is computed from the measurement that it would be part of")
        model = linear_model(plant, process_noise, measurement_noise, initial, noise_input)
        if plant.is_discrete:
            if dt is not None and dt != plant.dt:
                raise ValueError(f"the system is discrete with dt = {plant.dt}, got dt = {dt}")
            gain = lqr(plant, state_weight, control_weight, cross).gain
            return cls(SteadyStateKalmanFilter(model, float(plant.dt) if plant.dt is not None else None), gain)
        if dt is None:
            raise ValueError("a continuous system needs dt, the time for which a control is held")
        weights = sampled_weights(plant, state_weight, control_weight, dt, cross)
        return cls(SteadyStateKalmanFilter(model, dt), lqr(c2d(plant, dt).system, *weights).gain)

    def init(self, batch_shape: tuple[int, ...] = (), control: Tensor | None = None, seed: int = 0) -> ControllerState:
        """The observer's prior and the control (*batch, k) that acts before the first measurement, zero by default.

        Raises:
            ValueError: a control of another shape.
        """
        if control is None:
            control = self.gain.new_zeros(*batch_shape, len(self.gain))
        if control.shape != (*batch_shape, len(self.gain)):
            raise ValueError(f"control must be {(*batch_shape, len(self.gain))}, got {tuple(control.shape)}")
        return ControllerState(self.observer.init(batch_shape, seed), control)

    def step(
        self, state: ControllerState, y: Tensor, dt: Step = None, *, predict_first: bool = True
    ) -> tuple[ControllerState, Tensor]:
        """Take a measurement in and answer with the control that acts from now on.

        Args:
            state: of `init` or of the step before.
            y: (*batch, m); NaN means not measured.
            dt: as the observer's `step` takes it.
            predict_first: False where the measurement belongs to the time of the prior itself.

        Returns:
            The state, and u (*batch, k).
        """
        estimate, _ = self.observer.step(state.estimate, y, state.control, dt, predict_first=predict_first)
        control = -(estimate.belief.mean @ self.gain.mT)
        return ControllerState(estimate, control), control


class SampledWeights(NamedTuple):
    """State weight (*batch, d, d), control weight (*batch, k, k) and cross weight (*batch, d, k) of a step, in the
    order that `lqr` takes.
    """

    state: Tensor
    control: Tensor
    cross: Tensor


def sampled_weights(
    system: Any, state_weight: Tensor, control_weight: Tensor, dt: float | Tensor, cross: Tensor | None = None
) -> SampledWeights:
    """The integral of x^T Q x + u^T R u + 2 x^T N u over a step in which u is held, as weights of the sampled system.

    Args:
        system: continuous, `StateSpace` or ``control.StateSpace``.
        state_weight: Q (*batch, d, d). control_weight: R (*batch, k, k). cross: N (*batch, d, k), default zero; per
            second.
        dt: s, a number or (*batch).

    Returns:
        `SampledWeights`, of a step.

    Raises:
        TypeError, ValueError: weights as in `lqr`; a discrete system; dt as in `c2d`.

    Source: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23 (1978), the integral W;
        Franklin, Powell, Workman, Digital Control of Dynamic Systems (1998).
    """
    plant = as_system(system)
    if plant.is_discrete:
        raise ValueError(f"costs are sampled of a continuous system, this one is discrete with dt = {plant.dt}")
    check_period(dt, plant.a)
    cross = check_weights(plant, state_weight, control_weight, cross)
    d, k = plant.b.shape[-2:]
    a, b = plant.a, plant.b
    whole = blocks([[a, b], [a.new_zeros(k, d), a.new_zeros(k, k)]])
    weights = integrate_noise(whole.mT, blocks([[state_weight, cross], [cross.mT, control_weight]]), dt)
    return SampledWeights(weights[..., :d, :d], weights[..., d:, d:], weights[..., :d, d:])
