"""Magnetometer against SciPy's rotations and autodiff; the iron fit against what it was simulated with."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from torchfilt.models.attitude import VectorMeasurement
from torchfilt.models.sensors.magnetometer import Magnetometer, field_enu, fit_iron
from torchfilt.spaces import Euclidean, Product, UnitQuaternion
from torchfilt.testing import check_law

DOUBLE = torch.float64
SPACE = Product(UnitQuaternion("left"), Euclidean(15))
# Zurich: microtesla, 63.4 degrees down, 3.2 degrees east.
FIELD = field_enu(48.3, math.radians(63.4), math.radians(3.2))
HARD = torch.tensor([20.0, -35.0, 60.0], dtype=DOUBLE)
SOFT = torch.tensor([[1.1, 0.05, -0.03], [0.05, 0.95, 0.04], [-0.03, 0.04, 1.02]], dtype=DOUBLE)


def states(rows, seed=0):
    x = torch.randn(rows, 19, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)
    x[:, :4] = nn.functional.normalize(x[:, :4], dim=-1)
    return x


def directions(rows, generator, most=1.0, least=-1.0):
    """Uniform over the part of the sphere between two heights."""
    z = generator.uniform(least, most, rows)
    around = generator.uniform(0, 2 * np.pi, rows)
    level = np.sqrt(1 - z**2)
    return torch.from_numpy(np.stack([level * np.cos(around), level * np.sin(around), z], -1))


def readings(field, noise_sd, generator):
    noise = torch.from_numpy(generator.normal(size=(len(field), 3)))
    return 50 * field @ SOFT.mT + HARD + noise_sd * noise


def test_field():
    assert FIELD.norm().item() == pytest.approx(48.3, rel=1e-15)
    east, north, up = FIELD.tolist()
    assert math.degrees(math.atan2(-up, math.hypot(east, north))) == pytest.approx(63.4)
    assert math.degrees(math.atan2(east, north)) == pytest.approx(3.2)


OPTIONS = {
    "plain": {},
    "iron": dict(hard_iron=HARD, soft_iron=SOFT + torch.tensor([[0, 0.2, 0], [0, 0, 0], [0, 0, 0]], dtype=DOUBLE)),
    "hard iron in the state": dict(soft_iron=SOFT, hard_iron_at=16),
    "the rest in the state": dict(hard_iron=HARD, hard_iron_at=14),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_reading_and_derivatives(name):
    options, x = OPTIONS[name], states(6)
    law = Magnetometer(FIELD, torch.tensor([0.3, 0.4, 0.5], dtype=DOUBLE), **options)
    body = Rotation.from_quat(x[:, :4].numpy()).inv().apply(FIELD.numpy())
    expected = body @ options.get("soft_iron", torch.eye(3, dtype=DOUBLE)).numpy().T
    expected = expected + options.get("hard_iron", torch.zeros(3)).numpy()
    at = options.get("hard_iron_at")
    expected = expected if at is None else expected + x[:, at : at + 3].numpy()
    found, slope = law.first_order(x)
    np.testing.assert_allclose(found.mean, expected, rtol=0, atol=1e-12)
    assert found.is_diagonal and found.scale_tril.tolist() == [0.3, 0.4, 0.5]
    for k, row in enumerate(x):
        exact = torch.func.jacfwd(lambda v, row=row: law(SPACE.retract(row, v)).mean)(torch.zeros(18, dtype=DOUBLE))
        np.testing.assert_allclose(slope[k], exact, atol=1e-11)
    check_law(law, x)


def test_without_iron_it_is_a_vector_measurement():
    x = states(3)
    plain, vector = Magnetometer(FIELD, 0.3).first_order(x), VectorMeasurement(FIELD, 0.3).first_order(x)
    torch.testing.assert_close(plain[0].mean, vector[0].mean, rtol=1e-14, atol=1e-13)
    torch.testing.assert_close(plain[1], vector[1], rtol=1e-14, atol=1e-13)


def test_batches_single_precision_compile_and_training():
    law, x = Magnetometer(FIELD, 0.3, soft_iron=SOFT, hard_iron_at=16), states(6)
    whole = law.first_order(x)
    for part, full in zip(law.first_order(x.reshape(2, 3, 19)), whole, strict=True):
        part, full = (part.mean, full.mean) if isinstance(part, tuple) else (part, full)
        torch.testing.assert_close(part.reshape(full.shape), full, rtol=0, atol=1e-13)
    single = law.first_order(x.float())
    assert single[0].mean.dtype == single[1].dtype == torch.float32
    # Three products of up to 53 each, by rotations of a dozen roundings.
    np.testing.assert_allclose(single[1], whole[1], atol=12 * 53 * torch.finfo(torch.float32).eps)
    compiled = torch.compile(law.first_order, fullgraph=True, backend="eager")(x)
    torch.testing.assert_close(compiled[1], whole[1])
    torch.testing.assert_close(torch.func.vmap(lambda row: law(row).mean)(x), whole[0].mean)
    fields = torch.stack([FIELD, 2 * FIELD])
    two = Magnetometer(fields, 0.3)(x.reshape(2, 3, 19)).mean.reshape(6, 3)
    torch.testing.assert_close(two[3:], Magnetometer(2 * FIELD, 0.3)(x[3:]).mean)
    hard, soft = nn.Parameter(HARD.clone()), nn.Parameter(SOFT.clone())
    Magnetometer(FIELD, 0.3, hard_iron=hard, soft_iron=soft)(x).mean.sum().backward()
    assert hard.grad.tolist() == [6, 6, 6] and soft.grad.abs().min() > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(hard_iron=torch.ones(2)), r"hard_iron must be \(3,\), got shape \(2,\)"),
        (dict(soft_iron=torch.ones(3)), r"soft_iron must be \(3, 3\), got shape \(3,\)"),
        (dict(hard_iron=torch.tensor([0, math.nan, 0])), r"hard_iron must be finite, entry \(1,\) is nan"),
        (dict(soft_iron=torch.ones(3, 3)), "soft_iron must not be singular, its singular values are"),
        (dict(hard_iron_at=3), "hard_iron_at must be an index behind the quaternion, 4 or more, got 3"),
        (dict(sd=0.0), "sd must be positive and finite"),
        (dict(field=torch.zeros(3)), "reference must be finite and not zero"),
    ],
)
def test_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        Magnetometer(**{"field": FIELD, "sd": 0.3, **options})


def test_refuses_states_and_fields():
    with pytest.raises(ValueError, match=r"the state must have 19 numbers or more, got \(2, 18\)"):
        Magnetometer(FIELD, 0.3, hard_iron_at=16)(states(2)[:, :18])
    with pytest.raises(ValueError, match="strength must be positive and finite, got 0"):
        field_enu(0.0, 1.0, 0.0)
    with pytest.raises(ValueError, match=r"inclination_rad must be within 0\.5 pi, got 63\.4"):
        field_enu(48.3, 63.4, 0.0)
    with pytest.raises(ValueError, match=r"declination_rad must be within 1\.0 pi, got 4"):
        field_enu(48.3, 1.0, 4.0)


# Calibration ----------------------------------------------------------------------------------------------------------


def test_exact_readings_give_the_iron():
    """To rounding times the condition."""
    generator = np.random.default_rng(0)
    field = directions(60, generator)
    fit = fit_iron(readings(field, 0.0, generator), 50.0)
    np.testing.assert_allclose(fit.hard_iron, HARD, atol=1e-11)
    np.testing.assert_allclose(fit.soft_iron, SOFT, atol=1e-12)
    np.testing.assert_allclose(fit.correct(readings(field, 0.0, generator)), 50 * field, atol=1e-10)
    assert fit.noise_sd < 1e-11 and 1 < fit.condition < 5
    # Far off the middle, where the quadric through the raw numbers would lose them.
    moved = fit_iron(readings(field, 0.0, generator) + 1e5, 50.0)
    np.testing.assert_allclose(moved.hard_iron, HARD + 1e5, atol=1e-8)
    # A turn of the field before the iron can't be seen: S Q gives the symmetric root of S S'.
    turn = torch.from_numpy(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix())
    again = fit_iron(50 * field @ (SOFT @ turn).mT + HARD, 50.0)
    np.testing.assert_allclose(again.soft_iron, SOFT, atol=1e-12)
    single = fit_iron(readings(field, 0.0, generator).float(), 50.0)
    assert single.hard_iron.dtype == single.soft_iron_sd.dtype == torch.float32
    # The fit runs in double precision: readings up to 120 are rounded before, the answer after.
    np.testing.assert_allclose(single.hard_iron, HARD, atol=120 * torch.finfo(torch.float32).eps)


@pytest.mark.parametrize("least", [-1.0, 0.0])
def test_noisy_readings_give_the_iron_within_its_deviations(least):
    """100 fits of the sphere, and of half of it, to 400 readings with 0.3 of 50 microtesla of noise.

    Each of nine numbers: mean of the normalised error within 4.5 standard errors of zero, its mean square within 4.5 of
    one (false alarm 1.2e-4 each case). The bias that is stated, 4e-5 of the soft iron, is below 0.04 deviations.
    """
    generator, errors, noise = np.random.default_rng(1), [], []
    rows, columns = torch.triu_indices(3, 3)
    for _ in range(100):
        fit = fit_iron(readings(directions(400, generator, least=least), 0.3, generator), 50.0)
        soft = ((fit.soft_iron - SOFT) / fit.soft_iron_sd)[rows, columns]
        errors.append(torch.cat([(fit.hard_iron - HARD) / fit.hard_iron_sd, soft]))
        noise.append(fit.noise_sd)
    errors = torch.stack(errors)
    assert errors.mean(0).abs().max() < 4.5 / 10
    assert (errors.square().mean(0) - 1).abs().max() < 4.5 * math.sqrt(2 / 100)
    assert np.mean(noise) == pytest.approx(0.3, rel=5 / math.sqrt(2 * 391 * 100))


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
def test_turns_that_leave_directions_out_are_refused(tilt_deg):
    """A vehicle that only ever turns level, or tilts by 5 degrees at most."""
    generator, reach = np.random.default_rng(2), math.sin(math.radians(tilt_deg))
    field = directions(500, generator, reach, -reach)
    for noise in (0.0, 0.3):
        with pytest.raises(ValueError, match="samples do not cover enough directions: the condition number of"):
            fit_iron(readings(field, noise, generator), 50.0)
    with pytest.raises(ValueError, match="samples do not cover enough directions"):
        fit_iron(torch.ones(20, 3, dtype=DOUBLE), 50.0)


def test_readings_on_another_surface_are_refused():
    generator = np.random.default_rng(3)
    level = torch.from_numpy(generator.uniform(-2, 2, (200, 2)))
    hyperboloid = torch.cat([level, (1 + level.square().sum(-1, keepdim=True)).sqrt()], -1)
    hyperboloid[::2, 2] *= -1
    with pytest.raises(ValueError, match="samples do not lie on an ellipsoid: the quadric"):
        fit_iron(hyperboloid, 1.0)
    # A blob whose quadric is an ellipsoid, but not the nearest one.
    blob = torch.randn(20, 3, generator=torch.Generator().manual_seed(44), dtype=DOUBLE)
    with pytest.raises(ValueError, match="samples do not lie on an ellipsoid: the fit does not converge"):
        fit_iron(blob, 1.0)


def test_fit_refuses():
    good = readings(directions(30, np.random.default_rng(4)), 0.1, np.random.default_rng(5))
    for samples in (good[:9], good[:, :2], good[0]):
        with pytest.raises(ValueError, match=r"samples must be \(n, 3\) with n >= 10, got shape"):
            fit_iron(samples, 50.0)
    bad = good.clone()
    bad[3, 1] = math.nan
    with pytest.raises(ValueError, match=r"samples must be finite, entry \(3, 1\) is nan"):
        fit_iron(bad, 50.0)
    for strength in (0.0, math.inf):
        with pytest.raises(ValueError, match=f"field_strength must be positive and finite, got {strength}"):
            fit_iron(good, strength)
