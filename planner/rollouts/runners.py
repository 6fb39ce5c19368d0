"""Closed-loop rollouts on several threads, for `planner.rollouts.closed_loop`.

Few rollouts: threads share out their ids. Many rollouts: threads share out histories, for as many rollouts at a time
as they have room for. Each thread follows some of the ids until their first loss; groups with the same loss are joined;
and threads take these as tasks. Shared out by ids, each thread would run histories that the others run too. That costs
less than joining where rollouts do little but draw random words.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from planner.failure_model import own_key, threshold_key
from planner.rollout_sampling import MEETING_DRAW, MOVE_DRAW, rows_met
from planner.rollouts.loop import NO_COUNTS, ClosedLoop, typed, with_features
from planner.simulator.areas import Log, make_log
from planner.simulator.codes import NONE
from planner.simulator.jit import has_program
from planner.simulator.rollouts import run_group_tasks
from planner.simulator.state import (
    MOST_PASSES,
    SINGLES,
    Counts,
    How,
    Singles,
    State,
    Tables,
    Work,
    first_room,
    largest_group,
    make_counts,
    make_state,
    make_work,
)
from planner.simulator.thresholds import LEAST
from planner.world.map_knowledge import READING_DRAW
from planner.world.uncertain_maps import Uncertain

LARGEST_GROUP = 2**20
"""Rollouts that a thread takes at a time, of 8 bytes each, 12 where histories are shared out: more are no faster."""
MOST_KEPT = 2**16
"""The same with thresholds kept, 8 bytes more for each robot, or positions of threats, 8 bytes for each."""
LEAST_SHARED, MOST_DEFERRED = 2**13, 2**8
"""Rollouts per thread from which on histories are shared out, and the most groups that each thread then defers."""
LEAST_WORK = 2**17
"""Rollouts times cells below which a second thread, with 0.4 ms to start and end, does not pay."""
TRIALS = 4
"""Rounds in which histories and ids are shared out by turns, before the faster way is kept."""
NO_LOG = make_log(0, 0, 0)
KNOWN: WeakKeyDictionary[ClosedLoop, list[Work]] = WeakKeyDictionary()
"""Scratch arrays of the loop that ran last: rows of costs and coverage paths of its map serve its next call."""
Tasks = tuple[NDArray[np.int64], NDArray[np.int64]]
"""`tasks` and `taken` of `planner.simulator.rollouts.run_group_tasks`."""


def run_rollouts(
    loop: ClosedLoop, seed: int, start: int, count: int, threads: int | None, singles: Singles
) -> list[Counts]:
    """Run rollouts `start .. start + count - 1` on `threads` threads (None: all cores); the counts of each thread."""

    def work(runner: Runner, first: int, stop: int) -> None:
        runner.run(first, stop, singles)

    known = KNOWN.pop(loop, [])
    runners = _in_rounds(loop, seed, start, count, threads, singles, known)
    if runners is None:
        most = MOST_KEPT if loop.keeps_apart else LARGEST_GROUP
        runners = on_threads(loop, seed, start, count, most, threads, work, known)
    KNOWN.clear()  # one loop only: its scratch may be a quarter of a gigabyte per thread
    # A state that grew can count longer paths than the first state of the next call.
    room = first_room(loop.tables)
    KNOWN[loop] = [runner.work for runner in runners if runner.room == room]
    return [runner.counts for runner in runners]


def singles_of(loop: ClosedLoop, start: int, count: int) -> Singles:
    """Empty results of `count` single rollouts from id `start` on."""
    weighed = 0 if loop.weights is None else count
    numbers, value_sums = np.zeros((count, SINGLES), dtype=np.int32), np.zeros((weighed, 2), dtype=np.int64)
    if loop.weights is None:
        return Singles(numbers, value_sums, NO_COUNTS, NO_COUNTS.reshape(0, MOST_PASSES + 1), start)
    return Singles(numbers, value_sums, loop.weights.covered, loop.weights.found, start)


def on_threads(
    loop: ClosedLoop, seed: int, start: int, count: int, most: int, threads: int | None,
    work: Callable[[Runner, int, int], None], known: list[Work] | None = None,
) -> list[Runner]:  # fmt: skip
    """Call `work(runner, first, stop)` for ranges of ids, on several threads.

    Args:
        loop, seed: of the rollouts.
        start, count: the ids.
        most: ids per range, at most.
        threads: None: all cores.
        work: runs a range.
        known: scratch of earlier calls, which is used up.

    Returns:
        The runners, one per thread.
    """
    workers = _workers(loop, threads, count)
    most = max(1, min(most, -(-count // workers)))
    waiting = iter(range(start, start + count, most))

    def take(_: int) -> Runner:
        runner = Runner(loop, seed, most, known)
        for first in waiting:  # the iterator is shared: each range goes to one thread
            work(runner, first, min(first + most, start + count))
        return runner

    if workers == 1:
        return [take(0)]
    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(take, range(workers)))


def _workers(loop: ClosedLoop, threads: int | None, count: int) -> int:
    """Threads that `count` rollouts keep busy, at most `threads`; None: all cores where that pays."""
    usual = (os.cpu_count() or 1) if count * len(loop.cells) >= LEAST_WORK else 1
    return min(threads or usual, max(count, 1))


def _in_rounds(
    loop: ClosedLoop, seed: int, start: int, count: int, threads: int | None, singles: Singles, known: list[Work]
) -> list[Runner] | None:
    """Run rounds of rollouts, sharing out histories, or ids where that has proved faster.

    None if there are few rollouts, or no room for histories or areas.
    """
    workers = _workers(loop, threads, count)
    rounds = max(1, -(-count // (workers * LARGEST_GROUP)))
    most = -(-count // (workers * rounds))
    # State kept by rollout cannot be joined with that of other threads.
    if workers == 1 or most < LEAST_SHARED or loop.keeps_apart or loop.uncertainty is not None:
        return None
    runners = [Runner(loop, seed, most, known) for _ in range(workers)]
    waiting = runners[0].make_levels((MOST_DEFERRED + 1) * workers)
    if len(waiting.marks) < 2 * workers:
        return None
    with ThreadPoolExecutor(max_workers=workers) as pool:
        team = _Team(pool, runners, waiting, np.empty((2, workers * most), dtype=np.uint32), singles)
        ways, took = (team.by_histories, team.by_ids), [0.0, 0.0]
        for number, first in enumerate(range(start, start + count, workers * most)):
            # Which is faster depends on the map and the machine: try both, keep the faster; counts are the same.
            way, began = number % 2 if number < TRIALS else took.index(min(took)), time.perf_counter()
            if not ways[way](first, min(workers * most, start + count - first)):
                return None
            took[way] = time.perf_counter() - began
    return runners


@dataclass(frozen=True)
class _Team:
    """Threads that share out rollouts.

    Attributes:
        waiting: a stack with as many levels for each of them.
        ids: uint32 `[2, B]`, room for the ids of a round.
    """

    pool: ThreadPoolExecutor
    runners: list[Runner]
    waiting: State
    ids: NDArray[np.uint32]
    singles: Singles

    def by_ids(self, start: int, count: int) -> bool:
        """Run these rollouts, the same number on each thread; False if the area registry of a thread is full."""

        def run(runner: Runner, first: int) -> bool:
            return runner.fits(first, min(first + share, start + count), self.singles)

        share = -(-count // len(self.runners))
        return all(list(self.pool.map(run, self.runners, range(start, start + count, share))))

    def by_histories(self, start: int, count: int) -> bool:
        """The same, with the groups of all threads that have the same first loss joined."""
        ids, together = self.ids[:, :count]
        share, levels = -(-count // len(self.runners)), len(self.waiting.marks) // len(self.runners)
        self.waiting.marks["first"] = self.waiting.marks["last"] = 0

        def defer_groups(runner: Runner, number: int) -> bool:
            first, mine = number * share, slice(number * levels, (number + 1) * levels)
            some = ids[first : first + share]
            some[:] = np.arange(start + first, start + first + len(some), dtype=np.uint32)
            stack = State._make(row[mine] for row in self.waiting)
            used = runner.defer_groups(some, stack, self.singles)
            # Segments count from the thread's first id; joined, they count from the first id of the round.
            stack.marks["first"][: used + 1] += first
            stack.marks["last"][: used + 1] += first
            return used != NONE

        if not all(list(self.pool.map(defer_groups, self.runners, range(len(self.runners))))):
            return False
        self.waiting.robots["least_threshold"] = LEAST  # joined groups have rollouts of which threads know other bounds
        parts, tasks = join_groups(ids, self.waiting.marks, self.runners[0].largest_group)
        ends = np.cumsum([0, *map(len, parts)])
        cuts = np.searchsorted(ends, np.linspace(0, ends[-1], len(self.runners) + 1)).tolist()

        def copy(first: int, last: int) -> None:
            if last > first:
                np.concatenate(parts[first:last], out=together[ends[first] : ends[last]])

        def take(runner: Runner) -> bool:
            return runner.take(self.waiting, tasks, together, self.singles)

        list(self.pool.map(copy, cuts, cuts[1:]))
        share_cached_paths([runner.work for runner in self.runners])
        return all(list(self.pool.map(take, self.runners)))


def groups_at(begin: NDArray[np.int64], end: int, level: Any = 0) -> Tasks:
    """Groups of ids that begin at these places, the last one up to `end`, from these levels."""
    levels = np.broadcast_to(level, begin.shape)
    return np.column_stack([levels, begin, np.append(begin[1:], end)]), np.zeros(1, dtype=np.int64)


ONE = np.zeros(1, dtype=np.int64)
"""Begin of a group of all ids."""


def groups_by_map(ids: NDArray[np.uint32], uncertainty: Uncertain, seed: int) -> Tasks:
    """Sort the ids by their true map, in place; one group for each map, from the level of that index."""
    # Rollouts with different true maps are different runs from the first step on.
    truth = rows_met(uncertainty, seed, ids)[:, 0]
    order = np.argsort(truth, kind="stable")
    ids[:], found = ids[order], np.unique(truth)
    return groups_at(np.searchsorted(truth[order], found), len(ids), found)


def join_groups(ids: NDArray[np.uint32], marks: NDArray[np.void], most: int) -> tuple[list[NDArray[np.uint32]], Tasks]:
    """Join the deferred groups with the same history; one task for each, largest first, several beyond `most` rollouts.

    Before the first loss all rollouts are the same run: step, robot and verdict of the first loss determine the state.

    Args:
        ids: uint32 `[B]`.
        marks: GROUP `[L]` of the deferred states, with their segment of `ids`.
        most: rollouts of a task, at most.

    Returns:
        (segments of ids in the order of the tasks, tasks).
    """
    left = marks["last"] > marks["first"]
    words = ("first", "last", "step", "robot", "verdict")
    records = np.column_stack([np.flatnonzero(left), *(marks[left][word] for word in words)])
    sets: dict[tuple[int, ...], tuple[int, list[NDArray[np.uint32]]]] = {}
    for row, first, last, *which in records.tolist():
        sets.setdefault(tuple(which), (row, []))[1].append(ids[first:last])
    tasks, parts, begin = [], [], 0
    for row, alike in sorted(sets.values(), key=lambda one: -sum(map(len, one[1]))):
        end = begin + sum(map(len, alike))
        tasks += [(row, at, min(at + most, end)) for at in range(begin, end, most)]
        parts += alike
        begin = end
    return parts, (np.array(tasks, dtype=np.int64).reshape(-1, 3), np.zeros(1, dtype=np.int64))


def share_cached_paths(works: list[Work]) -> None:
    """Copy the cached coverage paths of the thread with most of them to the others, whose paths are its first ones."""
    most = max(works, key=lambda work: work.remembered[0])
    known = int(most.remembered[0])
    for work in works:
        # Paths were cached in the same order on all threads, so the longer list extends the shorter ones.
        if work.remembered[0] < known:
            end = most.ends[:known].max()  # the last index has no path if the cache is full
            work.paths[:end], work.ends[:known], work.slots[:] = most.paths[:end], most.ends[:known], most.slots
            work.remembered[0] = known


def _own_tables(loop: ClosedLoop) -> Tables:
    """A thread's tables: in online missions its ways to base belong to the map of its current group."""
    if not (loop.learns and loop.comes_home):
        return loop.tables
    ways = {name: getattr(loop.tables, name).copy() for name in ("home_steps", "home_cost", "onward")}
    return loop.tables._replace(**ways)


