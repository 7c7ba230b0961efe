"""The ellipsoid against 40-digit arithmetic, pymap3d, PROJ and geographiclib; gravity against its potential."""

import math

import numpy as np
import pymap3d
import pytest
import torch
from geographiclib.geodesic import Geodesic
from oracles import inertial_oracle as oracle
from pyproj import Transformer

from torchfilt.models.inertial import earth
from torchfilt.models.inertial.earth import WGS84, LocalMetres

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps
EDGE = [math.pi / 2, -math.pi / 2, 0.0, math.pi / 2 - 1e-9, 1e-9, -1.2]


def places(height_m, count=60, seed=0):
    """Latitudes from pole to pole, both poles and the equator among them; longitudes; one height."""
    rng = np.random.default_rng(seed)
    lat = np.concatenate([rng.uniform(-math.pi / 2, math.pi / 2, count), EDGE])
    lon = rng.uniform(-math.pi, math.pi, len(lat))
    return tuple(torch.from_numpy(v) for v in (lat, lon, np.full_like(lat, height_m)))


LAT, LON, HEIGHT = places(2500.0)


def test_constants_are_consistent():
    """Gravity at equator and pole, kept as numbers with ten decimals, follows from the four that define the field."""
    assert abs(oracle.gravity(0.0, 0.0)[0] - WGS84.gravity_equator_m_s2) < 1e-10
    assert abs(oracle.gravity(math.pi / 2, 0.0)[0] - WGS84.gravity_pole_m_s2) < 1e-10
    assert WGS84.eccentricity2 == pytest.approx(6.69437999014e-3, rel=1e-11)  # NGA.STND.0036, table 3.5
    assert WGS84.semi_minor_m == pytest.approx(6356752.3142, abs=6e-5)
    assert WGS84.centrifugal_ratio == pytest.approx(0.00344978650684, rel=1e-11)


def test_radii():
    found = torch.stack(earth.radii(LAT[:-6]), -1)
    np.testing.assert_allclose(found, [oracle.radii(v) for v in LAT[:-6]], rtol=8 * EPS)
    for witness, value in ((pymap3d.rcurve.meridian, found[:, 0]), (pymap3d.rcurve.transverse, found[:, 1])):
        np.testing.assert_allclose(value, witness(np.degrees(LAT[:-6].numpy())), rtol=1e-14)


def test_gravity_is_the_gradient_of_the_potential():
    """Exact on the ground to the constants' digits; above it to f^2 of the first order and 4 (h/a)^3 g of the third."""
    for height in (0.0, 1e3, 6e3):
        found = earth.gravity(LAT, torch.full_like(LAT, height)).numpy()
        exact = np.array([oracle.gravity(v, height)[0] for v in LAT])
        assert np.abs(found - exact).max() < 1e-10 + 1.05e-10 * height + 4.2 * (height / WGS84.semi_major_m) ** 3 * 9.83


def test_gravity_leaves_out_the_third_order_in_height():
    latitude = torch.tensor([0.6], dtype=DOUBLE)

    def error(height):
        found = earth.gravity(latitude, torch.tensor(height, dtype=DOUBLE))
        return abs(float(found) - oracle.gravity(0.6, height)[0])

    # f^2 of the first order is below the third where the height is large.
    assert math.log2(error(4e5) / error(2e5)) == pytest.approx(3, abs=0.2)
    assert math.log2(error(2e5) / error(1e5)) == pytest.approx(3, abs=0.3)


def test_slopes_are_the_derivatives():
    lat, height = LAT, 1e3 * LON
    one, zero = torch.ones_like(lat), torch.zeros_like(lat)
    by_latitude = torch.func.jvp(earth.radii, (lat,), (one,))[1]
    gravity = [torch.func.jvp(earth.gravity, (lat, height), way)[1] for way in ((one, zero), (zero, one))]
    for found, expected in zip(earth.slopes(lat, height), (*by_latitude, *gravity), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-14 * expected.abs().max().item())


def test_horizontal_gravity_that_is_left_out_is_as_small_as_stated():
    south = [abs(oracle.gravity(v, 6e3)[1]) for v in LAT]
    assert 4e-5 < max(south) < 5e-5


