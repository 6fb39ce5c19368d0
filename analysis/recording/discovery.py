"""Robots that learn the map: what they have seen of it at a step of a rollout, and which areas they make of that."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.recording.frames import AreaMap, Held
from planner.luck import true_map
from planner.mrac.board import State
from planner.mrac.executive import Executive
from planner.none import NO_ROBOT, NO_STEP
from planner.trace import Doing, Trace
from planner.worlds.doubt import Uncertain
from planner.worlds.world import World


@dataclass(frozen=True, eq=False)
class Discovery:
    """What the robots of a rollout come to know.

    Attributes:
        told: float32 `[H, W]`, what they believe at first; NaN: an obstacle.
        truth: float32 `[H, W]`, what they meet.
        when: int32 `[H, W]`, the step at the end of which each cell is first seen; NO_STEP.
    """

    told: NDArray[np.float32]
    truth: NDArray[np.float32]
    when: NDArray[np.int32]

    def seen(self, step: int) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that somebody has seen by the end of a step."""
        return (self.when != NO_STEP) & (self.when <= step)

    def believed(self, step: int) -> NDArray[np.float32]:
        """float32 `[H, W]`, the map as robots believe it at the end of a step."""
        return np.where(self.seen(step), self.truth, self.told)


def discovery_of(world: World, seed: int, trace: Trace) -> Discovery:
    """Of a rollout of the seed in a world that its robots are not told."""
    assert world.knowledge is not None
    when = world.knowledge.first_seen(trace.cells, trace.doing != Doing.DEAD).reshape(world.shape)
    truth = true_map(world.doubt, seed, trace.rollout) if isinstance(world.doubt, Uncertain) else world.met
    return Discovery(world.threat, truth, when)


def learned_maps(teams: Iterable[Executive]) -> Iterator[AreaMap]:
    """The areas at the end of step 0, and of every later step that changes who holds what, of a run that is played."""
    before: tuple[NDArray[np.int32], list[tuple[State, int]]] | None = None
    for team in teams:
        now = team.area_of, [(area.state, area.robot) for area in team.areas]
        if before is None or before[1] != now[1] or not np.array_equal(before[0], now[0]):
            before = now[0].copy(), now[1]
            held = np.array([Held[state.name] for state, _ in now[1]] + [Held.UNASSIGNED], dtype=np.int8)
            robot = np.array([robot for _, robot in now[1]] + [NO_ROBOT], dtype=np.int32)
            area = before[0]  # NO_AREA, -1, is the last
            yield AreaMap(team.step, area, held[area], robot[area], len(team.unassigned))
