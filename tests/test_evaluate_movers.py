"""What is answered where threats move: evaluate, its page and JSON, recordings, and what refuses in words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from movers import PRESUME_THREATS_THAT_STAY
from page_reader import check_page_is_sound
from test_page_runs import unpacked
from test_recording_topics import decoded

import mrac_jax as mrac
from analysis.evaluation.report import report
from analysis.inputs import Asked, load_task
from analysis.report.html import page_of
from planner.errors import InputError
from planner.formatting import percent
from planner.rollout_sampling import ways_of_movers
from planner.settings import Choices
from planner.world.world import World

MOVERS: list[dict[str, Any]] = [
    {"walk": 0.5, "h": 0.1, "count": 2},
    {"patrol": [[0, 0], [0, 1], [1, 1], [1, 0]], "h": 0.3, "start": [1, 1]},
]
GROUND = World.create([[0, 0, 0, 0.1, 0], [0, 0, np.nan, 0, 0], [0, 0.1, 0, 0, 0]])


def notes_of(answer: Any) -> list[str]:
    said = report(answer)
    return [*said.findings, *said.last, *(note for part in said.parts for note in part.notes)]


@pytest.fixture(scope="module")
def world() -> World:
    return mrac.with_movers(GROUND, MOVERS)


def test_one_robot_is_known_exactly_and_rollouts_agree(world: World) -> None:
    answer = mrac.evaluate(world, 1, rollouts=20_000, seed=3)
    assert answer.is_exact
    sampled, exact = answer.figures.visited.mean, answer.closed_form
    assert abs(sampled.mean - exact.visited) < 5 * sampled.se
    told = answer.to_json()
    assert told["exact"]["closed_loop"]["how"] == "exact"
    assert told["bounds"]["any_strategy"] is None and told["bounds"]["eq1"] == [None]
    assert told["movers"][2] == {**MOVERS[1]} and told["movers"][0] == {"walk": 0.5, "start": "anywhere", "h": 0.1}


def test_a_robot_that_waits_before_it_gives_up_is_still_met() -> None:
    """On three cells, by hand: at steps 0 to 3 a walker that meets it with chance 1/2 has taken .65625 of it."""
    world = mrac.with_movers(mrac.load([[0, 0, 0]]), [{"walk": 0.0, "h": 0.5, "start": "anywhere"}], plan_on="own")
    plan = mrac.plan(world, 1, starts=[[0, 0]], range=1)
    assert (plan.makespan, plan.time) == (1, 3)
    answer = mrac.evaluate(world, plan, rollouts=20_000, seed=1, advice=False)
    exact, tally = answer.to_json()["exact"], answer.tally
    assert answer.to_json()["losses"]["exact"] == pytest.approx(0.65625)
    assert exact["alive"] == pytest.approx(0.34375) and exact["time"] == pytest.approx(2)
    assert exact["open_loop"]["visited"] == pytest.approx(1.875)
    assert abs(tally.alive[1] / 20_000 - 0.34375) < 5 * np.sqrt(0.34375 * 0.65625 / 20_000)
    assert abs(tally.time @ np.arange(len(tally.time)) / 20_000 - 2) < 5 * 1.03 / np.sqrt(20_000)


def test_what_is_known_of_one_robot_is_what_is_said(world: World) -> None:
    """Losses, chances and quantiles of a robot alone are the closed form's, in words, tables and JSON."""
    answer = mrac.evaluate(world, 1, rollouts=500, seed=3, advice=False)
    exact, told, shown = answer.closed_form, answer.to_json(), answer.shown
    lost = exact.expected_losses
    assert (answer.losses.mean, answer.losses.half_width) == (pytest.approx(lost), 0)
    assert f"The robot is lost in {100 * lost:.2f} % of runs." in notes_of(answer)
    assert told["best"]["losses"]["mean"] == pytest.approx(told["losses"]["exact"]) == pytest.approx(lost)
    assert told["some_left"]["ci95"] == [pytest.approx(1 - lost)] * 2
    assert shown.complete.mean == pytest.approx(exact.visited_by_cell[answer.accessible.ravel()].min())
    at_least = [shown.visited.chance(cells).mean for cells in range(1, shown.visited.cells + 1)]
    assert sum(at_least) == pytest.approx(exact.visited), "the mean is the sum of the chances to visit 1, 2, ... cells"
    sampled = answer.figures.visited
    assert all(abs(sampled.chance(n).mean - at_least[n - 1]) < 5 * np.sqrt(0.25 / 500) for n in (3, 6, 9, 12))


