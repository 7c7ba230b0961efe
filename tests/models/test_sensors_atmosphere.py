"""The standard atmosphere against its published tables, the package ambiance, and its own differential equation."""

import math

import numpy as np
import pytest
import torch

from torchfilt.models.sensors import atmosphere
from torchfilt.models.sensors.atmosphere import (
    density_kg_m3,
    height_m,
    pressure_pa,
    temperature_k,
    to_geometric_m,
    to_geopotential_m,
)

DOUBLE = torch.float64
EPS = np.finfo(float).eps

# U.S. Standard Atmosphere, 1976, table 4 and part 4: geopotential height, K, Pa.
TABLE = np.array(
    [
        (-1000.0, 294.65, 113929.0),
        (0.0, 288.15, 101325.0),
        (1000.0, 281.65, 89874.6),
        (5000.0, 255.65, 54019.9),
        (11000.0, 216.65, 22632.06),
        (20000.0, 216.65, 5474.889),
        (32000.0, 228.65, 868.0187),
        (47000.0, 270.65, 110.9063),
        (51000.0, 270.65, 66.93887),
        (71000.0, 214.65, 3.956420),
        (84852.0, 186.946, 0.3733836),
    ]
)


def heights(count=400, dtype=DOUBLE):
    return torch.linspace(-4990, 84_800, count, dtype=dtype)


def test_published_tables():
    at = torch.from_numpy(TABLE[:, 0])
    np.testing.assert_allclose(temperature_k(at), TABLE[:, 1], rtol=1e-12)
    np.testing.assert_allclose(pressure_pa(at), TABLE[:, 2], rtol=5e-6)
    # The height of a rounded pressure: 5e-6 of a scale height of at most 8.7 km.
    np.testing.assert_allclose(height_m(torch.from_numpy(TABLE[:-1, 2])), TABLE[:-1, 0], atol=0.05)
    assert density_kg_m3(torch.zeros((), dtype=DOUBLE)).item() == pytest.approx(1.225, abs=5e-5)


def test_against_ambiance():
    """It takes heights above sea level, on the same sphere.

    Its gas constant is the printed 287.05287, ours the ratio it is rounded from, 287.053072: 7e-7, times up to 12.5,
    the exponent -ln(p / p0) at 80 km.
    """
    ambiance = pytest.importorskip("ambiance")
    above = np.linspace(-4990, 81_000, 500)
    theirs = ambiance.Atmosphere(above)
    ours = to_geopotential_m(torch.from_numpy(above))
    for found, expected in (
        (temperature_k(ours), theirs.temperature),
        (pressure_pa(ours), theirs.pressure),
        (density_kg_m3(ours), theirs.density),
    ):
        np.testing.assert_allclose(found, expected, rtol=7e-7 * 12.6 + 7e-7)


def test_inverse():
    """To rounding of the logarithm of the pressure, over the rise of temperature in a layer."""
    at = torch.cat([heights(), torch.from_numpy(TABLE[:, 0])])
    np.testing.assert_allclose(height_m(pressure_pa(at)), at, atol=2e-9)
    geometric = torch.linspace(-5000, 86_000, 50, dtype=DOUBLE)
    np.testing.assert_allclose(to_geometric_m(to_geopotential_m(geometric)), geometric, rtol=8 * EPS)
    assert to_geopotential_m(torch.tensor(86_000.0, dtype=DOUBLE)).item() == pytest.approx(84_852, abs=0.1)


def test_hydrostatic_balance():
    """Derivatives by autograd: dp/dh = -rho g, in all layers and on their edges; of the inverse one over that."""
    at = torch.cat([heights(60), torch.tensor([0.0, 11e3, 20e3, 47e3, 71e3], dtype=DOUBLE)])
    slope = torch.func.vmap(torch.func.grad(lambda h: pressure_pa(h, check=False)))(at)
    np.testing.assert_allclose(slope, -atmosphere.GRAVITY_M_S2 * density_kg_m3(at), rtol=1e-11)
    back = torch.func.vmap(torch.func.grad(lambda p: height_m(p, check=False)))(pressure_pa(at))
    np.testing.assert_allclose(back * slope, np.ones(len(at)), rtol=1e-11)
    # The second derivative, also where the formula is 0 / 0: d2p/dh2 = p (g / R T)^2 (1 + L R / g).
    sea = torch.zeros((), dtype=DOUBLE)
    second = torch.func.grad(torch.func.grad(lambda h: pressure_pa(h, check=False)))(sea).item()
    fall = atmosphere.GRAVITY_M_S2 / atmosphere.GAS_CONSTANT_J_KG_K
    expected = 101325 * (fall / 288.15) ** 2 * (1 - 6.5e-3 / fall)
    assert second == pytest.approx(expected, rel=1e-10)


def test_single_precision_and_batches():
    at = heights(24)
    for function, values in ((temperature_k, at), (pressure_pa, at), (density_kg_m3, at), (height_m, pressure_pa(at))):
        whole = function(values)
        torch.testing.assert_close(function(values.reshape(2, 3, 4)), whole.reshape(2, 3, 4), rtol=0, atol=0)
        single = function(values.float())
        assert single.dtype == torch.float32
        # Exponents up to 12.6 and sums of some terms; heights in layers whose scale is up to 8.7 km.
        few = 24 * torch.finfo(torch.float32).eps
        np.testing.assert_allclose(single.double(), whole, rtol=few, atol=8700 * few if function is height_m else 0)


def test_compiles_without_a_break():
    compiled = torch.compile(
        lambda h: height_m(pressure_pa(h, check=False), check=False), fullgraph=True, backend="eager"
    )
    torch.testing.assert_close(compiled(heights()), heights(), rtol=0, atol=2e-9)


@pytest.mark.parametrize("function", [temperature_k, pressure_pa, density_kg_m3])
@pytest.mark.parametrize("value", [-5001.0, 84_853.0, math.nan, math.inf])
def test_refuses_heights_outside(function, value):
    given = torch.tensor([[0.0, 1.0], [2.0, value]], dtype=DOUBLE)
    with pytest.raises(ValueError, match=rf"height_m must be between -5000 and 84852.*entry \(1, 1\) is {value}"):
        function(given)
    assert not math.isfinite(value) or torch.isfinite(function(given, check=False)).all()


@pytest.mark.parametrize("value", [0.37, 177_700.0, -1.0, math.nan])
def test_refuses_pressures_outside(value):
    with pytest.raises(ValueError, match=r"pressure_pa must be between 0\.373\d* and 17\d*.*entry \(0,\) is"):
        height_m(torch.tensor([value], dtype=DOUBLE))
    assert height_m(torch.tensor([180e3], dtype=DOUBLE), check=False).item() < -5000
