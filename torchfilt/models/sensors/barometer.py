"""Barometric altimeter: pressure or height by the standard atmosphere, with a lag and an offset that drifts.

The air in a barometer's case, its filter and its firmware follow the height late; its zero moves with the weather and
with its temperature. Both are numbers of the state: the lagged height, which `WithAltimeter` moves along, and the
offset, a random walk.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchfilt.gaussian import Gaussian
from torchfilt.laws import hold, one_number
from torchfilt.models.sensors import atmosphere
from torchfilt.spaces import Euclidean, Product, Space

Step = Tensor | float | None


# Lag ------------------------------------------------------------------------------------------------------------------


class LagWeights(NamedTuple):
    """What the lagged value after a step is made of; the three sum to one. Numbers, or tensors of the shape of dt."""

    lagged: Tensor | float
    before: Tensor | float
    after: Tensor | float


def lag_weights(dt: Tensor | float, time_constant_s: float) -> LagWeights:
    """Exact solution of d lagged / dt = (value - lagged) / T over a step in which the value is linear in time.

    With a = exp(-dt / T) and w = (1 - a) T / dt, the mean of exp(-t / T) over the step:
    lagged after = a lagged + (w - a) value before + (1 - w) value after.
    A value that accelerates at c over the step makes an error below c dt^2 / 8 (1 - a). dt = 0 is no motion.

    Args:
        dt: time step, number or tensor of any shape, >= 0. time_constant_s: T.

    Returns:
        `LagWeights`.

    Raises:
        ValueError: a time constant that is not positive and finite.

    Source: Franklin, Powell and Workman, Digital Control of Dynamic Systems (1998), section 6.3.2: triangle hold.
    """
    if not 0 < time_constant_s < math.inf:
        raise ValueError(f"time_constant_s must be positive and finite, got {time_constant_s}")
    share = dt / time_constant_s
    if isinstance(share, Tensor):
        still = share == 0
        away = torch.where(still, 1, share)
        mean: Tensor | float = torch.where(still, 1, -torch.expm1(-away) / away)
        left: Tensor | float = torch.exp(-share)
    else:
        mean = -math.expm1(-share) / share if share else 1.0
        left = math.exp(-share)
    return LagWeights(left, mean - left, 1 - mean)


def first_order_lag(
    lagged: Tensor, before: Tensor, after: Tensor, dt: Tensor | float, time_constant_s: float
) -> Tensor:
    """Lagged value after a step, see `lag_weights`; all tensors broadcast."""
    weights = lag_weights(dt, time_constant_s)
    return weights.lagged * lagged + weights.before * before + weights.after * after


class WithAltimeter(nn.Module):
    """A transition with the altimeter's own numbers appended to its state: lagged height, then offset.

    The lagged height follows the height exactly as long as that is linear in time over a step; what noise the step puts
    on the height it takes over by its share. The offset is a random walk. Constants may follow.

    Args:
        law: transition of the first d numbers, with a ``space`` that has a size and, for ``first_order`` to be offered,
            a ``first_order`` of its own.
        time_constant_s: of the lag; None leaves the lagged height out.
        offset_walk: root of the spectral density of the offset's rate, units of the offset (Pa or m) per sqrt(s), a
            number or scalar tensor (a parameter trains); None leaves the offset out.
        height: index of the height in the state.
        constants: how many numbers that stay as they are follow, such as a magnetometer's hard iron.

    Raises:
        ValueError: neither lag nor offset, a time constant that is not positive, a walk that is negative or not finite,
            a height outside the state, a negative number of constants, a law without a space of known size; when
            called, no dt, a state of another size.
    """

    walk: Tensor

    def __init__(
        self,
        law: nn.Module,
        time_constant_s: float | None = None,
        offset_walk: Tensor | float | None = None,
        *,
        height: int = 9,
        constants: int = 0,
    ) -> None:
        super().__init__()
        inner = getattr(law, "space", None)
        if inner is None or inner.size is None:
            raise ValueError(f"law must state a space of known size, {type(law).__name__} has {inner!r}")
        if time_constant_s is None and offset_walk is None:
            raise ValueError("give time_constant_s=, offset_walk= or both: there is nothing to append")
        if constants < 0:
            raise ValueError(f"constants must not be negative, got {constants}")
        if time_constant_s is not None:
            lag_weights(0.0, time_constant_s)
        curved = inner.size - inner.tangent_size
        if not 0 <= height - curved < inner.tangent_size:
            raise ValueError(f"height must be an index in {curved}..{inner.size - 1} of the state, got {height}")
        hold(self, "walk", one_number(0.0 if offset_walk is None else offset_walk, "offset_walk", zero=True))
        self.law: Any = law
        self.height, self.time_constant_s = height, time_constant_s
        self.lags, self.drifts, self.constants = (
            int(time_constant_s is not None),
            int(offset_walk is not None),
            constants,
        )
        self.extra = self.lags + self.drifts + constants
        self.space = _appended(inner, self.extra)
        self._size, self._error = inner.size, inner.tangent_size
        self._row = height - curved
        reached = getattr(law, "noise_in", None)
        reached = None if isinstance(reached, slice) else reached
        self._noisy_height = reached is None or self._row in reached
        if reached is not None:
            lag = [self._error] if self.lags and self._noisy_height else []
            self.noise_in = [*reached, *lag, *([self._error + self.lags] if self.drifts else [])]
        if hasattr(law, "first_order"):
            self.first_order = self._first_order

    def forward(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> Gaussian:
        """Law of the longer state (..., d + extra) after a step of dt (number or (..., 1)), s."""
        step = self._check(x, dt)
        return self._extend(x, self.law(x[..., : self._size], u, dt), step)

    def _first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and the derivative (..., e + extra, e + extra) of its mean's error by the error of x."""
        step = self._check(x, dt)
        inner, slope = self.law.first_order(x[..., : self._size], u, dt)
        eye = torch.eye(self._error + self.extra, dtype=x.dtype, device=x.device)
        rows = [pad(slope, (0, self.extra))]
        if self.time_constant_s is not None:
            weights = lag_weights(_wide(step), self.time_constant_s)
            height, lagged = eye[self._row : self._row + 1], eye[self._error : self._error + 1]
            after = rows[0][..., self._row : self._row + 1, :]
            rows.append(weights.lagged * lagged + weights.before * height + weights.after * after)
        rows.append(eye[self._error + self.lags :])
        lead = torch.broadcast_shapes(x.shape[:-1], *(row.shape[:-2] for row in rows))
        jacobian = torch.cat([row.expand(*lead, *row.shape[-2:]) for row in rows], -2)
        return self._extend(x, inner, step), jacobian

    def _extend(self, x: Tensor, inner: Gaussian, dt: Tensor | float) -> Gaussian:
        parts, factors = [inner.mean], []
        share: Tensor | float = 0.0
        if self.time_constant_s is not None:
            weights = lag_weights(dt, self.time_constant_s)
            at, share = slice(self.height, self.height + 1), weights.after
            lagged = weights.lagged * x[..., self._size : self._size + 1] + weights.before * x[..., at]
            parts.append(lagged + share * inner.mean[..., at])
            factors.append(x.new_zeros(1))
        parts.append(x[..., self._size + self.lags :])
        if self.drifts:
            drift = self.walk.to(x.dtype) * dt**0.5
            factors.append(drift if drift.dim() else drift.unsqueeze(0))
        factors.append(x.new_zeros(self.constants))
        own = _beside(factors)
        mean = _beside(parts)
        if inner.is_diagonal and not (self.lags and self._noisy_height):
            return Gaussian(mean, _beside([inner.scale_tril, own]), self.space, True)
        factor = inner.factor()
        taken = pad(factor[..., self._row : self._row + 1, :] * _wide(share), (0, 0, 0, self.extra - 1))
        blocks = pad(factor, (0, self.extra)), _beside([taken, torch.diag_embed(own)], own=2)
        lead = torch.broadcast_shapes(*(block.shape[:-2] for block in blocks))
        rows = [block.expand(*lead, *block.shape[-2:]) for block in blocks]
        return Gaussian(mean, torch.cat(rows, -2), self.space)

    def _check(self, x: Tensor, dt: Step) -> Tensor | float:
        if x.shape[-1] != self._size + self.extra:
            raise ValueError(f"the state must be (..., {self._size + self.extra}), got {tuple(x.shape)}")
        if dt is None:
            raise ValueError("this law needs the time step dt")
        return dt


