"""Tables of the page, of their own or as the command line prints them: both say the same because they are the same."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table

MOST_ROWS = 400
"""Rows of a table that are shown; the files beside the page hold all."""
FOLDED_FROM = 40
"""Longer tables are folded away until somebody asks for them."""
VERDICTS = re.compile(r"\b(fails|holds|vacuous|says nothing|undecided|not reproduced|reproduced)\b", re.IGNORECASE)
LOOKS = {
    "fails": "fails",
    "not reproduced": "fails",
    "holds": "holds",
    "reproduced": "holds",
    "undecided": "unsure",
    "vacuous": "empty",
    "says nothing": "empty",
}
"""How each verdict is shown: a colour and a sign, so that the colour is not all."""


@dataclass(frozen=True)
class TableData:
    """A table: `columns` names, `rows` of as many cells, `words` the columns that hold words, not numbers.

    unfolded: a long one is shown at once.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: frozenset[int] = frozenset({0})
    unfolded: bool = False

    @property
    def shown(self) -> Sequence[tuple[str, ...]]:
        """The rows that a page has room for."""
        return self.rows[:MOST_ROWS]

    @property
    def is_long(self) -> bool:
        """Whether it is folded away."""
        return len(self.shown) > FOLDED_FROM


def from_rich(table: Table, unfolded: bool = False) -> TableData:
    """A table of the command line; right-aligned columns hold numbers."""
    columns = [[str(cell) for cell in column.cells] for column in table.columns]
    words = frozenset(place for place, column in enumerate(table.columns) if column.justify != "right")
    names = tuple(str(column.header) for column in table.columns)
    return TableData(str(table.title or ""), names, tuple(zip(*columns, strict=True)), words, unfolded)


def parted(text: str) -> tuple[str, str, str, str]:
    """A text before its verdict, the verdict and its look, and the text after it; "" for what is not there."""
    found = VERDICTS.search(text)
    if found is None:
        return text, "", "", ""
    return text[: found.start()], found[0], LOOKS[found[0].lower()], text[found.end() :]
