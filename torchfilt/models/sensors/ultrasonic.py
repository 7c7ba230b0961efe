"""Ultrasonic range to a flat floor: the first echo within a cone, limits of range, noise that grows with distance."""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold, one_number
from torchfilt.quaternions import quaternion, rotate, stack, vector

Step = Tensor | float | None

# Cosine of the steepest slant that the law follows, 80 degrees.
_LEAST = math.cos(math.radians(80))


class UltrasonicRange(nn.Module):
    """Range, m, that a sonar along the body's down axis shows above a flat, level floor.

    A sonar reports its first echo. Of the rays of a cone with half angle b about an axis that is tilted by t off the
    vertical, one at an angle a off the vertical meets the floor at height / cos(a), and a runs from max(0, t - b) to
    t + b. The first echo is the shortest: height / cos(max(0, t - b)). Up to a tilt of b this is the height itself, and
    with b = 0, a thin beam, it is height / cos(t); its first derivative is continuous. Beyond a slant of 80 degrees the
    law stays at height / cos(80 degrees), finite for every state; sigma points reach such places, echoes do not.
    Noise: standard deviation noise_m + noise_share times the distance, at the distance predicted.

    The law knows no limits of range. Sensors show their least range for all that is nearer, and such a reading, put
    into the law, would pull the height up: pass what a sensor gives through `measured`, which turns it into NaN, not
    measured. Right at the limit this leaves the readings whose noise is positive: a bias of the order of noise_m within
    a few noise_m of it. Distances are taken as given: with a fixed speed of sound in the sensor they are 1.8 % too
    short for each 10 K above the temperature it was set for.

    Args:
        noise_m, noise_share: see above; numbers or scalar tensors (parameters train).
        half_angle_rad: of the cone.
        min_range_m, max_range_m: nearer readings are clamped, farther ones have no echo.
        max_tilt_rad: beyond it the floor reflects the sound away; half_angle_rad for a floor like a mirror.
        floor_m: height of the floor in the local frame.
        delay_s: age of a reading when it comes out. An attribute for whoever handles delays; the law itself is that of
            the moment at which the sound came back.
        height: index of the height in the state.

    Raises:
        ValueError: noise that is not positive at all distances, an angle outside [0, 80 degrees), limits of range that
            are not 0 <= min < max, a negative delay, an index below 4, a floor that is not finite; when called, a state
            without the height.

    Source: Borenstein, Everett and Feng, Where am I? Sensors and methods for mobile robot positioning (University of
    Michigan, 1996), section 4.1, for cone, limits and reflection; the range by the derivation above.
    """

    noise: Tensor
    size = 1

    def __init__(
        self,
        noise_m: Tensor | float,
        noise_share: Tensor | float = 0.0,
        *,
        half_angle_rad: float = math.radians(15),
        min_range_m: float = 0.2,
        max_range_m: float = 6.0,
        max_tilt_rad: float = math.radians(45),
        floor_m: float = 0.0,
        delay_s: float = 0.0,
        height: int = 9,
    ) -> None:
        super().__init__()
        least, share = one_number(noise_m, "noise_m"), one_number(noise_share, "noise_share", zero=True)
        for name, angle in (("half_angle_rad", half_angle_rad), ("max_tilt_rad", max_tilt_rad)):
            if not 0 <= angle < math.radians(80):
                raise ValueError(f"{name} must be at least 0 and below 80 degrees, {math.radians(80):.4g}, got {angle}")
        if not 0 <= min_range_m < max_range_m:
            raise ValueError(f"ranges must be 0 <= min_range_m < max_range_m, got {min_range_m} and {max_range_m}")
        if not 0 <= delay_s < math.inf:
            raise ValueError(f"delay_s must be finite and not negative, got {delay_s}")
        if not math.isfinite(floor_m):
            raise ValueError(f"floor_m must be finite, got {floor_m}")
        if height < 4:
            raise ValueError(f"height must be an index behind the quaternion, 4 or more, got {height}")
        hold(self, "noise", torch.stack([least, share.to(least.dtype)]))
        self.half_angle_rad, self.max_tilt_rad = half_angle_rad, max_tilt_rad
        self.min_range_m, self.max_range_m = min_range_m, max_range_m
        self.floor_m, self.delay_s, self.height = floor_m, delay_s, height

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the range (..., 1) at states (..., d)."""
        height, slant, *_ = self._geometry(x)
        return self._law(height / slant)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., 1, d - 1)."""
        height, slant, sine, (right, forward, _) = self._geometry(x)
        distance = height / slant
        # A rotation vector e in the local frame turns the body's up axis z to z + e x z: d cos(t) = e_x z_y - e_y z_x,
        # and d cos(t - b) = sin(t - b) / sin(t) d cos(t).
        by_cosine = -distance * sine / slant
        zero, one = torch.zeros_like(distance), 1 / slant
        by_turn = stack([by_cosine * forward, -by_cosine * right, zero])
        at = self.height - 1
        by_height = pad(one.unsqueeze(-1), (at - 3, x.shape[-1] - 2 - at))
        return self._law(distance), torch.cat([by_turn, by_height], -1).unsqueeze(-2)

    def in_view(self, x: Tensor) -> Tensor:
        """Whether states (..., d) give an unclamped echo: tilt and distance within the limits, (...)."""
        height, slant, _, (*_, up) = self._geometry(x)
        distance = height / slant
        echo = (up >= math.cos(self.max_tilt_rad)) & (distance <= self.max_range_m)
        return echo & (distance >= self.min_range_m)

    def simulate(self, x: Tensor, noise: Tensor) -> Tensor:
        """What the sensor puts out at states (..., d): the least range where it is too near, NaN without an echo.

        Args:
            x: true states. noise: standard normals (..., 1).

        Returns:
            (..., 1), m.
        """
        _, _, _, (*_, up) = self._geometry(x)
        reading = self(x).sample(noise)
        echo = (up.unsqueeze(-1) >= math.cos(self.max_tilt_rad)) & (reading <= self.max_range_m)
        return torch.where(echo, reading.clamp_min(self.min_range_m), torch.nan)

    def measured(self, reading: Tensor) -> Tensor:
        """Readings (...) of a sensor, m, as a filter takes them: NaN where they are clamped or beyond the range."""
        inside = (reading > self.min_range_m) & (reading <= self.max_range_m)
        return torch.where(inside, reading, torch.nan)

    def _law(self, distance: Tensor) -> Gaussian:
        least, share = self.noise.to(distance.dtype).unbind()
        deviation = least + share * distance.clamp_min(0)
        return Gaussian(distance.unsqueeze(-1), deviation.unsqueeze(-1), is_diagonal=True)

    def _geometry(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Height, cos(max(0, t - b)), sin(t - b) / sin(t) where the law follows the tilt, the body's up axis."""
        if x.shape[-1] <= self.height:
            raise ValueError(f"the state must have more than {self.height} numbers, got {tuple(x.shape)}")
        zero = torch.zeros_like(x[..., 0])
        right, forward, up = rotate(quaternion(x[..., :4]), (zero, zero, zero + 1))
        cos_b, sin_b = math.cos(self.half_angle_rad), math.sin(self.half_angle_rad)
        level = (right.square() + forward.square() + torch.finfo(x.dtype).tiny).sqrt()
        slant = up * cos_b + level * sin_b
        inside = up >= cos_b
        follows = ~inside & (slant > _LEAST)
        sine = torch.where(follows, (level * cos_b - up * sin_b) / torch.where(follows, level, 1), 0)
        slant = torch.where(inside, 1, slant.clamp_min(_LEAST))
        return x[..., self.height] - self.floor_m, slant, sine, vector([right, forward, up])
