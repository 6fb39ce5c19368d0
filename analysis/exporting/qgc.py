"""QGroundControl's plan file, one a robot: https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html."""

from __future__ import annotations

import numpy as np

from analysis.exporting.mission import Mission
from analysis.kit.folder import json_text
from planner.files import Json

TAKE_OFF, WAYPOINT, CHANGE_SPEED = 22, 16, 178
"""Of MAV_CMD."""
ABOVE_HOME, NO_PLACE = 3, 2
"""Of MAV_FRAME: altitudes are above the place of take-off; an item without a place."""
COPTER, ROVER = 2, 10
"""Of MAV_TYPE."""
PX4 = 12
"""Of MAV_AUTOPILOT: what QGroundControl plans for where no vehicle is connected; the items are every autopilot's."""


def qgc_plan(mission: Mission, robot: int) -> str:
    """The `.plan` of a robot: the speed, a take-off unless it drives (altitude 0), and a waypoint a straight run.

    Waiting is the hold time of its waypoint. What it does after the last one is not said: the autopilot's default.
    Raises MapError for a map that nobody has put on the Earth.
    """
    stops = mission.stops(robot)
    places = mission.lonlat(np.array([stop.cell for stop in stops])).tolist()
    drives = mission.altitude == 0
    items: list[Json] = [_item(CHANGE_SPEED, NO_PLACE, [1, mission.speed, -1, 0, 0, 0, 0])]
    for number, (stop, (east, north)) in enumerate(zip(stops, places, strict=True)):
        takes_off = number == 0 and not drives
        if takes_off:
            items.append(_placed(TAKE_OFF, 0.0, north, east, mission.altitude))
        if not takes_off or stop.waits:
            hold = stop.waits * mission.step_seconds
            items.append(_placed(WAYPOINT, hold, north, east, mission.altitude))
    for number, item in enumerate(items, start=1):
        item["doJumpId"] = number
    (east, north), *_ = places
    content = {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": mission.speed,
            "firmwareType": PX4,
            "globalPlanAltitudeMode": 1,
            "hoverSpeed": mission.speed,
            "items": items,
            "plannedHomePosition": [north, east, 0],
            "vehicleType": ROVER if drives else COPTER,
            "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }
    return json_text(content)


def _placed(command: int, hold: float, north: float, east: float, altitude: float) -> Json:
    item = _item(command, ABOVE_HOME, [hold, 0, 0, None, north, east, altitude])
    return item | {"AMSLAltAboveTerrain": None, "Altitude": altitude, "AltitudeMode": 1}


def _item(command: int, frame: int, params: list[float | None]) -> Json:
    return {"autoContinue": True, "command": command, "frame": frame, "params": params, "type": "SimpleItem"}
