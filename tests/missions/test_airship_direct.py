"""The direct form: its motion against closed forms and SciPy's rotations, its measurements against rigid motion."""

import math

import numpy as np
import pytest
import torch
from oracles import rotations_oracle
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from torchfilt.missions.airship.direct import DIRECT_SPACE, DirectTransition, InertialMeasurement, to_rates
from torchfilt.models.landing import LandingTransition
from torchfilt.spaces import Euclidean, Product

STEP = 0.05
OPTIONS = {
    "rate_sd_rad_s": 0.3,
    "rate_time_s": 0.4,
    "acceleration_sd_m_s2": 0.7,
    "acceleration_time_s": 1.5,
    "gyro_bias_walk_rad_s_sqrt_s": 0.02,
    "accel_bias_walk_m_s2_sqrt_s": 0.05,
}
KEEP = math.exp(-STEP / 0.4), math.exp(-STEP / 1.5)
GRAVITY = np.array([0.0, 0.0, 9.80665])


def states(count=5, seed=0, rate=2.0):
    """Any attitude, brisk rates: (count, 22)."""
    values = torch.randn(count, 22, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    values[:, 10:16] *= 0.1
    values[:, 16:19] *= rate
    return torch.cat([torch.nn.functional.normalize(values[:, :4], dim=-1), values[:, 4:]], -1)


def law(**changes):
    return DirectTransition(STEP, **(OPTIONS | changes))


# Motion ---------------------------------------------------------------------------------------------------------------


def test_mean_is_a_rigid_motion():
    """Rate and acceleration decay, then hold over the step: turn about a fixed body axis, a parabola."""
    x = states()
    after = law()(x, None, STEP).mean.numpy()
    for a, b in zip(after, x.numpy(), strict=True):
        rate, push = KEEP[0] * b[16:19], KEEP[1] * b[19:22]
        turn = rotations_oracle.retract(b[:4], STEP * rate, "right")
        assert rotations_oracle.distance(a[:4], turn) < 1e-14
        wanted = [b[4:7] + STEP * push, b[7:10] + STEP * b[4:7] + STEP**2 / 2 * push, b[10:16], rate, push]
        np.testing.assert_allclose(a[4:], np.concatenate(wanted), rtol=0, atol=1e-14)


def test_without_forgetting_it_follows_a_constant_motion_for_long():
    """Constant rate and acceleration: after 200 steps where the closed form is, to rounding."""
    still = law(rate_time_s=1e15, acceleration_time_s=1e15)
    first = states(3, seed=1)
    x = first
    for _ in range(200):
        x = still(x).mean
    first, time = first.numpy(), 200 * STEP
    for a, b in zip(x.numpy(), first, strict=True):
        assert rotations_oracle.distance(a[:4], rotations_oracle.retract(b[:4], time * b[16:19], "right")) < 1e-12
        np.testing.assert_allclose(a[4:7], b[4:7] + time * b[19:], rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(a[7:10], b[7:10] + time * b[4:7] + time**2 / 2 * b[19:], rtol=1e-11, atol=1e-11)


def by_differences(function, x, step=1e-5):
    """Central differences (21, 21) of the error of function(x) by the error of x; SciPy's rotations alone."""

    def moved(error):
        return np.concatenate([rotations_oracle.retract(x[:4], error[:3], "left"), x[4:] + error[3:]])

    def apart(a, b):
        return np.concatenate([rotations_oracle.local(a[:4], b[:4], "left"), b[4:] - a[4:]])

    columns = [apart(function(moved(-e)), function(moved(e))) / (2 * step) for e in step * np.eye(21)]
    return np.stack(columns, -1)


def test_jacobian_by_autodiff_and_differences():
    """In the tangent spaces of x and of the mean: autodiff to rounding, SciPy's differences to 1e-16 / 1e-5."""
    transition, x = law(), states(4, seed=2, rate=8.0)
    _, jacobian = transition.first_order(x, None, STEP)
    assert jacobian.shape == (4, 21, 21)
    for row, found in zip(x, jacobian, strict=True):
        centre = transition(row).mean

        def error(e, row=row, centre=centre):
            return DIRECT_SPACE.local(centre, transition(DIRECT_SPACE.retract(row, e)).mean)

        auto = torch.autograd.functional.jacobian(error, torch.zeros(21, dtype=torch.float64))
        torch.testing.assert_close(found, auto, rtol=0, atol=1e-12)

        def move(y):
            return transition(torch.from_numpy(y)).mean.numpy()

        np.testing.assert_allclose(found.numpy(), by_differences(move, row.numpy()), rtol=0, atol=1e-9)
    # The turn in it is that of a large step, not its first order.
    assert (jacobian[:, :3, 15:18] - STEP * KEEP[0] * torch.eye(3, dtype=torch.float64)).abs().max() > 1e-3


def driven(x, rate, push, gyro, accel):
    """Noise of the error (21, 21) of a state (22,), drawn where it arises: rate in body axes, the rest in world's."""
    turn = Rotation.from_quat(x[:4]).as_matrix()
    columns = np.zeros((21, 12))
    columns[0:3, 0:3] = STEP * turn * rate
    columns[15:18, 0:3] = np.eye(3) * rate
    columns[3:6, 3:6] = STEP * np.eye(3) * push
    columns[6:9, 3:6] = STEP**2 / 2 * np.eye(3) * push
    columns[18:21, 3:6] = np.eye(3) * push
    columns[9:12, 6:9] = np.eye(3) * gyro
    columns[12:15, 9:12] = np.eye(3) * accel
    return columns @ columns.T


def test_noise_covariance():
    x = states(4, seed=3)
    sizes = [0.3 * math.sqrt(1 - KEEP[0] ** 2), 0.7 * math.sqrt(1 - KEEP[1] ** 2), 0.02 * 0.05**0.5, 0.05 * 0.05**0.5]
    noise = law()(x, None, STEP)
    for row, covariance in zip(x.numpy(), noise.covariance.numpy(), strict=True):
        np.testing.assert_allclose(covariance, driven(row, *sizes), rtol=0, atol=1e-16)
    assert torch.equal(noise.scale_tril, noise.scale_tril.tril())


def test_noise_against_draws_that_turn():
    """Rates drawn and put into the motion by SciPy: covariance of attitude and rate to five standard errors.

    To first order in the turn, as the docstring says: a turn of 0.02 rad changes a correlation by half of it.
    """
    count = 20_000
    x = states(1, seed=4, rate=0.4)[0]
    noise = law()(x)
    mean, covariance = noise.mean.numpy(), noise.covariance.numpy()
    sd = 0.3 * math.sqrt(1 - KEEP[0] ** 2)
    drawn = mean[16:19] + sd * np.random.default_rng(5).standard_normal((count, 3))
    end = Rotation.from_quat(x[:4].numpy()) * Rotation.from_rotvec(STEP * drawn)
    turn = (end * Rotation.from_quat(mean[:4]).inv()).as_rotvec()
    found = np.cov(np.concatenate([turn, drawn - mean[16:19]], -1).T)
    picked = np.r_[0:3, 15:18]
    wanted = covariance[np.ix_(picked, picked)]
    scale = np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal()))
    half_turn = STEP * np.linalg.norm(mean[16:19]) / 2
    assert 0.005 < half_turn < 0.02
    assert np.abs((found - wanted) / scale).max() < 5 * math.sqrt(2 / count) + half_turn


