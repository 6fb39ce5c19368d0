"""The state of the lanes on which closed loops run, what they are counted into, and how its parts are read and written.

A lane is where one rollout runs. Flat tables hold one row a lane; robots are bits of words. Axis letters: `B` lanes,
`S` lanes chosen among them; `A`, `K`, `W`, `L`, `T` as in `mrac_jax.closed_loop.tables`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from mrac_jax.arrays import Array
from mrac_jax.closed_loop.tables import LABEL, OWNER_SHIFT, UNREACHABLE, WORD_BITS, LaneTables
from planner.simulator.codes import EventKind

# Sets of cells as bits: flood fill by shifts, for many lanes at once.
#
# A board is uint32 `[P / 32, S]`, place p of lane s being bit p % 32 of word p // 32: the lanes come last, so that
# every
# operation runs along them. Places are numbered row by row with a wall after each row (`mrac_jax.closed_loop.tables`),
# so
# the neighbours of a place are one, or one `stride`, away. Axis letters: `P` places, `A` cells, `S` lanes.

WORD, SHIFT = 32, 5
GROWTH = 2
"""Moves that a flood makes before it looks whether it is over."""


def word_and_bit(place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The word of each place, int32, and its bit there, uint32. Shifts: `//` and `%` of signed numbers are 20 steps."""
    return place >> SHIFT, jnp.uint32(1) << (place & jnp.int32(WORD - 1)).astype(jnp.uint32)


def boards_pack(cells: jax.Array, cell_at: jax.Array) -> jax.Array:
    """The board of bool `[S, A]`, with the cell at each place, int32 `[P]`."""
    at_place = cells[:, cell_at].reshape(cells.shape[0], -1, WORD)
    bits = jnp.uint32(1) << jnp.arange(WORD, dtype=jnp.uint32)
    return jnp.where(at_place, bits, jnp.uint32(0)).sum(axis=2, dtype=jnp.uint32).T


def unpack(board: jax.Array, spot: jax.Array) -> jax.Array:
    """bool `[S, A]` of a board, with each cell's place, int32 `[A]`."""
    word, bit = word_and_bit(spot)
    return ((board[word] & bit[:, None]) != 0).T


def size(board: jax.Array) -> jax.Array:
    """Cells in it, int32 `[S]`."""
    return jax.lax.population_count(board).sum(axis=0, dtype=jnp.uint32).astype(jnp.int32)


def some(board: jax.Array) -> jax.Array:
    """Whether there is any cell in it, bool `[S]`."""
    return (board != 0).any(axis=0)


def lowest(board: jax.Array) -> jax.Array:
    """The lowest place, int32 `[S]`; P where there is none."""
    places = jnp.arange(board.shape[0], dtype=jnp.int32)[:, None] * WORD
    lone = board & (~board + jnp.uint32(1))
    bit = jnp.int32(WORD - 1) - jax.lax.clz(lone).astype(jnp.int32)
    return jnp.where(board != 0, places + bit, board.shape[0] * WORD).min(axis=0)


def lowest_cell(board: jax.Array, cell_at: jax.Array) -> jax.Array:
    """The lowest cell, int32 `[S]`, with the cell at each place, int32 `[P]`; the one at the last place if none."""
    return cell_at[jnp.minimum(lowest(board), cell_at.shape[0] - 1)]


def single(cell: jax.Array, words: int) -> jax.Array:
    """The board of one cell each, int32 `[S]`; empty for cells past the end."""
    word, bit = word_and_bit(cell)
    return jnp.where(jnp.arange(words, dtype=jnp.int32)[:, None] == word, bit, jnp.uint32(0))


def up(board: jax.Array, cells: jax.Array) -> jax.Array:
    """Every cell moved to a higher index by so many cells, int32 scalar in [0, A)."""
    words, bits = cells >> SHIFT, (cells & (WORD - 1)).astype(jnp.uint32)
    count = board.shape[0]
    # Whole words by a slice, the rest by shifts; shifts by 32 are undefined, hence in two parts.
    padded = jnp.concatenate([jnp.zeros_like(board), board])
    near = jax.lax.dynamic_slice_in_dim(padded, count - words, count)
    far = jax.lax.dynamic_slice_in_dim(padded, count - words - 1, count)
    return (near << bits) | ((far >> (jnp.uint32(WORD - 1) - bits)) >> jnp.uint32(1))


