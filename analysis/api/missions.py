"""A mission that is driven."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from analysis.api.plans import plan_of
from analysis.inputs import plan_from_state
from planner.missions.mission import PATIENCE
from planner.plans.plan import Plan
from planner.plans.state import MissionState
from planner.plans.state_traces import read_state
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.driving.outlook import DrivenMission


def mission(
    world: World,
    plan: Plan | str | Path | int | None = None,
    *,
    state: MissionState | str | Path | None = None,
    patience: int | None = PATIENCE,
    gain: float = 1.0,
) -> DrivenMission:
    """A mission to be driven: it gives orders and takes reports, step by step, and goes on after a crash.

    Args:
        plan: a Plan, a plan file, how many robots to plan for, or None: the world's own team.
        state: where it stands: what `Mission.save` wrote, or anything that `plan` takes as a state.
        patience: steps in which a robot that was to move did not, after which others get its work; None: any number.
        gain: a robot leaves what it is under way to for work that became free, or a nearer cell of its area after it
            was pushed, where that saves more than this share of the cost of its way; 1: it never does.
    """
    from analysis.driving.outlook import DrivenMission

    world, made = plan_of(world, plan)
    if isinstance(state, str | Path) and Path(state).suffix == ".json":
        return DrivenMission.resume(state, world, made, patience=patience, gain=gain)
    if state is not None:
        found = state if isinstance(state, MissionState) else read_state(state, world)[0]
        made = plan_from_state(world, found, made.require(world))
    return DrivenMission(world, made, patience=patience, gain=gain)
