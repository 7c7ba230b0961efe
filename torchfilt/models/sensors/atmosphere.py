"""Standard atmosphere: pressure, temperature and density by height, and the height of a pressure.

Seven layers, in each of which the temperature is linear in the geopotential height, over dry air in hydrostatic
balance. Heights are geopotential ones unless a name says otherwise: metres of a column under constant gravity, 1.6 m
less than the geometric height at 3.2 km. The lowest layer goes on down to -5 km, as in the published tables.

Source: U.S. Standard Atmosphere, 1976 (NOAA-S/T 76-1562), equations 18, 19, 23, 33a, 33b and 42; up to 32 km the same
as ISO 2533 and ICAO Doc 7488.
"""

import math

import torch
from torch import Tensor

SEA_LEVEL_PRESSURE_PA = 101325.0
SEA_LEVEL_TEMPERATURE_K = 288.15
GRAVITY_M_S2 = 9.80665
GAS_CONSTANT_J_KG_K = 8314.32 / 28.9644
"""Of dry air; the universal constant and the molar mass are those of 1976."""
EARTH_RADIUS_M = 6_356_766.0
"""That makes gravity fall off as it does at 45 degrees of latitude."""
LOWEST_M, HIGHEST_M = -5000.0, 84_852.0

# Lower edge of each layer, m, and slope of the temperature in it, K/m.
_EDGES_M = (0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3)
_LAPSES_K_M = (-6.5e-3, 0.0, 1e-3, 2.8e-3, 0.0, -2.8e-3, -2e-3)
_FALL_K_M = GRAVITY_M_S2 / GAS_CONSTANT_J_KG_K


def _layers() -> list[tuple[float, float, float, float]]:
    """Edge, temperature and pressure there, slope, of each layer, stacked from the ground up."""
    found, temperature, pressure = [], SEA_LEVEL_TEMPERATURE_K, SEA_LEVEL_PRESSURE_PA
    for edge, top, lapse in zip(_EDGES_M, (*_EDGES_M[1:], HIGHEST_M), _LAPSES_K_M, strict=True):
        found.append((edge, temperature, pressure, lapse))
        above = temperature + lapse * (top - edge)
        ratio = math.log(above / temperature) / lapse if lapse else (top - edge) / temperature
        temperature, pressure = above, pressure * math.exp(-_FALL_K_M * ratio)
    return [*found, (HIGHEST_M, temperature, pressure, 0.0)]


_LAYERS = _layers()
LOWEST_PRESSURE_PA = _LAYERS[-1][2]
HIGHEST_PRESSURE_PA = SEA_LEVEL_PRESSURE_PA * (1 + 6.5e-3 * 5000 / SEA_LEVEL_TEMPERATURE_K) ** (_FALL_K_M / 6.5e-3)


def temperature_k(height_m: Tensor, *, check: bool = True) -> Tensor:
    """Temperature (...), K, at geopotential heights (...), m.

    Args:
        height_m: geopotential height. check: False where the values must not be looked at, as in a filter's step; the
            end layers then go on beyond the ends.

    Raises:
        ValueError: a height outside -5 km to 84.852 km or not finite.
    """
    edge, base, _, lapse = _layer_of_height(height_m, check)
    return base + lapse * (height_m - edge)


def pressure_pa(height_m: Tensor, *, check: bool = True) -> Tensor:
    """Pressure (...), Pa, at geopotential heights (...), m; arguments and errors as in `temperature_k`.

    In float32 a pressure near the ground is known to 0.008 Pa, which is 0.7 mm of height.
    """
    edge, temperature, pressure, lapse = _layer_of_height(height_m, check)
    above = height_m - edge
    return pressure * torch.exp(-_FALL_K_M / temperature * above * _log1p_ratio(lapse / temperature * above))


def density_kg_m3(height_m: Tensor, *, check: bool = True) -> Tensor:
    """Density of air (...), kg/m^3, at geopotential heights (...), m; arguments and errors as in `temperature_k`."""
    return pressure_pa(height_m, check=check) / (GAS_CONSTANT_J_KG_K * temperature_k(height_m, check=False))


def height_m(pressure_pa: Tensor, *, check: bool = True) -> Tensor:
    """Geopotential height (...), m, at which the atmosphere has pressures (...), Pa: the inverse of `pressure_pa`.

    Args:
        pressure_pa: pressure. check: as in `temperature_k`.

    Raises:
        ValueError: a pressure that belongs to a height outside -5 km to 84.852 km, or is not finite.
    """
    if check:
        _refuse("pressure_pa", pressure_pa, LOWEST_PRESSURE_PA, HIGHEST_PRESSURE_PA)
    edge, temperature, base, lapse = _rows(
        sum((pressure_pa <= layer[2]).long() for layer in _LAYERS[1:-1]), pressure_pa
    )
    scaled = torch.log(base / pressure_pa) / _FALL_K_M
    return edge + temperature * scaled * _expm1_ratio(lapse * scaled)


def to_geopotential_m(geometric_m: Tensor) -> Tensor:
    """Geopotential height (...) of heights (...) above sea level: r z / (r + z)."""
    return EARTH_RADIUS_M * geometric_m / (EARTH_RADIUS_M + geometric_m)


def to_geometric_m(geopotential_m: Tensor) -> Tensor:
    """Height above sea level (...) of geopotential heights (...): r h / (r - h)."""
    return EARTH_RADIUS_M * geopotential_m / (EARTH_RADIUS_M - geopotential_m)


def _layer_of_height(height_m: Tensor, check: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    if check:
        _refuse("height_m", height_m, LOWEST_M, HIGHEST_M)
    return _rows(sum((height_m >= edge).long() for edge in _EDGES_M[1:]), height_m)


def _rows(layer: Tensor | int, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Edge, temperature, pressure and slope (...) of layers (...)."""
    assert isinstance(layer, Tensor)
    table = torch.tensor(_LAYERS, dtype=like.dtype, device=like.device)
    # Under vmap a plain index of a scalar would be read out.
    picked = table.index_select(0, layer.reshape(-1)).reshape(*layer.shape, 4)
    edge, temperature, pressure, lapse = picked.unbind(-1)
    return edge, temperature, pressure, lapse


def _log1p_ratio(y: Tensor) -> Tensor:
    """log(1 + y) / y, with its series about zero, where layers of one temperature and edges of layers are."""
    small = y.abs() < 1e-5
    away = torch.where(small, 1, y)
    return torch.where(small, 1 + y * (-1 / 2 + y / 3), torch.log1p(away) / away)


def _expm1_ratio(y: Tensor) -> Tensor:
    """(exp(y) - 1) / y, with its series about zero."""
    small = y.abs() < 1e-5
    away = torch.where(small, 1, y)
    return torch.where(small, 1 + y * (1 / 2 + y / 6), torch.expm1(away) / away)


def _refuse(name: str, values: Tensor, low: float, high: float) -> None:
    """Raise a ValueError that names the first value outside; NaN is outside."""
    # A rounding of the dtype beyond the ends belongs to them.
    slack = 4 * torch.finfo(values.dtype).eps
    bad = ~((values.detach() >= low - slack * abs(low)) & (values.detach() <= high + slack * abs(high)))
    if bad.any():
        where = tuple(bad.nonzero()[0].tolist())
        raise ValueError(
            f"{name} must be between {low:.6g} and {high:.6g}, where the standard atmosphere is defined, "
            f"entry {where} is {values.detach()[where].item()}"
        )
