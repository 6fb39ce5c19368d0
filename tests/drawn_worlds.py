"""Small missions with any of the options that a closed loop has, drawn by a number: what engines are compared on."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import yaml
from helpers import delivered
from numpy.typing import NDArray
from oracle_enumeration import Threat

from planner.errors import MracError
from planner.make_plan import allocated_plan, make_plan
from planner.plan.plan import Plan, RobotPlan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.exact_tree import WHOLE, grow_tree
from planner.rollouts.single_run import SingleRun
from planner.settings import Settings
from planner.simulator.codes import Outcome
from planner.world.generate import PAPER_LEVELS, ThreatPattern, random_world
from planner.world.moving_threats import ANYWHERE, PLAN_ON, MovingThreat, PlannedOn
from planner.world.robot_types import checked_types
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World

# --- Worlds of tests: uncertain maps, moving threats, teams of several types, scenarios with threats.


def tiny_world(seed: int, height: int, width: int, wall: float = np.nan) -> World:
    """Cells with threats and walls drawn by the seed; cell [0, 0] is never a wall. `wall`: p of a wall."""
    draw = np.random.default_rng(seed)
    threat = draw.choice([0, 0, 0.1, 0.3, 0.6, wall], size=(height, width))
    threat[0, 0] = draw.choice([0, 0.2])
    return World.create(threat)


# Worlds in doubt, and expected values of small ones, by playing everything that can happen: the oracle of tests.

BASE = random_world(9, 9, ThreatPattern("scattered", 4, (0.04, 0.12, 0.2), 5), obstacles=0.2, threats=0.3)
DANGER = np.where(BASE.threat > 0, 1.0, 0.0)
WORLDS = {
    "persistent": BASE.with_latent_hazard("persistent", 0.3 * DANGER, 0.5),
    "consumed": BASE.with_latent_hazard("consumed", 0.6 * DANGER, 0.9),
    "maps": BASE.with_maps([BASE.threat, np.minimum(4 * BASE.threat, np.float32(0.9)), 0 * BASE.threat]),
    "level": BASE.with_spread("beta", 4.0, "level"),
}
"""Of every kind one."""
Play = Callable[[Callable[[int, int, int], bool]], np.ndarray]
"""Plays a run with this judge of hits; what it comes to."""


def closed_loop(plan: Plan, world: World) -> Play:
    """Cells visited, survived, robots alive, cells delivered, of a closed loop played by the simulator as Python."""
    loop = compile_closed_loop(plan, world, interpreted=True)

    def play(hit: Callable[[int, int, int], bool]) -> np.ndarray:
        run = SingleRun(loop, hit=hit).play()
        brought = len(delivered(run.trace, plan.bases))
        return np.array([run.visited.sum(), run.survived.sum(), run.alive.sum(), brought], dtype=float)

    return play


def open_loop(plan: Plan, world: World) -> Play:
    """The same of an open loop: robots in index order, step by step, each along its path until it is stopped."""

    def play(hit: Callable[[int, int, int], bool]) -> np.ndarray:
        visited, survived, alive, brought = set(), set(), set(range(len(plan.robots))), set()
        for step in range(plan.makespan + 1):
            for robot, path in enumerate(one.path for one in plan.robots):
                if robot in alive and step < len(path) and (step == 0 or path[step] != path[step - 1]):
                    cell = int(path[step])
                    visited.add(cell)
                    if hit(robot, step, cell):
                        alive.remove(robot)
                    else:
                        survived.add(cell)
                        if plan.bases and cell in plan.bases[robot]:
                            brought |= set(path[: step + 1].tolist())
        return np.array([len(visited), len(survived), len(alive), len(brought)], dtype=float)

    return play


def expected(play: Play, draw: Callable[[Callable[[float], bool], dict, int], bool]) -> np.ndarray:
    """The mean of what `play` gives over all that can happen.

    `draw(chance, memory, cell)` judges a visit; `chance(p)` is true with that chance; `memory` is the run's own.
    """
    total, left = np.zeros(()), [([], 1.0)]
    while left:
        decided, weight = left.pop()
        made: list[bool] = []
        memory: dict = {}

        def chance(p: float, decided: list[bool] = decided, made: list[bool] = made) -> bool:
            nonlocal weight
            if p in (0.0, 1.0):
                return p == 1.0
            if len(made) < len(decided):
                made.append(decided[len(made)])
            else:
                left.append(([*made, True], weight * p))
                weight *= 1 - p
                made.append(False)
            return made[-1]

        found = play(lambda robot, step, cell, chance=chance, memory=memory: draw(chance, memory, cell))
        total = total + weight * found
    return total


def persistent(q: np.ndarray, h: np.ndarray, consumed: bool = False) -> Callable[..., bool]:
    """Judges visits by hazards that are there or not, with q and h by cell."""

    def draw(chance: Callable[[float], bool], memory: dict, cell: int) -> bool:
        if cell not in memory:
            memory[cell] = chance(float(q[cell]))
        hit = memory[cell] and chance(float(h[cell]))
        if hit and consumed:
            memory[cell] = False
        return hit

    return draw


def one_of(maps: list[np.ndarray]) -> Callable[..., bool]:
    """Judges visits by one of equally likely maps of p by cell."""

    def draw(chance: Callable[[float], bool], memory: dict, cell: int) -> bool:
        if "map" not in memory:
            memory["map"] = next((n for n in range(len(maps) - 1) if chance(1 / (len(maps) - n))), len(maps) - 1)
        return chance(float(maps[memory["map"]][cell]))

    return draw


# Worlds with movers, drawn anew for tests: walkers and patrols of all kinds on small maps.


def rounds(world: World) -> list[tuple[int, ...]]:
    """Patrols round every free square of two by two cells."""
    width, free = world.shape[1], world.free
    corners = np.argwhere(free[:-1, :-1] & free[1:, :-1] & free[:-1, 1:] & free[1:, 1:])
    return [
        tuple(int(row + r) * width + int(col + c) for r, c in ((0, 0), (0, 1), (1, 1), (1, 0))) for row, col in corners
    ]


def moving_world(
    seed: int, levels: Sequence[float] = PAPER_LEVELS, most: int = 10, plan_on: PlannedOn = "joined"
) -> World:
    """A map of up to `most` x `most` cells with one to five movers, some of whom start where they are told."""
    random = np.random.default_rng(seed)
    height, width = random.integers(4, most + 1, 2).tolist()
    pattern = ThreatPattern(("contiguous", "scattered")[seed % 2], 4, tuple(levels), seed)
    world = random_world(height, width, pattern, obstacles=(0.2, 0.35)[seed // 2 % 2], threats=0.3)
    free, routes, movers = np.flatnonzero(world.free), rounds(world), []
    for _ in range(int(random.integers(1, 6))):
        hit, told = float(random.choice([0.05, 0.3, 0.9])), random.random() < 0.5
        if routes and random.random() < 0.4:
            route = routes[int(random.integers(len(routes)))]
            movers.append(MovingThreat(hit, 0.0, route[2] if told else ANYWHERE, route))
        else:
            start = int(random.choice(free)) if told else ANYWHERE
            movers.append(MovingThreat(hit, float(random.choice([0, 0.2, 0.5])), start))
    return world.with_moving_threats(movers, plan_on)


def in_rows(world: World) -> tuple[list[list[float | None]], list[Threat]]:
    """The world as the oracle has it."""
    movers, width = world.moving_threats, world.shape[1]
    grid = [[None if np.isnan(p) else float(p) for p in row] for row in movers.own]

    def cell(number: int) -> tuple[int, int]:
        return divmod(number, width)

    return grid, [
        Threat(one.hit, one.stay, None if one.start == ANYWHERE else cell(one.start), tuple(map(cell, one.route)))
        for one in movers.members
    ]


# Teams whose robots differ, drawn anew, and what is asked of them: all is as enumerated.


def drawn(seed: int, robots: int = 3) -> tuple[World, NDArray[np.int64], tuple[str, ...]]:
    """A random map of two sources of threats, three types of robots, and starts anywhere in one part of it."""
    rng = np.random.default_rng(seed)
    kind = ("scattered", "contiguous")[seed % 2]
    size = (9 + seed % 4, 8 + seed % 5)
    one, other = (ThreatPattern(kind, 4, PAPER_LEVELS[:3], 2 * seed + more) for more in (0, 1))  # type: ignore[arg-type]
    world = random_world(*size, one, obstacles=0.15, threats=0.2)
    second = np.nan_to_num(random_world(*size, other, obstacles=0.0, threats=0.3).threat).astype(np.float64)
    first, factors = np.nan_to_num(world.threat).astype(np.float64), rng.choice([0.0, 0.3, 1.0, 2.0], (3, 2))
    by_type = [1 - (1 - a * first) * (1 - b * second) for a, b in factors]
    world = World.create(np.where(world.free, 1 - (1 - first) * (1 - second), np.nan))
    world = replace(world, types=checked_types(("a", "b", "c"), np.array(by_type), world.free, "drawn"))
    free = np.argwhere(world.accessible(place_starts(world, 1)[0]))
    types = tuple(rng.choice(["a", "b", "c"], robots).tolist())
    return world, free[rng.integers(0, len(free), robots)], types


def assert_as_enumerated(plan: Plan, world: World, wanted: dict[str, Counter[Any]]) -> None:
    """The tree's chances are those that were enumerated."""
    tree = grow_tree(compile_closed_loop(plan, world), 0.0, 10**7)
    for name in ("visited", "survived", "time", "alive"):
        counts = getattr(tree.counts, name)
        found = {value: count / WHOLE for value, count in enumerate(counts.tolist()) if count}
        assert found == pytest.approx(dict(wanted[name]), abs=1e-9), name
    ends = {Outcome(n).word: count / WHOLE for n, count in enumerate(tree.counts.outcomes.tolist()) if count}
    assert ends == pytest.approx(dict(wanted["outcome"]), abs=1e-9)


