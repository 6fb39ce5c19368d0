"""The bound for every strategy of one robot: of all paths through the map, each new cell counted once, at a price.

One robot that is not stopped learns nothing, so a strategy is a path, perhaps drawn by chance. It visits node v with
chance `S_v`, the product of 1 - p over its entries before v. For any prices `m_v >= 0`

    sum_v w_v S_v  <=  sum_v m_v + max over paths, visits that repeat an earlier one included, of
                                   sum over visits max(0, w_v S - m_v)

since a path visits v for the first time once at most. The maximum is found backwards over (node, S), and needs no
memory of what was visited: with good prices it does not pay to come twice. S falls along `q ** l`, q = 1 - 1 / Q, each
p rounded down to whole levels l. What lies beyond the last level is worth no more than all cells at its S.

Prices are found by generating columns: a linear programme mixes the paths found so far under `every v once on
average`, its prices ask for the next path. Nothing of that is trusted: levels are checked in exact fractions and the
maximum is summed up in integers, every rounding upwards, so any prices prove what comes out.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import highspy
import numpy as np
from numpy.typing import NDArray

from analysis.theory.nodes import Nodes
from planner.jit import compiled

WORTH, SHARE = 2**18, 2**22
"""Units of w and S, as integers; those of prices and sums are their product."""
LEVELS, LAST = 400, 7
"""Q at least; levels go down to S of e ** -LAST."""
MOST_STATES = 1_000_000
"""(node, level) up to which it is worked out."""
ROUNDS = 300
"""Paths asked for at most; fewer only make the bound less sharp."""
BEGIN, STEP = 0.3, 0.1
"""Prices at first, as a share of w; how far they go each round from the best so far towards the programme's."""
CLOSE = 1e-4
"""It ends when less than this share of the cells could be gained."""


@dataclass(frozen=True, eq=False)
class Levels:
    """int64: `share` `[L]`, no less than S at each level; `fall` `[V]`, levels that a visit costs at least."""

    share: NDArray[np.int64]
    fall: NDArray[np.int64]


def path_bound(nodes: Nodes) -> float | None:
    """Expected cells visited that no strategy of one robot exceeds.

    None for more robots, and where areas are too large or dangers too small for MOST_STATES and 63 bits.
    """
    levels = _levels(nodes) if nodes.robots == 1 else None
    if levels is None:
        return None
    worth = np.ceil(nodes.weight * WORTH).astype(np.int64)
    mixture = Mixture(len(worth))
    asked = best = BEGIN * nodes.weight
    least = np.inf
    for _ in range(ROUNDS):
        price = np.rint(asked * (WORTH * SHARE)).astype(np.int64)
        most, counted, value = _best_path(nodes, levels, worth, price)
        proven = float(np.nextafter(float(Fraction(most + sum(price.tolist()), WORTH * SHARE)), np.inf))
        if proven < least:
            least, best = proven, asked
        mixed, wanted = mixture.add(counted, value)
        if least - mixed < CLOSE * nodes.weight.sum():
            break
        asked = STEP * wanted + (1.0 - STEP) * best
    return least


def _levels(nodes: Nodes) -> Levels | None:
    dangerous = nodes.threat > 0
    parts = max(LEVELS, int(np.ceil(1.0 / nodes.threat[dangerous].min())) + 1) if dangerous.any() else LEVELS
    count = LAST * parts
    largest = 2.0 * (parts + 2) * float(nodes.weight.max()) + float(nodes.weight.sum())
    if count * len(nodes.weight) > MOST_STATES or largest * WORTH * SHARE > 2.0**62:
        return None
    kept = 1 - Fraction(1, parts)
    fall = np.zeros(len(nodes.weight), dtype=np.int64)
    for p in np.unique(nodes.threat[dangerous]).tolist():
        levels = min(int(np.log1p(-p) / np.log1p(-1.0 / parts)) + 1, count)
        while kept**levels < 1 - Fraction(p):
            levels -= 1
        fall[nodes.threat == p] = levels
    if (fall[dangerous] == 0).any():
        return None
    upwards = SHARE * np.exp(np.arange(count) * np.log1p(-1.0 / parts)) * (1 + 1e-9)
    return Levels(np.ceil(upwards).astype(np.int64), fall)


