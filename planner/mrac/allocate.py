"""Who gets which area before the start (Algorithm 1), and who which part of an area that is shared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from planner.mrac.partition import Partition
from planner.mrac.paths import SafestPaths
from planner.mrac.search import NOT_WANTED
from planner.none import NO_ROBOT
from planner.plans.plan import Area


@dataclass(frozen=True)
class _SafeArea:
    number: int
    cells: NDArray[np.int64]
    robots: list[int]


def allocate_areas_to_robots(
    areas: list[tuple[int, NDArray[np.int64]]],
    starts: NDArray[np.int64],
    shape: tuple[int, int],
    paths: Sequence[SafestPaths],
    density: float,
    partition: Partition,
) -> tuple[Area, ...]:
    """Algorithm 1's initial allocation: the areas in id order with their owners (SPEC section 4).

    Args:
        areas: (level, cells) in id order. starts: cell index of each robot, int64 `[K]`.
        paths: of each robot. density: d; a safe area takes another robot while `robots in it * d <= cells`.
        partition: how an area of several robots is split.
    """
    safe = [_SafeArea(number, cells, []) for number, (level, cells) in enumerate(areas) if level == 0]
    with_room = np.full(len(paths[0].neighbours), NOT_WANTED, dtype=np.int32)
    for place, area in enumerate(safe):
        with_room[area.cells] = place
    for robot, start in enumerate(starts.tolist()):
        target = paths[robot].nearest(start, with_room)
        if target is not None:
            area = safe[with_room[target.cell]]
            area.robots.append(robot)
            if len(area.robots) * density > len(area.cells):
                with_room[area.cells] = NOT_WANTED
    split = {area.number for area in safe if len(area.robots) > 1}
    owner = {area.number: area.robots[0] for area in safe if len(area.robots) == 1}
    kept = [
        Area(level, owner.get(number, NO_ROBOT), cells)
        for number, (level, cells) in enumerate(areas)
        if number not in split
    ]
    for area in safe:
        if area.number in split:
            kept += _split_between(area, starts, shape, paths, partition)
    return tuple(kept)


def _split_between(
    area: _SafeArea,
    starts: NDArray[np.int64],
    shape: tuple[int, int],
    paths: Sequence[SafestPaths],
    partition: Partition,
) -> list[Area]:
    """One part of the area for each of its robots, by the Hungarian method on safest-path costs."""
    parts = partition(shape, area.cells, len(area.robots))
    from_each = (paths[robot].to_all(int(starts[robot])) for robot in area.robots)
    cells, begins = np.concatenate(parts), np.cumsum([0, *map(len, parts[:-1])])
    costs = np.array([np.minimum.reduceat(cost[cells], begins) for cost in from_each])
    of_row, of_column = linear_sum_assignment(costs)
    robot_of_part = {int(part): area.robots[int(row)] for row, part in zip(of_row, of_column, strict=True)}
    return [Area(0, robot_of_part[number], part) for number, part in enumerate(parts)]


@dataclass(frozen=True)
class SharedParts:
    """How an area is shared: positions in the list of parts that the owner and the helper take."""

    owner: int
    helper: int


def choose_parts(of_owner: list[int], of_helper: list[int]) -> SharedParts:
    """Two different parts by least total cost; ties: the owner's lower part, then the helper's (SPEC section 5).

    `of_owner`, `of_helper`: the cost of each robot's way to each part.
    """
    parts = range(len(of_owner))
    pairs = ((of_owner[o] + of_helper[h], o, h) for o in parts for h in parts if o != h)
    _, owner, helper = min(pairs)
    return SharedParts(owner, helper)
