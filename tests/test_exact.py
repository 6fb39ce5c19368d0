"""Exact values: certain missions, what an evaluation calls exact, trees of all that can happen."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import ANSWERS
from drawn_worlds import closed_loop as closed_loop_in_doubt
from drawn_worlds import expected, one_of, open_loop
from helpers import answer_of
from oracle_tree import closed_loop_exact
from test_failure_sampling import NAMES, known, world_of

import mrac_jax as mrac
from analysis import sampling as roll_out
from analysis.cli.app import run
from analysis.comparison import compare, make_side
from analysis.estimators.trial import SLACK, _loop_of, tree_of
from analysis.evaluation.evaluate import TO_LOOK_AT, evaluate
from analysis.evaluation.report import completion_text, losses_text, report
from analysis.evaluation.tables import distribution, histogram_bins
from analysis.report.result import print_report
from analysis.sampling import RolloutChoices
from analysis.utils.tables import as_text
from planner.errors import UsageError
from planner.formatting import percent
from planner.make_plan import make_plan
from planner.plan.plan import is_certain
from planner.rollouts import closed_loop
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.exact_tree import WHOLE, Tree, grow_tree
from planner.rollouts.runners import Runner
from planner.settings import Policy, Settings
from planner.simulator.codes import Outcome
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World


def tree_for(plan: Any, world: World, seconds: float = 2.0, slack: float = SLACK) -> Any:
    """The tree of a plan's closed loop, or None."""
    loop = _loop_of(plan, world, False, None)
    return None if loop is None else tree_of(loop, seconds, slack)


# Where nothing can happen one rollout is every run: the answer is at once, exact, and says why, in every command.

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


@BOTH
@pytest.mark.parametrize("name", ["safe", "walled"])
def test_one_rollout_answers_with_a_point(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str], name: str, loop: str
) -> None:
    words = ["evaluate", maps[name], "--robots", "2", "--loop", loop, "--seed", "7"]
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
    words = ["evaluate", maps["door"], "--robots", "1", "--loop", "open", "--rollouts", "500"]
    answer = answer_of(capsys, *words, "--threat-scale", "0,1")
    assert (answer["rollouts"], answer["certain"]) == (500, False)
    assert [scaled["certain"] for scaled in answer["threat_scale"]] == [True, False]
    assert answer["coverage"]["visited"]["ci95"][0] < answer["coverage"]["visited"]["ci95"][1]


