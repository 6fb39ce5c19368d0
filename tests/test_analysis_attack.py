"""`mrac-jax attack`: the worst places against brute force, `clear` as its way back, hidden truths, wrong input."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from page_reader import Reader

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.sampling import make_singles
from analysis.search import threat_placement as search
from analysis.search.place_reports import attack_findings, attack_headline, attack_report
from analysis.search.threat_placement import Attack
from planner.errors import InputError
from planner.policies import RULES
from planner.world.world import World

P, RUNS = 0.4, 64


def small_world(seed: int, height: int, width: int) -> World:
    """Few obstacles, some danger; one robot, whose coverage is a sum of products."""
    draw = np.random.default_rng(seed)
    threat = draw.choice([0.0, 0.0, 0.0, 0.1, np.nan], size=(height, width))
    threat[0, 0] = threat[0, 1] = 0.0
    return World.create(threat, starts=[[0, 0]])


def covered(path: np.ndarray, threat: np.ndarray) -> float:
    """Cells that one robot visits on average along a path: each with the chance that it gets so far."""
    alive, seen, total = 1.0, set[int](), 0.0
    for number, cell in enumerate(path.tolist()):
        total += alive * (cell not in seen)
        seen.add(cell)
        if number == 0 or cell != path[number - 1]:
            alive *= 1.0 - float(threat.flat[cell])
    return total


def brute_force(world: World, count: int) -> tuple[float, float]:
    """What the worst `count` cells leave to a robot that plans anew, and to one that keeps to its path."""
    path, worst = mrac.plan(world).robots[0].path, [np.inf, np.inf]
    free = [int(cell) for cell in np.flatnonzero(world.accessible(world.starts)) if cell != 0]
    for cells in combinations(free, count):
        threat = world.threat.copy()
        threat.flat[list(cells)] = 1.0 - (1.0 - threat.flat[list(cells)].astype(float)) * (1.0 - P)
        anew = mrac.plan(World.create(threat, starts=[[0, 0]])).robots[0].path
        for kind, way in enumerate((anew, path)):
            worst[kind] = min(worst[kind], covered(way, threat))
    return worst[0], worst[1]


def left(answer: Attack) -> tuple[float, float]:
    """What the places that were found leave to both robots."""
    path = mrac.plan(answer.world).robots[0].path
    known = answer.known_world
    return covered(mrac.plan(known).robots[0].path, known.threat), covered(path, answer.hidden_world.threat)


@pytest.mark.parametrize(("seed", "height", "width", "count"), [(0, 6, 6, 1), (1, 6, 6, 1), (2, 3, 5, 2), (3, 3, 5, 2)])
def test_the_worst_places_are_those_of_brute_force(seed: int, height: int, width: int, count: int) -> None:
    world = small_world(seed, height, width)
    answer, best = mrac.attack(world, count=count, p=P), brute_force(world, count)
    assert left(answer) == pytest.approx(best, abs=1e-6)
    base = covered(mrac.plan(world).robots[0].path, world.threat)
    for placed, kind, leaves in ((answer.known, "known", best[0]), (answer.hidden, "hidden", best[1])):
        gain = getattr(placed, kind)
        assert gain.rollouts == 0 and gain.cells.mean == pytest.approx(base - leaves, abs=1e-6)
    assert answer.engine == "" and answer.known.hidden.cells.mean <= answer.hidden.hidden.cells.mean + 1e-9


@pytest.mark.slow
def test_two_threats_on_6x6_are_mostly_those_of_brute_force() -> None:
    """Two that cost little alone may cost a robot most that plans anew: greedy with exchange can miss them."""
    shares = []
    for seed in range(10, 20):
        world = small_world(seed, 6, 6)
        base = covered(mrac.plan(world).robots[0].path, world.threat)
        found, worst = left(mrac.attack(world, count=2, p=P)), brute_force(world, 2)
        shares.append([(base - one) / (base - other) for one, other in zip(found, worst, strict=True)])
    known, hidden = np.transpose(shares)
    assert hidden == pytest.approx(np.ones(10), abs=1e-6)
    assert known.max() <= 1 + 1e-6 and np.sum(known > 1 - 1e-6) >= 8


@pytest.fixture(scope="module")
def attacked() -> Attack:
    world = World.create(np.where(np.add.outer(np.arange(5), np.arange(6)) % 4 == 3, 0.1, 0.0), starts=[[0, 0], [4, 0]])
    return mrac.attack(world, count=2, p=P, rollouts=RUNS, seed=3, engine="numba", exact="never")


def test_clear_gives_back_what_was_placed(attacked: Attack) -> None:
    for world, placed in ((attacked.known_world, attacked.known), (attacked.hidden_world, attacked.hidden)):
        assert np.count_nonzero(world.threat != attacked.world.threat) == 2
        back = mrac.clear(world, count=2, rollouts=16, exact="never")
        assert sorted(one.name for one in back.picks) == sorted(one.name for one in placed.threats)
        assert np.array_equal(back.cleared_world.threat, attacked.world.threat)
        cells = {int(one.cells[0]) for one in placed.threats}
        assert {int(one.threat.cells[0]) for one in back.options} == cells


def test_hidden_is_what_robots_meet_who_believe_the_old_map(attacked: Attack) -> None:
    """A hidden truth (docs/unknown.md), on the very rollouts that were compared."""
    told = attacked.world
    met = [mrac.with_truth(told, world) for world in (attacked.known_world, attacked.hidden_world)]
    base, *others = (
        make_singles(world, mrac.plan(world), attacked.choices)(RUNS, RUNS) for world in (told, *met)
    )  # fmt: skip
    for gain, other in zip((attacked.known.hidden, attacked.hidden.hidden), others, strict=True):
        assert gain is not None and gain.rollouts == RUNS
        assert gain.cells.mean == pytest.approx(np.mean(base.visited.astype(float) - other.visited))
        assert gain.robots.mean == pytest.approx(np.mean(base.alive.astype(float) - other.alive))


def test_what_a_scenario_says_of_combining_is_kept(tmp_path: Path) -> None:
    """The larger chance counts where it says so; the scenario's own threats can be cleared as before."""
    World.create(np.where(np.arange(6) == 3, 0.6, 0.0) * np.ones((2, 1))).save(tmp_path / "map.npz")
    (tmp_path / "points.csv").write_text("x,y,strength\n1.5,1.5,0.3\n")
    (tmp_path / "site.yaml").write_text(
        "map: map.npz\nrobots: {starts: [[0, 0]]}\ncombine: max\n"
        "threats:\n- {points: points.csv, falloff: {kind: disc, radius: 0.6}}\n"
    )
    world = mrac.load(tmp_path / "site.yaml")
    answer = mrac.attack(world, p=0.4)
    assert answer.known_world.threat.max() == np.float32(0.6)  # nothing is gained where it is worse already
    assert [*answer.known_world.sources.names] == ["line 2 of points.csv", answer.known.threats[0].name]  # type: ignore[union-attr]


