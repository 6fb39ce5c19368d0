"""Both loops run uncompiled on arrays that refuse negative indices: compiled kernels would read before the array.

For a process of its own, in which Numba compiles nothing.
"""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
from closed_loop_worlds import limited, survey_worlds
from drawn_worlds import WORLDS
from numba import config

from planner.make_plan import make_plan
from planner.rollouts import closed_loop, open_loop_numba, runners
from planner.rollouts.open_loop import compile_plan
from planner.settings import Settings
from planner.world.start_rule import place_starts
from planner.world.world import World

POLICIES: tuple[dict[str, Any], ...] = (
    {}, {"policy": "per_cell"}, {"policy": "per_cell", "risk_cap": 0.5, "robot_value": 9.0},
)  # fmt: skip
KERNELS = ((runners, "run_group_tasks"), (open_loop_numba, "_count_drawn_once"), (open_loop_numba, "_count_joint"))
DISTANCES = ((True, None), (False, None), (False, (0, 1, 1)))
"""From tables, from rows, and from searches as if all were far; with `nearby`, `wide` and `patience` of `Tables`."""
SEED, ROLLOUTS = 1, 2
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
                if isinstance(place, str):  # a field
                    continue
                assert place is None or place >= 0, f"index {index}"
                seen += 1


def forward(given: Any) -> Any:
    """The array, or the tuple with such arrays in it."""
    if isinstance(given, np.ndarray):
        return given.view(Forward)
    if isinstance(given, tuple):
        return given._make(map(forward, given)) if hasattr(given, "_make") else tuple(map(forward, given))
    return given


def unite(into: Any, into_at: int, of: Any, of_at: int, block: tuple[int, ...]) -> None:
    """`or_words`, which is code for LLVM, as are the others that `main` replaces."""
    into[into_at : into_at + len(block)] |= of[of_at : of_at + len(block)]


IN_PYTHON: dict[str, Any] = {
    "or_words": unite,
    "popcount": lambda word: np.uint32(int(word).bit_count()),
    "leading_zeros": lambda word: np.uint32(32 - int(word).bit_length()),
    "wide_vectors": lambda: None,
}


def main(count: int) -> None:
    """Every policy in turn on so many worlds of the survey, then worlds in doubt; prints how many places it saw."""
    assert config.DISABLE_JIT
    for module, name in KERNELS:
        kernel = getattr(module, name)
        setattr(module, name, lambda *given, kernel=kernel: kernel(*map(forward, given)))
    vars(open_loop_numba).update(IN_PYTHON, MOST_TILE=open_loop_numba.LEAST_TILE)
    worlds = survey_worlds()
    for number in range(count):
        one = worlds[number * len(worlds) // count]
        run(one.world, one.starts, replace(one.settings, **POLICIES[number % len(POLICIES)]), one.first_only)
    for world in WORLDS.values():
        run(world, place_starts(world, 5)[0], Settings(), False)
    sys.stdout.write(f"{seen}\n")


def run(world: World, starts: Any, settings: Settings, first_only: bool) -> None:
    """Open loop, closed loop with tables and without, by rows and by far searches."""
    plan = make_plan(world, starts, settings)
    compiled = compile_plan(plan, world)
    with np.errstate(over="ignore"):
        open_loop_numba.NumbaOpenLoop(compiled, SEED, threads=1).results(0, ROLLOUTS)
        for tabled, limits in DISTANCES:
            loop = closed_loop.compile_closed_loop(plan, world, first_only=first_only, tabled=tabled)
            if limits is not None:
                loop = limited(loop, *limits)
            closed_loop.run_range(loop, SEED, 0, ROLLOUTS, threads=1, singles=True)
            closed_loop.trace_rollouts(loop, SEED, [ROLLOUTS])
