"""Uncertain maps: latent hazards, and several candidate maps of which one is true (SPEC section 13).

Robots plan on one map, the world's `threat`. The true map of a rollout is drawn once, with separate random numbers, and
then each visit. Axis letters: `M` maps, `C` columns of their probabilities, `N` = H * W cells.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betainc, betaincinv, ndtr, ndtri

from planner.arguments import Numbers, check_word
from planner.errors import WorldError
from planner.failure_model import exposure_of
from planner.world.keys import CHANCE, Quantity, checked_layer, first_of
from planner.world.map_knowledge import Detector, Evidence, evidence_of

HazardKind = Literal["persistent", "consumed"]
SpreadKind = Literal["lognormal", "beta"]
Shared = Literal["common", "level"]
HAZARDS: tuple[HazardKind, ...] = get_args(HazardKind)
SPREADS: tuple[SpreadKind, ...] = get_args(SpreadKind)
SHARED: tuple[Shared, ...] = get_args(Shared)
HAZARD_DRAW, MAP_DRAW = 0, 1
"""Second counter words from which the two kinds of draws get their keys."""
UNIT = 2**24
"""Random numbers are whole numbers of 1 / UNIT."""
QUANTILES = 256
"""Equally likely values of a spread, each the mean over its part, so that the mean over all is p."""
MOST_CHANCES = 2**27
"""Most probabilities of all maps together."""
AMOUNTS = Numbers(0, 1e6, "a standard deviation, or effective sample size,", above=True, below=True)
MOST_LEVELS = 16
"""Levels of a spread `by: level`: the planner's default, p = 0 counted."""
LARGEST = float(np.nextafter(np.float32(1), np.float32(0)))


