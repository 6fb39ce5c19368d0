"""The repository: imports, what nobody uses, the table of slow tests, releases, the benchmarks."""

import ast
import io
import re
import runpy
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bench as bench_engines
import evidence
import networkx as nx
import numpy as np
import pytest
import yaml
from evidence import Evidence, read, slow_files, stale, written
from helpers import ROOT, run_python
from open_loop_reference import fixture

import mrac_jax as mrac
from mrac_jax import bench
from planner.errors import MracError
from planner.make_plan import make_plan
from planner.rollouts.engine import closed_loop_engine
from planner.rollouts.open_loop import compile_plan
from planner.tally import Tally
from planner.world.generate import random_world
from planner.world.start_rule import place_starts

# The code base: imports point back along planner -> analysis -> mrac_jax, oracles import no engine, pins name no host.

PACKAGES = ("planner", "analysis", "mrac_jax")
PUBLIC_API = re.compile(r"mrac_jax|mrac_jax\.__main__|mrac_jax\.env\.suite|analysis\.(api|cli)(\.\w+)?")
RESULTS = (
    "evaluation", "comparison", "checking", "reproduction", "sweeps", "recording", "search", "policy_evaluation",
    "debrief",
)  # fmt: skip
UTILITIES = ("statistics", "theory", "page", "pictures", "utils", "report", "exporting")


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """All nodes of a file: to walk it takes as long as to parse it."""
    return list(ast.walk(parsed(path)))


def statements(body: list[ast.stmt]) -> Iterator[ast.AST]:
    """These, and all that they hold: expressions, which hold no imports, are left out."""
    for node in body:
        yield node
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from statements(getattr(node, field, []))


@cache
def imports_of(path: Path) -> set[str]:
    """Every module that a file imports, wherever in it, also for the type checker alone."""
    found = set()
    for node in statements(parsed(path).body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = module_of(path).split(".")[: -node.level or None] if node.level else []
            module = ".".join([*package, *filter(None, [node.module])])
            found |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return found


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def sources() -> dict[str, Path]:
    return {module_of(path): path for package in PACKAGES for path in (ROOT / package).rglob("*.py")}


def package_of(module: str) -> str:
    """The package that a module is in, or the module itself if it stands at the top of its package."""
    parts = module.split(".")
    return ".".join(parts[:2])


def test_imports_point_back_along_the_data() -> None:
    """`mrac_jax` is the public API; its engines are looked up by name."""
    allowed = {"planner": {"planner"}, "analysis": {"planner", "analysis"}, "mrac_jax": {*PACKAGES, "jax"}}
    for package in PACKAGES:
        files = list((ROOT / package).rglob("*.py"))
        assert len(files) > 5
        for path in files:
            assert {name.split(".")[0] for name in imports_of(path)} & {*PACKAGES, "jax"} <= allowed[package], path


def graph_of(of: Callable[[str], str]) -> nx.DiGraph:
    """Who imports whom; the public API alone points forward, and no module imports it."""
    known = sources()
    graph = nx.DiGraph()
    for module, path in known.items():
        if not PUBLIC_API.fullmatch(module):
            seen = {of(name) for name in imports_of(path) & set(known) if name not in PACKAGES}
            graph.add_edges_from((of(module), other) for other in seen if other != of(module))
    return graph


def test_no_file_and_no_package_imports_in_a_cycle() -> None:
    for of in (str, package_of):
        cycles = [sorted(found) for found in nx.strongly_connected_components(graph_of(of)) if len(found) > 1]
        assert not cycles, of
    assert len(graph_of(str)) > 150


def test_packages_have_seven_layers_at_most() -> None:
    """`planner` is the lowest layer; every package of `analysis` is above all that it imports."""
    layers = nx.dag_longest_path(graph_of(lambda name: "planner" if name.startswith("planner") else package_of(name)))
    assert len(layers) <= 7, layers


def test_no_module_imports_the_public_api() -> None:
    for module, path in sources().items():
        if not PUBLIC_API.fullmatch(module):
            assert "mrac_jax.load" not in path.read_text(), module
            assert not re.search(rf'import_module\("({"|".join(PACKAGES)})', path.read_text()), module
            assert not {name for name in imports_of(path) if name != "mrac_jax" and PUBLIC_API.fullmatch(name)}, module


def test_utilities_import_no_results_and_results_no_command() -> None:
    answers = {f"analysis.{package}" for package in RESULTS}
    graph = graph_of(package_of)
    for utility in UTILITIES:
        assert not set(graph.successors(f"analysis.{utility}")) & {*answers, "analysis.cli", "analysis.studio"}, utility
    for answer in answers:
        assert not {"analysis.cli", "analysis.studio"} & set(graph.successors(answer)), answer


def test_oracles_never_see_an_engine() -> None:
    engines = ("planner.rollouts", "mrac_jax", "jax", "planner.simulator")
    plain = {"planner.simulator"} | {f"planner.simulator.{name}" for name in ("codes", "jit", "searches", "thresholds")}
    for path in (*(ROOT / "analysis" / "theory").rglob("*.py"), *(ROOT / "tests").glob("oracle_*.py")):
        seen = {module for module in imports_of(path) if module.startswith(engines)} - plain
        assert not {module for module in seen if module.rpartition(".")[0] not in plain}, path


def test_the_simulator_imports_numpy_numba_and_itself() -> None:
    allowed = {*sys.stdlib_module_names, "numpy", "numba", "llvmlite", "planner"}
    for path in (ROOT / "planner" / "simulator").rglob("*.py"):
        mine = {name for name in imports_of(path) if name.startswith("planner")}
        assert {name.partition(".")[0] for name in imports_of(path) - mine} <= allowed, path
        assert all(name.startswith("planner.simulator") for name in mine), path


def test_only_one_file_imports_metis() -> None:
    users = [path.name for path in (ROOT / "planner").rglob("*.py") if "pymetis" in imports_of(path)]
    assert users == ["areas.py"]


def test_constraints_name_no_host() -> None:
    text = (ROOT / "constraints.txt").read_text()
    assert not re.search(r"https?:|@ |--index|file:", text)
    pinned = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line) for line in pinned)


