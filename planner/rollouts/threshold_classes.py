"""What rollouts came to by the luck of their team: sums of each figure by classes of the total tolerance.

A total is a robot's tolerances added up over the team, before wear and susceptibility (SPEC section 14). It is known
what to expect of it, so an estimate can be put right by how lucky its rollouts happened to be
(`analysis.statistics.variance_reduction`). Whole numbers alone are added, so no sum depends on how rollouts are shared
out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.failure_model import key_of_luck, tolerances
from planner.simulator.codes import Outcome
from planner.simulator.failure_sampling import threefry
from planner.simulator.jit import program
from planner.simulator.thresholds import UNIT
from planner.tally import RolloutResults

CLASSES_A_NAT = 8
"""Of the total, which has a variance of one square nat a robot: classes take less than .14 % of that away."""
COLUMNS = ("rollouts", "visited", "survived", "time", "alive", "complete")
"""Summed up in each class."""
WIDTH = UNIT // CLASSES_A_NAT
STRIP = 512
"""Rollouts of which a robot's words are drawn at a time."""
FACTORS = 16
"""Uniform numbers, each at least 2**-33, whose product is a float64 in full precision."""
NEAR = 2.0**-28
"""Of a class and robot: a total so near to the border of two classes is added up in whole units."""


@program
def _multiply(key0, key1, first, robot_from, robot_to, words, products):  # type: ignore[no-untyped-def]
    """The product float64 `[B]` of the robots' uniform numbers, of every rollout from id `first` on.

    `words`, uint32 `[STRIP]`: scratch.
    """
    for begin in range(0, products.shape[0], STRIP):
        strip = products[begin : begin + STRIP]
        strip[:] = 1.0
        for robot in range(robot_from, robot_to):
            for number in range(len(strip)):  # apart from what follows, so that LLVM draws several at a time
                rollout = np.uint32(first + np.uint32(begin + number))
                words[number] = threefry(key0, key1, rollout, np.uint32(robot))[0]
            for number in range(len(strip)):
                strip[number] *= (words[number] + 0.5) * 2.0**-32


def luck_classes(seed: int, start: int, count: int, robots: int) -> NDArray[np.int64]:
    """int64 `[count]`, floor(total tolerance of robots 0 .. robots - 1 * CLASSES_A_NAT) of rollouts from `start` on.

    A total is minus the logarithm of a product. Tolerances are rounded to whole units, by at most .52 of one. Floats
    decide only where neither rounding matters, so every platform finds the same classes.
    """
    key0, key1 = (np.uint32(word) for word in key_of_luck(seed))
    totals, products, words = np.zeros(count), np.empty(count), np.empty(STRIP, dtype=np.uint32)
    for robot in range(0, robots, FACTORS):
        _multiply(key0, key1, np.uint32(start), robot, min(robot + FACTORS, robots), words, products)
        totals -= np.log(products, out=products)
    totals *= CLASSES_A_NAT
    classes = totals.astype(np.int64)
    near = np.flatnonzero(np.abs(totals - np.rint(totals)) < robots * NEAR)
    classes[near] = tolerances(seed, start + near, robots).sum(axis=1) // WIDTH
    return classes


def sums_by_luck(results: RolloutResults, seed: int, robots: int) -> NDArray[np.int64]:
    """int64 `[classes * len(COLUMNS)]`, as `Tally.by_luck` has them, of rollouts of so many robots."""
    classes = luck_classes(seed, results.start, len(results.visited), robots)
    sums = np.zeros((int(classes.max(initial=-1)) + 1, len(COLUMNS)), dtype=np.int64)
    figures = (results.visited, results.survived, results.time, results.alive, results.outcome)
    _add_figures(classes, *figures, int(Outcome.COMPLETE), sums)
    return sums.reshape(-1)


@program
def _add_figures(classes, visited, survived, time, alive, outcome, complete, sums):  # type: ignore[no-untyped-def]
    """In one pass: what is kept of single rollouts lies together, and is met once."""
    for number in range(classes.shape[0]):
        row = sums[classes[number]]
        row[0] += 1
        row[1] += visited[number]
        row[2] += survived[number]
        row[3] += time[number]
        row[4] += alive[number]
        row[5] += outcome[number] == complete
