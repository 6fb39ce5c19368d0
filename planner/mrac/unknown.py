"""What robots that are not told the map believe at first, and what may be true: levels on one scale (SPEC section 15).

Robots that learn about hazards believe one of several classes of each cell, whatever is true.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.worlds.doubt import Uncertain
from planner.worlds.evidence import Evidence
from planner.worlds.knowledge import Knowledge
from planner.worlds.learning import as_planned
from planner.worlds.levels import NO_LEVEL, ThreatLevels, levels_of_maps
from planner.worlds.phases import Phases
from planner.worlds.sight import Sense
from planner.worlds.world import FOUR_NEIGHBOURS, World


@dataclass(frozen=True, eq=False)
class Unknown:
    """What is believed and true. Axes: `N` = H * W cells, `M` maps of which one is true, `L` levels.

    Attributes:
        knowledge: of the world. values: float64 `[L]`, of all maps together; quantised: as of `ThreatLevels`.
        belief: int16 `[N]`, level of each cell that is believed free, NO_LEVEL of an obstacle: before the first step.
        truths: int16 `[M, N]`, the same truly; of hazards, what each class of the evidence makes robots believe; of
            phases, what is true in each.
        within: bool `[N]`, cells that robots may come to reach, whatever they learn.
        accessible: bool `[N]`, those that they truly can reach.
        evidence: what robots that learn about hazards go by; None: they see what is true.
        phases: of threats that change, of which robots are told as they do; None: nothing changes.
    """

    knowledge: Knowledge
    values: NDArray[np.float64]
    quantised: bool
    belief: NDArray[np.int16]
    truths: NDArray[np.int16]
    within: NDArray[np.bool_]
    accessible: NDArray[np.bool_]
    evidence: Evidence | None = None
    phases: Phases | None = None

    @property
    def looks(self) -> bool:
        """Whether robots look about, for cells that nobody has seen yet."""
        return self.evidence is None and self.phases is None

    @cached_property
    def learns(self) -> bool:
        """Whether anything is left to learn, and somebody looks."""
        differ = (self.truths != self.belief)[:, self.within]
        return (not self.looks or self.knowledge.sense.range > 0) and bool(differ.any())

    @cached_property
    def last_update(self) -> int:
        """The step from which the last announced phase holds that changes a level which robots know of; 0: none."""
        if self.phases is None:
            return 0
        changes = (self.truths[1:] != self.truths[:-1])[:, self.within].any(axis=1)
        return int(self.phases.begins[1:][changes].max(initial=0))

    @property
    def dearest(self) -> ThreatLevels:
        """Every cell that may be reached at the highest level that it may have."""
        most = np.maximum(self.truths.max(axis=0), self.belief)
        return ThreatLevels(self.values, np.where(self.within, most, NO_LEVEL).astype(np.int16), self.quantised)

    @cached_property
    def views(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """What is seen from each cell that may be reached, of such cells (`Sense.views`), in order of the cells."""
        begin, seen = self.knowledge.sense.views(self.knowledge.free, np.flatnonzero(self.within))
        kept = self.within[seen]
        return np.append(0, np.cumsum(kept))[begin], seen[kept]

    def view(self, cell: int) -> NDArray[np.int32]:
        """The cells that are seen from a cell."""
        begin, seen = self.views
        number = int(self._place[cell])
        return seen[begin[number] : begin[number + 1]]

    def seen_at(self, starts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """bool `[N]`: what robots in these cells have seen before the first step: nothing where the truth is drawn."""
        seen = np.zeros(len(self.within), dtype=np.bool_)
        for cell in starts.tolist() if len(self.truths) == 1 else ():
            seen[self.view(cell)] = True
        return seen

    @cached_property
    def _place(self) -> NDArray[np.int64]:
        return np.cumsum(self.within) - 1


def unknown_of(world: World, starts: NDArray[np.int64], most: int) -> Unknown | None:
    """Of robots at `starts` `[K, 2]` and at most so many levels; None where they are told the map."""
    known = world.knowledge
    if world.learned_hazard is not None:
        return _of_hazards(world, world.learned_hazard.evidence, starts, most)
    if world.phases is not None and world.phases.told:
        return _of_phases(world, world.phases, starts, most)
    if known is None:
        return None
    told = as_planned(world, starts).threat
    if isinstance(world.doubt, Uncertain) and world.doubt.whole:
        true = np.stack([world.doubt.threat_at(row).ravel() for row in range(world.doubt.count)])
    else:
        true = known.truth.reshape(1, -1)
    free = known.free | ~np.isnan(world.threat)
    within = reached(free, starts[:, 0] * world.shape[1] + starts[:, 1])
    # On the scale of what was believed before anybody looked, and of all that may be true: it tells no place.
    values, of_cell, quantised = levels_of_maps(np.concatenate([world.threat.reshape(1, -1), true]), within, most)
    looked = ((told != world.threat) & ~(np.isnan(told) & np.isnan(world.threat))).ravel()
    belief = np.where(looked, of_cell[1], of_cell[0]).astype(np.int16)
    return Unknown(known, values, quantised, belief, of_cell[1:], within, world.accessible(starts).ravel())


def _of_hazards(world: World, evidence: Evidence, starts: NDArray[np.int64], most: int) -> Unknown | None:
    """Of robots that learn about hazards; None where nothing that happens changes what they plan on."""
    within = world.accessible(starts).ravel()
    classes, first = evidence.chances, world.threat.ravel()
    if np.array_equal(classes[:, within], np.broadcast_to(first[within], classes[:, within].shape), equal_nan=True):
        return None
    values, of_cell, quantised = levels_of_maps(classes, within, most)
    detector = evidence.detector
    known = Knowledge(world.threat, Sense() if detector is None else detector.sense)
    belief = of_cell[evidence.class_of(evidence.prior, np.arange(len(first))), np.arange(len(first))]
    return Unknown(known, values, quantised, belief, of_cell, within, within, evidence)


def _of_phases(world: World, phases: Phases, starts: NDArray[np.int64], most: int) -> Unknown | None:
    within = world.accessible(starts).ravel()
    if (world.by_phase == world.by_phase[0])[:, within].all():
        return None
    values, of_cell, quantised = levels_of_maps(world.by_phase, within, most)
    known = Knowledge(world.threat, Sense())
    return Unknown(known, values, quantised, of_cell[0], of_cell, within, within, phases=phases)


def reached(free: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """bool `[N]`: the free cells, bool `[H, W]`, in a connected part with one of these."""
    part = ndimage.label(free, FOUR_NEIGHBOURS)[0].ravel()
    return (part > 0) & np.isin(part, part[cells])
