"""What robots said of the step under way: whether it can be true, and what of it was late."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import as_whole, is_whole
from planner.errors import StateError
from planner.files import Json
from planner.limits import MAX_STEP
from planner.missions.fleet import Fleet
from planner.missions.orders import Report
from planner.plans.reading import at


class Reports:
    """Reports to a fleet.

    Attributes:
        fleet: as it stands at the end of the last step.
        now: by robot, what holds at the end of this one. passed: (robot, cell) where it was in a step before.
        heard: of each robot the last step that it reported of. seen: p of cells that were seen, None of an obstacle.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.now: dict[int, Report] = {}
        self.passed: list[tuple[int, int]] = []
        self.heard = [fleet.step] * len(fleet.robots)
        self.seen: dict[int, float | None] = {}

    def carry(self, before: Reports) -> None:
        """Take over what was reported before cells were closed; of late ones what can be reached still."""
        self.now, self.heard, self.seen = before.now, before.heard, before.seen
        self.passed = [one for one in before.passed if self.fleet.problem.part[one[1]]]

    def clear(self) -> None:
        """The step is over."""
        self.now, self.passed, self.seen = {}, [], {}

    def hear(self, number: int, cell: ArrayLike | None, step: Any, moves_left: Any, **flags: bool) -> Report | None:
        """A report, arguments as of `Mission.report`; what holds of this step by it, None if nothing is new.

        What is late is taken to hold of a step before, and the report of where the robot was is given back.
        Raises StateError, and nothing is taken.
        """
        there, current = self._cell(number, cell), self.fleet.step + 1
        if moves_left is not None and not is_whole(moves_left, 0, MAX_STEP):
            raise StateError(f"robot {number}: moves_left is {moves_left!r}", expected=f"0 to {MAX_STEP}")
        said = current if step is None else as_whole(step)
        if not is_whole(said, 0, current):
            raise StateError(f"robot {number} reports of step {said!r}", expected=f"a step up to {current}")
        if said < current and said <= self.heard[number] and not any(flags.values()):
            self.passed.append((number, there))
            return Report(there)
        before = self.now.get(number)
        if before is not None and said > self.heard[number] and not before.stopped and there != before.cell:
            self.passed.append((number, before.cell))  # it was late itself
            self.now[number] = replace(before, cell=there)
        report = self._agreed(number, Report(there, moves_left=moves_left, **flags))
        self.heard[number] = max(said, self.heard[number])
        self.now[number] = report
        return None if report == before else report

    def _cell(self, number: int, cell: ArrayLike | None) -> int:
        """The index of the cell that a robot says it is at."""
        if cell is None:
            return self.now[number].cell if number in self.now else self.fleet.robots[number].cell
        world, part, found = self.fleet.problem.world, self.fleet.problem.part, whole_numbers(cell)
        height, width = world.shape
        expected = f"[row, col] of a cell that it can reach, row 0..{height - 1} and col 0..{width - 1}"
        if found.shape != (2,):
            raise StateError(f"robot {number} is at {cell!r:.60}", expected=expected)
        row, col = map(int, found)
        index, where = row * width + col, f"robot {number} is at [{row}, {col}]"
        if not (0 <= row < height and 0 <= col < width):
            raise StateError(f"{where}, off the map", expected=expected)
        if not world.free[row, col] or (index in self.seen and self.seen[index] is None):
            raise StateError(f"{where}, an obstacle", expected=expected)
        if part[index] != part[self.fleet.robots[number].cell]:
            raise StateError(f"{where}, with no way there", expected=expected)
        return index

    def _agreed(self, number: int, new: Report) -> Report:
        """The report, if it can be true with what is known; what it leaves out as it was said before in this step."""
        robot, before = self.fleet.robots[number], self.now.get(number)
        lost = (not robot.alive and (before is None or not before.found)) or (before is not None and before.stopped)
        where = robot.cell if before is None else before.cell
        if lost and not new.found:
            if new.stopped and new.cell == where:
                return before or replace(new, moves_left=None)
            what = "moves" if new.cell != where else "reports"
            raise StateError(f"robot {number} is lost, and {what}", expected="found, if it was found again")
        if lost and self.seen.get(new.cell, 0.0) is None:
            found = f"robot {number} is found at {at(new.cell, self.fleet.problem.world)}, seen to be an obstacle"
            raise StateError(found, expected="the cell where it is")
        if before is None or lost:
            return replace(new, found=lost and new.found)
        if new.cell != before.cell:
            places = " and ".join(at(cell, self.fleet.problem.world) for cell in (before.cell, new.cell))
            raise StateError(
                f"robot {number} is at {places} in step {self.fleet.step + 1}", expected="one place a step"
            )
        moves_left = before.moves_left if new.moves_left is None else new.moves_left
        return Report(new.cell, new.stopped, before.found, moves_left)

    def said(self) -> list[Json]:
        """They as files hold them."""
        width, late = self.fleet.problem.world.shape[1], self.fleet.step
        passed = [{"robot": robot, "cell": list(divmod(cell, width)), "step": late} for robot, cell in self.passed]
        return passed + [
            {"robot": number, **asdict(report), "cell": list(divmod(report.cell, width))}
            for number, report in self.now.items()
        ]


def whole_numbers(given: ArrayLike) -> NDArray[np.int64]:
    """They as an array; an empty one for anything else."""
    try:
        found = np.asarray(given)
    except ValueError:  # ragged
        found = np.zeros(0)
    return found if found.dtype.kind in "iu" else np.zeros(0, dtype=np.int64)
