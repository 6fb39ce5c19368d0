"""What an engine hands over: counts of one range of rollout ids, and how they become a Tally. NumPy only."""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from planner.rollouts.open_loop.compiled import CompiledPlan, Mode
from planner.rollouts.open_loop.events import source_counts
from planner.tally import Outcome, RolloutResults, Tally, tally_key


@dataclass(frozen=True, eq=False)
class RangeCounts:
    """Counts over some rollouts, int64. Axis letters as in `planner.rollouts.open_loop.compiled`.

    Attributes:
        rollouts: how many.
        rows: `[R]`, rollouts by outcome of each group.
        events: `[E]`, rollouts in which each joint event happened.
        visited, survived: `[accessible + 1]`; time: `[T + 1]`; alive: `[K + 1]`: histograms.
        complete_dead: rollouts that covered everything and lost every robot.
    """

    rollouts: int
    rows: NDArray[np.int64]
    events: NDArray[np.int64]
    visited: NDArray[np.int64]
    survived: NDArray[np.int64]
    time: NDArray[np.int64]
    alive: NDArray[np.int64]
    complete_dead: int


class OpenLoopKernel(Protocol):
    """What counts for one compiled plan, seed and mode."""

    def counts(self, start: int, count: int) -> RangeCounts:
        """The counts of rollouts `start .. start + count - 1`."""
        ...

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        ...


def tally_of(compiled: CompiledPlan, mode: Mode, seed: int, start: int, counts: RangeCounts) -> Tally:
    """The tally of the rollouts `start .. start + counts.rollouts - 1`."""
    tables = compiled.tables(mode)
    sources = source_counts(tables.groups, counts.rows, counts.events, counts.rollouts)
    complete = int(counts.visited[-1])
    stopped = int(counts.alive[0]) - counts.complete_dead
    outcomes = np.zeros(len(Outcome), dtype=np.int64)
    outcomes[Outcome.COMPLETE] = complete
    outcomes[Outcome.ALL_ROBOTS_LOST] = stopped
    outcomes[Outcome.END_OF_PATHS] = counts.rollouts - complete - stopped
    return Tally(
        key=tally_key(compiled.identity, "open", mode, seed),
        shape=compiled.shape,
        ids=((start, start + counts.rollouts),) if counts.rollouts else (),
        visited=counts.visited,
        survived=counts.survived,
        time=counts.time,
        alive=counts.alive,
        outcomes=outcomes,
        **tables.events.tally_arrays(sources),
    )


def outcomes_of(visited: NDArray[np.int32], alive: NDArray[np.int32], accessible: int) -> NDArray[np.int8]:
    """Open-loop outcome of each rollout, int8 `[B]`, from cells visited and robots alive `[B]`."""
    unfinished = np.where(alive == 0, np.int8(Outcome.ALL_ROBOTS_LOST), np.int8(Outcome.END_OF_PATHS))
    return np.where(visited == accessible, np.int8(Outcome.COMPLETE), unfinished)


def available_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_out(start: int, count: int, workers: int, unit: int) -> list[tuple[int, int]]:
    """(first id, number) of each worker's part of `start .. start + count - 1`, cut at multiples of `unit`."""
    stop = start + count
    share = -(-(stop - start // unit * unit) // (workers * unit)) * unit
    cuts = [start // unit * unit + share * worker for worker in range(1, workers)]
    edges = [start, *(cut for cut in cuts if start < cut < stop), stop]
    return [(first, last - first) for first, last in pairwise(edges)]
