"""Shared by the benchmarks: interleaved rounds in CPU time, calls counted, result tables and where they are kept."""

import datetime
import importlib.metadata
import json
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import _threads  # noqa: F401 - first of all
import torch
from torch.utils._python_dispatch import TorchDispatchMode

VIEWS = {"expand", "permute", "select", "slice", "squeeze", "t", "transpose", "unsqueeze", "view", "detach", "alias"}
VIEWS |= {"diagonal", "as_strided", "split", "unbind", "_unsafe_view"}
BEGIN, END = "-- last result --", "-- end of the last result --"


class Row(NamedTuple):
    """A thing to be timed.

    run: does the work and returns its outputs, or (CPU seconds, outputs) where the work is done by another process.
    rounds: how often at most; times are multiplied by ``scale`` where only a part of the work is done.
    """

    run: Callable[[], Any]
    rounds: int = 1_000_000
    scale: float = 1.0
    elsewhere: bool = False


class Timing(NamedTuple):
    """Median CPU seconds, all rounds, and the outputs of the last one."""

    seconds: float
    rounds: list[float]
    outputs: Any


def interleave(rows: dict[str, Row], rounds: int) -> dict[str, Timing]:
    """Run all rows in turn, ``rounds`` times after one warm-up, so that a busy spell of the machine meets all alike."""
    outputs: dict[str, Any] = {}
    seconds: dict[str, list[float]] = {name: [] for name in rows}
    for turn in range(-1, rounds):
        for name, row in rows.items():
            if turn >= row.rounds or (turn < 0 and row.rounds == 1):
                continue
            start = time.process_time()
            result = row.run()
            spent = time.process_time() - start
            if row.elsewhere:
                spent, result = result
            if turn >= 0:
                seconds[name].append(spent * row.scale)
                outputs[name] = result
    return {name: Timing(statistics.median(all_), all_, outputs[name]) for name, all_ in seconds.items()}


class Calls(TorchDispatchMode):
    """Counts ATen calls; ``views`` are those that move no data."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))

    @property
    def views(self) -> int:
        return sum(name in VIEWS for name in self.names)


def calls_per_step(run: Callable[[int], Any], short: int = 6, long: int = 16) -> tuple[float, float]:
    """ATen calls a step of ``run(steps)``, and how many of them are views: the difference of two lengths."""
    counts = []
    for steps in (short, long):
        with torch.no_grad(), Calls() as calls:
            run(steps)
        counts.append((len(calls.names), calls.views))
    (few, few_views), (many, many_views) = counts
    return (many - few) / (long - short), (many_views - few_views) / (long - short)


def one_thread() -> AbstractContextManager[Any]:
    """One thread and no gradients: what every row runs under."""
    torch.set_num_threads(1)
    return torch.no_grad()


class Peer:
    """A row in an environment of its own: one JSON document a line, to and fro."""

    def __init__(self, python: Path, script: Path, problem: dict[str, Any]) -> None:
        self.process = subprocess.Popen(
            [str(python), str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self.versions = self.ask(problem)

    def ask(self, document: dict[str, Any]) -> dict[str, Any]:
        """Send a document, wait for the answer.

        Raises:
            RuntimeError: the process ended.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(document) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the peer process ended with status {self.process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """End the process by ending its input."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=60)
        self.process.stdout.close()


def versions(*packages: str) -> dict[str, str]:
    """Versions of Python and of the installed ones among ``packages``."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def machine() -> str:
    """The machine in neutral words."""
    wide = " with AVX-512" if "AVX512" in torch.backends.cpu.get_cpu_capability() else ""
    return f"one thread of a {platform.machine()} processor{wide}, {os.cpu_count()} cores, {platform.system()}"


def table(head: list[str], body: list[list[str]]) -> str:
    """Left-aligned first column, the rest right-aligned."""
    widths = [max(len(row[k]) for row in [head, *body]) for k in range(len(head))]
    lines = []
    for row in [head, ["-" * width for width in widths], *body]:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def title(found: dict[str, str]) -> str:
    """Date, machine and versions: the first lines of a result."""
    listed = ", ".join(f"{name} {version}" for name, version in found.items())
    return f"{datetime.date.today()}, {machine()}\n{listed}"


def write_result(script: str, text: str) -> None:
    """Put a result into the script's own docstring, between the two marker lines."""
    path = Path(script)
    source = path.read_text()
    pattern = re.compile(f"{re.escape(BEGIN)}\n.*?{re.escape(END)}", re.DOTALL)
    if len(pattern.findall(source)) != 1:
        raise ValueError(f"{path.name} must hold the lines {BEGIN!r} and {END!r} once")
    path.write_text(pattern.sub(lambda _: f"{BEGIN}\n{text}\n{END}", source, count=1))


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """One JSON document."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(json.dumps(content, indent=1) + "\n")
