"""Luck by tolerance (SPEC section 14): what a robot bears, and what a visit adds, in whole units of 2**-32 nat.

Independent checks are the same law as one number a robot: a visit of threat p adds e(p) = -ln(1 - p) to its exposure,
and the visit at which the exposure reaches the robot's tolerance, an Exp(1) amount drawn once a rollout, stops it.
Integers alone decide, so every engine on every platform stops the same robots.
"""

from __future__ import annotations

from decimal import Context, Decimal
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gamma

from planner.luck_names import LuckName
from planner.threefry import key_of, own_key, threefry2x32

LUCK_DRAW = 2
"""Second word of the counter under which the tolerances have their key."""
UNIT = 2**32
"""Units in a nat."""
CERTAIN = 2**62
"""What a visit adds that stops every robot."""
LEAST, MOST = 1, 98_242_467_570
"""The tolerances that there are."""
DIGITS = Context(prec=40)
SURE = 1e-3
"""How far from a half a float64 has to be to round as the exact value does: its error is below 1e-4 units."""
SCALE = 2**16
"""Susceptibilities are whole numbers of 1 / SCALE."""

_LN2 = int((DIGITS.ln(Decimal(2)) * 2**58).to_integral_value())
LOGARITHMS = np.array(
    [int((DIGITS.ln(Decimal(128 + i) / 128) * 2**58).to_integral_value()) for i in range(129)], dtype=np.int64
)


def exposure_of(chance: ArrayLike) -> NDArray[np.int64]:
    """e(p), int64: -ln(1 - p) * 2**32, rounded half to even, of chances 0 <= p <= 1 (float32).

    NaN adds 0, p = 1 CERTAIN.

    Where float64 cannot tell which way to round, 40 decimal digits do.
    """
    p = np.nan_to_num(np.asarray(chance, dtype=np.float32)).astype(np.float64)
    certain = p >= 1
    value = -np.log1p(-np.where(certain, 0.0, p)) * UNIT
    units = np.asarray(np.rint(value).astype(np.int64))
    for place in np.argwhere(np.abs(value - np.floor(value) - 0.5) < SURE):
        units[tuple(place)] = _rounded(float(p[tuple(place)]))
    return np.where(certain, CERTAIN, units)


@cache
def _rounded(p: float) -> int:
    return int((-DIGITS.ln(DIGITS.subtract(Decimal(1), Decimal(p))) * UNIT).to_integral_value())


def log_units(odd: Any, top: Any, logarithms: Any) -> Any:
    """-ln(odd / 2**33) in units, within .52, of odd numbers below 2**33 whose highest bit is `top`.

    Plain int64 arithmetic (floor division and shifts), of arrays or numbers: kernels and JAX take it as it stands.
    `logarithms`: LOGARITHMS, as an array of theirs.
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


def tolerance_of(word: ArrayLike) -> NDArray[np.int64]:
    """T, int64, of random words (uint32): -ln((x + 1/2) / 2**32), falling in x."""
    odd = 2 * np.asarray(word, dtype=np.int64) + 1
    return log_units(odd, np.frexp(odd.astype(np.float64))[1].astype(np.int64) - 1, LOGARITHMS)


def least_word(exposure: ArrayLike) -> NDArray[np.int64]:
    """The least word whose tolerance is at most the exposure (int64), so that its robot is stopped; 2**32: none is."""
    borne = np.asarray(exposure, dtype=np.int64)
    low, high = np.zeros_like(borne), np.full_like(borne, UNIT)
    for _ in range(33):
        middle = np.minimum((low + high) >> 1, UNIT - 1)
        stops = tolerance_of(middle) <= borne
        low, high = np.where(stops | (low == high), low, middle + 1), np.where(stops, middle, high)
    return high


def key_of_luck(seed: int, luck: LuckName = "tolerance") -> tuple[int, int]:
    """The key under which tolerances are drawn; by step, the seed's own."""
    return own_key(seed, LUCK_DRAW) if luck == "tolerance" else key_of(seed)


