"""Measurement laws side by side: the law, its short cuts, and tensors made of what the sensors say."""

import copy
import pickle

import numpy as np
import pytest
import scipy.linalg
import torch
from torch import nn

import torchfilt as tf
from torchfilt.testing import check_law

DOUBLE = torch.float64


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def spd(size, seed=0):
    a = normal(size, size, seed=seed)
    return a @ a.mT + torch.eye(size, dtype=DOUBLE)


class Camera(nn.Module):
    """Range and bearing of a landmark from a plane state (x, y, speed), seen within a range only."""

    def __init__(self, sd=0.1, offer=True):
        super().__init__()
        self.size, self.space = 2, tf.Product(tf.Euclidean(1), tf.Angle(1))
        self.sd = nn.Parameter(torch.tensor([sd, 0.02], dtype=DOUBLE))
        if offer:
            self.first_order = self._first_order

    def forward(self, x):
        x1, x2 = x[..., 0], x[..., 1]
        mean = torch.stack([torch.hypot(x1, x2), torch.atan2(x2, x1)], -1)
        return tf.Gaussian(mean, self.sd, self.space, is_diagonal=True)

    def _first_order(self, x, u=None, dt=None):
        x1, x2, r = x[..., 0], x[..., 1], x[..., :2].norm(dim=-1)
        zero = torch.zeros_like(r)
        rows = [torch.stack([x1 / r, x2 / r, zero], -1), torch.stack([-x2 / r**2, x1 / r**2, zero], -1)]
        return self(x), torch.stack(rows, -2)

    def in_view(self, x):
        return x[..., :2].norm(dim=-1) < 2.0


H, OFFSET = normal(2, 3, seed=3), normal(2, seed=4)
SPEED = tf.LinearGaussian(H, spd(2, 5), OFFSET)
HEIGHT = tf.LinearGaussian(normal(1, 3, seed=6), 0.3 * torch.eye(1, dtype=DOUBLE))
X = normal(5, 3, seed=7)


def trio(**options):
    return tf.Sensors(speed=SPEED, camera=Camera(**options), height=HEIGHT)


# The law ------------------------------------------------------------------------------------------------------------


def test_a_measurement_is_the_parts_side_by_side():
    sensors, x = trio(), X
    law = sensors(x)
    parts = [sensors.law(name)(x) for name in sensors.names]
    assert torch.equal(law.mean, torch.cat([part.mean for part in parts], -1))
    expected = scipy.linalg.block_diag(*(part.factor().detach().numpy() for part in parts))
    np.testing.assert_array_equal(law.scale_tril.detach(), expected)
    assert law.scale_tril.dim() == 2, "nothing of it belongs to a row"
    assert law.space == tf.Product(tf.Euclidean(3), tf.Angle(1), tf.Euclidean(1))
    assert (sensors.names, sensors.sizes, sensors.size, sensors.tangent_size) == (
        ("speed", "camera", "height"),
        (2, 2, 1),
        5,
        5,
    )
    assert sensors.columns == sensors.parts == (slice(0, 2), slice(2, 4), slice(4, 5))
    # The joint density is the product of those of the parts.
    y = law.sample(normal(5, 5, seed=8))
    alone = sum(part.log_prob(share) for part, share in zip(parts, sensors.unpack(y).values(), strict=True))
    np.testing.assert_allclose(law.log_prob(y).detach(), alone.detach(), rtol=1e-13)


def test_standard_deviations_stay_a_vector_and_angles_wrap():
    sensors = tf.Sensors(one=Camera(), two=Camera(0.3))
    law = sensors(X)
    assert law.is_diagonal and torch.equal(law.scale_tril.detach(), torch.tensor([0.1, 0.02, 0.3, 0.02], dtype=DOUBLE))
    turned = law.mean + 2 * torch.pi * torch.tensor([0, 1, 0, -2.0]).double()
    away = law.space.local(law.mean, turned)
    assert away.abs().max() < 1e-14
    flat = tf.Sensors(one=HEIGHT, two=SPEED)
    assert flat(X).space == flat.space == tf.Euclidean(3) and not flat(X).is_diagonal


