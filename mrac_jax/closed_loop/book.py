"""The book of a closed loop: the table of all decisions, computed once on the host and kept as arrays.

A decision is local: the order in which a set of cells is covered from a cell, the path to a cell, the parts of a set.
A million rollouts rarely have more than a few thousand different decisions. Each is an *entry* of the book. Entries
that are *walks* have rows: row `base + o` of `prefix` holds the cells entered by their move o, as bits. Tables only
grow. Axis letters: `A` accessible cells, `W` words of bits, `N` entries, `R` rows of all walks, `D`
dangerous visits of all walks, `P` pieces, `H` buckets of the hash table. Only NumPy and Numba are used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import WorldError
from planner.mrac.areas import connected_parts, wavefront_parts
from planner.rollouts.loop import ClosedLoop
from planner.simulator.codes import NONE
from planner.simulator.jit import compiled

WORD_BITS = 32
SPLIT, HALVE, HOMEWARD = 2**32 - 1, 2**32 - 2, 2**32 - 3
"""Salts in place of the first cell of a walk: the parts of a set; its parts, bisected if there is only one; the path
from the set's one cell to a base of the first set of bases (of each further set a number less)."""
NOWHERE = 0
"""The entry of robots that do not move."""
BASE, LENGTH, END, FIRST, COUNT, PIECE, PARTS, BISECTED, COLUMNS = range(9)
"""Columns of `entries`: first row, moves, last cell; first and number of its dangerous visits; of a split: its first
piece, the number of pieces, and whether one part was bisected."""
CELLS = 2**31
"""Above every cell index: the first cell of a walk is below."""
NEVER = 2**30
"""Later than every step, and more than every cost."""
BUCKET = 4
"""Capacity of a bucket of the hash table: as many tags, then their entries."""
ROBOTS = (8, 16, 32, 64, 128, 256, 512, 1024)
"""Team sizes to which teams, and their sets of bases, are padded."""
WORDS = (5, 10, 13, 16, 20, 26, 32, 40, 52, 64, 80, 96, 128, 160, 200, 256, 320)
"""Words of bits are padded to one of these, so that programs are compiled for few sizes."""
ENTRIES, ROOM = 2**12, ((WORDS[7], 2**17), (WORDS[1], 2**16), (0, 2**15))
"""Initial capacity: entries, and rows of walks by least number of words. It suffices for usual missions, so that their
program is compiled once."""
MOST_BYTES = 2**31
"""Memory limit of a book in bytes."""
M1, M2, M3 = np.uint32(0x9E3779B1), np.uint32(0x85EBCA77), np.uint32(0xC2B2AE3D)


def mixed(words, salt):  # type: ignore[no-untyped-def]
    """(bucket, tag), uint32 `[..]`, of sets of cells `[.., W]` and salts `[..]`, uint32; NumPy and JAX alike.

    The tag is never 0. A comparison of the sets resolves equal tags.
    """
    place = np.arange(1, words.shape[-1] + 1, dtype=np.uint32)
    with np.errstate(over="ignore"):
        word = (words ^ (place * M2)) * (place * M1 | np.uint32(1))
        word = (word ^ word >> 15) * M3
        one = word.sum(axis=-1, dtype=np.uint32) + salt * M2
        two = (word ^ word >> 13).sum(axis=-1, dtype=np.uint32) ^ salt * M1
        one, two = (one ^ one >> 16) * M1, (two ^ two >> 15) * M3
    return one ^ one >> 15, (two ^ two >> 16) | np.uint32(1)


def padded_team(robots: int) -> int:
    """Capacity for robots of the lanes of a team."""
    return next(room for room in ROBOTS if room >= robots)


@compiled
def _cover(here, todo, sweep, cost, hop, out, ends):  # type: ignore[no-untyped-def]
    """Algorithm 3: write the cells entered from `here` to cover `todo` (bool, used up) into `out`; returns the count.

    `ends`: bool, whether a leg ends there. Returns NONE if `out` is too short.
    """
    size, left = 0, 0
    for cell in range(len(todo)):
        left += todo[cell]
    while left > 0:
        target = -1
        for side in range(4):
            cell = sweep[here, side]
            if target < 0 and cell < len(todo) and todo[cell]:
                target = cell
        if target < 0:
            for cell in range(len(todo)):
                if todo[cell] and (target < 0 or cost[here, cell] < cost[here, target]):
                    target = cell
        while here != target:
            here = hop[target, here]
            if size == len(out):
                return -1
            out[size], ends[size] = here, here == target
            size += 1
        todo[target] = False
        left -= 1
    return size


