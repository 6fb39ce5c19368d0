"""A world's threats source by source, so that a polygon, a point or a site of a scenario can be left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

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
