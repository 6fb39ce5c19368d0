"""Waypoints for a robot stack: each robot's nominal path as poses in metres in the map's frame (CSV)."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
from numpy.typing import NDArray

from planner.plans.plan import Plan
from planner.worlds.world import World

HEADER = ("robot", "step", "x", "y", "yaw")
DECIMALS = 6
"""Of x and y: micrometres, and so exact for coordinates of a projected map (millions of metres) in float64."""


def waypoints_csv(plan: Plan, world: World) -> str:
    """One row a robot and step, `robot,step,x,y,yaw`, waiting included.

    x, y: the cell's centre in metres (`World.to_xy`). yaw: radians in (-pi, pi], see `headings`.

    Source: SPEC section 9 (`origin`: the pose of the lower-left corner, yaw included).
    """
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(HEADER)
    for number, robot in enumerate(plan.robots):
        points = np.round(world.to_xy(robot.path), DECIMALS) + 0.0  # + 0.0: no "-0.000000"
        yaws = headings(robot.path, world)
        for step, ((x, y), yaw) in enumerate(zip(points.tolist(), yaws.tolist(), strict=True)):
            rows.writerow((number, step, f"{x:.{DECIMALS}f}", f"{y:.{DECIMALS}f}", repr(yaw)))
    return out.getvalue()


def headings(path: NDArray[np.int64], world: World) -> NDArray[np.float64]:
    """Which way the robot faces at each step of a path `[steps + 1]`: float64 radians `[steps + 1]` in (-pi, pi].

    The heading of the move that enters the cell, in the map's frame (the map's own yaw added; 0 = along +x). Waiting
    keeps it. Steps before the first move have that move's heading; a robot that never moves faces along its row.
    """
    rows, cols = np.divmod(path, world.shape[1])
    north, east = -np.diff(rows), np.diff(cols)
    moves = np.flatnonzero((north != 0) | (east != 0))
    if not len(moves):
        return np.full(len(path), _normalised(np.array(world.origin[2])))
    latest = np.searchsorted(moves, np.arange(len(path)) - 1, side="right") - 1  # move i enters step i + 1
    move = moves[np.maximum(latest, 0)]
    return _normalised(np.arctan2(north[move], east[move]) + world.origin[2])


def _normalised(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same directions in (-pi, pi]; what rounding leaves within 1e-12 of -pi is pi."""
    turned = angles - 2 * math.pi * np.round(angles / (2 * math.pi))
    return np.where(turned <= -math.pi + 1e-12, math.pi, turned)
