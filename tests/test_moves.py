"""Metropolis-Hastings on the newest state: the target is left as it is, and what cannot be reached is refused."""

import numpy as np
import pytest
import torch
from particle_problem import PLANE, gaussian, replicate, series, state_space, tensor
from scipy import stats

import torchfilt as tf
from torchfilt.kernels import optimal_bandwidth
from torchfilt.moves import MetropolisHastings
from torchfilt.resampling import ess_below, systematic
from torchfilt.types import StepInput

# One Kolmogorov-Smirnov test raises a false alarm with this probability.
FALSE_ALARM = 1e-5


def exact_posterior(rows, n, seed):
    """One step of the linear model from points: particles drawn exactly from p(x | y, x_before) with p's weights.

    Returns the model, the parents (equal weights), children (*rows, n, 2) of the exact law given each parent, and y.
    """
    model, (ys, _) = state_space(PLANE), series(1)
    A, Q, H, R, m0, P0 = (tensor(part) for part in PLANE)
    generator = torch.Generator().manual_seed(seed)
    parents = m0 + torch.randn(rows, n, 2, generator=generator, dtype=torch.float64) @ torch.linalg.cholesky(P0).mT
    gain = Q @ H.mT @ torch.linalg.inv(H @ Q @ H.mT + R)
    ahead = parents @ A.mT
    mean = ahead + (ys[0] - ahead @ H.mT) @ gain.mT
    root = torch.linalg.cholesky(Q - gain @ H @ Q)
    children = mean + torch.randn(rows, n, 2, generator=generator, dtype=torch.float64) @ root.mT
    return model, parents, children, ys[0], mean, root


def walk(move, model, parents, children, y, seed=0):
    """Apply a move by hand; particles are equally weighted. Gives the points."""
    before, after = (
        tf.Particles(x, torch.full(x.shape[:-1], -np.log(x.shape[-2]), dtype=x.dtype)) for x in (parents, children)
    )
    generator = torch.Generator().manual_seed(seed)
    noise = tf.StepNoise(
        None,
        torch.zeros(1, dtype=torch.float64),
        move_normal=torch.randn(move.steps, 1, *children.shape, generator=generator, dtype=torch.float64),
        move_uniform=torch.rand(move.steps, *children.shape[:-1], generator=generator, dtype=torch.float64),
    )
    moved = move(model, before, after, StepInput(y.expand(len(parents), 1, -1), None, None, noise, "none"))
    assert moved.particles.past == ()
    return moved.particles.x


@pytest.mark.parametrize("scale", [None, 0.3, 3.0])
def test_transition_target_is_invariant(scale):
    """Children drawn exactly from p(x | y, parent), walked 20 times: their whitened errors stay standard normal.

    A move that accepted everything, or refused by the wrong ratio, would widen or narrow them; see the next test.
    """
    model, parents, children, y, mean, root = exact_posterior(20, 200, 1)
    moved = walk(MetropolisHastings(20, scale), model, parents, children, y)
    assert (moved != children).any(-1).double().mean() > 0.8
    z = torch.linalg.solve_triangular(root, (moved - mean).mT, upper=False).mT.reshape(-1, 2)
    for component in z.mT:
        assert stats.kstest(component.numpy(), "norm").pvalue > FALSE_ALARM


def test_the_invariance_test_would_see_a_wrong_ratio():
    """Without the ratio (walks accepted blindly) and with the prior left out, the same test fails by far."""
    model, parents, children, y, mean, root = exact_posterior(20, 200, 1)
    generator = torch.Generator().manual_seed(5)
    blind = children + 0.5 * torch.randn(children.shape, generator=generator, dtype=torch.float64)
    flat = tf.StateSpaceModel(model.initial, tf.LinearGaussian(tensor(PLANE.A), 4 * tensor(PLANE.Q)), model.observation)
    wrong = walk(MetropolisHastings(20), flat, parents, children, y)
    for x in (blind, wrong):
        z = torch.linalg.solve_triangular(root, (x - mean).mT, upper=False).mT.reshape(-1, 2)
        assert stats.kstest(z[:, 0].numpy(), "norm").pvalue < 1e-8


