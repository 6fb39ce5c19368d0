"""Policies of one's own: the suite and its standings, the judge, the study of policies."""

import csv
import hashlib
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import policies_study
import pytest
from helpers import error_of, mostly_east
from policies_study import (
    FRONT_TEAMS,
    KINDS,
    ON_LARGE,
    SMALL,
    TEAMS,
    Setting,
    Study,
    report,
    study_json,
    study_policies,
)
from policies_study import summary as study_headline

import mrac_jax as mrac
from analysis.policy_evaluation.leaderboard import RANDOM, Leaderboard, Rolled, WorldResults
from analysis.policy_evaluation.policy_evaluation import estimate_of, roll_policy, scores_of, summary
from analysis.report.result import print_report
from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.estimates import mean_estimate
from analysis.sweeps.engine import Finished
from analysis.sweeps.store import Store
from analysis.theory.upper_bound import any_strategy
from analysis.utils.tables import as_text
from mrac_jax.env.coverage_env import ACTIONS, CoverageEnv
from mrac_jax.env.suite import main as suite_main
from planner.errors import UsageError
from planner.make_plan import make_plan
from planner.policies.rules import Rule
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts

# The suite: worlds that never change, a table whose figures can be worked out by hand, errors that name the world.

TINY = "contiguous-10-05-k1,scattered-10-05-k2"
HASHES = dict(map(str.split, (Path(__file__).parent / "fixtures" / "suite-hashes.txt").read_text().splitlines()))


def test_worlds_are_stable_for_ever() -> None:
    """Of map, what is in doubt and starts. A new hash is a new benchmark: give the world a new name instead."""
    found = {}
    for name, world in mrac.suite().items():
        found[name] = hashlib.sha256(f"{world.randomness_sha256} {world.starts.tolist()}".encode()).hexdigest()[:16]
        assert len(world.starts) == int(name.rpartition("-k")[2]) and world.accessible(world.starts).mean() > 0.6
    assert found == HASHES and len(found) == 30


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Leaderboard:
    """Two tiny worlds, with a policy that goes east, and MRAC's paths as another planner's on one of them."""
    folder, suite = tmp_path_factory.mktemp("copies"), mrac.suite(TINY)
    (folder / "README.txt").write_text("not a plan")
    name, world = next(iter(suite.items()))
    paths = [np.column_stack(np.divmod(robot.path, 10)).tolist() for robot in mrac.plan(world).robots]
    (folder / f"{name}.json").write_text(json.dumps({"paths": paths}))
    given = {"plans": {"copy": folder}, "rollouts": 60, "seed": 5, "processes": 1, "progress": False}
    return suite.judge(mostly_east, **given)


def test_the_figures_are_those_of_the_worlds(standing: Leaderboard, tmp_path: Path) -> None:
    said = standing.to_json()
    scores: dict[str, list[float]] = {}
    for world in said["worlds"].values():
        covered = {name: entry["coverage"]["mean"] for name, entry in world["entries"].items()}
        for name, mean in covered.items():
            scores.setdefault(name, []).append((mean - covered[RANDOM]) / (world["bound"] - covered[RANDOM]))
            error = world["entries"][name]["coverage"]["se"] or 0
            assert mean - 5 * error < world["optimum"] <= world["bound"] + 1e-12
        assert covered["mostly_east"] < covered["mrac"]
    for name, row in said["entries"].items():
        assert row["score"]["mean"] == pytest.approx(np.mean(scores[name]), abs=1e-12)
    ranked = [name for name, row in said["entries"].items() if row["rank"] is not None]
    assert ranked == sorted(ranked, key=lambda name: -np.mean(scores[name])) and len(ranked) == 6
    assert said["entries"][ranked[0]]["behind"]["mean"] == 0 and "mostly_east" in said["answer"]
    assert re.search(r" % (± |\()\d", said["answer"]) and "95 %" not in said["answer"], "% of the way from"
    standing.save(tmp_path)
    saved = mrac.load(tmp_path / "worlds" / f"{standing.worlds[1].name}.npz")
    assert saved.sha256 == mrac.suite()[standing.worlds[1].name].sha256 and saved.starts is not None


