"""A plan on its map, cell by cell: the threat, the chance that cells are covered, robots lost, the areas."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from numpy.typing import NDArray

from analysis.kit.words import bearing_words
from analysis.page.cell_maps import MOST_CELLS, CellLayer
from analysis.pictures.robots import MOST_LEVELS
from analysis.pictures.style import COVERED, LOSSES, ROBOT_COLOURS, threat_scale
from planner.none import NO_ROBOT
from planner.plans.plan import Plan
from planner.worlds.levels import find_levels
from planner.worlds.world import World


def _tint(colour: str, part: float) -> tuple[float, ...]:
    """A colour with white: `part` of it."""
    return tuple(part * shade + 1 - part for shade in to_rgb(colour))


TINTS = ListedColormap(["#efece4", *(_tint(colour, part) for colour in ROBOT_COLOURS for part in (0.6, 0.42))])
"""Nobody's, and two tints a robot, so that its areas side by side can be told apart."""


def chance_layers(
    world: World, plan: Plan, visited: NDArray[np.float64], lost: NDArray[np.float64], known: str
) -> list[CellLayer]:
    """Threat, the chance that each cell is covered, and robots lost there, `[N]`; `known`: how they are."""
    return [
        threat_layer(world, plan),
        CellLayer("Chance that the cell is covered", f"Visited; {known}.",
                  visited.reshape(world.shape), COVERED, "%", top=1.0, digits=2, short="Coverage"),
        CellLayer("Robots lost in the cell", f"Expected number; {known}.",
                  lost.reshape(world.shape), LOSSES, root=True, blocks="sum", short="Losses"),
    ]  # fmt: skip


def threat_layer(world: World, plan: Plan) -> CellLayer:
    """The map itself, as a layer, in the colours of the pictures."""
    accessible = world.accessible(plan.starts)
    threat = np.where(accessible, np.nan_to_num(world.threat.astype(np.float64)), 0.0)
    levels = find_levels(world, accessible, plan.settings.levels if plan.settings else MOST_LEVELS)
    scale = threat_scale(levels.values, float(threat.max()))
    words = p_words(plan, world)
    about = f"{words[0].upper()}{words[1:]}."
    labels = (0.0, *levels.values[1:])
    return CellLayer("Threat", about, threat, scale.colours, "%", norm=scale.norm, labels=labels, digits=2)


def p_words(plan: Plan, world: World) -> str:
    """What p is on a map."""
    return bearing_words(plan, world) or "the chance that one visit stops a robot"


def area_layers(plan: Plan) -> Iterator[CellLayer]:
    """The areas at the start, in the colours of the robots that hold them; none of another planner's plan."""
    if not plan.areas or plan.shape[0] * plan.shape[1] > MOST_CELLS:
        return
    area = np.zeros(plan.shape)
    for number, held in enumerate(plan.areas):
        area.reshape(-1)[held.cells] = number
    owners = np.array([held.robot for held in plan.areas])
    tints = np.where(owners == NO_ROBOT, 0, 1 + 2 * (owners % len(ROBOT_COLOURS)) + np.arange(len(owners)) % 2)
    names = tuple(
        f"{number}, level {held.level}, " + ("nobody's yet" if held.robot == NO_ROBOT else f"robot {held.robot}")
        for number, held in enumerate(plan.areas)
    )
    about = "Who holds which at the start: the colour of the robot's line, in two tints; pale: nobody yet."
    yield CellLayer("Areas", about, area, TINTS, norm=Tint(tints), names=names)


class Tint(Normalize):
    """The place on TINTS of each area, by its number."""

    def __init__(self, tints: NDArray[np.int64]) -> None:
        super().__init__(0, 1)
        self._places = (tints + 0.5) / TINTS.N

    def __call__(self, value: Any, clip: bool | None = None) -> Any:
        """Places in 0 .. 1 of areas `[H, W]`."""
        return self._places[np.asarray(value, dtype=np.int64)]
