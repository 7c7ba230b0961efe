"""Particle filters on the 16-state inertial error model against a bare torch loop, in one run.

    python benchmarks/bench_inertial.py [--only particle others] [--rounds 11] [--json FILE] [--write] [--quick]

CPU time of one thread, float64, rounds interleaved, medians. Bootstrap filter (sir) and regularised filter that keeps
the cloud's moments (rpf), systematic resampling at every step; all rows do the same work on the same data:
log-likelihood and filtered mean at every step. The bare loop is written by hand for this one problem
(`_inertial_loop.py`); given the same random numbers it has the library's outputs to rounding, which every run checks.
`--write` puts the result here:

-- last result --
2026-11-25, one thread of a x86_64 processor with AVX-512, 2 cores, Linux
python 3.11.7, torch 2.13.0+cpu, torchfilt 0.1.0

16 states, fixes of heading and position, 50 steps. ns a particle and step (ratios to the
bare loop with torch's own normals and with torchfilt's):

                                                n = 500           n = 2,000        n = 10,000         8 x 2,000
-----------------------------------  ------------------  ------------------  ----------------  ----------------
sir torchfilt                        2,158 (1.52, 1.48)    691 (1.39, 1.43)  294 (1.17, 1.40)  299 (1.16, 1.38)
sir torchfilt, covariance too        2,328 (1.64, 1.60)    800 (1.61, 1.66)  364 (1.45, 1.74)  381 (1.48, 1.76)
sir bare torch                       1,417 (1.00, 0.97)    497 (1.00, 1.03)  252 (1.00, 1.20)  257 (1.00, 1.19)
sir bare torch, torchfilt's normals  1,454 (1.03, 1.00)    482 (0.97, 1.00)  210 (0.83, 1.00)  216 (0.84, 1.00)
rpf torchfilt                        3,184 (1.59, 1.58)  1,111 (1.30, 1.48)  671 (1.12, 1.45)  637 (1.07, 1.38)
rpf torchfilt, covariance too        3,232 (1.62, 1.60)  1,176 (1.38, 1.57)  713 (1.19, 1.54)  701 (1.18, 1.52)
rpf bare torch                       2,000 (1.00, 0.99)    853 (1.00, 1.14)  597 (1.00, 1.29)  594 (1.00, 1.29)
rpf bare torch, torchfilt's normals  2,018 (1.01, 1.00)    748 (0.88, 1.00)  464 (0.78, 1.00)  460 (0.77, 1.00)

A step of 8 x 2,000 sir particles takes 4.8 ms.
A step of 8 x 2,000 rpf particles takes 10.2 ms.
ATen calls a step (views), sir: torchfilt 574 (79), bare torch 467 (64).
ATen calls a step (views), rpf: torchfilt 742 (132), bare torch 543 (79).

All filters of the study, 8 runs as a batch: 2,000 particles a run, 1,000 of the Rao-Blackwellised ones,
window of 5. ms a step of all runs:

                ms
-----------  -----
es-kf          1.9
es-kf-gated    2.1
es-kf-open     2.1
ckf            1.8
bank-36        4.6
sir            4.4
rpf-plain      8.7
rpf           10.0
mpf           20.2
mpf-window    26.8
mpf-literal   42.1
rbpf         158.9
rbpf-shared    6.4
-- end of the last result --
"""

import argparse
from collections.abc import Callable
from typing import Any

import _harness as harness
import _inertial_loop as bare
import torch
from _harness import Row
from torch import Tensor

from torchfilt.missions.inertial import FILTERS, InertialSettings, Scene, make_filter, make_scene
from torchfilt.noise import NoiseSource
from torchfilt.run import Filter

KINDS = ("sir", "rpf")
# The bare loop with the normals torch draws, and with those the library draws, which take half the time.
OWN, SAME = "bare torch", "bare torch, torchfilt's normals"


def given(filter_: Filter[Any], batch: tuple[int, ...], seed: int) -> tuple[Callable[[int], bare.Numbers], Tensor]:
    """The random numbers of a filter's run, for the bare loop; and those of its start."""
    belief = filter_.init(batch, seed).belief
    n = belief.x.shape[-2]
    # The start is step 0 and purpose 0 of the source.
    start = NoiseSource(seed).normal((*batch, n, 15), 0, 0, belief.x).movedim(-1, 0)

    def numbers(k: int) -> bare.Numbers:
        noise = filter_.draw(belief, k, seed)
        assert noise is not None and noise.proposal is not None
        kernel = None if noise.kernel is None else noise.kernel.movedim(-1, 0)
        return bare.Numbers(noise.resampling, noise.proposal.movedim(-1, 0), kernel)

    return numbers, start


