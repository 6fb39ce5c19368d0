"""Which of many evaluated rollouts to record: found as they stream by, in memory that does not grow with them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import quantile
from planner.arguments import argument
from planner.errors import UsageError
from planner.none import NO_ROLLOUT
from planner.tally import RolloutResults
from planner.threefry import key_of, threefry2x32

EXPECTED = "worst, median, best, random or quantile:Q with 0 < Q < 1"
_PURPOSE = 0x5049434B
"""Counter of the draw of `random`: "PICK"."""


@dataclass(frozen=True)
class Pick:
    """One choice: its name as given, and the quantile of visited coverage that it asks for (None: any rollout)."""

    name: str
    q: float | None


def parse_picks(text: str) -> tuple[Pick, ...]:
    """`"worst,median,quantile:0.05"` as picks, each name once. Raises UsageError."""
    named = {"worst": 0.0, "median": 0.5, "best": 1.0, "random": None}
    picks: dict[str, Pick] = {}
    for name in text.split(","):
        if name in named:
            picks[name] = Pick(name, named[name])
            continue
        number = re.fullmatch(r"quantile:(0?\.[0-9]{1,15})", name, re.ASCII)
        if number is None or not 0 < float(number[1]) < 1:
            raise UsageError(f"{argument('pick')} {name!r}", expected=EXPECTED)
        picks[name] = Pick(name, float(number[1]))
    return tuple(picks.values())


def parse_ids(text: str, most: int) -> tuple[int, ...]:
    """`"0,5,7-9"` as rollout ids, each once, in the order given; at most `most`. Raises UsageError."""
    ids: dict[int, None] = {}
    for part in text.split(","):
        bounds = re.fullmatch(r"([0-9]{1,1000})(?:-([0-9]{1,1000}))?", part, re.ASCII)
        if bounds is None:
            raise UsageError(f"{argument('ids')} {part[:60]!r}", expected='rollout ids, as "0,5,7-9"')
        first, last = int(bounds[1]), int(bounds[2] or bounds[1])
        if not first <= last < 2**32:
            expected = "ids below 2**32" if last >= 2**32 or "-" not in part else "the first id not above the last"
            raise UsageError(f"{argument('ids')} {part[:60]!r}", expected=expected)
        if last - first + 1 + len(ids) > most:
            raise UsageError(f"{argument('ids')} {text[:60]!r}: too many", expected=f"at most {most} rollouts in full")
        ids.update(dict.fromkeys(range(first, last + 1)))
    return tuple(ids)


class Picker:
    """Keeps, for every number of cells visited, the rollout to show for it.

    A quantile of visited coverage is a number of cells (`analysis.statistics.estimate.quantile`). Of the rollouts that
    visited just so many, the one with the most survived is taken, then the shortest, then the lowest id; for `worst`,
    the one with the fewest survived, then the longest, then the lowest id. Memory: a few numbers for each accessible
    cell.
    """

    def __init__(self, accessible: int) -> None:
        self._counts = np.zeros(accessible + 1, dtype=np.int64)
        self._top = np.full((accessible + 1, 3), NO_ROLLOUT, dtype=np.int64)  # survived, time, id
        self._worst: tuple[int, int, int, int] | None = None  # visited, survived, -time, id

    def add(self, results: RolloutResults) -> None:
        """Look at the rollouts of the next ids."""
        visited = results.visited.astype(np.int64)
        if not len(visited):
            return
        self._counts += np.bincount(visited, minlength=len(self._counts))
        order = np.lexsort((results.time, -results.survived, visited))  # stable: ids in order
        firsts = order[np.flatnonzero(np.diff(visited[order], prepend=-1))]
        new = np.stack([results.survived[firsts], results.time[firsts], results.start + firsts], axis=1)
        old = self._top[visited[firsts]]
        better = (old[:, 2] == NO_ROLLOUT) | _above(new, old)
        self._top[visited[firsts][better]] = new[better]
        low = np.flatnonzero(visited == visited.min())
        last = low[np.lexsort((-results.time[low], results.survived[low]))[0]]
        worst = (int(visited[last]), int(results.survived[last]), -int(results.time[last]), results.start + int(last))
        self._worst = worst if self._worst is None else min(self._worst, worst)

    def choose(self, pick: Pick, seed: int) -> int:
        """The id of the rollout; `random`: any of those seen (ids from 0), by the seed alone."""
        if pick.q is None:
            total = int(self._counts.sum())
            high, low = threefry2x32(key_of(seed), np.uint32(_PURPOSE), np.uint32(0))
            return ((int(high) << 32 | int(low)) * total) >> 64
        if pick.q == 0.0:
            assert self._worst is not None
            return self._worst[3]
        return int(self._top[quantile(self._counts, pick.q), 2])


def _above(new: NDArray[np.int64], old: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each (survived, time) of `new` is better: more survived, then shorter. Equal ones keep the earlier id."""
    return (new[:, 0] > old[:, 0]) | ((new[:, 0] == old[:, 0]) & (new[:, 1] < old[:, 1]))
