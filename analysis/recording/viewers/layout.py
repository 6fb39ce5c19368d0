"""The layout that shows a recording in Lichtblick and Foxglove, which draw nothing useful without one."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from planner.files import Json, atomic_write
from planner.worlds.world import World

MOST_STATES = 16
"""Robots with a line of their own in the panel of what each is doing."""
BACKGROUND, SAFE, THREAT = "#15181d", "#2a2f37", "#ff3b30"
LINES = {
    "/stats.coverage_visited": ("visited", "#4ea1ff"),
    "/stats.coverage_survived": ("survived", "#2ecc96"),
    "/stats.alive": ("robots alive", "#ffdd3c"),
    "/stats.unassigned_areas": ("areas nobody has", "#ff9f1c"),
}
_MARGIN = 1.12


def layout_json(world: World, robots: int) -> str:
    """The layout for recordings of `robots` robots in `world`, as JSON. The same input, the same text.

    From above: the threat map with the paths driven, beside it the areas with their owners. Below them what each of up
    to MOST_STATES robots is doing, coverage, how many robots are alive, and the events.
    """
    threat = {
        "/map/threat": {
            "visible": True,
            "colorField": "threat",
            "colorMode": "gradient",
            "gradient": [SAFE, THREAT],
            "minValue": 0,
            "maxValue": max(float(np.nanmax(world.threat, initial=0.0)), 1e-6),
        },
        "/driven": {"visible": True, "showOutlines": False},
    }
    areas = {"/areas": {"visible": True, "colorMode": "rgba-fields"}}
    doing = [
        {"value": f"/stats.doing[{robot}]", "label": f"robot {robot}", "timestampMethod": "receiveTime"}
        for robot in range(min(robots, MOST_STATES))
    ]
    panels = {
        "3D!threat": _map_panel(world, "Threat, and the paths driven", threat),
        "3D!areas": _map_panel(world, "Areas: bright where covered, pale where still to do", areas),
        "StateTransitions!doing": {
            "paths": doing,
            "isSynced": True,
            "lichtblickPanelTitle": "What each robot is doing",
        },
        "Plot!coverage": _plot(
            "Coverage: visited blue, survived green", ["/stats.coverage_visited", "/stats.coverage_survived"], top=1.0
        ),
        "Plot!alive": _plot("Robots alive", ["/stats.alive"], top=robots),
        "Plot!unassigned": _plot("Areas that nobody has", ["/stats.unassigned_areas"]),
        "RosOut!events": {
            "searchTerms": [],
            "minLogLevel": 1,
            "topicToRender": "/events",
            "lichtblickPanelTitle": "Events",
        },
    }
    counts = _split("column", "Plot!alive", "Plot!unassigned", 50)
    plots = _split("row", "Plot!coverage", counts, 55)
    below = _split("row", _split("row", "StateTransitions!doing", plots, 42), "RosOut!events", 72)
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 5},
        "layout": _split("column", _split("row", "3D!threat", "3D!areas", 50), below, 60),
    }
    return json.dumps(layout, indent=1) + "\n"


def write_layout(path: Path, world: World, robots: int) -> None:
    """Write the layout to `path`, whole or not at all. Raises MapError where the folder does not exist."""
    with atomic_write(path, "w") as out:
        out.write(layout_json(world, robots))


def _map_panel(world: World, title: str, topics: Json) -> Json:
    """A view from straight above that shows all of the map, whichever way it is turned."""
    height, width = world.shape
    corners = world.to_xy([0, width - 1, (height - 1) * width, height * width - 1])
    centre = corners.mean(axis=0).tolist()
    across, up = (np.ptp(corners, axis=0) + world.cell_size).tolist()
    distance = _MARGIN * max(up, across)
    shown = {
        **topics,
        "/map/obstacles": {"visible": True, "colorMode": "rgba-fields"},
        "/robots/markers": {"visible": True, "showOutlines": False},
    }
    hidden_frames = {"showLabel": False, "axisScale": 0, "lineWidth": 0, "enablePreloading": False}
    return {
        "lichtblickPanelTitle": title,
        "cameraState": {
            "distance": distance,
            "perspective": False,
            "phi": 0,
            "target": [0, 0, 0],
            "targetOffset": [*centre, 0],
            "targetOrientation": [0, 0, 0, 1],
            "thetaOffset": 0,
            "fovy": 45,
            "near": distance / 1000,
            "far": distance * 10,
        },
        "followMode": "follow-none",
        "followTf": "map",
        "scene": {"backgroundColor": BACKGROUND, "transforms": hidden_frames},
        "transforms": {},
        "topics": shown,
        "layers": {},
        "publish": {},
    }


def _plot(title: str, paths: Sequence[str], top: float | None = None) -> Json:
    """Lines over time, from 0 to `top` (None: to the largest)."""
    lines = [
        {
            "value": path,
            "label": LINES[path][0],
            "color": LINES[path][1],
            "lineSize": 2,
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for path in paths
    ]
    return {
        "lichtblickPanelTitle": title,
        "paths": lines,
        "minYValue": 0,
        **({} if top is None else {"maxYValue": top}),
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": False,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }


def _split(direction: str, first: Any, second: Any, percentage: int) -> Json:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}
