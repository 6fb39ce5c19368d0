"""Everything that can happen in a closed loop, as a tree that the compiled simulator walks instead of rollouts.

A history carries its mass, a chance in units of 1 / WHOLE. At a checked visit it parts: so much is stopped, the rest
goes on, depth first. With one robot alive nothing parts: what it still covers is summed along its one path. A branch
below the cut is left: what it has covered by then is the least that it covers, everything the most. Masses are whole
numbers, so none is lost; each parting rounds by half a unit at most.
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
"""Powers of ten of the mass below which branches are left: at first, when next to nothing is, and when nothing is."""
CHEAP = 2_000
"""Histories of a tree so small that one without anything left is grown although its slack is small enough."""
FALL = 6
"""A cut ten times as fine leaves a fourth to a tenth of the slack: so much finer the next one is."""
MOST_LEFT = 0.9
"""A tree that leaves more than this at the first cut is beyond reach: four robots in much danger leave up to .87,
five .94 and more."""
CLOSE = 0.01
"""Steps, and robots, within which a mean counts as known."""


@dataclass(frozen=True, eq=False)
class Tree:
    """A tree of histories. Axes: `A` accessible cells, `K` robots, `T` steps.

    Attributes:
        counts: masses, as rollouts are counted: chances times WHOLE. `visits`, `covered`, `new` are the least.
        cut: mass below which branches were left. seconds: that it took to find it.
    """

    counts: Counts
    cut: int
    seconds: float = 0.0

    @property
    def share_cut(self) -> float:
        """The chance below which branches were left."""
        return self.cut / WHOLE

    @cached_property
    def left(self) -> float:
        """Chance of what was left."""
        return float(self.counts.left_visited.sum()) / WHOLE

    @property
    def histories(self) -> int:
        """Ends that were reached, and branches that were left."""
        return int(self.counts.histories[:2].sum())

    @cached_property
    def rounding(self) -> float:
        """How far all chances together may be off: half a unit at each visit, and float64's own share."""
        return 2.0**-40 + float(self.counts.histories[2]) / WHOLE

    def bounds(self, figure: str, least: NDArray[np.float64], most: NDArray[np.float64]) -> tuple[float, float]:
        """The mean of a figure: at the ends, and between `least` and `most` where branches were left, by their value.

        A point where nothing was left.
        """
        ended, left = (getattr(self.counts, name).astype(np.float64) / WHOLE for name in (figure, f"left_{figure}"))
        sure = float(ended @ np.arange(len(ended)))
        if not self.left:
            return sure, sure
        low, high = sure + float(left @ least), sure + float(left @ most)
        wide = self.rounding * (len(ended) - 1)
        return max(low - wide, 0.0), min(high + wide, len(ended) - 1.0)

    def covered(self, figure: str) -> tuple[float, float]:
        """Expected cells "visited" or "survived", at least and at most."""
        cells = np.arange(len(self.counts.visited), dtype=np.float64)
        return self.bounds(figure, cells, np.full_like(cells, cells[-1]))

    def quantile(self, figure: str, share: float) -> tuple[int, int]:
        """The least number of cells "visited" or "survived" that a `share` of runs do not exceed, at least and at most.

        What was left covers no less than it had, and maybe everything.
        """
        ended, left = (getattr(self.counts, name).cumsum() / WHOLE for name in (figure, f"left_{figure}"))
        wide = self.rounding if self.left else 0.0
        surely = np.where(np.arange(len(left)) < len(left) - 1, ended, ended + left)
        low, high = (np.searchsorted(reached, share) for reached in (ended + left + wide, surely - wide))
        return int(low), min(int(high), len(ended) - 1)

    def cells(self, figure: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The chance that each cell `[A]` is "visited" or "survived", at least and at most."""
        covered = self.counts.covered - (self.counts.unsurvived if figure == "survived" else 0)
        return self.chance(covered)

    def visits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Expected visits of each cell `[A]`, at least and at most: in what was left each robot's every other move."""
        low = self.counts.visits / WHOLE
        if not self.left:
            return low, low
        moves = (len(self.counts.time) + 1) // 2
        further = float(self.counts.left_alive @ np.arange(len(self.counts.left_alive))) / WHOLE * moves
        return np.maximum(low - self.rounding * moves, 0.0), low + further + self.rounding * moves

    def alive(self) -> tuple[float, float]:
        """Expected robots alive at the end, at least and at most."""
        robots = np.arange(len(self.counts.alive), dtype=np.float64)
        return self.bounds("alive", np.zeros_like(robots), robots)

    def home(self) -> tuple[float, float]:
        """Expected robots at home at the end, at least and at most: in what was left maybe all that are alive."""
        sure, left = (float(of @ np.arange(len(of))) / WHOLE for of in (self.counts.home, self.counts.left_alive))
        return sure, sure + left

    def chance_home(self, least: int) -> tuple[float, float]:
        """The chance that so many robots or more are at home at the end, at least and at most."""
        sure, left = (float(of[least:].sum()) / WHOLE for of in (self.counts.home, self.counts.left_alive))
        return (
            (sure, sure) if not self.left else (max(sure - self.rounding, 0.0), min(sure + left + self.rounding, 1.0))
        )

    def chance_left(self) -> tuple[float, float]:
        """The chance that some robot is alive at the end, at least and at most."""
        return self.chance(self.counts.alive[1:].sum())

    def chance_complete(self) -> tuple[float, float]:
        """The chance that every cell is visited, at least and at most."""
        return self.chance(self.counts.outcomes[Outcome.COMPLETE])

    def chance(self, mass: Any) -> tuple[Any, Any]:
        """Of what has so much mass among the ends, at least and at most; a point where nothing was left."""
        sure = mass / WHOLE
        if not self.left:
            return sure, sure
        return np.maximum(sure - self.rounding, 0.0), np.minimum(sure + self.left + self.rounding, 1.0)

    def chance_of(self, figure: str, needed: int) -> tuple[float, float]:
        """The chance that so many cells or more are "visited" or "survived", at least and at most."""
        ended, left = (getattr(self.counts, name) for name in (figure, f"left_{figure}"))
        sure = float(ended[needed:].sum() + left[needed:].sum()) / WHOLE
        if not self.left or needed >= len(ended):
            return sure, sure
        return max(sure - self.rounding, 0.0), min(sure + float(left[:needed].sum()) / WHOLE + self.rounding, 1.0)

    def time(self) -> tuple[float, float]:
        """Expected steps, at least and at most: what was left may take all there are."""
        times = self.counts.time.astype(np.float64)
        sure = float(times @ np.arange(len(times))) / WHOLE
        return sure, sure + self.left * (len(times) - 1)

    @property
    def mean_time(self) -> float | None:
        """Expected steps, if known (CLOSE)."""
        return _known(*self.time())

    @property
    def mean_alive(self) -> float | None:
        """Expected robots alive at the end, if known (CLOSE)."""
        return _known(*self.alive())

    @property
    def mean_home(self) -> float | None:
        """Expected robots at home at the end, if known (CLOSE)."""
        return _known(*self.home())

    @property
    def slack(self) -> float:
        """Cells between the least and the most, of either meaning."""
        return max(high - low for low, high in map(self.covered, ("visited", "survived")))


def _known(low: float, high: float) -> float | None:
    return None if high - low > CLOSE else (low + high) / 2


def grow_tree(loop: ClosedLoop, slack: float, most: int, cheap: int = CHEAP) -> Tree | None:
    """The tree of a loop on a known map, with at most so much slack in cells; None: not within `most` histories.

    The cut falls until the slack is small; of a tree of no more than `cheap` histories until FINE_CUT. Nothing is left
    out of CHEAP ones, and at once of teams of two, whose trees have no more histories than their paths have dangers.
    """
    runner = Runner(loop, 0, loop.robots + 1)
    if loop.in_doubt or loop.movers is not None or loop.weights is not None or not runner.has_levels:
        return None
    began, good = time.perf_counter(), None
    power = FIRST_CUT if loop.robots > 2 else FINEST_CUT
    while True:
        cut = max(WHOLE // 10**power, 1)
        tree = Tree(runner.grow(WHOLE, cut, most), cut, time.perf_counter() - began)
        if tree.histories >= most or (power == FIRST_CUT and tree.left > MOST_LEFT):
            return good
        if tree.slack > slack:
            power = min(power + ceil(log(tree.slack / slack, FALL)), FINEST_CUT)
        elif tree.left and ((power < FINE_CUT and tree.histories <= cheap) or tree.histories <= CHEAP):
            good, power = tree, FINE_CUT if power < FINE_CUT else FINEST_CUT
        else:
            return tree
