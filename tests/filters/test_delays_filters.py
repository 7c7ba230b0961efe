"""Late measurements in every kind of filter: the same bits as a filter that got each of them at its time."""

import math

import numpy as np
import pytest
import torch

import torchfilt as tf
from torchfilt.delays import DelayedMeasurements, held, proportional
from torchfilt.models.attitude.kinematics import ATTITUDE_SPACE, GyroTransition, VectorMeasurement
from torchfilt.models.landing import Barometer, Beacon, LandingTransition, landing_prior
from torchfilt.moments import taylor

F64 = torch.float64
ROWS = 2
GATE = tf.Gate(0.99, {"fine": -6.0}, ("fine",))


class Walk(torch.nn.Module):
    """Two numbers that wander, faster with dt; one is bent by the other, so that the law is not linear."""

    def __init__(self, spread=1.0, bend=0.3):
        super().__init__()
        self.spread, self.bend = spread, bend

    def forward(self, x, u=None, dt=None):
        mean = torch.stack([x[..., 0] + dt * x[..., 1], x[..., 1] - dt * self.bend * x[..., 0].sin()], -1)
        if u is not None:
            mean = mean + dt * u
        return tf.Gaussian(mean, self.spread * dt**0.5 * torch.ones(2, dtype=x.dtype), is_diagonal=True)


class Straight(torch.nn.Module):
    """The same without the bend, linear and saying so."""

    def linear_form(self, u=None, dt=None):
        matrix = torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=F64)
        return tf.laws.LinearForm(matrix, None if u is None else dt * u, dt**0.5 * torch.eye(2, dtype=F64))

    def forward(self, x, u=None, dt=None):
        matrix, offset, factor = self.linear_form(u, dt)
        mean = x @ matrix.mT
        return tf.Gaussian(mean if offset is None else mean + offset, factor)

    takes_controls = True


def plane(motion=None):
    eye = torch.eye(2, dtype=F64)
    sensors = tf.Sensors(coarse=tf.LinearGaussian(eye[:1], 4 * eye[:1, :1]), fine=tf.LinearGaussian(eye, 0.04 * eye))
    return tf.StateSpaceModel(
        tf.Gaussian(torch.zeros(2, dtype=F64), eye), Walk() if motion is None else motion, sensors
    )


def attitude():
    prior = tf.Gaussian(
        torch.tensor([0, 0, 0, 1.0, 0, 0, 0], dtype=F64),
        torch.tensor([0.4, 0.4, 0.8, 0.02, 0.02, 0.02], dtype=F64),
        ATTITUDE_SPACE,
        is_diagonal=True,
    )
    sensors = tf.Sensors(
        coarse=VectorMeasurement(torch.tensor([0.0, 0.0, 9.8], dtype=F64), 0.5),
        fine=VectorMeasurement(torch.tensor([0.0, 20.0, -40.0], dtype=F64), 1.0),
    )
    return tf.StateSpaceModel(prior, GyroTransition(0.02, 0.001), sensors)


def landing():
    return tf.StateSpaceModel(
        landing_prior(), LandingTransition(0.001, 0.01, 1e-4), tf.Sensors(coarse=Barometer(0.3), fine=Beacon(0.02))
    )


RATES = torch.tensor([[-0.5, 0.5], [0.8, -0.8]], dtype=F64)
FILTERS = {
    "kalman": lambda: tf.KalmanFilter(plane(Straight())),
    "iterated": lambda: tf.ExtendedKalmanFilter(plane(), iterations=2),
    "unscented on an attitude": lambda: tf.UnscentedKalmanFilter(attitude()),
    "error state, landing": lambda: tf.ErrorStateKalmanFilter(landing()),
    "gated": lambda: tf.GaussianFilter(plane(), taylor(), gate=GATE),
    "bootstrap": lambda: tf.BootstrapFilter(plane(), 30),
    "auxiliary": lambda: tf.AuxiliaryParticleFilter(plane(), 30),
    "bootstrap on an attitude": lambda: tf.BootstrapFilter(attitude(), 30),
    "as many as needed": lambda: tf.BootstrapFilter(plane(), 60, tf.resampling.kld_adaptive([0.5, 0.5])),
    "regularized": lambda: tf.RegularizedParticleFilter(plane(), 30),
    "trajectories moved": lambda: tf.ResampleMoveParticleFilter(plane(), 30, window=3),
    "unscented particles": lambda: tf.UnscentedParticleFilter(plane(), 30),
    "locally linearized": lambda: tf.LocallyLinearizedParticleFilter(plane(), 30),
    "locally linearized on an attitude": lambda: tf.LocallyLinearizedParticleFilter(attitude(), 20),
    "rao-blackwellized": lambda: tf.RaoBlackwellizedParticleFilter(plane(), 30, drawn=slice(0, 1)),
    "gaussian sum": lambda: tf.GaussianSumFilter(plane()),
    "modes": lambda: tf.InteractingMultipleModel([plane(Walk(0.2)), plane(Walk(2.0))], rates_per_s=RATES),
    "reacquire": lambda: tf.Reacquire(tf.GaussianFilter(plane(), taylor(), gate=GATE), "fine", 0.15),
    "reacquire particles": lambda: tf.Reacquire(
        tf.LocallyLinearizedParticleFilter(plane(), 20, gate=GATE), "fine", 0.15
    ),
}
GRID = [k / 16 for k in range(1, 13)]  # exact in binary, so that the reference may divide time as it likes


