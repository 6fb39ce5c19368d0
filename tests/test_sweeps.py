"""`mrac-jax sweep` and `results`: sweep files, pooled rows, unknown maps and moving threats."""

import csv
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers import answer_of
from information_value import Team, study_knowing
from page_reader import refused
from scipy import stats

import mrac_jax as mrac
from analysis.cli import research as commands
from analysis.cli.app import run
from analysis.evaluation.evaluate import Evaluation
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate
from analysis.statistics.variance_reduction import TERMS, expected_pieces, pieces
from analysis.sweeps import report
from analysis.sweeps import results as pooling
from analysis.sweeps.cases import Generated, Places, Written
from analysis.sweeps.engine import Done, Job, run_cases
from analysis.sweeps.spec import read_spec
from analysis.sweeps.store import Run, Store
from analysis.sweeps.sweep import Sweep, run_sweep
from planner.errors import PER_VISIT, InputError, ScenarioError, UsageError
from planner.make_plan import make_plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.threshold_classes import classes_by_threshold
from planner.settings import Settings
from planner.tally import Tally
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# `mrac-jax sweep` and `results`: sweep files, common random numbers, intervals over maps, precision, export.

SPEC = """
base: {kind: contiguous, size: 7x9, ratio: 0.2}
maps: 5
first_seed: 11
rollouts: 40
seed: 3
sweep:
  robots: [1, 3]
  threat_checks: [every_visit, first_visit]
  risk: [paper, log]
"""


def spec_file(folder: Path, text: str = SPEC) -> Path:
    path = folder / "try.yaml"
    path.write_text(text)
    return path


def swept(folder: Path, text: str, store: Store | None = None) -> Sweep:
    """The sweep of this text, into a store in memory unless one is given."""
    return run_sweep(read_spec(spec_file(folder, text)), Store() if store is None else store, processes=1)


def test_jobs_cross_everything_on_the_same_maps_with_the_same_luck(tmp_path: Path) -> None:
    spec = read_spec(spec_file(tmp_path))
    jobs = list(spec.jobs())
    assert (len(spec.cases), len(spec.models), len(jobs)) == (4, 2, 20)
    assert [job.tag for job in jobs] == list(range(20))
    worlds = [job.case.world for job in jobs]
    assert all(isinstance(world, Generated) for world in worlds)
    assert [world.seed for world in worlds] == [seed for seed in range(11, 16) for _ in range(4)]  # type: ignore[union-attr]
    assert [job.models[0].seed for job in jobs] == [seed for seed in range(3, 8) for _ in range(4)]
    assert [job.models for job in jobs[:4]] == [(RolloutChoices(seed=3), RolloutChoices(first_only=True, seed=3))] * 4
    assert [(job.case.robots, job.case.choices.risk) for job in jobs[:4]] == [
        (1, "paper"), (1, "log"), (3, "paper"), (3, "log")
    ]  # fmt: skip
    labels = [spec.labels(*divmod(number, 2)) for number in range(8)]
    assert labels[1] == {"robots": 1, "threat_checks": "first_visit", "risk": "paper"}
    assert labels[6] == {"robots": 3, "threat_checks": "every_visit", "risk": "log"}


@pytest.mark.parametrize(
    ("base", "swept", "policies"),
    [("", "robots: [1, 2]", ("mrac",)), (", policy: per_cell", "robots: [1, 2]", ("per_cell",)),
     ("", "policy: [mrac, per_cell]", ("mrac", "per_cell"))],
)  # fmt: skip
def test_the_policies_of_a_sweep(tmp_path: Path, base: str, swept: str, policies: tuple[str, ...]) -> None:
    random_world(5, 5, ThreatPattern(seed=4)).save(tmp_path / "world.npz")
    text = f"base: {{input: world.npz{base}}}\nsweep: {{{swept}}}"
    assert read_spec(spec_file(tmp_path, text)).policies == policies


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_sweep_is_the_mean_of_map_means(tmp_path: Path, processes: int) -> None:
    """Against a plain calculation from the tallies; again, and in 2 processes, to the last bit."""
    spec, standing = read_spec(spec_file(tmp_path)), list[tuple[int, int, float, str]]()
    with Store() as store:
        answer = run_sweep(spec, store, processes=1, watch=lambda *now: standing.append(now))
        places, columns = Places(), []
        for job in spec.jobs():
            found = []
            for run_, tally in ((store.run(key), store.tally(key)) for key in keys_of(store, places, job)):
                assert run_ is not None
                found.append(float(tally.visited @ np.arange(len(tally.visited))) / 40 / tally.accessible)
            columns.append(found)
        means = np.array(columns).reshape(5, 8)  # maps, then (case, model)
        for number, row in enumerate(answer.rows):
            found_, values = row.estimate("visited"), means[:, number]
            assert (row.maps, row.rollouts) == (5, 200)
            assert found_.mean == pytest.approx(values.mean())
            assert found_.se == pytest.approx(values.std(ddof=1) / math.sqrt(5))
            assert found_.half_width >= stats.t.ppf(0.975, 4) * found_.se - 1e-12
            change = row.difference("visited")
            assert (change is None) == (number == 0)  # the first row from itself: nothing to say
            if change is None:
                continue
            assert change.mean == pytest.approx((values - means[:, 0]).mean(), abs=1e-12)
            assert change.se == pytest.approx((values - means[:, 0]).std(ddof=1) / math.sqrt(5), abs=1e-12)
        assert standing[-1][:2] == (20, 20) and standing[-1][3] == f"widest ± {100 * answer.widest:.2f} points: "
        widest = answer.widest_row
        assert widest is not None and widest.estimate("visited").half_width == answer.widest
        assert answer.within_share == widest.within_share and 0 < (widest.within_share or 0) < 1
    with Store() as store:
        again = run_sweep(spec, store, processes=processes)
        for mine, other in zip(again.rows, answer.rows, strict=True):
            for one, two in ((mine.moments, other.moments), (mine.apart, other.apart)):
                assert all(map(np.array_equal, vars(one).values(), vars(two).values()))


CONTROLLED = """
base: {kind: contiguous, size: 7x9, ratio: 0.2}
maps: 6
rollouts: 200
sweep: {robots: [2, 3], policy: [mrac, per_cell]}
"""


