"""The map that robots plan on, and the version of the rules of their rollouts (SPEC sections 15, 16)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from planner.errors import WorldError
from planner.settings import Settings
from planner.world.moving_threats import JOINED
from planner.world.world import World, check_starts


def true_world(world: World) -> World:
    """The true map as a known map; unchanged if the map is known, or if the true map is drawn."""
    return replace(world, threat=world.met, knowledge=None)


def as_planned(world: World, starts: ArrayLike) -> World:
    """The known map that robots plan on: the prior map with the cells in sensor range of the starts updated.

    A true map that is drawn updates nothing. A known map is returned unchanged.

    Args:
        world: the map.
        starts: `[K, 2]`, (row, col).
    """
    known = world.knowledge
    if known is None:
        return world
    threat = world.threat
    if world.uncertainty is None and known.sense.range > 0:
        placed = check_starts(starts, known.truth, world.source)
        cells = placed[:, 0] * world.shape[1] + placed[:, 1]
        seen = known.sense.views(known.free, np.unique(cells))[1]
        threat = threat.copy()
        # Only cells in range of the starts: a plan must not know more than its robots.
        threat.flat[seen] = known.truth.flat[seen]
        threat.setflags(write=False)
    return replace(world, threat=threat, knowledge=None, uncertainty=None)


def as_before(world: World) -> World:
    """The world as releases before 0.4 made it: with `plan_on` "joined" if it was not given.

    Unchanged if they made the same world, or rejected it (p = 1).
    """
    if world.movers is None or not world.movers.by_default:
        return world
    try:
        movers = replace(world.movers, by_default=False)
        return replace(world, threat=movers.planned(JOINED, world.source), uncertainty=movers)
    except WorldError:
        return world


# Version of the closed loop's rules: rollouts under different rules are never added up.
#
# Release 0.4 changed (docs/spec.md, sections 15, 16, 19, 22): the end of a run with phases and detectors, and with all
# robots lost on the way to base; ties between areas for several robot types; the default of `plan_on` for moving
# threats. All else is as in release 0.3, and its results remain usable.

BEFORE, NOW = 1, 2
"""Versions of the rules: of releases before 0.4, and of release 0.4."""
RELEASES = {BEFORE: "before 0.4", NOW: "0.4"}


def rules_of(world: World, settings: Settings, *, closed: bool = True) -> int:
    """The last version that changed a rule used by the team's rollouts.

    Args:
        world: the map.
        settings: of the plan.
        closed: for the closed loop.
    """
    told = world.phases is not None and world.phases.told
    mixed = settings.types is not None and not isinstance(settings.types, str) and len(set(settings.types)) > 1
    by_default = world.movers is not None and world.movers.by_default
    detects = world.learned_hazard is not None and world.learned_hazard.detector is not None
    # The nominal run is a closed loop too, and the open loop follows its paths.
    ends_otherwise = closed and (detects or settings.return_to is not None)
    return NOW if told or mixed or by_default or ends_otherwise else BEFORE