def test_noise_of_its_own_a_row():
    """One part's factor belongs to the row: the whole one does, with the shared ones in it."""
    each = spd(2, 1) * torch.arange(1.0, 6).double()[:, None, None]
    sensors = tf.Sensors(rows=tf.AdditiveGaussian(lambda x: x[..., :2], each), shared=HEIGHT)
    factor = sensors(X).scale_tril
    assert factor.shape == (5, 3, 3)
    for k in range(5):
        expected = scipy.linalg.block_diag(each[k], 0.3 * np.eye(1))
        np.testing.assert_allclose(factor[k] @ factor[k].mT, expected, rtol=1e-13)

    def varying(x):
        return tf.Gaussian(x[..., :2], 1 + x[..., :2].square(), is_diagonal=True)

    varying.size = 2
    law = tf.Sensors(first=varying, last=lambda_law())(X)
    assert law.is_diagonal and law.scale_tril.shape == (5, 3)
    assert torch.equal(law.scale_tril, torch.cat([1 + X[:, :2].square(), torch.full((5, 1), 0.5).double()], -1))


def lambda_law(size=1):
    def law(x):
        return tf.Gaussian(x[..., :1], torch.full((1,), 0.5, dtype=x.dtype), is_diagonal=True)

    law.size = size
    return law


def test_errors_of_a_quaternion_have_fewer_components():
    """columns count numbers, parts error components; NaN of a quaternion hides all of it."""
    tracker = tf.AdditiveGaussian(lambda x: x[..., :4], 0.01 * torch.eye(3, dtype=DOUBLE), tf.UnitQuaternion())
    sensors = tf.Sensors(height=lambda_law(), tracker=tracker, again=lambda_law())
    assert sensors.sizes == (1, 4, 1) and (sensors.size, sensors.tangent_size) == (6, 5)
    assert sensors.columns == (slice(0, 1), slice(1, 5), slice(5, 6))
    assert sensors.parts == (slice(0, 1), slice(1, 4), slice(4, 5))
    q = torch.nn.functional.normalize(normal(3, 4), dim=-1)
    law = sensors(q)
    assert law.mean.shape == (3, 6) and law.scale_tril.shape == (5, 5)
    hole = law.mean.clone()
    hole[:, 2] = torch.nan
    assert law.space.observed(hole).tolist() == [[True, False, False, False, True]] * 3


def test_controls_and_time_steps_reach_those_who_ask():
    def leaning(x, u, dt):
        return x[..., :1] * dt + u

    def only_dt(x, dt):
        return x[..., 1:2] / dt

    one = torch.eye(1, dtype=DOUBLE)
    sensors = tf.Sensors(
        a=tf.AdditiveGaussian(leaning, one),
        b=tf.AdditiveGaussian(only_dt, one),
        c=HEIGHT,
        d=tf.LinearGaussian(HEIGHT.matrix, one, control_matrix=2 * one),
    )
    assert sensors.takes_controls and not trio().takes_controls
    assert tf.Sensors(a=tf.LinearGaussian(HEIGHT.matrix, one, control_matrix=one)).takes_controls
    u = normal(5, 1, seed=9)
    mean = sensors(X, u, 0.5).mean
    expected = [X[:, :1] * 0.5 + u, X[:, 1:2] / 0.5, HEIGHT(X).mean, HEIGHT(X).mean + 2 * u]
    np.testing.assert_allclose(mean, torch.cat(expected, -1), rtol=1e-15)


# Short cuts ---------------------------------------------------------------------------------------------------------


def test_linear_form_is_that_of_the_parts():
    one = torch.eye(1, dtype=DOUBLE)
    push = tf.LinearGaussian(normal(1, 3, seed=1), one, control_matrix=3 * one)
    sensors = tf.Sensors(speed=SPEED, height=HEIGHT, push=push)
    u = normal(5, 1, seed=2)
    matrix, offset, factor = sensors.linear_form(u, None)
    np.testing.assert_array_equal(matrix, np.concatenate([H, HEIGHT.matrix, push.matrix]))
    np.testing.assert_array_equal(offset, np.concatenate([np.broadcast_to(OFFSET, (5, 2)), np.zeros((5, 1)), 3 * u], 1))
    expected = scipy.linalg.block_diag(*(np.linalg.cholesky(c) for c in (spd(2, 5), 0.3 * np.eye(1), np.eye(1))))
    np.testing.assert_allclose(factor, expected, rtol=1e-14)
    assert tf.Sensors(a=HEIGHT, b=HEIGHT).linear_form().offset is None
    batched = tf.Sensors(a=HEIGHT, b=tf.LinearGaussian(normal(4, 2, 3), spd(2)))
    assert batched.linear_form().matrix.shape == (4, 3, 3)


