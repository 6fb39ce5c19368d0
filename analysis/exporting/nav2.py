"""Poses for nav2, one file a robot: the goal of its action FollowWaypoints, or of NavigateThroughPoses, as YAML."""

from __future__ import annotations

import math

import numpy as np

from analysis.exporting.mission import Mission
from planner.plans.waypoints import DECIMALS, headings

POSE = (
    "- header: {{frame_id: map}}\n"
    "  pose:\n"
    "    position: {{x: {x}, y: {y}, z: 0.0}}\n"
    "    orientation: {{x: 0.0, y: 0.0, z: {z}, w: {w}}}\n"
)
"""A geometry_msgs/PoseStamped; stamp 0: the latest transform."""
PRESUMED = (
    "# A pose ends a straight run along cells of {cell:g} m. Presumed: footprint and inflation fit into a cell, so\n"
    "# that the costmap leaves the straight way free; xy_goal_tolerance of the goal checker is below {half:g} m, so\n"
    "# that the robot turns in that cell. Threats are not in the costmap: a way around something may enter others.\n"
)


def nav2_poses(mission: Mission, robot: int) -> str:
    """`poses:`, the start and the end of every straight run, metres in the map frame.

    It faces along the run that it ends. Waiting is left out: nav2 goes on when it has arrived.
    """
    path = mission.plan.robots[robot].path
    steps = np.array([stop.step for stop in mission.stops(robot)])
    points, yaws = mission.world.to_xy(path[steps]), headings(path, mission.world)[steps]
    poses = [
        POSE.format(x=_number(x), y=_number(y), z=_number(math.sin(yaw / 2), 12), w=_number(math.cos(yaw / 2), 12))
        for (x, y), yaw in zip(points.tolist(), yaws.tolist(), strict=True)
    ]
    cell = mission.world.cell_size
    presumed = PRESUMED.format(cell=cell, half=cell / 2)
    return f"# robot {robot}\n{presumed}poses:\n{''.join(poses)}"


def _number(value: float, decimals: int = DECIMALS) -> str:
    """A float that YAML 1.1 takes for one: never without a point."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