@pytest.mark.parametrize(("scale", "matched"), [(None, False), (0.9, False), (1.0, False), (0.6, True)])
def test_predictive_target_is_invariant(scale, matched):
    """p(y|x) N(x; predicted cloud): exact draws of it stay so, also where every draw is a new one (scale 1)."""
    model, (ys, _) = state_space(PLANE), series(1)
    A, Q, H, R, m0, P0 = (tensor(part) for part in PLANE)
    rows, n = 8, 2000
    generator = torch.Generator().manual_seed(2)
    parents = m0 + torch.randn(rows, n, 2, generator=generator, dtype=torch.float64) @ torch.linalg.cholesky(P0).mT
    ahead = parents @ A.mT
    # The move fits the cloud it was given, so each row has its own target.
    centre = ahead.mean(-2)
    apart = ahead - centre.unsqueeze(-2)
    P = apart.mT @ apart / n + Q
    S = H @ P @ H.mT + R
    gain = P @ H.mT / S
    mean = centre + ((ys[0] - centre @ H.mT).unsqueeze(-1) * gain.mT).sum(-2)
    root = torch.linalg.cholesky(P - gain @ H @ P)
    children = mean.unsqueeze(-2) + torch.randn(rows, n, 2, generator=generator, dtype=torch.float64) @ root.mT
    move = MetropolisHastings(40 if scale is None else 15, scale, "predictive", matched=matched)
    moved = walk(move, model, parents, children, ys[0])
    assert (moved != children).any(-1).double().mean() > 0.9
    z = torch.linalg.solve_triangular(root, (moved - mean.unsqueeze(-2)).mT, upper=False).mT.reshape(-1, 2)
    for component in z.mT:
        assert stats.kstest(component.numpy(), "norm").pvalue > FALSE_ALARM


def moments(x):
    apart = x - x.mean(-2, keepdim=True)
    return torch.cat([x.mean(-2), (apart.mT @ apart / x.shape[-2]).flatten(-2)], -1)


