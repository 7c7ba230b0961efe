"""The driver: streams, resumption, time steps and controls in all their forms, refusals."""

import itertools
import math

import pytest
import torch
from filters.gaussian_problem import RULES, model, problem, tensor

import torchfilt as tf

ROWS = 3


def nonlinear():
    """Takes u and dt, by name and in the other order."""
    eye = torch.eye(2, dtype=torch.float64)
    return tf.StateSpaceModel(
        tf.Gaussian(tensor([0.3, -0.2]), 0.5 * eye),
        tf.AdditiveGaussian(lambda x, dt, u: x + dt * torch.sin(x) + u, 0.1 * eye),
        tf.AdditiveGaussian(lambda x: x**2 + x, 0.2 * eye),
    )


def data(steps=8, hidden=True):
    p = problem(20, d=2, m=2, steps=steps, rows=ROWS)
    if hidden:
        p.ys[2, 1, 0] = p.ys[4, :, 1] = p.ys[5] = math.nan
    return tensor(p.ys), tensor(p.us), tensor(p.dts)


def same(a, b):
    """Bit for bit, NaN equal to NaN, None to None."""
    if not isinstance(a, torch.Tensor):
        return a == b
    return torch.equal(torch.nan_to_num(a), torch.nan_to_num(b)) and torch.equal(a.isnan(), b.isnan())


def same_history(a, b):
    assert same(a.mean, b.mean)
    assert same(a.covariance, b.covariance)
    for name, one, two in zip(tf.StepInfo._fields, a.diagnostics, b.diagnostics, strict=True):
        assert same(one, two), name


CASES = [("linear", "taylor"), *[("nonlinear", rule) for rule in RULES]]


def build(form, rule):
    if form == "linear":
        return tf.GaussianFilter(model(problem(20, d=2, m=2), "linear"), RULES[rule])
    return tf.GaussianFilter(nonlinear(), RULES[rule], 2)


@pytest.mark.parametrize("timing", ["number", "by step", "by row"])
@pytest.mark.parametrize(("form", "rule"), CASES)
def test_a_stream_equals_the_series_bit_for_bit(form, rule, timing):
    """One call a measurement: numbers and tensors as dt; a part of the rows, all rows and nothing missing."""
    filter = build(form, rule)
    ys, us, dts = data()
    dt = {"number": 0.7, "by step": dts, "by row": dts[:, None] * tensor([1.0, 0.5, 0.8])}[timing]
    history = filter(ys, us, dt)
    state = filter.init((ROWS,))
    for k, y in enumerate(ys):
        assert state.step == k
        state, info = filter.step(state, y, us[k], dt if timing == "number" else dt[k])
        assert same(state.belief.mean, history.mean[k])
        covariance = state.belief.covariance
        assert same(covariance, history.covariance[k])
        for name in ("log_likelihood", "ok", "nis", "innovation"):
            assert same(getattr(info, name), getattr(history.diagnostics, name)[k]), name
    assert same(state.belief.scale_tril, history.final.belief.scale_tril)
    assert state.step == history.final.step == len(ys)


@pytest.mark.parametrize(("form", "rule"), CASES)
def test_a_series_in_parts_equals_the_whole_bit_for_bit(form, rule):
    filter = build(form, rule)
    ys, us, dts = data()
    whole = filter(ys, us, dts)
    first = filter(ys[:3], us[:3], dts[:3])
    second = filter(ys[3:], us[3:], dts[3:], state=first.final)
    assert second.final.step == len(ys)
    assert same(torch.cat([first.mean, second.mean]), whole.mean)
    assert same(torch.cat([first.covariance, second.covariance]), whole.covariance)
    pieces = torch.cat([first.diagnostics.log_likelihood, second.diagnostics.log_likelihood])
    assert same(pieces, whole.diagnostics.log_likelihood)


