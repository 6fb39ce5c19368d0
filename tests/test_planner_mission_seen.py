"""A mission whose robots say what they see goes on as a simulated team that learns the map."""

import json

import numpy as np
import pytest
from test_planner_unknown import drawn

from planner.errors import StateError
from planner.mission.mission import Mission
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.rollout_sampling import Luck
from planner.settings import Settings
from planner.tally import Doing
from planner.world.features import as_planned, with_truth
from planner.world.generate import Stream
from planner.world.world import World


def of_one_level(number):
    """A drawn world with one dangerous level, so that costs are the same whatever is known of the map."""
    stream = Stream(number, 1518)
    believed, truth, starts, sense = drawn(number, stream)
    believed, truth = (np.where(one > 0, 0.3, one) for one in (believed, truth))
    for one in (believed, truth):  # some cell is dangerous on either map
        if not (one > 0).any():
            one[np.isnan(one) | (one == 0)] = np.where(np.isnan(one[np.isnan(one) | (one == 0)]), np.nan, 0.3)
    return with_truth(World.create(believed), truth, sense), starts


def drive(world, starts, settings, seed, steps, file=None):
    """Where robots are at the end of each step: driven, luck and their sensors answering; and simulated."""
    known, plan = as_planned(world, starts), make_plan(world, starts, settings)
    mission = Mission(known, make_plan(known, starts, settings), patience=None)
    luck, told, height_width = Luck(world, seed, 0), world.met.ravel(), world.shape
    trace = ReferenceLoop(plan, world).trace(seed, 0)
    cells, places = np.arange(told.size), []
    begin, view = world.knowledge.sense.views(world.knowledge.free, cells)
    for step in range(min(steps, trace.time + 1)):
        if mission.outcome is not None:
            break
        lost, alive, at = set(mission.lost), [], {}
        orders = mission.orders()
        for robot in range(mission.robots):
            if robot in lost:
                continue
            orders = mission.orders()
            before = None if step == 0 else mission.state.robots[robot].cell
            cell = orders[robot].cell[0] * height_width[1] + orders[robot].cell[1]
            stopped = (step == 0 or cell != before) and luck.hits(robot, step, cell)
            mission.report(robot, divmod(cell, height_width[1]), stopped=stopped)
            at[robot] = cell
            if not stopped:
                alive.append(robot)
        for robot in alive:
            seen = view[begin[at[robot]] : begin[at[robot] + 1]]
            said = [[*divmod(int(c), height_width[1]), None if np.isnan(told[c]) else float(told[c])] for c in seen]
            mission.report(robot, divmod(at[robot], height_width[1]), seen=json.loads(json.dumps(said)))
        if file is not None and step % 3 == 1:
            mission.save(file, force=True)
            mission = Mission.resume(file, known, make_plan(known, starts, settings), patience=None)
        mission.advance()
        places.append([robot.cell for robot in mission._fleet.robots])
    return np.array(places), trace


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_it_drives_as_the_simulator_does(policy, tmp_path):
    compared = surprised = 0
    for number in range(60):
        world, starts = of_one_level(number)
        file = tmp_path / "m.json" if number % 3 == 0 else None
        places, trace = drive(world, starts, Settings(policy=policy), number, 60, file)
        alive = trace.doing[: len(places)] != Doing.DEAD
        assert (np.where(alive, places, 0) == np.where(alive, trace.cells[: len(places)], 0)).all(), number
        compared += len(places)
        surprised += (trace.events[:, 2] == 8).sum()
    assert compared > 300 and surprised > 100


def test_what_cannot_be_seen_is_said_and_nothing_happens():
    world = World.create(np.zeros((3, 3)))
    mission = Mission(world, make_plan(world, [[0, 0]]))
    for wrong, message in (
        ([[0, 3, None]], "no cell of the map"),
        ([[0, 1]], r"expected \[\[row, col, p\]"),
        ([[0, 1, 1.0]], "p of"),
        ([[0, 0, None]], "a robot is there"),
        ("all", "seen is"),
    ):
        with pytest.raises(StateError, match=message):
            mission.report(0, [0, 0], seen=wrong)
    mission.advance()
    mission.report(0, mission.orders()[0].cell, seen=[[2, 2, None], [2, 1, 0.2]])
    assert mission.world.free.all()
    mission.advance()
    assert not mission.world.free[2, 2] and mission.world.threat[2, 1] == np.float32(0.2)
    assert mission.accessible == 8 and mission.outcome is None
