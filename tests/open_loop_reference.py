"""The open loop told plainly: robots walk their paths step by step. Shares no code with the engines; slow."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from planner.failure_model import key_of
from planner.plan.plan import Plan, RobotPlan
from planner.simulator.codes import Outcome
from planner.simulator.thresholds import threefry2x32
from planner.tally import Tally
from planner.world.world import World, load_world_file

FIXTURES = Path(__file__).parent / "fixtures"
Stop = Callable[[int, int, int, int], bool]
"""(rollout, robot, step, cell) -> is the robot stopped as it enters the cell?"""


def fixture(name: str, robots: int) -> tuple[Plan, World, dict]:
    """A fixture's nominal paths as a plan, its world, and its numbers."""
    numbers = json.loads((FIXTURES / f"{name}-k{robots}.json").read_text())
    world = load_world_file(FIXTURES / f"{name}.npz")
    return plan_of(world, numbers["nominal"]["paths"]), world, numbers


def plan_of(world: World, paths: list[list[int]]) -> Plan:
    """A plan of bare paths."""
    robots = tuple(RobotPlan(np.array(path, dtype=np.int64)) for path in paths)
    return Plan(world.shape, world.sha256, None, robots)


def tolerance_stops(plan: Plan, world: World, seed: int) -> Stop:
    """Stopped by the entry at which the sum of -ln(1 - p) over the robot's entries reaches -ln of its word / 2**32."""
    threat = world.threat.reshape(-1).astype(np.float64)
    key = tuple(int(word) for word in threefry2x32(key_of(seed), 0x48415A44, 2))
    borne: list[dict[int, float]] = []
    for robot in plan.robots:
        total, after = 0.0, {}
        for step, cell in enumerate(robot.path.tolist()):
            if step == 0 or cell != robot.path[step - 1]:
                total -= np.log1p(-threat[cell])
                after[step] = total
        borne.append(after)

    @cache
    def tolerance(rollout: int, robot: int) -> float:
        return float(-np.log((int(threefry2x32((key[0], key[1]), rollout, robot)[0]) + 0.5) / 2**32))

    return lambda rollout, robot, step, cell: borne[robot][step] >= tolerance(rollout, robot)


def walk(plan: Plan, world: World, ids: range, stops: Stop, key: str) -> Tally:
    """The tally of these rollouts, entry by entry."""
    accessible = int(world.accessible(plan.starts).sum())
    tally = Tally.empty(key, world.shape, len(plan.robots), accessible, plan.makespan)
    for rollout in ids:
        _walk_one(plan, rollout, stops, tally)
    return Tally(key, world.shape, ((ids.start, ids.stop),), **tally.counts())


def _walk_one(plan: Plan, rollout: int, stops: Stop, tally: Tally) -> None:
    visited: set[int] = set()
    survived: set[int] = set()
    alive = set(range(len(plan.robots)))
    time = 0
    for step in range(max(len(robot.path) for robot in plan.robots)):
        new_visited, new_survived = set(), set()
        for robot in sorted(alive):
            path = plan.robots[robot].path
            if step >= len(path) or (step > 0 and path[step] == path[step - 1]):
                continue
            cell, time = int(path[step]), step
            tally.visits[cell] += 1
            new_visited.add(cell)
            if stops(rollout, robot, step, cell):
                tally.stops[cell] += 1
                alive.discard(robot)
            else:
                new_survived.add(cell)
        if step < len(tally.new_visited):
            tally.new_visited[step] += len(new_visited - visited)
            tally.new_survived[step] += len(new_survived - survived)
        visited |= new_visited
        survived |= new_survived
    tally.covered_visited[list(visited)] += 1
    tally.covered_survived[list(survived)] += 1
    tally.visited[len(visited)] += 1
    tally.survived[len(survived)] += 1
    tally.time[time] += 1
    tally.alive[len(alive)] += 1
    unfinished = Outcome.END_OF_PATHS if alive else Outcome.ALL_ROBOTS_LOST
    tally.outcomes[Outcome.COMPLETE if len(visited) == tally.accessible else unfinished] += 1