# Worlds that have broken pictures and pages.


def extreme_worlds(crowd: bool = True) -> dict[str, tuple[World, Plan]]:
    """One cell, a single row, a tall map, cells out of reach, many robots, another planner's plan."""
    worlds = {
        "one": World.create([[0.0]]), "row": World.create([[0.0] * 40 + [0.5]], cell_size=2.5),
        "tall": World.create(np.where(np.arange(60)[:, None] % 7 == 6, [[0.1, 0.2, np.nan]], [[0.0, 0.05, 0.3]])),
        "split": World.create([[0.0, np.nan, 0.2], [0.0, np.nan, 0.2]]),
    }  # fmt: skip
    plans = {name: make_plan(world, [[0, 0]]) for name, world in worlds.items()}
    if crowd:
        many = World.create(np.where(np.random.default_rng(3).random((20, 25)) < 0.2, 0.04, 0.0))
        worlds["crowd"], plans["crowd"] = many, make_plan(many, place_starts(many, 64)[0])
    row, paths = worlds["row"], tuple(RobotPlan(robot.path[:9]) for robot in plans["row"].robots)
    foreign = Plan(row.shape, row.sha256, None, paths, outcome="end_of_paths", time=8)
    return {name: (world, plans[name]) for name, world in worlds.items()} | {"foreign": (row, foreign)}