def test_earth_rate_is_the_axis_in_enu():
    axis = torch.tensor([0.0, 0.0, WGS84.rate_rad_s], dtype=DOUBLE)
    expected = earth.enu_from_ecef_matrix(LAT, LON) @ axis
    torch.testing.assert_close(earth.earth_rate_enu(LAT), expected, rtol=0, atol=2 * EPS * WGS84.rate_rad_s)


def test_transport_rate_is_how_the_axes_turn():
    """dC/dt = -[w x] C along a motion whose ENU velocity is the derivative of the ECEF position."""
    lat, lon, h = (v[:-6] for v in (LAT, LON, HEIGHT))
    velocity = torch.tensor([120.0, -80.0, 7.0], dtype=DOUBLE).expand(len(lat), 3)
    axes = earth.enu_from_ecef_matrix(lat, lon)
    moved = (axes.mT @ velocity.unsqueeze(-1)).squeeze(-1)
    _, speeds = torch.func.jvp(earth.ecef_to_geodetic, (earth.geodetic_to_ecef(lat, lon, h),), (moved,))
    _, turning = torch.func.jvp(earth.enu_from_ecef_matrix, (lat, lon), speeds[:2])
    product = -(turning @ axes.mT)
    expected = torch.stack([product[:, 2, 1], product[:, 0, 2], product[:, 1, 0]], -1)
    found = earth.transport_rate_enu(lat, h, velocity)
    # 2e-5 rad/s, near the poles times the tangent of the latitude.
    limit = 1e-13 * (2e-5 * (1 + lat.tan().abs())).unsqueeze(-1)
    assert ((found - expected).abs() < limit).all()


@pytest.mark.parametrize("height", [-1e3, 0.0, 1e4, 4e7])
def test_ecef_positions(height):
    lat, lon, h = places(height)
    found = earth.geodetic_to_ecef(lat, lon, h)
    exact = [oracle.ecef(*v) for v in zip(lat, lon, h, strict=True)]
    np.testing.assert_allclose(found, exact, rtol=0, atol=4 * EPS * (6.4e6 + height))


# Rounding of coordinates of this size: 9e-10 m at the ground, 7e-9 m at 40,000 km.
@pytest.mark.parametrize(
    ("height", "limit"),
    [(-1e6, 4e-9), (-1e3, 2.5e-9), (0.0, 2.5e-9), (1e4, 2.5e-9), (4e5, 2.5e-9), (2e6, 4e-9), (2e7, 9e-9), (4e7, 2e-8)],
)
def test_ecef_to_geodetic_is_exact_to_rounding_at_any_height(height, limit):
    lat, lon, h = places(height)
    exact = torch.tensor([oracle.ecef(*v) for v in zip(lat, lon, h, strict=True)], dtype=DOUBLE)
    found = earth.ecef_to_geodetic(exact)
    radius = 6.4e6 + height
    assert ((found[0] - lat).abs() * radius).max() < limit
    assert ((found[1] - lon).abs() * lat.cos() * radius).max() < limit
    assert (found[2] - h).abs().max() < limit


def test_on_the_axis():
    x = torch.tensor([[0.0, 0.0, 7e6], [0.0, 0.0, -7e6]], dtype=DOUBLE)
    lat, _, h = earth.ecef_to_geodetic(x)
    assert lat.tolist() == [math.pi / 2, -math.pi / 2]
    torch.testing.assert_close(h, torch.full_like(h, 7e6 - WGS84.semi_minor_m), rtol=0, atol=2e-9)


