"""What a tally says of a mission as a decision wants it: the worst runs, robots left, time to a share of the cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Estimate, proportion
from planner.tally import Tally

SHARES = (0.5, 0.75, 0.9, 0.95, 0.99)
"""Of the accessible cells, by when so many are covered on average."""
TAIL = 0.05
"""Of the runs, the worst ones that CVaR is the mean of."""


def tail_mean(counts: NDArray[np.int64], tail: float = TAIL) -> float:
    """CVaR: the mean of the least values `0, 1, 2, ...` of a histogram, those of a share `tail` of its rollouts.

    The last rollouts of the tail count with the part of them that is in it (Rockafellar & Uryasev 2002).
    """
    wanted = tail * float(counts.sum())
    taken = np.minimum(np.cumsum(counts), wanted)
    return float(np.diff(taken, prepend=0.0) @ np.arange(len(counts))) / wanted


def robots_left(tally: Tally, certain: bool = False) -> list[Estimate]:
    """P(at least m robots are left at the end) for m = 1, ..., K."""
    return [proportion(int(count), tally.rollouts, certain) for count in at_least(tally.alive)]


def at_least(counts: NDArray) -> NDArray:
    """Of counts or chances of 0, 1, ..., K those of at least 1, ..., K."""
    return np.cumsum(counts[::-1])[::-1][1:]


def times_to(tally: Tally, shares: tuple[float, ...] = SHARES) -> dict[float, int | None]:
    """The first step by whose end a share of the accessible cells is visited on average; None: never."""
    curve = np.cumsum(tally.new_visited) / tally.rollouts
    found = {share: np.flatnonzero(curve >= share * tally.accessible - 1e-9) for share in shares}
    return {share: int(steps[0]) if len(steps) else None for share, steps in found.items()}
