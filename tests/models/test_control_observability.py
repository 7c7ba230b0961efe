"""Observability: matrices, ranks, Gramians, modes, manoeuvres of an INS, reports, experiments on nonlinear laws."""

import math

import control
import matplotlib.figure
import numpy as np
import pytest
import torch
from scipy import integrate, linalg

import torchfilt as tf
from torchfilt.laws import AdditiveGaussian
from torchfilt.models import attitude, landing
from torchfilt.models.control import ss
from torchfilt.models.control.empirical import empirical_gramian
from torchfilt.models.control.ins import INS_ERROR_NAMES, INS_ERROR_SCALE, ins_error_pair
from torchfilt.models.control.manoeuvres import stripped_observability, stripping_defect, total_observability
from torchfilt.models.control.observability import (
    controllability_gramian,
    ctrb,
    observability_gramian,
    obsv,
    pbh,
    rank,
)
from torchfilt.models.control.reports import heat_map, observability_report

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps
G = 9.80665
CHAIN = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]], dtype=DOUBLE)  # position, velocity, bias


def normal(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def row(*values):
    return torch.tensor([values], dtype=DOUBLE)


def close(got, wanted, factor=100.0):
    """To rounding times the length of the sums; the scale is that of the largest entry."""
    wanted = torch.as_tensor(wanted)
    assert got.shape == wanted.shape and got.dtype == wanted.dtype
    assert float((got - wanted).abs().max()) <= factor * EPS * float(wanted.abs().max())


def stable(*lead, size=4, seed=0):
    """Poles between -0.2 and about -3."""
    a = normal(*lead, size, size, seed=seed)
    return a - (torch.linalg.eigvals(a).real.amax(-1) + 0.2)[..., None, None] * torch.eye(size, dtype=DOUBLE)


# Matrices and ranks ---------------------------------------------------------------------------------------------------


def test_matrices_are_those_of_python_control():
    a, b, c = normal(5, 5), normal(5, 2, seed=1), normal(3, 5, seed=2)
    close(obsv(a, c), control.obsv(a.numpy(), c.numpy()))
    close(ctrb(a, b), control.ctrb(a.numpy(), b.numpy()))
    # A system speaks for itself, ours and theirs.
    theirs = control.ss(a.numpy(), b.numpy(), c.numpy(), np.zeros((3, 2)))
    for system in (ss(a, b, c), theirs):
        assert torch.equal(obsv(system), obsv(a, c)) and torch.equal(ctrb(system), ctrb(a, b))


def test_a_time_scale_is_another_unit_of_time():
    a, b, c = normal(4, 4), normal(4, 1, seed=1), normal(1, 4, seed=2)
    powers = np.array([7.0**k for k in range(4)])
    close(obsv(a, c, time_scale=7.0), control.obsv(a.numpy(), c.numpy()) * powers[:, None])
    close(ctrb(a, b, time_scale=7.0), control.ctrb(a.numpy(), b.numpy()) * powers)


def test_a_batch_is_a_loop_and_shared_matrices_broadcast():
    a, c = normal(2, 3, 4, 4), normal(3, 2, 4, seed=1)
    whole = obsv(a, c, time_scale=0.5)
    assert whole.shape == (2, 3, 8, 4)
    for i in range(2):
        for k in range(3):
            close(whole[i, k], obsv(a[i, k], c[k], time_scale=0.5))
    assert obsv(a.float(), c.float()).dtype == torch.float32


def test_rank_counts_what_is_above_the_stated_tolerance():
    left, right = torch.linalg.qr(normal(6, 6)).Q, torch.linalg.qr(normal(4, 4, seed=1)).Q
    values = torch.tensor([3.0, 1.0, 1e-9, 0.0], dtype=DOUBLE)
    matrix = left[:, :4] * values @ right
    found = rank(matrix)
    assert int(found.rank) == 3 and float(found.tolerance) == pytest.approx(6 * EPS * 3)
    assert np.allclose(found.singular_values, values, atol=10 * EPS)
    assert int(rank(matrix, 1e-6).rank) == 2 and float(rank(matrix, 1e-6).tolerance) == 1e-6
    assert int(rank(matrix, 1.0 + 1e-9).rank) == 1
    batch = torch.stack([matrix, torch.zeros_like(matrix), normal(6, 4, seed=2)])
    assert rank(batch).rank.tolist() == [3, 0, 4]


def test_a_scale_undoes_the_units_of_the_states():
    a, c = stable(size=4), normal(1, 4, seed=1)
    units = torch.tensor([1e6, 1.0, 1e-6, 1e-9], dtype=DOUBLE)  # new = old * units
    other = obsv(a * units.unsqueeze(-1) / units, c / units)
    assert int(rank(obsv(a, c)).rank) == 4
    # The same system in other units has a condition of 1e15 and more: the tolerance makes one state vanish.
    assert int(rank(other).rank) < 4
    again = rank(other, scale=units)
    assert int(again.rank) == 4
    assert np.allclose(again.singular_values, rank(obsv(a, c)).singular_values, rtol=1e-10)
    by_columns = rank(other, scale="columns").singular_values
    matrix = other.numpy() / np.linalg.norm(other.numpy(), axis=0)
    assert np.allclose(by_columns, np.linalg.svd(matrix, compute_uv=False), rtol=1e-10)
    assert int(rank(torch.eye(3, dtype=DOUBLE)[:, :2] @ row(1.0, 0.0).mT, scale="columns").rank) == 1
    assert int(rank(torch.zeros(3, 2, dtype=DOUBLE), scale="columns").rank) == 0  # zeros stay zeros


# Gramians -------------------------------------------------------------------------------------------------------------


def quadrature(a, c, horizon):
    """Integral of exp(a^T t) c^T c exp(a t) by an adaptive rule."""
    a, c = a.numpy(), c.numpy()

    def density(t):
        out = c @ linalg.expm(a * t)
        return out.T @ out

    return integrate.quad_vec(density, 0, horizon, epsabs=1e-13, epsrel=1e-12)[0]


@pytest.mark.parametrize("horizon", [0.3, 4.0])
def test_a_finite_gramian_is_the_integral_of_any_system(horizon):
    for a in (stable(), normal(4, 4, seed=3) * 0.7, torch.diag(torch.ones(3, dtype=DOUBLE), 1)):
        b, c = normal(4, 2, seed=1), normal(2, 4, seed=2)
        wanted = quadrature(a, c, horizon)
        assert np.allclose(observability_gramian(a, c, horizon), wanted, rtol=1e-9, atol=1e-11 * np.abs(wanted).max())
        wanted = quadrature(a.mT, b.mT, horizon)
        assert np.allclose(controllability_gramian(a, b, horizon), wanted, rtol=1e-9, atol=1e-11 * np.abs(wanted).max())


def test_the_double_integrators_gramian_in_closed_form():
    a, c, t = CHAIN[:2, :2], row(1.0, 0.0), 6.0
    close(observability_gramian(a, c, t), torch.tensor([[t, t**2 / 2], [t**2 / 2, t**3 / 3]], dtype=DOUBLE))


def test_gramians_for_ever_are_what_long_ones_tend_to_and_what_python_control_finds():
    a, b, c = stable(), normal(4, 2, seed=1), normal(2, 4, seed=2)
    system = control.ss(a.numpy(), b.numpy(), c.numpy(), np.zeros((2, 2)))
    observable, controllable = observability_gramian(a, c), controllability_gramian(a, b)
    residual = a.mT @ observable + observable @ a + c.mT @ c
    assert float(residual.abs().max()) < 1e-11 * float(observable.abs().max())
    # Poles at -0.2: after 200 s what is left is exp(-80).
    assert np.allclose(observability_gramian(system), observability_gramian(a, c, 200.0), rtol=1e-9)
    assert np.allclose(controllable, controllability_gramian(a, b, 200.0), rtol=1e-9)
    assert np.allclose(controllability_gramian(system), controllable, rtol=1e-12)
    batch = torch.stack([a, stable(seed=5)])
    close(observability_gramian(batch, c)[0], observability_gramian(a, c))
    assert observability_gramian(a.float(), c.float()).dtype == torch.float32


def test_discrete_gramians_are_sums():
    a, b, c = normal(3, 3) * 0.5, normal(3, 1, seed=1), normal(1, 3, seed=2)
    for count in (1, 2, 7, 12):
        terms = [np.linalg.matrix_power(a.numpy(), k) for k in range(count)]
        wanted = sum(p.T @ c.numpy().T @ c.numpy() @ p for p in terms)
        close(observability_gramian(a, c, count, discrete=True), wanted)
        wanted = sum(p @ b.numpy() @ b.numpy().T @ p.T for p in terms)
        close(controllability_gramian(a, b, count, discrete=True), wanted)
    system = ss(a, b, c, dt=0.5)  # says itself that it is discrete
    assert float(torch.linalg.eigvals(a).abs().max()) < 0.95
    for found, part in ((observability_gramian, c), (controllability_gramian, b)):
        assert np.allclose(found(system), found(a, part, 1000, discrete=True), rtol=1e-10)
        assert torch.equal(found(system), found(a, part, discrete=True))


# Modes ----------------------------------------------------------------------------------------------------------------


def test_modes_that_are_not_seen_are_named():
    modes = torch.tensor([-1.0, 0.5, -3.0, 0.25], dtype=DOUBLE)
    vectors = normal(4, 4)
    a = vectors @ torch.diag(modes) @ torch.linalg.inv(vectors)
    c = row(1.0, 0.0, 0.0, 1.0) @ torch.linalg.inv(vectors)  # the second and third mode don't reach it
    found = pbh(a, c)
    order = torch.argsort(found.eigenvalues.real)
    assert np.allclose(found.eigenvalues.real[order], [-3, -1, 0.25, 0.5])
    assert found.unobservable[order].tolist() == [True, False, False, True]
    assert found.undetectable[order].tolist() == [False, False, False, True]
    last = found.directions[order[-1]]
    assert abs(abs(torch.dot(last.real, vectors[:, 1]) / vectors[:, 1].norm()) - 1) < 1e-9
    # As a discrete system all but two die out, and 0.5 is one that does.
    discrete = pbh(a, c, discrete=True)
    assert discrete.undetectable[order].tolist() == [True, False, False, False]
    for k, value in enumerate(found.eigenvalues.numpy()):
        tall = np.vstack([value * np.eye(4) - a.numpy(), c.numpy()])
        assert float(found.singular_values[k]) == pytest.approx(np.linalg.svd(tall)[1][-1], abs=1e-13)
    norm = np.linalg.norm(np.vstack([a.numpy(), c.numpy()]), 2)
    assert float(found.tolerance) == pytest.approx(EPS**0.5 * norm)
    assert pbh(a, c, tolerance=1e3).unobservable.all() and not pbh(a, c, tolerance=0.0).unobservable[order[1]]


def test_modes_of_systems_and_batches():
    a = CHAIN[:2, :2]
    both = torch.stack([row(1.0, 0.0), row(0.0, 1.0)])
    found = pbh(a, both)
    assert found.undetectable.tolist() == [[False, False], [True, True]]
    assert np.allclose(found.directions[1].abs(), [[1, 0], [1, 0]])  # position
    assert pbh(ss(a, row(0.0, 1.0).mT, row(0.0, 1.0))).undetectable.all()
    discrete = ss(torch.diag(row(0.5, 1.0)[0]), row(1.0, 1.0).mT, row(0.0, 0.0) + 0, dt=1.0)
    assert pbh(discrete).undetectable.tolist() == [False, True]


def test_modes_that_last_are_told_through_rounding():
    """In mixed coordinates the eigenvalues of an integrator come out as plus and minus the root of eps."""
    signs = set()
    for seed in range(8):
        mixed = normal(3, 3, seed=seed)
        a = mixed @ torch.block_diag(CHAIN[:2, :2], torch.tensor([[-1.0]], dtype=DOUBLE)) @ torch.linalg.inv(mixed)
        c = row(0.0, 1.0, 1.0) @ torch.linalg.inv(mixed)  # position unseen
        found = pbh(a, c)
        signs |= set(torch.sign(found.eigenvalues.real[found.unobservable]).tolist())
        assert found.undetectable.sum() == 2
        step = torch.linalg.matrix_exp(a)
        assert pbh(step, c, discrete=True).undetectable.sum() == 2
        still = mixed @ torch.diag(row(0.0, -1.0, -2.0)[0]) @ torch.linalg.inv(mixed)
        with pytest.raises(ValueError, match="needs a stable system"):
            observability_gramian(still, c)
    assert {1.0, -1.0} <= signs


# Manoeuvres -----------------------------------------------------------------------------------------------------------

SPEED, RATE = 30.0, 0.1
LEVEL = torch.tensor([0.0, 0.0, G], dtype=DOUBLE)
FASTER = torch.tensor([0.0, 2.0, G], dtype=DOUBLE)
TURNING = torch.tensor([-SPEED * RATE, 0.0, G], dtype=DOUBLE)
BANKED = attitude.from_rotation_vector(torch.tensor([0.0, -math.atan(SPEED * RATE / G), 0.0], dtype=DOUBLE))
CLIMBING = attitude.from_rotation_vector(torch.tensor([0.2, 0.0, 0.0], dtype=DOUBLE))


def flight(*names, sensors=("position",)):
    pieces = {
        "level": (LEVEL, 0.0, None),
        "acceleration": (FASTER, 0.0, None),
        "turn": (TURNING, RATE, None),
        "banked turn": (TURNING, RATE, BANKED),
        "climb": (LEVEL, 0.0, CLIMBING),
    }
    return [ins_error_pair(force, rate, sensors, turned) for force, rate, turned in (pieces[name] for name in names)]


PUBLISHED = {
    "level, position": (flight("level"), 11),
    "level, heading": (flight("level", sensors=("position", "heading")), 13),
    "acceleration": (flight("level", "acceleration"), 14),
    "turn": (flight("level", "turn"), 15),
    "banked turn": (flight("level", "banked turn"), 15),
    "all": (flight("level", "acceleration", "turn", "climb"), 15),
}


@pytest.mark.parametrize("time_scale", [1.0, 10.0])
@pytest.mark.parametrize("case", list(PUBLISHED))
def test_ranks_of_an_ins_over_manoeuvres(case, time_scale):
    pieces, wanted = PUBLISHED[case]
    stripped = stripped_observability(pieces, time_scale=time_scale)
    total = total_observability(pieces, [10.0] * (len(pieces) - 1), time_scale=time_scale)
    for matrix in (stripped, total):
        found = rank(matrix, scale=INS_ERROR_SCALE)
        assert int(found.rank) == wanted == np.linalg.matrix_rank(matrix.numpy() * INS_ERROR_SCALE.numpy())
        # The decision is a clear one: nothing near the tolerance.
        values = found.singular_values
        assert float(values[wanted - 1]) > 1e6 * float(found.tolerance)
        assert wanted == 15 or float(values[wanted]) < 0.1 * float(found.tolerance)


def test_earths_rate_adds_one_weak_direction_to_level_flight():
    spin = 7.292e-5 * np.array([0.0, math.cos(0.8), math.sin(0.8)])
    for sensors, wanted in ((("position",), 12), (("position", "heading"), 13)):
        a, c = flight("level", sensors=sensors)[0]
        a = a.clone()
        a[:3, :3] -= torch.as_tensor(skewed(spin))
        a[3:6, 3:6] -= torch.as_tensor(skewed(2 * spin))
        found = rank(obsv(a, c), scale=INS_ERROR_SCALE)
        assert int(found.rank) == wanted
        if wanted == 12:
            assert float(found.singular_values[11]) < 1e-4 * float(found.singular_values[10])


def test_matrices_of_manoeuvres_are_what_numpy_stacks():
    pieces, times = flight("level", "acceleration", "turn"), (4.0, 7.0)
    past, stripped, total = np.eye(15), [], []
    for k, (a, c) in enumerate(pieces):
        block = control.obsv(a.numpy() * 3.0, c.numpy())
        stripped.append(block)
        total.append(block @ past)
        past = linalg.expm(a.numpy() * (*times, 0.0)[k]) @ past
    close(stripped_observability(pieces, time_scale=3.0), np.vstack(stripped))
    close(total_observability(pieces, times, time_scale=3.0), np.vstack(total), 1e4)


def test_the_stripped_matrix_may_stand_in_where_what_is_unseen_does_not_move():
    a = torch.zeros(3, 3, dtype=DOUBLE)
    a[0, 1] = 1
    fine = [(a, row(1.0, 0.0, 0.0)), (a, row(1.0, 0.0, 1.0))]
    assert torch.equal(stripping_defect(fine), torch.zeros(2, dtype=DOUBLE))
    # Position unseen in the second piece moves by the velocity, unseen too.
    a = CHAIN.clone()
    blind = [(a, row(1.0, 0.0, 0.0)), (a, row(0.0, 0.0, 1.0))]
    assert np.allclose(stripping_defect(blind), [0.0, 1.0])
    assert np.allclose(stripping_defect(blind, time_scale=5.0), [0.0, 5.0])
    scale = torch.tensor([10.0, 1.0, 1.0], dtype=DOUBLE)
    assert np.allclose(stripping_defect(blind, scale=scale), [0.0, 0.1])
    assert np.allclose(stripping_defect(blind, tolerance=1e3), [1.0, 1.0])  # nothing counts as seen: all of a is left
    # An INS in level flight: the gyro's bias about up is not seen and turns the heading, not seen either.
    heading = stripping_defect(flight("level"), scale=INS_ERROR_SCALE)
    assert float(heading) == pytest.approx(1e-3 / 1e-2)
    with_heading = stripping_defect(flight("level", sensors=("position", "heading")), scale=INS_ERROR_SCALE)
    assert float(with_heading) < 1e-12


def test_where_it_may_not_the_stripped_matrix_claims_too_much_or_too_little():
    """A state that one piece rotates away from the next one's sensor: the two matrices have different null spaces."""
    turn = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=DOUBLE)
    still = torch.zeros(2, 2, dtype=DOUBLE)
    # Unseen it turns by a quarter: then the first component of now is the second one of the start.
    pieces = [(turn, row(0.0, 0.0)), (still, row(1.0, 0.0))]
    assert float(stripping_defect(pieces)[0]) == pytest.approx(1.0)
    seen = observability_report(total_observability(pieces, [math.pi / 2]), ("x", "y"))
    claimed = observability_report(stripped_observability(pieces), ("x", "y"))
    assert np.allclose(seen.share, [0, 1], atol=1e-12) and np.allclose(claimed.share, [1, 0], atol=1e-12)


