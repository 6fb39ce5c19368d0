"""In whose words a scenario wants its answer, and the route that is to be safe: `metrics`, `route`, `route_xy`."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import Numbers
from planner.errors import WorldError
from planner.files import Json
from planner.worlds.keys import PLACE, Key
from planner.worlds.world import World

METRICS = ("coverage", "search", "clearance")
"""Whose words: of coverage planners, of search and rescue, of mine clearance."""
KEYS = ("metrics", "route", "route_xy")
SAMPLES = 16
"""Places looked at in each cell's length of a route."""


def reported(keys: dict[str, Key], world: World) -> Json:
    """`metrics` and `route` of `planner.worlds.world.Team`, those that the keys name."""
    found: Json = {}
    if "metrics" in keys:
        found["metrics"] = keys["metrics"].choice(METRICS)
    named = [name for name in KEYS[1:] if name in keys]
    if len(named) > 1:
        raise keys["route"].wrong("route or route_xy, not both")
    for name in named:
        metres = name == "route_xy"
        expected = f"a list of two {'[x, y] in metres' if metres else '[row, col]'} or more"
        corners = [
            item.numbers(Numbers(PLACE.least, PLACE.most), expected, 2) for item in keys[name].items(expected, 2)
        ]
        with keys[name].naming():
            found["route"] = route_over(world, world.places(corners) if metres else np.array(corners) + 0.5)
    return found


def route_over(world: World, corners: ArrayLike) -> NDArray[np.int64]:
    """The cells (row, col) int64 `[R, 2]` of a line through places in cells `[corners, 2]` (a centre is at .5).

    Raises WorldError where it leaves the map or meets an obstacle.
    """
    places = np.asarray(corners, dtype=np.float64)
    parts = []
    for start, stop in itertools.pairwise(places):
        count = SAMPLES * int(np.ceil(np.abs(stop - start).max())) + 1
        if count > SAMPLES * (sum(world.shape) + 2):
            raise WorldError("leaves the map", expected=f"places on the {world.shape[0]} x {world.shape[1]} cells")
        parts.append(np.linspace(start, stop, count))
    cells = np.floor(np.concatenate(parts)).astype(np.int64)
    cells = cells[np.append(True, (np.diff(cells, axis=0) != 0).any(axis=1))]
    off = ~((cells >= 0) & (cells < world.shape)).all(axis=1)
    if off.any():
        raise WorldError(f"leaves the map at {cells[off][0].tolist()}", expected="cells of the map")
    blocked = ~world.free[tuple(cells.T)]
    if blocked.any():
        raise WorldError(f"meets an obstacle at {cells[blocked][0].tolist()}", expected="free cells all the way")
    return cells


def with_route(world: World, route: ArrayLike) -> World:
    """The same world with a route that is to be safe, by (row, col) `[corners, 2]`. Raises WorldError."""
    corners = np.asarray(route)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 2 or corners.dtype.kind not in "iuf":
        raise WorldError(f"route has shape {list(corners.shape)}", expected="two [row, col] or more")
    try:
        cells = route_over(world, np.clip(corners, -(2.0**31), 2.0**31) + 0.5)
    except WorldError as error:
        raise WorldError(f"route {error.problem}", source=world.source, expected=error.expected) from error
    return replace(world, team=replace(world.team, route=cells))
