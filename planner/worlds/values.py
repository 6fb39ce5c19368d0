"""What cells are worth and how well a visit detects: the keys `value` and `detect` of a scenario (SPEC section 13)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.worlds.grid import Ground
from planner.worlds.keys import Key
from planner.worlds.physical import AMOUNTS, PROBABILITIES
from planner.worlds.points import COLUMNS, read_points
from planner.worlds.polygons import read_polygons, rings_of
from planner.worlds.quantities import DETECT, VALUE, Quantity, first_of
from planner.worlds.shapes import CUT_OFF, point_threat
from planner.worlds.threats import check_place, columns_said, one_source, raster_on, read_falloff
from planner.worlds.warp import How

Layer = NDArray[np.float64]
NOWHERE = "is said of no cell"


class Says(NamedTuple):
    """What a source says, float64 `[H, W]`, and of which cells, bool `[H, W]`; notes."""

    layer: Layer
    where: NDArray[np.bool_]
    notes: tuple[str, ...] = ()


def layers(keys: dict[str, Key], ground: Ground) -> tuple[dict[str, Layer | None], tuple[str, ...]]:
    """The arguments `value` and `detect` of `World.create`, float64 `[H, W]`, None if nothing is said; notes."""
    found = {of.name: _layer(keys.get(of.name), of, ground) for of in (VALUE, DETECT)}
    return {name: layer for name, (layer, _) in found.items()}, sum((notes for _, notes in found.values()), ())


def _layer(key: Key | None, of: Quantity, ground: Ground) -> tuple[Layer | None, tuple[str, ...]]:
    """The map's own layer, else 1 everywhere; then source by source, of which the last one counts in a cell; notes."""
    own = getattr(ground.grid, of.name)
    own = None if own is None else _over_pixels(of, ground)(own)
    notes: tuple[str, ...] = ()
    if key is None:
        return own, notes
    if of is VALUE and ground.grid.swath is not None:
        raise key.wrong("none of a map with a swath, where it counts the field's cells", "leave one of the two out")
    if not isinstance(key.value, list):
        return np.full(
            ground.frame.shape, key.number(of.numbers, f"{of.numbers.expected}, or a list of sources")
        ), notes
    layer = np.ones(ground.frame.shape) if own is None else own
    for source in key.items("a list of sources"):
        says = _source(source, of, ground)
        layer = np.where(says.where, says.layer, layer)
        notes += tuple(f"{source.path}: {note}" for note in says.notes)
    return layer, notes


def _over_pixels(of: Quantity, ground: Ground) -> Callable[[Layer], Layer]:
    """What a cell has of its pixels: the sum of their values, the mean of their chances."""
    return ground.total if of is VALUE else ground.mean


def _source(key: Key, of: Quantity, ground: Ground) -> Says:
    kind = one_source(key, SOURCES)
    options, read = SOURCES[kind]
    return read(key.mapping((kind,), optional=[of.name if name == "" else name for name in options]), of, ground)


def _everywhere(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    shape = ground.frame.shape
    return Says(np.full(shape, keys["everywhere"].number(of.numbers)), np.ones(shape, dtype=bool))


def _raster(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """A raster on the map's pixels, or on the cells, of the numbers themselves: values are amounts, and add up."""
    key = keys["raster"]
    how: How = "sum" if of is VALUE else "average"
    raster, free, pixels = raster_on(key, ground, how, AMOUNTS if of is VALUE else PROBABILITIES)
    values = np.where(free, raster.values, 0.0)
    wrong = ~((values >= 0) & (values <= of.numbers.most))
    if wrong.any():
        at, where = first_of(wrong)
        problem = f"names {key.value}, which says {of.name} = {values[at]:g} {where}"
        raise key.fault(problem, of.numbers.expected, "mend the raster")
    return Says(_over_pixels(of, ground)(values) if pixels else values, ground.free, raster.notes)


def _polygons(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """The number of the last polygon that holds the centre of a cell."""
    default = keys[of.name].number(of.numbers) if of.name in keys else None
    frame, place = ground.frame, ground.grid.georeference
    features, _, notes = read_polygons(keys["polygons"].file("a file of polygons"), default, frame, place, of)
    says, where = np.zeros(frame.shape), np.zeros(frame.shape, dtype=bool)
    for feature in features:
        held = feature.mask(frame)
        says, where = np.where(held, feature.number, says), where | held
    if not where.any():
        check_place(keys["polygons"], np.concatenate(rings_of(features)), frame, place, NOWHERE)
    return Says(says, where, notes)


def _points(keys: dict[str, Key], of: Quantity, ground: Ground) -> Says:
    """Points with a strength each, over what `falloff` says, else in the cell that holds them.

    Where several reach a cell their values add up, and of the chances to detect the best one counts.
    """
    key, frame, place = keys["points"], ground.frame, ground.grid.georeference
    path = key.file("a CSV file with x, y, strength")
    points, _, notes = read_points(path, frame, place, of, columns_said(keys))
    merge = np.add if of is VALUE else np.maximum
    if "falloff" in keys:
        kind, radius = read_falloff(keys["falloff"])
        says = point_threat(points, kind, radius, frame, merge)
        touched = np.column_stack([points[:, :2], np.ones(len(points))])
        where = point_threat(touched, "disc", radius if kind == "disc" else CUT_OFF * radius, frame, np.maximum) > 0
    else:
        at = frame.pixels(points[:, :2])
        held = frame.holds(at)
        says, where = np.zeros(frame.shape), np.zeros(frame.shape, dtype=bool)
        merge.at(says, tuple(at[held].T), points[held, 2])
        where[tuple(at[held].T)] = True
    if not where.any():
        check_place(key, points[:, :2], frame, place, NOWHERE)
    return Says(says, where, notes)


SOURCES: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Key], Quantity, Ground], Says]]] = {
    "everywhere": ((), _everywhere),
    "raster": ((), _raster),
    "polygons": (("",), _polygons),
    "points": (("falloff", *COLUMNS), _points),
}
"""Every kind of source: the keys that may stand beside it ("": the quantity's own name), and what reads it."""
