"""`tests/evidence.py`: every slow file is in one part, the page says what was run, and what is older than its code."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from datetime import date
from pathlib import Path

import evidence
import pytest
from evidence import Evidence, covered, of_the_day, parts, read, slow_files, stale, written

GOOD = Evidence("3 passed, 9 deselected", 61, "2026-11-24", "abc1234")

SLOW = "pytest" + ".mark.slow"


def test_every_file_is_in_one_part_and_parts_take_about_as_long() -> None:
    names = slow_files()
    assert len(names) > 40
    seconds = {name: 10.0 + 7 * (number % 40) for number, name in enumerate(names)}
    dealt = parts(names, seconds, 8)
    assert sorted(name for part in dealt for name in part) == names
    sums = [sum(seconds[name] for name in part) for part in dealt]
    assert max(sums) - min(sums) <= max(seconds.values())


def test_the_day_s_files_fit_and_all_come_round() -> None:
    names = [f"test_{number}" for number in range(23)]
    seconds = {name: 30.0 + number for number, name in enumerate(names[:20])} | {"test_20": 500.0}
    met = set[str]()
    for day in range(40):
        chosen = of_the_day(names, seconds, 120, date.fromordinal(740_000 + day))
        assert chosen and sum(seconds[name] for name in chosen) <= 120
        met |= {*chosen}
    assert met == set(names[:20])  # what takes too long, or was never run, is left out


def test_the_page_keeps_what_it_is_told() -> None:
    page = (evidence.ROOT / evidence.PAGE).read_text()
    rows = read(page) | {"test_one": GOOD, "test_two": replace(GOOD, said="1 failed, 2 passed", commit="abc1234+")}
    assert read(written(page, rows)) == rows and written(page, read(page)) == page
    assert set(read(page)) <= set(slow_files())


def test_covered_is_what_is_imported_to_the_last() -> None:
    paths = covered("test_analysis_picks")
    assert {
        "tests/test_analysis_picks.py",
        "analysis/search/start_positions.py",
        "planner/simulator/exact_tree.py",
    } <= paths
    assert "tests/test_analysis_control.py" in covered("test_analysis_value")
    assert "analysis/studio/server.py" not in paths and "mrac_jax/__init__.py" not in paths


def test_what_is_older_than_its_code_is_named(tmp_path: Path) -> None:
    def git(*words: str) -> str:
        name = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(["git", *name, *words], cwd=tmp_path, check=True, capture_output=True, text=True).stdout

    (tmp_path / "tests").mkdir()
    (tmp_path / "planner").mkdir()
    for name in ("a", "b", "c", "d", "e"):
        (tmp_path / f"tests/test_{name}.py").write_text(
            f"from planner import {'one' if name < 'c' else 'two'}\n# {SLOW}\n"
        )
    for name in ("one", "two", "__init__"):
        (tmp_path / f"planner/{name}.py").write_text("A = 1\n")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "first")
    rows = {f"test_{name}": replace(GOOD, commit=git("rev-parse", "HEAD").strip()) for name in "abcd"}
    rows["test_b"] = replace(rows["test_b"], said="1 failed, 3 passed")
    rows["test_d"] = replace(rows["test_d"], commit=rows["test_d"].commit + "+")
    said = ["test_b: 1 failed, 3 passed", "test_d: run with changes that were not committed", "test_e: never run"]
    assert list(stale(rows, tmp_path)) == said
    (tmp_path / "planner/two.py").write_text('"""Two."""\n\nA = 1  # or more\n"""As it was."""\n')
    assert list(stale(rows, tmp_path)) == said
    (tmp_path / "planner/two.py").write_text("A = 2\n")
    assert "test_c: older than the code that it covers (planner/two.py)" in list(stale(rows, tmp_path))


def test_a_run_says_how_it_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "MOST", 0.0)
    assert evidence.run("test_evidence").said == "cut off after 0.0 s"
