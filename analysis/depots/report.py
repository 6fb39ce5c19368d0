"""What `mrac-jax starts` says: the best starts, how much they are worth, and the other places."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from rich.table import Table

from analysis.depots.answer import Place, Starts
from analysis.kit.folder import json_text
from analysis.kit.tables import make_table
from analysis.kit.words import without_level
from analysis.report.blocks import CellMaps, KeyFigure, Part, Report
from analysis.report.words import (
    asked,
    luck_words,
    map_words,
    run_again,
    search_end,
    share_figure,
    sourced,
    team_figure,
)
from analysis.statistics.coverage import losses_said
from analysis.statistics.words import between, of_all
from planner.files import Json
from planner.shown import counted, percent

SHOWN = 10
"""Places in the table; the JSON object holds all."""


def report(starts: Starts) -> Report:
    """Where to start, on the map; the places that were simulated; the plan from the best."""
    choices, robots, maps = starts.choices, len(starts.starts), lambda: _maps(starts)
    all_of_all = len(starts.candidates) * choices.rollouts
    share = f", {percent(starts.rolled / all_of_all)} of simulating every one in full" if starts.depot else ""
    return Report(
        "starts", "starts", asked(starts.world, robots, "where to start?"),
        headline(starts), lambda: _json(starts), list(findings(starts)), _key_figures(starts),
        heading=(
            f"{map_words(starts.world, starts.cells, robots)}; {'one depot' if starts.depot else 'a start each'}",
            f"{counted(len(starts.candidates), 'candidate')}, {counted(len(starts.simulated), 'place')} simulated, "
            + luck_words(starts.world, choices, starts.engine, f"{counted(starts.rolled, 'rollout')}, "
                         f"{choices.rollouts:,} of the last two{share}; "),
        ),
        picture=maps, parts=[Part("Places", [_table(starts)], _footnotes(starts))], notes=starts.notes,
        settings=starts.settings.shown(starts.world.pace), pace=starts.world.pace, pictures={"starts.png": maps},
        files={"plan.json": lambda: json_text(starts.plan().to_json(), compact=True)},
    )  # fmt: skip


def headline(starts: Starts) -> str:
    """Where to start, what is covered from there, and how much more that is than now. Figures of fresh rollouts."""
    robots, best = counted(len(starts.starts), "robot"), starts.places[starts.best]
    if starts.partial:
        return f"Interrupted. Best found so far for {robots}: {best.at}."
    shown = starts.confirmed.counted if starts.confirmed is not None else None
    covered = "" if shown is None else f"{percent(shown.mean)} {starts.covered} on average" + " (exact)" * starts.exact
    if starts.stay and not starts.depot:
        return f"Stay: nothing found is surely better than {standing_words(starts)}: {covered}."
    what = f"Best depot found for {robots}: {best.at}, {covered}" if starts.depot else f"Start at {best.at}: {covered}"
    if starts.gain is None:
        where = " They stand there now: stay." if starts.best == starts.here else ""
        return f"{what}.{where}"
    if starts.stay:
        return f"{what}; that is not surely better than {standing_words(starts)}: stay, unless it has to be a depot."
    return f"{what}, {without_level(starts.gain.said(100, ' points'))} more than from {standing_words(starts)}."


def standing_words(starts: Starts) -> str:
    """Where the team stands if nobody says otherwise."""
    named = starts.world.starts is not None and len(starts.world.starts) >= len(starts.starts)
    return "the starts of the input" if named else f"the default starts ({starts.world.team.start})"


def findings(starts: Starts) -> Iterator[str]:
    """How sure that is, and how much starts matter here."""
    again = starts.confirmed
    if again is not None and again.coverage is not None and again.losses is not None:
        worth = "" if again.value is None else f"{again.value.said(100, ' %')} of the value and "
        cells = "" if again.value is None else " of the cells"
        covered = f"{worth}{again.coverage.said(100, ' %')}{cells} covered"
        yield sourced(
            again.rollouts, without_level(f"{covered}, {losses_said(again.losses, len(starts.starts))} lost.")
        )
    best = starts.places[starts.best]
    if starts.gain is not None and starts.stay:
        low, high = (100 * end for end in starts.gain.ci95)
        mean = f"{100 * starts.gain.mean:+.2f} points ({'exact' if low == high else f'{between(low, high)}, 95 %'})"
        yield f"The best {'depot' if starts.depot else 'other place'} found, {best.at}, against it: {mean}."
    others = [place for place in starts.simulated if place is not best]
    if others:
        worst = min((p.counted.mean for p in others if p.counted), default=0.0)
        number = counted(len(others), "other place")
        said = f"No significant difference from the {number} simulated"
        if starts.beaten:
            of_all = "the" if starts.beaten == len(others) else f"{starts.beaten} of the"
            said = f"It surely beats {of_all} {number} simulated"
        of_value = "" if starts.world.value is None else " of the value"
        how = "exact" if starts.exact else "95 %, all together"
        yield f"{said} ({how}); the worst covers {percent(worst)}{of_value}."
    if starts.words:
        yield f"run it: {command_of(starts)}"


def command_of(starts: Starts) -> str:
    """The command that evaluates the best starts as they were here."""
    at = ";".join(f"{row},{col}" for row, col in starts.starts.tolist())
    deadline = starts.choices.deadline
    ends = [] if deadline is None else ["--deadline", str(deadline)]
    return run_again(starts.words, ["--starts", at, *ends], starts.choices, exact=starts.exact)


def _key_figures(starts: Starts) -> list[KeyFigure]:
    out, again = list[KeyFigure](), starts.confirmed
    if again is not None and again.counted is not None and again.losses is not None:
        name = "visited on average" if again.value is None else "of the value visited"
        fresh = "" if starts.exact else ", fresh rollouts"
        out = [share_figure(again.counted, name, fresh), team_figure(again.losses, len(starts.starts))]
    if starts.gain is not None:
        low, high = (100 * end for end in starts.gain.ci95)
        note = f"{'exact' if low == high else between(low, high)}, against {standing_words(starts)}"
        out.append(KeyFigure(f"{100 * starts.gain.mean:+.2f} points", "best found", note))
    how = "" if starts.exact else ", all together with 95 %"
    others = f"of {counted(len(starts.simulated) - 1, 'other')} simulated{how}"
    return [*out, KeyFigure(f"{starts.beaten}", "surely beaten", others)]


def _maps(starts: Starts) -> CellMaps:
    """Coverage by depot where it was simulated, and threats."""
    from matplotlib.colors import Normalize

    from analysis.page.cell_maps import CellLayer
    from analysis.pictures.style import COVERED, THREAT

    world = starts.world
    threat = np.nan_to_num(np.where(world.accessible(starts.starts), world.threat, 0.0).astype(np.float64))
    layers = [CellLayer("Threat", "Chance that one visit of the cell stops the robot.", threat, THREAT, "%", digits=2)]
    if starts.depot:
        covered, known = np.zeros(world.shape), [place for place in starts.simulated if place.counted is not None]
        for place in known:
            covered[tuple(place.starts[0])] = place.counted.mean if place.counted else 0.0
        low, high = covered[covered > 0].min(initial=1.0), covered.max()
        about = f"Share {starts.covered} on average if all robots start in the cell; 0 where that was not simulated."
        layers.insert(0, CellLayer("Coverage by depot", about, covered, COVERED, "%", digits=2, short="Depots",
                                   norm=Normalize(low, high if high > low else low + 0.01), discs=True,
                                   labels=tuple(np.linspace(low, high, 4 if high > low else 1))))  # fmt: skip
    return CellMaps(world, starts.starts, layers)


def _table(starts: Starts) -> Table:
    """What was simulated, the best first."""
    valued = starts.world.value is not None
    columns = ("starts", "bound", "one robot", *["value, %", "from .. to"] * valued, "visited, %", "from .. to", "lost",
               "behind, points", "rollouts", "")  # fmt: skip
    dropped = ("one robot", "bound", "rollouts", "lost")
    title = "Simulated on common random numbers, the best first"
    table = make_table(columns, title, left=("starts", ""), dropped=dropped, padding=(0, 1, 0, 0))
    now = [place for place in starts.simulated[SHOWN:] if place.now]
    for place in (*starts.simulated[:SHOWN], *now):
        alone = "" if place.one_robot is None else f"{place.one_robot:.1f}"
        figures: tuple[str, ...] = ("",) * (5 if valued else 3)
        if place.coverage is not None and place.losses is not None:
            worth = () if place.value is None else place.value.columns(100.0, 100)
            figures = (*worth, *place.coverage.columns(100.0, 100), of_all(place.losses.mean, len(starts.starts)))
        behind = ""
        if place.behind is not None:
            low, high = (100 * end for end in place.behind)
            behind = f"{low:.2f}" if low == high else between(low, high, 1)
        marks = ["best"] * (place is starts.places[starts.best]) + ["now"] * place.now
        at = place.at.replace(", ", ",")
        table.add_row(
            at,
            f"{place.screen:.1f}",
            alone,
            *figures,
            behind,
            f"{place.rollouts:,}" if place.rollouts else "",
            ", ".join(marks),
        )
    return table


def _footnotes(starts: Starts) -> list[str]:
    counts = "cells" if starts.world.value is None else "value"
    more = len(starts.simulated) - SHOWN
    return [
        f"bound: {counts} that no strategy exceeds on average, by the chance to reach each; one robot: eq. (4), "
        f"{counts} of one robot's plan."
        + " ±: half the 95 % interval, in brackets its ends; behind: all of these intervals hold together with 95 %; "
        "places put aside early have few rollouts." * (not starts.exact),
        *([f"The JSON object has {counted(more, 'further place')}."] if more > 0 else []),
    ]


def _json(starts: Starts) -> Json:
    """Coverage: fractions of the accessible cells, `value`: of all value.

    What is told of the starts themselves is of fresh rollouts, unless it was interrupted.
    """
    again, here = starts.confirmed, None if starts.here is None else starts.places[starts.here]
    shown = starts.chosen if again is None else again
    confirmed = None
    if again is not None:
        confirmed = {"coverage": again.coverage, "losses": again.losses, **_value(again),
                     "first_rollout": starts.choices.rollouts}  # fmt: skip
    return {
        "starts": starts.starts,
        "depot": starts.depot,
        "coverage": shown.coverage,
        **_value(shown),
        "stay": starts.stay,
        "gain": starts.gain,
        "now": None if here is None else _place_json(here, False),
        "confirmed": confirmed,
        "candidates": [_place_json(place, starts.depot) for place in starts.places],
        "command": command_of(starts) if starts.words else None,
        "rolled": starts.rolled,
        **search_end(starts),
    }


def _value(place: Place) -> Json:
    return {} if place.value is None else {"value": place.value}


def _place_json(place: Place, depot: bool) -> Json:
    told = {name: getattr(place, name) for name in ("screen", "one_robot", "coverage", "losses", "behind", "rollouts")}
    return {"starts": place.starts[:1] if depot else place.starts, **told, **_value(place)}
