"""`evaluate` where the map is in doubt: doubt about the map apart from luck, what is not known, what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from doubt import expected, one_of, open_loop

import mrac_jax as mrac
from analysis.evaluation.pictures import doubt_figure
from analysis.evaluation.table import print_evaluation
from planner.errors import InputError
from planner.worlds.world import World

BASE = World.create([[0.0, 0.2, 0.0], [0.0, np.nan, 0.1], [0.0, 0.0, 0.3]])
MAPS = [BASE.threat, 0 * BASE.threat, np.where(BASE.threat > 0.15, np.float32(0.7), BASE.threat)]
QUIET = {"advice": False, "band": False, "rollouts": 4096, "engine": "numba"}


def test_the_open_loop_is_exact_on_each_map() -> None:
    world = mrac.with_maps(BASE, MAPS)
    plan = mrac.plan(world, 2)
    answer = mrac.evaluate(world, plan, loop="open", **QUIET)
    said = json.loads(json.dumps(answer.to_json()))
    play = open_loop(plan, world)
    means = np.sort([expected(play, one_of([one.ravel()]))[0] / answer.tally.accessible for one in MAPS])
    doubt = said["map_doubt"]
    assert (doubt["maps"], doubt["rollouts"]) == (3, 0)
    np.testing.assert_allclose(doubt["mean_of_means"], means.mean(), rtol=1e-9)
    np.testing.assert_allclose(list(doubt["quantiles"].values()), means, rtol=1e-9)
    assert abs(answer.tally.visited @ np.arange(9) / 4096 - 8 * means.mean()) < 5 * 8 / np.sqrt(4096)
    assert said["mode"] == "step"
    assert said["bounds"]["ideal_team"] is said["bounds"]["theorem3"]["visited"]["travel_set"] is None
    assert said["verdicts"] == {}
    total = doubt["sd"]["maps"] ** 2 + doubt["sd"]["luck"] ** 2
    cells = np.arange(9) / 8
    mean = answer.tally.visited @ cells / 4096
    np.testing.assert_allclose(total, answer.tally.visited @ (cells - mean) ** 2 / 4096, rtol=1e-3)
    assert doubt_figure(answer.outputs["map_doubt"]).axes


def test_what_is_not_known_is_null_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.console import Console

    mines = mrac.with_hazard(BASE, "consumed", np.nan_to_num(BASE.threat), 0.9)
    answer = mrac.evaluate(mines, 2, loop="open", **QUIET)
    said = answer.to_json()
    assert set(said["exact"]["open_loop"].values()) == {None}
    assert "map_doubt" not in said
    assert answer.losses.ci95[0] < answer.losses.ci95[1]
    print_evaluation(answer, Console(width=120), theory=True)
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert "presume one known map" in printed


@pytest.mark.parametrize("refused", ["check", "size", "starts", "clear", "threat_scale", "control_variate"])
def test_what_presumes_one_known_map_is_refused(refused: str) -> None:
    world = mrac.with_spread(BASE, "lognormal", 0.3)
    ask = {
        "check": lambda: mrac.check(world, 1),
        "size": lambda: mrac.size(world, target=0.5),
        "starts": lambda: mrac.starts(world, 1),
        "clear": lambda: mrac.clear(world, 1),
        "threat_scale": lambda: mrac.evaluate(world, 1, threat_scale=[2.0], **QUIET),
        "control_variate": lambda: mrac.evaluate(world, 1, control_variate=True, **QUIET),
    }
    with pytest.raises(InputError, match="one known map"):
        ask[refused]()


@pytest.mark.parametrize("asked", [{"metrics": "search"}, {"threat_scale": [2.0]}, {}])
def test_what_is_refused_is_refused_before_anything_is_planned(asked: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    def plan(*given: object, **more: object) -> None:
        raise AssertionError("planned")

    monkeypatch.setattr("analysis.api.plan_team", plan)
    world = mrac.with_spread(BASE, "lognormal", 0.3)
    world = world if asked else world.with_values(2.0)
    with pytest.raises(InputError, match="one known map"):
        mrac.evaluate(world, 1, **asked, **QUIET)
