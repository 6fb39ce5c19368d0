"""What `mrac-jax clear` says: the picks in sentences, all threats as a table, the JSON object."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from analysis.kit.face import json_end
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import between, counted, typed
from analysis.removal.answer import Cleared, Clearing, Gain, Threat, Turn
from planner.files import Json

KINDS = {"areas": "connected areas of danger", "sources": "polygons, points and sites of the scenario"}
KINDS_OF_GAIN = {"cells": "Cells", "of value": "Value"}
SHOWN = 12
"""Threats in the table; the JSON object holds all."""


def headline(clearing: Clearing) -> str:
    """What to clear first, and what it is worth on fresh rollouts."""
    picks, gain = clearing.picks, clearing.gain
    first = f"Best found to clear first: {place_words(clearing, picks[0])}"
    if gain is None:
        return f"Interrupted. {first}: {_said(clearing, clearing.turns[0].picked.known)} more, on what chose it."
    if len(picks) > 1:
        first = f"Best found to clear, in this order: {', '.join(threat.name for threat in picks)}"
    return f"{first}: {_said(clearing, gain)} more on average, after replanning."


def place_words(clearing: Clearing, threat: Threat) -> str:
    """A threat by name, size, chance and place."""
    row, col = divmod(int(threat.cells[0]), clearing.world.shape[1])
    most = "" if threat.thing is None else "at most "
    return f"{threat.name} ({counted(len(threat.cells), 'cell')} of {most}{100 * threat.p:.3g} % from [{row}, {col}])"


def _said(clearing: Clearing, gain: Gain | None) -> str:
    return "" if gain is None else gain.counted.said(unit=f" {clearing.unit}")


def findings(clearing: Clearing) -> Iterator[str]:
    """How sure that is, what the old plan wins, and what the picks add."""
    first, gain = clearing.turns[0], clearing.gain
    if gain is not None:
        worth = "" if gain.value is None else f"{gain.value.said(unit=' of value')} and "
        yield f"Fresh rollouts, after replanning: {worth}{gain.cells.said(unit=' cells')} more, " + (
            f"{gain.robots.said()} robots lost fewer.")  # fmt: skip
    yield _certainty(first)
    unknown = first.best_unknown
    most, own = (_said(clearing, one.unknown) for one in (unknown, first.picked))
    yield (
        f"With the old plan {unknown.threat.name} is worth most to clear: {most}; {first.picked.threat.name} is worth "
        f"{own} then."
    )
    for turn in clearing.turns[1:]:
        gained = _said(clearing, turn.picked.known)
        yield f"Then {place_words(clearing, turn.picked.threat)}: {gained} more than without it."


def _certainty(turn: Turn) -> str:
    others = [one for one in turn.simulated if one.behind is not None]
    beaten = sum(one.behind is not None and one.behind[0] > 0 for one in others)
    if not others:
        return "There is no other."
    close = [one.threat.name for one in others if one.behind is not None and one.behind[0] <= 0]
    alike = f"{', '.join(close[:4])}{' and more' if len(close) > 4 else ''}"
    if not beaten:
        return f"No significant difference from the other {len(others)} (95 %, all together): {alike}."
    said = f"It is surely worth more than {beaten} of the other {len(others)} (95 %, all together)"
    return f"{said}; no significant difference from {alike}." if close else f"{said}."


def print_clearing(clearing: Clearing, console: Console) -> None:
    """Print the answer, how sure it is, and all threats."""
    print_lines(console, (headline(clearing), *findings(clearing), *heading(clearing)))
    console.print(threats_table(clearing))
    print_lines(console, footnotes(clearing))


def heading(clearing: Clearing) -> list[str]:
    """What was looked at."""
    choices = clearing.choices
    ends = "" if choices.deadline is None else f", every mission ended at step {choices.deadline:,}"
    return [
        f"{clearing.world.source}: {clearing.cells:,} accessible cells, {counted(len(clearing.starts), 'robot')}, "
        f"{counted(len(clearing.options), 'threat')} ({KINDS[clearing.remove]}); "
        f"{counted(choices.rollouts, 'rollout')} of the last two, seed {choices.seed}, {clearing.engine}{ends}"
    ]


def threats_table(clearing: Clearing) -> Table:
    """Every threat as the first to be cleared, the best first."""
    areas = clearing.remove == "areas"
    columns = ("threat", *["at"] * areas, "cells", "p, %", "lost in it", "bound", "replanned", "from .. to",
               "old plan", "from .. to", "rollouts")  # fmt: skip
    title = f"{KINDS_OF_GAIN[clearing.unit]} won on average by clearing one threat"
    dropped = ("rollouts", "bound", "lost in it", *["at"] * areas, "from .. to")
    table = make_table(columns, title, left=("threat", "at"), dropped=dropped, padding=(0, 1, 0, 0))
    for one in _ranked(clearing)[:SHOWN]:
        threat = one.threat
        row, col = divmod(int(threat.cells[0]), clearing.world.shape[1])
        known = ("", "", "") if one.known is None else (*_columns(one.known), f"{one.known.rollouts:,}")
        table.add_row(threat.name, *[f"{row},{col}"] * areas, f"{len(threat.cells)}", f"{100 * threat.p:.3g}",
                      f"{one.hits:.3f}", f"{one.screen:.2f}", *known[:2], *_columns(one.unknown), known[2])  # fmt: skip
    return table


def _columns(gain: Gain) -> tuple[str, str]:
    low, high = gain.counted.ci95
    digits = 2 if high < 100 else 1
    return f"{gain.counted.mean:.{digits}f}", between(low, high, digits)


def _ranked(clearing: Clearing) -> list[Cleared]:
    first = clearing.turns[0]
    rest = [one for one in clearing.options if one.known is None]
    return [*first.simulated, *sorted(rest, key=lambda one: -one.screen)]


def footnotes(clearing: Clearing) -> list[str]:
    """How to read it."""
    lines = [
        "replanned: on the map without it. old plan: robots do as before, and nobody is stopped there. "
        "from .. to: 95 % intervals, each by itself.",
        "bound: how much the bound for every strategy rises. lost in it: robots a run, as things are.",
    ]
    if len(clearing.options) > SHOWN:
        lines.append(f"{len(clearing.options) - SHOWN} further threats are in the JSON object.")
    if clearing.remove == "sources":
        lines.append("p: the largest of the threat alone; where others overlap it, theirs stays.")
    return lines + [f"note: {note}" for note in clearing.notes]


def rows(clearing: Clearing) -> list[tuple[str, str]]:
    """For a console or a notebook."""
    shown = [(threat.name, place_words(clearing, threat)) for threat in clearing.picks]
    if clearing.gain is not None:
        shown.append(
            ("gain, fresh rollouts", f"{_said(clearing, clearing.gain)}, {clearing.gain.robots.said()} fewer lost")
        )
    return shown + [("note", note) for note in clearing.notes]


def clearing_json(clearing: Clearing) -> Json:
    """The JSON object of `clear`; gains in cells, and in value where there is any."""
    gain = clearing.gain
    return {
        "remove": clearing.remove,
        "threats": [_threat_json(one) for one in clearing.options],
        "pick": [threat.name for threat in clearing.picks],
        "gain": None if gain is None else gain.cells.to_json() | {"first_rollout": clearing.choices.rollouts},
        **({} if gain is None or gain.value is None else {"value_gain": gain.value.to_json()}),
        "robots_gain": None if gain is None else gain.robots.to_json(),
        "turns": [
            {"name": turn.picked.threat.name, "known": _gain_json(turn.picked.known),
             "unknown": _gain_json(turn.picked.unknown)}
            for turn in clearing.turns
        ],
        "robots": len(clearing.starts),
        "starts": clearing.starts.tolist(),
        "accessible": clearing.cells,
        "rollouts": clearing.choices.rollouts,
        "seed": clearing.choices.seed,
        "engine": clearing.engine,
        **json_end(clearing, clearing.notes),
    }  # fmt: skip


def _threat_json(one: Cleared) -> Json:
    return {
        "name": one.threat.name,
        "cells": one.threat.cells.tolist(),
        "p": float(typed(round(one.threat.p, 9))),
        "screen": one.screen,
        "hits": one.hits,
        "known": _gain_json(one.known),
        "unknown": _gain_json(one.unknown),
        "behind": None if one.behind is None else list(one.behind),
    }


def _gain_json(gain: Gain | None) -> Json | None:
    if gain is None:
        return None
    worth = {} if gain.value is None else {"value": gain.value.to_json()}
    return gain.cells.to_json() | worth | {"robots": gain.robots.to_json(), "rollouts": gain.rollouts}
