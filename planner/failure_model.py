"""What robots bear before they stop (SPEC section 14): how they wear, and how much exposure counts on each of them.

Simulators know neither. A robot is stopped once its exposure reaches its tolerance, and both say what tolerances are;
asked the other way round, which Exp(1) tolerances an exposure reaches (`fresh`), sets of rollouts part as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gamma

from planner.arguments import argument, check_each
from planner.errors import UsageError
from planner.simulator.thresholds import CERTAIN, DIGITS, MOST, SCALE, UNIT, threefry2x32, tolerance_of, unworn

OWN_KEYS = 0x48415A44
"""First counter word of the keys for hazards and maps."""


def key_of(seed: int) -> tuple[int, int]:
    """The generator's key: the two 32-bit halves of a seed `0 <= seed < 2**64`, low first."""
    return seed & 0xFFFFFFFF, seed >> 32


@lru_cache
def own_key(seed: int, purpose: int) -> tuple[int, int]:
    """The key of the numbers that say what is true in a rollout (SPEC section 13): one for hazards, one for maps."""
    x0, x1 = threefry2x32(key_of(seed), OWN_KEYS, purpose)
    return int(x0), int(x1)


# Failure thresholds (SPEC section 14): what a robot bears, and what a visit adds, in whole units of 2**-32 nat.
#
# Independent checks are the same law as one number a robot: a visit of threat p adds e(p) = -ln(1 - p) to its exposure,
# and the visit at which the exposure reaches the robot's tolerance, an Exp(1) amount drawn once a rollout, stops it.
# Integers alone decide, so every engine on every platform stops the same robots.

LUCK_DRAW = 2
"""Second word of the counter under which the tolerances have their key."""
SURE = 1e-3
"""How far from a half a float64 has to be to round as the exact value does: its error is below 1e-4 units."""


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


def least_word(exposure: ArrayLike) -> NDArray[np.int64]:
    """The least word whose tolerance is at most the exposure (int64), so that its robot is stopped; 2**32: none is."""
    borne = np.asarray(exposure, dtype=np.int64)
    low, high = np.zeros_like(borne), np.full_like(borne, UNIT)
    for _ in range(33):
        middle = np.minimum((low + high) >> 1, UNIT - 1)
        stops = tolerance_of(middle) <= borne
        low, high = np.where(stops | (low == high), low, middle + 1), np.where(stops, middle, high)
    return high


def key_of_luck(seed: int) -> tuple[int, int]:
    """The key under which tolerances are drawn."""
    return own_key(seed, LUCK_DRAW)


def tolerances(seed: int, rollouts: ArrayLike, robots: int) -> NDArray[np.int64]:
    """T, int64 `[B, K]`, of robots 0 .. K - 1 in these rollouts `[B]`: the same in teams of every size."""
    ids = np.asarray(rollouts, dtype=np.uint32)
    return tolerance_of(threefry2x32(key_of_luck(seed), ids[:, None], np.arange(robots, dtype=np.uint32))[0])


