"""Small pieces that Numba lacks: wide vectors, a population count, and Threefry on uint32 scalars."""

# Numba's integer rules turn uint32 sums into uint64: every step is cast back, and LLVM then drops the casts.

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from planner.jit import threaded

PARITY = np.uint32(0x1BD11BDA)
WIDEST = '"prefer-vector-width"="512"'


@intrinsic
def wide_vectors(typing_context: Any) -> Any:
    """Called first in a function: lets LLVM use 512-bit vectors in it where there are any (its default is 256 bits).

    Worth 1.5 times the random words a second on AVX-512; without effect on other machines.
    """

    def add_attribute(_context: Any, builder: Any, _signature: Any, _args: Any) -> Any:
        set.add(builder.function.attributes, WIDEST)
        return _context.get_dummy_value()

    return types.none(), add_attribute


@intrinsic
def popcount(typing_context: Any, word: Any) -> Any:
    """Bits set in a uint32 word."""
    return types.uint32(types.uint32), lambda _context, builder, _signature, args: builder.ctpop(args[0])


@threaded
def _round(x0, x1, rotation):  # type: ignore[no-untyped-def]
    x0 = np.uint32(x0 + x1)
    x1 = np.uint32(np.uint32(x1 << np.uint32(rotation)) | np.uint32(x1 >> np.uint32(32 - rotation)))
    return x0, np.uint32(x1 ^ x0)


@threaded
def _first_rounds(x0, x1):  # type: ignore[no-untyped-def]
    x0, x1 = _round(x0, x1, 13)
    x0, x1 = _round(x0, x1, 15)
    x0, x1 = _round(x0, x1, 26)
    return _round(x0, x1, 6)


@threaded
def _second_rounds(x0, x1):  # type: ignore[no-untyped-def]
    x0, x1 = _round(x0, x1, 17)
    x0, x1 = _round(x0, x1, 29)
    x0, x1 = _round(x0, x1, 16)
    return _round(x0, x1, 24)


@threaded
def threefry(key0, key1, counter0, counter1):  # type: ignore[no-untyped-def]
    """Words (x0, x1) of Threefry-2x32-20; every argument and both words uint32. Equal to `planner.threefry`."""
    key2 = np.uint32(np.uint32(key0 ^ key1) ^ PARITY)
    x0, x1 = _first_rounds(np.uint32(counter0 + key0), np.uint32(counter1 + key1))
    x0, x1 = _second_rounds(np.uint32(x0 + key1), np.uint32(np.uint32(x1 + key2) + np.uint32(1)))
    x0, x1 = _first_rounds(np.uint32(x0 + key2), np.uint32(np.uint32(x1 + key0) + np.uint32(2)))
    x0, x1 = _second_rounds(np.uint32(x0 + key0), np.uint32(np.uint32(x1 + key1) + np.uint32(3)))
    x0, x1 = _first_rounds(np.uint32(x0 + key1), np.uint32(np.uint32(x1 + key2) + np.uint32(4)))
    return np.uint32(x0 + key2), np.uint32(np.uint32(x1 + key0) + np.uint32(5))


@intrinsic
def leading_zeros(typing_context: Any, word: Any) -> Any:
    """Zeros before the first 1 of a uint32 word that is not 0."""

    def count(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.ctlz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint32(types.uint32), count


@intrinsic
def or_words(typing_context: Any, into: Any, into_at: Any, of: Any, of_at: Any, block: Any) -> Any:
    """`into[into_at + j] |= of[of_at + j]` for j below the length of the tuple `block`, as one vector operation.

    `into` and `of`: flat contiguous uint32 arrays; the places are not checked. (Written as a loop it stays scalar: LLVM
    cannot know that the arrays do not overlap.)
    """
    words = len(block)

    def combine(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.VectorType(ir.IntType(32), words)

        def pointer(place: int) -> Any:
            data = context.make_array(signature.args[place])(context, builder, args[place]).data
            return builder.bitcast(builder.gep(data, [args[place + 1]]), vector.as_pointer())

        target = pointer(0)
        joined = builder.or_(builder.load(target, align=4), builder.load(pointer(2), align=4))
        builder.store(joined, target, align=4)
        return context.get_dummy_value()

    return types.none(into, types.int64, of, types.int64, block), combine
