"""What is said of threats that change with time (docs/spec.md, section 16): answers, pages, recordings, sweeps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from movers import PRESUME_THREATS_THAT_STAY
from test_recording_topics import decoded

import mrac_jax as mrac
from analysis.evaluation.charts import threats
from analysis.evaluation.report import report
from analysis.pictures.style import house_style
from analysis.recording.pictures import RolloutPicture
from analysis.recording.viewers.topics import Stage
from planner.errors import InputError
from planner.simulator.closed_loop import compile_closed_loop, trace_rollouts
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

DAY = np.array([[0, 0, 0.2, 0, 0], [0, 0, np.nan, 0, 0], [0, 0.2, 0, 0, 0]])
NIGHT = np.array([[0, 0.3, 0, 0, 0], [0, 0, np.nan, 0.3, 0], [0, 0, 0, 0.3, 0]])


@pytest.fixture(scope="module")
def world() -> World:
    return mrac.with_phases(World.create(DAY), [(3, NIGHT), (6, DAY)])


def test_teams_are_known_exactly_and_rollouts_agree(world: World) -> None:
    for robots in (1, 2):
        answer = mrac.evaluate(world, robots, rollouts=20_000, seed=3, advice=False)
        sampled = mrac.evaluate(world, robots, rollouts=20_000, seed=3, exact="never", advice=False)
        exact = answer.to_json()["exact"]["closed_loop"]
        assert exact["how"] == "tree"
        if robots == 1:  # whose closed loop is its nominal path, until it is stopped
            assert exact["visited"] == pytest.approx(answer.closed_form.visited, rel=1e-9)
        found = sampled.tally.visited @ np.arange(len(sampled.tally.visited)) / 20_000
        assert abs(found - exact["visited"]) < 5 * 3 / 20_000**0.5
        told = answer.to_json()
        assert told["phases"] == {"from": [0, 3, 6], "plan_on": "now"} and told["bounds"]["eq1"] == [None] * robots
        assert "threats that change at step 3, 6; all robots know of a change as it comes" in " ".join(
            report(answer).last
        )
    shown = [(layer.name, layer.since) for layer in threats(answer)]
    assert shown == [("Threat", 0), ("Threat from step 3", 3), ("Threat from step 6", 6)]
    assert "phases" not in mrac.evaluate(World.create(DAY), 1, rollouts=10).to_json()


@pytest.mark.parametrize("loop", ["closed", "open"])
def test_a_recording_shows_the_threats_of_its_phase(world: World, tmp_path: Path, loop: Any) -> None:
    path = tmp_path / "a.mcap"
    mrac.record(world, 2, path, ids=[4], seed=2, loop=loop)
    by_topic = decoded(path)
    shown = [np.frombuffer(grid.data, dtype="<f4").reshape(3, 5)[::-1] for _, grid in by_topic["/map/threat"]]
    begun = [begin for begin in (0, 3, 6) if begin < len(by_topic["/rollout/step"])]
    expected = [np.nan_to_num(NIGHT if begin == 3 else DAY) for begin in begun]
    np.testing.assert_allclose(shown, expected, rtol=1e-6)
    assert len(begun) > 1


def test_so_does_a_picture(world: World) -> None:
    plan = mrac.plan(world, robots=2)
    (trace,) = trace_rollouts(compile_closed_loop(plan, world), 0, [1])
    with house_style():
        picture, shown = RolloutPicture(trace, Stage(world, plan, "closed", 0), 60), []
        for step in (0, 2, 3):
            picture.show(step)
            shown.append(np.array(picture.figure.axes[0].images[0].get_array()))
    assert np.array_equal(shown[0], shown[1]) and not np.array_equal(shown[1], shown[2])


@pytest.mark.parametrize("ask", PRESUME_THREATS_THAT_STAY)
def test_what_presumes_threats_that_stay_says_so(ask: Callable[[World], Any], world: World) -> None:
    with pytest.raises(InputError, match=r"here: threats that change at step 3, 6; .*; leave `phases` out"):
        ask(world)


def test_a_sweep_crosses_what_robots_plan_on(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", DAY)
    np.save(tmp_path / "night.npy", np.nan_to_num(NIGHT))
    (tmp_path / "s.yaml").write_text("map: m.npy\nphases: [{from: 3, threats: [{raster: night.npy}]}]\n")
    (tmp_path / "sweep.yaml").write_text(
        "base: {input: s.yaml, robots: 2}\nsweep: {plan_on: [now, worst], 'phases[0].from': [2, 4]}\nrollouts: 200\n"
    )
    rows = mrac.sweep(tmp_path / "sweep.yaml", tmp_path / "s.db").rows
    assert len(rows) == 4


def test_a_recording_shows_the_areas_of_robots_that_learn_about_hazards(tmp_path: Path) -> None:
    """They make areas that no event announces."""
    ground = random_world(8, 8, ThreatPattern("scattered", 4, (0.04, 0.12, 0.2), 1), obstacles=0.2, threats=0.4)
    q = np.where(np.nan_to_num(ground.threat) > 0, 0.3, 0.0)
    mrac.record(mrac.with_hazard(ground, "persistent", q, 0.5, learn=True), 3, tmp_path / "a.mcap", ids=[0, 1])
    assert len(decoded(tmp_path / "a.mcap")["/areas"]) > 2