def test_pieces_may_be_systems_and_batches():
    a, c = CHAIN, row(1.0, 0.0, 0.0)
    system = ss(a, torch.zeros(3, 1, dtype=DOUBLE), c)
    assert torch.equal(stripped_observability([system, (a, c)]), stripped_observability([(a, c)] * 2))
    rates = torch.tensor([0.1, -0.3], dtype=DOUBLE)
    many = [flight("level")[0], ins_error_pair(TURNING.expand(2, 3), rates)]
    assert total_observability(many, [5.0]).shape == (2, 90, 15)
    assert stripping_defect(many).shape == (2, 2)
    one = [many[0], ins_error_pair(TURNING, -0.3)]
    close(total_observability(many, [5.0])[1], total_observability(one, [5.0]))


# Errors of an INS -----------------------------------------------------------------------------------------------------


def strapdown(axes, velocity, position, gyro, accel, dt, count, rate, force_body):
    """Runs (n, ...) of a strapdown over flat ground, by numpy: axes that don't turn, the force of half-way."""
    turn = linalg.expm(skewed((rate + gyro) * dt))
    half = linalg.expm(skewed((rate + gyro) * dt / 2))
    for _ in range(count):
        push = (axes @ half @ (force_body + accel)[..., None])[..., 0] - np.array([0, 0, G])
        position = position + velocity * dt + push * dt**2 / 2
        velocity = velocity + push * dt
        axes = axes @ turn
    return axes, velocity, position


