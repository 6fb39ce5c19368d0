"""All padding of the JAX engine's tables: sizes rounded up to a few, so that many plans share one compilation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mrac_jax.compiled import STEP_UNIT, CompiledPlan, Mode, ModeTables
from planner.threefry import FAST_COUNTER

WORD_BITS = 32
LEAST_TAIL_WORDS = 64
"""Rows with fewer words are not divided."""
ROBOTS_IN_TAIL = 1.0
"""Robots that get as far as the tail's events, on average a rollout."""


@dataclass(frozen=True, eq=False)
class PaddedTables:
    """What the JAX engine reads; axis letters as in `mrac_jax.compiled`, sizes padded (see `pad_tables`).

    Attributes:
        counter: uint32 `[S]`, `fast`: second counter word of each slot.
        guide, threshold: uint32 `[S, buckets]` and `[S, D]`, `fast`: table and thresholds of `mrac_jax.guide.Guide`.
        step_base, step_bound: uint32 `[D, S]`, `step`: as in ModeTables, entries first.
        first_row: int32 `[G]`; stride: int32 `[G, A]`.
        own: uint32 `[R, 2]`: cells visited + 2**16 * cells survived of the group's own events, and 4 * last step at which
            a robot of it moves + robots of it alive (at most 2). `[R, 3]`, cells apart, if 2**16 cells are accessible.
        bits, tail: uint32 `[R, words]` each, the joint events of every row; the tail's are rarely reached.
        tail_row: int32 `[G]`, the first row of each group that has bits in the tail.
        visited_planes, survived_planes: uint32 `[planes, words]`, bit p of the weights of the joint events in the words from
            `lead_start` on; the others have none.
        drop_row: int32 scalar, the first row that counts nothing: where rollouts that were not asked for go.
        lead_start: static. mantissa, bisections: static, of the guide.
        cell_bins, time_bins, robot_bins: static, sizes of the histograms.
    """

    counter: NDArray[np.uint32]
    guide: NDArray[np.uint32]
    threshold: NDArray[np.uint32]
    step_base: NDArray[np.uint32]
    step_bound: NDArray[np.uint32]
    first_row: NDArray[np.int32]
    stride: NDArray[np.int32]
    own: NDArray[np.uint32]
    bits: NDArray[np.uint32]
    tail: NDArray[np.uint32]
    tail_row: NDArray[np.int32]
    visited_planes: NDArray[np.uint32]
    survived_planes: NDArray[np.uint32]
    drop_row: np.int32
    lead_start: int
    mantissa: int
    bisections: int
    cell_bins: int
    time_bins: int
    robot_bins: int


STATIC_FIELDS = ("lead_start", "mantissa", "bisections", "cell_bins", "time_bins", "robot_bins")
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


def pad_tables(compiled: CompiledPlan, mode: Mode) -> tuple[PaddedTables, NDArray[np.int64]]:
    """The tables of a mode with every size rounded up, and where the plan's words are in `bits` and `tail`, int64 `[W]`.

    What the padding holds, and why it changes no count:

    - rows (to a power of two, one spare at least): all zero: no cells, no time, nobody alive, no events. Groups that do
      not exist (G rounded up) stay in the first spare row, `drop_row`, with stride 0; its count is never read.
    - words (few: to 1 .. 8, 10, ...; many: each part to a multiple of 16): no event has these bits; weights 0.
    - slots of groups that do not exist: guide and thresholds 0 (no word is below), or the bound 2**24 at once (always
      stopped): outcome 0, and their stride is 0. Their `tail_row` is never reached.
    - dangerous entries after a robot's last: bound 2**24, as after every robot's last entry anyway.
    - histogram bins beyond the largest value: never reached.
    """
    tables = compiled.tables(mode)
    groups, events, guide = tables.groups, tables.events, tables.guide
    group_pad = size_bucket(groups.count) - groups.count
    slot_pad = group_pad * groups.members
    row_pad = power_bucket(groups.row_count + 1, 256) - groups.row_count
    words = arrange_words(compiled, tables)
    bits = np.zeros((groups.row_count, words.head + words.tail), dtype=np.uint32)
    bits[:, words.columns] = events.bits
    weights = (events.visited_weight, events.survived_weight)
    planes = size_bucket(max(plane_count(weight) for weight in weights))
    shown = [np.zeros((planes, bits.shape[1]), np.uint32) for _ in weights]
    for plane, weight in zip(shown, weights, strict=True):
        plane[:, words.columns] = weight_planes(weight, len(words.columns), planes)
    lead = slice(words.lead_start, words.lead_start + words.lead)
    visited, survived = events.own_visited, events.own_survived
    cells = [visited + (survived << 16)] if compiled.accessible < 2**16 else [visited, survived]
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
        own=_grow(np.stack([*cells, 4 * tables.time + tables.alive], axis=1), row_pad, 0),
        bits=_grow(bits[:, : words.head], row_pad, 0),
        tail=_grow(bits[:, words.head :], row_pad, 0),
        tail_row=_grow(words.tail_row, group_pad, fill=2**30, dtype=np.int32),
        visited_planes=shown[0][:, lead],
        survived_planes=shown[1][:, lead],
        drop_row=np.int32(groups.row_count),
        lead_start=words.lead_start,
        mantissa=0 if guide is None else guide.mantissa,
        bisections=0 if guide is None else guide.bisections,
        cell_bins=power_bucket(compiled.accessible + 1, 256),
        time_bins=power_bucket(compiled.last_step + 1, 256),
        robot_bins=power_bucket(compiled.robots + 1, 16),
    ), words.columns


