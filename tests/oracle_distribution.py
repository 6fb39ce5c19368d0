"""The open loop's exact distribution of coverage: P(m cells covered), where the plan's overlaps allow it.

What one robot covers is a prefix of the cells of its path in order of first entry, and the robots' luck is
independent; only which shared cells are covered already ties them together. So the robots are joined one at a time,
and of those joined only the covered cells are remembered that a later one enters too. Axis `A` = accessible cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.theory.exact import RobotChances, robot_chances
from planner.arguments import check_word
from planner.plans.plan import Plan
from planner.worlds.world import World

MOST_WORK = 1_000_000
"""Pairs of (covered shared cells, prefix of the next robot) that are joined before giving up; about 5 us each."""


@dataclass(frozen=True, eq=False)
class CoverageChances:
    """The open loop's distribution of coverage.

    Attributes:
        visited, survived: float64 `[A + 1]`, chance that exactly so many cells are covered, in each meaning.
    """

    visited: NDArray[np.float64]
    survived: NDArray[np.float64]

    def at_least(self, cells: int, meaning: Literal["visited", "survived"] = "visited") -> float:
        """Chance that `cells` or more are covered. Raises UsageError for a meaning that is none."""
        check_word("meaning", meaning, ("visited", "survived"))
        return float((self.visited if meaning == "visited" else self.survived)[cells:].sum())


def coverage_chances(plan: Plan, world: World, *, most_work: int = MOST_WORK) -> CoverageChances | None:
    """The exact distribution of the cells covered, or None if that would take more than `most_work` joinings.

    Robots that share no cells cost nothing extra. Among robots that do, the cost is (distinct sets of covered shared
    cells) x (prefixes of the next robot), each a convolution over `[A + 1]`: for two robots the product of their
    prefixes of shared cells, for k that reach the same cells up to the k-th power of them.
    """
    robots = [robot_chances(robot, world, plan.bearing, number) for number, robot in enumerate(plan.robots)]
    accessible = int(world.accessible(plan.starts).sum())
    visited = _joined([_prefixes(robot, visited=True) for robot in robots], accessible, most_work)
    survived = _joined([_prefixes(robot, visited=False) for robot in robots], accessible, most_work)
    return None if visited is None or survived is None else CoverageChances(visited, survived)


@dataclass(frozen=True, eq=False)
class _Prefixes:
    """One robot: `cells`, its distinct cells in order of first entry; `chance` `[cells + 1]`, by how many it covers."""

    cells: list[int]
    chance: NDArray[np.float64]


def _prefixes(robot: RobotChances, *, visited: bool) -> _Prefixes:
    by_now = np.cumsum(robot.first)  # distinct cells entered, this entry included
    covered = by_now if visited else by_now - robot.first
    chance = np.zeros(by_now[-1] + 1)
    np.add.at(chance, covered, robot.reach * robot.threat)
    chance[by_now[-1]] += robot.survival
    return _Prefixes(robot.cells[robot.first].tolist(), chance)


def _joined(robots: list[_Prefixes], accessible: int, most_work: int) -> NDArray[np.float64] | None:
    """Distribution of the size of the union of the robots' prefixes, float64 `[A + 1]`; None: too much work."""
    left = _in_order(robots)
    chances = {0: np.zeros(accessible + 1)}  # by the set of covered cells that matter later, as bits
    chances[0][0] = 1.0
    work = 0
    while left:
        robot, *left = left
        later = {cell for other in left for cell in other.cells}
        before = set().union(*(other.cells for other in robots if other is not robot))
        classes = _classes(robot, {cell for cell in robot.cells if cell in before})
        work += len(chances) * len(classes)
        if work > most_work:
            return None
        chances = _join(chances, classes, sum(1 << cell for cell in later))
    return chances[0]


def _in_order(robots: list[_Prefixes]) -> list[_Prefixes]:
    """Next always the robot that leaves the fewest cells to remember: groups that share no cells come in a row."""
    left, entered, order = list(robots), set[int](), list[_Prefixes]()

    def remembered(robot: _Prefixes) -> int:
        others = set().union(*(other.cells for other in left if other is not robot))
        return len((entered | set(robot.cells)) & others)

    while left:
        chosen = min(left, key=remembered)
        left.remove(chosen)
        entered |= set(chosen.cells)
        order.append(chosen)
    return order


def _classes(robot: _Prefixes, shared: set[int]) -> list[tuple[int, int, NDArray[np.float64]]]:
    """The robot's prefixes by the shared cells in them: (those cells as bits, least of its own, chance by own more)."""
    bits, own, classes, begin = 0, 0, [], 0
    for length in range(len(robot.cells) + 1):
        last = length == len(robot.cells)
        if last or robot.cells[length] in shared:
            chance = robot.chance[begin : length + 1]
            if chance.any():
                classes.append((bits, own, chance))
            own += length - begin
            begin = length + 1
            bits |= 0 if last else 1 << robot.cells[length]
    return classes


def _join(
    chances: dict[int, NDArray[np.float64]], classes: list[tuple[int, int, NDArray[np.float64]]], later: int
) -> dict[int, NDArray[np.float64]]:
    """One robot more: the distribution of cells covered by each set of covered cells that matters `later`."""
    joined: dict[int, NDArray[np.float64]] = {}
    for covered, chance in chances.items():
        for bits, own, more in classes:
            new = own + (bits & ~covered).bit_count()
            into = joined.setdefault((covered | bits) & later, np.zeros_like(chance))
            into[new:] += np.convolve(chance, more)[: len(into) - new]
    return joined
