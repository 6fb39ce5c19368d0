"""The closed loop of the readable simulator with the project's randomness: what the compiled engines answer to.

It is slow and shares no kernel with them; use it to check one, or to follow one rollout through
`planner.mrac.simulate`.
"""

from __future__ import annotations

import numpy as np

from planner.mrac.mission import state_of
from planner.mrac.partition import bisect
from planner.mrac.problem import prepare
from planner.mrac.recorder import Recorder
from planner.mrac.simulate import Run, Simulation, Split
from planner.plans.plan import Plan
from planner.plans.state import MissionState
from planner.threefry import uniform
from planner.trace import Trace
from planner.worlds.world import World


class ReferenceLoop:
    """A plan's closed loop, rollout by rollout.

    Args:
        plan: one of this project's planner, made for `world`. first_only: `threat_checks="first_visit"`.
        split: halves the one component of a shared area; another than the default makes other rollouts.

    Raises:
        PlanError: the plan of another planner, or for another map.
    """

    def __init__(self, plan: Plan, world: World, *, first_only: bool = False, split: Split = bisect) -> None:
        settings = plan.require(world, areas=True)
        self._problem = prepare(world, plan.starts, settings)
        self._areas, self._first_only, self._split, self._state = plan.areas, first_only, split, plan.state

    def run(self, seed: int, rollout: int, recorder: Recorder | None = None) -> Run:
        """Rollout `rollout` (below 2**32) of `seed`, `0 <= seed < 2**64`."""
        return self._begin(seed, rollout, recorder).run(self._problem.max_steps)

    def state_at(self, step: int, seed: int, rollout: int) -> MissionState | None:
        """Where the rollout stands at the end of a step, to go on from; None if it has ended by then."""
        run = self._begin(seed, rollout, None)
        if run.step == 0:
            run.take_turns()
        while run.step < step and run.outcome(self._problem.max_steps) is None:
            run.advance()
        return state_of(run) if run.step == step and run.outcome(self._problem.max_steps) is None else None

    def _begin(self, seed: int, rollout: int, recorder: Recorder | None) -> Simulation:
        threat = self._problem.world.threat.ravel()
        entered = np.zeros(threat.size, dtype=np.bool_)
        if self._state is not None:
            entered[self._state.visited] = True

        def hit(robot: int, step: int, cell: int) -> bool:
            checked = threat[cell] > 0 and not (self._first_only and entered[cell])
            entered[cell] = True
            return bool(checked and uniform(seed, rollout, step, robot) < threat[cell])

        return Simulation(self._problem, self._areas, hit, self._split, recorder, self._state)

    def trace(self, seed: int, rollout: int) -> Trace:
        """The same rollout in full; `planner.kernels.closed_loop.trace_rollouts` gives the same, event for event."""
        recorder = Recorder()
        run = self.run(seed, rollout, recorder)
        return recorder.trace(rollout, run.area_of, run.outcome)
