"""Conditional laws: what they mean, how functions are called, what is refused."""

import math

import numpy as np
import pytest
import torch

import torchfilt as tf
from torchfilt.laws import CallStyle, call_style, one_number, row_steps


def tensor(value):
    return torch.as_tensor(np.asarray(value), dtype=torch.float64)


A = tensor([[0.9, 0.1, 0.0], [0.2, 0.7, 0.3]])
B = tensor([[1.0], [0.5]])
COVARIANCE = tensor([[0.5, 0.2], [0.2, 0.4]])
OFFSET = tensor([1.0, -1.0])


def linear(**changes):
    given = {"matrix": A, "covariance": COVARIANCE, "offset": OFFSET, "control_matrix": B} | changes
    return tf.LinearGaussian(**given)


@pytest.mark.parametrize("lead", [(), (4,), (2, 4)])
def test_linear_law(lead):
    """Mean, covariance and linear form by their definition, for any leading dims, each row with its own control."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(*lead, 3, generator=generator, dtype=torch.float64)
    u = torch.randn(*lead, 1, generator=generator, dtype=torch.float64)
    law = linear()
    found = law(x, u)
    expected = torch.einsum("md,...d->...m", A, x) + OFFSET + torch.einsum("mk,...k->...m", B, u)
    torch.testing.assert_close(found.mean, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(found.covariance.expand(*lead, 2, 2), COVARIANCE.expand(*lead, 2, 2), rtol=0, atol=1e-15)
    form = law.linear_form(u)
    torch.testing.assert_close(
        torch.einsum("md,...d->...m", form.matrix, x) + form.offset, expected, rtol=0, atol=1e-15
    )
    assert torch.equal(law(x, u[..., :1]).mean, found.mean)


def test_a_matrix_for_each_row():
    """Rows of the batch with matrices of their own give the same through the linear form and through points."""
    matrices = torch.stack([A[:, :2], 2 * A[:, :2], -A[:, :2]])
    eye = torch.eye(2, dtype=torch.float64)
    law = tf.LinearGaussian(matrices, 0.1 * eye)
    prior = tf.Gaussian(tensor([[1.0, 2.0], [0.5, 0.5], [-1.0, 0.0]]), tensor([[0.5, 0.0], [0.1, 0.3]]))
    for row in range(3):
        torch.testing.assert_close(law(prior.mean).mean[row], matrices[row] @ prior.mean[row], rtol=0, atol=1e-15)
    rules = tf.moments.unscented(), tf.moments.cubature(), tf.moments.gauss_hermite(3)
    exact = tf.moments.predict(law, prior, tf.moments.taylor(), None, None)
    for rule in rules:  # 3 points and 3 rows: nothing may be paired by accident
        found = tf.moments.predict(law, prior, rule, None, None)
        torch.testing.assert_close(found.mean, exact.mean, rtol=0, atol=1e-14)
        torch.testing.assert_close(found.covariance, exact.covariance, rtol=0, atol=1e-14)


@pytest.mark.parametrize("points", [3, 5])  # 3 points and 3 rows: nothing may be paired by accident
def test_everything_for_each_row(points):
    """Matrix, offset and covariance of each row serve all points of the row, beside controls of each row."""
    generator = torch.Generator().manual_seed(2)
    scale = tensor([1.0, 2.0, 3.0])
    offsets = torch.stack([OFFSET, 10 * OFFSET, 100 * OFFSET])
    covariances = COVARIANCE * scale[:, None, None]
    x = torch.randn(3, points, 3, generator=generator, dtype=torch.float64)
    u = torch.randn(3, 1, 1, generator=generator, dtype=torch.float64)
    for matrices in (A, A * scale[:, None, None]):
        found = linear(matrix=matrices, covariance=covariances, offset=offsets)(x, u)
        added = tf.AdditiveGaussian(lambda x: x[..., :2], covariances)(x)
        for row in range(3):
            single = A if matrices.dim() == 2 else matrices[row]
            alone = linear(matrix=single, covariance=covariances[row], offset=offsets[row])(x[row], u[row])
            torch.testing.assert_close(found.mean[row], alone.mean, rtol=0, atol=1e-13)
            for law in (found, added):
                torch.testing.assert_close(law.covariance[row, -1], covariances[row], rtol=0, atol=1e-15)


@pytest.mark.parametrize("particles", [3, 5])
def test_filters_with_everything_for_each_row(particles):
    """Gaussian filters and banks whose particles are all equal give what each row gives alone."""
    eye = torch.eye(2, dtype=torch.float64)
    scale = tensor([1.0, 2.0, 3.0])[:, None, None]
    prior = tf.Gaussian(tensor([1.0, 2.0]), tensor([[0.5, 0.0], [0.1, 0.3]]))
    generator = torch.Generator().manual_seed(3)
    y = torch.randn(4, 3, 2, generator=generator, dtype=torch.float64)
    u = torch.randn(4, 3, 1, generator=generator, dtype=torch.float64)

    def model(row):
        motion = tf.LinearGaussian(
            (0.3 * scale * eye)[row],
            (0.1 * scale * eye)[row],
            (scale[:, 0] * OFFSET)[row],
            control_matrix=(scale * B)[row],
        )
        return tf.StateSpaceModel(prior, motion, tf.LinearGaussian(eye, (0.2 * scale * eye)[row]))

    def bank(model, rule):
        return tf.LocallyLinearizedParticleFilter(model, particles, rule, split=1.0)

    whole, alone = model(slice(None)), [tf.KalmanFilter(model(row)) for row in range(3)]
    expected = [one(y[:, row], u[:, row]) for row, one in enumerate(alone)]
    rules = tf.moments.taylor(), tf.moments.unscented()
    for found in (tf.UnscentedKalmanFilter(whole), tf.KalmanFilter(whole), *(bank(whole, rule) for rule in rules)):
        history = found(y, u)
        for row, one in enumerate(expected):
            torch.testing.assert_close(history.mean[:, row], one.mean, rtol=0, atol=1e-13)
            torch.testing.assert_close(history.covariance[:, row], one.covariance, rtol=0, atol=1e-13)
            torch.testing.assert_close(history.log_likelihood[row], one.log_likelihood, rtol=0, atol=1e-11)


@pytest.mark.parametrize("function", [lambda x: x, lambda x: x[..., 0], lambda x: x[..., :1].sum()])
def test_functions_that_do_not_fit_the_covariance_are_refused(function):
    """Another size than the noise, or a lost axis, is named where it happens, not three products later."""
    law = tf.AdditiveGaussian(function, tensor([[1.0]]))
    with pytest.raises(ValueError, match=r"function must turn x \(4, 2\) into \(\*lead, 1\)"):
        law(torch.zeros(4, 2, dtype=torch.float64))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"covariance": 0.1}, "covariance must be a matrix .* got float"),
        (
            {"covariance": COVARIANCE.float()},
            "covariance must have .* torch.float64, got torch.float32",
        ),
        ({"offset": OFFSET.float()}, "offset must have the matrix's dtype"),
        ({"control_matrix": B.float()}, "control_matrix must have the matrix's dtype"),
    ],
)
def test_types_that_are_refused(changes, message):
    """Precisions are not mixed, and a number is not a covariance."""
    with pytest.raises(TypeError, match=message):
        linear(**changes)


def test_singular_and_factor_covariances():
    singular = tensor([[1.0, 1.0], [1.0, 1.0]])
    torch.testing.assert_close(
        linear(covariance=singular)(torch.zeros(3).double(), torch.zeros(1).double()).covariance, singular
    )
    factor = torch.linalg.cholesky(COVARIANCE)
    by_factor = linear(covariance=None, scale_tril=factor)
    torch.testing.assert_close(by_factor.noise(), linear().noise(), rtol=0, atol=0)


def test_controls_that_are_missing():
    with pytest.raises(ValueError, match="control_matrix but no control u was given"):
        linear()(torch.zeros(3, dtype=torch.float64))


FACTOR = {"covariance": None}

# Changed arguments of the law above, and the words of the error.
REFUSED = {
    "vector for a matrix": ({"matrix": A[0]}, r"matrix must be \(\*batch, m, d\), got shape \(3,\)"),
    "NaN in the matrix": ({"matrix": A * torch.nan}, r"matrix must be finite, entry \(0, 0\) is nan"),
    "negative": ({"covariance": tensor([[1.0, 2.0], [2.0, 1.0]])}, "covariance must be positive semidefinite.*-1"),
    "not symmetric": ({"covariance": tensor([[1.0, 0.1], [0.2, 1.0]])}, "covariance must be symmetric.*0.1"),
    "not square": ({"covariance": COVARIANCE[:1]}, r"covariance must be a square matrix.*\(1, 2\)"),
    "infinite": ({"covariance": COVARIANCE * torch.inf}, "covariance must be finite, got inf"),
    "other size": ({"covariance": torch.eye(3, dtype=torch.float64)}, "covariance must be 2 x 2 to fit.*got 3"),
    "both": ({"scale_tril": COVARIANCE}, "exactly one of covariance= and scale_tril="),
    "none": ({"covariance": None}, "exactly one of covariance= and scale_tril="),
    "offset": ({"offset": tensor([1.0])}, r"offset must end in 2 .*got \(1,\)"),
    "NaN in the offset": ({"offset": OFFSET * torch.nan}, r"offset must be finite, entry \(0,\) is nan"),
    "control matrix": ({"control_matrix": B.T}, r"control_matrix must be \(\*batch, 2, k\), got shape \(1, 2\)"),
    "factor not square": (FACTOR | {"scale_tril": COVARIANCE[:1]}, r"scale_tril must be a square matrix .*\(1, 2\)"),
    "factor not lower": (FACTOR | {"scale_tril": COVARIANCE}, r"scale_tril must be lower .*\(0, 1\) is 0.2"),
    "factor not finite": (FACTOR | {"scale_tril": COVARIANCE.tril() * torch.nan}, "scale_tril must be finite"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(name):
    changes, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        linear(**changes)


def test_a_covariance_of_another_size_than_the_space_is_refused():
    with pytest.raises(ValueError, match=r"covariance must be 3 x 3 on UnitQuaternion.*got 4"):
        tf.AdditiveGaussian(torch.sin, torch.eye(4), tf.UnitQuaternion())


def test_integers_are_refused():
    with pytest.raises(TypeError, match=r"covariance must be a floating-point tensor, got torch\.int64"):
        linear(covariance=torch.eye(2, dtype=torch.int64))


# Call styles


class Module(torch.nn.Module):
    def forward(self, x, dt):
        return x * dt


STYLES = [
    (lambda x: x, CallStyle(False, False, True)),
    (lambda x, u: x + u, CallStyle(True, False, True)),
    (lambda x, dt: x + dt, CallStyle(False, True, True)),
    (lambda x, dt, u: x + dt + 10 * u, CallStyle(True, True, True)),
    (lambda x, u=None, dt=None: x, CallStyle(True, True, True)),
    (lambda x, force, step: x + force + 10 * step, CallStyle(True, True, False)),
    (lambda x, force: x + force, CallStyle(True, False, False)),
    (lambda x, gain=2.0: x * gain, CallStyle(False, False, False)),
    (lambda *given: sum(given), CallStyle(True, True, False)),
    (lambda x, **options: 2 * x, CallStyle(False, False, False)),
    (Module(), CallStyle(False, True, True)),
    (torch.sin, CallStyle(False, False, False)),
]


@pytest.mark.parametrize(("function", "style"), STYLES)
def test_arguments_by_name_or_by_place(function, style):
    found = call_style(function)
    assert (found.takes_u, found.takes_dt) == (style.takes_u, style.takes_dt)
    if style.takes_u or style.takes_dt:
        assert found.by_name == style.by_name
    x, u, dt = tensor([1.0]), tensor([0.2]), 0.03
    law = tf.AdditiveGaussian(function, tensor([[1.0]]))
    expected = {
        (False, False): lambda: function(x),
        (True, False): lambda: function(x, u),
        (False, True): lambda: function(x, dt=dt),
        (True, True): lambda: function(x, u=u, dt=dt) if style.by_name else function(x, u, dt),
    }[style.takes_u, style.takes_dt]()
    assert torch.equal(law(x, u, dt).mean, expected)


# State of the modules


def test_what_trains_what_is_kept_and_what_moves():
    law = linear(trainable=True)
    assert {name for name, _ in law.named_parameters()} == {"matrix", "offset", "control_matrix", "noise.scale_tril"}
    fixed = linear()
    assert not list(fixed.parameters())
    assert set(fixed.state_dict()) == set(law.state_dict())
    assert fixed.matrix is not A  # the caller's tensor may change later
    single = linear().float()
    assert single(torch.zeros(3), torch.zeros(1)).covariance.dtype == torch.float32
    law.load_state_dict(fixed.state_dict())


def test_gradients_reach_a_covariance_that_the_caller_owns():
    root = torch.linalg.cholesky(COVARIANCE).requires_grad_()
    law = tf.AdditiveGaussian(lambda x: x, root @ root.mT)
    value = law(OFFSET).log_prob(OFFSET + 1)
    (gradient,) = torch.autograd.grad(value, root)
    twin = torch.distributions.MultivariateNormal(OFFSET, root @ root.mT).log_prob(OFFSET + 1)
    (expected,) = torch.autograd.grad(twin, root)
    torch.testing.assert_close(gradient.tril(), expected.tril(), rtol=1e-12, atol=1e-12)


def test_one_number_is_taken_as_it_is_or_refused_under_its_name():
    assert one_number(0.1, "sd_m").dtype == torch.float64
    assert one_number(0.1, "sd_m", dtype=torch.float32).dtype == torch.float32
    kept = torch.nn.Parameter(torch.tensor(2.0))
    assert one_number(kept, "sd_m") is kept and one_number(0.0, "walk", zero=True) == 0
    for wrong in (0.0, -1.0, math.nan, math.inf, torch.ones(1)):
        with pytest.raises(ValueError, match="sd_m must be one positive finite number, got"):
            one_number(wrong, "sd_m")
    for wrong in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="walk must be one finite number >= 0, got"):
            one_number(wrong, "walk", zero=True)


def test_steps_of_rows_keep_the_precision_of_the_law():
    like = torch.zeros(1, dtype=torch.float64)
    assert row_steps(0.1, like) == 0.1 and row_steps(torch.tensor(0.5), like).dtype == torch.float64
    rows = row_steps(torch.tensor([[0.1], [0.2]], dtype=torch.float64), like.float())
    assert rows.shape == (2,) and rows.dtype == torch.float32
