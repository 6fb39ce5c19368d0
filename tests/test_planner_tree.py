"""Trees of all that can happen: against an independent enumeration, the readable one, and rollouts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracle_tree import closed_loop_exact
from test_planner_luck import NAMES, known, world_of

import mrac_jax as mrac
from analysis.estimators.trial import SLACK, closed_tree
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.simulator.exact_tree import WHOLE, grow_tree
from planner.tally import Outcome
from planner.world.changing_maps import with_hazard
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World


def mean(masses: np.ndarray) -> float:
    return float(masses.astype(float) @ np.arange(len(masses))) / WHOLE


@pytest.mark.parametrize("name", NAMES)
def test_expectations_are_those_of_an_independent_enumeration(name: str) -> None:
    world, exact = world_of(name), known(name)["exact"]
    loop = compile_closed_loop(make_plan(world, world.starts), world)
    tree = grow_tree(loop, 1e-7, 10**6)
    assert tree is not None
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
def test_trees_are_what_the_readable_simulator_enumerates(
    robots: int, settings: dict[str, Any], first_only: bool
) -> None:
    world = random_world(4, 5, ThreatPattern("scattered", 3, (0.1, 0.3), 5), obstacles=0.1, threats=0.3)
    plan = make_plan(world, place_starts(world, robots)[0], Settings(**settings))
    oracle = closed_loop_exact(plan, world, first_only=first_only)
    tree = grow_tree(compile_closed_loop(plan, world, first_only=first_only), 1e-7, 10**6)
    assert tree is not None
    for figure in ("visited", "survived"):
        low, high = tree.covered(figure)
        assert low - 1e-5 <= getattr(oracle, figure) <= high + 1e-5
    counts = tree.counts
    assert counts.visited.sum() + counts.left_visited.sum() == WHOLE
    for mine, theirs in ((counts.visited, oracle.visited_chance), (counts.survived, oracle.survived_chance)):
        assert np.abs(mine / WHOLE - theirs).max() <= tree.left + 1e-6
    assert np.abs(counts.alive / WHOLE - oracle.alive_chance).max() <= tree.left + 1e-6
    for share in (0.05, 0.5, 0.95):
        low, high = tree.quantile("visited", share)
        assert oracle.visited_chance[: low + 1].sum() >= share - tree.left - 1e-6
        assert high == low
        assert low == 0 or oracle.visited_chance[:low].sum() < share + 1e-6
    assert tree.chance_complete() == pytest.approx([oracle.complete] * 2, abs=tree.left + 1e-6)
    for outcome in (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS):
        sure = float(counts.outcomes[outcome]) / WHOLE
        assert sure == pytest.approx(getattr(oracle, outcome.word), abs=tree.left + 1e-6)


def test_a_tree_is_what_rollouts_come_to_cell_by_cell() -> None:
    world = random_world(12, 12, ThreatPattern("contiguous", 5, (0.05, 0.1, 0.2), 3))
    plan = make_plan(world, place_starts(world, 2)[0])
    loop = compile_closed_loop(plan, world)
    tree, count = grow_tree(loop, SLACK * len(loop.cells), 10**6), 100_000
    assert tree is not None
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
    assert fine is not None
    assert coarse is not None
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
    assert tree is not None
    assert tree.left == 0
    assert tree.covered("visited")[0] == tree.covered("visited")[1]


def test_no_tree_is_grown_where_all_is_left_at_the_first_cut() -> None:
    world = random_world(20, 20, ThreatPattern(seed=1))
    loop = compile_closed_loop(make_plan(world, place_starts(world, 8)[0]), world)
    assert grow_tree(loop, 0.03, 10**9) is None


def test_no_tree_where_maps_are_in_doubt_or_teams_too_large() -> None:
    world = random_world(20, 20, ThreatPattern(seed=1))
    assert closed_tree(make_plan(world, place_starts(world, 20)[0]), world) is None
    doubt = with_hazard(World.create([[0.0, 0.2, 0.0]]), "persistent", 0.5)
    assert closed_tree(make_plan(doubt, [[0, 0]]), doubt) is None
    loop = compile_closed_loop(make_plan(doubt, [[0, 0]]), doubt)
    assert grow_tree(loop, 1.0, 1000) is None


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
    assert (
        mrac.evaluate(world, plan, rollouts=64, exact="never", advice=False).to_json()["exact"]["closed_loop"] is None
    )


def test_how_long_an_exact_value_is_looked_for() -> None:
    """Work, not a clock: a thousandth of a second is too little for three robots, wherever it is run."""
    world = random_world(20, 20, ThreatPattern("contiguous", seed=1))
    plan = make_plan(world, place_starts(world, 3)[0])
    assert closed_tree(plan, world, seconds=0.001) is None
    fine, usual = closed_tree(plan, world, slack=1e-7), closed_tree(plan, world)
    assert fine is not None
    assert usual is not None
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
    world = mrac.load("example:paper")
    for robots, home in ((8, None), (8, "home"), (32, None), (32, "home")):
        closed_tree(mrac.plan(world, robots, range=60, return_to=home), world)
    assert asked[0] == asked[1]
    assert asked[2] == pytest.approx(asked[0] / 4, abs=1) and asked[3] == pytest.approx(asked[0] / 64, abs=1)
