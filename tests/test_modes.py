"""Navigation modes against the same filters run by hand on what each mode listens to."""

import re

import numpy as np
import pytest
import torch

import torchfilt as tf
from torchfilt.modes import Mode, NavigationModes, Situation, Switch, Switched, switches
from torchfilt.types import Moded

DOUBLE, DT = torch.float64, 0.5


def eye(n, scale=1.0):
    return scale * torch.eye(n, dtype=DOUBLE)


def make_model(curved=False):
    """Position and velocity; one sensor for each, and for the distance where it is curved."""
    motion = tf.LinearGaussian(torch.tensor([[1.0, DT], [0.0, 1.0]], dtype=DOUBLE), eye(2, 0.01))
    far = tf.LinearGaussian(torch.tensor([[1.0, 0.0]], dtype=DOUBLE), eye(1, 0.04))
    if curved:
        far = tf.AdditiveGaussian(lambda x: (x[..., :1].square() + 1).sqrt(), eye(1, 0.04))
        far.size = 1
    speed = tf.LinearGaussian(torch.tensor([[0.0, 1.0]], dtype=DOUBLE), eye(1, 0.25))
    prior = tf.Gaussian(torch.tensor([1.0, 0.5], dtype=DOUBLE), eye(2))
    return tf.StateSpaceModel(prior, motion, tf.Sensors(far=far, speed=speed))


def series(steps=12, batch=(3,), seed=0):
    rng = np.random.default_rng(seed)
    return torch.tensor(1 + 0.3 * rng.standard_normal((steps, *batch, 2)))


def since(seconds):
    return lambda now: now.since_s >= seconds - 1e-9


def silent(name):
    return lambda now: ~now.measured[name]


def make_modes(model, filters=None, ways=None):
    ekf = tf.GaussianFilter(model, tf.moments.taylor())
    near, away = filters or (ekf, ekf)
    ways = ways or (
        Switch("near", "away", "far was silent", silent("far")),
        Switch("near", "away", "two seconds are over", since(2.0)),
        Switch("away", "near", "one second is over", since(1.0)),
    )
    return NavigationModes([Mode("near", near, ("far",)), Mode("away", away, ("speed",))], ways)


def same(one, other):
    torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_one_mode_that_hears_all_is_its_filter():
    model, ys = make_model(), series()
    filter = tf.GaussianFilter(model, tf.moments.taylor(), gate=0.9)
    alone = filter(ys, dt=DT)
    moded = NavigationModes([Mode("only", filter)])(ys, dt=DT)
    same(moded.mean, alone.mean)
    torch.testing.assert_close(moded.log_likelihood, alone.log_likelihood, rtol=1e-14, atol=0)
    same(moded.diagnostics.accepted, alone.diagnostics.accepted)
    assert moded.evidence == "approximate" and (moded.diagnostics.mode == 0).all()
    assert (moded.diagnostics.switch == -1).all()


def by_hand(model, ys, rules):
    """Each row by itself in plain Python: ``rules(mode, seconds, y) -> number of the switch or None``."""
    targets = (1, 1, 0)
    heard, log = ys.clone(), []
    for row in range(ys.shape[1]):
        mode, seconds = 0, 0.0
        for k in range(len(ys)):
            seconds += DT
            heard[k, row, 1 - mode] = torch.nan
            way = rules(mode, seconds, ys[k, row])
            if way is not None:
                log.append((k, row, way))
                mode, seconds = targets[way], 0.0
    return heard, sorted(log)


def rules(mode, seconds, y):
    if mode == 0:
        return 0 if bool(torch.isnan(y[0])) else 1 if seconds >= 2.0 else None
    return 2 if seconds >= 1.0 else None


