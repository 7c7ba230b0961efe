"""Noise of inertial sensors: simulated series against closed forms of the Allan deviation, and back to parameters."""

import math

import numpy as np
import pytest
import torch

from torchfilt.models.inertial.imu import ImuGrade, measure, seeded_normals
from torchfilt.models.landing import LandingTransition
from torchfilt.models.sensors.imu import (
    ADIS16448,
    AllanParameters,
    ImuNoise,
    allan_deviation,
    fit_allan,
    random_walk,
    simulate_imu,
)

DOUBLE = torch.float64
INTERVAL = 0.01
CLUSTERS = (1, 3, 10, 30, 100, 300, 1000)
NOISE = ImuNoise(AllanParameters(2e-4, walk=1e-3), AllanParameters(2e-3, walk=3e-3), 0.01, 0.1)


def series(imu, count=20_000, seeds=16):
    still = torch.zeros(count, 3, dtype=DOUBLE)
    start = seeded_normals(range(seeds), (1, 6), 1)[0]
    return simulate_imu(still, still, INTERVAL, imu, seeded_normals(range(seeds), (count, 12)), start)


def closed_form(parameters, clusters):
    """Of white noise, and of a walk that stays for each interval: K^2 T (2 m^2 + 1) / (6 m), K^2 t / 3 for large m."""
    m = np.asarray(clusters, dtype=float)
    walk = parameters.walk**2 * INTERVAL * (2 * m**2 + 1) / (6 * m)
    return parameters.white**2 / (m * INTERVAL) + walk


@pytest.mark.parametrize("kind", ["both", "white", "walk"])
def test_simulated_series_have_the_allan_deviation_of_their_parameters(kind):
    """Variances averaged over 48 channels, to five standard errors taken from their spread: 42 numbers, a t law with 47
    degrees of freedom, false alarm 4e-4 in all.
    """
    gyro, accel = (
        AllanParameters(one.white * (kind != "walk"), walk=one.walk * (kind != "white"))
        for one in (NOISE.gyro, NOISE.accel)
    )
    sensed = series(ImuNoise(gyro, accel, 0.01, 0.1))
    for increments, parameters in zip(sensed.increments, (gyro, accel), strict=True):
        found = allan_deviation(increments / INTERVAL, CLUSTERS).flatten(1).square().numpy()
        error = found.std(1, ddof=1) / math.sqrt(found.shape[1])
        expected = closed_form(parameters, CLUSTERS)
        assert (np.abs(found.mean(1) - expected) < 5 * error).all(), (found.mean(1) / expected, error / expected)
        assert (error < 0.25 * expected).all()
        # The discrete walk against that of continuous time, from ten intervals on.
        smooth = parameters.deviation(INTERVAL * torch.tensor(CLUSTERS, dtype=DOUBLE)).numpy()
        np.testing.assert_allclose(np.sqrt(expected[2:]), smooth[2:], rtol=1 / 300)


def test_deviation_by_hand():
    time = torch.tensor([0.1, 1.0, 100.0], dtype=DOUBLE)
    one = AllanParameters(0.2, 0.03, 0.004)
    expected = [math.sqrt(0.04 / t + 2 * math.log(2) / math.pi * 9e-4 + 1.6e-5 * t / 3) for t in time.tolist()]
    np.testing.assert_allclose(one.deviation(time), expected, rtol=1e-14)
    assert one.deviation(time.float()).dtype == torch.float32


def test_allan_deviation_by_its_definition():
    rates = torch.randn(23, 2, generator=torch.Generator().manual_seed(0), dtype=DOUBLE) + 1e3
    found = allan_deviation(rates, (1, 4, 11))
    for row, m in zip(found, (1, 4, 11), strict=True):
        values = rates.numpy()
        pairs = [values[k + m : k + 2 * m].mean(0) - values[k : k + m].mean(0) for k in range(23 - 2 * m + 1)]
        np.testing.assert_allclose(row, np.sqrt(np.mean(np.square(pairs), 0) / 2), rtol=1e-11)
    # A drift a sample makes m / sqrt(2) of it.
    ramp = 0.3 * torch.arange(50, dtype=DOUBLE)
    np.testing.assert_allclose(allan_deviation(ramp, (1, 7)), [0.3 / 2**0.5, 2.1 / 2**0.5], rtol=1e-12)


