"""Unknown maps: the true map, the sensor range, and hazard estimates (SPEC section 15).

A world's `threat` is the prior map, on which robots plan; its `knowledge` holds the true map. The true map may also be
drawn for each rollout (`World.uncertainty`); then its obstacles are those of `Knowledge.truth`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isqrt, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import Numbers
from planner.errors import WorldError
from planner.files import Json
from planner.simulator.codes import ALWAYS, NEVER, NO_STEP
from planner.world.keys import CHANCE

# Sensor range: cells within a distance and, with `sight`, not behind obstacles; in integers, exact.

RANGE = Numbers(0, inf, text="0, or a number of cells from 1 on")
FARTHEST = 2**20
"""Cells; more than the size of the largest map."""
MOST_SEEN = 2**26
"""Most cells within range, summed over all cells of a map: 0.3 GB."""


@dataclass(frozen=True)
class Sensor:
    """Sensor of a robot: it sees every cell whose centre is within `range` cells of its own (Euclidean distance).

    With `sight`, only if the segment between the centres crosses the inside of no other obstacle cell.
    """

    range: float = 0.0
    sight: bool = False

    @property
    def square(self) -> int:
        """The largest squared distance that is seen, in cells."""
        return int(min(self.range, FARTHEST) ** 2)

    @property
    def description(self) -> str:
        """Description for messages."""
        if self.range == 0:
            return "robots see nothing"
        far = "everything" if self.range == inf else f"{self.range:g} cell{'s' * (self.range != 1)} far"
        return f"robots see {far}{', not past obstacles' if self.sight else ''}"

    def views(self, free: NDArray[np.bool_], cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Cells in range of given cells.

        Args:
            free: bool `[H, W]`, of the true map.
            cells: int64 `[C]`, indices.

        Returns:
            (begin int64 `[C + 1]`, seen int32): `seen[begin[i]:begin[i + 1]]`, increasing, is seen from `cells[i]`.

        Raises:
            WorldError: too many cells in range.
        """
        if len(cells) * min(4 * self.square + 1, free.size) > MOST_SEEN:
            problem = f"{len(cells)} cells from which {self.description.removeprefix('robots see ')} is seen"
            raise WorldError(
                problem, expected=f"at most {MOST_SEEN} cells in range in all", fix="give a smaller sensor_range"
            )
        height, width = free.shape
        rows, cols = np.divmod(cells, width)
        reach = isqrt(self.square)
        tall, wide = min(reach, height - 1), min(reach, width - 1)
        down_by, right_by = np.ogrid[-tall : tall + 1, -wide : wide + 1]
        who, what = [], []
        # Offsets are in the order of cell indices, so the cells seen from a cell increase too.
        for down, right in (np.argwhere(down_by**2 + right_by**2 <= self.square) - (tall, wide)).tolist():
            inside = (rows + down >= 0) & (rows + down < height) & (cols + right >= 0) & (cols + right < width)
            seers = np.flatnonzero(inside)
            for i, j in _between(down, right) if self.sight else ():
                seers = seers[free[rows[seers] + i, cols[seers] + j]]
            who.append(seers)
            what.append((cells[seers] + down * width + right).astype(np.int32))
        seer = np.concatenate(who)
        begin = np.append(0, np.cumsum(np.bincount(seer, minlength=len(cells))))
        return begin, np.concatenate(what)[np.argsort(seer, kind="stable")]


def _between(down: int, right: int) -> Iterator[tuple[int, int]]:
    """Cells between two cells, `down` and `right` apart, whose inside the segment of the centres crosses.

    The cell (i, j) is crossed iff 2 |down j - right i| < |down| + |right|: neither its sides nor the segment's line
    separate the two. Touching a corner does not count.
    """
    wide = abs(down) + abs(right)
    for i in range(min(down, 0), max(down, 0) + 1):
        for j in range(min(right, 0), max(right, 0) + 1):
            if (i, j) not in ((0, 0), (down, right)) and 2 * abs(down * j - right * i) < wide:
                yield i, j