def skewed(v):
    return np.cross(np.asarray(v)[..., None, :], np.eye(3)).swapaxes(-1, -2)


@pytest.mark.parametrize("name", ["level", "acceleration", "banked turn", "climb"])
def test_errors_of_an_ins_grow_as_two_flights_drift_apart(name):
    """Oracle: the nonlinear strapdown flown with the errors and without, seen from axes that turn with the heading."""
    force, rate, turned = {
        "level": (LEVEL, 0.0, None),
        "acceleration": (FASTER, 0.0, None),
        "banked turn": (TURNING, RATE, BANKED),
        "climb": (LEVEL, 0.0, CLIMBING),
    }[name]
    a, _ = ins_error_pair(force, rate, attitude=turned)
    body = np.eye(3) if turned is None else attitude.to_matrix(turned).numpy()
    rate_body, force_body = body.T @ [0, 0, rate], body.T @ force.numpy()
    dt, count = 4e-3, 1000
    sizes = 1e-3 * INS_ERROR_SCALE.numpy()
    error = np.concatenate([np.diag(sizes), -np.diag(sizes), np.zeros((1, 15))])
    start, velocity, position, gyro, accel = error.reshape(31, 5, 3).swapaxes(0, 1)
    axes = linalg.expm(skewed(start)) @ body
    axes, *moved = strapdown(axes, velocity, position, gyro, accel, dt, count, rate_body, force_body)
    apart = axes @ axes[-1].T
    tilt = np.stack([apart[:, 2, 1], apart[:, 0, 2], apart[:, 1, 0]], -1)
    tilt -= np.stack([apart[:, 1, 2], apart[:, 2, 0], apart[:, 0, 1]], -1)
    heading = linalg.expm(skewed([0.0, 0.0, rate * dt * count]))
    after = np.concatenate([part @ heading for part in (tilt / 2, *moved)] + [gyro, accel], -1)
    found = (after[:15] - after[15:30]).T / (2 * sizes)
    scaled = linalg.expm(a.numpy() * dt * count) * sizes / sizes[:, None]
    # What central differences leave of errors of 1e-5 rad, and of a mechanisation whose turn per step is 4e-4 rad.
    assert np.allclose(found * sizes / sizes[:, None], scaled, rtol=0, atol=1e-6 * np.abs(scaled).max())


