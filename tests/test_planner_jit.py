"""What the compiled simulator asks of Numba: no reference counts, no floating point where whole numbers are meant; and
what it promises in return: no negative index, rows of known lengths."""

from __future__ import annotations

import sys

import numba
import numpy as np
import pytest
from helpers import run_python

from planner.make_plan import make_plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.simulator.jit import KNOWN, PROGRAM, UNCOUNTED, WITHIN
from planner.simulator.state import State, Tables, first_state
from planner.simulator.struct_pointers import LENGTHS
from planner.world.world import World

IN_FLOATING_POINT = """
from numba.core import types
from numba.core.dispatcher import Dispatcher
import planner.simulator.areas, planner.simulator.failure_sampling, planner.simulator.paths, planner.simulator.rollouts
import planner.simulator.fixed_paths, planner.simulator.solo, planner.simulator.step, planner.simulator.visits
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.make_plan import make_plan
from planner.world.world import World

world = World.create([[0.0, 0.1, 0.0]])
run_range(compile_closed_loop(make_plan(world, [[0, 0]]), world), 1, 0, 2, threads=1)
seen = 0
for room in ("areas", "failure_sampling", "paths", "rollouts", "fixed_paths", "solo", "step", "visits"):
    for name, function in vars(getattr(planner.simulator, room)).items():
        if isinstance(function, Dispatcher) and name not in ("least_word", "mass_stopped"):  # which round
            for compiled in function.overloads.values():
                for variable, kind in compiled.type_annotation.typemap.items():
                    assert not isinstance(kind, types.Float), f"{name}: {variable} is {kind}"
                    seen += 1
print(seen)
"""

OF_ANOTHER_RELEASE = """
import sys
import numba
numba.__version__ = "99.0.0"
from planner.simulator.jit import kernel, program
part = kernel(lambda number: number + 3)
print(program(lambda number: part(number) * 1)(4), "planner.simulator.jit_parts" in sys.modules)
"""


def test_kernels_count_no_references() -> None:
    """Without the option the closed loop takes twice as long."""
    try:
        first = numba.njit(**UNCOUNTED)(lambda numbers: numbers[0])
        counted = numba.njit(lambda numbers: numbers[1:])
        assert (first(np.arange(3)), len(counted(np.arange(3)))) == (0, 2)
    except Exception as error:
        pytest.fail(
            f"Numba has changed ({error}): take what it no longer knows out of UNCOUNTED in planner/simulator/jit.py"
        )
    for function, expected in ((first, False), (counted, True)):
        (text,) = function.inspect_llvm().values()
        assert ("NRT_incref" in text or "NRT_decref" in text) == expected, (
            "Numba counts references where `_nrt` is False: look for what takes its place in planner/simulator/jit.py"
        )


def test_parts_of_kernels_are_called_without_wrappers() -> None:
    inner = numba.njit(**UNCOUNTED, **WITHIN, forceinline=True)(lambda numbers: numbers[0])
    outer = numba.njit(**UNCOUNTED)(lambda numbers: inner(numbers) + 1)
    assert outer(np.arange(3)) == 1


def run_anew(code: str, **environment: str) -> str:
    """What a new process prints that keeps no compiled code."""
    return run_python(code, MRAC_JAX_NO_CACHE="1", **environment)


def test_a_release_of_numba_that_is_not_known_compiles_as_it_does() -> None:
    said = run_anew(OF_ANOTHER_RELEASE)
    assert said.split() == ["7", "False"]
    assert numba.__version__.startswith(KNOWN) == ("planner.simulator.jit_parts" in sys.modules)


@pytest.mark.skipif(not numba.__version__.startswith(KNOWN), reason="that release compiles parts as it sees fit")
def test_no_index_is_asked_whether_it_is_negative() -> None:
    """It takes a tenth of the closed loop's time."""
    for options, expected in (({}, True), ({"pipeline_class": PROGRAM}, False)):
        at = numba.njit(**UNCOUNTED, **options)(lambda numbers, place: numbers[place, place + 1])
        assert at(np.arange(6).reshape(2, 3), 1) == 5
        (text,) = at.inspect_llvm().values()
        assert ("icmp slt i64 %arg.place, " in text) == expected


@pytest.mark.parametrize("worlds", [1, pytest.param(60, marks=pytest.mark.slow)])
def test_kernels_count_places_from_the_front(worlds: int) -> None:
    """What is compiled takes every index for one that is not negative."""
    code = f"import forward_indices; forward_indices.main({worlds})"
    assert int(run_anew(code, NUMBA_DISABLE_JIT="1")) > 10**5 * worlds


def test_rows_are_as_long_as_kernels_take_them_for() -> None:
    world = World.create([[0.0, 0.1, 0.0]])
    tables = compile_closed_loop(make_plan(world, [[0, 0]]), world).tables
    made = {Tables: tables, State: first_state(tables, 8)}
    assert {(kind, name): getattr(made[kind], name).shape[-1] for kind, name in LENGTHS} == LENGTHS


@pytest.mark.slow
def test_kernels_compute_with_whole_numbers_alone() -> None:
    """Numba compares int64 and uint64 as float64: slow, and wrong above 2**53."""
    assert int(run_anew(IN_FLOATING_POINT)) > 1000
