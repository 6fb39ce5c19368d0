"""All padding of the JAX engine's tables: sizes rounded up to a few, so that many plans share one compilation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mrac_jax.compiled import STEP_UNIT, CompiledPlan, Mode
from planner.threefry import FAST_COUNTER

WORD_BITS = 32


@dataclass(frozen=True, eq=False)
class PaddedTables:
    """What the JAX engine reads; axis letters as in `mrac_jax.compiled`, sizes padded (see `pad_tables`).

    Attributes:
        counter: uint32 `[S]`, `fast`: second counter word of each slot.
        guide, threshold: uint32 `[S, buckets]` and `[S, D]`, `fast`: table and thresholds of `mrac_jax.guide.Guide`.
        step_base, step_bound: uint32 `[D, S]`, `step`: as in ModeTables, entries first.
        first_row: int32 `[G]`; stride: int32 `[G, A]`.
        cells: uint32 `[1, R]`: cells visited + 2**16 * cells survived; `[2, R]`, one each, if 2**16 cells are accessible.
        moves: uint32 `[R]`: 4 * last step at which a robot of the group moves + robots of the group alive (at most 2).
        bits: uint32 `[R, W]`, the joint events of every row.
        visited_planes, survived_planes: uint32 `[planes, leading words]`, bit p of the joint events' weights.
        accessible: uint32 scalar.
        drop_row: int32 scalar, the first row that counts nothing: where rollouts that were not asked for go.
        mantissa, bisections: static, of the guide.
        cell_bins, time_bins, robot_bins: static, sizes of the histograms.
    """

    counter: NDArray[np.uint32]
    guide: NDArray[np.uint32]
    threshold: NDArray[np.uint32]
    step_base: NDArray[np.uint32]
    step_bound: NDArray[np.uint32]
    first_row: NDArray[np.int32]
    stride: NDArray[np.int32]
    cells: NDArray[np.uint32]
    moves: NDArray[np.uint32]
    bits: NDArray[np.uint32]
    visited_planes: NDArray[np.uint32]
    survived_planes: NDArray[np.uint32]
    accessible: np.uint32
    drop_row: np.int32
    mantissa: int
    bisections: int
    cell_bins: int
    time_bins: int
    robot_bins: int


STATIC_FIELDS = ("mantissa", "bisections", "cell_bins", "time_bins", "robot_bins")
DATA_FIELDS = tuple(name for name in PaddedTables.__dataclass_fields__ if name not in STATIC_FIELDS)


def size_bucket(size: int, steps: int = 4) -> int:
    """The least of 1 .. 2 * steps and their doublings that is at least `size`: at most 1 / steps too large."""
    if size <= 2 * steps:
        return max(size, 1)
    unit = 1 << ((size - 1).bit_length() - (2 * steps).bit_length() + 1)
    return -(-size // unit) * unit


def power_bucket(size: int, least: int = 1) -> int:
    """The least power of two that is at least `size` and `least`."""
    return max(least, 1 << max(size - 1, 0).bit_length())


def weight_planes(weight: NDArray[np.int64], words: int, planes: int) -> NDArray[np.uint32]:
    """uint32 `[planes, W]`: bit e % 32 of word e // 32 of plane p = bit p of the weight of event e."""
    padded = np.zeros(words * WORD_BITS, dtype=np.int64)
    padded[: len(weight)] = weight
    bits = (padded[None, :] >> np.arange(planes)[:, None]) & 1
    return (bits.reshape(planes, words, WORD_BITS) << np.arange(WORD_BITS)).sum(axis=2).astype(np.uint32)


def plane_count(weight: NDArray[np.int64]) -> int:
    """Planes that hold every weight, at least 1."""
    return max(1, int(weight.max(initial=0)).bit_length())


def pad_tables(compiled: CompiledPlan, mode: Mode) -> PaddedTables:
    """The tables of a mode with every size rounded up. What the padding holds, and why it changes no count:

    - rows (to a power of two, one spare at least): all zero: no cells, no time, nobody alive, no events. Groups that do
      not exist (G rounded up) stay in the first spare row, `drop_row`, with stride 0; its count is never read.
    - words (to 1 .. 8, then quarters of a power of two): no event has these bits, and their weights are 0.
    - slots of groups that do not exist: guide and thresholds 0 (no word is below), or the bound 2**24 at once (always
      stopped): outcome 0, and their stride is 0.
    - dangerous entries after a robot's last: bound 2**24, as after every robot's last entry anyway.
    - histogram bins beyond the largest value: never reached.
    """
    tables = compiled.tables(mode)
    groups, events, guide = tables.groups, tables.events, tables.guide
    group_pad = size_bucket(groups.count) - groups.count
    slot_pad = group_pad * groups.members
    row_pad = power_bucket(groups.row_count + 1, 256) - groups.row_count
    words = events.bits.shape[1]
    wide = size_bucket(words) if words else 0
    weights = (events.visited_weight, events.survived_weight)
    planes = max(2, size_bucket(max(plane_count(weight) for weight in weights)))
    weighted = min(wide, size_bucket(events.weighted_words)) if words else 0
    visited, survived = events.own_visited, events.own_survived
    packed = compiled.accessible < 2**16
    entries = size_bucket(tables.step_bound.shape[1])
    robots = np.where(groups.slot_robot >= 0, groups.slot_robot, 0)
    nothing = np.zeros((len(robots), 1), np.uint32)
    step_pads = ((0, entries - tables.step_bound.shape[1]), (0, slot_pad))
    return PaddedTables(
        counter=_grow(FAST_COUNTER - robots, slot_pad),
        guide=_grow(nothing if guide is None else guide.table, slot_pad, 0),
        threshold=_grow(nothing if guide is None else guide.threshold, slot_pad, 0),
        step_base=np.pad(tables.step_base.T, step_pads) if mode == "step" else nothing,
        step_bound=np.pad(tables.step_bound.T, step_pads, constant_values=STEP_UNIT) if mode == "step" else nothing,
        first_row=_grow(groups.first_row, group_pad, fill=groups.row_count, dtype=np.int32),
        stride=_grow(groups.stride, group_pad, 0, dtype=np.int32),
        cells=_grow(np.stack([visited + (survived << 16)] if packed else [visited, survived]), 0, row_pad),
        moves=_grow(4 * tables.time + tables.alive, row_pad),
        bits=_grow(events.bits, row_pad, wide - words),
        visited_planes=weight_planes(weights[0], wide, planes)[:, :weighted],
        survived_planes=weight_planes(weights[1], wide, planes)[:, :weighted],
        accessible=np.uint32(compiled.accessible),
        drop_row=np.int32(groups.row_count),
        mantissa=0 if guide is None else guide.mantissa,
        bisections=0 if guide is None else guide.bisections,
        cell_bins=power_bucket(compiled.accessible + 1, 256),
        time_bins=power_bucket(compiled.last_step + 1, 256),
        robot_bins=power_bucket(compiled.robots + 1, 16),
    )


def _grow(array: NDArray, *pads: int, fill: int = 0, dtype: type = np.uint32) -> NDArray:
    """`array` with so many more places at the end of each axis."""
    return np.pad(array, [(0, pad) for pad in pads], constant_values=fill).astype(dtype)
