"""The failure model (SPEC section 14): thresholds, hazards of visits, Weibull shape and hazard multipliers.

A robot is lost once its cumulative hazard reaches its failure threshold. The inverse question, which Exp(1) thresholds
a hazard reaches (`fresh`), lets simulators split groups of rollouts without knowing shape or multipliers.
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
from planner.simulator.thresholds import CERTAIN, DIGITS, MOST, SCALE, UNIT, exp1_hazard, threefry2x32, threshold_of

OWN_KEYS = 0x48415A44
"""First counter word from which keys for hazards and maps are derived."""


def key_of(seed: int) -> tuple[int, int]:
    """The generator's key: the two 32-bit halves of a seed `0 <= seed < 2**64`, low first."""
    return seed & 0xFFFFFFFF, seed >> 32


@lru_cache
def own_key(seed: int, purpose: int) -> tuple[int, int]:
    """The key of random numbers for one purpose in a rollout (SPEC section 13).

    Args:
        seed: 0 <= seed < 2**64.
        purpose: hazards, maps, thresholds, ...
    """
    x0, x1 = threefry2x32(key_of(seed), OWN_KEYS, purpose)
    return int(x0), int(x1)


# Failure thresholds (SPEC section 14) and hazards of visits, in whole units of 2**-32 nat.
#
# A visit of threat p adds the hazard e(p) = -ln(1 - p) to the robot's cumulative hazard. The robot is lost at the visit
# at which the sum reaches its threshold, an Exp(1) number drawn once per rollout: the same distribution as independent
# checks. Integers decide, so every engine on every platform loses the same robots.

THRESHOLD_DRAW = 2
"""Second counter word from which thresholds get their key."""
SURE = 1e-3
"""Distance from a half above which a float64 rounds as the exact value does: its error is below 1e-4 units."""


