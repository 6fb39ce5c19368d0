"""How long a scenario says that a step takes: `step: {seconds: 2}`, or `speed: 0.5`, metres a second; and a `turn`."""

from __future__ import annotations

from planner.pace import SPEEDS, STEP_SECONDS, TURNS, Pace
from planner.worlds.keys import Key
from planner.worlds.world import World

KEYS = ("step", "speed", "turn")


def pace_in(keys: dict[str, Key], world: World) -> Pace:
    """The pace that the keys name. Raises ScenarioError, also for a speed where nobody says how large cells are."""
    turn = keys["turn"].number(TURNS) if "turn" in keys else 0.0
    return Pace(_seconds_in(keys, world), turn)


def _seconds_in(keys: dict[str, Key], world: World) -> float | None:
    """Seconds a step; None: nobody says."""
    if "step" in keys:
        if "speed" in keys:
            raise keys["speed"].wrong("none beside step", "leave one of the two out")
        return keys["step"].mapping(("seconds",))["seconds"].number(STEP_SECONDS)
    if "speed" not in keys:
        return None
    seconds = world.cell_size / keys["speed"].number(SPEEDS)
    if not world.measured:
        problem = "is given, but nobody says how many metres a cell has"
        raise keys["speed"].fault(problem, fix="give `cell_size:` too, or `step: {seconds: ...}` instead")
    if not STEP_SECONDS.accepts(seconds):
        raise keys["speed"].fault(f"makes a step take {seconds:g} s", STEP_SECONDS.expected)
    return seconds
