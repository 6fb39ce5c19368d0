"""Tables of the page, of their own or as the command line prints them: both say the same because they are the same."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from analysis.page.markup import Html, element, join

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
    rows: tuple[tuple[str, ...], ...]
    words: frozenset[int] = frozenset({0})
    notes: tuple[str, ...] = ()
    unfolded: bool = False


class _Recorder(Console):
    """Keeps what is printed instead of writing it."""

    def __init__(self) -> None:
        super().__init__(width=200, color_system=None, force_terminal=False)
        self.printed: list[object] = []

    def print(self, *objects: object, **_: object) -> None:
        self.printed += objects


def printed(draw: Callable[[Console], None]) -> tuple[list[str], list[TableData]]:
    """(lines, tables) that `draw(console)` prints."""
    recorder = _Recorder()
    draw(recorder)
    tables = [from_rich(thing) for thing in recorder.printed if isinstance(thing, Table)]
    return [thing for thing in recorder.printed if isinstance(thing, str)], tables


def from_rich(table: Table) -> TableData:
    """A table of the command line; right-aligned columns hold numbers."""
    columns = [[_plain(cell) for cell in column.cells] for column in table.columns]
    words = frozenset(place for place, column in enumerate(table.columns) if column.justify != "right")
    names = tuple(_plain(column.header) for column in table.columns)
    return TableData(_plain(table.title or ""), names, tuple(zip(*columns, strict=True)), words)


def _plain(cell: object) -> str:
    return str(cell)


def table_html(table: TableData) -> Html:
    """The table; long ones folded, wide ones in a box that scrolls by itself."""
    head = element("tr", *(_cell("th", table, place, name, scope="col") for place, name in enumerate(table.columns)))
    shown = table.rows[:MOST_ROWS]
    notes = [element("p", note, class_="note") for note in table.notes]
    if len(shown) < len(table.rows):
        left = f"{len(shown):,} of {len(table.rows):,} rows; the files beside this page hold all."
        notes.append(element("p", left, class_="note"))
    body = element(
        "table",
        element("thead", head),
        element("tbody", *(_row(table, row) for row in shown)),
    )
    box = element("div", body, class_="scroll", tabindex="0", role="region", aria_label=table.title or "table")
    heading = element("h3", table.title) if table.title else None
    if len(shown) > FOLDED_FROM:
        box = element("details", element("summary", f"{len(shown):,} rows"), box, open=table.unfolded)
    return element("div", heading, box, *notes)


def tables_html(tables: Sequence[TableData]) -> Html:
    """One after another; side by side where there is room for two."""
    return element("div", *map(table_html, tables), class_="tables") if tables else Html()


def _row(table: TableData, row: tuple[str, ...]) -> Html:
    cells = [_cell("th" if place == 0 else "td", table, place, text) for place, text in enumerate(row)]
    return element("tr", *cells)


def _cell(name: str, table: TableData, place: int, text: str, scope: str | None = None) -> Html:
    if name == "th" and scope is None:
        scope = "row"
    return element(name, judged(text), scope=scope, class_=None if place in table.words else "number")


def judged(text: str) -> Html:
    """Text with its verdict, if it has one, as a coloured word with a sign."""
    found = VERDICTS.search(text)
    if found is None:
        return join([text])
    word = element("span", found[0], class_=f"verdict {LOOKS[found[0].lower()]}")
    return join((text[: found.start()], word, text[found.end() :]))