class Runner:
    """Rollouts of one thread, run again with more room for areas each time that the registry is full.

    Attributes:
        counts: of all rollouts so far. work: scratch arrays. tables, policy, how: arguments of its programs.
        room: areas that its state has room for.
    """

    counts: Counts
    _state: State

    def __init__(self, loop: ClosedLoop, seed: int, most: int, known: list[Work] | None = None) -> None:
        """Args: `most`: rollouts of a group, at most. `known`: scratch of earlier calls, one of which is used."""
        self._loop, self._seed, self._most = loop, seed, most
        self.tables, policy = typed(with_features(_own_tables(loop))), loop.policy
        # `stamp` is scratch of the thread; all other arrays of a policy are shared.
        self.policy = None if policy is None else typed(policy._replace(stamp=policy.stamp.copy()))
        own = own_key(seed, loop.purpose) if loop.is_uncertain else (0, 0)
        moving = [own_key(seed, draw) for draw in (MOVE_DRAW, MEETING_DRAW, READING_DRAW)]
        keys = [np.uint32(half) for key in (threshold_key(seed), own, *moving) for half in key]
        options = loop.max_steps, loop.first_only, loop.stay_inside, 0
        self.how = How._make((*keys[:4], *options, *keys[4:], 0, 0, None, None))
        # A cached path is fixed when it begins: not with rules that re-evaluate, map updates, ranges, or several types.
        differ = len(loop.tables.type_of) + len(loop.tables.pace) + len(loop.tables.reach) > 0
        remembers = loop.policy is None and not (loop.stay_inside or loop.learns or loop.comes_home or differ)
        self.work = make_work(loop.tables, most, remembers, known.pop() if known else None)
        self._done: list[tuple[int, int]] = []
        self._make_room(first_room(loop.tables))

    @property
    def state(self) -> State:
        """The state at the end of the last run."""
        return State._make(row[0] for row in self._state)

    @property
    def has_levels(self) -> bool:
        """Whether there is a level for every robot."""
        return len(self._state.marks) > self._loop.robots

    @property
    def largest_group(self) -> int:
        """Most rollouts of a group."""
        return largest_group(self._state, self._most)

    def run(self, first: int, stop: int, singles: Singles, log: Log = NO_LOG) -> None:
        """Count rollouts `first .. stop - 1`."""
        self._done.append((first, stop))
        parts = self._done[-1:]
        while not all(self.fits(*part, singles, log) for part in parts):
            self._make_room(4 * self.room)
            # Counts are void once the room ran out, so all rollouts counted so far are run again, with equal results.
            parts = self._done

    def fits(self, first: int, stop: int, singles: Singles, log: Log = NO_LOG) -> bool:
        """Count rollouts `first .. stop - 1`; False if the area registry is full: then all counts are void."""
        begin, most = self._loop.first_state(self.room), self.largest_group
        for at in range(first, stop, most):
            ids = np.arange(at, min(at + most, stop), dtype=np.uint32)
            log.events[:1], self.work.begin[0] = 0, at
            if self._loop.is_uncertain:
                self.work.left[: len(ids)] = self._loop.failure_model.thresholds(self._seed, ids, self._loop.robots)
            if self._loop.moving_threats is not None:
                self.work.at[: len(ids)] = self._loop.first_places(self._seed, ids)
            tasks = self._tasks(ids)
            if not self.take(begin, tasks, ids, singles, log):
                return False
        return True

    def _tasks(self, ids: NDArray[np.uint32]) -> Tasks:
        """The groups that these rollouts begin as."""
        if self._loop.uncertainty is not None:
            return groups_by_map(ids, self._loop.uncertainty, self._seed)
        return groups_at(np.arange(len(ids)) if self._loop.runs_alone else ONE, len(ids))

    def run_one(self, rollout: int, log: Log = NO_LOG) -> NDArray[np.int32]:
        """Run one rollout; its numbers, int32 `[SINGLES]`. Counts are not kept from one call to the next."""
        single = singles_of(self._loop, rollout, 1)
        self._done.clear()
        self.run(rollout, rollout + 1, single, log)
        return single.numbers[0]

    def defer_groups(self, ids: NDArray[np.uint32], stack: State, singles: Singles) -> int:
        """Defer groups at their first loss in `stack`, as `run_group_tasks` does; how many, or NONE.

        Cached coverage paths are dropped: those cached until the first loss are then the same for every thread, in the
        same order.
        """
        self.work.remembered[:], self.work.slots[:] = 1, 0
        first, how = self._loop.first_state(self.room), self.how._replace(deferred=len(stack.marks) - 1)
        return self._call(first, groups_at(ONE, len(ids)), stack, NO_LOG, how, ids, singles)

    def take(self, waiting: State, tasks: Tasks, ids: NDArray[np.uint32], singles: Singles, log: Log = NO_LOG) -> bool:
        """Run tasks until all are taken; False if the area registry is full."""
        return self._call(waiting, tasks, self._state, log, self.how, ids, singles) != NONE

    def grow(self, mass: int, cut: int, most: int) -> Counts:
        """Counts of the exact tree (`planner.rollouts.exact_tree`).

        Args:
            mass: units of probability 1.
            cut: mass below which branches are left.
            most: histories, at most.
        """
        how, no_ids = self.how._replace(cut=cut, most=most), np.zeros(1, dtype=np.uint32)
        self._make_room(self.room)
        while True:
            given = self._loop.first_state(self.room), groups_at(ONE, mass), self._state, NO_LOG, how
            if self._call(*given, no_ids, singles_of(self._loop, 0, 0)) != NONE:
                return self.counts
            self._make_room(4 * self.room)

    def make_levels(self, levels: int) -> State:
        """A stack of `levels` levels, fewer where the memory limit would be exceeded."""
        return make_state(self._loop.first_state(self.room), levels)

    def _make_room(self, room: int) -> None:
        """Make a state with room for `room` areas, and empty counts."""
        self.room = room
        self._state = self.make_levels(min(self._loop.robots + 1, self._most))
        passes = self._loop.weights is not None
        loop = self._loop
        sizes = len(loop.cells), loop.accessible, loop.robots, loop.max_steps
        self.counts = make_counts(*sizes, passes, loop.comes_home, bool(loop.tables.scores), loop.delivers)

    def _call(
        self, waiting: State, tasks: Tasks, stack: State, log: Log, how: How, ids: NDArray[np.uint32], singles: Singles
    ) -> int:
        """`run_group_tasks` under the loop's policy."""
        return int(run_group_tasks(*self._arguments(waiting, tasks, stack, log, how, ids, singles)))

    def _arguments(self, waiting: State, tasks: Tasks, stack: State, *others: Any) -> tuple[Any, ...]:
        return self.tables, self.policy, self.counts, waiting, *tasks, stack, self.work, *others

    def is_compiled(self, cached: bool) -> bool:
        """True if the program of a run that keeps its legs is compiled in this process.

        With `cached`: if that of rollouts, which keep none, is compiled or in the cache.
        """
        # Legs are a program of their own: a nominal run on a small map should not wait for its compilation.
        ids, state, log = np.zeros(1, dtype=np.uint32), self._state, make_log(0, 0, 0, legs=not cached)
        single = groups_at(ONE, len(ids))
        given = self._arguments(state, single, state, log, self.how, ids, singles_of(self._loop, 0, 0))
        return has_program(run_group_tasks, given, cached)