def test_sensors_of_an_ins():
    nose = attitude.from_rotation_vector(torch.tensor([0.3, 0.1, 0.4], dtype=DOUBLE))
    names = ("heading", "level", "speed", "velocity", "height", "position")
    _, c = ins_error_pair(LEVEL, 0.0, names, nose)
    assert c.shape == (11, 15)
    eye = torch.eye(15, dtype=DOUBLE)
    assert torch.equal(c[1:], eye[[0, 1, 4, 3, 4, 5, 8, 6, 7, 8]])
    for axis in range(3):
        shift = torch.zeros(3, dtype=DOUBLE)
        shift[axis] = 1e-5
        turned = [attitude.multiply(attitude.from_rotation_vector(s * shift), nose) for s in (1, -1)]
        ahead = [attitude.to_matrix(q)[:, 1].numpy() for q in turned]
        plus, minus = (math.atan2(v[0], v[1]) for v in ahead)  # clockwise from y
        assert float(c[0, axis]) == pytest.approx((plus - minus) / 2e-5, rel=1e-8, abs=1e-8)
    assert not c[0, 3:].any()
    a, c = ins_error_pair(LEVEL.float())
    assert a.dtype == c.dtype == torch.float32


# Reports --------------------------------------------------------------------------------------------------------------


def test_a_report_names_what_is_not_observed_and_how():
    pieces = flight("level")
    matrix = stripped_observability(pieces, time_scale=10.0)
    report = observability_report(matrix, INS_ERROR_NAMES, title="level flight", scale=INS_ERROR_SCALE)
    assert report.rank == 11 and report.title == "level flight" and report.names == INS_ERROR_NAMES
    assert report.unobserved == (
        "attitude right",
        "attitude forward",
        "attitude up",
        "gyro bias up",
        "accelerometer bias right",
        "accelerometer bias forward",
    )
    share = dict(zip(report.names, report.share.tolist(), strict=True))
    # A tilt of 0.01 rad is 0.098 m/s^2 of gravity beside biases of 0.1 m/s^2.
    lost = 1 / (1 + 0.980665**2)
    assert share["attitude right"] == pytest.approx(1 - lost, abs=1e-9)
    assert share["accelerometer bias forward"] == pytest.approx(lost, abs=1e-9)
    assert share["attitude up"] == pytest.approx(0, abs=1e-12) and share["velocity up"] == pytest.approx(1, abs=1e-12)
    assert report.directions.shape == (4, 15)
    scaled = matrix @ report.directions.mT
    assert float(scaled.abs().max()) < 1e-9
    # An attitude forward tips up the right side and looks like a push to the left that is not there.
    text = report.table()
    assert text.startswith("level flight: rank 11 of 15")
    assert "  +1 attitude up" in text.splitlines() and "  +1 gyro bias up" in text.splitlines()
    ratio = [
        line for line in text.splitlines() if line.startswith("  ") and "forward  " in line and "bias right" in line
    ]
    assert len(ratio) == 1 and ("9.807" in ratio[0] or "0.102" in ratio[0])
    for name in INS_ERROR_NAMES:
        assert name in text