@compiled
def _need(here, cells, ends, home, rows):  # type: ignore[no-untyped-def]
    """Fill the rows `[M + 1]` of a walk: the moves after its begin that a robot needs to make each move.

    It needs to be within range of a base (`home` `[A]`, moves from each cell) from every cell of the leg's rest. Each
    row has the most up to then; row 0 is of a move that stays. ends: bool `[M]`, where legs end.
    """
    rows[0] = home[here] + 1
    most = 0
    for move in range(len(cells), 0, -1):
        most = 0 if ends[move - 1] else most
        if home[cells[move - 1]] >= 0:
            most = max(most, home[cells[move - 1]] + move)
        rows[move] = most
    for move in range(2, len(cells) + 1):
        rows[move] = max(rows[move], rows[move - 1])


@compiled
def _reach(cells, cost, hop, target, steps):  # type: ignore[no-untyped-def]
    """For a piece: its cheapest cell to reach from each cell, and the moves of the path to it; NONE: unreachable."""
    least = np.full(len(cost), 2**62, dtype=np.int64)
    for cell in cells:  # entering any of them costs the same, so the costs the other way round rank alike
        for here in range(len(cost)):
            if 0 <= cost[cell, here] < least[here]:
                least[here], target[here], steps[here] = cost[cell, here], cell, 0
    for first in range(len(cost)):
        # Along the path up to its end or a cell that is known, and once more. All its cells go to its end: another cell
        # of the piece at the same cost has a higher index.
        here, moves = first, 0
        while steps[here] == 0 and here != target[first]:
            here, moves = hop[target[first], here], moves + 1
        last, moves, here = here, moves + steps[here], first
        while here != last:
            steps[here] = moves
            here, moves = hop[target[first], here], moves - 1


class Grown:
    """A table whose first axis doubles, so that programs are compiled for few sizes."""

    def __init__(self, room: int, width: tuple[int, ...], dtype: type) -> None:
        self.rows: NDArray = np.zeros((room, *width), dtype=dtype)
        self.used = 0

    def add(self, values: NDArray) -> int:
        """Append the rows; returns the index of the first."""
        begin = self.used
        while begin + len(values) > len(self.rows):
            self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)])
        self.rows[begin : begin + len(values)] = values
        self.used += len(values)
        return begin


