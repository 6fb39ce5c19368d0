"""A mission for `tests/test_driving.py` to kill: it drives itself by luck a visit, from its file, to its end."""

import os
import signal
import sys
import time
from pathlib import Path

from helpers import VisitDraws

from planner.errors import StateError
from planner.make_plan import make_plan
from planner.mission.mission import Mission
from planner.plan.plan import Plan
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World


def small_case(seed: int) -> tuple[World, Plan]:
    world = random_world(8, 9, ThreatPattern("contiguous", areas=3, seed=seed), obstacles=0.2, threats=0.3)
    return world, make_plan(world, place_starts(world, 3)[0])


def drive_by_luck(file: Path, seed: int) -> None:
    """Every report is in the file before the next is made."""
    world, plan = small_case(seed)
    try:
        mission = Mission.resume(file, world, plan) if file.exists() else Mission(world, plan)
    except StateError as error:  # killed after its last save: the file is of a mission that has ended
        if not error.problem.startswith(("every cell in reach is visited", "every robot is dead")):
            raise
        return
    luck, width = VisitDraws(world, seed, 0), world.shape[1]
    while mission.outcome is None:
        mission.save(file)
        for robot in range(mission.robots):
            order = mission.orders().get(robot)
            if order is None or robot not in mission.awaited:
                continue
            row, col = order.cell
            mission.report(robot, cell=order.cell, stopped=luck.hits(robot, mission.step, row * width + col))
            mission.save(file)
        mission.advance()
    mission.save(file)


def main(file: str, seed: str, *waits: str) -> int:
    """Drive it in a child, which is killed -9 after each of these milliseconds; returns the kills before its end."""
    small_case(int(seed))  # what is compiled is loaded once, before processes are forked
    for kills, wait in enumerate([*waits, "inf"]):
        child = os.fork()
        if child == 0:
            drive_by_luck(Path(file), int(seed))
            os._exit(0)
        ends = time.monotonic() + float(wait) / 1000
        while os.waitpid(child, os.WNOHANG)[0] == 0:
            if time.monotonic() > ends:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                break
            time.sleep(0.0005)
        else:
            return kills
    raise AssertionError("it did not end")


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