def test_one_rollout_of_a_dangerous_map_is_no_certainty(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    answer = answer_of(capsys, "evaluate", maps["door"], "--rollouts", "1", "--loop", "open")
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
        assert nominal.truncated_at(step).tally(0, 7) == numba.truncated_at(step).tally(0, 7)
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

    monkeypatch.setattr(closed_loop, "run_rollouts", refuse)
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
    words = ("--rollouts", "5000")
    answer = answer_of(capsys, "evaluate", maps["safe"], "--robots", "2", *words)
    assert answer["coverage"]["visited"]["ci95"] == [1.0, 1.0] and answer["control"] is None


def test_two_sides_on_which_nothing_can_happen_are_compared_once(
    maps: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    answer = answer_of(capsys, "compare", maps["safe"], "--robots", "1", "--b.robots", "3")
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
    answer = answer_of(capsys, "size", maps["safe"], "--complete", "--most", "3", "--loop", loop)
    assert answer["robots"] == 1
    assert [point["rollouts"] for point in answer["curve"]] == [1 if loop == "open" else 0]
    assert answer["curve"][0]["verdict_interval"] == [1.0, 1.0]
    words = ("size", maps["safe"], "--target", "0.9", "--most", "2", "--precision", "0.001", "--loop", loop)
    assert answer_of(capsys, *words)["robots"] == 1


def test_check_and_record_do_not_fail(maps: dict[str, str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["check", maps["walled"], "--robots", "2", "--json"]) == 0
    capsys.readouterr()
    out = tmp_path / "run.mcap"
    assert run(["record", maps["safe"], "--robots", "2", "--pick", "worst,best", "--out", str(out)]) == 0
    assert "1 rollout evaluated" in capsys.readouterr().out
    assert run(["inspect", str(out), "--replay", "--all"]) == 0


def test_scaled_worlds_are_judged_by_their_own_threats() -> None:
    world = World.create(np.full((3, 3), 0.2))
    plan = make_plan(world, place_starts(world, 1)[0])
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=64), threat_scale=(0.0, 2.0))
    assert [scaled.tally.rollouts for scaled in answer.outputs["threat_scale"].scaled] == [1, 64]
    assert answer.to_json()["threat_scale"][0]["losses"]["ci95"] == [0.0, 0.0]


# What an evaluation calls exact is the expected value of the loop that was evaluated, or null.

WORLD = World.create([[0, 0, 0.05, 0, np.nan], [0.3, 0, 0, 0, 0.5], [0, 0, 0, 0, 0.1]])
STARTS = [(2, 2), (1, 1), (1, 4)]
QUIET = {"advice": False, "band": False, "engine": "numba"}


def test_losses_alive_and_time_of_the_closed_loop_are_its_own() -> None:
    """Against the plain oracle, played through every pattern of hits; time against its own rollouts."""
    plan = mrac.plan(WORLD, starts=STARTS)
    answer = mrac.evaluate(WORLD, plan, rollouts=20_000, **QUIET)
    said, tally = answer.to_json(), answer.tally
    draw = one_of([WORLD.threat.ravel()])
    alive, alone = expected(closed_loop_in_doubt(plan, WORLD), draw)[2], expected(open_loop(plan, WORLD), draw)[2]
    assert alone - alive > 0.1
    assert said["exact"]["alive"] == said["exact"]["closed_loop"]["alive"] == pytest.approx(alive, abs=1e-6)
    assert said["losses"]["exact"] == pytest.approx(3 - alive, abs=1e-6)
    assert said["exact"]["open_loop"]["alive"] == pytest.approx(alone, abs=1e-6)
    assert said["exact"]["open_loop"]["losses"] == pytest.approx(3 - alone, abs=1e-6)
    steps = np.arange(len(tally.time))
    mean = tally.time @ steps / tally.rollouts
    se = np.sqrt(tally.time @ (steps - mean) ** 2) / tally.rollouts
    assert abs(said["exact"]["time"] - mean) < 5 * se < abs(said["exact"]["open_loop"]["time"] - mean)
    assert answer.losses.ci95 == (answer.losses.mean,) * 2 == (pytest.approx(3 - alive, abs=1e-6),) * 2


def test_sentences_say_the_exact_value_where_it_is_known() -> None:
    """Few rollouts miss it: the summary, the sentences, the tile and the table agree."""
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS), rollouts=64, **QUIET)
    robots, steps = answer.exact, f"{answer.exact.time:,.0f} steps on average"
    lost, sampled = f"{3 - robots.alive:.2f}", f"{answer.tally.alive @ np.arange(3, -1, -1) / 64:.2f}"
    assert lost != sampled, "a seed whose luck shows"
    assert losses_text(answer).startswith(f"{lost} of 3 robots lost on average") and steps in completion_text(answer)
    assert any(tile.value == f"{lost} of 3" for tile in report(answer).figures)
    shown = as_text(lambda console: print_report(report(answer), console))
    row = next(line for line in shown.splitlines() if line.startswith("  robots lost "))
    assert row.removeprefix("  robots lost ").strip().startswith(f"{lost} of 3") and "exact" in row


