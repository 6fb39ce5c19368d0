"""Robots that come home (SPEC section 19) in the lanes: what they can afford, when they turn, and when all do.

The readable statement is `planner.mrac.homecoming`, the concise one `planner.kernels.retire`. A robot that has turned
is among those that are `done`, not among those alive; while it has still to move, or to say that it is home, it is
`returning`. Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop.boards import word_and_bit
from mrac_jax.closed_loop.state import (
    JUDGE,
    Lanes,
    any_bit,
    low_half,
    read,
    write_down,
)
from mrac_jax.closed_loop.tables import UNREACHABLE, WORD_BITS, LaneTables
from planner.none import NO_AREA, NONE
from planner.tally import Outcome
from planner.trace import EventKind


def moves_left(tables: LaneTables, lanes: Lanes, lane: jax.Array, robot: jax.Array) -> jax.Array:
    """Moves that the robots of these lanes can still make, from the step on in which they would move first, int32."""
    assert tables.homes is not None and lanes.moves_left is not None
    batch = lanes.mode.shape[0]
    at = jnp.minimum(lane, batch - 1)
    now = 0 if lanes.looked is None else lanes.looked[at]
    own = read(lanes.moves_left, at * (lanes.moves_left.shape[0] // batch) + robot)
    return jnp.minimum(own, tables.homes.last - lanes.step[at] + now)


def affords(tables: LaneTables, here: jax.Array, robot: jax.Array, target: jax.Array, left: jax.Array) -> jax.Array:
    """Whether robots with so many moves left could come home from their targets, once they have gone there."""
    homes = tables.homes
    assert homes is not None
    way = read(homes.steps, homes.of[robot] * homes.size + target)
    return (way < 0) | (read(homes.moves, here * homes.size + target).astype(jnp.int32) + way <= left)


def further(tables: LaneTables, here: jax.Array, robot: jax.Array, target: jax.Array) -> jax.Array:
    """How much dearer the way home is from the targets than from here."""
    homes = tables.homes
    assert homes is not None
    row = homes.of[robot] * homes.size
    return jnp.maximum(read(homes.cost, row + target) - read(homes.cost, row + here), 0)


def targets(cost: jax.Array, label: jax.Array) -> jax.Array:
    """At each label the cell of its area that costs least, the lowest of several; int32 `[S, A]` of the cells'."""
    rows = jnp.broadcast_to(jnp.arange(len(label), dtype=jnp.int32)[:, None], label.shape)
    least = jnp.full_like(cost, UNREACHABLE).at[rows, label].min(cost, mode="promise_in_bounds")
    first = (cost == jnp.take_along_axis(least, label, axis=1)) & (cost < UNREACHABLE)
    cell = jnp.where(first, jnp.arange(label.shape[1], dtype=jnp.int32), label.shape[1] - 1)
    return jnp.full_like(cost, label.shape[1] - 1).at[rows, label].min(cell, mode="promise_in_bounds")


def in_reach(
    tables: LaneTables, here: jax.Array, robot: jax.Array, words: jax.Array, fits: jax.Array, left: jax.Array
) -> jax.Array:
    """Of the cells that fit those of areas that robots with so many moves left can afford, bool `[S, A]`."""
    label = low_half(words)
    target = targets(jnp.where(fits, tables.cost[here], UNREACHABLE), label)
    can = affords(tables, here[:, None], robot[:, None], target, left[:, None])
    return fits & jnp.take_along_axis(can, label, axis=1)


def has_to_turn(tables: LaneTables, lanes: Lanes, slot: jax.Array, robot: jax.Array, place: jax.Array) -> jax.Array:
    """Whether the rest of the leg of each lane's robot, at `place`, is more than it has left, bool `[B]`."""
    homes = tables.homes
    assert homes is not None and lanes.moves_left is not None
    leg = homes.of[robot] * homes.size + low_half(place)
    need = read(homes.need, leg * homes.size + (place >> 16).astype(jnp.int32)).astype(jnp.int32)
    return need > jnp.minimum(read(lanes.moves_left, slot), homes.last - lanes.step + 1)