def drawn_alike(
    n: int, batch: tuple[int, ...], regularize: bool, seed: int
) -> tuple[Callable[[int], bare.Numbers], Tensor]:
    """As `_inertial_loop.drawn_by_torch`, by the library's generator of normals."""
    source, like = NoiseSource(seed), torch.empty(0, dtype=torch.float64)

    def normals(count: int, step: int, stream: int) -> Tensor:
        return source.normal((*batch, n, count), step, stream, like).movedim(-1, 0)

    def numbers(k: int) -> bare.Numbers:
        kernel = normals(15, k, 2) if regularize else None
        return bare.Numbers(source.uniform((*batch, 1), k, 0, like), normals(6, k, 1), kernel)

    return numbers, normals(15, 0, 3)


class Case:
    """One filter with n particles, over the scene's first run or all of its runs as a batch."""

    def __init__(self, scene: Scene, kind: str, n: int, rows: int | None) -> None:
        self.kind, self.n, self.rows = kind, n, rows
        self.batch = () if rows is None else (rows,)
        self.regularize = kind == "rpf"
        pick = 0 if rows is None else slice(rows)
        self.fixes, self.controls = scene.fixes[:, pick], scene.controls[:, pick]
        self.filter = make_filter(kind, scene, InertialSettings(particles=n))
        self.flight = bare.prepare(scene, rows)

    @property
    def name(self) -> str:
        """Of its column."""
        return f"n = {self.n:,}" if self.rows is None else f"{self.rows} x {self.n:,}"

    @property
    def particle_steps(self) -> int:
        """Of the whole run."""
        return len(self.fixes) * self.n * (self.rows or 1)

    def library(self, record: str = "mean", seed: int = 3) -> tuple[Tensor, Tensor]:
        """Log-likelihood and means of the library."""
        history = self.filter(self.fixes, self.controls, dt=1.0, seed=seed, record=record)
        return history.log_likelihood, history.mean

    def by_hand(self, numbers: Callable[[int], bare.Numbers], start: Tensor) -> tuple[Tensor, Tensor]:
        """The same of the bare loop."""
        return bare.run(self.flight, self.n, self.regularize, numbers, start)

    def timed(self) -> dict[str, Row]:
        """The rows to compare."""
        shape = (self.n, self.batch, self.regularize)
        return {
            "torchfilt": Row(self.library),
            "torchfilt, covariance too": Row(lambda: self.library("moments")),
            OWN: Row(lambda: self.by_hand(*bare.drawn_by_torch(*shape, 4))),
            SAME: Row(lambda: self.by_hand(*drawn_alike(*shape, 5))),
        }

    def check(self) -> None:
        """With the same random numbers the bare loop gives what the library gives.

        In units of the start's deviations. Resampling turns a difference of rounding into another ancestor where a
        cumulative weight lies within 1e-14 of a position, once in some 1e8 particle-steps.

        Raises:
            AssertionError: it does not.
        """
        total, means = self.library()
        found, found_means = self.by_hand(*given(self.filter, self.batch, 3))
        wrong = float((found - total).abs().max())
        assert wrong < 1e-9, f"{self.kind}, {self.name}: log-likelihoods differ by {wrong:.3g}"
        space, scale = self.filter.model.transition.space, self.filter.model.initial().scale_tril
        wrong = float((space.local(means, found_means) / scale).abs().max())
        assert wrong < 1e-9, f"{self.kind}, {self.name}: means differ by {wrong:.3g} deviations of the start"


def calls(scene: Scene, kind: str, n: int) -> dict[str, tuple[float, float]]:
    """ATen calls of a step, and how many of them are views, of the library and the bare loop."""
    case = Case(scene, kind, n, None)

    def by_hand(steps: int) -> None:
        flight = case.flight
        cut = flight._replace(controls=flight.controls[:steps], fixes=flight.fixes[:steps], seen=flight.seen[:steps])
        bare.run(cut, n, case.regularize, *bare.drawn_by_torch(n, (), case.regularize, 0))

    def library(steps: int) -> None:
        case.filter(case.fixes[:steps], case.controls[:steps], dt=1.0, record="mean")

    return {"torchfilt": harness.calls_per_step(library), OWN: harness.calls_per_step(by_hand)}


