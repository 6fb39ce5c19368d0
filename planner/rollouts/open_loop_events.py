"""Traces of the open loop, and events of first coverage: event counts give the tally's arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from planner.failure_model import FailureModel
from planner.plan.plan import Plan, RobotPlan, last_move
from planner.rollout_sampling import LossDraws
from planner.simulator.codes import NO_AREA, NO_ROBOT, Doing, EventKind, Outcome
from planner.simulator.thresholds import threefry2x32
from planner.tally import Trace
from planner.world.uncertain_maps import Draws
from planner.world.world import World

# The open loop as a trace: every robot follows its nominal path until it is lost.
#
# Traces agree with the counts of the open-loop engines for the same seed and rollout. Axis letters: `K` robots, `T` =
# time + 1 steps.


def open_loop_trace(plan: Plan, world: World, seed: int, rollout: int) -> Trace:
    """The trace of one open-loop rollout.

    Nothing is reallocated: a lost robot's area stays its own. ALLOCATED events mark the steps at which a robot goes on
    to the next area of its plan. The areas are those at the end of the nominal run; an external plan has none.

    Args:
        plan: for this world.
        world: the map.
        seed: of the random numbers.
        rollout: id.
    """
    stops = _stops(plan, LossDraws(world, seed, rollout, plan.failure_model))
    ends = [last_move(robot.path) if stop is None else stop for robot, stop in zip(plan.robots, stops, strict=True)]
    time = max(ends)
    area_of = _area_of(plan, world)
    columns = [_column(robot, stop, time, area_of) for robot, stop in zip(plan.robots, stops, strict=True)]
    cells, doing, areas = (np.stack(values, axis=1) for values in zip(*columns, strict=True))
    events, missing = _events(plan, stops, cells, area_of, int(world.accessible(plan.starts).sum()))
    alive = any(stop is None for stop in stops)
    outcome = Outcome.COMPLETE if missing == 0 else Outcome.END_OF_PATHS if alive else Outcome.ALL_ROBOTS_LOST
    return Trace(
        rollout=rollout,
        cells=cells.astype(np.int32),
        doing=doing.astype(np.int8),
        areas=areas.astype(np.int32),
        events=np.array(events, dtype=np.int32).reshape(-1, 5),
        area_of=area_of,
        outcome=outcome,
    )


def _stops(plan: Plan, draws: LossDraws) -> list[int | None]:
    """The step at which each robot is lost, or None; evaluated in the order in which robots move."""
    stops: list[int | None] = [None] * len(plan.robots)
    moves = [(step, number) for number, robot in enumerate(plan.robots) for step in robot.entered.tolist()]
    for step, number in sorted(moves):
        if stops[number] is None and draws.hits(number, step, int(plan.robots[number].path[step])):
            stops[number] = step
    return stops


def _area_of(plan: Plan, world: World) -> NDArray[np.int32]:
    """int32 `[N]`, the area of each cell at the end of the nominal run."""
    area_of = np.full(world.threat.size, NO_AREA, dtype=np.int32)
    for number, area in enumerate(plan.areas + plan.areas_added):
        area_of[area.cells] = number
    return area_of


def _column(
    robot: RobotPlan, stop: int | None, time: int, area_of: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """(cell, doing, area) `[T]` of one robot; its activity is that of its next move."""
    path = robot.path[: time + 1]
    cells = np.pad(path, (0, time + 1 - len(path)), mode="edge")
    doing = np.full(time + 1, Doing.DONE, dtype=np.int64)
    areas = np.full(time + 1, NO_AREA, dtype=np.int64)
    first = min((leg.start for leg in robot.legs), default=1)
    doing[: max(first - 1, 0)] = Doing.IDLE
    for leg in robot.legs:
        now = slice(max(leg.start - 1, 0), max(min(leg.stop - 1, time + 1), 0))
        areas[now] = leg.area
        doing[now] = Doing.TRAVELING if leg.kind == "travel" else Doing.COVERING
        if leg.kind == "cover" and 1 <= leg.start <= time + 1 and area_of[cells[leg.start - 1]] != leg.area:
            doing[leg.start - 1] = Doing.TRAVELING  # the move that enters the area
    if not robot.legs:
        doing[: last_move(robot.path)] = Doing.TRAVELING
    if stop is not None:
        cells[stop:], doing[stop:], areas[stop:] = robot.path[stop], Doing.DEAD, NO_AREA
    return cells, doing, areas


def _events(
    plan: Plan, stops: list[int | None], cells: NDArray[np.int64], area_of: NDArray[np.int32], accessible: int
) -> tuple[list[tuple[int, int, int, int, int]], int]:
    """The rows of `Trace.events`, and the number of accessible cells not visited at the end."""
    left = np.bincount(area_of[area_of >= 0], minlength=len(plan.areas) + len(plan.areas_added))
    visited = np.zeros(len(area_of), dtype=np.bool_)
    turns = [_turns(robot) for robot in plan.robots]
    current = [_first_area(plan, number) for number in range(len(plan.robots))]
    moves = np.ones(cells.shape, dtype=np.bool_)
    moves[1:] = cells[1:] != cells[:-1]
    events: list[tuple[int, int, int, int, int]] = []
    for step in range(len(cells)):
        for robot, stop in enumerate(stops):
            if stop is not None and step > stop:
                continue
            cell = int(cells[step, robot])
            if moves[step, robot] and not visited[cell]:
                visited[cell] = True
                area = int(area_of[cell])
                if area != NO_AREA:
                    left[area] -= 1
                    if left[area] == 0:
                        events.append((step, robot, EventKind.COMPLETED, area, cell))
            if step == stop:
                events.append((step, robot, EventKind.HIT, current[robot], cell))
            elif step in turns[robot]:
                area, target = turns[robot][step]
                current[robot] = area
                events.append((step, robot, EventKind.ALLOCATED, area, target))
    return events, accessible - int(visited.sum())


def _turns(robot: RobotPlan) -> dict[int, tuple[int, int]]:
    """Steps at which the robot goes on to an area: step -> (area, cell where it begins there); its first excluded."""
    turns: dict[int, tuple[int, int]] = {}
    area = None
    for place, leg in enumerate(robot.legs):
        if leg.area != area and leg.start > 0:
            into = next(
                (later for later in robot.legs[place:] if later.area == leg.area and later.kind == "cover"), leg
            )
            turns[leg.start - 1] = (leg.area, int(robot.path[into.start]))
        area = leg.area
    return turns


def _first_area(plan: Plan, number: int) -> int:
    """The area that the robot has at t = 0."""
    given = [index for index, area in enumerate(plan.areas) if area.robot == number and area.robot != NO_ROBOT]
    return given[0] if given else NO_AREA


# All entries of the nominal paths, as columns.


@dataclass(frozen=True, eq=False)
class Entries:
    """Every entry of a cell on the nominal paths, robot by robot in order of time; start cells included.

    Attributes:
        robot, step, cell: int64 `[entries]`.
        passed: int64 `[entries]`, dangerous entries of that robot before this one: it is made iff outcome >= passed.
        dangerous: bool `[entries]`, whether the cell can destroy the robot.
        first: bool `[entries]`, whether it is the robot's first entry of the cell.
    """

    robot: NDArray[np.int64]
    step: NDArray[np.int64]
    cell: NDArray[np.int64]
    passed: NDArray[np.int64]
    dangerous: NDArray[np.bool_]
    first: NDArray[np.bool_]


# Groups of one or two robots: the outcomes of a group are numbered, and this number indexes all tables.

MOST_PAIR_ROWS = 2**14
"""Robots are paired if all pairs together have at most so many rows: their tables then fit into a core's cache."""


