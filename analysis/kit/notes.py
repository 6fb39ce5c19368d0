"""Notes to whoever runs this, on standard error, and what tells how far it has come."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from planner.errors import visible

Progress = Callable[[int, int, float], None]
"""`progress(done, total, seconds)`, called after every chunk; `total` is 0 when it is not known."""
Doing = Callable[[str], None]
"""`doing(what)`, called when something else begins."""


def quiet(*_: object) -> None:
    """The `Progress` and the `Doing` of who does not want to be told."""


def say(lines: Sequence[str]) -> None:
    """Print notes to standard error, one a line, whatever is in them."""
    for line in lines:
        print(visible(line, kept="\t"), file=sys.stderr)  # noqa: T201
