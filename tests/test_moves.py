"""Metropolis-Hastings: the target is left as it is, and what cannot be reached is refused."""

import numpy as np
import pytest
import torch
from particle_problem import PLANE, gaussian, replicate, series, state_space, tensor
from scipy import stats

import torchfilt as tf
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
    """Apply a move by hand; particles are equally weighted."""
    before, after = (
        tf.Particles(x, torch.full(x.shape[:-1], -np.log(x.shape[-2]), dtype=x.dtype)) for x in (parents, children)
    )
    generator = torch.Generator().manual_seed(seed)
    noise = tf.StepNoise(
        None,
        torch.zeros(1, dtype=torch.float64),
        move_normal=torch.randn(move.steps, *children.shape, generator=generator, dtype=torch.float64),
        move_uniform=torch.rand(move.steps, *children.shape[:-1], generator=generator, dtype=torch.float64),
    )
    return move(model, before, after, StepInput(y.expand(len(parents), 1, -1), None, None, noise, "none"))


@pytest.mark.parametrize("scale", [None, 0.3, 3.0])
def test_transition_target_is_invariant(scale):
    """Children drawn exactly from p(x | y, parent), walked 20 times: their whitened errors stay standard normal.

    A move that accepted everything, or refused by the wrong ratio, would widen or narrow them; see the next test.
    """
    model, parents, children, y, mean, root = exact_posterior(20, 200, 1)
    moved = walk(MetropolisHastings(20, scale), model, parents, children, y)
    assert (moved.x != children).any(-1).double().mean() > 0.8
    z = torch.linalg.solve_triangular(root, (moved.x - mean).mT, upper=False).mT.reshape(-1, 2)
    for component in z.mT:
        assert stats.kstest(component.numpy(), "norm").pvalue > FALSE_ALARM


def test_the_invariance_test_would_see_a_wrong_ratio():
    """Without the ratio (walks accepted blindly) and with the prior left out, the same test fails by far."""
    model, parents, children, y, mean, root = exact_posterior(20, 200, 1)
    generator = torch.Generator().manual_seed(5)
    blind = children + 0.5 * torch.randn(children.shape, generator=generator, dtype=torch.float64)
    flat = tf.StateSpaceModel(model.initial, tf.LinearGaussian(tensor(PLANE.A), 4 * tensor(PLANE.Q)), model.observation)
    wrong = walk(MetropolisHastings(20), flat, parents, children, y).x
    for x in (blind, wrong):
        z = torch.linalg.solve_triangular(root, (x - mean).mT, upper=False).mT.reshape(-1, 2)
        assert stats.kstest(z[:, 0].numpy(), "norm").pvalue < 1e-8


def test_predictive_target_is_invariant():
    """p(y|x) N(x; predicted cloud): exact draws of it stay so. Large n makes the fitted cloud the exact prediction."""
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
    moved = walk(MetropolisHastings(15, target="predictive"), model, parents, children, ys[0])
    assert (moved.x != children).any(-1).double().mean() > 0.9
    z = torch.linalg.solve_triangular(root, (moved.x - mean.unsqueeze(-2)).mT, upper=False).mT.reshape(-1, 2)
    for component in z.mT:
        assert stats.kstest(component.numpy(), "norm").pvalue > FALSE_ALARM


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
    assert rates.shape == (3, 600) and 0.2 < rates.mean() < 0.6
    final = history.final.belief
    uniforms = torch.rand(600, 1, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    # One particle a row, drawn by the weights.
    picked = (final.weights.cumsum(-1) < uniforms).sum(-1).clamp_max(399)
    draws = final.x[torch.arange(600), picked].numpy()
    root = np.linalg.cholesky(exact.covariance[-1])
    z = np.linalg.solve(root, (draws - exact.mean[-1]).T)
    for component in z:
        assert stats.kstest(component, "norm").pvalue > FALSE_ALARM


def test_moves_leave_the_evidence_unbiased():
    """The move comes after the weights, so the estimate's mean stays exact: z-score below 4.5 (1 in 150,000)."""
    ys, exact = series(3)
    filter = tf.BootstrapFilter(state_space(PLANE), 30, ess_below(0.7), MetropolisHastings(2))
    ratio = (filter(replicate(ys, 6000), seed=6).log_likelihood - exact.log_likelihood.sum()).exp()
    error = ratio.std() / 6000**0.5
    assert error < 0.01 and abs(ratio.mean() - 1) < 4.5 * error


def test_copies_part_again():
    """After resampling many particles are copies; a few walks make nearly all distinct."""
    model = state_space(PLANE._replace(Q=1e-6 * np.eye(2)))
    ys = tensor([[4.0], [4.0], [4.0]])
    spread = {}
    for move in (None, MetropolisHastings(10, target="predictive")):
        history = tf.BootstrapFilter(model, 200, systematic, move)(ys, seed=7)
        rounded = (history.final.belief.x / 0.05).round()
        spread[move is None] = len(torch.unique(rounded, dim=0))
    assert spread[False] > 3 * spread[True], spread


def test_singular_process_noise_refuses_every_walk_on_the_transition():
    """Rank-one noise: a walk leaves the law's support almost surely, so acceptance is zero and the filter is plain."""
    push = tensor([[0.5], [1.0]])
    model = tf.StateSpaceModel(
        gaussian(tensor([0.3, -0.2]), torch.eye(2).double()),
        tf.LinearGaussian(tensor([[1.0, 0.5], [0.0, 1.0]]), push @ push.mT * 0.1),
        tf.LinearGaussian(tensor([[1.0, 0.0]]), tensor([[0.5]])),
    )
    ys = tensor([[0.4], [0.9], [0.7]])
    plain = tf.BootstrapFilter(model, 100)(ys, seed=8)
    on_law = tf.BootstrapFilter(model, 100, move=MetropolisHastings(3))(ys, seed=8)
    on_cloud = tf.BootstrapFilter(model, 100, move=MetropolisHastings(3, target="predictive"))(ys, seed=8)
    assert (on_law.diagnostics.acceptance_rate == 0).all()
    assert torch.equal(on_law.mean, plain.mean)
    assert (on_cloud.diagnostics.acceptance_rate > 0.2).all()
    assert plain.diagnostics.acceptance_rate is None


def test_smaller_steps_are_accepted_more_often():
    ys, _ = series(3)
    rates = []
    for scale in (0.1, 0.5, 2.0, 8.0):
        move = MetropolisHastings(3, scale)
        history = tf.BootstrapFilter(state_space(PLANE), 200, move=move)(replicate(ys, 20), seed=9)
        rates.append(history.diagnostics.acceptance_rate.mean().item())
    assert rates == sorted(rates, reverse=True) and rates[0] > 0.9 and rates[-1] < 0.1


def test_default_scale_is_the_optimal_one():
    """2.38 / sqrt(e) in two dimensions."""
    ys, _ = series(2)
    one = tf.BootstrapFilter(state_space(PLANE), 50, move=MetropolisHastings(2))(ys, seed=1)
    other = tf.BootstrapFilter(state_space(PLANE), 50, move=MetropolisHastings(2, 2.38 / 2**0.5))(ys, seed=1)
    assert torch.equal(one.mean, other.mean)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(steps=0), "steps must be at least 1, got 0"),
        (dict(scale=0.0), "scale must be positive, got 0.0"),
        (dict(scale=float("nan")), "scale must be positive, got nan"),
        (dict(target="posterior"), "target must be .* got 'posterior'"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        MetropolisHastings(**arguments)