def test_rows_go_separate_ways_and_hear_what_their_mode_hears():
    model, ys = make_model(), series()
    ys[1, 0, 0] = ys[6, 2, 0] = torch.nan
    ekf = tf.GaussianFilter(model, tf.moments.taylor())
    heard, log = by_hand(model, ys, rules)
    filter = make_modes(model)
    history, expected = filter(ys, dt=DT), ekf(heard, dt=DT)
    torch.testing.assert_close(history.mean, expected.mean, rtol=0, atol=1e-13)
    torch.testing.assert_close(history.covariance, expected.covariance, rtol=0, atol=1e-13)
    torch.testing.assert_close(history.log_likelihood, expected.log_likelihood, rtol=1e-12, atol=0)
    found = list(switches(history, filter))
    reasons = ("far was silent", "two seconds are over", "one second is over")
    ends = (("near", "away"), ("near", "away"), ("away", "near"))
    assert found == [Switched(k, (row,), *ends[way], reasons[way]) for k, row, way in log]
    assert {entry.reason for entry in found} == set(reasons)
    # The mode that is told took the step in: it changes one step after its switch.
    assert history.diagnostics.mode[:3, 0].tolist() == [0, 0, 1] and history.diagnostics.switch[1, 0] == 0


def test_of_two_conditions_that_hold_the_first_is_taken():
    ways = Switch("near", "away", "first", since(1.0)), Switch("near", "near", "second", since(1.0))
    for order, target in ((ways, 1), (ways[::-1], 0)):
        modes = make_modes(make_model(), ways=order)
        history = modes(series(2), dt=DT)
        assert [now.reason for now in switches(history, modes)] == [order[0].reason] * 3
        assert history.final.belief.mode.tolist() == [target] * 3


def test_each_mode_has_its_filter():
    """A linearisation in one mode, sigma points in the other: as the two filters called in turn, row by row."""
    model, ys = make_model(curved=True), series()
    ys[1, 0, 0] = torch.nan
    filters = tf.GaussianFilter(model, tf.moments.taylor(), 3), tf.UnscentedKalmanFilter(model, alpha=0.5)
    both = NavigationModes(
        [Mode("near", filters[0]), Mode("away", filters[1])],
        [
            Switch("near", "away", "silent", silent("far")),
            Switch("near", "away", "late", since(2.0)),
            Switch("away", "near", "back", since(1.0)),
        ],
    )
    found = both(ys, dt=DT)
    apart = [[], []]
    for row in range(3):
        mode, seconds, state = 0, 0.0, filters[0].init()
        for k in range(len(ys)):
            seconds += DT
            state, info = filters[mode].step(state, ys[k, row], dt=DT)
            torch.testing.assert_close(found.mean[k, row], state.belief.mean, rtol=0, atol=1e-13)
            torch.testing.assert_close(found.covariance[k, row], state.belief.covariance, rtol=0, atol=1e-13)
            apart[mode].append(info.nis)
            torch.testing.assert_close(found.diagnostics.nis[k, row], info.nis, rtol=1e-10, atol=0)
            way = rules(mode, seconds, ys[k, row])
            if way is not None:
                mode, seconds = (1, 1, 0)[way], 0.0
    assert apart[0] and apart[1]


def test_a_stream_a_resumed_run_and_a_saved_one_are_the_whole(tmp_path):
    filter, ys = make_modes(make_model()), series()
    whole = filter(ys, dt=DT, record="beliefs")
    state = filter.init((3,))
    for k in range(7):
        state, info = filter.step(state, ys[k], dt=DT)
        same(info.mode, whole.diagnostics.mode[k])
    first = filter(ys[:7], dt=DT)
    first.save(tmp_path / "half.npz")
    again = tf.History.load(tmp_path / "half.npz")
    for final in (state, first.final, again.final):
        same(final.belief.mode, state.belief.mode)
        rest = filter(ys[7:], dt=DT, state=final)
        same(rest.mean, whole.mean[7:])
        same(rest.diagnostics.switch, whole.diagnostics.switch[7:])
    assert (whole.diagnostics.switch >= 0).sum() > 3
    data = whole.to_numpy()
    assert data["mode"].shape == data["switch"].shape == (12, 3)