def test_rows_are_put_right_by_what_all_maps_tell_of_luck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against least squares over all single rollouts, with a level for each map; differences too, also of two teams."""
    with Store() as store:
        answer = swept(tmp_path, CONTROLLED, store)
        again = pooling.collect(store, {}).rows
        with monkeypatch.context() as patch:  # whoever finished first
            patch.setattr(Store, "runs", lambda self, runs=Store.runs: iter(list(runs(self))[::-1]))
            for mine, other in zip(pooling.collect(store, {}).rows, again, strict=True):
                assert all(map(np.array_equal, vars(mine.moments).values(), vars(other.moments).values()))
    levels, means = np.repeat(np.eye(6), 200, axis=0), []
    for row in answer.rows:
        robots, policy = int(row.labels["robots"] or 0), str(row.labels["policy"])
        y, luck = [], []
        for seed in range(6):
            world = random_world(7, 9, ThreatPattern(seed=seed), threats=0.2)
            plan = make_plan(world, place_starts(world, robots)[0], Settings(policy=policy))
            loop = compile_closed_loop(plan, world)
            y.append(run_range(loop, seed, 0, 200, singles=True)[1].visited / len(loop.cells))  # type: ignore[union-attr]
            luck.append(pieces(classes_by_threshold(seed, 0, 200, robots), robots) - expected_pieces(robots))
        fit = np.linalg.lstsq(np.hstack([levels, np.concatenate(luck)]), np.concatenate(y), rcond=None)[0]
        means.append(fit[:6])
        found, change = row.estimate("visited"), row.difference("visited")
        assert (found.mean, found.se) == pytest.approx((fit[:6].mean(), stats.sem(fit[:6])))
        assert abs(found.mean - np.mean(y)) > 1e-4 and (change is None) == (row is answer.rows[0])
        apart = fit[:6] - means[0]
        if change is not None:
            assert (change.mean, change.se) == pytest.approx((apart.mean(), stats.sem(apart)), abs=1e-12)
        left = np.concatenate(y) - np.hstack([levels, np.concatenate(luck)]) @ fit
        noise = (left.reshape(6, 200) ** 2).sum(axis=1).mean() / 199 / 200
        assert row.within_share == pytest.approx(min(1.0, noise / fit[:6].var(ddof=1)))
    ends = {tuple(sorted(row.labels.items())): row.estimate("visited").ci95 for row in answer.rows}
    for row in again:
        assert row.estimate("visited").ci95 == pytest.approx(ends[tuple(sorted(row.labels.items()))])


def keys_of(store: Store, places: Places, job: Job) -> list[str]:
    from analysis.sweeps.cases import run_key

    return [run_key(places.team(job.case), model) for model in job.models]


def test_moments_against_numpy() -> None:
    values = np.random.default_rng(0).exponential(size=(200, 2, 2))
    values[:, 1] = 7.0
    error = np.array([[[0.1, 0.02], [0.02, 0.05]], [[0.0, 0.0], [0.0, 0.0]]])
    moments = pooling.Moments(2, 2)
    for value in values:
        moments.add(value, error, 6)
    apart = values[:, 0] - values[:, 0].mean(axis=0)
    assert moments.scatter[0] == pytest.approx(apart.T @ apart) and not moments.scatter[1].any()
    assert moments.lean[0] == pytest.approx(np.einsum("ma,mb,mc->abc", apart, apart, apart))
    assert not moments.lean[1].any()
    right = values[:, 0] @ [1.0, -0.4]  # 0.02 / 0.05, of 1,200 rollouts
    rare = max(abs((far**3).sum() / (far**2).sum() / 200) for far in (right - right.mean(), apart[:, 0]))
    found = moments.estimate(0, -np.inf, np.inf)
    assert (found.mean, found.se) == pytest.approx((right.mean(), stats.sem(right)))
    assert found.half_width == pytest.approx(stats.t.ppf(0.975, 199) * math.hypot(found.se, math.sqrt(6) * rare))
    left = 0.1 - 0.02**2 / 0.05
    assert moments.within_share(1) is None and moments.within_share(0) == pytest.approx(left / right.var(ddof=1))
    moments.shared += 0.01
    assert moments.estimate(0, -np.inf, np.inf).mean == pytest.approx(values[:, 0, 0].mean())  # they share their luck
    same = pooling.Moments(1, 1)
    for _ in range(10):
        same.add(np.ones((1, 1)), 0.0)
    assert same.estimate(0, 0, 1).ci95 == (pytest.approx(0.7), 1.0)  # every map so far: not a proof


def test_alike_on_every_map_is_no_proof(tmp_path: Path) -> None:
    """Maps without threats or obstacles: times and losses are the same on all three; others may have other ones."""
    text = "base: {kind: contiguous, size: 4x5, ratio: 0, obstacles: 0}\nmaps: 3\nrollouts: 4\nsweep: {robots: [1, 2]}"
    one, two = swept(tmp_path, text).rows
    for figure, most in (("alive", 2), ("time", 8 * 1 * 20 + 64)):
        found, reach = two.estimate(figure), two.reach(figure)
        assert (found.se, reach) == (0, most)
        assert found.ci95 == (max(found.mean - reach, 0.0), min(found.mean + reach, reach))
    apart = two.difference("time")
    assert apart is not None and apart.ci95[1] - apart.ci95[0] > 100
    assert one.reach("time") == 19  # one robot's largest time is proven


@pytest.mark.parametrize("trials", [400, pytest.param(4000, marks=pytest.mark.slow)])
def test_intervals_over_maps_hold_as_often_as_they_say(trials: int) -> None:
    """95 % intervals of means over 12 normal maps and 50 skewed ones: within 5 standard errors of 95 %."""
    random = np.random.default_rng(1)
    for draw, mean, maps in ((random.normal, 0.0, 12), (random.exponential, 1.0, 50)):
        held = 0
        for sample in draw(size=(trials, maps)):
            moments = pooling.Moments(1, 1)
            for value in sample:
                moments.add(value.reshape(1, 1), 0.0)
            low, high = moments.estimate(0, -np.inf, np.inf).ci95
            held += low <= mean <= high
        assert held / trials > 0.95 - 5 * math.sqrt(0.05 * 0.95 / trials)


def test_precision_takes_more_maps(tmp_path: Path) -> None:
    text = SPEC.replace("maps: 5", "maps: 4").replace("rollouts: 40", "rollouts: 20")
    with Store() as store:
        spec = read_spec(spec_file(tmp_path, text))
        precision = 0.6 * run_sweep(spec, store, processes=1).widest
        answer = run_sweep(spec, store, processes=1, precision=precision)
        maps = answer.rows[0].maps
        assert answer.reached and answer.widest < precision and maps in (8, 16, 32, 64)
        half = swept(tmp_path, text.replace("maps: 4", f"maps: {maps // 2}"), store)
        assert half.widest >= precision and half.finished.rollouts == 0
        with pytest.raises(InputError, match="precision"):
            run_sweep(spec, store, precision=1.5)


def test_precision_on_one_map_takes_more_rollouts(tmp_path: Path) -> None:
    random_world(7, 9, ThreatPattern(seed=4)).save(tmp_path / "world.npz")
    spec = read_spec(spec_file(tmp_path, "base: {input: world.npz}\nrollouts: 50\nsweep: {robots: [1, 2]}"))
    assert spec.maps is None
    with Store() as store:
        answer = run_sweep(spec, store, processes=1, precision=0.01)
        assert answer.reached and answer.rows[0].rollouts == 4096
        (found, _) = store.runs()
        tally = store.tally(found.key)
        assert tally is not None and answer.rows[0].estimate("visited") == pooling.single_map(found, tally)["visited"]


@pytest.mark.parametrize("rollouts", [1, 20])
def test_one_generated_map_says_as_much_as_a_map_that_is_given(tmp_path: Path, rollouts: int) -> None:
    """What was sampled is not said to be exact; `precision` takes more maps, whatever the first one says."""
    text = f"base: {{size: 6x6, robots: 1, ratio: 0.3}}\nmaps: 1\nrollouts: {rollouts}\n"
    spec = read_spec(spec_file(tmp_path, text))
    with Store() as store:
        answer = run_sweep(spec, store, processes=1)
        (row,), (found,) = answer.rows, store.runs()
        tally = store.tally(found.key)
        assert tally is not None and str(row.single) == str(
            pooling.single_map(found, tally)
        )  # se is NaN of one rollout
        for name in ("visited", "time", "complete"):
            low, high = row.estimate(name).ci95
            assert low < high and row.estimate(name) is row.single[name]
        assert answer.widest == row.single["visited"].half_width
        assert "exact" not in report.summary(answer)
        more = run_sweep(spec, store, processes=1, precision=0.99)
        (row,) = more.rows
        assert row.maps == 2 and not row.single and more.widest < 0.99
        assert row.estimate("visited") == row.moments.estimate(pooling.KEPT["visited"], 0.0, 1.0)


def test_the_unit_stands_with_the_mean() -> None:
    for estimate, said in (
        (Estimate(7 / 9, 0.0, (7 / 9, 7 / 9)), "77.78 % (exact)"),
        (Estimate(0.674, 0.01, (0.654, 0.694)), "67.4 ± 2.0 %"),
        (Estimate(0.0, 0.0, (0.0, 0.3)), "0 % (30.0 or less)"),
        (Estimate(0.5, math.nan, (-math.inf, math.inf)), "50.0 %"),
    ):
        assert report.percent(estimate, " %") == said
        assert report.percent(estimate) == said.replace(" %", "")


def test_no_collapse_on_one_map_where_every_rollout_is_the_same(tmp_path: Path) -> None:
    random_world(5, 5, ThreatPattern(seed=4), threats=0.0).save(tmp_path / "world.npz")
    found = swept(tmp_path, "base: {input: world.npz, robots: 1}\nrollouts: 100").rows[0].estimate("visited")
    assert found.mean == 1 and found.ci95[0] == pytest.approx(1 + math.log(0.025) / 100)


@pytest.mark.parametrize("luck", ["step", "tolerance"])
def test_a_spec_that_names_the_randomness_names_the_release(luck: str, tmp_path: Path) -> None:
    for text in (SPEC.replace("base: {", f"base: {{luck: {luck}, "), f"{SPEC}  luck: [{luck}]\n"):
        with pytest.raises(ScenarioError, match=re.escape(PER_VISIT)):
            read_spec(spec_file(tmp_path, text))


def test_scenarios_and_plans_of_others(tmp_path: Path) -> None:
    """A scenario with generated threats over maps and places in it; plan files, ours and another planner's."""
    world = random_world(6, 8, ThreatPattern(seed=4), threats=0.0)
    world.save(tmp_path / "floor.npz")
    text = """
base: {input: danger.yaml}
maps: 3
rollouts: 20
sweep:
  ratio: [0.1, 0.3]
  "threats[0].generate.levels": [[0.1], [0.3]]
"""
    danger = {"map": {"file": "floor.npz"}, "threats": [{"generate": {"kind": "scattered", "ratio": 0.1}}],
              "robots": {"count": 2, "start": "upper-left"}}  # fmt: skip
    (tmp_path / "danger.yaml").write_text(json.dumps(danger))
    spec = read_spec(spec_file(tmp_path, text))
    assert all(isinstance(job.case.world, Written) for job in spec.jobs())
    with Store() as store:
        rows = run_sweep(spec, store, processes=1).rows
        assert [row.labels["threats[0].generate.levels"] for row in rows] == ["[0.1]", "[0.3]"] * 2
        assert len({run_.facts["world"] for run_ in store.runs()}) == 12
        assert all(run_.what["robots"] == 2 for run_ in store.runs())
    dangerous = random_world(6, 8, ThreatPattern(seed=4))
    dangerous.save(tmp_path / "world.npz")
    starts, _ = place_starts(dangerous, 2)
    make_plan(dangerous, starts).save(tmp_path / "ours.json")
    (tmp_path / "theirs.json").write_text(json.dumps({"paths": [[starts[0].tolist()]]}))
    text = "base: {input: world.npz, loop: open}\nrollouts: 20\nsweep: {plan: [ours.json, theirs.json]}"
    rows = swept(tmp_path, text).rows
    assert [row.labels["plan"] for row in rows] == ["ours.json", "theirs.json"]
    assert rows[0].estimate("visited").mean > rows[1].estimate("visited").mean
    for name, borne in (("fresh", 0.0), ("worn", 3.0)):  # alike but for the state that they go on from
        state = {"format": "mrac-state", "version": 1, "step": 0, "visited": starts.tolist(),
                 "robots": [{"cell": cell, "exposure": borne} for cell in starts.tolist()]}  # fmt: skip
        (tmp_path / "state.json").write_text(json.dumps(state))
        mrac.plan(dangerous, state=tmp_path / "state.json", weibull_shape=3.0).save(tmp_path / f"{name}.json")
    with Store() as store:
        states = text.replace("ours.json, theirs.json", "fresh.json, worn.json").replace("open", "closed")
        fresh, worn = swept(tmp_path, states, store).rows
        assert len(store) == 2 and fresh.estimate("visited").mean > worn.estimate("visited").mean
    taken_over = swept(tmp_path, text.replace("loop: open", "loop: closed")).rows
    assert taken_over[1].estimate("visited").mean > rows[1].estimate("visited").mean


