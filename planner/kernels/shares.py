"""What threads share out: sets of rollouts that were hit alike (`planner.kernels.closed_loop`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.kernels.state import FIRST, LAST, ROBOT, STEP, VERDICT, Work

Tasks = tuple[NDArray[np.int64], NDArray[np.int64]]
"""`tasks` and `taken` of `planner.kernels.rollouts.run_set`."""


def whole_set(ids: NDArray[np.uint32]) -> Tasks:
    """All ids in one set, from level 0 on."""
    return np.array([[0, 0, len(ids)]]), np.zeros(1, dtype=np.int64)


def put_together(ids: NDArray[np.uint32], marks: NDArray[np.int64], most: int) -> tuple[NDArray[np.uint32], Tasks]:
    """The ids set by set, and a task for each set, the largest first; of more than `most` rollouts, several tasks.

    `marks` `[L, MARKS]` of the states that were put aside say which of the ids they are of, none if it has no more.
    Nobody had been hit before: who acts in which step, and what became of it, says all of the state.
    """
    rows = np.flatnonzero(marks[:, LAST] > marks[:, FIRST])
    first, size = marks[rows, FIRST], marks[rows, LAST] - marks[rows, FIRST]
    _, group = np.unique(marks[rows][:, [STEP, ROBOT, VERDICT]], axis=0, return_inverse=True)
    group = group.ravel()
    total = np.zeros(len(rows), dtype=np.int64)
    np.add.at(total, group, size)
    order = np.lexsort((group, -total[group]))
    heads = order[np.flatnonzero(np.diff(group[order], prepend=-1))]
    sizes = total[group[heads]]
    tasks = [
        (rows[head], begin, min(begin + most, end))
        for head, end, size_ in zip(heads, np.cumsum(sizes), sizes, strict=True)
        for begin in range(end - size_, end, most)
    ]
    together = np.concatenate([ids[:0], *(ids[first[part] : first[part] + size[part]] for part in order)])
    return together, (np.array(tasks, dtype=np.int64).reshape(-1, 3), np.zeros(1, dtype=np.int64))


def remember_alike(works: list[Work]) -> None:
    """Let all know the coverage paths of who knows most, of which the others know the first."""
    most = max(works, key=lambda work: work.remembered[0])
    known = int(most.remembered[0])
    for work in works:
        if work.remembered[0] < known:
            end = most.ends[known - 1]
            work.paths[:end], work.ends[:known], work.slots[:] = most.paths[:end], most.ends[:known], most.slots
            work.remembered[0] = known
