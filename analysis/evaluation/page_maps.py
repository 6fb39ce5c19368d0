"""An evaluation cell by cell: the maps, and the cells that stand out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.words import how_known
from analysis.kit.words import percent
from analysis.page.cell_maps import CellLayer, cell_maps_html
from analysis.page.markup import Html, element
from analysis.page.plan_paths import paths_legend, paths_svg
from analysis.page.tables import TableData
from analysis.pictures.robots import MOST_LEVELS
from analysis.pictures.style import COVERED, LOSSES, threat_scale
from planner.plans.plan import Plan
from planner.worlds.levels import find_levels
from planner.worlds.world import World


def maps(evaluation: Evaluation) -> Html:
    """Chance covered, robots lost, and threat, cell by cell."""
    lost = evaluation.expected.stops_by_cell
    visited, known = evaluation.expected.visited_by_cell, how_known(evaluation)
    return chance_maps(evaluation.world, evaluation.plan, visited, lost, known, f" {lost.sum():.2f} in all.")


def chance_maps(
    world: World, plan: Plan, visited: NDArray[np.float64], lost: NDArray[np.float64], known: str, more: str = ""
) -> Html:
    """The maps of the chance that each cell is covered and of the robots lost there, `[N]`, and the threat."""
    layers = [
        CellLayer("Chance that the cell is covered", f"Visited; {known}.",
                  visited.reshape(world.shape), COVERED, "%", top=1.0, digits=2),
        CellLayer("Robots lost in the cell", f"Expected number; {known}.{more}",
                  lost.reshape(world.shape), LOSSES, root=True, blocks="sum"),
        threat_layer(world, plan),
    ]  # fmt: skip
    accessible = world.accessible(plan.starts)
    return cell_maps_html(layers, world.free, accessible, plan.starts, world.cell_size, world.origin)


def plan_map(evaluation: Evaluation) -> Html:
    """The map by threat with every robot's nominal path: what the answer is about, at the head of the page."""
    world, plan = evaluation.world, evaluation.plan
    layer = replace(
        threat_layer(world, plan),
        name="The map and the plan",
        about="Colour: the chance that one visit stops a robot. Lines: the plan.",
    )
    accessible = world.accessible(plan.starts)
    drawn = paths_svg(plan)
    shown = cell_maps_html(
        [layer], world.free, accessible, plan.starts, world.cell_size, world.origin, above=drawn, heading="h2"
    )
    return element("div", shown, paths_legend(plan, drawn is not None), class_="plan-map")


def threat_layer(world: World, plan: Plan) -> CellLayer:
    """The map itself, as a layer, in the colours of the pictures."""
    accessible = world.accessible(plan.starts)
    threat = np.where(accessible, np.nan_to_num(world.threat.astype(np.float64)), 0.0)
    levels = find_levels(world, accessible, plan.settings.levels if plan.settings else MOST_LEVELS)
    scale = threat_scale(levels.values, float(threat.max()))
    about = "Chance that one visit of the cell stops the robot."
    labels = (0.0, *levels.values[1:])
    return CellLayer("Threat", about, threat, scale.colours, "%", norm=scale.norm, labels=labels, digits=2)


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
