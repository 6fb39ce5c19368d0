"""Types of robots and threats: p of a visit is the matrix's factor for both types times the map's p (SPEC 22)."""

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
    """Threats of each robot type.

    Attributes:
        names: of the types.
        threat: float32 `[Y, H, W]`, in the order of `names`; NaN = obstacle.
        team: types of the robots that the input places, one for all or one each; (): not given.
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
    def description(self) -> str:
        """Description for messages."""
        return f"robots of the types {', '.join(self.names)}"

    def number(self, name: str, source: str) -> int:
        """Index of a type.

        Args:
            name: of the type.
            source: for the message.

        Raises:
            PlanError: there is no such type.
        """
        if name not in self.names:
            expected, fix = "one of " + ", ".join(self.names), did_you_mean(name, self.names)
            raise PlanError(argument("types", name), source=source, expected=expected, fix=fix)
        return self.names.index(name)

    def arrays(self) -> dict[str, Any]:
        """Arrays of the world file, by name."""
        team = {"types_team": np.array(self.team)} if self.team else {}
        return {"types": np.array(self.names), "types_threat": self.threat} | team


def types_in(arrays: Mapping[str, NDArray], free: NDArray[np.bool_], source: str) -> RobotTypes:
    """The types in the arrays of a world file.

    Args:
        arrays: of the file.
        free: bool `[H, W]`.
        source: for messages.

    Raises:
        WorldError: they are invalid.
    """
    found = checked_types(tuple(map(str, arrays["types"].tolist())), arrays["types_threat"], free, source)
    team = arrays.get("types_team", np.array(())).tolist()
    for name in [team] if isinstance(team, str) else team:
        found.number(name, source)
    return replace(found, team=team if isinstance(team, str) else tuple(team))


def checked_types(
    names: tuple[str, ...], threat: NDArray[np.float64], free: NDArray[np.bool_], source: str
) -> RobotTypes:
    """Make checked types.

    Args:
        names: of the types.
        threat: float64 `[Y, H, W]`, below 1 in free cells.
        free: bool `[H, W]`.
        source: for messages.

    Raises:
        WorldError: names the first invalid cell.
    """
    if not names or len({*names} - {""}) != len(names) or threat.shape != (len(names), *free.shape):
        problem = f"types {list(names)} with threats {list(threat.shape)}"
        raise WorldError(problem, source=source, expected="names of types, each once, and p [H, W] of each")
    rounded = np.where(free, threat, np.nan).astype(np.float32)
    for name, one in zip(names, rounded, strict=True):
        wrong = free & ~((one >= 0) & (one < 1))
        if wrong.any():
            at, where = first_of(wrong)
            problem = f"p = {one[at]:g} for a robot of type {name} {where}"
            raise WorldError(problem, source=source, expected="0 <= p < 1", fix="give a smaller factor")
    rounded.setflags(write=False)
    return RobotTypes(names, rounded)


# Types in a scenario: a threat's `type`, and `robots: {matrix: ...}`.

FACTOR = Numbers(0, 1e6, "a factor of p")
TYPE = "type"
"""Key of a source of threats: its type."""
Matrix = Mapping[str, Mapping[str, float]]
"""Factor of p by robot type and threat type; types that are not named have 1."""


def read_matrix(robots: Key | None) -> dict[str, dict[str, float]]:
    """The factors in `robots: {matrix: ...}` of a scenario, by robot type; empty without types."""
    if robots is None or not isinstance(robots.value, dict) or "matrix" not in robots.value:
        return {}
    top = Key(robots.value["matrix"], f"{robots.path}.matrix", robots.source)
    rows = top.mapping(optional=_names(top, "of robots"))
    return {
        name: {of: key.number(FACTOR) for of, key in row.mapping(optional=_names(row, "of threats")).items()}
        for name, row in rows.items()
    }


def _names(key: Key, what: str) -> list[str]:
    """The keys of a mapping, which have to be names."""
    names = list(key.value) if isinstance(key.value, dict) else []
    if not names or not all(isinstance(name, str) and name for name in names):
        raise key.wrong(f"types {what} by name, as {{drone: {{mine: 0, radiation: 1}}, rover: {{radiation: 0.2}}}}")
    return names


def check_types(keys: list[Key], matrix: Matrix) -> list[str]:
    """The type of each source of threats, "" for none.

    Raises:
        ScenarioError: a type that is not in the matrix.
    """
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


# A world's threats source by source, so that single polygons, points or sites of a scenario can be removed.

MOST_PLACES = 2**22
"""Most places that the objects of a source may threaten; a source with more has no objects that can be removed.
"""

LONGEST_NAME = 40


def independent(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Probability that at least one of two independent threats destroys: 1 - (1-p)(1-q); exact if one of them is 0."""
    return np.where(one == 0, other, np.where(other == 0, one, 1 - (1 - one) * (1 - other)))


