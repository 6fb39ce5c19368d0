"""Types of robots and threats: p of a visit is a matrix's factor, for the two types, times the map's p (SPEC 22)."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from planner.arguments import Numbers, argument, did_you_mean
from planner.errors import PlanError, WorldError
from planner.world.keys import Key, first_of


@dataclass(frozen=True, eq=False)
class RobotTypes:
    """What stops robots of each type: float32 `[Y, H, W]`, NaN = obstacle, in the order of `names`.

    `team`: of which type the robots are that the input places, all or each; none: it does not say.
    """

    names: tuple[str, ...]
    threat: NDArray[np.float32]
    team: str | tuple[str, ...] = ()

    @property
    def sha256(self) -> str:
        """Hash of names and threats."""
        digest = hashlib.sha256("\0".join(self.names).encode())
        digest.update(np.ascontiguousarray(self.threat, dtype="<f4").tobytes())
        return digest.hexdigest()

    @property
    def said(self) -> str:
        """Which there are, in words."""
        return f"robots of the types {', '.join(self.names)}"

    def number(self, name: str, source: str) -> int:
        """The place of a type. Raises PlanError, naming `source`."""
        if name not in self.names:
            expected, fix = "one of " + ", ".join(self.names), did_you_mean(name, self.names)
            raise PlanError(argument("types", name), source=source, expected=expected, fix=fix)
        return self.names.index(name)

    def arrays(self) -> dict[str, Any]:
        """What a world file holds of them."""
        team = {"types_team": np.array(self.team)} if self.team else {}
        return {"types": np.array(self.names), "types_threat": self.threat} | team


def types_in(arrays: Mapping[str, NDArray], free: NDArray[np.bool_], source: str) -> RobotTypes | None:
    """The types in the arrays of a world file whose free cells are `free` `[H, W]`. Raises WorldError."""
    if "types" not in arrays:
        return None
    names, threat = arrays["types"], arrays.get("types_threat")
    shape = (names.size, *free.shape)
    if names.ndim != 1 or names.dtype.kind != "U" or len(set(names.tolist())) != names.size or names.size == 0:
        raise WorldError("types are not names", source=source, expected="the name of each type of robot, once")
    if threat is None or threat.shape != shape or threat.dtype.kind not in "fiu":
        raise WorldError("types without their threats", source=source, expected=f"types_threat {shape}")
    found = checked_types(tuple(names.tolist()), threat.astype(np.float64), free, source)
    if "types_team" not in arrays:
        return found
    team = arrays["types_team"]
    if team.ndim > 1 or team.size == 0 or not set(team.ravel().tolist()) <= set(found.names):
        expected = f"a type, or one for each robot, of {', '.join(found.names)}"
        raise WorldError("types_team are not types of robots", source=source, expected=expected)
    return replace(found, team=tuple(team.tolist()) if team.ndim else str(team))


def checked_types(
    names: tuple[str, ...], threat: NDArray[np.float64], free: NDArray[np.bool_], source: str
) -> RobotTypes:
    """Types with these threats `[Y, H, W]`, each below 1 in free cells. Raises WorldError."""
    rounded = np.where(free, threat, np.nan).astype(np.float32)
    for name, one in zip(names, rounded, strict=True):
        wrong = free & ~((one >= 0) & (one < 1))
        if wrong.any():
            at, where = first_of(wrong)
            problem = f"a robot of type {name} is stopped with p = {one[at]:g} {where}"
            raise WorldError(problem, source=source, expected="0 <= p < 1", fix="give a smaller factor")
    rounded.setflags(write=False)
    return RobotTypes(names, rounded)


# How a scenario says what types of robots and threats there are: a threat's `type`, `robots: {matrix: ...}`.

FACTOR = Numbers(0, 1e6, "a factor of p")
TYPE = "type"
"""The key of a source of threats that says of which type it is."""
Matrix = Mapping[str, Mapping[str, float]]
"""Factor of p by type of robot and type of threat; what it does not name has 1."""


def read_matrix(robots: Key | None) -> dict[str, dict[str, float]]:
    """The factors under `robots: {matrix: ...}` of a scenario, by type of robot; none: there are no types."""
    if robots is None or not isinstance(robots.value, dict) or "matrix" not in robots.value:
        return {}
    top = Key(robots.value["matrix"], f"{robots.path}.matrix", robots.source)
    rows = top.mapping(optional=_names(top, "of robots"))
    return {
        name: {of: key.number(FACTOR) for of, key in row.mapping(optional=_names(row, "of threats")).items()}
        for name, row in rows.items()
    }


def _names(key: Key, what: str) -> list[str]:
    """The names that a mapping has for keys."""
    names = list(key.value) if isinstance(key.value, dict) else []
    if not names or not all(isinstance(name, str) and name for name in names):
        raise key.wrong(f"types {what} by name, as {{drone: {{mine: 0, radiation: 1}}, rover: {{radiation: 0.2}}}}")
    return names


def check_types(keys: list[Key], matrix: Matrix) -> list[str]:
    """The type of each source of threats, "" of none. Raises ScenarioError for one that the matrix does not know."""
    known = {name for row in matrix.values() for name in row}
    found = []
    for key in keys:
        given = key.value.get(TYPE, "") if isinstance(key.value, dict) else ""
        if given and given not in known:
            of = Key(given, f"{key.path}.{TYPE}", key.source)
            expected = " or ".join(sorted(known)) or "none without `robots: {matrix: ...}`"
            raise of.wrong(expected, did_you_mean(given, sorted(known)) or "name it in the matrix")
        found.append(given)
    return found


# A world's threats source by source, so that a polygon, a point or a site of a scenario can be left out.

MOST_PLACES = 2**22
"""Places that the things of a source may threaten, one by one; one with more is a field, of which nothing is left out.
"""

LONGEST_NAME = 40


def independent(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """The chance that at least one of two independent threats hits: 1 - (1-p)(1-q); exact where one of them is 0."""
    return np.where(one == 0, other, np.where(other == 0, one, 1 - (1 - one) * (1 - other)))


COMBINE: dict[str, Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]] = {
    "product": independent,
    "max": np.maximum,
}
"""How threats combine: `product` (the default), 1 - prod(1 - p), or the largest."""


class Thing(NamedTuple):
    """One polygon, point or site: its `name` ("": none), `where` its file says it, p float64 `[n]` at places `[n]`."""

    name: str
    where: str
    at: NDArray[np.int64]
    p: NDArray[np.float64]


class Things(NamedTuple):
    """The things of one source; `cells` int64 `[m]`: the cell that each of its places lies in."""

    of: tuple[Thing, ...]
    cells: NDArray[np.int64]

    @classmethod
    def on(cls, things: Sequence[Thing], cell_of: Callable[[NDArray[np.int64]], NDArray[np.int64]]) -> Self | None:
        """Of things at pixels; None if those are too many. `cell_of`: the free cell of each, -1 where there is none."""
        if sum(len(thing.at) for thing in things) > MOST_PLACES:
            return None
        free = [thing._replace(at=thing.at[held], p=thing.p[held])
                for thing in things for held in (cell_of(thing.at) >= 0,)]  # fmt: skip
        places = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(thing.at for thing in free)]))
        return cls(tuple(one._replace(at=np.searchsorted(places, one.at)) for one in free), cell_of(places))

    def threat(self, things: Iterable[Thing], combine: str, size: int) -> NDArray[np.float64]:
        """What some of them make of so many cells: the largest p of the places in each, float64 `[size]`."""
        threat = np.zeros(size)
        np.maximum.at(threat, self.cells, combined(things, combine, len(self.cells)))
        return threat


def short_name(said: object) -> str:
    """What a file calls a thing, on one line; "" where it is no text and no number."""
    if isinstance(said, bool) or not isinstance(said, str | int | float):
        return ""
    return " ".join(str(said).split())[:LONGEST_NAME]


def combined(things: Iterable[Thing], combine: str, places: int) -> NDArray[np.float64]:
    """p of things together, float64 `[places]`."""
    threat = np.zeros(places)
    for thing in things:
        threat[thing.at] = COMBINE[combine](threat[thing.at], thing.p)
    return threat


@dataclass(frozen=True, eq=False)
class Sources:
    """What the threats of a world were combined from.

    Attributes:
        combine: how. free: bool `[H, W]`.
        layers: the map's own and every source, in order: things, or p float64 `[H, W]` of one that has none.
        out: things that are left out, by their place in `things`.
    """

    combine: str
    free: NDArray[np.bool_]
    layers: tuple[Things | NDArray[np.float64], ...]
    out: frozenset[int] = frozenset()

    @cached_property
    def things(self) -> tuple[tuple[int, Thing], ...]:
        """(layer, thing), left out or not."""
        layers = enumerate(self.layers)
        return tuple((number, thing) for number, layer in layers if isinstance(layer, Things) for thing in layer.of)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of all things, each another: as their files say, with the place in the file where there is no such name."""
        names = [thing.name or thing.where for _, thing in self.things]
        for add in (lambda thing, layer: thing.where, lambda thing, layer: f"threats[{layer - 1}]"):
            often = Counter(names)
            names = [
                f"{name} ({add(thing, layer)})" if often[name] > 1 else name
                for name, (layer, thing) in zip(names, self.things, strict=True)
            ]
        return tuple(names)

    def alone(self, thing: int) -> NDArray[np.float64]:
        """p of one thing by itself, float64 `[H * W]`."""
        layer, own = self.things[thing]
        things = self.layers[layer]
        assert isinstance(things, Things)
        return np.where(self.free.reshape(-1), things.threat([own], self.combine, self.free.size), 0.0)

    def without(self, thing: int) -> Self:
        """One more left out."""
        return replace(self, out=self.out | {thing})

    def threat(self) -> NDArray[np.float32]:
        """As of `World.threat`, with what is left out: `all_threats` again."""
        threat, first = np.zeros(self.free.size), 0
        for layer in self.layers:
            if isinstance(layer, Things):
                left = [thing for number, thing in enumerate(layer.of, first) if number not in self.out]
                first += len(layer.of)
                p = layer.threat(left, self.combine, threat.size)
            else:
                p = layer.reshape(-1)
            threat = COMBINE[self.combine](threat, p)
        found = np.where(self.free, threat.reshape(self.free.shape), np.nan).astype(np.float32)
        found.setflags(write=False)
        return found
