"""Moving threats, walkers and patrols, and threats that change by phases (SPEC section 16).

Robots plan on one map, the world's `threat`: that of the cells joined with long-run positions of moving threats, which
do not depend on robots. Axis letters: `M` moving threats, `N` = H * W cells.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from planner.arguments import whole
from planner.errors import WorldError
from planner.formatting import counted
from planner.world.keys import CHANCE, PLACE, Key, first_of

ANYWHERE = -1
"""Start of a moving threat whose first cell is drawn."""
MOST_MOVING = 1024
NEIGHBOURS = [[0, 1, 0], [1, 0, 1], [0, 1, 0]]


@dataclass(frozen=True)
class MovingThreat:
    """A moving threat.

    Attributes:
        hit: probability h that it destroys a robot that it meets. stay: for a walker, probability to stay in its cell.
        start: cell index of its start, or ANYWHERE.
        route: for a patrol, the cells of its closed route; else empty.
    """

    hit: float
    stay: float = 0.0
    start: int = ANYWHERE
    route: tuple[int, ...] = ()

    @property
    def patrols(self) -> bool:
        """Whether it follows a route."""
        return len(self.route) > 0

    @property
    def place(self) -> int:
        """Its start: a cell, or an index on the route; ANYWHERE if that is drawn."""
        return self.route.index(self.start) if self.patrols and self.start != ANYWHERE else self.start


@dataclass(frozen=True, eq=False)
class MovingThreats:
    """All moving threats, and the map that they move on.

    Attributes:
        own: float32 `[H, W]`, threat of the cells themselves; NaN = obstacle. members: the moving threats.
        by_default: whether `plan_on` was not given although it matters: some have no route.
    """

    own: NDArray[np.float32]
    members: tuple[MovingThreat, ...]
    by_default: bool = False
    key: ClassVar[str] = "moving_threats"

    @property
    def description(self) -> str:
        """Description for messages."""
        kinds = {"walks": "walk", "patrols": "patrol"}
        counts = (sum(one.patrols == of for one in self.members) for of in (False, True))
        words = [f"{n} {one if n == 1 else many}" for n, (one, many) in zip(counts, kinds.items(), strict=True) if n]
        hits = sorted({one.hit for one in self.members})
        stop = f"{hits[0]:g}" if len(hits) == 1 else f"{hits[0]:g} to {hits[-1]:g}"
        does = "destroys a robot that it meets" if len(self.members) == 1 else "destroy a robot that they meet"
        return f"moving threats: {' and '.join(words)}, and {does} with probability {stop}"

    def to_json(self) -> list[dict[str, Any]]:
        """List of the moving threats with the keys of a scenario."""

        def at(cell: int) -> list[int]:
            return list(divmod(cell, self.own.shape[1]))

        def kind(one: MovingThreat) -> dict[str, Any]:
            return {"patrol": [at(cell) for cell in one.route]} if one.patrols else {"walk": one.stay}

        return [
            kind(one) | {"start": "anywhere" if one.start == ANYWHERE else at(one.start), "h": one.hit}
            for one in self.members
        ]

    @property
    def sha256(self) -> str:
        """Hash of all data of the draws."""
        digest = hashlib.sha256(np.ascontiguousarray(self.own, dtype="<f4").tobytes())
        for name, array in self.arrays().items():
            if name != "movers_own":
                digest.update(f"{name}{array.dtype.str}{array.shape}".encode() + array.tobytes())
        return digest.hexdigest()

    @cached_property
    def weight(self) -> NDArray[np.int64]:
        """int64 `[H, W]`: long-run frequency of a walker in each cell, unscaled: its free neighbours, at least 1."""
        free = ~np.isnan(self.own)
        around = ndimage.correlate(free.astype(np.int64), NEIGHBOURS, mode="constant")
        # The stationary distribution of a random walk is proportional to the number of neighbours.
        return np.where(free, np.maximum(around, 1), 0)

    def chances(self, member: MovingThreat) -> NDArray[np.float64]:
        """float64 `[H, W]`: long-run share of steps that a moving threat is in each cell."""
        if member.patrols:
            often = np.bincount(member.route, minlength=self.own.size)
            return often.reshape(self.own.shape) / len(member.route)
        weight = self.weight
        if member.start != ANYWHERE:
            parts = ndimage.label(weight)[0]
            weight = np.where(parts == parts.flat[member.start], weight, 0)
        return weight / weight.sum()

    def joined(self, members: Iterable[MovingThreat], source: str) -> NDArray[np.float32]:
        """p of a visit with moving threats at their long-run positions, float32 `[H, W]`.

        Args:
            members: the moving threats to include.
            source: for messages.

        Raises:
            WorldError: p is 1 in some cell.
        """
        # Independent threats: the probabilities to survive them multiply.
        passed = 1.0 - self.own.astype(np.float64)
        for member in members:
            passed *= 1.0 - member.hit * self.chances(member)
        threat = (1.0 - passed).astype(np.float32)
        if (threat >= 1).any():
            problem = f"h of the moving threats makes p 1 {first_of(threat >= 1)[1]}"
            raise WorldError(problem, source=source, expected="below 1", fix="make it an obstacle, or h smaller")
        # Cells that no threat reaches keep p to the last bit, and so their level.
        threat = np.where(threat == self.own.astype(np.float64), self.own, threat)
        threat.setflags(write=False)
        return threat

    def planned(self, plan_on: PlannedOn, source: str) -> NDArray[np.float32]:
        """p that robots plan on, float32 `[H, W]`; errors as in `joined`."""
        members = [one for one in self.members if plan_on == JOINED or (one.patrols and plan_on == PATROLS)]
        return self.joined(members, source)

    def draws(self) -> None:
        """None: the cells themselves are certain."""
        return

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the world file, by name."""
        kinds = {"hit": "<f8", "stay": "<f8", "start": "<i8"}
        each = {name: np.array([getattr(one, name) for one in self.members], kinds[name]) for name in kinds}
        each["length"] = np.array([len(one.route) for one in self.members], "<i8")
        routes = np.array([cell for one in self.members for cell in one.route], "<i8")
        arrays = {f"movers_{name}": array for name, array in each.items()}
        return {"movers_own": self.own, "movers_routes": routes} | arrays