COMBINE: dict[str, Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]] = {
    "product": independent,
    "max": np.maximum,
}
"""Combinations of threats: `product` (the default), 1 - prod(1 - p), or the largest."""


class Thing(NamedTuple):
    """A polygon, point or site: `name` or "", `where` in its file, p float64 `[n]` at places int64 `[n]`."""

    name: str
    where: str
    at: NDArray[np.int64]
    p: NDArray[np.float64]


class Things(NamedTuple):
    """The objects of one source; `cells` int64 `[m]`: the cell of each place."""

    of: tuple[Thing, ...]
    cells: NDArray[np.int64]

    @classmethod
    def on(cls, things: Sequence[Thing], cell_of: Callable[[NDArray[np.int64]], NDArray[np.int64]]) -> Self | None:
        """Objects on cells, from objects at pixels; None if there are too many places.

        Args:
            things: at pixels.
            cell_of: the free cell of each pixel, -1 if there is none.
        """
        if sum(len(thing.at) for thing in things) > MOST_PLACES:
            return None
        # Objects over obstacles threaten no robot: their places are dropped before they are counted.
        free = [thing._replace(at=thing.at[held], p=thing.p[held])
                for thing in things for held in (cell_of(thing.at) >= 0,)]  # fmt: skip
        places = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(thing.at for thing in free)]))
        return cls(tuple(one._replace(at=np.searchsorted(places, one.at)) for one in free), cell_of(places))

    def threat(self, things: Iterable[Thing], combine: str, size: int) -> NDArray[np.float64]:
        """Threat of some of the objects: float64 `[size]`, the largest p of the places in each cell."""
        threat = np.zeros(size)
        # Combined at the places first, then the largest per cell: the order of `all_threats`.
        np.maximum.at(threat, self.cells, combined(things, combine, len(self.cells)))
        return threat


def short_name(said: object) -> str:
    """Name of an object in a file, on one line; "" if it is neither text nor a number."""
    if isinstance(said, bool) or not isinstance(said, str | int | float):
        return ""
    return " ".join(str(said).split())[:LONGEST_NAME]


def combined(things: Iterable[Thing], combine: str, places: int) -> NDArray[np.float64]:
    """Combined p of objects, float64 `[places]`."""
    threat = np.zeros(places)
    for thing in things:
        threat[thing.at] = COMBINE[combine](threat[thing.at], thing.p)
    return threat


@dataclass(frozen=True, eq=False)
class Sources:
    """Sources that the threats of a world were combined from.

    Attributes:
        combine: key of `COMBINE`. free: bool `[H, W]`.
        layers: the map's own threat and every source, in order: objects, or p float64 `[H, W]` without objects.
        out: objects that are removed, as indices of `things`.
    """

    combine: str
    free: NDArray[np.bool_]
    layers: tuple[Things | NDArray[np.float64], ...]
    out: frozenset[int] = frozenset()

    @cached_property
    def things(self) -> tuple[tuple[int, Thing], ...]:
        """(layer, object) of all objects, removed or not."""
        layers = enumerate(self.layers)
        return tuple((number, thing) for number, layer in layers if isinstance(layer, Things) for thing in layer.of)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Unique names of all objects: as in their files, with the place in the file where a name is not unique."""
        names = [thing.name or thing.where for _, thing in self.things]
        # First the place in the file, then the number of the source, as far as names are still ambiguous.
        for add in (lambda thing, layer: thing.where, lambda thing, layer: f"threats[{layer - 1}]"):
            often = Counter(names)
            names = [
                f"{name} ({add(thing, layer)})" if often[name] > 1 else name
                for name, (layer, thing) in zip(names, self.things, strict=True)
            ]
        return tuple(names)

    def alone(self, thing: int) -> NDArray[np.float64]:
        """p of one object, without all others, float64 `[H * W]`."""
        layer, own = self.things[thing]
        things = self.layers[layer]
        assert isinstance(things, Things)
        return np.where(self.free.reshape(-1), things.threat([own], self.combine, self.free.size), 0.0)

    def without(self, thing: int) -> Self:
        """A copy with one more object removed."""
        return replace(self, out=self.out | {thing})

    def threat(self) -> NDArray[np.float32]:
        """`World.threat` without the removed objects, float32 `[H, W]`."""
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
