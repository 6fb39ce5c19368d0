"""The closed loop event by event: a lane jumps from one decision of a robot to the next (`mrac_jax.closed_loop.book`).

A lane is a rollout. Each robot is on a walk of the book, up to its end or to the visit that destroys the robot, which
is known when the walk begins: a threshold is one number. The next event is the least (step, robot) at which a walk
ends. What is visited by then is the cells of the walks that have ended, and a row of `prefix` for each robot. There are
no moves and no searches: what a robot does next is looked up. A set that is not in the book makes its lane wait.

Axis letters: `B` lanes, `K` robots, `G` areas that a lane has room for; the others as in `mrac_jax.closed_loop.book`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp

from mrac_jax.arrays import STATIC, is_reached, less
from mrac_jax.closed_loop.book import (
    BISECTED,
    BUCKET,
    COUNT,
    FIRST,
    HALVE,
    HOMEWARD,
    LENGTH,
    NEVER,
    PARTS,
    PIECE,
    SPLIT,
    mixed,
)
from planner.simulator.codes import Outcome

START, FOLLOW, TRAVEL, COVER, LAND, RETURN, RECALL, CHARGE, IDLE, OUT, DEAD = range(11)
"""What a robot does: enters its start and has an area; follows an external path; travels; covers; enters its start and
has none; returns to base for good, or to be recharged; is recharged; waits; neither moves nor waits; is lost."""
ARRIVES, DIES, ENDS, TURNS = range(4)
"""How its walk ends: at its end, at a visit, with the last move of the robot's range, or with its return to base."""
OFF, RUN, MISSING, DONE, FULL = range(5)
"""Of a lane: no rollout; its next event; an entry is missing in the book; at its end; it needs more room."""
DOING, FATE, HERE, AREA, IDENT, WALK, ROW, SINCE, LAST, UNTIL, FIELDS = range(11)
"""Of a robot: its fate, the cell at which its walk ends, its piece (NONE) and the id of that area, its walk's entry and
first row, the step before its first move, how many it makes, and the step of the last move of its range (of one that
waits, moves left)."""
TIME, NUMBERS = 2, 8
"""Numbers of a rollout: visited, survived, time, alive, outcome, bisected, divided, robots at a base."""
LIMITLESS = 2**28
"""The range of a robot without one."""
STOPPED, FINAL = 2**31, 2**30
"""Flags of a log's row above the moves: the last one destroyed the robot; the rollout ended before the walk."""
HALVINGS = 23
"""Steps of a run fit into so many bits."""

hold = jax.lax.optimization_barrier


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Lanes:
    """Rollouts in progress. All int32 but sets and thresholds, uint32.

    Attributes:
        mode, number: `[B]`, of the lane, and of its rollout in the queue. fuel: `[B]`, events after which it halts.
        visited, survived: `[B, W]`, by walks that have ended; now: visited by the last event.
        slots: `[B, G]`, the piece of each unassigned area by its id, NONE of others; made: `[B]`, areas so far.
        key: `[B, K]`, step * K + robot of each robot's next event, NEVER: none. robots: `[B, K, FIELDS]`.
        left: `[B, K, 2]`, the threshold that is left as the walk begins, leading word first.
        shared: `[B, 2]`, areas bisected, and divided. last: `[B]`, the last step with progress, or that of the end.
            outcome: `[B]`. over: `[B]`, 0, or the outcome plus 1 once all robots return to base.
        asked: `[B, W + 1]`, the set and the salt of the entry that is missing.
    """

    mode: jax.Array
    number: jax.Array
    fuel: jax.Array
    visited: jax.Array
    survived: jax.Array
    now: jax.Array
    slots: jax.Array
    made: jax.Array
    key: jax.Array
    robots: jax.Array
    left: jax.Array
    shared: jax.Array
    last: jax.Array
    outcome: jax.Array
    over: jax.Array
    asked: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Homes:
    """Where robots return to. All int32, `S` sets of bases.

    Attributes:
        of: `[K]`, the bases of each robot. steps: `[S, A']`, moves of the way there, below 0 where there is none.
        range: `[K]`, moves that a robot can make. last, recharge: the step by which they are to be there; steps until a
            robot has its range again, 0: it does not.
        turnings: static: bits of the moves of the longest walk.
    """

    of: jax.Array
    steps: jax.Array
    range: jax.Array
    last: jax.Array
    recharge: jax.Array
    turnings: int = field(metadata=STATIC)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Book:
    """The decisions of a closed loop on a device: a frozen pytree. What a lane misses in it is reported.

    Attributes:
        entries .. buckets: as of `HostBook`; sums: uint32 `[D, 2]`, leading word first.
        mask: int32, costs without their level. every: uint32 `[W]`, all cells. max_steps, quiet: int32, T_max, and the
            steps in a row without progress after which a run ends. next_of: int32 `[P']`, of an external plan's area
            the next one of the same robot, NONE after the last.
        first: Lanes `[M]`, snapshots of the run without losses, at which lanes begin; before: uint32 `[M, K, 2]`, the
            hazard that robots have met by then, without the walk that they are on. milestones: int32 `[K]`, entries
            that tell from a robot's threshold the snapshot before its loss.
        homes: None where robots stay where they end.
        halvings, parts: static: bits of the most visits of a walk; parts that a split may have.
    """

    entries: jax.Array
    sets: jax.Array
    salts: jax.Array
    prefix: jax.Array
    cell_at: jax.Array
    sums: jax.Array
    at: jax.Array
    bits: jax.Array
    cost: jax.Array
    target: jax.Array
    steps: jax.Array
    need: jax.Array
    buckets: jax.Array
    homes: Homes | None
    mask: jax.Array
    every: jax.Array
    max_steps: jax.Array
    quiet: jax.Array
    next_of: jax.Array
    first: Lanes
    before: jax.Array
    milestones: jax.Array
    halvings: int = field(metadata=STATIC)
    parts: int = field(metadata=STATIC)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Log:
    """Walks that have ended, of all lanes: uint32 `[L, 4]` rows (number * 1024 + robot, entry, step before its first
    move, moves and flags), and how many, int32."""

    rows: jax.Array
    used: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Ended:
    """Results of lanes: int32 `[.., NUMBERS]`, and sets of the visited and the survived cells, uint32 `[.., W]`."""

    numbers: jax.Array
    visited: jax.Array
    survived: jax.Array


