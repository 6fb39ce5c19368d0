"""The programs that missions run: one for common missions, one for other plain ones, one for the rest.

Part of `planner.kernels.rollouts`, which see. A program is compiled for the types of the arrays that it is handed.
Those that its missions do without are read-only: so their type says that they are empty (`planner.kernels.handed`), and
what asks for them is left out.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from planner.kernels.state import State, Tables

Arrays = TypeVar("Arrays", bound=tuple)

COMMON, PLAIN, FULL = range(3)
"""Programs, the smallest first."""
WITHOUT = {Tables: ("entry", "truths"), State: ("legs", "entered")}
"""The fields from which on all are empty in a COMMON and in a PLAIN mission. PLAIN: on a map that robots are told,
without threats that move or change, whose robots are alike, do not wear, hear each other everywhere and stay where they
end. COMMON: besides, all distances are in tables, the map is certain, no hit makes a cell harmless, no path is given.
"""


def program_of(tables: Tables) -> int:
    """The program of a mission: the smallest that has all that its tables hold."""
    last = max(place for place, field in enumerate(tables) if field.size)
    return sum(Tables._fields.index(name) <= last for name in WITHOUT[Tables])


def typed(given: Arrays, program: int = FULL) -> Arrays:
    """The same named tuple with arrays of the types that the program is compiled for.

    They are contiguous and writable, but for those that the program does without, which have to be empty.
    """
    without = WITHOUT.get(type(given), ())[program:]
    last = given._fields.index(without[0]) if without else len(given)  # type: ignore[attr-defined]
    fields = [
        np.require(field, requirements=("C", "W"))
        if isinstance(field, np.ndarray) and not field.flags.carray
        else field
        for field in given
    ]
    for place in range(last, len(fields)):
        assert not fields[place].size, given._fields[place]  # type: ignore[attr-defined]
        fields[place] = np.empty_like(fields[place])
        fields[place].flags.writeable = False
    return type(given)(*fields)