def test_a_name_for_nothing_is_defined_once() -> None:
    """-1 has a name for each idea, and each name one place."""
    assigned = [node for path in sources().values() for node in parsed(path).body]
    nothing = [node for node in assigned if isinstance(node, ast.Assign) and ast.unparse(node.value) == "-1"]
    names = [name.id for node in nothing for name in node.targets if isinstance(name, ast.Name)]
    assert "NONE" in names and len(names) == len(set(names)), sorted(names)


def test_every_package_module_says_what_it_is_for() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            assert ast.get_docstring(parsed(path)), path


def test_a_report_loads_no_pictures() -> None:
    """Tables and JSON come without matplotlib: a third of a second of every command."""
    code = "import sys\n"
    reports = {module for module in sources() if re.fullmatch(r"analysis\..*reports?|analysis\.comparison", module)}
    assert len(reports) > 6
    for module in sorted(reports - {"analysis.report"}):
        code += f"import {module}\nassert 'matplotlib' not in sys.modules, '{module}'\n"
    run_python(code)


INTERFACES = ("cli", "studio", "page")
"""Packages whose words are those of the command line, or of style sheets."""
PRINTED = re.compile(
    r"tables?|\w*reports?|page|comparison|threats|leaderboard|policy_evaluation"
    r"|reproduction|replay|model|answer|document"
)
"""Files that say what a command prints."""


def strings_of(nodes: list[ast.AST]) -> Iterator[str]:
    """Texts in a file, but for docstrings."""
    told = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in told:
            yield node.value


OF_OPTIONS = {"planner.arguments", "planner.settings", "mrac_jax.env.suite"}
"""Modules with the names and the help of options."""


def test_errors_name_arguments_not_options() -> None:
    """`planner.arguments.argument` says an argument as its reader knows it, in Python or on the command line."""
    checked = 0
    for module, path in sources().items():
        if package_of(module) in {f"analysis.{interface}" for interface in INTERFACES} or PRINTED.fullmatch(path.stem):
            continue
        for text in strings_of(nodes_of(path)):
            checked += 1
            said = re.sub(r"`.*?`|mrac-jax .*", "", text)  # commands as they are typed
            if module not in OF_OPTIONS and not re.fullmatch(r"--[a-z-]+", said):
                assert not re.search(r"(?<![\w-])--[a-z]", said), (module, text)
    assert checked > 5000


