"""Runs the slow tests file by file, in parts or as time allows, and keeps in docs/evidence.md what passed when.

`evidence.py --part 3/8`: one of eight parts of about as many seconds each. `--minutes 3`: some files, other ones every
day, none that took longer than is left. `--check`: status 1 where a file has not passed on the code as it is: itself,
and all of the packages and helpers that it imports, to the last, but for comments and docstrings. Python alone is
needed for that.
"""

from __future__ import annotations

import argparse
import ast
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = "docs/evidence.md"
PACKAGES = ("planner", "analysis", "mrac_jax")
MOST = 1800
"""Seconds that a file may take."""
UNKNOWN = 120.0
"""Seconds that a file is taken for which was never run."""
ROW = re.compile(r"^\| `(\w+)` \| (.*) \| (\d+) \| (\S+) \| `(\w+\+?)` \|$", re.MULTILINE)


@dataclass(frozen=True)
class Evidence:
    """How a file of slow tests ended: pytest's words, seconds, day, commit ("+": with changes beside it)."""

    said: str
    seconds: float
    day: str
    commit: str


def slow_files(root: Path = ROOT) -> list[str]:
    """Names of the files that hold slow tests."""
    return sorted(path.stem for path in (root / "tests").glob("test_*.py") if "pytest.mark.slow" in path.read_text())


def read(text: str) -> dict[str, Evidence]:
    """What a page holds, by file."""
    return {name: Evidence(said, float(took), day, commit) for name, said, took, day, commit in ROW.findall(text)}


def written(text: str, rows: dict[str, Evidence]) -> str:
    """The page with these rows in the place of its own."""
    head = "| file | tests | seconds | day | commit |\n|---|---|---:|---|---|\n"
    lines = [f"| `{n}` | {r.said} | {r.seconds:.0f} | {r.day} | `{r.commit}` |\n" for n, r in sorted(rows.items())]
    return text[: text.index("| file |")] + head + "".join(lines)


def parts(names: Iterable[str], seconds: dict[str, float], count: int) -> list[list[str]]:
    """So many parts of about as many seconds: the longest first, each to the part that has least."""
    dealt: list[list[str]] = [[] for _ in range(count)]
    for name in sorted(names, key=lambda name: (-seconds.get(name, UNKNOWN), name)):
        min(dealt, key=lambda part: sum(seconds.get(one, UNKNOWN) for one in part)).append(name)
    return dealt


def of_the_day(names: list[str], seconds: dict[str, float], most: float, day: date) -> list[str]:
    """Files whose seconds are known to be no more than so many together: beginning elsewhere each day."""
    known = [name for name in names if seconds.get(name, MOST) <= most]
    first, chosen = day.toordinal() * 7 % max(len(known), 1), list[str]()
    for name in known[first:] + known[:first]:
        if sum(seconds[one] for one in (*chosen, name)) <= most:
            chosen.append(name)
    return chosen


@cache
def covered(name: str, root: Path = ROOT) -> frozenset[str]:
    """Paths of a test file, and of all of the packages and of `tests` that it imports, directly or not."""
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
    """Modules that a file imports, anywhere in it; those of `tests` by `tests.NAME`."""
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
    """What git says."""
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)


def code_of(text: str) -> str:
    """The code of a file of Python, without comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [one for one in node.body if not _is_text(one)]
    return ast.dump(tree)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def stale(rows: dict[str, Evidence], root: Path = ROOT) -> Iterator[str]:
    """What is missing: a line for each file of slow tests that has not passed on the code as it is."""

    @cache
    def differs(commit: str, path: str) -> bool:
        before = git("show", f"{commit}:{path}", root=root).stdout
        return code_of(before) != code_of((root / path).read_text())

    for name in slow_files(root):
        row = rows.get(name)
        if row is None:
            yield f"{name}: never run"
        elif "passed" not in row.said or "failed" in row.said or "error" in row.said:
            yield f"{name}: {row.said}"
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
    changes = git("status", "--porcelain", "--", ".", f":!{PAGE}").stdout
    commit = git("rev-parse", "--short", "HEAD").stdout.strip() + "+" * bool(changes)
    began, words = time.monotonic(), [sys.executable, "-m", "pytest", "-m", "slow", f"tests/{name}.py"]
    try:
        ended = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=MOST, check=False)
        said = (ended.stdout.strip().splitlines() or ["nothing"])[-1].strip("= ").split(" in ")[0]
        if ended.returncode:
            tell(ended.stdout)
    except subprocess.TimeoutExpired:
        said = f"cut off after {MOST} s"
    return Evidence(said, time.monotonic() - began, datetime.now(UTC).date().isoformat(), commit)


def tell(text: str) -> None:
    """Say it at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> int:
    """The command; status 1 where something did not pass, or is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", default="1/1", help="I/N")
    parser.add_argument("--minutes", type=float, help="of tests of the day; the page is left as it is")
    parser.add_argument("--check", action="store_true")
    asked, page = parser.parse_args(), ROOT / PAGE
    rows = read(page.read_text())
    if asked.check:
        missing = list(stale(rows))
        tell("\n".join(missing) or "all slow tests passed on the code as it is")
        return bool(missing)
    seconds, (part, count) = {name: row.seconds for name, row in rows.items()}, map(int, asked.part.split("/"))
    if asked.minutes:
        names = of_the_day(slow_files(), seconds, 60 * asked.minutes, datetime.now(UTC).date())
    else:
        names = parts(slow_files(), seconds, count)[part - 1]
    good = True
    for name in names:
        found = run(name)
        good &= "passed" in found.said and "failed" not in found.said and "error" not in found.said
        tell(f"{name}: {found.said}, {found.seconds:.0f} s")
        if not asked.minutes:
            page.write_text(written(page.read_text(), read(page.read_text()) | {name: found}))
    return not good


if __name__ == "__main__":
    sys.exit(main())
