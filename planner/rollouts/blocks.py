"""Ranges of rollout ids to run one after the other, each as many as take about half a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from planner.errors import UsageError
from planner.limits import BLOCK, MOST_ROLLOUTS

MOST_SEED = 2**64
CHUNK_SECONDS = 0.5
CELLS_A_CALL = 2**21
"""Cells that rollouts cover, about, in a call that is worth while: 4,096 rollouts of 500 cells."""
Result = TypeVar("Result")


def worth_a_call(cells: int) -> int:
    """Rollouts of the closed loop that a call is worth while for: a block, on large maps an aligned part of one."""
    return max(1, min(BLOCK, 1 << (CELLS_A_CALL // cells).bit_length() - 1))


def check_range(start: int, count: int, chunk: int | None, seed: int) -> None:
    """Raise UsageError for ids, a chunk or a seed that are none."""
    if start < 0 or count < 0 or start + count > MOST_ROLLOUTS:
        raise UsageError(f"rollouts {start} .. {start + count}", expected="ids 0 <= id < 2**32")
    if chunk is not None and chunk < 1:
        raise UsageError(f"chunk is {chunk}", expected="at least 1 rollout")
    if not 0 <= seed < MOST_SEED:
        raise UsageError(f"seed is {seed}", expected="0 <= seed < 2**64")


def run_ranges(
    work: Callable[[int, int], Result],
    start: int,
    count: int,
    *,
    chunk: int | None = None,
    checkpoints: Iterable[int] = (),
    unit: int = BLOCK,
) -> Iterator[tuple[int, int, Result, float]]:
    """`work(start, count)` for range after range of ids: (start, count, what it returned, seconds it took).

    Whoever stops iterating (or is interrupted) loses at most the range in flight.

    Args:
        work: runs a range. start, count: the ids.
        chunk: ids a range, rounded up to whole units; None = one unit, then twice as many for as long as a range takes
            less than a quarter of a second.
        checkpoints: numbers of ids (counted from `start`) at which a range must end, for stopping rules.
        unit: ranges end at its multiples.
    """
    ends = sorted({start + mark for mark in checkpoints if 0 < mark < count} | {start + count})
    size, position = chunk or unit, start
    while position < start + count:
        boundary = next(end for end in ends if end > position)
        stop = min(boundary, (position + size + unit - 1) // unit * unit)
        clock = time.perf_counter()
        result = work(position, stop - position)
        took = time.perf_counter() - clock
        yield position, stop - position, result, took
        position = stop
        if chunk is None and took < CHUNK_SECONDS / 2:
            size *= 2
