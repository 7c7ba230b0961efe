"""A state-space model is three laws: initial, transition, observation."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from torchfilt.gaussian import Gaussian
from torchfilt.laws import adapt, check_finite
from torchfilt.linalg import psd_factor
from torchfilt.noise import NoiseSource

Conditional = Gaussian | Distribution


class StateSpaceModel(nn.Module):
    """Initial law, transition law x_t | x_{t-1}, u_t, dt_t and measurement law y_t | x_t.

    Args:
        initial: a `Gaussian`, a `torch.distributions.Distribution`, or a module that returns one when called.
        transition: law called as ``transition(x, u, dt)``; arguments it does not take are left out.
        observation: law called as ``observation(x)``.
    """

    def __init__(
        self,
        initial: Gaussian | Distribution | nn.Module,
        transition: Callable[..., Conditional],
        observation: Callable[..., Conditional],
    ) -> None:
        super().__init__()
        self.initial = initial if isinstance(initial, nn.Module) else InitialLaw(initial)
        self.transition = transition
        self.observation = observation


class InitialLaw(nn.Module):
    """Holds the prior, so that it moves with the module; parameters stay parameters."""

    def __init__(self, law: Gaussian | Distribution) -> None:
        super().__init__()
        self._distribution: Distribution | None = None
        if isinstance(law, Distribution):
            self._distribution = law
            return
        if not isinstance(law, Gaussian):
            raise TypeError(f"initial must be a Gaussian, a torch Distribution or a module, got {type(law).__name__}")
        check_finite(law.mean, "initial mean")
        check_finite(law.scale_tril, "initial scale_tril")
        expected = law.space.tangent_size if law.space.tangent_size is not None else law.mean.shape[-1]
        if law.scale_tril.shape[-1] != expected:
            raise ValueError(f"initial scale_tril must end in {expected}, got {tuple(law.scale_tril.shape)}")
        for name, tensor in (("mean", law.mean), ("scale_tril", law.scale_tril)):
            if isinstance(tensor, nn.Parameter):
                self.register_parameter(name, tensor)
            elif tensor.requires_grad:
                setattr(self, name, tensor)
            else:
                self.register_buffer(name, tensor.clone())
        self.space, self.is_diagonal = law.space, law.is_diagonal

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
    covariance = getattr(law, "covariance_matrix", None)
    if covariance is not None:
        return Gaussian(law.mean, psd_factor(covariance))
    return Gaussian(law.mean, law.variance.sqrt(), is_diagonal=True)


def gaussian_law(law: Callable[..., Conditional]) -> Callable[..., Gaussian]:
    """The law with its signature filled up and its result adapted by moments."""
    if hasattr(law, "linear_form") or hasattr(law, "pooled"):
        return law  # type: ignore[return-value]
    call = adapt(law)
    return lambda x, u=None, dt=None: as_gaussian(call(x, u, dt))  # type: ignore[arg-type]


def log_prob(law: Conditional, y: Tensor, observed: Tensor | None = None) -> Tensor:
    """Log-density of y (..., d); components that are not ``observed`` are integrated out.

    Raises:
        ValueError: a joint torch Distribution of several components cannot drop only some of them.
    """
    if isinstance(law, Gaussian):
        return law.log_prob(y, observed)
    if observed is None:
        value = law.log_prob(y)
        return value if law.event_shape else value.sum(-1)
    filled = torch.where(torch.isnan(y), law.mean.detach(), y)
    value = law.log_prob(filled)
    if not law.event_shape:
        return torch.where(observed, value, 0).sum(-1)
    if not (observed.all(-1) | ~observed.any(-1)).all():
        raise ValueError(
            f"{type(law).__name__} is joint over its components: a measurement must miss all of them or none"
        )
    return torch.where(observed.all(-1), value, 0)


def sample(law: Conditional, noise: Tensor, source: NoiseSource, step: int, stream: int) -> Tensor:
    """Draw from a conditional law: a Gaussian uses ``noise``, a torch Distribution its own sampler under a forked seed."""
    if isinstance(law, Gaussian):
        return law.sample(noise)
    seed = source.generator(step, stream, torch.device("cpu")).initial_seed()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return law.rsample() if law.has_rsample else law.sample()