@pytest.mark.usefixtures("full_effort")
def test_advice_says_of_the_plan_what_the_headline_says() -> None:
    """Not what 64 rollouts came to, where all is known."""
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS), rollouts=64, **QUIET | {"advice": True})
    _, coverage, losses = answer.outputs["advice"].now
    told = [(coverage, answer.visited), (losses, answer.losses)]
    assert all((now.mean, now.ci95) == (shown.mean, shown.ci95) and now.half_width == 0 for now, shown in told)
    assert losses.mean != pytest.approx(answer.tally.alive @ np.arange(3, -1, -1) / 64)


@pytest.mark.parametrize("seed", [3, 8])
def test_chances_and_quantiles_are_those_of_a_brute_force_enumeration(seed: int) -> None:
    """Whatever the few rollouts are like: every figure, the curve, the histogram, the words and the JSON."""
    world = random_world(4, 5, ThreatPattern("scattered", 3, (0.1, 0.3), seed), obstacles=0.1, threats=0.3)
    plan = mrac.plan(world, 2)
    answer, oracle = mrac.evaluate(world, plan, rollouts=64, **QUIET), closed_loop_exact(plan, world)
    found, said, close = answer.figures, answer.to_json(), partial(pytest.approx, abs=1e-6)
    cells = len(oracle.visited_chance) - 1
    for meaning in ("visited", "survived"):
        chance, covered = getattr(oracle, f"{meaning}_chance"), getattr(found, meaning)
        reached, own = np.cumsum(chance[::-1])[::-1], getattr(answer, meaning)
        assert covered.counts / covered.counts.sum() == close(chance)
        assert [covered.chance(cell).mean for cell in range(cells + 1)] == close(reached)
        assert own.at_least(0.9).ci95 == close((reached[int(np.ceil(0.9 * cells - 1e-9))],) * 2)
        for q in (0.05, 0.3, 0.5, 0.95):
            assert own.quantile(q) * cells == np.searchsorted(np.cumsum(chance), q - 1e-9)
        assert said["coverage"][meaning]["at_least"]["1"]["mean"] == close(reached[-1])
        assert said["coverage"][meaning]["ci95"] == close([getattr(oracle, meaning) / cells] * 2)
    assert [chance.mean for chance in found.left] == close(oracle.alive_chance)
    assert said["complete"]["mean"] == close(oracle.complete)
    assert found.assured == np.searchsorted(np.cumsum(oracle.visited_chance), 0.05 - 1e-9)
    assert found.complete.columns() == (f"{100 * oracle.complete:.2f}", "exact")
    assert f"Every accessible cell is visited in {100 * oracle.complete:.2f} % of runs" in completion_text(answer)
    steps, bars = distribution(answer)
    edges = histogram_bins(found.visited.counts)
    heights = np.histogram(np.arange(cells + 1), bins=edges, weights=oracle.visited_chance)[0]
    assert bars.series[0].y == close(100 * heights)
    assert (bars.title, steps.series[0].low) == ("Runs by coverage", close(np.asarray(steps.series[0].y)))