def test_a_state_is_a_value():
    """Two branches from one state do not know of each other."""
    filter = build("nonlinear", "unscented")
    ys, us, dts = data()
    state = filter(ys[:3], us[:3], dts[:3]).final
    kept = state.belief.mean.clone(), state.belief.scale_tril.clone()
    one, _ = filter.step(state, ys[3], us[3], 0.5)
    other, _ = filter.step(state, ys[3] + 1, us[3], 0.5)
    again, _ = filter.step(state, ys[3], us[3], 0.5)
    assert same(one.belief.mean, again.belief.mean)
    assert not same(one.belief.mean, other.belief.mean)
    assert same(state.belief.mean, kept[0])
    assert same(state.belief.scale_tril, kept[1])


def test_forms_of_time_steps_and_controls_agree():
    filter = build("nonlinear", "taylor")
    ys, us, dts = data()
    shared = us[:, 0]
    wide = shared.unsqueeze(1).expand(-1, ROWS, -1)
    a = filter(ys, shared, dts)
    for controls, dt in itertools.product((shared, wide), (dts, dts[:, None].expand(-1, ROWS))):
        b = filter(ys, controls, dt)
        torch.testing.assert_close(a.mean, b.mean, rtol=0, atol=1e-13)
        torch.testing.assert_close(a.covariance, b.covariance, rtol=0, atol=1e-13)
    same_history(filter(ys, shared, 0.5), filter(ys, shared, torch.full((len(ys),), 0.5, dtype=torch.float64)))
    graph = filter(ys, shared, dts.clone().requires_grad_())  # keeps its graph: tensors in place of numbers
    torch.testing.assert_close(graph.mean.detach(), a.mean, rtol=0, atol=1e-13)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_any_number_of_batch_dims(batch):
    filter = build("nonlinear", "cubature")
    generator = torch.Generator().manual_seed(0)
    ys = torch.randn(4, *batch, 2, generator=generator, dtype=torch.float64)
    us = torch.randn(4, *batch, 1, generator=generator, dtype=torch.float64)
    history = filter(ys, us, 0.3)
    assert history.mean.shape == (4, *batch, 2)
    assert history.covariance.shape == (4, *batch, 2, 2)
    assert history.log_likelihood.shape == batch
    for name, tail in (("ok", ()), ("nis", ()), ("innovation", (2,)), ("innovation_scale_tril", (2, 2))):
        assert getattr(history.diagnostics, name).shape == (4, *batch, *tail), name
    for index in itertools.product(*map(range, batch)):
        key = (slice(None), *index)
        one = filter(ys[key], us[key], 0.3)
        torch.testing.assert_close(history.mean[key], one.mean, rtol=0, atol=1e-13)
        torch.testing.assert_close(history.log_likelihood[index], one.log_likelihood, rtol=0, atol=1e-12)


def test_dt_of_zero_moves_nothing_for_laws_that_know_dt():
    """A measurement at the prior's own time is a step with dt = 0 where noise vanishes with dt too."""

    class Walk(torch.nn.Module):
        def forward(self, x, u=None, dt=None):
            return tf.Gaussian(x, dt**0.5 * torch.eye(2, dtype=torch.float64))

    eye = torch.eye(2, dtype=torch.float64)
    laws = tf.StateSpaceModel(tf.Gaussian(tensor([1.0, 2.0]), eye), Walk(), tf.AdditiveGaussian(lambda x: x, 0.2 * eye))
    filter = tf.ExtendedKalmanFilter(laws)
    y = tensor([[1.5, 1.0]])
    a, b = filter(y, dt=0.0), filter(y, dt=3.0, predict_first=False)
    torch.testing.assert_close(a.mean, b.mean, rtol=0, atol=1e-15)
    torch.testing.assert_close(a.log_likelihood, b.log_likelihood, rtol=0, atol=1e-14)
    state, _ = filter.step(filter.init(), y[0], dt=3.0, predict_first=False)
    assert same(state.belief.mean, b.mean[0])


def test_progress_changes_nothing(capsys):
    filter = build("linear", "taylor")
    ys, us, dts = data()
    same_history(filter(ys, us, dts), filter(ys, us, dts, progress=True))
    assert capsys.readouterr().out == ""


# Refusals


@pytest.fixture
def filter():
    return build("nonlinear", "unscented")


def bad(tensor, place, value):
    tensor = tensor.clone()
    tensor[place] = value
    return tensor


