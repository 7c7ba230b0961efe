"""What every log of inertial sensors must keep, and its increments between filter times."""

import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchfilt.io.files import LogError
from torchfilt.io.inertial import (
    GnssFixes,
    InertialLog,
    Reference,
    check_fixes,
    check_samples,
    group_increments,
)


def samples(count=50, seed=0):
    random = np.random.default_rng(seed)
    time = torch.from_numpy(np.cumsum(random.uniform(0.008, 0.012, count)))
    gyro, force = torch.from_numpy(random.standard_normal((2, count, 3)))
    return time, gyro, force + torch.tensor([0, 0, 9.8])


def log_of(time, gyro, accel, gaps=()):
    nothing = Reference(*[time[:0]] * 8)
    return InertialLog(time, gyro, accel, fixes(), nothing, torch.tensor(gaps, dtype=torch.int64))


def fixes(count=20, **changes):
    """Northward at 10 m/s and eastward at 5 m/s, climbing 1 m/s."""
    time = torch.arange(count, dtype=torch.float64)
    latitude = 0.8 + 10 * time / 6.371e6
    longitude = -1.6 + 5 * time / 6.371e6 / np.cos(0.8)
    velocity = torch.tensor([5.0, 10.0, 1.0], dtype=torch.float64).expand(count, 3)
    return GnssFixes(time, latitude, longitude, 100 + time, velocity)._replace(**changes)


# Increments


