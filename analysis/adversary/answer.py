"""What a search for the worst places of threats holds: those for robots that know, those for robots that do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from analysis.removal.answer import Weighing
from analysis.removal.threat import Gain, Threat, Turn
from planner.worlds.world import World


@dataclass(frozen=True, eq=False)
class Placed:
    """Threats that were placed, and what they cost on rollouts that had no part in the choice; None: interrupted.

    `known`: robots that know of them and plan anew. `hidden`: robots that do as on the map without them.
    """

    threats: tuple[Threat, ...]
    known: Gain | None = None
    hidden: Gain | None = None


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Attack(Weighing):
    """The answer.

    Attributes:
        p: the chance that a visit of a threat stops. turn: what one threat costs in each cell.
        known, hidden: the worst found for robots that know of them, and for robots that do not.
    """

    reported_by = "analysis.adversary.report:report"

    p: float
    turn: Turn
    known: Placed
    hidden: Placed

    @property
    def known_world(self) -> World:
        """The map with the threats that robots know of; each is one of its `sources`."""
        return with_all(self.world, self.known.threats)

    @property
    def hidden_world(self) -> World:
        """What robots meet that do not know: `mrac.with_truth(world, answer.hidden_world)`."""
        return with_all(self.world, self.hidden.threats)


def with_all(world: World, threats: Sequence[Threat]) -> World:
    """The map with all of them placed."""
    for threat in threats:
        world = threat.placed(world)
    return world