def down(board: jax.Array, cells: jax.Array) -> jax.Array:
    """Every cell moved to a lower index by so many cells, int32 scalar in [0, A)."""
    words, bits = cells >> SHIFT, (cells & (WORD - 1)).astype(jnp.uint32)
    count = board.shape[0]
    padded = jnp.concatenate([board, jnp.zeros_like(board)])
    near = jax.lax.dynamic_slice_in_dim(padded, words, count)
    far = jax.lax.dynamic_slice_in_dim(padded, words + 1, count)
    return (near >> bits) | ((far << (jnp.uint32(WORD - 1) - bits)) << jnp.uint32(1))


def grow(board: jax.Array, inside: jax.Array, stride: jax.Array) -> jax.Array:
    """The board with the neighbours, inside the other one, of all its cells."""
    one = jnp.int32(1)
    return (board | up(board, one) | down(board, one) | up(board, stride) | down(board, stride)) & inside


def flood(inside: jax.Array, seed: jax.Array, stride: jax.Array) -> jax.Array:
    """The cells inside that can be reached from the seed's without leaving it."""

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        board = state[0]
        # Growing twice before asking halves the reductions; growing too often changes nothing.
        after = board
        for _ in range(GROWTH):
            after = grow(after, inside, stride)
        return after, (after != board).any()

    start = seed & inside
    return jax.lax.while_loop(lambda state: state[1], step, (start, (start != 0).any()))[0]


def first_component(inside: jax.Array, stride: jax.Array) -> jax.Array:
    """The 4-connected component that holds the lowest cell."""
    return flood(inside, single(lowest(inside), inside.shape[0]), stride)


def keep_lowest(board: jax.Array, count: jax.Array) -> jax.Array:
    """The board's lowest cells, so many of them, int32 `[S]`; all if there are fewer."""
    sizes = jax.lax.population_count(board).astype(jnp.int32)
    wanted = jnp.clip(count - (jnp.cumsum(sizes, axis=0) - sizes), 0, sizes)
    taken = jnp.zeros_like(sizes)  # bits looked at: the most whose cells are not more than wanted
    for half in (16, 8, 4, 2, 1):
        below = board & ((jnp.uint32(1) << (taken + half).astype(jnp.uint32)) - jnp.uint32(1))
        fits = jax.lax.population_count(below).astype(jnp.int32) <= wanted
        taken = jnp.where(fits, taken + half, taken)
    below = board & ((jnp.uint32(1) << taken.astype(jnp.uint32)) - jnp.uint32(1))
    return jnp.where(sizes <= wanted, board, below)


