"""`mrac-jax clear`: gains against the readable simulator, the gradient against differences, wrong input."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from page_reader import Reader

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.sampling import RolloutChoices
from analysis.search.place_reports import clear_findings, clear_headline
from analysis.search.threat_removal import Clearing, by_cell, find_clearing, threats_of
from analysis.theory.exact import coverage_gradient, open_loop_exact
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import simulate
from planner.rollout_sampling import Luck
from planner.settings import Settings
from planner.world.world import World

RISKS = np.zeros((6, 9))
RISKS[1:3, 3:7], RISKS[4:, 6:], RISKS[0, 8], RISKS[3, 2], RISKS[5, 0] = 0.2, 0.05, np.nan, np.nan, 0.2
WORLD = World.create(RISKS, starts=[[0, 0], [3, 0]])
RUNS = 24


@pytest.fixture(scope="module")
def small() -> Clearing:
    choices = RolloutChoices(rollouts=RUNS, seed=3, engine="numba", exact="never")
    return find_clearing(WORLD, WORLD.starts, Settings(), choices, count=2)


@cache
def by_the_readable_simulator(planned: World, true: World, ids: range) -> np.ndarray:
    """Cells visited, robots lost, value visited on average, planned on one map and hit on the other."""
    worth = np.ones(true.threat.size) if true.value is None else true.value.ravel()
    plan = make_plan(planned, WORLD.starts, Settings())
    problem = prepare(planned, plan.starts, plan.settings)
    runs = [simulate(problem, plan.areas, hit=Luck(true, 3, rollout).hits) for rollout in ids]
    return np.mean([[one.visited.sum(), (~one.alive).sum(), one.visited @ worth] for one in runs], axis=0)


def test_threats_are_connected_areas_of_one_level() -> None:
    remove, threats, notes = threats_of(WORLD, WORLD.starts, 16)
    assert remove == "areas" and not notes
    assert [(one.name, len(one.cells)) for one in threats] == [("area 0", 6), ("area 1", 8), ("area 2", 1)]
    assert [one.p for one in threats] == pytest.approx([0.05, 0.2, 0.2])
    without = threats[1].cleared(WORLD)
    assert (without.threat[1:3, 3:7] == 0).all() and without.threat[5, 0] == np.float32(0.2)
    assert np.isnan(without.threat[0, 8]) and WORLD.threat[1, 3] > 0


def test_gains_are_what_the_readable_simulator_says(small: Clearing) -> None:
    base = by_the_readable_simulator(WORLD, WORLD, range(RUNS))
    for one in small.options:
        cleared = one.threat.cleared(WORLD)
        assert one.known is not None and one.unknown.rollouts == RUNS
        start = by_the_readable_simulator(WORLD, WORLD, range(one.known.rollouts))
        for gain, planned, before in ((one.known, cleared, start), (one.unknown, WORLD, base)):
            after = by_the_readable_simulator(planned, cleared, range(gain.rollouts))
            assert gain.cells.mean == pytest.approx(after[0] - before[0])
            assert gain.robots.mean == pytest.approx(before[1] - after[1])
    first, second = small.turns
    assert len(second.options) == len(first.options) - 1 and first.picked.threat not in small.picks[1:]
    far = range(RUNS, 2 * RUNS)
    after, before = (by_the_readable_simulator(world, world, far) for world in (small.cleared_world, WORLD))
    assert small.gain is not None and small.gain.cells.mean == pytest.approx(after[0] - before[0])
    through = [one for one in first.options if one.known is not None and one.known.rollouts == RUNS]
    assert first.picked in through
    assert first.picked.known == max((one.known for one in through if one.known), key=lambda gain: gain.cells.mean)


def test_where_cells_are_worth_something_gains_are_in_value() -> None:
    value = np.where(np.arange(9) >= 5, 12.5, 1.0) * np.ones((6, 1))
    valued = WORLD.with_values(value)
    answer = find_clearing(
        valued, WORLD.starts, Settings(), RolloutChoices(rollouts=RUNS, seed=3, engine="numba", exact="never")
    )
    base = by_the_readable_simulator(valued, valued, range(RUNS))
    for one in answer.options:
        cleared = one.threat.cleared(valued)
        assert one.known is not None and one.known.value is not None and one.unknown.value is not None
        start = by_the_readable_simulator(valued, valued, range(one.known.rollouts))
        for gain, planned, before in ((one.known, cleared, start), (one.unknown, valued, base)):
            after = by_the_readable_simulator(planned, cleared, range(gain.rollouts))
            assert gain.cells.mean == pytest.approx(after[0] - before[0])
            assert gain.counted.mean == pytest.approx(after[2] - before[2], abs=1e-9)
    through = [one.known.counted.mean for one in answer.options if one.known and one.known.rollouts == RUNS]
    best = answer.turns[0].picked.known
    assert best is not None and best.counted.mean == max(through) and answer.unit == "of value"
    found = answer.to_json()
    assert found["value_gain"] == answer.gain.value.to_json() and found["threats"][0]["unknown"]["value"]  # type: ignore[union-attr]
    assert " of value " in clear_headline(answer)
    assert answer.gain is not None and answer.gain.counted.said(unit=" of value") in clear_headline(
        answer
    )  # fresh rollouts
    assert best.counted.said(unit=" of value") not in clear_headline(answer)


def test_the_gradient_is_that_of_the_closed_form() -> None:
    plan = make_plan(WORLD, WORLD.starts, Settings())
    gradient = coverage_gradient(plan, WORLD)
    step = 2.0**-7
    for row, col in [(0, 0), (0, 4), (1, 3), (2, 6), (4, 6), (5, 8), (5, 0), (3, 2)]:
        if np.isnan(WORLD.threat[row, col]):
            assert gradient[row, col] == 0
            continue
        threat = np.stack([WORLD.threat, WORLD.threat, WORLD.threat])
        threat[1:, row, col] += np.array([step, 2 * step], dtype=np.float32)
        at = [open_loop_exact(plan, replace(WORLD, threat=each)).visited for each in threat]
        slope = (-3 * at[0] + 4 * at[1] - at[2]) / (2 * step)  # of second order, from above: p >= 0
        assert gradient[row, col] == pytest.approx(slope, rel=2e-2, abs=1e-3)
    assert gradient.min() < -1


# The polygons, points and sites of a scenario.


def overlapping(folder: Path) -> str:
    """A field over the middle, a smaller one within it, a point beside both, a field where no robot gets to."""
    ground = np.zeros((6, 9))
    ground[:, 7] = np.nan
    World.create(ground).save(folder / "map.npz", force=True)
    fields = {"wide": (2, 1, 6, 4, 0.2), "inner": (3, 2, 5, 3, 0.5), "beyond": (8, 0, 9, 6, 0.4)}
    features = []
    for name, (west, south, east, north, p) in fields.items():
        corners = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        shape = {"type": "Polygon", "coordinates": [corners]}
        features.append({"type": "Feature", "properties": {"name": name, "p": p}, "geometry": shape})
    (folder / "fields.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    (folder / "points.csv").write_text("x,y,strength\n6.5,5.5,0.3\n")
    (folder / "site.yaml").write_text(
        "map: map.npz\nrobots: {starts: [[0, 0], [5, 0]]}\nthreats:\n- {polygons: fields.geojson}\n"
        "- {points: points.csv, falloff: {kind: disc, radius: 0.6}}\n"
    )
    return str(folder / "site.yaml")


def test_sources_are_cleared_one_by_one_and_what_overlaps_stays(tmp_path: Path) -> None:
    world = mrac.load(overlapping(tmp_path))
    answer = mrac.clear(world, remove="sources", rollouts=RUNS, seed=3, engine="numba", count=3)
    names = ["wide", "inner", "line 2 of points.csv"]
    assert [one.threat.name for one in answer.options] == names and "beyond" in world.sources.names  # type: ignore[union-attr]
    assert [one.threat.p for one in answer.options] == pytest.approx([0.2, 0.5, 0.3])
    assert " the other one (" in answer.turns[1].certainty("worth more")
    wide = answer.options[0].threat
    assert len(wide.cells) == 12 and wide.cleared(world).threat[3, 3] == np.float32(0.5)
    assert answer.options[1].threat.cleared(world).threat[3, 3] == np.float32(0.2)
    assert sorted(threat.name for threat in answer.picks) == sorted(names)
    reached = answer.cleared_world.threat[world.accessible(answer.starts)]
    assert (reached == 0).all() and (answer.cleared_world.threat[:, 8] == np.float32(0.4)).all()
    assert any("1 threat of the scenario" in note for note in answer.notes)
    gains = by_cell(answer.options, world.shape, lambda one: one.known)
    assert gains[3, 3] == max(one.known.cells.mean for one in answer.options[:2])  # type: ignore[union-attr]


def test_sources_are_the_default_where_there_are_several(tmp_path: Path) -> None:
    world = mrac.load(overlapping(tmp_path))
    chosen = {remove: threats_of(world, world.starts, 16, remove) for remove in (None, "sources", "areas")}  # type: ignore[arg-type]
    assert chosen[None][0] == "sources" and chosen["areas"][0] == "areas"
    assert [one.name for one in chosen["areas"][1]] == ["area 0", "area 1", "area 2"]
    hidden = World.create(np.where(np.isnan(world.threat), np.nan, world.threat / 2), world.starts)
    assert threats_of(hidden, hidden.starts, 16)[0] == "areas"
    changed = replace(world, threat=hidden.threat)
    assert threats_of(changed, world.starts, 16)[0] == "areas"
    with pytest.raises(UsageError, match=r"no polygon, point or site of its threats .*; use remove='areas'"):
        mrac.clear(WORLD, remove="sources")
    with pytest.raises(UsageError, match="remove='all'; expected 'areas' or 'sources'"):
        mrac.clear(WORLD, remove="all")  # type: ignore[arg-type]


# The command.


@pytest.fixture
def world_file(tmp_path: Path) -> str:
    WORLD.save(tmp_path / "world.npz")
    return str(tmp_path / "world.npz")


def test_the_command_says_gains_as_json(capsys: pytest.CaptureFixture[str], world_file: str, small: Clearing) -> None:
    assert (
        run(["clear", world_file, "--count", "2", "--rollouts", str(RUNS), "--seed", "3", "--exact", "never", "--json"])
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads(json.dumps(small.to_json()))
    assert found["pick"] == [threat.name for threat in small.picks] and found["gain"]["first_rollout"] == RUNS
    keys = {"name", "cells", "p", "screen", "hits", "known", "unknown", "behind"}
    assert all(set(one) == keys and one["unknown"]["ci95"] for one in found["threats"])
    assert found["threats"][1]["cells"] == [9 * row + col for row in (1, 2) for col in range(3, 7)]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--count", "0"], "--count 0; expected a whole number of threats, 1 to 3"),
        (["--count", "4"], "--count 4; expected a whole number of threats, 1 to 3"),
        (["--remove", "all"], "--remove 'all'; expected areas or sources"),
        (["--remove", "sources"], "lies where a robot can get; use --remove areas"),
        (["--starts", "0,8"], "[0, 8], an obstacle"),
        (["--robots", "3"], "--robots 3 contradicts the 2 starts"),
        (["--plan-for", "open"], "Unknown option: --plan-for"),
        (["--rollouts", "4294967296"], "expected at most 2147483648"),
    ],
)
def test_bad_options_are_told(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, words: list[str], said: str
) -> None:
    assert run(["clear", world_file, *words, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err.strip().splitlines()[-1]
    assert err.startswith("error: ") and said in err and not (tmp_path / "out").exists()


def test_without_threat_there_is_nothing_to_clear() -> None:
    with pytest.raises(UsageError, match="no cell that a robot can reach is dangerous"):
        mrac.clear(mrac.load(np.zeros((3, 3))))
    behind = mrac.load([[0.0, np.nan, 0.5]])
    with pytest.raises(UsageError, match="no cell that a robot can reach is dangerous"):
        mrac.clear(behind, starts=[[0, 0]])


def test_an_interruption_leaves_the_picks_so_far() -> None:
    calls: list[int] = []

    def stop(done: int, total: int, seconds: float) -> None:
        calls.append(done)
        if len(calls) > 5:
            raise KeyboardInterrupt

    answer = mrac.clear(WORLD, count=3, rollouts=RUNS, exact="never", progress=stop, on_interrupt="return")
    assert answer.partial and len(answer.picks) == 1 and answer.gain is None
    assert clear_headline(answer).startswith("Interrupted.") and answer.to_json()["gain"] is None
    with pytest.raises(KeyboardInterrupt):
        mrac.clear(WORLD, rollouts=RUNS, exact="never", progress=stop)


def test_the_answer_prints_and_saves_itself(small: Clearing, tmp_path: Path) -> None:
    files = {file.name for file in small.save(tmp_path / "out")}
    assert files == {"index.html", "clear.png", "clear.txt", "risk_paid.png", "clear.json"}
    page = Reader((tmp_path / "out" / "index.html").read_text()).text
    assert clear_headline(small) in page and all(said in page for said in clear_findings(small))
    assert "Where risk is paid" in page and 2 <= len(repr(small).splitlines()) <= 24