def test_plans_for_the_open_loop_are_swept_in_both_loops(tmp_path: Path) -> None:
    """The rollouts of `evaluate`: the closed loop takes over what their robots leave, on the same luck."""
    world = random_world(6, 8, ThreatPattern(seed=4, levels=(0.3, 0.5)))
    world.save(tmp_path / "world.npz")
    text = """
base: {input: world.npz, robots: 2, plan_for: open_loop, effort: 200}
rollouts: 200
sweep: {loop: [open, closed]}
"""
    rows = swept(tmp_path, text).rows
    means = [row.estimate("visited").mean for row in rows]
    plan = mrac.plan(world, robots=2, plan_for="open_loop", effort=200)
    for mean, loop in zip(means, ("open", "closed"), strict=True):
        answer = mrac.evaluate(world, plan, loop=loop, rollouts=200, engine="numba")  # type: ignore[arg-type]
        visited = answer.tally.visited  # counted: what is reported is exact
        cells = np.average(np.arange(len(visited)), weights=visited)
        assert mean == pytest.approx(cells / world.accessible(plan.starts).sum(), abs=1e-12)
    assert 1 > means[1] >= means[0]


def test_null_is_a_value_where_a_setting_may_be_unset(tmp_path: Path) -> None:
    spec = read_spec(spec_file(tmp_path, "base: {policy: per_cell}\nsweep: {risk_cap: [null, 0.5]}"))
    assert [job.case.choices.given() for job in spec.jobs(0, 1)] == [
        {"policy": "per_cell"}, {"policy": "per_cell", "risk_cap": 0.5}
    ]  # fmt: skip
    assert [spec.labels(case, 0) for case in (0, 1)] == [{"risk_cap": "null"}, {"risk_cap": 0.5}]