@dataclass(frozen=True, eq=False)
class Groups:
    """The robots of each group and the numbering of its outcomes.

    A group of robots i, j with outcomes o_i, o_j is in row `first_row + o_i * stride + o_j`, stride = outcomes of j.

    Attributes:
        slot_robot: int64 `[S]`, S = G * A: the robot in each slot, NO_ROBOT (outcome always 0) in the last if K is odd.
        size: int64 `[S]`, outcomes of each slot: 1 + the most dangerous entries that it can pass.
        members: A, robots a group, 1 or 2.
        first_row: int64 `[G]`; rows of a group are consecutive.
        row_count: R.
    """

    slot_robot: NDArray[np.int64]
    size: NDArray[np.int64]
    members: int
    first_row: NDArray[np.int64]
    row_count: int

    @property
    def count(self) -> int:
        """G."""
        return len(self.first_row)

    @property
    def stride(self) -> NDArray[np.int64]:
        """int64 `[G, A]`: rows from one outcome of the slot to its next."""
        sizes = self.size.reshape(-1, self.members)
        return np.concatenate([sizes[:, 1:], np.ones((self.count, 1), np.int64)], axis=1)

    @property
    def slot_of(self) -> NDArray[np.int64]:
        """int64 `[K]`: each robot's slot."""
        slots = np.flatnonzero(self.slot_robot >= 0)
        found = np.empty(len(slots), dtype=np.int64)
        found[self.slot_robot[slots]] = slots
        return found

    def sizes(self, group: int) -> tuple[int, int]:
        """Outcomes of the group's two robots (1 for a missing second one)."""
        mine = self.size[group * self.members : (group + 1) * self.members].tolist()
        return (mine[0], mine[1]) if self.members == 2 else (mine[0], 1)

    def rows(self, by_outcome: Sequence[NDArray], combine: Callable[[NDArray, NDArray], NDArray]) -> NDArray[np.uint32]:
        """A table by row from tables by robot.

        Args:
            by_outcome: `[outcomes, ...]` for each robot.
            combine: a ufunc with identity 0.

        Returns:
            uint32 `[R, ...]`.
        """
        parts = []
        for group in range(self.count):
            pair = [
                by_outcome[robot] if robot >= 0 else np.zeros_like(by_outcome[0][:1])
                for robot in self.slot_robot[group * self.members : (group + 1) * self.members]
            ]
            table = pair[0] if self.members == 1 else combine(pair[0][:, None], pair[1][None, :])
            parts.append(table.reshape(int(np.prod(self.sizes(group))), *by_outcome[0].shape[1:]))
        return np.concatenate(parts).astype(np.uint32)