def tolerances(seed: int, rollouts: ArrayLike, robots: int) -> NDArray[np.int64]:
    """T, int64 `[B, K]`, of robots 0 .. K - 1 in these rollouts `[B]`: the same in teams of every size."""
    ids = np.asarray(rollouts, dtype=np.uint32)
    return tolerance_of(threefry2x32(key_of_luck(seed), ids[:, None], np.arange(robots, dtype=np.uint32))[0])


def susceptible(tolerance: ArrayLike, susceptibility: float) -> NDArray[np.int64]:
    """The tolerances of a robot on which exposure counts so many times (`planner.limits`)."""
    borne, times = np.asarray(tolerance, dtype=np.int64), round(susceptibility * SCALE)
    return np.maximum(1, (borne // times << 16) + ((borne % times << 16) // times))


def worn(tolerance: ArrayLike, shape: float) -> NDArray[np.int64]:
    """Weibull tolerances of mean 1 and this shape (`planner.limits`) in place of Exp(1) ones: robots wear out."""
    borne = np.asarray(tolerance, dtype=np.int64)
    if shape == 1:
        return borne
    octave = np.maximum(np.frexp(borne.astype(np.float64))[1].astype(np.int64) - 1 - 6, 0)
    node = np.where(borne < 64, borne, 64 * octave + (borne >> octave))
    rest = borne & ((np.int64(1) << octave) - 1)
    part = (rest << 16) >> octave
    nodes = wear_nodes(float(shape))
    return nodes[node] + ((nodes[node + 1] - nodes[node]) * part >> 16)


def unworn(exposure: Any, nodes: NDArray[np.int64], times: Any) -> Any:
    """The largest Exp(1) tolerance that becomes no more than the exposure by `worn`, then by `susceptible`; 0: none.

    So a robot is stopped by an exposure just when this reaches the tolerance it had been drawn with. Plain int64
    arithmetic, of arrays or numbers, as `log_units`.

    nodes: of `wear_nodes`, none for shape 1; times: susceptibility in units of 1 / SCALE.
    """
    some = np.int64(1) * (exposure > 0)
    after = np.minimum(exposure, (2**62 // np.maximum(times, SCALE)) << 16) + some
    borne = (after >> 16) * times + (((after & (SCALE - 1)) * times - some) >> 16)
    if len(nodes) == 0:
        return borne
    borne = np.minimum(borne, nodes[len(nodes) - 1] - 1)
    node = np.searchsorted(nodes, borne, side="right") - 1
    octave = np.maximum((node >> 6) - 1, 0)
    part = (((borne - nodes[node] + 1) << 16) - 1) // (nodes[node + 1] - nodes[node])
    return ((node - (octave << 6)) << octave) + ((((part + 1) << octave) - 1) >> 16)


def wear_scale(shape: float) -> float:
    """s, a whole number of 2**-20, at which a Weibull tolerance of this shape has mean 1."""
    return round(2**20 / float(gamma(1 + 1 / shape))) / 2**20


@cache
def wear_nodes(shape: float) -> NDArray[np.int64]:
    """The quantile function at 0 .. 63, then 64 nodes an octave, an octave beyond the tolerances; none for shape 1."""
    if shape == 1:
        return np.zeros(0, dtype=np.int64)
    octaves = MOST.bit_length() - 5
    places = [*range(64), *((64 + i) << octave for octave in range(octaves) for i in range(64)), 64 << octaves]
    scale = Decimal(wear_scale(shape)) * UNIT
    power = Decimal(shape)
    return np.array([_worn_node(Decimal(place) / UNIT, scale, power) for place in places], dtype=np.int64)


def _worn_node(nats: Decimal, scale: Decimal, power: Decimal) -> int:
    if nats == 0:
        return 0
    return max(1, int((DIGITS.exp(DIGITS.divide(DIGITS.ln(nats), power)) * scale).to_integral_value()))