def test_first_order_is_the_derivative():
    """Against reverse-mode derivatives of the mean, with linear parts among the others."""
    sensors = trio()
    at, jacobian = sensors.first_order(X, None, None)
    assert torch.equal(at.mean, sensors(X).mean)
    expected = torch.stack([torch.func.jacrev(lambda x: sensors(x).mean)(x) for x in X])
    np.testing.assert_allclose(jacobian.detach(), expected.detach(), rtol=1e-12, atol=1e-14)
    assert sensors.first_order(X.unsqueeze(1), None, None)[1].shape == (5, 1, 5, 3)


def test_short_cuts_are_offered_where_all_parts_have_them():
    assert not hasattr(trio(), "linear_form") and hasattr(trio(), "first_order")
    assert hasattr(tf.Sensors(a=HEIGHT), "linear_form") and hasattr(tf.Sensors(a=HEIGHT), "first_order")
    assert not hasattr(trio(offer=False), "first_order")
    first, second = Camera(), Camera()
    first.linear_in = second.linear_in = slice(2, 3)
    assert tf.Sensors(a=first, b=HEIGHT, c=second).linear_in == slice(2, 3)
    second.linear_in = (2, 1)
    assert not hasattr(tf.Sensors(a=first, c=second), "linear_in")
    assert not hasattr(tf.Sensors(a=HEIGHT), "linear_in") and not hasattr(trio(), "linear_in")


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_copies_ask_their_own_parts(copier):
    sensors = tf.Sensors(speed=SPEED, height=tf.LinearGaussian(HEIGHT.matrix, torch.eye(1, dtype=DOUBLE)))
    other = copier(sensors)
    other.law("height").matrix.mul_(2)
    assert torch.equal(other.linear_form().matrix[2], 2 * sensors.linear_form().matrix[2])
    assert torch.equal(other.first_order(X, None, None)[1][2], 2 * sensors.first_order(X, None, None)[1][2])


def test_conformance():
    check_law(trio(), X)
    check_law(trio(offer=False), X)
    check_law(tf.Sensors({"speed": SPEED}, height=HEIGHT), X)


# A module -----------------------------------------------------------------------------------------------------------


def test_parameters_of_the_parts_train_move_and_are_saved():
    sensors = trio()
    assert [name for name, _ in sensors.named_parameters()] == ["laws.camera.sd"]
    sensors(X).log_prob(sensors(X).mean.detach() + 0.1).sum().backward()
    assert sensors.law("camera").sd.grad.abs().min() > 0
    other = trio(sd=3.0)
    other.load_state_dict(sensors.state_dict())
    assert torch.equal(other(X).scale_tril, sensors(X).scale_tril)
    small = copy.deepcopy(sensors).float()
    law = small(X.float())
    assert law.mean.dtype == law.scale_tril.dtype == torch.float32
    np.testing.assert_allclose(law.mean.detach(), sensors(X).mean.detach(), rtol=1e-5)


def test_under_vmap_and_forward_mode():
    sensors = trio()
    each = torch.func.vmap(lambda x: sensors(x).mean)(X)
    np.testing.assert_allclose(each.detach(), sensors(X).mean.detach(), rtol=1e-15)
    forward = torch.func.jvp(lambda x: sensors(x).mean, (X,), (torch.ones_like(X),))[1]
    slope = (sensors.first_order(X, None, None)[1] @ torch.ones(3, 1, dtype=DOUBLE)).squeeze(-1)
    np.testing.assert_allclose(forward.detach(), slope.detach(), rtol=1e-12, atol=1e-14)


# Measurements by name -----------------------------------------------------------------------------------------------


def test_pack_fills_with_nan_and_unpack_undoes_it():
    sensors = trio()
    y = sensors.pack({"height": torch.full((4, 1), 2.0).double(), "speed": None})
    assert y.shape == (4, 5) and y.dtype == DOUBLE
    assert torch.isnan(y).tolist() == [[True, True, True, True, False]] * 4 and (y[:, 4] == 2).all()
    named = {"speed": normal(6, 4, 2), "camera": normal(6, 4, 2, seed=1), "height": normal(6, 1, 1, seed=2)}
    series = sensors.pack(named)
    assert series.shape == (6, 4, 5)
    back = sensors.unpack(series)
    assert list(back) == ["speed", "camera", "height"]
    for name, value in named.items():
        assert torch.equal(back[name], value.expand_as(back[name]))
    silent = sensors.pack({}, (3,), X)
    assert silent.shape == (3, 5) and silent.dtype == DOUBLE and silent.isnan().all()
    one = sensors.pack({"height": torch.ones(1)}, like=torch.zeros((), dtype=torch.float32))
    assert one.shape == (5,) and one.dtype == torch.float32
    shared = sensors.pack({"height": torch.ones(1, 1, dtype=DOUBLE)}, lead=(3,))
    assert shared.shape == (3, 5)
    value = normal(4, 1).requires_grad_()
    sensors.pack({"height": value})[:, 4].sum().backward()
    assert torch.equal(value.grad, torch.ones(4, 1, dtype=DOUBLE))


