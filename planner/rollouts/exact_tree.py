"""The exact distribution of a closed loop: a tree of histories that the compiled simulator walks instead of rollouts.

A history carries its mass, a probability in units of 1 / WHOLE. At a checked visit it splits: one part loses the robot,
the other goes on, depth first. With one robot alive nothing splits: its remaining coverage is summed along one path. A
branch below the cut is left: the cells that it has covered are a lower bound, all cells an upper bound. Masses are
whole numbers, so none is lost; each split rounds by at most half a unit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from math import ceil, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.rollouts.loop import ClosedLoop
from planner.rollouts.runners import Runner
from planner.simulator.codes import Outcome
from planner.simulator.state import Counts

WHOLE = 2**50
"""Units of mass: sums over 8,192 visits of a cell still fit into 64 bits."""
FIRST_CUT, FINE_CUT, FINEST_CUT = 4, 12, 16
"""Cuts as powers of ten: the first; the one at which next to nothing is left; and the one at which nothing is."""
CHEAP = 2_000
"""Histories of a tree so small that one without branches left is grown even if the slack is small enough."""
FALL = 6
"""A cut ten times finer leaves a fourth to a tenth of the slack; the next cut is chosen by this factor."""
MOST_LEFT = 0.9
"""A tree that leaves more than this at the first cut is out of reach: four robots in much danger leave up to .87,
five .94 and more."""
CLOSE = 0.01
"""Steps, and robots, within which a mean counts as known."""


@dataclass(frozen=True, eq=False)
class Tree:
    """A tree of histories. Axes: `A` accessible cells, `K` robots, `T` steps.

    Attributes:
        counts: masses, counted as rollouts are: probabilities times WHOLE. `visits`, `covered`, `new` are lower bounds.
        cut: mass below which branches were left. seconds: time to grow the tree, all cuts included.
    """

    counts: Counts
    cut: int
    seconds: float = 0.0

    @cached_property
    def left(self) -> float:
        """Probability of the branches that were left."""
        return float(self.counts.left_visited.sum()) / WHOLE

    @property
    def histories(self) -> int:
        """Number of ends reached and branches left."""
        return int(self.counts.histories[:2].sum())

    @cached_property
    def rounding(self) -> float:
        """Bound on the rounding of all probabilities together: half a unit per visit, and that of float64."""
        return 2.0**-40 + float(self.counts.histories[2]) / WHOLE

    def bounds(self, figure: str, least: NDArray[np.float64], most: NDArray[np.float64]) -> tuple[float, float]:
        """Bounds on the mean of a figure.

        Args:
            figure: "visited", "survived" or "alive".
            least, most: `[values]`, bounds on the figure at the end of a branch left at each of its values.

        Returns:
            (lower, upper); equal if no branch was left.
        """
        ended, left = (getattr(self.counts, name).astype(np.float64) / WHOLE for name in (figure, f"left_{figure}"))
        # Masses are whole numbers below 2**53, so float64 holds each of them exactly.
        sure = float(ended @ np.arange(len(ended)))
        if not self.left:
            return sure, sure
        low, high = sure + float(left @ least), sure + float(left @ most)
        # Only bounds of a cut tree are widened: a complete tree is reported as a point.
        wide = self.rounding * (len(ended) - 1)
        return max(low - wide, 0.0), min(high + wide, len(ended) - 1.0)

    def covered(self, figure: str) -> tuple[float, float]:
        """Bounds on the expected number of cells "visited" or "survived"."""
        cells = np.arange(len(self.counts.visited), dtype=np.float64)
        return self.bounds(figure, cells, np.full_like(cells, cells[-1]))

    def quantile(self, figure: str, share: float) -> tuple[int, int]:
        """Bounds on the number of cells "visited" or "survived" that a `share` of runs do not exceed.

        Branches that were left cover at least their present cells, and at most all.
        """
        ended, left = (getattr(self.counts, name).cumsum() / WHOLE for name in (figure, f"left_{figure}"))
        wide = self.rounding if self.left else 0.0
        # A branch left may still cover all cells, so its mass counts as below the quantile only at the last value.
        surely = np.where(np.arange(len(left)) < len(left) - 1, ended, ended + left)
        low, high = (np.searchsorted(reached, share) for reached in (ended + left + wide, surely - wide))
        return int(low), min(int(high), len(ended) - 1)

    def cells(self, figure: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounds on the probability that each cell `[A]` is "visited" or "survived"."""
        covered = self.counts.covered - (self.counts.unsurvived if figure == "survived" else 0)
        return self.chance(covered)

    def visits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounds on the expected visits of each cell `[A]`: in a branch left each robot enters it every other step."""
        low = self.counts.visits / WHOLE
        if not self.left:
            return low, low
        # A robot cannot enter the same cell in two steps in a row.
        moves = (len(self.counts.time) + 1) // 2
        further = float(self.counts.left_alive @ np.arange(len(self.counts.left_alive))) / WHOLE * moves
        return np.maximum(low - self.rounding * moves, 0.0), low + further + self.rounding * moves

    def alive(self) -> tuple[float, float]:
        """Bounds on the expected number of robots alive at the end."""
        robots = np.arange(len(self.counts.alive), dtype=np.float64)
        return self.bounds("alive", np.zeros_like(robots), robots)

    def home(self) -> tuple[float, float]:
        """Bounds on the expected number of robots at base at the end: of branches left possibly all robots alive."""
        sure, left = (float(of @ np.arange(len(of))) / WHOLE for of in (self.counts.home, self.counts.left_alive))
        return sure, sure + left

    def chance_home(self, least: int) -> tuple[float, float]:
        """Bounds on the probability that at least `least` robots are at base at the end."""
        return self.chance(*(float(of[least:].sum()) for of in (self.counts.home, self.counts.left_alive)))

    def chance_left(self) -> tuple[float, float]:
        """Bounds on the probability that some robot is alive at the end."""
        return self.chance(self.counts.alive[1:].sum())

    def chance_complete(self) -> tuple[float, float]:
        """Bounds on the probability that every cell is visited."""
        return self.chance(self.counts.outcomes[Outcome.COMPLETE])

    def chance(self, mass: Any, left: float | None = None) -> tuple[Any, Any]:
        """Bounds on a probability with this mass among the ends; equal if no branch was left.

        `left`: mass of the branches left in which it may come true; None: all of them.
        """
        sure, more = mass / WHOLE, self.left if left is None else left / WHOLE
        if not self.left:
            return sure, sure
        return np.maximum(sure - self.rounding, 0.0), np.minimum(sure + more + self.rounding, 1.0)

    def chance_of(self, figure: str, needed: int) -> tuple[float, float]:
        """Bounds on the probability that at least `needed` cells are "visited" or "survived"."""
        ended, left = (getattr(self.counts, name) for name in (figure, f"left_{figure}"))
        # Branches left with enough cells already count: coverage never falls.
        sure = float(ended[needed:].sum() + left[needed:].sum())
        return (sure / WHOLE,) * 2 if needed >= len(ended) else self.chance(sure, float(left[:needed].sum()))

    def time(self) -> tuple[float, float]:
        """Bounds on the expected number of steps: branches left may take all steps."""
        times = self.counts.time.astype(np.float64)
        sure = float(times @ np.arange(len(times))) / WHOLE
        return sure, sure + self.left * (len(times) - 1)

    @property
    def mean_time(self) -> float | None:
        """Expected number of steps, None if not known within CLOSE."""
        return _known(*self.time())

    @property
    def mean_alive(self) -> float | None:
        """Expected number of robots alive at the end, None if not known within CLOSE."""
        return _known(*self.alive())

    @property
    def mean_home(self) -> float | None:
        """Expected number of robots at base at the end, None if not known within CLOSE."""
        return _known(*self.home())

    @property
    def slack(self) -> float:
        """Cells between the bounds on expected coverage, the larger of both meanings."""
        return max(high - low for low, high in map(self.covered, ("visited", "survived")))


def _known(low: float, high: float) -> float | None:
    return None if high - low > CLOSE else (low + high) / 2


def grow_tree(loop: ClosedLoop, slack: float, most: int, cheap: int = CHEAP) -> Tree | None:
    """Grow the tree of a loop on a known map.

    The cut falls until the slack is small; for a tree of at most `cheap` histories until FINE_CUT. With CHEAP
    histories, and for teams of two, no branch is left.

    Args:
        loop: with a known map, no moving threats and no weights.
        slack: cells between the bounds, at most.
        most: histories, at most.
        cheap: histories up to which the cut falls further.

    Returns:
        The tree; None if `most` histories do not suffice, or if the loop has none.
    """
    runner = Runner(loop, 0, loop.robots + 1)
    if loop.is_uncertain or loop.moving_threats is not None or loop.weights is not None or not runner.has_levels:
        return None
    began, good = time.perf_counter(), None
    # A tree of two robots has no more histories than their paths have dangers, so it is grown without a cut.
    power = FIRST_CUT if loop.robots > 2 else FINEST_CUT
    while True:
        cut = max(WHOLE // 10**power, 1)
        tree = Tree(runner.grow(WHOLE, cut, most), cut, time.perf_counter() - began)
        if tree.histories >= most or (power == FIRST_CUT and tree.left > MOST_LEFT):
            return good
        # The next cut is chosen by the slack missing: each cut grows the tree again, at a multiple of the cost.
        if tree.slack > slack:
            power = min(power + ceil(log(tree.slack / slack, FALL)), FINEST_CUT)
        elif tree.left and ((power < FINE_CUT and tree.histories <= cheap) or tree.histories <= CHEAP):
            good, power = tree, FINE_CUT if power < FINE_CUT else FINEST_CUT
        else:
            return tree
