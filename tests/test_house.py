"""The house: imports point back along planner -> analysis -> mrac_jax, oracles see no engine, and names no host."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import networkx as nx

ROOT = Path(__file__).parent.parent
ROOMS = ("planner", "analysis", "mrac_jax")
DOOR = re.compile(r"mrac_jax|mrac_jax\.__main__|analysis\.api(\.\w+)?")
ANSWERS = ("evaluation", "comparison", "checking", "experiments", "sweeps", "recording", "search", "policy_evaluation")
KITS = ("statistics", "theory", "page", "pictures", "utils", "report", "exporting")


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


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
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def sources() -> dict[str, Path]:
    return {module_of(path): path for room in ROOMS for path in (ROOT / room).rglob("*.py")}


def room_of(module: str) -> str:
    """The room that a module is in, or the module itself if it stands at the top of its package."""
    parts = module.split(".")
    return ".".join(parts[:2])


def rooms_seen(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports_of(path)} & {*ROOMS, "jax"}


def test_imports_point_back_along_the_data() -> None:
    """`mrac_jax` is the door, and the engines that are looked up by name; benchmarks alone race JAX itself."""
    allowed = {"planner": {"planner"}, "analysis": {"planner", "analysis"}, "mrac_jax": {*ROOMS, "jax"}}
    for room in ROOMS:
        files = list((ROOT / room).rglob("*.py"))
        assert len(files) > 5
        for path in files:
            more = {"jax"} if path.parent.name == "bench" else set()
            assert rooms_seen(path) <= allowed[room] | more, path


def arrows(of: Callable[[str], str]) -> nx.DiGraph:
    """Who imports whom; the door alone points forward, and nothing inside imports through it."""
    known = sources()
    graph = nx.DiGraph()
    for module, path in known.items():
        if not DOOR.fullmatch(module):
            seen = {of(name) for name in imports_of(path) & set(known) if name not in ROOMS}
            graph.add_edges_from((of(module), other) for other in seen if other != of(module))
    return graph


def test_no_file_and_no_room_imports_in_a_circle() -> None:
    for of in (str, room_of):
        circles = [sorted(found) for found in nx.strongly_connected_components(arrows(of)) if len(found) > 1]
        assert not circles, of
    assert len(arrows(str)) > 150


def test_seven_floors_carry_the_door() -> None:
    """`planner` is the ground; every room of `analysis` stands above all that it imports."""
    floors = nx.dag_longest_path(arrows(lambda module: "planner" if module.startswith("planner") else room_of(module)))
    assert len(floors) <= 7, floors


def test_nothing_inside_comes_through_the_door() -> None:
    for module, path in sources().items():
        if not DOOR.fullmatch(module):
            assert "mrac_jax.load" not in path.read_text(), module
            assert not re.search(rf'import_module\("({"|".join(ROOMS)})', path.read_text()), module
            assert not {name for name in imports_of(path) if name != "mrac_jax" and DOOR.fullmatch(name)}, module


def test_kits_know_no_answer_and_answers_no_command() -> None:
    answers = {f"analysis.{room}" for room in ANSWERS}
    graph = arrows(room_of)
    for kit in KITS:
        assert not set(graph.successors(f"analysis.{kit}")) & {*answers, "analysis.cli", "analysis.studio"}, kit
    for answer in answers:
        assert not {"analysis.cli", "analysis.studio"} & set(graph.successors(answer)), answer


def test_oracles_never_see_an_engine() -> None:
    engines = ("planner.rollouts", "mrac_jax", "jax", "planner.simulator")
    for path in (*(ROOT / "analysis" / "theory").rglob("*.py"), *(ROOT / "tests").glob("oracle_*.py")):
        assert not {module for module in imports_of(path) if module.startswith(engines)}, path
    readable = "planner.mrac.simulate"
    for path in (ROOT / "planner" / "simulator").rglob("*.py"):
        assert readable not in imports_of(path), path


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
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            assert ast.get_docstring(parsed(path)), path


def test_a_report_loads_no_pictures() -> None:
    """Tables and JSON come without matplotlib: a third of a second of every command."""
    code = "import sys\n"
    reports = {module for module in sources() if re.fullmatch(r"analysis\..*reports?|analysis\.comparison", module)}
    assert len(reports) > 6
    for module in sorted(reports - {"analysis.report"}):
        code += f"import {module}\nassert 'matplotlib' not in sys.modules, '{module}'\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


FACES = ("cli", "studio", "bench", "page")
"""Rooms whose words are those of the command line, or of style sheets."""
PRINTED = re.compile(
    r"tables?|\w*reports?|page|comparison|threat_placement|leaderboard|policy_evaluation|policies|information_value"
    r"|reproduction|replay|model|answer|document"
)
"""Files that say what a command prints."""


def strings_of(tree: ast.AST) -> Iterator[str]:
    """Texts in a file, but for docstrings."""
    told = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in told:
            yield node.value


def test_errors_name_arguments_not_options() -> None:
    """`planner.arguments.argument` says an argument as its reader knows it, in Python or on the command line."""
    checked = 0
    for module, path in sources().items():
        if room_of(module) in {f"analysis.{face}" for face in FACES} or PRINTED.fullmatch(path.stem):
            continue
        for text in strings_of(parsed(path)):
            checked += 1
            said = re.sub(r"`.*?`|mrac-jax .*", "", text)  # commands as they are typed
            if module != "planner.arguments" and not re.fullmatch(r"--[a-z-]+", said):
                assert not re.search(r"(?<![\w-])--[a-z]", said), (module, text)
    assert checked > 5000


REGISTERED = re.compile(r"app\.command|overload|infer_getattr|lower_getattr_generic|unbox|.*register\w*")
"""Decorators that hand on what they decorate: nobody calls it by its name."""
NAMED = {"world_with_starts", "cleared_world", "roll_out_readably", "unserialize_library"}
"""Used all the same: by who writes Python, by a process that is begun with a line of it, and by Numba."""
OURS = {"Protocol", "NamedTuple", "Enum", "IntEnum", "Exception", "object"}
"""Bases from elsewhere that call no method of their own accord."""


def names_in(tree: ast.AST) -> Counter[str]:
    """How often each name is used, looked up as "module:name" too; who imports it does not yet use it."""
    texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str))
    found = Counter(text.partition(":")[2] for text in texts if re.fullmatch(r"[\w.]+:\w+", text))
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.Name | ast.Attribute))
    return found + Counter(node.id if isinstance(node, ast.Name) else node.attr for node in nodes)


def definitions(tree: ast.Module, classes: set[str]) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    """Functions, classes and methods, but for those whose name others know: what overrides a class from elsewhere."""
    overriding: set[ast.stmt] = set()
    strange: set[str] = set()
    for node in ast.walk(tree):
        bases = {re.sub(r"\[.*", "", ast.unparse(base)) for base in getattr(node, "bases", ())}
        if isinstance(node, ast.ClassDef) and (bases - classes or bases & strange):
            strange.add(node.name)
            overriding |= set(node.body)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node not in overriding:
            decorators = (ast.unparse(one.func if isinstance(one, ast.Call) else one) for one in node.decorator_list)
            if not node.name.endswith("_") and not any(map(REGISTERED.fullmatch, decorators)):
                yield node


def test_nothing_is_there_that_nobody_uses() -> None:
    """Tests are nobody: an oracle that they alone ask lives with them. Documents name what is for who writes Python,
    templates what they show.
    """
    trees = [parsed(path) for path in sources().values()]
    classes = {node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)} | OURS
    uses = sum(map(names_in, trees), Counter())
    documents = " ".join(path.read_text() for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")))
    code = " ".join(re.findall(r"```.*?```|`[^`]*`", documents, re.DOTALL))
    code += " ".join(re.findall(r"{[{%].*?[%}]}", " ".join(path.read_text() for path in pages("html"))))
    named = {*re.findall(r"\w+", code), *NAMED}
    defined = [node for tree in trees for node in definitions(tree, classes)]
    unused = [node.name for node in defined if uses[node.name] <= names_in(node)[node.name] and node.name not in named]
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