REGISTERED = re.compile(r"app\.command|overload|infer_getattr|lower_getattr_generic|unbox|.*register\w*")
"""Decorators that hand on what they decorate: nobody calls it by its name."""
NAMED = {"world_with_starts", "cleared_world", "unserialize_library", "closed_rollouts", "step_env"}
"""Used all the same: by who writes Python, by a process that is begun with a line of it, and by Numba."""
PLAIN_BASES = {"Protocol", "NamedTuple", "Enum", "IntEnum", "Exception", "object"}
"""Bases from elsewhere that call no method of their own accord."""


def names_in(nodes: Iterable[ast.AST]) -> Counter[str]:
    """How often each name is used, looked up as "module:name" too; who imports it does not yet use it.

    The keys of JSON objects (`planner.json_objects`) name attributes.
    """
    found = Counter[str]()
    for node in nodes:
        if isinstance(node, ast.Name | ast.Attribute):
            found[node.id if isinstance(node, ast.Name) else node.attr] += 1
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"[\w.]+:\w+", node.value):
            found[node.value.partition(":")[2]] += 1
        elif isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "json_keys":
            found.update(re.findall(r"\w+", ast.literal_eval(node.value)))
    return found


def definitions(
    nodes: list[ast.AST], classes: set[str]
) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    """Functions, classes and methods, but for those whose name others know: what overrides a class from elsewhere."""
    overriding: set[ast.stmt] = set()
    strange: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            bases = {re.sub(r"\[.*", "", ast.unparse(base)) for base in node.bases}
            if bases - classes or bases & strange:
                strange.add(node.name)
                overriding |= set(node.body)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node not in overriding:
            decorators = (ast.unparse(one.func if isinstance(one, ast.Call) else one) for one in node.decorator_list)
            if not node.name.endswith("_") and not any(map(REGISTERED.fullmatch, decorators)):
                yield node


SELDOM = 12
"""A definition is not named so often within itself alone."""


def test_nothing_is_there_that_nobody_uses() -> None:
    """Tests are nobody: an oracle that they alone ask lives with them. Documents name what is for who writes Python,
    templates what they show.
    """
    files = [nodes_of(path) for path in sources().values()]
    classes = {node.name for nodes in files for node in nodes if isinstance(node, ast.ClassDef)} | PLAIN_BASES
    uses = names_in(node for nodes in files for node in nodes)
    documents = " ".join(path.read_text() for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")))
    code = " ".join(re.findall(r"```.*?```|`[^`]*`", documents, re.DOTALL))
    code += " ".join(re.findall(r"{[{%].*?[%}]}", " ".join(path.read_text() for path in pages("html"))))
    named = {*re.findall(r"\w+", code), *NAMED}
    defined = [node for nodes in files for node in definitions(nodes, classes)]
    rare = [node for node in defined if node.name not in named and uses[node.name] < SELDOM]
    unused = [node.name for node in rare if uses[node.name] <= names_in(ast.walk(node))[node.name]]
    assert len(defined) > 2000 and len(NAMED) <= 10
    assert not unused


def test_no_script_and_no_style_is_there_that_no_page_uses() -> None:
    said = Counter(re.findall(r"[\w-]+", " ".join(path.read_text() for path in pages("py", "js", "html"))))
    functions = [name for path in pages("js") for name in re.findall(r"function (\w+)\(", path.read_text())]
    styles = {name for path in pages("css") for name in re.findall(r"\.([a-z][\w-]*)(?=[^{}]*\{)", path.read_text())}
    assert len(functions) > 30 and len(styles) > 30
    assert not [name for name in functions if said[name] < 2]
    assert not [name for name in styles if not (said[name] or said[re.sub(r"\d+$|(?<=-)\w+$", "", name)])]


def pages(*suffixes: str) -> Iterator[Path]:
    return (path for suffix in suffixes for path in (ROOT / "analysis").rglob(f"*.{suffix}"))


def test_no_table_of_a_page_is_cut_by_an_empty_line() -> None:
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")):
        for table in re.findall(r"(?<=\n\n)\|.*\n.*", path.read_text(encoding="utf-8")):
            assert re.fullmatch(r"[|: -]+", table.splitlines()[1]), f"{path}: {table}"


PRIVATE = re.compile(
    r"(?<![\w`.,{/-])(luck|nobody|somebody|whoever|everybody|anybody|put right|called off|gone on with|looks? again|"
    r"breaks? off|as it stands|by itself|standings|susceptib\w+|the door|mended|dearer|dearest|foreign plan|bears|worn|"
    r"tolerances|lessons?|movers?|carried|news|told|headline|surprises|doubtful|roamed)(?![\w-])",
    re.IGNORECASE,
)
"""Private words of release 0.3; CONTRIBUTING.md gives the standard terms."""


def test_private_words_do_not_come_back() -> None:
    texts = {str(path): path.read_text() for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]}
    for path in (one for package in ("planner", "analysis", "mrac_jax") for one in (ROOT / package).rglob("*.py")):
        tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
        kinds = (tokenize.COMMENT, tokenize.STRING)
        said = (one.string for one in tokens if one.type == tokenize.NAME or (one.type in kinds and " " in one.string))
        texts[str(path)] = "\n".join(said)
    assert not [f"{path}: {found[1]}" for path, text in texts.items() for found in PRIVATE.finditer(text)]


