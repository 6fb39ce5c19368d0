"""Several rollouts at a time drawn for and parted, in vector registers.

Part of `planner.kernels.luck`, whose `threefry` LLVM makes vectors of by itself; but then each rollout is put in its
place alone, and both together take twice as long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from planner.threefry import threefry2x32

GROUP = 8
"""Lanes that are put in their places at once."""
ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
PARITY = np.uint32(0x1BD11BDA)
BYTE, WORD, PLACE = ir.IntType(8), ir.IntType(32), ir.IntType(64)
WORDS = ir.VectorType(WORD, GROUP)


def part_lanes(ids, words, at, gone, keys, counter, limits, lanes):
    """Draw for the `ids` uint32 `[B]` from `at` on, as many as the tuple `lanes` is long, a multiple of GROUP.

    Of the first `at`, `gone` were hit and are in `words` `[B]`. Who is not hit goes behind the others, to
    `ids[at - gone:]`, who is to `words[gone:]`, both in their order; returns how many were hit. What is behind those
    put there, up to `at + len(lanes)`, is scratch. `keys`, `counter`: of Threefry; `limits`: the word from which on it
    hits, and which of its bits are turned over before.
    """
    mine = ids[at : at + len(lanes)].copy()
    hit = threefry2x32(keys, mine, counter)[0] ^ limits[1] >= limits[0]
    count = np.count_nonzero(hit)
    ids[at - gone : at - gone + len(mine) - count] = mine[~hit]
    words[gone : gone + count] = mine[hit]
    return count


@overload(part_lanes)
def _compiled_part_lanes(ids, words, at, gone, keys, counter, limits, lanes):
    def part(ids, words, at, gone, keys, counter, limits, lanes):
        return _part_lanes(ids, words, at, gone, keys, counter, limits, lanes)

    return part


@intrinsic
def _part_lanes(
    typing_context: Any,
    ids: Any, words: Any, at: Any, gone: Any, keys: Any, counter: Any, limits: Any, lanes: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        ids, words = (context.make_array(signature.args[i])(context, builder, args[i]).data for i in (0, 1))
        at, gone, keys, counter, limits = args[2:7]
        kept = builder.sub(at, gone)
        permutes = "+avx2" in context.codegen().magic_tuple()[2].split(",")
        put = _put_permuted if permutes else _put_each
        mine = builder.load(_vector_at(builder, ids, at, ir.VectorType(WORD, len(lanes))), align=4)
        hit = _draw(
            builder, mine, cgutils.unpack_tuple(builder, keys, 2), counter, cgutils.unpack_tuple(builder, limits, 2)
        )
        for first in range(0, len(lanes), GROUP):
            group = ir.Constant(WORDS, list(range(first, first + GROUP)))
            some, hit_some = (builder.shuffle_vector(vector, vector, group) for vector in (mine, hit))
            # Eight answers are one byte: the number of a row in the table of orders.
            members = builder.zext(builder.bitcast(hit_some, BYTE), PLACE)
            put(builder, some, members, ids, kept, words, gone)
            count = builder.ctpop(members)
            kept, gone = builder.add(kept, builder.sub(PLACE(GROUP), count)), builder.add(gone, count)
        return builder.sub(gone, args[3])

    place = types.int64
    return place(ids, words, place, place, keys, types.uint32, limits, lanes), generate


def _vector_at(builder: Any, data: Any, place: Any, kind: Any) -> Any:
    return builder.bitcast(builder.gep(data, [place]), kind.as_pointer())


def _draw(builder: Any, ids: Any, keys: Any, counter: Any, limits: Any) -> Any:
    """Who is hit, a bit a lane, by the first of Threefry's words."""
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
    return builder.icmp_unsigned(">=", builder.xor(x0, in_all(limits[1])), in_all(limits[0]))


def _put_permuted(builder: Any, some: Any, hit: Any, ids: Any, kept: Any, words: Any, gone: Any) -> None:
    """By an instruction of AVX2, in an order that is read from a table for every set of lanes: its members first."""
    orders = [lane for members in range(256) for lane in sorted(range(GROUP), key=lambda one: ~members >> one & 1)]
    kind = ir.ArrayType(BYTE, len(orders))
    table = builder.module.globals.get("orders_of_lanes")
    if table is None:
        table = cgutils.global_constant(builder, "orders_of_lanes", ir.Constant(kind, bytearray(orders)))
    permuted = ir.FunctionType(WORDS, [WORDS, WORDS])
    permute = cgutils.get_or_insert_function(builder.module, permuted, "llvm.x86.avx2.permd")
    for data, place, members in ((ids, kept, builder.xor(hit, PLACE(255))), (words, gone, hit)):
        row = builder.gep(table, [PLACE(0), builder.mul(members, PLACE(GROUP))])
        # All eight lanes are written, members first; what is behind them is overwritten by the next.
        order = builder.load(builder.bitcast(row, ir.VectorType(BYTE, GROUP).as_pointer()), align=1)
        first = builder.call(permute, [some, builder.zext(order, WORDS)])
        builder.store(first, _vector_at(builder, data, place, WORDS), align=4)


def _put_each(builder: Any, some: Any, hit: Any, ids: Any, kept: Any, words: Any, gone: Any) -> None:
    """Lane after lane, without a jump: to both places, of which one moves on."""
    for lane in range(GROUP):
        one = builder.extract_element(some, WORD(lane))
        builder.store(one, builder.gep(ids, [kept]))
        builder.store(one, builder.gep(words, [gone]))
        is_hit = builder.and_(builder.lshr(hit, PLACE(lane)), PLACE(1))
        kept, gone = builder.add(kept, builder.xor(is_hit, PLACE(1))), builder.add(gone, is_hit)
