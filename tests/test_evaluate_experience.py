"""`evaluate` of robots that learn about hazards: beside told and blind ones on the same luck, and what they know."""

import json

import numpy as np
import pytest

import mrac_jax as mrac
from analysis.estimators.racing import told_of_hazards
from analysis.evaluation.outputs.information import entropy_of
from analysis.evaluation.report import report
from planner.errors import UsageError
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import is_certain
from planner.rollout_sampling import hazards_met
from planner.world.generate import ThreatPattern, random_world

SITE = random_world(7, 7, ThreatPattern("scattered", 3, (0.1, 0.3), 5), obstacles=0.1, threats=0.4)
Q = np.nan_to_num(np.array(SITE.threat)) * 2
QUIET = {"advice": False, "band": False, "engine": "numba"}


def test_three_teams_on_the_same_luck_and_what_is_known_in_the_end(tmp_path):
    world = mrac.with_hazard(SITE, "persistent", Q, 0.5, learn=True)
    answer = mrac.evaluate(world, 2, rollouts=300, seed=4, **QUIET)
    found = answer.outputs["experience"]
    said = json.loads(json.dumps(answer.to_json()))["experience"]
    blind = mrac.evaluate(mrac.with_hazard(SITE, "persistent", Q, 0.5), 2, rollouts=300, seed=4, **QUIET)
    assert (found.blind.tally.visited == blind.tally.visited).all()
    assert (found.learning.tally.visited == answer.tally.visited).all()
    ahead = found.learning.column("visited") - found.blind.column("visited")
    np.testing.assert_allclose(said["worth_of_learning"]["mean"], ahead.mean() / answer.tally.accessible)
    # a rollout of the told ones, by hand: its own map, planned for and rolled out
    there = hazards_met(world.doubt, 4, [7])[0].reshape(SITE.shape)
    told = mrac.with_hazard(SITE, "persistent", np.where(there, 1.0, 0.0), 0.5)
    run = ReferenceLoop(mrac.plan(told, starts=answer.plan.starts), told).run(4, 7)
    assert found.told.column("visited")[7] == run.visited.sum()
    assert (said["maps"], said["rollouts"], said["posterior"]["rollouts"]) == (128, 300, 256)
    bits = said["posterior"]["entropy"]
    np.testing.assert_allclose(bits["before"], entropy_of(Q)[found.reach].mean(), rtol=1e-6)
    assert 0 < bits["after"] < bits["before"]
    assert np.abs(found.posterior - found.prior)[found.reach].max() < 5 * 0.5 / np.sqrt(256)
    files = answer.save(tmp_path)
    assert {"posterior.png", "entropy.png"} <= {path.name for path in files}
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(tmp_path / "posterior.tif") as data:
        assert data.descriptions == ("prior", "posterior", "entropy")
        np.testing.assert_allclose(data.read(2), np.where(SITE.free, found.posterior, np.nan), rtol=1e-6)


def test_sure_stops_are_told_too_and_consumed_ones_vanish():
    for kind in ("persistent", "consumed"):
        world = mrac.with_hazard(SITE, kind, Q, 1.0, learn=True)
        plan = mrac.plan(world, 2)
        told = told_of_hazards(world, plan, mrac.evaluate(world, plan, rollouts=50, **QUIET).choices, 20)
        assert told.rollouts == 20
        assert told.tally.visited @ np.arange(len(told.tally.visited)) / 20 > 10


def test_who_has_nothing_to_learn_is_told_and_blind_alike():
    world = mrac.with_hazard(SITE, "persistent", np.where(Q > 0.3, 1.0, 0.0), 0.4, learn=True)
    found = mrac.evaluate(world, 2, rollouts=64, **QUIET).outputs["experience"]
    for other in (found.told, found.blind):
        assert (other.column("visited") == found.learning.column("visited")).all()
    assert found.bits == (0.0, 0.0)


def test_who_hears_nothing_may_take_what_the_plan_left_out():
    q = np.array([[0, 0, 0], [0, 0, 0.5]])
    world = mrac.with_hazard(mrac.load(np.zeros((2, 3))), "persistent", q, 0.5, learn=True)
    world = mrac.with_sense(world, {"range": 2, "detect": 0.9, "false_alarm": 0.1})
    plan = mrac.plan(world, starts=[[0, 0]], policy="per_cell", worth=20)
    assert is_certain(world, plan, "open") and not is_certain(world, plan)
    answer = mrac.evaluate(world, plan, rollouts=300, **QUIET)
    assert answer.tally.rollouts == 300 and 50 < answer.tally.visited[6] < 250
    assert answer.exact.visited is None and answer.visited.mean * 6 == 5 + answer.tally.visited[6] / 300


def test_others_have_no_such_figure():
    with pytest.raises(UsageError, match="learn about hazards"):
        mrac.evaluate(SITE, 2, rollouts=10, experience=True, **QUIET)
    world = mrac.with_hazard(SITE, "persistent", Q, 0.5, learn=True)
    answer = mrac.evaluate(world, 2, rollouts=10, loop="open", **QUIET)
    assert "experience" not in answer.outputs
    assert "learning is worth" not in report(answer).headline
