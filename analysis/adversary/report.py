"""What `mrac-jax attack` says: the worst places, what they cost robots of both kinds, every cell on the map."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import yaml
from rich.table import Table

from analysis.adversary.answer import Attack, Placed
from analysis.kit.tables import make_table
from analysis.removal.threat import Gain, Threat, Weighed, by_cell
from analysis.report.blocks import CellMaps, KeyFigure, Part, Report
from analysis.report.words import asked, luck_words, map_words, search_end, sourced
from planner.files import Json
from planner.shown import chance, counted
from planner.worlds.restart import said

SHOWN = 12
"""Cells in the table; the JSON object holds all."""
KNOWN, HIDDEN = "robots that know", "robots that do not know"


def report(attack: Attack) -> Report:
    """The worst places, with the maps of what a threat costs in each cell."""
    choices, robots, cells = attack.choices, len(attack.starts), counted(len(attack.turn.options), "cell")
    threats = f"{counted(len(attack.known.threats), 'threat')} of {chance(attack.p)}"
    hidden = len(attack.hidden.threats) > 0  # none: it was interrupted before
    return Report(
        "attack", "attack", asked(attack.world, robots, "where would a threat cost most?"), headline(attack),
        lambda: _json(attack), list(findings(attack)), _key_figures(attack),
        heading=(
            f"{map_words(attack.world, attack.cells, robots)}; {threats}, {cells} looked at",
            luck_words(attack.world, choices, attack.engine,
                       f"{counted(choices.rollouts, 'rollout')} of the last two, the same ids for all; "),
        ),
        picture=lambda: _maps(attack), parts=[Part("Cells", [_table(attack)], _footnotes(attack))],
        notes=attack.notes, settings=attack.settings.shown(attack.world.pace), pace=attack.world.pace,
        pictures={"attack.png": lambda: _maps(attack, 0)}
        | ({"hidden.png": lambda: _maps(attack, 1)} if hidden else {}),
        files={"known.npz": attack.known_world.to_bytes}
        | ({"hidden.npz": attack.hidden_world.to_bytes} if hidden else {})
        | ({} if attack.settings.own_words else {"known.yaml": lambda: _scenario(attack)}),
    )  # fmt: skip


def _scenario(attack: Attack) -> bytes:
    """The team on the map with the threats that it knows of."""
    team = said({"starts": attack.starts.tolist()}, attack.settings, attack.world.pace)
    return yaml.safe_dump({"map": {"file": "known.npz"}} | team, sort_keys=False).encode()


def headline(attack: Attack) -> str:
    """The worst places for both kinds of robot, and what they cost on fresh rollouts."""
    known, hidden = attack.known, attack.hidden
    if known.known is None or hidden.hidden is None:
        return f"Interrupted. Worst found so far for {KNOWN}: {_at(known.threats)}."
    return (
        f"Worst found for {KNOWN}: {_at(known.threats)}, {_fewer(attack, known.known)} on average; "
        f"for {HIDDEN}: {_at(hidden.threats)}, {_fewer(attack, hidden.hidden)}."
    )


def _at(threats: tuple[Threat, ...]) -> str:
    return ", ".join(threat.name.removeprefix("cell ") for threat in threats)


def _said(attack: Attack, gain: Gain) -> str:
    return gain.counted.said(unit=f" {attack.unit}")


def _fewer(attack: Attack, gain: Gain) -> str:
    return gain.counted.more(unit=f" {attack.unit}", words=("fewer", "more"))


def findings(attack: Attack) -> Iterator[str]:
    """What both cost in cells and robots, what it is worth to know, and how sure the worst cell is."""
    for placed, own, kind in ((attack.known, attack.known.known, KNOWN), (attack.hidden, attack.hidden.hidden, HIDDEN)):
        if own is not None:
            yield sourced(own.rollouts, f"{_at(placed.threats)} against {kind}: {own.said('fewer')}.")
    known, hidden = attack.known.hidden, attack.hidden.known
    if known is not None and hidden is not None:
        yield (
            f"The other way round: {_at(attack.known.threats)} would cost {HIDDEN} {_said(attack, known)}, "
            f"and {_at(attack.hidden.threats)} {KNOWN} {_said(attack, hidden)}."
        )
    yield f"A single threat costs {KNOWN} most in {attack.turn.picked.threat.name}. {attack.turn.certainty('worse')}"


def _key_figures(attack: Attack) -> list[KeyFigure]:
    return [
        KeyFigure(f"{gain.counted.columns()[0]} {attack.unit}", f"lost by {kind}", gain.counted.columns()[1])
        for gain, kind in ((attack.known.known, KNOWN), (attack.hidden.hidden, HIDDEN))
        if gain is not None
    ]


def _maps(attack: Attack, only: int | None = None) -> CellMaps:
    """What one threat in each cell costs both kinds; `only` one of them, with the worst places outlined."""
    from analysis.page.cell_maps import CellLayer
    from analysis.pictures.style import LOSSES

    options, shape = attack.turn.options, attack.world.shape
    lost = "Value lost" if attack.world.value is not None else "Cells lost"
    known = np.maximum(by_cell(options, shape, lambda one: one.known), 0.0)
    hidden = np.maximum(by_cell(options, shape, lambda one: one.unknown), 0.0)
    layers = [
        CellLayer(f"{lost}, {KNOWN}", f"By one threat of {chance(attack.p)} in the cell; planned anew.", known,
                  LOSSES, short="Known"),
        CellLayer(f"{lost}, {HIDDEN}", "By the same threat; they do as before.", hidden, LOSSES, short="Hidden"),
    ]  # fmt: skip
    placed = (attack.known, attack.hidden)[only or 0].threats
    parts = [] if only is None else [(threat.name.removeprefix("cell "), threat.cells, True) for threat in placed]
    return CellMaps(attack.world, attack.starts, layers if only is None else layers[only : only + 1], parts)


def _table(attack: Attack) -> Table:
    """The worst cells for one threat."""
    columns = ("cell", "p there, %", "bound", "known", "from .. to", "hidden", "from .. to", "rollouts")
    title = f"{'Cells' if attack.world.value is None else 'Value'} lost on average by one threat"
    table = make_table(columns, title, left=("cell",), dropped=("rollouts", "bound", "from .. to"))
    for one in attack.turn.simulated[:SHOWN]:
        if one.known is not None:
            there = float(attack.world.threat.reshape(-1)[one.threat.cells[0]])
            bound = "" if one.screen is None else f"{one.screen:.2f}"
            rolled = f"{one.known.rollouts:,}" if one.known.rollouts else ""
            table.add_row(one.threat.name.removeprefix("cell "), chance(there, unit=""), bound,
                          *one.known.counted.columns(), *one.unknown.counted.columns(), rolled)  # fmt: skip
    return table


def _footnotes(attack: Attack) -> list[str]:
    return [
        "known: on the map with it, planned anew. hidden: robots do as before. "
        "from .. to: 95 % intervals, each by itself.",
        *(["bound: how much the bound for every strategy falls."] if attack.turn.picked.screen is not None else []),
    ]


def _json(attack: Attack) -> Json:
    """What threats cost in cells, and in value where there is any."""
    return {
        "p": attack.p,
        "known": _placed_json(attack, attack.known),
        "hidden": _placed_json(attack, attack.hidden),
        "threats": [_threat_json(attack, one) for one in attack.turn.options],
        **search_end(attack),
    }


def _placed_json(attack: Attack, placed: Placed) -> Json:
    return {
        "cells": [_place(attack, threat) for threat in placed.threats],
        "loss": {"known": placed.known, "hidden": placed.hidden},
        "first_rollout": attack.choices.rollouts,
    }


def _place(attack: Attack, threat: Threat) -> list[int]:
    return list(divmod(int(threat.cells[0]), attack.world.shape[1]))


def _threat_json(attack: Attack, one: Weighed) -> Json:
    told = {name: getattr(one, name) for name in ("screen", "known", "behind")}
    return {"cell": _place(attack, one.threat), "hidden": one.unknown, **told}