BAD = {
    "sweep: {robot: [1]}": "did you mean 'robots'", "sweeps: {}": "did you mean 'sweep'",
    "base: {ratios: 1}": "did you mean 'ratio'", "sweep: {robots: []}": "a list of values",
    "sweep: {robots: 3}": "a list of values", "sweep: {robots: [0]}": r"sweep.robots\[0\]",
    "sweep: {robots: [2, 2]}": "not 2 twice", "sweep: {risk: [paper, logg]}": "did you mean 'log'",
    "sweep: {density: [0.5]}": "sweep.density.*above 1", "sweep: {ratio: [0.2, 0.9]}": "sweep.ratio.*360 threats",
    "base: {input: none.yaml}": "no such file",
    "base: {input: 'example:paper'}\nmaps: 3": "no maps, since the input is a single map",
    "base: {input: 'example:paper'}\nsweep: {size: [3x3]}": "size is for the paper's",
    "base: {input: 'example:paper'}\nsweep: {kind: [scattered]}": "no generated threats",
    "base: {unknown: free}": "unknown key `base.unknown`", "base: {map: floor.npz}": "use `input: FILE`",
    "base: {seed: 3}": "unknown key `base.seed`",
    "base: {loop: open}\nsweep: {threat_checks: [first_visit]}": "needs the closed loop",
    "sweep: {'threats[0].scale': [1]}": "an input in `base`", "base: {starts: [[0]]}": "row, col",
    "base: {robots: 2, starts: [[1, 1]]}": "2 robots and 1 starts",
    "maps: 0": "expected a whole number, 1 to 1000000", "first_seed: 18446744073709551615": "at most 2..64",
    "rollouts: 1.5": "a whole number", "[1, 2]": "expected keys", "maps: {": "line 1",
}  # fmt: skip


