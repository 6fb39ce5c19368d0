"""Poses for nav2, one file a robot: the goal of its action FollowWaypoints, or of NavigateThroughPoses, as YAML."""

from __future__ import annotations

import math

from analysis.exporting.mission import Mission
from planner.plans.plan import entries
from planner.plans.waypoints import DECIMALS, headings

POSE = (
    "- header: {{frame_id: map}}\n"
    "  pose:\n"
    "    position: {{x: {x}, y: {y}, z: 0.0}}\n"
    "    orientation: {{x: 0.0, y: 0.0, z: {z}, w: {w}}}\n"
)
"""A geometry_msgs/PoseStamped; stamp 0: the latest transform."""


def nav2_poses(mission: Mission, robot: int) -> str:
    """`poses:`, one for every cell that the robot enters (its start first), metres in the map frame.

    It faces along the move that enters the cell. Waiting is left out: nav2 goes on when it has arrived.
    """
    path = mission.plan.robots[robot].path
    steps = entries(path)
    points, yaws = mission.world.to_xy(path[steps]), headings(path, mission.world)[steps]
    poses = [
        POSE.format(x=_number(x), y=_number(y), z=_number(math.sin(yaw / 2), 12), w=_number(math.cos(yaw / 2), 12))
        for (x, y), yaw in zip(points.tolist(), yaws.tolist(), strict=True)
    ]
    return f"# robot {robot}\nposes:\n{''.join(poses)}"


def _number(value: float, decimals: int = DECIMALS) -> str:
    """A float that YAML 1.1 takes for one: never without a point."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
