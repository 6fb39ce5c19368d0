"""How wrong may the threat map be? The same plan under scaled threats."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import FOLDER, load_fixture
from oracle_tree import closed_loop_exact

from analysis.cli.app import run
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.outputs.what_if import parse_scales, scaled_threats
from analysis.sampling import RolloutChoices
from analysis.theory.exact import open_loop_exact
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.tally import Outcome
from planner.world.levels import place_starts
from planner.world.world import World

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
COUNTS = ("visited", "survived", "time", "alive", "outcomes", "stops", "visits")


@pytest.mark.parametrize("loop", ["closed", "open"])
def test_the_map_s_own_threats_change_nothing(loop) -> None:
    world = load_fixture("scattered-14x23-1000-k8").world
    plan = make_plan(world, place_starts(world, 8)[0])
    answer = evaluate(world, plan, RolloutChoices(loop=loop, rollouts=2048, seed=9), threat_scale=(1.0,))
    for name in COUNTS:
        assert np.array_equal(
            getattr(answer.outputs["threat_scale"].scaled[0].tally, name), getattr(answer.tally, name)
        ), name
    assert answer.outputs["threat_scale"].scaled[0].exact.visited == answer.closed_form.visited


@pytest.mark.usefixtures("few_lanes")
@pytest.mark.parametrize("engine", ["numba", "jax"])
def test_no_threats_lose_nobody_and_more_lose_more(engine) -> None:
    world = World.create(np.where(np.indices((5, 6)).sum(axis=0) % 3 == 1, 0.2, 0.0))
    plan = make_plan(world, [[0, 0], [4, 5], [0, 5]])
    choices = RolloutChoices(rollouts=1024, seed=4, engine=engine)
    answer = evaluate(world, plan, choices, threat_scale=(0.0, 0.5, 1.0, 4.9))
    none, *others = (scaled.tally for scaled in answer.outputs["threat_scale"].scaled)
    assert none.rollouts == none.outcomes[Outcome.COMPLETE] == none.alive[3] == 1  # every run is the same: one is run
    means = [tally.alive @ np.arange(4) / 1024 for tally in others]
    assert means == sorted(means, reverse=True) and means[0] > means[1] > means[2]


def test_the_open_loop_is_the_closed_form_of_those_threats() -> None:
    world = load_fixture("contiguous-14x23-1000-k2").world
    plan = make_plan(world, place_starts(world, 2)[0])
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=65_536, seed=3), threat_scale=(0.5, 2.0))
    for scaled in answer.outputs["threat_scale"].scaled:
        threats = World.create(world.threat * np.float32(scaled.scale))
        exact = open_loop_exact(plan, threats)
        assert scaled.exact.visited == pytest.approx(exact.visited, rel=1e-6)
        counts = scaled.tally.visited
        values = np.arange(len(counts))
        mean = counts @ values / 65_536
        se = np.sqrt(counts @ (values - mean) ** 2) / 65_536
        assert abs(mean - exact.visited) <= 4 * se


def test_the_closed_loop_decides_by_the_map_and_loses_by_the_scale() -> None:
    """With one level of threat, twice the threat is another map with the same plan: its enumeration is the truth."""
    threat = np.zeros((4, 6), dtype=np.float32)
    threat[1:3, 1:5] = 0.125
    world, twice = World.create(threat), World.create(2 * threat)
    starts = [[0, 0], [3, 5]]
    plan, other = make_plan(world, starts), make_plan(twice, starts)
    assert [r.path.tolist() for r in plan.robots] == [r.path.tolist() for r in other.robots]
    answer = evaluate(world, plan, RolloutChoices(rollouts=65_536, seed=6), threat_scale=(2.0,))
    truth = closed_loop_exact(other, twice).visited
    counts = answer.outputs["threat_scale"].scaled[0].tally.visited
    values = np.arange(len(counts))
    mean = counts @ values / 65_536
    assert abs(mean - truth) <= 4 * np.sqrt(counts @ (values - mean) ** 2) / 65_536


def test_the_command_and_its_errors(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", WORLD, "--robots", "4", "--rollouts", "512", "--exact", "never", "--threat-scale"]
    assert run([*words, "0.5,1,2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [entry["scale"] for entry in found["threat_scale"]] == [0.5, 1, 2]
    assert found["threat_scale"][1]["coverage"] == found["coverage"]
    assert run([*words, "2"]) == 0
    assert "so many times the map's" in capsys.readouterr().out
    for wrong in ("", "x", "1,,2", "-1", "nan", "inf"):
        assert run([*words, wrong]) == 2
        assert capsys.readouterr().err.startswith("error: --threat-scale")
    assert run([*words, "6"]) == 2
    assert "a scale of at most 4.99" in capsys.readouterr().err
    with pytest.raises(UsageError, match="100 at most"):
        parse_scales(",".join(["1"] * 101))
    with pytest.raises(UsageError, match=r"a scale of at most 1\.99"):
        scaled_threats(World.create([[0.5, 0.0]]), 2.0)