@pytest.mark.parametrize("height", [0.0, 3e3, 1e4])
def test_witnesses_below_10_km(height):
    """pymap3d is good to 3e-9 m here, PROJ to micrometres."""
    lat, lon, h = (v[:-6] for v in places(height))
    found = earth.geodetic_to_ecef(lat, lon, h)
    theirs = np.stack(pymap3d.geodetic2ecef(lat.numpy(), lon.numpy(), h.numpy(), deg=False), -1)
    np.testing.assert_allclose(found, theirs, rtol=0, atol=4e-9)
    back = earth.ecef_to_geodetic(found)
    theirs = pymap3d.ecef2geodetic(*found.numpy().T, deg=False)
    scale = (6.4e6, 6.4e6 * lat.cos().numpy(), 1.0)
    for mine, other, metres in zip(back, theirs, scale, strict=True):
        assert (np.abs(mine.numpy() - other) * metres).max() < 8e-9
    proj = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    longitude, latitude, up = proj.transform(*found.numpy().T)
    for mine, other, metres in zip(back, (np.radians(latitude), np.radians(longitude), up), scale, strict=True):
        assert (np.abs(mine.numpy() - other) * metres).max() < 1e-5


def test_axes_are_those_of_pymap3d():
    lat, lon, h = (v[:5] for v in (LAT, LON, HEIGHT))
    offset = torch.tensor([300.0, -200.0, 50.0], dtype=DOUBLE)
    east, north, up = pymap3d.ecef2enu(
        *(earth.geodetic_to_ecef(lat, lon, h) + offset).numpy().T, lat.numpy(), lon.numpy(), h.numpy(), deg=False
    )
    found = earth.enu_from_ecef_matrix(lat, lon) @ offset
    np.testing.assert_allclose(found, np.stack([east, north, up], -1), rtol=0, atol=1e-8)
    assert earth.enu_from_ecef_matrix(lat[:1], lon).shape == (5, 3, 3)