def test_of_large_maps_some_cells_are_looked_at_and_fewer_planned_for(monkeypatch: pytest.MonkeyPatch) -> None:
    world, best = small_world(0, 6, 6), mrac.attack(small_world(0, 6, 6), p=P)
    monkeypatch.setattr(search, "MOST_PLACES", 12)
    monkeypatch.setattr("analysis.search.threat_removal.TABLES", 0)
    few = mrac.attack(world, p=P)
    assert len(few.turn.options) == 12 and len(few.turn.simulated) == 8
    assert all(one.screen is not None for one in few.turn.options)
    assert [*few.notes] == ["of 27 cells, those 12 where more danger costs the plan's paths most"]
    assert left(few)[0] == pytest.approx(left(best)[0])  # here they hold the worst


def test_an_interruption_leaves_the_threats_so_far() -> None:
    world, calls = small_world(0, 6, 6), list[int]()

    def stop(done: int, total: int, seconds: float) -> None:
        calls.append(done)
        if len(calls) > 40:
            raise KeyboardInterrupt

    answer = mrac.attack(world, count=2, p=P, progress=stop, on_interrupt="return")
    assert answer.partial and len(answer.known.threats) >= 1 and answer.known.known is None
    assert attack_headline(answer).startswith("Interrupted.") and answer.to_json()["known"]["loss"]["known"] is None
    assert not answer.hidden.threats and {*attack_report(answer).files} == {"known.npz", "known.yaml"}


def test_an_answer_by_a_rule_of_one_s_own_has_no_scenario(tmp_path: Path) -> None:
    answer = mrac.attack(small_world(0, 6, 6), p=P, rollouts=16, policy=replace(RULES["per_cell"], name="mine"))
    names = {path.name for path in answer.save(tmp_path / "out")}
    assert "known.npz" in names and "known.yaml" not in names


def test_the_command_says_it_as_json_and_writes_both_maps(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, attacked: Attack
) -> None:
    attacked.world.save(tmp_path / "map.npz")
    words = ["attack", str(tmp_path / "map.npz"), "--count", "2", "--p", str(P), "--rollouts", str(RUNS), "--seed", "3"]
    assert run([*words, "--exact", "never", "--json", "--out", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads(json.dumps(attacked.to_json()))
    assert found["known"]["cells"] == [list(divmod(int(one.cells[0]), 6)) for one in attacked.known.threats]
    assert found["known"]["loss"]["known"]["mean"] == attacked.known.known.cells.mean  # type: ignore[union-attr]
    for name, world in (("known", attacked.known_world), ("hidden", attacked.hidden_world)):
        assert np.array_equal(mrac.load(tmp_path / "out" / f"{name}.npz").threat, world.threat)
    team = mrac.load(tmp_path / "out" / "known.yaml")
    assert team.starts is not None and team.starts.tolist() == attacked.starts.tolist()
    assert team.sha256 == attacked.known_world.sha256
    page = Reader((tmp_path / "out" / "index.html").read_text()).text
    assert attack_headline(attacked) in page and all(said in page for said in attack_findings(attacked))
    assert 2 <= len(repr(attacked).splitlines()) <= 24


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--count", "0"], "--count 0; expected a whole number of threats, 1 to 27"),
        (["--count", "28"], "--count 28; expected a whole number of threats, 1 to 27"),
        (["--p", "0"], "--p 0; expected a chance, 1e-6 or more and below 1"),
        (["--p", "1"], "--p 1; expected a chance, 1e-6 or more and below 1"),
        (["--p", "1e-60"], "--p 1e-60; expected a chance, 1e-6 or more and below 1"),
        (["--plan-for", "open"], "Unknown option: --plan-for"),
    ],
)
def test_bad_options_are_told(capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], said: str) -> None:
    small_world(0, 6, 6).save(tmp_path / "map.npz")
    assert run(["attack", str(tmp_path / "map.npz"), *words, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err.strip().splitlines()[-1]
    assert err.startswith("error: ") and said in err and not (tmp_path / "out").exists()


def test_where_every_cell_is_a_start_there_is_nothing_to_threaten() -> None:
    with pytest.raises(InputError, match="no cell that a robot can reach is left to threaten"):
        mrac.attack(mrac.load(np.zeros((1, 2))), starts=[[0, 0], [0, 1]])
