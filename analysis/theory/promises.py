"""What the survivors of a loss are still sure to do in the closed loop: finish the paths that they are on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.theory.quiet_run import NEVER, QuietRun
from planner.mrac.problem import Problem
from planner.none import NO_AREA, NO_ROBOT
from planner.trace import EventKind

"""Needs no area: a robot enters its start whatever happened before."""


class Promises:
    """What each loss that could come next in a quiet run leaves certain.

    A robot's *promise* at a loss: the cells still to enter on the path that it follows at that moment, i.e. up to
    where it next decides something: on a travel leg up to the entry into its area, on a cover leg up to the leg's end,
    and only if it got that area, and computed that path, before the loss.

    Proof that a promise is kept unless its robot is stopped on it, or the area is shared: the simulator changes a
    robot's path in no other case (`_finish_paths`: at its end; `_share`; `_start` and `_act` for a robot that has
    none), so whatever the other robots do or suffer, it enters these cells at these steps. Until step g (below) no area
    is shared. Each entry is checked by a hit of its own, so the promises of different robots are kept or broken
    independently, and a cell on several is visited with chance 1 - prod_j (1 - q_j) at least, q_j being the product of
    1 - p over robot j's entries from the loss to the cell.

    Proof that nothing is shared through step g. A lone survivor has nobody to share with. Else a robot shares only at
    the end of its path, holding nothing, and only if no unassigned area can be reached. Let the areas unassigned at the
    loss hold W unvisited cells, sizes s_1 >= s_2 >= ...; the accessible cells be connected (else take W = 0); e_j be
    the last step of robot j's promise (the step before the loss if it has none), and r the number of robots with
    e_j <= g. Suppose the first sharing is in step g. Robots with e_j > g have decided nothing since the loss, and
    visited no cell of W but those on their promises; each of the r others at most g - e_j more than on its promise.
    Areas never join, so every area made since lies in one of those of the loss or holds no cell of W; a robot holds one
    area, so the r robots, the one that shares left out, hold s_1 + ... + s_(r-1) cells of W at most. (A stopped robot
    holds none: its area is unassigned.) So if W - (cells of W on promises) - sum_j (g - e_j) exceeds that, some
    unvisited cell of W is in no robot's hands, and its area, unassigned, can be reached: no sharing. With r = 0 nobody
    decides anything at all.
    """

    def __init__(self, run: QuietRun, problem: Problem) -> None:
        self._run = run
        self._alive = np.setdiff1d(np.arange(len(problem.starts)), run.robot[list(run.hits)])
        self._connected = len(np.unique(problem.world.components().ravel()[problem.levels.accessible])) == 1
        # Entries robot by robot: those of robot j are `_begin[j]` to `_begin[j + 1] - 1`.
        self._order = np.argsort(run.robot, kind="stable")
        self._begin = np.searchsorted(run.robot[self._order], np.arange(len(problem.starts) + 1))
        cell, threat = run.cell[self._order], run.threat[self._order]
        self._cell, self._step, self._threat = cell, run.step[self._order], threat
        self._hazard = np.concatenate([[0.0], np.cumsum(-np.log1p(-threat))])  # of the entries before
        self._fresh = np.zeros(len(cell), dtype=np.bool_)
        for robot in range(len(problem.starts)):
            low, high = self._begin[robot], self._begin[robot + 1]
            self._fresh[low + np.unique(cell[low:high], return_index=True)[1]] = True
        self._stop, self._needs = self._promised()
        self._got = [self._areas_got(robot) for robot in range(len(problem.starts))]
        self._made, self._taken = self._lives_of_areas()
        self._member = np.repeat(np.arange(len(run.areas)), [len(area.cells) for area in run.areas])
        self._member_cell = np.concatenate([area.cells for area in run.areas])

    def _promised(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """For each entry, were it a robot's next one: where the promise ends (exclusive), and the area it needs."""
        stop = np.arange(len(self._cell))  # no promise: waits, and moves without a leg
        needs = np.full(len(self._cell), NO_AREA, dtype=np.int64)
        for robot, legs in enumerate(self._run.run.legs):
            begin, end = self._begin[robot], self._begin[robot + 1]
            steps = self._step[begin:end]
            for number, leg in enumerate(legs):
                low, high = (begin + np.searchsorted(steps, [leg.start, leg.stop])).tolist()
                needs[low:high] = leg.area
                if leg.kind == "cover":
                    stop[low], stop[low + 1 : high] = low + 1, high
                    continue
                arrives = number + 1 < len(legs) and legs[number + 1].start == leg.stop
                arrives = arrives and legs[number + 1].area == leg.area
                stop[low:high] = high + arrives
            stop[begin], needs[begin] = begin + 1, NO_AREA
        return stop, needs

    def _areas_got(self, robot: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(events at which the robot got an area, that area), from t = 0 on."""
        given = [number for number, area in enumerate(self._run.areas) if area.robot == robot]
        got = [(-1, given[0] if given else NO_AREA)] + [
            (event, area)
            for event, (who, kind, area, _) in enumerate(self._run.events)
            if kind == EventKind.ALLOCATED and who == robot
        ]
        events, areas = np.array(got, dtype=np.int64).T
        return events, areas

    def _lives_of_areas(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The events at which each area was made, and first given to a robot (NEVER)."""
        made = np.full(len(self._run.areas), NEVER, dtype=np.int64)
        taken = made.copy()
        known = len(self._run.areas) - len(self._run.run.areas_added)
        made[:known] = -1
        taken[[number for number, area in enumerate(self._run.areas) if area.robot != NO_ROBOT]] = -1
        for event, (_, kind, area, other) in enumerate(self._run.events):
            if kind in (EventKind.REALLOCATED, EventKind.SHARED):
                made[known : known + other] = event
                known += other
            elif kind == EventKind.ALLOCATED:
                taken[area] = min(int(taken[area]), event)
        return made, taken

    def after(self, loss: int) -> tuple[float, float]:
        """Expected cells that the promises add after a loss at this entry: (visited, survived)."""
        entry, reach = self._kept(loss)
        entry, reach = entry[self._fresh[entry]], reach[self._fresh[entry]]
        cell = self._cell[entry]
        new, safe = self._run.first_visit[cell] > loss, self._run.first_pass[cell] >= loss
        return _union(cell[new], reach[new]), _union(cell[safe], (reach * (1.0 - self._threat[entry]))[safe])

    def moves(self, loss: int) -> NDArray[np.int64]:
        """(robot, step, cell) of every promised entry after this loss, int64 `[entries, 3]`, robot by robot."""
        entry, _ = self._kept(loss)
        return np.stack([self._run.robot[self._order[entry]], self._step[entry], self._cell[entry]], axis=1)

    def _kept(self, loss: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The promised entries through the step until which nothing is shared, and the chance to reach each."""
        robots = self._alive[self._alive != self._run.robot[loss]].tolist()
        low = np.array([self._next(robot, loss) for robot in robots], dtype=np.int64)
        stops = [self._end(robot, entry, loss) for robot, entry in zip(robots, low.tolist(), strict=True)]
        size = np.array(stops, dtype=np.int64) - low
        ends = np.where(size > 0, self._step[low + size - 1], self._run.step[loss] - 1)
        entry = np.arange(size.sum()) + np.repeat(low - (np.cumsum(size) - size), size)
        sizes, promised = self._unassigned(loss, self._cell[entry])
        kept = self._step[entry] <= unshared_through(ends.tolist(), sizes, promised)
        return entry[kept], np.exp(self._hazard[np.repeat(low, size)] - self._hazard[entry])[kept]

    def _next(self, robot: int, loss: int) -> int:
        """The robot's first entry after the loss (the begin of the next robot's, if there is none)."""
        begin, end = self._begin[robot], self._begin[robot + 1]
        return int(begin + np.searchsorted(self._order[begin:end], loss))

    def _end(self, robot: int, entry: int, loss: int) -> int:
        """Where the robot's promise ends (exclusive), if it holds the area by then."""
        if entry == self._begin[robot + 1]:
            return entry
        events, areas = self._got[robot]
        holds = areas[np.searchsorted(events, self._run.noted[loss]) - 1]
        return int(self._stop[entry]) if self._needs[entry] in (NO_AREA, holds) else entry

    def _unassigned(self, loss: int, promised: NDArray[np.int64]) -> tuple[list[int], int]:
        """Sizes of what is unvisited of the areas unassigned at the loss, and how many of these cells are promised."""
        if not self._connected:
            return [], 0
        now = self._run.noted[loss]
        unassigned = (self._made < now) & (self._taken >= now)
        unvisited = unassigned[self._member] & (self._run.first_visit[self._member_cell] > loss)
        sizes = np.bincount(self._member[unvisited])
        return sizes[sizes > 0].tolist(), int(np.isin(self._member_cell[unvisited], promised).sum())


def unshared_through(ends: list[int], sizes: list[int], promised: int) -> int:
    """The last step through which no area can be shared (`Promises`).

    Args:
        ends: e_j, the last step of each survivor's promise. sizes: s_j, unvisited cells of each unassigned area.
        promised: cells of these areas that are on promises.
    """
    ends, sizes = sorted(ends), sorted(sizes, reverse=True)
    if len(ends) <= 1:
        return NEVER
    room, sum_of_ends, held = sum(sizes) - promised, 0, 0
    for robots, end in enumerate(ends, start=1):
        sum_of_ends += end
        held += sizes[robots - 2] if 2 <= robots <= len(sizes) + 1 else 0
        last = (room - held - 1 + sum_of_ends) // robots  # the greatest g that leaves a cell
        following = ends[robots] - 1 if robots < len(ends) else NEVER
        if last < end:
            return end - 1
        if last < following:
            return last
    return NEVER


def _union(cell: NDArray[np.int64], chance: NDArray[np.float64]) -> float:
    """Expected cells covered, `sum_c 1 - prod (1 - chance)` over independent robots."""
    if not len(cell):
        return 0.0
    cells, place = np.unique(cell, return_inverse=True)
    missed = np.ones(len(cells))
    np.multiply.at(missed, place, 1.0 - chance)
    return float(len(cells) - missed.sum())
