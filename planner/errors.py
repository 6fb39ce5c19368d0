"""The typed errors that bad input raises: each names the source, the value, what was expected and the fix.

Text from files and names is made fit to be shown: nothing in it moves a cursor, sets a title or turns a line round.
"""

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


PER_VISIT = "random numbers for each visit left with release 0.4; use release 0.3"
"""What is said to files and options that ask for them."""


class MracError(Exception):
    """Base of every error that this project raises on purpose."""


class InputError(MracError, ValueError):
    """Bad input from a person. `str(error)` is one line: source, problem, what was expected, the fix.

    It is a `ValueError`, so code that wraps the `ValueError` of a library lets an `InputError` pass first.

    Args:
        problem: what is wrong, with the offending value in it; or another error, as libraries do that raise the error
            of another process again, `type(error)(error)`.
        source: the file, option or key the value came from ("" when there is none).
        expected: what would have been accepted ("" when the problem says it).
        fix: what the person can do now ("" when the expectation says it).
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
