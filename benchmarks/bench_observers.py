"""What a step of a Kalman filter costs beside one of a gain that was computed once, in one run.

    python benchmarks/bench_observers.py [--rounds 9] [--json FILE] [--write] [--quick]

CPU time of one thread, float64, whole series in one call; medians over interleaved rounds. The NumPy loops are what one
would write by hand for these matrices, all series at once, without log-likelihood or checks; filterpy takes one series
after the other, without log-likelihood too (it computes it when asked). Every run checks that the rows of a kind give
the same means. The last run shared its cores with other work: look at the ratios. `--write` puts the result here:

-- last result --
2026-11-25, one thread of a x86_64 processor with AVX-512, 2 cores, Linux
python 3.11.7, torch 2.13.0+cpu, torchfilt 0.1.0, numpy 2.4.6, filterpy 2.0.0

Constant velocity, 6 states, 3 measured, 200 steps, nothing missing.
ns a series and step (ratio to torchfilt Kalman, which shares one covariance between the series):

                                            1 series    10,000 series
------------------------------------  --------------  ---------------
torchfilt Kalman                      140,764 (1.00)        68 (1.00)
torchfilt Kalman, a covariance a row  158,910 (1.13)    1,630 (24.02)
torchfilt steady state                 65,691 (0.47)        62 (0.92)
torchfilt Luenberger                   34,063 (0.24)        43 (0.64)
torchfilt Luenberger, its covariance  135,158 (0.96)        62 (0.91)
filterpy                               15,795 (0.11)  15,040 (221.67)
NumPy loop, Kalman                     14,188 (0.10)        17 (0.25)
NumPy loop, constant gain               3,117 (0.02)        16 (0.23)

filterpy ran over at most 3 series, scaled.
-- end of the last result --
"""

import argparse
from functools import partial
from typing import Any

import _harness as harness
import _problems as problems
import numpy as np
import torch
from _harness import Row
from torch import Tensor

import torchfilt as tf
from torchfilt.models import control

SIZES, STEPS = (1, 10_000), 200
OPTIMAL, CONSTANT = "gain of each step", "gain of all steps"
BASE = "torchfilt Kalman"
_LOOPS = {OPTIMAL: "Kalman", CONSTANT: "constant gain"}


def numpy_kalman(problem: problems.Linear) -> np.ndarray:
    """Means (t, series, 6) by the covariance form, the covariance shared by all series."""
    F, Q, H, R, P, ys = problem
    mean, means = np.zeros((ys.shape[1], len(F))), np.empty((*ys.shape[:2], len(F)))
    for k, y in enumerate(ys):
        mean, P = mean @ F.T, F @ P @ F.T + Q
        S = H @ P @ H.T + R
        gain = np.linalg.solve(S, H @ P).T
        mean = mean + (y - mean @ H.T) @ gain.T
        P = P - gain @ S @ gain.T
        means[k] = mean
    return means


def numpy_constant(problem: problems.Linear, gain: np.ndarray) -> np.ndarray:
    """Means (t, series, 6) by one gain (6, 3)."""
    F, H, ys = problem.F, problem.H, problem.ys
    mean, means = np.zeros((ys.shape[1], len(F))), np.empty((*ys.shape[:2], len(F)))
    for k, y in enumerate(ys):
        mean = mean @ F.T
        mean = mean + (y - mean @ H.T) @ gain.T
        means[k] = mean
    return means


def filterpy_kalman(problem: problems.Linear, series: int) -> np.ndarray:
    """Means (t, series, 6) of the first ``series`` series, one after the other."""
    from filterpy.kalman import KalmanFilter

    means = np.empty((len(problem.ys), series, len(problem.F)))
    for row in range(series):
        filter_ = KalmanFilter(dim_x=6, dim_z=3)
        filter_.F, filter_.Q, filter_.H, filter_.R = problem.F, problem.Q, problem.H, problem.R
        filter_.P, filter_.x = problem.P0.copy(), np.zeros(6)
        for k, y in enumerate(problem.ys[:, row]):
            filter_.predict()
            filter_.update(y)
            means[k, row] = filter_.x
    return means


