"""An evaluation cell by cell: the maps, and the cells that stand out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.words import how_known
from analysis.page.cell_maps import CellLayer, cell_maps_html
from analysis.page.markup import Html
from analysis.page.tables import TableData
from analysis.pictures.style import COVERED, LOSSES, SAFE, THREAT, percent
from planner.worlds.world import World


def maps(evaluation: Evaluation) -> Html:
    """Chance covered, robots lost, and threat, cell by cell."""
    world, plan, expected = evaluation.world, evaluation.plan, evaluation.expected
    accessible, known = world.accessible(plan.starts), how_known(evaluation)
    shape = world.shape
    lost = expected.stops_by_cell.reshape(shape)
    layers = [
        CellLayer("Chance that the cell is covered", f"Visited; {known}.",
                  expected.visited_by_cell.reshape(shape), COVERED, "%", top=1.0, digits=2),
        CellLayer("Robots lost in the cell", f"Expected number; {known}. {lost.sum():.2f} in all.",
                  lost, LOSSES, root=True, blocks="sum"),
        *map_layers(world, accessible),
    ]  # fmt: skip
    return cell_maps_html(layers, world.free, accessible, plan.starts, world.cell_size)


def map_layers(world: World, accessible: NDArray[np.bool_]) -> list[CellLayer]:
    """The map itself, as a layer."""
    threat = np.where(accessible, np.nan_to_num(world.threat.astype(np.float64)), 0.0)
    about = "Chance that one visit of the cell stops the robot."
    top = float(threat.max()) or 1.0
    return [CellLayer("Threat", about, threat, THREAT, "%", top=top, zero=SAFE, digits=2)]


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