@dataclass(frozen=True, eq=False)
class Knowledge:
    """The true map of robots that plan on `World.threat`.

    Attributes:
        truth: float32 `[H, W]`, NaN = obstacle; for an uncertain map the one that gives the obstacles.
        sensor: the robots' sensor.
    """

    truth: NDArray[np.float32]
    sensor: Sensor

    @property
    def free(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that are free on the true map."""
        return ~np.isnan(self.truth)

    def safe_without_sensor(self, planned: NDArray[np.bool_]) -> bool:
        """Whether robots without sensor cannot collide: the free cells `planned` `[H, W]` are the true ones."""
        return bool((self.free == planned).all())

    @property
    def description(self) -> str:
        """Description for messages."""
        return f"robots do not know the map; {self.sensor.description}"

    @property
    def sha256(self) -> str:
        """Hash of the true map and the sensor."""
        digest = hashlib.sha256(np.ascontiguousarray(self.truth, dtype="<f4").tobytes())
        digest.update(repr((float(self.sensor.range), self.sensor.sight)).encode())
        return digest.hexdigest()

    def first_seen(self, cells: NDArray[np.integer], alive: NDArray[np.bool_]) -> NDArray[np.int32]:
        """The step at which each cell is first seen, int32 `[N]`, NO_STEP if never.

        Args:
            cells: `[T, K]`, cell of each robot at the end of each step.
            alive: bool `[T, K]`, whether it still uses its sensor.
        """
        when = np.full(self.truth.size, NO_STEP, dtype=np.int32)
        places, first = np.unique(cells[alive], return_index=True)
        steps = np.nonzero(alive)[0][first]
        begin, seen = self.sensor.views(self.free, places.astype(np.int64))
        for number in np.argsort(-steps, kind="stable"):  # the earliest step is written last
            when[seen[begin[number] : begin[number + 1]]] = steps[number]
        return when

    def arrays(self) -> dict[str, Any]:
        """Arrays of the world file, by name."""
        return {"truth": self.truth, "sense": np.array([self.sensor.range, self.sensor.sight], dtype=np.float64)}


def make_sensor(given: float | Sensor | Mapping[str, Any], source: str) -> Sensor:
    """A checked sensor.

    Args:
        given: a range in cells, or `{range, sight}`.
        source: for messages.

    Raises:
        WorldError: it is invalid.
    """
    if isinstance(given, Sensor):
        given = {"range": given.range, "sight": given.sight}
    keys: Json = dict(given) if isinstance(given, Mapping) else {"range": given}
    cells, sight = keys.pop("range", None), keys.pop("sight", False)
    is_range = cells == inf or (RANGE.accepts(cells) and not 0 < cells < 1)
    if keys or not is_range or not isinstance(sight, bool | np.bool_):
        expected = f"{RANGE.expected}; or {{range, sight: true or false}}"
        said = given if is_range or keys else cells
        raise WorldError(f"sensor_range is {said!r:.60}", source=source, expected=expected)
    return Sensor(float(cells), bool(sight))


def make_knowledge(belief: NDArray[np.float32], truth: NDArray[np.float32], sensor: Sensor, source: str) -> Knowledge:
    """The true map of a prior map.

    Args:
        belief: float32 `[H, W]`, the prior map.
        truth: float32 `[H, W]`, the true map.
        sensor: the robots' sensor.
        source: for messages.

    Raises:
        WorldError: another shape, or robots without sensor that could collide with an obstacle.
    """
    if belief.shape != truth.shape:
        problem = f"the true map has shape {list(truth.shape)}"
        raise WorldError(problem, source=source, expected=f"the cells of the prior map, {list(belief.shape)}")
    # Without sensor a robot finds an obstacle only by a collision.
    differ = np.isnan(belief) != np.isnan(truth)
    if sensor.range == 0 and differ.any():
        row, col = np.argwhere(differ)[0].tolist()
        problem = (
            f"robots that see nothing are wrong about an obstacle at [{row}, {col}] ({int(differ.sum())} such cells)"
        )
        raise WorldError(problem, source=source, expected="the same obstacles", fix="give a sensor range of 1 or more")
    return Knowledge(truth, sensor)


# Hazard estimates from losses, survived visits and detectors: log odds, added up in whole numbers.
#
# Bayes' rule, cell by cell: hazards are independent of each other (SPEC section 15). Axis `N` = H * W.

NAT = 2**20
"""Log odds are whole numbers of 1 / NAT."""
VISITS, NATS = 3, 4
"""Classes of estimates that plans distinguish: survived visits; with a detector, nats below and above the prior."""
READING_DRAW = 5
"""Second counter word from which readings get their key."""
Readings = Callable[[int, int, NDArray[np.integer]], NDArray[np.bool_]]
"""`readings(robot, step, cells)`: bool `[n]`, for which of the cells the robot's detector gives an alarm."""


@dataclass(frozen=True)
class Detector:
    """Detector, read by every robot alive at the end of each step, independently for each cell in range.

    Attributes:
        sensor: range of the detector. detect: probability of an alarm at a hazard; false_alarm: elsewhere.
    """

    sensor: Sensor
    detect: float
    false_alarm: float

    @property
    def description(self) -> str:
        """Description for messages."""
        far = self.sensor.description.removeprefix("robots see ")
        return f"a detector, {far}, that finds {self.detect:g} of them and gives {self.false_alarm:g} false alarms"

    @property
    def alarm(self) -> int:
        """Log odds that an alarm adds; ALWAYS without false alarms."""
        return ALWAYS if self.false_alarm == 0 else round(log(self.detect / self.false_alarm) * NAT)

    @property
    def silence(self) -> int:
        """Log odds that silence subtracts; ALWAYS if no hazard is missed."""
        return ALWAYS if self.detect == 1 else round(log((1 - self.false_alarm) / (1 - self.detect)) * NAT)

    def array(self) -> NDArray[np.float64]:
        """Array of the world file."""
        return np.array([self.sensor.range, self.sensor.sight, self.detect, self.false_alarm], dtype=np.float64)


def make_detector(given: object, source: str) -> Detector:
    """A checked detector.

    Args:
        given: `{range, sight, detect, false_alarm}`.
        source: for messages.

    Raises:
        WorldError: it is invalid.
    """
    if not isinstance(given, Mapping) or not {"detect", "false_alarm"} <= given.keys():
        expected = "{range, detect, false_alarm}: hazards are found by detectors, not seen"
        raise WorldError(f"sensor_range is {given!r:.60}", source=source, expected=expected)
    detect, false_alarm = given["detect"], given["false_alarm"]
    sensor = make_sensor({name: given[name] for name in given if name not in ("detect", "false_alarm")}, source)
    CHANCE.check("detect", detect, WorldError, source)
    CHANCE.check("false_alarm", false_alarm, WorldError, source)
    if sensor.range == 0 or detect <= false_alarm:
        problem = (
            f"a detector with range {sensor.range:g}, detect {detect:g}, false_alarm {false_alarm:g} has no effect"
        )
        raise WorldError(problem, source=source, expected="a range of 1 or more, and more alarms where a hazard is")
    return Detector(sensor, float(detect), float(false_alarm))


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence on the hazard in each cell.

    Attributes:
        prior: int64 `[N]`, log odds before the mission.
        survival: int64 `[N]`, log odds that a survived visit subtracts.
        stop: log odds after a loss. detector: or None.
        chances: float32 `[C, N]`, p of robots' plans, by class; NaN: an obstacle, or a certain loss, treated as one.
    """

    prior: NDArray[np.int64]
    survival: NDArray[np.int64]
    stop: int
    detector: Detector | None
    chances: NDArray[np.float32]

    @cached_property
    def step(self) -> NDArray[np.int64]:
        """int64 `[N]`: difference in log odds between classes."""
        return np.full_like(self.prior, NAT) if self.detector else np.maximum(self.survival, 1)

    @property
    def less(self) -> int:
        """Number of classes with lower odds than the prior."""
        return NATS if self.detector else VISITS

    @property
    def more(self) -> int:
        """Number of classes with higher odds than the prior."""
        return NATS if self.detector else 0

    def class_of(self, odds: NDArray[np.int64], cells: NDArray[np.integer]) -> NDArray[np.int64]:
        """Class of each of some cells.

        Args:
            odds: int64 `[N]`, log odds.
            cells: int `[n]`.

        Returns:
            int64 `[n]`.
        """
        now = odds[cells]
        # Rounded towards the prior: a class is reached only by evidence of its full size.
        lost, step = self.prior[cells] - now, self.step[cells]
        steps = np.clip(np.sign(lost) * (np.abs(lost) // step), -self.more, self.less)
        return np.where(now == NEVER, 0, np.where(now == ALWAYS, 1, 2 + self.more + steps))

    def read(self, odds: NDArray[np.int64], cells: NDArray[np.integer], alarms: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Log odds int64 `[n]` of these cells after one reading each.

        Args:
            odds: int64 `[N]`.
            cells: int `[n]`.
            alarms: bool `[n]`.
        """
        assert self.detector is not None
        said = np.where(alarms, self.detector.alarm, -self.detector.silence)
        return added(odds[cells], said)


def added(odds: NDArray[np.int64], said: Any) -> NDArray[np.int64]:
    """Log odds plus evidence, int64; certain states stay."""
    # Certain evidence would overflow a sum: it replaces the log odds instead.
    sure = np.abs(said) == ALWAYS
    return np.where(np.abs(odds) == ALWAYS, odds, np.where(sure, said, odds + np.where(sure, 0, said)))


Chances = NDArray[np.float32]


def evidence_of(q: Chances, h: Chances, threat: Chances, consumed: bool, detector: Detector | None) -> Evidence:
    """Evidence of latent hazards.

    Args:
        q: float32 `[H, W]`, probability that the hazard exists.
        h: float32 `[H, W]`, probability that a visit to it destroys the robot.
        threat: float32 `[H, W]`, q h, the robots' prior map.
        consumed: whether the first loss removes a hazard.
        detector: or None.

    Source: Bayes' rule; SPEC section 15.
    """
    there, hits = (np.nan_to_num(one.ravel().astype(np.float64)) for one in (q, h))
    with np.errstate(divide="ignore"):
        first, passed = np.log(there) - np.log1p(-there), -np.log1p(-hits)
    prior = _whole(first)
    # After a loss a consumed hazard is gone, a persistent one is certain.
    made = Evidence(prior, _whole(passed), NEVER if consumed else ALWAYS, detector, threat.reshape(1, -1))
    steps = np.arange(-made.more, made.less + 1)
    # Other cells never change their class: no evidence can change their estimate.
    uncertain = (there > 0) & (there < 1) & (hits > 0)
    odds = np.where(uncertain, prior, 0) - steps[:, None] * np.where(made.step == ALWAYS, 0, made.step)
    some = np.minimum(hits / (1 + np.exp(-odds / NAT)), np.nextafter(np.float32(1), np.float32(0)))
    # The prior class keeps the map's p exactly, without rounding of the log odds.
    some[steps == 0] = threat.ravel()
    own = np.where(np.isnan(threat.ravel()), np.nan, threat.ravel().astype(np.float64))
    never = np.where((there > 0) & (uncertain | consumed), 0.0, own)
    # A certain loss is treated as an obstacle: p = 1 has no finite cost.
    always = np.where(uncertain, np.where(hits == 1, np.nan, hits), own)
    reached = not consumed or (detector is not None and detector.alarm == ALWAYS)
    rows = [never, always if reached else own, *np.where(uncertain, some, own)]
    chances = np.where(np.isnan(own), np.nan, np.stack(rows)).astype(np.float32)
    return replace(made, chances=chances)


def _whole(nats: NDArray[np.float64]) -> NDArray[np.int64]:
    """In units of 1 / NAT; infinite log odds are certain."""
    finite = np.isfinite(nats)
    return np.where(finite, np.rint(np.where(finite, nats, 0) * NAT), np.sign(nats) * 2.0**62).astype(np.int64)


def chance_of(odds: NDArray[np.int64]) -> NDArray[np.float64]:
    """Probability of a hazard from its log odds."""
    with np.errstate(over="ignore"):
        return np.where(odds == NEVER, 0.0, np.where(odds == ALWAYS, 1.0, 1 / (1 + np.exp(-odds / NAT))))