def test_a_late_measurement_decides_as_if_it_had_come_in_time():
    """Not only the belief: the mode too is what it would have been."""
    filter, ys = make_modes(make_model()), series(8, ())
    ys[3, 0] = torch.nan
    expected = filter(ys, dt=DT)
    stream = tf.DelayedMeasurements(filter, horizon_s=3.0)
    state = stream.init()
    for k in range(len(ys)):
        y = torch.where(torch.tensor([k == 1, False]), torch.nan, ys[k])  # far is silent at step 1, it seems
        state, _ = stream.step(state, y, dt=DT)
        if k == 1:
            assert state.belief.mode == 1
        if k == 2:
            late = torch.tensor([float(ys[1, 0]), torch.nan], dtype=DOUBLE)
            state, _ = stream.late(state, late, 2 * DT)
    same(state.belief.mean, expected.mean[-1])
    same(state.belief.mode, expected.final.belief.mode)
    same(state.belief.since_s, expected.final.belief.since_s)


def test_particles_under_one_filter():
    model, ys = make_model(), series(batch=(2,))
    filter = tf.BootstrapFilter(model, 50)
    modes = make_modes(model, (filter, filter))
    heard, _ = by_hand(model, ys, rules)
    found, expected = modes(ys, dt=DT, seed=3), filter(heard, dt=DT, seed=3)
    same(found.mean, expected.mean)
    assert (found.diagnostics.switch >= 0).any()


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_compiled_and_single_precision(dtype):
    model = make_model(curved=True).to(dtype)
    filters = tf.GaussianFilter(model, tf.moments.taylor()), tf.UnscentedKalmanFilter(model)
    modes, ys = make_modes(model, filters), series(5).to(dtype)
    step = torch.compile(modes.advance, fullgraph=True, backend="eager")
    belief = modes.init((3,)).belief
    history = modes(ys, dt=DT)
    for k in range(len(ys)):
        belief, info = step(belief, ys[k], None, DT)
        assert info.nis.dtype == belief.belief.mean.dtype == belief.since_s.dtype == dtype
    torch.testing.assert_close(belief.mean, history.mean[-1], rtol=0, atol=20 * torch.finfo(dtype).eps)
    _, info = step(modes.init().belief, ys[0, 0], None, DT)  # no batch: the answers of both filters are numbers
    torch.testing.assert_close(info.nis, history.diagnostics.nis[0, 0], rtol=0, atol=20 * torch.finfo(dtype).eps)


def test_rows_may_be_mapped():
    model = make_model(curved=True)
    modes = make_modes(model, (tf.GaussianFilter(model, tf.moments.taylor()), tf.UnscentedKalmanFilter(model)))
    belief, ys = modes.init((3,)).belief, series(1)[0]
    mode = torch.tensor([0, 1, 0])

    def after(mean, factor, mode, since_s, y):
        found, _ = modes.advance(Moded(tf.Gaussian(mean, factor), mode, since_s), y, None, DT)
        return found.belief.mean, found.belief.scale_tril, found.mode, found.since_s

    given = belief.belief.mean, belief.belief.scale_tril, mode, belief.since_s, ys
    for mapped, plain in zip(torch.func.vmap(after)(*given), after(*given), strict=True):
        torch.testing.assert_close(mapped, plain, rtol=1e-12, atol=1e-14)


def test_no_time_goes_by_where_the_first_measurement_is_of_the_priors_own():
    modes = make_modes(make_model(), ways=(Switch("near", "away", "by its clock", since(1.0)),))
    history = modes(series(3), dt=DT, predict_first=False)
    assert [now.step for now in switches(history, modes)] == [2] * 3  # a second is over with the third measurement
    same(modes(series(3)[:2], dt=DT, predict_first=False).final.belief.since_s, torch.full((3,), DT, dtype=DOUBLE))


