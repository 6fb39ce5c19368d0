"""Exceptions for bad input with source, value, expectation and fix; and the names of release 0.3.

Text from files and names is escaped for display: it cannot move a cursor, set a title or reverse the text direction.
"""

from __future__ import annotations

import unicodedata
import warnings
from collections.abc import Collection, Mapping
from typing import Any

HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
"""Unicode categories of characters that control a terminal, are invisible, or change the direction of the text."""


def visible(text: str, kept: str = "\n\t") -> str:
    r"""`text` with control characters (except those in `kept`), C1 and direction marks as escapes such as `\x1b`."""

    def escaped(letter: str) -> str:
        hidden = unicodedata.category(letter) in HIDDEN and letter not in kept
        return letter.encode("unicode_escape").decode("ascii") if hidden else letter

    return text if text.isprintable() else "".join(map(escaped, text))


PER_VISIT = "random numbers for each visit were removed in release 0.4; use release 0.3"
"""Message for files and options that need random numbers for each visit."""


class MracError(Exception):
    """Base class of all errors that this project raises on purpose."""


class InputError(MracError, ValueError):
    """Bad input from a user. `str(error)` is one line: source, problem, expectation, fix.

    It is a `ValueError`, so code that wraps the `ValueError` of a library has to let an `InputError` pass first.

    Args:
        problem: description of the error, with the offending value; or another error, for libraries that re-raise an
            error of another process as `type(error)(error)`.
        source: file, option or key of the value ("" if there is none).
        expected: accepted values ("" if the problem implies them).
        fix: the user's remedy ("" if the expectation implies it).
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
    """A mission state that does not fit its world, or is inconsistent."""


class UsageError(InputError):
    """Options of the command line that are wrong or contradict each other."""


# Names of release 0.3 that are still read in 0.4, each with one warning that gives the new name.

RENAMED = {
    "worth": "robot_value", "reserve": "risk_cap", "worths": "robot_values", "reserves": "risk_caps",
    "wear": "weibull_shape", "susceptibility": "hazard_multiplier", "sense": "sensor_range", "prior": "prior_map",
    "truth": "true_map", "movers": "moving_threats", "hazard": "latent_hazard", "uncertain": "map_uncertainty",
    "meaning": "metric",
}  # fmt: skip
"""Settings, arguments, options (`--robot-value`) and keys of files: old to new."""
LOOPS = {"closed": "closed_loop", "open": "open_loop"}
"""Values of `plan_for`: old to new."""
_OLD = {new: old for old, new in RENAMED.items()}


class RenamedWarning(FutureWarning):
    """A name of release 0.3 was used; release 0.5 does not read it."""


def warn_renamed(old: str, new: str, source: object = "") -> None:
    """Warn that `old` is now `new`; `source`: the file that has the old name."""
    where = f"{source}: " if str(source) else ""
    warnings.warn(f"{where}{old} is now {new}; release 0.5 no longer reads {old}", RenamedWarning, stacklevel=3)


def with_new_names(given: Mapping[Any, Any], allowed: Collection[str], source: object = "") -> dict[Any, Any]:
    """The same values under today's names, for names that `allowed` has only in their new form."""
    found = dict(given)
    for old in [name for name in found if isinstance(name, str) and name in RENAMED and name not in allowed]:
        if (new := RENAMED[old]) in allowed and new not in found:
            warn_renamed(f"`{old}`", f"`{new}`", source)
            found = {new if name == old else name: value for name, value in found.items()}
    for old in [name for name in found if name in ("first_visit", "first_visit_b") and name not in allowed]:
        if (new := f"threat_checks{old.removeprefix('first_visit')}") in allowed:
            warn_renamed(f"`{old}`", f"`{new}`", source)
            found[new] = "first_visit" if found.pop(old) else "every_visit"
    return found


def names_of_0_3(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings under the names of 0.3. Identities hash these names, so that stores and plans of 0.3 keep theirs."""
    values = {new: old for old, new in LOOPS.items()}
    found = {_OLD.get(name, name): value for name, value in settings.items()}
    return found | ({"plan_for": values[found["plan_for"]]} if found.get("plan_for") in values else {})
