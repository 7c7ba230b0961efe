"""Acquiring again: a filter that has locked on something else starts over, and nothing but refusals makes it."""

import pytest
import torch

import torchfilt as tf
from torchfilt.history import History
from torchfilt.moments import taylor
from torchfilt.robust import decisions

F64 = torch.float64
EYE = torch.eye(1, dtype=F64)
DT = 0.1


def model():
    """A slow walk from a wide prior, seen by a fine and a coarse sensor."""
    sensors = tf.Sensors(coarse=tf.LinearGaussian(EYE, 25 * EYE), fine=tf.LinearGaussian(EYE, 0.01 * EYE))
    prior = tf.Gaussian(torch.zeros(1, dtype=F64), 10 * EYE)
    return tf.StateSpaceModel(prior, tf.LinearGaussian(EYE, 1e-4 * EYE), sensors)


GATE = tf.Gate(0.999, {"fine": -6.0}, ("fine",))
INNER = {
    "gaussian": lambda: tf.GaussianFilter(model(), taylor(), gate=GATE),
    "bank": lambda: tf.LocallyLinearizedParticleFilter(model(), 20, gate=GATE),
}
inner = pytest.mark.parametrize("make", INNER.values(), ids=INNER)


def series():
    """Truth 8; the fine sensor shows -7 for ten steps, is silent for ten, then right. The other row is right always."""
    generator = torch.Generator().manual_seed(0)
    ys = 8 + torch.randn(60, 2, 2, generator=generator, dtype=F64) * torch.tensor([5.0, 0.1], dtype=F64)
    ys[:10, 0, 1] -= 15
    ys[10:20, :, 1] = torch.nan
    return ys


@inner
def test_it_starts_over_and_recovers(make):
    ys = series()
    stuck = make()(ys, dt=DT)
    history = tf.Reacquire(make(), "fine", patience_s=0.5)(ys, dt=DT)
    assert abs(stuck.mean[-1, 0, 0] - 8) > 5
    # Forty fixes with a deviation of 0.1, the fourth of five is off by 5 deviations once in a million.
    assert (history.mean[-1, :, 0] - 8).abs().max() < 0.1
    again = history.diagnostics.restarted.nonzero().tolist()
    assert again == [[24, 0]]  # refused from step 20 on: the fifth makes half a second; silence does not count
    log = list(decisions(history, ("coarse", "fine")))
    assert [(d.step, d.row) for d in log if d.restarted] == [(24, (0,))]


def test_at_the_time_of_the_prior_no_time_has_gone_by():
    ys = torch.tensor([[0.0, 50.0]] * 6, dtype=F64).unsqueeze(1)
    starts = [
        tf.Reacquire(INNER["gaussian"](), "fine", 0.5)(ys, dt=DT, predict_first=first).diagnostics.restarted[:, 0]
        for first in (True, False)
    ]
    assert [int(found.int().argmax()) for found in starts] == [4, 5]


@inner
def test_rows_do_not_know_of_each_other(make):
    ys = series()
    both, alone = (tf.Reacquire(make(), "fine")(part, dt=DT) for part in (ys, ys[:, 1:]))
    calm = tf.Reacquire(make(), "fine")(ys.flip(1)[:, :1], dt=DT)
    assert not bool(alone.diagnostics.restarted.any()) and not bool(both.diagnostics.restarted[:, 1].any())
    if isinstance(make(), tf.GaussianFilter):
        torch.testing.assert_close(both.mean[:, 1], calm.mean[:, 0], rtol=0, atol=1e-13)


@inner
def test_stream_save_and_resume(make, tmp_path):
    """The same bits in a stream, and after the first half was written and read again."""
    ys = series()
    tracker = tf.Reacquire(make(), "fine", patience_s=0.5)
    whole = tracker(ys, dt=DT)
    state = tracker.init((2,))
    for k, y in enumerate(ys):
        state, _ = tracker.step(state, y, dt=DT)
        assert torch.equal(state.belief.mean, whole.mean[k])
    tracker(ys[:22], dt=DT).save(tmp_path / "half.npz")
    half = History.load(tmp_path / "half.npz").final
    assert torch.equal(half.belief.refused_s, torch.tensor([0.2, 0.0], dtype=F64))
    rest = tracker(ys[22:], dt=DT, state=half)
    assert torch.equal(rest.mean, whole.mean[22:])


def test_before_the_sensor_speaks_nothing_is_lost():
    """The belief beside it is that of a filter without the sensor."""
    ys = series()
    final = tf.Reacquire(INNER["gaussian"](), "fine")(ys, dt=DT).final.belief
    blind = ys.clone()
    blind[..., 1] = torch.nan
    plain = tf.GaussianFilter(model(), taylor())(blind, dt=DT)
    torch.testing.assert_close(final.fallback.mean, plain.mean[-1], rtol=0, atol=1e-13)


@inner
@pytest.mark.slow
def test_it_compiles_whole(make):
    ys = series()
    tracker = tf.Reacquire(make(), "fine", patience_s=0.5)
    step = torch.compile(tracker.advance, fullgraph=True)
    state = tracker.init((2,))
    belief = other = state.belief
    for k in range(30):
        noise = tracker.draw(belief, k, 0)
        belief, _ = tracker.advance(belief, ys[k], None, DT, noise)
        other, _ = step(other, ys[k], None, DT, noise)
        torch.testing.assert_close(other.mean, belief.mean, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: tf.Reacquire(model(), "fine"), TypeError, "must be a GaussianFilter or a ParticleFilter"),
        (lambda: tf.Reacquire(tf.GaussianFilter(model(), taylor()), "fine"), ValueError, "give it gate="),
        (lambda: tf.Reacquire(INNER["gaussian"](), "coarse"), ValueError, "that the gate tests, got 'coarse'"),
        (
            lambda: tf.Reacquire(INNER["gaussian"](), "other"),
            ValueError,
            "one of coarse, fine that the gate tests, got 'other'",
        ),
        (lambda: tf.Reacquire(INNER["gaussian"](), "fine", 0.0), ValueError, "patience_s must be positive"),
        (lambda: tf.Reacquire(INNER["gaussian"](), "fine", rule="taylor"), TypeError, "rule must be a moment rule"),
        (lambda: tf.Reacquire(INNER["gaussian"](), "fine")(series()), ValueError, "the step needs its dt"),
    ],
)
def test_what_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()
