"""`mrac-jax reproduce policies`: the right maps, the same luck, what is worse, and its faces."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import analysis.experiments.policies
from analysis.cli.app import run
from analysis.experiments.policies import (
    FRONT_TEAMS,
    KINDS,
    ON_LARGE,
    SMALL,
    TEAMS,
    Setting,
    Study,
    bound_of,
    headline,
    report,
    study_json,
    study_policies,
)
from analysis.report.answer import print_report
from analysis.statistics.estimates import mean_estimate
from analysis.sweeps.engine import Finished
from analysis.sweeps.store import Store
from analysis.theory.upper_bound import any_strategy
from analysis.utils.folder import as_text
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts

FEW = (
    Setting("contiguous", 2), Setting("contiguous", 2, "per_cell", 0.25), Setting("contiguous", 2, cut=20),
    Setting("contiguous", 4),
)  # fmt: skip


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three settings, none on large maps, bounds of one team."""
    room = analysis.experiments.policies
    for name, value in {"SMALL": FEW, "ON_LARGE": (), "KINDS": ("contiguous",), "TEAMS": (2,)}.items():
        monkeypatch.setattr(room, name, value)


@pytest.mark.usefixtures("few")
def test_columns_are_those_of_the_maps_rolled_out_by_hand(tmp_path: Path) -> None:
    with Store.open(tmp_path / "s.db") as store:
        study = study_policies(maps=2, rollouts=30, seed=5, store=store, processes=1)
        again = study_policies(maps=2, rollouts=30, seed=5, store=store, processes=1)
    assert again.finished.rollouts == 0
    for number, seed in enumerate((5, 6)):
        world = random_world(pattern=ThreatPattern("contiguous", seed=seed))
        for setting in FEW:
            starts = place_starts(world, setting.robots)[0]
            settings = Settings(policy=setting.policy, reserve=setting.reserve, max_steps=setting.cut)
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
    assert study.bounds["contiguous", 2][0] == bound_of(("contiguous", 2, 5))


def made_up(maps: int = 4) -> Study:
    """Of every setting: `per_cell` covers 5 points more than `mrac`, but for one map of one team, and loses fewer."""
    columns = {}
    for setting in SMALL + ON_LARGE:
        visited = np.linspace(0.5, 0.6, maps) + 0.05 * (setting.policy != "mrac")
        if setting == Setting("scattered", 8, "per_cell"):
            visited[maps // 4] -= 0.08
        losses = np.full(maps, setting.robots * (0.5 if setting.worth else 1.0))
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
    assert left is not None
    assert left.mean == pytest.approx(0.9 - 0.55)
    assert study.gain(Setting("scattered", 4, "per_cell")).half_width == pytest.approx(0, abs=1e-12)


def test_its_faces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = made_up()
    assert headline(study) == (
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
    assert {row["worth"] for row in rows} >= {"", "160.0"}
    page = (tmp_path / "out" / "index.html").read_text()
    assert "What policies bring" in page
    alone = made_up(maps=1)
    assert json.loads(json.dumps(study_json(alone)))["points"][0]["visited"]["ci95"] is None
    monkeypatch.setattr("analysis.experiments.policies.FRONT_TEAMS", FRONT_TEAMS[:1])
    assert alone.save(tmp_path / "alone")


def test_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="maps=0"):
        study_policies(maps=0, rollouts=1)
    with pytest.raises(UsageError, match="seed=-1"):
        study_policies(maps=1, rollouts=1, seed=-1)
    assert run(["reproduce", "policy"]) == 2
    assert "expected fig4 or fig5 or fig6 or fig7 or all or policies" in capsys.readouterr().err