def test_what_a_tree_left_makes_chances_intervals_that_are_certain() -> None:
    world = random_world(14, 14, ThreatPattern("scattered", 4, (0.1, 0.2), 3), threats=0.3)
    plan = mrac.plan(world, 3)
    loop = compile_closed_loop(plan, world)
    fine, coarse = (Tree(Runner(loop, 0, 4).grow(WHOLE, WHOLE // of, 10**7), WHOLE // of) for of in (10**12, 1000))
    assert coarse.left > 10 * SLACK > 0
    sampled = mrac.evaluate(world, plan, rollouts=64, exact="never", **QUIET).figures
    exact, wide = sampled.with_tree(fine), sampled.with_tree(coarse)
    assert exact.losses.half_width == 0 and wide.time == sampled.time
    for one, other in zip(exact.visited.at_least.values(), wide.visited.at_least.values(), strict=True):
        assert other.ci95[0] <= one.ci95[0] <= one.ci95[1] <= other.ci95[1]
        assert one.columns()[1] == "exact"
    assert wide.visited.at_least[0.75].columns()[1].endswith(", certain")
    assert wide.assured is not None and wide.assured <= exact.assured


def test_no_more_is_rolled_out_than_is_looked_at_where_all_is_known() -> None:
    """Whatever precision is asked for; but as many as asked for by number, or by what counts rollouts itself."""
    plan, ask = mrac.plan(WORLD, starts=STARTS), partial(mrac.evaluate, WORLD, **QUIET)
    known, sampled = (ask(plan, precision=2e-4, exact=exact) for exact in ("auto", "never"))
    assert known.tally.rollouts == TO_LOOK_AT < sampled.tally.rollouts
    assert not known.notes and known.control == {} != sampled.control
    assert ask(plan, rollouts=64).tally.rollouts == 64
    assert ask(plan, precision=2e-4, deadline=4).tally.rollouts == sampled.tally.rollouts


def test_how_a_mission_ends_is_said_in_words() -> None:
    """One row a way to end; the limit of a plan with a deadline is the deadline."""
    world = World.create([[0, 0.1, 0, 0, 0.5, 0]])
    for asked, row in (
        ({"deadline": 3}, "chance that it is cut off at the deadline"),
        ({"max_steps": 3}, "chance that it is cut off at the step limit"),
        ({"range": 3}, "chance that it ends because no robot can go on"),
        ({"policy": "per_cell", "robot_value": 10}, "chance that it ends because the rest is not worth the risk"),
    ):
        answer = mrac.evaluate(world, mrac.plan(world, 1, **asked), rollouts=64, **QUIET)
        shown = as_text(lambda console, answer=answer: print_report(report(answer), console))
        assert [line for line in shown.splitlines() if row in line], shown


def test_one_robot_s_loops_are_one() -> None:
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS[:1]), rollouts=20_000, **QUIET)
    exact, tally = answer.to_json()["exact"], answer.tally
    assert exact["time"] == answer.time.mean == pytest.approx(exact["open_loop"]["time"], abs=1e-6)
    assert exact["alive"] == pytest.approx(exact["open_loop"]["alive"], abs=1e-6)
    assert abs(exact["time"] - tally.time @ np.arange(len(tally.time)) / tally.rollouts) < 0.1


def test_a_robot_that_waits_before_it_gives_up_has_no_exact_time() -> None:
    """It ends two steps after its last move: the open loop's time is not the closed loop's."""
    world = World.create([[0, 0, 0.5, 0]])
    answer = mrac.evaluate(world, mrac.plan(world, 1, policy="per_cell", robot_value=100), rollouts=16, **QUIET)
    assert answer.plan.outcome == "not_worth_the_risk"
    assert answer.to_json()["exact"]["time"] is None


def test_what_is_not_known_of_the_closed_loop_is_null() -> None:
    """A team under hazards, and one on maps in doubt: the open loop's values have a name of their own."""
    q = np.where(np.nan_to_num(WORLD.threat) > 0, 0.5, 0.0)
    for world in (WORLD.with_latent_hazard("persistent", q, 0.5), WORLD.with_maps([WORLD.threat, WORLD.threat])):
        said = mrac.evaluate(world, mrac.plan(world, starts=STARTS), rollouts=256, **QUIET).to_json()
        assert said["exact"]["alive"] is said["exact"]["time"] is said["losses"]["exact"] is None
        assert said["exact"]["closed_loop"] is None
        assert said["exact"]["open_loop"]["losses"] > 0
        assert said["losses"]["ci95"][0] < said["losses"]["ci95"][1]


def test_by_a_step_at_which_every_run_has_ended_nothing_is_said_twice() -> None:
    world = World.create([[0.0, 0.6, 0.0, 0.9], [0.0, 0.0, 0.1, 0.0]])
    plan = mrac.plan(world, 2, return_to="home")
    over, before = (mrac.evaluate(world, plan, rollouts=200, deadline=steps, advice=False) for steps in (40, 3))
    assert not any("By step" in line for line in report(over).findings)
    deadline, told = over.to_json()["deadline"], over.to_json()
    assert deadline["visited"]["mean"] == pytest.approx(told["best"]["visited"]["mean"])
    assert deadline["losses"]["mean"] == pytest.approx(told["losses"]["mean"])
    assert told["some_left"]["ci95"][0] == pytest.approx(told["some_left"]["ci95"][1])
    loop = mrac.evaluate(world, mrac.plan(world, 2), rollouts=200, deadline=3, loop="open", advice=False)
    visited, _ = loop.closed_form.by_deadline(3)
    assert f"By step 3: {percent(visited / 8, 2)} (exact) visited" in report(loop).findings[0]
    assert "deadline" in before.to_json()


def test_the_chance_that_a_robot_is_left_is_always_in_the_json() -> None:
    world = World.create([[0.0, 0.3, 0.2, 0.1]])
    sampled = mrac.evaluate(world, mrac.plan(world, 2), rollouts=300, exact="never", advice=False)
    left, count = sampled.to_json()["some_left"], int(sampled.tally.alive[1:].sum())
    assert left["mean"] == count / 300 and left["ci95"][0] < left["mean"] < left["ci95"][1]
    known = mrac.evaluate(world, mrac.plan(world, 2), rollouts=300, loop="open", advice=False)
    assert known.to_json()["some_left"]["mean"] == pytest.approx(1 - np.prod(1 - known.closed_form.survival))


# Trees of all that can happen: against an independent enumeration, the oracle's, and rollouts.


def mean(masses: np.ndarray) -> float:
    return float(masses.astype(float) @ np.arange(len(masses))) / WHOLE


@pytest.mark.parametrize("name", NAMES)
def test_expectations_are_those_of_an_independent_enumeration(name: str) -> None:
    world, exact = world_of(name), known(name)["exact"]
    loop = compile_closed_loop(make_plan(world, world.starts), world)
    tree = grow_tree(loop, 1e-7, 10**6)
    for figure in ("visited", "survived"):
        low, high = tree.covered(figure)
        assert low - 1e-8 <= exact[figure] <= high + 1e-8
        assert high - low <= 1e-7
    low, high = tree.alive()
    assert low - 1e-8 <= exact["alive"] <= high + 1e-8
    assert mean(tree.counts.time) == pytest.approx(exact["time"], abs=1e-5)


CASES: tuple[tuple[int, dict[str, Any], bool], ...] = (
    (2, {}, False), (3, {}, True), (2, {"policy": "per_cell"}, False), (2, {"range": 12}, False),
)  # fmt: skip


@pytest.mark.parametrize(("robots", "settings", "first_only"), CASES)
def test_trees_are_what_the_oracle_enumerates(robots: int, settings: dict[str, Any], first_only: bool) -> None:
    world = random_world(4, 5, ThreatPattern("scattered", 3, (0.1, 0.3), 5), obstacles=0.1, threats=0.3)
    starts = place_starts(world, robots)[0]
    plan = make_plan(world, starts, Settings(**settings))
    oracle: Any = SimpleNamespace(**ANSWERS["range"])
    if "range" not in settings:  # robots with a range are not the plain oracle's
        oracle = closed_loop_exact(plan, world, first_only=first_only)
    tree = grow_tree(compile_closed_loop(plan, world, first_only=first_only), 1e-7, 10**6)
    for figure in ("visited", "survived"):
        low, high = tree.covered(figure)
        assert low - 1e-5 <= getattr(oracle, figure) <= high + 1e-5
    counts = tree.counts
    assert counts.visited.sum() + counts.left_visited.sum() == WHOLE
    for mine, theirs in ((counts.visited, oracle.visited_chance), (counts.survived, oracle.survived_chance)):
        assert np.abs(mine / WHOLE - np.array(theirs)).max() <= tree.left + 1e-6
    assert np.abs(counts.alive / WHOLE - np.array(oracle.alive_chance)).max() <= tree.left + 1e-6
    for share in (0.05, 0.5, 0.95):
        low, high = tree.quantile("visited", share)
        assert sum(oracle.visited_chance[: low + 1]) >= share - tree.left - 1e-6
        assert high == low
        assert low == 0 or sum(oracle.visited_chance[:low]) < share + 1e-6
    assert tree.chance_complete() == pytest.approx([oracle.complete] * 2, abs=tree.left + 1e-6)
    for outcome in (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS):
        sure = float(counts.outcomes[outcome]) / WHOLE
        assert sure == pytest.approx(getattr(oracle, outcome.word), abs=tree.left + 1e-6)


def test_a_tree_is_what_rollouts_come_to_cell_by_cell() -> None:
    world = random_world(12, 12, ThreatPattern("contiguous", 5, (0.05, 0.1, 0.2), 3))
    plan = make_plan(world, place_starts(world, 2)[0])
    loop = compile_closed_loop(plan, world)
    tree, count = grow_tree(loop, SLACK * len(loop.cells), 10**6), 100_000
    tally = run_range(loop, 6, 0, count)[0]
    low, high = tree.covered("visited")
    middle = float(tally.visited @ np.arange(len(tally.visited))) / count
    se = float(np.sqrt(tally.visited @ (np.arange(len(tally.visited)) - middle) ** 2)) / count
    assert low - 5 * se <= middle <= high + 5 * se
    for figure in ("visited", "survived"):
        low, high = tree.cells(figure)
        found = getattr(tally, f"covered_{figure}")[loop.cells] / count
        assert (low - 5 * np.sqrt(low * (1 - low) / count) <= found).all()
        assert (found <= high + 5 * np.sqrt(high * (1 - high) / count)).all()
        assert (high - low <= 2 * tree.left).all()
    low, high = tree.visits()
    visits, most = tally.visits[loop.cells] / count, 5 * np.sqrt(9 / count)
    assert ((low - most <= visits) & (visits <= high + most)).all()
    stops = tally.stops[loop.cells] / count
    assert np.abs(stops - tree.counts.stops / WHOLE).max() <= 5 * np.sqrt(2 / count) + tree.left


def test_what_is_left_out_is_between_least_and_most() -> None:
    world = random_world(14, 14, ThreatPattern("scattered", 4, (0.1, 0.2), 3), threats=0.3)
    loop = compile_closed_loop(make_plan(world, place_starts(world, 3)[0]), world)
    fine, coarse = grow_tree(loop, 1e-4, 10**7), grow_tree(loop, 1.0, 10**7)
    assert coarse.cut > fine.cut
    assert coarse.histories < fine.histories
    for figure in ("visited", "survived"):
        (low, high), (least, most) = fine.covered(figure), coarse.covered(figure)
        assert least <= low <= high <= most
        assert most - least <= 1.0
        for share in (0.05, 0.5, 0.95):
            (low, high), (least, most) = fine.quantile(figure, share), coarse.quantile(figure, share)
            assert least <= low <= high <= most
    for point, wide in (
        *((fine.cells(figure), coarse.cells(figure)) for figure in ("visited", "survived")),
        (fine.visits(), coarse.visits()), (fine.chance_complete(), coarse.chance_complete()),
        (fine.chance_left(), coarse.chance_left()),
    ):  # fmt: skip
        assert (wide[0] <= point[0]).all()
        assert (point[0] <= point[1]).all()
        assert (point[1] <= wide[1]).all()
    assert grow_tree(loop, 1e-4, fine.histories // 10) is None


def test_nothing_is_left_out_of_teams_of_two() -> None:
    world = random_world(20, 20, ThreatPattern("scattered", seed=1))
    loop = compile_closed_loop(make_plan(world, place_starts(world, 2)[0]), world)
    tree = grow_tree(loop, 1.0, 10**6)
    assert tree.left == 0
    assert tree.covered("visited")[0] == tree.covered("visited")[1]


def test_no_tree_is_grown_where_all_is_left_at_the_first_cut() -> None:
    world = random_world(20, 20, ThreatPattern(seed=1))
    loop = compile_closed_loop(make_plan(world, place_starts(world, 8)[0]), world)
    assert grow_tree(loop, 0.03, 10**9) is None


def test_no_tree_where_maps_are_in_doubt_or_teams_too_large() -> None:
    world = random_world(20, 20, ThreatPattern(seed=1))
    assert tree_for(make_plan(world, place_starts(world, 20)[0]), world) is None
    doubt = World.create([[0.0, 0.2, 0.0]]).with_latent_hazard("persistent", 0.5)
    assert tree_for(make_plan(doubt, [[0, 0]]), doubt) is None
    loop = compile_closed_loop(make_plan(doubt, [[0, 0]]), doubt)
    assert grow_tree(loop, 1.0, 1000) is None


@pytest.mark.usefixtures("full_effort")
def test_evaluate_says_what_a_tree_knows() -> None:
    world = random_world(20, 20, ThreatPattern("contiguous", seed=1))
    plan = make_plan(world, place_starts(world, 3)[0])
    said = mrac.evaluate(world, plan, rollouts=20_000, advice=False, engine="numba").to_json()
    exact, cells = said["exact"]["closed_loop"], said["cells"]["accessible"]
    assert exact["how"] == "tree"
    low, high = exact["visited"]
    assert 0 < high - low <= SLACK * cells
    assert said["coverage"]["visited"]["ci95"] == [said["coverage"]["visited"]["mean"]] * 2
    assert low / cells - 1e-12 <= said["coverage"]["visited"]["mean"] <= high / cells + 1e-12
    assert exact["histories"] > 10
    assert 0 < exact["mass_cut"] < 1e-6
    assert exact["cut"] == pytest.approx(1e-12)
    assert exact["seconds"] > 0
    low, high = exact["complete"]
    assert 0 <= low < high <= low + 1e-6
    assert said["complete"]["ci95"] == [low, high]
    robots = said["robots"]
    assert exact["losses"] == pytest.approx([robots - exact["alive"]] * 2, abs=0.001)
    assert set(exact["quantiles"]["visited"]) == {"0.05", "0.5", "0.95"}
    never = mrac.evaluate(world, plan, rollouts=64, exact="never", advice=False)
    assert never.to_json()["exact"]["closed_loop"] is None


def test_how_long_an_exact_value_is_looked_for() -> None:
    """Work, not a clock: a thousandth of a second is too little for three robots, wherever it is run."""
    world = random_world(20, 20, ThreatPattern("contiguous", seed=1))
    plan = make_plan(world, place_starts(world, 3)[0])
    assert tree_for(plan, world, seconds=0.001) is None
    fine, usual = tree_for(plan, world, slack=1e-7), tree_for(plan, world)
    assert fine.slack <= 1e-7 * 300 < usual.slack
    for wrong in ("always", 0, True):
        with pytest.raises(UsageError, match="exact"):
            mrac.evaluate(world, plan, exact=wrong)
    a, b = ((world, make_plan(world, place_starts(world, robots)[0])) for robots in (1, 3))
    assert mrac.compare(a, b, rollouts=64).exact_difference("visited") is not None
    assert mrac.compare(a, b, rollouts=64, exact="never").exact_difference("visited") is None


def test_large_teams_that_come_home_have_fewer_histories(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("analysis.estimators.trial.grow_tree", lambda loop, slack, most, cheap: asked.append(most))
    world = mrac.load(np.full((6, 8), 0.05))
    for robots, home in ((8, None), (8, "home"), (32, None), (32, "home")):
        tree_for(mrac.plan(world, robots, range=60, return_to=home), world)
    assert asked[0] == asked[1]
    assert asked[2] == pytest.approx(asked[0] / 4, abs=1) and asked[3] == pytest.approx(asked[0] / 64, abs=1)