@pytest.mark.parametrize(
    "how",
    [{"scheduler": "nonsense"}, {"processes": 0}, {"processes": 2, "scheduler": "x"}, {"precision": 5}, {"maps": 0}],
)
def test_no_store_is_made_for_a_run_that_cannot_begin(
    tmp_path: Path, how: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    path, store = spec_file(tmp_path), tmp_path / "a.store"
    words = [word for name, value in how.items() for word in (f"--{name}", str(value))]
    said = next(reversed(how))
    if said != "maps":
        with pytest.raises(InputError, match=said):
            mrac.sweep(path, store, progress=False, **how)
        assert said in refused(capsys, "sweep", str(path), "--store", str(store), *words)
    if said != "precision":
        with pytest.raises(InputError, match=said):
            mrac.check(paper="fig4", store=store, progress=False, **how)
        assert said in refused(capsys, "check", "--paper", "fig4", "--store", str(store), *words)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Sweep twice, then look, filter, draw, export and merge."""
    path, store, out = str(spec_file(tmp_path)), str(tmp_path / "a.store"), tmp_path / "out"
    first = answer_of(capsys, "sweep", path, "--store", store, "--processes", "1")
    assert first["rollouts_run"] == 5 * 8 * 40 and first["partial"] is False and len(first["settings"]) == 8
    assert run(["sweep", path, "--store", store, "--processes", "1", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "nothing to run" in said.out and "1,600 taken from the store" in said.out
    assert {file.name for file in out.iterdir()} >= {"index.html", "visited.png", "time.png", "rows.csv", "sweep.json"}
    again = json.loads((out / "sweep.json").read_text())
    assert again["settings"] == first["settings"]
    page = (out / "index.html").read_text()
    assert "a mean over 5\N{NO-BREAK SPACE}maps: from" in page and "<svg" in page
    assert "https://" not in page and "http://" not in page.replace("http://www.w3.org", "")
    found = answer_of(capsys, "results", store)
    assert found["runs"] == 40 and found["common"]["kind"] == "contiguous"
    by_label = {json.dumps(row["setting"], sort_keys=True): row["visited"] for row in found["settings"]}
    assert by_label == {json.dumps(row["setting"], sort_keys=True): row["visited"] for row in first["settings"]}
    files = [str(tmp_path / name) for name in ("p.png", "r.csv", "r.parquet")]
    exports = ["--plot", files[0], "--csv", files[1], "--parquet", files[2]]
    assert run(["results", store, "--where", "robots=3", "--where", "risk=paper,log", *exports]) == 0
    capsys.readouterr()
    with Path(files[1]).open() as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == 20 and {row["robots"] for row in rows} == {"3"}
    parquet = pytest.importorskip("pyarrow.parquet").read_table(files[2]).to_pylist()
    assert [float(row["visited_mean"]) for row in rows] == [row["visited_mean"] for row in parquet]
    assert parquet[0]["robots"] == 3 and parquet[0]["risk"] in ("paper", "log")
    assert Path(files[0]).read_bytes().startswith(b"\x89PNG")
    with Store.open(tmp_path / "b.store") as other:
        run_cases([next(read_spec(spec_file(tmp_path, SPEC.replace("seed: 3", "seed: 9"))).jobs())], other, processes=1)
    union = str(tmp_path / "union.store")
    assert answer_of(capsys, "results", union, "--merge", store, "--merge", str(tmp_path / "b.store"))["runs"] == 42


def test_commands_name_every_figure() -> None:
    assert commands.FIGURES == pooling.FIGURES == tuple(report.NAMES)


def test_results_bad_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store, spec = tmp_path / "a.store", str(tmp_path / "try.yaml")
    with Store.open(store) as opened:
        run_cases([next(read_spec(spec_file(tmp_path)).jobs())], opened, processes=1)
    empty = tmp_path / "empty.store"
    Store.open(empty).close()
    wrong = {
        ("results", str(tmp_path / "none.store")): "no such file",
        ("results", str(empty)): "holds no rollouts",
        ("results", str(store), "--where", "robots"): "NAME=VALUE",
        ("results", str(store), "--where", "robot=1"): "did you mean 'robots'",
        ("results", str(store), "--where", "robots=7"): "expected robots of 1",
        ("results", str(store), "--by", "kin"): "did you mean 'kind'",
        ("results", str(store), "--plot", str(tmp_path / "a.jpg")): "does not end in .png",
        ("results", str(store), "--csv", str(tmp_path / "no" / "a.csv")): "no folder",
        ("results", str(store), "--merge", str(store)): "the store itself",
        ("results", str(store), "--figure", "cells"): "visited or survived",
        ("sweep", spec, "--store", spec): "is not a store",
        ("sweep", spec, "--precision", "2", "--store", str(empty)): "--precision 2",
        ("sweep", spec, "--scheduler", "tcp://a:1", "--processes", "2", "--store", str(empty)): "one of them",
    }  # fmt: skip
    for words, message in wrong.items():
        assert run(list(words)) == 2, words
        said = capsys.readouterr()
        assert said.out == "" and message in said.err.splitlines()[-1], (words, said.err)


def test_interrupted_sweep_says_what_was_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from analysis.sweeps import sweep as module

    def until_seven(jobs: object, store: Store, **where: object) -> object:
        progress = where.pop("progress")

        def stop(step: Done) -> None:
            progress(step)  # type: ignore[operator]
            if step.jobs == 7:
                raise KeyboardInterrupt

        return run_cases(jobs, store, progress=stop, **where)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "run_cases", until_seven)
    path, store = str(spec_file(tmp_path)), str(tmp_path / "a.store")
    found = answer_of(capsys, "sweep", path, "--store", store, "--processes", "1", status=130)
    assert found["partial"] is True and [row["maps"] for row in found["settings"]] == [2, 2, 2, 2, 2, 2, 1, 1]
    assert run(["sweep", path, "--store", store, "--processes", "1", "--json"]) == 130


def test_figures_of_a_run_are_those_of_its_tally(tmp_path: Path) -> None:
    with Store() as store:
        run_cases([next(read_spec(spec_file(tmp_path)).jobs())], store, processes=1)
        found = next(store.runs())
        tally = store.tally(found.key)
        values = np.repeat(np.arange(len(tally.visited)), tally.visited) / tally.accessible
        means, errors = pooling.figures_of(found)
        mean, squared = means[pooling.KEPT["visited"], 0], errors[pooling.KEPT["visited"], 0, 0]
        assert mean == pytest.approx(values.mean()) and squared == pytest.approx(values.var(ddof=1) / len(values))
        mean, squared = means[pooling.KEPT["complete"], 0], errors[pooling.KEPT["complete"], 0, 0]
        share = tally.outcomes[0] / tally.rollouts
        assert mean == share and squared == pytest.approx(share * (1 - share) / (tally.rollouts - 1))


# Rows of `results` that pool settings: a map counts once, and the intervals hold the truth as often as they say.

SPEC_POOLED = """
base: {kind: contiguous, size: 7x9, ratio: 0.2}
maps: 4
rollouts: 30
sweep: {robots: [1, 2], risk: [paper, log]}
"""
CELLS = 40
"""Accessible cells of the made-up maps."""


def test_a_row_counts_a_map_once(tmp_path: Path) -> None:
    """Against a plain calculation: settings averaged on each map, then Student's interval over the maps."""
    with Store() as store:
        swept(tmp_path, SPEC_POOLED, store)
        found = pooling.collect(store, {}, ["robots"])
        assert [row.maps for row in found.rows] == [4, 4] and [row.rollouts for row in found.rows] == [240, 240]
        assert found.runs == 16 and found.pooled == ("risk",)
        (note,) = found.notes
        assert "pooled over risk: log, paper" in note and "by=['robots', 'risk']" in note
        for row in found.rows:
            places = [{"robots": (str(row.labels["robots"]),), "map": (str(seed),)} for seed in range(4)]
            means = [
                np.mean(
                    [pooling.figures_of(each)[0][pooling.KEPT["visited"], 0] for each in pooling.select(store, place)]
                )
                for place in places
            ]
            assert row.estimate("visited").mean == pytest.approx(np.mean(means))
            assert row.estimate("visited").se == pytest.approx(np.std(means, ddof=1) / 2)
        everything = pooling.collect(store, {}, ["kind"]).rows
        assert [(row.maps, row.rollouts) for row in everything] == [(4, 480)]
        apart = pooling.collect(store, {}).rows
        assert [row.maps for row in apart] == [4] * 4 and not pooling.collect(store, {}).notes


def test_one_map_is_one_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The README's example in small: the interval is that of the rollouts, and the table says so."""
    random_world(7, 9, ThreatPattern(seed=4)).save(tmp_path / "world.npz")
    text = "base: {input: world.npz}\nrollouts: 200\nsweep: {robots: [1, 2], risk: [paper, log]}"
    path = tmp_path / "a.store"
    with Store.open(path) as store:
        swept(tmp_path, text, store)
        rows = sorted(pooling.collect(store, {}, ["robots", "risk"]).rows, key=lambda row: str(row.labels["robots"]))
        singles = [row.estimate("visited") for row in rows]
        pooled = [row.estimate("visited") for row in pooling.collect(store, {}, ["robots"]).rows]
    for mean, first, second in zip(pooled, singles[::2], singles[1::2], strict=True):
        assert mean.mean == pytest.approx((first.mean + second.mean) / 2)
        assert mean.half_width == pytest.approx((first.half_width + second.half_width) / 2)
    assert run(["results", str(path), "--by", "robots", "--plot", str(tmp_path / "p.png")]) == 0
    said = capsys.readouterr()
    assert "Each row: 1 map, 400 rollouts." in said.out and "error over rollouts on that map" in said.out
    assert "pooled over risk: log, paper" in said.out
    answer = answer_of(capsys, "results", str(path), "--by", "robots")
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
    with Store() as store:
        swept(tmp_path, text, store)
        assert len({each.facts["world"] for each in store.runs()}) == 4 and len(store) == 12
        assert {pooling.map_of(each) for each in store.runs()} == {("input", "danger.yaml")}
        rows = pooling.collect(store, {}, ["ratio"]).rows
        assert [(row.maps, row.rollouts) for row in rows] == [(1, 120), (1, 120)]
        assert [(row.maps, row.rollouts) for row in pooling.collect(store, {}).rows] == [(1, 60)] * 4


def test_inputs_are_maps(tmp_path: Path) -> None:
    for number in range(3):
        random_world(6, 8, ThreatPattern(seed=number)).save(tmp_path / f"{number}.npz")
    text = "base: {robots: 1}\nrollouts: 20\nsweep: {input: [0.npz, 1.npz, 2.npz], risk: [paper, log]}"
    with Store() as store:
        swept(tmp_path, text, store)
        (row,) = pooling.collect(store, {}, ["robots"]).rows
        assert (row.maps, row.rollouts) == (3, 120)
        assert row.moments.shared[pooling.KEPT["visited"]] > 0  # all three were rolled out with seed 0
        (row,) = pooling.collect(store, {"input": ("1.npz",)}, ["robots"]).rows
        assert row.maps == 1


def test_maps_that_lack_a_setting_are_left_out(tmp_path: Path) -> None:
    less = SPEC_POOLED.replace("maps: 4", "maps: 7").replace("[paper, log]", "[log]")
    with Store() as store:
        swept(tmp_path, SPEC_POOLED, store)
        swept(tmp_path, less, store)
        found = pooling.collect(store, {}, ["robots"])
        assert [row.maps for row in found.rows] == [4, 4] and found.runs == 16
        assert [note for note in found.notes if note.startswith("robots 1: 3 maps of 7 lack some")]
        assert [row.maps for row in pooling.collect(store, {}).rows] == [7, 7, 4, 4]
        with pytest.raises(UsageError, match=r"robots 1: no map has every risk.*by=\['robots', 'risk'\]"):
            pooling.collect(apart(store), {}, ["robots"])


def apart(store: Store) -> Store:
    """The same, but the maps of odd seeds have one risk and those of even seeds the other."""

    class Half(Store):
        def runs(self):  # type: ignore[no-untyped-def]
            return (each for each in store.runs() if (each.what["risk"] == "log") == (each.what["map"] in (1, 3)))

    return Half()


def part(setting: int, seed: int, mean: float, error: float) -> pooling.Part:
    means, errors = np.zeros((len(pooling.KEPT), TERMS)), np.zeros((len(pooling.KEPT), TERMS, TERMS))
    means[:, 0], errors[:, 0, 0] = mean, error**2
    return pooling.Part("", (setting,), seed, 100, 0, means, errors)


TRIALS = 250
SLACK = 3 * math.sqrt(0.05 * 0.95 / TRIALS)
"""Three standard errors of a share of 95 % in so many trials."""


def pooled(random: np.random.Generator) -> list[list[pooling.Part]]:
    """20 maps x 3 settings, which share the map and most of their luck."""
    maps = []
    for seed in range(20):
        middle, luck, own = random.normal(0.0, 1.0), random.normal(0.0, 0.3), random.normal(0.0, 0.2, 3)
        maps.append([part(s, seed, middle + s - 1 + luck + own[s], math.hypot(0.3, 0.2)) for s in range(3)])
    return maps


def one_seed(random: np.random.Generator) -> list[list[pooling.Part]]:
    """12 maps rolled out with one seed, on all of which the luck is the same."""
    luck = random.normal(0.0, 0.5)
    return [[part(0, 7, random.normal(0.0, 1.0) + luck, 0.5)] for _ in range(12)]


@pytest.mark.parametrize(("make", "most", "wide"), [(pooled, 0.95 + SLACK, 1.15), (one_seed, 1.0, 1.25)])
def test_intervals_over_maps_of_parts(make: Callable[..., list[list[pooling.Part]]], most: float, wide: float) -> None:
    """They hold 95 % of the time, and are hardly wider than Student's (1.07 times the normal's of 20 maps)."""
    random = np.random.default_rng(0)
    found = [pooling.moments_over(make(random)).estimate(pooling.KEPT["time"], -np.inf, np.inf) for _ in range(TRIALS)]
    inside = np.mean([each.ci95[0] <= 0 <= each.ci95[1] for each in found])
    spread = np.std([each.mean for each in found])
    assert 0.95 - SLACK < inside <= most
    assert np.mean([each.half_width for each in found]) / spread / 1.96 < wide


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
        found: list[tuple[pooling.Setting, Run, Tally]] = [
            ((chance,), RUN, tally_of(luck[0 if common else number], chance, 0))
            for number, chance in enumerate(chances)
        ]
        estimate = pooling.single_over(found)["visited"]
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
    assert pooling.single_over([((), RUN, tally) for tally in tallies]) == pooling.single_map(RUN, whole)


def test_complete() -> None:
    first, second, third = ([part(s, 0, 0.0, 0.0) for s in settings] for settings in ((0, 1), (1, 0, 1), (1,)))
    assert pooling.complete([first, second, third]) == [first, second]
    assert pooling.complete([third, [part(0, 0, 0.0, 0.0)]]) == []


MAPS = 1500
"""Of which samples are drawn, one map as often as it comes: their mean is the truth, however many they are."""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "robots", "rollouts"), [*product(("contiguous", "scattered"), (2, 8), (20, 60))])
def test_intervals_over_maps_hold_with_the_control(tmp_path: Path, kind: str, robots: int, rollouts: int) -> None:
    """300 samples of 60 maps drawn of 1,500: each figure of a row, and its difference from another policy, holds the
    mean of all as often as it says (3 standard errors below .95); the control halves what noise the rollouts leave."""
    text = f"base: {{kind: {kind}, robots: {robots}, size: 12x14}}\nmaps: {MAPS}\nrollouts: {rollouts}\n"
    with Store() as store:
        swept(tmp_path, text + "sweep: {policy: [mrac, per_cell]}", store)
        found: dict[tuple[str, int], tuple[np.ndarray, np.ndarray]] = {
            (str(each.what["policy"]), int(each.what["map"] or 0)): pooling.figures_of(each) for each in store.runs()
        }
    means = {name: np.mean([found[name, n][0] for n in range(MAPS)], axis=0)[:, 0] for name in ("mrac", "per_cell")}
    random, names, held, gains = np.random.default_rng(0), ("visited", "survived", "time", "alive"), [], []
    for _ in range(300):
        rows = [pooling.Row({}), pooling.Row({})]
        rows[1].first = rows[0].moments
        for number in random.integers(MAPS, size=60).tolist():
            one, other = (found[name, number] for name in ("mrac", "per_cell"))
            for row, mine in zip(rows, (one, other), strict=True):
                row.add(*mine, rollouts - 1, one[0])
        truths = [means["per_cell"][pooling.KEPT[name]] for name in names]
        truths += [float((means["per_cell"] - means["mrac"])[pooling.KEPT[name]]) for name in pooling.DIFFERENCES]
        estimates = [rows[1].estimate(name) for name in names] + [
            rows[1].difference(name) for name in pooling.DIFFERENCES
        ]  # type: ignore[list-item]
        held.append(
            [low <= truth <= high for truth, (low, high) in zip(truths, (e.ci95 for e in estimates), strict=True)]
        )
        by, spread = rows[1].moments.weights(pooling.KEPT["visited"]), rows[1].moments.within[pooling.KEPT["visited"]]
        gains.append(spread[0, 0] / (by @ spread @ by))
    assert (np.mean(held, axis=0) >= 0.95 - 3 * math.sqrt(0.95 * 0.05 / 300)).all(), np.mean(held, axis=0)
    assert np.median(gains) > 2


