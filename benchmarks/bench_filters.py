"""Steps of particle, Kalman and unscented filters against bare torch loops and peers, in one run.

    python benchmarks/bench_filters.py [--only particle kalman unscented] [--rounds 7] [--json FILE] [--write] [--quick]

CPU time of one thread, rounds interleaved, medians. All rows of a table do the same work on the same data: evidence and
filtered mean at every step; rows that do less are marked with *. Outputs are compared with the exact answer in the run.
`--write` puts the result here:

-- last result --
2026-11-25, one thread of a x86_64 processor with AVX-512, 2 cores, Linux
python 3.11.7, torch 2.13.0+cpu, torchfilt 0.1.0, numpy 2.4.6, filterpy 2.0.0, torch-kf 0.4.3

Bootstrap filter, 6 states, 3 measured, systematic resampling at every step, 50 steps.
ns a particle and step (ratio to the bare in-place loop of the same precision, of the normals too):

                                          n = 1e3     n = 1e4     n = 1e5
-------------------------------------  ----------  ----------  ----------
f32 torchfilt                          192 (3.25)   45 (1.71)   31 (1.34)
f32 torchfilt, covariance too          210 (3.56)   51 (1.97)   37 (1.60)
f32 bare torch, in place                59 (1.00)   26 (1.00)   23 (1.00)
f32 bare torch, naive                  145 (2.46)  100 (3.84)  101 (4.29)
f64 torchfilt, fast normals            199 (2.71)   55 (1.33)   56 (1.25)
f64 bare torch, in place, f32 normals   74 (1.00)   41 (1.00)   45 (1.00)
f64 torchfilt                          265 (1.85)   87 (0.78)   88 (0.78)
f64 torchfilt, covariance too          306 (2.14)  102 (0.92)   99 (0.87)
f64 bare torch, in place               143 (1.00)  111 (1.00)  114 (1.00)
f64 bare torch, naive                  222 (1.55)  179 (1.62)  192 (1.69)
f64 filterpy resampler + NumPy         295 (2.06)  272 (2.46)  274 (2.42)
f64 particles                          206 (1.44)  131 (1.19)  147 (1.29)

ATen calls a step: torchfilt 59 (19 of them views), bare in place 33 (7).

Kalman filter, 6 states, 3 measured, 200 steps, float64 unless said.
ns a series and step (ratio to torchfilt with a covariance a row):

                                            1 series       100 series    10,000 series
-----------------------------------  ---------------  ---------------  ---------------
torchfilt                            139,496 (0.864)    1,457 (0.452)       42 (0.025)
torchfilt, covariance too            141,289 (0.875)    1,482 (0.460)       43 (0.026)
torchfilt f32                        141,539 (0.877)    1,483 (0.460)       30 (0.018)
torchfilt, a covariance a row        161,462 (1.000)    3,224 (1.000)    1,664 (1.000)
torch, the obvious batch              56,036 (0.347)    1,727 (0.536)    1,182 (0.710)
torch-kf*                             48,398 (0.300)    1,326 (0.411)      866 (0.520)
filterpy                              59,276 (0.367)  56,528 (17.532)  58,721 (35.290)
torchfilt, a tenth missing anywhere  165,412 (1.024)    4,119 (1.278)    1,987 (1.194)

* no log-likelihood. filterpy ran over at most 3 series, scaled.

Unscented Kalman filter, coordinated turn, range and bearing, 50 steps, float64 unless said.
ns a series and step (ratio to filterpy, which ran over at most 3 series, scaled):

                      1 series       100 series    10,000 series
-------------  ---------------  ---------------  ---------------
filterpy       360,185 (1.000)  350,805 (1.000)  351,353 (1.000)
torchfilt      556,801 (1.546)    8,336 (0.024)    2,684 (0.008)
torchfilt f32  528,129 (1.466)    7,473 (0.021)    2,092 (0.006)

Unscented particle filter, 6 states, one series: ns a particle and step.

                  ns
-------------  -----
f64, n = 200   7,523
f32, n = 200   7,236
f64, n = 1000  5,386
f32, n = 1000  4,714
-- end of the last result --
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import _harness as harness
import _loops as loops
import _problems as problems
import numpy as np
import torch
from _harness import Row
from torch import Tensor

import torchfilt as tf

HERE = Path(__file__).resolve().parent
PEERS = HERE.parent / ".venv-peers" / "bin" / "python"
SINGLE, DOUBLE = torch.float32, torch.float64


def linear_model(m: dict[str, Tensor], rows: int | None = None) -> tf.StateSpaceModel:
    """The constant-velocity model; with ``rows``, a prior covariance for each row, so that nothing can be shared."""
    factor = m["root_P0"] if rows is None else m["root_P0"].expand(rows, 6, 6).clone()
    initial = tf.Gaussian(torch.zeros(6, dtype=factor.dtype), factor)
    return tf.StateSpaceModel(
        initial,
        tf.LinearGaussian(m["F"], scale_tril=m["root_Q"]),
        tf.LinearGaussian(m["H"], scale_tril=m["root_R"]),
    )


def filtered(filter_: Any, ys: Tensor, record: str = "mean", seed: int = 0) -> tuple[Any, Any]:
    """Log-likelihood and means of torchfilt; the prior belongs to the first measurement."""
    history = filter_(ys, predict_first=False, record=record, seed=seed)
    return history.log_likelihood, history.mean


# --- particles --------------------------------------------------------------------------------------------------------


def particle_rows(problem: problems.Linear, n: int, peer: harness.Peer | None) -> dict[str, Row]:
    """All bootstrap filters with n particles."""
    single, double = loops.tensors(problem, SINGLE), loops.tensors(problem, DOUBLE)

    def library(m: dict[str, Tensor], record: str, fast: bool = False) -> Row:
        filter_ = tf.BootstrapFilter(linear_model(m), n, fast_normals=fast)
        return Row(lambda: filtered(filter_, m["ys"], record, seed=11))

    rows = {
        "f32 torchfilt": library(single, "mean"),
        "f32 torchfilt, covariance too": library(single, "moments"),
        "f32 bare torch, in place": Row(lambda: loops.bare_particles(single, n, SINGLE, 12)),
        "f32 bare torch, naive": Row(lambda: loops.naive_particles(single, n, 13)),
        "f64 torchfilt, fast normals": library(double, "mean", fast=True),
        "f64 bare torch, in place, f32 normals": Row(lambda: loops.bare_particles(double, n, SINGLE, 14)),
        "f64 torchfilt": library(double, "mean"),
        "f64 torchfilt, covariance too": library(double, "moments"),
        "f64 bare torch, in place": Row(lambda: loops.bare_particles(double, n, DOUBLE, 15)),
        "f64 bare torch, naive": Row(lambda: loops.naive_particles(double, n, 16)),
        "f64 filterpy resampler + NumPy": Row(lambda: loops.filterpy_particles(problem, n, 17), rounds=3),
    }
    if peer is not None:
        rows["f64 particles"] = Row(lambda: _asked(peer.ask({"particles": n, "seed": 18})), rounds=3, elsewhere=True)
    return rows


def _asked(answer: dict[str, Any]) -> tuple[float, tuple[float, np.ndarray]]:
    return answer["seconds"], (answer["log_likelihood"], np.array(answer["means"]))


def bare_row(name: str) -> str:
    """The in-place loop that a row is compared with: same precision, same precision of the normals."""
    if name in ("f64 torchfilt, fast normals", "f64 bare torch, in place, f32 normals"):
        return "f64 bare torch, in place, f32 normals"
    return f"{name[:3]} bare torch, in place"


def check_particles(problem: problems.Linear, n: int, timings: dict[str, harness.Timing]) -> None:
    """Evidence and means against the exact ones, in units of the Monte Carlo error of 12 runs of the bare loop.

    log Z^ is taken as normal around log Z - s^2 / 2 with deviation s. Six s with s from 12 runs: below 1e-4 a row by
    chance. The mean may be half again as far from the exact mean as the worst of the 12.

    Raises:
        AssertionError: a row did something else.
    """
    total, means, variances = problems.kalman(problem)
    m = loops.tensors(problem, DOUBLE)
    runs = [loops.bare_particles(m, n, SINGLE, 100 + k) for k in range(12)]
    spread = float(np.std([run[0] for run in runs], ddof=1))

    def distance(mean: Any) -> float:
        apart = (np.asarray(mean, dtype=float) - means[:, 0]) / np.sqrt(variances)
        return float(np.sqrt((apart**2).mean()))

    worst = max(distance(run[1]) for run in runs)
    for name, timing in timings.items():
        log_likelihood, mean = timing.outputs
        off = (float(log_likelihood) - (float(total[0]) - spread**2 / 2)) / spread
        assert abs(off) < 6, f"{name}, n = {n}: log-likelihood {off:.1f} standard errors from the exact one"
        apart = distance(mean)
        assert apart < 1.5 * worst, f"{name}, n = {n}: mean off by {apart:.3g}, the bare loops by {worst:.3g} at most"


def particle_calls(dtype: torch.dtype = SINGLE) -> tuple[float, float]:
    """ATen calls of a bootstrap step, and how many of them are views."""
    m = loops.tensors(problems.constant_velocity(16), dtype)
    filter_ = tf.BootstrapFilter(linear_model(m), 1000)
    return harness.calls_per_step(lambda steps: filtered(filter_, m["ys"][:steps]))


def run_particles(sizes: list[int], steps: int, rounds: int) -> tuple[str, dict[str, Any]]:
    """Table and JSON."""
    problem = problems.constant_velocity(steps)
    given = {name: value.tolist() for name, value in problem._asdict().items()}
    peer = harness.Peer(PEERS, HERE / "_peers_particles.py", given) if PEERS.exists() else None
    results: dict[str, dict[int, harness.Timing]] = {}
    for n in sizes:
        timings = harness.interleave(particle_rows(problem, n, peer), rounds if n < 50_000 else min(rounds, 3))
        check_particles(problem, n, timings)
        for name, timing in timings.items():
            results.setdefault(name, {})[n] = timing
    if peer is not None:
        peer.close()
    body, ratios = [], {}
    for name, by_size in results.items():
        cells = []
        for n, timing in by_size.items():
            ratio = timing.seconds / results[bare_row(name)][n].seconds
            ratios[f"{name}, n = {n}"] = ratio
            cells.append(f"{timing.seconds / steps / n * 1e9:.0f} ({ratio:.2f})")
        body.append([name, *cells])
    calls, views = particle_calls()
    bare_calls, bare_views = harness.calls_per_step(
        lambda k: loops.bare_particles(loops.tensors(problems.constant_velocity(k), SINGLE), 1000, SINGLE, 0)
    )
    text = (
        f"Bootstrap filter, 6 states, 3 measured, systematic resampling at every step, {steps} steps.\n"
        "ns a particle and step (ratio to the bare in-place loop of the same precision, of the normals too):\n\n"
        + harness.table(["", *(f"n = {n:.0e}".replace("e+0", "e") for n in sizes)], body)
        + f"\n\nATen calls a step: torchfilt {calls:.0f} ({views:.0f} of them views), "
        f"bare in place {bare_calls:.0f} ({bare_views:.0f})."
        + ("" if peer is not None else "\nparticles was left out: make env-peers.")
    )
    return text, {
        "ratios": ratios,
        "calls_per_step": {"torchfilt": [calls, views], "bare": [bare_calls, bare_views]},
        "seconds": {name: {n: timing.rounds for n, timing in by_size.items()} for name, by_size in results.items()},
        "peer": peer.versions if peer is not None else None,
    }


# --- Kalman -----------------------------------------------------------------------------------------------------------


def kalman_rows(problem: problems.Linear) -> dict[str, Row]:
    """All Kalman filters over (t, series, 3)."""
    single, double = loops.tensors(problem, SINGLE), loops.tensors(problem, DOUBLE)
    series = problem.ys.shape[1]
    few = min(series, 3)
    shared, narrow = tf.KalmanFilter(linear_model(double)), tf.KalmanFilter(linear_model(single))
    own = tf.KalmanFilter(linear_model(double, series))
    slow = 2 if series >= 10_000 else 1_000_000
    rows = {
        "torchfilt": Row(lambda: filtered(shared, double["ys"])),
        "torchfilt, covariance too": Row(lambda: filtered(shared, double["ys"], "moments")),
        "torchfilt f32": Row(lambda: filtered(narrow, single["ys"])),
        "torchfilt, a covariance a row": Row(lambda: filtered(own, double["ys"]), rounds=slow),
        "torch, the obvious batch": Row(lambda: loops.obvious_kalman(double), rounds=slow),
        "torch-kf*": Row(lambda: loops.torch_kf_series(double), rounds=slow),
        "filterpy": Row(lambda: loops.filterpy_kalman(problem, few), rounds=3, scale=series / few),
    }
    return rows


def missing_row(problem: problems.Linear) -> Row:
    """Every series misses another tenth of its numbers: no covariance can be shared, and the data are not the same."""
    m = loops.tensors(problem, DOUBLE)
    gone = torch.rand(m["ys"].shape, generator=torch.Generator().manual_seed(3)) < 0.1
    ys = torch.where(gone, math.nan, m["ys"])
    filter_ = tf.KalmanFilter(linear_model(m))
    return Row(lambda: filtered(filter_, ys), rounds=2 if m["ys"].shape[1] >= 10_000 else 1_000_000)


def check_kalman(problem: problems.Linear, timings: dict[str, harness.Timing]) -> None:
    """Evidence to 1e-9 relative in float64, 1e-4 in float32; means to 1e-9 and 1e-3 of the measurement noise.

    Raises:
        AssertionError: a row did something else.
    """
    total, means, _ = problems.kalman(problem)
    for name, timing in timings.items():
        log_likelihood, mean = (np.asarray(output, dtype=float) for output in timing.outputs)
        rows = mean.shape[1]
        relative, absolute = (1e-4, 2e-3) if name.endswith("f32") else (1e-9, 2e-9)
        wrong = np.abs(mean - means[:, :rows]).max()
        assert wrong < absolute * max(1.0, np.abs(means).max()), f"{name}: mean off by {wrong:.3g}"
        if not np.isnan(log_likelihood).all():
            wrong = np.abs(log_likelihood / total[:rows] - 1).max()
            assert wrong < relative, f"{name}: log-likelihood off by {wrong:.3g}, relative"


def run_kalman(sizes: list[int], steps: int, rounds: int) -> tuple[str, dict[str, Any]]:
    """Table and JSON."""
    results: dict[str, dict[int, harness.Timing]] = {}
    for series in sizes:
        problem = problems.constant_velocity(steps, series)
        rows = kalman_rows(problem)
        extra = "torchfilt, a tenth missing anywhere"
        timings = harness.interleave({**rows, extra: missing_row(problem)}, rounds)
        check_kalman(problem, {name: timing for name, timing in timings.items() if name != extra})
        for name, timing in timings.items():
            results.setdefault(name, {})[series] = timing
    reference = "torchfilt, a covariance a row"
    body, ratios = [], {}
    for name, by_size in results.items():
        cells = []
        for series, timing in by_size.items():
            ratio = timing.seconds / results[reference][series].seconds
            ratios[f"{name}, series = {series}"] = ratio
            cells.append(f"{timing.seconds / steps / series * 1e9:,.0f} ({ratio:.3f})")
        body.append([name, *cells])
    text = (
        f"Kalman filter, 6 states, 3 measured, {steps} steps, float64 unless said.\n"
        "ns a series and step (ratio to torchfilt with a covariance a row):\n\n"
        + harness.table(["", *(f"{series:,} series" for series in sizes)], body)
        + "\n\n* no log-likelihood. filterpy ran over at most 3 series, scaled."
    )
    seconds = {name: {n: timing.rounds for n, timing in by_size.items()} for name, by_size in results.items()}
    return text, {"ratios": ratios, "seconds": seconds}


# --- unscented --------------------------------------------------------------------------------------------------------


def turn(x: Tensor) -> Tensor:
    """Coordinated turn over 1 s, (..., 5)."""
    px, py, vx, vy, w = x.unbind(-1)
    small = w.abs() < 1e-9
    safe = torch.where(small, 1.0, w)
    sin, cos = w.sin(), w.cos()
    s, c = torch.where(small, 1.0, sin / safe), torch.where(small, 0.0, (1 - cos) / safe)
    return torch.stack([px + s * vx - c * vy, py + c * vx + s * vy, cos * vx - sin * vy, sin * vx + cos * vy, w], -1)


def range_bearing(x: Tensor) -> Tensor:
    """(..., 2)."""
    return torch.stack([torch.hypot(x[..., 0], x[..., 1]), torch.atan2(x[..., 1], x[..., 0])], -1)


def turn_model(problem: problems.Turn, dtype: torch.dtype) -> tf.StateSpaceModel:
    """Coordinated turn seen by range and bearing."""
    mean0, root0, root_q, root_r = (torch.tensor(part, dtype=dtype) for part in problem[:4])
    space = tf.Product(tf.Euclidean(1), tf.Angle(1))
    return tf.StateSpaceModel(
        tf.Gaussian(mean0, root0),
        tf.AdditiveGaussian(turn, scale_tril=root_q),
        tf.AdditiveGaussian(range_bearing, scale_tril=root_r, space=space),
    )


def run_unscented(sizes: list[int], particles: list[int], steps: int, rounds: int) -> tuple[str, dict[str, Any]]:
    """Unscented Kalman filter over many series, unscented particle filter on one."""
    body, seconds = [], {}
    head = ["", *(f"{series:,} series" for series in sizes)]
    cells: dict[str, list[str]] = {}
    for series in sizes:
        problem = problems.coordinated_turn(steps, series)
        few = min(series, 3)
        rows = {"filterpy": Row(lambda p=problem, k=few: loops.filterpy_unscented(p, k), 3, series / few)}
        for name, dtype in (("torchfilt", DOUBLE), ("torchfilt f32", SINGLE)):
            filter_ = tf.UnscentedKalmanFilter(turn_model(problem, dtype))
            ys = torch.tensor(problem.ys, dtype=dtype)
            rows[name] = Row(lambda f=filter_, y=ys: filtered(f, y), 2 if series >= 10_000 else 1_000_000)
        timings = harness.interleave(rows, rounds)
        truth, wide = (timings[name].outputs for name in ("filterpy", "torchfilt"))
        wrong = np.abs(np.asarray(wide[0])[:few] - truth[0]).max()
        assert wrong < 1e-6, f"unscented filters disagree: log-likelihood off by {wrong:.3g}"
        for name, timing in timings.items():
            each = timing.seconds / steps / series * 1e9
            ratio = timing.seconds / timings["filterpy"].seconds
            cells.setdefault(name, []).append(f"{each:,.0f} ({ratio:.3f})")
            seconds[f"{name}, series = {series}"] = timing.rounds
    body = [[name, *row] for name, row in cells.items()]
    text = (
        f"Unscented Kalman filter, coordinated turn, range and bearing, {steps} steps, float64 unless said.\n"
        "ns a series and step (ratio to filterpy, which ran over at most 3 series, scaled):\n\n"
        + harness.table(head, body)
    )
    lines = []
    for name, timing, n in unscented_particles(problems.constant_velocity(steps), particles, rounds):
        lines.append([name, f"{timing.seconds / steps / n * 1e9:,.0f}"])
        seconds[f"unscented particle filter, {name}"] = timing.rounds
    text += "\n\nUnscented particle filter, 6 states, one series: ns a particle and step.\n\n"
    text += harness.table(["", "ns"], lines)
    return text, {"seconds": seconds}


def unscented_particles(
    problem: problems.Linear, sizes: list[int], rounds: int
) -> list[tuple[str, harness.Timing, int]]:
    """Name, timing and n of each row; the evidence lies within six standard deviations (of 8 seeds) of the exact one.

    Raises:
        AssertionError: it does not.
    """
    exact = float(problems.kalman(problem)[0][0])
    filters, rows = {}, {}
    for n in sizes:
        for label, dtype in (("f64", DOUBLE), ("f32", SINGLE)):
            m = loops.tensors(problem, dtype)
            filters[f"{label}, n = {n}"] = (tf.UnscentedParticleFilter(linear_model(m), n), m["ys"], n)
    for name, (filter_, ys, _) in filters.items():
        rows[name] = Row(lambda f=filter_, y=ys: filtered(f, y))
    timings = harness.interleave(rows, rounds)
    for name, (filter_, ys, _) in filters.items():
        values = torch.stack([filtered(filter_, ys, seed=1 + k)[0] for k in range(8)]).double()
        off = (float(timings[name].outputs[0]) - exact) / float(values.std())
        assert abs(off) < 6, f"unscented particle filter, {name}: log-likelihood off by {off:.1f} deviations"
    return [(name, timings[name], filters[name][2]) for name in filters]


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run, print, and write what is asked for; returns the JSON content."""
    parser = argparse.ArgumentParser(description="Filters against bare torch loops and peers.")
    parser.add_argument("--only", nargs="+", choices=("particle", "kalman", "unscented"), help="tables to run")
    parser.add_argument("--rounds", type=int, default=7, help="interleaved rounds (default 7)")
    parser.add_argument("--json", metavar="FILE", help="write all times, ratios and versions there")
    parser.add_argument("--write", action="store_true", help="put the result into this file's docstring")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it runs; times mean nothing")
    options = parser.parse_args(arguments)
    quick, rounds = options.quick, 1 if options.quick else options.rounds
    tables: dict[str, Callable[[], tuple[str, dict[str, Any]]]] = {
        "particle": lambda: run_particles([500] if quick else [1000, 10_000, 100_000], 10 if quick else 50, rounds),
        "kalman": lambda: run_kalman([1, 4] if quick else [1, 100, 10_000], 5 if quick else 200, rounds),
        "unscented": lambda: run_unscented(
            [1, 4] if quick else [1, 100, 10_000], [50] if quick else [200, 1000], 5 if quick else 50, rounds
        ),
    }
    found = harness.versions("torch", "torchfilt", "numpy", "filterpy", "torch-kf")
    content: dict[str, Any] = {"machine": harness.machine(), "versions": found}
    texts = [harness.title(found)]
    print(texts[0], flush=True)
    for name in options.only or tables:
        with harness.one_thread():
            text, content[name] = tables[name]()
        print(f"\n{text}", flush=True)
        texts.append(text)
    if options.json:
        harness.write_json(options.json, content)
    if options.write:
        harness.write_result(__file__, "\n\n".join(texts))
    return content


if __name__ == "__main__":
    main()
