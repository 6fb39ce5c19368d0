"""The house: imports point back along planner -> mrac_jax -> analysis, oracles see no engine, and names no host."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
ROOMS = ("planner", "mrac_jax", "analysis")


def imports_of(path: Path) -> set[str]:
    """Every module that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def rooms_seen(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports_of(path)} & {*ROOMS, "jax"}


def test_imports_point_back_along_the_data() -> None:
    allowed = {"planner": {"planner"}, "mrac_jax": {"planner", "mrac_jax", "jax"}, "analysis": {*ROOMS, "jax"}}
    for room in ROOMS:
        files = list((ROOT / room).rglob("*.py"))
        assert len(files) > 5
        for path in files:
            assert rooms_seen(path) <= allowed[room], path


def test_oracles_never_see_an_engine() -> None:
    engines = ("mrac_jax", "jax", "planner.kernels")
    for path in (ROOT / "analysis" / "theory").rglob("*.py"):
        assert not {module for module in imports_of(path) if module.startswith(engines)}, path
    readable = "planner.mrac.simulate"
    for path in (ROOT / "planner" / "kernels").rglob("*.py"):
        assert readable not in imports_of(path), path


def test_only_one_file_imports_metis() -> None:
    users = [path.name for path in (ROOT / "planner").rglob("*.py") if "pymetis" in imports_of(path)]
    assert users == ["partition.py"]


def test_constraints_name_no_host() -> None:
    text = (ROOT / "constraints.txt").read_text()
    assert not re.search(r"https?:|@ |--index|file:", text)
    pinned = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line) for line in pinned)


def test_every_package_module_says_what_it_is_for() -> None:
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            assert ast.get_docstring(ast.parse(path.read_text())), path
