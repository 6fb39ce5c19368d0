"""Rows of `results` that pool settings: a map counts once, and the intervals hold the truth as often as they say."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from analysis.cli.app import run
from analysis.statistics.control_variate import BESIDE
from analysis.sweeps.results import (
    DIFFERENCES,
    KEPT,
    Part,
    Row,
    Setting,
    collect,
    complete,
    figures_of,
    map_of,
    moments_over,
    select,
    single_map,
    single_over,
)
from analysis.sweeps.spec import read_spec
from analysis.sweeps.store import Memory, Run, Store
from analysis.sweeps.sweep import run_sweep
from planner.errors import UsageError
from planner.tally import Tally
from planner.world.generate import ThreatPattern, random_world

SPEC = """
base: {kind: contiguous, size: 7x9, ratio: 0.2}
maps: 4
rollouts: 30
sweep: {robots: [1, 2], risk: [paper, log]}
"""
CELLS = 40
"""Accessible cells of the made-up maps."""


def swept(folder: Path, text: str, store: Store) -> None:
    (folder / "try.yaml").write_text(text)
    run_sweep(read_spec(folder / "try.yaml"), store, processes=1)


def test_a_row_counts_a_map_once(tmp_path: Path) -> None:
    """Against a plain calculation: settings averaged on each map, then Student's interval over the maps."""
    with Memory() as store:
        swept(tmp_path, SPEC, store)
        found = collect(store, {}, ["robots"])
        assert [row.maps for row in found.rows] == [4, 4] and [row.rollouts for row in found.rows] == [240, 240]
        assert found.runs == 16 and found.pooled == ("risk",)
        (note,) = found.notes
        assert "pooled over risk: log, paper" in note and "by=['robots', 'risk']" in note
        for row in found.rows:
            places = [{"robots": (str(row.labels["robots"]),), "map": (str(seed),)} for seed in range(4)]
            means = [
                np.mean([figures_of(each)[0][KEPT["visited"], 0] for each in select(store, place)]) for place in places
            ]
            assert row.estimate("visited").mean == pytest.approx(np.mean(means))
            assert row.estimate("visited").se == pytest.approx(np.std(means, ddof=1) / 2)
        everything = collect(store, {}, ["kind"]).rows
        assert [(row.maps, row.rollouts) for row in everything] == [(4, 480)]
        apart = collect(store, {}).rows
        assert [row.maps for row in apart] == [4] * 4 and not collect(store, {}).notes


