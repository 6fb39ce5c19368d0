"""An evaluation cell by cell: its maps, for the page and for pictures, and the cells that stand out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.rest import NAMES, TO_DO, Rest
from analysis.evaluation.runs import runs
from analysis.evaluation.table import worst_of
from analysis.evaluation.words import how_known
from analysis.kit.words import percent
from analysis.page.cell_maps import CellLayer
from analysis.page.plan_layers import area_layers, chance_layers, p_words, threat_layer
from analysis.pictures.plans import plan_figure
from analysis.pictures.style import LOSSES
from analysis.report.blocks import CellMaps
from planner.shown import counted

CELLS = "cells"
"""The id of the maps cell by cell, whose pictures and values the head of the page shows too."""
OUTLINED = 5
"""Cells that cost most robots, on their picture."""


KINDS = ListedColormap(["#cfe3c3", "#8f96a3", "#b98fb5"])
"""Cells to do, done, and too far, as `analysis.evaluation.rest` numbers them."""
NO_KIND = -1


def maps(evaluation: Evaluation) -> CellMaps:
    """Threat, chance covered, robots lost, what is left of the risk, what outputs add, and the areas."""
    world, plan = evaluation.world, evaluation.plan
    threat, chance, losses = own_layers(evaluation)
    left = CellLayer("Residual risk", "Threat times the chance that the cell is not covered.",
                     threat.values * (1 - chance.values), LOSSES, "%", root=True, digits=2)  # fmt: skip
    more = [make() for found in evaluation.blocks for make in found.layers.values()]
    return CellMaps(world, plan.starts, [threat, chance, losses, left, *more, *area_layers(plan)], anchor=CELLS)


def own_layers(evaluation: Evaluation) -> list[CellLayer]:
    """Threat, chance covered, robots lost."""
    expected, known = evaluation.expected, how_known(evaluation)
    cells = evaluation.world.accessible(evaluation.plan.starts).ravel()
    rare = counted(int((expected.visited_by_cell[cells] < 0.5).sum()), "cell")
    covered = f" {percent(expected.visited / cells.sum())} of the cells on average; {rare} below 50 %."
    lost = expected.stops_by_cell
    layers = chance_layers(evaluation.world, evaluation.plan, expected.visited_by_cell, lost, known)
    threat, chance, losses = layers
    return [
        threat,
        replace(chance, about=chance.about + covered),
        replace(losses, about=f"{losses.about} {lost.sum():.2f} in all."),
    ]


def rest_map(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """What is to do, what was done, what is too far, and the chance to cover each cell."""
    world, plan = evaluation.world, evaluation.plan
    about = "Green: to do; grey: visited before; violet: too far for the moves of any robot."
    kinds = CellLayer("What is to do", about, rest.kinds.astype(np.float64), KINDS, norm=Normalize(0, len(NAMES) - 1),
                      names=NAMES, short="To do")  # fmt: skip
    mixed = (rest.kinds[world.accessible(plan.starts)] != TO_DO).any()
    return CellMaps(world, plan.starts, [kinds] * bool(mixed) + own_layers(evaluation)[1:2])


def plan_map(evaluation: Evaluation) -> CellMaps:
    """The map by threat with every robot's nominal path: what the answer is about, at the head of the page."""
    world, plan = evaluation.world, evaluation.plan
    about = f"Colour: {p_words(plan, world)}. Lines: the plan."
    layer = replace(threat_layer(world, plan), name="The map and the plan", about=about)
    return CellMaps(world, plan.starts, [layer], plan=plan, runs=runs(evaluation), values_of=CELLS)


def world_figure(evaluation: Evaluation) -> Figure:
    """The world by threat level, areas and every robot's nominal path."""
    closed = "; paths: the nominal ones (no robot lost)" if evaluation.loop == "closed" else ""
    return plan_figure(evaluation.world, evaluation.plan, closed)


def covered(evaluation: Evaluation) -> CellMaps:
    """The chance to cover each cell, with those below one half outlined."""
    world, plan, chance = evaluation.world, evaluation.plan, evaluation.expected.visited_by_cell
    rare = np.flatnonzero(world.accessible(plan.starts).ravel() & (chance < 0.5))
    return CellMaps(world, plan.starts, own_layers(evaluation)[1:2], [("", rare, True)] if len(rare) else ())


def losses(evaluation: Evaluation) -> CellMaps:
    """Robots lost in each cell, with the worst outlined and listed."""
    world, lost = evaluation.world, evaluation.expected.stops_by_cell
    worst = worst_of(lost, OUTLINED).tolist()
    places = [(*divmod(cell, world.shape[1]), lost[cell]) for cell in worst]
    lines = ("worst cells", *(f"[{row}, {col}]  {number:.3g}" for row, col, number in places))
    outlines = [("", np.array([cell]), True) for cell in worst]
    layer = own_layers(evaluation)[2:]
    return CellMaps(world, evaluation.plan.starts, layer, outlines, lines if worst else ("no robot is lost",))


def with_route(evaluation: Evaluation, layer: CellLayer) -> CellMaps:
    """What an output adds, and the route that is to be safe."""
    world, route = evaluation.world, evaluation.world.team.route
    parts = [] if route is None else [("route", route @ (world.shape[1], 1), True)]
    return CellMaps(world, evaluation.plan.starts, [layer], parts)


def rest_picture(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """The chance to cover each cell, with what is to do, what was done and what is too far outlined."""
    world, starts = evaluation.world, evaluation.plan.starts
    kinds = np.where(world.accessible(starts), rest.kinds, NO_KIND).ravel()
    parts = [(name, np.flatnonzero(kinds == kind), False) for kind, name in enumerate(NAMES) if (kinds == kind).any()]
    return CellMaps(world, starts, [replace(own_layers(evaluation)[1], name=rest.title)], parts)