DTYPE = "must have the model's dtype torch.float64, got torch.float32"
SIZE = "measurement has 1 numbers, the observation law gives 2"

# What is changed and how, the error and its words.
REFUSED = {
    "infinite measurement": (
        "y",
        lambda y: bad(y, (3, 1, 0), math.inf),
        ValueError,
        r"measurements .*\(3, 1, 0\) is inf",
    ),
    "other dtype": ("y", lambda y: y.float(), TypeError, f"measurements {DTYPE}"),
    "integers": ("y", lambda y: torch.nan_to_num(y).long(), TypeError, "dtype torch.float64, got torch.int64"),
    "one dim": ("y", lambda y: y[:, 0, 0], ValueError, r"must be \(t, \*batch, m\) with t >= 1, got \(8,\)"),
    "no steps": ("y", lambda y: y[:0], ValueError, r"t >= 1, got \(0, 3, 2\)"),
    "size of the measurement": ("y", lambda y: y[..., :1], ValueError, SIZE),
    "negative dt": ("dt", lambda t: bad(t, 4, -0.1), ValueError, r"dt must be finite and >= 0, entry \(4,\) is -0.1"),
    "NaN dt": ("dt", lambda t: bad(t, 4, math.nan), ValueError, r"dt must be finite and >= 0, entry \(4,\) is nan"),
    "negative number": ("dt", lambda t: -1.0, ValueError, "dt must be finite and >= 0, got -1.0"),
    "infinite number": ("dt", lambda t: math.inf, ValueError, "dt must be finite and >= 0, got inf"),
    "too few dt": ("dt", lambda t: t[:-1], ValueError, r"dt must be a number, \(8,\) or \(8, 3\), got \(7,\)"),
    "NaN control": ("u", lambda u: bad(u, (2, 0, 0), math.nan), ValueError, r"controls .* finite.*\(2, 0, 0\) is nan"),
    "dt of rows in another dtype": ("dt", lambda t: t[:, None].expand(8, 3).float(), TypeError, f"dt {DTYPE}"),
    "list of dt": ("dt", lambda t: t.tolist(), TypeError, "dt must be a number or a tensor, got list"),
    "array": ("y", lambda y: y.numpy(), TypeError, "measurements must be a tensor, got ndarray"),
    "array of controls": ("u", lambda u: u.numpy(), TypeError, "controls must be a tensor, got ndarray"),
    "too few controls": ("u", lambda u: u[:-1], ValueError, r"controls must be .* t = 8.*got \(7, 3, 1\)"),
    "one dim of controls": ("u", lambda u: u[:, 0, 0], ValueError, r"controls must be .*got \(8,\)"),
    "other batch of controls": ("u", lambda u: u[:, :2], ValueError, r"controls must be shared.*got \(8, 2, 1\)"),
    "other dtype of controls": ("u", lambda u: u.float(), TypeError, f"controls {DTYPE}"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_series_that_are_refused(filter, name):
    key, change, error, message = REFUSED[name]
    given = dict(zip(("y", "u", "dt"), data(), strict=True))
    given[key] = change(given[key])
    with pytest.raises(error, match=message):
        filter(*given.values())


STREAM = {
    "infinite measurement": (
        "y",
        lambda y: bad(y, (1, 0), -math.inf),
        ValueError,
        r"y must be finite.*\(1, 0\) is -inf",
    ),
    "other dtype": ("y", lambda y: y.float(), TypeError, f"y {DTYPE}"),
    "size of the measurement": ("y", lambda y: y[..., :1], ValueError, SIZE),
    "other batch": ("y", lambda y: y[:2], ValueError, r"y must be .*the state's \*batch = \(3,\), got \(2, 2\)"),
    "negative dt": ("dt", lambda t: -0.1, ValueError, "dt must be finite and >= 0, got -0.1"),
    "negative dt of a row": ("dt", lambda t: tensor([1.0, -1.0, 0.0]), ValueError, r"dt must be .*\(1,\) is -1"),
    "dt of another batch": (
        "dt",
        lambda t: tensor([1.0, 1.0]),
        ValueError,
        r"dt must be a number or \(3,\), got \(2,\)",
    ),
    "dt of rows in another dtype": ("dt", lambda t: torch.ones(3), TypeError, f"dt {DTYPE}"),
    "no dims": ("y", lambda y: y[0, 0], ValueError, r"y must be \(\*batch, m\), got a tensor without dims"),
    "list": ("y", lambda y: y.tolist(), TypeError, "y must be a tensor, got list"),
    "NaN dt": ("dt", lambda t: tensor(math.nan), ValueError, "dt must be finite and >= 0.*nan"),
    "NaN control": ("u", lambda u: bad(u, (2, 0), math.nan), ValueError, r"u must be finite, entry \(2, 0\) is nan"),
    "other batch of controls": ("u", lambda u: u[:2], ValueError, r"u must be shared.*got \(2, 1\)"),
    "other dtype of controls": ("u", lambda u: u.float(), TypeError, f"u {DTYPE}"),
}


@pytest.mark.parametrize("name", STREAM)
def test_steps_that_are_refused(filter, name):
    """A stream is checked as a series is."""
    key, change, error, message = STREAM[name]
    ys, us, _ = data()
    given = {"y": ys[0], "u": us[0], "dt": 0.5}
    given[key] = change(given[key])
    with pytest.raises(error, match=message):
        filter.step(filter.init((ROWS,)), *given.values())


def test_measurements_for_another_batch_than_the_state_or_the_prior_are_refused(filter):
    ys, us, _ = data()
    state = filter(ys, us, 0.5).final
    with pytest.raises(ValueError, match=r"measurements must be .*\(3,\).*got \(8, 2, 2\)"):
        filter(ys[:, :2], us[:, :2], 0.5, state=state)
    eye = torch.eye(2, dtype=torch.float64)
    rows = tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(3, 2, dtype=torch.float64), eye), *list(nonlinear().children())[1:]
    )
    with pytest.raises(ValueError, match=r"prior.*\(3,\).*\(2,\)"):
        tf.UnscentedKalmanFilter(rows)(ys[:, :2], us[:, :2], 0.5)


