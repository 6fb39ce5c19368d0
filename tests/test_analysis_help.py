"""`--help` and what is missing: every choice by its words, every format, what a command needs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from analysis.cli.app import run
from planner.settings import SETTINGS
from planner.world.map_files import FORMATS


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert run([command, "--help"]) == 0
    return re.sub(r"[\s│]+", " ", capsys.readouterr().out)


@pytest.mark.parametrize("command", ["evaluate", "plan", "compare", "starts"])
def test_choices_are_named(command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    told, shown = help_of(command, capsys), 0
    for name, setting in SETTINGS.items():
        if setting.kind == "word" and f"--{name.replace('_', '-')} " in told:
            words = (*setting.words, "best") if name == "policy" and command in ("evaluate", "plan") else setting.words
            assert f"[choices: {', '.join(words)}]" in told, name
            shown += 1
    assert shown >= 3


def test_input_names_every_format(capsys: pytest.CaptureFixture[str]) -> None:
    told = help_of("evaluate", capsys)
    named = set(re.findall(r"(?<!\w)\.[a-z]+\b", told[told.index("INPUT Scenario") : told.index("example:NAME")]))
    assert named == set(FORMATS)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("evaluate", "evaluate needs an INPUT, e.g. example:paper"),
        ("record", "record needs an INPUT, e.g. example:paper"),
        ("compare", "compare needs A, an INPUT, e.g. example:paper"),
        ("generate", "generate needs OUT"),
        ("record example:paper --out", "record needs a value after --out"),
        ("compare example:paper --b.robots", "compare needs a value after --b.robots"),
        (
            "evaluate example:paper --deadline 10m",
            "--deadline '10m'; expected steps, as 450, or a time, as 45min, 1h30min or 90s",
        ),
        (
            "plan example:paper --deadline 10m",
            "--deadline '10m'; expected steps, as 450, or a time, as 45min, 1h30min or 90s",
        ),
    ],
)
def test_what_a_command_needs(words: str, said: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(words.split()) == 2
    assert capfd.readouterr().err == f"error: {said}\n"


def test_a_scenario_is_no_sweep(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "field.yaml").write_text("map: field.npy\n")
    assert run(["sweep", str(tmp_path / "field.yaml")]) == 2
    assert "a sweep over it has `base: {input: field.yaml}`" in capfd.readouterr().err
