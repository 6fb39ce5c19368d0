"""What a range cuts off, and what a mission's state leaves: cells and robots, for the page and the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.theory.reachable import moves_left, within
from planner.pace import Pace
from planner.plans.plan import Plan
from planner.worlds.world import World

TO_DO, BEFORE, BEYOND = range(3)


@dataclass(frozen=True, eq=False)
class Rest:
    """Of a plan with a range, or from a state.

    Attributes:
        kinds: int64 `[H, W]`, of accessible cells: TO_DO; BEFORE, visited in the state; BEYOND, further than any robot
            alive has moves for, there and, of robots that come home, back. returns: they come home.
        step: of the state; None: it is the whole mission.
        limited: there is a range. ended: robots at the end of theirs in the nominal run.
        pace: how long a step takes, if that is known.
    """

    kinds: NDArray[np.int64]
    returns: bool
    step: int | None
    limited: bool
    ended: int
    pace: Pace

    @property
    def title(self) -> str:
        """Of the section and the picture."""
        parts = [] if self.step is None else [f"Going on from {self.pace.step(self.step)}"]
        return ", ".join([*parts, *["what the range leaves" if parts else "What the range leaves"] * self.limited])

    @property
    def too_far(self) -> str:
        """What makes a cell too far, for sentences."""
        return "too far for any robot to visit and come home" if self.returns else "too far for the moves of any robot"


NAMES = ("to do", "visited before", "too far")
"""Of the kinds, in order."""


def rest_of(world: World, plan: Plan) -> Rest | None:
    """What is left of a plan's mission; None for a whole one of robots that can drive without end."""
    moves = moves_left(plan)
    if plan.state is None and moves is None:
        return None
    accessible = world.accessible(plan.starts)
    kinds = np.full(world.shape, TO_DO)
    if moves is not None:
        kinds[accessible & ~within(world, plan)] = BEYOND
    if plan.state is not None:
        kinds.reshape(-1)[plan.state.visited] = BEFORE
    made = [int((np.diff(robot.path) != 0).sum()) for robot in plan.robots]
    ended = 0 if moves is None else sum(own >= most for own, most in zip(made, moves, strict=True))
    step = None if plan.state is None else plan.state.step
    return Rest(kinds, plan.comes_home, step, moves is not None, ended, world.pace)