def make_groups(depth: NDArray[np.int64], most_pair_rows: int = MOST_PAIR_ROWS) -> Groups:
    """Pair the robot of most outcomes with that of fewest if the rows are few enough; else single robots.

    Args:
        depth: int64 `[K]`, the most dangerous entries that each robot can survive.
        most_pair_rows: see MOST_PAIR_ROWS.
    """
    # Most with fewest keeps the products small, which are the numbers of rows.
    order = np.argsort(-depth, kind="stable").astype(np.int64)
    if len(order) % 2:
        order = np.append(order, NO_ROBOT)
    half = len(order) // 2
    slots = np.stack([order[:half], order[half:][::-1]], axis=1).reshape(-1)
    size, members = np.where(slots >= 0, depth[slots] + 1, 1), 2
    rows = size.reshape(-1, 2).prod(axis=1)
    if len(depth) == 1 or rows.sum() > most_pair_rows:
        slots, size, rows, members = np.arange(len(depth), dtype=np.int64), depth + 1, depth + 1, 1
    return Groups(slots, size, members, np.cumsum(rows) - rows, int(rows.sum()))


# First coverage: the events of shared cells, and the tally's arrays from event counts.
#
# An event is a set of (robot, requirement) pairs: it happens in a rollout iff some robot's outcome reaches its
# requirement. "Cell c is covered by its first m visitors" is an event; its count over rollouts gives coverage (m = all
# visitors) and new cells per step (count for m visitors minus count for m - 1), as integers. Omitted: visitors after a
# certain one (requirement 0), and requirements that no outcome reaches. Equal events of several cells are one event
# with a weight.