GOOD = torch.zeros(4, 2, dtype=DOUBLE)


@pytest.mark.parametrize(
    ("named", "options", "error", "message"),
    [
        (GOOD, {}, TypeError, "must be a tensor or a mapping by sensor, got Tensor"),
        ({"speedo": GOOD}, {}, ValueError, "no sensor 'speedo'; there are speed, camera, height"),
        ({"speed": 1.0}, {}, TypeError, r"sensor 'speed' must be a tensor \(\*lead, 2\) or None, got float"),
        ({"speed": GOOD[:, :1]}, {}, ValueError, r"sensor 'speed' must be \(\*lead, 2\), got \(4, 1\)"),
        ({"height": GOOD[0, 0]}, {}, ValueError, r"sensor 'height' must be \(\*lead, 1\), got \(\)"),
        ({"speed": GOOD, "camera": GOOD.float()}, {}, TypeError, "sensor 'camera' must have the dtype torch.float64"),
        ({"speed": GOOD}, {"like": GOOD.float()}, TypeError, "sensor 'speed' must have the dtype torch.float32"),
        ({"speed": GOOD, "camera": GOOD[:3]}, {}, ValueError, r"'camera' has leading dims \(3,\), .* not fit \(4,\)"),
        ({"speed": GOOD, "camera": GOOD[0]}, {}, ValueError, r"'camera' has leading dims \(\), .* not fit \(4,\)"),
        ({"speed": GOOD}, {"lead": (1,)}, ValueError, r"'speed' has leading dims \(4,\), .* not fit \(1,\)"),
        ({"speed": GOOD}, {"lead": (5, 4)}, ValueError, r"'speed' has leading dims \(4,\), .* not fit \(5, 4\)"),
        ({}, {}, ValueError, "no sensor says anything: give lead= and like="),
        ({"speed": None}, {"like": GOOD}, ValueError, "no sensor says anything"),
        ({}, {"lead": (4,)}, ValueError, "no sensor says anything"),
    ],
)
def test_bad_measurements_by_name(named, options, error, message):
    with pytest.raises(error, match=message):
        trio().pack(named, **options)


def test_measurements_of_another_size():
    sensors = trio()
    for call in (sensors.unpack, sensors.complete, lambda y: sensors.hide(y, X)):
        with pytest.raises(ValueError, match=r"measurements must be \(\.\.\., 5\), got \(4, 2\)"):
            call(GOOD)


def test_a_sensor_that_cannot_see_is_silent():
    """The camera sees to 2 m; who does not say how far always sees."""
    sensors = trio()
    x = torch.tensor([[1.0, 1, 0], [2, 1, 0], [0, 1.9, 5], [0, 2.1, 0]], dtype=DOUBLE)
    y = normal(4, 5)
    seen = sensors.hide(y, x)
    assert seen.isnan().tolist() == [[False] * 5, [False, False, True, True, False]] * 2
    assert torch.equal(seen[::2], y[::2]) and torch.equal(seen[:, :2], y[:, :2])
    wide = sensors.hide(y[0].expand(6, 4, 5), x)
    assert wide.shape == (6, 4, 5) and torch.equal(wide[3].isnan(), seen.isnan())