def spread(filter):
    """How a control is shared; increments for the landing, rates for the others."""
    return proportional if isinstance(filter.model.transition, LandingTransition) else held


def schedule(filter, rng):
    """Controls by step, and measurements (measured at, arrives at, sensor, value), on the grid, between and at 0."""
    law = filter.model.observation
    sizes = dict(zip(law.names, law.sizes, strict=True))
    means = law(filter.init((ROWS,)).belief.mean).mean
    places = dict(zip(law.names, law.columns, strict=True))
    events = []
    for sensor in law.names:
        times = [0.0, *rng.choice(GRID, 4, replace=False), *rng.choice(np.arange(1, 96, 2), 3, replace=False) / 128]
        for time in times:
            value = means[..., places[sensor]].numpy() + rng.normal(size=(ROWS, sizes[sensor]))
            if rng.uniform() < 0.3:
                value[rng.integers(ROWS)] = math.nan  # one row only
            late = rng.choice([0.0, 0.1, 0.3])
            arrival = next((t for t in GRID if t >= time + late), GRID[-1])
            events.append((float(time), arrival, sensor, torch.as_tensor(value)))
    control = {2: 2, 7: 3, 16: 6}[filter.init().belief.mean.shape[-1]]
    controls = torch.as_tensor(0.3 * rng.normal(size=(len(GRID), control)))
    return controls, events


def streamed(filter, controls, events, order=1):
    """Handed over as they arrive; what arrives together in the order of the list or backward."""
    wrapper = DelayedMeasurements(filter, 1.0, split=spread(filter))
    state = wrapper.init((ROWS,), seed=3)
    for time, u in zip(GRID, controls, strict=True):
        arrived = [one for one in events if one[1] == time][::order]
        state, _ = wrapper.step(state, {s: y for t, _, s, y in arrived if t == time}, u, time_s=time)
        for t, _, sensor, y in arrived:
            if t != time:
                state, info = wrapper.late(state, {sensor: y}, t)
                assert len(info.steps) == info.arrivals[0].refiltered
    return state


def in_order(filter, controls, events):
    """The filter alone, over all times that anything happens at."""
    state, total, before = filter.init((ROWS,), seed=3), 0.0, 0.0
    for time in sorted({0.0, *GRID, *(t for t, *_ in events)}):
        measured = {sensor: y for t, _, sensor, y in events if t == time}
        if time == 0:
            state, info = filter.step(state, measured, None, 0.0, predict_first=False)
        else:
            whole = math.ceil(time * 16) - 1
            u = controls[whole]
            if spread(filter) is proportional:
                u = u * ((time - before) * 16)
            state, info = filter.step(state, measured, u, time - before)
        total, before = total + info.log_likelihood, time
    return state, total


def tensors(value):
    """All tensors of a belief."""
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from tensors(part)


def same_bits(one, other):
    """Equal, NaN (not measured) too."""
    return torch.equal(one.isnan(), other.isnan()) and torch.equal(one.nan_to_num(-1e9), other.nan_to_num(-1e9))


@pytest.mark.parametrize("name", FILTERS)
def test_late_equals_in_order_to_the_bit(name):
    filter = FILTERS[name]()
    controls, events = schedule(filter, np.random.default_rng(len(name)))
    assert sum(arrival > t for t, arrival, *_ in events) >= 8
    state = streamed(filter, controls, events)
    expected, evidence = in_order(filter, controls, events)
    pairs = list(zip(tensors(state.belief), tensors(expected.belief), strict=True))
    if spread(filter) is proportional:  # the share of an increment is rounded
        for found, wanted in pairs:
            torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-10)
        return
    assert len(pairs) >= 2 and all(same_bits(found, wanted) for found, wanted in pairs)
    assert torch.equal(state.log_likelihood, evidence) and state.now.step == expected.step
    assert bool(torch.isfinite(evidence).all())


def test_the_order_of_arrival_does_not_matter():
    """Six random schedules, what comes together taken either way: one belief, to the bit."""
    filter = FILTERS["kalman"]()
    for seed in range(6):
        controls, events = schedule(filter, np.random.default_rng(seed))
        one, other = (streamed(filter, controls, events, order) for order in (1, -1))
        assert torch.equal(one.belief.mean, other.belief.mean)
        assert torch.equal(one.belief.scale_tril, other.belief.scale_tril)


def test_a_restart_is_told_where_it_belongs():
    """Refusals that came late start the filter over at their own times, in the reports of the steps run again."""
    filter = FILTERS["reacquire"]()
    wrapper = DelayedMeasurements(filter, 1.0)
    state = wrapper.init()
    good, off = (torch.full((2,), value, dtype=F64) for value in (0.0, 2.0))
    for k in range(1, 9):
        state, _ = wrapper.step(state, {"fine": good} if k < 3 else {}, dt=1 / 16)
    for k in range(3, 6):
        state, info = wrapper.late(state, {"fine": off}, k / 16)
    assert [bool(step.restarted) for step in info.steps] == [True, False, False, False]
    assert abs(float(state.belief.mean[0]) - 2) < 0.7 and not bool(info.steps[-1].restarted)