WORD_BITS = 32


@dataclass(frozen=True, eq=False)
class Events:
    """The joint events, and the linear map from counts to the tally's arrays.

    *Sources* are counts over a set of rollouts: first, group by group, how often `o_i < a and o_j < b` did not happen,
    `[size_i + 1, size_j + 1]` per group (see `source_counts`), then how often each joint event happened.

    Attributes:
        bits: uint32 `[R, W]`; bit e % 32 of word e // 32: the group's outcome makes joint event e happen. Events with a
            weight come first; both kinds are ordered by their least requirement, so that a robot lost early sets bits
            in few words.
        count: E. weighted_words: leading words that hold events with a weight.
        visited_weight, survived_weight: int64 `[E]`, cells that are covered exactly if the event happens.
        own_visited, own_survived: uint32 `[R]`, cells covered by events of the row's group.
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
        """The arrays by step and by cell of the tally, from the counts `[sources]`."""
        values = self.matrix @ sources
        names = ("new_visited", "new_survived", "visits", "stops", "covered_visited", "covered_survived")
        ends = np.cumsum([self.steps] * 2 + [self.cells] * 4)
        return dict(zip(names, np.split(values, ends[:-1]), strict=True))


def source_counts(
    groups: Groups, row_counts: NDArray[np.int64], event_counts: NDArray[np.int64], rollouts: int
) -> NDArray[np.int64]:
    """Counts of the sources.

    Entry (a, b) of a group counts the rollouts in which `o_i >= a` or `o_j >= b`.

    Args:
        groups: of the robots.
        row_counts: int64 `[R]`, rollouts by outcome of each group.
        event_counts: int64 `[E]`, rollouts by joint event.
        rollouts: their number.

    Returns:
        int64 `[sources]`.
    """
    parts = []
    for group in range(groups.count):
        first, second = groups.sizes(group)
        start = groups.first_row[group]
        table = np.zeros((first + 1, second + 1), dtype=np.int64)
        table[1:, 1:] = row_counts[start : start + first * second].reshape(first, second).cumsum(0).cumsum(1)
        parts.append((rollouts - table).reshape(-1))
    return np.concatenate([*parts, event_counts])


class _Local(NamedTuple):
    """Sources of one group's events: linear in the requirements of its robots, of which `size` is never reached.

    Attributes:
        group, size, stride: int64 `[K]`, of each robot. never: int64 `[G]`, source of the event that never happens.
        sources: their number.
    """

    group: NDArray[np.int64]
    size: NDArray[np.int64]
    stride: NDArray[np.int64]
    never: NDArray[np.int64]
    sources: int

    @classmethod
    def of(cls, groups: Groups) -> _Local:
        """The sources of all groups, one after the other."""
        pairs = np.array([groups.sizes(group) for group in range(groups.count)])
        tables = (pairs + 1).prod(axis=1)
        strides = np.stack([pairs[:, 1] + 1, np.ones_like(pairs[:, 0])], axis=1)
        never, slot = np.cumsum(tables) - tables + (pairs * strides).sum(axis=1), groups.slot_of
        stride = strides[:, : groups.members].ravel()[slot]
        return cls(slot // groups.members, groups.size[slot], stride, never, int(tables.sum()))

    def change(self, robot: NDArray[np.int64], need: NDArray[np.int64]) -> NDArray[np.int64]:
        """What the robot's requirement adds to `never` of its group."""
        return (need - self.size[robot]) * self.stride[robot]


