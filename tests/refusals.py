"""What every command does with bad input: one line, and status 2."""

from __future__ import annotations

import pytest

from analysis.cli.app import run


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line on standard error of a command that exits with 2."""
    assert run(list(words)) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("error: ") and said.err.count("\n") == 1
    return said.err.strip()
