"""Tables and lines on a console, as every answer prints them: no figure, interval or name is ever cut."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

KEPT_WHOLE, SHORT = 16, 10
"""Names of so many characters, and headers of so many, are not wrapped either."""


class FittedTable(Table):
    """A table that fits: columns of `dropped` go one by one, in this order; what is left stands in blocks of columns.

    Figures (columns to the right) are never wrapped, words and headers between words alone. A name in `dropped` that
    several columns have is the last of them.
    """

    dropped: tuple[str, ...] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        if not self.columns:
            return
        sizes = [self._sizes(console, options, place) for place in range(len(self.columns))]
        kept, gone = list(range(len(self.columns))), list[int]()
        for name in self.dropped:
            if self._widths(kept, sizes, options.max_width):
                break
            gone.append(max(place for place in kept if self.columns[place].header == name))
            kept.remove(gone[-1])
        for number, places in enumerate(self._blocks(kept, sizes, options.max_width)):
            yield self._part(places, self._widths(places, sizes, options.max_width), "" if number else self.title)
        if gone:
            names = ", ".join(map(self._named, sorted(gone)))
            has = "has it" if len(gone) == 1 else "have them"
            room = f"left out, as {options.max_width} characters have no room"
            yield Text(f"{room}: {names}; a wider window, --out and --json {has}")

    def _named(self, place: int) -> str:
        """A column's header; of those that share one, with that of the column before, which it goes with."""
        headers = [str(column.header) for column in self.columns]
        return headers[place] if headers.count(headers[place]) == 1 else f"{headers[place - 1]} {headers[place]}"

    def _sizes(self, console: Console, options: ConsoleOptions, place: int) -> tuple[int, int]:
        """Characters that a column needs, and that it takes without any wrapping; padding apart."""
        wide, column = options.update(max_width=100_000), self.columns[place]
        header, *cells = (Measurement.get(console, wide, text) for text in (column.header, *column.cells))
        whole = max((cell.maximum for cell in cells), default=0)
        needed = whole
        if column.justify != "right":
            needed = max(*(cell.minimum for cell in cells), min(whole, KEPT_WHOLE)) if cells else 0
        named = header.maximum if header.maximum <= SHORT else header.minimum
        return max(needed, named), max(whole, header.maximum)

    def _widths(self, places: Sequence[int], sizes: Sequence[tuple[int, int]], room: int) -> list[int]:
        """Of columns that stand side by side, words before figures in what is over; empty if they do not fit."""
        beside = self._part(places, [0] * len(places), "")
        spare = room - sum(map(beside._get_padding_width, range(len(places)))) - beside._extra_width
        spare -= sum(sizes[place][0] for place in places)
        if spare < 0:
            return []
        widths = [sizes[place][0] for place in places]
        for number in sorted(range(len(places)), key=lambda number: self.columns[places[number]].justify == "right"):
            more = min(spare, sizes[places[number]][1] - widths[number])
            widths[number], spare = widths[number] + more, spare - more
        return widths

    def _blocks(self, kept: Sequence[int], sizes: Sequence[tuple[int, int]], room: int) -> Iterator[list[int]]:
        """The columns that stand side by side; each block begins with the first column, which names the rows."""
        first, *rest = kept
        block = [first]
        for place in rest:
            if len(block) > 1 and not self._widths([*block, place], sizes, room):
                yield block
                block = [first]
            block.append(place)
        yield block

    def _part(self, places: Sequence[int], widths: Sequence[int], title: Any) -> Table:
        part = Table(title=title or None, box=self.box, title_justify=self.title_justify, padding=self.padding,
                     pad_edge=self.pad_edge, collapse_padding=self.collapse_padding)  # fmt: skip
        fixed: Sequence[int | None] = widths or [None] * len(places)
        part.columns = [
            replace(self.columns[place], _index=number, width=width, overflow="fold")
            for number, (place, width) in enumerate(zip(places, fixed, strict=True))
        ]
        part.rows = self.rows
        return part


def make_table(
    columns: Iterable[str],
    title: str | None = None,
    *,
    left: Container[str] = ("",),
    dropped: Iterable[str] = (),
    **look: Any,
) -> FittedTable:
    """A table without rows.

    Args:
        columns: their names. left: those of words, which stand to the left. dropped: as of `FittedTable`, those that
            can be missed, the least important first.
        look: as of rich's Table.
    """
    table = FittedTable(title=title, box=box.SIMPLE_HEAD, title_justify="left", **look)
    table.dropped = tuple(dropped)
    for name in columns:
        table.add_column(name, justify="left" if name in left else "right")
    return table


def print_lines(console: Console, lines: Sequence[str]) -> None:
    """Lines as they are, whatever is in them."""
    for line in lines:
        console.print(line, markup=False, highlight=False)
