"""Where nothing can happen one rollout is every run: the answer is at once, exact, and says why, in every command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from analysis import sampling as roll_out
from analysis.cli.app import run
from analysis.comparison import compare, make_side
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.report import to_json
from analysis.sampling import RolloutChoices
from planner.mrac.make_plan import make_plan
from planner.plan.plan import is_certain
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Policy, Settings
from planner.simulator import closed_loop
from planner.tally import Outcome
from planner.world.levels import place_starts
from planner.world.world import World

BOTH = pytest.mark.parametrize("loop", ["open", "closed"])
WALLED = np.array([[0, 0, 0, 0, np.nan, 0.5], [0, np.nan, 0, 0, np.nan, 0.5], [0, 0, 0, 0, np.nan, 0.5]])
"""Danger that nobody can reach."""


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """World files: without danger, with danger behind a wall, and the same with a door."""
    folder, open_door = tmp_path_factory.mktemp("maps"), WALLED.copy()
    open_door[1, 4] = 0.0
    found = {}
    for name, threat in (("safe", np.zeros((5, 7))), ("walled", WALLED), ("door", open_door)):
        found[name] = str(folder / f"{name}.npz")
        World.create(threat).save(found[name], force=True)
    return found


def answer_of(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert run(words) == 0
    answer: dict = json.loads(capsys.readouterr().out)
    return answer


@BOTH
@pytest.mark.parametrize("name", ["safe", "walled"])
def test_one_rollout_answers_with_a_point(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str], name: str, loop: str
) -> None:
    words = ["evaluate", maps[name], "--robots", "2", "--loop", loop, "--json", "--seed", "7"]
    for more in ([], ["--rollouts", "50000"], ["--precision", "0.0001"], ["--deadline", "3", "--threat-scale", "0,1"]):
        answer = answer_of(capsys, *words, *more)
        by = "numba" if loop == "open" else "nominal run"
        assert (answer["rollouts"], answer["certain"], answer["seed"], answer["engine"]) == (1, True, 7, by)
        for meaning in ("visited", "survived"):
            shown = answer["coverage"][meaning]
            assert (shown["mean"], shown["se"], shown["ci95"]) == (1.0, 0.0, [1.0, 1.0])
            assert all(chance["ci95"] == [1.0, 1.0] for chance in shown["at_least"].values())
        assert (answer["complete"]["ci95"], answer["losses"]["ci95"]) == ([1.0, 1.0], [0.0, 0.0])
        assert (answer["time"]["se"], answer["time"]["mean"]) == (0.0, answer["plan"]["makespan"])
        for scaled in answer.get("threat_scale", []):
            assert (scaled["certain"], scaled["coverage"]["visited"]["ci95"]) == (True, [1.0, 1.0])


@BOTH
def test_it_is_said_in_a_line_and_no_formula_fails(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str], loop: str
) -> None:
    assert run(["evaluate", maps["safe"], "--robots", "3", "--loop", loop]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "every run is the same and 1 rollout is enough" in said
    assert "none is lost" in said
    assert "FAILS" not in said
    assert "1 rollout," in said
    assert "1 rollouts" not in said


def test_danger_on_the_way_is_rolled_out_as_asked(maps: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", maps["door"], "--robots", "1", "--loop", "open", "--rollouts", "500", "--json"]
    answer = answer_of(capsys, *words, "--threat-scale", "0,1")
    assert (answer["rollouts"], answer["certain"]) == (500, False)
    assert [scaled["certain"] for scaled in answer["threat_scale"]] == [True, False]
    assert answer["coverage"]["visited"]["ci95"][0] < answer["coverage"]["visited"]["ci95"][1]


def test_one_rollout_of_a_dangerous_map_is_no_certainty(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    answer = answer_of(capsys, "evaluate", maps["door"], "--rollouts", "1", "--json", "--loop", "open")
    assert (answer["rollouts"], answer["certain"]) == (1, False)
    assert answer["coverage"]["visited"]["se"] is None


@BOTH
def test_more_rollouts_are_indeed_the_same(loop: str) -> None:
    """The claim itself, on the engines: with danger on the map and none on the way, 300 rollouts are one another."""
    world = World.create(WALLED)
    plan = make_plan(world, place_starts(world, 2)[0])
    assert is_certain(world, plan)
    choices = RolloutChoices(loop=loop, rollouts=300, engine="numba")  # type: ignore[arg-type]
    tally = list(roll_out.make_roll_out(world, plan, choices)(choices, None))[-1].tally
    one = evaluate(world, plan, choices).tally
    for name, counts in one.counts().items():
        assert np.array_equal(300 * counts, tally.counts()[name][: len(counts)]), name


@pytest.mark.parametrize("robots", [1, 3])
@pytest.mark.parametrize(("policy", "deadline"), [("mrac", None), ("per_cell", None), ("mrac", 2), ("per_cell", 2)])
def test_the_nominal_run_is_counted_as_an_engine_counts_it(robots: int, policy: Policy, deadline: int | None) -> None:
    """Count for count, key and all, whole and cut off: before its end, at it, and after it."""
    world = World.create(WALLED)
    plan = make_plan(world, place_starts(world, robots)[0], Settings(policy=policy, deadline=deadline))
    assert plan.outcome == ("complete" if deadline is None else "deadline")
    how = Rolling(seed=5)
    nominal, numba = make_engine(plan, world, how), make_engine(plan, world, how, "numba")
    assert (nominal.name, numba.name) == ("nominal run", "numba")
    assert nominal.tally(3, 40) == numba.tally(3, 40)
    ended = Outcome.COMPLETE if deadline is None else Outcome.STEP_LIMIT
    assert nominal.tally(3, 40).outcomes[ended] == 40
    for step in (1, plan.time - 1, plan.time, plan.time + 5):
        assert nominal.until(step).tally(0, 7) == numba.until(step).tally(0, 7)
    assert nominal.tally(0, 3) + nominal.tally(3, 2) == numba.tally(0, 5)
    for name in ("start", "visited", "survived", "time", "alive", "outcome"):
        assert np.array_equal(getattr(nominal.results(2, 9), name), getattr(numba.results(2, 9), name)), name
    assert list(nominal.traces([4, 0])) == list(numba.traces([4, 0]))


@pytest.mark.parametrize("way", ["home", "danger", "asked for"])
def test_what_may_differ_from_the_nominal_run_is_rolled_out(way: str) -> None:
    threat = np.zeros((3, 4))
    threat[2, 3] = 0.5 * (way == "danger")
    world = World.create(threat)
    settings = Settings(return_to="home") if way == "home" else Settings()
    plan = make_plan(world, place_starts(world, 2)[0], settings)
    assert make_engine(plan, world, Rolling(), "numba" if way == "asked for" else "auto").name == "numba"


def test_a_large_safe_map_is_answered_without_compiled_rollouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map of 5 cm a pixel: the kernel of rollouts, which takes a minute to compile, is not asked for."""

    def refuse(*given: object) -> None:
        raise AssertionError("rolled out by compiled code")

    monkeypatch.setattr(closed_loop, "run_sets", refuse)
    monkeypatch.setattr(closed_loop, "on_threads", refuse)
    world = World.create(np.zeros((120, 100)))
    plan = make_plan(world, place_starts(world, 3)[0])
    answer = evaluate(world, plan, RolloutChoices(deadline=2000), band=True, advice=True)
    assert answer.certain and answer.engine == "nominal run"
    assert answer.tally.visited[12_000] == 1
    band = answer.outputs["band"]
    assert band.low[-1] == band.high[-1] == 12_000 and band.low[0] == 3  # type: ignore[attr-defined]


