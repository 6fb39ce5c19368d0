"""How far robots drive and how often they turn on the way, and what the turns cost (docs/spec.md, section 20)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.plans.plan import last_move


@dataclass(frozen=True, eq=False)
class Drive:
    """What the robots of a run drive. Axis `K` = robots.

    Attributes:
        moves: int64 `[K]`. turns: int64 `[K]`, quarter turns, two for turning round, none before the first move.
        last: int64 `[K]`, the step of the last move.
    """

    moves: NDArray[np.int64]
    turns: NDArray[np.int64]
    last: NDArray[np.int64]

    def time(self, turn: float) -> float:
        """Steps until the last robot has arrived, where each of its quarter turns takes it `turn` steps more."""
        return float((self.last + turn * self.turns).max(initial=0.0))


def drive_of(paths: Iterable[NDArray]) -> Drive:
    """Of each path, cell indices `[steps + 1]` at every step; a cell that comes twice in a row is a step of waiting."""
    rows = [(*_moves_and_turns(path), last_move(path)) for path in paths]
    return Drive(*np.array(rows, dtype=np.int64).reshape(-1, 3).T)


def _moves_and_turns(path: NDArray) -> tuple[int, int]:
    """The moves of a path, and its quarter turns."""
    ways = np.diff(path.astype(np.int64))
    ways = ways[ways != 0]
    before, after = ways[:-1], ways[1:]
    return len(ways), int(np.count_nonzero(before != after) + np.count_nonzero(before == -after))
