"""Small missions with any of the options that a closed loop has, drawn by a number: what engines are compared on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from drawn_worlds import moving_world
from numpy.typing import NDArray

from planner.errors import MracError
from planner.make_plan import allocated_plan
from planner.settings import Settings
from planner.world.changing_maps import with_hazard, with_maps, with_phases, with_spread
from planner.world.features import with_prior, with_sense, with_truth
from planner.world.generate import PAPER_LEVELS, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.robot_types import checked_types
from planner.world.world import World

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
    danger = np.where(np.nan_to_num(world.threat) > 0, 1.0, 0.0)
    if kind in ("hazard", "learned", "detector"):
        how = str(rng.choice(["persistent", "consumed"]))
        world = with_hazard(world, how, 0.4 * danger, float(rng.choice([0.3, 0.9, 1.0])), kind != "hazard")
        if kind == "detector":
            world = with_sense(world, {"range": 2, "detect": 0.8, "false_alarm": 0.1})
    elif kind == "maps":
        other = np.minimum(3 * world.threat, np.float32(0.9))
        world = with_maps(world, [world.threat, other, 0 * world.threat])
        if rng.random() < 0.5:
            world = with_prior(world, 0.04, sense=float(rng.choice([1, 2])))
    elif kind == "spread":
        world = with_spread(world, "beta", 4.0, str(rng.choice(["common", "level"])))
    elif kind == "phases":
        later = np.where(np.isnan(world.threat), np.nan, np.nan_to_num(world.threat)[::-1, ::-1])
        world = with_phases(
            world, [(0, world), (int(rng.integers(4, 30)), later)], str(rng.choice(["now", "first", "worst"]))
        )
    elif kind == "prior":
        world = with_prior(world, 0.04, str(rng.choice(["unknown", "known"])), sense=float(rng.choice([1, 2, 3])))
    elif kind == "truth":
        truth = random_world(height, width, replace(threats, seed=threats.seed + 1), obstacles=0.15, threats=0.3)
        world = with_truth(world, truth, sense=float(rng.choice([1, 2])))
    elif kind == "moving":
        world = moving_world(number, most=9)
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
        "wear": sometimes(0.15, 2.0),
        "susceptibility": sometimes(0.15, tuple(float(times) for times in rng.choice([0.5, 1.0, 3.0], robots))),
        "steps_per_move": sometimes(0.2, tuple(int(steps) for steps in rng.integers(1, 4, robots))),
        "radio": sometimes(0.2, float(rng.integers(2, 6))),
        "types": tuple(rng.choice(["a", "b", "c"], robots).tolist()) if kind == "types" else None,
    }
    if choices["range"] and choices["return_to"]:
        choices["recharge"] = sometimes(0.5, int(rng.integers(1, 5)))
    if policy != "mrac":
        choices["reserve"] = sometimes(0.3, 0.4)
        choices["worth"] = sometimes(0.3, float(rng.integers(2, 60)))
        if policy == "per_cell" and choices["worth"] is None:
            choices["priority"] = sometimes(0.2, tuple(int(of) for of in rng.integers(0, 4, cells)))
    return {name: value for name, value in choices.items() if value is not None}
