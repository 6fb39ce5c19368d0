"""Robots that look at what others have visited (SPEC section 11): what the lanes do beside the paper's rule.

The readable statement is `planner.mrac.simulate`, the concise one `planner.kernels.attentive`. A cell to do is one that
nobody has visited: its PENDING bit. A robot that notices something does not move until a search has told where to.
Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop.policies import LanePolicy
from mrac_jax.closed_loop.search import FAR, Chosen, choose, entry, first_cell, put_rows, take_area
from mrac_jax.closed_loop.state import (
    ACT,
    FIND_AREA,
    FIND_FAR,
    FIND_OR_SHARE,
    LOOK_AGAIN,
    NEXT,
    RETARGET,
    SHARE,
    Lanes,
    get,
    high_half,
    lane_rows,
    low_half,
    pack,
    put,
    read,
    spread,
    write_down,
)
from mrac_jax.closed_loop.tables import OPEN, PENDING, UNREACHABLE, VISITED, LaneTables
from planner.policies.offer import Offer
from planner.trace import EventKind

WORD, HALF = 16, 2**16 - 1
"""Bits of the trailing word of a product, and its largest value."""


class Candidate(NamedTuple):
    """An area, by the fractions that the rule orders it by. `number`: its id, FAR for none. Arrays of one shape."""

    number: jax.Array
    label: jax.Array
    first: tuple[jax.Array, jax.Array]
    second: tuple[jax.Array, jax.Array]


def notice(
    tables: LaneTables,
    lanes: Lanes,
    moves: jax.Array,
    traveling: jax.Array,
    area: jax.Array,
    target: jax.Array,
    ahead: jax.Array,
) -> jax.Array:
    """What each lane's robot does before it moves, a mode, int32 `[B]`: ACT where there is nothing to notice.

    moves: bool, there is a robot about to move; area, target, ahead: its area, the cells it is going to and enters.
    """
    assert tables.policy is not None and lanes.looked is not None
    row = lane_rows(lanes.cells, lanes.mode.shape[0])
    gone = (read(lanes.cells, row + target) & VISITED) != 0
    mode = jnp.where(gone, jnp.where(traveling, RETARGET, lanes.find_next), ACT)
    if tables.policy.looks_again:
        wary = traveling & (lanes.waiting > 0) & (read(tables.level, ahead) > 0)
        mode = jnp.where(wary, LOOK_AGAIN, mode)
    done = low_half(read(lanes.areas, row + area)) == 0
    mode = jnp.where(done, jnp.where(lanes.waiting > 0, FIND_OR_SHARE, SHARE), mode)
    return jnp.where(moves & (lanes.step > 0) & ~lanes.looked, mode, ACT)


def find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """The next area, target, or far cell of a coverage path, in up to `width` lanes that search one."""
    return jax.lax.cond(_seeks(lanes).any(), lambda now: _find(tables, now, width), lambda now: now, lanes)


def _seeks(lanes: Lanes) -> jax.Array:
    wanted = lanes.mode == FIND_FAR
    for mode in (FIND_AREA, FIND_OR_SHARE, RETARGET, LOOK_AGAIN):
        wanted = wanted | (lanes.mode == mode)
    return wanted


def _find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    chosen = choose(lanes, _seeks(lanes), width)
    lane, robot, words = chosen.lane, chosen.robot, chosen.words
    at = jnp.minimum(lane, lanes.mode.shape[0] - 1)
    mode, own, goal = (
        lanes.mode[at],
        low_half(entry(chosen.duty, robot)),
        high_half(get(lanes, lanes.place, lane, robot)),
    )
    looks, stays = mode == LOOK_AGAIN, (mode == FIND_FAR) | (mode == RETARGET)
    mine = low_half(words) == own[:, None]
    offered = (mine & (looks | stays)[:, None]) | (((words & OPEN) != 0) & ~stays[:, None])
    label, cell, found = first_area(tables, lanes, chosen, offered & ((words & PENDING) != 0))
    keeps = found & (looks | stays) & (label == own)
    takes, frees = found & ~keeps, looks & ~keeps
    keeps_goal = keeps & looks & ((entry(words, goal) & VISITED) == 0)
    lanes = _release(tables, lanes, chosen, own, frees)
    words = jnp.where(mine & frees[:, None], words | OPEN, words)
    shut = takes[:, None] & (low_half(words) == label[:, None])
    after = jnp.where(found, lanes.found_next(at), jnp.where(mode == FIND_AREA, NEXT, SHARE))
    lanes = replace(
        lanes,
        cells=put_rows(lanes, lane, jnp.where(shut, words & ~jnp.uint32(OPEN), words)),
        place=put(lanes, lanes.place, lane, robot, pack(chosen.here, cell), found & ~keeps_goal),
        mode=spread(lanes.mode, chosen.slot, after),
    )
    return take_area(lanes, chosen, cell, label, takes, ~found)


def _release(tables: LaneTables, lanes: Lanes, chosen: Chosen, own: jax.Array, frees: jax.Array) -> Lanes:
    """The robots' areas are nobody's again, `[S]`; who is without one has hope."""
    batch, lane = lanes.mode.shape[0], chosen.lane
    at = jnp.minimum(lane, batch - 1)
    if lanes.log is not None:
        ahead = read(tables.hop, chosen.here * tables.size + high_half(get(lanes, lanes.place, lane, chosen.robot)))
        number = get(lanes, lanes.ids, lane, own)
        told = [spread(jnp.zeros_like(lanes.robot), chosen.slot, one) for one in (number, ahead.astype(jnp.int32))]
        happened = spread(jnp.zeros(batch, dtype=jnp.bool_), chosen.slot, frees)
        lanes = write_down(lanes, happened, lanes.robot, EventKind.LOOKED_AGAIN, *told)
    at_rest = lanes.alive[:, at] & ~(lanes.traveling | lanes.covering)[:, at]
    left = low_half(get(lanes, lanes.areas, lane, own)).astype(jnp.uint32)
    return replace(
        lanes,
        areas=put(lanes, lanes.areas, lane, own, left, frees),
        waiting=spread(lanes.waiting, chosen.slot, lanes.waiting[at] + frees.astype(jnp.int32)),
        hopeful=spread(lanes.hopeful, chosen.slot, jnp.where(frees, at_rest, lanes.hopeful[:, at])),
    )


def first_area(
    tables: LaneTables, lanes: Lanes, chosen: Chosen, offered: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of the areas of the cells offered, bool `[S, A]`, the first that each robot can reach.

    Its label, its target (the cheapest cell offered), int32 `[S]`, and whether there is one.
    """
    assert tables.policy is not None
    label, at = low_half(chosen.words), jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1)
    cost = jnp.where(offered, tables.cost[chosen.here], UNREACHABLE)
    rows = jnp.broadcast_to(jnp.arange(len(label), dtype=jnp.int32)[:, None], label.shape)
    least = jnp.full_like(cost, UNREACHABLE).at[rows, label].min(cost, mode="promise_in_bounds")  # at each label
    unvisited = jnp.maximum(low_half(lanes.areas.reshape(lanes.mode.shape[0], -1)[at]), 1)
    level = jnp.broadcast_to(tables.level, cost.shape)
    offer = Offer(level, least, unvisited, jnp.broadcast_to(tables.policy.entry, cost.shape))
    number = jnp.where(least < UNREACHABLE, lanes.ids.reshape(lanes.mode.shape[0], -1)[at], FAR)
    area, found = first_of(tables.policy, offer, number)
    return area, first_cell((label == area[:, None]) & (cost == entry(least, area)[:, None])), found


