"""A state-space model is three laws: initial, transition, observation."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from torchfilt.gaussian import Gaussian
from torchfilt.laws import LinearGaussian, call_style, check_factor, check_finite, takes_in_order
from torchfilt.linalg import psd_factor
from torchfilt.symmetry import Gauge, GaugedInitial, GaugedTransition
from torchfilt.types import Missing, StepInput

Conditional = Gaussian | Distribution

# What a law may offer beside the call; `torchfilt.moments` uses it.
_SHORT_CUTS = ("linear_form", "pooled", "first_order")


def _short_cuts(law: Callable[..., Conditional]) -> list[str]:
    """What the law offers, the space that belongs to a linear form, the sensors and which components are exact."""
    found = [name for name in _SHORT_CUTS if hasattr(law, name)]
    also = [name for name in ("names", "parts", "exact") if hasattr(law, name)]
    return [*found, *also, "space"] if found and hasattr(law, "space") else [*found, *also]


class StateSpaceModel(nn.Module):
    """Initial law, transition law x_t | x_{t-1}, u_t, dt_t and measurement law y_t | x_t, u_t, dt_t.

    Args:
        initial: a `Gaussian`, a `torch.distributions.Distribution`, or a module that returns one when called.
        transition: law called as ``transition(x, u, dt)``; arguments it does not take are left out.
        observation: law called as ``observation(x, u, dt)`` with the control and time step of the motion that led to x;
            arguments it does not take are left out.
        gauge: symmetry of the model, a map of states (..., d) to the representative of their orbit, see
            `torchfilt.symmetry`; applied to the prior and to each state that sets out on a motion. None for none.

    Raises:
        TypeError: initial is none of these, a law is not callable, linear laws of another dtype.
        ValueError: linear laws of another size than the initial mean.
    """

    def __init__(
        self,
        initial: Gaussian | Distribution | nn.Module,
        transition: Callable[..., Conditional],
        observation: Callable[..., Conditional],
        *,
        gauge: Gauge | None = None,
    ) -> None:
        super().__init__()
        for name, law in (("transition", transition), ("observation", observation)):
            if not callable(law):
                raise TypeError(f"{name} must be a law, called as law(x) or law(x, u, dt), got {type(law).__name__}")
        if gauge is not None and not callable(gauge):
            raise TypeError(f"gauge must be a map of states, called as gauge(x), got {type(gauge).__name__}")
        self.initial = initial if isinstance(initial, nn.Module) else InitialLaw(initial)
        self.transition = transition
        self.observation = observation
        self.gauge = gauge
        self._check_linear_laws()
        if gauge is not None:
            self.initial = GaugedInitial(self.initial, gauge)
            self.transition = transition = GaugedTransition(transition, gauge)
        laws = {"transition": transition, "observation": observation}
        self._styles = {name: call_style(law) for name, law in laws.items()}
        self._short_cuts = {name: _short_cuts(law) for name, law in laws.items()}
        self._direct = {
            name: any(hasattr(law, key) for key in _SHORT_CUTS) and takes_in_order(law) for name, law in laws.items()
        }

    def _check_linear_laws(self) -> None:
        """Linear laws show their sizes before anything runs."""
        if not isinstance(self.initial, InitialLaw) or self.initial.is_distribution:
            return
        mean = self.initial.mean
        for name in ("transition", "observation"):
            law = getattr(self, name)
            if not isinstance(law, LinearGaussian):
                continue
            if law.matrix.dtype != mean.dtype:
                raise TypeError(f"the {name}'s matrix is {law.matrix.dtype}, the initial mean {mean.dtype}")
            rows, columns = law.matrix.shape[-2:]
            if columns != mean.shape[-1] or (name == "transition" and rows != columns):
                raise ValueError(
                    f"the {name}'s matrix (..., {rows}, {columns}) does not fit a state of {mean.shape[-1]} numbers"
                )

    def representative(self, x: Tensor) -> Tensor:
        """States (..., d) in the model's gauge, in which alone they can be compared; x itself without a symmetry."""
        return x if self.gauge is None else self.gauge(x)

    def takes_controls(self) -> bool:
        """Whether a law has a place for a control u."""
        return any(
            getattr(getattr(self, name), "takes_controls", style.takes_u) for name, style in self._styles.items()
        )

    def conditional(
        self, name: str, x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None
    ) -> Conditional:
        """What the law called ``name`` ("transition" or "observation") gives at x."""
        result: Conditional = self._styles[name].call(getattr(self, name), x, u, dt)
        return result

    def moments(self, name: str) -> Callable[..., Gaussian]:
        """The law called ``name`` as (x, u, dt) -> Gaussian; short cuts that it offers stay visible."""
        law = getattr(self, name)
        if self._direct[name]:
            return law

        def called(x: Tensor, u: Tensor | None = None, dt: Tensor | float | None = None) -> Gaussian:
            return as_gaussian(self.conditional(name, x, u, dt))

        for key in self._short_cuts[name]:
            setattr(called, key, getattr(law, key))
        return called

    def is_linear(self) -> bool:
        """Whether transition and observation are linear in the state with Gaussian noise and say so."""
        return hasattr(self.transition, "linear_form") and hasattr(self.observation, "linear_form")

    def prior(self, batch_shape: tuple[int, ...] | None = None) -> Gaussian:
        """The initial law by its first two moments.

        Raises:
            ValueError: it has a batch of its own, which is not ``batch_shape``.
        """
        prior = as_gaussian(self.initial())
        own = prior.scale_tril.shape[: -1 if prior.is_diagonal else -2]
        check_batch(torch.broadcast_shapes(prior.mean.shape[:-1], own), batch_shape)
        return prior


