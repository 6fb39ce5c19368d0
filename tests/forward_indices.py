"""Closed loops run uncompiled on arrays that refuse negative indices: compiled kernels would read before the array.

For a process of its own, in which Numba compiles nothing.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
from closed_loop_worlds import survey_worlds
from numba import config

from planner.kernels import closed_loop
from planner.mrac.make_plan import make_plan

POLICIES: tuple[dict[str, Any], ...] = (
    {}, {"policy": "per_cell"}, {"policy": "per_cell", "reserve": 0.5, "worth": 9.0},
)  # fmt: skip
ROLLOUTS = 2
seen = 0


class Forward(np.ndarray):
    """An array, and views of it, in which places count from the front."""

    def __getitem__(self, index: Any) -> Any:
        self.ask(index)
        return super().__getitem__(index)

    def __setitem__(self, index: Any, value: Any) -> None:
        self.ask(index)
        super().__setitem__(index, value)

    def ask(self, index: Any) -> None:
        """Raise AssertionError for a place before the array."""
        global seen
        for part in index if isinstance(index, tuple) else (index,):
            places = (part.start, part.stop) if isinstance(part, slice) else (part,)
            for place in places:
                assert place is None or place >= 0, f"index {index}"
                seen += 1


def forward(given: Any) -> Any:
    """The array, or the named tuple with such arrays in it."""
    if isinstance(given, np.ndarray):
        return given.view(Forward)
    return given._make(map(forward, given)) if hasattr(given, "_make") else given


def main(count: int) -> None:
    """Every policy in turn on so many worlds of the survey, with tables and without; prints how many places it saw."""
    assert config.DISABLE_JIT
    for name in ("run_set", "run_attentive"):
        kernel = getattr(closed_loop, name)
        setattr(closed_loop, name, lambda *given, kernel=kernel: kernel(*map(forward, given)))
    worlds = survey_worlds()
    for number in range(count):
        one, policy = worlds[number * len(worlds) // count], POLICIES[number % len(POLICIES)]
        plan = make_plan(one.world, one.starts, replace(one.settings, **policy))
        for tabled in (True, False):
            loop = closed_loop.compile_closed_loop(plan, one.world, first_only=one.first_only, tabled=tabled)
            with np.errstate(over="ignore"):
                closed_loop.run_range(loop, one.seed, 0, ROLLOUTS, threads=1, singles=True)
                closed_loop.trace_rollouts(loop, one.seed, [ROLLOUTS])
    sys.stdout.write(f"{seen}\n")