def rows_of(problem: problems.Linear) -> dict[str, tuple[str, Row]]:
    """What is timed, by name, with its kind: rows of one kind give the same means."""
    F, Q, H, R, P0, ys = (torch.tensor(part) for part in problem)
    series = ys.shape[1]
    prior = tf.Gaussian(F.new_zeros(6), torch.linalg.cholesky(P0))
    own = tf.Gaussian(F.new_zeros(6), torch.linalg.cholesky(P0).expand(series, 6, 6).clone())
    plant = control.ss(F, F.new_zeros(6, 0), H, dt=1.0)
    steady = tf.SteadyStateKalmanFilter(control.linear_model(plant, Q, R, prior))
    filters: dict[str, tuple[str, Any]] = {
        BASE: (OPTIMAL, tf.KalmanFilter(control.linear_model(plant, Q, R, prior))),
        "torchfilt Kalman, a covariance a row": (OPTIMAL, tf.KalmanFilter(control.linear_model(plant, Q, R, own))),
        "torchfilt steady state": (CONSTANT, steady),
        "torchfilt Luenberger": (CONSTANT, tf.LuenbergerObserver(plant, steady.gain)),
        "torchfilt Luenberger, its covariance": (CONSTANT, tf.LuenbergerObserver(plant, steady.gain, prior, Q, R)),
    }

    def means(filter_: Any) -> Tensor:
        mean: Tensor = filter_(ys, record="mean").mean
        return mean

    slow = 2 if series >= 10_000 else 1_000_000
    rows = {
        name: (kind, Row(partial(means, filter_), slow if "a row" in name else 1_000_000))
        for name, (kind, filter_) in filters.items()
    }
    few, gain = min(series, 3), steady.gain.numpy()
    rows["filterpy"] = OPTIMAL, Row(lambda: filterpy_kalman(problem, few), rounds=3, scale=series / few)
    rows["NumPy loop, Kalman"] = OPTIMAL, Row(lambda: numpy_kalman(problem))
    rows["NumPy loop, constant gain"] = CONSTANT, Row(lambda: numpy_constant(problem, gain))
    return rows


def check(kinds: dict[str, str], timings: dict[str, harness.Timing]) -> None:
    """Means of a kind agree to 1e-9 of metres and m/s, some thousand roundings of numbers up to 1e3.

    Raises:
        AssertionError: a row did something else.
    """
    expected = {kind: timings[f"NumPy loop, {loop}"].outputs for kind, loop in _LOOPS.items()}
    for name, timing in timings.items():
        found = np.asarray(timing.outputs)
        wrong = np.abs(found - expected[kinds[name]][:, : found.shape[1]]).max()
        assert wrong < 1e-9, f"{name}: means are off by {wrong:.3g}"


def run_observers(sizes: tuple[int, ...], steps: int, rounds: int) -> tuple[str, dict[str, Any]]:
    """Table and JSON."""
    cells: dict[str, list[str]] = {}
    ratios: dict[str, float] = {}
    seconds: dict[str, list[float]] = {}
    for series in sizes:
        rows = rows_of(problems.constant_velocity(steps, series))
        timings = harness.interleave({name: row for name, (_, row) in rows.items()}, rounds)
        check({name: kind for name, (kind, _) in rows.items()}, timings)
        for name, timing in timings.items():
            ratio = timing.seconds / timings[BASE].seconds
            cells.setdefault(name, []).append(f"{timing.seconds / steps / series * 1e9:,.0f} ({ratio:.2f})")
            ratios[f"{name}, series = {series}"] = ratio
            seconds[f"{name}, series = {series}"] = timing.rounds
    body = [[name, *row] for name, row in cells.items()]
    text = (
        f"Constant velocity, 6 states, 3 measured, {steps} steps, nothing missing.\n"
        f"ns a series and step (ratio to {BASE}, which shares one covariance between the series):\n\n"
        + harness.table(["", *(f"{series:,} series" for series in sizes)], body)
        + "\n\nfilterpy ran over at most 3 series, scaled."
    )
    return text, {"ratios": ratios, "seconds": seconds}


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run, print, and write what is asked for; returns the JSON content."""
    parser = argparse.ArgumentParser(description="Kalman filters and observers with a constant gain.")
    parser.add_argument("--rounds", type=int, default=9, help="interleaved rounds (default 9)")
    parser.add_argument("--json", metavar="FILE", help="write all times, ratios and versions there")
    parser.add_argument("--write", action="store_true", help="put the result into this file's docstring")
    parser.add_argument("--quick", action="store_true", help="few steps and series, to see that it runs")
    options = parser.parse_args(arguments)
    found = harness.versions("torch", "torchfilt", "numpy", "filterpy")
    with harness.one_thread():
        sizes, steps, rounds = ((1, 4), 8, 1) if options.quick else (SIZES, STEPS, options.rounds)
        text, numbers = run_observers(sizes, steps, rounds)
    print(f"{harness.title(found)}\n\n{text}")
    content = {"machine": harness.machine(), "versions": found, "particle": numbers}
    if options.json:
        harness.write_json(options.json, content)
    if options.write:
        harness.write_result(__file__, f"{harness.title(found)}\n\n{text}")
    return content


if __name__ == "__main__":
    main()
