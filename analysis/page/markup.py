"""HTML that cannot be broken by what stands in it: every text is escaped unless it is already `Html`."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable

from planner.visible import visible

VOID = {"br", "col", "hr", "img", "input", "link", "meta"}
"""Elements without an end tag."""


class Html(str):
    """Text that is HTML already: put in as it is."""

    __slots__ = ()


def escape(text: object) -> Html:
    """`text` as HTML that shows it: markup escaped, invisible, unpaired and direction-turning characters named."""
    if isinstance(text, Html):
        return text
    return Html(html.escape(visible(str(text)), quote=True))


def element(name: str, /, *children: object, **attributes: object) -> Html:
    """`<name attributes>children</name>`. Attributes of None or False are left out, True stands alone.

    `class_` is class, `for_` is for; other underscores become hyphens (`aria_label`).
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        words.append(key if value is True else f'{key}="{escape(value)}"')
    opening = f"<{' '.join(words)}>"
    return Html(opening if name in VOID else f"{opening}{join(children)}</{name}>")


def join(parts: Iterable[object], between: str = "") -> Html:
    """The parts one after another, each escaped unless it is Html."""
    return Html(between.join(escape(part) for part in parts if part is not None))


def paragraphs(lines: Iterable[object], **attributes: object) -> Html:
    """One `<p>` a line."""
    return join(element("p", line, **attributes) for line in lines)


def items(lines: Iterable[object], **attributes: object) -> Html:
    """A list, one entry a line; nothing of no lines."""
    entries = [element("li", line) for line in lines]
    return element("ul", *entries, **attributes) if entries else Html()


def data(value: object, **attributes: object) -> Html:
    """A script element that holds `value` as JSON: inert, and nothing in it can end it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return element("script", Html(text), type="application/json", **attributes)