def test_a_report_in_single_precision_names_the_same_states():
    a, c = (part.float() for part in flight("level")[0])
    report = observability_report(obsv(a, c), INS_ERROR_NAMES, scale=INS_ERROR_SCALE)
    double = observability_report(obsv(*flight("level")[0]), INS_ERROR_NAMES, scale=INS_ERROR_SCALE)
    assert report.share.dtype == torch.float32 and report.rank == 11
    assert report.unobserved == double.unobserved
    assert np.allclose(report.directions, double.directions, rtol=1e-4, atol=1e-6)


def test_a_table_leaves_out_what_does_not_weigh():
    """In the states' sizes, not in their units: a bias of 0.02 weighs more beside sizes of 0.1 than 1 beside 100."""
    matrix = row(0.02, -1.0, 0.0) * 1.0
    scale = torch.tensor([1.0, 1.0, 1.0], dtype=DOUBLE)
    text = observability_report(matrix, ("x", "v", "b"), scale=scale).table()
    assert "  +1 x" in text.splitlines()  # and 0.02 v, a fiftieth
    heavy = observability_report(matrix, ("x", "v", "b"), scale=torch.tensor([10.0, 1.0, 1.0], dtype=DOUBLE))
    assert "  +1 x  +0.02 v" in heavy.table().splitlines() or "  +50 x  +1 v" in heavy.table().splitlines()
    assert heavy.sizes.tolist() == [10.0, 1.0, 1.0]
    assert np.allclose(observability_report(matrix, "xvb", scale="columns").sizes, [50.0, 1.0, 1.0])
    assert observability_report(matrix, "xvb").sizes.tolist() == [1.0, 1.0, 1.0]


def test_shares_and_directions_against_a_projection_by_numpy():
    matrix = normal(3, 6)
    scale = torch.tensor([1.0, 10.0, 0.1, 2.0, 5.0, 1e-3], dtype=DOUBLE)
    report = observability_report(matrix, "abcdef", scale=scale)
    scaled = matrix.numpy() * scale.numpy()
    onto = np.linalg.pinv(scaled) @ scaled
    assert np.allclose(report.share, np.diag(onto), atol=1e-12)
    assert report.rank == 3 and report.directions.shape == (3, 6)
    assert np.allclose(matrix @ report.directions.mT, 0, atol=1e-9 * float(report.directions.abs().max()))
    null = linalg.null_space(scaled)
    spanned = report.directions.numpy() / scale.numpy()
    assert np.linalg.matrix_rank(np.vstack([null.T, spanned])) == 3
    ones = (report.directions - 1).abs() < 1e-12
    assert ones.any(-1).all()
    columns = observability_report(matrix, "abcdef", scale="columns")
    unit = matrix.numpy() / np.linalg.norm(matrix.numpy(), axis=0)
    assert np.allclose(columns.share, np.diag(np.linalg.pinv(unit) @ unit), atol=1e-12)
    assert np.allclose(matrix @ columns.directions.mT, 0, atol=1e-12)


def test_a_report_of_all_and_of_nothing():
    eye = torch.eye(2, dtype=DOUBLE)
    all_seen = observability_report(eye, ("x", "v"))
    assert all_seen.unobserved == () and all_seen.directions.shape == (0, 2)
    assert "rank 2 of 2" in all_seen.table() and "not observed" not in all_seen.table()
    assert "not counted none" in all_seen.table()
    nothing = observability_report(0 * eye, ("x", "v"))
    assert nothing.rank == 0 and nothing.unobserved == ("x", "v") and "counted none" in nothing.table()
    assert observability_report(eye, ("x", "v"), tolerance=2.0).rank == 0
    assert observability_report(eye.float(), ("x", "v")).share.dtype == torch.float32


