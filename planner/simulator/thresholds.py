"""Failure thresholds in whole numbers, and the random words that they are drawn from (SPEC sections 6 and 14)."""

from __future__ import annotations

from decimal import Context, Decimal
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Threefry-2x32 with 20 rounds (Salmon et al. 2011), the only source of randomness, in NumPy.
#
# A draw is addressed by (seed, rollout, robot), so it never depends on earlier draws (SPEC section 6).

ROTATIONS = (13, 15, 26, 6, 17, 29, 16, 24)
SHIFTS = [(np.uint32(left), np.uint32(32 - left)) for left in ROTATIONS]
KEY_PARITY = 0x1BD11BDA


def threefry2x32(
    key: tuple[int, int], counter0: ArrayLike, counter1: ArrayLike
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Words of Threefry-2x32 with 20 rounds.

    Args:
        key: two 32-bit halves.
        counter0, counter1: uint32, broadcast together.

    Returns:
        (x0, x1), uint32.

    Source: Salmon et al. (2011); SPEC section 6.
    """
    key0, key1 = np.uint32(key[0]), np.uint32(key[1])
    schedule = (key0, key1, key0 ^ key1 ^ np.uint32(KEY_PARITY))
    words = np.broadcast_arrays(np.asarray(counter0, np.uint32), np.asarray(counter1, np.uint32))
    with np.errstate(over="ignore"):
        # In place, which halves the time; numbers get an axis, because they cannot be changed in place.
        x0, x1 = (np.atleast_1d(word + half) for word, half in zip(words, schedule, strict=False))
        turned = np.empty_like(x1)
        for group in range(5):
            for left, right in SHIFTS[4 * (group % 2) : 4 * (group % 2) + 4]:
                x0 += x1
                np.right_shift(x1, right, out=turned)
                x1 <<= left
                x1 |= turned
                x1 ^= x0
            x0 += schedule[(group + 1) % 3]
            x1 += schedule[(group + 2) % 3] + np.uint32(group + 1)
    shape = words[0].shape
    return x0.reshape(shape)[()], x1.reshape(shape)[()]


UNIT = 2**32
"""Hazard units per nat."""
CERTAIN = 2**62
"""Hazard of a visit that destroys every robot."""
LEAST, MOST = 1, 98_242_467_570
"""Smallest and largest failure threshold."""
DIGITS = Context(prec=40)
SCALE = 2**16
"""Hazard multipliers are whole numbers of 1 / SCALE."""

_LN2 = int((DIGITS.ln(Decimal(2)) * 2**58).to_integral_value())
LOGARITHMS = np.array(
    [int((DIGITS.ln(Decimal(128 + i) / 128) * 2**58).to_integral_value()) for i in range(129)], dtype=np.int64
)


def log_units(odd: Any, top: Any, logarithms: Any) -> Any:
    """-ln(odd / 2**33) in hazard units, within 0.52.

    Plain int64 arithmetic (floor division and shifts) on arrays or numbers, so that kernels and JAX can use it
    unchanged.

    Args:
        odd: int64, odd numbers below 2**33.
        top: index of the highest bit of each.
        logarithms: LOGARITHMS, as an array of the caller's library.

    Source: SPEC section 14.
    """
    m = odd << (40 - top)
    i = (m - 2**40 + 2**32) >> 33
    d = m - 2**40 - (i << 33)
    t = (d << 21) // (128 + i)
    a = t >> 24
    r2 = a * a >> 20
    r3 = r2 * a >> 30
    r4 = r3 * a >> 30
    q = t - (r2 << 13) + (r3 << 14) // 3 - (r4 << 12)
    return ((33 - top) * _LN2 - (logarithms[i] + (q << 4)) + 2**25) >> 26


def threshold_of(word: ArrayLike) -> NDArray[np.int64]:
    """Failure thresholds of random words: -ln((x + 1/2) / 2**32) in hazard units, decreasing in x.

    Args:
        word: uint32.

    Returns:
        int64, of the same shape.
    """
    odd = 2 * np.asarray(word, dtype=np.int64) + 1
    return log_units(odd, np.frexp(odd.astype(np.float64))[1].astype(np.int64) - 1, LOGARITHMS)


def exp1_hazard(exposure: Any, nodes: NDArray[np.int64], times: Any) -> Any:
    """The largest Exp(1) threshold that a cumulative hazard reaches, under a Weibull shape and a hazard multiplier.

    0 if there is none. A robot is lost exactly if this value reaches the threshold that was drawn for it. Plain int64
    arithmetic on arrays or numbers, as in `log_units`.

    Args:
        exposure: int64, cumulative hazard.
        nodes: int64, of `weibull_nodes`; empty for shape 1.
        times: hazard multiplier in units of 1 / SCALE.

    Source: SPEC section 14.
    """
    some = np.int64(1) * (exposure > 0)
    after = np.minimum(exposure, (2**62 // np.maximum(times, SCALE)) << 16) + some
    cumulative_hazard = (after >> 16) * times + (((after & (SCALE - 1)) * times - some) >> 16)
    if len(nodes) == 0:
        return cumulative_hazard
    cumulative_hazard = np.minimum(cumulative_hazard, nodes[len(nodes) - 1] - 1)
    node = np.searchsorted(nodes, cumulative_hazard, side="right") - 1
    octave = np.maximum((node >> 6) - 1, 0)
    part = (((cumulative_hazard - nodes[node] + 1) << 16) - 1) // (nodes[node + 1] - nodes[node])
    return ((node - (octave << 6)) << octave) + ((((part + 1) << octave) - 1) >> 16)