def test_sensors_fail_by_chance():
    """Rates within 4.5 standard errors (1e-5 of false alarms) of 4000 steps, sensors independent of each other."""
    sensors = tf.Sensors(speed=SPEED, camera=Camera(), level=tf.PseudoMeasurement(lambda x: x[..., :1], 1, 0.1))
    y = torch.zeros(4000, 5, dtype=DOUBLE)
    uniforms = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    silent = sensors.drop_out(y, 0.2, uniforms).isnan()
    assert (
        not silent[:, 4].any() and torch.equal(silent[:, 0], silent[:, 1]) and torch.equal(silent[:, 2], silent[:, 3])
    )
    limit = 4.5 * (0.2 * 0.8 / 4000) ** 0.5
    assert (silent[:, [0, 2]].double().mean(0) - 0.2).abs().max() < limit
    both = (silent[:, 0] & silent[:, 2]).double().mean()
    assert abs(both - 0.04) < 4.5 * (0.04 * 0.96 / 4000) ** 0.5
    named = sensors.drop_out(y, {"camera": 1.0, "level": 0.2}, uniforms).isnan()
    assert not named[:, :2].any() and named[:, 2:4].all() and torch.equal(named[:, 4], uniforms[:, 2] < 0.2)
    assert not sensors.drop_out(y, 0.0, torch.zeros(4000, 3)).isnan().any()
    with pytest.raises(ValueError, match=r"uniforms must be \(4000, 3\), a column a sensor, got \(4000, 5\)"):
        sensors.drop_out(y, 0.2, y)
    with pytest.raises(ValueError, match=r"share of sensor 'camera' must be in \[0, 1\], got 1.5"):
        sensors.drop_out(y, {"camera": 1.5}, uniforms)
    with pytest.raises(ValueError, match="no sensor 'kamera'"):
        sensors.drop_out(y, {"kamera": 0.5}, uniforms)


# Refusals -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("laws", "error", "message"),
    [
        ({}, ValueError, "needs at least one law"),
        ({"two words": HEIGHT}, ValueError, "must be an identifier, such as barometer, got 'two words'"),
        ({7: HEIGHT}, ValueError, "must be an identifier, such as barometer, got 7"),
        ({"values": HEIGHT}, ValueError, "'values' can't name a sensor: torch.nn.ModuleDict keeps it"),
        ({"height": 3.0}, TypeError, "sensor 'height' must be a law, called as law.x., got float"),
        ({"height": lambda x: HEIGHT(x)}, ValueError, "sensor 'height', a function, must state how many numbers"),
        ({"height": tf.AdditiveGaussian(torch.sin, spd(2)), "any": nn.Linear(2, 2)}, ValueError, "sensor 'any', a Lin"),
    ],
)
def test_bad_laws(laws, error, message):
    with pytest.raises(error, match=message):
        tf.Sensors(laws)


def test_a_name_twice_and_a_name_unknown():
    with pytest.raises(ValueError, match="sensor 'height' is given twice"):
        tf.Sensors({"height": HEIGHT}, height=HEIGHT)
    with pytest.raises(ValueError, match="no sensor 'depth'"):
        trio().law("depth")


def test_laws_that_do_not_keep_what_they_state():
    heavy = tf.AdditiveGaussian(lambda x: x[..., :1], torch.eye(1, dtype=DOUBLE))

    def student(x):
        return torch.distributions.StudentT(4.0, x[..., :1], 1.0)

    student.size = 1
    with pytest.raises(TypeError, match="sensor 'tail' gives a StudentT; sensors side by side must give a Gaussian"):
        tf.Sensors(fine=heavy, tail=student)(X)
    with pytest.raises(ValueError, match="sensor 'wide' states 2 numbers with 2 errors, it gives 1 numbers with 1"):
        tf.Sensors(fine=heavy, wide=lambda_law(2))(X)

    def attitude(x):
        return tf.Gaussian(x[..., :4], torch.ones(3, dtype=x.dtype), tf.UnitQuaternion(), True)

    attitude.size = 4
    with pytest.raises(
        ValueError, match=r"states 4 numbers with 4 errors, it gives 4 numbers with 3 .* state its space"
    ):
        tf.Sensors(star=attitude)(normal(2, 4))


def test_a_space_that_only_the_call_shows():
    """A law that states its size alone may still give angles: the whole measurement wraps there."""

    def compass(x):
        return tf.Gaussian(x[..., :1], torch.ones(1, dtype=x.dtype), tf.Angle(1), True)

    compass.size = 1
    law = tf.Sensors(compass=compass, height=HEIGHT)(X)
    assert law.space == tf.Product(tf.Angle(1), tf.Euclidean(1))


@pytest.mark.slow
def test_compiled_law_equals_eager():
    torch._dynamo.reset()
    sensors = trio()
    compiled = torch.compile(lambda x: sensors(x)[:2], fullgraph=True)
    for found, expected in zip(compiled(X), sensors(X)[:2], strict=True):
        np.testing.assert_allclose(found.detach(), expected.detach(), rtol=1e-14)
