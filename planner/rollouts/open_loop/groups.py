"""Robots in groups of one or two: the outcomes of a group are numbered, and one number looks everything up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.none import NO_ROBOT

MOST_PAIR_ROWS = 2**14
"""Robots are paired while all pairs' rows are at most so many: their tables then stay in a core's cache."""


@dataclass(frozen=True, eq=False)
class Groups:
    """The robots of each group and the numbering of its outcomes.

    A group of robots i, j with outcomes o_i, o_j is in row `first_row + o_i * stride + o_j`, stride = outcomes of j.

    Attributes:
        slot_robot: int64 `[S]`, S = G * A: the robot in each slot, NO_ROBOT (outcome always 0) in the last if K is odd.
        size: int64 `[S]`, outcomes of each slot: 1 + the most dangerous entries that it can pass.
        members: A, robots a group, 1 or 2.
        first_row: int64 `[G]`; rows of a group are consecutive.
        row_count: R.
    """

    slot_robot: NDArray[np.int64]
    size: NDArray[np.int64]
    members: int
    first_row: NDArray[np.int64]
    row_count: int

    @property
    def count(self) -> int:
        """G."""
        return len(self.first_row)

    @property
    def stride(self) -> NDArray[np.int64]:
        """int64 `[G, A]`: rows from one outcome of the slot to its next."""
        sizes = self.size.reshape(-1, self.members)
        return np.concatenate([sizes[:, 1:], np.ones((self.count, 1), np.int64)], axis=1)

    @property
    def slot_of(self) -> NDArray[np.int64]:
        """int64 `[K]`: each robot's slot."""
        slots = np.flatnonzero(self.slot_robot >= 0)
        found = np.empty(len(slots), dtype=np.int64)
        found[self.slot_robot[slots]] = slots
        return found

    def sizes(self, group: int) -> tuple[int, int]:
        """Outcomes of the group's two robots (1 for one that is not there)."""
        mine = self.size[group * self.members : (group + 1) * self.members].tolist()
        return (mine[0], mine[1]) if self.members == 2 else (mine[0], 1)

    def rows(self, by_outcome: Sequence[NDArray], combine: Callable[[NDArray, NDArray], NDArray]) -> NDArray[np.uint32]:
        """A table by row, uint32 `[R, ...]`, from one per robot `[outcomes, ...]`, by a ufunc with identity 0."""
        parts = []
        for group in range(self.count):
            pair = [
                by_outcome[robot] if robot >= 0 else np.zeros_like(by_outcome[0][:1])
                for robot in self.slot_robot[group * self.members : (group + 1) * self.members]
            ]
            table = pair[0] if self.members == 1 else combine(pair[0][:, None], pair[1][None, :])
            parts.append(table.reshape(int(np.prod(self.sizes(group))), *by_outcome[0].shape[1:]))
        return np.concatenate(parts).astype(np.uint32)


def make_groups(depth: NDArray[np.int64], most_pair_rows: int = MOST_PAIR_ROWS) -> Groups:
    """Pairs (the robot with most outcomes with that of fewest) if their rows are few enough, else single robots.

    Args:
        depth: int64 `[K]`, the most dangerous entries that each robot can pass.
        most_pair_rows: see MOST_PAIR_ROWS.
    """
    # Most with fewest: the products, which are the rows, stay small.
    order = np.argsort(-depth, kind="stable").astype(np.int64)
    if len(order) % 2:
        order = np.append(order, NO_ROBOT)
    half = len(order) // 2
    slots = np.stack([order[:half], order[half:][::-1]], axis=1).reshape(-1)
    pair_size = np.where(slots >= 0, depth[slots] + 1, 1)
    pair_rows = pair_size.reshape(-1, 2).prod(axis=1)
    if len(depth) > 1 and pair_rows.sum() <= most_pair_rows:
        return _number(slots, pair_size, 2, pair_rows)
    single = np.arange(len(depth), dtype=np.int64)
    return _number(single, depth + 1, 1, depth + 1)


def _number(slots: NDArray[np.int64], size: NDArray[np.int64], members: int, rows: NDArray[np.int64]) -> Groups:
    first = np.cumsum(rows) - rows
    return Groups(slot_robot=slots, size=size, members=members, first_row=first, row_count=int(rows.sum()))
