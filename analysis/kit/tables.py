"""Tables and lines on a console, as every answer prints them."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table


def make_table(
    columns: Iterable[str], title: str | None = None, *, left: Container[str] = ("",), fixed: Any = None, **look: Any
) -> Table:
    """A table without rows.

    Args:
        columns: their names. left: those of words, which stand to the left. fixed: those that are never wrapped.
        look: as of rich's Table.
    """
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", **look)
    for name in columns:
        table.add_column(name, justify="left" if name in left else "right", no_wrap=fixed is not None and name in fixed)
    return table


def print_lines(console: Console, lines: Sequence[str]) -> None:
    """Lines as they are, whatever is in them."""
    for line in lines:
        console.print(line, markup=False, highlight=False)
