"""The closed loop of the readable simulator with the project's randomness: what the compiled engines answer to.

It is slow and shares no kernel with them; use it to check one, or to follow one rollout through
`planner.mrac.simulate`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from planner.luck import Luck, rows_met
from planner.luck_names import LuckName
from planner.mrac.executive import Executive
from planner.mrac.recorder import Recorder
from planner.mrac.resume import state_of
from planner.mrac.simulate import Hit, Run, make_team, play_step, simulate
from planner.mrac.takeover import check_every_visit, ready_loop
from planner.plans.plan import Plan
from planner.plans.state import MissionState
from planner.roaming import Roaming, check_counters
from planner.trace import Trace
from planner.worlds.doubt import Uncertain
from planner.worlds.world import World


class ReferenceLoop:
    """A plan's closed loop, rollout by rollout.

    Args:
        plan: this project's, made for `world`, or the paths of another planner (`planner.mrac.takeover`).
        first_only: `threat_checks="first_visit"`. luck: by which robots are stopped.

    Raises:
        PlanError: a plan for another map.
    """

    def __init__(self, plan: Plan, world: World, *, first_only: bool = False, luck: LuckName = "tolerance") -> None:
        self._problem, self._areas = ready_loop(plan, world)
        check_counters(world, len(plan.robots), self._problem.max_steps)
        check_every_visit(world, first_only)
        plan.bearing.check_luck(luck)
        self._luck: LuckName = luck
        self._bearing = plan.bearing
        self._world, self._first_only, self._state = world, first_only, plan.state

    def run(self, seed: int, rollout: int, recorder: Recorder | None = None) -> Run:
        """Rollout `rollout` (below 2**32) of `seed`, `0 <= seed < 2**64`."""
        problem, areas = self._problem, self._areas
        luck = self._luck_of(seed, rollout)
        return simulate(
            problem, areas, hit=self._hit(luck), recorder=recorder, state=self._state,
            truth=self._truth(seed, rollout), movers=self._movers_of(seed, rollout), readings=luck.readings,
        )  # fmt: skip

    def state_at(self, step: int, seed: int, rollout: int) -> MissionState | None:
        """Where the rollout stands at the end of a step, to go on from; None if it has ended by then."""
        luck = self._luck_of(seed, rollout)
        for team in self._steps(seed, rollout, luck):
            if team.step == step and team.outcome(self._problem.max_steps) is None:
                return state_of(team, [luck.borne(number) for number in range(len(team.robots))])
        return None

    def teams(self, seed: int, rollout: int) -> Iterator[Executive]:
        """The team as it stands at the end of every step: one, which goes on."""
        return self._steps(seed, rollout, self._luck_of(seed, rollout))

    def _steps(self, seed: int, rollout: int, luck: Luck) -> Iterator[Executive]:
        truth, movers, hit = self._truth(seed, rollout), self._movers_of(seed, rollout), self._hit(luck)
        team = make_team(self._problem, self._areas, state=self._state, truth=truth, readings=luck.readings)
        while team.outcome(self._problem.max_steps) is None:
            play_step(team, hit, movers)
            yield team

    def _luck_of(self, seed: int, rollout: int) -> Luck:
        return Luck(self._world, seed, rollout, self._luck, self._bearing)

    def _truth(self, seed: int, rollout: int) -> int:
        """Which of the maps in doubt is true, 0 where there is one."""
        doubt = self._world.doubt
        return int(rows_met(doubt, seed, rollout)[0]) if isinstance(doubt, Uncertain) else 0

    def _movers_of(self, seed: int, rollout: int) -> Roaming | None:
        movers = self._world.movers
        return None if movers is None else Roaming(movers, seed, rollout, len(self._problem.starts))

    def _hit(self, luck: Luck) -> Hit:
        entered = np.zeros(self._world.threat.size, dtype=np.bool_)
        if self._state is not None:
            entered[self._state.visited] = True

        def hit(robot: int, step: int, cell: int) -> bool:
            checked = not (self._first_only and entered[cell])
            entered[cell] = True
            return checked and luck.hits(robot, step, cell)

        return hit

    def trace(self, seed: int, rollout: int) -> Trace:
        """The same rollout in full; `planner.kernels.closed_loop.trace_rollouts` gives the same, event for event."""
        recorder = Recorder()
        run = self.run(seed, rollout, recorder)
        return recorder.trace(rollout, run.area_of, run.outcome)