def test_matched_normals_leave_mean_and_covariance_of_the_cloud_alone():
    """Nothing is measured, so each step is accepted, and a cloud that is its own fit keeps both to rounding.

    Plain normals change them by n^-1/2. Of 4 particles in two dimensions a match would ask too much: they stay plain.
    """
    A, Q, H, R, _, _ = (tensor(part) for part in PLANE)
    prior = gaussian(tensor([0.0, 0.0]), Q)
    model = tf.StateSpaceModel(prior, tf.LinearGaussian(A, scale_tril=0 * Q), tf.LinearGaussian(H, 1e16 * R))
    change = {}
    for n in (4, 2000):
        parents = torch.randn(3, n, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        children = parents @ A.mT
        for matched in (False, True):
            move = MetropolisHastings(3, 0.6, "predictive", matched=matched)
            moved = walk(move, model, parents, children, tensor([0.0]))
            assert (moved != children).all()
            change[n, matched] = (moments(moved) - moments(children)).abs().amax().item()
    assert change[2000, True] < 1e-12 and change[2000, False] > 1e-3
    assert change[4, True] == change[4, False] > 1e-3


@pytest.mark.parametrize("target", ["transition", "predictive"])
def test_filtering_marginal_is_kept_through_a_whole_filter(target):
    """Many walks a step leave the exact filtering law: one resampled particle a row, 600 rows, against N(m, P).

    Bias of order 1/n with n = 400 is far below what 600 draws resolve (2 % of a standard deviation of 4 %).
    """
    ys, exact = series(3)
    move = MetropolisHastings(10, target=target)
    history = tf.BootstrapFilter(state_space(PLANE), 400, move=move)(replicate(ys, 600), seed=3)
    assert history.diagnostics.ok.all()
    rates = history.diagnostics.acceptance_rate
    assert rates.shape == (3, 600)
    assert 0.2 < rates.mean() < 0.6 if target == "transition" else rates.mean() > 0.7
    final = history.final.belief
    uniforms = torch.rand(600, 1, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    # One particle a row, drawn by the weights.
    picked = (final.weights.cumsum(-1) < uniforms).sum(-1).clamp_max(399)
    draws = final.x[torch.arange(600), picked].numpy()
    root = np.linalg.cholesky(exact.covariance[-1])
    z = np.linalg.solve(root, (draws - exact.mean[-1]).T)
    for component in z:
        assert stats.kstest(component, "norm").pvalue > FALSE_ALARM


@pytest.mark.parametrize("window", [1, 3])
def test_moves_leave_the_evidence_unbiased(window):
    """The move comes after the weights, so the estimate's mean stays exact: z-score below 4.5 (1 in 150,000)."""
    ys, exact = series(3)
    filter = tf.BootstrapFilter(state_space(PLANE), 30, ess_below(0.7), MetropolisHastings(2, window=window))
    ratio = (filter(replicate(ys, 6000), seed=6).log_likelihood - exact.log_likelihood.sum()).exp()
    error = ratio.std() / 6000**0.5
    assert error < 0.01 and abs(ratio.mean() - 1) < 4.5 * error
    assert filter.evidence == "unbiased"
    assert tf.BootstrapFilter(state_space(PLANE), 30, move=MetropolisHastings(target="predictive")).evidence == (
        "approximate"
    )


def test_copies_part_again():
    """After resampling many particles are copies; a few walks make nearly all distinct."""
    model = state_space(PLANE._replace(Q=1e-6 * np.eye(2)))
    ys = tensor([[4.0], [4.0], [4.0]])
    spread = {}
    for window in (0, 1, 3):
        move = MetropolisHastings(10, target="predictive", window=window) if window else None
        history = tf.BootstrapFilter(model, 200, systematic, move)(ys, seed=7)
        rounded = (history.final.belief.x / 0.05).round()
        spread[window] = len(torch.unique(rounded, dim=0))
    assert spread[1] > 3 * spread[0] and spread[3] > 3 * spread[0], spread


@pytest.mark.parametrize("window", [1, 3])
def test_singular_process_noise_refuses_every_walk_on_the_transition(window):
    """Rank-one noise: a walk leaves the law's support almost surely, so acceptance is zero and the filter is plain."""
    push = tensor([[0.5], [1.0]])
    model = tf.StateSpaceModel(
        gaussian(tensor([0.3, -0.2]), torch.eye(2).double()),
        tf.LinearGaussian(tensor([[1.0, 0.5], [0.0, 1.0]]), push @ push.mT * 0.1),
        tf.LinearGaussian(tensor([[1.0, 0.0]]), tensor([[0.5]])),
    )
    ys = tensor([[0.4], [0.9], [0.7], [1.2]])
    plain = tf.BootstrapFilter(model, 100)(ys, seed=8)
    on_law = tf.BootstrapFilter(model, 100, move=MetropolisHastings(3, window=window))(ys, seed=8)
    predictive = MetropolisHastings(3, target="predictive", window=window)
    on_cloud = tf.BootstrapFilter(model, 100, move=predictive)(ys, seed=8)
    assert (on_law.diagnostics.acceptance_rate == 0).all()
    assert torch.equal(on_law.mean, plain.mean)
    assert (on_cloud.diagnostics.acceptance_rate > 0.4).all()
    assert plain.diagnostics.acceptance_rate is None


@pytest.mark.parametrize(
    ("target", "scales", "least"), [("transition", (0.1, 0.5, 2.0, 8.0), 0.1), ("predictive", (0.1, 0.3, 0.6, 1), 0.7)]
)
def test_smaller_steps_are_accepted_more_often(target, scales, least):
    ys, _ = series(3)
    rates = []
    for scale in scales:
        move = MetropolisHastings(3, scale, target)
        history = tf.BootstrapFilter(state_space(PLANE), 200, move=move)(replicate(ys, 20), seed=9)
        rates.append(history.diagnostics.acceptance_rate.mean().item())
    assert rates == sorted(rates, reverse=True) and rates[0] > 0.9 and rates[-1] < least


@pytest.mark.parametrize(
    ("options", "scale"),
    [
        (dict(), 2.38 / 2**0.5),
        (dict(window=3), 2.38 / 4**0.5),  # two steps in: two states of two numbers each
        (dict(target="predictive"), optimal_bandwidth(2, 50)),
        (dict(target="predictive", window=2), optimal_bandwidth(2, 50)),
    ],
)
def test_default_scale_is_the_optimal_one(options, scale):
    ys, _ = series(2)
    one = tf.BootstrapFilter(state_space(PLANE), 50, move=MetropolisHastings(2, **options))
    other = tf.BootstrapFilter(state_space(PLANE), 50, move=MetropolisHastings(2, scale, **options))
    state, _ = one.step(one.init((), 1), ys[0])
    assert torch.equal(one.step(state, ys[1])[0].belief.x, other.step(state, ys[1])[0].belief.x)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(steps=0), "steps must be at least 1, got 0"),
        (dict(window=0), "window must be at least 1, got 0"),
        (dict(scale=0.0), "scale must be positive, got 0.0"),
        (dict(scale=float("nan")), "scale must be positive, got nan"),
        (dict(scale=1.5, target="predictive"), r"scale must be in \(0, 1\], .*got 1.5"),
        (dict(target="posterior"), "target must be .* got 'posterior'"),
        (dict(matched=True), "matched normals belong to .* target='predictive'"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        MetropolisHastings(**arguments)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_predictive_move_adds_one_likelihood_a_step(steps):
    """The law that the proposal made and the likelihood that weighted it are used again."""
    calls = {"motion": 0, "sensor": 0}

    def motion(x):
        calls["motion"] += 1
        return 0.9 * x

    def sensor(x):
        calls["sensor"] += 1
        return x[..., :1]

    Q, R = tensor(PLANE.Q), tensor(PLANE.R)
    model = tf.StateSpaceModel(
        gaussian(tensor([0.0, 0.0]), Q), tf.AdditiveGaussian(motion, Q), tf.AdditiveGaussian(sensor, R)
    )
    filter = tf.BootstrapFilter(model, 20, move=MetropolisHastings(steps, target="predictive"))
    state = filter.init((2,), 0)
    filter.step(state, tensor([[0.1], [0.2]]))
    assert calls == {"motion": 1, "sensor": 1 + steps}
