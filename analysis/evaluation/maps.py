"""An evaluation cell by cell: its maps, for the page and for pictures, and the cells that stand out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.rest import NAMES, TO_DO, Rest
from analysis.evaluation.table import worst_of
from analysis.report.blocks import CellMaps, Planned

if TYPE_CHECKING:
    from analysis.page.cell_maps import CellLayer

CELLS = "cells"
"""The id of the maps cell by cell, whose pictures and values the head of the page shows too."""
OUTLINED = 5
"""Cells that cost most robots, on their picture."""
NO_KIND = -1
MOST_PHASES = 8
"""Phases whose threats have a map of their own."""


def maps(evaluation: Evaluation) -> CellMaps:
    """Threat, chance covered, robots lost, what is left of the risk, what outputs add, and the areas."""
    own = evaluation.layers
    more = [make() for found in evaluation.blocks for make in found.layers.values()]
    layers = [*threats(evaluation), own.chance, own.losses, own.left, *more, *own.areas]
    return CellMaps(evaluation.ground, evaluation.plan.starts, layers, anchor=CELLS)


def threats(evaluation: Evaluation) -> list[CellLayer]:
    """What robots plan on at first; where threats change, those of each phase too, of many the first few."""
    from analysis.page.plan_layers import threat_layer

    own, world, phases = evaluation.layers.threat, evaluation.ground, evaluation.ground.phases
    if phases is None:
        return [own]
    begins = phases.begins[:MOST_PHASES].tolist()
    layers = [threat_layer(replace(world, threat=p, doubt=None), evaluation.plan) for p in phases.threats[:MOST_PHASES]]
    named = [replace(of, name=f"Threat from step {at}", since=at) for at, of in zip(begins, layers, strict=True)]
    return [own, *named] if phases.plan_on == "worst" else [replace(own, since=0), *named[1:]]


def rest_map(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """What is to do, what was done, what is too far, and the chance to cover each cell."""
    mixed = (rest.kinds[evaluation.accessible] != TO_DO).any()
    layers = [*(evaluation.layers.to_do if mixed else []), evaluation.layers.chance]
    return CellMaps(evaluation.ground, evaluation.plan.starts, layers)


def plan_map(evaluation: Evaluation) -> CellMaps:
    """The map by threat with every robot's nominal path: what the answer is about, at the head of the page."""
    world, plan = evaluation.ground, evaluation.plan
    return CellMaps(world, plan.starts, [evaluation.layers.plan], plan=plan, runs=evaluation.played, values_of=CELLS)


def world_drawn(evaluation: Evaluation) -> Planned:
    """The world by threat level, areas and every robot's nominal path."""
    closed = "; paths: the nominal ones (no robot lost)" if evaluation.loop == "closed" else ""
    return Planned(evaluation.ground, evaluation.plan, closed)


def covered(evaluation: Evaluation) -> CellMaps:
    """The chance to cover each cell, with those below one half outlined."""
    world, plan, chance = evaluation.ground, evaluation.plan, evaluation.expected.visited_by_cell
    rare = np.flatnonzero(evaluation.accessible.ravel() & (chance < 0.5))
    return CellMaps(world, plan.starts, [evaluation.layers.chance], [("", rare, True)] if len(rare) else ())


def losses(evaluation: Evaluation) -> CellMaps:
    """Robots lost in each cell, with the worst outlined and listed."""
    world, lost = evaluation.ground, evaluation.expected.stops_by_cell
    worst = worst_of(lost, OUTLINED).tolist()
    places = [(*divmod(cell, world.shape[1]), lost[cell]) for cell in worst]
    listed = ("worst cells", *(f"[{row}, {col}]  {number:.3g}" for row, col, number in places))
    lines = listed if worst else ("no robot is lost",)
    outlines = [("", np.array([cell]), True) for cell in worst]
    return CellMaps(world, evaluation.plan.starts, [evaluation.layers.losses], outlines, lines)


def with_route(evaluation: Evaluation, make: Callable[[], CellLayer]) -> CellMaps:
    """What an output adds, and the route that is to be safe."""
    world, route = evaluation.ground, evaluation.ground.team.route
    parts = [] if route is None else [("route", route @ (world.shape[1], 1), True)]
    return CellMaps(world, evaluation.plan.starts, [make()], parts)


def rest_picture(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """The chance to cover each cell, with what is to do, what was done and what is too far outlined."""
    world, starts = evaluation.ground, evaluation.plan.starts
    kinds = np.where(evaluation.accessible, rest.kinds, NO_KIND).ravel()
    parts = [(name, np.flatnonzero(kinds == kind), False) for kind, name in enumerate(NAMES) if (kinds == kind).any()]
    return CellMaps(world, starts, [replace(evaluation.layers.chance, name=rest.title)], parts)
