"""Clohessy-Wiltshire law against matrix exponentials."""

import numpy as np
import pytest
import torch
from oracles import relative_motion_oracle as oracle

from torchfilt.models.relative_motion import ClohessyWiltshire, cw_input, cw_noise_factor, cw_transition

N = 1.078e-3
TIMES = [0.01, 10.0, 600.0, 3000.0, 5800.0]


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


# Lengths and times of the orbit: states divided by UNIT are dimensionless.
UNIT = np.repeat([1.0, N], 3)


@pytest.mark.parametrize("t", TIMES)
def test_transition_and_input_equal_the_matrix_exponential(t):
    """Tolerance: 1e-14 times the size of the exponential, which the oracle reaches by squaring."""
    transition, push, _ = oracle.cw_step(N * t)
    tolerance = 1e-14 * np.exp(2 * N * t)
    ours = cw_transition(tensor(N), tensor(t)).numpy() / UNIT[:, None] * UNIT
    np.testing.assert_allclose(ours, transition, rtol=0, atol=tolerance)
    held = cw_input(tensor(N), tensor(t)).numpy() / UNIT[:, None] * N**2
    np.testing.assert_allclose(held, push, rtol=0, atol=tolerance)


@pytest.mark.parametrize("t", TIMES)
def test_noise_equals_van_loan(t):
    """Correlations and deviations; the oracle's product of growing and shrinking exponentials costs exp(2 n t) eps."""
    _, _, expected = oracle.cw_step(N * t)
    factor = cw_noise_factor(tensor(N), tensor(t), tensor(3e-9)).numpy() / UNIT[:, None] * (N**3 / 3e-9) ** 0.5
    size = np.outer(*[np.sqrt(np.diag(expected))] * 2)
    small = min(N * t, 1.0)  # position variances shrink as (n t)^3 and are a difference of terms of size n t
    tolerance = 1e-14 * np.exp(2 * N * t) / small**2
    np.testing.assert_allclose(factor @ factor.T / size, expected / size, rtol=0, atol=tolerance)
    assert np.array_equal(factor, np.tril(factor))
    assert (np.diag(factor) > 0).all()


def test_noise_of_two_steps_is_the_noise_of_their_sum():
    one, two = ClohessyWiltshire(N, 1e-9, 10.0), ClohessyWiltshire(N, 1e-9)
    phi, _, factor = one.linear_form()
    q = factor @ factor.mT
    whole = two.linear_form(dt=20.0).scale_tril
    torch.testing.assert_close(phi @ q @ phi.mT + q, whole @ whole.mT, rtol=1e-12, atol=1e-20)


def test_held_matrices_are_those_made_on_the_fly():
    held, free = ClohessyWiltshire(N, 1e-9, 10.0), ClohessyWiltshire(N, 1e-9)
    u = torch.ones(3, dtype=torch.float64)
    for a, b in zip(held.linear_form(u), free.linear_form(u, 10.0), strict=True):
        assert torch.equal(a, b)
    assert torch.equal(held.linear_form(dt=5.0).matrix, free.linear_form(dt=5.0).matrix)
    assert held.linear_form(dt=10.0).matrix is held.linear_form().matrix


def test_forward_is_the_linear_form_on_batches_with_their_own_steps():
    law = ClohessyWiltshire(N, 1e-9)
    x = torch.randn(3, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    u = torch.tensor([1e-4, 2e-4, -1e-4], dtype=torch.float64)
    dt = torch.tensor([5.0, 10.0, 0.0], dtype=torch.float64).reshape(3, 1, 1)
    result = law(x, u, dt)
    assert result.mean.shape == (3, 5, 6)
    assert result.scale_tril.shape == (3, 1, 6, 6)
    for k in range(3):
        single = law(x[k], u, float(dt[k]))
        torch.testing.assert_close(result.mean[k], single.mean, rtol=1e-13, atol=1e-15)
        torch.testing.assert_close(result.scale_tril[k, 0], single.scale_tril, rtol=1e-13, atol=0)
    assert torch.equal(result.mean[2], x[2])
    assert torch.equal(result.scale_tril[2, 0], torch.zeros(6, 6).double())


def test_float32_follows_the_state_or_the_module():
    law = ClohessyWiltshire(N, 1e-9, 10.0)
    assert law(torch.ones(6)).mean.dtype == torch.float32
    assert law.float().linear_form().matrix.dtype == torch.float32


def test_gradients_reach_mean_motion_and_noise():
    n = tensor(N).requires_grad_()
    psd = tensor(1e-4).requires_grad_()
    x = torch.tensor([30.0, -20.0, 10.0, 0.1, 0.2, -0.1], dtype=torch.float64)

    def response(n, psd):
        law = ClohessyWiltshire(n, psd)
        result = law(x, None, 200.0)
        return result.mean, result.scale_tril

    assert torch.autograd.gradcheck(response, (n, psd), eps=1e-8, atol=1e-3, rtol=1e-5)
    law = ClohessyWiltshire(torch.nn.Parameter(tensor(N)), 1e-9, 10.0)
    law(x).mean.sum().backward()
    assert law.mean_motion_rad_s.grad is not None


def test_whole_graph_compiles_and_maps():
    law = ClohessyWiltshire(N, 1e-9, 10.0)
    x = torch.randn(4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    mapped = torch.func.vmap(torch.func.jacfwd(lambda x: law(x, None, 7.0).mean))(x)
    torch.testing.assert_close(mapped[2], law.linear_form(dt=7.0).matrix)
    compiled = torch.compile(lambda x: law(x, None, 10.0).mean, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x), law(x).mean)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((-1e-3, 1e-9), "positive"),
        ((1e-3, -1.0), ">= 0"),
        ((1e-3, 1e-9, -1.0), "dt_s"),
        ((float("nan"), 1e-9), "finite"),
    ],
)
def test_bad_arguments_are_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        ClohessyWiltshire(*arguments)


def test_a_missing_time_step_is_named():
    with pytest.raises(ValueError, match="no time step"):
        ClohessyWiltshire(1e-3, 1e-9)(torch.ones(6))


def test_held_matrices_follow_loaded_constants():
    law, other = (ClohessyWiltshire(n, psd, dt_s=10.0) for n, psd in ((0.0011, 1e-9), (0.0012, 4e-9)))
    law.load_state_dict(other.state_dict())
    x = torch.ones(6, dtype=torch.float64)
    ours, theirs = law(x, None, 10.0), other(x, None, 10.0)
    assert torch.equal(ours.mean, theirs.mean) and torch.equal(ours.scale_tril, theirs.scale_tril)


def test_a_time_step_as_a_number_is_not_rounded_on_its_way():
    """0.1 s through single precision would be off by 1.5e-9 s."""
    law = ClohessyWiltshire(N, 3e-9)
    for one, other in zip(law.linear_form(dt=0.1), law.linear_form(dt=tensor([0.1])), strict=True):
        assert one is other is None or torch.equal(one, other)
    np.testing.assert_allclose(law.linear_form(dt=0.1).matrix[0, 3], np.sin(N * 0.1) / N, rtol=1e-15)