def check_batch(lead: torch.Size, batch_shape: tuple[int, ...] | None) -> None:
    """Raise a ValueError where a prior with leading dims of its own is asked for another batch."""
    if lead and batch_shape is not None and lead != torch.Size(batch_shape):
        raise ValueError(f"the prior is for a batch of {tuple(lead)}, not {tuple(batch_shape)}")


class InitialLaw(nn.Module):
    """Holds the prior, so that it moves with the module; parameters stay parameters."""

    mean: Tensor
    scale_tril: Tensor

    def __init__(self, law: Gaussian | Distribution) -> None:
        super().__init__()
        self._distribution: Distribution | None = None
        if isinstance(law, Distribution):
            self._distribution = law
            return
        if not isinstance(law, Gaussian):
            raise TypeError(f"initial must be a Gaussian, a torch Distribution or a module, got {type(law).__name__}")
        if law.mean.dim() == 0 or law.space.size not in (None, law.mean.shape[-1]):
            size = "d" if law.space.size is None else law.space.size
            raise ValueError(f"initial mean must be (*batch, {size}) on {law.space!r}, got {tuple(law.mean.shape)}")
        if not law.mean.is_floating_point():
            raise TypeError(f"initial mean must be floating point, got {law.mean.dtype}")
        check_finite(law.mean, "initial mean")
        check_finite(law.scale_tril, "initial scale_tril")
        expected = law.space.tangent_size if law.space.tangent_size is not None else law.mean.shape[-1]
        if law.scale_tril.shape[-1] != expected:
            raise ValueError(f"initial scale_tril must end in {expected}, got {tuple(law.scale_tril.shape)}")
        if not law.is_diagonal:
            check_factor(law.scale_tril, "initial scale_tril")
        for name, tensor in (("mean", law.mean), ("scale_tril", law.scale_tril)):
            if isinstance(tensor, nn.Parameter):
                self.register_parameter(name, tensor)
            elif tensor.requires_grad:
                setattr(self, name, tensor)
            else:
                self.register_buffer(name, tensor.clone())
        self.space, self.is_diagonal = law.space, law.is_diagonal

    @property
    def is_distribution(self) -> bool:
        """Whether the law is a torch Distribution."""
        return self._distribution is not None

    def forward(self) -> Conditional:
        """The law."""
        if self._distribution is not None:
            return self._distribution
        return Gaussian(self.mean, self.scale_tril, self.space, self.is_diagonal)


