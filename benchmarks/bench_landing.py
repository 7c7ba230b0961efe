"""A step of the landing filters for one vehicle, against the 25 ms between two measurements, in one run.

    python benchmarks/bench_landing.py [--compiled] [--rounds 11] [--json FILE] [--write] [--quick]

CPU time of one thread, float64, one vehicle whose beacon is in view; medians over interleaved rounds of 40 steps.
`--compiled` adds the bank of 200 through `torch.compile(fullgraph=True)`, which takes minutes to compile; every run
checks that it gives what the eager one gives. `two factorisations` is what LAPACK alone takes for the two QR
factorisations of a bank's step, the floor of a square-root filter. `--write` puts the result here:

-- last result --
2026-11-25, one thread of a x86_64 processor with AVX-512, 2 cores, Linux
python 3.11.7, torch 2.13.0+cpu, torchfilt 0.1.0

15 error components, barometer and beacon:

                            ms a step  of 25 ms
--------------------------  ---------  --------
ukf                              2.12     0.085
llpf-50                          2.82     0.113
two factorisations of 50         0.31     0.012
llpf-200                         5.04     0.202
llpf-200 compiled                3.50     0.140
two factorisations of 200        1.19     0.048
llpf-1000                       26.94     1.078
two factorisations of 1000       6.33     0.253
-- end of the last result --
"""

import argparse
from collections.abc import Callable
from typing import Any

import _harness as harness
import torch
from _harness import Row
from torch import Tensor

import torchfilt as tf
from torchfilt.missions.landing.scene import LandingSettings, Scene, make_scene
from torchfilt.missions.landing.study import make_filter

PERIOD_MS, STEPS = 25.0, 40
SIZES = (50, 200, 1000)


def run_of(filter_: Any, scene: Scene, step: Callable[..., Any]) -> Callable[[], Tensor]:
    """Forty steps from the sight of the beacon on; gives the last mean."""
    first, start = int(scene.acquired[0]), filter_.init((1,))

    def run() -> Tensor:
        belief = start.belief
        with torch.no_grad():
            for k in range(first, first + STEPS):
                noise = filter_.draw(belief, k, 0)
                y, u = scene.measurements[k], scene.controls[k]
                belief, _ = step(belief, y, u, scene.dt, noise, "rows")
        mean: Tensor = belief.mean
        return mean

    return run


def factorisations(n: int) -> Callable[[], Tensor]:
    """Two batched QR factorisations of a bank's sizes, forty times."""
    generator = torch.Generator().manual_seed(0)
    columns = [
        torch.randn(n, rows, size, generator=generator, dtype=torch.float64) for rows, size in ((45, 15), (39, 18))
    ]

    def run() -> Tensor:
        for _ in range(STEPS):
            factors = [torch.linalg.qr(part, mode="r").R for part in columns]
        return factors[0][0, 0]

    return run


def rows_of(scene: Scene, sizes: tuple[int, ...], compiled: bool) -> dict[str, Row]:
    """What is timed, by name."""
    ukf = make_filter("ukf", scene)
    rows = {"ukf": Row(run_of(ukf, scene, ukf.advance))}
    for n in sizes:
        bank = tf.LocallyLinearizedParticleFilter(scene.model, n)
        eager = run_of(bank, scene, bank.advance)
        rows[f"llpf-{n}"] = Row(eager)
        # All sizes share one code object, whose recompilations torch limits; it is 200 members that must be in time.
        if compiled and (n == 200 or len(sizes) == 1):
            other = run_of(bank, scene, torch.compile(bank.advance, fullgraph=True))
            torch.testing.assert_close(other(), eager(), rtol=0, atol=1e-9)
            rows[f"llpf-{n} compiled"] = Row(other)
        rows[f"two factorisations of {n}"] = Row(factorisations(n))
    return rows


def run_steps(scene: Scene, sizes: tuple[int, ...], compiled: bool, rounds: int) -> tuple[str, dict[str, Any]]:
    """Table and JSON."""
    timings = harness.interleave(rows_of(scene, sizes, compiled), rounds)
    ms = {name: timing.seconds / STEPS * 1e3 for name, timing in timings.items()}
    body = [[name, f"{value:.2f}", f"{value / PERIOD_MS:.3f}"] for name, value in ms.items()]
    text = "15 error components, barometer and beacon:\n\n" + harness.table(["", "ms a step", "of 25 ms"], body)
    return text, {"ms": ms, "ratios": {name: value / PERIOD_MS for name, value in ms.items()}}


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run, print, and write what is asked for; returns the JSON content."""
    parser = argparse.ArgumentParser(description="Landing filters against real time.")
    parser.add_argument("--compiled", action="store_true", help="time the bank of 200 compiled too")
    parser.add_argument("--rounds", type=int, default=11, help="interleaved rounds (default 11)")
    parser.add_argument("--json", metavar="FILE", help="write all times, ratios and versions there")
    parser.add_argument("--write", action="store_true", help="put the result into this file's docstring")
    parser.add_argument("--quick", action="store_true", help="small banks, to see that it runs; times mean nothing")
    options = parser.parse_args(arguments)
    found = harness.versions("torch", "torchfilt")
    with harness.one_thread():
        scene = make_scene(LandingSettings(runs=1))
        sizes, rounds = ((5,), 1) if options.quick else (SIZES, options.rounds)
        text, numbers = run_steps(scene, sizes, options.compiled, rounds)
    print(f"{harness.title(found)}\n\n{text}")
    content = {"machine": harness.machine(), "versions": found, "particle": numbers}
    if options.json:
        harness.write_json(options.json, content)
    if options.write:
        harness.write_result(__file__, f"{harness.title(found)}\n\n{text}")
    return content


if __name__ == "__main__":
    main()