# `tests/evidence.py`: the table holds each result, stale results are named.

GOOD = Evidence("3 passed, 9 deselected", 61, "2026-11-24", "abc1234")


def test_the_table_keeps_results() -> None:
    text = evidence.TABLE.read_text()
    rows = read(text)
    assert written(rows) == text and read(written(rows | {"test_one": GOOD})) == rows | {"test_one": GOOD}
    assert set(rows) <= set(slow_files())


def test_what_is_older_than_the_code_is_named(tmp_path: Path) -> None:
    def git(*words: str) -> str:
        name = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(["git", *name, *words], cwd=tmp_path, check=True, capture_output=True, text=True).stdout

    for name in ("planner", "analysis", "mrac_jax", "tests"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "one.py").write_text("A = 1\n")
    for name in "abcd":
        (tmp_path / f"tests/test_{name}.py").write_text("# pytest" + ".mark.slow\n")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "first")
    commit = git("rev-parse", "HEAD").strip()
    rows = {f"test_{name}": replace(GOOD, commit=commit) for name in "abc"}
    rows["test_b"] = replace(rows["test_b"], summary="1 failed, 3 passed")
    rows["test_c"] = replace(rows["test_c"], commit=commit + "+")
    named = ["test_b: 1 failed, 3 passed", f"test_c: older than the code ({commit}+)", "test_d: never run"]
    assert list(stale(rows, tmp_path)) == named
    (tmp_path / "planner/one.py").write_text("A = 2\n")
    assert stale(rows, tmp_path)[0] == f"test_a: older than the code ({commit})"


def test_a_run_says_how_it_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "MOST", 0.0)
    assert evidence.run("test_house").summary == "cut off after 0.0 s"


# What a release says of itself: one version, the same dependencies everywhere, links that an index can follow.

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
RELATIVE = r"\]\((?!https?:)"


def written_release(name: str) -> Any:
    text = (ROOT / name).read_text(encoding="utf-8")
    return yaml.safe_load(re.sub(r"\{\{.*?\}\}", "python", text))


def test_one_version() -> None:
    cited = written_release("CITATION.cff")
    assert (cited["version"], cited["license"]) == (PROJECT["version"], PROJECT["license"])
    assert written_release("conda/meta.yaml")["package"]["version"] == PROJECT["version"] == mrac.__version__
    assert f"\n## {PROJECT['version']}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_conda_installs_what_the_wheel_needs() -> None:
    recipe = written_release("conda/meta.yaml")
    wanted = [
        f"python {PROJECT['requires-python']}",
        *(re.sub(r"(?=[>=])", " ", one, count=1) for one in PROJECT["dependencies"]),
    ]
    assert [one.replace("matplotlib-base", "matplotlib") for one in recipe["requirements"]["run"]] == wanted
    assert recipe["about"]["summary"] == PROJECT["description"]


