"""Sensor grades and noise against data sheets' units and the Allan deviation; the check of logged samples."""

import math

import numpy as np
import pytest
import torch

from torchfilt.models.inertial.imu import (
    MEMS,
    MEMS_START,
    TACTICAL,
    TACTICAL_START,
    ImuGrade,
    StartErrors,
    check_imu,
    measure,
    seeded_normals,
)

DOUBLE = torch.float64
INTERVAL = 0.01


def allan_deviation(rates, samples):
    """Of rates (t, ...) averaged over clusters of so many samples, one after another."""
    count = len(rates) // samples
    means = rates[: count * samples].reshape(count, samples, *rates.shape[1:]).mean(1)
    return np.sqrt((np.diff(means, axis=0) ** 2).mean(0) / 2), count


@pytest.mark.parametrize(
    ("grade", "expected"),
    [
        # deg/h, deg/sqrt(h), g, g/sqrt(Hz)
        (TACTICAL, (0.1, 0.01, 1e-4, 1e-5)),
        (MEMS, (10.0, 0.3, 1e-3, 1e-4)),
    ],
)
def test_grades_in_units_of_data_sheets(grade, expected):
    hour, g = 3600.0, 9.80665
    bias, walk, force, density = vars(grade).values()
    found = (math.degrees(bias) * hour, math.degrees(walk) * hour**0.5, force / g, density / g)
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_starts():
    minute = math.degrees(1) * 60
    for start, expected in ((TACTICAL_START, (1.2, 1.2, 1.5)), (MEMS_START, (30, 30, 120))):
        np.testing.assert_allclose(np.array(start.attitude_sd_rad) * minute, expected, rtol=1e-14)
        assert (start.position_sd_m, start.velocity_sd_m_s) == ((10.0, 10.0, 15.0), 0.8)


@pytest.mark.parametrize("grade", [TACTICAL, MEMS])
def test_noise_has_the_allan_deviation_of_its_grade(grade):
    """White noise of density N: N / sqrt(tau) at all tau, whatever the constant bias.

    The squares of m successive differences of white cluster means vary by sqrt(3 / m) of their mean (neighbours share a
    cluster), their root by half of that; 24 channels are averaged. Five deviations for each of 10 numbers: false alarm
    6e-6.
    """
    t, seeds = 30_000, range(8)
    true = torch.zeros(t, 3, dtype=DOUBLE)
    noise = seeded_normals(seeds, (t, 6))
    bias = torch.full((8, 3), 5.0, dtype=DOUBLE)
    found = measure(true, true, INTERVAL, grade, bias * grade.gyro_bias_sd_rad_s, bias * 0.01, noise)
    for increments, density in zip(
        found, (grade.angle_random_walk_rad_sqrt_s, grade.velocity_random_walk_m_s_sqrt_s), strict=True
    ):
        for samples in (1, 10, 30, 100, 300):
            deviation, count = allan_deviation(increments.numpy() / INTERVAL, samples)
            ratio = np.sqrt((deviation**2).mean()) / (density / math.sqrt(samples * INTERVAL))
            assert abs(ratio - 1) < 5 * math.sqrt(3 / (count - 1) / deviation.size) / 2, samples


def test_biases_come_through():
    """The mean of measured minus true is the bias, to five standard errors of 48 numbers (false alarm 3e-5)."""
    t, seeds = 20_000, range(8)
    turn, push = 1e-3 * torch.ones(t, 3, dtype=DOUBLE), torch.tensor([0.0, 0.01, 0.098], dtype=DOUBLE).expand(t, 3)
    gyro = MEMS.gyro_bias_sd_rad_s * seeded_normals(seeds, (1, 3), 1)[0]
    accel = MEMS.accel_bias_sd_m_s2 * seeded_normals(seeds, (1, 3), 2)[0]
    assert gyro.shape == (8, 3)
    found = measure(turn, push, INTERVAL, MEMS, gyro, accel, seeded_normals(seeds, (t, 6)))
    for measured, true, bias, density in (
        (found.dtheta_rad, turn, gyro, MEMS.angle_random_walk_rad_sqrt_s),
        (found.dvelocity_m_s, push, accel, MEMS.velocity_random_walk_m_s_sqrt_s),
    ):
        mean = (measured - true.unsqueeze(1)).mean(0) / INTERVAL
        assert ((mean - bias).abs() < 5 * density / math.sqrt(t * INTERVAL)).all()


def test_each_seed_has_numbers_of_its_own():
    """Whoever stands beside it; other streams and other seeds are unrelated: correlation below 5 / sqrt(6000)."""
    many = seeded_normals([3, 7, 11], (1000, 6))
    assert many.shape == (1000, 3, 6)
    assert torch.equal(many[:, 1], seeded_normals([7], (1000, 6))[:, 0])
    other = seeded_normals([7], (1000, 6), stream=1)[:, 0]
    for a, b in ((many[:, 0], many[:, 1]), (many[:, 1], other)):
        assert (a * b).mean().abs() < 5 / 6000**0.5