def first_of(policy: LanePolicy, offer: Offer, number: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The column of the first offer by the rule, then by number, int32 `[S]` of `[S, A]`; and whether there is one.

    number: FAR where nothing is offered.
    """

    def wide(value: jax.Array | int) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype=jnp.int32), number.shape)

    (first, second), column = policy.order(offer), jnp.arange(number.shape[1], dtype=jnp.int32)
    each = Candidate(number, wide(column), (wide(first[0]), wide(first[1])), (wide(second[0]), wide(second[1])))
    one = jnp.int32(1)
    nothing = Candidate(jnp.int32(FAR), one, (one, one), (one, one))
    best: Candidate = jax.lax.reduce(each, nothing, _earlier, (1,))
    return jnp.where(best.number == FAR, 0, best.label), best.number != FAR


def _earlier(one: Candidate, other: Candidate) -> Candidate:
    """The one of two that goes first: by the fractions, exactly, then by number."""
    before = one.number < other.number
    for mine, theirs in ((one.second, other.second), (one.first, other.first)):
        left, right = _product(mine[0], theirs[1]), _product(theirs[0], mine[1])
        less = (left[0] < right[0]) | ((left[0] == right[0]) & (left[1] < right[1]))
        before = less | ((left[0] == right[0]) & (left[1] == right[1]) & before)
    before = (other.number == FAR) | ((one.number != FAR) & before)
    return jax.tree.map(lambda mine, theirs: jnp.where(before, mine, theirs), one, other)


def _product(numerator: jax.Array, denominator: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The product of an int32 and a positive number below 2**16, exactly: product >> 16, and its 16 trailing bits."""
    low = (numerator & HALF).astype(jnp.uint32) * denominator.astype(jnp.uint32)
    return (numerator >> WORD) * denominator + (low >> WORD).astype(jnp.int32), low & HALF