class HostBook:
    """The tables of one closed loop, on the host.

    Attributes:
        cells, words: A, W. entries: int32 `[N, COLUMNS]`; sets, salts: uint32 `[N, W]`, `[N]`, the keys of entries.
        prefix: uint32 `[R, W]`; cell_at: int32 `[R]`, the robot's cell, NONE where it waits on its path.
        shift: number of bits below the level in the costs of pieces.
        sums: int64 `[D]`, hazard along the walk up to and with each dangerous visit, a zero before the first; at: int32
            `[D]`, the move of each.
        bits: uint32 `[P, W]`, pieces: sets of cells that are or were areas, those of the plan first. cost: int32
            `[P, A']`, from each cell, its level on top, NEVER if it is out of reach; target: int32, to which of its
            cells; steps: int32, moves there.
        need: int32 `[R, S]`, by set of bases, moves from the walk's begin on without which a robot returns to base
            before that move; no column where none does. brought: int32 `[R, S]`, the last move so far that enters a
            base, 0: none.
        buckets: uint32 `[H, 2 * BUCKET]`.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        t, self.loop = loop.tables, loop
        self.cells = len(loop.cells)
        least = -(-self.cells // WORD_BITS)
        self.words = next((words for words in WORDS if words >= least), least)
        wide, room = self.words * WORD_BITS, next(room for least, room in ROOM if self.words >= least)
        self.entries = Grown(ENTRIES, (COLUMNS,), np.int32)
        self.sets, self.salts = Grown(ENTRIES, (self.words,), np.uint32), Grown(ENTRIES, (), np.uint32)
        self.prefix, self.cell_at = Grown(room, (self.words,), np.uint32), Grown(room, (), np.int32)
        self.sums, self.at = Grown(room, (), np.int64), Grown(room, (), np.int32)
        self.bits = Grown(2**10, (self.words,), np.uint32)
        self.cost, self.target, self.steps = (Grown(2**10, (wide,), np.int32) for _ in range(3))
        bases = padded_team(len(t.home_steps)) if len(t.home_steps) > 1 else len(t.home_steps)
        self.need, self.brought = (Grown(room, (bases,), np.int32) for _ in range(2))
        self.longest = 1
        self.buckets = np.zeros((4 * ENTRIES, 2 * BUCKET), dtype=np.uint32)
        self.most_visits = 1
        self.shift = int(t.cost_to.max(initial=0)).bit_length()
        if int(t.level.max()) + 1 << self.shift > NEVER:
            raise WorldError(
                f"costs of up to {int(t.cost_to.max()):,} on {int(t.level.max()) + 1} levels",
                expected="a product below 2**30 for the closed loop in JAX",
                fix=f"use {argument('engine', 'numba')}, or fewer {argument('levels')}",
            )
        self._path = np.empty(64 * self.cells + 64, dtype=np.int64)
        self.level = np.empty(self.cells, dtype=np.int64)
        self.add_walk(0, np.zeros(0, dtype=np.int64))
        for area, level in enumerate(t.level):
            mine = t.order[t.begin[area] : t.begin[area + 1]]
            self.level[mine] = level
            self._add_piece(np.sort(mine))

    @property
    def tables(self) -> dict[str, Grown]:
        """All tables but the buckets, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Grown)}

    def row_of(self, cells: NDArray) -> NDArray[np.uint32]:
        """The set of these cells, uint32 `[W]`."""
        whole = np.zeros(self.words * WORD_BITS, dtype=np.bool_)
        whole[cells] = True
        return np.packbits(whole, bitorder="little").view("<u4").astype(np.uint32)

    def cells_of(self, row: NDArray[np.uint32]) -> NDArray[np.int64]:
        """The cells of a set, rising."""
        return np.flatnonzero(np.unpackbits(row.astype("<u4").view(np.uint8), bitorder="little"))

    def look_up(self, salt: int, row: NDArray[np.uint32]) -> int:
        """The entry of a set and a salt (a cell, SPLIT or HALVE); a new one is computed and added."""
        bucket, tag = mixed(row, np.uint32(salt))
        there = self.buckets[int(bucket) & (len(self.buckets) - 1)]
        for entry in there[BUCKET:][there[:BUCKET] == tag].tolist():
            if self.salts.rows[entry] == salt and (self.sets.rows[entry] == row).all():
                return int(entry)
        cells = self.cells_of(row)
        if salt >= HALVE:
            entry = self._add_split(cells, salt == HALVE)
        elif salt >= CELLS:
            entry = self.add_walk(int(cells[0]), self.way_home(int(cells[0]), HOMEWARD - salt))
        else:
            entry = self.add_walk(salt, *self.path(salt, cells))
        self.sets.rows[entry], self.salts.rows[entry] = row, salt
        self._put(entry, int(bucket), int(tag))
        return entry

    def _put(self, entry: int, bucket: int, tag: int) -> None:
        there = self.buckets[bucket & (len(self.buckets) - 1)]
        # Two sets with one tag in one bucket would hide each other: a larger table separates them.
        if (there[:BUCKET] > 0).all() or (there[:BUCKET] == tag).any():
            self.buckets = np.zeros((2 * len(self.buckets), 2 * BUCKET), dtype=np.uint32)
            keyed = np.flatnonzero(self.sets.rows[: self.sets.used].any(axis=1))
            for known, *key in zip(keyed.tolist(), *mixed(self.sets.rows[keyed], self.salts.rows[keyed]), strict=True):
                self._put(known, *map(int, key))
            return
        place = int((there[:BUCKET] > 0).sum())
        there[place], there[BUCKET + place] = tag, entry

    def way_home(self, here: int, bases: int) -> NDArray[np.int64]:
        """The cells entered from `here` to the base of this set of bases."""
        t, way = self.loop.tables, []
        while t.home_steps[bases, here] > 0:
            here = int(t.onward[bases, here])
            way.append(here)
        return np.array(way, dtype=np.int64)

    def path(self, here: int, cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], None, NDArray[np.bool_]]:
        """The cells entered from `here` to cover these, and the ends of legs; a cell that is reached is covered."""
        t = self.loop.tables
        while True:
            todo = np.zeros(self.cells, dtype=np.bool_)
            todo[cells] = True
            ends = np.zeros(len(self._path), dtype=np.bool_)
            size = _cover(np.int64(here), todo, t.sweep, t.cost_to, t.hop_to, self._path, ends)
            if size >= 0:
                return self._path[:size].copy(), None, ends[:size]
            self._path = np.empty(2 * len(self._path), dtype=np.int64)

    def add_walk(
        self,
        here: int,
        cells: NDArray[np.int64],
        waits: NDArray[np.bool_] | None = None,
        ends: NDArray[np.bool_] | None = None,
    ) -> int:
        """The entry of a walk from `here` through the cells, without a key.

        waits: bool `[M]`, moves that stay and enter no cell; None: none. ends: ends of legs; None: the last move.
        """
        t, entered = self.loop.tables, cells if waits is None else np.where(waits, NONE, cells)
        rows = np.zeros((len(entered) + 1, self.words), dtype=np.uint32)
        move = np.flatnonzero(entered >= 0)
        rows[move + 1, entered[move] >> 5] = np.uint32(1) << (entered[move] & 31).astype(np.uint32)
        base = self.prefix.add(np.bitwise_or.accumulate(rows))
        self.cell_at.add(np.append(here, entered))
        self.longest = max(self.longest, len(cells))
        need, brought = (np.zeros((len(rows), self.need.rows.shape[1]), dtype=np.int32) for _ in range(2))
        for bases, home in enumerate(t.home_steps):
            _need(here, cells, np.arange(len(cells)) == len(cells) - 1 if ends is None else ends, home, need[:, bases])
            brought[move + 1, bases] = (move + 1) * t.home_bases[bases, entered[move]]
        self.need.add(need)
        self.brought.add(np.maximum.accumulate(brought))
        end = int(cells[-1]) if len(cells) else here
        moves = np.flatnonzero((entered >= 0) & (t.bound[cells] > 0))
        self.most_visits = max(self.most_visits, len(moves))
        self.at.add(np.append(0, moves + 1))
        first = self.sums.add(np.append(0, np.cumsum(t.exposure[entered[moves]]))) + 1
        return self._add_entry(base, len(entered), end, first, len(moves))

    def _add_entry(self, *columns: int) -> int:
        self._check_room()
        self.sets.add(np.zeros((1, self.words), dtype=np.uint32))
        self.salts.add(np.zeros(1, dtype=np.uint32))
        return self.entries.add(np.array([[*columns, *[0] * (COLUMNS - len(columns))]]))

    def _check_room(self) -> None:
        size = sum(table.rows.nbytes for table in self.tables.values())
        if size > MOST_BYTES:
            raise WorldError(
                f"the decisions of this mission take up {size / 2**30:.1f} GiB",
                expected=f"at most {MOST_BYTES / 2**30:.0f} GiB for the closed loop in JAX",
                fix=f"use {argument('engine', 'numba')}, or coarsen the map",
            )

    def _add_piece(self, cells: NDArray[np.int64]) -> int:
        t, wide = self.loop.tables, self.words * WORD_BITS
        target, steps = np.full(wide, NONE, np.int32), np.full(wide, NONE, np.int32)
        _reach(cells, t.cost_to, t.hop_to, target, steps)
        cost = np.full(wide, NEVER, dtype=np.int64)
        there = np.flatnonzero(target >= 0)
        cost[there] = t.cost_to[there, target[there]].astype(np.int64) + (int(self.level[cells[0]]) << self.shift)
        self.cost.add(cost[None])
        self.target.add(np.maximum(target, 0)[None])
        self.steps.add(np.where(steps < 0, NEVER, steps)[None])
        return self.bits.add(self.row_of(cells)[None])

    def _add_split(self, cells: NDArray[np.int64], halves: bool) -> int:
        shape, every, first = self.loop.shape, self.loop.cells, self.bits.used
        parts = connected_parts(shape, every[cells])
        bisected = halves and len(parts) == 1
        for part in wavefront_parts(shape, parts[0], 2) if bisected else parts:
            self._add_piece(np.searchsorted(every, part))
        return self._add_entry(0, 0, 0, 1, 0, first, self.bits.used - first, bisected)
