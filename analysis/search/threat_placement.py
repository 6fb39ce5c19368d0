"""Where threats cost a team most: one after the other on common luck, then each moved while that costs more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.racing import check_search, screened
from analysis.estimators.trial import Trial
from analysis.sampling import RolloutChoices
from analysis.search.threat_removal import Gain, Search, Threat, Turn, Weighing
from analysis.theory.exact import coverage_gradient
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.arguments import Numbers, whole
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.world.world import World

# What a search for the worst places of threats holds: those for robots that know, those for robots that do not.


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

    reported_by = "analysis.search.place_reports:attack_report"

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


MOST_PLACES = 512
"""Cells that are looked at: of larger maps those where a little more danger costs the plan's own paths most."""
ROUNDS = 2
"""Times that every threat is taken up again at most; a move makes it worse for the team or is none."""
CHANCE = Numbers(1e-6, 1 - 2**-25, below=True, said="a chance, 1e-6 or more and below 1")


@dataclass
class _Adversary:
    """Who places threats against robots of one kind.

    Attributes:
        make: what robots do on a map. screens: whether cells are screened by the bound where not all find room.
        picks: the threats placed so far.
    """

    search: Search
    world: World
    places: Sequence[Threat]
    make: Callable[[World], Trial]
    screens: bool
    picks: list[Threat] = field(default_factory=list)

    def place(self, count: int) -> None:
        """`count` threats, greedily; then each is taken up again and put down where it costs most."""
        while len(self.picks) < count:
            self.picks.append(self._worst(self.picks, None))
        for _ in range(ROUNDS if count > 1 else 0):
            before = list(self.picks)
            for number, pick in enumerate(before):
                self.picks[number] = self._worst(self.picks[:number] + self.picks[number + 1 :], pick)
            if all(one is other for one, other in zip(before, self.picks, strict=True)):
                break

    def _worst(self, others: Sequence[Threat], now: Threat | None) -> Threat:
        """The worst place beside others; `now`, where it stands, unless another one is worse on the same luck."""
        world = with_all(self.world, others)
        left = [place for place in self.places if place not in others]
        order = list(range(len(left)))
        if self.screens:
            order = self.search.screened(world, left, always=False)[0]
        held = [] if now is None else [left.index(now)]
        order += [place for place in held if place not in order]
        self.search.doing("replanned" if self.screens else "with the old plan")
        race = self.search.race(
            [partial(self._meet, world, left[place]) for place in order], kept=[{order.index(place)} for place in held]
        )
        best = race.best
        for kept in (order.index(place) for place in held):
            best = kept if race.runs[kept].share <= race.runs[best].share else best
        return left[order[best]]

    def _meet(self, world: World, threat: Threat) -> Trial:
        return self.make(threat.placed(world))


def find_attack(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    *,
    count: int = 1,
    p: float = 0.2,
    progress: ProgressCallback | None = None,
    doing: Doing | None = None,
) -> Attack:
    """The cells in which `count` threats of chance `p` cost robots most that know of them, and that do not.

    `choices`: rollouts of the last two places that are left, the same ids for all. An interruption (KeyboardInterrupt)
    leaves the threats so far, `partial`; before the first, it is raised again. Raises InputError.
    """
    choices = choices.timed(world.pace)
    check_search(world, settings, choices, "a search for the worst places of threats")
    CHANCE.check("p", p)
    search = Search(world, starts, settings, choices, progress, doing or quiet, most=MOST_PLACES, placing=True)
    as_is = search.anew(world)
    places, notes = places_of(world, starts, settings, float(p))
    whole(1, len(places), "a whole number of threats").check("count", count)
    turn = search.turn(world, places, screening=False)
    known = _Adversary(search, world, places, search.anew, True, [turn.picked.threat])
    hidden = _Adversary(search, world, places, as_is.under, False)
    ends, stopped = (Placed(()), Placed(())), False
    try:
        known.place(count)
        hidden.place(count)
        ends = _confirmed(search, as_is, known.picks, hidden.picks)
    except KeyboardInterrupt:
        ends, stopped = (Placed(tuple(known.picks)), Placed(tuple(hidden.picks))), True
    return Attack(
        **search.asked(world),
        p=float(p),
        turn=turn,
        known=ends[0],
        hidden=ends[1],
        partial=stopped,
        notes=notes + (screened(settings) if len(places) > search.room else ()),
    )


def places_of(
    world: World, starts: NDArray[np.int64], settings: Settings, p: float
) -> tuple[list[Threat], tuple[str, ...]]:
    """A threat for every cell that robots at `starts` `[K, 2]` can reach and none starts in; notes.

    Raises UsageError where there is none.
    """
    free = world.accessible(starts)
    free[tuple(starts.T)] = False
    cells = np.flatnonzero(free)
    if not len(cells):
        raise UsageError(f"{world.source}: no cell that a robot can reach is left to threaten", expected="a larger map")
    notes: tuple[str, ...] = ()
    if len(cells) > MOST_PLACES:
        costs = -coverage_gradient(make_plan(world, starts, settings), world).reshape(-1)[cells]
        notes = (f"of {len(cells):,} cells, those {MOST_PLACES} where more danger costs the plan's paths most",)
        cells = np.sort(cells[np.argsort(-costs, kind="stable")[:MOST_PLACES]])
    places = zip(*np.divmod(cells, world.shape[1]), cells, strict=True)
    return [Threat(f"cell [{row}, {col}]", np.array([cell]), p) for row, col, cell in places], notes


def _confirmed(
    search: Search, as_is: Trial, known: Sequence[Threat], hidden: Sequence[Threat]
) -> tuple[Placed, Placed]:
    """Both placements, with what each costs robots of both kinds."""
    worlds = [with_all(as_is.world, threats) for threats in (known, hidden)]
    one, other, met, unseen = search.confirm([as_is, *map(search.anew, worlds), *map(as_is.under, worlds)])
    return Placed(tuple(known), one, met), Placed(tuple(hidden), other, unseen)
