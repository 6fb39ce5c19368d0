"""Bits of sets of robots and of areas, and where a set of rollouts parts.

Part of `planner.kernels.rollouts`, which see. A set is uint64 `[words]`, member i in bit i % 64 of word i / 64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from planner.jit import kernel

ONE = np.uint64(1)


def lowest_bit(word):
    """The number of the lowest bit of a word that is not 0."""
    return (int(word) & -int(word)).bit_length() - 1


@intrinsic
def _trailing_zeros(typing_context: Any, word: Any) -> Any:
    def count(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), count


@overload(lowest_bit)
def _compiled_lowest_bit(word):
    return lambda word: _trailing_zeros(word)


def highest_bit(word):
    """The number of the highest bit of a word that is not 0."""
    return int(word).bit_length() - 1


@intrinsic
def _highest(typing_context: Any, word: Any) -> Any:
    def count(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.sub(ir.Constant(ir.IntType(64), 63), builder.ctlz(args[0], ir.Constant(ir.IntType(1), 1)))

    return types.int64(types.uint64), count


@overload(highest_bit)
def _compiled_highest_bit(word):
    return lambda word: _highest(word)


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