def susceptible(tolerance: ArrayLike, hazard_multiplier: float) -> NDArray[np.int64]:
    """The tolerances of a robot on which exposure counts so many times (`planner.arguments`)."""
    borne, times = np.asarray(tolerance, dtype=np.int64), round(hazard_multiplier * SCALE)
    return np.maximum(1, (borne // times << 16) + ((borne % times << 16) // times))


def worn(tolerance: ArrayLike, shape: float) -> NDArray[np.int64]:
    """Weibull tolerances of mean 1 and this shape (`planner.arguments`) in place of Exp(1) ones: robots wear out."""
    borne = np.asarray(tolerance, dtype=np.int64)
    if shape == 1:
        return borne
    octave = np.maximum(np.frexp(borne.astype(np.float64))[1].astype(np.int64) - 1 - 6, 0)
    node = np.where(borne < 64, borne, 64 * octave + (borne >> octave))
    rest = borne & ((np.int64(1) << octave) - 1)
    part = (rest << 16) >> octave
    nodes = wear_nodes(float(shape))
    return nodes[node] + ((nodes[node + 1] - nodes[node]) * part >> 16)


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


Susceptibility = float | tuple[float, ...]


@dataclass(frozen=True)
class Bearing:
    """What a team bears.

    Attributes:
        shape: of its Weibull tolerances of mean 1 nat; 1: exponential, nothing wears out.
        susceptibility: how many times exposure counts, one number for all robots or one each.
        begun: the exposure that each robot is known to have borne before rollouts begin, in units of 2**-32 nat; none:
            it does not matter.
        types: of robots, whose maps differ (`World.of_robots`); None: there is one map.
    """

    shape: float = 1.0
    hazard_multiplier: Susceptibility = 1.0
    begun: tuple[int, ...] = ()
    types: str | tuple[str, ...] | None = None

    @property
    def is_plain(self) -> bool:
        """True where the chance of each visit is the map's p, whoever makes it and whatever came before."""
        return self.is_even and self.types is None

    @property
    def is_even(self) -> bool:
        """True where it is p of the robot's own map."""
        return self.shape == 1 and bool((np.asarray(self.hazard_multiplier) == 1).all())

    @property
    def said(self) -> str:
        """What is not plain of it, in words; "" where all is."""
        wear = f"Weibull shape {self.shape:g}" if self.shape != 1 else ""
        numbers = np.unique(np.asarray(self.hazard_multiplier, dtype=np.float64))
        least, most = f"{numbers[0]:g}", f"{numbers[-1]:g}"
        between = least if least == most else f"{least} to {most}"
        count = f"hazard multiplier {between}" if (numbers != 1).any() else ""
        names = (self.types,) if isinstance(self.types, str) else dict.fromkeys(self.types or ())
        kinds = f"robots of type {' and '.join(names)}" if names else ""
        return " and ".join(filter(None, (wear, count, kinds)))

    def to_json(self) -> dict[str, Any]:
        """What is not the default of it, as plan files hold it."""
        of = self.hazard_multiplier
        shape = {} if self.shape == 1 else {"weibull_shape": self.shape}
        kinds = {} if self.types is None else {"types": self.types}
        return shape | kinds | ({} if of == 1 else {"hazard_multiplier": list(of) if isinstance(of, tuple) else of})

    def check(self, robots: int, source: str = "") -> None:
        """Raise PlanError where it is of another team."""
        check_each("hazard_multiplier", self.hazard_multiplier, robots, source)

    def check_known(self, what: str) -> None:
        """Raise UsageError where `what` presumes that every visit of a cell stops any robot with the chance p."""
        if not self.is_plain:
            problem = f"{what} presumes that each visit stops any robot with the map's p; here: {self.said}"
            named = (
                ("weibull_shape", "hazard_multiplier")
                if self.types is None
                else ("weibull_shape", "hazard_multiplier", "types")
            )
            raise UsageError(problem, fix=f"leave {' and '.join(map(argument, named))} out")

    def times(self, robots: int) -> NDArray[np.int64]:
        """Susceptibility of each robot `[K]`, in units of 1 / SCALE."""
        given = self.hazard_multiplier[:robots] if isinstance(self.hazard_multiplier, tuple) else self.hazard_multiplier
        return np.broadcast_to(np.rint(np.asarray(given, dtype=np.float64) * SCALE).astype(np.int64), robots)

    @property
    def nodes(self) -> NDArray[np.int64]:
        """`planner.failure_model.wear_nodes`."""
        return wear_nodes(float(self.shape))

    def fresh(self, exposure: NDArray[np.int64], robot: int) -> NDArray[np.int64]:
        """The largest Exp(1) tolerances that such exposures `[..]` of the robot reach; 0: none."""
        return np.asarray(unworn(exposure, self.nodes, self.times(robot + 1)[robot]))

    def fresh_begun(self, robots: int) -> NDArray[np.int64]:
        """The same of what each robot `[K]` is known to have borne."""
        if not self.begun:
            return np.zeros(robots, dtype=np.int64)
        return np.asarray(unworn(np.array(self.begun[:robots]), self.nodes, self.times(robots)))

    def most(self, robots: int) -> NDArray[np.int64]:
        """The largest exposure after which any luck leaves each robot `[K]` alive."""
        largest = worn(MOST, self.shape)
        return np.array([susceptible(largest, times / SCALE) - 1 for times in self.times(robots).tolist()])

    def tolerances(self, seed: int, rollouts: ArrayLike, robots: int) -> NDArray[np.int64]:
        """What each robot still bears in each rollout, int64 `[B, K]`, beyond what it is known to have borne."""
        drawn, begun = tolerances(seed, rollouts, robots), self.fresh_begun(robots)
        if self.is_even:
            return drawn
        ones = [
            susceptible(worn(drawn[:, one] + begun[one], self.shape), times / SCALE)
            for one, times in enumerate(self.times(robots).tolist())
        ]
        return np.stack(ones, axis=1) - np.array(self.begun[:robots] or [0] * robots)

    def survival(self, exposure: NDArray[np.float64], robot: int) -> NDArray[np.float64]:
        """The chance to bear these exposures (nat), `exp(-(a E / s) ** B)`; from what was borne before on."""
        times, power = self.times(robot + 1)[robot] / SCALE, float(self.shape)

        def nats(borne: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((times * borne / wear_scale(power)) ** power)

        begun = np.array(self.begun[robot] * 2.0**-32 if self.begun else 0.0)
        return np.asarray(np.exp(nats(begun) - nats(begun + exposure)))

    def first_chance(self, chance: float, robot: int = 0) -> float:
        """F(e): that a visit of threat `chance` stops a fresh robot."""
        return 1.0 - float(self.survival(-np.log1p(-np.array(min(chance, 1 - 1e-12))), robot))


PLAIN = Bearing()