def test_processes_are_stationary():
    """Iterating the law's covariance: stated deviations at all times from there, and reached from nowhere."""
    transition, x = law(), states(1, seed=6)[0]
    wanted = np.r_[np.full(3, 0.3**2), np.full(3, 0.7**2)]
    start = np.zeros((21, 21))
    start[15:, 15:] = np.diag(wanted)
    for covariance, steps, tolerance in ((start, 1, 1e-15), (np.zeros((21, 21)), 400, 1e-8)):
        y = x
        for _ in range(steps):
            noise, jacobian = transition.first_order(y)
            covariance = jacobian.numpy() @ covariance @ jacobian.numpy().T + noise.covariance.numpy()
            y = noise.mean
        # What is left of nothing: exp(-2 t / T) with t = 20 s and T = 1.5 s is 3e-12.
        np.testing.assert_allclose(covariance[15:, 15:], np.diag(wanted), rtol=0, atol=tolerance)


def test_velocity_and_position_spread_as_the_closed_form():
    """Velocity and position by sums over 60 steps, against the continuous process by Van Loan's exponential.

    The law holds the acceleration over a step that the process changes within: 3 % for 0.05 s of 1.5 s.
    """
    transition, x = law(), states(1, seed=7)[0]
    covariance, count = np.zeros((21, 21)), 60
    covariance[18:21, 18:21] = 0.7**2 * np.eye(3)
    for _ in range(count):
        noise, jacobian = transition.first_order(x)
        covariance = jacobian.numpy() @ covariance @ jacobian.numpy().T + noise.covariance.numpy()
        x = noise.mean
    time = count * STEP
    a = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1 / 1.5]])  # velocity, position, acceleration
    q = np.diag([0, 0, 2 * 0.7**2 / 1.5])
    big = expm(np.block([[-a, q], [np.zeros((3, 3)), a.T]]) * time)
    exact = big[3:, 3:].T @ big[:3, 3:] + big[3:, 3:].T @ np.diag([0, 0, 0.7**2]) @ big[3:, 3:]
    for axis in range(3):
        picked = [3 + axis, 6 + axis, 18 + axis]
        np.testing.assert_allclose(covariance[np.ix_(picked, picked)], exact, rtol=0.03)
    # Biases: random walks from zero.
    np.testing.assert_allclose(covariance[9:12, 9:12], 0.02**2 * time * np.eye(3), rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(covariance[12:15, 12:15], 0.05**2 * time * np.eye(3), rtol=1e-12, atol=1e-18)


def test_biases_stay_by_default():
    sizes = {name: value for name, value in OPTIONS.items() if "walk" not in name}
    variance = DirectTransition(STEP, **sizes)(states(1)).variance[0]
    assert (variance[9:15] == 0).all() and (variance[15:] > 0).all()


def test_batches_dtypes_and_compile():
    transition = law()
    x = states(6).unflatten(0, (2, 3))
    whole, jacobian = transition.first_order(x, None, STEP)
    assert whole.mean.shape == (2, 3, 22) and jacobian.shape == (2, 3, 21, 21)
    torch.testing.assert_close(transition(x[1, 2]).mean, whole.mean[1, 2], rtol=0, atol=1e-15)
    small, slope = transition.first_order(x.float(), None, STEP)
    assert small.mean.dtype == small.scale_tril.dtype == slope.dtype == torch.float32
    # Numbers up to 4, some roundings each.
    assert whole.mean.abs().max() < 4.1
    torch.testing.assert_close(small.mean.double(), whole.mean, rtol=0, atol=4 * 4 * torch.finfo(torch.float32).eps)
    compiled = torch.compile(lambda y: transition.first_order(y, None, STEP)[1], backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(x), jacobian, rtol=0, atol=1e-15)
    mapped = torch.func.vmap(lambda y: transition(y, None, STEP).mean)(x)
    torch.testing.assert_close(mapped, whole.mean, rtol=0, atol=1e-15)


# Measurement ----------------------------------------------------------------------------------------------------------


def test_measurement_of_a_rigid_motion():
    """SciPy: force less gravity in the axes of the middle of the step that has ended, biases on top."""
    x = states(5, seed=8)
    sensor = InertialMeasurement(STEP, 0.002, 0.03)
    told = sensor(x)
    for row, mean in zip(x.numpy(), told.mean.numpy(), strict=True):
        middle = Rotation.from_quat(row[:4]) * Rotation.from_rotvec(-STEP / 2 * row[16:19])
        force = middle.inv().apply(row[19:22] + GRAVITY)
        np.testing.assert_allclose(mean, np.r_[row[16:19] + row[10:13], force + row[13:16]], rtol=0, atol=1e-13)
    np.testing.assert_allclose(told.scale_tril, [0.002 / STEP**0.5] * 3 + [0.03 / STEP**0.5] * 3, rtol=1e-15)
    assert told.is_diagonal and sensor.size == 6
    longer = torch.cat([x, torch.ones(5, 3, dtype=torch.float64)], -1)
    assert torch.equal(sensor(longer).mean, told.mean) and sensor(x.float()).scale_tril.dtype == torch.float32


def test_derivative_of_the_measurement_by_autodiff():
    """In the tangent space of x, large turns of a step, with numbers behind the state: to rounding."""
    x = torch.cat([states(4, seed=12, rate=8.0), torch.ones(4, 2, dtype=torch.float64)], -1)
    space, sensor = Product(DIRECT_SPACE, Euclidean(2)), InertialMeasurement(STEP, 1e-4, 1e-3)
    told, jacobian = sensor.first_order(x)
    assert jacobian.shape == (4, 6, 23) and torch.equal(told.mean, sensor(x).mean)
    for row, found in zip(x, jacobian, strict=True):

        def measured(e, row=row):
            return sensor(space.retract(row, e)).mean

        auto = torch.autograd.functional.jacobian(measured, torch.zeros(23, dtype=torch.float64))
        torch.testing.assert_close(found, auto, rtol=0, atol=1e-12)


def increments_of(before, after):
    """Turn, and change of velocity less gravity's in the axes at the start, between two states: (6,)."""
    start, end = Rotation.from_quat(before[:4]), Rotation.from_quat(after[:4])
    dv = start.inv().apply(after[4:7] - before[4:7] + STEP * GRAVITY)
    return np.r_[(start.inv() * end).as_rotvec(), dv]


def test_increments_and_measurement_agree():
    """A rigid motion with constant rate and acceleration: what the sensor law tells is exactly its increments."""
    x = states(6, seed=9)
    x[:, 10:16] = 0
    after = law()(x).mean
    sensed = np.stack([increments_of(*pair) for pair in zip(x.numpy(), after.numpy(), strict=True)])
    rates = to_rates(torch.from_numpy(sensed), STEP)
    torch.testing.assert_close(rates, InertialMeasurement(STEP, 1e-4, 1e-3)(after).mean, rtol=0, atol=1e-12)


def test_increments_with_biases_agree_with_the_indirect_form():
    """Biased increments that the indirect law takes back to the same motion: the direct law tells them.

    To second order in the turn of a step, 0.02 rad: bias times the turn squared over 12, and the bias's own turn.
    """
    x = states(6, seed=10, rate=0.3)
    x[:, 10:13] *= 0.2
    after = law()(x).mean
    sensed = InertialMeasurement(STEP, 1e-4, 1e-3)(after).mean
    turn = Rotation.from_rotvec(STEP / 2 * sensed[:, :3].numpy())
    control = torch.cat([sensed[:, :3], torch.from_numpy(turn.apply(sensed[:, 3:].numpy()))], -1) * STEP
    moved = LandingTransition(1e-4, 1e-3)(x[:, :16], control, STEP).mean
    np.testing.assert_allclose(to_rates(control, STEP), sensed, rtol=0, atol=1e-13)
    away = LandingTransition(1e-4, 1e-3).space.local(moved, after[:, :16])
    assert away[:, :3].abs().max() < 1e-12 and away.abs().max() < 1e-5
    assert (sensed[:, :3] * STEP).abs().max() > 0.01 and x[:, 10:16].abs().amin() > 1e-4


def test_to_rates_inverts_a_numeric_strapdown():
    """Rate in body axes and acceleration in world axes constant: force of the middle out of a sum of 200 slices."""
    rng, slices = np.random.default_rng(11), 200
    for _ in range(3):
        rate, acceleration = rng.normal(size=3), rng.normal(size=3)
        start = Rotation.random(random_state=rng)
        times = (np.arange(slices) + 0.5) * STEP / slices
        # Force in body axes along a motion with constant acceleration, summed in axes at the start.
        along = start * Rotation.from_rotvec(np.outer(times, rate))
        force = along.inv().apply(acceleration + GRAVITY)
        dv = (Rotation.from_rotvec(np.outer(times, rate)).apply(force)).mean(0) * STEP
        rates = to_rates(torch.from_numpy(np.r_[STEP * rate, dv]), STEP).numpy()
        middle = start * Rotation.from_rotvec(STEP / 2 * rate)
        np.testing.assert_allclose(rates, np.r_[rate, middle.inv().apply(acceleration + GRAVITY)], atol=1e-12)
    assert to_rates(torch.zeros(3, 2, 6), STEP).shape == (3, 2, 6)


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["step_s", *OPTIONS])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_transition_refuses(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be finite and (positive|not negative), got {value}$"):
        DirectTransition(**({"step_s": STEP} | OPTIONS | {name: value}))


@pytest.mark.parametrize("name", ["step_s", "rate_time_s", "acceleration_time_s"])
def test_transition_refuses_no_time(name):
    with pytest.raises(ValueError, match=rf"^{name} must be finite and positive, got 0.0"):
        DirectTransition(**({"step_s": STEP} | OPTIONS | {name: 0.0}))


@pytest.mark.parametrize("name", ["step_s", "angle_random_walk_rad_sqrt_s", "velocity_random_walk_m_s_sqrt_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_measurement_refuses(name, value):
    given = {"step_s": STEP, "angle_random_walk_rad_sqrt_s": 1e-3, "velocity_random_walk_m_s_sqrt_s": 1e-3}
    with pytest.raises(ValueError, match=f"^{name} must be finite and positive, got {value}$"):
        InertialMeasurement(**(given | {name: value}))


def test_calls_refused():
    x = states()
    for dt in (0.1, 0.0, 0.0500001, math.nan):
        with pytest.raises(ValueError, match=f"dt must be the step the law was made for, 0.05, got {dt}"):
            law()(x, None, dt)
        with pytest.raises(ValueError, match="dt must be the step the law was made for"):
            law().first_order(x, None, dt)
    with pytest.raises(ValueError, match=r"dt must be one number, the step the law was made for, 0\.05, got a tensor"):
        law()(x, None, torch.full((5, 1), STEP))
    assert torch.equal(law()(x, None, STEP * (1 + 1e-12)).mean, law()(x).mean)  # rounding of times is no other step
    with pytest.raises(ValueError, match=r"the state must be \(\.\.\., 22\), got \(5, 21\)"):
        law()(x[:, :21])
    with pytest.raises(ValueError, match=r"the state must have 22 numbers or more, got \(5, 21\)"):
        InertialMeasurement(STEP, 1e-3, 1e-3)(x[:, :21])