def bisect(inside: jax.Array, stride: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two connected halves of a component, the one with its lowest cell first (SPEC section 5, `Bisection`).

    A wavefront grows from a far end, whole layers and the last one in index order, until half of the cells (rounded
    up) are in; of the rest the largest component stays (of equal ones, that with the lowest cell), the others join.
    """
    words = inside.shape[0]
    source = single(lowest(inside), words)

    def spread(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        reached, last, _ = state
        wider = grow(reached, inside, stride)
        layer = wider & ~reached
        return wider, jnp.where(some(layer), layer, last), (layer != 0).any()

    last = jax.lax.while_loop(lambda state: state[2], spread, (source, source, (source != 0).any()))[1]
    half = (size(inside) + 1) // 2

    def fill(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        board = state[0]
        layer = grow(board, inside, stride) & ~board
        after = board | keep_lowest(layer, half - size(board))
        return after, (after != board).any()

    start = single(lowest(last), words) & inside
    grown = jax.lax.while_loop(lambda state: state[1], fill, (start, (start != 0).any()))[0]

    def weigh(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        rest, stays, most = state
        part = first_component(rest, stride)
        # Components come in order of their lowest cell, so `>` leaves ties with the lowest.
        larger = size(part) > most
        return rest & ~part, jnp.where(larger, part, stays), jnp.where(larger, size(part), most)

    rest = inside & ~grown
    nothing = (rest, jnp.zeros_like(rest), jnp.zeros_like(half))
    stays = jax.lax.while_loop(lambda state: (state[0] != 0).any(), weigh, nothing)[1]
    others = inside & ~stays
    swap = lowest(others) < lowest(stays)
    return jnp.where(swap, others, stays), jnp.where(swap, stays, others)


OFF, ACT, NEXT, FIND_CELL, FIND_FAR, FIND_AREA, FIND_OR_SHARE, LOST, SHARE, END = range(10)
"""What a lane does next: nothing (no rollout left); its robot acts; the next robot's turn; search the next cell of a
coverage path (among the nearest; among all; inside its area); search an area (else stay; else share); split the area of
a lost robot; share; hand over its results."""
RETARGET, LOOK_AGAIN, JUDGE, CHARGE = range(END + 1, END + 5)
"""By other rules than the paper's: search the next target in the area; a better area; is the rest not worth the risk?
Where robots are charged: is there something for a robot without an area, once it is?"""
NEW_VISITED, NEW_SURVIVED, STOPPED, CELL_KINDS, STEP_KINDS = 1, 2, 4, 8, 4
"""Bits of a visit's kind: visits are counted by (cell, kind) and (step, kind)."""
VISITED_COLUMN, SURVIVED_COLUMN, TIME_COLUMN, ALIVE_COLUMN, OUTCOME_COLUMN, BISECTED_COLUMN, DIVIDED_COLUMN, COLUMNS = (
    range(8)
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Log:
    """What the lanes write down to be made into traces (`planner.tally.Trace`), int32. `E` events a lane.

    Attributes:
        events: `[B * E, 5]`; count: `[B]`, how many happened (more than E: the rest is lost).
        frames: `[B * T, 3, K]`, cell, doing and area of each robot at the end of each step. cell_ids:
            `[B * A]`, id of each cell's area.
    """

    events: Array
    count: Array
    frames: Array
    cell_ids: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lanes:
    """The state of every lane.

    Attributes:
        cells, areas: uint32 `[B * A]`, words (`mrac_jax.closed_loop.tables`); ids: int32 `[B * A]`, area ids at their
        labels.
        place: uint32 `[B * K]`, each robot's cell, and from bit 16 the cell that its current leg leads to.
        duty: uint32 `[B * K]`, each robot's area, and from bit 16 the pending cells of its coverage path.
        traveling, covering, alive: uint32 `[W, B]`, bits of the robots; at the end of its range one is not among those
            alive, but done; nor is one that has turned for home. done: those that found nothing more to do;
            hopeful: those without an area that have not yet looked for one since the last areas were made.
        waiting: int32 `[B]`, unassigned areas.
        rollout: uint32 `[B]`, its id; number: int32 `[B]`, its place among the results.
        mode, step, robot: int32 `[B]`: what comes next, t, whose turn it is (K: nobody's).
        halt: int32 `[B]`, the step before which the lane goes off, to be copied; one that has passed: none.
        quiet: int32 `[B]`, steps without progress; progress: bool `[B]`, in this step.
        unvisited, survived: int32 `[B]`, cells. made: int32 `[B]`, areas so far.
        bisected, divided: int32 `[B]`, shares of an area in one piece, in several. outcome: int32 `[B]`.
        looked: bool `[B]`, the robot whose turn it is has looked at what others have visited, and has yet to move; None
            by the paper's rule. held: uint32 `[W, B]`, robots kept from areas at risk, and safe_left: int32
            `[B]`, unvisited safe cells; None likewise.
        left: uint32 `[B * K * 2]`, what each robot still bears (`mrac_jax.arrays`).
        moves_left: int32 `[B * K]`, of robots with a range; None where nobody has one.
        passes: uint8 `[B * A]`, survived visits of each cell, MOST_PASSES for more; None where nobody asks.
        returning: uint32 `[W, B]`, robots on their way home; None where they do not come home. Else `outcome` is NONE
            until nothing more is to be done. ready: int32 `[B * K]`, of robots that are charged the step in which they
            have their range again, before they are at their base 2**31 - 1, else 0; None where nobody is.
        log: what traces are made of, or None.
    """

    cells: Array
    areas: Array
    ids: Array
    place: Array
    duty: Array
    traveling: Array
    covering: Array
    alive: Array
    hopeful: Array
    done: Array
    rollout: Array
    number: Array
    mode: Array
    step: Array
    robot: Array
    halt: Array
    quiet: Array
    progress: Array
    unvisited: Array
    survived: Array
    made: Array
    waiting: Array
    bisected: Array
    divided: Array
    outcome: Array
    looked: Array | None
    held: Array | None
    safe_left: Array | None
    left: Array
    moves_left: Array | None
    passes: Array | None
    returning: Array | None
    ready: Array | None
    log: Log | None

    @property
    def unharmed(self) -> Array:
        """uint32 `[W, B]`: the robots that were not stopped, whether they can still move or not."""
        return self.alive if self.moves_left is None else self.alive | self.done

    @property
    def rests(self) -> int:
        """What lanes do whose robots have found nothing to do."""
        return NEXT if self.ready is None else CHARGE

    def found_next(self, lanes: Array | slice = slice(None)) -> Array | int:
        """What these lanes do when their robots have found where to go."""
        return NEXT if self.looked is None else jnp.where(self.looked[lanes], ACT, NEXT)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Queue:
    """Rollouts that wait for a lane, `R` of them at most.

    Attributes:
        rollout: uint32 `[R]`, ids. begin_at: int32 `[R]`, the snapshot that each begins as.
        left: uint32 `[R, K * 2]`, what its robots still bear then. count: int32 scalar, how many there are.
    """

    rollout: Array
    begin_at: Array
    left: Array
    count: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sums:
    """Counts so far, int32.

    Attributes:
        by_cell: `[A * CELL_KINDS]`, visits by cell and kind. by_step: `[T * STEP_KINDS]`, visits by step and kind.
        passes: `[A * MOST_PASSES]`, rollouts with 1, 2, ... or more survived visits of the cell; None likewise.
        results: `[R, COLUMNS]`, what each rollout came to, and where survived visits are counted PIECES columns each of
            the weights of what was covered and found. next: how many have begun.
        moves: visits counted so far.
    """

    by_cell: Array
    by_step: Array
    passes: Array | None
    results: Array
    next: Array
    moves: Array


def read(flat: jax.Array, places: jax.Array) -> jax.Array:
    """Entries of a flat table."""
    return flat.at[places].get(mode="promise_in_bounds")


def write(flat: jax.Array, places: jax.Array, values: jax.Array) -> jax.Array:
    """A flat table with entries replaced; each lane writes at a place of its own."""
    return flat.at[places].set(values, mode="promise_in_bounds", unique_indices=True)


def choose_lanes(wants: jax.Array, width: int) -> tuple[jax.Array, jax.Array]:
    """The first `width` of the lanes in which it is true, bool `[B]`.

    Their numbers, int32 `[S]` (B: there is none), and each lane's place among them, int32 `[B]` (S: it has none).
    """
    batch = wants.shape[0]
    # A scan instead of a sort: the first lanes that want it, and each one's place among them.
    rank = jnp.cumsum(wants, dtype=jnp.int32) - 1
    slot = jnp.where(wants & (rank < width), rank, width)
    nobody = jnp.full(width, batch, dtype=jnp.int32)
    return nobody.at[slot].set(jnp.arange(batch, dtype=jnp.int32), mode="drop"), slot


def spread(old: jax.Array, slot: jax.Array, values: jax.Array) -> jax.Array:
    """`[.., B]` with the values, `[.., S]`, of the lanes that were chosen: read where XLA would loop to write them."""
    width = values.shape[-1]
    return jnp.where(slot < width, values[..., jnp.minimum(slot, width - 1)], old)


def get(lanes: Lanes, flat: jax.Array, lane: jax.Array, place: jax.Array) -> jax.Array:
    """One entry of each chosen lane's row in a flat table, `[S]`; of some other lane's where there is none (lane B)."""
    batch = lanes.mode.shape[0]
    return read(flat, jnp.minimum(lane, batch - 1) * (flat.shape[0] // batch) + place)


def put(
    lanes: Lanes, flat: jax.Array, lane: jax.Array, place: jax.Array, values: jax.Array, where: jax.Array
) -> jax.Array:
    """The flat table with one entry of each chosen lane's row replaced, in the lanes of `where`, bool `[S]`."""
    batch = lanes.mode.shape[0]
    places = jnp.where(where & (lane < batch), lane * (flat.shape[0] // batch) + place, flat.shape[0])
    return flat.at[places].set(values, mode="drop")


def put_rows(lanes: Lanes, flat: jax.Array, lane: jax.Array, rows: jax.Array) -> jax.Array:
    """The flat table with the chosen lanes' rows replaced, `[S, row]`."""
    return flat.reshape(lanes.mode.shape[0], -1).at[lane].set(rows, mode="drop").reshape(-1)


def lane_rows(flat: jax.Array, lanes: int) -> jax.Array:
    """Where each lane's row begins in a flat `[lanes * row]` table, int32 `[lanes]`."""
    return jnp.arange(lanes, dtype=jnp.int32) * jnp.int32(flat.shape[0] // lanes)


def bits_of(robot: jax.Array, words: int) -> jax.Array:
    """The robot's bit, uint32 `[W, B]`; none for robot K and above."""
    mine, bit = word_and_bit(robot)
    return jnp.stack([jnp.where(mine == word, bit, jnp.uint32(0)) for word in range(words)])


def any_bit(words: jax.Array) -> jax.Array:
    """bool `[B]` of uint32 `[W, B]`."""
    return (words != 0).any(axis=0)


def first_bit(words: jax.Array, none: int) -> jax.Array:
    """The lowest robot among the bits, int32 `[B]`; `none` if there is none."""
    lowest = jnp.full(words.shape[1], none, dtype=jnp.int32)
    for word in reversed(range(words.shape[0])):
        bits = words[word]
        place = jnp.int32(WORD_BITS - 1) - jax.lax.clz(bits & (~bits + jnp.uint32(1))).astype(jnp.int32)
        lowest = jnp.where(bits != 0, place + jnp.int32(word * WORD_BITS), lowest)
    return lowest


def switch(words: jax.Array, bits: jax.Array, on: jax.Array, off: jax.Array) -> jax.Array:
    """The words with the bits set where `on`, cleared where `off` (bool `[B]`)."""
    return (words | jnp.where(on, bits, jnp.uint32(0))) & ~jnp.where(off, bits, jnp.uint32(0))


def bits_above(robot: jax.Array, words: int) -> jax.Array:
    """The bits of the robots after this one, uint32 `[W, B]`."""
    mine, bit = word_and_bit(robot)
    above = ~((bit - jnp.uint32(1)) | bit)
    every, nothing = jnp.uint32(2**WORD_BITS - 1), jnp.uint32(0)
    return jnp.stack([jnp.where(mine == w, above, jnp.where(mine < w, every, nothing)) for w in range(words)])


def low_half(word: jax.Array) -> jax.Array:
    """The label or cell in the 15 low bits, int32."""
    return (word & LABEL).astype(jnp.int32)


def high_half(word: jax.Array) -> jax.Array:
    """What stands from bit 16 on, int32."""
    return (word >> OWNER_SHIFT).astype(jnp.int32)


def state_pack(low: jax.Array, high: jax.Array) -> jax.Array:
    """uint32 of two numbers."""
    return low.astype(jnp.uint32) | (high.astype(jnp.uint32) << OWNER_SHIFT)


def write_down(
    lanes: Lanes, happened: jax.Array, robot: jax.Array, kind: EventKind, area: jax.Array, other: jax.Array
) -> Lanes:
    """The event in the log of the lanes where it happened, bool `[B]`; nothing if no log is kept."""
    if lanes.log is None:
        return lanes
    log, batch = lanes.log, happened.shape[0]
    room = log.events.shape[0] // batch
    place = jnp.where(happened & (log.count < room), lane_rows(log.events, batch) + log.count, log.events.shape[0])
    event = jnp.stack([lanes.step, robot, jnp.full_like(robot, int(kind)), area, other], axis=1)
    events = log.events.at[place].set(event, mode="drop")
    return replace(lanes, log=replace(log, events=events, count=log.count + happened.astype(jnp.int32)))


# What robots that come home can afford (SPEC section 19) in the lanes: how far they can go, and how far home is.
#
# The same rules in the simulator: `planner.simulator.areas`. Axis letters as in `mrac_jax.closed_loop.state`.


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


def flags_of(words: jax.Array, team: int) -> jax.Array:
    """bool `[K, B]` of uint32 `[W, B]`."""
    word, bit = word_and_bit(jnp.arange(team, dtype=jnp.int32))
    return (words[word] & bit[:, None]) != 0


def robots_home(tables: LaneTables, lanes: Lanes, at: jax.Array) -> jax.Array:
    """Robots of the lanes `at` that were not stopped and are at a base, int32 `[S]`."""
    homes, batch = tables.homes, lanes.mode.shape[0]
    assert homes is not None
    place = low_half(lanes.place.reshape(batch, -1)[at])
    there = read(homes.steps, homes.of * homes.size + place) == 0
    return (there & flags_of(lanes.unharmed[:, at], place.shape[1]).T).sum(axis=1, dtype=jnp.int32)
