"""Coordinates that come round: which order longitude and latitude are in, and shapes across longitude 180.

RFC 7946, 3.1.9, cuts shapes there: the two parts of one polygon lie a whole turn apart, and are brought together here.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.world.grid import RANGE, TURN, WGS84, Frame, Georeference, near, principal
from planner.world.raster_files import describe

Rings = list[NDArray[np.float64]]
"""A polygon: rings `[points, 2]`, x or longitude first, the holes among them."""
Boxes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Least and largest coordinates `[boxes, 2]`; of a point both are the point."""
NEAR = 0.01
"""Degrees around a map, or the map's own size, within which shapes are taken to be meant for it."""
SEAM = 1e-9
"""Of a turn: edges that lie so near each other on both sides of a cut are one (4 cm at the equator)."""
WIDE = 10
"""Cells that the sides of a cut at longitude 180 lie apart at most to be told of."""
SAMPLES = 9
"""Places along each side of a map whose longitudes and latitudes are looked at."""
Edge = tuple[tuple[float, float], tuple[float, float]]


def in_range(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """bool `[...]`: which (x, y) `[..., 2]` can be longitude and latitude."""
    return np.asarray((np.abs(places) <= RANGE).all(axis=-1))


def fine(places: NDArray[np.float64]) -> bool:
    """True if coordinates have more digits than millimetres, as degrees do."""
    return bool((np.abs(places - np.round(places, 3)) > 1e-9).any())


def latitude_first(place: Sequence[float], where: str, source: object, why: str) -> MapError:
    """The error for coordinates in the wrong order, of which `place` is one."""
    problem = f"{where}latitude stands first, as in {place[0]:.10g}, {place[1]:.10g}: {why}"
    return MapError(problem, source=source, expected="longitude, then latitude", fix="swap the two everywhere in it")


def check_range(places: NDArray[np.float64], where: str, source: object) -> None:
    """Raise MapError for (longitude, latitude) `[n, 2]` out of range; it says so if latitude stands first."""
    wrong = ~in_range(places)
    if not wrong.any():
        return
    x, y = places[wrong][0].tolist()
    if in_range(places[:, ::-1]).all():
        raise latitude_first((x, y), where, source, f"{y:.6g} is no latitude")
    problem = f"{where}a point at longitude {x:g}, latitude {y:g}"
    raise MapError(problem, source=source, expected="degrees, -180..180 and -90..90")


def boxes_of(rings: Rings) -> Boxes:
    """Least and largest longitude and latitude of each ring, and of those that may cross 180 read so too."""
    short = [_unwrapped(ring, TURN) for ring in rings if _is_wide(ring, TURN)]
    both = [*rings, *(np.subtract(ring, (TURN * np.round(ring[0, 0] / TURN), 0)) for ring in short)]
    return np.array([ring.min(axis=0) for ring in both]), np.array([ring.max(axis=0) for ring in both])


def _is_wide(ring: NDArray[np.float64], turn: float) -> bool:
    """True if a step of the ring goes round by more than half a turn, and less than a whole one."""
    step = np.abs(np.diff(ring[:, 0], append=ring[:1, 0]))
    return bool(((step > turn / 2) & (step < turn)).any())


def _unwrapped(ring: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """The ring with every step the short way round."""
    return np.column_stack([np.unwrap(ring[:, 0], period=turn), ring[:, 1]])


@dataclass(frozen=True)
class Patch:
    """Where on the Earth a map lies.

    Attributes:
        low, high: its least and largest longitude and latitude, `[2]`; longitudes go on across 180.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, frame: Frame, georeference: Georeference) -> Patch:
        """That of a map's frame. Raises MapError."""
        height, width = frame.shape
        middle = georeference.to_lonlat(frame.at(height / 2, width / 2))
        rows, cols = np.meshgrid(np.linspace(0, height, SAMPLES), np.linspace(0, width, SAMPLES))
        places = georeference.to_lonlat(frame.at(rows, cols), about=middle[0]).reshape(-1, 2)
        return cls(places.min(axis=0), places.max(axis=0))

    @property
    def middle(self) -> NDArray[np.float64]:
        """(longitude, latitude) `[2]`."""
        return (self.low + self.high) / 2

    @property
    def words(self) -> str:
        """Its middle in words: `46.95 N 9.001 E`."""
        return describe(*principal(self.middle).tolist())

    def meets(self, boxes: Boxes, margin: float = 0.0) -> NDArray[np.bool_]:
        """bool `[boxes]`: which of these boxes in degrees reach to within `margin` degrees of the map."""
        low, high = boxes
        middle, half = (low + high) / 2, (high - low) / 2
        middle = np.stack([near(middle[:, 0], float(self.middle[0]), TURN), middle[:, 1]], axis=1)
        apart = np.abs(middle - self.middle) - half - (self.high - self.low) / 2
        return (apart <= margin).all(axis=1) & in_range(low) & in_range(high)

    @property
    def margin(self) -> float:
        """Degrees from the map within which places are taken to be meant for it."""
        return max(NEAR, float((self.high - self.low).max()))

    def is_near(self, places: NDArray[np.float64]) -> bool:
        """True if one of (longitude, latitude) `[n, 2]` is meant for the map."""
        return bool(self.meets((places, places), self.margin).any())

    def check_order(self, boxes: Boxes, source: object) -> None:
        """Raise MapError for boxes none of which lies near the map, if they do with latitude and longitude swapped."""
        low, high = boxes
        swapped = self.meets((low[:, ::-1], high[:, ::-1]), self.margin)
        if swapped.any() and not self.meets(boxes, self.margin).any():
            why = f"swapped, it lies on the map, at {self.words}"
            raise latitude_first(low[swapped][0].tolist(), "", source, why)


def on_map(
    places: NDArray[np.float64], frame: Frame, georeference: Georeference, source: object
) -> NDArray[np.float64]:
    """(longitude, latitude) `[n, 2]` as metres of the map's frame. Raises MapError, also if latitude stands first."""
    patch = Patch.of(frame, georeference)
    patch.check_order((places, places), source)
    longitudes = near(places[:, 0], float(patch.middle[0]), TURN)
    return georeference.from_crs(np.stack([longitudes, places[:, 1]], axis=1), WGS84)


def extent(values: NDArray[np.float64], turn: float) -> tuple[float, float]:
    """Least and largest x of the shortest stretch that holds all `values`, where x comes round after `turn` (0: never).

    The first lies within half a turn of 0, the second may lie beyond.
    """
    x = np.unique(values)
    if not turn or (x[-1] - x[0] <= turn / 2 and np.abs(x).max() <= turn / 2):
        return float(x[0]), float(x[-1])
    x = np.unique(x % turn)
    gaps = np.append(x[1:], x[0] + turn) - x
    last = int(np.argmax(gaps))
    high = float(x[last])
    low = high - (turn - float(gaps[last]))
    back = turn * np.floor(low / turn + 0.5)
    return float(low - back), float(high - back)


def closed(polygons: list[Rings], turn: float, cell: float) -> tuple[list[Rings], float]:
    """The polygons with the sides of a cut, at most a cell apart, moved to where x comes round; how far apart they lie.

    That is at half a turn, or at 0 where x counts to a whole one. Sides up to WIDE cells apart are told of; beyond: 0.
    """
    x = np.concatenate([ring[:, 0] for rings in polygons for ring in rings])
    for west, east in ((-turn / 2, turn / 2), (0.0, turn)):
        short = float(np.abs(x - west).min()), float(np.abs(x - east).min())
        width = sum(short)
        if not turn or width > WIDE * cell:
            continue
        for side, other in ((west, short[1]), (east, short[0])) if width <= cell else ():
            polygons = [[_moved_to(side, ring, cell - other) for ring in rings] for rings in polygons]
        return polygons, width
    return polygons, 0.0


def _moved_to(side: float, ring: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
    x = np.where(np.abs(ring[:, 0] - side) <= tolerance, side, ring[:, 0])
    return np.column_stack([x, ring[:, 1]])


class Unrolled(NamedTuple):
    """Polygons where x comes round: `areas`, which together are the shape, and the `borders` around it.

    They are the same but where the shape was cut: there areas share an edge, and borders do not have it.
    """

    areas: list[Rings]
    borders: list[Rings]


def unrolled(polygons: list[Rings], low: float, high: float, turn: float) -> Unrolled:
    """Polygons of one shape where they lie about x = low .. high, where x comes round after `turn` (0: never).

    A ring with a step of more than half a turn goes the short way if it holds their middle no other way. A polygon
    comes as often as it lies there, at least once.
    """
    if not turn:
        return Unrolled(polygons, polygons)
    moved: list[Rings] = []
    turns: list[int] = []
    for rings in polygons:
        rings = _short_way(rings, low, high, turn)
        x = np.concatenate([ring[:, 0] for ring in rings])
        nearest = round(((low + high) - (x.min() + x.max())) / 2 / turn)
        there = [n for n in range(nearest - 1, nearest + 2) if x.min() + n * turn < high and x.max() + n * turn > low]
        for number in there or [nearest]:
            moved.append([np.add(ring, (number * turn, 0.0)) for ring in rings] if number else rings)
            turns.append(number)
    return Unrolled(moved, _joined(moved, turns, SEAM * turn) if len(set(turns)) > 1 else moved)


def _short_way(rings: Rings, low: float, high: float, turn: float) -> Rings:
    """The polygon with every step the short way round, if it has longer ones and is about x = low .. high only so."""
    if not any(_is_wide(ring, turn) for ring in rings):
        return rings

    def away(ring: NDArray[np.float64]) -> float:
        """From the middle of low .. high to the nearest x of the ring; below 0 within it."""
        middle, half = (low + high) / 2, float(np.ptp(ring[:, 0])) / 2
        return abs(float(near(ring[:, 0].min() + half, middle, turn)) - middle) - half

    short = [_unwrapped(ring, turn) for ring in rings]
    if away(rings[0]) <= 0 or away(short[0]) > (high - low) / 2 or np.ptp(short[0][:, 0]) == 0:
        return rings
    middle = float(short[0][:, 0].min() + short[0][:, 0].max()) / 2
    for ring in short[1:]:
        own = float(ring[:, 0].min() + ring[:, 0].max()) / 2
        ring[:, 0] += near(own, middle, turn) - own
    return short


def _joined(polygons: list[Rings], turns: list[int], tolerance: float) -> list[Rings]:
    """The borders of polygons, without those that they share after they were moved by different numbers of turns.

    Where an even number of edges runs along such a border it is none; what is left is walked round anew.
    """
    owners, edges = [], []
    for number, rings in enumerate(polygons):
        for ring in rings:
            edges.append(np.concatenate([ring, np.roll(ring, -1, axis=0)], axis=1))
            owners.append(np.full(len(ring), number))
    edge, owner = np.concatenate(edges), np.concatenate(owners)  # (x0, y0, x1, y1) of each
    upright = np.flatnonzero((np.abs(edge[:, 0] - edge[:, 2]) <= tolerance) & (edge[:, 1] != edge[:, 3]))
    upright = upright[np.argsort(edge[upright, 0])]
    groups = np.split(upright, np.flatnonzero(np.diff(edge[upright, 0]) > tolerance) + 1)
    seams = [group for group in groups if len({turns[number] for number in owner[group]}) > 1]
    if not seams:
        return polygons
    involved = np.isin(owner, owner[np.concatenate(seams)])
    borders: list[Edge] = []
    for seam in seams:
        x = edge[seam[0], 0]
        for column in (0, 2):
            edge[np.abs(edge[:, column] - x) <= tolerance, column] = x
        levels, ends = np.unique(edge[seam][:, [1, 3]], return_inverse=True)
        counts = np.zeros(len(levels), dtype=np.int64)
        np.add.at(counts, ends.reshape(-1, 2).min(axis=1), 1)
        np.add.at(counts, ends.reshape(-1, 2).max(axis=1), -1)
        odd = np.flatnonzero(np.cumsum(counts) % 2)
        borders += [((x, levels[n]), (x, levels[n + 1])) for n in odd]
    involved[np.concatenate(seams)] = False
    kept = [((x0, y0), (x1, y1)) for x0, y0, x1, y1 in edge[involved].tolist() if (x0, y0) != (x1, y1)] + borders
    parts = set(owner[np.concatenate(seams)].tolist())
    rest = [rings for number, rings in enumerate(polygons) if number not in parts]
    return [*rest, _walked(kept)] if kept else rest


def _walked(edges: list[Edge]) -> Rings:
    """Closed rings of the edges: from every corner an even number of them leads on."""
    ends: dict[tuple[float, float], list[int]] = defaultdict(list)
    for number, edge in enumerate(edges):
        for corner in edge:
            ends[corner].append(number)
    rings, used = [], [False] * len(edges)
    for first, (start, _) in enumerate(edges):
        if used[first]:
            continue
        ring, corner = [start], start
        while True:
            onward = ends[corner]
            while onward and used[onward[-1]]:
                onward.pop()
            if not onward:
                break
            number = onward.pop()
            used[number] = True
            one, other = edges[number]
            corner = other if corner == one else one
            ring.append(corner)
        rings.append(np.array(ring))
    return rings