# Sweeps of what robots know and of moving threats: the answer of `evaluate` on the same map, and what is wrong.

TRUE = random_world(7, 9, ThreatPattern(seed=4), obstacles=0.15)
GUARD = "{patrol: [[1, 2], [1, 3], [2, 3], [2, 2]], h: 0.3}"
ROLLOUTS = 1100
"""Enough for the control by total tolerance, on both sides."""


def swept_unsaid(folder: Path, text: str, rollouts: int = ROLLOUTS) -> Sweep:
    TRUE.save(folder / "true.npz", force=True)
    (folder / "dark.yaml").write_text("map: true.npz\nprior_map: {p: 0.04}\nsensor_range: .inf\nrobots: {count: 2}\n")
    (folder / "try.yaml").write_text(f"{text}\nrollouts: {rollouts}\n")
    with Store.open(folder / "try.store") as store:
        return run_sweep(read_spec(folder / "try.yaml"), store, processes=1)


def dark(sensor: float, obstacles: str = "unknown") -> World:
    return TRUE.with_prior_map(0.04, obstacles, sensor_range=sensor)  # type: ignore[arg-type]


def mined(world: World, kind: str = "persistent", learn: bool = True) -> World:
    return world.with_latent_hazard(kind, np.nan_to_num(world.threat), 0.5, learn)


