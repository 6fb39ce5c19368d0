"""The open loop as a trace: every robot on its nominal path until it is stopped.

What it comes to is what the open loop's engines count for the same seed and rollout. Axis letters: `K`
robots, `T` = time + 1 steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.ids import NO_AREA, NO_ROBOT
from planner.plan.plan import Plan, RobotPlan, last_move
from planner.rollout_sampling import Luck
from planner.tally import Doing, EventKind, Outcome, Trace
from planner.world.world import World


def open_loop_trace(plan: Plan, world: World, seed: int, rollout: int) -> Trace:
    """One rollout of the plan's open loop in full.

    Nothing is reallocated: a stopped robot's area stays its own. ALLOCATED events tell when a robot turns to the next
    area of its plan. The areas are those at the end of the nominal run. The plan of another planner has none.
    """
    stops = _stops(plan, Luck(world, seed, rollout, plan.bearing))
    ends = [last_move(robot.path) if stop is None else stop for robot, stop in zip(plan.robots, stops, strict=True)]
    time = max(ends)
    area_of = _area_of(plan, world)
    columns = [_column(robot, stop, time, area_of) for robot, stop in zip(plan.robots, stops, strict=True)]
    cells, doing, areas = (np.stack(values, axis=1) for values in zip(*columns, strict=True))
    events, missing = _events(plan, stops, cells, area_of, int(world.accessible(plan.starts).sum()))
    alive = any(stop is None for stop in stops)
    outcome = Outcome.COMPLETE if missing == 0 else Outcome.END_OF_PATHS if alive else Outcome.ALL_ROBOTS_LOST
    return Trace(
        rollout=rollout,
        cells=cells.astype(np.int32),
        doing=doing.astype(np.int8),
        areas=areas.astype(np.int32),
        events=np.array(events, dtype=np.int32).reshape(-1, 5),
        area_of=area_of,
        outcome=outcome,
    )


def _stops(plan: Plan, luck: Luck) -> list[int | None]:
    """The step at which each robot is stopped, or None; asked in the order in which they move."""
    stops: list[int | None] = [None] * len(plan.robots)
    moves = [(step, number) for number, robot in enumerate(plan.robots) for step in robot.entered.tolist()]
    for step, number in sorted(moves):
        if stops[number] is None and luck.hits(number, step, int(plan.robots[number].path[step])):
            stops[number] = step
    return stops


def _area_of(plan: Plan, world: World) -> NDArray[np.int32]:
    """int32 `[N]`, the area of each cell at the end of the nominal run."""
    area_of = np.full(world.threat.size, NO_AREA, dtype=np.int32)
    for number, area in enumerate(plan.areas + plan.areas_added):
        area_of[area.cells] = number
    return area_of


def _column(
    robot: RobotPlan, stop: int | None, time: int, area_of: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """(cell, doing, area) `[T]` of one robot: what its next move belongs to is what it is doing now."""
    path = robot.path[: time + 1]
    cells = np.pad(path, (0, time + 1 - len(path)), mode="edge")
    doing = np.full(time + 1, Doing.DONE, dtype=np.int64)
    areas = np.full(time + 1, NO_AREA, dtype=np.int64)
    first = min((leg.start for leg in robot.legs), default=1)
    doing[: max(first - 1, 0)] = Doing.IDLE
    for leg in robot.legs:
        now = slice(max(leg.start - 1, 0), max(min(leg.stop - 1, time + 1), 0))
        areas[now] = leg.area
        doing[now] = Doing.TRAVELING if leg.kind == "travel" else Doing.COVERING
        if leg.kind == "cover" and 1 <= leg.start <= time + 1 and area_of[cells[leg.start - 1]] != leg.area:
            doing[leg.start - 1] = Doing.TRAVELING  # the move that enters the area
    if not robot.legs:
        doing[: last_move(robot.path)] = Doing.TRAVELING
    if stop is not None:
        cells[stop:], doing[stop:], areas[stop:] = robot.path[stop], Doing.DEAD, NO_AREA
    return cells, doing, areas


def _events(
    plan: Plan, stops: list[int | None], cells: NDArray[np.int64], area_of: NDArray[np.int32], accessible: int
) -> tuple[list[tuple[int, int, int, int, int]], int]:
    """The rows of `Trace.events`, and how many accessible cells are not visited at the end."""
    left = np.bincount(area_of[area_of >= 0], minlength=len(plan.areas) + len(plan.areas_added))
    visited = np.zeros(len(area_of), dtype=np.bool_)
    turns = [_turns(robot) for robot in plan.robots]
    current = [_first_area(plan, number) for number in range(len(plan.robots))]
    moves = np.ones(cells.shape, dtype=np.bool_)
    moves[1:] = cells[1:] != cells[:-1]
    events: list[tuple[int, int, int, int, int]] = []
    for step in range(len(cells)):
        for robot, stop in enumerate(stops):
            if stop is not None and step > stop:
                continue
            cell = int(cells[step, robot])
            if moves[step, robot] and not visited[cell]:
                visited[cell] = True
                area = int(area_of[cell])
                if area != NO_AREA:
                    left[area] -= 1
                    if left[area] == 0:
                        events.append((step, robot, EventKind.COMPLETED, area, cell))
            if step == stop:
                events.append((step, robot, EventKind.HIT, current[robot], cell))
            elif step in turns[robot]:
                area, target = turns[robot][step]
                current[robot] = area
                events.append((step, robot, EventKind.ALLOCATED, area, target))
    return events, accessible - int(visited.sum())


def _turns(robot: RobotPlan) -> dict[int, tuple[int, int]]:
    """At which step the robot turns to which area, and the cell where it will begin there: its first excluded."""
    turns: dict[int, tuple[int, int]] = {}
    area = None
    for place, leg in enumerate(robot.legs):
        if leg.area != area and leg.start > 0:
            into = next(
                (later for later in robot.legs[place:] if later.area == leg.area and later.kind == "cover"), leg
            )
            turns[leg.start - 1] = (leg.area, int(robot.path[into.start]))
        area = leg.area
    return turns


def _first_area(plan: Plan, number: int) -> int:
    """The area that the robot has at t = 0."""
    given = [index for index, area in enumerate(plan.areas) if area.robot == number and area.robot != NO_ROBOT]
    return given[0] if given else NO_AREA


# Every entry of the nominal paths, as columns.


@dataclass(frozen=True, eq=False)
class Entries:
    """Every entry of a cell on the nominal paths, robot by robot in order of time; start cells included.

    Attributes:
        robot, step, cell: int64 `[entries]`.
        passed: int64 `[entries]`, dangerous entries of that robot before this one: it is made iff outcome >= passed.
        dangerous: bool `[entries]`, whether the cell can stop the robot.
        first: bool `[entries]`, whether it is the robot's first entry of the cell.
    """

    robot: NDArray[np.int64]
    step: NDArray[np.int64]
    cell: NDArray[np.int64]
    passed: NDArray[np.int64]
    dangerous: NDArray[np.bool_]
    first: NDArray[np.bool_]


# Robots in groups of one or two: the outcomes of a group are numbered, and one number looks everything up.

MOST_PAIR_ROWS = 2**14
"""Robots are paired while all pairs' rows are at most so many: their tables then stay in a core's cache."""


@dataclass(frozen=True, eq=False)
class Groups:
    """The robots of each group and the numbering of its outcomes.

    A group of robots i, j with outcomes o_i, o_j is in row `first_row + o_i * stride + o_j`, stride = outcomes of j.

    Attributes:
        slot_robot: int64 `[S]`, S = G * A: the robot in each slot, NO_ROBOT (outcome always 0) in the last if K is odd.
        size: int64 `[S]`, outcomes of each slot: 1 + the most dangerous entries that it can pass.
        members: A, robots a group, 1 or 2.
        first_row: int64 `[G]`; rows of a group are consecutive.
        row_count: R.
    """

    slot_robot: NDArray[np.int64]
    size: NDArray[np.int64]
    members: int
    first_row: NDArray[np.int64]
    row_count: int

    @property
    def count(self) -> int:
        """G."""
        return len(self.first_row)

    @property
    def stride(self) -> NDArray[np.int64]:
        """int64 `[G, A]`: rows from one outcome of the slot to its next."""
        sizes = self.size.reshape(-1, self.members)
        return np.concatenate([sizes[:, 1:], np.ones((self.count, 1), np.int64)], axis=1)

    @property
    def slot_of(self) -> NDArray[np.int64]:
        """int64 `[K]`: each robot's slot."""
        slots = np.flatnonzero(self.slot_robot >= 0)
        found = np.empty(len(slots), dtype=np.int64)
        found[self.slot_robot[slots]] = slots
        return found

    def sizes(self, group: int) -> tuple[int, int]:
        """Outcomes of the group's two robots (1 for one that is not there)."""
        mine = self.size[group * self.members : (group + 1) * self.members].tolist()
        return (mine[0], mine[1]) if self.members == 2 else (mine[0], 1)

    def rows(self, by_outcome: Sequence[NDArray], combine: Callable[[NDArray, NDArray], NDArray]) -> NDArray[np.uint32]:
        """A table by row, uint32 `[R, ...]`, from one per robot `[outcomes, ...]`, by a ufunc with identity 0."""
        parts = []
        for group in range(self.count):
            pair = [
                by_outcome[robot] if robot >= 0 else np.zeros_like(by_outcome[0][:1])
                for robot in self.slot_robot[group * self.members : (group + 1) * self.members]
            ]
            table = pair[0] if self.members == 1 else combine(pair[0][:, None], pair[1][None, :])
            parts.append(table.reshape(int(np.prod(self.sizes(group))), *by_outcome[0].shape[1:]))
        return np.concatenate(parts).astype(np.uint32)


