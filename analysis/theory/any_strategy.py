"""A bound for every strategy: no team covers more of this map, however it decides and whatever it learns on the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from analysis.theory.bounds import ideal_team
from analysis.theory.flow import ROUNDS, flow_bound
from analysis.theory.nodes import ULP, contract
from analysis.theory.own_bounds import ideal_connected
from planner.worlds.doubt import Hazard
from planner.worlds.world import World, check_starts

MOST_CELLS = 500
"""Accessible cells up to which the programme is solved as sharply unasked as asked: about half a second."""
MOST_DANGEROUS, HASTY = 1000, 12
"""Dangerous cells up to which it is solved unasked on larger maps, in so many rounds: within 3 seconds."""


@dataclass(frozen=True)
class AnyStrategy:
    """Expected cells visited that no strategy exceeds.

    Attributes:
        flow: the programme's bound, certified; None: it was not solved.
        connected: `own_bounds.ideal_connected`. ideal: `bounds.ideal_team`.
    """

    flow: float | None
    connected: float
    ideal: float

    @property
    def cells(self) -> float:
        """The least of them."""
        return min(bound for bound in (self.flow, self.connected, self.ideal) if bound is not None)


def any_strategy(world: World, starts: ArrayLike, flow: bool | None = None, ways: bool = True) -> AnyStrategy:
    """The bounds of `world` for robots at `starts` `[K, 2]`.

    `flow`: whether the programme is solved, which may take seconds; None: in HASTY rounds at most on maps of more than
    MOST_CELLS, and not where more than MOST_DANGEROUS of them are dangerous. `ways`: as of `flow_bound`.
    """
    world.check_settled("the bound for every strategy")
    checked = check_starts(starts, world.threat, world.source)
    threat = np.sort(world.threat[world.accessible(checked)].astype(np.float64))
    solved = np.count_nonzero(threat) <= MOST_DANGEROUS if flow is None else flow
    rounds = ROUNDS if flow or len(threat) <= MOST_CELLS else HASTY
    nodes = contract(world, checked) if solved else None
    return AnyStrategy(
        flow=None if nodes is None else flow_bound(nodes, rounds, ways),
        connected=ideal_connected(world, checked),
        ideal=ideal_team(threat, len(checked)),
    )


def most_cells(world: World, starts: ArrayLike, flow: bool | None = None) -> float:
    """The least of the bounds of `world`, also where hazards are there or not; `flow`: as of `any_strategy`.

    Of hazards `ideal_team` alone is left, with p = q h: it counts first visits of the team, at each of which a robot is
    stopped with that chance whatever came before, as cells are drawn apart. Survivors may know more of visits after it.
    """
    if not isinstance(world.doubt, Hazard):
        return any_strategy(world, starts, flow).cells
    checked = check_starts(starts, world.threat, world.source)
    threat = world.doubt.q[world.accessible(checked)].astype(np.float64) * world.doubt.h[world.accessible(checked)]
    return ideal_team(np.sort(threat), len(checked))


def value_bound(world: World, starts: ArrayLike, ways: bool = True) -> float:
    """Expected value of visited cells that no strategy exceeds: the programme with a cell's value as its weight.

    `ways`: as of `flow_bound`.
    """
    checked = check_starts(starts, world.threat, world.source)
    if world.value is None:
        return flow_bound(contract(world, checked), ways=ways)
    largest = float(world.value.max())
    nodes = contract(world, checked, world.value / largest * (1.0 + ULP))
    return flow_bound(nodes, ways=ways) * largest * (1.0 + ULP)
