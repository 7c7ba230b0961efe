"""What the studies on logs share: filters one after the other, a table, numbers and figures in a run folder."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import Tensor

from torchfilt.missions.stages import Arrays, Stages, versions, write_outcome


def run_study(
    names: Sequence[str],
    settings: Any,
    recipe: dict[str, Any],
    out: str | Path,
    *,
    follow: Callable[[str], Arrays],
    summarize: Callable[[Arrays], dict[str, Any]],
    table: Callable[[dict[str, Any]], list[str]],
    draw: Callable[[dict[str, Arrays], Path], list[Path]] | None,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Run filters on one log; those that the folder already holds for this recipe are not run again.

    Args:
        names: of the filters. settings: a dataclass. recipe: what results depend on beside it, JSON-ready.
        out: run folder; receives stages/, figures/, table.txt and metrics.json.
        follow: arrays of a filter by its name, ``cpu_s`` among them. summarize: its numbers. table: lines of a text.
        draw: writes figures of all arrays into a folder and tells the files; None draws none.
        say: told what happens, a line each.

    Returns:
        What metrics.json holds: filters (by name), settings, versions.
    """
    folder, recipe = Path(out), {**asdict(settings), **recipe}
    stages = Stages(folder / "stages", say)
    results: dict[str, Arrays] = {}
    summary: dict[str, Any] = {"filters": {}}
    for name in names:
        kept = stages.has(name, recipe)
        results[name] = stages.get(name, recipe, lambda name=name: follow(name))  # type: ignore[misc]
        summary["filters"][name] = summarize(results[name])
        say(f"{name}: " + ("as before" if kept else f"{results[name]['cpu_s']:.1f} s of CPU"))
    summary |= {"settings": asdict(settings), "versions": versions()}
    lines = table(summary)
    for line in lines:
        say(line)
    write_outcome(folder, lines, summary)
    if draw is not None:
        for path in draw(results, folder / "figures"):
            say(f"wrote {path}")
    return summary


def digest(values: Iterable[Any]) -> str:
    """Of tensors by their bytes, of anything else by its text: whether two logs are the same."""
    found = hashlib.sha256()
    for value in values:
        found.update(value.numpy().tobytes() if isinstance(value, Tensor) else str(value).encode())
    return found.hexdigest()
