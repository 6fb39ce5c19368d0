"""Exceptions for bad input: each names source, value, expectation and fix.

Text from files and names is escaped for display: it cannot move a cursor, set a title or reverse the text direction.
"""

from __future__ import annotations

import unicodedata

HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
"""Unicode categories of characters that control a terminal, are invisible, or change the direction of the text."""


def visible(text: str, kept: str = "\n\t") -> str:
    r"""`text` with control characters (except those in `kept`), C1 and direction marks as escapes such as `\x1b`."""

    def shown(letter: str) -> str:
        hidden = unicodedata.category(letter) in HIDDEN and letter not in kept
        return letter.encode("unicode_escape").decode("ascii") if hidden else letter

    return text if text.isprintable() else "".join(map(shown, text))


PER_VISIT = "random numbers for each visit were removed in release 0.4; use release 0.3"
"""Message about files and options that need them."""


class MracError(Exception):
    """Base class of all errors that this project raises on purpose."""


class InputError(MracError, ValueError):
    """Bad input from a user. `str(error)` is one line: source, problem, expectation, fix.

    It is a `ValueError`, so code that wraps the `ValueError` of a library has to let an `InputError` pass first.

    Args:
        problem: what is wrong, with the offending value; or another error, for libraries that re-raise an error of
            another process as `type(error)(error)`.
        source: file, option or key of the value ("" if there is none).
        expected: accepted values ("" if the problem implies them).
        fix: what the user can do ("" if the expectation implies it).
    """

    def __init__(self, problem: str | Exception, *, source: object = "", expected: str = "", fix: str = "") -> None:
        self.problem, self.source, self.expected, self.fix = str(problem), str(source), expected, fix
        parts = [f"{self.source}: {self.problem}" if self.source else self.problem]
        if expected:
            parts.append(f"expected {expected}")
        if fix:
            parts.append(fix)
        super().__init__(visible(" ".join("; ".join(parts).split())))


class WorldError(InputError):
    """A world that cannot be used: shape, threat values, starts."""


class MapError(InputError):
    """A map, image, raster or elevation file that cannot be read."""


class ScenarioError(InputError):
    """A scenario file with a wrong key, value or combination."""


class PlanError(InputError):
    """A plan that does not fit its world, or whose paths cannot be driven."""


class StateError(InputError):
    """A state of a mission that does not fit its world, or itself."""


class UsageError(InputError):
    """Options of the command line that are wrong or contradict each other."""