class Draws(NamedTuple):
    """Draws of a rollout's true map, in integers of 1 / UNIT. Axis `N`.

    A visit's number u1 destroys the robot iff it is below a bound given by the rollout's number u2 of the cell: with a
    `table`, `table[u2 * M >> 24, column]`; else `bound` if u2 is below `there`, and 0 if not.

    Attributes:
        purpose: of the key of u2 (`planner.failure_model.own_key`).
        counter: uint32 `[N]`, second counter word of u2; the first is the rollout's id.
        there: uint32 `[N]`. bound: uint32 `[N]`, the largest possible bound.
        table: uint32 `[M, C]`, no rows for hazards. column: int32 `[N]`.
        spends: whether the first loss in a cell makes it harmless for the rest of the rollout.
    """

    purpose: int
    counter: NDArray[np.uint32]
    there: NDArray[np.uint32]
    bound: NDArray[np.uint32]
    table: NDArray[np.uint32]
    column: NDArray[np.int32]
    spends: bool

    @property
    def sha256(self) -> str:
        """Hash of all data."""
        digest = hashlib.sha256(bytes((self.purpose, self.spends)))
        for array in (self.counter, self.there, self.bound, self.table, self.column):
            digest.update(np.ascontiguousarray(array, dtype="<u4").tobytes())
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Hazard:
    """Latent hazards: each exists or not for a whole rollout; a visit to one destroys the robot with probability h.

    Attributes:
        kind: "persistent", or "consumed": the first loss removes it.
        q: float32 `[H, W]`, probability that it exists. h: float32 `[H, W]`, that a visit to it destroys the robot.
        learn: whether robots estimate hazards from losses and survived visits. detector: also from readings, or None.
    """

    kind: HazardKind
    q: NDArray[np.float32]
    h: NDArray[np.float32]
    learn: bool = False
    detector: Detector | None = None
    key: ClassVar[str] = "latent_hazard"

    @property
    def description(self) -> str:
        """Description for messages."""
        removed = ", removed by the first loss" if self.kind == "consumed" else ""
        return f"{self.kind} hazards: each exists or not for a whole run{removed}{self.learning}"

    @property
    def learning(self) -> str:
        """Description of the estimates; "" without."""
        has = "" if self.detector is None else f", and have {self.detector.description}"
        return f"; robots estimate them{has}" if self.learn else ""

    @property
    def taught(self) -> str:
        """Identity of the data, besides `threat`, that decisions depend on: "" without estimates."""
        detector = [] if self.detector is None else self.detector.array().tolist()
        return f"~{self.draws().sha256}{detector}" if self.learn else ""

    @cached_property
    def evidence(self) -> Evidence:
        """Evidence of losses, survived visits and readings in each cell."""
        return evidence_of(self.q, self.h, self.threat, self.kind == "consumed", self.detector)

    @property
    def threat(self) -> NDArray[np.float32]:
        """float32 `[H, W]`, p = q * h, the robots' prior map."""
        return (self.q.astype(np.float64) * self.h).astype(np.float32)

    def draws(self) -> Draws:
        """The draws of every cell."""
        there, bound = bounds_of(self.q).ravel(), bounds_of(self.h).ravel()
        cells = there.size
        return Draws(
            purpose=HAZARD_DRAW,
            counter=np.arange(cells, dtype=np.uint32),
            there=there,
            bound=np.where(there > 0, bound, np.uint32(0)),
            table=np.zeros((0, 0), dtype=np.uint32),
            column=np.zeros(cells, dtype=np.int32),
            spends=self.kind == "consumed",
        )

    def exposures(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(hazard of a visit to each cell, int64 `[N]`, if the latent hazard exists; empty table)."""
        return exposure_of(np.where(self.q > 0, self.h, 0)).ravel(), np.zeros((0, 0), dtype=np.int64)

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the world file, by name."""
        found: dict[str, NDArray] = {"hazard_kind": np.array(self.kind), "hazard_q": self.q, "hazard_h": self.h}
        found |= {"hazard_learn": np.array(True)} if self.learn else {}
        return found | ({} if self.detector is None else {"hazard_detector": self.detector.array()})


@dataclass(frozen=True, eq=False)
class Uncertain:
    """Equally likely candidates of the true map. A rollout's number selects the row; with `by: level` one per level.

    Attributes:
        chances: float32 `[M, C]`, p. column: int32 `[H, W]`, of each cell; NO_COLUMN on obstacles.
        number: int32 `[H, W]`, which of the rollout's numbers selects the row for the cell: 0, or its level + 1.
        description: for messages.
    """

    chances: NDArray[np.float32]
    column: NDArray[np.int32]
    number: NDArray[np.int32]
    description: str
    key: ClassVar[str] = "map_uncertainty"

    @property
    def count(self) -> int:
        """M."""
        return len(self.chances)

    @property
    def whole(self) -> bool:
        """True if one number selects the whole map: then there are exactly M maps."""
        return not self.number.any()

    def threat_at(self, rows: ArrayLike) -> NDArray[np.float32]:
        """float32 `[H, W]`: the map of these rows `[numbers]`, one for each number of a rollout; NaN: obstacle."""
        row = np.atleast_1d(np.asarray(rows, dtype=np.int64))[self.number]
        return np.where(self.column == NO_COLUMN, np.float32(np.nan), self.chances[row, self.column])

    def plan_on(self, how: float | None) -> NDArray[np.float32]:
        """float32 `[H, W]`: cell-wise mean of the maps, or (`how`) their quantile at this share."""
        if how is None:
            each = self.chances.astype(np.float64).mean(axis=0).astype(np.float32)
        else:
            # A value that occurs: an interpolated quantile would be a level of no map.
            each = np.quantile(self.chances, how, axis=0, method="inverted_cdf")
        return np.where(self.column == NO_COLUMN, np.float32(np.nan), each[self.column])

    def draws(self) -> Draws:
        """The draws of every cell."""
        table, column = bounds_of(self.chances), np.maximum(self.column, 0).ravel()
        # The largest bound of any map: 0 tells kernels that no visit can destroy a robot.
        bound = np.where(self.column.ravel() == NO_COLUMN, np.uint32(0), table.max(axis=0)[column])
        nothing = np.zeros(column.size, dtype=np.uint32)
        number = self.number.ravel().astype(np.uint32)
        return Draws(MAP_DRAW, number, nothing, bound, table, column.astype(np.int32), spends=False)

    def exposures(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(largest hazard of a visit to each cell, int64 `[N]`; hazard of each probability, int64 `[M, C]`)."""
        doses = exposure_of(self.chances)
        return np.where(self.column == NO_COLUMN, 0, doses.max(axis=0)[self.column]).ravel(), doses

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the world file, by name."""
        names = ("chances", "column", "number")
        return {f"uncertain_{name}": getattr(self, name) for name in names} | {
            "uncertain_said": np.array(self.description)
        }


NO_COLUMN = -1


def bounds_of(chance: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Bounds uint32: a 24-bit number n is below the bound iff n / UNIT is below the probability; 0 for NaN."""
    return np.ceil(np.nan_to_num(chance.astype(np.float64)) * UNIT).astype(np.uint32)


def make_hazard(kind: str, q: ArrayLike, h: ArrayLike, free: NDArray[np.bool_], source: str) -> Hazard:
    """Checked latent hazards.

    Args:
        kind: "persistent" or "consumed".
        q: probability of existence, a number or `[H, W]`.
        h: probability that a visit destroys the robot, a number or `[H, W]`.
        free: bool `[H, W]`.
        source: for messages.

    Raises:
        WorldError: names the first invalid cell.
    """
    if kind not in HAZARDS:
        raise WorldError(f"hazard kind is {kind!r}", source=source, expected=" or ".join(("independent", *HAZARDS)))
    there, hit = (_chances(name, value, free, source) for name, value in (("q", q), ("h", h)))
    with np.errstate(invalid="ignore"):
        # A product of 1 would destroy every robot at every visit.
        certain = (there * hit.astype(np.float64)).astype(np.float32) >= 1
    if certain.any():
        problem = f"hazard q * h is 1 {first_of(certain)[1]}"
        raise WorldError(problem, source=source, expected="below 1", fix="make it an obstacle")
    return Hazard(kind, there, hit)


def _chances(name: str, value: ArrayLike, free: NDArray[np.bool_], source: str) -> NDArray[np.float32]:
    """float32 `[H, W]`, NaN on obstacles: probabilities in 0..1 on every free cell, else a WorldError."""
    layer = checked_layer(value, Quantity(f"hazard {name}", CHANCE), free, source)
    chances = np.where(free, layer, np.nan).astype(np.float32)  # type: ignore[arg-type]
    chances.setflags(write=False)
    return chances


def uncertain_in(arrays: Mapping[str, NDArray], free: NDArray[np.bool_], source: str) -> Uncertain:
    """The uncertain maps in the arrays of a world file.

    Args:
        arrays: of the file.
        free: bool `[H, W]`.
        source: for messages.

    Raises:
        WorldError: they are invalid.
    """
    chances, column, number = (arrays[f"uncertain_{name}"] for name in ("chances", "column", "number"))
    whole = all(array.dtype.kind == "i" and array.shape == free.shape for array in (column, number))
    fits = chances.ndim == 2 and chances.dtype == np.float32 and bool(((chances >= 0) & (chances < 1)).all())
    fits = fits and whole and chances.size > 0 and 0 <= number.min() <= number.max() <= MOST_LEVELS
    if not (fits and np.where(free, (column >= 0) & (column < chances.shape[1]), column == NO_COLUMN).all()):
        problem = "uncertain_chances, _column and _number do not fit the map"
        raise WorldError(problem, source=source, expected="chances float32 [M, C], the others int32 [H, W]")
    said = str(arrays.get("uncertain_said", "maps of a world file"))
    return Uncertain(np.ascontiguousarray(chances), column.astype(np.int32), number.astype(np.int32), said)


def maps_of(maps: NDArray[np.float32], description: str) -> Uncertain:
    """Equally likely maps of the same cells.

    Args:
        maps: float32 `[M, H, W]`, all with the obstacles of the first.
        description: for messages.
    """
    free = ~np.isnan(maps[0])
    column = np.full(free.shape, NO_COLUMN, dtype=np.int32)
    column[free] = np.arange(int(free.sum()))
    return Uncertain(np.ascontiguousarray(maps[:, free]), column, np.zeros(free.shape, dtype=np.int32), description)


def spread_of(
    threat: NDArray[np.float32], levels: NDArray[np.integer], kind: str, amount: float, by: str, source: str
) -> tuple[Uncertain, int]:
    """A spread of p as equally likely maps.

    Args:
        threat: float32 `[H, W]`, means; NaN = obstacle.
        levels: int `[H, W]`, level of each free cell.
        kind: "lognormal", p times a factor of mean 1 whose logarithm has the standard deviation `amount`; or "beta",
            of mean p and with an effective sample size of `amount`.
        amount: see `kind`.
        by: "common", one number for the whole map, or "level".
        source: for messages.

    Returns:
        (maps, number of cells with values cut off below 1).

    Raises:
        WorldError: an invalid argument, or too many distinct threats.
    """
    check_word("kind", kind, SPREADS, WorldError, source)
    check_word("by", by, SHARED, WorldError, source)
    AMOUNTS.check("amount", amount, WorldError, source)
    free = ~np.isnan(threat)
    # One column for each distinct p instead of one for each cell.
    values, places = np.unique(threat[free], return_inverse=True)
    if len(values) * QUANTILES > MOST_CHANCES:
        most = MOST_CHANCES // QUANTILES
        raise WorldError(f"{len(values)} distinct threats", source=source, expected=f"at most {most} with a spread")
    chances = (_lognormal if kind == "lognormal" else _beta)(values.astype(np.float64), amount)
    column = np.full(free.shape, NO_COLUMN, dtype=np.int32)
    column[free] = places
    number = np.where(free, levels + 1, 0) if by == "level" else np.zeros(free.shape)
    cut = int(np.isin(column, np.flatnonzero((chances > LARGEST).any(axis=0))).sum())
    description = f"{QUANTILES} equally likely values of a {kind} spread of {amount:g}, {by}"
    # p = 1 is not representable: the largest float32 below it takes its place.
    table = np.minimum(chances, LARGEST).astype(np.float32)
    return Uncertain(table, column, number.astype(np.int32), description), cut


def _lognormal(p: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """float64 `[QUANTILES, C]`: means of p * exp(sigma * z - sigma**2 / 2) over equally likely parts of z."""
    # Means over parts of equal probability, in closed form: their mean is exactly p.
    edges = ndtri(np.arange(QUANTILES + 1) / QUANTILES)
    factor = QUANTILES * np.diff(ndtr(edges - sigma))
    return factor[:, None] * p[None, :]


def _beta(p: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """float64 `[QUANTILES, C]`: means of Beta(p * size, (1 - p) * size) over equally likely parts; 0 for p = 0."""
    safe, edges = p == 0, np.arange(QUANTILES + 1)[:, None] / QUANTILES
    a = np.where(safe, 0.5, p) * size
    b = size - a
    means = QUANTILES * np.diff(betainc(a + 1, b, betaincinv(a, b, edges)), axis=0) * p
    return np.where(safe, 0.0, means)
