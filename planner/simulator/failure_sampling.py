"""Failure sampling: a Threefry word for each rollout of a group decides whether a robot is lost, and splits the group.

The open loop draws with the same `threefry`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload, register_jitable

from .jit import UNCOUNTED, kernel, rare_kernel, scalar
from .state import highest_bit
from .thresholds import LOGARITHMS, MOST, exp1_hazard, log_units, threefry2x32

# Several rollouts at a time are drawn for and sorted, in vector registers. LLVM vectorises a plain `threefry`, but then
# each rollout is stored separately, and both together take twice as long.

GROUP = 8
"""Lanes that are stored at once."""
ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
PARITY = np.uint32(0x1BD11BDA)
BYTE, WORD, PLACE = ir.IntType(8), ir.IntType(32), ir.IntType(64)
WORDS = ir.VectorType(WORD, GROUP)


def split_lanes(ids, words, at, gone, keys, counter, limit, lanes):
    """Draw for `len(lanes)` rollouts and sort them: those in which the robot survives, and those in which it is lost.

    Args:
        ids: uint32 `[B]`. Survivors are appended at `ids[at - gone:]`, in order.
        words: uint32 `[B]`. The other rollouts are appended at `words[gone:]`, in order.
        at: position of the first rollout to draw for.
        gone: rollouts before it in which the robot is lost.
        keys: two uint32 halves of the Threefry key.
        counter: second word of its counter.
        limit: smallest word for which the robot is lost.
        lanes: a tuple as long as the number of rollouts, a multiple of GROUP.

    Returns:
        How many are lost. Elements up to `at + len(lanes)` after those written are scratch.
    """
    mine = ids[at : at + len(lanes)].copy()
    lost = threefry2x32(keys, mine, counter)[0] >= limit
    count = np.count_nonzero(lost)
    ids[at - gone : at - gone + len(mine) - count] = mine[~lost]
    words[gone : gone + count] = mine[lost]
    return count


@overload(split_lanes)
def _compiled_part_lanes(ids, words, at, gone, keys, counter, limit, lanes):
    def part(ids, words, at, gone, keys, counter, limit, lanes):
        return _part_lanes(ids, words, at, gone, keys, counter, limit, lanes)

    return part


@intrinsic
def _part_lanes(
    typing_context: Any,
    ids: Any, words: Any, at: Any, gone: Any, keys: Any, counter: Any, limit: Any, lanes: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        ids, words = (context.make_array(signature.args[i])(context, builder, args[i]).data for i in (0, 1))
        at, gone, keys, counter, limit = args[2:7]
        kept = builder.sub(at, gone)
        permutes = "+avx2" in context.codegen().magic_tuple()[2].split(",")
        put = _put_permuted if permutes else _put_each
        mine = builder.load(_vector_at(builder, ids, at, ir.VectorType(WORD, len(lanes))), align=4)
        lost = _draw(builder, mine, cgutils.unpack_tuple(builder, keys, 2), counter, limit)
        for first in range(0, len(lanes), GROUP):
            group = ir.Constant(WORDS, list(range(first, first + GROUP)))
            some, lost_some = (builder.shuffle_vector(vector, vector, group) for vector in (mine, lost))
            # The eight results form one byte: the row number in the table of permutations.
            members = builder.zext(builder.bitcast(lost_some, BYTE), PLACE)
            put(builder, some, members, ids, kept, words, gone)
            count = builder.ctpop(members)
            kept, gone = builder.add(kept, builder.sub(PLACE(GROUP), count)), builder.add(gone, count)
        return builder.sub(gone, args[3])

    place = types.int64
    return place(ids, words, place, place, keys, types.uint32, limit, lanes), generate


def _vector_at(builder: Any, data: Any, place: Any, kind: Any) -> Any:
    return builder.bitcast(builder.gep(data, [place]), kind.as_pointer())


def _draw(builder: Any, ids: Any, keys: Any, counter: Any, limit: Any) -> Any:
    """Bit of each lane: whether the first Threefry word reaches the limit."""
    kind, (key0, key1) = ids.type, keys

    def constant(value: int) -> Any:
        return ir.Constant(kind, [value] * kind.count)

    def in_all(value: Any) -> Any:
        one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, WORD(0))
        return builder.shuffle_vector(one, one, constant(0))

    turned = ir.FunctionType(kind, [kind] * 3)
    turn = cgutils.get_or_insert_function(builder.module, turned, f"llvm.fshl.v{kind.count}i32")
    schedule = key0, key1, builder.xor(builder.xor(key0, key1), WORD(int(PARITY)))
    x0, x1 = builder.add(ids, in_all(key0)), in_all(builder.add(counter, key1))
    for part in range(5):
        for rotation in ROTATIONS[part % 2]:
            x0 = builder.add(x0, x1)
            x1 = builder.xor(builder.call(turn, [x1, x1, constant(rotation)]), x0)
        x0 = builder.add(x0, in_all(schedule[(part + 1) % 3]))
        x1 = builder.add(x1, in_all(builder.add(schedule[(part + 2) % 3], WORD(part + 1))))
    return builder.icmp_unsigned(">=", x0, in_all(limit))


def _put_permuted(builder: Any, some: Any, lost: Any, ids: Any, kept: Any, words: Any, gone: Any) -> None:
    """Store with an AVX2 permutation, read from a table for every set of lanes: the lanes of the set come first."""
    orders = [lane for members in range(256) for lane in sorted(range(GROUP), key=lambda one: ~members >> one & 1)]
    kind = ir.ArrayType(BYTE, len(orders))
    table = builder.module.globals.get("orders_of_lanes")
    if table is None:
        table = cgutils.global_constant(builder, "orders_of_lanes", ir.Constant(kind, bytearray(orders)))
    permuted = ir.FunctionType(WORDS, [WORDS, WORDS])
    permute = cgutils.get_or_insert_function(builder.module, permuted, "llvm.x86.avx2.permd")
    for data, place, members in ((ids, kept, builder.xor(lost, PLACE(255))), (words, gone, lost)):
        row = builder.gep(table, [PLACE(0), builder.mul(members, PLACE(GROUP))])
        # All eight lanes are stored; those after the set's lanes are overwritten by the next store.
        order = builder.load(builder.bitcast(row, ir.VectorType(BYTE, GROUP).as_pointer()), align=1)
        first = builder.call(permute, [some, builder.zext(order, WORDS)])
        builder.store(first, _vector_at(builder, data, place, WORDS), align=4)


def _put_each(builder: Any, some: Any, lost: Any, ids: Any, kept: Any, words: Any, gone: Any) -> None:
    """Store lane after lane without a branch: to both places, of which one advances."""
    for lane in range(GROUP):
        one = builder.extract_element(some, WORD(lane))
        builder.store(one, builder.gep(ids, [kept]))
        builder.store(one, builder.gep(words, [gone]))
        is_lost = builder.and_(builder.lshr(lost, PLACE(lane)), PLACE(1))
        kept, gone = builder.add(kept, builder.xor(is_lost, PLACE(1))), builder.add(gone, is_lost)


# Numba's integer rules turn uint32 sums into uint64: every step is cast back, and LLVM drops the casts.


register_jitable(**UNCOUNTED)(log_units)
register_jitable(**UNCOUNTED)(exp1_hazard)

MANY, SOME = (0,) * (4 * GROUP), (0,) * GROUP
"""Lanes that keep a core busy, and the fewest that are worth a vector."""


@scalar
def threefry(key0, key1, counter0, counter1):
    """Words (x0, x1) of Threefry-2x32 with 20 rounds; equal to `planner.simulator.thresholds.threefry2x32`.

    Args:
        key0, key1: uint32 halves of the key.
        counter0, counter1: uint32 words of the counter: rollout and purpose.

    Returns:
        Two uint32 words.

    Source: Salmon et al. (2011); SPEC section 6.
    """
    schedule = key0, key1, np.uint32(np.uint32(key0 ^ key1) ^ PARITY)
    x0, x1 = np.uint32(counter0 + key0), np.uint32(counter1 + key1)
    # Loops of constant length: LLVM unrolls them and knows every index.
    for part in range(5):
        for rotation in ROTATIONS[part % 2]:
            x0 = np.uint32(x0 + x1)
            x1 = np.uint32(np.uint32(x1 << np.uint32(rotation)) | np.uint32(x1 >> np.uint32(32 - rotation)))
            x1 = np.uint32(x1 ^ x0)
        x0 = np.uint32(x0 + schedule[(part + 1) % 3])
        x1 = np.uint32(np.uint32(x1 + schedule[(part + 2) % 3]) + np.uint32(part + 1))
    return x0, x1


@kernel
def exp1_threshold(word):
    """The failure threshold of one random word (`planner.simulator.thresholds.threshold_of`)."""
    odd = (np.int64(word) << 1) + 1
    return log_units(odd, highest_bit(np.uint64(odd)), LOGARITHMS)


@kernel
def threshold_or_bound(how, rollout, robot, exposure):
    """The failure threshold in a rollout if the hazard `exposure` reaches it; else a lower bound above the hazard."""
    word = threefry(how.key0, how.key1, rollout, np.uint32(robot))[0]
    # A lower bound without a logarithm, which nearly always suffices.
    surely = 2**32 - 1 - np.int64(word)  # 1 - x <= -ln x
    return exp1_threshold(word) if surely <= exposure else surely


@kernel
def least_word(exposure):
    """The smallest word whose threshold `exposure`, 1 or more, reaches (`planner.failure_model.least_word`).

    A threshold is within 0.52 units of the exact one, which falls by 2**32 / x from word to word. So the search starts
    that far below the exact position and steps up to the first word that integers confirm.
    """
    # Floats only choose the start, integers decide: the same word on every platform.
    place = math.exp(-exposure * 2.0**-32)
    word = max(np.int64(math.ceil(place * (2.0**32 - 0.53) - 0.50001)), 0)
    while exp1_threshold(word) > exposure:
        word += 1
    return word


@kernel
def fresh(t, robot, exposure):
    """The Exp(1) hazard that equals a robot's cumulative hazard under its Weibull shape and multiplier."""
    return exposure if not t.wears else _fresh(t, robot, exposure)


