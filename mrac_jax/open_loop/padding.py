"""All padding of the JAX engine's tables: sizes rounded up to a few, so that many plans share one compilation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import Array, on_host
from mrac_jax.doubt import Doubt, make_doubt
from mrac_jax.two_words import two_words
from planner.rollouts.open_loop.compiled import CompiledPlan, ModeTables, words_of
from planner.rollouts.open_loop.joint_draws import JointDraws
from planner.rollouts.open_loop.planes import plane_count, weight_planes
from planner.threefry import own_key

NEVER = 2**30
"""A row after all others."""
ENTRIES_A_STEP = 4
"""Dangerous entries of maps in doubt that are drawn before anybody looks whether any rollout goes on."""
LEAST_PLANES = 3
LEAST_TAIL_WORDS = 64
"""Rows with fewer words are not divided."""
ROBOTS_IN_TAIL = 4.0
"""Robots that get as far as the tail's events, on average a rollout."""


@dataclass(frozen=True, eq=False)
class PaddedDraws:
    """`open_loop.joint_draws.JointDraws` with every size rounded up; entries after the last hit nobody.

    Attributes:
        slot, place, spot: `[E]`. exposure: uint32 `[E, 2]`, the most that the entry adds; doubt: how much of it. count:
            int32 scalar, E without the padding.
        last: int32 `[S]`. spent: `[spots]`, of no value: how many cells are kept for each rollout, one at least.
    """

    slot: Array
    place: Array
    exposure: Array
    spot: Array
    doubt: Doubt
    count: Array
    last: Array
    spent: Array


@dataclass(frozen=True, eq=False)
class PaddedTables:
    """What the JAX engine reads; axis letters as in `open_loop.compiled`, sizes padded (see `pad_tables`).

    Attributes:
        counter: uint32 `[S]`, second counter word of each slot's number.
        guide, threshold: uint32 `[S, buckets]` and `[S, D]`, table and thresholds of
            `planner.rollouts.open_loop.guide.Guide`; nothing where the map is in doubt.
        first_row: int32 `[G]`; stride: int32 `[G, A]`.
        own: two uint32 `[R]`: cells visited + 2**16 * cells survived of the group's own events; 4 * last step at which
            a robot of it moves + robots of it alive (at most 2). Three, the cells apart, from 2**16 accessible on.
        bits: the joint events of every row, in no, one or two parts, uint32 `[R, words]` each: a head, and a tail of
            events that are rarely reached.
        tail_row: int32 `[G]`, the first row of each group that has bits in the tail.
        visited_planes, survived_planes: for each part, uint32 `[planes, weighted words]`: bit p of the events' weights.
        weighted: static, for each part, the range of words (start, stop) whose events have weights.
        joint: what is drawn instead where the map is in doubt, else None.
        drop_row: int32 scalar, the first row that counts nothing: where rollouts that were not asked for go.
        mantissa, bisections: static, of the guide.
        cell_bins, time_bins, robot_bins: static, sizes of the histograms.
    """

    counter: Array
    guide: Array
    threshold: Array
    first_row: Array
    stride: Array
    own: tuple[Array, ...]
    bits: tuple[Array, ...]
    tail_row: Array
    visited_planes: tuple[Array, ...]
    survived_planes: tuple[Array, ...]
    joint: PaddedDraws | None
    drop_row: Array
    weighted: tuple[tuple[int, int], ...]
    mantissa: int
    bisections: int
    cell_bins: int
    time_bins: int
    robot_bins: int


STATIC_FIELDS = ("weighted", "mantissa", "bisections", "cell_bins", "time_bins", "robot_bins")
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


def pad_tables(compiled: CompiledPlan, seed: int) -> tuple[PaddedTables, NDArray[np.int64]]:
    """The tables by tolerance with every size rounded up, and where the plan's words are in `bits`, int64 `[W]`.

    What the padding holds, and why it changes no count:

    - rows (to a power of two, one spare at least): all zero: no cells, no time, nobody alive, no events. Groups that do
      not exist (G rounded up) stay in the first spare row, `drop_row`, with stride 0; its count is never read.
    - words (few: to 2, 4, 6, 8, ...; many: each part to a multiple of 16): no event has these bits; weights 0.
    - planes (to 3, 4, ...): no weight has these bits.
    - slots of groups that do not exist: guide and thresholds 0 (no word is below): outcome 0, and their stride is 0.
      Their `tail_row` is never reached.
    - entries of all robots after the last one of a map in doubt: not counted, nobody is stopped.
    - histogram bins beyond the largest value: never reached.
    """
    tables = compiled.tables("tolerance")
    groups, events, guide = tables.groups, tables.events, tables.guide
    group_pad = size_bucket(groups.count) - groups.count
    slot_pad = group_pad * groups.members
    row_pad = power_bucket(groups.row_count + 1, 256) - groups.row_count
    order = arrange_words(compiled, tables)
    bits = np.zeros((groups.row_count, sum(order.sizes)), dtype=np.uint32)
    bits[:, order.columns] = events.bits
    weights = (events.visited_weight, events.survived_weight)
    planes = size_bucket(max(LEAST_PLANES, *(plane_count(weight) for weight in weights)))
    shown = [np.zeros((planes, bits.shape[1]), np.uint32) for _ in weights]
    for plane, weight in zip(shown, weights, strict=True):
        plane[:, order.columns] = weight_planes(weight, len(order.columns), planes)
    parts = [(sum(order.sizes[:n]), size) for n, size in enumerate(order.sizes)]
    lead = [slice(at + start, at + stop) for (at, _), (start, stop) in zip(parts, order.weighted, strict=True)]
    visited, survived = events.own_visited, events.own_survived
    cells = [visited + (survived << 16)] if compiled.accessible < 2**16 else [visited, survived]
    counter, draws = words_of(groups, "tolerance")[0], compiled.world.draws
    nothing = np.zeros((len(counter), 1), np.uint32)
    return on_host(
        PaddedTables,
        counter=_grow(counter, slot_pad),
        guide=_grow(nothing if guide is None else guide.table, slot_pad, 0),
        threshold=_grow(nothing if guide is None else guide.threshold, slot_pad, 0),
        first_row=_grow(groups.first_row, group_pad, fill=groups.row_count, dtype=np.int32),
        stride=_grow(groups.stride, group_pad, 0, dtype=np.int32),
        own=tuple(_grow(column, row_pad) for column in (*cells, 4 * tables.time + tables.alive)),
        bits=tuple(_grow(bits[:, at : at + size], row_pad, 0) for at, size in parts),
        tail_row=_grow(order.tail_row, group_pad, fill=NEVER, dtype=np.int32),
        visited_planes=tuple(shown[0][:, words] for words in lead),
        survived_planes=tuple(shown[1][:, words] for words in lead),
        joint=None
        if tables.joint is None or draws is None
        else pad_draws(tables.joint, own_key(seed, draws.purpose), slot_pad),
        drop_row=np.int32(groups.row_count),
        weighted=order.weighted,
        mantissa=0 if guide is None else guide.mantissa,
        bisections=0 if guide is None else guide.bisections,
        cell_bins=power_bucket(compiled.accessible + 1, 256),
        time_bins=power_bucket(compiled.last_step + 1, 256),
        robot_bins=power_bucket(compiled.robots + 1, 16),
    ), order.columns


