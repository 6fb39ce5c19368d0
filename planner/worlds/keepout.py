"""What a scenario keeps robots out of, put on the map as obstacles: polygons, and occupied pixels of another map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planner.worlds.grid import OCCUPIED, Grid
from planner.worlds.keys import Key
from planner.worlds.polygons import read_polygons
from planner.worlds.ros_map import FULL, read_ros_map
from planner.worlds.shapes import values_over

KINDS = ("polygons", "layer")


def keep_out(key: Key, grid: Grid) -> Grid:
    """The map with obstacles where a polygon holds a pixel's centre, or a ROS map laid over it is occupied (100).

    Raises ScenarioError for what names neither or keeps out nothing, MapError for a file that cannot be read.
    """
    state, notes = grid.state.copy(), list(grid.notes)
    for item in key.items("a list of {polygons: ...} and {layer: ...}"):
        keys = item.mapping(optional=KINDS)
        if len(keys) != 1:
            raise item.wrong("one of polygons and layer")
        (kind,) = keys
        if kind == "layer":
            layer = read_ros_map(keys[kind].file("a map_server YAML file"))
            held = values_over(layer, grid.frame) >= FULL
            notes.extend(f"{item.path}: {note}" for note in layer.notes)
        else:
            path = keys[kind].file("a file of polygons")
            shapes = read_polygons(path, 0.0, grid.frame, grid.georeference)
            held = np.logical_or.reduce([feature.mask(grid.frame) for feature in shapes.features])
            notes += [f"{item.path}: {note}" for note in shapes.notes]
        if not held.any():
            raise keys[kind].wrong("something on the map", "it keeps robots out of no pixel: check its coordinates")
        state[held] = OCCUPIED
        notes.append(f"{item.path}: {int(held.sum())} pixels are kept out of")
    return replace(grid, state=state, notes=tuple(notes))
