"""What the map is worth to robots that are not told it: told, learning and blind teams on the same luck."""

from __future__ import annotations

import json
from dataclasses import replace
from math import hypot, inf
from pathlib import Path

import numpy as np
import pytest
from page_reader import check_page_is_sound

import mrac_jax as mrac
from analysis.estimators.racing import MOST_MAPS
from analysis.evaluation.answer import Evaluation
from analysis.evaluation.layers import run_of, runs
from analysis.evaluation.outputs.information import Knowledge, parse_ranges
from analysis.recording.replay import replay
from analysis.sampling import RolloutChoices
from analysis.theory.verdicts import longest_run
from planner.errors import InputError
from planner.ids import NO_STEP
from planner.plan.plan import Plan
from planner.rollout_sampling import rows_met
from planner.rollouts.engine import Rolling, make_engine
from planner.tally import Doing
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

TOLD = random_world(10, 10, ThreatPattern(seed=3)).with_starts([[0, 0], [0, 1]])
DARK = mrac.with_prior(TOLD, 0.04, "known", sense=2)
COUNT, SENSED = 600, (0, 1, 3)


@pytest.fixture(scope="module")
def answer() -> Evaluation:
    return mrac.evaluate(DARK, sense=SENSED, rollouts=COUNT, exact="never", advice=False, band=False)


def visited(world: World, plan: Plan, count: int) -> np.ndarray:
    return make_engine(plan, world, Rolling("closed")).results(0, count).visited


def test_each_team_is_what_it_is_by_itself(answer: Evaluation) -> None:
    found = answer.outputs["knowledge"]
    assert isinstance(found, Knowledge) and [team.range for team in found.teams] == [0, 1, 2, 3, inf]
    cells, alone = answer.cells["accessible"], {}
    for team in found.teams:
        world = mrac.with_sense(DARK, team.range)
        alone[team.range] = visited(world, mrac.plan(world), COUNT) / cells
        assert team.coverage.mean == pytest.approx(alone[team.range].mean(), abs=1e-12)
    assert found.learning.coverage.mean == answer.visited.mean
    assert (alone[inf] == visited(TOLD, mrac.plan(TOLD), COUNT) / cells).all()
    price, apart = found.told.ahead(found.learning), alone[inf] - alone[2]
    assert price.mean == pytest.approx(apart.mean()) and price.se == pytest.approx(apart.std(ddof=1) / COUNT**0.5)
    data = json.loads(json.dumps(answer.to_json()))["knowledge"]
    assert data["price_of_not_knowing"]["mean"] == price.mean and data["curve"][-1]["range"] == "inf"
    assert data["worth_of_sensing"]["mean"] == pytest.approx((alone[2] - alone[0]).mean())
    assert [(step["from"], step["to"]) for step in data["steps"]] == [(1, 2), (2, 3)]
    assert [step["worth"]["mean"] for step in data["steps"]] == pytest.approx(
        [(alone[2] - alone[1]).mean(), (alone[3] - alone[2]).mean()]
    )
    assert data["rollouts"] == COUNT and data["curve"][-1]["behind"]["mean"] == 0


def test_one_robot_that_learns_may_take_longer_than_its_plan() -> None:
    world = mrac.with_prior(TOLD.with_starts([[0, 0]]), 0.04, sense=1)
    plan = mrac.plan(world)
    longest = make_engine(plan, world, Rolling("closed")).results(0, COUNT).time.max()
    assert plan.time < longest <= longest_run(world, plan, "closed")


def test_what_one_robot_that_learns_covers_is_not_its_plan_s() -> None:
    world = mrac.with_prior(TOLD.with_starts([[0, 0]]), 0.04, sense=1)
    plan, blind = mrac.plan(world), mrac.with_sense(DARK.with_starts([[0, 0]]), 0)
    found = mrac.evaluate(world, plan, exact="never", rollouts=COUNT, advice=False, band=False)
    assert found.exact.visited is None and found.exact.time is None
    assert found.visited.mean * found.visited.covered.cells == pytest.approx(visited(world, plan, COUNT).mean())
    tree = mrac.evaluate(world, plan, rollouts=COUNT, advice=False, band=False).exact.visited
    by_plan = mrac.evaluate(blind, rollouts=COUNT, advice=False, band=False).exact.visited
    assert tree is not None and by_plan is not None and tree.mean > by_plan.mean + 0.03
    both = mrac.compare((world, plan), (blind, mrac.plan(blind)), rollouts=COUNT)
    assert both.a.exact is not None and both.b.exact is not None
    assert (both.a.exact[0], both.b.exact[0]) == pytest.approx((tree.cells, by_plan.cells))


def test_a_start_that_is_falsely_believed_an_obstacle(tmp_path: Path) -> None:
    world = mrac.with_truth(mrac.load(np.array([[np.nan, 0, 0], [0, 0.2, 0]])), np.array([[0, 0, 0], [0, 0.2, 0]]), 1)
    world = world.with_starts([[0, 0]])
    world.save(tmp_path / "a.npz")
    again = mrac.load(tmp_path / "a.npz")
    assert again.starts is not None and again.starts.tolist() == [[0, 0]]
    plan = mrac.plan(again)
    plan.save(tmp_path / "plan.json")
    answer = mrac.evaluate(again, tmp_path / "plan.json", advice=False)
    assert answer.visited.mean == 1 and "index.html" in {path.name for path in answer.save(tmp_path / "out")}
    mrac.record(again, plan, path=tmp_path / "a.mcap", ids=[0])
    assert replay(tmp_path / "a.mcap").identical


