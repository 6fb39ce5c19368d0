"""Where to go: the search among all cells, of a few lanes of the batch at a time.

The next area, and the next cell of a coverage path that is far away. Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop.homeward import in_reach, moves_left
from mrac_jax.closed_loop.state import (
    FIND_AREA,
    FIND_CELL,
    FIND_FAR,
    FIND_OR_SHARE,
    NEXT,
    SHARE,
    Lanes,
    bits_of,
    choose_lanes,
    get,
    low_half,
    pack,
    put,
    put_rows,
    spread,
    switch,
    write_down,
)
from mrac_jax.closed_loop.tables import LABEL, OPEN, PENDING, UNREACHABLE, LaneTables
from planner.trace import EventKind

FAR = 2**31 - 1


@dataclass(frozen=True)
class Chosen:
    """Lanes that wait, and what is looked at there.

    Attributes:
        lane: int32 `[S]`, which; B where fewer than S wait. slot: int32 `[B]`, each lane's place among them, or S.
        shares: bool `[S]`, its robot wants to share.
        robot: int32 `[S]`, whose turn it is; here: int32 `[S]`, its cell.
        words: uint32 `[S, A]`, the lane's cells. duty: uint32 `[S, K]`.
    """

    lane: jax.Array
    slot: jax.Array
    shares: jax.Array
    robot: jax.Array
    here: jax.Array
    words: jax.Array
    duty: jax.Array


def choose(lanes: Lanes, wants: jax.Array, width: int) -> Chosen:
    """Up to `width` of the lanes in which it is true, bool `[B]`."""
    batch = lanes.mode.shape[0]
    lane, slot = choose_lanes(wants, width)
    at = jnp.minimum(lane, batch - 1)
    robot = jnp.minimum(lanes.robot[at], lanes.duty.shape[0] // batch - 1)
    return Chosen(
        lane=lane,
        slot=slot,
        shares=(lanes.mode[at] == SHARE) & (lane < batch),
        robot=robot,
        here=low_half(get(lanes, lanes.place, lane, robot)),
        words=lanes.cells.reshape(batch, -1)[at],
        duty=lanes.duty.reshape(batch, -1)[at],
    )


def entry(rows: jax.Array, column: jax.Array) -> jax.Array:
    """One entry of each row, `[S]`."""
    return jnp.take_along_axis(rows, column[:, None], axis=1)[:, 0]


def first_cell(where: jax.Array) -> jax.Array:
    """The lowest cell at which it is true, int32 `[S]` of bool `[S, A]`; the last cell if there is none."""
    return jnp.where(where, jnp.arange(where.shape[1], dtype=jnp.int32), where.shape[1] - 1).min(axis=1)


def find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """The next area, or the next cell of a coverage path that is far away, in up to `width` lanes that search one."""
    return jax.lax.cond(_seeks(lanes).any(), lambda now: _find(tables, now, width), lambda now: now, lanes)


def _seeks(lanes: Lanes) -> jax.Array:
    return (lanes.mode == FIND_FAR) | (lanes.mode == FIND_AREA) | (lanes.mode == FIND_OR_SHARE)


def _find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    chosen = choose(lanes, _seeks(lanes), width)
    lane, robot, words = chosen.lane, chosen.robot, chosen.words
    mode = lanes.mode[jnp.minimum(lane, lanes.mode.shape[0] - 1)]
    wants_cell = mode == FIND_FAR
    wanted = jnp.uint32(PENDING) | (entry(chosen.duty, robot) & LABEL)
    pending = (words & (PENDING | LABEL)) == wanted[:, None]
    fits = jnp.where(wants_cell[:, None], pending, (words & OPEN) != 0)
    if tables.homes is not None:
        left = moves_left(tables, lanes, lane, robot)
        fits = jnp.where(wants_cell[:, None], fits, in_reach(tables, chosen.here, robot, words, fits, left))
    fits, found = _best(tables, chosen.here, fits)
    cell = _of_least_area(lanes, chosen, fits, ~wants_cell)
    label = low_half(entry(words, cell))
    # An area whose last cell somebody passed through is completed, but its cells still say OPEN: look again without it.
    stale = low_half(get(lanes, lanes.areas, lane, label)) == 0  # somebody has passed through the last of its cells
    takes, again = found & ~wants_cell & ~stale, found & ~wants_cell & stale
    # From here on no other lane state tells that the area is taken: its cells must say so.
    shut = (found & ~wants_cell)[:, None] & (low_half(words) == label[:, None])
    after = jnp.where(found, NEXT, jnp.where(mode == FIND_OR_SHARE, SHARE, lanes.rests))
    lanes = replace(
        lanes,
        cells=put_rows(lanes, lanes.cells, lane, jnp.where(shut, words & ~jnp.uint32(OPEN), words)),
        place=put(lanes, lanes.place, lane, robot, pack(chosen.here, cell), found & ~again),
        mode=spread(lanes.mode, chosen.slot, jnp.where(again, mode, after)),
    )
    return take_area(lanes, chosen, cell, label, takes, ~found & ~wants_cell)


def _best(tables: LaneTables, here: jax.Array, fits: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rule that picks where to go: of the cells that fit, bool `[S, A]`, the best, and whether there is one, `[S]`.

    The least (level, cost), as seen from the cells `here`: SPEC section 5, `Allocate Next Area`; of equal areas the one
    with the least id is then taken. The pending cells of one area are of one level.
    """
    cost = tables.cost[here]
    fits = fits & (cost < UNREACHABLE)
    for key in (jnp.broadcast_to(tables.level, cost.shape), cost):
        fits = fits & (key == jnp.where(fits, key, FAR).min(axis=1, keepdims=True))
    return fits, fits.any(axis=1)


