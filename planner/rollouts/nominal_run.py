"""The closed loop of a plan in which no robot can be lost: every rollout is the nominal run, which the plan holds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.ids import BLOCK
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan, is_certain
from planner.simulator.loop import ClosedLoop
from planner.tally import Outcome, RolloutResults, Tally, Trace
from planner.world.world import World


def is_nominal(plan: Plan, world: World) -> bool:
    """Whether every closed-loop rollout is the nominal run, and the plan's paths alone say how that is counted.

    Paths do not say it of a mission under way, nor which robots have returned to a base.
    """
    return plan.state is None and not plan.comes_home and is_certain(world, plan)


class NominalRun:
    """Counts the nominal run as often as it is asked for (see `planner.rollouts.engine.Engine`).

    The paths are counted with NumPy, so that nothing is compiled: on a large map without threats the compilation takes
    a minute, and the answer a second. How areas were shared (`RolloutResults.bisected` and `divided`) is left out.
    """

    name = "nominal run"
    least = BLOCK

    def __init__(self, world: World, plan: Plan, loop: ClosedLoop, seed: int, make_full: Callable[[], Any]) -> None:
        """`plan`: one that `is_nominal` in this world; `loop`: the same, compiled to arrays.

        `make_full`: makes the `Engine` that rolls it out under other threats, or with other counts.
        """
        self.world, self.plan, self.loop, self.seed, self.accessible = world, plan, loop, seed, loop.accessible
        self._make_full = make_full

    @cached_property
    def _full(self) -> Any:
        return self._make_full()

    @cached_property
    def _once(self) -> Tally:
        """The nominal run, counted once, as rollout 0."""
        end, size = min(self.plan.time, self.loop.max_steps), self.plan.shape[0] * self.plan.shape[1]
        first, visits = np.full(size, end + 1), np.zeros(size, dtype=np.int64)
        for robot in self.plan.robots:
            steps = robot.entered[robot.entered <= end]
            np.minimum.at(first, robot.path[steps], steps)
            visits += np.bincount(robot.path[steps], minlength=size)
        new = np.bincount(first[visits > 0], minlength=end + 1)
        covered = int(new.sum())
        ended = Outcome[self.plan.outcome.upper()]
        # Counts hold one code for the deadline and the step limit.
        over = Outcome.STEP_LIMIT if ended is Outcome.DEADLINE or self.plan.time != end else ended
        once = {"visited": covered, "survived": covered, "time": end, "alive": len(self.plan.robots), "outcomes": over}
        none = self.loop.empty_tally(self.seed)
        counts: dict[str, Any] = {
            name: np.zeros(max(len(getattr(none, name)), at + 1), dtype=np.int64) for name, at in once.items()
        }
        for name, at in once.items():
            counts[name][at] = 1
        seen = (visits > 0).astype(np.int64)
        cells: dict[str, Any] = {"visits": visits, "covered_visited": seen, "covered_survived": seen}
        return replace(none, ids=((0, 1),), new_visited=new, new_survived=new, **counts, **cells)

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        if count == 0:
            return self.loop.empty_tally(self.seed)
        times: dict[str, Any] = {name: values * count for name, values in self._once.counts().items()}
        return replace(self._once, ids=((start, start + count),), **times)

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        names = ("visited", "survived", "time", "alive", "outcomes")
        columns = (np.full(count, np.argmax(getattr(self._once, name)), dtype=np.int32) for name in names)
        visited, survived, time, alive, outcome = columns
        return RolloutResults(start, visited, survived, time, alive, outcome.astype(np.int8))

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """Both of them."""
        return self.tally(start, count), self.results(start, count)

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given."""
        if self.loop.max_steps < self.plan.time:
            return self._full.traces(rollouts)
        once = ReferenceLoop(self.plan, self.world).trace(self.seed, 0)
        return (replace(once, rollout=rollout) for rollout in rollouts)

    def until(self, step: int) -> NominalRun:
        """The same rollouts cut off at the end of `step`."""
        return NominalRun(self.world, self.plan, self.loop.until(step), self.seed, lambda: self._full.until(step))

    def under(self, truth: World) -> Any:
        """The same decisions under the threats of `truth`."""
        return self._full.under(truth)

    def weighing(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> Any:
        """The same rollouts, survived visits counted."""
        return self._full.weighing(covered, found)
