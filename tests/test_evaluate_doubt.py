"""`evaluate` where the map is in doubt: doubt about the map apart from luck, what is not known, what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from doubt import expected, one_of, open_loop

import mrac_jax as mrac
from analysis.evaluation.report import report
from analysis.report.answer import print_report
from analysis.report.picture import figure_of
from planner.errors import InputError
from planner.world.world import World

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
    assert said["bounds"]["ideal_team"] is said["bounds"]["theorem3"]["visited"]["travel_set"] is None
    assert said["verdicts"] == {}
    total = doubt["sd"]["maps"] ** 2 + doubt["sd"]["luck"] ** 2
    cells = np.arange(9) / 8
    mean = answer.tally.visited @ cells / 4096
    np.testing.assert_allclose(total, answer.tally.visited @ (cells - mean) ** 2 / 4096, rtol=1e-3)
    assert figure_of(report(answer), "doubt.png").axes


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
        return mrac.with_maps(ROW, [[[0, p, 0, 0.3, 0, 0]] for p in first]), parts_of(first, np.full(128, 0.3))
    if kind == "alike":
        return mrac.with_maps(ROW, [ROW.threat] * 100), parts_of(*np.array([[0.1], [0.3]]))
    world = mrac.with_spread(ROW, "lognormal", 0.8, kind)
    first, second = (world.doubt.chances[:, world.doubt.column[0, cell]] for cell in (1, 3))
    pairs = (first, second) if kind == "common" else (np.repeat(first, 256), np.tile(second, 256))
    return world, parts_of(*pairs)


KINDS = {"antithetic": (128, 128), "alike": (100, 100), "common": (256, 256), "level": (256, 65536)}
"""Maps behind the answer, at most, and in all."""


@pytest.mark.parametrize("seeds", [6, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_doubt_and_luck_are_told_apart(kind: str, seeds: int) -> None:
    """Both parts from 4,096 rollouts: variances right on average, intervals hold in 94 % within 2 standard errors."""
    world, truth = doubtful(kind)
    held, variances = np.zeros(2), []
    for seed in range(seeds):
        said = mrac.evaluate(world, 1, seed=seed, **(QUIET | {"rollouts": 4096})).to_json()["map_doubt"]
        assert 0.98 * KINDS[kind][0] <= said["maps"] <= KINDS[kind][0] and said["of"] == KINDS[kind][1]
        for at, name in enumerate(("maps", "luck")):
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
    doubt = answer.outputs["map_doubt"]
    assert doubt.means.std() == pytest.approx(doubt.parts.between.mean) == pytest.approx(truth[0], rel=0.05)
    assert abs(doubt.means.mean() - answer.tally.visited @ np.arange(7) / 6 / 20_000) < 0.005
    assert "256 maps, 20,000 rollouts" in doubt.chart().title + doubt.blocks().notes[0]
    few = mrac.evaluate(world, 1, **(QUIET | {"rollouts": 100})).outputs["map_doubt"]
    assert few.behind == "64 maps drawn of 256, 1,024 rollouts"
    drawn = mrac.evaluate(doubtful("level")[0], 1, loop="open", **QUIET).outputs["map_doubt"]
    assert drawn.behind == "1,024 maps drawn of 65,536, exact on each"
    assert drawn.parts.between.ci95[0] < doubtful("level")[1][0] < drawn.parts.between.ci95[1]


def test_what_is_not_known_is_null_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.console import Console

    mines = mrac.with_hazard(BASE, "consumed", np.nan_to_num(BASE.threat), 0.9)
    answer = mrac.evaluate(mines, 2, loop="open", **QUIET)
    said = answer.to_json()
    assert set(said["exact"]["open_loop"].values()) == {None}
    assert "map_doubt" not in said
    assert answer.losses.ci95[0] < answer.losses.ci95[1]
    print_report(report(answer, theory=True), Console(width=120))
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert "presume one known map" in printed


@pytest.mark.parametrize("refused", ["check", "size", "starts", "clear", "threat_scale"])
def test_what_presumes_one_known_map_is_refused(refused: str) -> None:
    world = mrac.with_spread(BASE, "lognormal", 0.3)
    ask = {
        "check": lambda: mrac.check(world, 1),
        "size": lambda: mrac.size(world, target=0.5),
        "starts": lambda: mrac.starts(world, 1),
        "clear": lambda: mrac.clear(world, 1),
        "threat_scale": lambda: mrac.evaluate(world, 1, threat_scale=[2.0], **QUIET),
    }
    with pytest.raises(InputError, match="one known map"):
        ask[refused]()


@pytest.mark.parametrize("asked", [{"metrics": "search"}, {"threat_scale": [2.0]}, {}])
def test_what_is_refused_is_refused_before_anything_is_planned(asked: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    def plan(*given: object, **more: object) -> None:
        raise AssertionError("planned")

    monkeypatch.setattr("analysis.api.plans.plan_team", plan)
    world = mrac.with_spread(BASE, "lognormal", 0.3)
    world = world if asked else world.with_values(2.0)
    with pytest.raises(InputError, match="one known map"):
        mrac.evaluate(world, 1, **asked, **QUIET)