# Scenarios with threats, and files for them.


def world_file(folder: Path, threat: np.ndarray, name: str = "w.npz", **more: object) -> str:
    World.create(threat, **more).save(folder / name, force=True)  # type: ignore[arg-type]
    return name


def load(folder: Path, threats: list, height: int = 6, width: int = 9, **more: object) -> np.ndarray:
    """Threat `[H, W]` of a scenario with these sources; the map has one obstacle, at [0, 1]."""
    if "map" not in more:
        ground = np.zeros((height, width))
        ground[0, 1] = np.nan
        more["map"] = {"file": world_file(folder, ground)}
    path = folder / "scenario.yaml"
    path.write_text(yaml.safe_dump({"threats": threats, **more}))
    return load_input(path).threat


def raster(folder: Path, values: np.ndarray, name: str = "r.npy") -> str:
    np.save(folder / name, values)
    return name


def fields(file: Path, *named: tuple[str, float, float, float, float, float]) -> None:
    """A GeoJSON file of rectangles: each its name, p, west, south, east, north."""
    features = []
    for name, p, west, south, east, north in named:
        ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        shape = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {"name": name, "p": p}, "geometry": shape})
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))


# --- Small missions with any of the options that a closed loop has, drawn by a number: what engines are compared on.

KINDS = ("plain", "hazard", "maps", "spread", "phases", "prior", "truth", "learned", "detector", "moving", "types")
"""Of worlds."""


