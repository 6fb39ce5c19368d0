"""The best strategy of one robot, by iteration over (where it is, what it has visited): no search, no state joined.

Of a robot that comes home, over the moves that it has left too: it goes nowhere from where it could not come home.
"""

from __future__ import annotations

import numpy as np

from planner.world.world import World


def best_of_one_robot(world: World) -> float:
    """The most that a robot from [0, 0] can cover on average, however it decides: value, or cells where none has it."""
    width, count = world.shape[1], world.threat.size
    passed = 1.0 - np.nan_to_num(world.threat.ravel(), nan=1.0).astype(float)
    value = np.ones(count) if world.value is None else world.value.ravel()
    places = np.argwhere(world.free)
    moves = [(a, b) for a in places for b in places if np.abs(a - b).sum() == 1]
    best, masks = np.zeros((count, 2**count)), np.arange(2**count)
    while True:
        new = np.zeros_like(best)
        for here, there in np.array(moves).reshape(-1, 2, 2) @ (width, 1):
            gained = np.where(masks >> there & 1, 0.0, value[there])
            new[here] = np.maximum(new[here], gained + passed[there] * best[there][masks | 1 << there])
        if np.abs(new - best).max() < 1e-12:
            return float(value[0] + passed[0] * best[0, 1])
        best = new


def best_that_comes_home(
    world: World, moves: int, bases: list[tuple[int, int]], charged: bool
) -> tuple[float, set[tuple[int, int]]]:
    """(cells, those that can be visited) of a robot from [0, 0] with so many moves, that always can come to a base.

    `charged`: at a base it has all its moves again. States are dictionaries, (cell, visited, moves left): value.
    """
    threat = world.threat.astype(float)
    free = {tuple(cell) for cell in np.argwhere(world.free).tolist()}
    ways = {(r, c): [n for n in ((r - 1, c), (r, c - 1), (r, c + 1), (r + 1, c)) if n in free] for r, c in free}
    back, edge = dict.fromkeys(bases, 0), list(bases)
    for cell in edge:
        for near in ways.get(cell, []):
            if near not in back:
                back[near] = back[cell] + 1
                edge.append(near)

    def left_at(cell: tuple[int, int], left: int) -> int:
        return moves if charged and cell in bases else left

    first = ((0, 0), frozenset([(0, 0)]), moves)
    follows: dict[tuple, list[tuple]] = {}
    due = [first]
    while due:
        state = due.pop()
        if state in follows:
            continue
        cell, visited, left = state
        nexts = [near for near in ways[cell] if back.get(near, moves + 1) <= left - 1]
        follows[state] = [(near, visited | {near}, left_at(near, left - 1)) for near in nexts]
        due += follows[state]
    best = dict.fromkeys(follows, 0.0)
    while True:
        change = 0.0
        for (cell, visited, left), after in follows.items():
            value = max(
                ((there[0] not in visited) + (1 - threat[there[0]]) * best[there] for there in after), default=0.0
            )
            change = max(change, value - best[cell, visited, left])
            best[cell, visited, left] = value
        if change < 1e-12:
            seen = set().union(*(visited for _, visited, _ in follows))
            return 1 + (1 - float(threat[0, 0])) * best[first], seen
