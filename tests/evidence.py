"""Run the slow tests file by file and keep the last result of each in tests/evidence.json.

`evidence.py --part 3/8` runs one of eight parts of about equal time. `--minutes 3` runs the files that fit into three
minutes, other files every day. `--check` exits with status 1 if a file has not passed on the present code: the file
itself and all that it imports, without comments and docstrings. `--check` needs Python alone.
"""

from __future__ import annotations

import argparse
import ast
import json
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
TABLE = ROOT / "tests/evidence.json"
PACKAGES = ("planner", "analysis", "mrac_jax")
MOST = 1800
"""Time limit of a file, in seconds."""
UNKNOWN = 120.0
"""Assumed time of a file that was never run, in seconds."""


@dataclass(frozen=True)
class Evidence:
    """Result of a file of slow tests: pytest's summary, seconds, day and commit ("+": with uncommitted changes)."""

    summary: str
    seconds: float
    day: str
    commit: str


def slow_files(root: Path = ROOT) -> list[str]:
    """Names of the files that hold slow tests."""
    return sorted(path.stem for path in (root / "tests").glob("test_*.py") if "pytest.mark.slow" in path.read_text())


def read(text: str) -> dict[str, Evidence]:
    """Results by file, of the text of `TABLE`."""
    return {name: Evidence(**row) for name, row in json.loads(text).items()}


def written(rows: dict[str, Evidence]) -> str:
    """The text of `TABLE`: one line a file, so that changes read well in a diff."""
    lines = (f"  {json.dumps(name)}: {json.dumps(asdict(row))}" for name, row in sorted(rows.items()))
    return "{\n" + ",\n".join(lines) + "\n}\n"


def parts(names: Iterable[str], seconds: dict[str, float], count: int) -> list[list[str]]:
    """Split files into parts of about equal time: the longest file first, each into the shortest part."""
    dealt: list[list[str]] = [[] for _ in range(count)]
    for name in sorted(names, key=lambda name: (-seconds.get(name, UNKNOWN), name)):
        min(dealt, key=lambda part: sum(seconds.get(one, UNKNOWN) for one in part)).append(name)
    return dealt


def of_the_day(names: list[str], seconds: dict[str, float], most: float, day: date) -> list[str]:
    """Files that together take at most `most` seconds, from a first file that changes every day."""
    known = [name for name in names if seconds.get(name, MOST) <= most]
    first, chosen = day.toordinal() * 7 % max(len(known), 1), list[str]()
    for name in known[first:] + known[:first]:
        if sum(seconds[one] for one in (*chosen, name)) <= most:
            chosen.append(name)
    return chosen


@cache
def covered(name: str, root: Path = ROOT) -> frozenset[str]:
    """Paths of a test file and of all files of the packages and of `tests` that it imports, directly or not."""
    found, todo = set[str](), [f"tests.{name}"]
    while todo:
        stem = todo.pop().replace(".", "/")
        for path in (root / f"{stem}.py", root / stem / "__init__.py"):
            if path.exists() and str(path.relative_to(root)) not in found:
                found.add(str(path.relative_to(root)))
                todo += imported(path, root)
    return frozenset(found | {"tests/conftest.py"})


@cache
def imported(path: Path, root: Path) -> list[str]:
    """Names of the modules that a file imports; helpers are named `tests.NAME`."""
    found = list[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        module = node.module if isinstance(node, ast.ImportFrom) else None
        if isinstance(node, ast.ImportFrom) and node.level:
            package = path.relative_to(root).parts[: -node.level]
            module = ".".join([*package, *filter(None, [module])])
        for name in names if module is None else (module, *(f"{module}.{one}" for one in names)):
            if name.split(".")[0] in PACKAGES:
                found.append(name)
            elif (root / "tests" / f"{name}.py").exists():
                found.append(f"tests.{name}")
    return found


def git(*words: str, root: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run git in `root`."""
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)


def code_of(text: str) -> str:
    """The code of a Python file without comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [one for one in node.body if not _is_text(one)]
    return ast.dump(tree)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def stale(rows: dict[str, Evidence], root: Path = ROOT) -> Iterator[str]:
    """One line for each file of slow tests that has not passed on the present code."""

    @cache
    def differs(commit: str, path: str) -> bool:
        before = git("show", f"{commit}:{path}", root=root).stdout
        return code_of(before) != code_of((root / path).read_text())

    for name in slow_files(root):
        row = rows.get(name)
        if row is None:
            yield f"{name}: never run"
        elif "passed" not in row.summary or "failed" in row.summary or "error" in row.summary:
            yield f"{name}: {row.summary}"
        elif row.commit.endswith("+"):
            yield f"{name}: run with changes that were not committed"
        else:
            changed = git("diff", "--name-only", row.commit, "--", *sorted(covered(name, root)), root=root)
            older = [path for path in changed.stdout.split() if differs(row.commit, path)]
            if changed.returncode or older:
                what = older[0] if older else f"no commit {row.commit}"
                yield f"{name}: older than the code that it covers ({what})"


def run(name: str) -> Evidence:
    """Run the slow tests of a file."""
    changes = git("status", "--porcelain", "--", ".", f":!{TABLE.relative_to(ROOT)}").stdout
    commit = git("rev-parse", "--short", "HEAD").stdout.strip() + "+" * bool(changes)
    began, words = time.monotonic(), [sys.executable, "-m", "pytest", "-m", "slow", f"tests/{name}.py"]
    try:
        ended = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=MOST, check=False)
        summary = (ended.stdout.strip().splitlines() or ["nothing"])[-1].strip("= ").split(" in ")[0]
        if ended.returncode:
            tell(ended.stdout)
    except subprocess.TimeoutExpired:
        summary = f"cut off after {MOST} s"
    return Evidence(summary, round(time.monotonic() - began), datetime.now(UTC).date().isoformat(), commit)


def tell(text: str) -> None:
    """Print a line without delay."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> int:
    """Run the command; status 1 if a file did not pass or is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", default="1/1", help="I/N")
    parser.add_argument("--minutes", type=float, help="files of the day for this time; the table stays as it is")
    parser.add_argument("--check", action="store_true")
    asked, rows = parser.parse_args(), read(TABLE.read_text())
    if asked.check:
        missing = list(stale(rows))
        tell("\n".join(missing) or "all slow tests passed on the present code")
        return bool(missing)
    seconds, (part, count) = {name: row.seconds for name, row in rows.items()}, map(int, asked.part.split("/"))
    if asked.minutes:
        names = of_the_day(slow_files(), seconds, 60 * asked.minutes, datetime.now(UTC).date())
    else:
        names = parts(slow_files(), seconds, count)[part - 1]
    good = True
    for name in names:
        found = run(name)
        good &= "passed" in found.summary and "failed" not in found.summary and "error" not in found.summary
        tell(f"{name}: {found.summary}, {found.seconds:.0f} s")
        if not asked.minutes:
            TABLE.write_text(written(read(TABLE.read_text()) | {name: found}))
    return not good


if __name__ == "__main__":
    sys.exit(main())
