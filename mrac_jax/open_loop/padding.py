"""All padding of the JAX engine's tables: sizes rounded up to a few, so that many plans share one compilation."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import STATIC, Array, on_host
from mrac_jax.doubt import Doubt, make_doubt
from mrac_jax.two_words import two_words
from planner.rollouts.open_loop.compiled import CompiledPlan, words_of
from planner.rollouts.open_loop.joint_draws import JointDraws
from planner.rollouts.open_loop.planes import plane_count, weight_planes
from planner.threefry import own_key

ENTRIES_A_STEP = 4
"""Dangerous entries of maps in doubt that are drawn before anybody looks whether any rollout goes on."""
LEAST_PLANES = 3


@jax.tree_util.register_dataclass
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class PaddedTables:
    """What the JAX engine reads; axis letters as in `open_loop.compiled`, sizes padded (see `pad_tables`).

    Attributes:
        counter: uint32 `[S]`, second counter word of each slot's number.
        guide, threshold: uint32 `[S, buckets]` and `[S, D]`, table and thresholds of
            `planner.rollouts.open_loop.guide.Guide`; nothing where the map is in doubt.
        first_row: int32 `[G]`; stride: int32 `[G, A]`.
        visited, survived: uint32 `[R]`, cells of the group's own events. time: uint32 `[R]`, last step at which a robot
            of it moves; alive: uint32 `[R]`, robots of it alive.
        bits: uint32 `[R, words]`, the joint events of every row.
        visited_planes, survived_planes: uint32 `[planes, weighted words]`: bit p of the weights of the first words'
            events; the others have none.
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
    visited: Array
    survived: Array
    time: Array
    alive: Array
    bits: Array
    visited_planes: Array
    survived_planes: Array
    joint: PaddedDraws | None
    drop_row: Array
    mantissa: int = field(metadata=STATIC)
    bisections: int = field(metadata=STATIC)
    cell_bins: int = field(metadata=STATIC)
    time_bins: int = field(metadata=STATIC)
    robot_bins: int = field(metadata=STATIC)


def size_bucket(size: int) -> int:
    """The least of 1 .. 8 and their doublings that is at least `size`: at most a quarter too large."""
    if size <= 8:
        return max(size, 1)
    unit = 1 << ((size - 1).bit_length() - 3)
    return -(-size // unit) * unit


def power_bucket(size: int, least: int = 1) -> int:
    """The least power of two that is at least `size` and `least`."""
    return max(least, 1 << max(size - 1, 0).bit_length())


def pad_tables(compiled: CompiledPlan, seed: int) -> PaddedTables:
    """The tables by tolerance with every size rounded up.

    What the padding holds, and why it changes no count:

    - rows (to a power of two, one spare at least): all zero: no cells, no time, nobody alive, no events. Groups that do
      not exist (G rounded up) stay in the first spare row, `drop_row`, with stride 0; its count is never read.
    - words (to 2, 4, 6, 8, ...): no event has these bits; weights 0.
    - planes (to 3, 4, ...): no weight has these bits.
    - slots of groups that do not exist: guide and thresholds 0 (no word is below): outcome 0, and their stride is 0.
    - entries of all robots after the last one of a map in doubt: not counted, nobody is stopped.
    - histogram bins beyond the largest value: never reached.
    """
    tables = compiled.tables("tolerance")
    groups, events, guide = tables.groups, tables.events, tables.guide
    group_pad = size_bucket(groups.count) - groups.count
    slot_pad = group_pad * groups.members
    row_pad = power_bucket(groups.row_count + 1, 256) - groups.row_count
    words, weighted = (2 * size_bucket(-(-many // 2)) for many in (events.bits.shape[1], events.weighted_words))
    weights = (events.visited_weight, events.survived_weight)
    planes = size_bucket(max(LEAST_PLANES, *(plane_count(weight) for weight in weights)))
    shown = [weight_planes(weight, max(words, weighted), planes)[:, :weighted] for weight in weights]
    counter, draws = words_of(groups, "tolerance")[0], compiled.world.draws
    nothing = np.zeros((len(counter), 1), np.uint32)
    return on_host(
        PaddedTables,
        counter=_grow(counter, slot_pad),
        guide=_grow(nothing if guide is None else guide.table, slot_pad, 0),
        threshold=_grow(nothing if guide is None else guide.threshold, slot_pad, 0),
        first_row=_grow(groups.first_row, group_pad, fill=groups.row_count, dtype=np.int32),
        stride=_grow(groups.stride, group_pad, 0, dtype=np.int32),
        visited=_grow(events.own_visited, row_pad),
        survived=_grow(events.own_survived, row_pad),
        time=_grow(tables.time, row_pad),
        alive=_grow(tables.alive, row_pad),
        bits=_grow(events.bits, row_pad, words - events.bits.shape[1]),
        visited_planes=shown[0],
        survived_planes=shown[1],
        joint=None
        if tables.joint is None or draws is None
        else pad_draws(tables.joint, own_key(seed, draws.purpose), slot_pad),
        drop_row=np.int32(groups.row_count),
        mantissa=0 if guide is None else guide.mantissa,
        bisections=0 if guide is None else guide.bisections,
        cell_bins=power_bucket(compiled.accessible + 1, 256),
        time_bins=power_bucket(compiled.last_step + 1, 256),
        robot_bins=power_bucket(compiled.robots + 1, 16),
    )


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


def _grow(array: NDArray, *pads: int, fill: int = 0, dtype: type = np.uint32) -> NDArray:
    """`array` with so many more places at the end of each axis."""
    return np.pad(array, [(0, pad) for pad in pads], constant_values=fill).astype(dtype)
