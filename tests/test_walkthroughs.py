"""CONTRIBUTING.md's walk-throughs, performed: each block is run as if it stood at the end of the file it names."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from closed_loop_compare import assert_same_results, assert_same_tally
from plan_files import load_plan

import mrac_jax as mrac
from analysis.evaluation.report import report
from analysis.report.answer import print_report, report_of
from analysis.sampling import RolloutChoices, make_singles
from analysis.utils.folder import as_text
from planner.errors import InputError
from planner.formatting import percent
from planner.mrac.simulate import ReferenceLoop
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import SETTINGS
from planner.world.scenario import load_input

GUIDE = (Path(__file__).parent.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
BLOCKS = dict(re.findall(r"```python\n# (\S+)\.py\n(.*?)```", GUIDE, re.DOTALL))


def walk_through(monkeypatch: pytest.MonkeyPatch, file: str, table: str) -> dict[str, Any]:
    """The names in `file` after its block; what the block puts into `table` is taken out again."""
    module = import_module(file.replace("/", ".").removesuffix(".__init__"))
    before = dict(getattr(module, table))
    monkeypatch.setattr(module, table, dict(before))
    names = dict(vars(module))
    exec(compile(BLOCKS[file], file, "exec", dont_inherit=True), names)
    assert len(names[table]) == len(before) + 1
    return names


def test_every_block_is_performed() -> None:
    threats, maps, policies = "planner/world/threats", "planner/world/map_files", "planner/policies/__init__"
    question = {"analysis/lasting/search", "analysis/lasting/report"}
    assert set(BLOCKS) - question == {
        threats, maps, policies, "planner/rollouts/engine", "analysis/evaluation/outputs/table",
    }  # fmt: skip


def test_a_source_of_threats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "m.npy", np.full((6, 4), 0.1))
    scenario = tmp_path / "s.yaml"
    scenario.write_text("map: m.npy\nthreats: [{stripes: {every: 3, p: 0.05}}]\n")
    with pytest.raises(InputError, match="stripes"):
        load_input(scenario)
    walk_through(monkeypatch, "planner/world/threats", "SOURCES")
    expected = np.full((6, 4), 0.1)
    expected[::3] = 1 - 0.9 * 0.95
    np.testing.assert_allclose(load_input(scenario).threat, expected, rtol=1e-6)
    scenario.write_text("map: m.npy\nthreats: [{stripes: {every: 0, p: 0.05}}]\n")
    with pytest.raises(InputError, match=r"threats\[0\]\.stripes\.every` is 0; expected a whole number, 1 or more"):
        load_input(scenario)


def test_a_map_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = tmp_path / "yard.drawn"
    drawn.write_text("...#\n....\n")
    with pytest.raises(InputError, match=r"unknown map format '\.drawn'"):
        load_input(drawn)
    walk_through(monkeypatch, "planner/world/map_files", "FORMATS")
    assert load_input(drawn).free.tolist() == [[True, True, True, False], [True] * 4]
    (tmp_path / "s.yaml").write_text("map: yard.drawn\ncell_size: 2\n")
    assert load_input(tmp_path / "s.yaml").free.tolist() == [[True, False]]
    drawn.write_text("...#\n...\n")
    with pytest.raises(InputError, match="expected a rectangle of characters"):
        load_input(drawn)


def test_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = mrac.World.create([[0.1, 0.1, 0.0, 0.1]])
    with pytest.raises(InputError, match="by_size"):
        mrac.plan(world, starts=[[0, 2]], policy="by_size")
    names = walk_through(monkeypatch, "planner/policies/__init__", "RULES")
    monkeypatch.setitem(SETTINGS, "policy", replace(SETTINGS["policy"], words=tuple(names["RULES"])))
    plan = mrac.plan(world, starts=[[0, 2]], policy="by_size")
    assert plan.robots[0].path.tolist() == [2, 1, 0, 1, 2, 3]
    plan.save(tmp_path / "plan.json")
    again = load_plan(tmp_path / "plan.json", world)
    assert again.settings == plan.settings
    assert ReferenceLoop(again, world).run(1, 0).visited.any()


def test_an_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = mrac.load(np.full((4, 4), 0.05))
    plan = mrac.plan(world, robots=3)
    with pytest.raises(InputError, match="evaluate has no argument 'home'; expected one of policy"):
        mrac.evaluate(world, plan, home=2)
    names = walk_through(monkeypatch, "analysis/evaluation/outputs/table", "OUTPUTS")
    monkeypatch.setattr("analysis.evaluation.evaluate.OUTPUTS", names["OUTPUTS"])
    with pytest.raises(InputError, match="home=0; expected a whole number of robots"):
        mrac.evaluate(world, plan, home=0)
    answer = mrac.evaluate(world, plan, rollouts=512, home=2)
    share = float(answer.tally.alive[2:].sum() / 512)
    assert 0 < share < 1
    assert (answer.to_json()["home"]["robots"], answer.to_json()["home"]["mean"]) == (2, share)
    said = f"2 robots or more left: {percent(share)} of runs"
    assert said in as_text(lambda console: print_report(report(answer), console))
    assert said in (answer.save(tmp_path)[0]).read_text(encoding="utf-8").replace("\xa0", " ")
    assert "home" not in mrac.evaluate(world, plan, rollouts=64).to_json()


def test_a_question(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("lasting", "lasting.search", "lasting.report"):
        module = ModuleType(f"analysis.{name}")
        monkeypatch.setitem(sys.modules, module.__name__, module)
        if name != "lasting":
            exec(compile(BLOCKS[f"analysis/{name.replace('.', '/')}"], name, "exec", dont_inherit=True), vars(module))
    world = mrac.load(np.full((4, 4), 0.05))
    plan = mrac.plan(world, robots=3)
    choices = RolloutChoices(rollouts=512)
    answer = sys.modules["analysis.lasting.search"].find_lasting(world, plan, choices)
    share = float((make_singles(world, plan, choices)(0, 512).alive == 3).mean())
    assert 0 < share < 1
    said = f"Nobody is lost in {percent(share)} of runs."
    assert answer.to_json()["chance"]["mean"] == share and said in repr(answer)
    assert said in as_text(lambda console: print_report(report_of(answer), console))
    pages = [
        path.read_text(encoding="utf-8").replace("\xa0", " ")
        for path in answer.save(tmp_path)
        if path.suffix == ".html"
    ]
    assert len(pages) == 1 and said in pages[0]


def test_a_back_end(monkeypatch: pytest.MonkeyPatch) -> None:
    world = mrac.load("example:paper")
    plan = mrac.plan(world, robots=4)
    names = walk_through(monkeypatch, "planner/rollouts/engine", "CLOSED_LOOP")
    for module in ("planner.rollouts.engine", "analysis.sampling"):
        monkeypatch.setattr(f"{module}.ENGINES", ("auto", "jax", "numba", "halves"))
    halves, numba = (make_engine(plan, world, Rolling(seed=3), name) for name in ("halves", "numba"))  # type: ignore[arg-type]
    assert isinstance(halves, names["InHalves"])
    for start, count in ((0, 1), (7, 501)):
        (tally, results), (other, others) = halves.run(start, count), numba.run(start, count)
        assert_same_tally(tally, other)
        assert_same_results(results, others)
    answers = [mrac.evaluate(world, plan, rollouts=512, engine=name, band=False) for name in ("halves", "numba")]  # type: ignore[arg-type]
    assert [answer.engine for answer in answers] == ["halves", "numba"]
    assert_same_tally(answers[0].tally, answers[1].tally)
