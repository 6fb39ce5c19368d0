"""Notes to whoever runs this, on standard error, and what tells how far it has come."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial

from planner.errors import visible

Progress = Callable[[int, int, float], None]
"""`progress(done, total, seconds)`, called after every chunk; `total` is 0 when it is not known."""
Doing = Callable[[str], None]
"""`doing(what)`, called when something else begins."""


def quiet(*_: object) -> None:
    """The `Progress` and the `Doing` of who does not want to be told."""


def of_things(progress: Progress, things: str) -> Progress:
    """The same, of other things than rollouts; who does not say what is counted hears the numbers alone."""
    said: Callable[..., None] = progress
    return partial(said, things=things) if getattr(progress, "says_things", False) else progress


def say(lines: Sequence[str]) -> None:
    """Print notes to standard error, one a line, whatever is in them."""
    for line in lines:
        print(visible(line, kept="\t"), file=sys.stderr)  # noqa: T201
