"""What a mission knows without being told: the phase of its threats, and what visits and stops say of its hazards.

It is said to the team at the end of a step, as what robots see is (`planner.missions.seeing`): plans go by p of the
moment.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from planner.arguments import whole
from planner.errors import WorldError
from planner.missions.seeing import Seen
from planner.plans.plan import Plan
from planner.worlds.doubt import Hazard
from planner.worlds.evidence import ALWAYS, added
from planner.worlds.keys import Key
from planner.worlds.world import World


class Lessons:
    """Of one mission.

    Attributes:
        phases: of its threats, or None. evidence: what its robots learn about hazards by, or None.
        odds: int64 `[N]`, log odds of a hazard in each cell; of none without evidence.
    """

    def __init__(self, world: World, plan: Plan) -> None:
        """Raises WorldError for robots that learn in another way, or cannot act on it."""
        hazard = world.doubt if isinstance(world.doubt, Hazard) and world.doubt.learn else None
        self.phases = world.phases
        self.evidence = None if hazard is None else hazard.evidence
        if hazard is not None and hazard.detector is not None:
            problem, fix = f"a mission that is driven reads no detector; here: {hazard.said}", "leave `sense` out"
            raise WorldError(problem, source=world.source, fix=f"{fix}, and say by `seen` what one tells")
        if self.evidence is None and world.phases is None:
            world.check_told("a mission that is driven")
        elif plan.is_foreign or (plan.settings is not None and plan.settings.transit == "area"):
            world.check_told("a mission on another planner's paths, or whose legs stay in their area,")
        self.odds = np.zeros(0, dtype=np.int64) if self.evidence is None else self.evidence.prior.copy()
        self._happened: set[int] = set()

    def __bool__(self) -> bool:
        return self.evidence is not None or self.phases is not None

    def learn(self, cell: int, *, stopped: bool) -> None:
        """A robot visited the cell, or is lost in it."""
        if self.evidence is not None:
            at = np.array([cell])
            self.odds[at] = self.evidence.stop if stopped else added(self.odds[at], -self.evidence.survival[at])
            self._happened.add(cell)

    def last_update(self, accessible: NDArray[np.bool_]) -> int:
        """The step from which the last announced phase holds that changes p of an accessible cell `[N]`; 0: none."""
        if self.phases is None or not self.phases.told:
            return 0
        maps = self.phases.threats.reshape(len(self.phases.begins), -1)[:, accessible]
        return int(self.phases.begins[1:][(maps[1:] != maps[:-1]).any(axis=1)].max(initial=0))

    def at_end(self, step: int, world: World, held: Iterable[int]) -> Seen:
        """p of cells by what is known at the end of the step; no obstacle where robots are, `held`."""
        told: Seen = {}
        if self.phases is not None and self.phases.told and (self.phases.begins == step + 1).any():
            before, now = (self.phases.threats[int(self.phases.number_at(at))].ravel() for at in (step, step + 1))
            changed = np.flatnonzero((before != now) & world.free.ravel())
            told = dict(zip(changed.tolist(), now[changed].tolist(), strict=True))
        cells = np.array(sorted(self._happened), dtype=np.int64)
        self._happened.clear()
        if self.evidence is not None and len(cells):
            p = self.evidence.chances[self.evidence.class_of(self.odds, cells), cells]
            found = {cell: None if np.isnan(one) else float(one) for cell, one in zip(cells.tolist(), p, strict=True)}
            told |= {cell: one for cell, one in found.items() if one is not None or cell not in {*held}}
        return told

    def met(self, step: int, world: World) -> NDArray[np.float32]:
        """float32 `[H, W]`: p of visits in the step, as is known by now."""
        if self.phases is None or self.phases.told:
            return world.threat
        return self.phases.threats[int(self.phases.number_at(step))]

    def to_json(self) -> list[list[int]]:
        """What a file holds: [cell, odds] of each cell whose odds are not those at first."""
        if self.evidence is None:
            return []
        other = np.flatnonzero(self.odds != self.evidence.prior)
        return np.stack([other, self.odds[other]], axis=1).tolist()

    def read(self, key: Key) -> None:
        """What `to_json` gave. Raises StateError."""
        for item in key.items("a list of [cell, odds]", least=0):
            cell, odds = item.items("[cell, odds]", exactly=2)
            self.odds[cell.number(whole(0, len(self.odds) - 1))] = odds.number(whole(-ALWAYS, ALWAYS))
