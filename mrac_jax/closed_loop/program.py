"""The closed loop as one program: lanes that begin, run, hand over their results and begin again, until none is left.

Axis letters as in `mrac_jax.closed_loop.state`; `R` rollouts that a call has room for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from mrac_jax.arrays import Array, HostArrays, on_host
from mrac_jax.closed_loop import attentive, search
from mrac_jax.closed_loop.areas import settle
from mrac_jax.closed_loop.beginning import COPIED
from mrac_jax.closed_loop.homeward import robots_home
from mrac_jax.closed_loop.limits import judge
from mrac_jax.closed_loop.returning import charge
from mrac_jax.closed_loop.state import (
    ACT,
    CELL_KINDS,
    COLUMNS,
    END,
    OFF,
    STEP_KINDS,
    Lanes,
    Log,
    Queue,
    Sums,
    choose_lanes,
    put_rows,
    spread,
)
from mrac_jax.closed_loop.steps import micro_step
from mrac_jax.closed_loop.tables import PIECES, VISITED, LaneTables, areas_at
from planner.kernels.loop import ClosedLoop
from planner.kernels.state import MOST_PASSES
from planner.none import NO_AREA

MOST_MOVES = 2**30
"""Moves after which a call ends, done or not: its counts are int32."""


@dataclass(frozen=True)
class Pace:
    """How often what is done, and for how many lanes at a time. No count depends on it.

    Attributes:
        micro_steps: between two rounds of what is dear. look: lanes that look among the nearest cells at a time; find:
            that search all cells; settle: whose areas are split and shared; begin: that begin a rollout.
    """

    micro_steps: int
    look: int
    find: int
    settle: int
    begin: int


def run(tables: LaneTables, snapshots: Lanes, lanes: Lanes, sums: Sums, queue: Queue, pace: Pace) -> tuple[Lanes, Sums]:
    """The rollouts of the queue: one loop, until every lane is off (or MOST_MOVES are counted).

    Args:
        tables, lanes, sums: lanes that are off begin the next rollout; those that are not go on.
        snapshots: lanes as rollouts begin, `[M]`.
        pace: static.
    """

    find = search.find if tables.policy is None else attentive.find

    def goes_on(state: tuple[Lanes, Sums]) -> jax.Array:
        lanes, sums = state
        return ((lanes.mode != OFF).any() | (sums.next < queue.count)) & (sums.moves < MOST_MOVES)

    def round_(state: tuple[Lanes, Sums]) -> tuple[Lanes, Sums]:
        # Dear things wait for the end of a round, so that several lanes that want them are served at once.
        lanes, sums = hand_over(tables, snapshots, *state, queue, pace.begin)
        lanes, sums = jax.lax.fori_loop(
            0, pace.micro_steps, lambda _, now: micro_step(tables, now[0], now[1], pace.look), (lanes, sums)
        )
        lanes = settle(tables, find(tables, lanes, pace.find), pace.settle)
        lanes = charge(tables, lanes, pace.settle)
        return lanes if tables.policy is None else judge(tables, lanes, pace.settle), sums

    return jax.lax.while_loop(goes_on, round_, (lanes, sums))


def hand_over(
    tables: LaneTables, snapshots: Lanes, lanes: Lanes, sums: Sums, queue: Queue, width: int
) -> tuple[Lanes, Sums]:
    """Up to `width` lanes at their end hand over their results and, like those that are off, begin the next rollout."""
    free = (lanes.mode == END) | ((lanes.mode == OFF) & (sums.next < queue.count))

    def change(state: tuple[Lanes, Sums]) -> tuple[Lanes, Sums]:
        lanes, sums = state
        lane, slot = choose_lanes(free, width)
        sums = replace(sums, results=_results(tables, lanes, sums.results, lane))
        chosen = lane < free.shape[0]
        # Ids are given out in the order of lanes; results go to the id's place, so the order shows nowhere.
        number = sums.next + jnp.cumsum(chosen, dtype=jnp.int32) - 1
        begins = chosen & (number < queue.count)
        place = jnp.minimum(number, queue.rollout.shape[0] - 1)
        lanes = _begin(snapshots, lanes, lane, slot, queue.begin_at[place])
        lanes = replace(
            lanes,
            mode=spread(lanes.mode, slot, jnp.where(begins, ACT, OFF)),
            number=spread(lanes.number, slot, number),
            rollout=spread(lanes.rollout, slot, queue.rollout[place]),
            left=put_rows(lanes, lanes.left, lane, queue.left[place]),
        )
        return lanes, replace(sums, next=sums.next + begins.sum(dtype=jnp.int32))

    return jax.lax.cond(free.any(), change, lambda state: state, (lanes, sums))


def _results(tables: LaneTables, lanes: Lanes, results: jax.Array, lane: jax.Array) -> jax.Array:
    """The results with those of the lanes at their end."""
    at = jnp.minimum(lane, lanes.mode.shape[0] - 1)
    alive = jax.lax.population_count(lanes.unharmed[:, at]).sum(axis=0, dtype=jnp.uint32).astype(jnp.int32)
    columns: tuple[jax.Array, ...] = (
        tables.accessible - lanes.unvisited[at],
        lanes.survived[at],
        lanes.step[at],
        alive,
        lanes.outcome[at],
        lanes.bisected[at],
        lanes.divided[at],
    )
    if tables.homes is not None:
        columns += (robots_home(tables, lanes, at),)
    if tables.weights is not None and lanes.passes is not None:
        columns += (*_worth(tables.weights, lanes, at),)
    # Lanes that were OFF are among the chosen too: they have no results yet.
    ended = (lane < lanes.mode.shape[0]) & (lanes.mode[at] == END)
    return results.at[jnp.where(ended, lanes.number[at], results.shape[0])].set(jnp.stack(columns, axis=1), mode="drop")


def _worth(weights: tuple[Array, Array], lanes: Lanes, at: jax.Array) -> jax.Array:
    """The weights of what was visited, then found, in the lanes `at`, by pieces: int32 `[2 * PIECES, S]`."""
    batch, (covered, found) = lanes.mode.shape[0], weights
    visited = (lanes.cells.reshape(batch, -1)[at] & VISITED) != 0
    passes = lanes.passes.reshape(batch, -1)[at].astype(jnp.int32)  # type: ignore[union-attr]
    each = jnp.arange(visited.shape[1], dtype=jnp.int32)
    weighed = jnp.concatenate([jnp.where(visited, covered[:, None], 0), found[:, each, passes]])
    return weighed.sum(axis=2, dtype=jnp.int32)


def _begin(snapshots: Lanes, lanes: Lanes, lane: jax.Array, slot: jax.Array, which: jax.Array) -> Lanes:
    """The lanes that were chosen as copies of these snapshots, int32 `[S]`."""
    batch, kept = lanes.mode.shape[0], snapshots.mode.shape[0]
    new: HostArrays = {}
    for name in COPIED:
        old, copied = getattr(lanes, name), getattr(snapshots, name)
        if old is None:
            continue
        # One value a lane is spread; a row of cells or robots is copied.
        if old.shape[-1] == batch:
            new[name] = spread(old, slot, copied[..., which])
        else:
            new[name] = put_rows(lanes, old, lane, copied.reshape(kept, -1)[which])
    return replace(lanes, **new)


def columns_of(tables: LaneTables) -> int:
    """Columns of the results that are not weights: where robots come home, those that are there are one."""
    return COLUMNS + (tables.homes is not None)


def no_sums(tables: LaneTables, steps: int, room: int) -> Sums:
    """Counts (NumPy) of no rollouts, with room for so many steps and results."""
    return on_host(
        Sums,
        by_cell=np.zeros(tables.size * CELL_KINDS, dtype=np.int32),
        by_step=np.zeros(steps * STEP_KINDS, dtype=np.int32),
        passes=None if tables.weights is None else np.zeros(tables.size * MOST_PASSES, dtype=np.int32),
        results=np.zeros((room, columns_of(tables) + (0 if tables.weights is None else 2 * PIECES)), dtype=np.int32),
        next=np.int32(0),
        moves=np.int32(0),
    )


def empty_log(tables: LaneTables, loop: ClosedLoop, batch: int, steps: int, events: int) -> Log:
    """A log (NumPy) with room for so many steps and events a lane."""
    robots, cell_ids = len(tables.starts), np.full(tables.size, NO_AREA, dtype=np.int32)
    cell_ids[: len(loop.cells)] = areas_at(loop)
    return on_host(
        Log,
        events=np.zeros((batch * events, 5), dtype=np.int32),
        count=np.zeros(batch, dtype=np.int32),
        frames=np.zeros((batch * steps, 3, robots), dtype=np.int32),
        cell_ids=np.tile(cell_ids, batch),
    )
