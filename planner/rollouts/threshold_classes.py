"""Sums of each figure by classes of the team's total failure threshold, for control variates.

The total is the sum of a team's Exp(1) thresholds, without Weibull shape and hazard multipliers (SPEC section 14). Its
distribution is known, so it serves as a control variate (`analysis.statistics.variance_reduction`). Only whole numbers
are added, so no sum depends on how rollouts are shared out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.failure_model import exp1_thresholds, threshold_key
from planner.simulator.codes import Outcome
from planner.simulator.failure_sampling import threefry
from planner.simulator.jit import program
from planner.simulator.thresholds import UNIT
from planner.tally import RolloutResults

CLASSES_A_NAT = 8
"""Classes per nat of the total. Its variance is one square nat per robot; classes lose less than .14 % of that."""
COLUMNS = ("rollouts", "visited", "survived", "time", "alive", "complete")
"""Sums kept in each class."""
WIDTH = UNIT // CLASSES_A_NAT
STRIP = 512
"""Rollouts whose random words are drawn at a time."""
FACTORS = 16
"""Uniform numbers, each at least 2**-33, whose product a float64 represents with full precision."""
NEAR = 2.0**-28
"""Of a class, per robot: a total this close to the border of two classes is added up in whole units."""


@program
def _multiply(key0, key1, first, robot_from, robot_to, words, products):  # type: ignore[no-untyped-def]
    """Products float64 `[B]` of the robots' uniform numbers, for every rollout from id `first` on.

    `words`, uint32 `[STRIP]`, is scratch.
    """
    for begin in range(0, products.shape[0], STRIP):
        strip = products[begin : begin + STRIP]
        strip[:] = 1.0
        for robot in range(robot_from, robot_to):
            for number in range(len(strip)):  # a loop over draws only, which LLVM vectorises
                rollout = np.uint32(first + np.uint32(begin + number))
                words[number] = threefry(key0, key1, rollout, np.uint32(robot))[0]
            for number in range(len(strip)):
                strip[number] *= (words[number] + 0.5) * 2.0**-32


def classes_by_threshold(seed: int, start: int, count: int, robots: int) -> NDArray[np.int64]:
    """Classes of rollouts: floor(CLASSES_A_NAT * total threshold of robots 0 .. robots - 1).

    A total is minus the logarithm of a product. Thresholds are rounded to whole units, by at most .52 of one. Floats
    decide only where neither rounding matters, so every platform finds the same classes.

    Args:
        seed: of the random numbers.
        start: first id.
        count: rollouts.
        robots: K.

    Returns:
        int64 `[count]`.
    """
    key0, key1 = (np.uint32(word) for word in threshold_key(seed))
    totals, products, words = np.zeros(count), np.empty(count), np.empty(STRIP, dtype=np.uint32)
    for robot in range(0, robots, FACTORS):
        _multiply(key0, key1, np.uint32(start), robot, min(robot + FACTORS, robots), words, products)
        totals -= np.log(products, out=products)
    totals *= CLASSES_A_NAT
    classes = totals.astype(np.int64)
    near = np.flatnonzero(np.abs(totals - np.rint(totals)) < robots * NEAR)
    classes[near] = exp1_thresholds(seed, start + near, robots).sum(axis=1) // WIDTH
    return classes


def sums_by_threshold(results: RolloutResults, seed: int, robots: int) -> NDArray[np.int64]:
    """Sums over rollouts by class, as in `Tally.by_threshold`.

    Args:
        results: of consecutive rollouts.
        seed: of their random numbers.
        robots: K.

    Returns:
        int64 `[classes * len(COLUMNS)]`.
    """
    classes = classes_by_threshold(seed, results.start, len(results.visited), robots)
    sums = np.zeros((int(classes.max(initial=-1)) + 1, len(COLUMNS)), dtype=np.int64)
    figures = (results.visited, results.survived, results.time, results.alive, results.outcome)
    _add_figures(classes, *figures, int(Outcome.COMPLETE), sums)
    return sums.reshape(-1)


@program
def _add_figures(classes, visited, survived, time, alive, outcome, complete, sums):  # type: ignore[no-untyped-def]
    """In one pass over the rollouts: the results of a rollout are read once."""
    for number in range(classes.shape[0]):
        row = sums[classes[number]]
        row[0] += 1
        row[1] += visited[number]
        row[2] += survived[number]
        row[3] += time[number]
        row[4] += alive[number]
        row[5] += outcome[number] == complete
