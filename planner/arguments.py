"""Checks of arguments. Messages name a Python argument or a command-line option, as the user typed it."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Iterable
from contextvars import ContextVar
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Literal, get_args

from planner.errors import InputError, PlanError, UsageError

# Limits: of the random-number counter (SPEC section 6) and of the storage of rollout ids (section 9).

MAX_STEP = 2**22 - 2
"""Last step that the random-number counter can address."""
MOST_ROLLOUTS = 2**32
"""Number of rollout ids."""
MAX_PLAN_BYTES = 2**26
"""Limit of a plan or state file: 64 MiB, about 6 million path entries. Reading it takes about 16 times the memory."""
BLOCK = 4096
"""Rollout ids of an aligned block, the unit of storage, of resuming and of stopping rules."""

EngineName = Literal["auto", "jax", "numba"]
ENGINES: tuple[EngineName, ...] = get_args(EngineName)

# Arguments.

COMMAND_LINE: ContextVar[bool] = ContextVar("command_line", default=False)
"""True while a command line runs: `argument` then names options."""
OPTIONS = {
    "first_only=True": "--threat-checks first_visit",
    "picks": "--pick",
    "folder": "--out",
    "evaluated": "--rollouts",
    "force=True": "--force",
}
"""Arguments whose option has another name."""


def argument(name: str, *value: object) -> str:
    """An argument, with its value if one is given: `loop='both'` in Python, `--loop both` on the command line."""
    shown = "".join(f"={reprlib.repr(item)}" for item in value)
    if not COMMAND_LINE.get():
        return f"{name}{shown}"
    typed = "".join(f" {_typed(item)}" for item in value)
    return OPTIONS.get(f"{name}{shown}", f"--{name.replace('_', '-')}{typed}")


def _typed(value: object) -> str:
    """A value as typed on the command line."""
    if isinstance(value, list | tuple):
        return ",".join(map(_typed, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def exactly(value: float) -> str:
    """A number in the fewest digits that identify it, as an option accepts it: "20", "0.1", "1e-05"."""
    short = f"{value:g}"
    return short if float(short) == value else str(value)


def is_whole(value: object, low: int, high: int) -> bool:
    """True for a whole number (no boolean, no 8.0) with low <= value <= high."""
    return isinstance(value, Integral) and not isinstance(value, bool) and low <= int(value) <= high


def as_whole(value: Any) -> Any:
    """An integral float as an int (1e4 as 10000); other values unchanged, for a later check."""
    return int(value) if not isinstance(value, Integral) and is_real(value) and value == int(value) else value


def is_real(value: object) -> bool:
    """True for a finite number (no boolean, no text)."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


def check_each(name: str, given: object, robots: int, source: str = "", what: str = "number") -> None:
    """Raise PlanError for a tuple whose length is not the number of robots."""
    if isinstance(given, tuple) and len(given) != robots:
        problem = f"{argument(name)} of {len(given)} robots for a team of {robots}"
        raise PlanError(problem, source=source, expected=f"one {what}, or one for each robot")


@dataclass(frozen=True)
class Numbers:
    """A set of accepted numbers. The check of a value and its message have the same source.

    Attributes:
        least, most: the limits. above: `least` is excluded. below: `most` is excluded.
        what: noun for the message. whole: integers only; the float 8.0 is refused.
        text: full text for the message, in place of `what` and the limits.
    """

    least: float = -math.inf
    most: float = math.inf
    what: str = "a number"
    above: bool = False
    below: bool = False
    whole: bool = False
    text: str = ""

    @property
    def expected(self) -> str:
        """Text of the accepted values: "a number above 0, at most 1"."""
        least, most = (str(n) if self.whole else exactly(n) for n in (self.least, self.most))
        first = f"{self.what} above {least}" if self.above else f"{self.what}, {least}"
        if math.isinf(self.most):
            words = self.what if math.isinf(self.least) else first if self.above else f"{first} or more"
        else:
            words = f"{first}, {'below' if self.below else 'at most'} {most}" if self.above else f"{first} to {most}"
        return self.text or words

    def accepts(self, value: object) -> bool:
        """True for an accepted number."""
        if not is_real(value) or (self.whole and not isinstance(value, Integral)):
            return False
        number: Any = value
        after = self.least < number if self.above else self.least <= number
        return after and (number < self.most if self.below else number <= self.most)

    def check(
        self,
        name: str,
        value: object,
        error: type[InputError] = UsageError,
        source: str = "",
        fix: str = "",
        optional: bool = False,
    ) -> None:
        """Raise `error` unless the argument `name` is an accepted number; `optional`: or None."""
        if not self.accepts(value) and not (optional and value is None):
            raise error(argument(name, value), source=source, expected=self.expected, fix=fix or self.meant(value))

    def meant(self, value: object) -> str:
        """The fix for a percentage instead of a fraction: "did you mean 0.05?" for 5; "" for other values."""
        number: Any = value
        if self.most > 1 or not is_real(value) or not 1 < number <= 100 or not self.accepts(number / 100):
            return ""
        return f"did you mean {number / 100:g}?"


ANY = Numbers()
"""Every finite number."""


def whole(least: float, most: float = math.inf, what: str = "a whole number", text: str = "") -> Numbers:
    """Whole numbers within these limits."""
    return Numbers(least, most, what, whole=True, text=text)


POSITIVE = Numbers(0, above=True)
FRACTION = Numbers(0, 1, "a fraction")
SEED = whole(0, 2**64 - 1, text="a whole number, 0 to 2**64 - 1")


def check_word(
    name: str, value: object, words: Iterable[str], error: type[InputError] = UsageError, source: str = ""
) -> None:
    """Raise `error` unless the argument `name` is one of `words`."""
    words = tuple(words)
    if isinstance(value, str) and value in words:
        return
    expected = " or ".join(map(repr, words))
    raise error(argument(name, value), source=source, expected=expected, fix=did_you_mean(value, words))


def nearest(given: object, words: Iterable[str], likeness: float = 0.6) -> str:
    """The word of `words` closest to `given`, "" if none is close. Case, - and _ do not count.

    `likeness`: minimum similarity, 0 to 1.
    """
    plain = {_plain(word): word for word in words}
    close = difflib.get_close_matches(_plain(str(given)[:60]), plain, n=1, cutoff=likeness)
    return plain[close[0]] if close else ""


def _plain(word: str) -> str:
    return word.lower().replace("-", "").replace("_", "")


def did_you_mean(given: object, words: Iterable[str]) -> str:
    """The fix for a word that is not in `words`: the closest one; "" if none is close."""
    close = nearest(given, words)
    return f"did you mean {close!r}?" if close else ""
