"""Laws that name what their noise reaches: no numbers are drawn for the rest, and the filter is the same one."""

import numpy as np
import pytest
import torch
from particle_problem import PLANE, bias_score, replicate, series, state_space, tensor

import torchfilt as tf
from torchfilt.moments import unscented
from torchfilt.proposals import Local

DRIVEN = PLANE._replace(Q=np.diag([0.5, 0.0]))


def named(reached):
    laws = state_space(DRIVEN)
    laws.transition.noise_in = reached
    return laws


@pytest.mark.parametrize("reached", [slice(0, 1), [0]])
def test_evidence_stays_unbiased(reached):
    """Two hundred rows of 100 particles, 4.5 standard errors (1 in 150,000)."""
    ys, exact = series(8, model=DRIVEN)
    total = tf.BootstrapFilter(named(reached), 100)(replicate(ys, 200), seed=1).log_likelihood
    z, ratio, error = bias_score(total, exact.log_likelihood.sum())
    assert error < 0.1 and abs(z) < 4.5, (ratio, error)


def test_numbers_are_drawn_for_what_the_noise_reaches_alone():
    filters = [tf.BootstrapFilter(named(reached), 3000) for reached in (None, slice(1, 2))]
    plain, frugal = (f.draw(f.init((2,)).belief, 4, 5) for f in filters)
    assert (plain.proposal != 0).all()
    noise = frugal.proposal
    assert noise.shape == (2, 3000, 2) and noise.dtype == torch.float64
    assert (noise[..., 0] == 0).all()
    # Mean and variance of 6,000 standard normals, 4.5 standard errors (1 in 150,000 each).
    assert abs(noise[..., 1].mean()) < 4.5 / 6000**0.5 and abs(noise[..., 1].var() - 1) < 4.5 * (2 / 6000) ** 0.5
    assert torch.equal(plain.resampling, frugal.resampling)


def test_it_is_a_matter_of_the_draw_alone():
    """With the same numbers a step is the same, to the bit."""
    plain, frugal = (tf.BootstrapFilter(laws, 50) for laws in (state_space(DRIVEN), named(slice(0, 1))))
    belief, y = plain.init((3,)).belief, tensor([[0.2], [0.1], [-0.4]])
    noise = frugal.draw(belief, 0, 2)
    (one, info), (other, _) = (f.advance(belief, y, noise=noise) for f in (plain, frugal))
    assert torch.equal(one.x, other.x) and torch.equal(one.log_weights, other.log_weights)
    # A component that is not driven is where the motion takes it.
    before = belief.x.gather(-2, info.ancestors.unsqueeze(-1).expand(3, 50, 2))
    torch.testing.assert_close(one.x[..., 1], before @ tensor(PLANE.A[1]), rtol=0, atol=1e-15)


def test_a_proposal_of_its_own_draws_everything():
    """Its particles come from Gaussians that have spread in all directions."""
    guided = tf.ParticleFilter(named(slice(0, 1)), 50, Local(unscented(), "always", split=0.0, weights="joint"))
    noise = guided.draw(guided.init().belief, 0, 2).proposal
    assert (noise != 0).all()
