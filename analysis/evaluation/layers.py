"""What an evaluation says cell by cell, as layers of one map: for the page and for pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import NDArray

from analysis.evaluation.expected import Expected
from analysis.evaluation.rest import NAMES, Rest
from analysis.page.cell_maps import CellLayer
from analysis.page.plan_layers import area_layers, chance_layers, p_words
from analysis.pictures.style import LOSSES
from planner.plans.plan import Plan
from planner.shown import counted, percent
from planner.worlds.world import World

KINDS = ListedColormap(["#cfe3c3", "#8f96a3", "#b98fb5"])
"""Cells to do, done, and too far, as `analysis.evaluation.rest` numbers them."""


@dataclass(frozen=True, eq=False)
class Layers:
    """A value for each cell.

    Attributes:
        plan: the threat, below the plan's paths. threat, chance, losses: of the map, covered, robots lost.
        left: what is left of the risk. areas: who holds which; none of paths alone.
        to_do: what is left to do, of a mission that is limited or under way.
    """

    plan: CellLayer
    threat: CellLayer
    chance: CellLayer
    losses: CellLayer
    left: CellLayer
    areas: list[CellLayer]
    to_do: list[CellLayer]


def layers_of(
    world: World, plan: Plan, accessible: NDArray[np.bool_], expected: Expected, how_known: str, rest: Rest | None,
    lines: str = "the plan",
) -> Layers:  # fmt: skip
    """Of expected values; `how_known`, and what the `lines` over the map are, which a page draws on demand: in words.

    `rest`: of the mission, where that is not all of it.
    """
    lost = expected.stops_by_cell
    threat, chance, losses = chance_layers(world, plan, expected.visited_by_cell, lost, how_known)
    rare = counted(int((expected.visited_by_cell[accessible.ravel()] < 0.5).sum()), "cell")
    covered = f" {percent(expected.visited / accessible.sum())} of the cells on average; {rare} below 50 %."
    left = CellLayer("Residual risk", "Threat times the chance that the cell is not covered.",
                     threat.values * (1 - chance.values), LOSSES, "%", root=True, digits=2)  # fmt: skip
    about = f"Colour: {p_words(plan, world)}. Paths: {lines}."
    return Layers(
        replace(threat, name="The map and the plan", about=about),
        threat,
        replace(chance, about=chance.about + covered),
        replace(losses, about=f"{losses.about} {lost.sum():.2f} in all."),
        left,
        list(area_layers(plan)),
        [] if rest is None else [_to_do(rest)],
    )


def _to_do(rest: Rest) -> CellLayer:
    about = f"Green: to do; grey: visited before; violet: {rest.too_far}."
    return CellLayer("What is to do", about, rest.kinds.astype(np.float64), KINDS, norm=Normalize(0, len(NAMES) - 1),
                     names=NAMES, short="To do")  # fmt: skip
