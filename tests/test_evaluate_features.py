"""`evaluate` with uncertain maps, unknown maps, hazards that are learned, moving threats, phases, ranges and states."""

import json
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import hypot, inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from drawn_worlds import expected, one_of, open_loop
from page_reader import Reader, check_page_is_sound
from test_page import unpacked_runs as unpacked
from test_record import decoded

import mrac_jax as mrac
from analysis.estimators.racing import MOST_MAPS, sample_with_known_hazards
from analysis.evaluation.evaluate import Evaluation
from analysis.evaluation.figures import BEFORE, BEYOND, TO_DO, Rest, rest_of
from analysis.evaluation.layers import run_of, runs
from analysis.evaluation.outputs.information import Knowledge, entropy_of
from analysis.evaluation.report import remainder_text, report
from analysis.evaluation.tables import threats
from analysis.inputs import Asked, load_task
from analysis.pictures import picture_style
from analysis.recording.pictures import RolloutPicture
from analysis.recording.replay import replay
from analysis.recording.viewers.topics import Stage
from analysis.report.rendering import figure_of, page_of
from analysis.report.result import print_report
from analysis.sampling import RolloutChoices
from analysis.theory.verdicts import longest_run
from analysis.utils.tables import as_text
from planner.errors import InputError, UsageError
from planner.formatting import percent
from planner.json_objects import as_json
from planner.plan.plan import Plan, is_certain
from planner.plan.state import MissionState
from planner.plan.state_file import load_state
from planner.rollout_sampling import hazards_met, rows_met, threat_paths
from planner.rollouts.closed_loop import compile_closed_loop, trace_rollouts
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.single_run import PythonLoop
from planner.settings import Choices
from planner.simulator.codes import NO_STEP, Doing
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

# `evaluate` where the map is in doubt: doubt about the map apart from luck, what is not known, what is refused.

BASE = World.create([[0.0, 0.2, 0.0], [0.0, np.nan, 0.1], [0.0, 0.0, 0.3]])
MAPS = [BASE.threat, 0 * BASE.threat, np.where(BASE.threat > 0.15, np.float32(0.7), BASE.threat)]
QUIET = {"advice": False, "band": False, "rollouts": 4096, "engine": "numba"}


def test_the_open_loop_is_exact_on_each_map() -> None:
    world = BASE.with_maps(MAPS)
    plan = mrac.plan(world, 2)
    answer = mrac.evaluate(world, plan, loop="open", **QUIET)
    said, play = json.loads(json.dumps(answer.to_json())), open_loop(plan, world)
    means = np.sort([expected(play, one_of([one.ravel()]))[0] / answer.tally.accessible for one in MAPS])
    doubt, cells, visited = said["map_variance"], np.arange(9) / 8, answer.tally.visited
    assert (doubt["maps"], doubt["rollouts"]) == (3, 0)
    told = [doubt["mean_of_means"], *doubt["quantiles"].values()]
    np.testing.assert_allclose(told, [means.mean(), *means], rtol=1e-9)
    mean = visited @ cells / 4096
    assert abs(mean - means.mean()) < 5 / np.sqrt(4096)
    assert said["bounds"]["ideal_team"] is said["bounds"]["theorem3"]["visited"]["travel_set"] is None
    total = doubt["sd"]["maps"] ** 2 + doubt["sd"]["random_numbers"] ** 2
    np.testing.assert_allclose(total, visited @ (cells - mean) ** 2 / 4096, rtol=1e-3)
    assert said["verdicts"] == {} and figure_of(report(answer), "map_variance.png").axes


ROW = World.create([[0.0, 0.1, 0.0, 0.3, 0.0, 0.0]])


