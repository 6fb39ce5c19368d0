"""How an object shows itself in a console and in a notebook: a title, rows of a name and what it is; counts, times."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

Rows = Sequence[tuple[str, str]]


def text_of(title: str, rows: Rows) -> str:
    """For `__repr__`: the title, then a line a row."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {what}" for name, what in rows)])


def html_of(title: str, rows: Rows) -> str:
    """For `_repr_html_`: the same as a table."""
    cells = (f'<tr><td>{escape(name)}</td><td style="text-align:left">{escape(what)}</td></tr>' for name, what in rows)
    return f"<b>{escape(title)}</b><table>{''.join(cells)}</table>"


def counted(number: int, thing: str, things: str = "") -> str:
    """ "1 chunk", "3,001 rollouts"; `things`: the plural, where an s does not make it."""
    return f"{number:,} {thing if number == 1 else things or thing + 's'}"


def duration(seconds: float) -> str:
    """Seconds as "40 s", "2 min 5 s" or "1 h 20 min"."""
    whole = max(round(seconds), 1)
    if whole < 60:
        return f"{whole} s"
    larger, unit, smaller, rest = (whole // 60, "min", "s", whole % 60) if whole < 3600 else (
        whole // 3600, "h", "min", whole % 3600 // 60
    )  # fmt: skip
    return f"{larger} {unit}" + (f" {rest} {smaller}" if rest else "")