def test_named_measurements_time_steps_of_rows_and_controls():
    model = make_model()
    seen = []

    def when(now):
        seen.append(now)
        return now.since_s > 0.9

    modes = make_modes(model, ways=(Switch("near", "away", "by its clock", when),))
    state = modes.init((2,))
    y = {"far": torch.tensor([[1.0], [torch.nan]], dtype=DOUBLE)}
    state, info = modes.step(state, y, dt=torch.tensor([0.5, 1.0], dtype=DOUBLE))
    assert info.switch.tolist() == [-1, 0] and state.belief.mode.tolist() == [0, 1]
    assert state.belief.since_s.tolist() == [0.5, 0.0]
    (now,) = seen
    assert isinstance(now, Situation) and now.measured["far"].tolist() == [True, False] and now.u is None
    assert not now.measured["speed"].any() and now.y.shape == (2, 2)
    same(now.belief.mean, state.belief.mean)
    same(now.info.ok, info.ok)


def test_refusals():
    model = make_model()
    ekf = tf.GaussianFilter(model, tf.moments.taylor())
    mode = Mode("near", ekf)
    way = Switch("near", "near", "again", since(1.0))
    cases = [
        (ValueError, "at least one Mode", lambda: NavigationModes([])),
        (TypeError, "Mode(name, filter, sensors)", lambda: NavigationModes([ekf])),
        (TypeError, "Mode(name, filter, sensors)", lambda: NavigationModes([Mode("near", model)])),
        (TypeError, "Switch(source, target", lambda: NavigationModes([mode], ["near"])),
        (TypeError, "Switch(source, target", lambda: NavigationModes([mode], [Switch("near", "near", "", None)])),
        (ValueError, "names of modes must differ, got near, near", lambda: NavigationModes([mode, mode])),
        (ValueError, "far, speed, got 'sonar'", lambda: NavigationModes([Mode("near", ekf, ("sonar",))])),
        (
            ValueError,
            "between modes near, got 'home'",
            lambda: NavigationModes([mode], [Switch("near", "home", "", since(1))]),
        ),
        (ValueError, "needs its dt", lambda: NavigationModes([mode])(series())),
        (
            ValueError,
            "'near' to 'near' must give bool (3,), got torch.float64 (3,)",
            lambda: NavigationModes([mode], [Switch("near", "near", "", lambda now: now.since_s)])(series(), dt=DT),
        ),
        (
            ValueError,
            "must give bool (3,), got bool",
            lambda: NavigationModes([mode], [Switch("near", "near", "", lambda now: True)])(series(), dt=DT),
        ),
    ]
    plain = tf.StateSpaceModel(model.initial, model.transition, model.observation.law("far"))
    cases += [
        (
            TypeError,
            "modes select Sensors, the measurement law is a LinearGaussian",
            lambda: NavigationModes([Mode("near", tf.KalmanFilter(plain))]),
        ),
        (
            TypeError,
            "carry a Gaussian or Particles, got Moded",
            lambda: NavigationModes([Mode("near", NavigationModes([mode], [way]))]),
        ),
        (
            TypeError,
            "GaussianFilter each, got GaussianFilter and ParticleFilter",
            lambda: NavigationModes([mode, Mode("far", tf.BootstrapFilter(model, 5))]),
        ),
        (
            ValueError,
            "the same model",
            lambda: NavigationModes([mode, Mode("far", tf.UnscentedKalmanFilter(make_model()))]),
        ),
        (
            ValueError,
            "have a gate or none",
            lambda: NavigationModes([mode, Mode("far", tf.UnscentedKalmanFilter(model, gate=0.9))]),
        ),
        (ValueError, "ran without modes", lambda: list(switches(ekf(series(), dt=DT), NavigationModes([mode])))),
    ]
    for error, message, call in cases:
        with pytest.raises(error, match=re.escape(message)):
            call()
