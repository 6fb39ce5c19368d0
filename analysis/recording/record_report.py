"""What `record` did, in words and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from analysis.kit.tables import make_table
from analysis.recording.record import Recorded
from planner.files import Json
from planner.shown import counted


def recorded_json(done: Recorded) -> Json:
    """The JSON object of `record --json`; of an interrupted recording, the rollouts that were done."""
    cells = done.tally.accessible
    rows = [
        asdict(row) | {"visited": row.visited / cells, "survived": row.survived / cells, "cells_visited": row.visited}
        for row in done.rows
    ]
    return {
        **({"partial": True} if done.partial else {}),
        "file": str(done.path),
        "bytes": done.path.stat().st_size,
        "steps": done.steps,
        "rollouts": rows,
        "settings": done.settings.to_json(),
        "accessible": cells,
        "evaluate_seconds": done.evaluate_seconds,
        "record_seconds": done.record_seconds,
    }


def print_recorded(done: Recorded, console: Console) -> None:
    """The same in words."""
    cells = done.tally.accessible
    columns = ("rollout", "picked as", "ends", "step", "visited, %", "survived, %", "alive", "events")
    table = make_table(columns, left=("picked as", "ends"), dropped=("events", "survived, %"))
    for row in done.rows:
        ends = "all lost" if row.outcome == "stopped" else row.outcome.replace("_", " ")
        shares = (f"{100 * count / cells:.1f}" for count in (row.visited, row.survived))
        table.add_row(
            str(row.rollout), ", ".join(row.picks), ends, str(row.time), *shares, str(row.alive), str(row.events)
        )
    console.print(table)
    size = done.path.stat().st_size / 1e6
    console.print(
        f"{done.path}: {size:.2f} MB, {counted(done.steps, 'step')} in full; {done.tally.rollouts:,} evaluated",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


def interrupted_lines(done: Recorded, asked: Path) -> list[str]:
    """What is said of an interrupted recording that should have gone to `asked`; nothing of a whole one."""
    if not done.partial:
        return []
    stays = "" if done.path == asked else f"; {asked} was there before and stays"
    count = f"{len(done.rows):,} of {counted(len(done.settings.ids), 'rollout')}"
    return [f"interrupted: {done.path} holds {count}{stays}"]