def _best_path(
    nodes: Nodes, levels: Levels, worth: NDArray[np.int64], price: NDArray[np.int64]
) -> tuple[int, NDArray[np.float64], float]:
    """The most that visits are worth beyond their prices; how often that path counts each node `[V]`, and its w S."""
    order = np.argsort(nodes.source, kind="stable")
    target, first = nodes.target[order], np.searchsorted(nodes.source[order], np.arange(len(worth) + 1))
    tail = int(worth.sum()) * int(levels.share[-1])
    most = np.zeros((len(worth), len(levels.share) + 1), dtype=np.int64)
    most[:, -1] = tail
    move = np.full(most.shape, -1, dtype=np.int32)
    _backwards(first, target, levels.fall, levels.share, worth, price, most, move)
    start, last = int(np.flatnonzero(nodes.starts)[0]), len(levels.share)
    level = min(int(levels.fall[start]), last)
    visits, at = [start], [0]
    while level < last and move[visits[-1], level] >= 0:
        visits.append(int(move[visits[-1], level]))
        at.append(level)
        level = min(level + int(levels.fall[visits[-1]]), last)
    value = worth[visits] * levels.share[at]
    gain = value - price[visits]
    counted = np.bincount(np.array(visits)[gain > 0], minlength=len(worth)).astype(np.float64)
    total = max(int(gain[0]), 0) + int(most[start, min(int(levels.fall[start]), last)])
    return total, counted, float(value[gain > 0].sum()) / (WORTH * SHARE)


@compiled
def _backwards(first, target, fall, share, worth, price, most, move):  # type: ignore[no-untyped-def]
    """Fills `most` `[V, L + 1]`, of a robot at a node at a level, and `move`, the visit that gives it (-1: none)."""
    count, last = len(fall), len(share)
    for level in range(last - 1, -1, -1):
        for dangerous in (False, True):  # safe nodes lie beside dangerous ones alone, whose visits lead to later levels
            for node in range(count):
                if (fall[node] > 0) == dangerous:
                    for edge in range(first[node], first[node + 1]):
                        visit = target[edge]
                        then = most[visit, min(level + fall[visit], last)]
                        gain = max(worth[visit] * share[level] - price[visit], 0) + then
                        if gain > most[node, level]:
                            most[node, level], move[node, level] = gain, visit


class Mixture:
    """The best mixture of the paths found so far that counts every node once on average, at most."""

    def __init__(self, count: int) -> None:
        """Of no path yet, through `count` nodes."""
        self._solver = highspy.Highs()
        self._solver.silent()
        self._solver.setOptionValue("threads", 1)  # none of its own, which a fork of this process would lack
        empty, none = np.zeros(count + 1, dtype=np.int32), np.zeros(0, dtype=np.int32)
        below = np.full(count + 1, -highspy.kHighsInf)
        self._solver.addRows(count + 1, below, np.ones(count + 1), 0, empty, none, np.zeros(0))

    def add(self, counted: NDArray[np.float64], value: float) -> tuple[float, NDArray[np.float64]]:
        """(what the best mixture is worth, in cells; the prices of the nodes `[V]`) with this path."""
        rows = np.append(np.flatnonzero(counted), len(counted)).astype(np.int32)
        share = np.append(counted[counted > 0], 1.0)
        self._solver.addCol(-value, 0.0, highspy.kHighsInf, len(rows), rows, share)
        self._solver.run()
        price = np.maximum(-np.array(self._solver.getSolution().row_dual), 0.0)
        return -self._solver.getInfo().objective_function_value, price[:-1]