def test_the_heat_map_shows_shares_by_report():
    reports = [
        observability_report(stripped_observability(pieces), INS_ERROR_NAMES, title=title, scale=INS_ERROR_SCALE)
        for title, (pieces, _) in PUBLISHED.items()
    ]
    axes = heat_map(reports)
    assert np.allclose(axes.images[0].get_array()[:, 1], reports[1].share)
    assert [label.get_text() for label in axes.get_yticklabels()] == list(INS_ERROR_NAMES)
    assert [label.get_text().split("\n")[1] for label in axes.get_xticklabels()][:2] == ["rank 11", "rank 13"]
    axes.figure.canvas.draw()
    own = matplotlib.figure.Figure().subplots()
    assert heat_map(reports[:1], own) is own


# Experiments ----------------------------------------------------------------------------------------------------------


def linear_model(a, c, deviation):
    d, m = a.shape[-1], c.shape[-2]
    prior = tf.Gaussian(torch.zeros(d, dtype=DOUBLE), torch.eye(d, dtype=DOUBLE))
    law = tf.LinearGaussian(c, torch.diag(deviation.square()))
    assert len(deviation) == m
    return tf.StateSpaceModel(prior, tf.LinearGaussian(a, torch.eye(d, dtype=DOUBLE)), law)


@pytest.mark.parametrize("scale", [1e-3, 50.0])
def test_the_experiment_on_a_linear_law_is_the_linear_gramian(scale):
    a, c, deviation = normal(4, 4) * 0.5, normal(2, 4, seed=1), torch.tensor([0.5, 3.0], dtype=DOUBLE)
    model, x0 = linear_model(a, c, deviation), normal(4, seed=2)
    white = c / deviation.unsqueeze(-1)
    found = empirical_gramian(model, x0, steps=6, scale=scale, predict_first=False)
    # Differences of numbers of size 1 to 100 by steps of 1e-3: rounding over the step, in numbers of size one.
    bound = dict(rtol=1e-10, atol=1e-11) if scale < 1 else dict(rtol=1e-12, atol=1e-13)
    assert np.allclose(found.gramian, observability_gramian(a, white, 6, discrete=True), **bound)
    rows = np.vstack([white.numpy() @ np.linalg.matrix_power(a.numpy(), k) for k in range(6)])
    assert np.allclose(found.sensitivity, rows, **bound)
    moved = empirical_gramian(model, x0, steps=6, scale=scale).sensitivity
    assert np.allclose(moved, rows @ a.numpy(), **bound)


def pendulum():
    """An angle, its rate and the length of the rod; the shadow of the bob and its heading are measured, correlated."""

    def swing(x, u, dt):
        angle, rate, length = x.unbind(-1)
        push = u[..., 0] - G / length * angle.sin()
        step = dt[..., 0] if isinstance(dt, torch.Tensor) else dt
        return torch.stack([angle + step * rate + step**2 / 2 * push, rate + step * push, length], -1)

    def shadow(x):
        return torch.stack([x[..., 2] * x[..., 0].sin(), x[..., 0]], -1)

    root = torch.tensor([[0.1, 0.0], [0.05, 0.02]], dtype=DOUBLE)
    prior = tf.Gaussian(torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE), torch.eye(3, dtype=DOUBLE))
    space = tf.Product(tf.Euclidean(1), tf.Angle(1))
    seen = AdditiveGaussian(shadow, scale_tril=root, space=space)
    moved = AdditiveGaussian(swing, torch.eye(3, dtype=DOUBLE))
    return tf.StateSpaceModel(prior, moved, seen), swing, shadow, root


def test_the_experiment_on_a_nonlinear_law_tends_to_its_jacobian_with_the_square_of_the_scale():
    model, swing, shadow, root = pendulum()
    x0 = torch.tensor([3.1, 0.4, 1.3], dtype=DOUBLE)  # swings over the cut of the angle
    controls, times = normal(8, 1), torch.linspace(0.05, 0.2, 8, dtype=DOUBLE)

    def outputs(start):
        x, seen = start, []
        for u, dt in zip(controls, times, strict=True):
            x = swing(x, u, float(dt))
            seen.append(torch.linalg.solve_triangular(root, shadow(x).unsqueeze(-1), upper=False).squeeze(-1))
        return torch.cat(seen)

    exact = torch.func.jacfwd(outputs)(x0)
    wanted = exact.mT @ exact
    errors = []
    for scale in (1e-2, 1e-3):
        gramian = empirical_gramian(model, x0, controls, times, scale).gramian
        errors.append(float((gramian - wanted).norm() / wanted.norm()))
    # Central differences: a tenth of the scale makes a hundredth of the error, up to terms of the scale's square.
    assert errors[0] / errors[1] == pytest.approx(100, rel=100 * 1e-2**2)
    each = torch.tensor([1e-4, 2e-4, 1e-5], dtype=DOUBLE)
    fine = empirical_gramian(model, x0, controls, times, each)
    assert np.allclose(fine.sensitivity, exact, rtol=1e-5, atol=1e-5 * float(exact.abs().max()))


def test_rows_of_a_batch_are_runs_of_their_own():
    model, *_ = pendulum()
    x0 = torch.tensor([0.5, 0.4, 1.3], dtype=DOUBLE) + 0.1 * normal(2, 3, 3)
    controls, times = normal(4, 2, 3, 1), 0.1 + 0.1 * torch.rand(4, 2, 3, dtype=DOUBLE)
    whole = empirical_gramian(model, x0, controls, times)
    assert whole.sensitivity.shape == (2, 3, 8, 3) and whole.gramian.shape == (2, 3, 3, 3)
    for i in range(2):
        for k in range(3):
            one = empirical_gramian(model, x0[i, k], controls[:, i, k], times[:, i, k])
            assert np.allclose(whole.sensitivity[i, k], one.sensitivity, rtol=1e-7, atol=1e-7)
    still = empirical_gramian(model, x0, controls, torch.tensor(0.1, dtype=DOUBLE)).sensitivity
    assert torch.equal(still, empirical_gramian(model, x0, controls, 0.1).sensitivity)


