"""Sweeps of what robots know and of threats that move: the answer of `evaluate` on the same map, and what is wrong."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import mrac_jax as mrac
from analysis.evaluation.answer import Evaluation
from analysis.experiments.information_value import Team, study_knowing
from analysis.sweeps.results import Row
from analysis.sweeps.spec import read_spec
from analysis.sweeps.store import Store
from analysis.sweeps.sweep import Sweep, run_sweep
from planner.errors import InputError
from planner.mrac.make_plan import make_plan
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

TRUE = random_world(7, 9, ThreatPattern(seed=4), obstacles=0.15)
GUARD = "{patrol: [[1, 2], [1, 3], [2, 3], [2, 2]], h: 0.3}"
ROLLOUTS = 1100
"""Enough for the control by total tolerance, on both sides."""


def swept(folder: Path, text: str, rollouts: int = ROLLOUTS) -> Sweep:
    TRUE.save(folder / "true.npz", force=True)
    (folder / "dark.yaml").write_text("map: true.npz\nprior: {p: 0.04}\nsense: .inf\nrobots: {count: 2}\n")
    (folder / "try.yaml").write_text(f"{text}\nrollouts: {rollouts}\n")
    with Store.open(folder / "try.store") as store:
        return run_sweep(read_spec(folder / "try.yaml"), store, processes=1)


def dark(sense: float, obstacles: str = "unknown") -> World:
    return mrac.with_prior(TRUE, 0.04, obstacles, sense=sense)  # type: ignore[arg-type]


def mined(world: World, kind: str = "persistent", learn: bool = True) -> World:
    return mrac.with_hazard(world, kind, np.nan_to_num(world.threat), 0.5, learn)


FINDS = {"range": 1, "detect": 0.8, "false_alarm": 0.1}
LEARN = "{kind: %s, h: 0.5, learn: true}"
WALKS = [{"walk": 0.5, "h": "threats"}]
SWEEPS = {
    "base: {input: dark.yaml}\nsweep: {sense: [1, 2, .inf]}": [dark(1), dark(2), dark(inf)],
    "base: {input: true.npz, robots: 2, sense: {range: 2, sight: true}}\n"
    "sweep: {prior: [{p: 0.04}, {p: 0.04, obstacles: known}]}": [
        mrac.with_prior(TRUE, 0.04, obstacles, sense={"range": 2, "sight": True}) for obstacles in ("unknown", "known")
    ],
    "base: {input: dark.yaml, sense: 0, prior: {p: 0.04, obstacles: known}}\nsweep: {prior.p: [0.04]}": [
        dark(0, "known")
    ],
    "base: {input: true.npz, robots: 2, plan_on: own}\n"
    "sweep: {movers: [[{walk: 0.5, h: threats}], [{walk: 1, h: threats}]]}": [
        mrac.with_movers(TRUE, [{"walk": stay, "h": "threats"}], "own") for stay in (0.5, 1)
    ],
    f"base: {{input: true.npz, robots: 1, movers: [{GUARD}]}}\nsweep: {{'movers[0].h': [0.1, 0.3]}}": [
        mrac.with_movers(TRUE, [{"patrol": [[1, 2], [1, 3], [2, 3], [2, 2]], "h": h}]) for h in (0.1, 0.3)
    ],
    f"base: {{input: true.npz, robots: 2, hazard: {LEARN % 'persistent'}}}\nsweep: {{hazard.learn: [true, false]}}": [
        mined(TRUE), mined(TRUE, learn=False)
    ],
    "base: {input: true.npz, robots: 2, sense: {range: 1, detect: 0.8, false_alarm: 0.1}}\n"
    f"sweep: {{hazard: [{LEARN % 'persistent'}, {LEARN % 'consumed'}]}}": [
        mrac.with_sense(mined(TRUE, kind), FINDS) for kind in ("persistent", "consumed")
    ],
    "base: {input: true.npz, robots: 2}\nsweep: {uncertain: [{spread: {kind: lognormal, sigma: 0.5}}]}": [
        mrac.with_spread(TRUE, "lognormal", 0.5)
    ],
}  # fmt: skip


def held_against(row: Row, world: World, plan: mrac.Plan | int, *names: str) -> Evaluation:
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
    for row, world in zip(swept(tmp_path, text).rows, SWEEPS[text], strict=True):
        alone = held_against(row, world, robots, "time")
        exact = alone.closed_form.visited / alone.cells["accessible"]
        known = row.known("exact visited")
        assert np.isnan(exact) if known is None else known.mean == pytest.approx(exact)


OF_TEAMS = {
    "range: 20, return_to: home": "robots: [3, 4]",
    "range: 14, return_to: home, recharge: 3": "policy: [mrac, per_cell]",
    "susceptibility: 2, start: upper-left": "robots: [3, 1]",
    "susceptibility: [1, 3]": "starts: [[[0, 3], [4, 0]]]",
}


@pytest.mark.parametrize("block", OF_TEAMS)
def test_a_row_of_another_team_keeps_to_the_rest_of_the_robots_block(block: str, tmp_path: Path) -> None:
    """That of `evaluate` with its options `robots`, `starts` and `policy`; so do robots that are charged."""
    TRUE.save(tmp_path / "true.npz")
    (tmp_path / "team.yaml").write_text(f"map: true.npz\nrobots: {{count: 2, {block}}}\n")
    world = mrac.load(tmp_path / "team.yaml")
    ((name, values),) = yaml.safe_load(f"{{{OF_TEAMS[block]}}}").items()
    rows = swept(tmp_path, f"base: {{input: team.yaml}}\nsweep: {{{OF_TEAMS[block]}}}").rows
    for row, value in zip(rows, values, strict=True):
        held_against(row, world, mrac.plan(world, **{name: value}))


def test_so_many_robots_are_the_first_of_those_that_the_input_places(tmp_path: Path) -> None:
    TRUE.save(tmp_path / "true.npz")
    (tmp_path / "team.yaml").write_text("map: true.npz\nrobots: {starts: [[4, 0], [0, 3]]}\n")
    rows = swept(tmp_path, "base: {input: team.yaml}\nsweep: {robots: [1, 2]}").rows
    world = mrac.load(tmp_path / "team.yaml")
    for row, starts in zip(rows, ([[4, 0]], [[4, 0], [0, 3]]), strict=True):
        held_against(row, world, mrac.plan(world, starts=starts))


REFUSED = {
    "count: 2, radio: 3": "team.yaml robots=3: a sweep with radio; leave radio out",
    "count: 2, steps_per_move: [1, 2]": "a sweep with steps_per_move",
    "count: 2, matrix: {a: {x: 2}}, types: a": "a sweep with types",
    "count: 2, range: [9, 8]": "range of 2 robots for a team of 3; expected one number",
    "count: 2, susceptibility: [1, 3]": "susceptibility of 2 robots for a team of 3; expected one number",
    "starts: [[0, 3], [4, 0]]": "robots=3 contradicts the 2 starts of .*team.yaml; leave robots out",
}


@pytest.mark.parametrize("block", REFUSED)
def test_what_another_team_cannot_have_is_found_before_the_first_rollout(block: str, tmp_path: Path) -> None:
    TRUE.save(tmp_path / "true.npz")
    (tmp_path / "team.yaml").write_text(f"map: true.npz\nrobots: {{{block}}}\n")
    (tmp_path / "try.yaml").write_text("base: {input: team.yaml}\nsweep: {robots: [3]}\n")
    with pytest.raises(InputError, match=rf"try.yaml: sweep.robots: .*{REFUSED[block]}"):
        read_spec(tmp_path / "try.yaml")


def test_random_maps_are_gone_on_with(tmp_path: Path) -> None:
    """All of them look alike to robots that know nothing, and yet each is a run of its own."""
    text = "base: {size: 6x8, robots: 2, prior: {p: 0.04}}\nmaps: %d\nseed: 3\nsweep: {sense: [1, 2]}"
    swept(tmp_path, text % 2, 30)
    answer = swept(tmp_path, text % 3, 30)
    assert (answer.finished.rollouts, answer.finished.reused) == (2 * 30, 4 * 30)
    for row, sense in zip(answer.rows, (1, 2), strict=True):
        found = [covered(mrac.with_prior(small(n), 0.04, sense=sense), 2, "mrac", 3 + n, 30) for n in range(3)]
        assert row.estimate("visited").mean == pytest.approx(np.mean(found))


SHIFT = random_world(6, 8, ThreatPattern("scattered", seed=9), obstacles=0.0, threats=0.3)


def shifted(world: World) -> World:
    both = 1 - (1.0 - world.threat) * (1.0 - SHIFT.threat)
    return mrac.with_phases(world, [(9, np.where(world.free, both, np.nan))])


@pytest.mark.parametrize(
    ("key", "value", "made"),
    [
        ("hazard", "{kind: persistent, h: 0.5, learn: true}", mined),
        ("phases", "[{from: 9, threats: [{raster: %s}]}]", shifted),
    ],
)
def test_random_maps_have_hazards_and_phases(key: str, value: str, made: Any, tmp_path: Path) -> None:
    np.save(tmp_path / "shift.npy", SHIFT.threat)
    text = f"base: {{size: 6x8, robots: 2}}\nmaps: 3\nseed: 3\nsweep: {{{key}: [{value}]}}"
    (row,) = swept(tmp_path, text.replace("%s", str(tmp_path / "shift.npy")), 30).rows
    found = [covered(made(small(n)), 2, "mrac", 3 + n, 30) for n in range(3)]
    assert row.estimate("visited").mean == pytest.approx(np.mean(found))


def small(seed: int) -> World:
    return random_world(6, 8, ThreatPattern(seed=seed))


def covered(world: World, robots: int, policy: str, seed: int, rollouts: int) -> float:
    plan = make_plan(world, place_starts(world, robots)[0], mrac.Settings(policy=policy))
    tally = run_range(compile_closed_loop(plan, world), seed, 0, rollouts)[0]
    return float(tally.visited @ np.arange(tally.accessible + 1)) / rollouts / tally.accessible


def test_null_leaves_a_key_out_and_names_are_shown(tmp_path: Path) -> None:
    text = "base: {size: 6x8, plan_on: own}\nmaps: 1\nsweep: {movers: [null, [{walk: 1, h: threats}]]}"
    told, among = swept(tmp_path, text, 10).rows
    assert told.estimate("visited").mean == pytest.approx(covered(small(0), 1, "mrac", 0, 10))
    assert told.known("ideal") is not None and among.known("ideal") is None
    assert among.labels == {"movers": '[{"h":"threats","walk":1}]'}
    assert read_spec(tmp_path / "try.yaml").labels(0, 0) == {"movers": "null"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sweep: {sense: [1]}", "sweep.sense: .*random map: .*nothing to sense"),
        ("base: {prior: {p: 0.04}}\nsweep: {sense: [1, 0.5]}", "sweep.sense: .*from 1 on"),
        ("base: {sense: 0}\nsweep: {prior: [{p: 0.04}]}", "wrong about an obstacle"),
        ("sweep: {plan_on: [own]}", "none without movers"),
        ("sweep: {prior.p: [0.1]}", "there is no prior.p to sweep"),
        ("sweep: {movers: [[{walk: 0.5, h: often}]]}", "threats"),
        ("sweep: {movers: [[{walk: 0.5, h: threats, count: 2}]]}", "count"),
        ("sweep: {hazard: [{kind: consumed, learn: often}]}", "learn` is 'often'"),
        ("base: {phases: [{from: 0, threats: []}]}\nsweep: {hazard: [{kind: consumed}]}", "none beside hazard"),
        ("base: {input: true.npz}\nsweep: {truth: [none.npz]}", "none.npz"),
    ],
)
def test_what_is_wrong_is_said_before_the_first_rollout(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        swept(tmp_path, text, 10)


def test_the_maps_threats_leave_it_and_walk() -> None:
    world = mrac.with_movers(TRUE, WALKS, "patrols")
    assert world.movers is not None and (world.threat[TRUE.free] == 0).all()
    assert [mover.hit for mover in world.movers.members] == TRUE.threat[TRUE.threat > 0].tolist()
    joined = mrac.with_movers(TRUE, WALKS, "joined").threat[TRUE.free].astype(float)
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
            "see 2": mrac.with_prior(world, 0.04, sense=2),
            "blind": mrac.with_prior(world, 0.04, "known"),
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
