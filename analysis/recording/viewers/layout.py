"""The layout that shows a recording in Lichtblick and Foxglove, which draw nothing useful without one."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import numpy as np

from planner.files import Json, atomic_write
from planner.worlds.world import World

MOST_STATES = 16
"""Robots with a line of their own in the panel of what each is doing."""
_MARGIN = 1.12


def layout_json(world: World, robots: int) -> str:
    """The layout for recordings of `robots` robots in `world`, as JSON. The same input, the same text.

    From above: the threat map with the paths driven, of robots that learn it first the true one; beside it the areas
    with their owners. Below them what each of up to MOST_STATES robots is doing, coverage, how many robots are alive,
    and the events. All that depends on neither stands in `layout.json` beside this file, with null where something
    does.
    """
    layout: Json = json.loads(files("analysis.recording.viewers").joinpath("layout.json").read_text(encoding="utf-8"))
    panels, camera = layout["configById"], _camera(world)
    for name in ("3D!threat", "3D!areas"):
        panels[name]["cameraState"].update(camera)
    largest = max(float(np.nanmax(layer, initial=0.0)) for layer in (world.threat, world.by_phase))
    panels["3D!threat"]["topics"]["/map/threat"]["maxValue"] = max(largest, 1e-6)
    if world.knowledge is not None and world.knowledge.sense.range > 0:
        _show_truth(layout)
    panels["Plot!alive"]["maxYValue"] = robots
    panels["StateTransitions!doing"]["paths"] = [
        {"value": f"/stats.doing[{robot}]", "label": f"robot {robot}", "timestampMethod": "receiveTime"}
        for robot in range(min(robots, MOST_STATES))
    ]
    return json.dumps(layout, indent=1) + "\n"


def _show_truth(layout: Json) -> None:
    """The map as robots believe it behind what nobody has seen, and beside it what is true, under one camera."""
    panels, told = layout["configById"], layout["configById"]["3D!threat"]
    told["lichtblickPanelTitle"] = "As believed; dark: not seen yet"
    topics = {name: shown for name, shown in told["topics"].items() if name not in ("/map/threat", "/map/obstacles")}
    as_painted = {"visible": True, "colorMode": "rgba-fields"}
    panels["3D!truth"] = told | {
        "lichtblickPanelTitle": "What is true, and the paths driven",
        "topics": {"/map/truth": as_painted} | topics,
    }
    told["topics"]["/map/fog"] = as_painted
    maps = layout["layout"]["first"]
    layout["layout"]["first"] = {"direction": "row", "first": "3D!truth", "second": maps, "splitPercentage": 33.3}


def write_layout(path: Path, world: World, robots: int) -> None:
    """Write the layout to `path`, whole or not at all. Raises MapError where the folder does not exist."""
    with atomic_write(path, "w") as out:
        out.write(layout_json(world, robots))


def _camera(world: World) -> Json:
    """Straight above, and so far that all of the map is seen, whichever way it is turned."""
    height, width = world.shape
    corners = world.to_xy([0, width - 1, (height - 1) * width, height * width - 1])
    across, up = (np.ptp(corners, axis=0) + world.cell_size).tolist()
    distance = _MARGIN * max(up, across)
    offset = [*corners.mean(axis=0).tolist(), 0]
    return {"distance": distance, "targetOffset": offset, "near": distance / 1000, "far": distance * 10}
