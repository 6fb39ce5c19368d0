"""Random settings of everything: every engine, thread count, chunk, table and resumption gives the same, bit for bit.

python tests/determinism.py [--count N] [--first M]

Setting number n is always the same one: a small world (known; in doubt; with hazards; not told to robots; with moving
threats), a team and settings that `random.Random(n)` draws; what the product refuses is drawn again. Compared: traces
of the compiled closed loop with those of the simulator as Python; tallies in one piece, in chunks, by one thread and by
two, with tables and without; JAX's where it takes the setting; a run cut at a step, written as a state, read, and gone
on with.
"""

import argparse
import json
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import numpy as np
from drawn_worlds import moving_world
from helpers import VisitLoop

from planner.errors import InputError
from planner.make_plan import make_plan
from planner.open_loop import plan_team
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.plan.state_file import parse_state
from planner.policies import RULES
from planner.policies.rules import ORDERS
from planner.rollouts.closed_loop import compile_closed_loop, trace_rollouts
from planner.rollouts.engine import Engine, Rolling, closed_loop_engine, make_engine, open_loop_engine
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.uncertain_maps import SHARED
from planner.world.world import World

ROLLOUTS, TRACED = 200, 3
LANES = 64
Drawn = tuple[World, Plan, Rolling]


def plain(number: int, draw: random.Random) -> World:
    pattern = ThreatPattern(draw.choice(("contiguous", "scattered")), areas=3, seed=number)
    side = draw.randint(4, 10), draw.randint(4, 10)
    return random_world(*side, pattern, obstacles=draw.choice((0.1, 0.25)), threats=draw.choice((0.2, 0.4)))


def sense(draw: random.Random) -> dict[str, Any]:
    return {"range": draw.choice((0, 1, 1.5, 2, 3)), "sight": draw.random() < 0.5}


def hazards(number: int, draw: random.Random) -> World:
    world, learn = plain(number, draw), draw.random() < 0.5
    q = np.where(world.free, np.where(world.threat > 0, draw.choice((0.2, 0.6)), 0.0), np.nan)
    world = World.create(np.where(world.free, 0.0, np.nan)).with_latent_hazard(
        draw.choice(("persistent", "consumed")), q, draw.choice((0.3, 0.9)), learn
    )
    rates = {"detect": draw.choice((0.9, 0.5)), "false_alarm": draw.choice((0.1, 0.3))}
    return world.with_sensor_range(sense(draw) | rates) if learn and draw.random() < 0.6 else world


def doubtful(number: int, draw: random.Random) -> World:
    world = plain(number, draw)
    if draw.random() < 0.5:
        return world.with_spread(*draw.choice((("lognormal", 0.5), ("beta", 20.0))), draw.choice(SHARED))
    maps = [np.where(world.free, np.roll(np.nan_to_num(world.threat), shift, axis=1), np.nan) for shift in range(3)]
    return world.with_maps(maps, draw.choice((None, 0.9)))


def untold(number: int, draw: random.Random) -> World:
    world = plain(number, draw)
    if draw.random() < 0.5:
        return world.with_prior_map(draw.choice((0.0, 0.05)), draw.choice(("unknown", "known")), sense(draw))
    believed = World.create(np.where(np.roll(world.free, 1, axis=0) & world.free, world.threat, 0.0))
    return believed.with_true_map(world, sense(draw))


WORLDS: dict[str, Callable[[int, random.Random], World]] = {
    "known": plain,
    "hazards": hazards,
    "in doubt": doubtful,
    "not told": untold,
    "moving": lambda number, draw: moving_world(number, plan_on=draw.choice(("joined", "own"))),
}


def settings(draw: random.Random, robots: int) -> Settings:
    """Anything; a third of what there is, at a time."""
    each = lambda low, high: tuple(draw.randint(low, high) for _ in range(robots))  # noqa: E731
    may: dict[str, Callable[[], Any]] = {
        "policy": lambda: draw.choice(list(RULES)),
        "risk_cap": lambda: draw.choice((0.3, 0.5, 1.0)),
        "robot_value": lambda: draw.choice((0.5, 6.0, 20.0)),
        "range": lambda: draw.choice((draw.randint(5, 60), each(5, 60))),
        "deadline": lambda: draw.randint(0, 80),
        "max_steps": lambda: draw.randint(1, 100),
        "weibull_shape": lambda: draw.choice((0.5, 2.0, 3.5)),
        "hazard_multiplier": lambda: draw.choice((0.5, 3.0, tuple(0.5 + one / 10 for one in each(0, 20)))),
        "return_to": lambda: draw.choice(("home", "nearest")),
        "recharge": lambda: draw.randint(1, 9),
        "in_area": lambda: draw.choice(ORDERS),
        "levels": lambda: draw.randint(2, 16),
        "density": lambda: draw.choice((1.5, 4.0, 20.0)),
        "risk": lambda: draw.choice(("paper", "log")),
        "transit": lambda: draw.choice(("grid", "area")),
        "plan_for": lambda: draw.choice(("closed", "closed", "open")),
    }
    asked = {name: make() for name, make in may.items() if draw.random() < 0.33}
    if asked.get("policy", "mrac") == "mrac":
        asked |= {"risk_cap": None, "robot_value": None}
    if not asked.keys() >= {"range", "return_to"}:
        asked["recharge"] = None
    return Settings(**asked, effort=200 if asked.get("plan_for") == "open" else None)


def drawn(number: int, refused: Counter[str]) -> Drawn:
    """The setting of this number: the first drawn that is not refused."""
    draw = random.Random(number)
    while True:
        try:
            world = WORLDS[list(WORLDS)[number % len(WORLDS)]](number, draw)
            starts = place_starts(world, robots := draw.randint(1, 5))[0]
            plan = plan_team(world, starts, settings(draw, robots), None)
            how = Rolling(
                loop=draw.choice(("closed", "closed", "closed", "open")), seed=number,
                first_only=draw.random() < 0.2,
            )  # fmt: skip
            make_engine(plan, world, how, "numba")
        except InputError as error:
            refused[error.problem[:60]] += 1
            continue
        return world, plan, how


def unequal(number: int, *, jax: bool, refused: Counter[str]) -> Iterator[str]:
    """What is not equal under setting `number`."""
    world, plan, how = drawn(number, refused)
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
        (first, few), (rest, more) = engine.run(0, cut), engine.run(cut, ROLLOUTS - cut)
        joined = type(few).join([few, more])
        if first + rest != tally or any(
            not np.array_equal(vars(joined)[one], held) for one, held in vars(singles).items()
        ):
            yield f"{name}, in chunks of {cut} and {ROLLOUTS - cut}"


def unlike_python(world: World, plan: Plan, how: Rolling) -> Iterator[str]:
    """The compiled closed loop against the simulator as Python, and that one gone on with from a state."""
    python = PythonLoop(plan, world, first_only=how.first_only)
    loop = compile_closed_loop(plan, world, first_only=how.first_only)
    for mine in trace_rollouts(loop, how.seed, range(TRACED)):
        if mine != (trace := python.trace(how.seed, mine.rollout)):
            yield f"as Python, rollout {mine.rollout}"
            return
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