def test_an_index_shows_no_link_that_it_cannot_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setitem(sys.modules, "setuptools", SimpleNamespace(setup=given.update))
    index_readme = runpy.run_path(str(ROOT / "setup.py"))["index_readme"]
    assert re.search(RELATIVE, README)
    assert given["long_description"] == index_readme(README, PROJECT.get("urls", {}).get("Source", ""))
    bare, linked = index_readme(README), index_readme(README, "https://forge.example/raw/main/")
    for text in (bare, linked):
        assert not re.search(RELATIVE, text)
        assert len(text.splitlines()) > 40
    assert "![" not in bare
    assert "(https://forge.example/raw/main/docs/start.md)" in linked


WITHOUT_JAX = """
import sys
import tokenize
from importlib.machinery import PathFinder
find = PathFinder.find_spec
PathFinder.find_spec = staticmethod(lambda name, *where: None if name.startswith("jax") else find(name, *where))
import mrac_jax as mrac
from analysis.cli.app import run
assert run(["evaluate", "example:paper", "--engine", "jax"]) == 2
try:
    mrac.evaluate(mrac.load("example:paper"), 1, engine="jax")
except mrac.InputError as error:
    assert str(error).startswith("jax is not installed"), error
else:
    raise AssertionError("no error")
words = [sys.argv[1], "--rollouts", "100", "--exact", "never", "--no-advice", "--json"]
assert all(run(["evaluate", *words, "--loop", loop]) == 0 for loop in ("open", "closed"))
assert run(["threats", sys.argv[1], "--remove", "1", "--rollouts", "16", "--exact", "never", "--out", sys.argv[2]]) == 0
assert "jax" not in sys.modules
"""