@rare_kernel
def _fresh(t, robot, exposure):
    return exp1_hazard(exposure, t.nodes, t.times[robot]) - t.begun[robot]


@rare_kernel
def lost_mass(t, s, robot, place, mass):
    """Mass of a tree's branch that a visit destroys, rounded; adds the visit to the robot's cumulative hazard."""
    if not t.wears:
        return np.int64(t.chance[place] * mass + 0.5)
    before = fresh(t, robot, s.robots[robot].cumulative_hazard)
    s.robots[robot].cumulative_hazard += t.exposure[place]
    more = fresh(t, robot, s.robots[robot].cumulative_hazard) - before
    return np.int64(-math.expm1(-more * 2.0**-32) * mass + 0.5)


@kernel
def first_lost(t, s, c, w, how, ids, robot, cell, place):
    """Sort the ids of the group at a visit: rollouts in which the robot survives come first, both parts in order.

    The robot's random word in a rollout decides, against one limit for the whole group. No word is drawn while the
    cumulative hazard is below the lower bound on the thresholds. A tree has no ids: its mass splits by the probability.

    Args:
        place: index of the visit in the tables (`visit_of`).

    Returns:
        Position of the first rollout that loses the robot.
    """
    first, last = s.marks.first, s.marks.last
    if t.loses:
        return first if t.loses(robot, s.marks.step, cell) else last
    if how.cut > 0:
        c.histories[2] += 1
        return last - lost_mass(t, s, robot, place, last - first)
    # The state of an uncertain cell differs from rollout to rollout: no limit serves the whole group.
    if t.uncertain:
        return split_uncertain(t, ids, w, how, first, last, robot, cell)
    s.robots[robot].cumulative_hazard += t.exposure[place]
    cumulative_hazard = fresh(t, robot, s.robots[robot].cumulative_hazard)
    # Most visits end here, whatever the size of the group.
    if cumulative_hazard < s.robots[robot].least_threshold:
        return last
    return split_by_threshold(s, w, how, ids, robot, cumulative_hazard)