def test_small_teams_are_known_exactly() -> None:
    found = mrac.evaluate(DARK, rollouts=2000, advice=False, band=False).outputs["knowledge"]
    assert isinstance(found, Knowledge) and found.behind == "exact" and found.blind is not None
    worth, cells = found.learning.ahead(found.blind), found.told.found.largest("visited")
    blind = mrac.with_sense(DARK, 0)
    sampled = [visited(world, mrac.plan(world), 20_000) / cells for world in (DARK, blind)]
    assert worth.half_width == 0
    assert abs(worth.mean - (sampled[0] - sampled[1]).mean()) < 5 * (sampled[0] - sampled[1]).std() / 20_000**0.5


def test_where_the_map_is_drawn_who_is_told_plans_on_each() -> None:
    threat = np.nan_to_num(TOLD.threat)
    maps = [np.where(TOLD.free, np.clip(threat * scale, 0, 0.9), np.nan) for scale in (0.1, 3.0)]
    world = mrac.with_sense(mrac.with_maps(TOLD, maps), 1)
    found = mrac.evaluate(world, rollouts=COUNT, advice=False, band=False).outputs["knowledge"]
    assert isinstance(found, Knowledge)
    rows, by_map = rows_met(world.doubt, 0, np.arange(COUNT))[:, 0], []  # type: ignore[arg-type]
    for row in range(2):
        one = replace(TOLD, threat=world.doubt.threat_at(row))  # type: ignore[union-attr]
        by_map.append(visited(one, mrac.plan(one), COUNT))
    mine = np.where(rows == 0, *by_map)
    assert found.told.coverage.mean * found.told.found.largest("visited") == pytest.approx(mine.mean())


def test_who_sees_everything_of_a_drawn_map_is_not_who_is_told_it() -> None:
    """He plans before the first look: the figures of the team are those of the evaluation, not of another plan."""
    threat = np.nan_to_num(TOLD.threat)
    maps = [np.where(TOLD.free, one, np.nan) for one in (threat, threat[::-1])]
    answer = mrac.evaluate(mrac.with_sense(mrac.with_maps(TOLD, maps), inf), rollouts=COUNT, advice=False, band=False)
    found = answer.outputs["knowledge"]
    assert isinstance(found, Knowledge) and [team.range for team in found.teams] == [0, inf, inf]
    assert found.learning is not found.told
    assert found.learning.coverage.mean == pytest.approx(answer.figures.visited.mean.mean / answer.cells["accessible"])
    assert found.told.ahead(found.learning).mean != 0


def test_of_many_maps_the_first_ones_are_planned_on() -> None:
    threat = np.nan_to_num(TOLD.threat)
    maps = [np.where(TOLD.free, threat * (0.5 + number / 200), np.nan) for number in range(MOST_MAPS + 30)]
    world = mrac.with_sense(mrac.with_maps(TOLD, maps), 1)
    found = mrac.evaluate(world, rollouts=300, advice=False, band=False).outputs["knowledge"]
    assert isinstance(found, Knowledge)
    rows = rows_met(world.doubt, 0, np.arange(300))[:, 0]  # type: ignore[arg-type]
    first = list(dict.fromkeys(rows.tolist()))[:MOST_MAPS]
    kept = np.isin(rows, first)
    assert len(first) == MOST_MAPS and found.told.found.rollouts == int(kept.sum()) < 300
    mine = visited(world, mrac.plan(world), 300)[kept]
    assert found.learning.coverage.mean * found.told.found.largest("visited") == pytest.approx(mine.mean())


def test_fog_is_what_nobody_has_seen(answer: Evaluation) -> None:
    engine = make_engine(answer.plan, DARK, Rolling("closed"))
    for trace in engine.traces([0, 5, 11]):
        run = run_of("one", trace, DARK, RolloutChoices())
        expected = np.full(DARK.threat.size, NO_STEP)
        for step in range(len(trace.cells) - 1, -1, -1):
            for robot in np.flatnonzero(trace.doing[step] != Doing.DEAD):
                row, col = divmod(int(trace.cells[step, robot]), 10)
                for cell in range(100):
                    if hypot(cell // 10 - row, cell % 10 - col) <= 2:
                        expected[cell] = step
        assert run.seen is not None and (run.seen == expected).all()
    for world, loop in ((mrac.with_sense(DARK, 0), "closed"), (DARK, "open")):  # nobody looks, and nothing is dark
        choices = RolloutChoices(loop=loop, rollouts=20)
        found, note = runs(world, mrac.plan(world), choices, 20, False)
        assert [run.seen for run in found] == [None] * 4 and "Dark" not in note


def test_words_and_page(answer: Evaluation, tmp_path: Path) -> None:
    answer.save(tmp_path)
    page, text = (tmp_path / "index.html").read_text(), (tmp_path / "evaluation.txt").read_text()
    page = check_page_is_sound(page).text
    for words in (
        "not knowing it costs",
        "to see is worth",
        "told the map",
        "robots see 2 cells far",
        "A better sensor",
    ):
        assert words in text and words in page
    assert (tmp_path / "believed.png").exists() and (tmp_path / "sense.png").exists()
    assert "Theorem 3" not in text and "Paths: the plan" not in page


def test_no_range_is_no_list_of_ranges() -> None:
    assert parse_ranges(None) == () and parse_ranges("0,2,inf") == (0, 2, inf)
    with pytest.raises(InputError, match="ranges in cells"):
        parse_ranges("")


@pytest.mark.parametrize(
    ("world", "sense", "words"),
    [
        (TOLD, (1,), "robots are told the map"),
        (DARK, (0.5,), "0, or a number of cells from 1 on"),
        (mrac.with_prior(TOLD, 0.04, sense=2), (0,), "wrong about an obstacle"),
    ],
)
def test_what_cannot_be_sensed_is_said(world: World, sense: tuple[float, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        mrac.evaluate(world, sense=sense, rollouts=10)
