"""What `mrac-jax sweep` says: a sentence, the table, the JSON object, progress, and the folder of `--out`."""

from __future__ import annotations

import math
from importlib.metadata import version

from rich.console import Console

from analysis.sweeps.rows import Row
from analysis.sweeps.rows_report import percent, print_rows, row_json, shown
from analysis.sweeps.sweep import Sweep
from planner.arguments import argument
from planner.files import Json
from planner.shown import counted

PICTURES = ("visited", "time")


def headline(sweep: Sweep) -> str:
    """How much was done, and how sure it is, in one sentence."""
    spec, finished = sweep.spec, sweep.finished
    cases = counted(len(sweep.rows), "setting")
    on = "one map" if spec.maps is None else counted(max((row.maps for row in sweep.rows), default=0), "map")
    ran = f"{finished.rollouts:,} rollouts run" if finished.rollouts else "nothing to run"
    reused = f", {finished.reused:,} taken from the store" if finished.reused else ""
    begins = "Interrupted: " if sweep.partial else ""
    said = f"{begins}{cases} on {on}: {ran}{reused} in {duration(finished.seconds)}"
    if not math.isnan(sweep.widest):
        said += f"; every mean visited coverage is within ± {100 * sweep.widest:.2f} points (95 %)"
    return said + "."


def answer_of(sweep: Sweep) -> str:
    """What came out, in one sentence: the least and the most covered of the settings."""
    low, high = (pick(sweep.rows, key=lambda row: row.estimate("visited").mean) for pick in (min, max))
    on = "one map" if sweep.spec.maps is None else f"a mean over {counted(high.maps, 'map')}"
    if low is high:
        return f"{percent(high.estimate('visited'))} % of the accessible cells visited, {on}."
    ends = (f"{percent(row.estimate('visited'))} % ({named(row)})" for row in (low, high))
    return f"Visited of the accessible cells, {on}: from {' to '.join(ends)}."


def named(row: Row) -> str:
    """A row's labels in words."""
    return ", ".join(f"{name.replace('_', ' ')} {shown(value)}" for name, value in row.labels.items())


def notes_of(sweep: Sweep) -> list[str]:
    """What a user should know about precision: where the spread comes from, and whether it was enough."""
    notes = []
    share = sweep.within_share
    if share is not None:
        what = "more maps" if share < 0.5 else "more rollouts a map, or more maps,"
        noise = f"{100 * share:.1f} % of the spread between maps is noise of the rollouts"
        notes.append(f"where the interval is widest, {noise}: {what} narrow it")
    if not sweep.reached and not sweep.partial:
        notes.append(f"{argument('precision')} was not reached with all maps and rollouts that there are")
    cut = sum(row.timeouts for row in sweep.rows)
    if cut:
        notes.append(f"{cut:,} rollouts were cut off at the limit of steps (timeout): raise max_steps")
    return notes


def duration(seconds: float) -> str:
    """ "9.3 s", "4 min 10 s", "2 h 5 min"."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def print_sweep(sweep: Sweep, console: Console) -> None:
    """The sentence, the table, the notes."""
    console.print(headline(sweep), highlight=False)
    print_rows(sweep.rows, console)
    for note in notes_of(sweep):
        console.print(note, highlight=False)


def sweep_json(sweep: Sweep) -> Json:
    """The JSON object of `--json`."""
    spec, finished = sweep.spec, sweep.finished
    return {
        "spec": str(spec.source),
        "maps": spec.maps,
        "first_seed": None if spec.maps is None else spec.first_seed,
        "rollouts": spec.rollouts,
        "seed": spec.base["seed"],
        "settings": [row_json(row) for row in sweep.rows],
        "rollouts_run": finished.rollouts,
        "rollouts_reused": finished.reused,
        "seconds": finished.seconds,
        "precision": sweep.precision,
        "precision_reached": sweep.reached if sweep.precision is not None else None,
        "widest": None if math.isnan(sweep.widest) else sweep.widest,
        "within_share": sweep.within_share,
        "notes": notes_of(sweep),
        "partial": sweep.partial,
        "version": version("mrac-jax"),
    }
