"""README.md, the documents and CONTRIBUTING.md: examples run, files that are named are there."""

import ast
import json
import re
import shlex
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers import assert_same_results, assert_same_tally, load_plan
from jsonschema import Draft202012Validator, ValidationError
from make_examples import main, office_floor, paper_world

import analysis.examples
import mrac_jax as mrac
from analysis.cli.app import app
from analysis.evaluation.report import report
from analysis.report.result import print_report, report_of
from analysis.report.schema import FILE, schema
from analysis.sampling import RolloutChoices, make_singles
from analysis.utils.tables import as_text
from planner.errors import InputError
from planner.formatting import percent
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.single_run import PythonLoop
from planner.settings import OPTIONS, SETTINGS
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts

# README.md and the documents: examples run or parse as pasted, and files and modules that are named are there.

ROOT = Path(__file__).parent.parent
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md"))
}
PYTHON = {
    name: "\n".join(blocks)
    for name, text in PAGES.items()
    if name != "CONTRIBUTING.md" and (blocks := re.findall(r"^```python\n(.*?)```", text, re.DOTALL | re.MULTILINE))
}
COMMANDS = [
    (name, line)
    for name, text in PAGES.items()
    for block in re.findall(r"^```[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
    if line.startswith("mrac-jax")
]


FIGURES = {page: re.findall(r"# ([0-9.]*[0-9])\.\.\.", text) for page, text in PYTHON.items()}
MOST = 1024
"""Rollouts of a quick example: where the page gives no figure that would differ."""


def few_rollouts(text: str) -> str:
    return re.sub(r"\brollouts=([\d_]+)", lambda found: f"rollouts={min(int(found[1]), MOST)}", text)


@pytest.mark.parametrize("page", sorted(page for page in PYTHON if page != "docs/start.md"))
def test_the_python_examples_run(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_examples(page, PYTHON[page] if FIGURES[page] else few_rollouts(PYTHON[page]), tmp_path, monkeypatch, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted(page for page in PYTHON if page == "docs/start.md" or not FIGURES[page]))
def test_the_python_examples_run_as_they_stand(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_examples(page, PYTHON[page], tmp_path, monkeypatch, capsys)


def run_examples(
    page: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every page by itself, in an empty folder; a figure that is said (`# 0.822...`) is what comes out."""
    monkeypatch.chdir(tmp_path)
    exec(compile(text, page, "exec", dont_inherit=True), {})
    lines = capsys.readouterr().out.splitlines()
    for figure in FIGURES[page]:
        assert any(line.startswith(figure) for line in lines), (figure, lines)
    for name in re.findall(r'"(\w+\.(?:png|mcap|geojson))"', PYTHON[page]):
        assert (tmp_path / name).exists(), name
    for name in re.findall(r"\bmrac\.(\w+)", PYTHON[page]):
        assert name in mrac.__all__


def test_every_guide_has_examples() -> None:
    assert {"README.md", "docs/start.md", "docs/compare.md", "docs/check.md"} <= set(PYTHON)
    assert len(COMMANDS) > 40


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_the_commands_parse(page: str, line: str) -> None:
    """By the command line's own parser: an option that is renamed or gone is an error here."""
    command, _, _ = app.parse_args(shlex.split(line, comments=True)[1:], exit_on_error=False, print_error=False)
    assert command.__module__.startswith("analysis.cli"), line


@pytest.mark.parametrize("document", PAGES)
def test_what_is_named_is_there(document: str) -> None:
    text = PAGES[document]
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", text):
        assert ((ROOT / document).parent / target).exists(), target
    for named in re.findall(r"`(?:python -m )?((?:analysis|planner|mrac_jax)[./][\w./]+)", text):
        path = ROOT / named.removesuffix(".py").replace(".", "/")
        assert any(found.exists() for found in (ROOT / named, path, path.with_suffix(".py"))), named


def test_the_reference_describes_what_is_there() -> None:
    """Directives for classes and modules, and the members that a module's directive lists."""
    found = re.findall(r"^\.\. auto\w+:: (\S+)\n(?: +:members: (\w.*))?", PAGES["docs/reference.md"], re.MULTILINE)
    names = [".".join(filter(None, (one, member))) for one, members in found for member in members.split(", ")]
    for name in names:
        resolve_name(name)
    assert {*names, "mrac_jax.plots", "mrac_jax.functional"} >= {f"mrac_jax.{name}" for name in mrac.__all__}


def test_programs_of_the_documents_import_what_is_there() -> None:
    """Scripts, and cells of notebooks, which `make docs` alone runs."""
    programs = [path.read_text() for path in (ROOT / "docs").rglob("*.py")]
    for page in PAGES.values():
        programs += re.findall(r"^```{code-cell}\n(?::.*\n)*(.*?)^```", page, re.DOTALL | re.MULTILINE)
    imports = [node for text in programs for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    own = [one for one in imports if (one.module or "").partition(".")[0] in ("planner", "analysis", "mrac_jax")]
    for name in {f"{one.module}.{alias.name}" for one in own for alias in one.names}:
        resolve_name(name)
    assert len(own) > 50


def test_every_page_is_in_the_site() -> None:
    listed = re.findall(r"```{toctree}\n(.*?)```", PAGES["docs/index.md"], re.DOTALL)
    pages = {line for block in listed for line in block.splitlines() if line and not line.startswith(":")}
    assert pages | {"index"} == {name[5:-3] for name in PAGES if name.startswith("docs/")}


def test_the_home_page_lists_every_command() -> None:
    questions = "".join(line for line in PAGES["docs/index.md"].splitlines() if line.startswith("| "))
    commands = {name for name in app if not name.startswith("-")}
    assert len(commands) > 15
    assert {name for name in commands if not re.search(rf"`{name}\b", questions)} == set()


def test_the_readme_names_whose_work_it_stands_on() -> None:
    shipped = (ROOT / "analysis/examples/README.md").read_text(encoding="utf-8")
    assert "matplotlib" in shipped
    for credited in ("Yehoshua", "Agmon", "matplotlib", "Rongelap", "Moving AI", "MIT"):
        assert credited in PAGES["README.md"], credited


# CONTRIBUTING.md's walk-throughs, performed: each block is run as if it stood at the end of the file it names.

BLOCKS = dict(re.findall(r"```python\n# (\S+)\.py\n(.*?)```", PAGES["CONTRIBUTING.md"], re.DOTALL))


def walk_through(monkeypatch: pytest.MonkeyPatch, file: str, table: str) -> dict[str, Any]:
    """The names in `file` after its block; at the end of the test its entry in `table` is taken out again.

    The table is the program's own, not a copy: other modules have imported it by then.
    """
    module = import_module(file.replace("/", ".").removesuffix(".__init__"))
    names = dict(vars(module))
    before = dict(names[table])
    exec(compile(BLOCKS[file], file, "exec", dont_inherit=True), names)
    name, added = names[table].popitem()
    assert names[table] == before
    monkeypatch.setitem(names[table], name, added)
    return names


def test_every_block_is_performed() -> None:
    threats, maps, policies = "planner/world/threats", "planner/world/map_files", "planner/policies/__init__"
    question = {"analysis/lasting/search", "analysis/lasting/report"}
    assert set(BLOCKS) - question == {
        threats, maps, policies, "planner/rollouts/engine", "analysis/evaluation/evaluate",
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
    world = mrac.World.create([[0.1, 0.0, 0.1, 0.1]])
    with pytest.raises(InputError, match="by_size"):
        mrac.plan(world, starts=[[0, 1]], policy="by_size")
    names = walk_through(monkeypatch, "planner/policies/__init__", "RULES")
    monkeypatch.setitem(SETTINGS, "policy", replace(SETTINGS["policy"], words=tuple(names["RULES"])))
    plan = mrac.plan(world, starts=[[0, 1]], policy="by_size")
    assert plan.robots[0].path.tolist() == [1, 2, 3, 2, 1, 0]  # `per_cell` goes to cell 0 first
    plan.save(tmp_path / "plan.json")
    again = load_plan(tmp_path / "plan.json", world)
    assert again.settings == plan.settings
    assert PythonLoop(again, world).run(1, 0).visited.any()


@pytest.mark.usefixtures("one_picture")
def test_an_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = mrac.load(np.full((4, 4), 0.05))
    plan = mrac.plan(world, robots=3)
    with pytest.raises(InputError, match="evaluate has no argument 'home'; expected one of policy"):
        mrac.evaluate(world, plan, home=2)
    walk_through(monkeypatch, "analysis/evaluation/evaluate", "OUTPUTS")
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
    said = f"No robot is lost in {percent(share)} of runs."
    assert answer.to_json()["chance"]["mean"] == share and said in repr(answer)
    assert said in as_text(lambda console: print_report(report_of(answer), console))
    pages = [
        path.read_text(encoding="utf-8").replace("\xa0", " ")
        for path in answer.save(tmp_path)
        if path.suffix == ".html"
    ]
    assert len(pages) == 1 and said in pages[0]


# --- The JSON Schema of the results.


def strict(node: Any) -> Any:
    """The schema with an error for every key that it does not name."""
    if isinstance(node, list):
        return [strict(one) for one in node]
    if not isinstance(node, dict):
        return node
    extended = "properties" in node and "anyOf" in node
    out = {name: value if extended and name == "anyOf" else strict(value) for name, value in node.items()}
    return out | ({"unevaluatedProperties": False} if {"$ref", "properties"} & set(node) else {})


def test_json_objects_follow_the_schema(tmp_path: Path) -> None:
    """Every result has the types of the schema in the package, and no key that it lacks."""
    written = json.loads(FILE.read_text(encoding="utf-8"))
    assert written == json.loads(json.dumps(schema())), "run `python -m analysis.report.schema`"
    world, few, log = mrac.load(np.pad(np.full((3, 3), 0.05), 1)), {"rollouts": 64}, tmp_path / "r.mcap"
    (tmp_path / "s.yaml").write_text("base: {size: 6x6}\nmaps: 2\nrollouts: 8\nsweep: {robots: [1, 2]}")
    more = {"deadline": 9, "marginal_risk": True, "turn": 1, "threat_scale": [0.5, 1]}
    found: dict[str, Any] = {
        "evaluate": mrac.evaluate(world.with_values(2.0, 0.5), 2, **more, **few),
        "compare": mrac.compare((world, 1), (world, 2), **few),
        "front": mrac.front(world, 2, losses=1, **few),
        "size": mrac.size(world, target=0.5, **few),
        "starts": mrac.starts(world, 2, **few),
        "threats_add": mrac.threats(world, 2, add=1, **few),
        "threats_remove": mrac.threats(world, 2, remove=1, **few),
        "check": mrac.check(world, 2, **few),
        "check_worlds": mrac.check(worlds=2, robots=2, size="4x4", **few),
        "check_paper": mrac.check(paper="fig4", maps=2, rollouts=4),
        "sweep": mrac.sweep(tmp_path / "s.yaml", tmp_path / "s.store"), "results": mrac.results(tmp_path / "s.store"),
        "record": mrac.record(world, 2, log, ids=[0]), "inspect": mrac.inspect(log),
        "inspect_replay": mrac.inspect(log, replay=True),
        "inspect_repair": mrac.inspect(log, repair=tmp_path / "s.mcap"),
        "judge": mrac.judge(world, lambda *given: np.zeros(1, int), robots=1, **few),
    }  # fmt: skip
    unsure = world.with_spread("lognormal", 0.5), world.with_latent_hazard("persistent", 0.1, learn=True)
    teams = (world.with_prior_map(0.1, sensor_range=1), 2), (world, mrac.plan(world, 2, steps_per_move=(1, 2)))
    others = [mrac.evaluate(*team, **few) for team in [*((one, 2) for one in unsure), *teams]]
    wanted = [{"map_variance"}, {"experience"}, {"knowledge"}, {"team"}]
    assert all(keys <= answer.to_json().keys() for keys, answer in zip(wanted, others, strict=True))
    defs = {name: {key: strict(value) for key, value in one.items()} for name, one in written["$defs"].items()}
    for command, result in [*(("evaluate", answer) for answer in others), *found.items()]:
        rule = strict(written["commands"][command]) | {"$defs": defs, "properties": {"format": {"const": 2}}}
        Draft202012Validator(rule).validate(json.loads(json.dumps({"format": 2} | result.to_json())))
    with pytest.raises(ValidationError, match="unexpected"):
        Draft202012Validator(rule).validate(found["judge"].to_json() | {"another": 1})


def test_a_back_end(monkeypatch: pytest.MonkeyPatch) -> None:
    world = mrac.load("example:paper")
    plan = mrac.plan(world, robots=4)
    names = walk_through(monkeypatch, "planner/rollouts/engine", "CLOSED_LOOP")
    engines = ("auto", "jax", "numba", "halves")
    monkeypatch.setattr("planner.rollouts.engine.ENGINES", engines)
    monkeypatch.setitem(OPTIONS, "engine", replace(OPTIONS["engine"], words=engines))
    halves, numba = (make_engine(plan, world, Rolling(seed=3), name) for name in ("halves", "numba"))  # type: ignore[arg-type]
    assert isinstance(halves, names["InHalves"])
    for start, count in ((0, 1), (7, 501)):
        (tally, results), (other, others) = halves.run(start, count), numba.run(start, count)
        assert_same_tally(tally, other)
        assert_same_results(results, others)
    answers = [mrac.evaluate(world, plan, rollouts=512, engine=name, band=False) for name in ("halves", "numba")]  # type: ignore[arg-type]
    assert [answer.engine for answer in answers] == ["halves", "numba"]
    assert_same_tally(answers[0].tally, answers[1].tally)


# The examples that ship: they load, they are what their script makes, and they are worth looking at.

FOLDER = Path(analysis.examples.__file__).parent


def test_the_script_makes_what_ships(tmp_path: Path) -> None:
    main(tmp_path)
    assert (tmp_path / "building_map.pgm").read_bytes() == (FOLDER / "building_map.pgm").read_bytes()
    assert load_input(tmp_path / "paper.npz").sha256 == load_input(FOLDER / "paper.npz").sha256
    assert load_input(FOLDER / "paper.npz").sha256 == paper_world().sha256
    assert office_floor().shape == (320, 480)


EXAMPLES = [
    ("paper.npz", (20, 20), None, 100, 0.9),
    ("building.yaml", (32, 48), 4, 239, 1.0),
    ("terrain.yaml", (63, 60), 8, 1229, 0.99),
]


@pytest.mark.parametrize(("name", "shape", "robots", "dangerous", "reachable"), EXAMPLES)
def test_examples(name: str, shape: tuple[int, int], robots: int | None, dangerous: int, reachable: float) -> None:
    world = load_input(FOLDER / name)
    assert (world.shape, world.team.robots, int((world.threat > 0).sum())) == (shape, robots, dangerous)
    starts, notes = place_starts(world, robots or 8)
    assert notes == ()
    assert world.accessible(starts).sum() >= reachable * world.free.sum()
    assert len(np.unique(world.threat[world.free])) <= 6


def test_no_example_is_large() -> None:
    assert sum(path.stat().st_size for path in FOLDER.iterdir() if path.is_file()) < 200_000