@pytest.mark.usefixtures("one_picture")
def test_the_folder_is_written_and_its_page_shows_no_failure(maps: dict[str, str], tmp_path: Path) -> None:
    assert run(["evaluate", maps["safe"], "--robots", "2", "--out", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "index.html").read_text()
    assert "every run is the same" in page
    assert ">FAILS<" not in page
    assert "readings fail" not in page


def test_luck_has_no_part_in_it(maps: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--rollouts", "5000", "--json")
    answer = answer_of(capsys, "evaluate", maps["safe"], "--robots", "2", *words)
    assert answer["coverage"]["visited"]["ci95"] == [1.0, 1.0] and answer["control"] is None


def test_two_sides_on_which_nothing_can_happen_are_compared_once(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    answer = answer_of(capsys, "compare", maps["safe"], "--robots", "1", "--b.robots", "3", "--json")
    assert (answer["rollouts"], answer["certain"]) == (1, True)
    time = answer["difference"]["time"]
    assert time["ci95"] == [time["mean"]] * 2
    assert time["mean"] < 0
    assert run(["compare", maps["safe"], "--robots", "1", "--b.robots", "3", "--precision", "0.001"]) == 0
    assert "every run is the same" in capsys.readouterr().out


def test_one_side_in_danger_is_rolled_out(maps: dict[str, str]) -> None:
    world, choices = World.create(np.full((4, 4), 0.1)), RolloutChoices(loop="open", rollouts=200)
    safe = World.create(np.zeros((4, 4)))
    sides = [make_side(one, make_plan(one, place_starts(one, 1)[0]), choices) for one in (world, safe)]
    assert compare(*sides).rollouts == 200


@BOTH
def test_the_size_of_a_team_needs_a_rollout_a_team_or_an_exact_tree(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str], loop: str
) -> None:
    answer = answer_of(capsys, "size", maps["safe"], "--complete", "--most", "3", "--loop", loop, "--json")
    assert answer["robots"] == 1
    assert [point["rollouts"] for point in answer["curve"]] == [1 if loop == "open" else 0]
    assert answer["curve"][0]["verdict_interval"] == [1.0, 1.0]
    words = ("size", maps["safe"], "--target", "0.9", "--most", "2", "--precision", "0.001", "--loop", loop, "--json")
    assert answer_of(capsys, *words)["robots"] == 1


def test_check_and_record_do_not_fail(maps: dict[str, str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["check", maps["walled"], "--robots", "2", "--json"]) == 0
    capsys.readouterr()
    out = tmp_path / "run.mcap"
    assert run(["record", maps["safe"], "--robots", "2", "--pick", "worst,best", "--out", str(out)]) == 0
    assert "1 rollout evaluated" in capsys.readouterr().out
    assert run(["replay", str(out), "--all"]) == 0


def test_scaled_worlds_are_judged_by_their_own_threats() -> None:
    world = World.create(np.full((3, 3), 0.2))
    plan = make_plan(world, place_starts(world, 1)[0])
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=64), threat_scale=(0.0, 2.0))
    assert [scaled.tally.rollouts for scaled in answer.outputs["threat_scale"].scaled] == [1, 64]
    assert to_json(answer)["threat_scale"][0]["losses"]["ci95"] == [0.0, 0.0]
