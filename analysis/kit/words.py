"""Numbers with their things, as the commands say them."""

from __future__ import annotations


def counted(number: int, thing: str, things: str = "") -> str:
    """ "1 chunk", "3,001 rollouts"; `things`: the plural, where an s does not make it."""
    return f"{number:,} {thing if number == 1 else things or thing + 's'}"
