"""Paths and areas with their chances as GeoJSON (RFC 7946: longitude and latitude, WGS 84)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite

import numpy as np

from analysis.exporting.mission import DEGREES, Mission
from analysis.exporting.outlines import outline
from planner.files import Json

Position = list[float]


@dataclass(frozen=True)
class Feature:
    """A path (one line) or an area (rings, the outer one first, closed) in longitude and latitude, and its facts."""

    name: str
    is_area: bool
    lines: list[list[Position]]
    facts: Json


def features(mission: Mission) -> Iterator[Feature]:
    """Every area of t = 0, then every robot's path. Raises MapError for a map that nobody has put on the Earth.

    Of an area: `level`, `robot` (that has it at t = 0), `threat` (its largest), and, open loop, exact: `covered` (the
    mean chance of its cells to be visited), `losses` (robots expected to be lost in it). Of a path: `robot`, `steps`,
    `chance_of_loss` before its end. None: not known exactly. `believed_threat`: of robots that are not told the map.
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
        rings = [_corners(mission, ring) for ring in outline(area.cells, width)]
        yield Feature(f"area {number}", True, rings, facts)
    for number, robot in enumerate(mission.plan.robots):
        facts = {
            "robot": number,
            "steps": mission.stops(number)[-1].step,
            "cells": len(np.unique(robot.path[robot.entered])),
            "chance_of_loss": _rounded(1 - mission.exact.survival[number]),
        }
        cells = [stop.cell for stop in mission.stops(number)]
        cells = cells if len(cells) > 1 else cells * 2  # a line has two points, if the robot never moves too
        yield Feature(f"robot {number}", False, [mission.lonlat(np.array(cells)).tolist()], facts)


def _corners(mission: Mission, ring: list[tuple[int, int]]) -> list[Position]:
    rows, cols = np.array(ring).T
    places = mission.world.to_lonlat(mission.world.at(rows, cols))
    return (np.round(places, DEGREES) + 0.0).tolist()


def _rounded(value: float) -> float | None:
    return round(float(value), 9) if isfinite(value) else None


def geojson(mission: Mission) -> str:
    """A FeatureCollection of `features`: Polygons, LineStrings."""
    collection = [
        {
            "type": "Feature",
            "properties": {"name": feature.name} | feature.facts,
            "geometry": {"type": "Polygon", "coordinates": feature.lines}
            if feature.is_area
            else {"type": "LineString", "coordinates": feature.lines[0]},
        }
        for feature in features(mission)
    ]
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in collection)
    return f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n'
