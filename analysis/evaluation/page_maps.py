"""An evaluation cell by cell: the maps, and the cells that stand out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.value import Value
from analysis.evaluation.page_runs import runs
from analysis.evaluation.rest import NAMES, TO_DO, Rest
from analysis.evaluation.words import how_known
from analysis.kit.words import percent
from analysis.page.cell_maps import CellLayer, cell_maps_html
from analysis.page.markup import Html, element
from analysis.page.plan_layers import area_layers, chance_layers, p_words, threat_layer
from analysis.page.plan_paths import paths_legend, paths_svg
from analysis.page.tables import TableData
from analysis.pictures.style import LOSSES
from planner.worlds.world import World

CELLS = "cells"
"""The id of the maps cell by cell, whose pictures and values the head of the page shows too."""


KINDS = ListedColormap(["#cfe3c3", "#8f96a3", "#b98fb5"])
"""Cells to do, done, and too far, as `analysis.evaluation.rest` numbers them."""


def maps(evaluation: Evaluation) -> Html:
    """Threat, chance covered, robots lost, what is left of the risk, and the areas, cell by cell."""
    lost = evaluation.expected.stops_by_cell
    visited, known = evaluation.expected.visited_by_cell, how_known(evaluation)
    world, plan = evaluation.world, evaluation.plan
    threat, chance, losses = chance_layers(world, plan, visited, lost, known, f" {lost.sum():.2f} in all.")
    left = CellLayer("Residual risk", "Threat times the chance that the cell is not covered.",
                     threat.values * (1 - chance.values), LOSSES, "%", root=True, digits=2)  # fmt: skip
    value = evaluation.output(Value)
    worth = [] if value is None else [_value_left(world, value)]
    layers = [threat, chance, losses, left, *worth, *area_layers(plan)]
    accessible = world.accessible(plan.starts)
    return cell_maps_html(layers, world.free, accessible, plan.starts, world.cell_size, world.origin, anchor=CELLS)


def _value_left(world: World, value: Value) -> CellLayer:
    """What is left of what the cells are worth."""
    about = f"Value times the chance that it is not found. {value.left.mean:.4g} of {value.worth.total:.4g} in all."
    return CellLayer("Value left", about, value.left_by_cell.reshape(world.shape), LOSSES, root=True, blocks="sum",
                     short="Left")  # fmt: skip


def rest_map(evaluation: Evaluation, rest: Rest) -> Html:
    """What is to do, what was done, what is too far, and the chance to cover each cell."""
    world, plan = evaluation.world, evaluation.plan
    accessible = world.accessible(plan.starts)
    about = "Green: to do; grey: visited before; violet: too far for the moves of any robot."
    kinds = CellLayer("What is to do", about, rest.kinds.astype(np.float64), KINDS, norm=Normalize(0, len(NAMES) - 1),
                      names=NAMES, short="To do")  # fmt: skip
    visited = evaluation.expected.visited_by_cell
    chance = chance_layers(world, plan, visited, evaluation.expected.stops_by_cell, how_known(evaluation), "")[1]
    layers = [kinds, chance] if (rest.kinds[accessible] != TO_DO).any() else [chance]
    return cell_maps_html(layers, world.free, accessible, plan.starts, world.cell_size, world.origin)


def plan_map(evaluation: Evaluation) -> Html:
    """The map by threat with every robot's nominal path: what the answer is about, at the head of the page."""
    world, plan = evaluation.world, evaluation.plan
    layer = replace(
        threat_layer(world, plan),
        name="The map and the plan",
        about=f"Colour: {p_words(plan, world)}. Lines: the plan.",
    )
    accessible = world.accessible(plan.starts)
    drawn = paths_svg(plan)
    shown = cell_maps_html(
        [layer], world.free, accessible, plan.starts, world.cell_size, world.origin, above=drawn, heading="h2",
        values_of=CELLS,
    )  # fmt: skip
    return element("div", shown, runs(evaluation), paths_legend(plan, drawn is not None), class_="plan-map")


def worst_cells(evaluation: Evaluation, most: int = 10) -> list[TableData]:
    """The cells that cost most robots, and those that are covered least."""
    world, expected = evaluation.world, evaluation.expected
    accessible = np.flatnonzero(world.accessible(evaluation.plan.starts))
    chance, lost, threat = expected.visited_by_cell, expected.stops_by_cell, world.threat.ravel()

    def rows(cells: NDArray[np.int64]) -> tuple[tuple[str, ...], ...]:
        return tuple(
            (
                str(int(cell) // world.shape[1]),
                str(int(cell) % world.shape[1]),
                percent(float(threat[cell]), 2),
                percent(float(chance[cell]), 2),
                f"{lost[cell]:.4f}",
            )
            for cell in cells
        )

    columns = ("row", "column", "threat", "chance covered", "robots lost")
    by_loss = accessible[np.argsort(-lost[accessible], kind="stable")][:most]
    by_loss = by_loss[lost[by_loss] > 0]
    by_chance = accessible[np.argsort(chance[accessible], kind="stable")][:most]
    found = [
        TableData("Cells that cost most robots", columns, rows(by_loss), frozenset()),
        TableData("Cells covered least", columns, rows(by_chance), frozenset()),
    ]
    return [table for table in found if table.rows]