def integral(time, values, at):
    """Oracle: values held over the interval that ends at their time, integrated by numpy's interpolation."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(values[1:] * np.diff(time)[:, None], axis=0)])
    return np.stack([np.interp(at, time, column) for column in total.T], -1)


@given(st.integers(2, 60), st.integers(1, 12), st.integers(0, 10**6))
def test_increments_are_differences_of_the_integral(count, steps, seed):
    """Tolerance: 1e-12 is 1000 roundings of sums below 10."""
    time, gyro, accel = samples(count, seed)
    random = np.random.default_rng(seed + 1)
    edges = np.sort(random.uniform(time[0], time[-1], steps + 1))
    edges[::3] = time.numpy()[np.searchsorted(time.numpy(), edges[::3])]  # some on samples
    edges = np.unique(edges)
    if len(edges) < 2:
        return
    found = group_increments(log_of(time, gyro, accel), times_s=torch.from_numpy(edges))
    assert found.time_s.tolist() == edges[1:].tolist()
    assert found.dt_s.tolist() == np.diff(edges).tolist()
    for sums, values in ((found.dtheta_rad, gyro), (found.dv_m_s, accel)):
        expected = np.diff(integral(time.numpy(), values.numpy(), edges), axis=0)
        np.testing.assert_allclose(sums.numpy(), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.sample_dt_s.sum(1), np.diff(edges), rtol=0, atol=1e-15)
    assert found.whole.all()


def test_samples_of_a_step_come_in_order_and_steps_are_filled_up_with_nothing():
    time = torch.tensor([0.0, 1, 2, 3, 4], dtype=torch.float64)
    gyro = time.unsqueeze(-1).expand(5, 3).contiguous()
    found = group_increments(log_of(time, gyro, gyro + 10), times_s=torch.tensor([0.5, 2.0, 2.25, 4.0]).double())
    assert found.sample_dt_s.tolist() == [[0.5, 1.0], [0.25, 0.0], [0.75, 1.0]]
    assert found.gyro_rad_s[..., 0].tolist() == [[1, 2], [3, 0], [3, 4]]
    assert found.accel_m_s2[..., 2].tolist() == [[11, 12], [13, 0], [13, 14]]
    assert found.dtheta_rad[:, 1].tolist() == [2.5, 0.75, 6.25]


def test_a_rate_gives_equal_steps_from_the_first_sample():
    time = 3 + torch.arange(101, dtype=torch.float64) * 0.01
    _, gyro, accel = samples(101)
    found = group_increments(log_of(time, gyro, accel), 10.0)
    torch.testing.assert_close(found.time_s, 3 + torch.arange(1, 11).double() / 10, rtol=1e-15, atol=0)
    expected = gyro[1:].reshape(10, 10, 3).sum(1) * 0.01
    torch.testing.assert_close(found.dtheta_rad, expected, rtol=0, atol=1e-13)  # times are rounded at 4e-16
    assert len(group_increments(log_of(time, gyro, accel), 3.0).dt_s) == 3
    assert len(group_increments(log_of(time, gyro, accel), 7.0).dt_s) == 7


def test_a_step_over_a_gap_is_not_whole():
    time, gyro, accel = samples()
    time = time + 1.0 * (torch.arange(50) >= 20)
    marked = check_samples("a", time, gyro, accel, 0.1, "mark")
    assert marked.tolist() == [20]
    found = group_increments(
        log_of(time, gyro, accel, [20]), times_s=torch.stack([time[0], time[19], time[20], time[49]])
    )
    assert found.whole.tolist() == [True, False, True]
    inside = torch.tensor([time[19] + 0.4, time[19] + 0.6])
    assert group_increments(log_of(time, gyro, accel, [20]), times_s=inside).whole.tolist() == [False]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "either a rate or times"),
        ({"rate_hz": 1.0, "times_s": torch.tensor([0.1, 0.2])}, "either a rate or times"),
        ({"rate_hz": 0.0}, "rate must be positive and finite, got 0.0 Hz"),
        ({"rate_hz": float("nan")}, "rate must be positive and finite, got nan"),
        ({"rate_hz": float("inf")}, "rate must be positive and finite, got inf"),
        ({"rate_hz": 0.5}, "no step of 2 s fits into the"),
        ({"times_s": torch.tensor([0.1])}, r"at least two numbers that increase, got shape \(1,\)"),
        ({"times_s": torch.tensor([[0.1, 0.2]])}, "one row"),
        ({"times_s": torch.tensor([0.1, 0.1])}, "increase"),
        ({"times_s": torch.tensor([0.1, float("nan")])}, "increase"),
        ({"times_s": torch.tensor([0.0, 0.1])}, "times go from 0 to 0.1 s, the samples from"),
        ({"times_s": torch.tensor([0.1, 9.0])}, "times go from 0.1 to 9 s, the samples from"),
    ],
)
def test_filter_times_that_do_not_fit_are_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        group_increments(log_of(*samples()), **arguments)


# Samples


def put(values, row, value):
    values = values.clone()
    values[row] = value
    return values


T, W, F = samples()


@pytest.mark.parametrize(
    ("time", "gyro", "accel", "words"),
    [
        (T[:0], W[:0], F[:0], "a.csv: .*at least one sample"),
        (put(T, 3, torch.nan), W, F, "a.csv: times_s must be finite: sample 3"),
        (put(T, 3, T[2]), W, F, "a.csv: times_s must increase, this one is repeated: sample 3 at"),
        (put(T, 3, T[0]), W, F, "a.csv: times_s must increase, this one goes backward: sample 3 at"),
        (torch.where(torch.arange(50) > 9, T + 0.1, T), W, F, "a.csv: .* no gap above 0.05 s: sample 10 at"),
        (T, put(W, 5, torch.nan), F, "a.csv: gyro_rad_s must be finite: sample 5"),
        (T, W, put(F, 5, torch.inf), "a.csv: accel_m_s2 must be finite: sample 5"),
        (T, put(W, 5, 21.0), F, "a.csv: angular rate must be at most 35 rad/s: sample 5"),
        (T, W, put(F, 7, 120.0), "a.csv: specific force must be at most 200 m/s.2: sample 7"),
        (T, W, F / 9.8, "a.csv: specific force must be in m/s.2: .* as if in g"),
    ],
)
def test_samples_that_cannot_be_true_are_named_by_file_sample_and_rule(time, gyro, accel, words):
    with pytest.raises(LogError, match=words):
        check_samples("a.csv", time, gyro, accel, 0.05, "refuse")


def test_gaps_and_their_limit_are_arguments():
    assert check_samples("a", T, W, F, 0.01, "mark").tolist() == ((T.diff() > 0.01).nonzero().squeeze(-1) + 1).tolist()
    with pytest.raises(ValueError, match='gaps must be "refuse" or "mark", got \'ignore\''):
        check_samples("a", T, W, F, 0.05, "ignore")
    for wrong in (0.0, float("nan")):
        with pytest.raises(ValueError, match=re.escape(f"max_gap_s must be positive, got {wrong}")):
            check_samples("a", T, W, F, wrong, "refuse")


# Fixes


def test_fixes_that_agree_pass():
    check_fixes("g", fixes())
    check_fixes("g", fixes(position_sd_m=torch.ones(20, 3), velocity_sd_m_s=torch.ones(20, 3)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"latitude_rad": fixes().latitude_rad.rad2deg()}, "row 1: got 45.8.* rad of latitude; is it in degrees"),
        ({"longitude_rad": fixes().longitude_rad.rad2deg()}, "row 1: got -91.6.* rad of longitude; is it in degrees"),
        ({"latitude_rad": fixes().latitude_rad.deg2rad()}, "velocity differs from the differenced position by"),
        ({"velocity_m_s": fixes().velocity_m_s[:, [1, 0, 2]]}, "by 7.07 m/s in the median, more than 3.0 m/s"),
        ({"velocity_m_s": fixes().velocity_m_s * 3.6}, "check units and axes"),
        ({"height_m": put(fixes().height_m, 4, torch.nan)}, "row 5: got nan of height_m; values must be finite"),
        ({"velocity_m_s": put(fixes().velocity_m_s, 4, torch.inf)}, "row 5: .* of velocity_m_s; values must be finite"),
        ({"time_s": put(fixes().time_s, 4, 2.0)}, "row 5: time goes from 3.0 s to 2.0 s"),
        ({"position_sd_m": put(torch.ones(20, 3), 2, 0.0)}, "row 3: got 0.0 of position_sd_m; it must be positive"),
        ({"velocity_sd_m_s": -torch.ones(20, 3)}, "row 1: got -1.0 of velocity_sd_m_s; it must be positive"),
    ],
)
def test_fixes_that_cannot_be_true_are_named(changes, words):
    with pytest.raises(LogError, match=words):
        check_fixes("g", fixes(**changes))


def test_the_tolerance_of_velocity_is_an_argument():
    check_fixes("g", fixes(velocity_m_s=fixes().velocity_m_s[:, [1, 0, 2]]), tolerance_m_s=8.0)
    with pytest.raises(LogError, match=r"more than 1e-06 m/s"):
        check_fixes("g", fixes(velocity_m_s=fixes().velocity_m_s + 1e-3), tolerance_m_s=1e-6)
