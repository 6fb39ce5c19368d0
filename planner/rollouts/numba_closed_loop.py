"""The compiled classical simulator (`planner.kernels.closed_loop`) as an engine."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from planner.kernels import closed_loop
from planner.kernels.loop import ClosedLoop
from planner.rollouts.blocks import worth_a_call
from planner.tally import RolloutResults, Tally
from planner.trace import Trace
from planner.worlds.world import World

TRACED = 8
"""Rollouts traced at a time."""


class NumbaClosedLoop:
    """One closed loop and seed, rolled out by Numba (see `planner.rollouts.engine.Engine`)."""

    name = "numba"

    def __init__(self, loop: ClosedLoop, seed: int, *, threads: int | None = None) -> None:
        """`threads`: None for all cores; no count depends on it."""
        self.loop, self.seed, self._threads = loop, seed, threads
        self.accessible = loop.accessible
        self.least = worth_a_call(self.accessible) if loop.tabled else 1

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        return closed_loop.run_range(self.loop, self.seed, start, count, threads=self._threads)[0]

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        return self.run(start, count)[1]

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the single results of those rollouts: one pass gives both."""
        tally, results = closed_loop.run_range(self.loop, self.seed, start, count, threads=self._threads, singles=True)
        assert results is not None
        return tally, results

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given, a few at a time."""
        waiting = iter(rollouts)
        while few := list(itertools.islice(waiting, TRACED)):
            yield from closed_loop.trace_rollouts(self.loop, self.seed, few)

    def until(self, step: int) -> NumbaClosedLoop:
        """The same rollouts cut off at the end of `step`."""
        return NumbaClosedLoop(self.loop.until(step), self.seed, threads=self._threads)

    def under(self, truth: World) -> NumbaClosedLoop:
        """The same decisions under the threats of `truth`."""
        return NumbaClosedLoop(self.loop.under(truth), self.seed, threads=self._threads)

    def weighing(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> NumbaClosedLoop:
        """The same rollouts, survived visits counted: `ClosedLoop.weighing`."""
        return NumbaClosedLoop(self.loop.weighing(covered, found), self.seed, threads=self._threads)
