"""What rollouts came to by the luck of their team: sums of each figure by classes of the total tolerance.

A total is a robot's tolerances added up over the team, before wear and susceptibility (SPEC section 14). It is known
what to expect of it, so an estimate can be put right by how lucky its rollouts happened to be
(`analysis.statistics.control`). Whole numbers alone are added, so no sum depends on how rollouts are shared out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.jit import program
from planner.kernels.luck import threefry, tolerance
from planner.tally import Outcome, RolloutResults
from planner.tolerance import UNIT, key_of_luck

CLASSES_A_NAT = 8
"""Of the total, which has a variance of one square nat a robot: classes take less than .14 % of that away."""
COLUMNS = ("rollouts", "visited", "survived", "time", "alive", "complete")
"""Summed up in each class."""
WIDTH = UNIT // CLASSES_A_NAT


@program
def _add_classes(key0, key1, first, robots, classes):  # type: ignore[no-untyped-def]
    """The class int64 `[B]` of every rollout from id `first` on."""
    for number in range(classes.shape[0]):
        total = np.int64(0)
        for robot in range(robots):
            total += tolerance(threefry(key0, key1, np.uint32(first + np.uint32(number)), np.uint32(robot))[0])
        classes[number] = total // WIDTH


def luck_classes(seed: int, start: int, count: int, robots: int) -> NDArray[np.int64]:
    """int64 `[count]`, floor(total tolerance of robots 0 .. robots - 1 * CLASSES_A_NAT) of rollouts from `start` on."""
    key, classes = key_of_luck(seed), np.empty(count, dtype=np.int64)
    _add_classes(np.uint32(key[0]), np.uint32(key[1]), np.uint32(start), robots, classes)
    return classes


def sums_by_luck(results: RolloutResults, seed: int, robots: int) -> NDArray[np.int64]:
    """int64 `[classes * len(COLUMNS)]`, as `Tally.by_luck` has them, of rollouts by tolerance of so many robots."""
    classes = luck_classes(seed, results.start, len(results.visited), robots)
    complete = results.outcome == Outcome.COMPLETE
    figures = (results.visited, results.survived, results.time, results.alive, complete)
    sums = [np.bincount(classes), *(_summed(classes, values) for values in figures)]
    return np.stack(sums, axis=1).reshape(-1)


def _summed(classes: NDArray[np.int64], values: NDArray) -> NDArray[np.int64]:
    """Exact: float64 holds every whole number below 2**53, and a range of ids has no larger sum."""
    return np.bincount(classes, weights=values).astype(np.int64)
