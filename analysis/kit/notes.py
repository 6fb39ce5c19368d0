"""Notes to whoever runs this, on standard error."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from planner.visible import visible


def say(lines: Sequence[str]) -> None:
    """Print notes to standard error, one a line, whatever is in them."""
    for line in lines:
        print(visible(line, kept="\t"), file=sys.stderr)  # noqa: T201