class _Visitors(NamedTuple):
    """Visitors cell by cell in order of time. The event of each: it, or one before it, covers the cell.

    Cells `[N ..]` and steps `[T + 1 ..]` are those of survived coverage.

    Attributes:
        cell, step, robot, need: int64 `[P]`, a robot's first entry of a cell, and the least outcome that makes it.
        start: int64 `[P]`, where the visitors of the cell begin; after a certain one (need 0) there is none.
    """

    cell: NDArray[np.int64]
    step: NDArray[np.int64]
    robot: NDArray[np.int64]
    need: NDArray[np.int64]
    start: NDArray[np.int64]

    @classmethod
    def of(cls, entries: Entries, size: NDArray[np.int64], cells: int, steps: int) -> _Visitors:
        """The visitors that can reach each cell; `size`: outcomes of each robot."""
        first = np.flatnonzero(entries.first)
        survived = np.repeat([0, 1], len(first))
        cell, step, robot, passed, dangerous = (
            np.tile(of[first], 2)
            for of in (entries.cell, entries.step, entries.robot, entries.passed, entries.dangerous)
        )
        need, cell, step = passed + dangerous * survived, cell + cells * survived, step + steps * survived
        kept = np.flatnonzero(need < size[robot])
        kept = kept[np.lexsort((robot[kept], step[kept], cell[kept]))]
        certain = np.cumsum(need[kept] == 0) - (need[kept] == 0)
        kept = kept[certain == certain[np.searchsorted(cell[kept], cell[kept])]]
        return cls(cell[kept], step[kept], robot[kept], need[kept], np.searchsorted(cell[kept], cell[kept]))

    def running(self, values: NDArray) -> NDArray:
        """Sums of `values` `[P]` over the event of each visitor: a certain visitor's event is its own alone."""
        total = np.cumsum(values)
        return np.where(self.need == 0, values, total - (total - values)[self.start])


def _terms(row: NDArray[np.int64], source: NDArray[np.int64], sign: int) -> NDArray[np.int64]:
    """Elements of `Events.matrix`, int64 `[3, n]`: row, source, value."""
    return np.stack([row, source, np.full(len(row), sign)])


def _entry_terms(entries: Entries, local: _Local, cells: int, row: int) -> list[NDArray[np.int64]]:
    """Visits of each cell, in rows from `row` on, and losses there: an entry is made, and the next outcome not."""
    terms, danger = [], entries.dangerous
    for first, later, sign, some in ((row, 0, 1, True), (row + cells, 0, 1, danger), (row + cells, 1, -1, danger)):
        made = some & (entries.passed + later < local.size[entries.robot])
        robot = entries.robot[made]
        source = local.never[local.group[robot]] + local.change(robot, entries.passed[made] + later)
        terms.append(_terms(first + entries.cell[made], source, sign))
    return terms


