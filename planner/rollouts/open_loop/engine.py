"""The open loop as an engine: the kernels of either back end count, this makes tallies, results and traces of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from planner.errors import UsageError
from planner.limits import BLOCK
from planner.rollouts.open_loop.compiled import CompiledPlan, Mode, luck_of
from planner.rollouts.open_loop.counts import OpenLoopKernel, tally_of
from planner.rollouts.open_loop.trace import open_loop_trace
from planner.tally import RolloutResults, Tally
from planner.trace import Trace
from planner.worlds.world import World

MakeKernel = Callable[[CompiledPlan, int, Mode], OpenLoopKernel]


class OpenLoop:
    """One compiled plan, seed and mode (see `planner.rollouts.engine.Engine`)."""

    least = BLOCK

    def __init__(self, compiled: CompiledPlan, seed: int, mode: Mode, name: str, make_kernel: MakeKernel) -> None:
        """`make_kernel`: what counts; `name`: of it, for messages. No count depends on either."""
        self.compiled, self.seed, self.mode, self.name = compiled, seed, mode, name
        self.accessible, self._make_kernel = compiled.accessible, make_kernel
        self._kernel = make_kernel(compiled, seed, mode)

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        return tally_of(self.compiled, self.mode, self.seed, start, self._kernel.counts(start, count))

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        return self._kernel.results(start, count)

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """Both of them."""
        return self.tally(start, count), self.results(start, count)

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given. Raises UsageError in `fast` mode, which knows no steps."""
        if self.mode == "fast":
            raise UsageError(f"traces in {self.mode!r} mode", expected="mode 'step'")
        plan, world, luck = self.compiled.plan, self.compiled.world, luck_of(self.mode)
        return (open_loop_trace(plan, world, self.seed, one, luck) for one in rollouts)

    def until(self, step: int) -> OpenLoop:
        """The same rollouts cut off at the end of `step`."""
        return OpenLoop(self.compiled.until(step), self.seed, self.mode, self.name, self._make_kernel)

    def under(self, truth: World) -> OpenLoop:
        """The same paths under the threats of `truth`."""
        return OpenLoop(self.compiled.under(truth), self.seed, self.mode, self.name, self._make_kernel)

    def weighing(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> OpenLoop:
        """There is nothing to sample: `analysis.theory.value` knows it exactly. Raises UsageError."""
        raise UsageError("survived visits are counted in the closed loop alone", expected="the open loop's exact ones")
