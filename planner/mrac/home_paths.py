"""Ways to base: from every cell the safest path to a base (SPEC section 19); and maps of robot types (SPEC 22)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planner.arguments import MAX_STEP, argument
from planner.errors import PlanError
from planner.settings import Settings
from planner.simulator.codes import NO_CELL
from planner.simulator.jit import compiled
from planner.simulator.searches import UNREACHED, SafestPaths, safest_paths
from planner.world.levels import NO_LEVEL, ThreatLevels, entry_costs, level_costs, levels_of_maps
from planner.world.world import World

# Maps of robots of several types: one area registry, and for each type its own costs and paths (SPEC section 22).
#
# An area is a connected set of cells that have one level for each type. So any robot pays the same for all cells of an
# area, as Algorithm 3 requires.


@dataclass(frozen=True, eq=False)
class OwnMaps:
    """Maps of robot types. Axes: `Y` types, `K` robots, `L` levels of areas, `N` cells.

    Attributes:
        of: int64 `[K]`, the type of each robot. values: float64, the common scale of the types' levels.
        level: int64 `[Y, L]`, level on that scale of an area of each level, by type.
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
    """Maps of a team with several robot types. Levels of areas increase with their mean p over the team.

    Args:
        worlds: of each robot `[K]`, at least two of them different.
        accessible: bool `[H, W]`.
        settings: of the plan.

    Returns:
        (levels of areas; int64, cost of entering a cell of each level of the scale; maps by type).

    Raises:
        PlanError: a setting that such teams do not support.
        WorldError: path costs are too large.
    """
    if settings.transit != Settings().transit:
        problem = f"{argument('transit')} for robots of several types"
        raise PlanError(problem, fix=f"leave {argument('transit')} out, or give all robots one type")
    # By identity: robots of one type share one world.
    kinds = list(dict.fromkeys(worlds))
    of = np.array([kinds.index(world) for world in worlds])
    within = accessible.ravel()
    threats = np.stack([world.threat.ravel() for world in kinds])
    values, of_map, quantised = levels_of_maps(threats, within, settings.levels)
    of_map = np.where(within, of_map, NO_LEVEL).astype(np.int16)
    # Level 0, safe for all types, exists even if it is empty.
    found, of_cell = np.unique(np.column_stack([np.zeros(len(kinds), of_map.dtype), of_map[:, within]]), axis=1,
                               return_inverse=True)  # fmt: skip
    # Areas are ordered by the team's mean, since types disagree on which of two areas is safer.
    mean = np.bincount(of, minlength=len(kinds)) @ values[found] / len(of)
    order = np.argsort(mean, kind="stable")
    common = np.full(within.size, NO_LEVEL, dtype=np.int16)
    common[within] = np.argsort(order)[of_cell.ravel()[1:]]
    costs = [entry_costs(ThreatLevels(values, own, quantised), settings.risk, worlds[0].source) for own in of_map]
    entry = level_costs(values, within.size, settings.risk).astype(np.int64)
    paths = tuple(safest_paths(worlds[0].shape, own) for own in costs)
    maps = OwnMaps(of, values, found[:, order].astype(np.int64), np.stack(costs), paths)
    return ThreatLevels(mean[order], common, quantised), entry, maps


CUT_OFF = -1
"""Moves of a way to base where no base can be reached: never more than a robot's moves left, so no return starts."""


@dataclass(frozen=True, eq=False)
class WaysToBase:
    """Ways to base. Axes: `B` sets of bases (and types), `N` cells, `K` robots.

    Attributes:
        starts: int64 `[K]`, the robots' starts. of: int64 `[K]`, the set of bases of each robot.
        bases: bool `[B, N]`, cells of each set.
        cost: int64 `[B, N]`, cost of the way to base, UNREACHED where there is none.
        steps: int32 `[B, N]`, its moves, 0 at a base, CUT_OFF where there is none.
        onward: int32 `[B, N]`, its next cell, NO_CELL at a base and where there is none.
        last: D, the step at which the mission is known to end; MAX_STEP if there is none.
    """

    starts: NDArray[np.int64]
    of: NDArray[np.int64]
    bases: NDArray[np.bool_]
    cost: NDArray[np.int64]
    steps: NDArray[np.int32]
    onward: NDArray[np.int32]
    last: int

    def moves(self, robot: int, cell: int) -> int:
        """h: moves of the robot's way to base from the cell."""
        return int(self.steps[self.of[robot], cell])

    def with_robot_map(self, paths: SafestPaths, costs: NDArray[np.int64]) -> WaysToBase:
        """The same on another map, with these paths and entry costs int64 `[N]`."""
        found = [ways_to(np.flatnonzero(cells), paths, costs) for cells in self.bases]
        cost, steps, onward = (np.stack(rows) for rows in zip(*found, strict=True))
        return replace(self, cost=cost, steps=steps, onward=onward)


