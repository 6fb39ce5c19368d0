"""What the open-loop engines are measured against: a good NumPy engine, and the naive JAX program.

`NumpyOpenLoop` reads the same tables as the engines and gives the same tally, count for count. `naive_rollouts` is what
one writes first, one Bernoulli a step under `vmap(scan)`; it has random numbers of its own.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from planner.rollouts.open_loop.compiled import CompiledPlan, Mode
from planner.rollouts.open_loop.counts import RangeCounts, available_cores, outcomes_of, share_out
from planner.rollouts.open_loop.planes import plane_count, weight_planes
from planner.tally import RolloutResults
from planner.threefry import threefry2x32
from planner.tolerance import key_of_luck

TILE = 2**15
"""Rollouts a tile: of 4,096 .. 32,768 the fastest."""
LEADING_BITS = 16
Sums = tuple[NDArray[np.int64], ...]


class NumpyOpenLoop:
    """The open loop in NumPy: prefix counts by row, event words, bincounts; tiles shared out among threads."""

    name = "numpy"

    def __init__(self, compiled: CompiledPlan, seed: int, mode: Mode, threads: int | None = None) -> None:
        self.compiled, self._key = compiled, key_of_luck(seed)
        self.tables = compiled.tables(mode)
        self.threads = threads or available_cores()
        events = self.tables.events
        weights = (events.visited_weight, events.survived_weight)
        self._planes = [
            weight_planes(w, events.bits.shape[1], plane_count(w))[:, : events.weighted_words] for w in weights
        ]
        self._lookup = [_make_lookup(one) for one in compiled.thresholds(mode)]

    def counts(self, start: int, count: int) -> RangeCounts:
        """The counts of rollouts `start .. start + count - 1`."""
        with ThreadPoolExecutor(self.threads) as pool:
            done = list(pool.map(lambda part: self._part(*part), share_out(start, count, self.threads, TILE)))
        rows, events, visited, survived, time, alive, full = (
            sum(parts[1:], start=parts[0]) for parts in zip(*done, strict=True)
        )
        return RangeCounts(
            count, rows, events[: self.tables.events.count], visited, survived, time, alive, int(full[0])
        )

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        visited, survived, time, alive = (a.astype(np.int32) for a in self._score(self._rows(start, count))[:4])
        return RolloutResults(
            start, visited, survived, time, alive, outcomes_of(visited, alive, self.compiled.accessible)
        )

    def _part(self, start: int, count: int) -> Sums:
        total: list[NDArray[np.int64]] = []
        for first in range(start, start + count, TILE):
            counts = self._tile(first, min(TILE, start + count - first))
            total = [a + b for a, b in zip(total, counts, strict=True)] if total else list(counts)
        return tuple(total)

    def _tile(self, first: int, size: int) -> Sums:
        accessible, last_step, robots = self.compiled.accessible, self.compiled.last_step, self.compiled.robots
        rows = self._rows(first, size)
        visited, survived, time, alive, union = self._score(rows)
        full = np.count_nonzero((visited == accessible) & (alive == 0))
        return (
            np.bincount(rows.ravel(), minlength=self.tables.groups.row_count),
            _count_events(union),
            np.bincount(visited, minlength=accessible + 1),
            np.bincount(survived, minlength=accessible + 1),
            np.bincount(time, minlength=last_step + 1),
            np.bincount(alive, minlength=robots + 1),
            np.array([full], dtype=np.int64),
        )

    def _rows(self, first: int, size: int) -> NDArray[np.int64]:
        """Rows int64 `[G, L]`."""
        groups = self.tables.groups
        rollouts = np.arange(first, first + size, dtype=np.uint64).astype(np.uint32)
        rows = np.repeat(groups.first_row[:, None], size, axis=1)
        for slot, robot in enumerate(groups.slot_robot.tolist()):
            if robot >= 0:
                rows[slot // groups.members] += self._outcomes(robot, rollouts) * groups.stride.reshape(-1)[slot]
        return rows

    def _outcomes(self, robot: int, rollouts: NDArray[np.uint32]) -> NDArray[np.int64]:
        least, inside, crowded, rising = self._lookup[robot]
        words = threefry2x32(self._key, rollouts, robot)[0]
        bucket = words >> np.uint32(32 - LEADING_BITS)
        outcome = least[bucket] + (words < inside[bucket])
        rare = np.flatnonzero(bucket < crowded)
        outcome[rare] = len(rising) - np.searchsorted(rising, words[rare].astype(np.uint64), side="right")
        return outcome

    def _score(self, rows: NDArray[np.int64]) -> tuple[NDArray, ...]:
        """Cells visited and survived, time, alive `[L]`, and the union of the rows' event bits `[L, W]`."""
        tables, events = self.tables, self.tables.events
        visited, survived = events.own_visited[rows].sum(axis=0), events.own_survived[rows].sum(axis=0)
        time, alive = tables.time[rows].max(axis=0), tables.alive[rows].sum(axis=0)
        union = events.bits[rows[0]]
        for row in rows[1:]:
            union |= events.bits[row]
        weighted = union[:, : events.weighted_words]
        for total, planes in zip((visited, survived), self._planes, strict=True):
            for place, plane in enumerate(planes):
                bits = np.bitwise_count(weighted & plane)
                total += bits.sum(axis=1, dtype=np.uint64).astype(total.dtype) << np.uint64(place)
        return visited.astype(np.int64), survived.astype(np.int64), time.astype(np.int64), alive.astype(np.int64), union