def _of_least_area(lanes: Lanes, chosen: Chosen, fits: jax.Array, any_area: jax.Array) -> jax.Array:
    """Of the cells that fit, bool `[S, A]`, the lowest; where they may be of any area, of the one with the least id."""
    label = low_half(chosen.words)
    # Labels are cells, not ids: between areas of equal level and cost the ids decide, which is rare.
    lowest = jnp.where(fits, label, LABEL).min(axis=1)
    tie = any_area & (lowest < jnp.where(fits, label, -1).max(axis=1))

    def least() -> jax.Array:
        rows = lanes.ids.reshape(lanes.mode.shape[0], -1)[jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1)]
        number = jnp.where(fits, jnp.take_along_axis(rows, label, axis=1), FAR)
        return jnp.where(tie[:, None], fits & (number == number.min(axis=1, keepdims=True)), fits)

    return first_cell(jax.lax.cond(tie.any(), least, lambda: fits))


def take_area(
    lanes: Lanes, chosen: Chosen, cell: jax.Array, label: jax.Array, takes: jax.Array, missed: jax.Array
) -> Lanes:
    """The area that was found is the robot's, who may stand in it; it has no hope for one if none was. `[S]` each."""
    batch, words = lanes.mode.shape[0], lanes.alive.shape[0]
    lane, robot = chosen.lane, chosen.robot
    at = jnp.minimum(lane, batch - 1)
    left = low_half(get(lanes, lanes.areas, lane, label))
    stands, bit, never = takes & (cell == chosen.here), bits_of(robot, words), jnp.zeros_like(takes)

    def switched(name: str, on: jax.Array, off: jax.Array) -> jax.Array:
        board = getattr(lanes, name)
        return spread(board, chosen.slot, switch(board[:, at], bit, on, off))

    number = get(lanes, lanes.ids, lane, label)
    lanes = replace(
        lanes,
        areas=put(lanes, lanes.areas, lane, label, pack(left, robot + 1), takes),
        waiting=spread(lanes.waiting, chosen.slot, lanes.waiting[at] - takes.astype(jnp.int32)),
        duty=put(lanes, lanes.duty, lane, robot, pack(label, left), takes),
        traveling=switched("traveling", takes & ~stands, stands),
        covering=switched("covering", stands, takes & ~stands),
        hopeful=switched("hopeful", never, takes | missed),
        done=switched("done", never, takes),
        mode=spread(lanes.mode, chosen.slot, jnp.where(stands, FIND_CELL, lanes.mode[at])),
        progress=spread(lanes.progress, chosen.slot, lanes.progress[at] | takes),
    )
    if lanes.log is None:
        return lanes

    def wide(values: jax.Array) -> jax.Array:
        return spread(jnp.zeros(batch, dtype=values.dtype), chosen.slot, values)

    return write_down(lanes, wide(takes), wide(robot), EventKind.ALLOCATED, wide(number), wide(cell))
