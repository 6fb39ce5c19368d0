"""What `mrac-jax starts` says: the best starts in a sentence, the others as a table, the JSON object."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from analysis.depots.answer import Place, Starts
from analysis.kit.face import json_end
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import between, counted, percent
from analysis.statistics.estimate import Estimate
from planner.files import Json

SHOWN = 10
"""Places in the table; the JSON object holds all."""


def headline(starts: Starts) -> str:
    """Where to start, what is covered from there, and how much more that is than now. Figures of fresh rollouts."""
    robots, best = counted(len(starts.starts), "robot"), starts.places[starts.best]
    if starts.partial:
        return f"Interrupted. Best found so far for {robots}: {best.at}."
    shown = starts.confirmed.counted if starts.confirmed is not None else None
    covered = "" if shown is None else f"{percent(shown.mean)} {starts.covered} on average"
    if starts.stay and not starts.depot:
        return f"Stay: nothing found is surely better than {standing_words(starts)}: {covered}."
    what = f"Best depot found for {robots}: {best.at}, {covered}" if starts.depot else f"Start at {best.at}: {covered}"
    if starts.gain is None:
        where = " They stand there now: stay." if starts.best == starts.here else ""
        return f"{what}.{where}"
    if starts.stay:
        return f"{what}; that is not surely better than {standing_words(starts)}: stay, unless it has to be a depot."
    return f"{what}, {_points(starts.gain)} more than from {standing_words(starts)}."


def standing_words(starts: Starts) -> str:
    """Where the team stands if nobody says otherwise."""
    named = starts.world.starts is not None and len(starts.world.starts) >= len(starts.starts)
    return "the starts of the input" if named else f"the default starts ({starts.world.team.start})"


def _points(gain: Estimate) -> str:
    return f"{gain.said(100, ' points')}"


def findings(starts: Starts) -> Iterator[str]:
    """How sure that is, and how much starts matter here."""
    if starts.confirmed is not None:
        yield f"Fresh rollouts: {_confirmed(starts, starts.confirmed)} robots lost."
    best = starts.places[starts.best]
    if starts.gain is not None and starts.stay:
        low, high = (100 * end for end in starts.gain.ci95)
        mean = f"{100 * starts.gain.mean:+.2f} points ({between(low, high)}, 95 %)"
        yield f"The best {'depot' if starts.depot else 'other place'} found, {best.at}, against it: {mean}."
    others = [place for place in starts.simulated if place is not best]
    if others:
        worst = min((p.counted.mean for p in others if p.counted), default=0.0)
        count = f"{starts.beaten} of the {counted(len(others), 'other place')}"
        said = f"It surely beats {count} simulated" if starts.beaten else (
            f"No significant difference from the {counted(len(others), 'other place')} simulated")  # fmt: skip
        of_value = "" if starts.world.value is None else " of the value"
        yield f"{said} (95 %, all together); the worst covers {percent(worst)}{of_value}."
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
    return [*words, "--rollouts", str(choices.rollouts), "--seed", str(choices.next_seed)]


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
               "behind, points", "rollouts", "")  # fmt: skip
    dropped = ("one robot", "bound", "rollouts", "lost")
    title = "Simulated on the same luck, the best first"
    table = make_table(columns, title, left=("starts", ""), dropped=dropped, padding=(0, 1, 0, 0))
    now = [place for place in starts.simulated[SHOWN:] if place.now]
    for place in (*starts.simulated[:SHOWN], *now):
        alone = "" if place.one_robot is None else f"{place.one_robot:.1f}"
        figures: tuple[str, ...] = ("",) * (5 if valued else 3)
        if place.coverage is not None and place.losses is not None:
            worth = () if place.value is None else _columns(place.value)
            figures = (*worth, *_columns(place.coverage), f"{place.losses.mean:.2f}")
        behind = "" if place.behind is None else f"{100 * place.behind[0]:.1f} .. {100 * place.behind[1]:.1f}"
        marks = ["best"] * (place is starts.places[starts.best]) + ["now"] * place.now
        at = place.at.replace(", ", ",")
        table.add_row(at, f"{place.screen:.1f}", alone, *figures, behind, f"{place.rollouts:,}", ", ".join(marks))
    return table


def _columns(estimate: Estimate) -> tuple[str, str]:
    low, high = (100 * end for end in estimate.ci95)
    return f"{100 * estimate.mean:.2f}", between(low, high)


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
        ("surely better than", f"{starts.beaten} of {len(starts.simulated) - 1} others (95 %)"),
    ]
    if starts.confirmed is not None:
        shown.append(("fresh rollouts", f"{_confirmed(starts, starts.confirmed)} robots lost"))
    if starts.gain is not None:
        shown.append(("best found less now", _points(starts.gain)))
    return shown + [("note", note) for note in starts.notes]


def starts_json(starts: Starts) -> Json:
    """The JSON object of `starts`; coverage: fractions of the accessible cells, `value`: of all value.

    What is told of the starts themselves is of fresh rollouts, unless it was interrupted.
    """
    confirmed, here = starts.confirmed, None if starts.here is None else starts.places[starts.here]
    shown = starts.chosen if confirmed is None else confirmed
    return {
        "starts": starts.starts.tolist(),
        "depot": starts.depot,
        "coverage": _json(shown.coverage),
        **({} if shown.value is None else {"value": shown.value.to_json()}),
        "stay": starts.stay,
        "gain": _json(starts.gain),
        "now": None if here is None else _place_json(here, False),
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
