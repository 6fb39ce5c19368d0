"""`mrac-jax compare`: differences on common random numbers, against exact ones and against themselves."""

import json
import re
from dataclasses import replace
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import FOLDER, load_fixture
from helpers import answer_of, error_of
from page_reader import refused

import analysis.comparison
import mrac_jax as mrac
from analysis.cli.app import run
from analysis.comparison import FIGURES, Comparison, compare, differing, make_side, report, summary
from analysis.inputs import load_world
from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.estimates import FIRST_LOOK
from planner.errors import UsageError
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.world.world import World

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")


@cache
def team(robots: int, name: str = "contiguous-14x23-1000-k2") -> tuple[World, Plan]:
    world = load_fixture(name).world
    return world, mrac.plan(world, robots)


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    return answer_of(capsys, "compare", *words)


@cache
def compared(robots: tuple[int, int], rollouts: int = 0, **how: Any) -> Comparison:
    how |= {"rollouts": rollouts} if rollouts else {}
    return compare(*(make_side(*team(k), RolloutChoices(**how)) for k in robots))


def test_a_difference_is_that_of_the_rollouts_one_by_one() -> None:
    found, choices = compared((3, 4), 1000, seed=3), RolloutChoices(rollouts=1000, seed=3)
    a, b = (make_singles(*team(k), choices)(0, 1000) for k in (3, 4))
    apart = (b.visited.astype(int) - a.visited) / found.a.cells
    estimate = found.difference("visited").estimate
    assert estimate.mean == pytest.approx(apart.mean(), rel=1e-12)
    assert estimate.se == pytest.approx(apart.std(ddof=1) / np.sqrt(1000), rel=1e-9)
    assert (found.ahead, found.behind) == (int((apart > 0).sum()), int((apart < 0).sum()))
    assert found.difference("alive").estimate.mean == pytest.approx((b.alive.astype(int) - a.alive).mean())


def test_turned_round_it_changes_sign_and_the_same_on_both_sides_differs_in_nothing() -> None:
    there, back, same = (compared(robots, 2048) for robots in ((3, 4), (4, 3), (4, 4)))
    for figure in FIGURES:
        one, other, none = (found.difference(figure).estimate for found in (there, back, same))
        assert (one.mean, one.se) == pytest.approx((-other.mean, other.se), abs=1e-12)
        assert (none.mean, none.se, none.ci95) == (0, 0, (0, 0))
    assert (there.ahead, there.behind) == (back.behind, back.ahead) and same.ahead == same.behind == 0
    assert summary(same) == "A and B are equal: no difference (exact)."


def test_rests_of_two_missions_differ_by_what_they_go_on_from(tmp_path: Path) -> None:
    world, sides = World.create([[0, 0.1, 0.2, 0.3]]), []
    for name, borne in (("a.json", 0.0), ("b.json", 1.5)):
        state = {"format": "mrac-state", "version": 1, "step": 1, "visited": [[0, 0], [0, 1]],
                 "robots": [{"cell": [0, 1], "exposure": borne}]}  # fmt: skip
        (tmp_path / name).write_text(json.dumps(state))
        plan = mrac.plan(world, state=tmp_path / name, weibull_shape=3.0)
        sides.append(make_side(world, plan, RolloutChoices(rollouts=20_000)))
    found = compare(*sides)
    assert found.differing == (("its own state",), ("another state",))
    difference, exact = found.difference("visited").estimate, found.exact_difference("visited")
    assert exact is not None and exact < -0.17 and abs(difference.mean - exact) < 5 * difference.se


def test_plans_that_differ_in_their_areas_alone_are_told_apart() -> None:
    world = World.create([[0, 0.1, 0.2, 0.3]])
    plan = mrac.plan(world, robots=1)
    swapped = replace(plan, areas=plan.areas[::-1])
    sides = [make_side(world, one, RolloutChoices(rollouts=64)) for one in (plan, swapped)]
    assert differing(*sides) == (("its own allocation",), ("another allocation",))