def ways_to_base(
    settings: Settings,
    starts: NDArray[np.int64],
    shape: tuple[int, int],
    paths: SafestPaths,
    costs: NDArray[np.int64],
    homes: NDArray[np.int64] | None = None,
    own: OwnMaps | None = None,
) -> WaysToBase | None:
    """The ways to base of a team. Cost: a search from every base.

    Args:
        settings: of the plan.
        starts: int64 `[K]`, cells of the robots.
        shape: (H, W).
        paths: safest paths.
        costs: int64 `[N]`, entry costs.
        homes: int64 `[K]`, first cells of the robots of a resumed mission.
        own: maps of robot types, each with its own ways.

    Returns:
        None if robots do not return.

    Raises:
        PlanError: a base off the map, or, for a mission that begins, a robot that cannot reach a base.
    """
    if settings.return_to is None:
        return None
    begun = starts if homes is None else homes
    if settings.return_to == "home":
        bases, of = np.unique(begun, return_inverse=True)
        sets = [np.array([base]) for base in bases.tolist()]
    else:
        shared = np.unique(begun) if settings.return_to == "nearest" else _cells(settings.return_to, shape)
        sets, of = [shared], np.zeros(len(starts), dtype=np.int64)
    maps = ((paths, costs),) if own is None else tuple(zip(own.paths, own.costs, strict=True))
    kinds = np.zeros(len(starts), dtype=np.int64) if own is None else own.of
    # One set of ways for each combination of type and bases that occurs.
    pairs, of = np.unique(np.stack([kinds, of]), axis=1, return_inverse=True)
    found = [ways_to(sets[bases], *maps[kind]) for kind, bases in pairs.T.tolist()]
    cells = np.arange(len(costs))
    among = np.stack([np.isin(cells, sets[bases]) for _, bases in pairs.T.tolist()])
    cost, steps, onward = (np.stack(rows) for rows in zip(*found, strict=True))
    last = MAX_STEP if settings.last_step is None else settings.last_step
    home = WaysToBase(begun, of.ravel().astype(np.int64), among, cost, steps, onward, last)
    if homes is None:
        _check(home, settings, starts, shape)
    return home


def _cells(places: str | tuple[tuple[int, int], ...], shape: tuple[int, int]) -> NDArray[np.int64]:
    """The bases as cells, increasing."""
    rows, cols = np.array(places, dtype=np.int64).T
    off = np.flatnonzero((rows >= shape[0]) | (cols >= shape[1]))
    if len(off):
        raise PlanError(
            f"{argument('return_to')}: base {list(map(int, places[off[0]]))} is outside the map",
            expected=f"row 0..{shape[0] - 1} and col 0..{shape[1] - 1}",
        )
    return np.unique(rows * shape[1] + cols)


def _check(home: WaysToBase, settings: Settings, starts: NDArray[np.int64], shape: tuple[int, int]) -> None:
    """Raise PlanError for a robot that cannot return to base from its start."""
    moves = np.broadcast_to(np.asarray(MAX_STEP if settings.range is None else settings.range), len(starts))
    for robot, start in enumerate(starts.tolist()):
        way, where = home.moves(robot, start), [int(n) for n in divmod(start, shape[1])]
        if way == CUT_OFF:
            problem = f"{argument('return_to')}: robot {robot}, which starts at {where}, cannot reach a base"
            raise PlanError(problem, expected="a base in the same part of the map, on a free cell")
        pace = settings.paces[robot] if settings.paces else 1
        if way > min(int(moves[robot]), home.last // pace):
            problem = f"{argument('return_to')}: robot {robot} starts {way} moves from its base"
            raise PlanError(
                problem, expected=f"at most {min(int(moves[robot]), home.last // pace)}, its range or the deadline"
            )


def ways_to(
    bases: NDArray[np.int64], paths: SafestPaths, costs: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32]]:
    """Ways to the nearest of some bases: (cost int64, steps int32, onward int32), each `[N]`, as in `WaysToBase`.

    Args:
        bases: int64, cells.
        paths: safest paths.
        costs: int64 `[N]`, entry costs.
    """
    n = len(costs)
    cost = np.full(n, UNREACHED, dtype=np.int64)
    for base in bases[costs[bases] > 0].tolist():
        # A path costs what its reverse costs, except at the ends: the first cell of a path is not entered.
        away = paths.to_all(base)
        back = np.where(away == UNREACHED, UNREACHED, away - costs + costs[base])
        back[base] = 0
        nearer = (back != UNREACHED) & ((cost == UNREACHED) | (back < cost))
        cost[nearer] = back[nearer]
    steps, onward = np.full(n, 2**30, dtype=np.int32), np.full(n, NO_CELL, dtype=np.int32)
    reached = np.flatnonzero(cost != UNREACHED)
    nearest_first = reached[np.argsort(cost[reached], kind="stable")]
    _follow(nearest_first, cost, costs, paths.neighbours, steps, onward)
    steps[cost == UNREACHED] = CUT_OFF
    return cost, steps, onward


@compiled
def _follow(nearest_first, cost, costs, neighbours, steps, onward):  # type: ignore[no-untyped-def]
    """Fill steps and onward of the cells, in increasing cost: a cell's successor is always filled before it."""
    for cell in nearest_first:
        if cost[cell] == 0:
            steps[cell] = 0
            continue
        for side in range(4):
            beside = neighbours[cell, side]
            if beside == NO_CELL or cost[beside] < 0 or cost[beside] + costs[beside] != cost[cell]:
                continue
            if steps[beside] + 1 < steps[cell]:
                steps[cell], onward[cell] = steps[beside] + 1, beside