@rare_kernel
def split_by_threshold(s, w, how, ids, robot, cumulative_hazard):
    """`first_lost` by the failure thresholds of the group."""
    first, last = s.marks.first, s.marks.last
    if last - first == 1:
        # A single rollout has one threshold, so its word is drawn once for each robot.
        s.robots[robot].least_threshold = exp1_threshold(threefry(how.key0, how.key1, ids[first], np.uint32(robot))[0])
        return first if cumulative_hazard >= s.robots[robot].least_threshold else last
    if last - first < GROUP:
        lost_from, s.robots[robot].least_threshold = split_few(ids, w.words, how, first, last, robot, cumulative_hazard)
        return lost_from
    # Survivors have a threshold above the hazard; their exact minimum is not worth computing for a large group.
    s.robots[robot].least_threshold = cumulative_hazard + 1
    return part(ids, w.words, how, first, last, np.uint32(robot), np.uint32(least_word(cumulative_hazard)))


@kernel
def part(ids, words, how, first, last, counter, limit):
    """Sort `ids[first:last]` in place by whether their word reaches the limit; the position of the first that does."""
    if last - first == 1:
        return first if threefry(how.key0, how.key1, ids[first], counter)[0] >= limit else last
    return first + split_many(ids[first:last], words[: last - first], how.key0, how.key1, counter, limit)


