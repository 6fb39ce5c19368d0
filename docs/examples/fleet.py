"""A simulated fleet, driven by `mrac-jax drive` through a pipe. Its reports are lost, late and doubled.

python fleet.py example:paper 4
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
from typing import Any

import mrac_jax as mrac


class Fleet:
    """Robots that follow orders and are destroyed by the threats of the map.

    Args:
        world: the map. trouble: chance that a report is lost, that it comes a step late, and that it is said twice.
    """

    def __init__(self, world: mrac.World, trouble: float, seed: int) -> None:
        self.threat, self.trouble, self.random = world.threat, trouble, random.Random(seed)
        self.at: dict[int, tuple[int, int] | None] = {}
        self.stopped: set[int] = set()
        self.late: list[dict[str, Any]] = []

    def carry_out(self, orders: dict[str, Any]) -> list[dict[str, Any]]:
        """The lines that reach the mission in the step of these orders; the last one ends it."""
        step, lines, self.late = orders["step"], self.late, []
        for order in orders["orders"]:
            robot, cell = order["robot"], (order["cell"][0], order["cell"][1])
            if robot not in self.stopped and self.at.get(robot) != cell:
                self.at[robot] = cell
                if self.random.random() < self.threat[cell]:
                    self.stopped.add(robot)
            report = {"type": "report", "robot": robot, "cell": self.at[robot], "step": step}
            if robot in self.stopped:  # who watches it says so, until no order comes any more
                report["stopped"] = True
            lost, late, doubled = (self.random.random() < self.trouble for _ in range(3))
            if late:
                self.late.append(report)
            elif not lost:
                lines += [report] * (1 + doubled)
        return [*lines, {"type": "step", "step": step}]


def drive(source: str, robots: int, trouble: float = 0.1, seed: int = 0, *options: str) -> dict[str, Any]:
    """Drive a mission to its end; the last line that was said."""
    fleet = Fleet(mrac.load(source), trouble, seed)
    command = [sys.executable, "-m", "mrac_jax", "drive", source, "--robots", str(robots), *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as mission:
        assert mission.stdin is not None and mission.stdout is not None
        for line in mission.stdout:
            said = json.loads(line)
            if said["type"] == "end":
                mission.stdin.close()
                return said
            if said["type"] == "error":
                sys.stderr.write(said["error"] + "\n")
            elif said["type"] == "orders":
                for answer in fleet.carry_out(said):
                    mission.stdin.write(json.dumps(answer) + "\n")
                mission.stdin.flush()
    raise RuntimeError("the mission ended without a word")


if __name__ == "__main__":
    sys.stdout.write(json.dumps(drive(sys.argv[1], int(sys.argv[2]))) + "\n")