def at(table: jax.Array, place: jax.Array) -> jax.Array:
    """Rows of a table; every place is in it."""
    return table.at[place].get(mode="promise_in_bounds")


def pick(rows: jax.Array, robot: jax.Array) -> jax.Array:
    """The entry of one robot in each lane, `[B, ..]` of `[B, K, ..]`."""
    return jnp.take_along_axis(rows, robot.reshape(-1, *[1] * (rows.ndim - 1)), axis=1)[:, 0]


def entered(book: Book, row: jax.Array) -> jax.Array:
    """The cells of walks up to these rows, int32 `[B, K]`, of all robots: uint32 `[B, W]`."""
    if row.shape[1] > 16:
        return jnp.bitwise_or.reduce(at(book.prefix, row), axis=1)
    total = at(book.prefix, row[:, 0])
    for robot in range(1, row.shape[1]):
        total = total | at(book.prefix, row[:, robot])
    return total


def visits_before(
    book: Book, first: jax.Array, count: jax.Array, move: jax.Array, left: jax.Array | None, halvings: int
) -> jax.Array:
    """How many of a walk's dangerous visits `[S]` come up to a move, or leave some of a threshold `[S, 2]`.

    `halvings`: as many as the number of visits has bits. `left`: None, or the threshold.
    """

    def halve(_: int, span: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = span
        middle = (low + high) >> 1
        place = first + middle
        passes = at(book.at, place) <= move if left is None else ~is_reached(left, at(book.sums, place))
        passes = (low < high) & passes
        # A barrier: XLA would compute a chain of gathers anew for each of its readers.
        return hold((jnp.where(passes, middle + 1, low), jnp.where(passes, high, middle)))

    return jax.lax.fori_loop(0, halvings, halve, (jnp.zeros_like(count), count))[0]


def walk(
    book: Book, entry: jax.Array, left: jax.Array, budget: jax.Array, halvings: int | None = None
) -> tuple[jax.Array, ...]:
    """Of walks that begin `[S]`, with such thresholds `[S, 2]` and moves left: (first row, moves, fate, last cell)."""
    base, length, end, first, count = hold(at(book.entries, entry)).T[:5]
    survived = visits_before(book, first, count, first, left, halvings or book.halvings)
    lost = jnp.where(survived < count, at(book.at, first + survived), NEVER)
    last = jnp.minimum(lost, length)
    ends = (budget < lost) & (budget <= length)
    fate = jnp.where(ends, ENDS, jnp.where(lost < NEVER, DIES, ARRIVES))
    return hold((base, jnp.where(ends, budget, last), fate, end))


def hazard_of(book: Book, entry: jax.Array, visits: jax.Array | None = None) -> jax.Array:
    """The hazard of a walk's first visits, all of them if None, uint32 `[S, 2]`."""
    row = at(book.entries, entry)
    return at(book.sums, row[:, FIRST] - 1 + (row[:, COUNT] if visits is None else visits))


def stride_of(book: Book, lanes: Lanes) -> int:
    """Keys of a step: the robots' turns, and where they return to base, what they do at the end of the step."""
    return lanes.key.shape[1] * (1 if book.homes is None else 2)


def moves_home(book: Book, robot: jax.Array, cell: jax.Array) -> jax.Array:
    """Moves of robots' ways to a base from cells, of the same shape; below 0: there is none."""
    assert book.homes is not None
    place = at(book.homes.of, robot) * book.homes.steps.shape[1] + cell
    return at(book.homes.steps.reshape(-1), place)


def turning(
    book: Book, robot: jax.Array, entry: jax.Array, since: jax.Array, until: jax.Array, moves: jax.Array,
    fate: jax.Array, waits: bool = False,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """(moves, fate) of walks `[S]` of robots with an area, which return to base as soon as they could not later on.

    `waits`: one of no moves takes a turn.
    """
    if book.homes is None:
        return moves, fate
    homes, sets = book.homes, book.need.shape[1]
    within = jnp.minimum(until, homes.last) - since
    row, length = at(book.entries, entry)[:, :2].T
    table, column = book.need.reshape(-1), at(homes.of, robot)

    def halve(_: int, span: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = span
        middle = (low + high) >> 1
        goes = (low < high) & (at(table, (row + middle) * sets + column) <= within)
        return hold((jnp.where(goes, middle + 1, low), jnp.where(goes, high, middle)))

    first = jax.lax.fori_loop(0, homes.turnings, halve, (jnp.ones_like(length), length + 1))[0]
    turns = (first <= length) & (first <= moves)
    moves = jnp.where(turns, first - 1, moves)
    if waits:
        turns = turns | ((length == 0) & (at(table, row * sets + column) > within))
    return hold((moves, jnp.where(turns, TURNS, fate)))


def look_up(book: Book, row: jax.Array, salt: jax.Array) -> jax.Array:
    """The entries of sets `[S, W]` and salts, uint32 `[S]`; -1: missing."""
    bucket, tag = hold(mixed(row, salt))
    there = at(book.buckets, (bucket & jnp.uint32(book.buckets.shape[0] - 1)).astype(jnp.int32))
    entry = jnp.where(there[:, :BUCKET] == tag[:, None], there[:, BUCKET:], 0).max(axis=1).astype(jnp.int32)
    # Equal hashes are not enough: the set itself has to be the same.
    same = (at(book.sets, entry) == row).all(axis=1) & (at(book.salts, entry) == salt)
    return jnp.where(same & (entry > 0), entry, -1)


def one_cell(book: Book, cell: jax.Array) -> jax.Array:
    """The sets of one cell, uint32 `[S, W]`."""
    word = jnp.arange(book.every.shape[0], dtype=jnp.int32)
    bit = jnp.uint32(1) << (cell & 31).astype(jnp.uint32)
    return jnp.where(word == (cell >> 5)[:, None], bit[:, None], jnp.uint32(0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Sharing:
    """What comes of looking for an area to share, `[B]` each: whether there is one, and its owner; the split of its
    unvisited cells and the walks of owner and helper to their parts; each -1: missing, then asked for; parts `[B, 2]`,
    counted from the split's first."""

    found: jax.Array
    owner: jax.Array
    split: jax.Array
    parts: jax.Array
    walks: jax.Array
    asked: jax.Array


def find_to_share(
    book: Book, lanes: Lanes, helper: jax.Array, here: jax.Array, offset: jax.Array, afford: jax.Array
) -> Sharing:
    """`Find Area To Share` for helpers in the cells `here`: of those near enough the least (level, cost, id)."""
    robots, flat = jnp.arange(lanes.key.shape[1], dtype=jnp.int32), book.cost.shape[1]
    doing, area = lanes.robots[:, :, DOING], lanes.robots[:, :, AREA]
    owns = (doing == START) | (doing == TRAVEL) | (doing == COVER)
    piece = jnp.maximum(area, 0)
    place = piece * flat + here[:, None]
    rest = at(book.bits, piece) & ~lanes.now[:, None]
    left = jax.lax.population_count(rest).sum(axis=2, dtype=jnp.uint32).astype(jnp.int32)
    cost = at(book.cost.reshape(-1), place)
    fits = owns & (robots != helper[:, None]) & (left >= 2) & (at(book.steps.reshape(-1), place) <= left)
    fits = fits & (cost < NEVER)
    if book.homes is not None:
        fits = fits & affords(book, place, helper, afford)
    found = fits.any(axis=1)
    for value in (cost, lanes.robots[:, :, IDENT]):
        fits = fits & (value == jnp.where(fits, value, NEVER).min(axis=1, keepdims=True))
    owner = jnp.argmax(fits, axis=1).astype(jnp.int32)
    todo = pick(rest, owner)
    halve = jnp.full(owner.shape, HALVE, jnp.uint32)
    split = look_up(book, todo, halve)
    entry = at(book.entries, jnp.maximum(split, 0))
    there = at(book.cell_at, pick(lanes.robots[:, :, ROW] + offset, owner))
    parts = jnp.arange(book.parts, dtype=jnp.int32)
    piece = jnp.minimum(entry[:, PIECE, None] + parts, book.bits.shape[0] - 1) * flat
    one, two = (at(book.cost.reshape(-1), piece + cell[:, None]) & book.mask for cell in (there, here))
    differ = (parts[:, None] != parts) & (jnp.maximum(parts[:, None], parts) < entry[:, PARTS, None, None])
    total = jnp.where(differ, one[:, :, None] + two[:, None, :], 2 * NEVER - 1)
    best = jnp.argmin(total.reshape(total.shape[0], -1), axis=1).astype(jnp.int32)
    chosen = jnp.stack([best // book.parts, best % book.parts], axis=1)
    cells = jnp.stack([there, here], axis=1).reshape(-1)
    goal = at(book.target.reshape(-1), (entry[:, PIECE, None] + chosen).reshape(-1) * flat + cells)
    ways = one_cell(book, goal)
    walks = look_up(book, ways, cells.astype(jnp.uint32)).reshape(-1, 2)
    ways = jnp.concatenate([ways, cells[:, None].astype(jnp.uint32)], axis=1).reshape(*walks.shape, -1)
    way = jnp.where(walks[:, :1] < 0, ways[:, 0], ways[:, 1])
    asked = jnp.where((split < 0)[:, None], jnp.concatenate([todo, halve[:, None]], axis=1), way)
    return Sharing(found, owner, split, chosen, walks, asked)


def affords(book: Book, place: jax.Array, robot: jax.Array, left: jax.Array) -> jax.Array:
    """Whether robots `[B]` with so many moves left could return to base from pieces at these places `[B, n]`."""
    steps, goal = at(book.steps.reshape(-1), place), at(book.target.reshape(-1), place)
    way = moves_home(book, jnp.broadcast_to(robot[:, None], place.shape), goal)
    return (way < 0) | (steps + way <= left[:, None])


def next_event(book: Book, lanes: Lanes, log: Log | None) -> tuple[Lanes, Log | None]:
    """The next event of every lane that runs."""
    (K, G), flat = (lanes.key.shape[1], lanes.slots.shape[1]), book.cost.shape[1]
    robots = jnp.arange(K, dtype=jnp.int32)
    homes, stride = book.homes, stride_of(book, lanes)
    runs, key = (lanes.mode == RUN) & (lanes.fuel > 0), lanes.key.min(axis=1)
    if homes is not None:
        lanes, log, over = _all_return(book, lanes, log, runs, key)
        runs, key = runs & ~over, lanes.key.min(axis=1)
    none, step, who = key == NEVER, key // stride, key % stride % K
    due = key % stride >= K  # at the end of the step
    late = step > book.max_steps
    step = jnp.where(late, book.max_steps, step)
    mine = robots == who[:, None]
    # Robots that act later in this step have not moved in it.
    behind = (robots > who[:, None]) & ~(late | due)[:, None]
    last = lanes.robots[:, :, LAST]
    offset = jnp.clip(step[:, None] - lanes.robots[:, :, SINCE] - behind, 0, last)
    row = lanes.robots[:, :, ROW]
    now = hold(lanes.visited | entered(book, row + offset))
    me, left = hold((pick(lanes.robots, who), pick(lanes.left, who)))
    doing, fate, piece = me[:, DOING], me[:, FATE], jnp.maximum(me[:, AREA], 0)
    row_end = pick(row, who) + me[:, LAST]
    here = me[:, HERE]
    if homes is not None:  # who turns back is not at the end of its walk
        here = hold(jnp.where(me[:, WALK] > 0, at(book.cell_at, row_end), here))
    ends = late | none
    if homes is None:
        ends = ends | (now == book.every).all(axis=1)
    dies, leaves = fate == DIES, fate != ARRIVES
    alive = (lanes.robots[:, :, DOING] != DEAD).sum(axis=1, dtype=jnp.int32) - dies
    todo = hold(at(book.bits, piece) & ~now)
    owns = (me[:, AREA] >= 0) & ((doing != FOLLOW) | dies)
    rest = (todo != 0).any(axis=1) & owns
    splits = leaves & rest & (alive > 0)
    again = (doing == FOLLOW) & dies & (at(book.next_of, piece) >= 0) & (me[:, AREA] >= 0) & (alive > 0)
    covers, starts = ~leaves & (doing == TRAVEL) & rest, ~leaves & (doing == START)
    returns = (doing == RETURN) | (doing == RECALL)
    wants = ~leaves & ~covers & ~starts & ~returns & ~due & (doing != LAND)
    # A robot that waits or is charged has moves left, another one a step at which they end.
    until = me[:, UNTIL] + jnp.where(doing == IDLE, step, 0)
    if homes is not None:
        until = jnp.where(doing == CHARGE, step + at(homes.range, who), until)

    # The unassigned area of least (level, cost, id): slots are in order of id.
    place = jnp.maximum(lanes.slots, 0) * flat + here[:, None]
    costs = jnp.where(lanes.slots >= 0, at(book.cost.reshape(-1), place), NEVER)
    afford, too_far = until - step, jnp.zeros_like(due)
    if homes is not None:
        afford = jnp.minimum(until, homes.last) - step
        every, costs = costs, jnp.where(affords(book, place, who, afford), costs, NEVER)
        too_far = (costs.min(axis=1) == NEVER) & (every.min(axis=1) < NEVER)
        costs = jnp.where(too_far[:, None], every, costs)
    best = jnp.argmin(costs, axis=1).astype(jnp.int32)
    least, area = hold((costs.min(axis=1), jnp.maximum(pick(lanes.slots, best), 0)))
    is_open = least < NEVER
    # It may have been completed by a robot that passed: then it is closed, and the robot looks again.
    closed = wants & is_open & ((at(book.bits, area) & ~now) == 0).all(axis=1)
    takes = wants & is_open & ~closed & ~too_far
    asks = wants & (~is_open | too_far) & ~closed & (doing != IDLE)

    area = jnp.where(starts, piece, area)
    goal = at(book.target.reshape(-1), area * flat + here)
    salt = jnp.where(splits, jnp.uint32(SPLIT), here.astype(jnp.uint32))
    lanes = replace(lanes, now=jnp.where(runs[:, None], now, lanes.now))
    share = _if_any(runs & asks & ~ends, lambda: find_to_share(book, lanes, who, here, offset, afford))
    shares = asks & share.found
    arrives = turned = homeward = recalls = jnp.zeros_like(due)
    if homes is not None:
        way = moves_home(book, who, here)
        # For what is out of its range alone a robot is recharged, if it has made a move.
        recalls = wants & too_far & ~closed & ~shares & (homes.recharge > 0) & (until - step < at(homes.range, who))
        turned = (fate == TURNS) | ((fate == ENDS) & (way == 0) & ~returns) | recalls | due
        need = at(
            book.need.reshape(-1),
            jnp.where(me[:, LAST] < at(book.entries, me[:, WALK])[:, LENGTH], row_end + 1, row_end) * book.need.shape[1]
            + at(homes.of, who),
        )
        own = (homes.recharge > 0) & (until - step + 1 < at(homes.range, who)) & (need > until - me[:, SINCE])
        recalls = recalls | ((fate == TURNS) & own) | ((fate == ENDS) & (way == 0) & (homes.recharge > 0))
        recalls = jnp.where(returns, doing == RECALL, recalls)
        again = again | (turned & splits)
        arrives = (turned & (way == 0)) | (returns & (fate == ARRIVES))
        homeward = turned & (way > 0) & ~splits
        goal = jnp.where(homeward, here, goal)
        salt = jnp.where(homeward, jnp.uint32(HOMEWARD) - at(homes.of, who).astype(jnp.uint32), salt)
    goal = one_cell(book, goal)
    wanted = jnp.where((splits | covers)[:, None], todo, goal)
    entry = hold(look_up(book, wanted, salt))
    needs = splits | covers | starts | takes | homeward
    asked = jnp.concatenate([wanted, salt[:, None]], axis=1)

    entry = jnp.where(shares, share.split, entry)
    split = at(book.entries, jnp.maximum(entry, 0))
    first, count = split[:, PIECE], split[:, PARTS]
    missing = (needs & (entry < 0)) | (shares & ((share.split < 0) | (share.walks < 0).any(axis=1)))
    makes = splits | shares
    full = makes & ~missing & ((lanes.made + count > G) | (shares & (count > book.parts)))
    acts = runs & ~ends & ~missing & ~full
    wanted_share = shares
    splits, takes, closed, shares, makes = (acts & of for of in (splits, takes, closed, shares, makes))
    goes = acts & (covers | starts | takes | shares | (homeward & ~again))
    again, rests = acts & again, acts & ((asks & ~shares) | (wants & ~is_open) | (~leaves & (doing == LAND)))
    rests = (rests | (acts & wants & too_far & ~closed & ~shares)) & ~turned
    gone = acts & (leaves | turned | returns) & ~again & ~goes
    charges = gone & arrives & recalls & (lanes.over == 0)

    done = None
    if homes is not None:  # one that turns back goes on with what is left of its threshold
        walked = at(book.entries, me[:, WALK])
        done = visits_before(book, walked[:, FIRST], walked[:, COUNT], me[:, LAST], None, book.halvings)
    spent = acts & ~again & ~dies & ((fate == ARRIVES) | (homes is not None))
    left = jnp.where(spent[:, None], less(left, hazard_of(book, me[:, WALK], done)), left)
    leg = jnp.maximum(jnp.where(shares, share.walks[:, 1], entry), 0)
    # A robot that turns back before its move makes it on its way to the base.
    since = step - (fate == TURNS)
    base, moves, how, end = walk(book, leg, left, until - since + homeward)
    if homes is not None:
        turns = turning(book, who, leg, since, until, moves, how)
        moves, how = (jnp.where(homeward, old, new) for old, new in zip((moves, how), turns, strict=True))
    given, number = first + share.parts[:, 1], lanes.made + share.parts[:, 1]
    columns = {
        DOING: jnp.where(homeward, jnp.where(recalls, RECALL, RETURN), jnp.where(covers, COVER, TRAVEL)), FATE: how,
        HERE: end, WALK: leg, ROW: base, SINCE: since, LAST: moves, UNTIL: until,
        AREA: jnp.where(shares, given, jnp.where(covers, piece, jnp.where(homeward, -1, area))),
        IDENT: jnp.where(shares, number, jnp.where(covers | starts, me[:, IDENT], best)),
    }  # fmt: skip
    fresh = jnp.stack([columns[name].astype(jnp.int32) for name in range(FIELDS)], axis=1)
    still = {
        DOING: jnp.where(gone, jnp.where(dies, DEAD, jnp.where(charges, CHARGE, OUT)), jnp.where(closed, doing, IDLE)),
        FATE: ARRIVES,
        HERE: here, AREA: jnp.where(closed, me[:, AREA], -1), IDENT: me[:, IDENT], WALK: 0, ROW: 0, SINCE: step,
        LAST: 0, UNTIL: jnp.where(closed, me[:, UNTIL], until - step),
    }  # fmt: skip
    stays = jnp.stack([jnp.broadcast_to(still[name], step.shape).astype(jnp.int32) for name in range(FIELDS)], axis=1)
    after = jnp.where(goes[:, None], fresh, stays)
    left_over = jnp.where(turned, -1, at(book.next_of, piece))
    after = jnp.where(again[:, None], me.at[:, AREA].set(left_over), after)
    key = jnp.where(goes, (since + moves + (how == TURNS)) * stride + who, jnp.where(closed | again, key, NEVER))
    if homes is not None:
        key = jnp.where(charges, (step + homes.recharge) * stride + who, key)
        # One that waits returns at the end of the step after which it would be late.
        rest_until = jnp.maximum(homes.last - moves_home(book, who, here), step) * stride + K + who
        is_due = rests & (moves_home(book, who, here) > 0) & (homes.last <= book.max_steps)
        key = jnp.where(is_due, rest_until, key)
    # A robot without an area at its start looks for one from the next step on.
    key = jnp.where(rests & (doing == LAND), (step + 1) * stride + who, key)
    mine = mine & acts[:, None]
    opened = splits | (shares & (count > 2))
    waits = (lanes.robots[:, :, DOING] == IDLE) & opened[:, None]
    woken = (step[:, None] + (robots < who[:, None])) * stride + robots
    keys = jnp.where(waits, jnp.minimum(woken, lanes.key), lanes.key)

    place = jnp.arange(G, dtype=jnp.int32)
    slots = jnp.where((takes | closed)[:, None] & (place == best[:, None]), -1, lanes.slots)
    part = place - lanes.made[:, None]
    new = makes[:, None] & (part >= 0) & (part < count[:, None])
    taken = shares[:, None] & (part[:, :, None] == share.parts[:, None]).any(axis=2)
    slots = jnp.where(new, jnp.where(taken, -1, first[:, None] + part), slots)

    come = acts & ~again
    bisected = split[:, BISECTED] > 0
    kinds = shares[:, None] & jnp.stack([bisected, ~bisected], axis=1)
    ended = runs & (ends | (acts & dies & (alive == 0)))
    ahead = lanes.last + book.quiet
    final = jnp.where(none, jnp.minimum(ahead, book.max_steps), step)
    outcome = jnp.where(late, int(Outcome.STEP_LIMIT), int(Outcome.ALL_ROBOTS_LOST))
    outcome = jnp.where(none & (ahead <= book.max_steps), int(Outcome.NO_PROGRESS), outcome)
    if homes is not None:
        outcome = jnp.where(none & (lanes.over > 0), lanes.over - 1, outcome)
        final = jnp.where(none & (lanes.over > 0), lanes.last, final)
    moved = come & ~due & (goes | ((doing != IDLE) & (step > me[:, SINCE]) & (fate != TURNS)))
    mode = jnp.where(ended, DONE, jnp.where(missing, MISSING, jnp.where(full, FULL, RUN)))
    changed = replace(
        lanes,
        mode=jnp.where(runs, mode, lanes.mode),
        fuel=lanes.fuel - (acts | (runs & ends)).astype(jnp.int32),
        visited=jnp.where(come[:, None], lanes.visited | at(book.prefix, row_end), lanes.visited),
        survived=jnp.where(come[:, None], lanes.survived | at(book.prefix, row_end - dies), lanes.survived),
        slots=slots,
        made=lanes.made + jnp.where(makes, count, 0),
        key=jnp.where(mine, key[:, None], keys),
        robots=jnp.where(mine[:, :, None], after[:, None], lanes.robots),
        left=jnp.where(mine[:, :, None], left[:, None], lanes.left),
        shared=lanes.shared + kinds,
        last=jnp.where(ended, final, jnp.where(moved, step, lanes.last)),
        outcome=jnp.where(ended, outcome, lanes.outcome),
        asked=jnp.where((runs & missing)[:, None], jnp.where(wanted_share[:, None], share.asked, asked), lanes.asked),
    )
    if log is not None:
        flags = jnp.where(dies, jnp.uint32(STOPPED), jnp.uint32(0))
        log = write(log, come & (me[:, LAST] > 0), _row(lanes.number, who, me, me[:, LAST], flags))
    share = replace(share, found=shares)
    return _if_any_else(
        shares, lambda: _owner_sets_out(book, changed, log, share, lanes.made, first, step, who, offset), (changed, log)
    )


def _row(number: jax.Array, robot: jax.Array, me: jax.Array, moves: jax.Array, flags: jax.Array) -> jax.Array:
    """Rows of the log, uint32 `[.., 4]`."""
    whole = (number * 1024 + robot, me[..., WALK], me[..., SINCE], moves)
    first, entry, since, last = (part.astype(jnp.uint32) for part in whole)
    return jnp.stack([first, entry, since, last | flags], axis=-1)


def write(log: Log, chosen: jax.Array, rows: jax.Array) -> Log:
    """Append the chosen rows, `[S]` of `[S, 4]`."""
    place = log.used + jnp.cumsum(chosen, dtype=jnp.int32) - 1
    place = jnp.where(chosen, place, log.rows.shape[0])
    return Log(log.rows.at[place].set(rows, mode="drop"), log.used + chosen.sum(dtype=jnp.int32))


def _if_any(wanted, make):  # type: ignore[no-untyped-def]
    """`make()` where some lane wants it, else zeros. On a GPU a branch would make the host wait."""
    if jax.default_backend() != "cpu":
        return make()
    none = jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), jax.eval_shape(make))
    return jax.lax.cond(wanted.any(), make, lambda: none)


def _if_any_else(wanted, make, other):  # type: ignore[no-untyped-def]
    return make() if jax.default_backend() != "cpu" else jax.lax.cond(wanted.any(), make, lambda: other)


def _owner_sets_out(book, lanes, log, share, made, first, step, helper, offset):  # type: ignore[no-untyped-def]
    """The owner of a shared area leaves its walk where it is, and sets out to its part.

    One that has yet to enter its start only has another area.
    """
    K, owner = lanes.key.shape[1], share.owner
    me, by = pick(lanes.robots, owner), pick(offset, owner)
    waits = me[:, DOING] == START
    entry = at(book.entries, me[:, WALK])
    visits = visits_before(book, entry[:, FIRST], entry[:, COUNT], by, None, book.halvings)
    left = less(pick(lanes.left, owner), hazard_of(book, me[:, WALK], visits))
    since = step - (owner > helper)
    way, budget = jnp.maximum(share.walks[:, 0], 0), me[:, UNTIL] - since
    base, moves, fate, end = walk(book, way, left, budget)
    # One that is at its target already begins to cover at its next turn, which may be the last of its range.
    fate = jnp.where((moves == 0) & (budget <= 1), ENDS, fate)
    moves, fate = turning(book, owner, way, since, me[:, UNTIL], moves, fate, True)
    columns = {
        DOING: TRAVEL, FATE: fate, HERE: end, AREA: first + share.parts[:, 0], IDENT: made + share.parts[:, 0],
        WALK: way, ROW: base, SINCE: since, LAST: moves, UNTIL: me[:, UNTIL],
    }  # fmt: skip
    after = jnp.stack([jnp.broadcast_to(columns[name], step.shape).astype(jnp.int32) for name in range(FIELDS)], axis=1)
    given = jnp.array([name in (AREA, IDENT) for name in range(FIELDS)])
    after = jnp.where(waits[:, None] & ~given, me, after)
    here = share.found[:, None] & (jnp.arange(K, dtype=jnp.int32) == owner[:, None])
    goes = here & ~waits[:, None]
    come = jnp.where((share.found & ~waits)[:, None], at(book.prefix, me[:, ROW] + by), jnp.uint32(0))
    lanes = replace(
        lanes,
        visited=lanes.visited | come,
        survived=lanes.survived | come,
        key=jnp.where(
            goes,
            ((since + jnp.maximum(moves + (fate == TURNS), 1)) * stride_of(book, lanes) + owner)[:, None],
            lanes.key,
        ),
        robots=jnp.where(here[:, :, None], after[:, None], lanes.robots),
        left=jnp.where(goes[:, :, None], left[:, None], lanes.left),
    )
    if log is not None:
        rows = _row(lanes.number, owner, me, by, jnp.zeros(by.shape, jnp.uint32))
        log = write(log, share.found & ~waits & (by > 0), rows)
    return lanes, log


def begin(book: Book, left: jax.Array, number: jax.Array) -> tuple[Lanes, jax.Array]:
    """Lanes of rollouts with these thresholds, `[S, K, 2]`, at the snapshot before their first loss, and its number."""
    S, K = left.shape[:2]
    endless = jnp.full(S * K, LIMITLESS, jnp.int32)
    marks = walk(book, jnp.tile(book.milestones, S), left.reshape(-1, 2), endless, HALVINGS)[1]
    which = marks.reshape(S, K).min(axis=1)
    lanes = jax.tree.map(lambda of: at(of, which), book.first)
    left = less(left, at(book.before, which))
    me = lanes.robots.reshape(S * K, FIELDS)
    doing, stride = me[:, DOING], stride_of(book, lanes)
    homeward = (doing == RETURN) | (doing == RECALL)
    _, moves, fate, _ = walk(book, me[:, WALK], left.reshape(-1, 2), me[:, UNTIL] - me[:, SINCE] + homeward)
    who = jnp.tile(jnp.arange(K, dtype=jnp.int32), S)
    turns = turning(book, who, me[:, WALK], me[:, SINCE], me[:, UNTIL], moves, fate)
    owns = (doing == TRAVEL) | (doing == COVER)
    moves, fate = (jnp.where(owns, new, old).reshape(S, K) for old, new in zip((moves, fate), turns, strict=True))
    stands = (lanes.robots[:, :, LAST] == 0) & (lanes.robots[:, :, FATE] != TURNS)
    stands = stands | (at(book.entries, lanes.robots[:, :, WALK])[:, :, LENGTH] == 0)
    key = (lanes.robots[:, :, SINCE] + moves + (fate == TURNS)) * stride + jnp.arange(K, dtype=jnp.int32)
    fate = jnp.where(stands, lanes.robots[:, :, FATE], fate)
    kept = lanes.robots.at[:, :, LAST].set(jnp.where(stands, 0, moves)).at[:, :, FATE].set(fate)
    return replace(lanes, number=number, left=left, key=jnp.where(stands, lanes.key, key), robots=kept), which


def ended(book: Book, lanes: Lanes) -> tuple[Ended, jax.Array, jax.Array]:
    """What lanes at their end have come to; and rows of the log, uint32 `[S, K, 4]`, and which of them there are."""
    robots, row = lanes.robots, lanes.robots[:, :, ROW]

    def by(time: jax.Array) -> jax.Array:
        return jnp.clip(time[:, None] - robots[:, :, SINCE], 0, robots[:, :, LAST])

    def covered(time: jax.Array) -> jax.Array:
        return lanes.visited | entered(book, row + by(time))

    def halve(_: int, span: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = span
        middle = (low + high) >> 1
        full = (covered(middle) == book.every).all(axis=1)
        return hold((jnp.where(full, low, middle + 1), jnp.where(full, middle, high)))

    complete = (lanes.now == book.every).all(axis=1)
    span = jnp.zeros_like(lanes.last), lanes.last
    rewinds = complete.any() if book.homes is None else jnp.bool_(False)
    first = jax.lax.cond(rewinds, lambda: jax.lax.fori_loop(0, HALVINGS, halve, span)[1], lambda: lanes.last)
    time = jnp.where(complete, first, lanes.last)
    moves = by(time)
    stopped = (robots[:, :, FATE] == DIES) & (robots[:, :, SINCE] + robots[:, :, LAST] <= time[:, None])
    lost = (robots[:, :, DOING] == DEAD) | stopped
    visited, survived = covered(time), lanes.survived | entered(book, row + moves - stopped)

    def size(cells: jax.Array) -> jax.Array:
        return jax.lax.population_count(cells).sum(axis=1, dtype=jnp.uint32).astype(jnp.int32)

    numbers = [size(visited), size(survived), time, (~lost).sum(axis=1, dtype=jnp.int32)]
    numbers += [jnp.where(complete, int(Outcome.COMPLETE), lanes.outcome), lanes.shared[:, 0], lanes.shared[:, 1]]
    flags = jnp.where(stopped, jnp.uint32(STOPPED), jnp.uint32(0)) | jnp.uint32(FINAL)
    who = jnp.arange(robots.shape[1], dtype=jnp.int32)
    home = jnp.zeros_like(time)
    if book.homes is not None:
        cell = jnp.where(robots[:, :, WALK] > 0, at(book.cell_at, row + moves), robots[:, :, HERE])
        is_home = moves_home(book, jnp.broadcast_to(who, cell.shape), cell) == 0
        home = (is_home & ~lost).sum(axis=1, dtype=jnp.int32)
    numbers.append(home)
    rows = _row(lanes.number[:, None], who, robots, moves, flags)
    return Ended(jnp.stack(numbers, axis=1), visited, survived), rows, moves > 0


def _all_return(book, lanes, log, runs, key):  # type: ignore[no-untyped-def]
    """Lanes whose mission is over before the next event: at the end of that step all robots return to base.

    Each leaves its walk where it is; at the end of the step it sets out. Returns lanes, log, and which lanes these are.
    """
    robots, stride = lanes.robots, stride_of(book, lanes)
    step, K = jnp.minimum(key // stride, book.max_steps + 1), lanes.key.shape[1]
    moving = (robots[:, :, DOING] <= CHARGE).any(axis=1)

    def covered(time: jax.Array) -> jax.Array:
        offset = jnp.clip(time[:, None] - robots[:, :, SINCE], 0, robots[:, :, LAST])
        return (lanes.visited | entered(book, robots[:, :, ROW] + offset) == book.every).all(axis=1)

    stuck = lanes.last + book.quiet
    asleep = ~moving & (step + (key % stride >= K) > stuck) & (stuck <= book.max_steps)
    may = runs & (lanes.over == 0)
    # What has been visited by the last event was not complete before it.
    complete = (step > lanes.last) & covered(step - 1)
    over = may & (complete | asleep)

    def halve(_: int, span: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = span
        middle = (low + high) >> 1
        full = covered(middle)
        return hold((jnp.where(full, low, middle + 1), jnp.where(full, middle, high)))

    def turn() -> tuple[Lanes, Log | None]:
        first = jax.lax.fori_loop(0, HALVINGS, halve, (jnp.minimum(lanes.last, step - 1), step - 1))[1]
        time = jnp.where(complete, first, stuck)
        offset = jnp.clip(time[:, None] - robots[:, :, SINCE], 0, robots[:, :, LAST])
        doing = robots[:, :, DOING]
        cut = over[:, None] & ((doing < RETURN) | (doing == IDLE))
        flat = robots.reshape(-1, FIELDS)
        entry = at(book.entries, flat[:, WALK])
        visits = visits_before(book, entry[:, FIRST], entry[:, COUNT], offset.reshape(-1), None, book.halvings)
        left = less(lanes.left.reshape(-1, 2), hazard_of(book, flat[:, WALK], visits)).reshape(lanes.left.shape)
        rows = jnp.where(cut, robots[:, :, ROW] + offset, 0)
        come = jnp.bitwise_or.reduce(at(book.prefix, rows), axis=1)
        cell = jnp.where(robots[:, :, WALK] > 0, at(book.cell_at, robots[:, :, ROW] + offset), robots[:, :, HERE])
        who = jnp.broadcast_to(jnp.arange(K, dtype=jnp.int32), doing.shape)
        values: dict[int, Any] = {
            DOING: IDLE, FATE: ARRIVES, HERE: cell, AREA: -1, IDENT: 0, WALK: 0, ROW: 0, SINCE: time[:, None], LAST: 0,
            UNTIL: jnp.where(doing == IDLE, robots[:, :, UNTIL], robots[:, :, UNTIL] - time[:, None]),
        }  # fmt: skip
        after = jnp.stack([jnp.broadcast_to(values[name], doing.shape).astype(jnp.int32) for name in range(FIELDS)], -1)
        charging = over[:, None] & (doing == CHARGE)
        kept = robots.at[:, :, DOING].set(jnp.where(charging, OUT, doing))
        keys = jnp.where(cut, time[:, None] * stride + K + who, jnp.where(charging, NEVER, lanes.key))
        changed = replace(
            lanes,
            visited=lanes.visited | come,
            survived=lanes.survived | come,
            robots=jnp.where(cut[:, :, None], after, kept),
            left=jnp.where(cut[:, :, None], left, lanes.left),
            key=keys,
            over=jnp.where(over, jnp.where(complete, int(Outcome.COMPLETE), int(Outcome.NO_PROGRESS)) + 1, lanes.over),
            last=jnp.where(over, time, lanes.last),
            fuel=lanes.fuel - over.astype(jnp.int32),
        )
        if log is None:
            return changed, None
        flags = jnp.zeros(doing.shape, jnp.uint32)
        written = _row(lanes.number[:, None], who, robots, offset, flags).reshape(-1, 4)
        return changed, write(log, (cut & (offset > 0)).reshape(-1), written)

    lanes, log = _if_any_else(over, turn, (lanes, log))
    return lanes, log, over