def test_biases_walk():
    """Start and steps by hand; a walk that does not move is the constant bias of the inertial package, bit for bit."""
    noise, start = seeded_normals(range(3), (5, 12)), seeded_normals(range(3), (1, 6), 1)[0]
    true = torch.rand(5, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    sensed = simulate_imu(true, -true, INTERVAL, NOISE, noise, start)
    gyro, accel = 0.01 * start[:, :3].numpy(), 0.1 * start[:, 3:].numpy()
    for k in range(5):
        np.testing.assert_allclose(sensed.gyro_bias_rad_s[k], gyro, rtol=1e-12)
        np.testing.assert_allclose(sensed.accel_bias_m_s2[k], accel, rtol=1e-12)
        white = 2e-4 * 0.1 * noise[k, :, :3].numpy()
        np.testing.assert_allclose(
            sensed.increments.dtheta_rad[k], true[k].numpy() + gyro * INTERVAL + white, rtol=0, atol=1e-15
        )
        gyro = gyro + 1e-3 * 0.1 * noise[k, :, 6:9].numpy()
        accel = accel + 3e-3 * 0.1 * noise[k, :, 9:].numpy()
    rest = ImuNoise(AllanParameters(2e-4), AllanParameters(2e-3), 0.01, 0.1)
    sensed = simulate_imu(true, -true, INTERVAL, rest, noise, start)
    plain = measure(true, -true, INTERVAL, rest.grade(), 0.01 * start[:, :3], 0.1 * start[:, 3:], noise[..., :6])
    assert torch.equal(sensed.increments.dtheta_rad, plain.dtheta_rad)
    assert torch.equal(sensed.increments.dvelocity_m_s, plain.dvelocity_m_s)
    alone = simulate_imu(true.float(), -true.float(), INTERVAL, NOISE, noise[:, 0].float(), start[0].float())
    assert alone.gyro_bias_rad_s.shape == (5, 3) and alone.increments.dtheta_rad.dtype == torch.float32


def test_variance_of_a_walk():
    """K^2 t, to five standard errors of 3,000 walks (false alarm 6e-7)."""
    noise = torch.randn(101, 1000, 3, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)
    end = random_walk(torch.zeros(3, dtype=DOUBLE), 0.2, 0.05, noise)[-1]
    assert end.square().mean().item() == pytest.approx(0.2**2 * 5.0, rel=5 * math.sqrt(2 / 3000))


def test_parameters_come_back():
    """Exactly from their own deviation; from simulated series to five standard errors of 48 channels, as above."""
    time = torch.logspace(-2, 3, 12, dtype=DOUBLE)
    true = AllanParameters(1.7e-4, 2e-5, 3e-6)
    found = fit_allan(time, true.deviation(time))
    np.testing.assert_allclose(list(vars(found).values()), list(vars(true).values()), rtol=1e-9)
    single = fit_allan(time.float(), true.deviation(time.float()))
    np.testing.assert_allclose(single.white, true.white, rtol=1e-5)
    pure = fit_allan(time, AllanParameters(1.7e-4).deviation(time))
    assert pure.white == pytest.approx(1.7e-4) and max(pure.instability, pure.walk) < 1e-10
    clusters = (10, 20, 40, 80, 160, 320)
    deviation = allan_deviation(series(NOISE).increments.dtheta_rad / INTERVAL, clusters).flatten(1)
    averaging = INTERVAL * torch.tensor(clusters, dtype=DOUBLE)
    fits = [fit_allan(averaging, column, instability=False) for column in deviation.unbind(-1)]
    for name, expected in (("white", 4e-8), ("walk", 1e-6)):
        found = np.array([vars(fit)[name] for fit in fits]) ** 2
        error = found.std(ddof=1) / 48**0.5
        assert abs(found.mean() - expected) < 5 * error, name
        assert error < 0.05 * expected
    assert all(fit.instability == 0 for fit in fits)
    # With flicker noise to be found as well the walk loses to it.
    loose = np.mean([fit_allan(averaging, column).walk ** 2 for column in deviation.unbind(-1)])
    assert loose < 1e-6


def test_markov_bias_stands_for_flicker():
    """Peak of the Allan deviation of a Gauss-Markov bias (closed form) is sqrt(2 ln 2 / pi) of the bias instability."""
    one, time = AllanParameters(1e-4, 3e-5), 200.0
    t = np.linspace(0.1, 10, 20_001)
    shape = np.sqrt((1 - (3 - 4 * np.exp(-t) + np.exp(-2 * t)) / (2 * t)) / t)
    peak = one.markov_walk(time) * math.sqrt(time) * shape.max()
    assert peak == pytest.approx(math.sqrt(2 * math.log(2) / math.pi) * 3e-5, rel=2e-4)
    assert abs(t[shape.argmax()] - 1.89) < 0.01


def test_what_filters_take():
    assert NOISE.grade() == ImuGrade(0.01, 2e-4, 0.1, 2e-3)
    law = LandingTransition(**NOISE.densities())
    assert law.densities.tolist() == [*[2e-4] * 3, *[2e-3] * 3, *[0.0] * 3, *[1e-3] * 3, *[3e-3] * 3]
    assert ADIS16448.gyro.white == 1.6968e-4 and ADIS16448.accel.walk == 3e-3


def test_refuses():
    for name in ("white", "instability", "walk"):
        for value in (-1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match=f"{name} must be finite and not negative, got {value}"):
                AllanParameters(**{"white": 1.0, name: value})
    with pytest.raises(ValueError, match="gyro_bias_sd_rad_s must be finite and not negative, got -1"):
        ImuNoise(NOISE.gyro, NOISE.accel, -1.0, 0.1)
    with pytest.raises(ValueError, match="time_s must be positive and finite, got 0"):
        NOISE.gyro.markov_walk(0.0)
    still, noise = torch.zeros(4, 3), torch.zeros(4, 12)
    for interval in (0.0, math.nan):
        with pytest.raises(ValueError, match=f"interval_s must be positive, got {interval}"):
            simulate_imu(still, still, interval, NOISE, noise, torch.zeros(6))
    with pytest.raises(ValueError, match=r"noise must be .* got \(4, 6\) and \(6,\)"):
        simulate_imu(still, still, 0.1, NOISE, noise[:, :6], torch.zeros(6))
    for clusters in ((), (0,), (1, 3)):
        with pytest.raises(ValueError, match="clusters must be at least 1 and at most half of 4 samples"):
            allan_deviation(still, clusters)
    time = torch.ones(4)
    for deviation in (torch.ones(3), torch.ones(4, 1)):
        with pytest.raises(ValueError, match=r"must both be \(n,\) with n >= 3, got \(4,\) and"):
            fit_allan(time, deviation)
    with pytest.raises(ValueError, match=r"n >= 3, got \(2,\) and \(2,\)"):
        fit_allan(time[:2], time[:2])
    with pytest.raises(ValueError, match="deviation must be positive and finite, entry 2 is 0"):
        fit_allan(time, torch.tensor([1.0, 1.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match="averaging_s must be positive and finite, entry 0 is nan"):
        fit_allan(torch.tensor([math.nan, 1.0, 1.0]), torch.ones(3))
