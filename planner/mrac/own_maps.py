"""The maps of robots that differ in type: one book of areas, and for each type its own costs and ways (SPEC 22).

An area is a connected set of cells that have one level for each type. So a robot enters all cells of an area at one
cost, as Algorithm 3 presumes, whichever type it is of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import PlanError
from planner.mrac.costs import entry_costs, level_costs
from planner.mrac.paths import SafestPaths, safest_paths
from planner.settings import Settings
from planner.worlds.levels import NO_LEVEL, ThreatLevels, levels_of_maps
from planner.worlds.world import World


@dataclass(frozen=True, eq=False)
class OwnMaps:
    """Axes: `Y` types, `K` robots, `L` levels of areas, `N` cells.

    Attributes:
        of: int64 `[K]`, the type of each robot. values: float64, the scale of what types call levels.
        level: int64 `[Y, L]`, which level of the scale an area of each level is to a type.
        costs: int64 `[Y, N]`, entry costs. paths: safest paths of each type.
    """

    of: NDArray[np.int64]
    values: NDArray[np.float64]
    level: NDArray[np.int64]
    costs: NDArray[np.int64]
    paths: tuple[SafestPaths, ...]


def own_maps(
    worlds: tuple[World, ...], accessible: NDArray[np.bool_], settings: Settings
) -> tuple[ThreatLevels, NDArray[np.int64], OwnMaps]:
    """The levels of areas, the cost of entering a cell of each level of the scale, and the maps by type.

    `worlds`: of each robot `[K]`, two of them or more different. Levels of areas rise by their mean p over the team.
    Raises PlanError for what such teams do not do, WorldError.
    """
    if settings.transit != Settings().transit:
        problem = f"{argument('transit')} for robots of several types"
        raise PlanError(problem, fix=f"leave {argument('transit')} out, or give all robots one type")
    kinds = list(dict.fromkeys(worlds))
    of = np.array([kinds.index(world) for world in worlds])
    within = accessible.ravel()
    threats = np.stack([world.threat.ravel() for world in kinds])
    values, of_map, quantised = levels_of_maps(threats, within, settings.levels)
    of_map = np.where(within, of_map, NO_LEVEL).astype(np.int16)
    # Level 0, safe for all, exists even when it is empty.
    found, of_cell = np.unique(np.column_stack([np.zeros(len(kinds), of_map.dtype), of_map[:, within]]), axis=1,
                               return_inverse=True)  # fmt: skip
    mean = np.bincount(of, minlength=len(kinds)) @ values[found] / len(of)
    order = np.argsort(mean, kind="stable")
    common = np.full(within.size, NO_LEVEL, dtype=np.int16)
    common[within] = np.argsort(order)[of_cell.ravel()[1:]]
    costs = [entry_costs(ThreatLevels(values, own, quantised), settings.risk, worlds[0].source) for own in of_map]
    entry = level_costs(values, within.size, settings.risk).astype(np.int64)
    paths = tuple(safest_paths(worlds[0].shape, own) for own in costs)
    maps = OwnMaps(of, values, found[:, order].astype(np.int64), np.stack(costs), paths)
    return ThreatLevels(mean[order], common, quantised), entry, maps
