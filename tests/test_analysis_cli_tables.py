"""Every table of every command on consoles of 80, 100 and 120 columns: no figure, interval or name is cut."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from analysis.cli.app import run
from analysis.utils.folder import as_text
from analysis.utils.tables import FittedTable
from planner.world.world import World

WIDTHS = (80, 100, 120)
THREAT = np.zeros((6, 9))
THREAT[1:3, 3:7], THREAT[4:, 6:], THREAT[0, 8] = 0.2, 0.05, np.nan
FEW, TEAM = ["--rollouts", "64"], ["--robots", "3"]
CLOSED, FRONT = ["evaluate", "map.npz", *TEAM, *FEW], ["--worths", "12.5", "--reserves", "0.25", *FEW]
COMMANDS = {
    "evaluate": [*CLOSED, "--threat-scale", "0.5,2", "--deadline", "40", "--theory"],
    "open loop": [*CLOSED, "--loop", "open", "--theory"],
    "value": ["evaluate", "valued.yaml", *FEW, "--metrics", "search"],
    "in doubt": ["evaluate", "doubtful.yaml", *FEW],
    "size": ["size", "map.npz", "--target", "0.9", "--most", "4", *FEW],
    "size of value": ["size", "valued.yaml", "--target", "0.9", "--most", "4", *FEW],
    "front": ["front", "map.npz", *TEAM, *FRONT],
    "front with a goal": ["front", "valued.yaml", "--target", "0.5", *FRONT],
    "starts": ["starts", "map.npz", *TEAM, *FEW],
    "starts of value": ["starts", "valued.yaml", "--depot", *FEW],
    "clear": ["clear", "map.npz", *TEAM, *FEW],
    "attack": ["attack", "map.npz", *TEAM, *FEW],
    "attack on value": ["attack", "valued.yaml", "--count", "2", "--p", "0.4", *FEW],
    "compare": ["compare", "map.npz", *TEAM, "--b.policy", "per_cell", "--b.worth", "12.5", *FEW],
    "check": ["check", "map.npz", *TEAM, *FEW],
    "check of many": ["check", "--worlds", "2", "--robots", "1,2,3,4,12", "--size", "6x6", "--processes", "1", *FEW],
    "plan": ["plan", "map.npz", *TEAM],
    "sweep": ["sweep", "sweep.yaml", "--store", "results.db", "--processes", "1"],
    "results": ["results", "results.db"],
    "record": ["record", "map.npz", *TEAM, "--out", "run.mcap", "--force"],
    "inspect": ["inspect", "run.mcap"],
}
BEFORE = {"results": "sweep", "inspect": "record"}
"""What makes the file that a command reads."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the inputs of the commands above lie."""
    made = tmp_path_factory.mktemp("tables")
    World.create(THREAT).save(made / "map.npz")
    scenario = {"map": "map.npz", "robots": {"count": 3}}
    doubt = {"uncertain": {"spread": {"kind": "lognormal", "sigma": 0.5, "by": "common"}}}
    (made / "valued.yaml").write_text(json.dumps(scenario | {"value": 1234.5, "detect": 0.5}))
    (made / "doubtful.yaml").write_text(json.dumps(scenario | doubt))
    settings = {
        "base": {"input": "map.npz"},
        "rollouts": 64,
        "sweep": {"robots": [1, 3], "policy": ["mrac", "per_cell"]},
    }
    (made / "sweep.yaml").write_text(json.dumps(settings))
    return made


@pytest.mark.parametrize("command", COMMANDS)
def test_no_table_cuts_a_figure(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each is run once, on 80 columns; its tables are printed again at each width."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "80")
    if command in BEFORE:
        assert run(COMMANDS[BEFORE[command]]) == 0
        capsys.readouterr()
    shown: list[FittedTable] = []
    drawn = FittedTable.__rich_console__
    with monkeypatch.context() as kept:
        kept.setattr(FittedTable, "__rich_console__", lambda self, *how: (shown.append(self), drawn(self, *how))[1])
        assert run(COMMANDS[command]) == 0
    said = capsys.readouterr().out
    assert shown and "…" not in said and max(map(len, said.splitlines())) <= 80
    for table in shown:
        for width in WIDTHS:
            check_whole(table, width)


def check_whole(table: FittedTable, width: int) -> None:
    """Every figure stands on one line as it is, unless its column is said to be left out; no line is too long."""
    said = as_text(lambda console: console.print(table), width)
    body, _, note = said.partition("left out, as")
    left_out, words = " ".join(note.split()), set(body.split())
    lines = [" ".join(line.split()) for line in body.splitlines()]
    assert "…" not in said and max(map(len, said.splitlines())) <= width
    for place, column in enumerate(table.columns):
        name = table._named(place)
        if name and name in left_out:
            continue
        assert set(str(column.header).split()) <= words, (name, width)
        for cell in map(str, column.cells):
            whole = any(" ".join(cell.split()) in line for line in lines)
            in_words = column.justify != "right" and set(cell.split()) <= words
            assert whole or in_words, (name, cell, width)


def test_a_table_that_cuts_is_found() -> None:
    """The check above fails where a console is too narrow for a figure."""
    table = FittedTable()
    table.add_column("a figure", justify="right")
    table.add_row("1234567890 .. 1234567891")
    check_whole(table, 80)
    with pytest.raises(AssertionError):
        check_whole(table, 12)