def test_without_jax_its_own_engine_alone_is_missed(tmp_path: Path) -> None:
    threat = np.zeros((4, 5), dtype=np.float32)
    threat[1, 1:4] = 0.2
    np.save(tmp_path / "small.npy", threat)
    words = [sys.executable, "-c", WITHOUT_JAX, str(tmp_path / "small.npy"), str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert "error: jax is not installed; pip install jax\n" in done.stderr
    assert (tmp_path / "out" / "risk_paid.png").exists()


# `make bench` has a row for every engine that is asked for, and times none that counts differently.


@pytest.mark.parametrize(
    ("loop", "asked", "rows"),
    [("open", ["numba", "jax"], ["numba", "numba", "jax"]), ("closed", ["python"], ["python"])],
)
def test_every_engine_has_a_row(
    loop: str, asked: list[str], rows: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    world = random_world(6, 6)
    plan = make_plan(world, place_starts(world, 2)[0])
    for owner, name, value in (
        (bench_engines, "cases", lambda: iter([("small", world, plan)])), (bench_engines, "LOOPS", (loop,)),
        (sys, "argv", ["engines", *asked]), (bench_engines, "SECONDS", 0.01),
    ):  # fmt: skip
        monkeypatch.setattr(owner, name, value)
    bench_engines.main()
    printed = [row.replace(" 1 thread", "").split() for row in capsys.readouterr().out.splitlines()]
    found = [row for row in printed if row[0] == "small"]
    assert [row[2].rstrip(",") for row in found] == rows
    assert all(float(row[3].replace(",", "")) > 0 for row in found)


def test_engines_that_count_differently_are_not_timed() -> None:
    def contender(number: int) -> bench_engines.Contender:
        tally = Tally.empty(f"{number:064d}", (2, 2), 1, 4)
        return bench_engines.Contender(f"number {number}", lambda: (lambda count: count, 1, tally))

    with pytest.raises(MracError, match="number 1 counts differently"):
        bench_engines.race([contender(0), contender(0), contender(1)])


def test_naive_program_agrees_with_the_closed_form() -> None:
    import jax

    plan, world, numbers = fixture("tiny-6x3-20", 5)
    compiled = compile_plan(plan, world)
    paths = [robot.path[: compiled.last_step + 1] for robot in plan.robots]
    (visited, survived, _, _), _ = bench_engines.naive_rollouts(paths, world.threat.reshape(-1), 2048)(
        jax.random.key(1)
    )
    for found, meaning in ((visited, "visited"), (survived, "survived")):
        error = np.std(found) / np.sqrt(len(found))
        assert abs(np.mean(found) - numbers["open_loop_exact"][meaning]) <= 5 * error


# `python -m mrac_jax.bench`: checks before rates, a row for every part, an end in time.

BARE = """
import sys, time

class Bare:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Bare())
from mrac_jax import bench
bench.measure = lambda *_: time.sleep(60)
sys.exit(bench.main(["--small", "--minutes", "0.0001"]))
"""
NOT_NEEDED = "cyclopts,rich,matplotlib,PIL,jinja2,highspy,gymnasium,pandas,pyarrow,rasterio,dask"
RATES = ("thresholds (host: NumPy)", "open loop, mrac.functional", "open loop, engine", "closed loop, ")


def rates_in(printed: str) -> dict[str, list[float]]:
    """By part: rollouts a call, rates of JAX and Numba, and their ratio."""
    rows = [
        re.fullmatch(r"20x20 \S+ \S+ +(\S.*?)  +([\d,.]+) +([\d,.]+) +([\d,.]+) +([\d.e-]+).*", row)
        for row in printed.splitlines()
    ]
    return {row[1]: [float(cell.replace(",", "")) for cell in row.groups()[1:]] for row in rows if row}


def bench_without_compiling(seed: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """The program's status; in the place of the closed loop in JAX, Numba's of this seed."""

    def closed(loop: Any, _: int, *, lanes: int) -> Any:
        engine: Any = closed_loop_engine(loop, seed, "numba", 1)
        vars(engine).update(
            starts=0, least=8 * lanes, host=SimpleNamespace(tables={}, entries=SimpleNamespace(used=lanes))
        )
        return engine

    small = bench.Scale(1, (2**6, 2**5), (), 2**8, (2**10,), 2**8, 2**8)
    for name, value in (("WatchedLoop", closed), ("SCALES", {"small": small}), ("CHECKED", 2**8)):
        monkeypatch.setattr(bench, name, value)
    return bench.main(["--small"])


def test_jax_benchmark_has_a_row_for_every_part(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench_without_compiling(bench.SEED, monkeypatch) == 0
    printed = capsys.readouterr().out
    assert len(re.findall(r"check: .* 256 +equal", printed)) == 4
    rates = rates_in(printed)
    assert list(rates) == [*RATES[:3], "closed loop, 64 lanes", "closed loop, 32 lanes"]
    assert all(cell > 0 for row in rates.values() for cell in row)
    for loop in ("open loop", "closed loop"):
        assert re.search(rf"{loop}: JAX is faster from +(none|[\d,]+)", printed)


def test_jax_benchmark_times_nothing_that_differs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench_without_compiling(bench.SEED + 1, monkeypatch) == bench.DIFFERENT == 1
    printed = capsys.readouterr().out
    assert len(re.findall("DIFFERENT", printed)) == 1
    assert re.search(r"check: closed loop, by rollout +256 +DIFFERENT", printed)
    assert not rates_in(printed)


def test_parts_of_the_jax_benchmark_end_in_time(capsys: pytest.CaptureFixture[str]) -> None:
    """One that would not end by then, were it as long as the longest before it, is skipped."""
    now = [5.0]
    run = bench.Run(100.0, lambda: now[0])
    for share, times in ((0.5, (5, 25, 30, 40)), (1.0, (60, 75, 86))):
        run.begin(share)
        for now[0] in times:
            assert run.allows("world", f"at {now[0]}") == (now[0] != times[-1])
    printed = re.findall(r"world +(.*?) +skipped: the time of this part is over", capsys.readouterr().out)
    assert printed == ["at 40", "at 86"]


def test_jax_benchmark_needs_few_packages_and_is_cut_off() -> None:
    done = subprocess.run([sys.executable, "-c", BARE, NOT_NEEDED], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == bench.CUT_OFF and "stopped after 0.0001 minutes" in done.stdout, done.stderr


@pytest.mark.slow
def test_jax_benchmark_runs() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mrac_jax.bench", "--small", "--minutes", "30"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rates = rates_in(done.stdout)
    assert list(rates) == [*RATES[:3], "closed loop, 256 lanes"] and "trips to the host" in done.stdout
    assert all(cell > 0 for row in rates.values() for cell in row)