@pytest.mark.usefixtures("full_effort")
def test_the_sentence_says_what_differs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    asked = ("--robots", "1", "--b.robots", "4", "--b.risk", "log", "--rollouts", "512")
    said = " points more of the accessible cells than A (1 robot, risk paper) on average"
    for how in ((), ("--exact", "0.5")):
        assert f"{said} (exact);" in answer(capsys, WORLD, *asked, *how)["answer"]
    found = answer(capsys, WORLD, *asked, "--exact", "never")["answer"]
    assert "B (4 robots, risk log) visits" in found and "than A (1 robot, risk paper) on average" in found
    one, other = (f"{row},{col}" for row, col in team(2)[1].starts)
    for words, a, b in (
        ("--robots 1 --b.robots 4 --b.risk log", ["1 robot", "risk paper"], ["4 robots", "risk log"]),
        ("--policy per_cell --robot-value 30.5 --b.policy mrac", ["policy per_cell", "robot value 30.5"],
         ["policy mrac", "no robot value"]),
        ("--deadline 90 --b.return-to home", ["no return to"], ["return to home"]),  # the deadline is both sides'
        (f"--starts {one} --b.starts {other}", ["its own starts"], ["other starts"]),
    ):  # fmt: skip
        found = answer(capsys, WORLD, *words.split(), "--rollouts", "64", "--exact", "never")
        assert found["differing"] == {"a": a, "b": b}

    paths = tmp_path / "paths.json"
    plan, cells_of = team(3)[1], lambda path: np.transpose(np.divmod(path, 23))
    paths.write_text(json.dumps({"paths": [cells_of(robot.path).tolist() for robot in plan.robots]}))
    assert run(["compare", WORLD, str(paths), "--robots", "3", "--rollouts", "512"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "B (an external plan, open loop) visits" in said and "than A (an MRAC plan, closed loop)" in said
    assert "note: in A the areas of lost robots are reassigned, in B not" in said


def test_two_sensors_on_the_same_luck(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """B's option is one of A's team's; the means are those of each by itself, and not to see a difference of maps."""
    scenario = str(tmp_path / "dark.yaml")
    Path(scenario).write_text(f"map: {WORLD}\nprior_map: {{p: 0.04}}\nsensor_range: 2\nrobots: {{count: 3}}\n")
    asked = "--robots 2 --sensor-range 1 --b.sense inf --rollouts 2048 --exact never"
    found = answer(capsys, scenario, *asked.split(" "))
    assert found["differing"] == {"a": ["robots see 1 cell far"], "b": ["robots see everything"]}
    assert (found["a"]["robots"], found["b"]["robots"]) == (2, 2)
    low, high = found["difference"]["visited"]["ci95"]
    assert 0 < low < high and found["difference"]["visited"]["gain"] > 2
    world = load_world(scenario)
    for side, far in (("a", 1), ("b", inf)):
        seeing = world.with_sensor_range(far)
        alone = make_singles(seeing, mrac.plan(seeing, 2), RolloutChoices(rollouts=2048))(0, 2048).visited.mean()
        assert found[side]["mean"]["visited"] == pytest.approx(alone / found[side]["accessible"], abs=0.02)
    known, plan = team(2)
    for one, words in ((known, "known map"), (known.with_prior_map(0.04, sensor_range=1), "robots see 1 cell far")):
        worlds = (one, known.with_prior_map(0.04, sensor_range=2))
        sides = (make_side(w, make_plan(w, plan.starts), RolloutChoices(rollouts=64)) for w in worlds)
        assert compare(*sides).differing == ((words,), ("robots see 2 cells far",))
    assert "error: B:" in (said := error_of(capsys, "compare", WORLD, "--b.sense", "1")) and "has no effect" in said
    assert "--sensor-range 'far'" in error_of(capsys, "compare", scenario, "--sensor-range", "far")


def test_the_interval_holds_the_exact_difference() -> None:
    """Common random numbers are sharper for small changes: open and closed loop of the same plan share the luck."""
    sides = [make_side(*team(2), RolloutChoices(loop=loop, rollouts=8192)) for loop in ("open", "closed")]
    loops, teams = compare(*sides), compared((1, 2), 65_536, seed=8)
    assert loops.difference("visited").gain > 2
    for found, figure in ((teams, "visited"), (teams, "survived"), (loops, "visited")):
        estimate = found.difference(figure).estimate
        assert abs(estimate.mean - found.exact_difference(figure)) <= 4 * estimate.se


@pytest.mark.usefixtures("few_lanes")
def test_engines_give_the_same_comparison() -> None:
    world = World.create(np.where(np.indices((5, 6)).sum(axis=0) % 3 == 1, 0.2, 0.0))
    plans = [make_plan(world, [[0, 0], [4, 5], [0, 5]][:robots]) for robots in (2, 3)]
    found = [
        compare(*(make_side(world, plan, RolloutChoices(rollouts=512, engine=engine)) for plan in plans))
        for engine in ("numba", "jax")
    ]
    assert found[0].pairs == found[1].pairs


def test_precision_is_of_the_difference_and_looked_at_after_doubling() -> None:
    found = compared((3, 4), precision=0.004)
    half = compared((3, 4), found.rollouts // 2)
    widths = [one.difference("visited").estimate.half_width for one in (found, half)]
    assert widths[0] < 0.004 <= widths[1] and found.rollouts in [FIRST_LOOK << j for j in range(6)]


@pytest.mark.parametrize(
    ("other", "said"),
    [({"seed": 2}, "seed: 1 and 2"), ({"rollouts": 64}, "rollouts: 512 and 64"),
     ({"precision": 0.1}, "precision: None and 0.1")],
)  # fmt: skip
def test_sides_of_other_rollouts_are_refused(other: dict[str, Any], said: str) -> None:
    """Rollout r of both must meet the same luck."""
    mine = RolloutChoices(rollouts=512, seed=1)
    with pytest.raises(UsageError, match=f"the sides differ in {said}; expected the same rollouts"):
        compare(*(make_side(*team(3), choices) for choices in (mine, replace(mine, **other))))


def test_interrupted_leaves_what_was_done(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    real, calls = analysis.comparison._add, []

    def stop_later(*words):  # type: ignore[no-untyped-def]
        calls.append(words)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*words)

    monkeypatch.setattr(analysis.comparison, "_add", stop_later)
    found = answer_of(capsys, "compare", WORLD, "--robots", "3", "--b.robots", "4", "--rollouts", "50000", status=130)
    assert found["partial"] is True and found["rollouts"] == FIRST_LOOK


def test_the_command_on_teams_settings_plans_and_loops(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    found = answer(capsys, WORLD, "--robots", "1", "--b.robots", "4", "--rollouts", "4096")
    assert (found["a"]["robots"], found["b"]["robots"]) == (1, 4)
    low, high = found["difference"]["visited"]["ci95"]
    assert 0 < low < high and found["b_ahead"]["mean"] > 0.5 and "more" in found["answer"]

    few = (WORLD, "--rollouts", "512")
    found = answer(capsys, *few, "--robots", "1", "--b.risk", "log")
    assert (found["a"]["settings"]["risk"], found["b"]["settings"]["risk"]) == ("paper", "log")
    assert found["exact_difference"]["visited"] is not None

    plan, stays = str(tmp_path / "plan.json"), str(tmp_path / "stays.json")
    team(3)[1].save(plan)
    assert answer(capsys, WORLD, plan, *few[1:], "--robots", "3")["difference"]["visited"]["mean"] == 0
    Path(stays).write_text(json.dumps({"paths": [team(1)[1].starts.tolist()]}))
    found = answer(capsys, WORLD, stays, *few[1:], "--loop", "open")
    assert found["b"]["settings"] is None and found["difference"]["visited"]["ci95"][1] < 0

    for words, said in (("--b.loop open", "; open loop"), ("--deadline 40 --b.density 8", "by step 40")):
        assert run(["compare", *few, "--robots", "3", *words.split()]) == 0
        assert said in " ".join(capsys.readouterr().out.split())


WRONG = {
    "compare WORLD --b.robots 0": "--b.robots 0; expected a whole number, 1 to 1024",
    "compare WORLD --b.robot 3": "did you mean", "compare nowhere.npz": "a: nowhere.npz",
    "compare WORLD nowhere.npz": "b: nowhere.npz", "compare WORLD nowhere.json": "b: nowhere.json",
    "compare WORLD x.json --b.plan y.json": "one of them", "compare": "a",
    "compare WORLD --b.loop open --b.threat-checks first_visit": "closed loop",
    "compare WORLD --precision 0.1 --rollouts 5": "one of them",
}  # fmt: skip


@pytest.mark.parametrize("words", WRONG)
def test_wrong_usage_is_one_line_and_status_2(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert WRONG[words] in refused(capsys, *(WORLD if word == "WORLD" else word for word in words.split())).lower()


def test_who_comes_home_is_compared_too(capsys: pytest.CaptureFixture[str]) -> None:
    """Against the rollouts one by one; where one side alone comes home its own figures stand in a note."""
    world, choices = team(3)[0], RolloutChoices(rollouts=1024, seed=5)
    plans = [mrac.plan(world, 3, return_to="home", range=60, policy=policy) for policy in ("mrac", "per_cell")]
    sides = [make_side(world, plan, choices) for plan in plans]
    found = compare(*sides)
    home = np.array([make_singles(world, plan, choices)(0, 1024).home for plan in plans], dtype=np.int64)
    assert [found.mean(side, "home") for side in sides] == pytest.approx(home.mean(axis=1))
    apart = {"home": home[1] - home[0], "all_home": (home[1] == 3).astype(int) - (home[0] == 3)}
    for figure, values in apart.items():
        estimate = found.difference(figure).estimate
        assert estimate.mean == pytest.approx(values.mean()) and abs(values).sum() > 0
        assert estimate.se == pytest.approx(values.std(ddof=1) / 32, rel=1e-9)
    asked = (WORLD, "--robots", "3", "--rollouts", "256")
    both = answer(capsys, *asked, "--return-to", "home", "--b.policy", "per_cell")
    assert both["difference"].keys() == both["a"]["mean"].keys() == {*FIGURES, "home", "all_home", "delivered"}
    assert run(["compare", *asked, "--b.return-to", "home"]) == 0
    assert "note: B's robots return to base, " in " ".join(capsys.readouterr().out.split())
    alone = answer(capsys, *asked, "--b.return-to", "home")
    assert alone["difference"].keys() == alone["a"]["mean"].keys() == set(FIGURES) and "home" in alone["b"]["mean"]


def test_the_headline_says_how_often_and_with_what_confidence() -> None:
    """A share of runs is the only percentage of the sentence."""
    found, few = (compared((3, 4), rollouts, seed=3) for rollouts in (6000, 4))
    notes = report(few).notes
    assert any(note.startswith("too few rollouts to compare ") and "time, steps" in note for note in notes)
    assert not any("too few" in note for note in report(found).notes)
    for runs, said in (
        ((6000, 0), "100 % of runs, behind in 0 %."),
        ((5999, 1), "> 99.9 % of runs, behind in < 0.1 %."),
    ):
        assert summary(replace(found, ahead=runs[0], behind=runs[1])).endswith(f"; B is ahead in {said}")
    for one, seen in ((found, ""), (few, "No difference seen: ")):
        vars(one)["exact_difference"] = lambda figure: None
        said = summary(one)
        assert said.startswith(f"{seen}B (4 robots) visits ") and "95 %" not in said
        assert re.search(r"on average \(B - A: -?[\d.]+ \.\. [\d.]+, confidence 0\.95\); B is ahead in ", said)
