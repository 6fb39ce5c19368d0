"""How long a scenario says that a step takes: `step: {seconds: 2}`, or `speed: 0.5`, metres a second; and a `turn`."""

from __future__ import annotations

from planner.arguments import Numbers
from planner.pace import SPEEDS, STEP_SECONDS, TURNS, Pace
from planner.worlds.keys import Key
from planner.worlds.world import World

KEYS = ("step", "speed", "turn")
CELLS_A_STEP = Numbers(0, 1, above=True)
NEARLY = 0.02
"""How far 1 / speed may be from a whole number of steps, of itself: 0.33 is a third."""


def pace_in(keys: dict[str, Key], world: World) -> Pace:
    """The pace that the keys name. Raises ScenarioError, also for a speed where nobody says how large cells are."""
    turn = keys["turn"].number(TURNS) if "turn" in keys else 0.0
    return Pace(_seconds_in(keys, world), turn)


def steps_per_move(key: Key) -> Key:
    """Cells a step, one number for all robots or one each, as whole steps a move. Raises ScenarioError."""
    several = isinstance(key.value, list)
    steps = []
    for item in key.items("cells a step, one a robot") if several else [key]:
        speed = item.number(CELLS_A_STEP)
        steps.append(round(1 / speed))
        if abs(steps[-1] * speed - 1) > NEARLY:
            raise item.wrong("cells a step: 1, or 1 over a whole number, as 0.5", "or give steps_per_move: [2, 3]")
    return Key(steps if several else steps[0], key.path, key.source)


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
        raise keys["speed"].fault(
            problem, fix="give the metres of a pixel, `map: {file: ..., resolution: 0.5}`, or `step: {seconds: ...}`"
        )
    if not STEP_SECONDS.accepts(seconds):
        raise keys["speed"].fault(f"makes a step take {seconds:g} s", STEP_SECONDS.expected)
    return seconds