def test_plans_of_other_planners_have_rows(standing: Leaderboard) -> None:
    """MRAC's own paths, followed, are its open loop; without a plan for every world there is no rank."""
    first = standing.worlds[0]
    assert (first.rolled["copy, open loop"].visited == first.rolled["mrac, open loop"].visited).all()
    rows = {row.name: row for row in standing.entries}
    assert rows["copy, open loop"].rank is None and rows["copy, open loop"].worlds == 1
    assert "copy, closed loop" not in standing.worlds[1].rolled


def test_ranks_and_distances_by_hand() -> None:
    """Bound 10 of 10 cells, a walk of 2: scores are (J - 2) / 8."""
    walk = Rolled(np.full(4, 2), np.zeros(4, np.int64))
    worlds = []
    for name, ours, other in (("one", [6, 6, 10, 10], [6, 6, 6, 6]), ("two", [2, 2, 2, 2], [6, 6, 6, 6])):
        rolled = {"ours": Rolled(np.array(ours), np.array([0, 0, 1, 1])), "other": Rolled(np.array(other), walk.lost)}
        worlds.append(WorldResults(name, 2, 10, 10.0, None, {RANDOM: walk, **rolled}))
    other, ours, random = Leaderboard(tuple(worlds), 4, 0, "ours", 0.0).entries
    assert (other.name, other.rank, other.score.se, other.first) == ("other", 1, 0.0, 2)
    assert (other.score.mean, ours.score.mean) == (pytest.approx(0.5), pytest.approx(0.375))
    assert (ours.rank, ours.lost) == (2, 0.25) and ours.behind is not None
    assert ours.behind.mean == pytest.approx(0.125) and ours.behind.se == pytest.approx(0.25 / np.sqrt(3) / 2)
    assert ours.first == 1 and (random.score.mean, random.coverage) == (0.0, pytest.approx(0.2))


def test_who_always_takes_the_first_offer_is_mrac() -> None:
    given = {"actions": "areas", "rollouts": 40, "processes": 1, "progress": False}
    (played,) = mrac.suite("contiguous-10-25-k2").judge(lambda offers: [1] * len(offers), **given).worlds
    assert (played.rolled["<lambda>"].visited == played.rolled["mrac"].visited).all() and played.lost("mrac") > 0.5


def test_one_rollout_has_no_score() -> None:
    found = mrac.suite("contiguous-10-05-k1").judge(rollouts=1, processes=1, progress=False)
    assert "No entry has a score" in repr(found) and all(row.rank is None for row in found.entries)


@pytest.mark.slow
def test_a_rule_of_ones_own_may_be_judged() -> None:
    rule = Rule("by_size", lambda offer: ((offer.level, 1), (-offer.unvisited, 1)))
    found = mrac.suite("contiguous-10-05-k1").judge(rule, rollouts=9, processes=1, progress=False)
    assert {row.name for row in found.entries} >= {"by_size", "mrac", "per_cell", "per_cell+reserve", RANDOM}


@pytest.mark.slow
def test_processes_change_no_figure_of_the_table() -> None:
    one, two = (mrac.suite(TINY).judge(mostly_east, rollouts=300, processes=n, progress=False) for n in (1, 2))
    assert one.to_json() == two.to_json()


