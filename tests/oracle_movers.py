"""One robot on a given path among movers, by every way that things can go: plain Python, no engine, no theory.

A history is where every mover is and which cells the robot has visited and survived; each step multiplies it. The rules
are those of docs/spec.md, section 16, read anew. Chances are floats, maps lists of rows with None for obstacles.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

Cell = tuple[int, int]


@dataclass(frozen=True)
class Threat:
    """A mover: h, and how it goes. start: a cell, or None: anywhere."""

    h: float
    stay: float = 0.0
    start: Cell | None = None
    route: tuple[Cell, ...] = ()


def beside(grid: list[list[float | None]], cell: Cell) -> list[Cell]:
    row, col = cell
    places = [(row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col)]
    return [(r, c) for r, c in places if 0 <= r < len(grid) and 0 <= c < len(grid[0]) and grid[r][c] is not None]


def begins(grid: list[list[float | None]], threat: Threat) -> list[tuple[int | Cell, float]]:
    """Where it may be before it first moves: (place on its route, or cell; chance)."""
    if threat.route:
        places = [i for i, cell in enumerate(threat.route) if threat.start in (None, cell)]
        places = places if threat.start is None else places[:1]
        return [(place, 1 / len(places)) for place in places]
    if threat.start is not None:
        return [(threat.start, 1.0)]
    free = [(r, c) for r, line in enumerate(grid) for c, p in enumerate(line) if p is not None]
    weight = {cell: max(len(beside(grid, cell)), 1) for cell in free}
    return [(cell, weight[cell] / sum(weight.values())) for cell in free]


def goes(grid: list[list[float | None]], threat: Threat, place: int | Cell) -> list[tuple[int | Cell, float]]:
    if threat.route:
        return [((place + 1) % len(threat.route), 1.0)]
    ways = beside(grid, place)
    if not ways:
        return [(place, 1.0)]
    return [(place, threat.stay), *((way, (1 - threat.stay) / len(ways)) for way in ways)]


def outcomes(grid: list[list[float | None]], path: list[Cell], threats: list[Threat]) -> tuple[float, float, float]:
    """(expected cells visited, survived, chance to be alive at the end); it stands still where a cell comes twice."""
    visited = survived = alive = 0.0
    firsts = [list(begins(grid, threat)) for threat in threats]
    for start in itertools.product(*firsts):
        weight = 1.0
        for _, chance in start:
            weight *= chance
        stack = [(0, tuple(place for place, _ in start), weight)]
        while stack:
            step, places, weight = stack.pop()
            cell = path[step]
            seen = set(path[: step + 1])
            moves = step == 0 or cell != path[step - 1]
            p = grid[cell[0]][cell[1]] if moves else 0.0
            before = set(path[:step])
            visited += weight * p * len(seen)
            survived += weight * p * len(before)
            for after in itertools.product(*(goes(grid, t, at) for t, at in zip(threats, places, strict=True))):
                share, passes = weight * (1 - p), 1.0
                for _, chance in after:
                    share *= chance
                there = [t.route[at] if t.route else at for t, (at, _) in zip(threats, after, strict=True)]
                for threat, at in zip(threats, there, strict=True):
                    passes *= 1 - threat.h if at == cell else 1.0
                visited += share * (1 - passes) * len(seen)
                survived += share * (1 - passes) * len(before)
                if step + 1 < len(path):
                    stack.append((step + 1, tuple(at for at, _ in after), share * passes))
                else:
                    visited += share * passes * len(seen)
                    survived += share * passes * len(seen)
                    alive += share * passes
    return visited, survived, alive
