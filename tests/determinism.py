"""Random settings of everything: every engine, thread count, chunk, table and resumption gives the same, bit for bit.

python tests/determinism.py [--count N] [--first M]

Setting number n is always the same one: mission n of `drawn_worlds`, which is of any kind and has any options, the
loop that is rolled out, and the loop that is planned for. A refused one is replaced by another. Compared: traces of the
compiled closed loop with those of the simulator as Python; tallies in one piece, in chunks, by one thread and by two,
with tables and without; JAX's where it takes the setting; a run cut at a step, written as a state, read, and gone on
with.
"""

import argparse
import json
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from unittest import mock

import numpy as np
from drawn_worlds import drawn_compiled_mission, drawn_mission
from helpers import VisitLoop, play_both_ways

from planner.errors import InputError
from planner.make_plan import make_plan
from planner.open_loop import plan_team
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop, trace_rollouts
from planner.rollouts.engine import Engine, Rolling, closed_loop_engine, make_engine, open_loop_engine
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.single_run import PythonLoop
from planner.world.world import World

ROLLOUTS, TRACED = 200, 3
LANES = 64
AFTER_REFUSAL = 10**9
"""To a number, for the mission that takes the place of a refused one."""
Drawn = tuple[World, Plan, Rolling]


def drawn(number: int, refused: Counter[str], *, jax: bool) -> Drawn:
    """The mission of this number; where it is refused, that of a number far from those that are asked for.

    `jax`: one that JAX takes in most cases.
    """
    draw = random.Random(number)
    while True:
        how = Rolling(
            loop=draw.choice(("closed", "closed", "closed", "open")), seed=number, first_only=draw.random() < 0.2
        )
        try:
            plan, world = drawn_compiled_mission(number) if jax else drawn_plan(number, draw)
            make_engine(plan, world, how, "numba")
        except InputError as error:
            refused[error.problem[:60]] += 1
            number += AFTER_REFUSAL
            continue
        return world, plan, how


def drawn_plan(number: int, draw: random.Random) -> tuple[Plan, World]:
    """The plan of a drawn mission, some for the open loop, and some cut off by `max_steps`."""
    world, starts, settings = drawn_mission(number)
    settings = replace(settings, max_steps=draw.choice((None, None, draw.randint(1, 100))))
    if draw.random() < 0.2:
        settings = replace(settings, plan_for="open_loop", effort=200)
    return plan_team(world, starts, settings, None), world


def unequal(number: int, *, jax: bool, refused: Counter[str]) -> Iterator[str]:
    """What is not equal under setting `number`."""
    world, plan, how = drawn(number, refused, jax=jax)
    read = parse_plan(json.loads(json.dumps(plan.to_json())), world, "file")
    whole = make_engine(plan, world, how, "numba")
    tally, singles = whole.run(0, ROLLOUTS)
    others: dict[str, Engine] = {"the plan of a file": make_engine(read, world, how, "numba")}
    if how.loop == "open":
        compiled = compile_plan(plan, world)
        others |= {f"{n} threads": open_loop_engine(compiled, how.seed, "numba", n) for n in (1, 2)}
    else:
        yield from unlike_python(world, plan, how)
        for tabled in (True, False):
            loop = compile_closed_loop(plan, world, first_only=how.first_only, tabled=tabled)
            name = f"{1 + tabled} threads, {'' if tabled else 'no '}tables"
            others[name] = closed_loop_engine(loop, how.seed, "numba", 1 + tabled)
    if jax:
        try:
            others["jax"] = make_engine(plan, world, how, "jax")
        except InputError as error:
            refused["jax: " + error.problem[:55]] += 1
    cut = 1 + number * 37 % (ROLLOUTS - 1)
    for name, engine in others.items():
        if name == "jax":  # the last one: it does not count cells delivered
            tally, singles = (replace(of, delivered=of.delivered[:0]) for of in (tally, singles))
        (first, few), (rest, more) = engine.run(0, cut), engine.run(cut, ROLLOUTS - cut)
        joined = type(few).join([few, more])
        if first + rest != tally or any(
            not np.array_equal(vars(joined)[one], held) for one, held in vars(singles).items()
        ):
            yield f"{name}, in chunks of {cut} and {ROLLOUTS - cut}"


def unlike_python(world: World, plan: Plan, how: Rolling) -> Iterator[str]:
    """The compiled closed loop against the simulator as Python, and that one gone on with from a state."""
    play_both_ways(plan, world, how.seed, TRACED, first_only=how.first_only)
    uncut = VisitLoop(plan, world, first_only=how.first_only)  # a state has no thresholds, so that rests draw them anew
    trace = uncut.trace(how.seed, TRACED - 1)
    try:
        state = uncut.state_at(trace.time // 2, how.seed, TRACED - 1)
        if state is None:
            return
        read = parse_state(json.loads(json.dumps(state.to_json())), world, "file")
        rest = make_plan(world, read.starts, plan.settings, state=read)
    except InputError:  # what has no state
        return
    compiled = compile_closed_loop(rest, world, first_only=how.first_only)
    python = PythonLoop(rest, world, first_only=how.first_only)
    if trace_rollouts(compiled, how.seed, [TRACED - 1])[0] != python.trace(how.seed, TRACED - 1):
        yield "the rest, as Python and compiled"
    again = VisitLoop(rest, world, first_only=how.first_only).trace(how.seed, TRACED - 1)
    if not np.array_equal(again.cells[state.step :], trace.cells[state.step :]) or again.outcome != trace.outcome:
        yield f"gone on with from step {state.step}"


def check(numbers: range, refused: Counter[str], *, jax: Callable[[int], bool] = lambda number: False) -> Iterator[str]:
    """What is not equal under these settings; few rollouts are shared out to threads too. `jax`: asked too?"""
    lanes = mock.patch("mrac_jax.closed_loop.engine.LANES", {"cpu": LANES, "gpu": LANES})
    with mock.patch("planner.rollouts.runners.LEAST_SHARED", 1), lanes:
        for number in numbers:
            try:
                for what in unequal(number, jax=jax(number), refused=refused):
                    yield f"setting {number}: {what}"
            except Exception as error:
                yield f"setting {number}: {error!r}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jax", type=int, default=20, help="one in so many with JAX, which compiles")
    asked, found, refused = parser.parse_args(), 0, Counter[str]()
    numbers = range(asked.first, asked.first + asked.count)
    for what in check(numbers, refused, jax=lambda number: number % asked.jax == 0):
        found += 1
        sys.stdout.write(f"{what}\n")
        sys.stdout.flush()
    sys.stdout.write(
        f"{asked.count} settings from {asked.first}: {found} unequal; refused: {dict(refused.most_common())}\n"
    )
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
