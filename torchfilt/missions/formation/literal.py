"""The unscented particle filter as the formation study prints it: a failure kept on purpose, to be shown and tested."""

from dataclasses import dataclass

from torch import Tensor

from torchfilt.gaussian import Gaussian
from torchfilt.model import Conditional, StateSpaceModel, log_likelihood, log_prob
from torchfilt.moments import Rule, predict, unscented, update
from torchfilt.particles import Particles
from torchfilt.proposals import Evidence, Local, Proposed
from torchfilt.types import StepInput


@dataclass(frozen=True)
class EquationSeven:
    """Carried covariances P_i, draws from all of N(x_i+, P_i+), weights p(y|x) p(x|x_i) / N(x; x_i+, P_i+).

    The draw spreads over P_i, which holds the uncertainty of the start, and the transition density p(x|x_i) is as
    narrow as one step's process noise: almost no draw lies where its own ancestor can have gone, all weight falls on
    one particle, and what it says is chance. `torchfilt.proposals.Local` puts the same kernel into both densities.

    Args:
        rule: moment rule of each particle.

    Source: Wei, Song, Zhang (2012), equation 7; its transition density p(x_k | x_{k-1}^i) read as printed.
    """

    rule: Rule
    evidence: Evidence = "approximate"
    draws_at_once: bool = True
    needs_redraw_noise: bool = False
    leaves_points: bool = False

    def start(self, initial: Conditional, draws: Tensor, noise: Tensor) -> Particles:
        """Draws of the prior that also carry all of its covariance."""
        return Local(self.rule, "always", None, weights="joint").start(initial, draws, noise)

    def refresh(self, particles: Particles, noise: Tensor | None, resampled: Tensor | None) -> Particles:
        """Nothing is shared anew."""
        return particles

    def __call__(self, model: StateSpaceModel, particles: Particles, step: StepInput) -> Proposed:
        """Arguments as in `torchfilt.proposals.Local`."""
        assert step.noise.proposal is not None and particles.scale_tril is not None
        bank = Gaussian(particles.x, particles.scale_tril, particles.space)
        u, dt = step.u, step.dt
        predicted = predict(model.moments("transition"), bank, self.rule, u, dt) if step.move else bank
        sensor = model.moments("observation")
        posterior = update(sensor, predicted, step.y, self.rule, step.missing, u=u, dt=dt).belief
        x = posterior.sample(step.noise.proposal)
        came = log_prob(model.conditional("transition", particles.x, u, dt), x) if step.move else bank.log_prob(x)
        log_weight = log_likelihood(model, x, step) + came - posterior.log_prob(x)
        return Proposed(x, posterior.scale_tril, log_weight, posterior.space)


def literal_proposal() -> EquationSeven:
    """With the unscented rule."""
    return EquationSeven(unscented())
