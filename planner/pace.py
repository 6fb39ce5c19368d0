"""How long a step takes, where somebody says it: a time in steps is then said in minutes too, and given in either; and
how many steps a quarter turn costs, which is said beside it.

No plan, tally, hash or count knows it (docs/spec.md, section 18).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from planner.arguments import Numbers, argument
from planner.errors import UsageError
from planner.shown import counted, duration

STEP_SECONDS = Numbers(1e-6, 1e6, "seconds")
SPEEDS = Numbers(0, 1_000, "metres a second", above=True)
TURNS = Numbers(0, 1_000, "steps a quarter turn")
UNITS = {"h": 3600.0, "min": 60.0, "s": 1.0}
SPAN = re.compile(r"\s*".join(rf"(?:([0-9]{{1,9}}(?:\.[0-9]{{1,9}})?)\s*{unit})?" for unit in UNITS))
TIMES = "45min, 1h30min or 90s"
SPANS = f"steps, as 450, or a time, as {TIMES}"
WHOLE = 1e-12
"""By how much of itself a quotient may lie below a whole number and count as it: what floats lose."""
SHORT = 9.5
"""Seconds below which tenths are said."""
HOW_TO_SAY = "the scenario's `step: {seconds: 2}` or `speed:` (m/s)"


def seconds_of(text: str) -> float | None:
    """Seconds of a time as `1h30min`, `45 min` or `90s`, larger units first; None for what is none."""
    found = SPAN.fullmatch(text.strip())
    if not found or not any(found.groups()):
        return None
    return sum(float(number) * unit for number, unit in zip(found.groups(), UNITS.values(), strict=True) if number)


@dataclass(frozen=True)
class Pace:
    """The seconds that a step takes; None: nobody says, and times are in steps alone. `turn`: steps a quarter turn."""

    seconds: float | None = None
    turn: float = 0.0

    def __bool__(self) -> bool:
        return self.seconds is not None

    @property
    def minutes(self) -> float:
        """That a step takes; NaN where nobody says."""
        return math.nan if self.seconds is None else self.seconds / 60.0

    def also(self, steps: float) -> str:
        """What stands after a time in steps: " (22 min 30 s)"; "" where nobody says how long a step takes."""
        if self.seconds is None:
            return ""
        seconds = steps * self.seconds
        return f" ({seconds:.2g} s)" if seconds < SHORT else f" ({duration(seconds)})"

    @property
    def each(self) -> str:
        """What stands after the name of an axis of steps: " (3 s each)"."""
        return "" if self.seconds is None else f" ({self.seconds:.3g} s each)"

    def step(self, step: float) -> str:
        """ "step 450 (22 min 30 s)"."""
        return f"step {round(step):,}{self.also(step)}"

    def steps(self, steps: float) -> str:
        """ "450 steps (22 min 30 s)", of a mean the nearest whole number of them."""
        return f"{counted(round(steps), 'step')}{self.also(steps)}"

    def last_step(self, name: str, given: Any, source: str = "") -> Any:
        """The last step that is over by a deadline, which is one or a time; anything else as it is, for a check.

        Raises UsageError, naming the argument `name`, or the key of that name in `source`, for a text that is no time,
        and where nobody says how long a step takes.
        """
        if not isinstance(given, str):
            return given
        seconds, said = seconds_of(given), f"`{name}` is {given}" if source else argument(name, given)
        if seconds is None:
            raise UsageError(said, source=source, expected=SPANS)
        if self.seconds is None:
            options = "" if source else f"{argument('step_seconds')} or {argument('speed')}, or "
            fix = f"give {options}{HOW_TO_SAY}"
            problem = f"{said}, but nobody says how long a step takes"
            raise UsageError(problem, source=source, expected="steps", fix=fix)
        return math.floor(seconds / self.seconds * (1 + WHOLE))


UNPACED = Pace()


def pace_of(step_seconds: Any, speed: Any, cell_size: float | None) -> Pace:
    """The pace that is asked for by one of the two, or by none; `cell_size`: metres, None where nobody says.

    Raises UsageError.
    """
    if step_seconds is not None and speed is not None:
        both = f"both {argument('step_seconds')} and {argument('speed')} are given"
        raise UsageError(both, expected="one of them")
    if step_seconds is not None:
        STEP_SECONDS.check("step_seconds", step_seconds)
        return Pace(float(step_seconds))
    if speed is None:
        return UNPACED
    SPEEDS.check("speed", speed)
    if cell_size is None:
        problem = f"{argument('speed', speed)}, but nobody says how many metres a cell has"
        raise UsageError(problem, fix=f"give {argument('cell_size')}, or {argument('step_seconds')} instead")
    if not STEP_SECONDS.accepts(cell_size / speed):
        problem = f"{argument('speed', speed)} makes a step of {cell_size:g} m take {cell_size / speed:g} s"
        raise UsageError(problem, expected=STEP_SECONDS.expected)
    return Pace(cell_size / speed)
