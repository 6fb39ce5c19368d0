"""What `mrac-jax starts` says: the best starts in a sentence, the others as a table, the JSON object."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from analysis.depots.answer import Place, Starts
from analysis.kit.face import json_end
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import counted, percent
from analysis.statistics.estimate import Estimate
from planner.files import Json

SHOWN = 20
"""Places in the table; the JSON object holds all."""


def headline(starts: Starts) -> str:
    """Where to start, and what is covered from there."""
    best, robots = starts.chosen, len(starts.starts)
    what = f"The best depot for {counted(robots, 'robot')} is" if starts.depot else "The best starts are"
    covered = "" if best.counted is None else f": {percent(best.counted.mean)} {starts.covered} on average"
    said = f"{what} {best.at}{covered}."
    return f"Interrupted. {said}" if starts.partial else said


def findings(starts: Starts) -> Iterator[str]:
    """How sure that is, and how much starts matter here."""
    if starts.confirmed is not None:
        count = starts.choices.rollouts
        yield (
            f"On {count:,} rollouts that had no part in the choice (ids {count:,} to {2 * count - 1:,}): "
            f"{_confirmed(starts, starts.confirmed)} robots lost."
        )
    others = starts.simulated[1:]
    if others:
        worst = min((p.counted.mean for p in others if p.counted), default=0.0)
        of_value = "" if starts.world.value is None else " of the value"
        yield (
            f"It is certain to be better than {starts.beaten} of the {len(others)} others that were simulated, all "
            f"together with 95 %; the worst of them covers {percent(worst)}{of_value}."
        )
    close = [p for p in others if p.behind is not None and p.behind[0] <= 0]
    if close and not starts.depot:
        yield f"{counted(len(close), 'other team')} of starts cannot be told apart from it on these rollouts."
    elif close:
        yield f"{counted(len(close), 'other depot')} cannot be told apart from it on these rollouts."
    if starts.words:
        yield f"run it: {shlex.join(command_of(starts))}"


def _confirmed(starts: Starts, place: Place) -> str:
    coverage, value, losses = place.coverage, place.value, place.losses
    assert coverage is not None and losses is not None
    worth = "" if value is None else f"{value.said(100, ' %')} of the value and "
    cells = "" if value is None else " of the cells"
    return f"{worth}{coverage.said(100, ' %')}{cells} covered, {losses.said()}"


def command_of(starts: Starts) -> list[str]:
    """The command that rolls out the best starts as they were here."""
    at = ";".join(f"{row},{col}" for row, col in starts.starts.tolist())
    choices = starts.choices
    words = ["mrac-jax", "evaluate", *starts.words, "--starts", at]
    if choices.deadline is not None:
        words += ["--deadline", str(choices.deadline)]
    return [*words, "--rollouts", str(choices.rollouts), "--seed", str(choices.seed)]


def print_starts(starts: Starts, console: Console) -> None:
    """Print the answer, how sure it is, and what was simulated."""
    print_lines(console, (headline(starts), *findings(starts), *heading(starts)))
    console.print(places_table(starts))
    print_lines(console, footnotes(starts))


def heading(starts: Starts) -> list[str]:
    """What was looked at."""
    choices = starts.choices
    all_of_all = len(starts.candidates) * choices.rollouts
    share = f", {percent(starts.rolled / all_of_all)} of simulating every one in full" if starts.depot else ""
    ends = "" if choices.deadline is None else f", every mission ended at step {choices.deadline:,}"
    return [
        f"{starts.world.source}: {starts.cells:,} accessible cells, {counted(len(starts.starts), 'robot')}, "
        f"{counted(len(starts.candidates), 'candidate')}; {counted(len(starts.simulated), 'place')} simulated in "
        f"{counted(starts.rolled, 'rollout')}{share}; seed {choices.seed}, {starts.engine}{ends}"
    ]


def places_table(starts: Starts) -> Table:
    """What was simulated, the best first."""
    valued = starts.world.value is not None
    columns = ("starts", "bound", "one robot", *["value, %", "from .. to"] * valued, "visited, %", "from .. to", "lost",
               "behind, points", "rollouts")  # fmt: skip
    title = "Simulated on the same luck, the best first"
    table = make_table(columns, title, left=("starts",), padding=(0, 1, 0, 0))
    for place in starts.simulated[:SHOWN]:
        alone = "" if place.one_robot is None else f"{place.one_robot:.1f}"
        figures: tuple[str, ...] = ("",) * (5 if valued else 3)
        if place.coverage is not None and place.losses is not None:
            worth = () if place.value is None else _columns(place.value)
            figures = (*worth, *_columns(place.coverage), f"{place.losses.mean:.2f}")
        behind = "" if place.behind is None else f"{100 * place.behind[0]:.1f}..{100 * place.behind[1]:.1f}"
        table.add_row(place.at, f"{place.screen:.1f}", alone, *figures, behind, f"{place.rollouts:,}")
    return table


def _columns(estimate: Estimate) -> tuple[str, str]:
    low, high = (f"{100 * end:.2f}" for end in estimate.ci95)
    return f"{100 * estimate.mean:.2f}", f"{low}..{high}"


def footnotes(starts: Starts) -> list[str]:
    """How to read it."""
    counts = "cells" if starts.world.value is None else "value"
    lines = [
        f"bound: {counts} that no strategy exceeds on average, by the chance to reach each; one robot: eq. (4), "
        f"{counts} of one robot's plan. behind: all of these intervals hold together with 95 %; places put aside "
        "early have few rollouts."
    ]
    if len(starts.simulated) > SHOWN:
        lines.append(f"{len(starts.simulated) - SHOWN} further places are in the JSON object.")
    return lines + [f"note: {note}" for note in starts.notes]


def rows(starts: Starts) -> list[tuple[str, str]]:
    """For a console or a notebook."""
    shown = [
        ("starts", starts.chosen.at),
        ("certain to beat", f"{starts.beaten} of {len(starts.simulated) - 1} others"),
    ]
    if starts.confirmed is not None:
        shown.append(("on other rollouts", f"{_confirmed(starts, starts.confirmed)} robots lost"))
    return shown + [("note", note) for note in starts.notes]


def starts_json(starts: Starts) -> Json:
    """The JSON object of `starts`; coverage: fractions of the accessible cells, `value`: of all value."""
    chosen, confirmed = starts.chosen, starts.confirmed
    return {
        "starts": starts.starts.tolist(),
        "depot": starts.depot,
        "coverage": _json(chosen.coverage),
        **({} if chosen.value is None else {"value": chosen.value.to_json()}),
        "confirmed": None
        if confirmed is None
        else {"coverage": _json(confirmed.coverage), "losses": _json(confirmed.losses)}
        | ({} if confirmed.value is None else {"value": confirmed.value.to_json()})
        | {"first_rollout": starts.choices.rollouts},
        "candidates": [_place_json(place, starts.depot) for place in starts.places],
        "command": shlex.join(command_of(starts)) if starts.words else None,
        "robots": len(starts.starts),
        "accessible": starts.cells,
        "rollouts": starts.choices.rollouts,
        "rolled": starts.rolled,
        "seed": starts.choices.seed,
        "engine": starts.engine,
        **json_end(starts, starts.notes),
    }


def _json(estimate: Estimate | None) -> Json | None:
    return None if estimate is None else estimate.to_json()


def _place_json(place: Place, depot: bool) -> Json:
    return {
        "starts": place.starts[:1].tolist() if depot else place.starts.tolist(),
        "screen": place.screen,
        "one_robot": place.one_robot,
        "coverage": _json(place.coverage),
        **({} if place.value is None else {"value": place.value.to_json()}),
        "losses": _json(place.losses),
        "behind": None if place.behind is None else list(place.behind),
        "rollouts": place.rollouts,
    }