def collect_events(entries: Entries, groups: Groups, cells: int, last_step: int) -> Events:
    """Collect all events of a plan. Cost: O(first entries), once for each meaning of coverage.

    Args:
        entries: of the plan's paths.
        groups: of the robots.
        cells: N.
        last_step: T.
    """
    steps, local = last_step + 1, _Local.of(groups)
    terms = _entry_terms(entries, local, cells, 2 * steps)
    seen = _Visitors.of(entries, local.size, cells, steps)
    group = local.group[seen.robot]
    of_one = (seen.need == 0) | (seen.running((group != group[seen.start]).astype(np.int64)) == 0)
    event = local.never[group] + seen.running(local.change(seen.robot, seen.need))
    # Visitors of one step cover the cell together: the event of the last one counts.
    last = np.append((seen.cell[1:] != seen.cell[:-1]) | (seen.step[1:] != seen.step[:-1]), True)
    # The sum of random numbers of (robot, requirement) names a set of them: equal sets of several cells are one event.
    high, low = threefry2x32((0, 0), seen.robot, seen.need)
    name, joint = seen.running(high.astype(np.uint64) << np.uint64(32) | low), np.flatnonzero(last & ~of_one)
    _, first, number = np.unique(name[joint], return_index=True, return_inverse=True)
    event[joint] = local.sources + number
    event, cell, step = event[last], seen.cell[last], seen.step[last]
    final = np.append(np.diff(cell) > 0, True)
    follows = np.flatnonzero(~final[:-1]) + 1
    terms += [_terms(step, event, 1), _terms(step[follows], event[follows - 1], -1)]
    terms.append(_terms(2 * steps + 2 * cells + cell[final], event[final], 1))
    weights = [
        np.bincount(event[final & (cell // cells == meaning)], minlength=local.sources + len(first))
        for meaning in (0, 1)
    ]
    shown = [weight[local.sources :] for weight in weights]

    # The members of each joint event: its visitor, and those before it in the cell.
    place = joint[first]
    length = place + 1 - seen.start[place]
    member = np.repeat(place - np.cumsum(length) + 1, length) + np.arange(length.sum())
    owner = np.repeat(np.arange(len(place)), length)
    least = np.full(len(place), np.iinfo(np.int64).max)
    np.minimum.at(least, owner, seen.need[member])
    order = np.lexsort((least, shown[0] + shown[1] == 0))
    bit, (row, source, sign) = np.argsort(order), np.concatenate(terms, axis=1)
    source = np.append(np.arange(local.sources), local.sources + bit)[source]
    shape = (2 * steps + 4 * cells, local.sources + len(place))
    return Events(
        bits=_pack(seen.robot[member], seen.need[member], bit[owner], len(place), groups),
        count=len(place),
        weighted_words=-(-int(np.count_nonzero(shown[0] + shown[1])) // WORD_BITS),
        visited_weight=shown[0][order],
        survived_weight=shown[1][order],
        own_visited=_own_cells(weights[0], groups),
        own_survived=_own_cells(weights[1], groups),
        matrix=csr_array((sign, (row, source)), shape=shape, dtype=np.int64),
        steps=steps,
        cells=cells,
    )


def _own_cells(weights: NDArray[np.int64], groups: Groups) -> NDArray[np.uint32]:
    """Cells covered by a group's own events in each of its rows, uint32 `[R]`; `weights`: cells by source."""
    parts, start = [], 0
    for group in range(groups.count):
        first, second = groups.sizes(group)
        table = weights[start : start + (first + 1) * (second + 1)].reshape(first + 1, -1)
        beyond = table[::-1, ::-1].cumsum(0).cumsum(1)[::-1, ::-1]  # cells with both requirements at least (a, b)
        parts.append((table.sum() - beyond[1:, 1:]).reshape(-1))
        start += table.size
    return np.concatenate(parts).astype(np.uint32)


def _pack(
    robot: NDArray[np.int64], need: NDArray[np.int64], bit: NDArray[np.int64], count: int, groups: Groups
) -> NDArray[np.uint32]:
    """The bits of every row, uint32 `[R, W]`: outcomes of `robot` from `need` on set `bit`."""
    size = groups.size[groups.slot_of]
    table = np.zeros((int(size.sum()), -(-count // WORD_BITS)), dtype=np.uint32)
    outcome = (np.cumsum(size) - size)[robot] + need
    np.bitwise_or.at(table, (outcome, bit // WORD_BITS), np.uint32(1) << (bit % WORD_BITS).astype(np.uint32))
    reached = [np.bitwise_or.accumulate(one, axis=0) for one in np.split(table, np.cumsum(size)[:-1])]
    return groups.rows(reached, np.bitwise_or)


# From a random word to a robot's outcome: the number of its thresholds above the word, exactly, in one read.
#
# The thresholds fall roughly geometrically, so words are put into buckets like floating-point numbers: by the position
# of the leading 1 and the bits after it. A table holds the least outcome of each bucket and, nearly always, the one
# threshold inside it; if buckets hold more, a branchless bisection follows. All comparisons are between integers.

WORD = 2**32
MANTISSA_CHOICES = (6, 8)
"""Bits after the leading 1 that a bucket may depend on; 33 * 2**bits buckets per slot."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Inverse survival of all slots. With m = mantissa, lz = leading zeros of `x | 1`, and normal = x << lz:

        bucket = (normal >> (31 - m)) + ((31 - lz) << m)
        no bisections:  o = (table >> (31 - m)) + ((normal mod 2**(31 - m)) < (table mod 2**(31 - m)))
        else:  o = table;  for half in (2**(bisections - 1), ..., 2, 1):  if x < threshold[o + half]:  o += half

    Attributes:
        mantissa: m.
        bisections: 0 if no bucket holds two thresholds.
        table: uint32 `[S, buckets]`: the outcome of the bucket's largest word; without bisections above the low 31 - m
            bits of the threshold inside the bucket (0: none, no word is below).
        threshold: uint32 `[S, D + 2**bisections]`: entry o is T[o - 1], to be passed for outcome o; entry 0 and those
            after the last are 0, which no word is below.
    """

    mantissa: int
    bisections: int
    table: NDArray[np.uint32]
    threshold: NDArray[np.uint32]


def make_guide(thresholds: Sequence[NDArray[np.uint64]]) -> Guide:
    """Make the guide.

    Args:
        thresholds: for each slot uint64 `[D]`, non-increasing, at most 2**32.
    """
    longest = max(len(above) for above in thresholds)
    for mantissa in MANTISSA_CHOICES:
        lowest, highest = bucket_ranges(mantissa)
        least = _outcomes(thresholds, highest)
        inside = int((_outcomes(thresholds, lowest) - least).max(initial=0))
        if inside <= 1 and longest < 2 ** (mantissa + 1):
            low = _inside_bits(thresholds, least, lowest, highest, mantissa)
            return Guide(mantissa, 0, least << np.uint32(31 - mantissa) | low, np.zeros((len(least), 1), np.uint32))
    bisections = max(inside, 1).bit_length()
    table = np.zeros((len(thresholds), longest + 1 + 2**bisections), dtype=np.uint32)
    for slot, above in enumerate(thresholds):
        table[slot, 1 : len(above) + 1] = np.minimum(above, WORD - 1)  # 2**32 is never compared: `least` is past it
    return Guide(mantissa, bisections, least, table)


def bucket_ranges(mantissa: int) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Smallest and largest word of every bucket, uint64 `[buckets]`; 0, 0 for a bucket without words."""
    count = 2**mantissa
    lowest, highest = np.zeros(33 * count, dtype=np.uint64), np.zeros(33 * count, dtype=np.uint64)
    for octave in range(32):  # words 2**octave .. 2**(octave + 1) - 1
        leading = np.arange(count, 2 * count, dtype=np.uint64)
        if octave >= mantissa:
            first = leading << np.uint64(octave - mantissa)
            last = first + np.uint64(2 ** (octave - mantissa) - 1)
        else:
            whole = leading % np.uint64(2 ** (mantissa - octave)) == 0
            first = last = np.where(whole, leading >> np.uint64(mantissa - octave), np.uint64(0))
        place = slice((octave + 1) * count, (octave + 2) * count)
        lowest[place], highest[place] = first, last
    return lowest, highest


def _outcomes(thresholds: Sequence[NDArray[np.uint64]], words: NDArray[np.uint64]) -> NDArray[np.uint32]:
    """uint32 `[S, words]`: number of thresholds of each slot above each word."""
    falling = [-above.astype(np.int64) for above in thresholds]
    return np.stack([np.searchsorted(above, -words.astype(np.int64), "left") for above in falling]).astype(np.uint32)


def _inside_bits(
    thresholds: Sequence[NDArray[np.uint64]],
    least: NDArray[np.uint32],
    lowest: NDArray[np.uint64],
    highest: NDArray[np.uint64],
    mantissa: int,
) -> NDArray[np.uint32]:
    """Low bits of the threshold inside each bucket, shifted as words are; 0 if there is none."""
    octave = np.maximum(np.arange(len(lowest)) // 2**mantissa - 1, 0).astype(np.uint64)
    low = np.zeros_like(least)
    for slot, above in enumerate(thresholds):
        # The next threshold below the bucket's largest word; if there is none 0, which no word is below.
        following = np.append(above, np.uint64(0))[least[slot]]
        inside = (lowest < following) & (following <= highest)
        normal = (following << (np.uint64(31) - octave)) % np.uint64(2 ** (31 - mantissa))
        low[slot] = np.where(inside, normal, np.uint64(0)).astype(np.uint32)
    return low


# Draws of an uncertain map: the dangerous entries of all robots in the order in which they are made.
#
# If hazards may exist or not, or the map is one of several (`planner.world.uncertain_maps`), the robots of a rollout
# are not independent, so there is no inverse survival; and a hazard may be spent after the first loss. NumPy only.

Exposures = tuple[NDArray[np.int64], NDArray[np.int64]]
"""`planner.world.world.World.exposures`."""


class JointDraws(NamedTuple):
    """Dangerous entries of all robots by (step, robot). Axis `E`; the others as in
    `planner.world.uncertain_maps.Draws`.

    Attributes:
        slot: int32 `[E]`, the robot's slot. place: int32 `[E]`, number of its dangerous entries before.
        own_counter, there, column: `[E]`, of the cell. spot: int32 `[E]`, index of the cell among those entered.
        exposure: int64 `[E]`, hazard of the visit. doses: int64 `[M, C]`, if the map is one of several.
        robot: uint32 `[S]`, robot of each slot.
        nodes, times: the failure model (`planner.failure_model`): `weibull_nodes`, and int64 `[S]`, hazard multipliers.
        last: int32 `[S]`, the outcome of a slot whose robot survives.
        spots: number of cells that may become harmless in a rollout, 0 unless the first loss has that effect.
    """

    slot: NDArray[np.int32]
    place: NDArray[np.int32]
    own_counter: NDArray[np.uint32]
    there: NDArray[np.uint32]
    column: NDArray[np.int32]
    spot: NDArray[np.int32]
    exposure: NDArray[np.int64]
    doses: NDArray[np.int64]
    robot: NDArray[np.uint32]
    nodes: NDArray[np.int64]
    times: NDArray[np.int64]
    last: NDArray[np.int32]
    spots: int


def joint_draws(
    draws: Draws, exposures: Exposures, entries: Entries, groups: Groups, failure_model: FailureModel
) -> JointDraws:
    """The draws of the dangerous entries.

    Args:
        draws: of the uncertain map.
        exposures: `World.exposures`.
        entries: of the plan's paths, with cells of each phase.
        groups: of the robots.
        bearing: the failure model.
    """
    exposure, doses = exposures
    robot, step, cell = (one[entries.dangerous] for one in (entries.robot, entries.step, entries.cell))
    slot_of = groups.slot_of
    many = np.bincount(robot, minlength=len(slot_of))
    place = np.arange(len(robot)) - np.repeat(np.cumsum(many) - many, many)
    last = np.zeros(len(groups.slot_robot), dtype=np.int32)
    last[slot_of] = many
    order = np.lexsort((robot, step))
    robot, step, cell = robot[order], step[order], cell[order]
    entered, spot = np.unique(cell, return_inverse=True)
    return JointDraws(
        slot=slot_of[robot].astype(np.int32),
        place=place[order].astype(np.int32),
        own_counter=draws.counter[cell],
        there=draws.there[cell],
        column=draws.column[cell],
        spot=spot.astype(np.int32),
        exposure=exposure[cell],
        doses=doses,
        robot=np.maximum(groups.slot_robot, 0).astype(np.uint32),
        nodes=failure_model.nodes,
        times=failure_model.times(len(slot_of))[np.maximum(groups.slot_robot, 0)],
        last=last,
        spots=len(entered) if draws.spends else 0,
    )
