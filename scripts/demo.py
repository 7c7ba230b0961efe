#!/usr/bin/env python
"""The main job, end to end: learn relative dynamics, then track with them.

Two studies run side by side, one process each: the simulated formation
(run_formation.py) and a day of GRACE A and B (run_grace.py). Both are usable
alone. Interrupted, the same command goes on where it stood. The run folder
receives metrics.json with the numbers of both, and their figures.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

from _command import EXIT_FAILED, EXIT_OK, EXIT_USAGE, new_parser
from jsonargparse import ArgumentParser

STUDIES = {"paper": "run_formation.py", "grace": "run_grace.py"}
SCRIPTS = Path(__file__).parent


EXAMPLES = """\
examples:
  the defaults: 10 runs of the formation, 5 noise seeds on the log
    demo.py
  more runs
    demo.py --runs 100 --grace-runs 20 --out runs/demo-100

exit codes: 0 done, 1 failed, 2 wrong use, 130 or 143 stopped by SIGINT or
SIGTERM; finished stages are kept.
"""


def build_parser() -> ArgumentParser:
    """All options; nothing heavy is imported here, so that --help answers at once."""
    parser = new_parser("demo.py", __doc__, EXAMPLES)

    group = parser.add_argument_group("Studies")
    group.add_argument("--runs", default=10, type=int, metavar="R", help="Monte-Carlo runs of the simulated formation")
    group.add_argument("--grace-runs", default=5, type=int, metavar="R", help="noise seeds on the GRACE log")
    group.add_argument("--seed", default=0, type=int, metavar="N", help="of noise, initial errors and particles")

    group = parser.add_argument_group("Output")
    group.add_argument("--out", default="runs/demo", type=str, metavar="DIR", help="run folder")
    group.add_argument("--force", action="store_true", help="start anew instead of going on with what is there")
    group.add_argument("--quiet", action="store_true", help="print nothing but errors and the tables")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run and return the exit code: 0 done, 1 failed, 2 wrong use, 128 + signal after an interruption."""
    options = build_parser().parse_args(arguments)
    for name in ("runs", "grace_runs"):
        if options[name] < 1:
            print(f"demo.py: --{name.replace('_', '-')} must be at least 1, got {options[name]}", file=sys.stderr)
            return EXIT_USAGE
    folder = Path(options.out)
    if folder.exists() and not folder.is_dir():
        print(f"demo.py: --out {folder} is not a folder", file=sys.stderr)
        return EXIT_USAGE
    begin = time.monotonic()
    common = ["--seed", str(options.seed), "--force" if options.force else "--resume"]
    common += ["--quiet"] if options.quiet else []
    runs = {"paper": options.runs, "grace": options.grace_runs}
    children = {
        name: _start(script, [*common, "--runs", str(runs[name]), "--out", str(folder / name)], row)
        for row, (name, script) in enumerate(STUDIES.items())
    }
    code = _wait(children)
    if code:
        return code
    metrics = _merge(folder)
    _write(folder / "metrics.json", metrics)
    for name in STUDIES:
        print((folder / name / "table.txt").read_text(), end="\n\n")
    print(f"{folder / 'metrics.json'}: all numbers; figures in {folder}/*/figures; {time.monotonic() - begin:.0f} s")
    return EXIT_OK


def _start(script: str, arguments: list[str], row: int) -> subprocess.Popen[bytes]:
    """A study in a process of its own with one thread: two studies, two cores."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "TQDM_POSITION": str(row)}
    # A session of its own: signals reach it from here, once, and not a second time from the terminal.
    return subprocess.Popen(
        [sys.executable, str(SCRIPTS / script), *arguments], env=environment, start_new_session=True
    )


def _wait(children: dict[str, "subprocess.Popen[bytes]"]) -> int:
    """Wait for all; pass signals on; a failed study ends the others, whose finished stages are kept."""
    received: list[int] = []

    def forward(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for child in children.values():
            if child.poll() is None:
                child.send_signal(signal.SIGINT)

    before = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        while any(child.poll() is None for child in children.values()):
            time.sleep(0.1)
            failed = [name for name, child in children.items() if child.poll()]
            if failed and not received:
                forward(0, None)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    failed = [name for name, child in children.items() if child.returncode]
    if received and received[0]:
        print("demo.py: stopped; the same command goes on from here", file=sys.stderr)
        return 128 + received[0]
    if failed:
        print(f"demo.py: the study {failed[0]!r} failed, see above", file=sys.stderr)
        return EXIT_FAILED
    return EXIT_OK


def _merge(folder: Path) -> dict[str, Any]:
    """Numbers of all studies in one."""
    merged: dict[str, Any] = {}
    seeds: set[int] = set()
    for name in STUDIES:
        own = json.loads((folder / name / "metrics.json").read_text())
        merged[name] = own[name]
        merged["versions"] = merged.get("versions", {}) | own.get("versions", {})
        seeds |= set(own.get("seeds", []))
    merged["seeds"] = sorted(seeds)
    return merged


def _write(path: Path, value: Any) -> None:
    from torchfilt.storage import atomic_write

    atomic_write(path, (json.dumps(value, indent=1) + "\n").encode())


if __name__ == "__main__":
    sys.exit(main())
