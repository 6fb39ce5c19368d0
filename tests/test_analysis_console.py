"""Text from files and names on the terminal: shown as escapes, whichever way it gets there."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.table import Table
from rich.text import Text

from analysis.cli.app import run
from analysis.cli.console import output_console
from analysis.utils.notes import say
from analysis.utils.tables import SafeConsole
from planner.errors import InputError, visible
from planner.world.world import World

HOSTILE = "a\x1b]0;title\x07b\x9b2Jc\u202etxt\u2066d\x08e\u200bf"
SHOWN = r"a\x1b]0;title\x07b\x9b2Jc\u202etxt\u2066d\x08e\u200bf"


def harmless(text: str) -> bool:
    return all(letter.isprintable() or letter == "\n" for letter in text)


def test_visible_keeps_what_can_be_seen() -> None:
    assert visible(HOSTILE) == SHOWN
    assert visible(visible(HOSTILE)) == SHOWN
    for plain in ("", "Zürich ± 3 %, 地図 🤖", "two\nlines\tand a tab", "\u00a0"):
        assert visible(plain) == plain
    assert visible("two\nlines\u2028\ud800", kept="") == r"two\nlines\u2028\ud800"


def test_notes_and_errors(capsys: pytest.CaptureFixture[str]) -> None:
    say([HOSTILE, "wrote a\nerror: b"])
    assert capsys.readouterr().err == f"{SHOWN}\nwrote a\\nerror: b\n"
    assert SHOWN in str(InputError(HOSTILE, source=HOSTILE, expected=HOSTILE, fix=HOSTILE))
    assert harmless(str(InputError(HOSTILE, source=HOSTILE, expected=HOSTILE, fix=HOSTILE)))


@pytest.mark.parametrize("colours", [True, False])
def test_the_console_shows_escapes_in_lines_tables_and_titles(colours: bool) -> None:
    out = io.StringIO()
    console = SafeConsole(file=out, width=200, force_terminal=colours, color_system="standard" if colours else None)
    table = Table("[red]x", HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE, Text(HOSTILE, style="bold"))
    console.print(HOSTILE, highlight=False)
    console.print(table)
    console.print("[link=https://example.org]x[/link] [/] :smile:", highlight=False)
    said = out.getvalue()
    assert said.count(SHOWN) == 4  # of a Text of its own rich drops some characters, the others are escapes too
    assert "[link=https://example.org]x[/link] [/] :smile:" in said
    assert "[red]x" in said
    if colours:  # the console's own colours, and nothing else
        assert "\x1b[1m" in said
        said = said.replace("\x1b[0m", "")
        said = re.sub(r"\x1b\[[0-9;]*m", "", said)
    assert harmless(said)
    rows = [line for line in said.splitlines() if "│" in line or "┃" in line]
    assert len(rows) == 2
    assert len({len(line) for line in rows}) == 1


def test_the_command_line_shows_escapes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    World.create(np.array([[0.0, 0.25, np.nan]])).save(f"{HOSTILE}.npz")
    Path("keys.yaml").write_text(f'map: x.npz\n"{HOSTILE.encode("unicode_escape").decode()}": 1\n')
    Path("raw.yaml").write_bytes(b"map: x\x1b.npz\n")
    Path("plan.json").write_text(json.dumps({"format": HOSTILE}))
    Path("a.geojson").write_text(json.dumps({"type": HOSTILE}))
    Path("shapes.yaml").write_text(
        f'map: "{HOSTILE.encode("unicode_escape").decode()}.npz"\nthreats: [{{polygons: a.geojson}}]\n'
    )
    name = f"{HOSTILE}.npz"
    wrong = (
        ["evaluate", f"{HOSTILE}.txt"],
        ["evaluate", "keys.yaml"],
        ["evaluate", "raw.yaml"],
        ["evaluate", "shapes.yaml"],
        ["evaluate", name, "--plan", "plan.json"],
        ["evaluate", name, f"--{HOSTILE}"],
        ["evaluate", name, "--robots", HOSTILE],
        [HOSTILE],
    )
    for words in wrong:
        assert run(words) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("error: ")
        assert harmless(said.err), words
    assert run(["plan", name, "--out", f"{HOSTILE}.json", "--waypoints", f"{HOSTILE}.csv"]) == 0
    said = capsys.readouterr()
    assert harmless(said.out + said.err)
    assert f"wrote {SHOWN}.json" in said.err


def test_help_is_still_drawn(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", "--help"]) == 0
    said = capsys.readouterr().out
    assert "--rollouts" in said
    assert "[bold" not in said
    assert output_console().width > 0
