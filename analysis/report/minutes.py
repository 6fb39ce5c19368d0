"""Times of a JSON object in minutes beside those in steps: `time_minutes` beside `time`, and so on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from planner.formatting import Pace

TIMES = ("time", "time_to", "makespan", "deadline", "max_steps", "step", "steps")
"""Keys whose values are times in steps."""
OF_AN_ESTIMATE = ("mean", "se", "ci95", "max")
NO_TIMES = ("control",)
"""Keys below which figures are called as times are, and are none."""


def with_minutes(said: Any, pace: Pace) -> Any:
    """What JSON holds, with the minutes of every time in it; as it is where nobody says how long a step takes."""
    if not pace:
        return said
    if isinstance(said, list):
        return [with_minutes(one, pace) for one in said]
    if not isinstance(said, dict):
        return said
    out: dict[str, Any] = {}
    for name, value in said.items():
        out[name] = value if name in NO_TIMES else with_minutes(value, pace)
        minutes = _minutes(value, name, pace) if name in TIMES else None
        out |= {} if minutes is None else {f"{name}_minutes": minutes}
    return out


def _minutes(value: Any, name: str, pace: Pace) -> Any:
    """A number, numbers or an estimate in steps, in minutes; None for anything else."""
    if isinstance(value, Mapping):
        kept = value if name == "time_to" else [key for key in OF_AN_ESTIMATE if key in value]
        return {key: _minutes(value[key], "", pace) for key in kept} or None
    if isinstance(value, list):
        return [_minutes(one, "", pace) for one in value]
    return None if value is None or isinstance(value, bool | str) else value * pace.minutes