def test_one_map_is_one_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The README's example in small: the interval is that of the rollouts, and the table says so."""
    random_world(7, 9, ThreatPattern(seed=4)).save(tmp_path / "world.npz")
    text = "base: {input: world.npz}\nrollouts: 200\nsweep: {robots: [1, 2], risk: [paper, log]}"
    path = tmp_path / "a.store"
    with Store.open(path) as store:
        swept(tmp_path, text, store)
        rows = sorted(collect(store, {}, ["robots", "risk"]).rows, key=lambda row: str(row.labels["robots"]))
        singles = [row.estimate("visited") for row in rows]
        pooled = [row.estimate("visited") for row in collect(store, {}, ["robots"]).rows]
    for mean, first, second in zip(pooled, singles[::2], singles[1::2], strict=True):
        assert mean.mean == pytest.approx((first.mean + second.mean) / 2)
        assert mean.half_width == pytest.approx((first.half_width + second.half_width) / 2)
    assert run(["results", str(path), "--by", "robots", "--plot", str(tmp_path / "p.png")]) == 0
    said = capsys.readouterr()
    assert "Each row: 1 map, 400 rollouts." in said.out and "luck of the rollouts on that map" in said.out
    assert "pooled over risk: log, paper" in said.out
    assert run(["results", str(path), "--by", "robots", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["pooled"] == ["risk"] and answer["runs"] == 4
    assert [row["maps"] for row in answer["settings"]] == [1, 1]
    assert [row["visited"]["mean"] for row in answer["settings"]] == [each.mean for each in pooled]


def test_worlds_of_one_input_are_one_map(tmp_path: Path) -> None:
    """Places of a scenario, and what threats are generated with, change the world of every setting, not the map."""
    random_world(6, 8, ThreatPattern(seed=4), threats=0.0).save(tmp_path / "floor.npz")
    danger = "map: {file: floor.npz}\nthreats: [{generate: {kind: scattered, ratio: 0.1}}]"
    (tmp_path / "danger.yaml").write_text(danger)
    text = """
base: {input: danger.yaml}
rollouts: 20
sweep: {ratio: [0.1, 0.3], "threats[0].generate.levels": [[0.1], [0.3]], seed: [1, 2, 3]}
"""
    with Memory() as store:
        swept(tmp_path, text, store)
        assert len({each.facts["world"] for each in store.runs()}) == 4 and len(store) == 12
        assert {map_of(each) for each in store.runs()} == {("input", "danger.yaml")}
        rows = collect(store, {}, ["ratio"]).rows
        assert [(row.maps, row.rollouts) for row in rows] == [(1, 120), (1, 120)]
        assert [(row.maps, row.rollouts) for row in collect(store, {}).rows] == [(1, 60)] * 4


def test_inputs_are_maps(tmp_path: Path) -> None:
    for number in range(3):
        random_world(6, 8, ThreatPattern(seed=number)).save(tmp_path / f"{number}.npz")
    text = "base: {robots: 1}\nrollouts: 20\nsweep: {input: [0.npz, 1.npz, 2.npz], risk: [paper, log]}"
    with Memory() as store:
        swept(tmp_path, text, store)
        (row,) = collect(store, {}, ["robots"]).rows
        assert (row.maps, row.rollouts) == (3, 120)
        assert row.moments.shared[KEPT["visited"]] > 0  # all three were rolled out with seed 0
        (row,) = collect(store, {"input": ("1.npz",)}, ["robots"]).rows
        assert row.maps == 1


def test_maps_that_lack_a_setting_are_left_out(tmp_path: Path) -> None:
    less = SPEC.replace("maps: 4", "maps: 7").replace("[paper, log]", "[log]")
    with Memory() as store:
        swept(tmp_path, SPEC, store)
        swept(tmp_path, less, store)
        found = collect(store, {}, ["robots"])
        assert [row.maps for row in found.rows] == [4, 4] and found.runs == 16
        assert [note for note in found.notes if note.startswith("robots 1: 3 maps of 7 lack some")]
        assert [row.maps for row in collect(store, {}).rows] == [7, 7, 4, 4]
        with pytest.raises(UsageError, match=r"robots 1: no map has every risk.*by=\['robots', 'risk'\]"):
            collect(apart(store), {}, ["robots"])


def apart(store: Store) -> Store:
    """The same, but the maps of odd seeds have one risk and those of even seeds the other."""

    class Half(Memory):
        def runs(self):  # type: ignore[no-untyped-def]
            return (each for each in store.runs() if (each.what["risk"] == "log") == (each.what["map"] in (1, 3)))

    return Half()


def part(setting: int, seed: int, mean: float, error: float) -> Part:
    means, errors = np.zeros((len(KEPT), BESIDE)), np.zeros((len(KEPT), BESIDE, BESIDE))
    means[:, 0], errors[:, 0, 0] = mean, error**2
    return Part("", (setting,), seed, 100, 0, means, errors)


def held(make: object, truth: float) -> tuple[float, float]:
    """(share of TRIALS whose interval holds the truth, its mean half-width over 1.96 standard deviations)."""
    found = [moments_over(make()).estimate(KEPT["time"], -np.inf, np.inf) for _ in range(TRIALS)]  # type: ignore[operator]
    inside = np.mean([each.ci95[0] <= truth <= each.ci95[1] for each in found])
    spread = np.std([each.mean for each in found])
    return float(inside), float(np.mean([each.half_width for each in found]) / spread / 1.96)


TRIALS = 1000
SLACK = 3 * math.sqrt(0.05 * 0.95 / TRIALS)
"""Three standard errors of a share of 95 % in so many trials."""


def test_intervals_over_maps_with_settings_pooled() -> None:
    """20 maps x 3 settings, which share the map and most of their luck: 95 %, and no wider than Student's calls for."""
    random = np.random.default_rng(0)

    def store() -> list[list[Part]]:
        maps = []
        for seed in range(20):
            middle, luck = random.normal(0.0, 1.0), random.normal(0.0, 0.3)
            own = random.normal(0.0, 0.2, 3)
            maps.append([part(s, seed, middle + s - 1 + luck + own[s], math.hypot(0.3, 0.2)) for s in range(3)])
        return maps

    inside, wide = held(store, 0.0)
    assert abs(inside - 0.95) < SLACK
    assert wide < 1.15  # Student's t of 19 degrees of freedom is 1.07 times the normal's


def test_intervals_over_maps_that_share_their_luck() -> None:
    """12 maps rolled out with one seed, on all of which the luck is the same."""
    random = np.random.default_rng(1)

    def store() -> list[list[Part]]:
        luck = random.normal(0.0, 0.5)
        return [[part(0, 7, random.normal(0.0, 1.0) + luck, 0.5)] for _ in range(12)]

    inside, wide = held(store, 0.0)
    assert inside > 0.95 - SLACK and wide < 1.25


def tally_of(luck: np.ndarray, chance: float, seed: int) -> Tally:
    """Rollouts that cover a cell each with `chance`; the same `luck` `[n, CELLS]` for every setting."""
    visited = np.bincount((luck < chance).sum(axis=1), minlength=CELLS + 1)
    tally = Tally.empty(f"plan {chance}/closed/step/{seed}", (1, CELLS), 1, CELLS)
    outcomes = np.array([len(luck), 0, 0, 0, 0])
    alive = np.array([0, len(luck)])
    counts = {"visited": visited, "survived": visited, "time": visited, "alive": alive, "outcomes": outcomes}
    return replace(tally, ids=((0, len(luck)),), **counts)


RUN = Run("key", {}, {"cells": {"accessible": CELLS, "free": CELLS}, "longest": 400}, ((0, 1),), None)


@pytest.mark.parametrize("common", [True, False])
def test_intervals_of_one_map(common: bool) -> None:
    """Settings pooled on one map: with common luck they hold in 95 %, with luck of their own they hold all the more."""
    random, trials, chances = np.random.default_rng(2), 400, (0.3, 0.5)
    truth, inside, means, wide = sum(chances) / 2, 0, [], []
    for _ in range(trials):
        luck = random.random((2, 150, CELLS))
        found: list[tuple[Setting, Run, Tally]] = [
            ((chance,), RUN, tally_of(luck[0 if common else number], chance, 0))
            for number, chance in enumerate(chances)
        ]
        estimate = single_over(found)["visited"]
        inside += estimate.ci95[0] <= truth <= estimate.ci95[1]
        means.append(estimate.mean)
        wide.append(estimate.half_width)
    assert inside / trials > 0.95 - 3 * math.sqrt(0.05 * 0.95 / trials)
    assert abs(np.mean(means) - truth) < 5 * np.std(means) / math.sqrt(trials)
    assert np.mean(wide) < 8 * np.std(means)  # one map, not two: once it was half of everything there is


def test_seeds_of_one_setting_are_one_sample() -> None:
    luck = np.random.default_rng(3).random((3, 50, CELLS))
    tallies = [tally_of(each, 0.4, seed) for seed, each in enumerate(luck)]
    whole = tally_of(luck.reshape(150, CELLS), 0.4, 0)
    assert single_over([((), RUN, tally) for tally in tallies]) == single_map(RUN, whole)


def test_complete() -> None:
    first, second, third = ([part(s, 0, 0.0, 0.0) for s in settings] for settings in ((0, 1), (1, 0, 1), (1,)))
    assert complete([first, second, third]) == [first, second]
    assert complete([third, [part(0, 0, 0.0, 0.0)]]) == []


MAPS = 1500
"""Of which samples are drawn, one map as often as it comes: their mean is the truth, however many they are."""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "robots", "rollouts"), [*product(("contiguous", "scattered"), (2, 8), (20, 60))])
def test_intervals_over_maps_hold_with_the_control(tmp_path: Path, kind: str, robots: int, rollouts: int) -> None:
    """300 samples of 60 maps drawn of 1,500: each figure of a row, and its difference from another policy, holds the
    mean of all as often as it says (3 standard errors below .95); the control halves what noise the rollouts leave."""
    text = f"base: {{kind: {kind}, robots: {robots}, size: 12x14}}\nmaps: {MAPS}\nrollouts: {rollouts}\n"
    with Memory() as store:
        swept(tmp_path, text + "sweep: {policy: [mrac, per_cell]}", store)
        found: dict[tuple[str, int], tuple[np.ndarray, np.ndarray]] = {
            (str(each.what["policy"]), int(each.what["map"] or 0)): figures_of(each) for each in store.runs()
        }
    means = {name: np.mean([found[name, n][0] for n in range(MAPS)], axis=0)[:, 0] for name in ("mrac", "per_cell")}
    random, names, held, gains = np.random.default_rng(0), ("visited", "survived", "time", "alive"), [], []
    for _ in range(300):
        rows = [Row({}), Row({})]
        rows[1].first = rows[0].moments
        for number in random.integers(MAPS, size=60).tolist():
            one, other = (found[name, number] for name in ("mrac", "per_cell"))
            for row, mine in zip(rows, (one, other), strict=True):
                row.add(*mine, rollouts - 1, one[0])
        truths = [means["per_cell"][KEPT[name]] for name in names]
        truths += [float((means["per_cell"] - means["mrac"])[KEPT[name]]) for name in DIFFERENCES]
        estimates = [rows[1].estimate(name) for name in names] + [rows[1].difference(name) for name in DIFFERENCES]  # type: ignore[list-item]
        held.append(
            [low <= truth <= high for truth, (low, high) in zip(truths, (e.ci95 for e in estimates), strict=True)]
        )
        by, spread = rows[1].moments.weights(KEPT["visited"]), rows[1].moments.within[KEPT["visited"]]
        gains.append(spread[0, 0] / (by @ spread @ by))
    assert (np.mean(held, axis=0) >= 0.95 - 3 * math.sqrt(0.95 * 0.05 / 300)).all(), np.mean(held, axis=0)
    assert np.median(gains) > 2
