"""Which release's rules a team's closed loop follows: rollouts of different rules are never added up.

Release 0.4 changed (docs/spec.md, sections 15, 16, 19, 22): how a run ends with phases and detectors, and where all
robots are lost on the way home; ties between areas for robots of several types; what robots plan on by default among
moving threats. All else is as in release 0.3, and results of it go on to be used.
"""

from __future__ import annotations

from planner.settings import Settings
from planner.world.world import World

BEFORE, NOW = 1, 2
"""Versions of the rules: those of releases before 0.4, and those of release 0.4."""
RELEASES = {BEFORE: "before 0.4", NOW: "0.4"}


def rules_of(world: World, settings: Settings, *, closed: bool = True) -> int:
    """The last version that changed a rule that the team's rollouts follow. `closed`: of the closed loop."""
    told = world.phases is not None and world.phases.told
    mixed = settings.types is not None and not isinstance(settings.types, str) and len(set(settings.types)) > 1
    by_default = world.movers is not None and world.movers.by_default
    detects = world.learned_hazard is not None and world.learned_hazard.detector is not None
    # The run without losses is a closed loop too, whose paths the open loop follows.
    ends_otherwise = closed and (detects or settings.return_to is not None)
    return NOW if told or mixed or by_default or ends_otherwise else BEFORE
