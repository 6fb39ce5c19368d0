"""Plans for export: probabilities of the open loop, straight runs, heights, and shapes in longitude and latitude."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.pictures import ROBOT_COLOURS
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from planner.arguments import Numbers
from planner.errors import MapError
from planner.files import Json
from planner.formatting import SPEEDS
from planner.plan.plan import Plan, last_move
from planner.plan.state import NO_CELLS
from planner.world.frame import TURN, near, principal
from planner.world.raster_bands import HEIGHTS, lay_over, read_band
from planner.world.world import World

# Common to all formats: a plan on its world, exact probabilities of the open loop, and paths as straight runs.

KML = "http://www.opengis.net/kml/2.2"
DEGREES = 9
"""Decimals of longitude and latitude: a tenth of a millimetre."""
ALTITUDE, SPEED = 20.0, 3.0
"""Defaults: metres above the take-off position, and metres a second."""


class Stop(NamedTuple):
    """End of a straight run: the step at which a robot arrives, the cell, and the steps that it waits there."""

    step: int
    cell: int
    waits: int


@dataclass(frozen=True, eq=False)
class Mission:
    """A plan for export.

    Attributes:
        world, plan: the map and the paths on it.
        altitude: metres above the take-off position, with `terrain` above the ground; 0: on the ground.
        speed: metres a second.
        terrain: float64 `[H, W]`, metres, height of the ground at the cells' centres (NaN: not known), or None.
        battery: minutes that a robot flies with one battery, or None.
        now: the time of the export, with a time zone.
    """

    world: World
    plan: Plan
    altitude: float
    speed: float
    terrain: NDArray[np.float64] | None
    battery: float | None
    now: datetime

    @cached_property
    def exact(self) -> OpenLoopExact:
        """Exact expectations of the open loop."""
        return open_loop_exact(self.plan, self.world)

    @property
    def believed(self) -> str:
        """Prefix of the names of figures that belong to the prior map, where it differs from the true map."""
        return "" if self.world.knowledge is None else "believed_"

    def unknown(self, figures: tuple[str, ...]) -> tuple[str, ...]:
        """A note with the names of those figures that lack an exact value for some cell or robot, and the reason."""
        uncertainty = self.world.uncertainty or self.world.knowledge
        if not figures or uncertainty is None:
            return ()
        covered, lost, survival = self.exact.visited_by_cell, self.exact.stops_by_cell, self.exact.survival
        of = {"covered": covered, "losses": lost, "residual": covered, "chance_of_loss": survival}
        left = [name for name in figures if np.isnan(of[name]).any()]
        if not left:
            return ()
        names = " and ".join(filter(None, (", ".join(left[:-1]), left[-1])))
        return (
            f"{names} omitted where the open loop has no exact value (`evaluate` estimates them): "
            f"{uncertainty.description}",
        )

    @property
    def step_seconds(self) -> float:
        """Seconds for each step."""
        return self.world.cell_size / self.speed

    def stops(self, robot: int) -> list[Stop]:
        """The ends of the straight runs of a robot's path."""
        return straight_runs(self.plan.robots[robot].path)

    def lonlat(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """(longitude, latitude) of the centres of cells, degrees. Raises MapError for a map without georeference."""
        return rounded(principal(on_earth(self.world, self.world.to_xy(cells))))

    @property
    def bases(self) -> NDArray[np.int64]:
        """Cells to which robots return, int64 `[bases]`; none if they do not."""
        to = None if self.plan.settings is None else self.plan.settings.return_to
        places = self.plan.starts if isinstance(to, str) else np.array(to or (), dtype=np.int64).reshape(-1, 2)
        return np.unique(places @ (self.world.shape[1], 1)) if to is not None else NO_CELLS


def on_earth(world: World, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(longitude, latitude) of points (x, y) in the map frame; longitudes continue beyond 180. Raises MapError."""
    height, width = world.shape
    middle = world.to_lonlat(world.at(height / 2, width / 2))
    assert world.georeference is not None
    return world.georeference.to_lonlat(points, about=middle[0])


def rounded(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(longitude, latitude) with the decimals of files, without -0."""
    return np.round(places, DEGREES) + 0.0


def make_mission(
    world: World,
    plan: Plan,
    altitude: float | None = None,
    speed: float | None = None,
    terrain: Path | None = None,
    battery: float | None = None,
    now: datetime | None = None,
) -> Mission:
    """A checked mission.

    None: ALTITUDE; the speed that the world implies, else SPEED; level ground; no limit; the time of the call.

    Raises InputError: an altitude, speed or battery out of range, a plan of another map, a raster `terrain` without
    heights somewhere on the paths.
    """
    if speed is None:
        speed = SPEED if world.pace.seconds is None else world.cell_size / world.pace.seconds
    altitude = ALTITUDE if altitude is None else altitude
    Numbers(0, 10_000, "metres above the ground").check("altitude", altitude)
    SPEEDS.check("speed", speed)
    Numbers(0, 10_000, "minutes", above=True).check("battery", battery, optional=True)
    plan.require(world)
    # The raster is opened after these checks.
    ground = None if terrain is None else ground_heights(world, plan, terrain)
    return Mission(world, plan, altitude, speed, ground, battery, now or datetime.now(UTC))


def ground_heights(world: World, plan: Plan, raster: Path) -> NDArray[np.float64]:
    """Heights of the ground at the cells' centres, float64 `[H, W]`, linear in the raster's.

    Raises MapError: no raster of heights, a map or a raster without georeference, a path beyond its heights.
    """
    world.to_lonlat((0, 0))
    band = read_band(raster, HEIGHTS)
    if band.bounds is None or band.crs is None:
        raise MapError("has no position", source=raster, expected="a raster of heights with a CRS")
    assert world.georeference is not None
    found = lay_over(band, world.frame, world.georeference, "bilinear", str(raster))
    path = np.concatenate([robot.path for robot in plan.robots])
    if (bare := np.isnan(found.ravel()[path])).any():
        row, col = divmod(int(path[np.argmax(bare)]), world.shape[1])
        problem = f"has no height at the cell [{row}, {col}] of a path ({len(np.unique(path[bare]))} such cells)"
        raise MapError(problem, source=raster, expected="heights along all paths", fix="take a raster that covers them")
    return found


def straight_runs(path: NDArray[np.int64]) -> list[Stop]:
    """The ends of a path's straight runs, with the start and the last cell; waiting at the end is omitted."""
    # Plans pad shorter paths by waiting at the end.
    path = path[: last_move(path) + 1]
    moves = np.diff(path)
    stops = [Stop(0, int(path[0]), 0)]
    for step, end in pairwise(np.unique([0, *np.flatnonzero(np.diff(moves)) + 1, len(moves)]).tolist()):
        if moves[step] == 0:
            stops[-1] = stops[-1]._replace(waits=end - step)
        else:
            stops.append(Stop(end, int(path[end]), 0))
    return stops


# Lines and polygons cut at longitude 180 (RFC 7946, section 3.1.9), so that no part spans the whole flat map.

Position = list[float]
Ring = NDArray[np.float64]
"""Corners (longitude, latitude) `[points, 2]`, closed; longitudes continue beyond 180."""
HALF = TURN / 2
POLE = 90 - 1e-9
"""Latitude from which a corner counts as the pole (0.1 mm)."""


def over_a_pole(ring: Ring) -> bool:
    """True for a closed ring around a pole, or through one: the short steps in longitude do not sum to 0."""
    # Each step is taken the short way around the Earth.
    steps = near(np.diff(ring[:, 0]), 0.0, TURN)
    through = np.abs(np.abs(steps) - HALF) < 1e-6
    return bool(abs(steps.sum()) > HALF or through.any() or (np.abs(ring[:, 1]) >= POLE).any())


def cut_line(line: Ring) -> list[Ring]:
    """The parts of a line with longitudes in -180..180; a line that only touches 180 is not cut."""
    points = [line[0]]
    for (x0, y0), (x1, y1) in pairwise(line):
        low, high = min(x0, x1), max(x0, x1)
        seams = [TURN * n + HALF for n in range(math.floor((low - HALF) / TURN), math.ceil((high - HALF) / TURN) + 1)]
        crossed = sorted((seam for seam in seams if low < seam < high), reverse=bool(x0 > x1))
        points += [np.array([seam, y0 + (seam - x0) * (y1 - y0) / (x1 - x0)]) for seam in crossed]
        points.append(np.array([x1, y1]))
    places = np.array(points)
    # The middle of a segment decides its turn, so that an end on the seam is unambiguous.
    turns = np.floor(((places[:-1, 0] + places[1:, 0]) / 2 + HALF) / TURN)
    ends = [0, *(np.flatnonzero(np.diff(turns)) + 1).tolist(), len(turns)]
    return [places[first : last + 1] - (turns[first] * TURN, 0) for first, last in pairwise(ends)]


def cut_area(rings: list[Ring]) -> list[list[Ring]]:
    """The parts of a polygon (outer ring first, then holes), each as rings with longitudes in -180..180.

    Outer rings are counterclockwise and holes clockwise, before and after.
    """
    import shapely

    low, high = min(ring[:, 0].min() for ring in rings), max(ring[:, 0].max() for ring in rings)
    first, last = math.floor((low + HALF) / TURN), math.ceil((high + HALF) / TURN) - 1
    if last <= first:
        return [[ring - (first * TURN, 0) for ring in rings]]
    area, parts = shapely.make_valid(shapely.Polygon(rings[0], rings[1:])), []
    for turn in range(first, last + 1):
        west, east = turn * TURN - HALF, turn * TURN + HALF
        held = shapely.get_parts(shapely.orient_polygons(area & shapely.box(west, -90, east, 90)))
        for part in (part for part in held if part.geom_type == "Polygon"):
            corners = [
                np.clip(shapely.get_coordinates(ring), (west, -90), (east, 90)) for ring in shapely.get_rings(part)
            ]
            parts.append([ring - (turn * TURN, 0) for ring in corners])
    return parts


def outlines(areas: list[NDArray[np.int64]], shape: tuple[int, int]) -> list[list[NDArray[np.int64]]]:
    """Closed rings (row, col) `[points, 2]` of cell corners around 4-connected areas, each outer ring first.

    Seen with row 0 at the top, outer rings are counterclockwise and holes are clockwise (RFC 7946, section 3.1.6).
    Rings are simple: where two cells meet only in a corner, the outline turns to the other cell.
    """
    from rasterio.features import shapes

    labels = np.zeros(shape, dtype=np.int32)
    for number, cells in enumerate(areas, start=1):
        labels.reshape(-1)[cells] = number
    rings = {int(label): outline["coordinates"] for outline, label in shapes(labels, labels > 0, connectivity=4)}
    return [[np.array(ring, dtype=np.int64)[:, ::-1] for ring in rings[n]] for n in range(1, len(areas) + 1)]


def polygons(world: World, areas: list[NDArray[np.int64]]) -> list[list[list[list[Position]]]]:
    """The parts of each area (cells) in longitude and latitude: closed rings, outer ring first.

    Raises MapError for a map without georeference, and for an area over a pole, which has no such ring.
    """
    found = []
    for number, borders in enumerate(outlines(areas, world.shape)):
        rings = [on_earth(world, world.at(*ring.T)) for ring in borders]
        if any(over_a_pole(ring) for ring in rings):
            problem = f"area {number} lies over a pole, and cannot be written in longitude and latitude"
            fix = "export .tif or .csv, in the map's metres, or .gpx, which holds no areas"
            raise MapError(problem, source=world.source, expected="no area over a pole", fix=fix)
        found.append([[rounded(ring).tolist() for ring in part] for part in cut_area(rings)])
    return found


# Paths and areas with their probabilities.


@dataclass(frozen=True)
class Feature:
    """A path or an area in longitude and latitude, with its properties.

    Attributes:
        name: for display. facts: properties.
        is_area: area or path.
        parts: after the cut at longitude 180, usually one: a line of a path, or the closed rings of an area, outer ring
            first.
        points: of a path, uncut.
    """

    name: str
    is_area: bool
    parts: list[list[list[Position]]]
    facts: Json
    points: list[Position] = field(default_factory=list)


UNASSIGNED = "#777777"


def colour_of(feature: Feature) -> str:
    """The colour of its robot, "#rrggbb"."""
    robot = feature.facts["robot"]
    return UNASSIGNED if robot is None else ROBOT_COLOURS[robot % len(ROBOT_COLOURS)]


def features(mission: Mission) -> Iterator[Feature]:
    """Every area at t = 0, then every robot's path. Raises MapError for a map without georeference."""
    yield from _areas(mission)
    yield from paths(mission)


def _areas(mission: Mission) -> Iterator[Feature]:
    """Every area at t = 0. Raises MapError also for an area over a pole, which has no ring of longitudes and latitudes.

    Properties: `level`, `robot` (to which it is assigned at t = 0), `threat` (its largest), and exact for the open
    loop `covered` (mean probability that its cells are visited) and `losses` (expected robots lost in it). None: no
    exact value. `believed_threat`: of the prior map, if the team does not know the true map.
    """
    world, areas = mission.world, mission.plan.areas
    threat, parts = world.threat.ravel(), polygons(world, [area.cells for area in areas])
    for number, area in enumerate(areas):
        facts = {
            "area": number,
            "level": area.level,
            "robot": None if area.robot < 0 else area.robot,
            "cells": len(area.cells),
            f"{mission.believed}threat": _rounded(threat[area.cells].max()),
            "covered": _rounded(mission.exact.visited_by_cell[area.cells].mean()),
            "losses": _rounded(mission.exact.stops_by_cell[area.cells].sum()),
        }
        yield Feature(f"area {number}", True, parts[number], facts)


def paths(mission: Mission) -> Iterator[Feature]:
    """Every robot's path: `robot`, `steps`, `chance_of_loss` before its end (None: no exact value)."""
    world = mission.world
    for number, robot in enumerate(mission.plan.robots):
        facts = {
            "robot": number,
            "steps": mission.stops(number)[-1].step,
            "cells": len(np.unique(robot.path[robot.entered])),
            "chance_of_loss": _rounded(1 - mission.exact.survival[number]),
        }
        cells = [stop.cell for stop in mission.stops(number)]
        # A LineString needs two points, even if the robot never moves.
        line = np.array(cells if len(cells) > 1 else cells * 2)
        lines = [[rounded(part).tolist()] for part in cut_line(on_earth(world, world.to_xy(line)))]
        yield Feature(f"robot {number}", False, lines, facts, mission.lonlat(line).tolist())


def _rounded(value: float) -> float | None:
    return round(float(value), 9) if math.isfinite(value) else None