def exposure_of(chance: ArrayLike) -> NDArray[np.int64]:
    """Hazards of visits: e(p) = -ln(1 - p) in hazard units, rounded half to even.

    Where float64 cannot decide the rounding, 40 decimal digits do.

    Args:
        chance: float32, probabilities 0 <= p <= 1; NaN gives 0, p = 1 CERTAIN.

    Returns:
        int64, of the same shape.

    Source: SPEC section 14.
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
    """The least random word whose threshold is at most the hazard, so that the robot is lost; 2**32: none.

    Args:
        exposure: int64, cumulative hazards.
    """
    hazard = np.asarray(exposure, dtype=np.int64)
    low, high = np.zeros_like(hazard), np.full_like(hazard, UNIT)
    for _ in range(33):
        middle = np.minimum((low + high) >> 1, UNIT - 1)
        stops = threshold_of(middle) <= hazard
        low, high = np.where(stops | (low == high), low, middle + 1), np.where(stops, middle, high)
    return high


def threshold_key(seed: int) -> tuple[int, int]:
    """The key of failure thresholds."""
    return own_key(seed, THRESHOLD_DRAW)


def exp1_thresholds(seed: int, rollouts: ArrayLike, robots: int) -> NDArray[np.int64]:
    """Failure thresholds, the same for a robot in teams of every size.

    Args:
        seed: 0 <= seed < 2**64.
        rollouts: ids `[B]`.
        robots: K.

    Returns:
        int64 `[B, K]`, in hazard units.
    """
    ids = np.asarray(rollouts, dtype=np.uint32)
    return threshold_of(threefry2x32(threshold_key(seed), ids[:, None], np.arange(robots, dtype=np.uint32))[0])


def scaled_thresholds(threshold: ArrayLike, hazard_multiplier: float) -> NDArray[np.int64]:
    """Thresholds of a robot with a hazard multiplier: int64, from Exp(1) or Weibull thresholds."""
    hazard, times = np.asarray(threshold, dtype=np.int64), round(hazard_multiplier * SCALE)
    return np.maximum(1, (hazard // times << 16) + ((hazard % times << 16) // times))


def weibull_thresholds(threshold: ArrayLike, shape: float) -> NDArray[np.int64]:
    """Weibull thresholds of mean 1 and this shape, int64, from Exp(1) thresholds by the quantile function."""
    hazard = np.asarray(threshold, dtype=np.int64)
    if shape == 1:
        return hazard
    octave = np.maximum(np.frexp(hazard.astype(np.float64))[1].astype(np.int64) - 1 - 6, 0)
    node = np.where(hazard < 64, hazard, 64 * octave + (hazard >> octave))
    rest = hazard & ((np.int64(1) << octave) - 1)
    part = (rest << 16) >> octave
    nodes = weibull_nodes(float(shape))
    return nodes[node] + ((nodes[node + 1] - nodes[node]) * part >> 16)


def weibull_scale(shape: float) -> float:
    """s, a whole number of 2**-20: the scale of a Weibull threshold of this shape with mean 1."""
    return round(2**20 / float(gamma(1 + 1 / shape))) / 2**20


@cache
def weibull_nodes(shape: float) -> NDArray[np.int64]:
    """The quantile function at 0 .. 63, then 64 nodes per octave, up to an octave beyond the largest threshold.

    int64; empty for shape 1.
    """
    if shape == 1:
        return np.zeros(0, dtype=np.int64)
    octaves = MOST.bit_length() - 5
    places = [*range(64), *((64 + i) << octave for octave in range(octaves) for i in range(64)), 64 << octaves]
    scale = Decimal(weibull_scale(shape)) * UNIT
    power = Decimal(shape)
    return np.array([_weibull_node(Decimal(place) / UNIT, scale, power) for place in places], dtype=np.int64)


def _weibull_node(nats: Decimal, scale: Decimal, power: Decimal) -> int:
    if nats == 0:
        return 0
    return max(1, int((DIGITS.exp(DIGITS.divide(DIGITS.ln(nats), power)) * scale).to_integral_value()))


HazardMultiplier = float | tuple[float, ...]


@dataclass(frozen=True)
class FailureModel:
    """Failure model of a team.

    Attributes:
        shape: Weibull shape of its thresholds, of mean 1 nat; 1: exponential, robots do not wear out.
        hazard_multiplier: multiplier of hazards, one number for all robots or one each.
        begun: cumulative hazard of each robot before rollouts begin, in units of 2**-32 nat; (): irrelevant.
        types: of robots with different maps (`World.of_robots`); None: one map.
    """

    shape: float = 1.0
    hazard_multiplier: HazardMultiplier = 1.0
    begun: tuple[int, ...] = ()
    types: str | tuple[str, ...] | None = None

    @property
    def is_plain(self) -> bool:
        """True if each visit destroys a robot with the map's p, for all robots and whatever happened before."""
        return self.is_even and self.types is None

    @property
    def is_even(self) -> bool:
        """True if each visit destroys a robot with p of its own map."""
        return self.shape == 1 and bool((np.asarray(self.hazard_multiplier) == 1).all())

    @property
    def description(self) -> str:
        """Description of what differs from the plain model; "" if nothing does."""
        shape = f"Weibull shape {self.shape:g}" if self.shape != 1 else ""
        numbers = np.unique(np.asarray(self.hazard_multiplier, dtype=np.float64))
        least, most = f"{numbers[0]:g}", f"{numbers[-1]:g}"
        between = least if least == most else f"{least} to {most}"
        count = f"hazard multiplier {between}" if (numbers != 1).any() else ""
        names = (self.types,) if isinstance(self.types, str) else dict.fromkeys(self.types or ())
        kinds = f"robots of type {' and '.join(names)}" if names else ""
        return " and ".join(filter(None, (shape, count, kinds)))

    def to_json(self) -> dict[str, Any]:
        """Values that differ from the default, as in plan files."""
        of = self.hazard_multiplier
        shape = {} if self.shape == 1 else {"weibull_shape": self.shape}
        kinds = {} if self.types is None else {"types": self.types}
        return shape | kinds | ({} if of == 1 else {"hazard_multiplier": list(of) if isinstance(of, tuple) else of})

    def check(self, robots: int, source: str = "") -> None:
        """Check that it is for a team of this size.

        Raises:
            PlanError: it is for another one.
        """
        check_each("hazard_multiplier", self.hazard_multiplier, robots, source)

    def check_known(self, what: str) -> None:
        """Check that the model is plain; `what`: subject of the message.

        Raises:
            UsageError: it is not.
        """
        if not self.is_plain:
            problem = f"{what} requires the same p for all visits and robots; here: {self.description}"
            named = ("weibull_shape", "hazard_multiplier", "types")[: 2 if self.types is None else 3]
            raise UsageError(problem, fix=f"leave {' and '.join(map(argument, named))} out")

    def times(self, robots: int) -> NDArray[np.int64]:
        """Hazard multiplier of each robot, int64 `[K]`, in units of 1 / SCALE."""
        given = self.hazard_multiplier[:robots] if isinstance(self.hazard_multiplier, tuple) else self.hazard_multiplier
        return np.broadcast_to(np.rint(np.asarray(given, dtype=np.float64) * SCALE).astype(np.int64), robots)

    @property
    def nodes(self) -> NDArray[np.int64]:
        """`weibull_nodes` of the shape."""
        return weibull_nodes(float(self.shape))

    def fresh(self, exposure: NDArray[np.int64], robot: int) -> NDArray[np.int64]:
        """The largest Exp(1) thresholds that these cumulative hazards reach; 0: none.

        Args:
            exposure: int64 `[..]`.
            robot: index.
        """
        return np.asarray(exp1_hazard(exposure, self.nodes, self.times(robot + 1)[robot]))

    def exp1_begun(self, robots: int) -> NDArray[np.int64]:
        """The same for each robot's hazard before rollouts begin, int64 `[K]`."""
        if not self.begun:
            return np.zeros(robots, dtype=np.int64)
        return np.asarray(exp1_hazard(np.array(self.begun[:robots]), self.nodes, self.times(robots)))

    def most(self, robots: int) -> NDArray[np.int64]:
        """The largest cumulative hazard that each robot `[K]` can survive with some threshold, int64."""
        largest = weibull_thresholds(MOST, self.shape)
        return np.array([scaled_thresholds(largest, times) - 1 for times in (self.times(robots) / SCALE).tolist()])

    def thresholds(self, seed: int, rollouts: ArrayLike, robots: int) -> NDArray[np.int64]:
        """Remaining thresholds of robots in rollouts, beyond their hazard so far.

        Args:
            seed: 0 <= seed < 2**64.
            rollouts: ids `[B]`.
            robots: K.

        Returns:
            int64 `[B, K]`.
        """
        drawn, begun = exp1_thresholds(seed, rollouts, robots), self.exp1_begun(robots)
        if self.is_even:
            return drawn
        hazard = weibull_thresholds(drawn + begun, self.shape)
        times = (self.times(robots) / SCALE).tolist()
        scaled = np.stack([scaled_thresholds(hazard[:, one], of) for one, of in enumerate(times)], axis=1)
        return scaled - np.array(self.begun[:robots] or [0] * robots)

    def survival(self, exposure: NDArray[np.float64], robot: int) -> NDArray[np.float64]:
        """Probability to survive further hazards, `exp(-(a E / s) ** B)`, given the hazard so far.

        Args:
            exposure: float64, nats.
            robot: index.
        """
        times, power = self.times(robot + 1)[robot] / SCALE, float(self.shape)

        def nats(hazard: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((times * hazard / weibull_scale(power)) ** power)

        begun = np.array(self.begun[robot] * 2.0**-32 if self.begun else 0.0)
        return np.asarray(np.exp(nats(begun) - nats(begun + exposure)))

    def first_chance(self, chance: float, robot: int = 0) -> float:
        """F(e): probability that a visit of threat `chance` destroys a new robot."""
        return 1.0 - float(self.survival(-np.log1p(-np.array(min(chance, 1 - 1e-12))), robot))


PLAIN = FailureModel()
