"""Run the slow tests file by file and keep the last result of each in tests/evidence.json.

`evidence.py --part 3/8` runs one of eight parts. `--check` exits with status 1 if a file has not passed on the code of
the present commit: another commit since then changed no file of the packages or of `tests`.
"""

import argparse
import json
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parent.parent
TABLE = ROOT / "tests/evidence.json"
CODE = ("planner", "analysis", "mrac_jax", "tests")
MOST = 1800
"""Time limit of a file, in seconds."""


@dataclass(frozen=True)
class Evidence:
    """Result of a file of slow tests: pytest's summary, seconds, day and commit ("+": with uncommitted changes)."""

    summary: str
    seconds: float
    day: str
    commit: str

    @property
    def passed(self) -> bool:
        """Whether tests passed and none failed."""
        return "passed" in self.summary and "failed" not in self.summary and "error" not in self.summary


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


def git(*words: str, root: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run git in `root`."""
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)


def stale(rows: dict[str, Evidence], root: Path = ROOT) -> list[str]:
    """One line for each file of slow tests that has not passed on the present code."""
    lines = []
    for name in slow_files(root):
        row = rows.get(name)
        if row is None or not row.passed:
            lines.append(f"{name}: {'never run' if row is None else row.summary}")
        elif git("diff", "--quiet", row.commit, "--", *CODE, f":!{TABLE.relative_to(ROOT)}", root=root).returncode:
            lines.append(f"{name}: older than the code ({row.commit})")
    return lines


def run(name: str) -> Evidence:
    """Run the slow tests of a file."""
    changes = git("status", "--porcelain", "--", ".", f":!{TABLE.relative_to(ROOT)}").stdout
    commit = git("rev-parse", "--short", "HEAD").stdout.strip() + "+" * bool(changes)
    began, words = time.monotonic(), [sys.executable, "-m", "pytest", "-m", "slow", f"tests/{name}.py"]
    try:
        ended = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=MOST, check=False)
        summary = (ended.stdout.strip().splitlines() or ["nothing"])[-1].strip("= ").split(" in ")[0]
        if ended.returncode:
            print(ended.stdout, flush=True)  # noqa: T201
    except subprocess.TimeoutExpired:
        summary = f"cut off after {MOST} s"
    return Evidence(summary, round(time.monotonic() - began), datetime.now(UTC).date().isoformat(), commit)


def main() -> int:
    """Run the command; status 1 if a file did not pass or is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", default="1/1", help="I/N")
    parser.add_argument("--check", action="store_true")
    asked = parser.parse_args()
    if asked.check:
        missing = stale(read(TABLE.read_text()))
        print("\n".join(missing) or "all slow tests passed on the present code")  # noqa: T201
        return bool(missing)
    part, count = map(int, asked.part.split("/"))
    good = True
    for name in slow_files()[part - 1 :: count]:
        found = run(name)
        good &= found.passed
        print(f"{name}: {found.summary}, {found.seconds:.0f} s", flush=True)  # noqa: T201
        TABLE.write_text(written(read(TABLE.read_text()) | {name: found}))
    return not good


if __name__ == "__main__":
    sys.exit(main())
