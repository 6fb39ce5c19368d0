"""Text from files and names, made fit to be shown: nothing in it moves a cursor, sets a title or turns a line round."""

from __future__ import annotations

import unicodedata

HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
"""Categories of characters that command a terminal, that nobody sees, or that turn the direction of the text."""


def visible(text: str, kept: str = "\n\t") -> str:
    r"""`text` with control characters (but those in `kept`), C1 and direction marks too, as escapes such as `\x1b`."""

    def shown(letter: str) -> str:
        hidden = unicodedata.category(letter) in HIDDEN and letter not in kept
        return letter.encode("unicode_escape").decode("ascii") if hidden else letter

    return text if text.isprintable() else "".join(map(shown, text))
