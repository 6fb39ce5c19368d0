"""A ROS 2 node that drives robots by `mrac-jax drive`: their poses in, goals for nav2 out. Robot i is /robot_i.

Source your ROS, then `python ros_node.py depot.yaml 4`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from functools import partial
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.node import Node

import mrac_jax as mrac

SILENCE = 30.0
"""Seconds without a pose after which a robot is given up for lost."""


class Driver(Node):
    """Reports poses by cell, sends each order as a goal; a robot that is silent for long is lost."""

    def __init__(self, world: mrac.World, robots: int, command: list[str]) -> None:
        super().__init__("mrac_driver")
        self.world, self.last = world, [self.get_clock().now()] * robots
        self.goals: dict[int, tuple[int, int]] = {}
        self.lost: set[int] = set()
        self.mission = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.clients_ = [ActionClient(self, NavigateToPose, f"/robot_{i}/navigate_to_pose") for i in range(robots)]
        for i in range(robots):
            self.create_subscription(PoseWithCovarianceStamped, f"/robot_{i}/amcl_pose", partial(self.pose, i), 10)
        self.create_timer(1.0, self.look_for_lost)
        self.listener = threading.Thread(target=self.listen, daemon=True)
        self.listener.start()

    def tell(self, **said: Any) -> None:
        """A line to the mission."""
        assert self.mission.stdin is not None
        self.mission.stdin.write(json.dumps(said) + "\n")
        self.mission.stdin.flush()

    def pose(self, robot: int, message: Any) -> None:
        """A robot is somewhere: it is reported once it is in the cell of its order."""
        self.last[robot] = self.get_clock().now()
        place = message.pose.pose.position
        row, col = (int(one) for one in self.world.to_cells([place.x, place.y]))
        if robot in self.lost:
            self.lost.discard(robot)
            self.tell(type="report", robot=robot, cell=[row, col], found=True)
        elif self.goals.get(robot) == (row, col):
            del self.goals[robot]
            self.tell(type="report", robot=robot, cell=[row, col])

    def look_for_lost(self) -> None:
        """Report who has been silent for too long."""
        now = self.get_clock().now()
        for robot, last in enumerate(self.last):
            if robot not in self.lost and (now - last).nanoseconds > SILENCE * 1e9:
                self.lost.add(robot)
                self.tell(type="report", robot=robot, stopped=True)

    def listen(self) -> None:
        """Orders become goals; errors are logged; the end ends the node."""
        assert self.mission.stdout is not None
        for line in self.mission.stdout:
            said = json.loads(line)
            if said["type"] == "orders":
                for order in said["orders"]:
                    self.send(order["robot"], (order["cell"][0], order["cell"][1]))
            elif said["type"] == "error":
                self.get_logger().error(said["error"])
            elif said["type"] == "end":
                self.get_logger().info(f"{said['outcome']}: {said['covered']:.1%} covered")

    def send(self, robot: int, cell: tuple[int, int]) -> None:
        """The centre of a cell as a goal."""
        self.goals[robot] = cell
        x, y = self.world.to_xy(cell[0] * self.world.shape[1] + cell[1])
        goal = NavigateToPose.Goal(pose=PoseStamped())
        goal.pose.header.frame_id = "map"
        goal.pose.pose.position.x, goal.pose.pose.position.y = float(x), float(y)
        goal.pose.pose.orientation.w = 1.0
        self.clients_[robot].send_goal_async(goal)


if __name__ == "__main__":
    rclpy.init()
    words = ["drive", sys.argv[1], "--robots", sys.argv[2], "--state", "mission.json"]
    rclpy.spin(Driver(mrac.load(sys.argv[1]), int(sys.argv[2]), [sys.executable, "-m", "mrac_jax", *words]))
