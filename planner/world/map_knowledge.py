"""Robots that are not told the map: what is true, and how far they see (SPEC section 15).

A world's `threat` is what its robots believe, and plan on; its `knowledge` is what they meet. What is drawn for each
rollout (`World.doubt`) may be their truth too: then its obstacles are those of `Knowledge.truth`.
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

# What is seen from where: cells within a range, and with `sight` only past no obstacle; in integers, exact.

RANGE = Numbers(0, inf, said="0, or a number of cells from 1 on")
FARTHEST = 2**20
"""Cells; nothing is farther on the largest map."""
MOST_SEEN = 2**26
"""Most cells that may be within range of all cells of a map, one after the other: 0.3 GB."""


@dataclass(frozen=True)
class Sense:
    """What a robot that is alive sees: every cell whose centre lies within `range` cells of its own, Euclidean.

    `sight`: only where the segment of the two centres crosses the inside of no other cell that is an obstacle.
    """

    range: float = 0.0
    sight: bool = False

    @property
    def square(self) -> int:
        """The largest squared distance, in cells, that is seen."""
        return int(min(self.range, FARTHEST) ** 2)

    @property
    def said(self) -> str:
        """It in words."""
        if self.range == 0:
            return "robots see nothing"
        far = "everything" if self.range == inf else f"{self.range:g} cell{'s' * (self.range != 1)} far"
        return f"robots see {far}{', not past obstacles' if self.sight else ''}"

    def views(self, free: NDArray[np.bool_], cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """(begin `[C + 1]`, seen): `seen[begin[i]:begin[i + 1]]`, rising, is seen from `cells[i]`; indices of cells.

        `free`: bool `[H, W]`, truly. `cells`: int64 `[C]`. Raises WorldError for too many.
        """
        if len(cells) * min(4 * self.square + 1, free.size) > MOST_SEEN:
            problem = f"{len(cells)} cells from which {self.said.removeprefix('robots see ')} is seen"
            raise WorldError(
                problem, expected=f"at most {MOST_SEEN} cells in range in all", fix="give a smaller sensor_range"
            )
        height, width = free.shape
        rows, cols = np.divmod(cells, width)
        who, what = [], []
        # Offsets rise as the cells do that they lead to, so what is seen from a cell rises too.
        for down, right in self._offsets(height, width):
            inside = (rows + down >= 0) & (rows + down < height) & (cols + right >= 0) & (cols + right < width)
            seers = np.flatnonzero(inside)
            for i, j in _between(down, right) if self.sight else ():
                seers = seers[free[rows[seers] + i, cols[seers] + j]]
            who.append(seers)
            what.append((cells[seers] + down * width + right).astype(np.int32))
        seer = np.concatenate(who)
        begin = np.append(0, np.cumsum(np.bincount(seer, minlength=len(cells))))
        return begin, np.concatenate(what)[np.argsort(seer, kind="stable")]

    def _offsets(self, height: int, width: int) -> Iterator[tuple[int, int]]:
        reach = isqrt(self.square)
        tall, wide = min(reach, height - 1), min(reach, width - 1)
        for down in range(-tall, tall + 1):
            for right in range(-wide, wide + 1):
                if down * down + right * right <= self.square:
                    yield down, right


def _between(down: int, right: int) -> Iterator[tuple[int, int]]:
    """The cells other than the two whose inside the segment crosses to the cell so far `down` and `right`.

    That of the cell (i, j) is crossed iff 2 |down j - right i| < |down| + |right|: no side of it, and not the segment's
    line, keeps the two apart. A corner that is touched does not count.
    """
    wide = abs(down) + abs(right)
    for i in range(min(down, 0), max(down, 0) + 1):
        for j in range(min(right, 0), max(right, 0) + 1):
            if (i, j) not in ((0, 0), (down, right)) and 2 * abs(down * j - right * i) < wide:
                yield i, j


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What is true while robots believe `World.threat`.

    Attributes:
        truth: float32 `[H, W]`, NaN = obstacle; where maps are in doubt the one that stands for them all.
        sense: what robots see of it.
    """

    truth: NDArray[np.float32]
    sense: Sense

    @property
    def free(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that truly are no obstacles."""
        return ~np.isnan(self.truth)

    def may_be_blind(self, told: NDArray[np.bool_]) -> bool:
        """Whether they are told all obstacles, `told` `[H, W]` being free: else who does not look may run into one."""
        return bool((self.free == told).all())

    @property
    def said(self) -> str:
        """It in words."""
        return f"robots are not told the map; {self.sense.said}"

    @property
    def sha256(self) -> str:
        """Hash of all of it."""
        digest = hashlib.sha256(np.ascontiguousarray(self.truth, dtype="<f4").tobytes())
        digest.update(repr((float(self.sense.range), self.sense.sight)).encode())
        return digest.hexdigest()

    def first_seen(self, cells: NDArray[np.integer], alive: NDArray[np.bool_]) -> NDArray[np.int32]:
        """int32 `[N]`: the step at which each cell is first seen, NO_STEP if never.

        `cells`, `alive`: `[T, K]`, where each robot is at the end of each step, and whether it still looks.
        """
        when = np.full(self.truth.size, NO_STEP, dtype=np.int32)
        places, first = np.unique(cells[alive], return_index=True)
        steps = np.nonzero(alive)[0][first]
        begin, seen = self.sense.views(self.free, places.astype(np.int64))
        for number in np.argsort(-steps, kind="stable"):  # who came first is written last
            when[seen[begin[number] : begin[number + 1]]] = steps[number]
        return when

    def arrays(self) -> dict[str, Any]:
        """What the world file holds of it."""
        return {"truth": self.truth, "sense": np.array([self.sense.range, self.sense.sight], dtype=np.float64)}


def make_sense(given: float | Sense | Mapping[str, Any], source: str) -> Sense:
    """A checked sense from a range, or `{range, sight}`. Raises WorldError."""
    if isinstance(given, Sense):
        given = {"range": given.range, "sight": given.sight}
    keys: Json = dict(given) if isinstance(given, Mapping) else {"range": given}
    cells, sight = keys.pop("range", None), keys.pop("sight", False)
    if keys or not isinstance(sight, bool | np.bool_):
        raise WorldError(
            f"sensor_range is {given!r:.60}", source=source, expected="a range, or {range, sight: true or false}"
        )
    if not (cells == inf or (RANGE.accepts(cells) and not 0 < cells < 1)):
        raise WorldError(f"sensor_range is {cells!r:.60}", source=source, expected=RANGE.expected)
    return Sense(float(cells), bool(sight))


def make_knowledge(belief: NDArray[np.float32], truth: NDArray[np.float32], sense: Sense, source: str) -> Knowledge:
    """What is true `[H, W]` beside a belief `[H, W]`. Raises WorldError for another shape, and who would bump."""
    if belief.shape != truth.shape:
        problem = f"the truth has shape {list(truth.shape)}"
        raise WorldError(problem, source=source, expected=f"the cells that robots are told of, {list(belief.shape)}")
    differ = np.isnan(belief) != np.isnan(truth)
    if sense.range == 0 and differ.any():
        row, col = np.argwhere(differ)[0].tolist()
        problem = (
            f"robots that see nothing are wrong about an obstacle at [{row}, {col}] ({int(differ.sum())} such cells)"
        )
        raise WorldError(problem, source=source, expected="the same obstacles", fix="let them sense 1 or more")
    return Knowledge(truth, sense)


def knowledge_in(arrays: Mapping[str, NDArray], belief: NDArray[np.float32], source: str) -> Knowledge | None:
    """What the arrays of a world file say is true beside its threats; its chances are checked. Raises WorldError."""
    if "truth" not in arrays:
        return None
    said = arrays.get("sense", np.zeros(2))
    if said.shape != (2,) or said.dtype.kind != "f" or said[1] not in (0, 1):
        raise WorldError("sense is no pair", source=source, expected="[range, 0 or 1]")
    sense = make_sense({"range": float(said[0]), "sight": bool(said[1])}, source)
    return make_knowledge(belief, arrays["truth"], sense, source)


# What robots learn of hazards from what happens to them, and from a detector: log odds, added up in whole numbers.
#
# Bayes' rule, cell by cell: a hazard is there or not, independently of all others (SPEC section 15). Axis `N` = H * W.

NAT = 2**20
"""Log odds are whole numbers of 1 / NAT."""
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
        raise WorldError(f"sensor_range is {given!r:.60}", source=source, expected=expected)
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
