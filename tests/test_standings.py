"""The suite: worlds that never change, a table whose figures can be worked out by hand, errors that name the world."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from own_policies import mostly_east

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.policy_evaluation.leaderboard import RANDOM, Played, Rolled, Standing
from planner.policies.rule import Rule

TINY = "contiguous-10-05-k1,scattered-10-05-k2"
HASHES = {
    "contiguous-10-05-k1": "c1788f228df159bf",
    "contiguous-10-15-k1": "ba6a234cfbb69594",
    "contiguous-10-25-k2": "ab2819b1b5e00d9b",
    "scattered-10-05-k2": "5b606a6f710af8db",
    "scattered-10-15-k1": "028cef84dcafe7d8",
    "scattered-10-25-k3": "852ec60092d74796",
    "contiguous-20-05-k2": "2841ac82228b2319",
    "contiguous-20-15-k8": "ed066ad5d6766de4",
    "contiguous-20-25-k20": "43c9b80b4a9f4e37",
    "scattered-20-05-k4": "a43388f4040e2dd4",
    "scattered-20-15-k4": "d06ba45ca0dd1e43",
    "scattered-20-25-k8": "00cb7416a3c97a36",
    "contiguous-40-05-k4": "a2bee396548bb694",
    "contiguous-40-15-k12": "229fed80dc574ac5",
    "contiguous-40-25-k8": "d75b42f3c7816dbd",
    "scattered-40-05-k8": "36ead962d97503a5",
    "scattered-40-15-k20": "0d9f1df11ce6afe7",
    "scattered-40-25-k12": "6b10bab00a16d42f",
    "contiguous-64-05-k5": "ac6ca56590150f2c",
    "contiguous-64-15-k10": "a573a745069d5e8f",
    "contiguous-64-25-k20": "a4c7d301fc3090ba",
    "scattered-64-05-k10": "d065e1937ed6f4de",
    "scattered-64-15-k20": "8256feb15a0823c5",
    "scattered-64-25-k16": "729259d80493efd4",
    "persistent-contiguous-20-15-k4": "d76e9b4f157da6b0",
    "persistent-scattered-20-25-k8": "b5cb85eb3065344f",
    "consumed-contiguous-20-15-k4": "06552d58268e80ec",
    "consumed-scattered-20-25-k8": "445cb5e967a6ff5d",
    "terrain-k2": "75368c1436c54dfe",
    "terrain-k8": "9dde0ce94d4c534c",
}


def test_worlds_are_stable_for_ever() -> None:
    """Of map, what is in doubt and starts. A new hash is a new benchmark: give the world a new name instead."""
    found = {}
    for name, world in mrac.suite().items():
        assert world.starts is not None
        found[name] = hashlib.sha256(f"{world.luck_sha256} {world.starts.tolist()}".encode()).hexdigest()[:16]
        assert len(world.starts) == int(name.rpartition("-k")[2]) and world.accessible(world.starts).mean() > 0.6
    assert found == HASHES and len(found) == 30


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Standing:
    """Two tiny worlds, with a policy that goes east, and MRAC's paths as another planner's on one of them."""
    folder, suite = tmp_path_factory.mktemp("copies"), mrac.suite(TINY)
    (folder / "README.txt").write_text("not a plan")
    name, world = next(iter(suite.items()))
    paths = [np.column_stack(np.divmod(robot.path, 10)).tolist() for robot in mrac.plan(world).robots]
    (folder / f"{name}.json").write_text(json.dumps({"paths": paths}))
    given = {"plans": {"copy": folder}, "rollouts": 200, "seed": 5, "processes": 1, "progress": False}
    return suite.judge(mostly_east, **given)


def test_the_figures_are_those_of_the_worlds(standing: Standing, tmp_path: Path) -> None:
    said = standing.to_json()
    scores: dict[str, list[float]] = {}
    for world in said["worlds"].values():
        covered = {name: entry["coverage"]["mean"] for name, entry in world["entries"].items()}
        for name, mean in covered.items():
            scores.setdefault(name, []).append((mean - covered[RANDOM]) / (world["bound"] - covered[RANDOM]))
            assert (
                mean - 5 * (world["entries"][name]["coverage"]["se"] or 0) < world["optimum"] <= world["bound"] + 1e-12
            )
        assert covered["mostly_east"] < covered["mrac"]
    for name, row in said["entries"].items():
        assert row["score"]["mean"] == pytest.approx(np.mean(scores[name]), abs=1e-12)
    ranked = [name for name, row in said["entries"].items() if row["rank"] is not None]
    assert ranked == sorted(ranked, key=lambda name: -np.mean(scores[name])) and len(ranked) == 6
    assert said["entries"][ranked[0]]["behind"]["mean"] == 0 and "mostly_east" in said["answer"]
    assert re.search(r" % (± |\()\d", said["answer"]) and "95 %" not in said["answer"], (
        "% is a share of what lies between"
    )
    standing.save(tmp_path)
    saved = mrac.load(tmp_path / "worlds" / f"{standing.worlds[1].name}.npz")
    assert saved.sha256 == mrac.suite()[standing.worlds[1].name].sha256 and saved.starts is not None


def test_plans_of_other_planners_have_rows(standing: Standing) -> None:
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
        worlds.append(Played(name, 2, 10, 10.0, None, {RANDOM: walk, **rolled}))
    other, ours, random = Standing(tuple(worlds), 4, 0, "ours", 0.0).entries
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
    assert "Nobody has a score" in repr(found) and all(row.rank is None for row in found.entries)


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
    "raises": (
        "def policy(seen):\n    return seen.nothing\n",
        [],
        "my.py on contiguous-10-05-k1: the policy raised A",
    ),
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
    assert run(["suite", *kept, *more, "--out", "out"]) == 2
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
    with pytest.raises(mrac.InputError, match=r"mrac.py: a policy that is called 'mrac'; expected a name"):
        suite.judge(tmp_path / "mrac.py", rollouts=2, processes=1, progress=False)
    with pytest.raises(KeyError):
        suite["terrain-k8"]


def test_the_page_has_every_world() -> None:
    page = (Path(__file__).parent.parent / "docs" / "suite.md").read_text(encoding="utf-8")
    assert [line.split(" | ")[0][2:] for line in page.splitlines() if "-k" in line[:40] and line[0] == "|"] == list(
        HASHES
    )