def test_noise_that_depends_on_the_state_is_that_of_the_run_itself():
    class Farther(torch.nn.Module):
        def forward(self, x):
            return tf.Gaussian(x, 0.1 * x, is_diagonal=True)

    prior = tf.Gaussian(torch.ones(1, dtype=DOUBLE), torch.eye(1, dtype=DOUBLE))
    model = tf.StateSpaceModel(prior, tf.LinearGaussian(row(1.0), row(1.0)), Farther())
    found = empirical_gramian(model, torch.tensor([4.0], dtype=DOUBLE), steps=1).sensitivity
    assert float(found) == pytest.approx(1 / 0.4, rel=1e-9)


def test_the_landing_on_quaternions_against_its_own_first_order():
    """Sixteen numbers, fifteen errors, some sensors: Jacobians of both laws multiplied."""
    model = landing.landing_model()
    x0 = landing.LANDING_SPACE.retract(model.prior().mean, 0.05 * normal(15))
    controls = torch.cat(
        [0.02 * normal(5, 3), torch.tensor([0.0, 0.0, 0.1 * G], dtype=DOUBLE) + 0.1 * normal(5, 3)], -1
    )
    found = empirical_gramian(model, x0, controls, 0.1, 1e-5)
    x, past, rows = x0, torch.eye(15, dtype=DOUBLE), []
    for u in controls:
        law, jacobian = model.transition.first_order(x, u, 0.1)
        x, past = law.mean, jacobian @ past
        seen = model.conditional("observation", x, u, 0.1)

        def local(error, at=x, centre=seen):
            after = landing.LANDING_SPACE.retract(at, error)
            return centre.space.local(centre.mean, model.observation(after).mean)

        slope = torch.func.jacfwd(local)(torch.zeros(15, dtype=DOUBLE)) @ past
        rows.append(torch.linalg.solve_triangular(seen.factor(), slope, upper=False))
    wanted = torch.cat(rows)
    # The Jacobian of the motion is of second order in the turn and the gyro's bias.
    assert np.allclose(found.sensitivity, wanted, rtol=1e-3, atol=2e-4 * float(wanted.abs().max()))


# Errors ---------------------------------------------------------------------------------------------------------------

