"""The laws of an attitude and its gyro's bias against SciPy's rotations, differentiation and their own calibration."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

import torchfilt as tf
from torchfilt import moments
from torchfilt.models.attitude import ATTITUDE_SPACE, GyroTransition, VectorMeasurement, plausible

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps
UP = torch.tensor([0.0, 0.0, 9.81], dtype=DOUBLE)
FIELD = torch.tensor([0.2, 15.7, -40.9], dtype=DOUBLE)


def normal(*shape, seed=0, scale=1.0):
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def states(count, seed=1):
    q = normal(count, 4, seed=seed)
    return torch.cat([q / q.norm(dim=-1, keepdim=True), normal(count, 3, seed=seed + 100, scale=0.05)], -1)


def rates(count, seed=2):
    return normal(count, 3, seed=seed, scale=3.0)


WALK = GyroTransition(2e-3, 1e-4)
DECAY = GyroTransition(2e-3, 1e-4, gyro_bias_time_s=7.0)
LAWS = {
    "walk": WALK,
    "decay": DECAY,
    "accelerometer": VectorMeasurement(UP, 0.5),
    "magnetometer": VectorMeasurement(FIELD, torch.tensor([1.0, 2.0, 3.0], dtype=DOUBLE)),
}
STEPS = {"number": 0.2, "rows": torch.tensor([[0.2], [0.1], [0.3], [0.0], [1.0]], dtype=DOUBLE)}


# What they mean -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", STEPS)
def test_the_body_turns_by_the_rate_without_the_bias(step):
    x, u, dt = states(5), rates(5), STEPS[step]
    law = WALK(x, u, dt)
    turn = Rotation.from_rotvec(((u - x[:, 4:]) * dt).numpy())
    expected = (Rotation.from_quat(x[:, :4]) * turn).as_quat(canonical=False)
    np.testing.assert_allclose(law.mean[:, :4], expected, rtol=0, atol=16 * EPS)
    assert torch.equal(law.mean[:, 4:], x[:, 4:])
    assert law.space == ATTITUDE_SPACE
    assert law.is_diagonal
    span = torch.as_tensor(dt, dtype=DOUBLE).sqrt() * torch.tensor([2e-3] * 3 + [1e-4] * 3, dtype=DOUBLE)
    torch.testing.assert_close(law.scale_tril, span, rtol=8 * EPS, atol=0)


def test_small_steps_are_one_long_step():
    """A constant rate in body axes: a thousand steps of a millisecond, each rounded."""
    x, u = states(4), rates(4)
    small = x
    for _ in range(1000):
        small = WALK(small, u, 1e-3).mean
    torch.testing.assert_close(small, WALK(x, u, 1.0).mean, rtol=0, atol=1000 * EPS)


@pytest.mark.parametrize("step", STEPS)
def test_a_bias_decays_to_its_settled_deviation(step):
    x, u, dt = states(5), rates(5), STEPS[step]
    law, span = DECAY(x, u, dt), torch.as_tensor(dt, dtype=DOUBLE)
    torch.testing.assert_close(law.mean[:, 4:], x[:, 4:] * torch.exp(-span / 7))
    torch.testing.assert_close(law.mean[:, :4], WALK(x, u, dt).mean[:, :4], rtol=0, atol=0)
    variance = (1e-4**2 * 7 / 2 * (1 - torch.exp(-2 * span / 7))).expand(*span.shape[:-1], 3)
    torch.testing.assert_close(law.scale_tril[..., 3:].square(), variance, rtol=1e-12, atol=0)
    settled = DECAY(x, u, 1e4).scale_tril[3:]
    torch.testing.assert_close(settled, torch.full((3,), 1e-4 * math.sqrt(3.5), dtype=DOUBLE))


def test_a_sensor_sees_its_reference_in_body_axes():
    x = states(6)
    turn = Rotation.from_quat(x[:, :4])
    for name, reference in (("accelerometer", UP), ("magnetometer", FIELD)):
        law = LAWS[name](x)
        np.testing.assert_allclose(law.mean, turn.inv().apply(reference.numpy()), rtol=0, atol=45 * 8 * EPS)
        assert law.is_diagonal
    assert LAWS["accelerometer"](x).scale_tril.tolist() == [0.5] * 3
    assert LAWS["magnetometer"](x).scale_tril.tolist() == [1.0, 2.0, 3.0]
    level = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=DOUBLE)
    assert torch.equal(LAWS["accelerometer"](level).mean, UP)
    assert LAWS["accelerometer"].size == 3


def test_a_reference_a_row_and_states_of_another_kind():
    """Rows have places of their own; the state may go on after its quaternion."""
    references = torch.stack([FIELD, 2 * FIELD, UP])
    law = VectorMeasurement(references, 1.0)
    x = torch.cat([states(3), normal(3, 9, seed=9)], -1)
    each = torch.stack([VectorMeasurement(r, 1.0)(row).mean for r, row in zip(references, x, strict=True)])
    torch.testing.assert_close(law(x).mean, each, rtol=0, atol=0)
    points = x.unsqueeze(1).expand(3, 4, 16)
    torch.testing.assert_close(law(points).mean, each.unsqueeze(1).expand(3, 4, 3), rtol=0, atol=0)
    at, jacobian = law.first_order(points)
    assert jacobian.shape == (3, 4, 3, 15)
    assert not jacobian[..., 3:].any()
    torch.testing.assert_close(at.mean, law(points).mean, rtol=0, atol=0)


# First order ----------------------------------------------------------------------------------------------------------


class Plain(nn.Module):
    """A law without its short cut."""

    def __init__(self, law):
        super().__init__()
        self.law = law

    def forward(self, x, u=None, dt=None):
        return self.law(x) if isinstance(self.law, VectorMeasurement) else self.law(x, u, dt)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("name", LAWS)
def test_first_order_is_the_derivative_on_the_space(name, step):
    law, x, u, dt = LAWS[name], states(5), rates(5), STEPS[step]
    at, jacobian = law.first_order(x, u, dt)
    lifted = u.unsqueeze(-2), dt.unsqueeze(-2) if isinstance(dt, torch.Tensor) else dt

    def response(error):
        points = ATTITUDE_SPACE.retract(x.unsqueeze(-2), error)
        return at.space.local(at.mean.unsqueeze(-2), Plain(law)(points, *lifted).mean)

    directions = torch.eye(6, dtype=DOUBLE).expand(5, 6, 6).contiguous()
    expected = torch.func.jvp(response, (torch.zeros_like(directions),), (directions,))[1].mT
    torch.testing.assert_close(jacobian, expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_taylor_takes_the_short_cut(name):
    law, x, u = LAWS[name], states(3), rates(3)
    belief = tf.Gaussian(x, 0.1 * normal(6, 6, seed=3).tril(), ATTITUDE_SPACE)
    short, long = (moments.taylor().linearize(each, belief, u, 0.2) for each in (law, Plain(law)))
    torch.testing.assert_close(short.slope, long.slope, rtol=1e-11, atol=1e-13)
    torch.testing.assert_close(short.mean, long.mean, rtol=0, atol=0)


@pytest.mark.parametrize("name", LAWS)
def test_gradients_vmap_and_one_graph(name):
    law, x, u = Plain(LAWS[name]), states(2), rates(2)
    dt = torch.tensor([[0.2]], dtype=DOUBLE)
    inputs = [part.clone().requires_grad_() for part in (x, u, dt)]

    def scaled(x, u, dt):
        return law(x, u, dt).mean / 10 + 0 * (u.sum() + dt.sum())

    assert torch.autograd.gradcheck(scaled, inputs, check_forward_ad=True)
    for function in (lambda x, u: law(x, u, 0.2).mean, lambda x, u: LAWS[name].first_order(x, u, 0.2)[1]):
        whole = function(x, u)
        torch.testing.assert_close(torch.vmap(function)(x, u), whole, rtol=1e-12, atol=1e-13)
        compiled = torch.compile(function, fullgraph=True, backend="eager", dynamic=False)
        torch.testing.assert_close(compiled(x, u), whole, rtol=0, atol=0)


def test_densities_and_deviations_train():
    walk, deviation = (nn.Parameter(torch.tensor(value, dtype=DOUBLE)) for value in (1e-3, 0.5))
    GyroTransition(walk, 1e-4)(states(2), rates(2), 0.25).scale_tril.sum().backward()
    assert walk.grad.item() == pytest.approx(3 * 0.5, rel=4 * EPS)
    VectorMeasurement(UP, deviation)(states(2)).scale_tril.sum().backward()
    assert deviation.grad.item() == 3


# Implausible vectors --------------------------------------------------------------------------------------------------


def test_vectors_of_another_length_are_not_measured():
    """Inside a share of the length, just outside, NaN, infinity; a length a row."""
    v = torch.tensor([[0.0, 0.0, 9.0], [0.0, 7.9, 0.0], [11.9, 0.0, 0.0], [0.0, 12.1, 0.0]], dtype=DOUBLE)
    assert plausible(v, 10.0, 0.2).isnan().any(-1).tolist() == [False, True, False, True]
    assert torch.equal(plausible(v, 10.0, 0.2)[0], v[0])
    lengths = torch.tensor([9.0, 9.0, 20.0, 12.0], dtype=DOUBLE)
    assert plausible(v, lengths, 0.05).isnan().all(-1).tolist() == [False, True, True, False]
    odd = torch.tensor([[math.nan, 0.0, 10.0], [math.inf, 0.0, 0.0]], dtype=DOUBLE)
    found = plausible(odd, 10.0, 0.2)
    assert found[0].isnan().tolist() == [True, False, False]
    assert found[1].isnan().all()
    for tolerance, length in ((0.0, 10.0), (math.nan, 10.0), (0.1, 0.0), (0.1, -1.0)):
        with pytest.raises(ValueError, match=f"tolerance and length must be positive, got {tolerance} and {length}"):
            plausible(v, length, tolerance)


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1.0,), "angle_random_walk_rad_sqrt_s must be one finite number >= 0, got -1"),
        ((torch.ones(3),), "angle_random_walk_rad_sqrt_s must be one finite number"),
        ((1e-3, math.inf), "gyro_bias_walk_rad_s_sqrt_s must be one finite number >= 0, got inf"),
        ((1e-3, 0.0, 0.0), "gyro_bias_time_s must be positive and finite, got 0"),
        ((1e-3, 0.0, math.inf), "gyro_bias_time_s must be positive and finite, got inf"),
    ],
)
def test_gyros_that_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        GyroTransition(*arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((UP[:2], 1.0), r"reference must be \(\*batch, 3\) in world axes, got shape \(2,\)"),
        ((0 * UP, 1.0), r"reference must be finite and not zero, got \[0.0, 0.0, 0.0\]"),
        ((UP * math.nan, 1.0), "reference must be finite and not zero"),
        ((UP, 0.0), "sd must be positive and finite, got 0"),
        ((UP, math.inf), "sd must be positive and finite, got inf"),
        ((UP, torch.ones(2)), r"sd must be one number or \(3,\), got shape \(2,\)"),
    ],
)
def test_sensors_that_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        VectorMeasurement(*arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ((states(2), None, 0.1), r"the measured rate as a control u \(\.\.\., 3\), got none"),
        ((states(2), torch.zeros(2, 6), 0.1), r"control u \(\.\.\., 3\), got shape \(2, 6\)"),
        ((states(2), rates(2), None), "this law needs the time step dt"),
        ((states(2), rates(2), -0.1), "dt must be >= 0, got -0.1"),
        ((states(2)[:, :6], rates(2), 0.1), r"the state must be \(\.\.\., 7\), got \(2, 6\)"),
    ],
)
def test_calls_that_are_refused(call, message):
    for way in (WALK, WALK.first_order):
        with pytest.raises(ValueError, match=message):
            way(*call)
    with pytest.raises(ValueError, match=r"must begin with a quaternion, \(\.\.\., 4 or more\), got \(2, 3\)"):
        LAWS["accelerometer"](states(2)[:, :3])


# In a filter ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["mekf", "ukf", "ckf"])
def test_filters_of_the_laws_are_calibrated(kind):
    """100 bodies drawn from the model itself: NEES of 6 and NIS of 6 degrees of freedom.

    Means over 100 runs: 6 +- 0.35 and, with 60 steps, 6 +- 0.045; five standard deviations miss once in 2 million.
    """
    runs, steps, dt = 100, 60, 0.1
    motion = GyroTransition(5e-3, 1e-3)
    sensors = tf.Sensors(accelerometer=VectorMeasurement(UP, 0.3), magnetometer=VectorMeasurement(FIELD, 1.0))
    deviation = torch.tensor([0.05] * 3 + [0.02] * 3, dtype=DOUBLE)
    prior = tf.Gaussian(torch.tensor([0.5, -0.5, 0.5, 0.5, 0, 0, 0], dtype=DOUBLE), deviation, ATTITUDE_SPACE, True)
    x = prior._replace(mean=prior.mean.expand(runs, 7)).sample(normal(runs, 6, seed=11))
    controls, noise, error = normal(steps, 3, seed=12), normal(steps, runs, 6, seed=13), normal(steps, runs, 6, seed=14)
    ys = []
    for k in range(steps):
        x = motion(x, controls[k], dt).sample(noise[k])
        ys.append(sensors(x).sample(error[k]))
    make = {
        "mekf": tf.ErrorStateKalmanFilter,
        "ukf": tf.UnscentedKalmanFilter,
        "ckf": tf.CubatureKalmanFilter,
    }[kind]
    history = make(tf.StateSpaceModel(prior, motion, sensors))(torch.stack(ys), controls, dt)
    belief = history.final.belief
    away = ATTITUDE_SPACE.local(belief.mean, x)
    nees = torch.linalg.solve_triangular(belief.factor(), away.unsqueeze(-1), upper=False).square().sum((-2, -1))
    assert abs(nees.mean() - 6) < 5 * math.sqrt(2 * 6 / runs)
    assert abs(history.diagnostics.nis.mean() - 6) < 5 * math.sqrt(2 * 6 / (runs * steps))
