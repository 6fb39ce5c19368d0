"""Bits of sets of robots and of areas, and where a set of rollouts parts.

Part of `planner.kernels.rollouts`, which see. A set is uint64 `[words]`, member i in bit i % 64 of word i / 64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from planner.jit import kernel

ONE = np.uint64(1)
NOT_ZERO = ir.Constant(ir.IntType(1), 1)
"""Said of a word whose zeros are counted, so that the machine need not ask."""


def instruction(result: types.Type, of: types.Type, emit: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """A function of one word that is an instruction or two of the machine, for compiled code alone."""

    @intrinsic
    def one(typing_context: Any, word: Any) -> Any:
        return result(of), lambda _context, builder, _signature, args: emit(builder, args[0])

    return one


popcount = instruction(types.uint32, types.uint32, lambda builder, word: builder.ctpop(word))
"""Bits set in a uint32 word."""
leading_zeros = instruction(types.uint32, types.uint32, lambda builder, word: builder.ctlz(word, NOT_ZERO))
"""Zeros before the first 1 of a uint32 word that is not 0."""
_zeros_below = instruction(types.int64, types.uint64, lambda builder, word: builder.cttz(word, NOT_ZERO))
_zeros_above = instruction(types.int64, types.uint64, lambda builder, word: builder.ctlz(word, NOT_ZERO))


def lowest_bit(word):
    """The number of the lowest bit of a word that is not 0."""
    return (int(word) & -int(word)).bit_length() - 1


def highest_bit(word):
    """The number of the highest bit of a word that is not 0."""
    return int(word).bit_length() - 1


@overload(lowest_bit)
def _compiled_lowest_bit(word):
    return lambda word: _zeros_below(word)


@overload(highest_bit)
def _compiled_highest_bit(word):
    return lambda word: 63 - _zeros_above(word)


def fill(bits: NDArray[np.uint64], members: NDArray[np.int64] | list[int] | slice) -> None:
    """Make `members`, numbers `[M]` or a range of them, those of the set `bits` `[W]`, and no others; not compiled."""
    flags = np.zeros(64 * len(bits), dtype=np.bool_)
    flags[members] = True
    bits[:] = np.packbits(flags, bitorder="little").view("<u8")


@kernel
def put(bits, member):
    """Add a member."""
    bits[member >> 6] |= ONE << np.uint64(member & 63)


@kernel
def drop(bits, member):
    """Take a member out."""
    bits[member >> 6] &= ~(ONE << np.uint64(member & 63))


@kernel
def holds(bits, member):
    """Whether it is one of them."""
    return bits[member >> 6] >> np.uint64(member & 63) & ONE != 0
