"""The search that `clear` and `attack` share: which of many threats costs a team most, in two directions.

`clear` asks what each threat costs that is there, `attack` what each would cost that is not. Two questions in both,
with answers that have little to do with each other. Robots that *know* plan anew: their way may lead through where the
threat was, or round where it is, so what counts is what lies behind. Robots that do *not know* do as before: what
counts is how many of them it stops.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Doing, Progress
from analysis.removal.threat import Gain, Threat, Turn, Weighed
from analysis.sampling import RolloutChoices
from analysis.theory.any_strategy import MOST_CELLS, any_strategy, value_bound
from analysis.theory.own_bounds import reach_chances
from analysis.theory.value import Worth
from analysis.trials.halving import Halving
from analysis.trials.measured import Measured
from analysis.trials.trial import Trial, alike
from planner.mrac.make_plan import allocated_plan
from planner.rollouts.engine import choose_engine
from planner.settings import Settings
from planner.worlds.world import World

FEWEST = 8
"""Threats that are planned for anew at least, however long their maps' tables take."""
SOLVED = 64
"""Threats up to which the screening bound is the flow programme's, a fifth of a second each on 300 cells."""
ALL_UNKNOWN = 2**18
"""Rollouts for robots that do not know, of all threats together."""
TABLES = 2**28
"""Pairs of cells of all-pairs tables that are made and kept: every map has its own."""


class Search:
    """What all turns share: the team, its settings, what is rolled out, and whether all so far is `exact`.

    `room`: threats that are planned for anew.
    """

    def __init__(
        self,
        world: World,
        starts: NDArray[np.int64],
        settings: Settings,
        choices: RolloutChoices,
        progress: Progress | None,
        doing: Doing,
        *,
        most: int,
        placing: bool = False,
    ) -> None:
        """`most`: threats that are planned for anew, if their maps' tables find room. `placing`: they are not there."""
        self.starts, self.settings, self.choices, self.placing = starts, settings, choices, placing
        self.progress, self.doing, self.robots = progress, doing, len(starts)
        self.cells, self.valued = int(world.accessible(starts).sum()), world.value is not None
        self.total = Worth.of(world).total if self.valued else float(self.cells)
        self.exact = True
        self.room = min(most, max(FEWEST, TABLES // self.cells**2))

    def asked(self, world: World) -> dict[str, Any]:
        """What an answer says of it (`answer.Weighing`)."""
        engine = "" if self.exact else choose_engine(self.choices.engine).name
        return {"world": world, "starts": self.starts, "settings": self.settings, "choices": self.choices,
                "cells": self.cells, "engine": engine}  # fmt: skip

    def anew(self, world: World) -> Trial:
        """The team's plan on a map, before its nominal run."""
        return Trial(world, allocated_plan(world, self.starts, self.settings), self.choices)

    def other(self, world: World, threat: Threat) -> World:
        """The map without a threat that is there, or with one that is not."""
        return threat.placed(world) if self.placing else threat.cleared(world)

    def turn(self, world: World, threats: Sequence[Threat], screening: bool = True) -> Turn:
        """What each of `threats` costs on `world`, and the one that costs robots most that know.

        `screening`: they are screened even where all find room.
        """
        as_is = self.anew(world)
        known = as_is.known()
        order, screens = self.screened(world, threats, screening)
        self.doing("with the old plan")
        gains = [self._unknown(as_is, self.other(world, threat), len(threats)) for threat in threats]
        self.doing("replanned")
        contenders = [partial(self.anew, self.other(world, threats[place])) for place in order]
        race = self.race(contenders, exact=known is not None)
        base: Measured = as_is.sample(0, self.choices.rollouts) if known is None or not race.exact else known
        self.exact &= base.exact and not any(gain.rollouts for gain in gains)
        hits = as_is.stops(base)
        options = [
            Weighed(threat, screen, float(hits[threat.cells].sum()), gain)
            for threat, screen, gain in zip(threats, screens, gains, strict=True)
        ]
        for contender, place in enumerate(order):
            low, high = (0.0, 0.0) if contender == race.best else race.behind(contender)
            behind = None if contender == race.best else (low * self.total, high * self.total)
            options[place] = replace(options[place], known=self.gain(base, race.runs[contender]), behind=behind)
        return Turn(tuple(options), order[race.best], race.rolled)

    def screened(
        self, world: World, threats: Sequence[Threat], always: bool
    ) -> tuple[list[int], Sequence[float | None]]:
        """Places of the threats that find room, those first that cost the bound most; what they cost it, if asked."""
        if not always and len(threats) <= self.room:
            return list(range(len(threats))), [None] * len(threats)
        self.doing("screening")
        screens = self._screens(world, threats)
        return np.argsort(-np.array(screens), kind="stable")[: self.room].tolist(), screens

    def race(
        self, contenders: Sequence[Callable[[], Trial]], *, exact: bool = True, kept: Sequence[Collection[int]] = ()
    ) -> Halving:
        """The contenders on common luck, run; the best of them is the one whose threat costs most."""
        race = Halving(contenders, self.choices.rollouts, room=self.room, kept=kept, exact=exact, least=self.placing)
        race.run(self.progress)
        self.exact &= race.exact
        return race

    def gain(self, base: Measured, other: Measured) -> Gain:
        """What is won without it on average, in cells, robots, and value where there is any."""
        there, gone = (other, base) if self.placing else (base, other)
        worth = gone.ahead(there, "value", self.total) if self.valued else None
        rollouts = min(base.rollouts, other.rollouts)
        return Gain(gone.ahead(there, "visited"), there.ahead(gone, "lost"), rollouts, worth)

    def _unknown(self, as_is: Trial, truth: World, threats: int) -> Gain:
        """For robots that decide as before."""
        count = min(self.choices.rollouts, max(ALL_UNKNOWN // threats, 2))
        return self.gain(*alike([as_is, as_is.under(truth)], 0, count, 1 / threats))

    def _screens(self, world: World, threats: Sequence[Threat]) -> list[float]:
        """What each threat costs the bound for every strategy, in cells, or in value."""
        flow = self.cells <= MOST_CELLS and len(threats) <= SOLVED
        bound, sign = self._value_bound if self.valued else self._bound, -1.0 if self.placing else 1.0
        before = bound(world, flow)
        return [sign * (bound(self.other(world, threat), flow) - before) for threat in threats]

    def _bound(self, world: World, flow: bool) -> float:
        return any_strategy(world, self.starts, flow, ways=False).cells

    def _value_bound(self, world: World, flow: bool) -> float:
        """The programme with values, or the value by the chance to reach each cell."""
        if flow:
            return value_bound(world, self.starts, ways=False)
        return float(Worth.of(world).value @ reach_chances(world, self.starts))

    def confirm(self, trials: Sequence[Trial]) -> list[Gain]:
        """What the others cost against the first, on rollouts that had no part in the choice."""
        count = self.choices.rollouts
        base, *others = alike(trials, count, count)
        self.exact &= base.exact
        return [self.gain(base, other) for other in others]
