"""Paths and areas with their chances as GeoJSON (RFC 7946: longitude and latitude, WGS 84)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import isfinite

import numpy as np

from analysis.exporting.antimeridian import cut_area, cut_line, over_a_pole
from analysis.exporting.mission import Mission, rounded
from analysis.exporting.outlines import outline
from planner.errors import MapError
from planner.files import Json

Position = list[float]


@dataclass(frozen=True)
class Feature:
    """A path or an area in longitude and latitude, and its facts.

    Attributes:
        name: of it. facts: what is known of it.
        is_area: it is an area, not a path.
        parts: what a cut at longitude 180 leaves, mostly one part: of a path one line, of an area rings, the outer one
            first, closed.
        points: of a path, uncut.
    """

    name: str
    is_area: bool
    parts: list[list[list[Position]]]
    facts: Json
    points: list[Position] = field(default_factory=list)


def features(mission: Mission) -> Iterator[Feature]:
    """Every area of t = 0, then every robot's path. Raises MapError for a map that nobody has put on the Earth."""
    yield from _areas(mission)
    yield from paths(mission)


def _areas(mission: Mission) -> Iterator[Feature]:
    """Every area of t = 0. Raises MapError also for one over a pole: it has no ring of longitudes and latitudes.

    Of each: `level`, `robot` (that has it at t = 0), `threat` (its largest), and, open loop, exact: `covered` (the
    mean chance of its cells to be visited), `losses` (robots expected to be lost in it).
    None: not known exactly. `believed_threat`: of robots that are not told the map.
    """
    world, width = mission.world, mission.world.shape[1]
    threat = world.threat.ravel()
    for number, area in enumerate(mission.plan.areas):
        facts = {
            "area": number,
            "level": area.level,
            "robot": None if area.robot < 0 else area.robot,
            "cells": len(area.cells),
            f"{mission.believed}threat": _rounded(threat[area.cells].max()),
            "covered": _rounded(mission.exact.visited_by_cell[area.cells].mean()),
            "losses": _rounded(mission.exact.stops_by_cell[area.cells].sum()),
        }
        rings = [mission.on_earth(world.at(*np.array(ring).T)) for ring in outline(area.cells, width)]
        if any(over_a_pole(ring) for ring in rings):
            problem = f"area {number} lies over a pole, and cannot be written in longitude and latitude"
            fix = "export .tif or .csv, in the map's metres, or .gpx, which holds no areas"
            raise MapError(problem, source=world.source, expected="areas beside the poles", fix=fix)
        parts = [[rounded(ring).tolist() for ring in part] for part in cut_area(rings)]
        yield Feature(f"area {number}", True, parts, facts)


def paths(mission: Mission) -> Iterator[Feature]:
    """Every robot's path: `robot`, `steps`, `chance_of_loss` before its end (None: not known exactly)."""
    world = mission.world
    for number, robot in enumerate(mission.plan.robots):
        facts = {
            "robot": number,
            "steps": mission.stops(number)[-1].step,
            "cells": len(np.unique(robot.path[robot.entered])),
            "chance_of_loss": _rounded(1 - mission.exact.survival[number]),
        }
        cells = [stop.cell for stop in mission.stops(number)]
        line = np.array(cells if len(cells) > 1 else cells * 2)  # of two points, if it never moves too
        lines = [[rounded(part).tolist()] for part in cut_line(mission.on_earth(world.to_xy(line)))]
        yield Feature(f"robot {number}", False, lines, facts, mission.lonlat(line).tolist())


def _rounded(value: float) -> float | None:
    return round(float(value), 9) if isfinite(value) else None


def geojson(mission: Mission) -> str:
    """A FeatureCollection of `features`: Polygons and LineStrings, of several parts where longitude 180 cuts them."""
    collection = [
        {"type": "Feature", "properties": {"name": feature.name} | feature.facts, "geometry": _geometry(feature)}
        for feature in features(mission)
    ]
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in collection)
    return f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n'


def _geometry(feature: Feature) -> Json:
    kind = "Polygon" if feature.is_area else "LineString"
    parts = feature.parts if feature.is_area else [line for (line,) in feature.parts]
    if len(parts) == 1:
        return {"type": kind, "coordinates": parts[0]}
    return {"type": f"Multi{kind}", "coordinates": parts}