def make_groups(depth: NDArray[np.int64], most_pair_rows: int = MOST_PAIR_ROWS) -> Groups:
    """Pairs (the robot with most outcomes with that of fewest) if their rows are few enough, else single robots.

    Args:
        depth: int64 `[K]`, the most dangerous entries that each robot can pass.
        most_pair_rows: see MOST_PAIR_ROWS.
    """
    # Most with fewest: the products, which are the rows, stay small.
    order = np.argsort(-depth, kind="stable").astype(np.int64)
    if len(order) % 2:
        order = np.append(order, NO_ROBOT)
    half = len(order) // 2
    slots = np.stack([order[:half], order[half:][::-1]], axis=1).reshape(-1)
    pair_size = np.where(slots >= 0, depth[slots] + 1, 1)
    pair_rows = pair_size.reshape(-1, 2).prod(axis=1)
    if len(depth) > 1 and pair_rows.sum() <= most_pair_rows:
        return _number(slots, pair_size, 2, pair_rows)
    single = np.arange(len(depth), dtype=np.int64)
    return _number(single, depth + 1, 1, depth + 1)


def _number(slots: NDArray[np.int64], size: NDArray[np.int64], members: int, rows: NDArray[np.int64]) -> Groups:
    first = np.cumsum(rows) - rows
    return Groups(slot_robot=slots, size=size, members=members, first_row=first, row_count=int(rows.sum()))