def moving_threats_in(arrays: Mapping[str, NDArray]) -> list[MovingThreat]:
    """The moving threats in the arrays of a world file, not yet checked."""
    routes = np.split(arrays["movers_routes"], np.cumsum(arrays["movers_length"])[:-1])
    if list(map(len, routes)) != arrays["movers_length"].tolist():
        raise ValueError("movers_length does not add up to movers_routes")
    each = zip(*(arrays[f"movers_{name}"].tolist() for name in ("hit", "stay", "start")), routes, strict=True)
    return [MovingThreat(hit, stay, start, tuple(route.tolist())) for hit, stay, start, route in each]


def _check(member: MovingThreat, name: str, threat: NDArray[np.float32], source: str) -> None:
    """Raise WorldError for a moving threat that cannot be on the map `threat` `[H, W]`."""
    for chance, value in (("h", member.hit), ("walk", member.stay)):
        CHANCE.check(f"{name}.{chance}", value, WorldError, source)
    free = ~np.isnan(threat)

    def at(cell: int) -> str:
        return f"[{', '.join(map(str, divmod(cell, threat.shape[1])))}]"

    def wrong(problem: str, expected: str) -> WorldError:
        return WorldError(f"`{name}`: {problem}", source=source, expected=expected)

    for cell in member.route or {member.start} - {ANYWHERE}:
        if not (0 <= cell < free.size and free.flat[cell]):
            what = f"its route has {at(cell)}" if member.patrols else f"it starts at {at(cell)}"
            raise wrong(f"{what}, which is no free cell", "free cells")
    for one, other in zip(member.route, (*member.route[1:], *member.route[:1]), strict=True):
        if np.abs(np.subtract(divmod(one, threat.shape[1]), divmod(other, threat.shape[1]))).sum() != 1:
            raise wrong(f"its route goes from {at(one)} to {at(other)}", "a closed route of adjacent cells")
    if member.patrols and member.start not in (ANYWHERE, *member.route):
        raise wrong(f"it starts at {at(member.start)}, off its route", "a cell of the route")


AT, STAYS = "[row, col], whole numbers", "a chance to stay, 0 to 1"
PlannedOn = Literal["patrols", "joined", "own"]
PLAN_ON: tuple[PlannedOn, ...] = get_args(PlannedOn)
PATROLS, JOINED = PLAN_ON[:2]
"""Robots plan on p joined with the long-run positions of moving threats that have a route, the default; or of all
moving threats, the default before release 0.4."""
THREATS = "threats"
"""Value of h for walkers that are the threats of the map."""


def make_moving_threats(
    given: Iterable[MovingThreat | Mapping[str, Any]], threat: NDArray[np.float32], by_default: bool, source: str
) -> MovingThreats:
    """Moving threats from a user's list.

    Args:
        given: moving threats, or the keys of each as in a scenario.
        threat: float32 `[H, W]`, p of the map, NaN = obstacle.
        by_default: whether the user leaves `plan_on` out.
        source: for messages.

    Raises:
        WorldError: one of them is invalid.
    """
    named: list[tuple[str, MovingThreat]] = []
    own = threat
    for number, one in enumerate(given):
        name = f"moving_threats[{number}]"
        key = Key(one, name, source, WorldError)
        if isinstance(one, Mapping) and isinstance(one.get("h"), str):
            some = _walking_threats(key, threat)
            # The threats move away from their cells, which are safe from then on.
            own = np.where(np.isnan(threat), np.float32(np.nan), np.float32(0))
        else:
            some = [one] if isinstance(one, MovingThreat) else _repeated(key, threat.shape)
        named += [(name, member) for member in some]
    if not 0 < len(named) <= MOST_MOVING:
        raise WorldError(counted(len(named), "moving threat"), source=source, expected=f"1 to {MOST_MOVING}")
    for name, member in dict.fromkeys(named):
        _check(member, name, threat, source)
    members = tuple(member for _, member in named)
    # Without free walkers both defaults give the same map.
    return MovingThreats(own, members, by_default and not all(one.patrols for one in members))