def drawn_mission(number: int) -> tuple[World, NDArray[np.int64], Settings]:
    """A world, starts and settings that go together."""
    rng = np.random.default_rng(number)
    while True:
        try:
            world, kind = _world(rng, number)
        except MracError:
            continue
        free = np.argwhere(world.accessible(place_starts(world, 1)[0]))
        robots = int(rng.integers(1, 6))
        starts = free[rng.integers(0, len(free), robots)]
        try:
            settings = Settings(**_options(rng, robots, kind, free, world.threat.size))
            allocated_plan(world, starts, settings)
        except MracError:
            continue  # options that exclude each other
        return world, starts, settings


def _world(rng: np.random.Generator, number: int) -> tuple[World, str]:
    kind = str(rng.choice(KINDS))
    pattern: Literal["contiguous", "scattered"] = "contiguous" if rng.random() < 0.5 else "scattered"
    levels = tuple(PAPER_LEVELS[: int(rng.integers(1, 5))])
    threats = ThreatPattern(pattern, len(levels), levels, int(rng.integers(1000)))
    height, width = (int(side) for side in rng.integers(3, 12, 2))
    world = random_world(height, width, threats, obstacles=float(rng.choice([0, 0.15, 0.3])), threats=0.35)
    danger, sight = np.where(np.nan_to_num(world.threat) > 0, 1.0, 0.0), number % 2 == 0
    if kind in ("hazard", "learned", "detector"):
        how = str(rng.choice(["persistent", "consumed"]))
        world = world.with_latent_hazard(how, 0.4 * danger, float(rng.choice([0.3, 0.9, 1.0])), kind != "hazard")
        if kind == "detector":
            world = world.with_sensor_range({"range": 2, "sight": sight, "detect": 0.8, "false_alarm": 0.1})
    elif kind == "maps":
        other = np.minimum(3 * world.threat, np.float32(0.9))
        world = world.with_maps([world.threat, other, 0 * world.threat], 0.9 if number % 3 == 0 else None)
        if rng.random() < 0.5:
            world = world.with_prior_map(0.04, "unknown", {"range": float(rng.choice([1, 2])), "sight": sight})
    elif kind == "spread":
        world = world.with_spread(
            *(("beta", 4.0), ("lognormal", 0.5))[number % 2], str(rng.choice(["common", "level"]))
        )
    elif kind == "phases":
        later = np.where(np.isnan(world.threat), np.nan, np.nan_to_num(world.threat)[::-1, ::-1])
        world = world.with_phases(
            [(0, world), (int(rng.integers(4, 30)), later)], str(rng.choice(["now", "first", "worst"]))
        )
    elif kind == "prior":
        world = world.with_prior_map(
            0.04, str(rng.choice(["unknown", "known"])), {"range": float(rng.choice([1, 2, 3])), "sight": sight}
        )
    elif kind == "truth":
        truth = random_world(height, width, replace(threats, seed=threats.seed + 1), obstacles=0.15, threats=0.3)
        world = world.with_true_map(truth, {"range": float(rng.choice([1, 2])), "sight": sight})
    elif kind == "moving":
        world = moving_world(number, most=9, plan_on=PLAN_ON[number % len(PLAN_ON)])
    elif kind == "types":
        one = np.nan_to_num(world.threat).astype(np.float64)
        of = np.array([1 - (1 - factor * one) for factor in (1.0, 0.4, 0.0)])
        world = replace(world, types=checked_types(("a", "b", "c"), of, world.free, "drawn"))
    return world, kind