FUNCTIONS = {
    "radii": (earth.radii, (LAT[:5],)),
    "gravity": (earth.gravity, (LAT[:5], HEIGHT[:5])),
    "slopes": (earth.slopes, (LAT[:5], HEIGHT[:5])),
    "earth_rate_enu": (earth.earth_rate_enu, (LAT[:5],)),
    "transport_rate_enu": (earth.transport_rate_enu, (LAT[:5], HEIGHT[:5], torch.ones(5, 3, dtype=DOUBLE))),
    "geodetic_to_ecef": (earth.geodetic_to_ecef, (LAT[:5], LON[:5], HEIGHT[:5])),
    "ecef_to_geodetic": (earth.ecef_to_geodetic, (earth.geodetic_to_ecef(LAT[:5], LON[:5], HEIGHT[:5]),)),
    "enu_from_ecef_matrix": (earth.enu_from_ecef_matrix, (LAT[:5], LON[:5])),
    "to_metres": (LocalMetres(0.4, -1.0, 20.0).to_metres, (LAT[:5], LON[:5], HEIGHT[:5])),
    "to_geodetic": (LocalMetres(0.4, -1.0, 20.0).to_geodetic, (torch.ones(5, 3, dtype=DOUBLE),)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_vmap_and_one_graph(name):
    function, inputs = FUNCTIONS[name]
    whole = function(*inputs)
    torch.testing.assert_close(torch.vmap(function)(*inputs), whole, rtol=4 * EPS, atol=1e-9)
    compiled = torch.compile(function, fullgraph=True, backend="eager", dynamic=False)
    torch.testing.assert_close(compiled(*inputs), whole, rtol=0, atol=0)


def test_derivatives():
    lat, lon, h = (v[:5].clone().requires_grad_() for v in (LAT, LON, HEIGHT))
    velocity = torch.full((5, 3), 30.0, dtype=DOUBLE, requires_grad=True)

    def check(function, *inputs, step=1e-6, atol=1e-5):
        assert torch.autograd.gradcheck(function, inputs, eps=step, atol=atol, rtol=1e-6, check_forward_ad=True)

    # Differences of numbers of 6e6 m over a step of 1e-4 rad are good to 1e-5 m/rad.
    check(earth.geodetic_to_ecef, lat, lon, h, step=1e-4, atol=0.1)
    check(earth.radii, lat, step=1e-4, atol=1e-2)
    check(earth.gravity, lat, h, atol=1e-8)
    check(earth.earth_rate_enu, lat, atol=1e-12)
    # In units that make all of them of size one, away from the poles.
    check(lambda a, b, v: 1e6 * earth.transport_rate_enu(a / 2, 1e6 * b, v), lat, 1e-6 * h, velocity)
    check(earth.enu_from_ecef_matrix, lat, lon)
    # Heights to a metre a metre, latitudes to 1e-7 rad a metre.
    ecef = earth.geodetic_to_ecef(lat, lon, h).detach().requires_grad_()
    check(lambda x: earth.ecef_to_geodetic(x)[2], ecef, step=1.0, atol=1e-6)
    check(lambda x: earth.ecef_to_geodetic(x)[0], ecef, step=1.0, atol=1e-12)
    check(lambda x: earth.ecef_to_geodetic(x)[1], ecef, step=1.0, atol=1e-11)


def test_single_precision_resolves_half_a_metre():
    """Coordinates of 6.4e6 m are 0.5 m apart in float32, and latitudes as much."""
    lat, lon, h = (v[:-6].float() for v in (LAT, LON, HEIGHT))
    x = earth.geodetic_to_ecef(lat, lon, h)
    assert x.dtype == torch.float32
    assert (x - earth.geodetic_to_ecef(lat.double(), lon.double(), h.double())).abs().max() < 2.0
    back = earth.ecef_to_geodetic(x)
    exact = earth.ecef_to_geodetic(x.double())
    assert (back[2] - exact[2]).abs().max() < 2.0
    assert ((back[0] - exact[0]).abs() * 6.4e6).max() < 2.0
    assert earth.gravity(lat, h).dtype == earth.transport_rate_enu(lat, h, x).dtype == torch.float32
    torch.testing.assert_close(
        earth.gravity(lat, h).double(), earth.gravity(lat.double(), h.double()), rtol=1e-6, atol=0
    )


ORIGIN = LocalMetres(math.radians(34.2), math.radians(108.9), 2000.0)


def test_local_metres_and_back():
    metres = 2e5 * torch.randn(100, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    lat, lon, h = ORIGIN.to_geodetic(metres)
    # Latitude and longitude in rad round to 2e-16 of a radian: 3e-9 m.
    torch.testing.assert_close(ORIGIN.to_metres(lat, lon, h), metres, rtol=0, atol=4e-9)
    # The map is linear: twice the metres, twice the way.
    twice = ORIGIN.to_geodetic(2 * metres)
    for one, two, start in zip((lat, lon, h), twice, ORIGIN, strict=True):
        torch.testing.assert_close(two - start, 2 * (one - start), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("azimuth", "component"), [(0.0, 1), (90.0, 0)])
def test_local_metres_are_metres_at_the_origin(azimuth, component):
    """A short geodesic (geographiclib) from an origin on the ellipsoid."""
    origin = ORIGIN._replace(height_m=0.0)
    end = Geodesic.WGS84.Direct(34.2, 108.9, azimuth, 10.0)
    metres = origin.to_metres(
        *(torch.tensor(v, dtype=DOUBLE) for v in (math.radians(end["lat2"]), math.radians(end["lon2"]), 0))
    )
    # The radii change by 1.5e-6 of a metre over 10 m; degrees round to 1e-8 m.
    assert metres[component] == pytest.approx(10.0, abs=1e-6)


def test_height_of_the_origin_scales_the_metres():
    low = ORIGIN._replace(height_m=0.0)
    assert ORIGIN.north_m - low.north_m == pytest.approx(2000.0, abs=1e-8)
    assert ORIGIN.east_m - low.east_m == pytest.approx(2000.0 * math.cos(ORIGIN.latitude_rad), abs=1e-8)
    meridian, transverse = earth.radii(torch.tensor(ORIGIN.latitude_rad, dtype=DOUBLE))
    assert low.north_m == pytest.approx(float(meridian), rel=4 * EPS)
    assert low.east_m == pytest.approx(float(transverse) * math.cos(ORIGIN.latitude_rad), rel=4 * EPS)


def test_the_date_line_is_no_border():
    origin = LocalMetres(0.1, math.pi - 1e-6, 0.0)
    there = torch.tensor([50.0, 0.0, 0.0], dtype=DOUBLE)
    lat, lon, h = origin.to_geodetic(there)
    assert -math.pi <= lon < -math.pi + 1e-5
    torch.testing.assert_close(origin.to_metres(lat, lon, h), there, rtol=0, atol=4e-9)
