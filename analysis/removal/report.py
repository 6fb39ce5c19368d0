"""What `mrac-jax clear` says: what to clear, what that wins, all threats on the map and in figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from rich.table import Table

from analysis.kit.tables import make_table
from analysis.removal.answer import Clearing
from analysis.removal.threat import Gain, Threat, Weighed, by_cell
from analysis.report.blocks import CellMaps, KeyFigure, Part, Report
from analysis.report.words import asked, luck_words, map_words, search_end, sourced
from planner.arguments import exactly
from planner.files import Json
from planner.shown import chance, counted

KINDS = {"areas": "connected areas of danger", "sources": "polygons, points and sites of the scenario"}
KINDS_OF_GAIN = {"cells": "Cells", "of value": "Value"}
SHOWN = 12
"""Threats in the table; the JSON object holds all."""


def report(clearing: Clearing) -> Report:
    """What to clear first, with the map of gains; every threat."""
    choices, robots = clearing.choices, len(clearing.starts)
    return Report(
        "clear", "clear", asked(clearing.world, robots, "what to clear first?"), headline(clearing),
        lambda: _json(clearing), list(findings(clearing)), _key_figures(clearing),
        heading=(
            f"{map_words(clearing.world, clearing.cells, robots)}, {counted(len(clearing.options), 'threat')} "
            f"({KINDS[clearing.remove]})",
            luck_words(clearing.world, choices, clearing.engine,
                       f"{counted(choices.rollouts, 'rollout')} of the last two, the same ids for all; "),
        ),
        picture=lambda: _maps(clearing), parts=[Part("Threats", [_table(clearing)], _footnotes(clearing))],
        notes=clearing.notes, settings=clearing.settings.shown(clearing.world.pace), pace=clearing.world.pace,
        pictures={"clear.png": lambda: _maps(clearing, 0), "risk_paid.png": lambda: _maps(clearing, 2)},
    )  # fmt: skip


def headline(clearing: Clearing) -> str:
    """What to clear first, and what it is worth on fresh rollouts."""
    picks, gain = clearing.picks, clearing.gain
    first = f"Best found to clear first: {place_words(clearing, picks[0])}"
    if gain is None:
        return f"Interrupted. {first}: {_more(clearing, clearing.turns[0].picked.known)}, on what chose it."
    if len(picks) > 1:
        first = f"Best found to clear, in this order: {', '.join(threat.name for threat in picks)}"
    return f"{first}: {_more(clearing, gain)} on average, after replanning."


def place_words(clearing: Clearing, threat: Threat) -> str:
    """A threat by name, size, chance and place."""
    row, col = divmod(int(threat.cells[0]), clearing.world.shape[1])
    most = "" if threat.thing is None else "at most "
    at = f"{'' if len(threat.cells) == 1 else 'from '}row {row}, column {col}"
    return f"{threat.name} ({counted(len(threat.cells), 'cell')}, {most}p = {chance(threat.p)}, {at})"


def _said(clearing: Clearing, gain: Gain | None) -> str:
    return "" if gain is None else gain.counted.said(unit=f" {clearing.unit}")


def _more(clearing: Clearing, gain: Gain | None) -> str:
    return "" if gain is None else gain.counted.more(unit=f" {clearing.unit}")


def findings(clearing: Clearing) -> Iterator[str]:
    """How sure that is, what the old plan wins, and what the picks add."""
    first, gain = clearing.turns[0], clearing.gain
    if gain is not None:
        yield sourced(gain.rollouts, f"after replanning, {gain.said('more')}.")
    yield first.certainty("worth more")
    unknown = first.best_unknown
    most, own = (_said(clearing, one.unknown) for one in (unknown, first.picked))
    then = "" if unknown is first.picked else f"; {first.picked.threat.name} is worth {own} then"
    yield f"With the old plan {unknown.threat.name} is worth most to clear: {most}{then}."
    for turn in clearing.turns[1:]:
        gained = _more(clearing, turn.picked.known)
        yield f"Then {place_words(clearing, turn.picked.threat)}: {gained} than without it."


def _key_figures(clearing: Clearing) -> list[KeyFigure]:
    gain, first, unit, out = clearing.gain, clearing.turns[0], clearing.unit, list[KeyFigure]()
    if gain is not None:
        mean, interval = gain.counted.columns()
        fresh = ", fresh rollouts" if gain.rollouts else ""
        out.append(KeyFigure(f"{mean} {unit}", "won after replanning", f"{interval}{fresh}"))
    unknown = first.best_unknown
    return [
        *out,
        KeyFigure(f"{unknown.unknown.counted.mean:.1f} {unit}", "most with the old plan", unknown.threat.name),
        KeyFigure(f"{len(clearing.options)}", "threats", f"{len(first.simulated)} planned for anew"),
    ]


def _maps(clearing: Clearing, only: int | None = None) -> CellMaps:
    """Gains after replanning and with the old plan, and where risk is paid, cell by cell; `only` one of them."""
    from analysis.page.cell_maps import CellLayer
    from analysis.pictures.style import COVERED, LOSSES

    options, shape = clearing.options, clearing.world.shape
    known, unknown = by_cell(options, shape, lambda one: one.known), by_cell(options, shape, lambda one: one.unknown)
    won = f"{KINDS_OF_GAIN[clearing.unit]} won"
    paid = "What one percent of threat more in a cell would cost, open loop, same paths. No advice on what to clear."
    layers = [
        CellLayer(f"{won}, replanned", "By clearing the threat that the cell is in; planned anew.", known, COVERED,
                  short="Replanned"),
        CellLayer(f"{won}, old plan", "By clearing the threat; they do as before.", unknown, COVERED,
                  short="Old plan"),
        CellLayer("Where risk is paid", paid, np.maximum(clearing.risk_paid, 0.0), LOSSES, root=True, blocks="sum",
                  short="Risk paid"),
    ]  # fmt: skip
    ranked = [one.threat for one in _ranked(clearing)] if only == 0 else []
    parts = [(threat.name, threat.cells, threat in clearing.picks) for threat in ranked]
    return CellMaps(clearing.world, clearing.starts, layers if only is None else layers[only : only + 1], parts)


def _table(clearing: Clearing) -> Table:
    """Every threat as the first to be cleared, the best first."""
    areas = clearing.remove == "areas"
    columns = ("threat", *["at"] * areas, "cells", "p, %", "lost in it", "bound", "replanned", "from .. to",
               "old plan", "from .. to", "rollouts")  # fmt: skip
    title = f"{KINDS_OF_GAIN[clearing.unit]} won on average by clearing one threat"
    dropped = ("rollouts", "bound", "lost in it", *["at"] * areas, "from .. to")
    table = make_table(columns, title, left=("threat", "at"), dropped=dropped, padding=(0, 1, 0, 0))
    for one in _ranked(clearing)[:SHOWN]:
        threat, known = one.threat, one.known
        row, col = divmod(int(threat.cells[0]), clearing.world.shape[1])
        told = ("", "", "") if known is None else (*_columns(known), f"{known.rollouts:,}" if known.rollouts else "")
        table.add_row(threat.name, *[f"{row},{col}"] * areas, f"{len(threat.cells)}",
                      chance(threat.p, unit=""), f"{one.hits:.3f}", f"{one.screen:.2f}", *told[:2],
                      *_columns(one.unknown), told[2])  # fmt: skip
    return table


def _columns(gain: Gain) -> tuple[str, str]:
    return gain.counted.columns()


def _ranked(clearing: Clearing) -> list[Weighed]:
    rest = [one for one in clearing.options if one.known is None]
    return [*clearing.turns[0].simulated, *sorted(rest, key=lambda one: -(one.screen or 0.0))]


def _footnotes(clearing: Clearing) -> list[str]:
    lines = [
        "replanned: on the map without it. old plan: robots do as before, and nobody is stopped there. "
        "from .. to: 95 % intervals, each by itself.",
        "bound: how much the bound for every strategy rises. lost in it: robots a run, as things are.",
    ]
    if len(clearing.options) > SHOWN:
        lines.append(f"The JSON object has {counted(len(clearing.options) - SHOWN, 'further threat')}.")
    if clearing.remove == "sources":
        lines.append("p: the largest of the threat alone; where others overlap it, theirs stays.")
    return lines


def _json(clearing: Clearing) -> Json:
    """Gains in cells, and in value where there is any."""
    gain = clearing.gain
    return {
        "remove": clearing.remove,
        "threats": [_threat_json(one) for one in clearing.options],
        "pick": [threat.name for threat in clearing.picks],
        "gain": None if gain is None else gain.cells.to_json() | {"first_rollout": clearing.choices.rollouts},
        **({} if gain is None or gain.value is None else {"value_gain": gain.value}),
        "robots_gain": None if gain is None else gain.robots,
        "turns": [
            {"name": turn.picked.threat.name, "known": turn.picked.known, "unknown": turn.picked.unknown}
            for turn in clearing.turns
        ],
        **search_end(clearing),
    }


def _threat_json(one: Weighed) -> Json:
    threat, told = one.threat, {name: getattr(one, name) for name in ("screen", "hits", "known", "unknown", "behind")}
    return {"name": threat.name, "cells": threat.cells, "p": float(exactly(round(threat.p, 9))), **told}
