"""Late measurements: equal to having them in order, told apart by times, and never fused in silence."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import torchfilt as tf
from torchfilt import delays
from torchfilt.delays import DelayedMeasurements, held, proportional
from torchfilt.laws import LinearForm
from torchfilt.storage import IntegrityError, write_verified

F64 = torch.float64
DENSITY, POSITION_SD, SPEED_SD = 0.5, 0.4, 0.8
M0, P0 = np.array([1.0, 2.0]), np.diag([4.0, 9.0])
NAN = math.nan


def tensor(values, dtype=F64):
    return torch.as_tensor(np.asarray(values, dtype=float)).to(dtype)


class ConstantVelocity(torch.nn.Module):
    """Position and velocity, pushed by white acceleration and, where there is one, by a control in m/s^2."""

    takes_controls = True

    def __init__(self, dtype=F64):
        super().__init__()
        self.like = torch.zeros(2, dtype=dtype)

    def linear_form(self, u=None, dt=None):
        matrix = self.like.new_tensor([[1.0, dt], [0.0, 1.0]])
        first = [math.sqrt(DENSITY * dt**3 / 3), math.sqrt(DENSITY * 3 * dt) / 2, math.sqrt(DENSITY * dt) / 2]
        factor = self.like.new_tensor([[first[0], 0.0], [first[1], first[2]]])
        offset = None if u is None else u * self.like.new_tensor([dt**2 / 2, dt])
        return LinearForm(matrix, offset, factor)

    def forward(self, x, u=None, dt=None):
        matrix, offset, factor = self.linear_form(u, dt)
        mean = x @ matrix.mT
        return tf.Gaussian(mean if offset is None else mean + offset, factor)


def model(dtype=F64, **more):
    sensors = tf.Sensors(
        position=tf.LinearGaussian(tensor([[1, 0]], dtype), tensor([[POSITION_SD**2]], dtype)),
        speed=tf.LinearGaussian(tensor([[0, 1]], dtype), tensor([[SPEED_SD**2]], dtype)),
        **more,
    )
    return tf.StateSpaceModel(
        tf.Gaussian(tensor(M0, dtype), tensor(np.sqrt(P0), dtype)), ConstantVelocity(dtype), sensors
    )


def kalman(**more):
    return tf.KalmanFilter(model(**more))


def stream(filter=None, horizon_s=0.5, split=held, **more):
    return DelayedMeasurements(kalman() if filter is None else filter, horizon_s, split=split, **more)


def moved(wrapper, state, steps, dt=0.1):
    for _ in range(steps):
        state, _ = wrapper.step(state, {}, dt=dt)
    return state


# ----------------------------------------------------------------------------------------------------------------------
# Values


def batch_answer(at_s, measured):
    """State at a time given measurements (time, row of the state, value, deviation), by one Gaussian conditioning.

    No recursion and no order: the joint law of the state at all times. Cov(x(s), x(t)) of the integrated Wiener process
    in closed form. Also the evidence.
    """
    times = [at_s, *(time for time, *_ in measured)]

    def joint(s, t):
        low = min(s, t)
        ws, wt = np.array([[1, s], [0, 1]]), np.array([[1, t], [0, 1]])
        noise = DENSITY * np.array(
            [
                [low**3 / 3 + abs(t - s) * low**2 / 2, low**2 / 2 + (s - low) * low],
                [low**2 / 2 + (t - low) * low, low],
            ]
        )
        return ws @ P0 @ wt.T + noise

    prior = np.block([[joint(s, t) for t in times] for s in times])
    mean = np.concatenate([np.array([[1, t], [0, 1]]) @ M0 for t in times])
    H = np.zeros((len(measured), len(mean)))
    for k, (_, place, _, _) in enumerate(measured):
        H[k, 2 * (k + 1) + place] = 1
    R = np.diag([sd**2 for *_, sd in measured])
    residual = np.array([value for _, _, value, _ in measured]) - H @ mean
    S = H @ prior @ H.T + R
    gain = np.linalg.solve(S, H @ prior).T
    evidence = -0.5 * (residual @ np.linalg.solve(S, residual) + np.linalg.slogdet(2 * np.pi * S)[1])
    return (mean + gain @ residual)[:2], (prior - gain @ H @ prior)[:2, :2], evidence


SCHEDULE = [
    # measured at, arrives at, sensor, value
    (0.0, 0.2, "position", 1.3),
    (0.0, 0.3, "speed", 2.5),
    (0.3, 0.3, "position", 1.9),
    (0.25, 0.5, "speed", 1.1),
    (0.25, 0.5, "position", 1.6),
    (0.4, 0.6, "speed", 0.4),
    (0.37, 0.7, "speed", 3.0),
    (0.7, 0.7, "position", 2.2),
    (0.7, 0.7, "speed", 2.0),
    (0.66, 0.8, "position", 2.6),
]


def run_schedule(wrapper, dtype=F64):
    """Steps of 0.1 s to 0.8 s; each measurement is handed over when it arrives."""
    state, infos = wrapper.init(time_s=0.0), []
    for k in range(1, 9):
        now = k * 0.1
        arrived = [one for one in SCHEDULE if math.isclose(one[1], now)]
        current = {name: tensor([y], dtype) for t, _, name, y in arrived if math.isclose(t, now)}
        state, info = wrapper.step(state, current, time_s=now)
        infos.append(info)
        for t, _, name, y in arrived:
            if not math.isclose(t, now):
                state, info = wrapper.late(state, {name: tensor([y], dtype)}, t)
                infos.append(info)
    return state, infos


@pytest.mark.parametrize(("dtype", "rtol"), [(F64, 1e-10), (torch.float32, 1e-4)])
def test_a_scrambled_schedule_equals_the_batch_answer(dtype, rtol):
    """Ten measurements, seven late, three out of order; mean, covariance and evidence of an independent formula.

    Rounding: condition of the joint covariance below 1e4, times machine precision, with a margin of 100.
    """
    state, _ = run_schedule(stream(tf.KalmanFilter(model(dtype)), horizon_s=1.0), dtype)
    rows = {"position": (0, POSITION_SD), "speed": (1, SPEED_SD)}
    mean, covariance, evidence = batch_answer(0.8, [(t, rows[n][0], y, rows[n][1]) for t, _, n, y in SCHEDULE])
    assert state.belief.mean.dtype == dtype
    np.testing.assert_allclose(state.belief.mean, mean, rtol=rtol)
    np.testing.assert_allclose(state.belief.covariance, covariance, rtol=rtol)
    np.testing.assert_allclose(float(state.log_likelihood), evidence, rtol=rtol)


def test_the_log_says_what_became_of_each():
    state, infos = run_schedule(stream(horizon_s=1.0))
    log = [entry for info in infos for entry in info.arrivals]
    told = {(e.sensor, e.time_s): (e.action, e.out_of_order, e.refiltered) for e in log}
    assert told == {
        ("position", 0.0): ("inserted", False, 3),  # the step at the prior and two more
        ("speed", 0.0): ("joined", False, 4),
        ("position", 3 * 0.1): ("on time", False, 1),
        ("speed", 0.25): ("inserted", False, 4),  # both halves of the third step and two more
        ("position", 0.25): ("joined", True, 4),
        ("speed", 0.4): ("joined", False, 3),
        ("speed", 0.37): ("inserted", True, 5),
        ("position", 7 * 0.1): ("on time", False, 1),
        ("speed", 7 * 0.1): ("on time", False, 1),
        ("position", 0.66): ("inserted", True, 3),
    }
    assert [e.delay_s for e in log if e.sensor == "speed"] == pytest.approx([0.3, 0.25, 0.2, 0.0, 0.33])
    assert all(len(info.steps) == e.refiltered for info in infos for e in info.arrivals)
    assert state.arrivals == tuple(log) and state.newest_s == (7 * 0.1, 7 * 0.1)


def test_rows_of_a_batch_miss_different_measurements():
    """A late measurement of one row; the other is as if it had never come, but for the step that was split."""
    wrapper = stream()
    state = wrapper.init((2,))
    for k in range(4):
        state, _ = wrapper.step(state, {"speed": tensor([[k], [1.0]])}, dt=0.1)
    late, info = wrapper.late(state, {"position": tensor([[5.0], [NAN]])}, 0.15)
    np.testing.assert_allclose(late.belief.mean[1], state.belief.mean[1], rtol=1e-12)
    assert abs(late.belief.mean[0, 0] - state.belief.mean[0, 0]) > 1
    other, _ = wrapper.late(late, {"position": tensor([[NAN], [3.0]])}, 0.15)  # another row of the same time: no repeat
    both, _ = wrapper.late(state, {"position": tensor([[5.0], [3.0]])}, 0.15)
    torch.testing.assert_close(other.belief.mean, both.belief.mean, rtol=0, atol=0)
    assert info.steps[0].nis.shape == (2,)
    np.testing.assert_array_equal(other.log_likelihood, both.log_likelihood)


@pytest.mark.parametrize("split", [held, proportional, lambda u, fraction: u.clone()])
def test_controls_of_a_split_step(split):
    """A force that is held, or an impulse that is spread: both parts together push as the whole did."""

    class Push(ConstantVelocity):
        def linear_form(self, u=None, dt=None):
            rate = u / dt if split is proportional else u
            return super().linear_form(rate, dt)

    def filter():
        plain = model()
        return tf.KalmanFilter(tf.StateSpaceModel(plain.initial, Push(), plain.observation))

    u = tensor([3.0]) * (0.1 if split is proportional else 1.0)
    wrapper = stream(filter(), split=split)
    state = wrapper.init()
    for _ in range(3):
        state, _ = wrapper.step(state, {}, u, 0.1)
    state, info = wrapper.late(state, {"position": tensor([4.0])}, 0.125)
    assert len(info.steps) == 3
    # Three tenths of a second at 3 m/s^2 move the answer without a push; the law is linear.
    pushed_then, pushed_now = 1.5 * 0.125**2, np.array([1.5 * 0.09, 0.9])
    mean, covariance, _ = batch_answer(0.3, [(0.125, 0, 4.0 - pushed_then, POSITION_SD)])
    np.testing.assert_allclose(state.belief.mean, mean + pushed_now, rtol=1e-12)
    np.testing.assert_allclose(state.belief.covariance, covariance, rtol=1e-12)


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.9])
def test_the_share_of_compensated_increments_is_wrong_by_an_eighth_of_their_product(fraction):
    """Against the integral of a force that turns with the body at a constant rate, by a fine sum over rotations."""
    rate, force, dt = np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, 9.0]), 0.02

    def push(span):
        middles = (np.arange(2000) + 0.5) / 2000 * span
        return Rotation.from_rotvec(np.outer(middles, rate)).apply(force).mean(0) * span

    bound = np.linalg.norm(np.cross(rate * dt, push(dt))) / 8
    for part in (fraction, 1 - fraction):
        share = proportional(tensor(push(dt)), part).numpy()
        error = np.linalg.norm(share - push(part * dt))
        # s (1 - s) / 2 of the product, but for terms of the third order: the turn is 0.012 rad.
        assert error < bound * 1.02
        np.testing.assert_allclose(error, 4 * part * (1 - part) * bound, rtol=0.02)


def test_a_callable_is_asked_for_each_part():
    asked = []

    def split(u, fraction):
        asked.append((float(u), fraction))
        return fraction * u

    wrapper = stream(split=split)
    state, _ = wrapper.step(wrapper.init(), {}, tensor([8.0]), 0.4)
    state, _ = wrapper.late(state, {"speed": tensor([1.0])}, 0.1)
    assert asked == [(8.0, 0.25), (8.0, 0.75)]
    assert [float(one.u) for one in state.past] == [2.0, 6.0]
    assert [one.dt for one in state.past] == pytest.approx([0.1, 0.3])


def test_constraints_enter_each_step_once():
    """A constraint speaks at each step by itself, at a new one too, and never twice at one."""
    still = tf.PseudoMeasurement(tensor([[0, 1]]), 1, sd=0.5, value=1.5)
    wrapper = stream(kalman(still=still))
    state = moved(wrapper, wrapper.init(), 2)
    state, info = wrapper.late(state, {"position": tensor([1.0])}, 0.1)
    assert [e.sensor for e in info.arrivals] == ["position"]
    state, _ = wrapper.late(state, {"position": tensor([1.0])}, 0.15)
    constraint = [(t, 1, 1.5, 0.5) for t in (0.1, 0.15, 0.2)]
    expected, _, _ = batch_answer(0.2, [(0.1, 0, 1.0, POSITION_SD), (0.15, 0, 1.0, POSITION_SD), *constraint])
    np.testing.assert_allclose(state.belief.mean, expected, rtol=1e-11)
    # Left out of a step on purpose, it does not come in with a late measurement by another sensor.
    free, _ = wrapper.step(state, {"still": None}, dt=0.1)
    free, _ = wrapper.late(free, {"speed": tensor([2.0])}, 0.3)
    expected, _, _ = batch_answer(
        0.3, [(0.1, 0, 1.0, POSITION_SD), (0.15, 0, 1.0, POSITION_SD), *constraint, (0.3, 1, 2.0, SPEED_SD)]
    )
    np.testing.assert_allclose(free.belief.mean, expected, rtol=1e-11)


def test_what_is_given_is_left_alone_and_may_be_used_again():
    """Branches of one state do not see each other, and a buffer that is filled anew does not rewrite the past."""
    wrapper = stream()
    buffer, push = tensor([1.5, NAN]), tensor([0.5])
    state, _ = wrapper.step(wrapper.init(), buffer, push, 0.1)
    state, _ = wrapper.step(state, {}, push, 0.1)
    one, _ = wrapper.late(state, {"speed": tensor([2.0])}, 0.1)
    buffer.fill_(99.0), push.fill_(99.0)
    other, _ = wrapper.late(state, {"speed": tensor([2.0])}, 0.1)
    assert torch.equal(one.belief.mean, other.belief.mean) and len(state.past) == 2
    value = tensor([NAN, 2.0])  # makes a step of its own at 0.05 s, which is run again later
    third, _ = wrapper.late(state, value, 0.05)
    value.fill_(99.0)
    again, _ = wrapper.late(third, {"position": tensor([1.0])}, 0.05)
    order, _ = wrapper.late(state, {"position": tensor([1.0]), "speed": tensor([2.0])}, 0.05)
    assert torch.equal(again.belief.mean, order.belief.mean)


def test_gradients_pass_through_the_way_back():
    """The derivative of the evidence by a late value: minus the innovation over its variance."""
    wrapper = stream()
    state = moved(wrapper, wrapper.init(), 3)
    late = tensor([4.0]).requires_grad_()
    state, _ = wrapper.late(state, {"position": late}, 0.1)
    (slope,) = torch.autograd.grad(state.log_likelihood, late)
    variance = 4 + 9 * 0.01 + DENSITY * 0.001 / 3 + POSITION_SD**2
    np.testing.assert_allclose(slope, [-(4.0 - 1.2) / variance], rtol=1e-10)


# ----------------------------------------------------------------------------------------------------------------------
# What it is worth


def test_a_delay_that_is_not_told_is_a_bias():
    """Positions 0.3 s old at 10 m/s: taken as new they are off by 3 m; put where they belong the filter is calibrated.

    400 runs of 10 s, positions at 10 Hz with 0.4 m, acceleration noise 0.5 m^2/s^3; numbers of docs/filters.md.
    """
    runs, steps, lag, dt = 400, 100, 3, 0.1
    generator = torch.Generator().manual_seed(0)
    form = ConstantVelocity().linear_form(None, dt)
    x = tensor([0.0, 10.0]) + tensor([2.0, 3.0]) * torch.randn(runs, 2, generator=generator, dtype=F64)
    start, path, ys = x, [], []
    for _ in range(steps):
        x = x @ form.matrix.mT + torch.randn(runs, 2, generator=generator, dtype=F64) @ form.scale_tril.mT
        path.append(x)
        ys.append(x[:, :1] + POSITION_SD * torch.randn(runs, 1, generator=generator, dtype=F64))
    prior = tf.Gaussian(tensor([0.0, 10.0]), tensor(np.sqrt(P0)))
    plain = model()
    filter = tf.KalmanFilter(tf.StateSpaceModel(prior, plain.transition, plain.observation))
    wrapper = stream(filter, split=None)
    naive, state, refiltered = filter.init((runs,)), wrapper.init((runs,)), 0
    for k in range(steps):
        came = {"position": ys[k - lag]} if k >= lag else {}
        naive, _ = filter.step(naive, came, dt=dt)
        state, _ = wrapper.step(state, {}, dt=dt)
        if k >= lag:
            state, info = wrapper.late(state, came, (k - lag + 1) * dt)
            refiltered += len(info.steps)
    assert start.shape == (runs, 2)

    def report(belief):
        error = belief.mean - path[-1]
        nees = (error * torch.linalg.solve(belief.covariance, error.unsqueeze(-1)).squeeze(-1)).sum(-1).mean()
        return float(error[:, 0].mean()), float(error[:, 0].square().mean().sqrt()), float(nees)

    bias, rms, nees = report(naive.belief)
    print(f"\nas if new: bias {bias:.2f} m, rms {rms:.2f} m, NEES {nees:.1f}")
    naive_sd = float(naive.belief.covariance[..., 0, 0].mean().sqrt())
    handled_bias, handled_rms, handled_nees = report(state.belief)
    print(f"handled: bias {handled_bias:.3f} m, rms {handled_rms:.3f} m, NEES {handled_nees:.2f}; {refiltered} steps")
    deviation = float(state.belief.covariance[..., 0, 0].mean().sqrt())
    # Final speeds are 10 m/s with 3.7 m/s: 0.3 of their mean has a standard error of 0.06 m; four, 1 in 16,000.
    assert abs(bias + 0.3 * 10) < 0.25
    assert abs(handled_bias) < 4 * deviation / math.sqrt(runs)
    # The mean square of 400 has a relative deviation of 0.07; that of a mean NEES of 2 is 0.1: four of each.
    assert abs(handled_rms**2 / deviation**2 - 1) < 4 * 0.07 and abs(handled_nees - 2) < 4 * 0.1
    # What the bias alone makes of a claim that does not know of it, the speed's part left out.
    assert nees > (0.3 * 10 - 0.25) ** 2 / naive_sd**2 > chi2.isf(1e-6, 2 * runs) / runs
    assert refiltered == (lag + 1) * (steps - lag)


# ----------------------------------------------------------------------------------------------------------------------
# The horizon, the clock and the log


def test_the_past_is_bounded():
    wrapper = stream(horizon_s=0.5)
    state = wrapper.init()
    for _ in range(40):
        state, _ = wrapper.step(state, {"speed": tensor([1.0])}, dt=0.1)
        assert len(state.past) <= 6 and len(state.arrivals) <= 6
    assert state.past[0].time_s == pytest.approx(3.5) and state.past[0].since_s == pytest.approx(3.4)
    with pytest.raises(ValueError, match="already been taken in"):  # the last that can be reached
        wrapper.late(state, {"speed": tensor([1.0])}, 3.5)
    state, info = wrapper.late(state, {"position": tensor([8.0])}, 3.5)
    assert len(info.steps) == 6


def test_stale_measurements_are_refused_or_skipped_but_never_fused():
    for time_s, why in (
        (0.3, "at 1 s the horizon of 0.5 s reaches back to 0.5 s only"),
        (-0.1, "at 1 s the horizon of 0.5 s"),
    ):
        wrapper = stream()
        state = moved(wrapper, wrapper.init(), 10)
        with pytest.raises(ValueError, match=f"the measurement is of {time_s} s, {why}"):
            wrapper.late(state, {"position": tensor([1.0])}, time_s)
        calm = stream(on_stale="skip")
        after, info = calm.late(state, {"position": tensor([1.0])}, time_s)
        assert info.steps == () and after.now is state.now and after.past == state.past
        (entry,) = info.arrivals
        assert entry == after.arrivals[-1]
        assert entry[:2] == ("position", time_s) and entry.action == "skipped" and entry.refiltered == 0
        assert after.newest_s == state.newest_s


def test_before_the_prior_there_is_nothing():
    wrapper = stream()
    state = wrapper.init(time_s=5.0)
    for steps in (0, 2):
        with pytest.raises(ValueError, match=r"the measurement is of 4.9 s, before the prior at 5 s"):
            wrapper.late(moved(wrapper, state, steps), {"position": tensor([1.0])}, 4.9)
    after, info = wrapper.late(state, {"position": tensor([1.0])}, 5.0)
    assert info.arrivals[0].action == "inserted" and after.time_s == 5.0
    zero, _ = wrapper.step(state, {"position": tensor([1.0])}, dt=0)
    stated, _ = wrapper.step(state, {"position": tensor([1.0])}, time_s=5.0)
    assert torch.equal(after.belief.mean, zero.belief.mean) and torch.equal(after.belief.mean, stated.belief.mean)
    np.testing.assert_allclose(after.belief.mean[0], 1.0, rtol=1e-12)  # the prior's own mean


def test_a_sensor_speaks_once_at_a_time_unless_told():
    wrapper = stream()
    state = moved(wrapper, wrapper.init(), 1)
    state, _ = wrapper.step(state, {"position": tensor([1.0])}, dt=0.1)
    state, _ = wrapper.step(state, {"speed": tensor([3.0])}, dt=0.1)
    with pytest.raises(ValueError, match=r"sensor 'position' has already been taken in at 0.2 s; .* replace=True"):
        wrapper.late(state, {"position": tensor([2.0]), "speed": tensor([1.0])}, 0.2)
    after, info = wrapper.late(state, {"position": tensor([2.0]), "speed": tensor([1.0])}, 0.2, replace=True)
    assert [e.action for e in info.arrivals] == ["replaced", "joined"]
    assert [e.out_of_order for e in info.arrivals] == [False, True]
    measured = [(0.2, 0, 2.0, POSITION_SD), (0.2, 1, 1.0, SPEED_SD), (0.3, 1, 3.0, SPEED_SD)]
    mean, _, evidence = batch_answer(0.3, measured)
    np.testing.assert_allclose(after.belief.mean, mean, rtol=1e-11)
    np.testing.assert_allclose(float(after.log_likelihood), evidence, rtol=1e-11)


def test_times_as_near_as_the_tolerance_are_one():
    wrapper = stream(tolerance_s=0.01)
    state = moved(wrapper, wrapper.init(), 3)
    for time_s in (0.195, 0.205, 0.302):
        _, info = wrapper.late(state, {"position": tensor([1.0])}, time_s)
        assert info.arrivals[0].action == "joined"
    _, info = wrapper.late(state, {"position": tensor([1.0])}, 0.215)
    assert info.arrivals[0].action == "inserted"
    same, info = wrapper.step(state, {"position": tensor([1.0])}, dt=0.005)
    assert info.arrivals[0].action == "joined" and same.time_s == state.time_s


def test_without_names_the_sensor_is_the_measurement():
    law = tf.LinearGaussian(torch.eye(2, dtype=F64), torch.eye(2, dtype=F64))
    wrapper = stream(tf.KalmanFilter(tf.StateSpaceModel(model().initial, ConstantVelocity(), law)))
    assert wrapper.sensors == ("measurement",)
    state, info = wrapper.step(wrapper.init(), tensor([1.0, NAN]), dt=0.1)
    assert info.arrivals[0].sensor == "measurement"
    _, info = wrapper.late(state, tensor([NAN, 1.0]), 0.1)
    assert info.arrivals[0].action == "joined"
    with pytest.raises(ValueError, match="sensor 'measurement' has already"):
        wrapper.late(state, tensor([1.0, 1.0]), 0.1)


def test_a_stream_goes_on_from_a_history():
    filter = kalman()
    history = filter(tensor([[1.0, NAN], [2.0, 1.0]]), dt=0.1)
    wrapper = stream(filter)
    state = wrapper.init(time_s=0.2, state=history.final)
    assert torch.equal(state.belief.mean, history.mean[-1]) and state.time_s == 0.2
    after, _ = wrapper.step(state, {"speed": tensor([1.0])}, dt=0.1)
    expected, _ = filter.step(history.final, {"speed": tensor([1.0])}, dt=0.1)
    assert torch.equal(after.belief.mean, expected.belief.mean) and after.now.step == 3


def test_failed_rows_raise_or_are_reported():
    """A step that fails on the way back leaves the state as it was."""
    exact = tf.PseudoMeasurement(tensor([[1, 0], [1, 0]]), 2, sd=0.0)  # the same number twice, without noise
    wrapper = stream(kalman(exact=exact))
    state, _ = wrapper.step(wrapper.init(), {"exact": None}, dt=0.1)
    bad = {"exact": tensor([1.0, 2.0])}
    with pytest.raises(tf.FilterError, match="step 0"):
        wrapper.late(state, bad, 0.1)
    failed, info = wrapper.late(state, bad, 0.1, throw=False)
    assert not bool(info.steps[-1].ok) and bool(torch.isfinite(state.belief.mean).all())
    with pytest.raises(tf.FilterError, match="step 1"):
        wrapper.step(state, bad, dt=0.1)
    _, info = wrapper.step(state, bad, dt=0.1, throw=False)
    assert not bool(info.steps[0].ok) and failed.time_s == 0.1


# ----------------------------------------------------------------------------------------------------------------------
# Files


def test_a_saved_stream_goes_on_with_the_same_bits(tmp_path):
    filters = {"kalman": kalman(), "bootstrap": tf.BootstrapFilter(model(), 20)}
    for name, filter in filters.items():
        wrapper = stream(filter)
        state = moved(wrapper, wrapper.init((2,), seed=5), 4)
        delays.save(state, tmp_path / name)
        read = delays.load(tmp_path / name)
        late = {"position": tensor([[1.0], [2.0]])}
        one, _ = wrapper.late(state, late, 0.15)
        other, _ = wrapper.late(read, late, 0.15)
        assert torch.equal(one.belief.mean, other.belief.mean) and one.arrivals == other.arrivals


def test_files_that_are_not_whole_are_refused(tmp_path):
    path = tmp_path / "stream"
    delays.save(stream().init(), path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    with pytest.raises(IntegrityError, match="truncated or altered"):
        delays.load(path)
    write_verified(path, b"something else", delays.FILE_KIND)
    with pytest.raises(IntegrityError, match="not a stream of this version"):
        delays.load(path)
    with (tmp_path / "other").open("wb") as file:
        torch.save({"a": 1}, file)
    write_verified(path, (tmp_path / "other").read_bytes(), delays.FILE_KIND)
    with pytest.raises(IntegrityError, match="it holds a dict"):
        delays.load(path)
    with (tmp_path / "other").open("wb") as file:
        torch.save(tf.Gate(0.9), file)  # nothing but the parts of a state is ever made from a file
    write_verified(path, (tmp_path / "other").read_bytes(), delays.FILE_KIND)
    with pytest.raises(IntegrityError, match=r"not a stream of this version \(UnpicklingError\)"):
        delays.load(path)
    with pytest.raises(FileNotFoundError):
        delays.load(tmp_path / "none")
    with pytest.raises(TypeError, match="state must be a DelayedState"):
        delays.save(kalman().init(), path)

    class Own(tf.Euclidean):
        pass

    state = stream().init()
    foreign = state._replace(now=state.now._replace(belief=state.belief._replace(space=Own(2))))
    with pytest.raises(TypeError, match="only the library's own spaces"):
        delays.save(foreign, path)


# ----------------------------------------------------------------------------------------------------------------------
# Errors


def imm(**jump):
    return tf.InteractingMultipleModel([model(), model()], **jump)


PROBABILITIES = torch.full((2, 2), 0.5, dtype=F64)
FIXED = tf.LinearGaussian(torch.eye(2, dtype=F64), torch.eye(2, dtype=F64))
BLIND = tf.AdditiveGaussian(lambda x: x, torch.eye(2, dtype=F64))


def with_motion(law, **more):
    return tf.StateSpaceModel(model().initial, law, model().observation, **more)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: DelayedMeasurements(model(), 1.0), TypeError, "filter must be a Filter, got StateSpaceModel"),
        (lambda: stream(split="held"), TypeError, "split must be callable .* got str"),
        (lambda: stream(horizon_s=0.0), ValueError, "horizon_s must be positive and finite, got 0.0"),
        (lambda: stream(horizon_s=math.inf), ValueError, "horizon_s must be positive and finite, got inf"),
        (lambda: stream(tolerance_s=NAN), ValueError, "tolerance_s must be positive and finite, got nan"),
        (lambda: stream(on_stale="fuse"), ValueError, "on_stale must be 'raise' or 'skip', got 'fuse'"),
        (lambda: stream(tf.KalmanFilter(with_motion(FIXED))), ValueError, "a LinearGaussian, does not look at dt"),
        (
            lambda: stream(tf.UnscentedKalmanFilter(with_motion(BLIND, gauge=lambda x: x))),
            ValueError,
            "an? AdditiveGaussian, does not look at dt",
        ),
        (lambda: stream(tf.BootstrapFilter(with_motion(lambda x: FIXED(x)), 5)), ValueError, "does not look at dt"),
        (lambda: stream(imm(transition_probabilities=PROBABILITIES)), ValueError, "rates_per_s only"),
        (
            lambda: stream(tf.InteractingMultipleModel([model(), with_motion(FIXED)], rates_per_s=0 * PROBABILITIES)),
            ValueError,
            "does not look at dt",
        ),
    ],
)
def test_wrong_settings(make, error, message):
    with pytest.raises(error, match=message):
        make()


ONE = {"position": torch.ones(1, dtype=F64)}


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda w, s: w.late(s, ONE, 0.4), ValueError, r"is of 0.4 s, but the filter has come to 0.2 s only"),
        (lambda w, s: w.late(s, ONE, NAN), ValueError, "time_s must be finite, got nan"),
        (lambda w, s: w.late(s, ONE, torch.tensor(0.1)), TypeError, "time_s must be a number, got Tensor"),
        (lambda w, s: w.late(s.now, ONE, 0.1), TypeError, "state must be a DelayedState, .* got FilterState"),
        (lambda w, s: w.late(s, {}, 0.1), ValueError, "must measure something"),
        (lambda w, s: w.late(s, {"position": None}, 0.1), ValueError, "must measure something"),
        (lambda w, s: w.late(s, torch.full((2,), NAN, dtype=F64), 0.1), ValueError, "must measure something"),
        (lambda w, s: w.late(s, {"sonar": ONE["position"]}, 0.1), ValueError, "there is no sensor 'sonar'"),
        (lambda w, s: w.late(s, torch.ones(3, dtype=F64), 0.1), ValueError, r"y must be \(2,\), .* got \(3,\)"),
        (lambda w, s: w.late(s, torch.ones(2), 0.1), TypeError, "must have the dtype torch.float64, got torch.float32"),
        (lambda w, s: w.late(s, [1.0, 2.0], 0.1), TypeError, "y must be a tensor, or a mapping by sensor, got list"),
        (lambda w, s: w.late(s, torch.full((2,), math.inf, dtype=F64), 0.1), ValueError, "must be finite or NaN"),
        (lambda w, s: w.step(s.now, ONE, dt=0.1), TypeError, "state must be a DelayedState"),
        (lambda w, s: w.step(s, ONE), ValueError, "give exactly one of dt= and time_s="),
        (lambda w, s: w.step(s, ONE, dt=0.1, time_s=0.3), ValueError, "give exactly one of dt= and time_s="),
        (lambda w, s: w.step(s, ONE, dt=torch.tensor(0.1)), TypeError, "dt must be a number, one clock for all rows"),
        (lambda w, s: w.step(s, ONE, dt=-0.1), ValueError, "dt must be finite and >= 0, got -0.1"),
        (lambda w, s: w.step(s, ONE, time_s=0.1), ValueError, "must not run backward, from 0.2 to 0.1 s; .* late"),
        (lambda w, s: w.step(s, ONE, time_s="now"), TypeError, "time_s must be a number, got str"),
        (lambda w, s: w.step(s, ONE, torch.ones(1, dtype=F64), 0.0), ValueError, "no time has no control"),
        (lambda w, s: w.step(s, [1.0], dt=0.1), TypeError, "y must be a tensor, got list"),
        (lambda w, s: w.init(time_s=NAN), ValueError, "time_s must be finite, got nan"),
    ],
)
def test_wrong_calls(call, error, message):
    wrapper = stream()
    with pytest.raises(error, match=message):
        call(wrapper, moved(wrapper, wrapper.init(), 2))


def test_steps_are_not_split_unless_told():
    wrapper = stream(split=None)
    state = moved(wrapper, wrapper.init(), 2)
    with pytest.raises(ValueError, match=r"0.15 s, within the step from 0.1 to 0.2 s: give split=held"):
        wrapper.late(state, ONE, 0.15)
    _, info = wrapper.late(state, ONE, 0.1)
    assert info.arrivals[0].action == "joined"