FINDS = {"range": 1, "detect": 0.8, "false_alarm": 0.1}
LEARN = "{kind: %s, h: 0.5, learn: true}"
WALKS = [{"walk": 0.5, "h": "threats"}]
SWEEPS = {
    "base: {input: dark.yaml}\nsweep: {sensor_range: [1, 2, .inf]}": [dark(1), dark(2), dark(inf)],
    "base: {input: true.npz, robots: 2, sensor_range: {range: 2, sight: true}}\n"
    "sweep: {prior_map: [{p: 0.04}, {p: 0.04, obstacles: known}]}": [
        TRUE.with_prior_map(0.04, obstacles, {"range": 2, "sight": True}) for obstacles in ("unknown", "known")
    ],
    "base: {input: dark.yaml, sensor_range: 0, prior_map: {p: 0.04, obstacles: known}}\nsweep: {prior.p: [0.04]}": [
        dark(0, "known")
    ],
    "base: {input: true.npz, robots: 2, plan_on: own}\n"
    "sweep: {moving_threats: [[{walk: 0.5, h: threats}], [{walk: 1, h: threats}]]}": [
        TRUE.with_moving_threats([{"walk": stay, "h": "threats"}], "own") for stay in (0.5, 1)
    ],
    f"base: {{input: true.npz, robots: 1, moving_threats: [{GUARD}]}}\nsweep: {{'movers[0].h': [0.1, 0.3]}}": [
        TRUE.with_moving_threats([{"patrol": [[1, 2], [1, 3], [2, 3], [2, 2]], "h": h}]) for h in (0.1, 0.3)
    ],
    f"base: {{input: true.npz, robots: 2, latent_hazard: {LEARN % 'persistent'}}}\n"
    "sweep: {latent_hazard.learn: [true, false]}": [
        mined(TRUE), mined(TRUE, learn=False)
    ],
    "base: {input: true.npz, robots: 2, sensor_range: {range: 1, detect: 0.8, false_alarm: 0.1}}\n"
    f"sweep: {{latent_hazard: [{LEARN % 'persistent'}, {LEARN % 'consumed'}]}}": [
        mined(TRUE, kind).with_sensor_range(FINDS) for kind in ("persistent", "consumed")
    ],
    "base: {input: true.npz, robots: 2}\nsweep: {map_uncertainty: [{spread: {kind: lognormal, sigma: 0.5}}]}": [
        TRUE.with_spread("lognormal", 0.5)
    ],
}  # fmt: skip


def held_against(row: pooling.Row, world: World, plan: mrac.Plan | int, *names: str) -> Evaluation:
    """What `evaluate` says on the row's rollouts, which is what the row says of "visited", and of `names`."""
    alone = mrac.evaluate(world, plan, rollouts=ROLLOUTS, exact="never", engine="numba", advice=False, band=False)
    known = {"visited": alone.figures.visited.mean.times(1 / alone.cells["accessible"]), "time": alone.figures.time}
    for name in ("visited", *names):
        found = row.estimate(name)
        assert (found.mean, *found.ci95) == pytest.approx((known[name].mean, *known[name].ci95), rel=1e-12), name
    return alone


@pytest.mark.parametrize("text", SWEEPS)
def test_a_row_is_what_evaluate_says(text: str, tmp_path: Path) -> None:
    robots = 1 if "robots: 1" in text else 2
    for row, world in zip(swept_unsaid(tmp_path, text).rows, SWEEPS[text], strict=True):
        alone = held_against(row, world, robots, "time")
        exact = alone.closed_form.visited / alone.cells["accessible"]
        known = row.known("exact visited")
        assert np.isnan(exact) if known is None else known.mean == pytest.approx(exact)


OF_TEAMS = {
    "range: 20, return_to: home": "robots: [3, 4]",
    "range: 14, return_to: home, recharge: 3": "policy: [mrac, per_cell]",
    "hazard_multiplier: 2, start: upper-left": "robots: [3, 1]",
    "hazard_multiplier: [1, 3]": "starts: [[[0, 3], [4, 0]]]",
}


@pytest.mark.parametrize("block", OF_TEAMS)
def test_a_row_of_another_team_keeps_to_the_rest_of_the_robots_block(block: str, tmp_path: Path) -> None:
    """That of `evaluate` with its options `robots`, `starts` and `policy`; so do robots that are charged."""
    TRUE.save(tmp_path / "true.npz")
    (tmp_path / "team.yaml").write_text(f"map: true.npz\nrobots: {{count: 2, {block}}}\n")
    world = mrac.load(tmp_path / "team.yaml")
    ((name, values),) = yaml.safe_load(f"{{{OF_TEAMS[block]}}}").items()
    rows = swept_unsaid(tmp_path, f"base: {{input: team.yaml}}\nsweep: {{{OF_TEAMS[block]}}}").rows
    for row, value in zip(rows, values, strict=True):
        held_against(row, world, mrac.plan(world, **{name: value}))


def test_so_many_robots_are_the_first_of_those_that_the_input_places(tmp_path: Path) -> None:
    TRUE.save(tmp_path / "true.npz")
    (tmp_path / "team.yaml").write_text("map: true.npz\nrobots: {starts: [[4, 0], [0, 3]]}\n")
    rows = swept_unsaid(tmp_path, "base: {input: team.yaml}\nsweep: {robots: [1, 2]}").rows
    world = mrac.load(tmp_path / "team.yaml")
    for row, starts in zip(rows, ([[4, 0]], [[4, 0], [0, 3]]), strict=True):
        held_against(row, world, mrac.plan(world, starts=starts))


def test_random_maps_are_gone_on_with(tmp_path: Path) -> None:
    """All of them look alike to robots that know nothing, and yet each is a run of its own."""
    text = "base: {size: 6x8, robots: 2, prior_map: {p: 0.04}}\nmaps: %d\nseed: 3\nsweep: {sensor_range: [1, 2]}"
    swept_unsaid(tmp_path, text % 2, 30)
    answer = swept_unsaid(tmp_path, text % 3, 30)
    assert (answer.finished.rollouts, answer.finished.reused) == (2 * 30, 4 * 30)
    for row, sensor in zip(answer.rows, (1, 2), strict=True):
        found = [covered(small(n).with_prior_map(0.04, sensor_range=sensor), 2, "mrac", 3 + n, 30) for n in range(3)]
        assert row.estimate("visited").mean == pytest.approx(np.mean(found))


SHIFT = random_world(6, 8, ThreatPattern("scattered", seed=9), obstacles=0.0, threats=0.3)


def shifted(world: World) -> World:
    both = 1 - (1.0 - world.threat) * (1.0 - SHIFT.threat)
    return world.with_phases([(9, np.where(world.free, both, np.nan))])


ON_RANDOM_MAPS = [
    ("latent_hazard", "{kind: persistent, h: 0.5, learn: true}", mined),
    ("phases", "[{from: 9, threats: [{raster: %s}]}]", shifted),
]