def parts_of(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """(sd of the maps' means, sd of luck) of one robot on ROW, from the maps' p of its two dangers, `[M]` each.

    Two cells are visited for certain, two more if the first danger is passed, the last two if both are.
    """
    a, b = 1 - first.astype(float), 1 - second.astype(float)
    covered, chance = np.array([2.0, 4.0, 6.0]) / 6, np.array([1 - a, a * (1 - b), a * b])
    means = covered @ chance
    return float(means.std()), float(np.sqrt((covered**2 @ chance - means**2).mean()))


def doubtful(kind: str) -> tuple[World, tuple[float, float]]:
    """ROW in doubt, and its parts of variance, known without sampling."""
    if kind == "antithetic":  # every second map is without its first danger
        first = np.float32(0.9) * (np.arange(128) % 2)
        return ROW.with_maps([[[0, p, 0, 0.3, 0, 0]] for p in first]), parts_of(first, np.full(128, 0.3))
    if kind == "alike":
        return ROW.with_maps([ROW.threat] * 100), parts_of(*np.array([[0.1], [0.3]]))
    world = ROW.with_spread("lognormal", 0.8, kind)
    first, second = (world.uncertainty.chances[:, world.uncertainty.column[0, cell]] for cell in (1, 3))
    pairs = (first, second) if kind == "common" else (np.repeat(first, 256), np.tile(second, 256))
    return world, parts_of(*pairs)


KINDS = {"antithetic": (128, 128), "alike": (100, 100), "common": (256, 256), "level": (256, 65536)}
"""Maps behind the answer, at most, and in all."""


@pytest.mark.parametrize("seeds", [4, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_doubt_and_luck_are_told_apart(kind: str, seeds: int) -> None:
    """Both parts from 4,096 rollouts: variances right on average, intervals hold in 94 % within 2 standard errors."""
    world, truth = doubtful(kind)
    held, variances = np.zeros(2), []
    for seed in range(seeds):
        said = mrac.evaluate(world, 1, seed=seed, **(QUIET | {"rollouts": 4096})).to_json()["map_variance"]
        assert 0.98 * KINDS[kind][0] <= said["maps"] <= KINDS[kind][0] and said["of"] == KINDS[kind][1]
        for at, name in enumerate(("maps", "random_numbers")):
            low, high = said["sd_ci95"][name]
            held[at] += low <= truth[at] + 1e-9 and truth[at] - 1e-9 <= high
        variances.append([value**2 for value in said["sd"].values()])
    assert (held / seeds >= 0.94 - 2 * np.sqrt(0.94 * 0.06 / seeds)).all(), held / seeds
    found, se = np.mean(variances, axis=0), np.std(variances, axis=0, ddof=1) / np.sqrt(seeds)
    assert abs(found[1] - truth[1] ** 2) <= 5 * se[1]
    if kind == "alike":  # clipped at 0, and far below the scatter of the means of some 40 rollouts each
        assert 0 <= found[0] < 0.3 * truth[1] ** 2 * 100 / 4096
    else:
        assert abs(found[0] - truth[0] ** 2) <= 5 * se[0]


def test_the_maps_means_scatter_as_the_maps_do() -> None:
    """Not by the noise of their rollouts too; and they say of how many maps they are, on paper and in the picture."""
    world, truth = doubtful("common")
    answer = mrac.evaluate(world, 1, **(QUIET | {"rollouts": 20_000}))
    doubt = answer.outputs["map_variance"]
    assert doubt.means.std() == pytest.approx(doubt.parts.between.mean) == pytest.approx(truth[0], rel=0.05)
    assert abs(doubt.means.mean() - answer.tally.visited @ np.arange(7) / 6 / 20_000) < 0.005
    assert "256 maps, 20,000 rollouts" in doubt.chart().title + doubt.elements().notes[0]
    few = mrac.evaluate(world, 1, **(QUIET | {"rollouts": 100})).outputs["map_variance"]
    assert few.behind == "64 maps drawn of 256, 1,024 rollouts"
    drawn = mrac.evaluate(doubtful("level")[0], 1, loop="open", **QUIET).outputs["map_variance"]
    assert drawn.behind == "1,024 maps drawn of 65,536, exact on each"
    assert drawn.parts.between.ci95[0] < doubtful("level")[1][0] < drawn.parts.between.ci95[1]


def test_what_is_not_known_is_null_and_said() -> None:
    mines = BASE.with_latent_hazard("consumed", np.nan_to_num(BASE.threat), 0.9)
    answer = mrac.evaluate(mines, 2, loop="open", **QUIET)
    said = answer.to_json()
    assert set(said["exact"]["open_loop"].values()) == {None} and "map_variance" not in said
    assert answer.losses.ci95[0] < answer.losses.ci95[1]
    printed = as_text(lambda console: print_report(report(answer, theory=True), console), 120)
    assert "nan" not in printed and "assume one known map" in printed


MOVERS: list[dict[str, Any]] = [
    {"walk": 0.5, "h": 0.1, "count": 2},
    {"patrol": [[0, 0], [0, 1], [1, 1], [1, 0]], "h": 0.3, "start": [1, 1]},
]
GROUND = World.create([[0, 0, 0, 0.1, 0], [0, 0, np.nan, 0, 0], [0, 0.1, 0, 0, 0]])
MOVING = GROUND.with_moving_threats(MOVERS)
DAY = np.array([[0, 0, 0.2, 0, 0], [0, 0, np.nan, 0, 0], [0, 0.2, 0, 0, 0]])
NIGHT = np.array([[0, 0.3, 0, 0, 0], [0, 0, np.nan, 0.3, 0], [0, 0, 0, 0.3, 0]])
PHASES = World.create(DAY).with_phases([(3, NIGHT), (6, DAY)])
PRESUMING: dict[str, Callable[[World], Any]] = {
    "check": lambda world: mrac.check(world, 2),
    "size": lambda world: mrac.size(world, target=0.9),
    "starts": lambda world: mrac.starts(world, robots=2),
    "clear": lambda world: mrac.threats(world, remove=1, robots=2),
    "threat_scale": lambda world: mrac.evaluate(world, 2, threat_scale=(0.5,)),
    "marginal_risk": lambda world: mrac.evaluate(world, 2, marginal_risk=True),
    "drive": lambda world: mrac.drive(world, 2).outlook(),
}
UNKNOWN = {
    "one known map": BASE.with_spread("lognormal", 0.3),
    r"here: moving threats: .*; leave `moving_threats` out": MOVING,
    r"here: threats that change at step 3, 6; .*; leave `phases` out": PHASES,
}


@pytest.mark.parametrize("ask", PRESUMING)
@pytest.mark.parametrize("said", UNKNOWN)
def test_what_presumes_one_known_map_of_threats_that_stay_is_refused(ask: str, said: str) -> None:
    if (ask, said) != ("drive", "one known map"):
        with pytest.raises(InputError, match=said):
            PRESUMING[ask](UNKNOWN[said])


@pytest.mark.parametrize("asked", [{"value": True}, {"threat_scale": [2.0]}, {}])
def test_what_is_refused_is_refused_before_anything_is_planned(asked: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    def plan(*given: object, **more: object) -> None:
        raise AssertionError("planned")

    monkeypatch.setattr("planner.open_loop.plan_team", plan)
    world = BASE.with_spread("lognormal", 0.3)
    world = world if asked else world.with_values(2.0)
    with pytest.raises(InputError, match="one known map"):
        mrac.evaluate(world, 1, **asked, **QUIET)


# What the map is worth to robots that are not told it: told, learning and blind teams on the same luck.

TOLD = random_world(10, 10, ThreatPattern(seed=3)).with_starts([[0, 0], [0, 1]])
DARK = TOLD.with_prior_map(0.04, "known", sensor_range=2)
COUNT, SENSED = 600, (0, 1, 3)


@pytest.fixture(scope="module")
def answer() -> Evaluation:
    return mrac.evaluate(DARK, sensor_range=SENSED, rollouts=COUNT, exact="never", advice=False, band=False)


def visited(world: World, plan: Plan, count: int) -> np.ndarray:
    return make_engine(plan, world, Rolling("closed")).results(0, count).visited


def test_each_team_is_what_it_is_by_itself(answer: Evaluation) -> None:
    found = answer.outputs["knowledge"]
    assert isinstance(found, Knowledge) and [team.range for team in found.teams] == [0, 1, 2, 3, inf]
    cells, alone = answer.cells["accessible"], {}
    for team in found.teams:
        world = DARK.with_sensor_range(team.range)
        alone[team.range] = visited(world, mrac.plan(world), COUNT) / cells
        assert team.found.coverage.mean == pytest.approx(alone[team.range].mean(), abs=1e-12)
    assert found.learning.found.coverage.mean == answer.visited.mean
    assert (alone[inf] == visited(TOLD, mrac.plan(TOLD), COUNT) / cells).all()
    price, apart = found.known_map.ahead(found.learning), alone[inf] - alone[2]
    assert price.mean == pytest.approx(apart.mean()) and price.se == pytest.approx(apart.std(ddof=1) / COUNT**0.5)
    data = json.loads(json.dumps(answer.to_json()))["knowledge"]
    assert data["price_of_not_knowing"]["mean"] == price.mean and data["curve"][-1]["range"] == "inf"
    assert data["value_of_sensing"]["mean"] == pytest.approx((alone[2] - alone[0]).mean())
    assert [(step["from"], step["to"]) for step in data["steps"]] == [(1, 2), (2, 3)]
    gains = [(alone[far + 1] - alone[far]).mean() for far in (1, 2)]
    assert [step["gain"]["mean"] for step in data["steps"]] == pytest.approx(gains)
    assert data["rollouts"] == COUNT and data["curve"][-1]["behind"]["mean"] == 0


def test_what_one_robot_that_learns_covers_is_not_its_plan_s() -> None:
    """And it may take longer."""
    world = TOLD.with_starts([[0, 0]]).with_prior_map(0.04, sensor_range=1)
    plan, blind = mrac.plan(world), DARK.with_starts([[0, 0]]).with_sensor_range(0)
    results, quiet = make_engine(plan, world, Rolling("closed")).results(0, COUNT), {"advice": False, "band": False}
    assert plan.time < results.time.max() <= longest_run(world, plan, "closed")
    found = mrac.evaluate(world, plan, exact="never", rollouts=COUNT, **quiet)
    assert found.exact.visited is None and found.exact.time is None
    assert found.visited.mean * found.visited.covered.cells == pytest.approx(results.visited.mean())
    ways = ((world, plan), (blind, None))
    tree, by_plan = (mrac.evaluate(*way, rollouts=COUNT, **quiet).exact.visited for way in ways)
    assert tree.mean > by_plan.mean + 0.03
    both = mrac.compare((world, plan), (blind, mrac.plan(blind)), rollouts=COUNT)
    assert (both.a.exact[0], both.b.exact[0]) == pytest.approx((tree.cells, by_plan.cells))


@pytest.mark.usefixtures("one_picture")
def test_a_start_that_is_falsely_believed_an_obstacle(tmp_path: Path) -> None:
    world = mrac.load(np.array([[np.nan, 0, 0], [0, 0.2, 0]])).with_true_map(np.array([[0, 0, 0], [0, 0.2, 0]]), 1)
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
    gain, cells = found.learning.ahead(found.no_sensor), found.known_map.found.largest("visited")
    mine, blind = (visited(world, mrac.plan(world), 20_000) / cells for world in (DARK, DARK.with_sensor_range(0)))
    assert found.behind == "exact" and gain.half_width == 0
    assert abs(gain.mean - (mine - blind).mean()) < 5 * (mine - blind).std() / 20_000**0.5


def test_where_the_map_is_drawn_who_is_told_plans_on_each() -> None:
    threat = np.nan_to_num(TOLD.threat)
    maps = [np.where(TOLD.free, np.clip(threat * scale, 0, 0.9), np.nan) for scale in (0.1, 3.0)]
    world = TOLD.with_maps(maps).with_sensor_range(1)
    told = mrac.evaluate(world, rollouts=COUNT, advice=False, band=False).outputs["knowledge"].known_map
    each = [replace(TOLD, threat=world.uncertainty.threat_at(row)) for row in range(2)]
    rows = rows_met(world.uncertainty, 0, np.arange(COUNT))[:, 0]
    by_map = [visited(one, mrac.plan(one), COUNT) for one in each]
    assert told.found.mean("visited").mean == pytest.approx(np.where(rows == 0, *by_map).mean())


def test_who_sees_everything_of_a_drawn_map_is_not_who_is_told_it() -> None:
    """He plans before the first look: the figures of the team are those of the evaluation, not of another plan."""
    threat = np.nan_to_num(TOLD.threat)
    maps = [np.where(TOLD.free, one, np.nan) for one in (threat, threat[::-1])]
    answer = mrac.evaluate(TOLD.with_maps(maps).with_sensor_range(inf), rollouts=COUNT, advice=False, band=False)
    found = answer.outputs["knowledge"]
    assert [team.range for team in found.teams] == [0, inf, inf] and found.learning is not found.known_map
    assert found.learning.found.mean("visited").mean == pytest.approx(answer.figures.visited.mean.mean)
    assert found.known_map.ahead(found.learning).mean != 0


def test_of_many_maps_the_first_ones_are_planned_on() -> None:
    threat = np.nan_to_num(TOLD.threat)
    maps = [np.where(TOLD.free, threat * (0.5 + number / 200), np.nan) for number in range(MOST_MAPS + 30)]
    world = TOLD.with_maps(maps).with_sensor_range(1)
    found = mrac.evaluate(world, rollouts=300, advice=False, band=False).outputs["knowledge"]
    rows = rows_met(world.uncertainty, 0, np.arange(300))[:, 0]
    kept = np.isin(rows, first := list(dict.fromkeys(rows.tolist()))[:MOST_MAPS])
    assert len(first) == MOST_MAPS and found.known_map.found.rollouts == int(kept.sum()) < 300
    mine = visited(world, mrac.plan(world), 300)[kept].mean()
    assert found.learning.found.mean("visited").mean == pytest.approx(mine)


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
    for world, loop in ((DARK.with_sensor_range(0), "closed"), (DARK, "open")):  # nobody looks, and nothing is dark
        choices = RolloutChoices(loop=loop, rollouts=20)
        found, note = runs(world, mrac.plan(world), choices, 20, False)
        assert [run.seen for run in found] == [None] * 4 and "Dark" not in note


def test_words_and_page(answer: Evaluation, tmp_path: Path) -> None:
    answer.save(tmp_path)
    text = (tmp_path / "evaluation.txt").read_text()
    page = check_page_is_sound((tmp_path / "index.html").read_text()).text
    words = ("With a known map: ", "Without a sensor: ", "known map", "robots see 2 cells far", "Gain by sensor range")
    assert all(said in text and said in page for said in words)
    assert (tmp_path / "believed.png").exists() and (tmp_path / "sense.png").exists()
    assert "Theorem 3" not in text and "Paths: the plan" not in page


SENSELESS = [
    (TOLD, (1,), "the map is known"),
    (DARK, (0.5,), "0, or a number of cells from 1 on"),
    (TOLD.with_prior_map(0.04, sensor_range=2), (0,), "wrong about an obstacle"),
]


@pytest.mark.parametrize(("world", "sensor_range", "words"), SENSELESS)
def test_what_cannot_be_sensed_is_said(world: World, sensor_range: tuple[float, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        mrac.evaluate(world, sensor_range=sensor_range, rollouts=10)


# `evaluate` of robots that learn about hazards: beside told and blind ones on the same luck, and what they know.

SITE = random_world(7, 7, ThreatPattern("scattered", 3, (0.1, 0.3), 5), obstacles=0.1, threats=0.4)
Q = np.nan_to_num(np.array(SITE.threat)) * 2
QUIET_EXPERIENCE = {"advice": False, "band": False, "engine": "numba"}


def test_three_teams_on_the_same_luck_and_what_is_known_in_the_end(tmp_path):
    world = SITE.with_latent_hazard("persistent", Q, 0.5, learn=True)
    answer = mrac.evaluate(world, 2, rollouts=300, seed=4, **QUIET_EXPERIENCE)
    found = answer.outputs["experience"]
    said = json.loads(json.dumps(answer.to_json()))["experience"]
    blind = mrac.evaluate(SITE.with_latent_hazard("persistent", Q, 0.5), 2, rollouts=300, seed=4, **QUIET_EXPERIENCE)
    assert (found.no_learning.tally.visited == blind.tally.visited).all()
    assert (found.learning.tally.visited == answer.tally.visited).all()
    ahead = found.learning.column("visited") - found.no_learning.column("visited")
    np.testing.assert_allclose(said["value_of_learning"]["mean"], ahead.mean() / answer.tally.accessible)
    # a rollout of the told ones, by hand: its own map, planned for and rolled out
    there = hazards_met(world.uncertainty, 4, [7])[0].reshape(SITE.shape)
    told = SITE.with_latent_hazard("persistent", np.where(there, 1.0, 0.0), 0.5)
    run = PythonLoop(mrac.plan(told, starts=answer.plan.starts), told).run(4, 7)
    assert found.known_hazards.column("visited")[7] == run.visited.sum()
    assert (said["maps"], said["rollouts"], said["posterior"]["rollouts"]) == (128, 300, 256)
    bits = said["posterior"]["entropy"]
    np.testing.assert_allclose(bits["before"], entropy_of(Q)[found.reach].mean(), rtol=1e-6)
    assert 0 < bits["after"] < bits["before"]
    assert np.abs(found.posterior - found.prior)[found.reach].max() < 5 * 0.5 / np.sqrt(256)
    files = answer.save(tmp_path)
    assert {"posterior.png", "entropy.png"} <= {path.name for path in files}
    with rasterio.open(tmp_path / "posterior.tif") as data:
        assert data.descriptions == ("prior", "posterior", "entropy")
        np.testing.assert_allclose(data.read(2), np.where(SITE.free, found.posterior, np.nan), rtol=1e-6)


def test_sure_stops_are_told_too_and_consumed_ones_vanish():
    for kind in ("persistent", "consumed"):
        world = SITE.with_latent_hazard(kind, Q, 1.0, learn=True)
        answer = mrac.evaluate(world, 2, rollouts=50, **QUIET_EXPERIENCE)
        told = sample_with_known_hazards(world, answer.plan, answer.choices, 20)
        assert told.rollouts == 20 and told.column("visited").mean() > 10


def test_who_has_nothing_to_learn_is_told_and_blind_alike():
    world = SITE.with_latent_hazard("persistent", np.where(Q > 0.3, 1.0, 0.0), 0.4, learn=True)
    found = mrac.evaluate(world, 2, rollouts=64, **QUIET_EXPERIENCE).outputs["experience"]
    for other in (found.known_hazards, found.no_learning):
        assert (other.column("visited") == found.learning.column("visited")).all()
    assert found.bits.before == found.bits.after == 0.0


def test_who_hears_nothing_may_take_what_the_plan_left_out():
    q = np.array([[0, 0, 0], [0, 0, 0.5]])
    world = mrac.load(np.zeros((2, 3))).with_latent_hazard("persistent", q, 0.5, learn=True)
    world = world.with_sensor_range({"range": 2, "detect": 0.9, "false_alarm": 0.1})
    plan = mrac.plan(world, starts=[[0, 0]], policy="per_cell", robot_value=20)
    assert is_certain(world, plan, "open") and not is_certain(world, plan)
    answer = mrac.evaluate(world, plan, rollouts=300, **QUIET_EXPERIENCE)
    assert answer.tally.rollouts == 300 and 50 < answer.tally.visited[6] < 250
    assert answer.exact.visited is None and answer.visited.mean * 6 == 5 + answer.tally.visited[6] / 300


def test_others_have_no_such_figure():
    with pytest.raises(UsageError, match="learn about hazards"):
        mrac.evaluate(SITE, 2, rollouts=10, experience=True, **QUIET_EXPERIENCE)
    world = SITE.with_latent_hazard("persistent", Q, 0.5, learn=True)
    answer = mrac.evaluate(world, 2, rollouts=10, loop="open", **QUIET_EXPERIENCE)
    assert "experience" not in answer.outputs
    assert "learning" not in report(answer).summary


# What is answered where threats move: evaluate, its page and JSON, recordings, and what refuses in words.


def notes_of(answer: Any) -> list[str]:
    said = report(answer)
    return [*said.findings, *said.last, *(note for part in said.parts for note in part.notes)]


def test_one_robot_is_known_exactly_and_rollouts_agree() -> None:
    answer = mrac.evaluate(MOVING, 1, rollouts=20_000, seed=3)
    assert answer.is_exact
    sampled, exact = answer.figures.visited.mean, answer.closed_form
    assert abs(sampled.mean - exact.visited) < 5 * sampled.se
    told = answer.to_json()
    assert told["exact"]["closed_loop"]["how"] == "exact"
    assert told["bounds"]["any_strategy"] is None and told["bounds"]["eq1"] == [None]
    walker, _, patrol = told["moving_threats"]
    assert patrol == {**MOVERS[1]} and walker == {"walk": 0.5, "start": "anywhere", "h": 0.1}


def test_a_robot_that_waits_before_it_gives_up_is_still_met() -> None:
    """On three cells, by hand: at steps 0 to 3 a walker that meets it with chance 1/2 has taken .65625 of it."""
    world = mrac.load([[0, 0, 0]]).with_moving_threats([{"walk": 0.0, "h": 0.5, "start": "anywhere"}], plan_on="own")
    plan = mrac.plan(world, 1, starts=[[0, 0]], range=1)
    assert (plan.makespan, plan.time) == (1, 3)
    answer = mrac.evaluate(world, plan, rollouts=20_000, seed=1, advice=False)
    said, tally = answer.to_json(), answer.tally
    exact = said["exact"]
    found = said["losses"]["exact"], exact["alive"], exact["time"], exact["open_loop"]["visited"]
    assert found == pytest.approx((0.65625, 0.34375, 2, 1.875))
    assert abs(tally.alive[1] / 20_000 - 0.34375) < 5 * np.sqrt(0.34375 * 0.65625 / 20_000)
    assert abs(tally.time @ np.arange(len(tally.time)) / 20_000 - 2) < 5 * 1.03 / np.sqrt(20_000)


def test_what_is_known_of_one_robot_is_what_is_said() -> None:
    """Losses, chances and quantiles of a robot alone are the closed form's, in words, tables and JSON."""
    answer = mrac.evaluate(MOVING, 1, rollouts=500, seed=3, advice=False)
    exact, told, shown = answer.closed_form, answer.to_json(), answer.shown
    lost = exact.expected_losses
    assert (answer.losses.mean, answer.losses.half_width) == (pytest.approx(lost), 0)
    assert any(f"all in {100 * lost:.2f} % of runs" in note for note in notes_of(answer))
    assert told["best"]["losses"]["mean"] == pytest.approx(told["losses"]["exact"]) == pytest.approx(lost)
    assert told["some_left"]["ci95"] == [pytest.approx(1 - lost)] * 2
    assert shown.complete.mean == pytest.approx(exact.visited_by_cell[answer.accessible.ravel()].min())
    at_least = [shown.visited.chance(cells).mean for cells in range(1, shown.visited.cells + 1)]
    assert sum(at_least) == pytest.approx(exact.visited), "the mean is the sum of the chances to visit 1, 2, ... cells"
    sampled = answer.figures.visited
    assert all(abs(sampled.chance(n).mean - at_least[n - 1]) < 5 * np.sqrt(0.25 / 500) for n in (3, 6, 9, 12))


def test_what_is_known_by_a_step_is_what_is_said() -> None:
    answer = mrac.evaluate(MOVING, 1, rollouts=200, deadline=4, advice=False)
    found, exact = as_json(answer.outputs["deadline"]), answer.closed_form
    assert found["visited"]["mean"] * 14 == pytest.approx(exact.by_deadline(4)[0]) and found["visited"]["se"] == 0
    assert found["losses"]["mean"] == pytest.approx(exact.losses_by(4))
    by_step = f"By step 4: {percent(exact.by_deadline(4)[0] / 14, 2)} (exact) visited"
    assert any(note.startswith(by_step) for note in notes_of(answer))
    whole = mrac.evaluate(MOVING, 1, rollouts=200, deadline=10**4, advice=False)
    assert not any("By step" in note for note in notes_of(whole))


def test_one_robot_on_a_map_that_is_too_large_is_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.theory.exact.MOST_WORK", 20)
    answer = mrac.evaluate(MOVING, 1, rollouts=50)
    assert not answer.is_exact and answer.to_json()["exact"]["open_loop"]["visited"] is None


def test_a_team_is_sampled_and_said_to_be_among_movers() -> None:
    answer = mrac.evaluate(MOVING, 2, rollouts=400)
    met = "2 walk and 1 patrols, and destroy a robot that they meet with probability 0.1 to 0.3"
    assert not answer.is_exact and met in " ".join(report(answer).last)
    assert "moving_threats" not in mrac.evaluate(GROUND, 2, rollouts=50).to_json()


def test_a_page_plays_the_movers_of_its_runs() -> None:
    answer = mrac.evaluate(MOVING, 2, rollouts=60)
    page = check_page_is_sound(page_of(report(answer), "mrac-jax evaluate", {}, ()))
    plan, *rolled = next(found for found in page.data() if "runs" in found)["runs"]
    assert "threats" not in plan and len(rolled) == 3
    for run in rolled:
        moving = run["threats"] | {"time": run["time"]}
        ways = [threat_paths(MOVING, 0, one, run["time"] + 1) for one in range(60)]
        assert any(np.array_equal(unpacked(moving, 5), way) for way in ways)


def test_a_recording_shows_where_movers_are(tmp_path: Path) -> None:
    for name, ground in (("a.mcap", MOVING), ("b.mcap", GROUND)):
        mrac.record(ground, 2, tmp_path / name, ids=[4], seed=2)
    by_topic = decoded(tmp_path / "a.mcap")
    steps, scenes = len(by_topic["/rollout/step"]), [scene for _, scene in by_topic["/movers/markers"]]
    found = [[(p.x, p.y) for p in (e.cubes[0].pose.position for e in scene.entities)] for scene in scenes]
    np.testing.assert_allclose(found, MOVING.to_xy(threat_paths(MOVING, 2, 4, steps)))
    assert len(by_topic["/movers/points"]) == steps and "/movers/markers" not in decoded(tmp_path / "b.mcap")


def test_a_scenario_says_what_robots_plan_on_and_not_that_all_survive(tmp_path: Path) -> None:
    """Where nothing but walkers is dangerous; one line where `plan_on` is left out, none where it is given."""
    np.save(tmp_path / "m.npy", np.zeros((3, 3)))
    for more, notes in (("", 1), ("plan_on: patrols\n", 0), ("plan_on: joined\n", 0)):
        (tmp_path / "s.yaml").write_text(f"map: m.npy\nmoving_threats: [{{walk: 0.5, h: 0.2}}]\n{more}")
        task = load_task(Asked(str(tmp_path / "s.yaml"), Choices()))
        assert sum("`plan_on` is not given" in note for note in task.notes) == notes
        assert not any("every robot survives" in note for note in task.notes)


# What is said of threats that change with time (docs/spec.md, section 16): answers, pages, recordings, sweeps.


def test_teams_are_known_exactly_and_rollouts_agree() -> None:
    how = {"rollouts": 20_000, "seed": 3, "advice": False}
    for robots in (1, 2):
        answer = mrac.evaluate(PHASES, robots, **how)
        visited, told = mrac.evaluate(PHASES, robots, exact="never", **how).tally.visited, answer.to_json()
        exact = told["exact"]["closed_loop"]
        if robots == 1:  # whose closed loop is its nominal path, until it is stopped
            assert exact["visited"] == pytest.approx(answer.closed_form.visited, rel=1e-9)
        assert abs(visited @ np.arange(len(visited)) / 20_000 - exact["visited"]) < 5 * 3 / 20_000**0.5
        assert exact["how"] == "tree" and told["bounds"]["eq1"] == [None] * robots
        assert told["phases"] == {"from": [0, 3, 6], "plan_on": "now"}
        said = "threats that change at step 3, 6; all robots know of a change as it comes"
        assert said in " ".join(report(answer).last)
    shown = [(layer.name, layer.since) for layer in threats(answer)]
    assert shown == [("Threat", 0), ("Threat from step 3", 3), ("Threat from step 6", 6)]
    assert "phases" not in mrac.evaluate(World.create(DAY), 1, rollouts=10).to_json()


@pytest.mark.parametrize("loop", ["closed", "open"])
def test_a_recording_shows_the_threats_of_its_phase(tmp_path: Path, loop: Any) -> None:
    path = tmp_path / "a.mcap"
    mrac.record(PHASES, 2, path, ids=[4], seed=2, loop=loop)
    by_topic = decoded(path)
    shown = [np.frombuffer(grid.data, dtype="<f4").reshape(3, 5)[::-1] for _, grid in by_topic["/map/threat"]]
    begun = [begin for begin in (0, 3, 6) if begin < len(by_topic["/rollout/step"])]
    expected = [np.nan_to_num(NIGHT if begin == 3 else DAY) for begin in begun]
    np.testing.assert_allclose(shown, expected, rtol=1e-6)
    assert len(begun) > 1


def test_so_does_a_picture() -> None:
    plan = mrac.plan(PHASES, robots=2)
    (trace,) = trace_rollouts(compile_closed_loop(plan, PHASES), 0, [1])
    with picture_style():
        picture, shown = RolloutPicture(trace, Stage(PHASES, plan, "closed", 0), 60), []
        for step in (0, 2, 3):
            picture.show(step)
            shown.append(np.array(picture.figure.axes[0].images[0].get_array()))
    assert np.array_equal(shown[0], shown[1]) and not np.array_equal(shown[1], shown[2])


def test_a_sweep_crosses_what_robots_plan_on(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", DAY)
    np.save(tmp_path / "night.npy", np.nan_to_num(NIGHT))
    (tmp_path / "s.yaml").write_text("map: m.npy\nphases: [{from: 3, threats: [{raster: night.npy}]}]\n")
    (tmp_path / "sweep.yaml").write_text(
        "base: {input: s.yaml, robots: 2}\nsweep: {plan_on: [now, worst], 'phases[0].from': [2, 4]}\nrollouts: 200\n"
    )
    rows = mrac.sweep(tmp_path / "sweep.yaml", tmp_path / "s.db", processes=1).rows
    assert len(rows) == 4


def test_a_recording_shows_the_areas_of_robots_that_learn_about_hazards(tmp_path: Path) -> None:
    """They make areas that no event announces."""
    ground = random_world(8, 8, ThreatPattern("scattered", 4, (0.04, 0.12, 0.2), 1), obstacles=0.2, threats=0.4)
    q = np.where(np.nan_to_num(ground.threat) > 0, 0.3, 0.0)
    mrac.record(ground.with_latent_hazard("persistent", q, 0.5, learn=True), 3, tmp_path / "a.mcap", ids=[0, 1])
    assert len(decoded(tmp_path / "a.mcap")["/areas"]) > 2


# What a range cuts off and what a state leaves: on the page and in the picture, and nowhere else.

QUIET_REST = {"rollouts": 200, "bound": False, "advice": False, "engine": "numba"}
LAND = np.zeros((5, 9))
LAND[1:, 4], LAND[2, 7] = np.nan, 0.3
WORLD = World.create(LAND, [[4, 0], [0, 0]])


def moves_to(world: World, start: tuple[int, int]) -> np.ndarray:
    """Fewest moves from a cell, by breadth-first search; inf where there is no way."""
    away = np.full(world.shape, np.inf)
    away[start] = 0
    queue = deque([start])
    while queue:
        row, col = queue.popleft()
        for near in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
            if 0 <= near[0] < 5 and 0 <= near[1] < 9 and world.free[near] and np.isinf(away[near]):
                away[near] = away[row, col] + 1
                queue.append(near)
    return away


@pytest.mark.parametrize("moves", [(1, 1), (3, 6), (12, 2)])
def test_what_is_too_far_is_further_than_every_robot_has_moves_for(moves: tuple[int, int]) -> None:
    rest, beyond, said, _ = told_beyond(moves, None)
    assert rest.step is None and rest.title == "Cells within range"
    assert said[0].startswith(f"Too far for the moves of any robot: {beyond} accessible")
    assert f", {rest.ended} of 2 robots use up their range" in said[1]


def told_beyond(moves: tuple[int, int], to: str | tuple | None) -> tuple[Rest, int, list[str], Evaluation]:
    """What robots of this range leave, cells too far for both (as a breadth-first search finds too), the sentences and
    the evaluation. From such a cell the moves there and back are together too many for either robot.
    """
    starts, plan = ((4, 0), (0, 0)), mrac.plan(WORLD, range=moves, return_to=to)
    bases = {"home": [[start] for start in starts], "nearest": [starts] * 2}.get(str(to), [to] * 2)
    back = [np.min([moves_to(WORLD, base) for base in of], axis=0) if to else 0 for of in bases]
    near = [moves_to(WORLD, start) + home <= most for start, home, most in zip(starts, back, moves, strict=True)]
    rest, beyond = rest_of(WORLD, plan), WORLD.accessible(plan.starts) & ~near[0] & ~near[1]
    np.testing.assert_array_equal(rest.kinds == BEYOND, beyond)
    answer = mrac.evaluate(WORLD, plan, **QUIET_REST)
    assert not answer.expected.visited_by_cell[beyond.ravel()].any()
    return rest, int(beyond.sum()), list(remainder_text(answer, rest)), answer


@pytest.mark.parametrize("moves", [(6, 14), (12, 9)])
@pytest.mark.parametrize("to", ["home", "nearest", ((0, 2), (4, 8))])
def test_of_robots_that_come_home_the_way_home_counts(moves: tuple[int, int], to: str | tuple) -> None:
    """In the words and the layer too."""
    rest, beyond, (said,), answer = told_beyond(moves, to)
    assert rest.returns
    assert said.startswith(f"Too far for any robot to visit and return: {beyond} accessible cells (")
    assert answer.layers.to_do[0].about.endswith("violet: too far for any robot to visit and return.")


def state(folder: Path) -> MissionState:
    said = {"format": "mrac-state", "version": 1, "world": {"shape": [5, 9], "sha256": WORLD.sha256}, "step": 7}
    said |= {"visited": [[4, 0], [3, 0], [2, 0], [0, 0], [0, 1]]}
    said |= {"robots": [{"cell": [2, 0]}, {"cell": [0, 1], "status": "dead"}]}
    (folder / "now.json").write_text(json.dumps(said))
    return load_state(folder / "now.json", WORLD)


@pytest.mark.usefixtures("one_picture")
def test_a_state_is_told_and_drawn_and_whole_missions_are_as_they_were(tmp_path: Path) -> None:
    answer = mrac.evaluate(WORLD, state=state(tmp_path), **QUIET_REST)
    rest, cells = rest_of(answer.world, answer.plan), int(WORLD.accessible(WORLD.starts).sum())
    assert rest.title == "Resumed from step 7" and (rest.kinds != BEYOND).all()
    assert np.flatnonzero(rest.kinds == BEFORE).tolist() == [0, 1, 18, 27, 36]
    left = answer.expected.visited_by_cell[(rest.kinds == TO_DO).ravel()].sum()
    (said,) = remainder_text(answer, rest)
    assert said.startswith(f"Before step 7, where this plan resumes: 5 of {cells} accessible cells")
    assert "1 of 2 robots lost" in said and f"Of the {cells - 5} left {left:,.1f} are visited" in said
    answer.save(tmp_path / "out")
    page = Reader((tmp_path / "out" / "index.html").read_text()).text
    assert said in page and "rest.png" in page and (tmp_path / "out" / "rest.png").stat().st_size > 10_000
    whole = mrac.evaluate(WORLD, 2, **QUIET_REST)
    assert rest_of(WORLD, whole.plan) is None and "rest.png" not in report(whole).pictures


def test_a_robot_that_is_lost_reaches_nothing_and_moves_made_are_spent(tmp_path: Path) -> None:
    plan = mrac.plan(WORLD, state=state(tmp_path), range=4)
    rest = rest_of(WORLD, plan)
    assert rest is not None and rest.title == "Resumed from step 7, cells within range"
    near = moves_to(WORLD, (2, 0)) <= 4 - plan.state.robots[0].moves  # type: ignore[union-attr]
    beyond = WORLD.free & WORLD.accessible(plan.starts) & ~near
    beyond.reshape(-1)[[0, 1, 18, 27, 36]] = False
    np.testing.assert_array_equal(rest.kinds == BEYOND, beyond)