def test_a_state_of_another_kind_of_filter_is_refused(filter):
    ys, us, _ = data()
    cloud = tf.BootstrapFilter(nonlinear(), 10)
    with pytest.raises(TypeError, match="state must hold the Gaussian of this filter, got Particles"):
        filter(ys, us, 0.5, state=cloud.init((ROWS,)))
    with pytest.raises(TypeError, match="state must hold the Particles of this filter, got Gaussian"):
        cloud.step(filter.init((ROWS,)), ys[0], us[0], 0.5)
    with pytest.raises(TypeError, match=r"state must be a FilterState.*got Gaussian"):
        filter.step(filter.init((ROWS,)).belief, ys[0], us[0], 0.5)


def test_a_time_step_may_be_a_tensor_without_dims():
    """The same as the number, in a series and in a stream, and its derivative is that of the difference quotient."""
    filter = build("nonlinear", "unscented")
    ys, us, _ = data()
    same_history(filter(ys, us, tensor(0.5)), filter(ys, us, 0.5))
    dt = tensor(0.5).requires_grad_()
    (gradient,) = torch.autograd.grad(filter(ys, us, dt).log_likelihood.sum(), dt)
    above, below = (filter(ys, us, 0.5 + sign * 1e-5).log_likelihood.sum() for sign in (1, -1))
    # Truncation of order 1e-10, rounding 1e-15 |value| / 1e-5.
    torch.testing.assert_close(gradient, (above - below) / 2e-5, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_of_a_tensor_have_the_bits_of_the_series(dtype):
    """Noise that grows with the root of the step: rounded in the model's precision or in Python's, one way only."""
    walk = tf.AdditiveGaussian(lambda x, dt: x * (1 + dt**0.5 / 3), 0.1 * torch.eye(1, dtype=dtype))
    sensor = tf.LinearGaussian(torch.eye(1, dtype=dtype), torch.eye(1, dtype=dtype))
    prior = tf.Gaussian(torch.ones(1, dtype=dtype), torch.eye(1, dtype=dtype))
    tracker = tf.UnscentedKalmanFilter(tf.StateSpaceModel(prior, walk, sensor))
    generator = torch.Generator().manual_seed(3)
    dt, y = (torch.rand(40, *shape, generator=generator, dtype=dtype) for shape in ((), (1,)))
    state = tracker.init()
    for k in range(40):
        state, _ = tracker.step(state, y[k], dt=dt[k])
    assert torch.equal(state.belief.mean, tracker(y, dt=dt).mean[-1])


def test_a_filter_needs_a_model():
    with pytest.raises(TypeError, match="model must be a StateSpaceModel, got Linear"):
        tf.GaussianFilter(torch.nn.Linear(1, 1), RULES["taylor"])


# Rows that fail


class Root(torch.nn.Module):
    """Square root of the first component: NaN below zero."""

    def forward(self, x, u=None, dt=None):
        return tf.Gaussian(x[..., :1].sqrt(), 0.1 * torch.eye(1, dtype=torch.float64))


def failing():
    eye = torch.eye(2, dtype=torch.float64)
    return tf.StateSpaceModel(
        tf.Gaussian(tensor([4.0, 0.0]), 0.1 * eye), tf.AdditiveGaussian(lambda x, u: x + u, 0.01 * eye), Root()
    )


@pytest.mark.parametrize("rule", RULES)
def test_a_sick_row_is_named_and_leaves_the_others_alone(rule):
    """Row 1 is pushed below zero at step 3: its measurement law is NaN there, its status is False from then on."""
    filter = tf.GaussianFilter(failing(), RULES[rule])
    ys = 2 + 0.1 * torch.randn(6, ROWS, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    calm = torch.zeros(6, ROWS, 2, dtype=torch.float64)
    push = bad(calm, (3, 1, 0), -30.0)
    healthy = filter(ys, calm)
    with pytest.raises(tf.FilterError) as caught:
        filter(ys, push)
    message = str(caught.value)
    for part in ("step 3", "rows [(1,)]", "finite", "positive definite", f"{ys[3, 1].item()}", "throw=False"):
        assert part in message, (part, message)
    history = filter(ys, push, throw=False)
    ok = history.diagnostics.ok
    assert ok[:, [0, 2]].all()
    assert torch.equal(ok[:, 1], torch.arange(6) < 3)
    for row in (0, 2):
        assert same(history.mean[:, row], healthy.mean[:, row])
        assert same(history.covariance[:, row], healthy.covariance[:, row])
        assert same(history.diagnostics.log_likelihood[:, row], healthy.diagnostics.log_likelihood[:, row])
    assert same(history.mean[:3, 1], healthy.mean[:3, 1])
    assert history.mean[3:, 1].isnan().any(-1).all()
    # The stream says the same.
    state = filter(ys[:3], calm[:3]).final
    with pytest.raises(tf.FilterError, match=r"step 3, rows \[\(1,\)\]"):
        filter.step(state, ys[3], push[3])
    _, info = filter.step(state, ys[3], push[3], throw=False)
    assert info.ok.tolist() == [True, False, True]


def test_a_single_series_that_fails():
    filter = tf.ExtendedKalmanFilter(failing())
    push = torch.zeros(4, 2, dtype=torch.float64)
    push[2, 0] = -30.0
    with pytest.raises(tf.FilterError, match=r"step 2, the only row: .*it was \[2.0\]"):
        filter(torch.full((4, 1), 2.0, dtype=torch.float64), push)
    assert filter(torch.full((4, 1), 2.0, dtype=torch.float64), push, throw=False).diagnostics.ok.tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_the_step_of_a_failure_counts_from_the_start_of_the_stream():
    filter = tf.ExtendedKalmanFilter(failing())
    ys, push = torch.full((2, 1), 2.0, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)
    state = filter(ys, push).final
    with pytest.raises(tf.FilterError, match="step 2, the only row"):
        filter(ys, push - 30.0, state=state)


def test_many_failed_rows_are_counted():
    filter = tf.ExtendedKalmanFilter(failing())
    with pytest.raises(tf.FilterError, match="and 3 more"):
        filter(torch.full((1, 4, 2, 1), 2.0, dtype=torch.float64), torch.full((1, 2), -30.0, dtype=torch.float64))
