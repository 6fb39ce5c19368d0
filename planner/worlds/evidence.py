"""What robots learn of hazards from what happens to them, and from a detector: log odds, added up in whole numbers.

Bayes' rule, cell by cell: a hazard is there or not, independently of all others (SPEC section 15). Axis `N` = H * W.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.errors import WorldError
from planner.worlds.knowledge import make_sense
from planner.worlds.quantities import CHANCE
from planner.worlds.sight import Sense

NAT = 2**20
"""Log odds are whole numbers of 1 / NAT."""
ALWAYS, NEVER = 2**62, -(2**62)
"""That a hazard is there, and that none is."""
VISITS, NATS = 3, 4
"""Classes that plans tell apart: survived visits; with a detector, nats less and more than at first."""
READING_DRAW = 5
"""Second word of the counter under which readings have their key."""
Readings = Callable[[int, int, NDArray[np.integer]], NDArray[np.bool_]]
"""`readings(robot, step, cells)`: for which of the cells its detector gives an alarm, bool `[n]`."""


@dataclass(frozen=True)
class Detector:
    """Read by every live robot at the end of each step, for each cell in range, every time by itself.

    Attributes:
        sense: which cells those are. detect: chance of an alarm where a hazard is; false_alarm: where none is.
    """

    sense: Sense
    detect: float
    false_alarm: float

    @property
    def said(self) -> str:
        """It in words."""
        far = self.sense.said.removeprefix("robots see ")
        return f"a detector, {far}, that finds {self.detect:g} of them and gives {self.false_alarm:g} false alarms"

    @property
    def alarm(self) -> int:
        """What an alarm adds to the log odds; ALWAYS where it is never a false one."""
        return ALWAYS if self.false_alarm == 0 else round(log(self.detect / self.false_alarm) * NAT)

    @property
    def silence(self) -> int:
        """What silence takes from them; ALWAYS where nothing is ever missed."""
        return ALWAYS if self.detect == 1 else round(log((1 - self.false_alarm) / (1 - self.detect)) * NAT)

    def array(self) -> NDArray[np.float64]:
        """What the world file holds of it."""
        return np.array([self.sense.range, self.sense.sight, self.detect, self.false_alarm], dtype=np.float64)


def make_detector(given: object, source: str) -> Detector:
    """A checked detector from `{range, sight, detect, false_alarm}`. Raises WorldError."""
    if not isinstance(given, Mapping) or not {"detect", "false_alarm"} <= given.keys():
        expected = "{range, detect, false_alarm}: hazards are not seen, detectors tell of them"
        raise WorldError(f"sense is {given!r:.60}", source=source, expected=expected)
    detect, false_alarm = given["detect"], given["false_alarm"]
    sense = make_sense({name: given[name] for name in given if name not in ("detect", "false_alarm")}, source)
    CHANCE.check("detect", detect, WorldError, source)
    CHANCE.check("false_alarm", false_alarm, WorldError, source)
    if sense.range == 0 or detect <= false_alarm:
        problem = f"a detector with range {sense.range:g}, detect {detect:g}, false_alarm {false_alarm:g} tells nothing"
        raise WorldError(problem, source=source, expected="a range of 1 or more, and more alarms where a hazard is")
    return Detector(sense, float(detect), float(false_alarm))


def detector_in(arrays: Mapping[str, NDArray], source: str) -> Detector | None:
    """That of a world file's arrays. Raises WorldError."""
    if "hazard_detector" not in arrays:
        return None
    said = arrays["hazard_detector"]
    if said.shape != (4,) or said.dtype.kind != "f" or said[1] not in (0, 1):
        raise WorldError(
            "hazard_detector is no detector", source=source, expected="[range, 0 or 1, detect, false_alarm]"
        )
    numbers = {"range": float(said[0]), "detect": float(said[2]), "false_alarm": float(said[3])}
    return make_detector(numbers | {"sight": bool(said[1])}, source)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What each happening says of the hazard in a cell.

    Attributes:
        prior: int64 `[N]`, log odds at first. survival: int64 `[N]`, what a survived visit takes from them.
        stop: what they are after a stop. detector: or None.
        chances: float32 `[C, N]`, p that robots plan on, by class; NaN: an obstacle, or a sure stop, which is one.
    """

    prior: NDArray[np.int64]
    survival: NDArray[np.int64]
    stop: int
    detector: Detector | None
    chances: NDArray[np.float32]

    @cached_property
    def step(self) -> NDArray[np.int64]:
        """int64 `[N]`: log odds from one class to the next."""
        return np.full_like(self.prior, NAT) if self.detector else np.maximum(self.survival, 1)

    @property
    def less(self) -> int:
        """Classes of fewer odds than at first."""
        return NATS if self.detector else VISITS

    @property
    def more(self) -> int:
        """Classes of more."""
        return NATS if self.detector else 0

    def class_of(self, odds: NDArray[np.int64], cells: NDArray[np.integer]) -> NDArray[np.int64]:
        """int64 `[n]`, the class of each of these cells by the log odds of all, int64 `[N]`."""
        now = odds[cells]
        lost, step = self.prior[cells] - now, self.step[cells]
        steps = np.clip(np.sign(lost) * (np.abs(lost) // step), -self.more, self.less)
        return np.where(now == NEVER, 0, np.where(now == ALWAYS, 1, 2 + self.more + steps))

    def read(self, odds: NDArray[np.int64], cells: NDArray[np.integer], alarms: NDArray[np.bool_]) -> NDArray[np.int64]:
        """The log odds `[n]` of these cells after one reading each."""
        assert self.detector is not None
        said = np.where(alarms, self.detector.alarm, -self.detector.silence)
        return added(odds[cells], said)


def added(odds: NDArray[np.int64], said: Any) -> NDArray[np.int64]:
    """Log odds and what was said, int64: what is certain stays so."""
    sure = np.abs(said) == ALWAYS
    return np.where(np.abs(odds) == ALWAYS, odds, np.where(sure, said, odds + np.where(sure, 0, said)))


Chances = NDArray[np.float32]


def evidence_of(q: Chances, h: Chances, threat: Chances, consumed: bool, detector: Detector | None) -> Evidence:
    """Of hazards that are there with q, and stop a visit with h, all `[H, W]`; `threat`: q h, that robots plan on."""
    there, hits = (np.nan_to_num(one.ravel().astype(np.float64)) for one in (q, h))
    with np.errstate(divide="ignore"):
        first, passed = np.log(there) - np.log1p(-there), -np.log1p(-hits)
    prior = _whole(first)
    made = Evidence(prior, _whole(passed), NEVER if consumed else ALWAYS, detector, threat.reshape(1, -1))
    steps = np.arange(-made.more, made.less + 1)
    doubtful = (there > 0) & (there < 1) & (hits > 0)
    odds = np.where(doubtful, prior, 0) - steps[:, None] * np.where(made.step == ALWAYS, 0, made.step)
    some = np.minimum(hits / (1 + np.exp(-odds / NAT)), np.nextafter(np.float32(1), np.float32(0)))
    some[steps == 0] = threat.ravel()
    own = np.where(np.isnan(threat.ravel()), np.nan, threat.ravel().astype(np.float64))
    never = np.where((there > 0) & (doubtful | consumed), 0.0, own)
    always = np.where(doubtful, np.where(hits == 1, np.nan, hits), own)
    reached = not consumed or (detector is not None and detector.alarm == ALWAYS)
    rows = [never, always if reached else own, *np.where(doubtful, some, own)]
    chances = np.where(np.isnan(own), np.nan, np.stack(rows)).astype(np.float32)
    return replace(made, chances=chances)


def _whole(nats: NDArray[np.float64]) -> NDArray[np.int64]:
    """In units of 1 / NAT; infinite: certain."""
    finite = np.isfinite(nats)
    return np.where(finite, np.rint(np.where(finite, nats, 0) * NAT), np.sign(nats) * 2.0**62).astype(np.int64)


def chance_of(odds: NDArray[np.int64]) -> NDArray[np.float64]:
    """The chance that a hazard is there, by its log odds."""
    with np.errstate(over="ignore"):
        return np.where(odds == NEVER, 0.0, np.where(odds == ALWAYS, 1.0, 1 / (1 + np.exp(-odds / NAT))))
