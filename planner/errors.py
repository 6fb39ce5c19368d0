"""The typed errors that bad input raises: each names the source, the value, what was expected and the fix."""

from __future__ import annotations

from planner.visible import visible


class MracError(Exception):
    """Base of every error that this project raises on purpose."""


class InputError(MracError):
    """Bad input from a person. `str(error)` is one line: source, problem, what was expected, the fix.

    Args:
        problem: what is wrong, with the offending value in it.
        source: the file, option or key the value came from ("" when there is none).
        expected: what would have been accepted ("" when the problem says it).
        fix: what the person can do now ("" when the expectation says it).
    """

    def __init__(self, problem: str, *, source: object = "", expected: str = "", fix: str = "") -> None:
        self.problem, self.source, self.expected, self.fix = problem, str(source), expected, fix
        parts = [f"{self.source}: {problem}" if self.source else problem]
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