@rare_kernel
def split_few(ids, words, how, first, last, robot, cumulative_hazard):
    """The same by the robot's thresholds; and the lowest threshold of the rollouts in which it survives."""
    gone, least = 0, np.int64(MOST)
    for place in range(first, last):
        one = ids[place]
        mine = threshold_or_bound(how, one, robot, cumulative_hazard)
        # Stored to both places without a branch: losses cannot be predicted, and only one of the two advances.
        ids[place - gone], words[gone] = one, one
        gone += np.int64(mine <= cumulative_hazard)
        least = min(least, mine if mine > cumulative_hazard else np.int64(MOST))
    return first + _join(ids[first:last], words, gone), least


@rare_kernel
def split_many(ids, words, key0, key1, counter, limit):
    """The same for all of `ids` `[B]`; `words` `[B]` is scratch. Returns how many survive."""
    # Four vectors at a time hide the latency of Threefry's chain; one at a time handles most of the rest.
    at, gone = _part_by(ids, words, 0, 0, (key0, key1), counter, limit, MANY)
    at, gone = _part_by(ids, words, at, gone, (key0, key1), counter, limit, SOME)
    for index in range(at, len(ids)):
        one = ids[index]
        ids[index - gone], words[gone] = one, one
        gone += np.int64(threefry(key0, key1, one, counter)[0] >= limit)
    return _join(ids, words, gone)


@kernel
def _part_by(ids, words, at, gone, keys, counter, limit, lanes):
    """`split_lanes` while enough rollouts are left; returns where it ends, and how many are lost by then."""
    while at + len(lanes) <= len(ids):
        gone += split_lanes(ids, words, at, gone, keys, counter, limit, lanes)
        at += len(lanes)
    return at, gone


@rare_kernel
def split_uncertain(t, ids, w, how, first, last, robot, cell):
    """`first_lost` on an uncertain map: each rollout draws the cell too (`planner.world.uncertain_maps.Draws`).

    The remaining threshold of each robot is kept for every rollout.
    """
    mine, room = ids[first:last], w.words[: last - first]
    for index in range(len(mine)):
        left = w.left[mine[index] - w.begin[0]]
        word = own_word(t, how, mine[index], cell)
        left[robot] -= hazard_in_state(t.exposure, t.doses, t.there, t.column, cell, word)
        room[index] = left[robot] > 0
    return first + split_ids(mine, room, 1)


@kernel
def own_word(t, how, rollout, cell):
    """The 24 random bits that determine the state of the cell in this rollout."""
    return np.int64(threefry(how.own0, how.own1, rollout, t.own_counter[cell])[0] >> np.uint32(8))


@kernel
def hazard_in_state(of, table, there, columns, place, word):
    """Hazard of a visit, or its bound, for the state of the cell that the word determines.

    Args:
        of: int64 `[A]`, hazards; used where `table` is empty.
        table: int64 `[M, C]`, hazards by quantile of the word, or empty.
        there: int64 `[A]`, of 2**24 words, those for which the hazard exists.
        columns: `[A]`, column of each cell in `table`.
        place: the cell.
        word: 24 bits.

    Source: `planner.world.uncertain_maps.Draws`.
    """
    if len(table) > 0:
        return np.int64(table[word * len(table) >> 24, columns[place]])
    return np.int64(of[place]) if word < there[place] else np.int64(0)


@kernel
def split_ids(ids, words, bound):
    """Sort `ids` by whether their word is at least the bound; returns how many are. `words` becomes scratch."""
    gone = 0
    for index in range(len(ids)):
        one, lost = ids[index], np.int64(words[index] < bound)
        ids[index - gone] = one
        words[gone] = one
        gone += lost
    return _join(ids, words, gone)


@kernel
def _join(ids, words, gone):
    """Append the `gone` first elements of `words` after the survivors in `ids`; returns the number of survivors."""
    kept = len(ids) - gone
    for index in range(gone):
        ids[kept + index] = words[index]
    return kept