def _walking_threats(key: Key, threat: NDArray[np.float32]) -> list[MovingThreat]:
    """A walker for each dangerous cell of the map, with its p as h."""
    keys = key.mapping(("walk", "h"))
    if keys["h"].value != THREATS:
        raise keys["h"].wrong(f"{CHANCE.expected}, or {THREATS}")
    stay = keys["walk"].number(CHANCE, STAYS)
    return [MovingThreat(float(p), stay) for p in threat[threat > 0]]


def _repeated(key: Key, shape: tuple[int, ...]) -> list[MovingThreat]:
    """The moving threat of an entry, repeated `count` times."""
    keys = key.mapping(("h",), optional=("walk", "patrol"), defaults={"start": "anywhere", "count": 1})
    if ("walk" in keys) == ("patrol" in keys):
        raise key.wrong("either walk or patrol")
    stay = keys["walk"].number(CHANCE, STAYS) if "walk" in keys else 0.0
    cells = keys["patrol"].items("a list of two cells [row, col] or more", 2) if "patrol" in keys else ()
    start = ANYWHERE if keys["start"].value == "anywhere" else _cell(keys["start"], shape)
    one = MovingThreat(keys["h"].number(CHANCE), stay, start, tuple(_cell(cell, shape) for cell in cells))
    return [one] * keys["count"].number(whole(1, MOST_MOVING))


def _cell(key: Key, shape: tuple[int, ...]) -> int:
    """The index of a cell of the map."""
    row, col = key.numbers(PLACE, AT, 2)
    height, width = shape
    if not (0 <= row < height and 0 <= col < width):
        raise key.wrong(f"a cell of the map: row 0..{height - 1} and col 0..{width - 1}")
    return int(row * width + col)


# Threats that change by phases: p of a visit is that of the phase of its step (SPEC section 16).
#
# Axis letters: `P` phases, `N` = H * W cells.

Foresight = Literal["now", "first", "worst"]
FORESIGHTS: tuple[Foresight, ...] = get_args(Foresight)
MOST_PHASES = 1024
SAID = {
    "now": "all robots know of a change as it comes",
    "first": "robots plan on the first map only",
    "worst": "robots plan on the cell-wise maximum",
}


@dataclass(frozen=True, eq=False)
class Phases:
    """Maps and the steps from which they hold.

    Attributes:
        begins: int64 `[P]`, the step at which each phase begins, increasing, the first 0.
        threats: float32 `[P, H, W]`, p of a visit in each; NaN = obstacle, the same in all.
        plan_on: "now": at the end of the step before a phase begins its map becomes the robots'; "first", "worst":
            robots use the first map, or the cell-wise maximum, throughout.
    """

    begins: NDArray[np.int64]
    threats: NDArray[np.float32]
    plan_on: Foresight = "now"
    key: ClassVar[str] = "phases"

    @property
    def description(self) -> str:
        """Description for messages."""
        steps = ", ".join(map(str, self.begins[1:5].tolist())) + ", ..." * (len(self.begins) > 5)
        return f"threats that change at step {steps}; {SAID[self.plan_on]}"

    @property
    def are_announced(self) -> bool:
        """Whether changes become known as they come."""
        return self.plan_on == "now"

    @property
    def planned(self) -> NDArray[np.float32]:
        """float32 `[H, W]`: the robots' first map."""
        threat = self.most if self.plan_on == "worst" else self.threats[0].copy()
        threat.setflags(write=False)
        return threat

    @property
    def most(self) -> NDArray[np.float32]:
        """float32 `[H, W]`: the cell-wise maximum."""
        return np.asarray(self.threats.max(axis=0))

    def number_at(self, steps: ArrayLike) -> NDArray[np.int64]:
        """int64: the phase of each of these steps."""
        return np.asarray(np.searchsorted(self.begins, steps, side="right") - 1, dtype=np.int64)

    def to_json(self) -> dict[str, Any]:
        """Begins, and `plan_on`."""
        return {"from": self.begins.tolist(), "plan_on": self.plan_on}

    @property
    def sha256(self) -> str:
        """Hash of all data."""
        digest = hashlib.sha256(self.plan_on.encode())
        for array in (self.begins.astype("<i8"), self.threats.astype("<f4")):
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def draws(self) -> None:
        """None: nothing is uncertain."""
        return

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the world file, by name."""
        return {
            "phases_from": self.begins.astype("<i8"),
            "phases_threat": self.threats,
            "phases_plan_on": np.array(self.plan_on),
        }