@dataclass(frozen=True, eq=False)
class WordOrder:
    """Where the plan's event words go: `[no weight, soon | weight, soon][weight, late | no weight, late]`.

    Attributes:
        columns: int64 `[W]`, the place of each of the plan's words; head, tail: sizes of the two parts.
        lead_start, lead: the words with weights.
        tail_row: int64 `[G]`, each group's first row that has bits in the tail; 2**30 if there is no tail.
    """

    columns: NDArray[np.int64]
    head: int
    tail: int
    lead_start: int
    lead: int
    tail_row: NDArray[np.int64]


def arrange_words(compiled: CompiledPlan, tables: ModeTables) -> WordOrder:
    """Few words, or pairs of robots: as they are, no tail. Else words that about one robot a rollout reaches are the tail."""
    events, groups = tables.events, tables.groups
    words = events.bits.shape[1]
    no_tail = np.full(groups.count, 2**30, dtype=np.int64)
    if words < LEAST_TAIL_WORDS or groups.members > 1:
        wide = size_bucket(words) if words else 0
        lead = min(wide, size_bucket(events.weighted_words)) if words else 0
        return WordOrder(np.arange(words), wide, 0, 0, lead, no_tail)
    reached = events.bits != 0
    size = int(groups.size.max())
    alive_after = [np.cumprod(1.0 - threat.astype(np.float64)) for threat in compiled.danger_threat]
    robots_at = sum((np.pad(alive, (1, max(size - len(alive), 0)), constant_values=(1, 0))[:size] for alive in alive_after))
    depth = int(np.argmax(np.append(robots_at, 0.0) <= ROBOTS_IN_TAIL))
    outcome = np.arange(groups.row_count) - np.repeat(groups.first_row, groups.size)
    soon = reached[outcome < depth].any(axis=0)
    lead = np.arange(words) < events.weighted_words
    parts = [np.flatnonzero(part) for part in (soon & ~lead, soon & lead, ~soon & lead, ~soon & ~lead)]
    sizes = [-(-len(part) // 16) * 16 for part in parts]
    starts = np.cumsum([0, *sizes])
    columns = np.empty(words, dtype=np.int64)
    for part, start in zip(parts, starts, strict=False):
        columns[part] = start + np.arange(len(part))
    late = reached[:, ~soon].any(axis=1)
    tail_row = [
        first + int(np.argmax(late[first : first + many])) if late[first : first + many].any() else 2**30
        for first, many in zip(groups.first_row.tolist(), groups.size.tolist(), strict=True)
    ]
    head, tail = sizes[0] + sizes[1], sizes[2] + sizes[3]
    return WordOrder(columns, head, tail, sizes[0], sizes[1] + sizes[2], np.array(tail_row, dtype=np.int64))


def _grow(array: NDArray, *pads: int, fill: int = 0, dtype: type = np.uint32) -> NDArray:
    """`array` with so many more places at the end of each axis."""
    return np.pad(array, [(0, pad) for pad in pads], constant_values=fill).astype(dtype)