def as_gaussian(law: Conditional) -> Gaussian:
    """A conditional law by its first two moments; our own `Gaussian` passes through.

    Raises:
        TypeError: neither a `Gaussian` nor a `torch.distributions.Distribution`.
    """
    if isinstance(law, Gaussian):
        return law
    if not isinstance(law, Distribution):
        raise TypeError(f"a law must return a Gaussian or a torch Distribution, got {type(law).__name__}")
    if isinstance(law, torch.distributions.MultivariateNormal):
        return Gaussian(law.loc, law.scale_tril)
    if isinstance(law, torch.distributions.MixtureSameFamily) and law.event_shape:
        return Gaussian(law.mean, psd_factor(_mixture_covariance(law)))
    covariance = getattr(law, "covariance_matrix", None)
    if covariance is not None:
        return Gaussian(law.mean, psd_factor(covariance))
    mean, variance = law.mean, law.variance
    if mean.dim() == 0:  # a scalar law is a state of one number
        mean, variance = mean.unsqueeze(-1), variance.unsqueeze(-1)
    return Gaussian(mean, variance.sqrt(), is_diagonal=True)


def _mixture_covariance(law: torch.distributions.MixtureSameFamily) -> Tensor:
    """Covariance (..., e, e): components that are independent inside are not so across the mixture."""
    parts = as_gaussian(law.component_distribution)
    apart = parts.mean - law.mean.unsqueeze(-2)
    each = parts.covariance + apart.unsqueeze(-1) * apart.unsqueeze(-2)
    return (law.mixture_distribution.probs[..., None, None] * each).sum(-3)


def log_prob(law: Conditional, y: Tensor, missing: Missing = "rows") -> Tensor:
    """Log-density of y (..., d) under a conditional law; NaN components are integrated out.

    Args:
        law: one law a row.
        y: broadcasts with the leading dims of the law.
        missing: as in `torchfilt.moments.update`.

    Raises:
        ValueError: y has another size than the law, or a joint torch Distribution would have to drop only some of its
            components.
    """
    if isinstance(law, torch.distributions.MultivariateNormal) and missing != "none":
        law = as_gaussian(law)  # joint, but its margins are known
    if isinstance(law, Gaussian):
        if y.shape[-1] != law.mean.shape[-1]:
            raise ValueError(f"the measurement has {y.shape[-1]} numbers, the observation law {law.mean.shape[-1]}")
        return law.log_prob(y, None if missing == "none" else law.space.observed(y))
    shape = (*law.batch_shape, *law.event_shape)
    if shape[-1:] != y.shape[-1:]:
        raise ValueError(f"the measurement has {y.shape[-1]} numbers, a draw of the observation law is {shape}")
    if missing == "none":
        value = law.log_prob(y)
        return value if law.event_shape else value.sum(-1)
    observed = ~torch.isnan(y)
    # Any number of the support will do; laws without a mean, such as Cauchy's, have 0 in it.
    value = law.log_prob(torch.where(observed, y, law.mean.detach().nan_to_num(0, 0, 0)))
    if not law.event_shape:
        return torch.where(observed, value, 0).sum(-1)
    if not (observed.all(-1) | ~observed.any(-1)).all():
        raise ValueError(
            f"{type(law).__name__} is joint over its components: a measurement must miss all of them or none"
        )
    return torch.where(observed.all(-1), value, 0)


def log_likelihood(model: StateSpaceModel, x: Tensor, step: StepInput) -> Tensor:
    """Log-density (*batch, n) of the measurement at points x (*batch, n, d)."""
    return log_prob(model.conditional("observation", x, step.u, step.dt), step.y, step.missing)


def sample(law: Conditional, noise: Tensor, seed: int) -> Tensor:
    """Draw from a conditional law.

    Args:
        law: one law a row.
        noise: standard normals (..., e), used by a Gaussian.
        seed: used by a torch Distribution, whose own sampler runs under it; the global generator is put back.
    """
    if isinstance(law, Gaussian):
        return law.sample(noise)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return law.rsample() if law.has_rsample else law.sample()
