"""Simulated annealing over the orders in which robots go to nodes, one robot's turn after another's, compiled."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.jit import put_first, threaded
from planner.open_loop.nodes import Nodes

TURN = 250
"""Evaluations of one robot's orders before the others have their turns."""
HOT, COLD = 0.5, 0.005
"""Expected cells that a move may lose with chance 1/e, at the start and at the end."""
LONGEST = 0.25
"""Targets moved at once, as a share of all that matter; mostly few."""
NEGLIGIBLE = 1e-9
"""Chance to get so far that ends an evaluation."""


@dataclass(frozen=True, eq=False)
class Found:
    """Axes: `K` robots, `V` nodes.

    Attributes:
        orders: int64 of each robot, its targets. cells: expected cells visited by the team.
        evaluations: done, of those asked for.
    """

    orders: tuple[NDArray[np.int64], ...]
    cells: float
    evaluations: int


def chances(nodes: Nodes, order: NDArray[np.int64], here: int) -> NDArray[np.float64]:
    """S, float64 `[V]`: chance that a robot at node `here` gets to each node, if it goes to them in this order."""
    chance = np.zeros(len(nodes.weight))
    _gain(order, here, nodes.passed, nodes.weight, nodes.towards, np.zeros(len(chance), dtype=np.bool_), chance)
    return chance


def search(
    nodes: Nodes,
    orders: tuple[NDArray[np.int64], ...],
    starts: NDArray[np.int64],
    effort: int,
    seed: int,
    seconds: float | None = None,
) -> Found:
    """The best orders met within `effort` evaluations from `orders`; `starts` int64 `[K]`: the robots' nodes.

    The same arguments give the same orders, unless `seconds` end it before.
    """
    draw = np.random.default_rng(seed)
    began, done = time.monotonic(), 0
    now = [order.copy() for order in orders]
    reached = np.array([chances(nodes, order, here) for order, here in zip(now, starts.tolist(), strict=True)])
    best, most = tuple(order.copy() for order in now), team_cells(nodes, reached)
    scratch = np.empty_like(nodes.weight, dtype=np.int64), np.zeros(len(nodes.weight), dtype=np.bool_)
    while done < effort and (seconds is None or time.monotonic() - began < seconds):
        for robot, here in enumerate(starts.tolist()):
            count = min(TURN, effort - done)
            heat = HOT * (COLD / HOT) ** (done / effort)
            others = nodes.weight * np.prod(1.0 - np.delete(reached, robot, axis=0), axis=0)
            _turn(now[robot], here, nodes.passed, others, nodes.towards, draw.random((count, 6)), heat, *scratch)
            reached[robot] = chances(nodes, now[robot], here)
            done += count
            cells = team_cells(nodes, reached)
            if cells > most:
                best, most = tuple(order.copy() for order in now), cells
    return Found(best, most, done)


def team_cells(nodes: Nodes, reached: NDArray[np.float64]) -> float:
    """`sum_c 1 - prod_j (1 - S_j(c))` of S `[K, V]`."""
    return float(nodes.weight @ (1.0 - np.prod(1.0 - reached, axis=0)))


@threaded
def _gain(order, here, passed, weight, towards, seen, chance):  # type: ignore[no-untyped-def]
    """(sum of `weight` `[V]` by the chance to get there, targets that matter); writes that into `chance` if it is long.

    `seen` bool `[V]`: scratch.
    """
    seen[:] = False
    seen[here] = True
    total, reach, used = weight[here], passed[here], 0
    if len(chance):
        chance[here] = 1.0
    for target in order:
        used += 1
        if seen[target]:
            continue
        while here != target:
            here = towards[target, here]
            if not seen[here]:
                seen[here] = True
                total += weight[here] * reach
                if len(chance):
                    chance[here] = reach
            reach *= passed[here]
        if reach < NEGLIGIBLE:
            break
    return total, used


@threaded
def _turn(order, here, passed, weight, towards, draws, heat, tried, seen):  # type: ignore[no-untyped-def]
    """Anneal one robot's `order` in place, a row of `draws` `[evaluations, 6]` for each evaluation."""
    unasked = np.empty(0)
    value, used = _gain(order, here, passed, weight, towards, seen, unasked)
    count = len(order)
    tried = tried[:count]
    for draw in draws:
        after = min(int(draw[0] * used), count - 1)
        run = 1 + int(draw[1] ** 3 * LONGEST * used)
        if draw[2] < 0.5:  # a node beside the one at `after`, on the way to any other
            beside = towards[order[min(int(draw[3] * count), count - 1)], order[after]]
            begin = 0
            while begin < count - 1 and order[begin] != beside:
                begin += 1
        else:
            begin = min(int(draw[3] * (used + run)), count - 1)
        run = min(run, count - begin)
        if begin <= after < begin + run:
            continue
        _move(order, tried, begin, run, after, draw[4] < 0.5)
        new, new_used = _gain(tried, here, passed, weight, towards, seen, unasked)
        if new >= value or draw[5] < np.exp((new - value) / heat):
            put_first(tried, order)
            value, used = new, new_used


@threaded
def _move(order, tried, begin, run, after, backwards):  # type: ignore[no-untyped-def]
    """`order` with `run` targets from `begin` on moved behind the one at `after`, written to `tried`."""
    place = 0
    for old in range(len(order)):
        if not begin <= old < begin + run:
            tried[place] = order[old]
            place += 1
        if old == after:
            for step in range(run):
                tried[place] = order[begin + run - 1 - step] if backwards else order[begin + step]
                place += 1
