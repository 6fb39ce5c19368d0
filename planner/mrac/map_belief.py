"""Robots that learn the map: what they see that is not as they believed, and what follows from it (SPEC section 15).

At the end of a step whatever is seen is believed. What of it surprises is taken out of the areas, and so is what
cannot be reached any more; what can be reached and is in no area becomes one; then robots look at their ways again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.mrac.areas import bisect, connected_parts
from planner.mrac.board import Recorder, Robot, State
from planner.mrac.executive import Executive, Split
from planner.mrac.problem import Problem
from planner.plan.plan import Area
from planner.plan.state import MissionState
from planner.simulator.codes import NO_AREA, NO_CELL, NO_ROBOT, Doing, EventKind
from planner.simulator.searches import coverage_path, neighbour_table
from planner.world.levels import NO_LEVEL
from planner.world.map_knowledge import Evidence, Readings, added


class Learning(Executive):
    """A run whose robots believe a map until they see that it is another.

    Attributes:
        belief: int16 `[N]`, level of each cell that is believed free, NO_LEVEL of an obstacle.
        truth: int16 `[N]`, the same truly, which robots see bit by bit; None: they are told by others (`believe`).
    """

    def __init__(
        self,
        problem: Problem,
        allocation: tuple[Area, ...],
        split: Split = bisect,
        recorder: Recorder | None = None,
        state: MissionState | None = None,
        truth: NDArray[np.int16] | None = None,
    ) -> None:
        super().__init__(problem, allocation, split, recorder, state)
        self.belief, self.truth = problem.levels.of_cell.copy(), truth
        if problem.unknown is not None and truth is not None:
            self.belief = problem.unknown.belief.copy()
            self.unvisited = int(problem.unknown.accessible.sum())
            if problem.rule.looks_ahead and problem.unknown.looks:
                self.seen = problem.unknown.seen_at(problem.starts)

    def levels(self) -> NDArray[np.int16]:
        """Those that are believed; of cells that nobody can reach any more too, which may be on an old way."""
        return self.belief

    def end_step(self) -> None:
        """Every robot has had its turn, and they learn."""
        cells = self.looked_at()
        if len(cells):
            if self.seen is not None:
                self.changes += not self.seen[cells].all()
                self.seen[cells] = True
            # A map update is progress: a robot without an area looks again in the next step.
            self.progress |= self.believe(cells, self.found(cells))
        super().end_step()

    def looked_at(self) -> NDArray[np.int64]:
        """The cells of which robots may learn something at the end of this step, int64 `[n]`, rising."""
        unknown, live = self.problem.unknown, [robot.cell for robot in self.robots if robot.alive]
        if unknown is None or self.truth is None or not live:
            return np.zeros(0, dtype=np.int64)
        return np.unique(np.concatenate([unknown.view(cell) for cell in live])).astype(np.int64)

    def found(self, cells: NDArray[np.int64]) -> NDArray[np.int16]:
        """What they now know of these cells: the levels `[n]`."""
        assert self.truth is not None
        return self.truth[cells]

    def believe(self, cells: NDArray[np.integer], levels: NDArray[np.int16]) -> bool:
        """From now on robots believe these cells to be of these levels, NO_LEVEL: an obstacle. True: any is new."""
        news = cells[self.belief[cells] != levels].astype(np.int64)
        self.belief[cells] = levels
        live = np.array([robot.cell for robot in self.robots if robot.alive], dtype=np.int64)
        if len(news) == 0 or len(live) == 0:
            return False
        legs = {robot.number: self._leg(robot) for robot in self.robots if robot.on_its_way}
        ways = {robot.number: robot.ahead for robot in self.robots}
        self.problem = self.problem.believing(self.belief, live)
        gone = np.zeros(len(self.visited), dtype=np.bool_)
        gone[news] = True
        if self.recorder is not None:
            self.recorder.note(self.step, NO_ROBOT, EventKind.SURPRISED, NO_AREA, len(news))
        for number, area in enumerate(list(self.areas)):
            if area.state is State.ASSIGNED:
                self._keep_what_is_left(number, gone)
            elif area.state is State.UNASSIGNED:
                self._fall_apart(number, gone)
        self._take_in()
        self._count_open()
        for robot in self.robots:
            if robot.on_its_way:
                # who shares what it has with another has set out anew by then
                leg = legs[robot.number] if robot.ahead is ways[robot.number] else self._leg(robot)
                self._set_right(robot, leg, gone)
            elif robot.status is Doing.RETURNING and self.problem.home is not None:
                robot.ahead = self.problem.home.way(robot.number, robot.cell)[::-1]
                robot.status = Doing.RETURNING if robot.ahead else Doing.DONE  # cut off
        return True

    # --- (2): what leaves its area ---

    def _keep_what_is_left(self, number: int, gone: NDArray[np.bool_]) -> None:
        """An area that a robot has keeps what the robot can reach."""
        area, part = self.areas[number], self.problem.part
        stays = ~gone[area.cells] & (part[area.cells] == part[self.robots[area.robot].cell])
        self._let_go(area.cells[~stays])
        area.cells = area.cells[stays]
        area.unvisited = int(np.count_nonzero(~self.visited[area.cells]))

    def _fall_apart(self, number: int, gone: NDArray[np.bool_]) -> None:
        """One that nobody has becomes its unvisited rest in connected parts, the first of which goes on as the area.

        If cells left it, or it lies in several parts of the map.
        """
        area, part = self.areas[number], self.problem.part[self.areas[number].cells]
        if not gone[area.cells].any() and part[0] > 0 and (part == part[0]).all():
            return
        rest = area.cells[~gone[area.cells] & (part > 0) & ~self.visited[area.cells]]
        self._let_go(area.cells)
        parts = connected_parts(self.problem.world.shape, rest)
        if not parts:
            area.cells, area.unvisited, area.state = rest, 0, State.COMPLETED
            self.unassigned.remove(number)
            return
        self._hold(number, parts[0])
        for cells in parts[1:]:
            self.append_area(area.level, cells)

    def _let_go(self, cells: NDArray[np.int64]) -> None:
        self.area_of[cells] = NO_AREA

    def _hold(self, number: int, cells: NDArray[np.int64]) -> None:
        """The area that nobody has now holds these cells."""
        area = self.areas[number]
        area.cells, area.unvisited = cells, int(np.count_nonzero(~self.visited[cells]))
        self.area_of[cells] = number

    # --- (3): what is in no area ---

    def _take_in(self) -> None:
        """Unvisited cells in reach that no area holds join those of their level that nobody has, or are new ones."""
        left = np.flatnonzero((self.problem.part > 0) & ~self.visited & (self.area_of == NO_AREA))
        shape, levels = self.problem.world.shape, self.belief[left]
        parts = [part for level in np.unique(levels) for part in connected_parts(shape, left[levels == level])]
        beside = neighbour_table(shape, np.ones(shape[0] * shape[1], dtype=np.bool_))
        for part in sorted(parts, key=lambda part: int(part[0])):
            level, sides = int(self.belief[part[0]]), beside[part]
            touched = np.unique(self.area_of[sides[sides != NO_CELL]])
            mine = [n for n in touched.tolist() if n in self.unassigned and self.areas[n].level == level]
            if not mine:
                self.append_area(level, part)
                continue
            self._hold(mine[0], np.sort(np.concatenate([part, *(self.areas[number].cells for number in mine)])))
            for number in mine[1:]:
                area = self.areas[number]
                area.cells, area.unvisited, area.state = part[:0], 0, State.COMPLETED
                self.unassigned.remove(number)

    def _count_open(self) -> None:
        """What the board keeps of the areas that nobody has, anew."""
        self.changes += 1
        self.open_level = NO_LEVEL
        self.open_in.clear()
        for number in self.unassigned:
            self.open_in[self._where(number)] += 1

    # --- (4): who sets out anew ---

    def _set_right(self, robot: Robot, leg: NDArray[np.int64], gone: NDArray[np.bool_]) -> None:
        """A robot whose area has nothing left to do decides; one whose way is not as it was sets out anew."""
        if self.areas[robot.area].unvisited == 0:
            robot.ahead = []
            self.complete(robot.area)
            self._allocate_next(robot)
        elif self._is_lost(robot, leg, gone):
            if robot.status is Doing.TRAVELING:
                self._travel(robot)
            else:
                robot.ahead = []
                self._cover(robot)
        elif robot.status is Doing.COVERING and not self.rule.attentive:
            self._cover_on(robot, leg)
        self._finish_paths(robot)

    def _is_lost(self, robot: Robot, cells: NDArray[np.int64], gone: NDArray[np.bool_]) -> bool:
        part = self.problem.part
        return bool(gone[cells].any() or (part[cells] != part[robot.cell]).any())

    def _leg(self, robot: Robot) -> NDArray[np.int64]:
        """The way to its area, or the leg of its coverage path that it is on."""
        ahead = np.array(robot.ahead[::-1], dtype=np.int64)
        if robot.status is Doing.TRAVELING or self.rule.attentive:
            return ahead
        return ahead[: int(np.isin(ahead, self._still_to_cover(robot)).argmax()) + 1]

    def _still_to_cover(self, robot: Robot) -> NDArray[np.int64]:
        """What its coverage path has still to reach: no leg crosses one of them."""
        left = np.setdiff1d(robot.to_do, robot.path[robot.since :])
        return left[self.area_of[left] == robot.area]

    def _cover_on(self, robot: Robot, leg: NDArray[np.int64]) -> None:
        """On along the leg, and then by legs that are found as the map is believed now."""
        left = self._still_to_cover(robot)
        order, sides = self.problem.settings.in_area, self.problem.sides
        further = coverage_path(self.problem.paths, int(leg[-1]), left[left != leg[-1]], None, order, sides)
        robot.ahead = np.concatenate([leg, further])[::-1].tolist()
        robot.to_do, robot.since = left, len(robot.path)


# Robots that learn about hazards: what happened to them in a step, and what follows from it (SPEC section 15).
#
# During a step they only take note. At its end what they believe of the cells concerned is that of the evidence's
# class;
# where that is another level than before, it surprises as what is seen does (`planner.mrac.map_belief`).


class Experienced(Learning):
    """A run whose robots learn from survived visits, stops, and detectors.

    Attributes:
        odds: int64 `[N]`, log odds of a hazard in each cell.
    """

    def __init__(
        self,
        problem: Problem,
        allocation: tuple[Area, ...],
        split: Split,
        recorder: Recorder | None,
        evidence: Evidence,
        readings: Readings | None,
    ) -> None:
        assert problem.unknown is not None
        super().__init__(problem, allocation, split, recorder, None, problem.unknown.belief)
        self.odds, self.evidence, self._readings = evidence.prior.copy(), evidence, readings

    def stop(self, number: int) -> None:
        """The robot is stopped: there is, or was, a hazard in its cell."""
        super().stop(number)
        self.odds[self.robots[number].cell] = self.evidence.stop

    def survive(self, number: int) -> None:
        """The robot goes on: less speaks for a hazard in the cell that it has entered."""
        cell = np.array([self.robots[number].cell])
        super().survive(number)
        self.odds[cell] = added(self.odds[cell], -self.evidence.survival[cell])

    def looked_at(self) -> NDArray[np.int64]:
        """Cells that robots are in, stopped or not, and those in range of their detectors."""
        cells = np.array([robot.cell for robot in self.robots], dtype=np.int64)
        if not any(robot.alive for robot in self.robots):
            return cells[:0]
        return np.union1d(cells, self._read()) if self.evidence.detector else np.unique(cells)

    def found(self, cells: NDArray[np.int64]) -> NDArray[np.int16]:
        """The levels `[n]` of what the evidence says by now."""
        assert self.problem.unknown is not None
        return self.problem.unknown.truths[self.evidence.class_of(self.odds, cells), cells]

    def _read(self) -> NDArray[np.int64]:
        """Every live robot reads its detector; the cells in range."""
        assert self.problem.unknown is not None
        assert self._readings is not None
        inside = [np.zeros(0, dtype=np.int64)]
        for robot in self.robots:
            if robot.alive:
                cells = self.problem.unknown.view(robot.cell).astype(np.int64)
                self.odds[cells] = self.evidence.read(self.odds, cells, self._readings(robot.number, self.step, cells))
                inside.append(cells)
        return np.unique(np.concatenate(inside))


# Robots that are told of threats that change, as they do (SPEC section 16).
#
# At the end of the step before a phase begins every cell whose level changes surprises as what is seen does
# (`planner.mrac.map_belief`).


class Forewarned(Learning):
    """A run whose robots believe the map of the phase that the next step is in."""

    def looked_at(self) -> NDArray[np.int64]:
        """All cells before a phase begins, else none."""
        assert self.problem.unknown is not None and self.problem.unknown.phases is not None
        changes = (self.problem.unknown.phases.begins == self.step + 1).any()
        return np.flatnonzero(self.problem.unknown.within & changes)

    def found(self, cells: NDArray[np.int64]) -> NDArray[np.int16]:
        """Their levels `[n]` from the next step on."""
        assert self.problem.unknown is not None and self.problem.unknown.phases is not None
        return self.problem.unknown.truths[self.problem.unknown.phases.number_at(self.step + 1), cells]