def _appended(space: Space, extra: int) -> Space:
    """The space with Euclidean numbers behind it; Euclidean neighbours merged."""
    parts = list(space.spaces) if isinstance(space, Product) else [space]
    if isinstance(parts[-1], Euclidean):
        extra += parts.pop().size or 0
    return Product(*parts, Euclidean(extra)) if parts else Euclidean(extra)


def _beside(parts: list[Tensor], own: int = 1) -> Tensor:
    """Joined along the last dim; all but the last ``own`` dims broadcast."""
    lead = torch.broadcast_shapes(*(part.shape[:-own] for part in parts))
    return torch.cat([part.expand(*lead, *part.shape[-own:]) for part in parts], -1)


def _wide(value: Tensor | float) -> Tensor | float:
    """Room for a matrix behind what has one number a row."""
    return value.unsqueeze(-1) if isinstance(value, Tensor) and value.dim() > 0 else value


# Measurement ----------------------------------------------------------------------------------------------------------


class BarometricAltimeter(nn.Module):
    """Pressure, Pa, or height, m, that a barometer shows at a height above the frame's origin.

    Pressure: that of the standard atmosphere as far above the level of the reference pressure, plus the offset in Pa.
    Height: the height itself plus the offset in m, as firmware with the same atmosphere and reference makes it.
    The atmosphere's temperature is the standard one: air that is 10 K warmer makes heights 3.5 % too small. Over the
    few metres of a hall geopotential and geometric height are the same.

    Args:
        sd_pa: standard deviation of a sensor that gives pressure; or
        sd_m: of one that gives height; number or scalar tensor (a parameter trains).
        reference_pressure_pa: at the frame's origin; of a sensor that gives height it makes no difference.
        height: index of the height in the state.
        lagged: index of the lagged height, see `WithAltimeter`; the sensor then shows that one. None: no lag.
        offset: index of the offset, in the unit of the output. None: no offset.

    Raises:
        ValueError: both deviations or none, one that is not positive and finite, a reference pressure that the standard
            atmosphere does not have, an index below 4; when called, a state without the numbers named.

    Source: U.S. Standard Atmosphere, 1976; Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation
    Systems (2013), section 6.2.1, for the errors.
    """

    deviation: Tensor
    size = 1

    def __init__(
        self,
        *,
        sd_pa: Tensor | float | None = None,
        sd_m: Tensor | float | None = None,
        reference_pressure_pa: float = atmosphere.SEA_LEVEL_PRESSURE_PA,
        height: int = 9,
        lagged: int | None = None,
        offset: int | None = None,
    ) -> None:
        super().__init__()
        if (sd_pa is None) == (sd_m is None):
            raise ValueError("give exactly one of sd_pa= and sd_m=: what the sensor puts out")
        name, given = ("sd_pa", sd_pa) if sd_m is None else ("sd_m", sd_m)
        assert given is not None
        deviation = one_number(given, name)
        for label, index in (("height", height), ("lagged", lagged), ("offset", offset)):
            if index is not None and index < 4:
                raise ValueError(f"{label} must be an index behind the quaternion, 4 or more, got {index}")
        hold(self, "deviation", deviation.reshape(1))
        self.gives_pressure = sd_m is None
        self.shown, self.offset = height if lagged is None else lagged, offset
        reference = torch.tensor(reference_pressure_pa, dtype=torch.float64)
        self.reference_height_m = atmosphere.height_m(reference).item()

    def forward(self, x: Tensor) -> Gaussian:
        """Law of the reading (..., 1), Pa or m, at states (..., d)."""
        return Gaussian(self._mean(x), self.deviation.to(x.dtype), is_diagonal=True)

    def first_order(self, x: Tensor, u: Tensor | None = None, dt: Step = None) -> tuple[Gaussian, Tensor]:
        """The law at x and its derivative (..., 1, d - 1); of a pressure by the height it is -density times gravity."""
        law = self(x)
        eye = torch.eye(x.shape[-1] - 1, dtype=x.dtype, device=x.device)
        row = eye[self.shown - 1]
        if self.gives_pressure:
            density = atmosphere.density_kg_m3(self._level(x), check=False)
            row = -atmosphere.GRAVITY_M_S2 * density * row
        if self.offset is not None:
            row = row + eye[self.offset - 1]
        return law, row.expand(*x.shape[:-1], -1).unsqueeze(-2)

    def _mean(self, x: Tensor) -> Tensor:
        last = max(self.shown, self.offset or 0)
        if x.shape[-1] <= last:
            raise ValueError(f"the state must have more than {last} numbers, got {tuple(x.shape)}")
        level = self._level(x)
        mean = atmosphere.pressure_pa(level, check=False) if self.gives_pressure else x[..., self.shown, None]
        return mean if self.offset is None else mean + x[..., self.offset, None]

    def _level(self, x: Tensor) -> Tensor:
        """Height (..., 1) in the standard atmosphere."""
        return self.reference_height_m + x[..., self.shown, None]