STAYS = "def policy(seen):\n    return [0]\n"
WRONG = {
    "no policy": ("x = 1\n", [], "my.py: defines no `policy`; expected `def policy(observations)`"),
    "no Python": ("def\n", [], "my.py: raised SyntaxError"),
    "raises": ("def policy(seen):\n    return seen.nothing\n", [], "my.py on contiguous-10-05-k1: the policy raised A"),
    "nonsense": ("def policy(seen):\n    return [9]\n", [], "my.py on contiguous-10-05-k1: the policy returned [9]"),
    "unknown": (STAYS, ["--only", "nowhere"], "--only: no world 'nowhere'; expected a"),
    "no plans": (
        "def policy(seen):\n    return [0]\n",
        ["--plans", "DARP=."],
        ".: no plan of DARP; expected files named",
    ),
    "no folder": (STAYS, ["--plans", "DARP"], "--plans 'DARP'; expected NAME=FOLDER"),
    "processes": (STAYS, ["--processes", "0"], "--processes"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said_in_a_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text, more, said = WRONG[name]
    Path("my.py").write_text(text)
    words = ["--only", "contiguous-10-05-k1", "--policy", "my.py", "--rollouts", "2", "--processes", "1"]
    kept = [word for place in range(0, len(words), 2) if words[place] not in more for word in words[place : place + 2]]
    assert suite_main([*kept, *more, "--out", "out"]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1 and said in lines[0] and not Path("out").exists()


def test_a_plan_from_elsewhere_and_a_name_that_is_taken_are_refused(tmp_path: Path) -> None:
    suite = mrac.suite("scattered-10-05-k2")
    (world,) = suite.values()
    row, col = world.starts[0].tolist()  # type: ignore[index]
    (tmp_path / "scattered-10-05-k2.json").write_text(json.dumps([[[row, col]]]))
    with pytest.raises(mrac.InputError, match=r"k2.json: its robots start at .*; expected .* the starts of scatt"):
        suite.judge(plans={"DARP": tmp_path}, rollouts=2, processes=1, progress=False)
    (tmp_path / "mrac.py").write_text("policy = len\n")
    with pytest.raises(mrac.InputError, match=r"mrac.py: a policy with the name 'mrac'; expected a name"):
        suite.judge(tmp_path / "mrac.py", rollouts=2, processes=1, progress=False)
    with pytest.raises(KeyError):
        suite["terrain-k8"]


def test_the_table_has_every_world() -> None:
    table = (Path(__file__).parent.parent / "docs/tables/suite-worlds.csv").read_text(encoding="utf-8")
    assert re.findall(r"(\S+-k\d+),\d", table) == list(HASHES)


# A policy of one's own, judged: the luck of plans, compiled or in Python alike, a score between walk and bound.

CORRIDOR = mrac.World.create(np.array([[0.0, 0.0, *[0.1] * 10]]))
EAST = ACTIONS.index("east")


def test_a_policy_meets_the_luck_of_plans() -> None:
    """In a corridor every plan goes east, and so does this policy: the same cells, robots and steps, id for id."""
    plan, choices = mrac.plan(CORRIDOR, 1), RolloutChoices(rollouts=300, seed=9)
    found = make_singles(CORRIDOR, plan, choices)(0, 300)
    visited, lost, steps = roll_policy(CoverageEnv(CORRIDOR, 1), lambda seen: [EAST], 9, 300)
    assert (visited == found.visited).all() and (lost == 1 - found.alive).all() and (steps == found.time).all()
    assert 0 < lost.sum() < 300
    judged = mrac.judge(CORRIDOR, jax.jit(lambda seen: jnp.full(len(seen), EAST)), 1, rollouts=300, seed=9)
    assert judged.plans["mrac"].ahead.mean == 0 and judged.coverage.mean == visited.mean() / 12
    assert judged.random.mean < judged.coverage.mean < judged.bound + 4 * judged.coverage.se
    assert re.search(r"It covers [\d.]+ % ± [\d.]+; ", repr(judged)) and "95 %" not in summary(judged)
    assert "upper bound: " in repr(judged) and judged.to_json()["score"]["mean"] == judged.score.mean


def to_new(seen: jax.Array) -> jax.Array:
    """Every robot to its first neighbour that is free and unvisited, else east."""
    place = jnp.argmax(seen[:, 3].reshape(len(seen), -1), axis=1)
    rows, cols = place // seen.shape[3], place % seen.shape[3]
    wanted = jnp.pad((seen[:, 1] == 0) & (seen[:, 2] == 0), ((0, 0), (1, 1), (1, 1)))
    sides = [(0, 1), (1, 0), (1, 2), (2, 1)]
    new = jnp.stack([wanted[jnp.arange(len(seen)), rows + down, cols + right] for down, right in sides], axis=1)
    return jnp.where(new.any(axis=1), 1 + jnp.argmax(new, axis=1), EAST)


def test_compiled_or_asked_is_the_same() -> None:
    env = CoverageEnv(random_world(6, 7, obstacles=0.15, threats=0.3), 3, max_steps=40)
    compiled = jax.jit(to_new)
    one, other = (roll_policy(env, policy, 5, 40) for policy in (compiled, lambda seen: np.asarray(compiled(seen))))
    assert all((a == b).all() for a, b in zip(one, other, strict=True))
    walk = roll_policy(env, None, 5, 40)
    assert one[0].mean() > walk[0].mean() and (roll_policy(env, None, 5, 20)[0] == walk[0][:20]).all()


def test_a_policy_may_be_random() -> None:
    env = CoverageEnv(CORRIDOR, 2, max_steps=9)
    asked = [roll_policy(env, lambda seen, draws: draws.integers(0, 5, len(seen)), 1, 6) for _ in range(2)]
    compiled = [roll_policy(env, jax.jit(lambda seen, key: jax.random.randint(key, 2, 0, 5)), 1, 6) for _ in range(2)]
    for first, second in (asked, compiled):
        assert all((a == b).all() for a, b in zip(first, second, strict=True)) and len(set(first[0].tolist())) > 1


def test_the_interval_of_a_score_holds_it() -> None:
    """In 95 of 100 samples, within 5 standard errors, where both figures are known."""
    draw, held, turns = np.random.default_rng(8), 0, 400
    for _ in range(turns):
        shared = draw.random(200) * 0.2
        scores = scores_of(0.4 + shared + draw.random(200) * 0.2, 0.1 + shared + draw.random(200) * 0.1, 0.9)
        found = estimate_of(scores)
        held += found.ci95[0] <= (0.6 - 0.25) / (0.9 - 0.25) <= found.ci95[1]
    assert abs(held / turns - 0.95) < 5 * np.sqrt(0.95 * 0.05 / turns)
    assert scores_of(np.ones(5), np.ones(5), 1.0) is None


NO_POLICIES = [
    (jax.jit(lambda seen: jnp.full(1, 7)), "the policy returned actions"),
    (jax.jit(lambda seen: jnp.full(1, -1)), "the policy returned actions"),
    (jax.jit(lambda seen: seen[:, 0, 0, 0]), "the policy returned actions"),
    (jax.jit(lambda seen: seen), None), (lambda seen: 3, None), (lambda seen: [7], None),
    (lambda seen: [0.5], None), (5, None),
]  # fmt: skip


@pytest.mark.parametrize(("wrong", "said"), NO_POLICIES)
def test_what_is_no_policy_is_refused(wrong: object, said: str | None) -> None:
    """Compiled ones, whose actions there are not, and others."""
    with pytest.raises(mrac.InputError, match=said):
        mrac.judge(CORRIDOR, wrong, 1, rollouts=8)  # type: ignore[arg-type]


def test_processes_change_no_figure() -> None:
    given = {"rollouts": 40, "seed": 4, "max_steps": 12, "against": ("mrac",), "progress": False}
    one, two = (mrac.judge(CORRIDOR, mostly_east, 2, processes=n, **given) for n in (1, 2))
    assert one.to_json() == two.to_json() and one.coverage.se > 0
    assert one.to_json() == mrac.evaluate(CORRIDOR, 2, policy=mostly_east, **given).to_json()
    with pytest.raises(mrac.InputError, match=r"processes=2, but the policy cannot be sent.*can be imported"):
        mrac.judge(CORRIDOR, lambda seen: mostly_east(seen, None), processes=2, rollouts=300)


@pytest.mark.parametrize("kind", ["persistent", "consumed"])
def test_hazards_are_those_of_plans(kind: str, tmp_path: Path) -> None:
    """Robots side by side in a corridor, so that a consumed hazard is gone for who comes after in the same step."""
    world = CORRIDOR.with_latent_hazard(kind, np.array([[0.0, 0.0, *[0.5] * 10]]), 0.4).with_starts([[0, 0]] * 3)
    (tmp_path / "paths.json").write_text(str([[[0, col] for col in range(12)]] * 3))
    plan = mrac.read_plan(tmp_path / "paths.json", world)
    choices = RolloutChoices(loop="open", rollouts=400, seed=3)
    found = make_singles(world, plan, choices)(0, 400)
    visited, lost, _ = roll_policy(CoverageEnv(world), lambda seen: [EAST] * 3, 3, 400)
    assert (visited == found.visited).all() and (lost == 3 - found.alive).all() and len(set(lost.tolist())) > 2
    judged = mrac.judge(world, jax.jit(lambda seen: jnp.full(len(seen), EAST)), rollouts=400, progress=False)
    assert judged.coverage.mean < judged.bound + 4 * judged.coverage.se


def test_what_is_for_plans_alone_is_refused_of_a_policy() -> None:
    said = r"no argument 'loop' for a policy; expected one of starts, actions, view"
    with pytest.raises(mrac.InputError, match=said):
        mrac.evaluate(CORRIDOR, policy=mostly_east, loop="open")
    with pytest.raises(mrac.InputError, match="both a plan and a policy"):
        mrac.evaluate(CORRIDOR, mrac.plan(CORRIDOR), policy=mostly_east)  # type: ignore[call-overload]


# `python docs/examples/experiments.py policies`: the right maps, the same luck, what is worse, and its faces.

FEW = (
    Setting("contiguous", 2), Setting("contiguous", 2, "per_cell", 0.25), Setting("contiguous", 2, cut=20),
    Setting("contiguous", 4),
)  # fmt: skip


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three settings, none on large maps, bounds of one team."""
    room = policies_study
    for name, value in {"SMALL": FEW, "ON_LARGE": (), "KINDS": ("contiguous",), "TEAMS": (2,)}.items():
        monkeypatch.setattr(room, name, value)


@pytest.mark.usefixtures("few", "full_effort")
def test_columns_are_those_of_the_maps_rolled_out_by_hand(tmp_path: Path) -> None:
    with Store.open(tmp_path / "s.db") as store:
        study = study_policies(maps=2, rollouts=30, seed=5, store=store, processes=1)
        again = study_policies(maps=2, rollouts=30, seed=5, store=store, processes=1)
    assert again.finished.rollouts == 0
    for number, seed in enumerate((5, 6)):
        world = random_world(pattern=ThreatPattern("contiguous", seed=seed))
        for setting in FEW:
            starts = place_starts(world, setting.robots)[0]
            settings = Settings(policy=setting.policy, risk_cap=setting.risk_cap, max_steps=setting.cut)
            few, exact = setting.robots == 4, setting.robots == 2
            tally = run_range(
                compile_closed_loop(make_plan(world, starts, settings), world), seed, 0, 30 if few else 2**15
            )[0]
            found = {name: values[number] for name, values in study.columns[setting].items()}
            figures = {"visited": tally.visited, "time": tally.time, "losses": tally.alive[::-1]}
            for name, counts in figures.items():  # of two robots the tree's, within some 5 standard errors of rollouts
                mean = mean_estimate(counts, 1 / tally.accessible if name == "visited" else 1.0)
                near = pytest.approx(mean.mean, abs=2.6 * mean.half_width) if exact else pytest.approx(mean.mean)
                assert found[name] == near
                assert not exact or found[name] != mean.mean or mean.se == 0
            assert again.columns[setting]["visited"][number] == found["visited"]
            assert (found["exact"], found["se"] == 0) == (exact, exact)
    starts = place_starts(random_world(pattern=ThreatPattern("contiguous", seed=5)), 2)[0]
    bound = any_strategy(world := random_world(pattern=ThreatPattern("contiguous", seed=5)), starts, flow=True).cells
    assert study.bounds["contiguous", 2].tolist() == [bound / world.accessible(starts).sum()]


def made_up(maps: int = 4) -> Study:
    """Of every setting: `per_cell` covers 5 points more than `mrac`, but for one map of one team, and loses fewer."""
    columns = {}
    for setting in SMALL + ON_LARGE:
        visited = np.linspace(0.5, 0.6, maps) + 0.05 * (setting.policy != "mrac")
        if setting == Setting("scattered", 8, "per_cell"):
            visited[maps // 4] -= 0.08
        losses = np.full(maps, setting.robots * (0.5 if setting.robot_value else 1.0))
        columns[setting] = {
            "visited": visited, "losses": losses, "time": np.full(maps, 200.0), "complete": np.zeros(maps),
            "se": np.full(maps, 0.005), "exact": np.full(maps, setting.robots <= 2),
        }  # fmt: skip
    bounds = {(kind, robots): np.full(1, 0.9) for kind in KINDS for robots in TEAMS}
    return Study(columns, bounds, 200, 7, Finished(10, 20, 30, 1.0))


def test_what_is_worse_and_what_is_left() -> None:
    study = made_up()
    setting = Setting("scattered", 8, "per_cell")
    [worse] = study.worse(setting)
    assert (worse.seed, worse.difference) == (8, pytest.approx(-0.03))
    assert worse.errors == pytest.approx(0.03 / np.hypot(0.005, 0.005))
    assert study.gain(setting).mean == pytest.approx(0.05 - 0.02)
    left = study.gap(setting)
    assert left.mean == pytest.approx(0.9 - 0.55)
    assert study.gain(Setting("scattered", 4, "per_cell")).half_width == pytest.approx(0, abs=1e-12)


def test_its_faces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = made_up()
    assert study_headline(study) == (
        "per_cell covers 3.0 to 5.0 points more than mrac with the same team, and over a point less on 1 of 40 maps "
        "and teams."
    )
    said = as_text(lambda console: print_report(report(study), console), 140)
    assert "scattered, k = 8: 1 of 4 maps, 1 of them beyond 3 standard errors: seed 8 (-3.0)" in said
    assert "Each map's means are exact for k = 1 and 2." in said
    found = study_json(study)
    assert {(point["robots"], point["exact"]) for point in found["points"]} == {(1, 4), (2, 4), (4, 0), (8, 0), (20, 0)}
    assert len(found["points"]) == len(SMALL) + len(ON_LARGE)
    assert [entry["robots"] for entry in found["worse"] if entry["maps"]] == [8]
    assert "partial" not in found
    names = {path.name for path in study.save(tmp_path / "out")}
    pictures = {"gains.png", *(f"front-{robots}.png" for robots in FRONT_TEAMS)}
    assert names == {"index.html", "policies.txt", "policies.json", "points.csv", *pictures}
    rows = list(csv.DictReader((tmp_path / "out" / "points.csv").read_text().splitlines()))
    assert len(rows) == 4 * len(found["points"])
    assert {row["robot_value"] for row in rows} >= {"", "160.0"}
    page = (tmp_path / "out" / "index.html").read_text()
    assert "What policies bring" in page
    alone = made_up(maps=1)
    assert json.loads(json.dumps(study_json(alone)))["points"][0]["visited"]["ci95"] is None
    monkeypatch.setattr("policies_study.FRONT_TEAMS", FRONT_TEAMS[:1])
    assert alone.save(tmp_path / "alone")


def test_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="maps=0"):
        study_policies(maps=0, rollouts=1)
    with pytest.raises(UsageError, match="seed=-1"):
        study_policies(maps=1, rollouts=1, seed=-1)
    assert "reproduce policies: is now docs/examples/experiments.py" in error_of(capsys, "reproduce", "policies")
