"""A mission among hazards that it learns of, or threats that change, goes on as a simulated team does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from planner.errors import InputError
from planner.failure_model import exposure_of
from planner.mission.mission import Mission
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.rollout_sampling import Luck
from planner.settings import Settings
from planner.tally import Doing, EventKind, Outcome
from planner.world.changing_maps import with_hazard, with_phases
from planner.world.features import with_sense
from planner.world.world import World

P = 0.3
HOMES: list[dict[str, Any]] = [
    {}, {"return_to": "home"}, {"return_to": "nearest", "range": 12}, {"return_to": "home", "deadline": 18},
]  # fmt: skip


def drawn(number: int, kind: str) -> tuple[World, list[list[int]]]:
    """A world with one dangerous level at any time, so that costs are on one scale whatever is known."""
    luck = np.random.default_rng(number)
    shape = (int(luck.integers(3, 7)), int(luck.integers(3, 7)))
    walls = np.where(luck.random(shape) < 0.15, np.nan, 0.0)
    walls[0, 0] = 0.0
    maps = [np.where(np.isnan(walls), np.nan, np.where(luck.random(shape) < 0.4, P, 0.0)) for _ in range(3)]
    for one in maps:
        one[0, 0] = P
    starts = [[0, 0]] * int(luck.integers(1, 4))
    if kind == "phases":
        begins = np.sort(luck.choice(np.arange(1, 20), 2, replace=False)).tolist()
        return with_phases(World.create(maps[0]), list(zip(begins, maps[1:], strict=True))), starts
    return with_hazard(World.create(walls), kind, np.nan_to_num(maps[0]), 1.0, learn=True), starts


def drive(world: World, starts: list[list[int]], settings: Settings, seed: int, file: Path | None) -> tuple[Any, Any]:
    """Where robots are at the end of each step, driven, luck answering; and simulated."""
    plan, luck, width, places = make_plan(world, starts, settings), Luck(world, seed, 0), world.shape[1], []
    trace, mission = ReferenceLoop(plan, world).trace(seed, 0), Mission(world, plan, patience=None)
    for step in range(min(60, trace.time + 1)):
        # a cell that nobody can visit is none that is left: by then all is done, and who is to come home has turned
        short = mission.accessible < world.accessible(starts).sum()
        if mission.outcome is not None or (short and mission._fleet.over is not None):
            break
        for robot in sorted({*range(mission.robots)} - {*mission.lost}):
            row, col = mission.orders()[robot].cell
            moved = step == 0 or mission.state.robots[robot].cell != row * width + col
            stopped = moved and luck.hits(robot, step, row * width + col)
            mission.report(robot, (row, col), stopped=stopped)
        if file is not None and step % 3 == 1:
            mission.save(file, force=True)
            mission = Mission.resume(file, world, plan, patience=None)
        mission.advance()
        places.append([robot.cell for robot in mission._fleet.robots])
    return np.array(places), trace


@pytest.mark.parametrize("kind", ["phases", "persistent", "consumed"])
@pytest.mark.parametrize("worlds", [20, pytest.param(400, marks=pytest.mark.slow)])
def test_it_drives_as_the_simulator_does(worlds: int, kind: str, tmp_path: Path) -> None:
    surprised = 0
    for number in range(worlds):
        world, starts = drawn(number, kind)
        file = tmp_path / "m.json" if number % 3 == 0 else None
        settings = Settings(policy=("mrac", "per_cell")[number % 2], **HOMES[number // 2 % len(HOMES)])
        places, trace = drive(world, starts, settings, number, file)
        alive = trace.doing[: len(places)] != Doing.DEAD
        assert (np.where(alive, places, 0) == np.where(alive, trace.cells[: len(places)], 0)).all(), number
        surprised += int((trace.events[:, 2] == EventKind.SURPRISED).sum())
    assert surprised > 10


@pytest.mark.parametrize("more", [{}, {"return_to": "home"}])
def test_a_mission_waits_for_a_phase_that_is_announced(more: dict[str, Any], tmp_path: Path) -> None:
    """`0 .5 0 0`, one robot that is worth 4 cells: it goes once all is safe, from step f on, and covers all."""
    home = 3 if more else 0
    for f in (1, 3, 4, 9):
        world = with_phases(World.create([[0, 0.5, 0, 0]]), [(f, np.zeros((1, 4)))])
        settings = Settings(policy="per_cell", worth=4.0, **more)
        places, trace = drive(world, [[0, 0]], settings, f, tmp_path / "m.json" if f > 3 else None)
        assert (trace.outcome, trace.time) == (Outcome.COMPLETE, f + 3 + home)
        assert places.ravel().tolist() == [0] * (f + 1) + [1, 2, 3] + [2, 1, 0] * bool(home)
        assert places.tolist() == trace.cells.tolist()


def test_what_a_visit_and_a_stop_say_is_bayes_rule(tmp_path: Path) -> None:
    """q 0.4, h 0.5, a row of cells: survived twice in [0, 1], stopped in [0, 2]; kept in a file."""
    q, h = 0.4, 0.5
    world = with_hazard(World.create(np.zeros((1, 4))), "persistent", [[0, q, q, q]], h, learn=True)
    mission = Mission(world, make_plan(world, [[0, 0], [0, 0]]))
    for place, other in (([0, 0], [0, 0]), ([0, 1], [0, 1]), ([0, 2], [0, 1])):
        mission.report(0, place, stopped=place == [0, 2])
        mission.report(1, other)
        mission.save(tmp_path / "m.json")
        mission = Mission.resume(tmp_path / "m.json", world, make_plan(world, [[0, 0], [0, 0]]))
        mission.advance()
    for _ in range(2):
        q = q * (1 - h) / (1 - q * h)
    assert mission.world.threat.tolist() == [[0, pytest.approx(q * h), 0.5, pytest.approx(0.2)]]
    mission.save(tmp_path / "m.json")
    odds = dict(json.loads((tmp_path / "m.json").read_text())["odds"])
    assert odds == {1: pytest.approx(np.log(q / (1 - q)) * 2**20, abs=2), 2: 2**62}


def test_what_is_borne_is_of_the_phase() -> None:
    world = with_phases(World.create([[0.0, 0.1, 0.1]]), [(2, [[0.0, 0.2, 0.3]])], "first")
    mission = Mission(world, make_plan(world, [[0, 0]], Settings(wear=2.0)))
    for place in ([0, 0], [0, 1], [0, 2]):
        mission.report(0, place)
        mission.advance()
    assert mission.world.threat[0, 2] == np.float32(0.1)
    (robot,) = mission.state.robots
    assert robot.exposure == int(exposure_of(np.float32(0.1))) + int(exposure_of(np.float32(0.3)))


def test_what_it_cannot_act_on_is_said() -> None:
    mined = with_hazard(World.create(np.zeros((2, 3))), "persistent", 0.2, learn=True)
    swept = with_sense(mined, {"range": 1, "detect": 0.9, "false_alarm": 0.1})
    with pytest.raises(InputError, match=r"reads no detector.*say by `seen` what one tells"):
        Mission(swept, make_plan(swept, [[0, 0]]))