def pad_draws(joint: JointDraws, key: tuple[int, int], slot_pad: int) -> PaddedDraws:
    """The draws with every size rounded up, and so many slots of no robot."""
    size = power_bucket(len(joint.slot), 64)
    slot, place, exposure, spot = (
        np.pad(each, (0, size - len(joint.slot))) for each in (joint.slot, joint.place, joint.exposure, joint.spot)
    )
    spends = joint.spots > 0
    return on_host(
        PaddedDraws,
        slot=slot,
        place=place,
        exposure=two_words(exposure.astype(np.int64)),
        spot=spot if spends else np.zeros_like(spot),
        doubt=make_doubt(joint, key, spends, size),
        count=np.int32(len(joint.slot)),
        last=_grow(joint.last, slot_pad, dtype=np.int32),
        spent=np.zeros(power_bucket(joint.spots), dtype=np.bool_),
    )


@dataclass(frozen=True, eq=False)
class WordOrder:
    """Where the event words go: one part, or two: `[others, soon; weights, soon]`, `[weights, late; others, late]`.

    Attributes:
        columns: int64 `[W]`, the place of each of the plan's words, parts one after the other.
        sizes: words of each part, padding included. weighted: range of words with weights in each part.
        tail_row: int64 `[G]`, each group's first row that has bits in the second part, or NEVER.
    """

    columns: NDArray[np.int64]
    sizes: tuple[int, ...]
    weighted: tuple[tuple[int, int], ...]
    tail_row: NDArray[np.int64]


def arrange_words(compiled: CompiledPlan, tables: ModeTables) -> WordOrder:
    """Few words, or pairs of robots: one part. Else the words that few robots reach in a rollout are their own part."""
    events, groups = tables.events, tables.groups
    words = events.bits.shape[1]
    never = np.full(groups.count, NEVER, dtype=np.int64)
    if words == 0:
        return WordOrder(np.zeros(0, dtype=np.int64), (), (), never)
    if words < LEAST_TAIL_WORDS or groups.members > 1:
        wide, weighted_words = (2 * size_bucket(-(-many // 2)) for many in (words, events.weighted_words))
        return WordOrder(np.arange(words), (wide,), ((0, weighted_words),), never)
    depth = _depth_reached(compiled, int(groups.size.max()))
    reached = events.bits != 0
    outcome = np.arange(groups.row_count) - np.repeat(groups.first_row, groups.size)
    soon = reached[outcome < depth].any(axis=0)
    lead = np.arange(words) < events.weighted_words
    kinds = [np.flatnonzero(kind) for kind in (soon & ~lead, soon & lead, ~soon & lead, ~soon & ~lead)]
    sizes = [-(-len(kind) // 16) * 16 for kind in kinds]
    columns = np.empty(words, dtype=np.int64)
    for kind, start in zip(kinds, np.cumsum([0, *sizes]), strict=False):
        columns[kind] = start + np.arange(len(kind))
    late = reached[:, ~soon].any(axis=1)
    for group, (first, many) in enumerate(zip(groups.first_row.tolist(), groups.size.tolist(), strict=True)):
        if late[first : first + many].any():
            never[group] = first + int(np.argmax(late[first : first + many]))
    weighted = ((sizes[0], sizes[0] + sizes[1]), (0, sizes[2]))
    return WordOrder(columns, (sizes[0] + sizes[1], sizes[2] + sizes[3]), weighted, never)


def _depth_reached(compiled: CompiledPlan, most: int) -> int:
    """The least number of dangerous entries that at most ROBOTS_IN_TAIL robots get past, on average."""
    robots = np.zeros(most, dtype=np.float64)
    for threat in compiled.danger_threat:
        passed = np.concatenate([[1.0], np.cumprod(1.0 - threat.astype(np.float64))])[:most]
        robots[: len(passed)] += passed
    return int(np.argmax(np.append(robots, 0.0) <= ROBOTS_IN_TAIL))


def _grow(array: NDArray, *pads: int, fill: int = 0, dtype: type = np.uint32) -> NDArray:
    """`array` with so many more places at the end of each axis."""
    return np.pad(array, [(0, pad) for pad in pads], constant_values=fill).astype(dtype)
