"""What the studies share: filters one after the other, a table, numbers and figures in a run folder."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from torchfilt.missions.stages import Arrays, Stages, versions, write_outcome


def run_study(
    names: Sequence[str],
    settings: Any,
    out: str | Path,
    *,
    recipe: Callable[[str], dict[str, Any]],
    follow: Callable[[str], Arrays],
    summarize: Callable[[str, Arrays], dict[str, Any]],
    table: Callable[[dict[str, Any]], list[str]],
    draw: Callable[[dict[str, Arrays], Path], list[Path]] | None,
    say: Callable[[str], None],
    what: str = "filters",
    more: dict[str, Any] | None = None,
    notes: Callable[[dict[str, Arrays]], list[str]] = lambda results: [],
) -> dict[str, Any]:
    """Run filters on the same data; those that the folder already holds for their recipe are not run again.

    Args:
        names: of the filters. settings: a dataclass, JSON-ready.
        out: run folder; receives stages/, figures/, table.txt and metrics.json.
        recipe: everything that a filter's result depends on, by its name, JSON-ready.
        follow: arrays of a filter by its name; ``cpu_s`` among them, a number or one a step.
        summarize: numbers of a filter, JSON-ready, from its name and arrays.
        table: lines of a text, from what is returned. notes: lines below it, from all arrays.
        draw: writes figures of all arrays into a folder and tells the files; None draws none.
        say: told what happens, a line each.
        what: the name under which the filters are found in what is returned. more: what else is.

    Returns:
        What metrics.json holds: more, filters (by name), settings, versions.
    """
    folder = Path(out)
    stages = Stages(folder / "stages", say)
    results: dict[str, Arrays] = {}
    found: dict[str, Any] = {}
    for name in names:
        own = recipe(name)
        kept = stages.has(name, own)
        results[name] = stages.get(name, own, partial(follow, name))
        found[name] = summarize(name, results[name])
        say(f"{name}: " + ("as before" if kept else f"{results[name]['cpu_s'].sum():.1f} s of CPU"))
    summary = {**(more or {}), what: found, "settings": asdict(settings), "versions": versions()}
    lines = [*table(summary), *notes(results)]
    for line in lines:
        say(line)
    write_outcome(folder, lines, summary)
    if draw is not None:
        for path in draw(results, folder / "figures"):
            say(f"wrote {path}")
    return summary


def digest(values: Iterable[Any]) -> str:
    """Of tensors by their bytes, of tuples by their parts, of anything else by its text: whether two logs are equal."""
    found = hashlib.sha256()
    for value in values:
        if isinstance(value, tuple):
            found.update(digest(value).encode())
        else:
            found.update(value.numpy().tobytes() if isinstance(value, Tensor) else str(value).encode())
    return found.hexdigest()
