"""Where there are no tables of distances: however they are found, rollouts are those that tables lead to."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from closed_loop_worlds import limited, survey_world

from planner.make_plan import allocated_plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.runners import KNOWN, Runner, singles_of
from planner.settings import Settings
from planner.simulator.state import Work
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

WAYS = {
    "near": (10**6, 1_000, 255),
    "far": (0, 1_000, 255),
    "far, past wide components": (0, 0, 255),
    "rows": (0, 1_000, 0),
    "rows of who asks again": (0, 1_000, 1),
}
"""`nearby`, `wide` and `patience` of `Tables`."""
SEED, ROLLOUTS = 3, 300
SURVEYED = ("contiguous-8", "combs-8", "crossings-0", "scattered-8", "many-levels-2", "disconnected-1")


def planned(policy: str, transit: Literal["grid", "area"] = "grid") -> list[tuple[World, ClosedLoop, ClosedLoop]]:
    """Worlds, with closed loops by tables and by searches."""
    made = [(one.world, one.starts, one.settings) for one in map(survey_world, SURVEYED)]
    for seed, (height, width, robots) in enumerate([(17, 19, 3), (9, 30, 6)]):
        pattern = ThreatPattern(("contiguous", "scattered")[seed], 5, seed=seed)
        world = random_world(height, width, pattern, obstacles=0.1)
        made.append((world, place_starts(world, robots)[0], Settings()))
    loops = []
    for world, starts, settings in made:
        plan = allocated_plan(world, starts, replace(settings, policy=policy, transit=transit))
        tabled, searched = (compile_closed_loop(plan, world, tabled=tabled) for tabled in (True, False))
        loops.append((world, tabled, searched))
    return loops


def worked(loop: ClosedLoop) -> Work:
    """The scratch of a thread that has run the rollouts."""
    runner = Runner(loop, SEED, ROLLOUTS)
    runner.run(0, ROLLOUTS, singles_of(loop, 0, 0))
    return runner.work


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_every_way_to_find_distances_leads_to_the_same_rollouts(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    loops = planned(policy)
    for room in (2**28, 0):
        monkeypatch.setattr("planner.simulator.state.ROWS_BYTES", room)
        for way, limits in WAYS.items():
            far = rows = paths = replaced = 0
            for world, tabled, searched in loops:
                loop = limited(searched, *limits)
                assert run_range(loop, SEED, 0, ROLLOUTS)[0] == run_range(tabled, SEED, 0, ROLLOUTS)[0], (way, world)
                work = worked(loop)
                far += int(work.touched.max())
                rows += int((work.source_of >= 0).sum())
                paths += int(work.remembered[0]) - 1
                replaced += len(work.rows) == 2 and bool((work.source_of >= 0).all())
            if policy == "mrac":
                assert (far > 0) == (way != "near") and paths > 20
                assert (rows > 100 if room else replaced == len(loops)) if way == "rows" else rows >= 0
            else:
                assert rows > 100 if room else replaced > 3


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_what_earlier_calls_found_out_of_a_map_changes_no_rollout(policy: str) -> None:
    calls = (SEED, 0), (SEED + 1, 100), (SEED, 0)
    for world, tabled, searched in planned(policy):
        expected = [run_range(tabled, seed, first, 100)[0] for seed, first in calls]
        found = [
            (run_range(searched, seed, first, 100, threads=1)[0], KNOWN[searched][0].rows) for seed, first in calls
        ]
        assert [tally for tally, _ in found] == expected, world
        # They went on with the same rows, and what is known of one map alone is kept.
        assert found[0][1] is found[1][1] is found[2][1] and tabled not in KNOWN


@pytest.mark.parametrize("words", [0, 64, 512])
def test_room_for_coverage_paths_changes_no_rollout(words: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("planner.simulator.state.REMEMBERED", words)
    for _, tabled, searched in planned("mrac"):
        assert run_range(searched, SEED, 0, ROLLOUTS)[0] == run_range(tabled, SEED, 0, ROLLOUTS)[0]


def test_legs_that_stay_in_their_area_are_not_remembered() -> None:
    for _, tabled, searched in planned("mrac", "area"):
        assert run_range(searched, SEED, 0, ROLLOUTS)[0] == run_range(tabled, SEED, 0, ROLLOUTS)[0]
        assert len(worked(searched).paths) == len(worked(tabled).paths) == 0


def test_a_path_of_more_moves_than_16_bits_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is found a leg at a time."""
    world = random_world(270, 270, ThreatPattern("scattered", seed=1), obstacles=0.11, threats=0.0)
    plan = allocated_plan(world, place_starts(world, 1)[0], Settings())
    loop = compile_closed_loop(plan, world)
    assert loop.first_state(8).home.dtype == np.uint16
    runner = Runner(loop, SEED, 1)
    tally = runner.run_one(0)
    assert runner.work.remembered[0] == 2
    monkeypatch.setattr("planner.simulator.state.REMEMBERED", 0)
    assert tally.tolist() == Runner(loop, SEED, 1).run_one(0).tolist()
    assert tally[2] > 2**16