@pytest.mark.parametrize(("key", "value", "made"), ON_RANDOM_MAPS)
def test_random_maps_have_hazards_and_phases(key: str, value: str, made: Any, tmp_path: Path) -> None:
    np.save(tmp_path / "shift.npy", SHIFT.threat)
    text = f"base: {{size: 6x8, robots: 2}}\nmaps: 3\nseed: 3\nsweep: {{{key}: [{value}]}}"
    (row,) = swept_unsaid(tmp_path, text.replace("%s", str(tmp_path / "shift.npy")), 30).rows
    found = [covered(made(small(n)), 2, "mrac", 3 + n, 30) for n in range(3)]
    assert row.estimate("visited").mean == pytest.approx(np.mean(found))


def small(seed: int) -> World:
    return random_world(6, 8, ThreatPattern(seed=seed))


def covered(world: World, robots: int, policy: str, seed: int, rollouts: int) -> float:
    plan = make_plan(world, place_starts(world, robots)[0], mrac.Settings(policy=policy))
    tally = run_range(compile_closed_loop(plan, world), seed, 0, rollouts)[0]
    return float(tally.visited @ np.arange(tally.accessible + 1)) / rollouts / tally.accessible


def test_null_leaves_a_key_out_and_names_are_shown(tmp_path: Path) -> None:
    text = "base: {size: 6x8, plan_on: own}\nmaps: 1\nsweep: {moving_threats: [null, [{walk: 1, h: threats}]]}"
    told, among = swept_unsaid(tmp_path, text, 10).rows
    assert told.estimate("visited").mean == pytest.approx(covered(small(0), 1, "mrac", 0, 10))
    assert told.known("ideal") is not None and among.known("ideal") is None
    assert among.labels == {"moving_threats": '[{"h":"threats","walk":1}]'}
    assert read_spec(tmp_path / "try.yaml").labels(0, 0) == {"moving_threats": "null"}


OF_THREE = "base: {input: team.yaml}\nsweep: {robots: [3]}"
REFUSED = [
    ("count: 2, radio: 3", OF_THREE, "team.yaml robots=3: a sweep with radio; leave radio out"),
    ("count: 2, steps_per_move: [1, 2]", OF_THREE, "a sweep with steps_per_move"),
    ("count: 2, matrix: {a: {x: 2}}, types: a", OF_THREE, "a sweep with types"),
    ("count: 2, range: [9, 8]", OF_THREE, "range of 2 robots for a team of 3; expected one number"),
    ("count: 2, hazard_multiplier: [1, 3]", OF_THREE, "hazard_multiplier of 2 robots for a team of 3; expected one"),
    ("starts: [[0, 3], [4, 0]]", OF_THREE, "robots=3 contradicts the 2 starts of .*team.yaml; leave robots out"),
    ("", "sweep: {sensor_range: [1]}", "sweep.sensor_range: .*random map: .*a sensor range has no effect"),
    ("", "base: {prior_map: {p: 0.04}}\nsweep: {sensor_range: [1, 0.5]}", "sweep.sensor_range: .*from 1 on"),
    ("", "base: {sensor_range: 0}\nsweep: {prior_map: [{p: 0.04}]}", "wrong about an obstacle"),
    ("", "sweep: {plan_on: [own]}", "none without moving_threats"),
    ("", "sweep: {prior_map.p: [0.1]}", "there is no prior_map.p to sweep"),
    ("", "sweep: {moving_threats: [[{walk: 0.5, h: often}]]}", "threats"),
    ("", "sweep: {moving_threats: [[{walk: 0.5, h: threats, count: 2}]]}", "count"),
    ("", "sweep: {latent_hazard: [{kind: consumed, learn: often}]}", "learn` is 'often'"),
    ("", "base: {phases: [{from: 0, threats: []}]}\nsweep: {latent_hazard: [{kind: consumed}]}",
     "none together with latent_hazard"),
    ("", "base: {input: true.npz}\nsweep: {true_map: [none.npz]}", "none.npz"),
]  # fmt: skip
"""The robots of team.yaml, a sweep, and what is wrong with it."""


@pytest.mark.parametrize(("robots", "text", "words"), [*(("", *one) for one in BAD.items()), *REFUSED])
def test_what_is_wrong_is_said_before_the_first_rollout(
    robots: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    TRUE.save(tmp_path / "true.npz")
    (tmp_path / "team.yaml").write_text(f"map: true.npz\nrobots: {{{robots}}}\n")
    path = spec_file(tmp_path, text)
    assert "try.yaml" in refused(capsys, "sweep", str(path), "--store", str(tmp_path / "a.store"))
    assert not list(tmp_path.glob("a.store*"))
    with pytest.raises(InputError, match=rf"try.yaml.*{'sweep.robots: ' if robots else ''}.*{words}"):
        read_spec(path)


def test_the_maps_threats_leave_it_and_walk() -> None:
    world = TRUE.with_moving_threats(WALKS, "patrols")
    assert world.moving_threats is not None and (world.threat[TRUE.free] == 0).all()
    assert [mover.hit for mover in world.moving_threats.members] == TRUE.threat[TRUE.threat > 0].tolist()
    joined = TRUE.with_moving_threats(WALKS, "joined").threat[TRUE.free].astype(float)
    assert joined.mean() == pytest.approx(TRUE.threat[TRUE.free].mean(), rel=0.05) and joined.std() < 0.01


TEAM: Team = ("contiguous", 2, "per_cell")


def test_reproduce_online_is_the_maps_rolled_out_by_hand(tmp_path: Path) -> None:
    """Differences are those of the same maps and luck; killed and gone on with, it is the same."""
    with Store.open(tmp_path / "s.db") as store:
        how: Any = {"rollouts": 20, "seed": 5, "teams": (TEAM,), "store": store, "processes": 1}
        study_knowing("online", maps=1, **how)
        study = study_knowing("online", maps=2, **how)
    assert study.finished.reused == study.finished.rollouts == 7 * 20
    by_way: dict[str, list[float]] = {way: [] for way in ("told", "see 2", "blind")}
    for seed in (5, 6):
        world = random_world(pattern=ThreatPattern(seed=seed))
        met = {
            "told": world,
            "see 2": world.with_prior_map(0.04, sensor_range=2),
            "blind": world.with_prior_map(0.04, "known"),
        }
        for way, found in by_way.items():
            found.append(covered(met[way], 2, "per_cell", seed, 20))
    for way, found in by_way.items():
        assert study.estimate(TEAM, way).mean == pytest.approx(np.mean(found))
    apart = study.apart(TEAM, "told", "see 2")
    assert apart.se == pytest.approx(np.subtract(by_way["told"], by_way["see 2"]).std(ddof=1) / 2**0.5)
    names = {path.name for path in study.save(tmp_path / "out")}
    assert names == {"index.html", "online.txt", "online.json", "points.csv", "per_cell.png"}
    said = study.to_json()
    assert said["answer"].startswith("Robots that know nothing of the map and see three cells cover")
    assert {point["way"]: point["visited"]["mean"] for point in said["points"]}["told"] == pytest.approx(
        np.mean(by_way["told"])
    )
    assert len((tmp_path / "out" / "points.csv").read_text().splitlines()) == 1 + 7 * 2
