"""The policy that covers most on a map: a few settings raced on common luck, the best told on luck of its own.

Which settings are worth a try was found on random maps: `watchful` with so many robots at risk at once, and with the
safe areas at t = 0 left to one robot each; `per_cell`, and the paper's rule. Then a better order of areas is sought.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.kit.words import policy_words
from analysis.sampling import SECONDS, RolloutChoices
from analysis.trials.halving import USUAL, Halving, check_search
from analysis.trials.ordering import can_order, order_areas
from analysis.trials.trial import Trial, alike
from planner.arguments import POSITIVE, argument
from planner.kernels.tables import AllPairs
from planner.mrac.make_plan import allocated_plan, make_plan
from planner.plans.plan import Plan
from planner.policies import DEFAULT
from planner.policies.per_cell import PER_CELL
from planner.policies.watchful import WATCHFUL
from planner.settings import BEST, Settings
from planner.shown import counted
from planner.worlds.world import World

SHARES = (1 / 8, 1 / 4, 1 / 2)
"""Of the robots alive, that may be at risk at once; a single one too."""
ALONE = 1e6
"""A density d at which no safe area is shared at t = 0."""
BASE = PER_CELL.name
"""The rule that limits on the team go with."""
TRIES = 50
"""Orders of areas that are tried for a second of the search, however fast the machine is."""
LUCK = 2**64 - 1
"""Seed of the search: nobody evaluates by it who does not ask for it, so that what is found is judged on other luck."""

BEST_OF = "the best of "
"""How the note of a plan that was searched for begins."""


class _TimeOver(Exception):
    """The search's own, caught where it began."""


def plan_best(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    seconds: float | None = None,
) -> Plan:
    """The plan of the best of `contenders`; its last note says which that is, and what it gains.

    Args:
        settings: what all have in common. seconds: after which the race ends as it stands (default: SECONDS); whoever
            ends in time finds the same on every machine.

    Raises InputError.
    """
    POSITIVE.check("seconds", seconds, optional=True)
    choices = RolloutChoices(rollouts=USUAL, seed=LUCK)
    check_search(world, settings, choices, argument("policy", BEST))
    raced, kept = contenders(settings, len(starts)), AllPairs()
    makers = [partial(_trial, world, starts, one, choices, kept) for one in raced]
    for maker in (makers[0], makers[1], makers[-1]):  # what is compiled costs the race no time
        maker().sample(0, 1)
    race, ends = Halving(makers, USUAL), time.perf_counter() + (seconds or SECONDS)

    def watch(*_: float) -> None:
        if time.perf_counter() > ends:
            raise _TimeOver

    in_time = True
    try:
        race.run(watch)
    except _TimeOver:
        in_time = False
    found, maker = raced[race.best], makers[race.best]
    if in_time and can_order(found):
        tries = round(TRIES * (seconds or SECONDS))
        found = order_areas(world, starts, found, choices, kept, tries, lambda: time.perf_counter() < ends)
        ordered = partial(_trial, world, starts, found, choices, kept)
        before, after = alike([maker(), ordered()], 0, USUAL)
        found, maker = (found, ordered) if after.share > before.share else (raced[race.best], maker)
        in_time = time.perf_counter() < ends
    made = make_plan(world, starts, found)
    told, plain = alike([maker(), makers[0]()], USUAL, USUAL)
    gain = told.ahead(plain, told.counted, 1.0 / told.largest(told.counted))
    gained = gain.more(100, " points", ("more", "less"))
    more = f", {gained} than {policy_words(raced[0])} on other luck" if found != raced[0] else ""
    over = "" if in_time else f"; the search ended after {seconds or SECONDS:g} s"
    note = f"{BEST_OF}{counted(len(raced), 'setting')} is {policy_words(found)}{more}{over}"
    return replace(made, notes=(*made.notes, note))


def is_best(plan: Plan) -> bool:
    """Whether the plan is one of `plan_best`."""
    return any(note.startswith(BEST_OF) for note in plan.notes)


def contenders(settings: Settings, robots: int) -> list[Settings]:
    """What is raced: the paper's rule, or with limits on the team the plainest first; what is given stays."""
    watchful = replace(settings, policy=WATCHFUL.name)
    most = {max(1, math.ceil(share * robots)): share for share in (*SHARES[::-1], 1 / robots)}
    reserves = [settings.reserve] if settings.reserve is not None else [None, *(most[m] for m in most if m < robots)]
    densities = [settings.density, ALONE] if settings.density == Settings.density else [settings.density]
    limited = settings.reserve is not None or settings.worth is not None
    return [replace(settings, policy=policy) for policy in (DEFAULT, BASE)[limited:]] + [
        replace(watchful, reserve=reserve, density=density) for density in densities for reserve in reserves
    ]


def _trial(
    world: World, starts: NDArray[np.int64], settings: Settings, choices: RolloutChoices, kept: AllPairs
) -> Trial:
    return Trial(world, allocated_plan(world, starts, settings), choices, kept)
