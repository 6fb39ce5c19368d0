"""The closed loop of the readable simulator with the project's randomness: what the compiled engines answer to.

It is slow and shares no kernel with them; use it to check one, or to follow one rollout through
`planner.mrac.simulate`.
"""

from __future__ import annotations

import numpy as np

from planner.luck import Luck
from planner.mrac.partition import bisect
from planner.mrac.recorder import Recorder
from planner.mrac.simulate import Run, Split, simulate
from planner.mrac.takeover import ready_loop
from planner.plans.plan import Plan
from planner.trace import Trace
from planner.worlds.world import World


class ReferenceLoop:
    """A plan's closed loop, rollout by rollout.

    Args:
        plan: this project's, made for `world`, or the paths of another planner (`planner.mrac.takeover`).
        first_only: `threat_checks="first_visit"`.
        split: halves the one component of a shared area; another than the default makes other rollouts.

    Raises:
        PlanError: a plan for another map.
    """

    def __init__(self, plan: Plan, world: World, *, first_only: bool = False, split: Split = bisect) -> None:
        self._problem, self._areas = ready_loop(plan, world)
        self._world, self._first_only, self._split = world, first_only, split

    def run(self, seed: int, rollout: int, recorder: Recorder | None = None) -> Run:
        """Rollout `rollout` (below 2**32) of `seed`, `0 <= seed < 2**64`."""
        luck, entered = Luck(self._world, seed, rollout), np.zeros(self._world.threat.size, dtype=np.bool_)

        def hit(robot: int, step: int, cell: int) -> bool:
            checked = not (self._first_only and entered[cell])
            entered[cell] = True
            return checked and luck.hits(robot, step, cell)

        return simulate(self._problem, self._areas, hit=hit, split=self._split, recorder=recorder)

    def trace(self, seed: int, rollout: int) -> Trace:
        """The same rollout in full; `planner.kernels.closed_loop.trace_rollouts` gives the same, event for event."""
        recorder = Recorder()
        run = self.run(seed, rollout, recorder)
        return recorder.trace(rollout, run.area_of, run.outcome)