def _options(rng: np.random.Generator, robots: int, kind: str, free: NDArray[np.int64], cells: int) -> dict[str, Any]:
    def sometimes(chance: float, value: Any) -> Any:
        return value if rng.random() < chance else None

    policy = str(rng.choice(["mrac", "mrac", "per_cell", "per_cell", "watchful", "frontier"]))
    bases = [tuple(int(part) for part in free[rng.integers(len(free))]) for _ in range(2)]
    choices: dict[str, Any] = {
        "policy": policy,
        "levels": sometimes(0.2, 3),
        "density": sometimes(0.3, 1.5),
        "risk": sometimes(0.3, "log"),
        "transit": sometimes(0.15, "area"),
        "in_area": sometimes(0.3, str(rng.choice(["boustrophedon", "rows", "columns"]))),
        "range": sometimes(0.3, tuple(int(moves) for moves in rng.integers(4, 60, robots))),
        "return_to": sometimes(0.3, ["home", "nearest", tuple(bases)][int(rng.integers(3))]),
        "deadline": sometimes(0.2, int(rng.integers(5, 80))),
        "weibull_shape": sometimes(0.15, 2.0),
        "hazard_multiplier": sometimes(0.15, tuple(float(times) for times in rng.choice([0.5, 1.0, 3.0], robots))),
        "steps_per_move": sometimes(0.2, tuple(int(steps) for steps in rng.integers(1, 4, robots))),
        "radio": sometimes(0.2, float(rng.integers(2, 6))),
        "types": tuple(rng.choice(["a", "b", "c"], robots).tolist()) if kind == "types" else None,
    }
    if choices["range"] and choices["return_to"]:
        choices["recharge"] = sometimes(0.5, int(rng.integers(1, 5)))
    if policy != "mrac":
        choices["risk_cap"] = sometimes(0.3, 0.4)
        choices["robot_value"] = sometimes(0.3, float(rng.integers(2, 60)))
        if policy == "per_cell" and choices["robot_value"] is None:
            choices["priority"] = sometimes(0.2, tuple(int(of) for of in rng.integers(0, 4, cells)))
    return {name: value for name, value in choices.items() if value is not None}


LEFT_OUT_OF_BOOK = {"transit", "steps_per_move", "radio", "types", "risk_cap", "robot_value", "priority"}
"""Options of `_options` that JAX's closed loop leaves to the compiled simulator."""


def drawn_compiled_mission(number: int) -> tuple[Plan, World]:
    """A plan and its world by the paper's rule, with any of the other options."""
    rng = np.random.default_rng(number)
    while True:
        try:
            world = World.create(_world(rng, number)[0].threat)
            free = np.argwhere(world.accessible(place_starts(world, 1)[0]))
            if number % 5 == 0:  # robots in parts that are not connected
                free = np.argwhere(world.free)
            robots = int(rng.integers(1, 6))
            starts = free[rng.integers(0, len(free), robots)]
            options = _options(rng, robots, "plain", free, world.threat.size)
            kept = {name: value for name, value in options.items() if name not in LEFT_OUT_OF_BOOK}
            return allocated_plan(world, starts, Settings(**kept | {"policy": "mrac"})), world
        except MracError:
            continue