def run_particles(scene: Scene, sizes: list[tuple[int, int | None]], rounds: int) -> tuple[str, dict[str, Any]]:
    """Table and JSON of the rows against the bare loop."""
    ratios: dict[str, float] = {}
    strict: dict[str, float] = {}
    seconds: dict[str, list[float]] = {}
    cells: dict[str, list[str]] = {}
    lines, names = [], []
    for n, rows in sizes:
        for kind in KINDS:
            case = Case(scene, kind, n, rows)
            case.check()
            timings = harness.interleave(case.timed(), rounds)
            for name, timing in timings.items():
                key = f"{kind} {name}, {case.name}"
                ratios[key] = timing.seconds / timings[OWN].seconds
                strict[key] = timing.seconds / timings[SAME].seconds
                seconds[key] = timing.rounds
                each = timing.seconds / case.particle_steps * 1e9
                cells.setdefault(f"{kind} {name}", []).append(f"{each:,.0f} ({ratios[key]:.2f}, {strict[key]:.2f})")
            if rows is not None:
                step = timings["torchfilt"].seconds / len(case.fixes) * 1e3
                lines.append(f"A step of {case.name} {kind} particles takes {step:.1f} ms.")
        names.append(case.name)
    body = [[name, *found] for name, found in sorted(cells.items(), key=lambda item: KINDS.index(item[0][:3]))]
    for kind in KINDS:
        counted = calls(scene, kind, sizes[0][0])
        shown = ", ".join(f"{name} {total:.0f} ({views:.0f})" for name, (total, views) in counted.items())
        lines.append(f"ATen calls a step (views), {kind}: {shown}.")
    text = (
        f"16 states, fixes of heading and position, {len(scene.fixes)} steps. ns a particle and step (ratios to the\n"
        "bare loop with torch's own normals and with torchfilt's):\n\n" + harness.table(["", *names], body) + "\n\n"
    ) + "\n".join(lines)
    return text, {"ratios": ratios, "ratios_same_normals": strict, "seconds": seconds}


def run_others(scene: Scene, settings: InertialSettings, rounds: int) -> tuple[str, dict[str, Any]]:
    """Table and JSON of all filters of the study; for information, they are different methods."""
    rows = {}
    for name in FILTERS:
        filter_ = make_filter(name, scene, settings)
        state = filter_.init((settings.runs,), settings.seed)
        rows[name] = Row(
            lambda f=filter_, s=state: (
                f(scene.fixes, scene.controls, dt=1.0, state=s, record="mean", throw=False).log_likelihood
            )
        )
    timings = harness.interleave(rows, rounds)
    steps = len(scene.fixes)
    body = [[name, f"{timing.seconds / steps * 1e3:,.1f}"] for name, timing in timings.items()]
    text = (
        f"All filters of the study, {settings.runs} runs as a batch: {settings.particles:,} particles a run, "
        f"{settings.conditional_particles:,} of the Rao-Blackwellised ones,\nwindow of {settings.window}. "
        "ms a step of all runs:\n\n" + harness.table(["", "ms"], body)
    )
    return text, {"seconds": {name: timing.rounds for name, timing in timings.items()}}


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run, print, and write what is asked for; returns the JSON content."""
    parser = argparse.ArgumentParser(description="Inertial particle filters against a bare torch loop.")
    parser.add_argument("--only", nargs="+", choices=("particle", "others"), help="tables to run")
    parser.add_argument("--rounds", type=int, default=11, help="interleaved rounds (default 11)")
    parser.add_argument("--json", metavar="FILE", help="write all times, ratios and versions there")
    parser.add_argument("--write", action="store_true", help="put the result into this file's docstring")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it runs; times mean nothing")
    options = parser.parse_args(arguments)
    quick, rounds = options.quick, 1 if options.quick else options.rounds
    runs, steps, n = (2, 16, 100) if quick else (8, 50, 2000)
    settings = InertialSettings(runs=runs, steps=steps, particles=n, conditional_particles=n // 2)
    found = harness.versions("torch", "torchfilt")
    content: dict[str, Any] = {"machine": harness.machine(), "versions": found}
    texts = [harness.title(found)]
    print(texts[0], flush=True)
    with harness.one_thread():
        scene = make_scene(settings)
        sizes: list[tuple[int, int | None]] = [(50, None)] if quick else [(500, None), (2000, None), (10_000, None)]
        tables: dict[str, Callable[[], tuple[str, dict[str, Any]]]] = {
            "particle": lambda: run_particles(scene, [*sizes, (n, runs)], rounds),
            "others": lambda: run_others(scene, settings, min(rounds, 3)),
        }
        for name in options.only or tables:
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