def test_what_is_known_by_a_step_is_what_is_said(world: World) -> None:
    answer = mrac.evaluate(world, 1, rollouts=200, deadline=4, advice=False)
    found, exact = answer.outputs["deadline"].as_json(), answer.closed_form
    assert found["visited"]["mean"] * 14 == pytest.approx(exact.by_deadline(4)[0]) and found["visited"]["se"] == 0
    assert found["losses"]["mean"] == pytest.approx(exact.losses_by(4))
    by_step = f"By step 4: {percent(exact.by_deadline(4)[0] / 14, 2)} (exact) visited"
    assert any(note.startswith(by_step) for note in notes_of(answer))
    whole = mrac.evaluate(world, 1, rollouts=200, deadline=10**4, advice=False)
    assert not any("By step" in note for note in notes_of(whole))


def test_one_robot_on_a_map_that_is_too_large_is_sampled(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.theory.exact.MOST_WORK", 20)
    answer = mrac.evaluate(world, 1, rollouts=50)
    assert not answer.is_exact and answer.to_json()["exact"]["open_loop"]["visited"] is None


def test_a_team_is_sampled_and_said_to_be_among_movers(world: World) -> None:
    answer = mrac.evaluate(world, 2, rollouts=400)
    assert not answer.is_exact
    assert "2 walk and 1 patrols, and stop a robot that they meet with chance 0.1 to 0.3" in " ".join(
        report(answer).last
    )
    assert "movers" not in mrac.evaluate(GROUND, 2, rollouts=50).to_json()


def test_a_page_plays_the_movers_of_its_runs(world: World) -> None:
    answer = mrac.evaluate(world, 2, rollouts=60)
    page = check_page_is_sound(page_of(report(answer), "mrac-jax evaluate", {}, ()))
    plan, *rolled = next(found for found in page.data() if "runs" in found)["runs"]
    assert "movers" not in plan and len(rolled) == 3
    for run in rolled:
        moving = run["movers"] | {"time": run["time"]}
        ways = [ways_of_movers(world, 0, one, run["time"] + 1) for one in range(60)]
        assert any(np.array_equal(unpacked(moving, 5), way) for way in ways)


def test_a_recording_shows_where_movers_are(world: World, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    mrac.record(world, 2, path, ids=[4], seed=2)
    by_topic = decoded(path)
    steps = [step for _, step in by_topic["/rollout/step"]]
    expected = world.to_xy(ways_of_movers(world, 2, 4, len(steps)))
    scenes = [scene for _, scene in by_topic["/movers/markers"]]
    found = [[(p.x, p.y) for p in (e.cubes[0].pose.position for e in scene.entities)] for scene in scenes]
    np.testing.assert_allclose(found, expected)
    assert len(by_topic["/movers/points"]) == len(steps)
    assert "/movers/markers" not in decoded_topics(GROUND, tmp_path / "b.mcap")


def decoded_topics(world: World, path: Path) -> set[str]:
    mrac.record(world, 2, path, ids=[4], seed=2)
    return set(decoded(path))


@pytest.mark.parametrize("ask", PRESUME_THREATS_THAT_STAY)
def test_what_presumes_threats_that_stand_says_so(ask: Callable[[World], Any], world: World) -> None:
    with pytest.raises(InputError, match=r"here: threats that move: .*; leave `movers` out"):
        ask(world)


def test_a_scenario_says_what_robots_plan_on_and_not_that_all_survive(tmp_path: Path) -> None:
    """Where nothing but walkers is dangerous; one line where `plan_on` is left out, none where it is given."""
    np.save(tmp_path / "m.npy", np.zeros((3, 3)))
    for more, notes in (("", 1), ("plan_on: patrols\n", 0), ("plan_on: joined\n", 0)):
        (tmp_path / "s.yaml").write_text(f"map: m.npy\nmovers: [{{walk: 0.5, h: 0.2}}]\n{more}")
        task = load_task(Asked(str(tmp_path / "s.yaml"), Choices()))
        assert sum("`plan_on` is not given" in note for note in task.notes) == notes
        assert not any("every robot survives" in note for note in task.notes)
