"""Robots that look at what others have visited (SPEC section 11): what the lanes do beside the paper's rule.

The readable statement is `planner.mrac.simulate`, the concise one `planner.kernels.attentive`. A cell to do is one that
nobody has visited: its PENDING bit. A robot that notices something does not move until a search has told where to.
Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop.limits import bits_at, has_to_wait, hold
from mrac_jax.closed_loop.offers import first_area, open_cells
from mrac_jax.closed_loop.search import Chosen, choose, entry, take_area
from mrac_jax.closed_loop.state import (
    ACT,
    FIND_AREA,
    FIND_CELL,
    FIND_FAR,
    FIND_OR_SHARE,
    LOOK_AGAIN,
    RETARGET,
    SHARE,
    Lanes,
    get,
    high_half,
    lane_rows,
    low_half,
    pack,
    put,
    put_rows,
    read,
    spread,
    write_down,
)
from mrac_jax.closed_loop.tables import OPEN, PENDING, VISITED, LaneTables
from planner.trace import EventKind


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
    # From the least to the most important of what may be noticed: a later line overrides.
    mode = jnp.where(gone, jnp.where(traveling, RETARGET, FIND_CELL), ACT)
    if tables.policy.looks_again:
        others = (lanes.waiting > 0) | tables.policy.refuses
        if tables.policy.breaks_off:
            traveling, others = jnp.ones_like(traveling), others | tables.policy.holds
        if lanes.returning is not None:  # its own may be more than it can afford by now
            others = jnp.ones_like(others)
        wary = traveling & others & (read(tables.level, ahead) > 0)
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
    assert lanes.held is not None
    chosen = choose(lanes, _seeks(lanes), width)
    lane, robot, words = chosen.lane, chosen.robot, chosen.words
    at = jnp.minimum(lane, lanes.mode.shape[0] - 1)
    mode, own = lanes.mode[at], low_half(entry(chosen.duty, robot))
    goal = high_half(get(lanes, lanes.place, lane, robot))
    looks, stays = mode == LOOK_AGAIN, (mode == FIND_FAR) | (mode == RETARGET)
    mine = low_half(words) == own[:, None]
    unvisited = mine & ((words & PENDING) != 0)
    offered = (unvisited & (looks | stays)[:, None]) | (open_cells(words) & ~stays[:, None])
    first = first_area(tables, lanes, chosen, chosen.here, offered, ~stays, limited=~stays)
    label, held = first.candidate.label, bits_at(lanes.held[:, at], robot)
    breaks_off = tables.policy is not None and tables.policy.breaks_off
    waits = has_to_wait(tables, lanes, chosen, first, ~stays if breaks_off else ~(stays | looks))
    found = first.found & ~waits
    keeps = found & (looks | stays) & (label == own)
    takes, frees = found & ~keeps, looks & ~keeps
    # Who keeps its area keeps its target until somebody visits it, also if another cell is cheaper by now.
    fresh = (entry(words, goal) & VISITED) == 0
    covers = bits_at(lanes.covering[:, at], robot) & looks & keeps
    keeps_goal = keeps & looks & (fresh | covers)
    after = jnp.where(covers & ~fresh, FIND_CELL, lanes.found_next(at))
    lanes = _release(tables, lanes, chosen, own, frees)
    words = jnp.where(mine & frees[:, None], words | OPEN, words)
    shut = takes[:, None] & (low_half(words) == label[:, None])
    rests = (mode == FIND_AREA) & ~(waits | held)
    lanes = replace(
        lanes,
        cells=put_rows(lanes, lanes.cells, lane, jnp.where(shut, words & ~jnp.uint32(OPEN), words)),
        place=put(lanes, lanes.place, lane, robot, pack(chosen.here, first.cell), found & ~keeps_goal),
        held=hold(lanes, chosen, waits, takes),
        mode=spread(lanes.mode, chosen.slot, jnp.where(found, after, jnp.where(rests, lanes.rests, SHARE))),
    )
    return take_area(lanes, chosen, first.cell, label, takes, ~first.found)


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
