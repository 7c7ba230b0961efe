"""The particle methods of the literature: each is the one loop with its own parts."""

from collections.abc import Sequence

from torchfilt.filters.particle import ParticleFilter
from torchfilt.gates import Gate
from torchfilt.kernels import Regularize
from torchfilt.model import StateSpaceModel
from torchfilt.moments import Rule, taylor, unscented
from torchfilt.moves import MetropolisHastings, Target
from torchfilt.proposals import Local, LookAhead, Prior, Redraw, Weights
from torchfilt.rao_blackwell import RaoBlackwellized
from torchfilt.resampling import Resampler, ess_below, systematic


def BootstrapFilter(
    model: StateSpaceModel,
    particles: int = 1000,
    resampler: Resampler = systematic,
    move: MetropolisHastings | None = None,
    fast_normals: bool = False,
) -> ParticleFilter:
    """Particles moved by the transition law and weighted by the measurement.

    Source: Gordon, Salmond, Smith, IEE Proceedings F 140 (1993).
    """
    return ParticleFilter(model, particles, Prior(), resampler, move, fast_normals)


def UnscentedParticleFilter(
    model: StateSpaceModel,
    particles: int = 200,
    rule: Rule | None = None,
    split: float | None = 0.6,
    redraw: Redraw = "always",
    pooled: bool = True,
    weights: Weights = "marginal",
    resampler: Resampler | None = None,
    move: MetropolisHastings | None = None,
) -> ParticleFilter:
    """An unscented Kalman filter for each particle, uncertainty shared between spread and local covariance.

    The default keeps the fraction ``split`` of the cloud's covariance in each particle and moment-matches the redrawn
    centres, which is what makes the method robust; ``pooled=False, split=0.0, weights="joint"`` is the proper
    importance sampler of van der Merwe et al., ``split=None`` the literal form that keeps each P_i in full as well.

    Sources: van der Merwe, Doucet, de Freitas, Wan, NIPS 13 (2000); Wei, Song, Zhang (2012), equation 7.
    """
    local = Local(rule or unscented(), redraw, split, pooled, weights)
    return ParticleFilter(model, particles, local, resampler or ess_below(0.5), move)


def LocallyLinearizedParticleFilter(
    model: StateSpaceModel,
    particles: int = 100,
    rule: Rule | None = None,
    split: float | None = 0.5,
    redraw: Redraw = "never",
    pooled: bool = False,
    weights: Weights = "marginal",
    resampler: Resampler | None = None,
    gate: Gate | None = None,
    iterations: int = 1,
) -> ParticleFilter:
    """A bank of Gaussian filters with weights: the same loop and proposal as the unscented particle filter.

    Particles start as draws that hold the share 1 - split of the prior's covariance and are not redrawn, because
    drawing from a covariance that is also kept counts it twice. Works on any space, so that with a `UnitQuaternion` in
    it each particle is a quaternion filter of its own. The literal form draws each particle anew at every step and
    weights it by prior times likelihood over proposal: ``redraw="always", split=None, weights="joint"``.
    """
    local = Local(rule or unscented(), redraw, split, pooled, weights, gate, iterations)
    return ParticleFilter(model, particles, local, resampler or ess_below(0.5))


def AuxiliaryParticleFilter(
    model: StateSpaceModel,
    particles: int = 1000,
    power: float = 1.0,
    resampler: Resampler = systematic,
    fast_normals: bool = False,
) -> ParticleFilter:
    """Particles are resampled by how well their predicted mean explains the measurement that comes next.

    ``power`` below 1 flattens that look ahead: a sharp likelihood at a point says too much of a wide transition.

    Source: Pitt and Shephard, Filtering via simulation: auxiliary particle filters, JASA 94 (1999).
    """
    return ParticleFilter(model, particles, Prior(), resampler, look_ahead=LookAhead(power), fast_normals=fast_normals)


def RegularizedParticleFilter(
    model: StateSpaceModel,
    particles: int = 1000,
    kernel: Regularize | None = None,
    resampler: Resampler = systematic,
    fast_normals: bool = False,
) -> ParticleFilter:
    """A bootstrap filter whose resampled particles are drawn anew from a kernel around each.

    The default kernel keeps mean and covariance of the cloud, ``Regularize(keep_moments=False)`` is the plain one.

    Source: Musso, Oudjane, Le Gland, Improving regularised particle filters (2001).
    """
    kernel = Regularize() if kernel is None else kernel
    return ParticleFilter(model, particles, Prior(), resampler, kernel=kernel, fast_normals=fast_normals)


def RaoBlackwellizedParticleFilter(
    model: StateSpaceModel,
    particles: int = 200,
    *,
    drawn: slice | Sequence[int],
    rule: Rule | None = None,
    shared: bool = False,
    resampler: Resampler | None = None,
) -> ParticleFilter:
    """Particles over the ``drawn`` error components, each with a Gaussian over the others.

    Everything drawn, ``slice(None)``, is the bootstrap filter, nothing, ``()``, the Gaussian filter of ``rule``. With
    ``shared`` all particles of a row have the derivatives at its mean, and one covariance.

    Source: Schon, Gustafsson, Nordlund, IEEE TSP 53 (2005).
    """
    proposal = RaoBlackwellized(drawn, rule or taylor(), shared)
    return ParticleFilter(model, particles, proposal, resampler or ess_below(0.5))


def ResampleMoveParticleFilter(
    model: StateSpaceModel,
    particles: int = 1000,
    window: int = 1,
    steps: int = 1,
    scale: float | None = None,
    target: Target = "predictive",
    kernel: Regularize | None = None,
    resampler: Resampler = systematic,
    fast_normals: bool = False,
) -> ParticleFilter:
    """A bootstrap filter that moves the last ``window`` states of each particle together after every measurement.

    On the predictive target the kernel of a regularised filter becomes a proposal: a shrinking step at the start of the
    window, its normals matched to the cloud; the states after it are resampled locally, by their own noise, and the
    measurements of the window accept or refuse the whole. With a single state a kernel that keeps the moments follows
    each resampling as well, `Regularize()` where ``kernel`` is None; longer windows go with none. On the target
    "transition", the literal density, which is of no use where process noise is singular, None means no kernel.

    Arguments as in `torchfilt.moves.MetropolisHastings` and `ParticleFilter`.

    Sources: Gilks and Berzuini, Following a moving target, JRSS B 63 (2001); Musso, Oudjane, Le Gland, Improving
    regularised particle filters (2001).
    """
    predictive = target == "predictive"
    if kernel is None and predictive and window == 1:
        kernel = Regularize()
    move = MetropolisHastings(steps, scale, target, window, matched=predictive)
    return ParticleFilter(model, particles, Prior(), resampler, move, fast_normals, kernel=kernel)
