"""Noise of inertial sensors by their Allan deviation: parameters, what a filter needs of them, simulation, estimate.

A sensor shows true + bias + white noise. The bias is a random walk here; `torchfilt.models.inertial.imu` has the grades
with constant biases, and turns true increments into measured ones.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfilt.models.inertial.imu import ImuGrade, Increments, measure

# Flicker noise: its Allan deviation is flat at this share of the bias instability.
_FLOOR = math.sqrt(2 * math.log(2) / math.pi)
# Largest value of the Allan deviation of a first-order Gauss-Markov process, over density times root of its time.
_MARKOV_PEAK = 0.4365
_ROUNDS = 20


@dataclass(frozen=True)
class AllanParameters:
    """Noise of one kind of sensor, all axes alike.

    white: N, density of the white noise, rad/s/sqrt(Hz). instability: B, bias instability, rad/s.
    walk: K, density of the rate random walk, rad/s^2/sqrt(Hz), that is rad/s per sqrt(s).
    For accelerometers m/s^2 stands in the place of rad/s.

    Raises:
        ValueError: a number that is negative or not finite.

    Source: IEEE Std 952-1997, annex C.
    """

    white: float
    instability: float = 0.0
    walk: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {value}")

    def deviation(self, averaging_s: Tensor) -> Tensor:
        """Allan deviation (...) at averaging times (...): root of N^2 / t + 2 ln 2 / pi B^2 + K^2 t / 3."""
        white, walk = self.white**2 / averaging_s, self.walk**2 * averaging_s / 3
        return (white + (_FLOOR * self.instability) ** 2 + walk).sqrt()

    def markov_walk(self, time_s: float) -> float:
        """Density of what drives a bias that decays in ``time_s`` so that it stands for the bias instability.

        Flicker noise has no model with finitely many states. A first-order Gauss-Markov bias has an Allan deviation
        that rises to 0.437 density sqrt(time) at 1.89 times its time and is flat around there: this puts the peak at
        the flicker noise's level. For laws that take a bias time, such as `torchfilt.models.attitude.GyroTransition`.

        Returns:
            As ``walk``.

        Raises:
            ValueError: a time that is not positive and finite.
        """
        if not 0 < time_s < math.inf:
            raise ValueError(f"time_s must be positive and finite, got {time_s}")
        return _FLOOR * self.instability / (_MARKOV_PEAK * math.sqrt(time_s))


@dataclass(frozen=True)
class ImuNoise:
    """Noise of three gyros and three accelerometers, and the deviations of their biases at the start.

    Raises:
        ValueError: a deviation that is negative or not finite.
    """

    gyro: AllanParameters
    accel: AllanParameters
    gyro_bias_sd_rad_s: float
    accel_bias_sd_m_s2: float

    def __post_init__(self) -> None:
        self.grade()

    def grade(self) -> ImuGrade:
        """An `ImuGrade`: what stays when biases do not walk."""
        return ImuGrade(self.gyro_bias_sd_rad_s, self.gyro.white, self.accel_bias_sd_m_s2, self.accel.white)

    def densities(self) -> dict[str, float]:
        """The arguments of a transition, by name: white noise of both sensors and what drives both biases.

        Of `torchfilt.models.landing.LandingTransition` and `torchfilt.models.inertial.navigation.StrapdownTransition`.
        """
        return {
            "angle_random_walk_rad_sqrt_s": self.gyro.white,
            "velocity_random_walk_m_s_sqrt_s": self.accel.white,
            "gyro_bias_walk_rad_s_sqrt_s": self.gyro.walk,
            "accel_bias_walk_m_s2_sqrt_s": self.accel.walk,
        }


ADIS16448 = ImuNoise(
    AllanParameters(white=1.6968e-4, walk=1.9393e-5),
    AllanParameters(white=2.0e-3, walk=3.0e-3),
    gyro_bias_sd_rad_s=math.radians(0.5),
    accel_bias_sd_m_s2=0.05,
)
"""A small industrial sensor. Densities: those that come with the logs of Burri et al., The EuRoC micro aerial vehicle
datasets, IJRR 35 (2016); deviations of the biases at the start: round numbers of our own."""


# Simulation -----------------------------------------------------------------------------------------------------------


class SensedMotion(NamedTuple):
    """Increments (t, *batch, 3) that an IMU puts out and the biases (t, *batch, 3) in them."""

    increments: Increments
    gyro_bias_rad_s: Tensor
    accel_bias_m_s2: Tensor


def random_walk(start: Tensor, density: float, interval_s: float, noise: Tensor) -> Tensor:
    """Biases (t, ..., 3) at the start of each interval: a sum of independent steps of sd density sqrt(interval).

    Args:
        start: (..., 3). noise: standard normals (t, ..., 3); the last of them is not used.

    Returns:
        (t, ..., 3), in the unit of ``start``.

    Raises:
        ValueError: an interval that is not positive.
    """
    if not interval_s > 0:
        raise ValueError(f"interval_s must be positive, got {interval_s}")
    steps = density * math.sqrt(interval_s) * noise[:-1].cumsum(0)
    return torch.cat([start.expand(1, *noise.shape[1:]), start + steps])


def simulate_imu(
    dtheta_rad: Tensor, dvelocity_m_s: Tensor, interval_s: float, imu: ImuNoise, noise: Tensor, start: Tensor
) -> SensedMotion:
    """What an IMU puts out whose biases walk; a bias stays for an interval and steps at its end.

    Args:
        dtheta_rad, dvelocity_m_s: true increments (t, 3) in body axes. interval_s: over which they were integrated.
        imu: gives the densities; flicker noise is not simulated.
        noise: standard normals (t, *batch, 12): white noise, then steps of the biases, gyros first.
        start: standard normals (*batch, 6), of the biases at the start, gyros first.

    Returns:
        `SensedMotion`: rad, m/s, and biases in rad/s and m/s^2.

    Raises:
        ValueError: an interval that is not positive, noise without 12 numbers.

    Source: IEEE Std 952-1997, annex C; Farrell, Aided Navigation (2008), section 4.6.3, for the discrete walk.
    """
    if noise.shape[-1] != 12 or start.shape[-1] != 6:
        shapes = f"{tuple(noise.shape)} and {tuple(start.shape)}"
        raise ValueError(f"noise must be (t, *batch, 12) and start (*batch, 6), got {shapes}")
    white, gyro_steps, accel_steps = noise.split((6, 3, 3), -1)
    gyro_start, accel_start = start.split(3, -1)
    gyro = random_walk(imu.gyro_bias_sd_rad_s * gyro_start, imu.gyro.walk, interval_s, gyro_steps)
    accel = random_walk(imu.accel_bias_sd_m_s2 * accel_start, imu.accel.walk, interval_s, accel_steps)
    sensed = measure(dtheta_rad, dvelocity_m_s, interval_s, imu.grade(), gyro, accel, white)
    return SensedMotion(sensed, gyro, accel)


# Estimate -------------------------------------------------------------------------------------------------------------


def allan_deviation(rates: Tensor, clusters: Sequence[int]) -> Tensor:
    """Overlapping estimate of the Allan deviation of samples at equal intervals.

    Args:
        rates: (t, ...), such as angular rates at rest.
        clusters: numbers m of samples that are averaged; the averaging time is m intervals.

    Returns:
        (len(clusters), ...), in the unit of the rates.

    Raises:
        ValueError: no clusters, one below 1, or fewer samples than two clusters.

    Source: Riley, Handbook of Frequency Stability Analysis (NIST SP 1065, 2008), section 5.2: overlapping
    Allan variance.
    """
    if not clusters or min(clusters) < 1 or 2 * max(clusters) > len(rates):
        raise ValueError(f"clusters must be at least 1 and at most half of {len(rates)} samples, got {list(clusters)}")
    # Sums of what is left of the mean: a large constant would cost digits.
    total = torch.cat([torch.zeros_like(rates[:1]), (rates - rates.mean(0)).cumsum(0)])
    found = []
    for m in clusters:
        change = (total[2 * m :] - 2 * total[m:-m] + total[: -2 * m]) / m
        found.append((change.square().mean(0) / 2).sqrt())
    return torch.stack(found)


def fit_allan(averaging_s: Tensor, deviation: Tensor, *, instability: bool = True) -> AllanParameters:
    """Parameters whose Allan deviation comes nearest to an estimated one, in relative terms.

    The square is linear in N^2, B^2 and K^2, none of which may be negative: least squares with that constraint, each
    row over the fitted square, found by repetition (over the estimates themselves low ones would count too much).
    Flicker noise looks like white noise and walk together where few times are known, and takes some of both.

    Args:
        averaging_s: (n,), n >= 3, positive. deviation: (n,), positive.
        instability: False for a series without flicker noise, such as a simulated one: B is zero.

    Returns:
        `AllanParameters`.

    Raises:
        ValueError: shapes, or numbers that are not positive and finite.

    Source: IEEE Std 952-1997, annex C, for the sum; Lawson and Hanson, Solving Least Squares Problems (1974), chapter
    23, for the constraint.
    """
    from scipy.optimize import nnls

    _check_curve(averaging_s, deviation)
    time, square = averaging_s.detach().double(), deviation.detach().double().square()
    terms = torch.stack([1 / time, torch.full_like(time, instability * _FLOOR**2), time / 3], -1)
    near, found = square, torch.zeros(3, dtype=torch.float64)
    for _ in range(_ROUNDS):
        columns = terms / near.unsqueeze(-1)
        # To columns of length one, so that no unit decides which of them counts.
        length = torch.linalg.vector_norm(columns, dim=0).clamp_min(torch.finfo(torch.float64).tiny)
        found = torch.from_numpy(nnls((columns / length).numpy(), (square / near).numpy())[0]) / length
        near = terms @ found
    white, flicker, walk = found.sqrt().tolist()
    return AllanParameters(white, flicker, walk)


def _check_curve(averaging_s: Tensor, deviation: Tensor) -> None:
    if averaging_s.dim() != 1 or len(averaging_s) < 3 or averaging_s.shape != deviation.shape:
        shapes = f"{tuple(averaging_s.shape)} and {tuple(deviation.shape)}"
        raise ValueError(f"averaging_s and deviation must both be (n,) with n >= 3, got {shapes}")
    for name, values in (("averaging_s", averaging_s), ("deviation", deviation)):
        bad = ~((values > 0) & (values < math.inf))
        if bad.any():
            k = int(bad.nonzero()[0])
            raise ValueError(f"{name} must be positive and finite, entry {k} is {values[k].item()}")