def test_noise_without_a_batch_and_in_single_precision():
    noise = seeded_normals([0], (5, 6))
    turn, push = torch.rand(5, 3).double(), torch.rand(5, 3).double()
    bias = torch.tensor([1.0, 2.0, 3.0], dtype=DOUBLE)
    one = measure(turn, push, INTERVAL, MEMS, bias, -bias, noise[:, 0])
    batch = measure(turn, push, INTERVAL, MEMS, bias, -bias, noise)
    single = measure(turn.float(), push.float(), INTERVAL, MEMS, bias.float(), -bias.float(), noise[:, 0].float())
    for alone, row, short in zip(one, batch, single, strict=True):
        assert alone.shape == (5, 3)
        assert torch.equal(row[:, 0], alone)
        assert short.dtype == torch.float32
        torch.testing.assert_close(short.double(), alone, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ImuGrade(-1.0, 0.0, 0.0, 0.0), "gyro_bias_sd_rad_s must be finite and not negative, got -1.0"),
        (lambda: ImuGrade(0.0, math.nan, 0.0, 0.0), "angle_random_walk_rad_sqrt_s must be finite"),
        (lambda: ImuGrade.from_datasheet(1, 1, math.inf, 1), "accel_bias_sd_m_s2 must be finite"),
        (lambda: StartErrors(position_sd_m=(1.0, -2.0, 1.0)), r"position_sd_m .* got \(1.0, -2.0, 1.0\)"),
        (lambda: StartErrors(velocity_sd_m_s=math.nan), "velocity_sd_m_s must be finite"),
        (
            lambda: measure(*[torch.zeros(1, 3)] * 2, 0.0, MEMS, *[torch.zeros(3)] * 2, torch.zeros(1, 6)),
            "interval_s must be positive, got 0.0",
        ),
    ],
)
def test_bad_settings_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


# Logged samples -------------------------------------------------------------------------------------------------------


def log(**changes):
    """Ten good samples at 100 Hz as numpy, with changes: name=(index, value)."""
    rng = np.random.default_rng(0)
    parts = {
        "times": 5 + np.arange(10) / 100,
        "gyro": 0.1 * rng.standard_normal((10, 3)),
        "accel": rng.standard_normal((10, 3)) + np.array([0, 0, 9.8]),
    }
    for name, (index, value) in changes.items():
        parts[name][index] = value
    return parts.values()


def test_good_samples_pass():
    check_imu(*log())
    check_imu(*(torch.from_numpy(part).requires_grad_() for part in log()))
    check_imu(*(torch.from_numpy(part).float() for part in log()))
    check_imu(*(part[:1] for part in log()))
    check_imu(*log(times=(slice(6, None), 9 + np.arange(4) / 100)), max_gap_s=math.inf)
    # Fast, and loaded, but not impossible: a spinning rocket.
    check_imu(*log(gyro=(4, [0, 30.7, 0]), accel=(5, [0, 0, 190])))
    # In free fall nothing is felt.
    check_imu(*log(accel=(slice(None), 0.01)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gyro": ((4, 1), np.nan)}, r"gyro_rad_s must be finite: sample 4 at 5.04 s is \[.*nan"),
        ({"accel": ((7, 0), np.inf)}, r"accel_m_s2 must be finite: sample 7 at 5.07 s is \[.*inf"),
        ({"times": (3, np.nan)}, "times_s must be finite: sample 3 at nan s is nan"),
        ({"times": (6, 5.05)}, "repeated: sample 6 at 5.05 s follows sample 5 at 5.05 s"),
        ({"times": (6, 5.01)}, "backward: sample 6 at 5.01 s follows sample 5 at 5.05 s"),
        (
            {"times": (slice(6, None), 5.2 + np.arange(4) / 100)},
            r"no gap above 0.1 s: sample 6 at 5.2 s follows sample 5 at 5.05 s",
        ),
        ({"gyro": (2, [30, 30, 0])}, "angular rate must be at most 35 rad/s: sample 2 at 5.02 s is 42.4264"),
        ({"gyro": (2, [30, 30, 0])}, "as degrees per second the largest would be 0.74 rad/s"),
        ({"accel": (8, [0, 0, -250])}, r"at most 200 m/s\^2: sample 8 at 5.08 s is 250"),
        (
            {"accel": (slice(None), [0.02, 0, 1])},
            r"must be in m/s\^2: its median over 10 samples is 1, as if in g; multiply by 9.80665",
        ),
    ],
)
def test_bad_samples_are_named(changes, words):
    with pytest.raises(ValueError, match=words):
        check_imu(*log(**changes))
    with pytest.raises(ValueError, match=words):
        check_imu(*(torch.from_numpy(part) for part in log(**changes)))


def test_the_first_fault_is_named():
    with pytest.raises(ValueError, match=r"sample 3 at 5.03 s is 49"):
        check_imu(*log(gyro=([7, 3], [[60, 0, 0], [49, 0, 0]])))
    with pytest.raises(ValueError, match=r"no gap above 0.005 s: sample 1 at 5.01 s follows sample 0 at 5 s"):
        check_imu(*log(), max_gap_s=0.005)


@pytest.mark.parametrize(
    "shapes", [((10,), (10, 3), (9, 3)), ((10,), (10, 4), (10, 4)), ((10, 1), (10, 3), (10, 3)), ((0,), (0, 3), (0, 3))]
)
def test_shapes_are_named(shapes):
    with pytest.raises(ValueError, match=r"times_s must be .* at least one sample, got"):
        check_imu(*(np.ones(shape) for shape in shapes))