def end_at_home(
    tables: LaneTables, lanes: Lanes, ends: jax.Array, outcome: jax.Array
) -> tuple[Lanes, jax.Array, jax.Array]:
    """At the end of a step: lanes in which all have turned if there is nothing more to be done.

    And where the step does end, since it is known how; and how the run ends, NONE if it goes on. `[B]` each.
    """
    homes, team = tables.homes, lanes.place.shape[0] // lanes.mode.shape[0]
    assert homes is not None
    over = ends & (lanes.outcome == NONE) & (outcome != NONE) & (outcome != Outcome.TIMEOUT)
    lanes = replace(lanes, outcome=jnp.where(over, outcome, lanes.outcome))
    if tables.policy is not None:  # was it called off? The step's end comes again, once that is known
        asks = over & (outcome == Outcome.STUCK)
        lanes = replace(lanes, mode=jnp.where(asks, JUDGE, lanes.mode), robot=jnp.where(asks, team, lanes.robot))
        ends = ends & ~asks
    calls = ends & any_bit(lanes.alive) & ((lanes.outcome != NONE) | (homes.last - lanes.step <= homes.furthest))
    lanes = jax.lax.cond(calls.any(), lambda now: _call_home(tables, now, calls), lambda now: now, lanes)
    late = jnp.where(lanes.step >= tables.max_steps, jnp.int32(Outcome.TIMEOUT), NONE)
    late = jnp.where(any_bit(lanes.unharmed), late, jnp.int32(Outcome.STOPPED))
    assert lanes.returning is not None
    away = any_bit(lanes.returning)
    outcome = jnp.where((lanes.outcome == NONE) | away, late, lanes.outcome)
    return lanes, ends, jnp.where((outcome != NONE) & (lanes.unvisited == 0), jnp.int32(Outcome.COMPLETE), outcome)


def _call_home(tables: LaneTables, lanes: Lanes, calls: jax.Array) -> Lanes:
    """In the lanes that call, all turn where the mission is over, and who waits and would come too late."""
    homes, batch = tables.homes, lanes.mode.shape[0]
    assert homes is not None and lanes.returning is not None
    place = low_half(lanes.place).reshape(batch, -1)
    team = place.shape[1]
    row = homes.of * homes.size
    way = read(homes.steps, row + place)
    late = ((way > 0) & (homes.last - lanes.step[:, None] <= way)).T
    rests = ~_flags(lanes.traveling | lanes.covering, team)
    over = lanes.outcome != NONE
    turns = _flags(lanes.alive, team) & calls & (over | (late & rests))
    if lanes.log is not None:
        lanes = _tell(tables, lanes, turns.T, way, read(homes.base, row + place).astype(jnp.int32))
    away, off = _words(turns & (way.T > 0), lanes.alive), ~_words(turns, lanes.alive)
    return replace(
        lanes,
        duty=jnp.where(turns.T.reshape(-1), jnp.uint32(tables.none), lanes.duty),
        traveling=lanes.traveling & off,
        covering=lanes.covering & off,
        alive=lanes.alive & off,
        hopeful=lanes.hopeful & off,
        held=None if lanes.held is None else lanes.held & off,
        done=lanes.done | ~off,
        returning=lanes.returning | away,
    )


def _tell(tables: LaneTables, lanes: Lanes, turns: jax.Array, way: jax.Array, base: jax.Array) -> Lanes:
    """In the log: who turns, bool `[B, K]`, for which base, and who is there."""
    batch, team = turns.shape
    label, number = low_half(lanes.duty.reshape(batch, team)), lanes.ids.reshape(batch, -1)
    area = jnp.where(label == tables.none, NO_AREA, jnp.take_along_axis(number, label, axis=1))

    def tell(robot: jax.Array, lanes: Lanes) -> Lanes:
        who, none = jnp.full(batch, robot, dtype=jnp.int32), jnp.full(batch, NO_AREA, dtype=jnp.int32)
        lanes = write_down(lanes, turns[:, robot], who, EventKind.TURNED_HOME, area[:, robot], base[:, robot])
        there = turns[:, robot] & (way[:, robot] == 0)
        return write_down(lanes, there, who, EventKind.HOME, none, base[:, robot])

    return jax.lax.fori_loop(0, team, tell, lanes)


def _flags(words: jax.Array, team: int) -> jax.Array:
    """bool `[K, B]` of uint32 `[W, B]`."""
    word, bit = word_and_bit(jnp.arange(team, dtype=jnp.int32))
    return (words[word] & bit[:, None]) != 0


def _words(flags: jax.Array, like: jax.Array) -> jax.Array:
    """uint32 `[W, B]`, as many as `like`, of bool `[K, B]`."""
    padded = jnp.pad(flags, ((0, like.shape[0] * WORD_BITS - flags.shape[0]), (0, 0)))
    bits = jnp.uint32(1) << jnp.arange(WORD_BITS, dtype=jnp.uint32)
    by_word = padded.reshape(like.shape[0], WORD_BITS, -1)
    return jnp.where(by_word, bits[:, None], jnp.uint32(0)).sum(axis=1, dtype=jnp.uint32)


def robots_home(tables: LaneTables, lanes: Lanes, at: jax.Array) -> jax.Array:
    """Robots of the lanes `at` that were not stopped and are at a base, int32 `[S]`."""
    homes, batch = tables.homes, lanes.mode.shape[0]
    assert homes is not None
    place = low_half(lanes.place.reshape(batch, -1)[at])
    there = read(homes.steps, homes.of * homes.size + place) == 0
    return (there & _flags(lanes.unharmed[:, at], place.shape[1]).T).sum(axis=1, dtype=jnp.int32)
