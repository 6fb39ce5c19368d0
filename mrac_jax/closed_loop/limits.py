"""The limits on a team (`planner.policies.limits`) in the lanes: who has to wait, and what is not worth the risk.

Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop.boards import word_and_bit
from mrac_jax.closed_loop.homeward import in_reach, moves_left
from mrac_jax.closed_loop.offers import First, first_area, is_before, open_cells
from mrac_jax.closed_loop.search import Chosen, choose
from mrac_jax.closed_loop.state import END, JUDGE, NEXT, Lanes, bits_of, high_half, low_half, read, spread, switch
from mrac_jax.closed_loop.tables import UNREACHABLE, LaneTables
from planner.none import NO_ROBOT
from planner.tally import Outcome


def bits_at(words: jax.Array, robot: jax.Array) -> jax.Array:
    """Whether each robot's bit is set, bool `[S]`, of uint32 `[W, S]` and int32 `[S]`."""
    word, bit = word_and_bit(robot)
    return (jnp.take_along_axis(words, word[None], axis=0)[0] & bit) != 0


def hold(lanes: Lanes, chosen: Chosen, on: jax.Array, off: jax.Array) -> jax.Array:
    """`lanes.held` with the robots held from now on, or no longer, bool `[S]`."""
    assert lanes.held is not None
    held = lanes.held[:, jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1)]
    return spread(lanes.held, chosen.slot, switch(held, bits_of(chosen.robot, len(held)), on, off))


def is_full(tables: LaneTables, lanes: Lanes, at: jax.Array, robot: jax.Array) -> jax.Array:
    """Whether as many robots besides this one as may be are at risk in the lanes `at`; int32 and bool `[S]`."""
    policy, risky = tables.policy, at_risk(tables, lanes, at)
    assert policy is not None
    others = risky & (jnp.arange(risky.shape[1], dtype=jnp.int32) != robot[:, None])
    alive = jax.lax.population_count(lanes.unharmed[:, at]).sum(axis=0, dtype=jnp.uint32).astype(jnp.int32)
    return policy.holds & (others.sum(axis=1, dtype=jnp.int32) >= policy.most[alive])


def at_risk(tables: LaneTables, lanes: Lanes, at: jax.Array) -> jax.Array:
    """Which robots are at risk in the lanes `at`, bool `[S, K]`.

    One dangerous cell on the way to a target costs more than every safe one.
    """
    policy, batch = tables.policy, lanes.mode.shape[0]
    assert policy is not None
    place, area = lanes.place.reshape(batch, -1)[at], low_half(lanes.duty.reshape(batch, -1)[at])
    robots = jnp.arange(place.shape[1], dtype=jnp.int32)
    word, bit = word_and_bit(robots)
    moves = (((lanes.traveling | lanes.covering)[:, at][word] & bit[:, None]) != 0).T  # [S, K]
    dangerous = (tables.cost[low_half(place), high_half(place)] >= policy.cells) | (tables.level[area] > 0)
    risky, homes = moves & dangerous, tables.homes
    if homes is None or lanes.returning is None:
        return risky
    returns = ((lanes.returning[:, at][word] & bit[:, None]) != 0).T
    return risky | (returns & (read(homes.cost, homes.of * homes.size + low_half(place)) >= policy.cells))


def asking(tables: LaneTables, lanes: Lanes) -> jax.Array:
    """Those held who ask again, uint32 `[W, B]`: nobody where the team is full and nothing safe is left to do."""
    assert tables.policy is not None and lanes.held is not None and lanes.safe_left is not None
    held, nothing = lanes.held, lanes.safe_left == 0
    if lanes.ready is not None:  # who is held may be charged
        return held

    def some() -> jax.Array:
        every = jnp.arange(len(nothing), dtype=jnp.int32)
        vain = nothing & is_full(tables, lanes, every, jnp.full_like(every, NO_ROBOT))
        return jnp.where(vain, jnp.uint32(0), held)

    return jax.lax.cond((nothing & (held != 0)).any(), some, lambda: held)


def has_to_wait(tables: LaneTables, lanes: Lanes, chosen: Chosen, mine: First, asks: jax.Array) -> jax.Array:
    """Whether the robots that ask, bool `[S]`, are held from the area that they would be allocated (`reserve`)."""
    policy = tables.policy
    assert policy is not None
    asks = asks & policy.holds & mine.found & mine.dangerous

    def wait() -> jax.Array:
        full = is_full(tables, lanes, jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1), chosen.robot)
        return asks & (full | _is_another_s(tables, lanes, chosen, mine, asks & ~full))

    return jax.lax.cond(asks.any(), wait, lambda: asks)


def _is_another_s(tables: LaneTables, lanes: Lanes, chosen: Chosen, mine: First, asks: jax.Array) -> jax.Array:
    """Whether another robot without an area, or where robots break off one not at risk, would get its own first one
    before, `[S]`.
    """
    batch, policy = lanes.mode.shape[0], tables.policy
    assert policy is not None
    at = jnp.minimum(chosen.lane, batch - 1)
    busy = jnp.zeros_like(lanes.alive) if policy.breaks_off else lanes.traveling | lanes.covering
    at_rest, risky = (lanes.alive & ~busy)[:, at], at_risk(tables, lanes, at) if policy.breaks_off else None
    place, offered = low_half(lanes.place.reshape(batch, -1)[at]), open_cells(chosen.words)

    def also(robot: jax.Array, before: jax.Array) -> jax.Array:
        # Robot by robot, since nearly always none other is at rest and the branch is not taken.
        could = asks & (robot != chosen.robot) & bits_at(at_rest, jnp.full_like(chosen.robot, robot))
        could = could if risky is None else could & ~risky[:, robot]

        def compare() -> jax.Array:
            theirs = first_area(
                tables, lanes, chosen, place[:, robot], offered, robot=jnp.full_like(chosen.robot, robot)
            )
            return could & theirs.found & is_before(tables, theirs.candidate, mine.candidate)

        return before | jax.lax.cond(could.any(), compare, lambda: jnp.zeros_like(could))

    return jax.lax.fori_loop(0, place.shape[1], also, jnp.zeros_like(asks))


def judge(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """A run without progress is not worth the risk if a live robot can reach an unassigned area."""
    waits = lanes.mode == JUDGE
    return jax.lax.cond(waits.any(), lambda now: _judge(tables, now, width), lambda now: now, lanes)


def _judge(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    batch = lanes.mode.shape[0]
    chosen = choose(lanes, lanes.mode == JUDGE, width)
    at = jnp.minimum(chosen.lane, batch - 1)
    place, offered = low_half(lanes.place.reshape(batch, -1)[at]), open_cells(chosen.words)

    def also(robot: jax.Array, could: jax.Array) -> jax.Array:
        who = jnp.full_like(chosen.robot, robot)
        if tables.homes is None:
            reached = (offered & (tables.cost[place[:, robot]] < UNREACHABLE)).any(axis=1)
        else:
            left = moves_left(tables, lanes, chosen.lane, who)
            reached = in_reach(tables, place[:, robot], who, chosen.words, offered, left).any(axis=1)
        return could | (reached & bits_at(lanes.alive[:, at], who))

    could = jax.lax.fori_loop(0, place.shape[1], also, jnp.zeros(len(at), dtype=jnp.bool_))
    outcome = jnp.where(could, jnp.int32(Outcome.NOT_WORTH_THE_RISK), lanes.outcome[at])
    return replace(
        lanes,
        outcome=spread(lanes.outcome, chosen.slot, outcome),
        mode=jnp.where(chosen.slot < width, END if tables.homes is None else NEXT, lanes.mode),
    )