def _make_lookup(
    thresholds: NDArray[np.uint64],
) -> tuple[NDArray[np.int64], NDArray[np.uint32], int, NDArray[np.uint64]]:
    """Outcomes by a word's leading bits: the least, the threshold inside the bucket (0: none), the number of buckets at
    the low end that hold several thresholds at worst, and the thresholds in rising order for those.
    """
    rising = thresholds[::-1].copy()
    first = np.arange(2**LEADING_BITS, dtype=np.uint64) << np.uint64(32 - LEADING_BITS)
    last = first + np.uint64(2 ** (32 - LEADING_BITS) - 1)
    least, most = (len(rising) - np.searchsorted(rising, words, side="right") for words in (last, first))
    inside = np.where(most > least, np.append(thresholds, np.uint64(0))[least], np.uint64(0)).astype(np.uint32)
    several = np.flatnonzero(most - least > 1)
    return least, inside, int(several.max(initial=-1)) + 1, rising


def _count_events(union: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Rollouts in which each event happened, int64 `[W * 32]`: in fields of 4 bits over 8 rollouts, of 8 over 128."""
    size, words = union.shape
    if words == 0:
        return np.zeros(0, dtype=np.int64)
    padded = np.zeros((-(-size // 128) * 128, words), dtype=np.uint32)
    padded[:size] = union
    eight = padded.reshape(8, -1, words)
    counts = np.zeros((words, 4, 2, 4), dtype=np.int64)
    for place in range(4):
        nibbles = (
            ((eight >> np.uint32(place)) & np.uint32(0x11111111)).sum(axis=0, dtype=np.uint32).reshape(16, -1, words)
        )
        for half in range(2):
            octets = ((nibbles >> np.uint32(4 * half)) & np.uint32(0x0F0F0F0F)).sum(axis=0, dtype=np.uint32)
            for octet in range(4):
                counts[:, octet, half, place] = ((octets >> np.uint32(8 * octet)) & np.uint32(255)).sum(axis=0)
    return counts.reshape(-1)


def naive_rollouts(paths: list[NDArray[np.int64]], threat: NDArray[np.float32], batch: int):  # type: ignore[no-untyped-def]
    """A jitted function of a `jax.random` key: the tally's sums over `batch` rollouts by `vmap(scan)`, step by step."""
    import jax
    import jax.numpy as jnp

    steps = max(len(path) for path in paths)
    cell = jnp.array([np.pad(path, (0, steps - len(path)), mode="edge") for path in paths], dtype=jnp.int32).T
    enters = jnp.concatenate([jnp.ones((1, cell.shape[1]), bool), cell[1:] != cell[:-1]])
    chance = jnp.array(threat, dtype=jnp.float32)[cell]

    def rollout(key):  # type: ignore[no-untyped-def]
        def step(state, now):  # type: ignore[no-untyped-def]
            alive, visited, survived, time = state
            cells, entering, threats, number, draw = now
            moves = entering & alive
            stopped = moves & jax.random.bernoulli(draw, threats)
            seen = visited.at[cells].max(moves)
            passed = survived.at[cells].max(moves & ~stopped)
            info = (moves, stopped, seen.sum() - visited.sum(), passed.sum() - survived.sum())
            return (alive & ~stopped, seen, passed, jnp.where(moves.any(), number, time)), info

        nowhere = jnp.zeros(len(threat), dtype=bool)
        start = (jnp.ones(cell.shape[1], dtype=bool), nowhere, nowhere, jnp.int32(0))
        inputs = (cell, enters, chance, jnp.arange(steps, dtype=jnp.int32), jax.random.split(key, steps))
        (alive, visited, survived, time), (moves, stops, *new) = jax.lax.scan(step, start, inputs)
        return (visited.sum(), survived.sum(), time, alive.sum()), (moves, stops, *new, visited, survived)

    def sums(key):  # type: ignore[no-untyped-def]
        single, counted = jax.vmap(rollout)(jax.random.split(key, batch))
        return single, jax.tree.map(lambda leaf: leaf.sum(axis=0, dtype=jnp.int32), counted)

    return jax.jit(sums)
