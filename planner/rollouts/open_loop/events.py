"""Who covers a cell first: the events of shared cells, and how event counts become the tally's arrays.

An event is a set of (robot, requirement) pairs: it happens in a rollout iff a robot's outcome reaches its requirement.
"Cell c is covered by its first m visitors" is one; its count over rollouts gives coverage (m = all visitors) and new
cells per step (count of m visitors minus count of m - 1), as integers. Left out: visitors after a certain one
(requirement 0), and requirements that no outcome reaches. Equal events of several cells are one event with a weight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from planner.rollouts.open_loop.groups import Groups

if TYPE_CHECKING:
    from planner.rollouts.open_loop.entries import Entries

WORD_BITS = 32
Visitor = tuple[int, int, int]
"""(step, robot, requirement) of a robot's first entry of a cell."""


@dataclass(frozen=True, eq=False)
class Events:
    """The joint events and the linear map from counts to the tally's arrays.

    *Sources* are counts over a set of rollouts: first, group by group, how often `o_i < a and o_j < b` did not happen,
    `[size_i + 1, size_j + 1]` a group (see `source_counts`), then how often each joint event happened.

    Attributes:
        bits: uint32 `[R, W]`; bit e % 32 of word e // 32: the group's outcome alone makes joint event e happen. Events
            with a weight come first, and among them, and among the others, those that happen soonest: a robot that is
            stopped early then reaches few words.
        count: E; weighted_words: leading words that hold events with a weight.
        visited_weight, survived_weight: int64 `[E]`, cells that are covered exactly if the event happens.
        own_visited, own_survived: int64 `[R]`, cells covered by the events of the row's group alone.
        matrix: int64 sparse `[rows of the tally, sources]`; rows: new_visited and new_survived `[T + 1]` each, visits,
            stops, covered_visited and covered_survived `[N]` each.
        steps, cells: T + 1 and N.
    """

    bits: NDArray[np.uint32]
    count: int
    weighted_words: int
    visited_weight: NDArray[np.int64]
    survived_weight: NDArray[np.int64]
    own_visited: NDArray[np.uint32]
    own_survived: NDArray[np.uint32]
    matrix: csr_array
    steps: int
    cells: int

    def tally_arrays(self, sources: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
        """The arrays by step and by cell of the tally, from the sources' counts."""
        values = self.matrix @ sources
        names = ("new_visited", "new_survived", "visits", "stops", "covered_visited", "covered_survived")
        ends = np.cumsum([self.steps] * 2 + [self.cells] * 4)
        return dict(zip(names, np.split(values, ends[:-1]), strict=True))


def source_counts(
    groups: Groups, row_counts: NDArray[np.int64], event_counts: NDArray[np.int64], rollouts: int
) -> NDArray[np.int64]:
    """The sources' counts from the rollouts in each row `[R]` and in each joint event `[E]`.

    Entry (a, b) of a group: rollouts - (rollouts with o_i < a and o_j < b): those in which `o_i >= a` or `o_j >= b`.
    """
    parts = []
    for group in range(groups.count):
        first, second = groups.sizes(group)
        start = groups.first_row[group]
        table = np.zeros((first + 1, second + 1), dtype=np.int64)
        table[1:, 1:] = row_counts[start : start + first * second].reshape(first, second).cumsum(0).cumsum(1)
        parts.append((rollouts - table).reshape(-1))
    return np.concatenate([*parts, event_counts])


def collect_events(entries: Entries, groups: Groups, cells: int, last_step: int) -> Events:
    """All events of a plan under these groups. Cost: O(first entries), once per coverage meaning."""
    book = _Book(groups)
    steps = last_step + 1
    visits_at, stops_at = 2 * steps, 2 * steps + cells
    book.count_entries(entries, visits_at, stops_at)
    visited, survived = Counter[int](), Counter[int]()
    for cell, visitors in _visitors(entries, groups, survive=False):
        visited[book.follow(visitors, 0, stops_at + cells + cell)] += 1
    for cell, visitors in _visitors(entries, groups, survive=True):
        survived[book.follow(visitors, steps, stops_at + 2 * cells + cell)] += 1
    joint = book.sort_joint(lambda source: visited[source] + survived[source] > 0)
    weights = [
        np.array([counter[source] for source in joint], dtype=np.int64).reshape(len(joint))
        for counter in (visited, survived)
    ]
    return Events(
        bits=_pack([book.joint[source - book.local_count] for source in joint], groups),
        count=len(joint),
        weighted_words=-(-int(((weights[0] + weights[1]) > 0).sum()) // WORD_BITS),
        visited_weight=weights[0],
        survived_weight=weights[1],
        own_visited=_own_cells(visited, groups),
        own_survived=_own_cells(survived, groups),
        matrix=book.matrix(2 * steps + 4 * cells),
        steps=steps,
        cells=cells,
    )


def _visitors(entries: Entries, groups: Groups, survive: bool) -> Iterator[tuple[int, list[Visitor]]]:
    """Each cell with its possible visitors in order of (step, robot), up to the first certain one."""
    depth = groups.size[groups.slot_of] - 1
    need = entries.passed + (entries.dangerous if survive else 0)
    kept = np.flatnonzero(entries.first & (need <= depth[entries.robot]))
    order = kept[np.lexsort((entries.robot[kept], entries.step[kept], entries.cell[kept]))]
    columns = (entries.step[order].tolist(), entries.robot[order].tolist(), need[order].tolist())
    visitors = list(zip(*columns, strict=True))
    cells, starts = np.unique(entries.cell[order], return_index=True)
    for cell, start, stop in zip(cells.tolist(), starts.tolist(), [*starts[1:].tolist(), len(order)], strict=True):
        mine = visitors[start:stop]
        certain = next((place for place, (_, _, needed) in enumerate(mine) if needed == 0), len(mine))
        yield cell, mine[: certain + 1]


class _Book:
    """Gives every distinct event its source number, and collects the entries of the tally's matrix."""

    def __init__(self, groups: Groups) -> None:
        self.groups = groups
        self.joint: list[dict[int, int]] = []
        self._joint_number: dict[frozenset[tuple[int, int]], int] = {}
        shapes = [groups.sizes(g) for g in range(groups.count)]
        self._first_local = np.cumsum([0] + [(a + 1) * (b + 1) for a, b in shapes]).tolist()
        self.local_count = self._first_local[-1]
        self._slot = groups.slot_of.tolist()
        self._rows: list[int] = []
        self._sources: list[int] = []
        self._signs: list[int] = []
        self._bit_of = np.zeros(0, dtype=np.int64)

    def local(self, needs: dict[int, int]) -> int | None:
        """The source of an event of robots `needs` (robot -> requirement) of one group; None if of several groups."""
        members = self.groups.members
        group = self._slot[next(iter(needs))] // members
        first, second = self.groups.sizes(group)
        never = [first, second]
        for robot, need in needs.items():
            slot = self._slot[robot]
            if slot // members != group:
                return None
            never[slot % members] = need
        return self._first_local[group] + never[0] * (second + 1) + never[1]

    def source(self, needs: dict[int, int]) -> int:
        """The source number of an event."""
        local = self.local(needs)
        if local is not None:
            return local
        name = frozenset(needs.items())
        if name not in self._joint_number:
            self._joint_number[name] = len(self.joint)
            self.joint.append(dict(needs))
        return self.local_count + self._joint_number[name]

    def follow(self, visitors: list[Visitor], first_step_row: int, covered_row: int) -> int:
        """Enter one cell: new at each visitor's step, covered at the end. Returns the source of its coverage."""
        needs: dict[int, int] = {}
        before = -1
        for place, (step, robot, need) in enumerate(visitors):
            if need == 0:
                needs = {robot: 0}  # certain from here on, whoever else came before
            else:
                needs[robot] = need
            # Who comes in the same step counts together: the cell is new in that step once.
            if place + 1 < len(visitors) and visitors[place + 1][0] == step:
                continue
            now = self.source(needs)
            self._add(first_step_row + step, now, 1)
            if before >= 0:
                self._add(first_step_row + step, before, -1)
            before = now
        self._add(covered_row, before, 1)
        return before

    def count_entries(self, entries: Entries, visits_row: int, stops_row: int) -> None:
        """Enter the visits and stops of every cell."""
        depth = (self.groups.size[self.groups.slot_of] - 1).tolist()
        columns = (entries.robot.tolist(), entries.cell.tolist(), entries.passed.tolist(), entries.dangerous.tolist())
        for robot, cell, passed, dangerous in zip(*columns, strict=True):
            if passed > depth[robot]:
                continue
            made = self.source({robot: passed})
            self._add(visits_row + cell, made, 1)
            if dangerous:
                self._add(stops_row + cell, made, 1)
                if passed < depth[robot]:
                    self._add(stops_row + cell, self.source({robot: passed + 1}), -1)

    def sort_joint(self, has_weight: Callable[[int], bool]) -> list[int]:
        """The joint events' sources in the order of their bits: those with a weight first, by least requirement."""
        first = self.local_count

        def order(source: int) -> tuple[bool, int]:
            return (not has_weight(source), min(self.joint[source - first].values()))

        joint = sorted(range(first, first + len(self.joint)), key=order)
        self._bit_of = np.empty(len(joint), dtype=np.int64)
        self._bit_of[np.array(joint, dtype=np.int64) - first] = np.arange(len(joint))
        return joint

    def matrix(self, rows: int) -> csr_array:
        """What was collected, int64 `[rows, sources]`, joint events in the order of `sort_joint`."""
        values, sources = np.array(self._signs, dtype=np.int64), np.array(self._sources, dtype=np.int64)
        joint = sources >= self.local_count
        sources[joint] = self.local_count + self._bit_of[sources[joint] - self.local_count]
        shape = (rows, self.local_count + len(self.joint))
        return csr_array((values, (np.array(self._rows), sources)), shape=shape, dtype=np.int64)

    def _add(self, row: int, source: int, sign: int) -> None:
        self._rows.append(row)
        self._sources.append(source)
        self._signs.append(sign)


def _own_cells(weights: Counter[int], groups: Groups) -> NDArray[np.uint32]:
    """Cells covered by a group's own events in each of its rows, uint32 `[R]`; `weights`: cells by source."""
    parts, start = [], 0
    for group in range(groups.count):
        first, second = groups.sizes(group)
        size = (first + 1) * (second + 1)
        table = np.array([weights[start + place] for place in range(size)], dtype=np.int64).reshape(first + 1, -1)
        beyond = table[::-1, ::-1].cumsum(0).cumsum(1)[::-1, ::-1]  # cells with both requirements at least (a, b)
        parts.append((table.sum() - beyond[1:, 1:]).reshape(-1))
        start += size
    return np.concatenate(parts).astype(np.uint32)


def _pack(joint: list[dict[int, int]], groups: Groups) -> NDArray[np.uint32]:
    """The bits of every row, uint32 `[R, W]`."""
    words = -(-len(joint) // WORD_BITS)
    by_robot = [np.zeros((size, words), dtype=np.uint32) for size in groups.size[groups.slot_of].tolist()]
    for event, needs in enumerate(joint):
        for robot, need in needs.items():
            by_robot[robot][need, event // WORD_BITS] |= np.uint32(1 << event % WORD_BITS)
    reached = [np.bitwise_or.accumulate(table, axis=0) for table in by_robot]
    return groups.rows(reached, np.bitwise_or)
