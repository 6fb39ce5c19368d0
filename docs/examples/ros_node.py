"""A ROS 2 node that drives robots by `mrac-jax drive`: their poses in, goals for nav2 out. Robot i is /robot_i.

Source your ROS, then `python ros_node.py depot.yaml 4`.
"""

import json
import sys
import threading
from functools import partial
from subprocess import PIPE, Popen
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.node import Node

import mrac_jax as mrac

SILENCE = 30.0
"""Seconds without a pose after which a robot is given up for lost."""
SLOW = 20.0
"""Seconds for a step; who has not got to its goal by then is where it is, and the others go on."""


class Driver(Node):
    """Reports poses by cell, sends each order as a goal; a robot that is silent for long is lost."""

    def __init__(self, world: mrac.World, robots: int, command: list[str]) -> None:
        super().__init__("mrac_driver")
        self.world, self.step, self.since = world, 0, self.get_clock().now()
        self.last, self.lost = [self.since] * robots, set[int]()
        self.goals, self.at = dict[int, tuple[int, int]](), dict[int, tuple[int, int]]()
        self.mission = Popen(command, stdin=PIPE, stdout=PIPE, text=True, bufsize=1)
        self.clients_ = [ActionClient(self, NavigateToPose, f"/robot_{i}/navigate_to_pose") for i in range(robots)]
        for i in range(robots):
            self.create_subscription(PoseWithCovarianceStamped, f"/robot_{i}/amcl_pose", partial(self.pose, i), 10)
        self.create_timer(1.0, self.look_round)
        self.listener = threading.Thread(target=self.listen, daemon=True)
        self.listener.start()

    def tell(self, **said: Any) -> None:
        """A line to the mission."""
        assert self.mission.stdin is not None
        self.mission.stdin.write(json.dumps(said) + "\n")

    def pose(self, robot: int, message: Any) -> None:
        """A robot is somewhere: it is reported once it is in the cell of its order."""
        self.last[robot] = self.get_clock().now()
        place = message.pose.pose.position
        row, col = self.at[robot] = tuple(self.world.to_cells([place.x, place.y]).tolist())
        found = {"found": True} if robot in self.lost else {}
        if found or self.goals.get(robot) == (row, col):
            self.lost.discard(robot)
            self.goals.pop(robot, None)
            self.tell(type="report", robot=robot, cell=[row, col], **found)

    def look_round(self) -> None:
        """Report who has been silent for too long; end a step that takes too long, with where everybody is."""
        now, step = self.get_clock().now(), self.step
        if (now - self.since).nanoseconds > SLOW * 1e9:
            self.since = now
            for robot in {*self.goals} & {*self.at} - self.lost:
                self.tell(type="report", robot=robot, cell=self.at[robot], step=step)
            self.tell(type="step", step=step)
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
                self.step, self.since = said["step"], self.get_clock().now()
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
