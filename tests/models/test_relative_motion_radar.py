"""Radar geometry against rotation matrices, and its inverse."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import relative_motion_oracle as oracle

from torchfilt.models.relative_motion import (
    RADAR_SPACE,
    BiasedRanging,
    ClohessyWiltshire,
    RendezvousRadar,
    TwoBody,
    WithConstant,
    line_of_sight,
)

RADIUS = 7e6
RADAR = RendezvousRadar(RADIUS)
coordinate = st.floats(-1, 1).filter(lambda v: abs(v) > 1e-3)


@given(st.tuples(coordinate, coordinate, coordinate), st.sampled_from([1.0, 1e3, 1e6]))
@settings(max_examples=60, deadline=None)
def test_geometry_equals_rotation_matrices(direction, size):
    """Tolerance: the oracle subtracts positions of 7e6 m, an angle error of eps 7e6 / range."""
    position = np.array(direction) * size
    ours = RADAR.measure(torch.from_numpy(position)).numpy()
    expected = oracle.radar(position, RADIUS)
    rounding = 16 * np.finfo(float).eps * RADIUS
    # alpha is an angle in the x-y plane: its error grows as the line of sight leaves that plane.
    slant = math.hypot(direction[0], direction[1]) * size
    np.testing.assert_allclose(ours[0], expected[0], rtol=1e-13)
    assert abs(math.remainder(ours[1] - expected[1], 2 * math.pi)) < rounding / (slant * 0.5)
    assert abs(ours[2] - expected[2]) < rounding / (slant * 0.5)


@given(st.tuples(coordinate, coordinate, coordinate), st.sampled_from([1.0, 1e3, 1e6]))
@settings(max_examples=60, deadline=None)
def test_one_measurement_gives_the_position_back(direction, size):
    position = torch.tensor(direction, dtype=torch.float64) * size
    back = RADAR.invert(RADAR.measure(position))
    assert (back - position).abs().max() < 1e-12 * size


def test_the_line_of_sight_is_as_long_as_the_separation():
    position = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 1e5
    sight = line_of_sight(position, RADIUS)
    torch.testing.assert_close(sight.norm(dim=-1), position.norm(dim=-1), rtol=1e-13, atol=0)


def test_float32_angles_keep_their_digits():
    position = torch.tensor([300.0, -370.0, -400.0], dtype=torch.float64)
    error = RADAR.measure(position.float()) - RADAR.measure(position)
    assert error[0].abs() < 8 * 1.2e-7 * 600
    assert error[1:].abs().max() < 16 * 1.2e-7


def test_law_lives_on_a_length_and_two_angles():
    law = RADAR(torch.tensor([[300.0, 1.0, -400.0, 0, 0, 0]], dtype=torch.float64))
    assert law.space == RADAR_SPACE
    expected = torch.tensor([0.1, math.radians(0.05), math.radians(0.05)], dtype=torch.float64) / 3
    torch.testing.assert_close(law.scale_tril, expected)
    # A measurement one turn further on is the same measurement.
    turned = law.mean + torch.tensor([0.0, 2 * math.pi, 0.0], dtype=torch.float64)
    torch.testing.assert_close(law.log_prob(turned), law.log_prob(law.mean))
    own = RendezvousRadar(RADIUS, 1.0, 0.01, torch.tensor(0.02))
    torch.testing.assert_close(own(law.mean).scale_tril, torch.tensor([1.0, 0.01, 0.02]).double())


def test_jacobian_equals_central_differences():
    """Steps of 0.1 m at 600 m: truncation (0.1 / 600)^2 of the slope."""
    x = torch.tensor([300.0, -370.0, -400.0], dtype=torch.float64)
    jacobian = torch.func.jacfwd(RADAR.measure)(x)
    step = 0.1 * torch.eye(3, dtype=torch.float64)
    difference = (RADAR.measure(x + step) - RADAR.measure(x - step)).mT / 0.2
    torch.testing.assert_close(jacobian, difference, rtol=1e-6, atol=1e-10)


def test_field_of_view_hides_what_it_does_not_see():
    limited = RendezvousRadar(RADIUS, field_of_view_rad=math.radians(30))
    y = torch.tensor([[500.0, 0.1, -0.5], [500.0, 0.6, 0.0], [500.0, 0.0, -0.53]], dtype=torch.float64)
    assert limited.in_view(y).tolist() == [True, False, False]
    hidden = limited.hide(y)
    assert torch.equal(hidden[0], y[0])
    assert hidden[1:].isnan().all()
    assert RADAR.in_view(y).all()
    assert torch.equal(RADAR.hide(y), y)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [((-1.0,), "chief_radius"), ((7e6, 0.0), "deviations"), ((7e6, 1.0, 1.0, 1.0, -0.1), "field_of_view")],
)
def test_bad_arguments_are_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        RendezvousRadar(*arguments)


def test_a_constant_rides_along():
    law = ClohessyWiltshire(1e-3, 1e-9, 10.0)
    longer = WithConstant(law, 2)
    x = torch.randn(4, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u = torch.tensor([1e-3, 0, 0], dtype=torch.float64)
    result, inner = longer(x, u, 10.0), law(x[:, :6], u, 10.0)
    assert torch.equal(result.mean, torch.cat([inner.mean, x[:, 6:]], -1))
    assert torch.equal(result.scale_tril[:6, :6], inner.scale_tril)
    assert not result.scale_tril[6:].any()
    matrix, offset, factor = longer.linear_form(u, 10.0)
    torch.testing.assert_close(x @ matrix.mT + offset, result.mean)
    assert torch.equal(factor, result.scale_tril)
    assert not hasattr(WithConstant(TwoBody(0.0), 1), "linear_form")
    assert not hasattr(longer, "pooled")


def test_a_constant_may_drift():
    law = WithConstant(ClohessyWiltshire(1e-3, 1e-9), 1, drift_psd=1e-4)
    factor = law(torch.zeros(3, 7).double(), None, torch.tensor([[1.0], [4.0], [0.0]]).double()).scale_tril
    torch.testing.assert_close(factor[:, 6, 6], torch.tensor([0.01, 0.02, 0.0], dtype=torch.float64))
    with pytest.raises(ValueError, match="time step"):
        WithConstant(ClohessyWiltshire(1e-3, 1e-9, 10.0), 1, drift_psd=1e-4)(torch.zeros(7).double())


def test_constants_pool_and_stay_diagonal():
    """Inner laws with a pooled noise or a diagonal factor keep both."""

    class Inner(torch.nn.Module):
        def forward(self, x, u=None, dt=None):
            from torchfilt.gaussian import Gaussian

            return Gaussian(x, torch.ones_like(x), is_diagonal=True)

        def pooled(self, x, weights, u=None, dt=None):
            return self(x)._replace(scale_tril=torch.ones(*x.shape[:-2], 1, x.shape[-1]))

    law = WithConstant(Inner(), 1)
    assert law(torch.zeros(5, 4)).scale_tril.tolist() == [[1, 1, 1, 0]] * 5
    pooled = law.pooled(torch.zeros(2, 5, 4), torch.full((5,), 0.2))
    assert pooled.mean.shape == (2, 5, 4)
    assert pooled.scale_tril.shape == (2, 1, 4)


@pytest.mark.parametrize("arguments", [(0,), (1, -1.0)])
def test_bad_constants_are_named(arguments):
    with pytest.raises(ValueError, match=r">= 0|at least 1"):
        WithConstant(TwoBody(0.0), *arguments)


def test_ranging_adds_its_bias_to_the_range_only():
    x = torch.tensor([-3700.0, 225e3, 1e3, 0, 0, 0, -0.012], dtype=torch.float64)
    law = BiasedRanging(6.84e6, 0.01, 3e-4, 3e-4)(x)
    plain = RendezvousRadar(6.84e6).measure(x)
    torch.testing.assert_close(
        law.mean - plain, torch.tensor([-0.012, 0, 0]).double(), rtol=0, atol=8 * 225e3 * 2.3e-16
    )
    torch.testing.assert_close(law.scale_tril, torch.tensor([0.01, 3e-4, 3e-4]).double())