A, C = CHAIN, row(1.0, 0.0, 0.0)
NOSE_UP = torch.tensor([math.pi / 2, 0.0, 0.0], dtype=DOUBLE)
NAN = torch.full((1, 3), math.nan, dtype=DOUBLE)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: obsv(A[:2], C), ValueError, r"a must be \(\*batch, d, d\), got shape \(2, 3\)"),
        (lambda: obsv(A, C[:, :2]), ValueError, r"c must be \(\*batch, m, 3\) to fit a \(3, 3\), got \(1, 2\)"),
        (lambda: ctrb(A, C), ValueError, r"b must be \(\*batch, 3, k\) to fit a \(3, 3\), got \(1, 3\)"),
        (lambda: obsv(A, C[0]), ValueError, r"c must be .* got \(3,\)"),
        (lambda: obsv(A, NAN), ValueError, r"c must be finite, entry \(0, 0\) is nan"),
        (lambda: obsv(A, C.float()), TypeError, "a and c must have one dtype, got torch.float64 and torch.float32"),
        (lambda: obsv(A.long(), C), TypeError, "a must be a floating-point tensor, got torch.int64"),
        (lambda: obsv(A.numpy(), C), TypeError, "a must be a floating-point tensor, got ndarray"),
        (lambda: obsv(A), TypeError, "a system must be"),
        (lambda: obsv(A, C, time_scale=0.0), ValueError, "time_scale must be positive and finite, got 0.0"),
        (lambda: rank(A.tolist()), TypeError, "matrix must be a floating-point tensor, got list"),
        (lambda: rank(A[0]), ValueError, r"matrix must be \(\*batch, m, n\), got shape \(3,\)"),
        (lambda: rank(A[:0]), ValueError, r"matrix must be \(\*batch, m, n\), got shape \(0, 3\)"),
        (lambda: rank(NAN), ValueError, "matrix must be finite"),
        (lambda: rank(A, -1.0), ValueError, "tolerance must be finite and not negative, got -1.0"),
        (lambda: rank(A, scale="rows"), ValueError, "scale must be sizes of the states or 'columns', got 'rows'"),
        (lambda: rank(A, scale=C[0]), ValueError, r"scale must be 3 positive finite numbers, got \[1.0, 0.0, 0.0\]"),
        (lambda: rank(A, scale=C[0, :1]), ValueError, "scale must be 3 positive"),
        (lambda: observability_gramian(A, C), ValueError, "a mode with Re >= 0: 0"),
        (lambda: controllability_gramian(A.mT, C.mT), ValueError, "needs a stable system"),
        (lambda: observability_gramian(2 * torch.eye(3).double(), C, discrete=True), ValueError, r"\|z\| >= 1: 2"),
        (lambda: observability_gramian(A, C, -1.0), ValueError, "horizon must be positive and finite, got -1.0"),
        (
            lambda: observability_gramian(A, C, 1.5, discrete=True),
            ValueError,
            "positive whole number of steps, got 1.5",
        ),
        (lambda: pbh(ss(A, C.mT, C), discrete=True), ValueError, "this system is continuous, its dt is None"),
        (
            lambda: observability_gramian(ss(A, C.mT, C), None, 1.0, discrete=True),
            ValueError,
            "this system is continuous",
        ),
        (lambda: controllability_gramian(ss(A, C.mT, C), None, 1.0, discrete=True), ValueError, "this system is cont"),
        (lambda: pbh(A, C, tolerance=math.nan), ValueError, "tolerance must be finite and not negative, got nan"),
        (lambda: stripped_observability([]), ValueError, r"pieces must be at least one pair .* got sizes \[\]"),
        (lambda: stripped_observability([(A, C), (A[:2, :2], C[:, :2])]), ValueError, r"one state size, .*\[3, 2\]"),
        (lambda: stripping_defect([ss(A, C.mT, C, dt=1.0)]), ValueError, "piece 0 is discrete with dt = 1.0"),
        (lambda: total_observability([(A, C)] * 2, []), ValueError, r"durations_s must be 1 positive .* got \[\]"),
        (lambda: total_observability([(A, C)] * 2, [0.0]), ValueError, r"durations_s must be 1 .* got \[0.0\]"),
        (lambda: observability_report(A, ("x", "v")), ValueError, "names must be 3 different ones, .* got 2"),
        (lambda: observability_report(A, ("x", "v", "x")), ValueError, "names must be 3 different"),
        (lambda: observability_report(A.expand(2, 3, 3), "xvb"), ValueError, r"one matrix \(m, d\), got .*\(2, 3, 3\)"),
        (lambda: heat_map([]), ValueError, "reports must be at least one, all of the same states, got 0"),
        (
            lambda: heat_map([observability_report(A, "xvb"), observability_report(A, "abc")]),
            ValueError,
            "reports must be at least one, all of the same states, got 2",
        ),
        (lambda: ins_error_pair([0, 0, 9.8]), TypeError, "specific_force_m_s2 must be a floating-point tensor"),
        (
            lambda: ins_error_pair(LEVEL[:2]),
            ValueError,
            r"specific_force_m_s2 must be .* got shape \(2,\)",
        ),
        (lambda: ins_error_pair(LEVEL * math.inf), ValueError, "specific_force_m_s2 must be finite"),
        (lambda: ins_error_pair(LEVEL, math.nan), ValueError, "turn_rate_rad_s must be finite"),
        (
            lambda: ins_error_pair(LEVEL, 0.0, ("gps",)),
            ValueError,
            r"some of position, .* got \('gps',\)",
        ),
        (lambda: ins_error_pair(LEVEL, 0.0, ()), ValueError, "sensors must be some of"),
        (lambda: ins_error_pair(LEVEL, 0.0, "heading"), ValueError, "sensors must be some of .* got 'heading'"),
        (
            lambda: ins_error_pair(LEVEL, attitude=LEVEL),
            ValueError,
            r"attitude must be .* got shape \(3,\)",
        ),
        (
            lambda: ins_error_pair(
                LEVEL,
                0.0,
                ("heading",),
                attitude.from_rotation_vector(math.pi / 2 * torch.tensor([1.0, 0, 0]).double()),
            ),
            ValueError,
            "no heading where the nose points straight up or down",
        ),
    ],
)
def test_bad_input_is_refused_by_name(call, error, message):
    with pytest.raises(error, match=message):
        call()


MODEL = linear_model(A, C, torch.ones(1, dtype=DOUBLE))
X0 = torch.ones(3, dtype=DOUBLE)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(model=A), TypeError, "model must be a StateSpaceModel, got Tensor"),
        (dict(x0=[1.0, 1.0, 0.0]), TypeError, r"x0 must be a tensor \(\*batch, d\), got list"),
        (dict(x0=X0.float()), TypeError, "x0 must have the model's dtype torch.float64, got torch.float32"),
        (dict(x0=X0[:2]), ValueError, r"x0 must be \(\*batch, 3\), got shape \(2,\)"),
        (dict(x0=X0 * math.nan), ValueError, r"x0 must be finite, entry \(0,\) is nan"),
        (dict(controls=torch.zeros(2, 1)), TypeError, "controls must have the model's dtype"),
        (dict(controls=torch.zeros(2, 5, 1).double()), ValueError, r"controls must be \(t, k\), got shape \(2, 5, 1\)"),
        (dict(controls=NAN), ValueError, "controls must be finite"),
        (dict(controls=torch.zeros(3, 1).double()), ValueError, "got 3 controls and steps=2"),
        (dict(steps=None), ValueError, "got None controls and steps=None"),
        (dict(steps=0), ValueError, "at least one step"),
        (dict(scale=0.0), ValueError, "scale must be a positive finite number or 3 of them, got 0.0"),
        (dict(scale=X0[:2]), ValueError, r"scale must be a positive finite number or 3 of them, got \[1.0, 1.0\]"),
        (dict(dt=-1.0), ValueError, "dt must be finite and >= 0, got -1.0"),
        (dict(dt=X0), ValueError, r"dt must be a number, \(2,\) or \(2,\), got \(3,\)"),
        (dict(dt=-X0[:2]), ValueError, r"dt must be finite and >= 0, got \[-1.0, -1.0\]"),
    ],
)
def test_a_bad_experiment_is_refused_by_name(change, error, message):
    with pytest.raises(error, match=message):
        empirical_gramian(**({"model": MODEL, "x0": X0, "steps": 2} | change))


def test_an_experiment_needs_noise_and_a_run_that_stays_finite():
    silent = linear_model(A, C, torch.zeros(1, dtype=DOUBLE))
    with pytest.raises(ValueError, match="measurements must have noise in all components"):
        empirical_gramian(silent, X0, steps=2)
    explosive = linear_model(1e200 * torch.eye(3, dtype=DOUBLE), C, torch.ones(1, dtype=DOUBLE))
    with pytest.raises(ValueError, match="they are not at step 1: the run diverged"):
        empirical_gramian(explosive, X0, steps=3)
