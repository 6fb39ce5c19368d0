"""Everybody on every world on the same luck: cells visited and robots lost, rollout by rollout."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from analysis.judging.rolling import roll_policy, wanted_for
from analysis.kit.notes import Progress, quiet
from analysis.kit.pool import answers
from analysis.sampling import RolloutChoices, make_singles
from analysis.standings.entries import Own, plan_files, read_foreign
from analysis.standings.standing import RANDOM, Played, Rolled, Standing
from analysis.standings.worlds import suite_world
from analysis.theory.any_strategy import most_cells
from analysis.theory.optimum import optimum
from planner.errors import InputError, UsageError
from planner.plan_team import plan_team
from planner.plans.plan import Plan
from planner.policies.rule import Rule
from planner.rollouts.names import of_jax
from planner.settings import Settings
from planner.worlds.world import World

TIMES = 4
"""A mission is ended after so many steps for each accessible cell."""
RESERVE = 0.25
PER_CELL = Settings(policy="per_cell")
OURS = {
    "mrac": (Settings(), "closed"),
    "mrac, open loop": (Settings(), "open"),
    "per_cell": (PER_CELL, "closed"),
    "per_cell+reserve": (replace(PER_CELL, reserve=RESERVE), "closed"),
}
"""Those that always stand in the table: settings, and the loop of the same plan."""


@dataclass(frozen=True)
class Asked:
    """What is played on a world.

    Attributes:
        rollouts, seed: the same for everybody. own: a policy, or None. plans: files of other planners, by world.
    """

    rollouts: int
    seed: int
    own: Own | None
    plans: Mapping[str, Mapping[str, Path]]


def run_suite(
    names: tuple[str, ...],
    own: Own | None,
    plans: Mapping[str, str | Path],
    rollouts: int,
    seed: int,
    processes: int | None = None,
    progress: Progress = quiet,
) -> Standing:
    """The table of these worlds; `processes` (None: one a core) changes nothing but the time.

    An interruption leaves the worlds that are done; none: KeyboardInterrupt again. Raises InputError.
    """
    RolloutChoices(rollouts=rollouts, seed=seed)
    if own is not None and own.name in (RANDOM, *OURS):
        raise UsageError(f"a policy that is called {own.name!r}", source=own.said, expected="a name of its own")
    asked = Asked(rollouts, seed, own, plan_files(plans, names))
    wanted = wanted_for(None if own is None else own.given, processes, len(names))
    begun, found, partial_answer = time.monotonic(), {}, False
    largest = sorted(names, key=lambda name: -suite_world(name).threat.size)
    try:
        for name, played in answers(partial(play, asked), largest, wanted):
            found[name] = played
            progress(len(found), len(names), time.monotonic() - begun)
    except KeyboardInterrupt:
        if not found:
            raise
        partial_answer = True
    worlds = tuple(found[name] for name in names if name in found)
    return Standing(worlds, rollouts, seed, None if own is None else own.name, time.monotonic() - begun, partial_answer)


def play(asked: Asked, name: str) -> Played:
    """Everybody on one world. Raises InputError, which names a policy and the world."""
    world = suite_world(name)
    assert world.starts is not None
    cells = int(world.accessible(world.starts).sum())
    choices = RolloutChoices(rollouts=asked.rollouts, seed=asked.seed, deadline=TIMES * cells)
    make_env = partial(of_jax("environment"), world, max_steps=TIMES * cells)
    plans = {planner: read_foreign(files[name], world) for planner, files in asked.plans.items() if name in files}
    rolled = {} if asked.own is None else {asked.own.name: _own(asked.own, world, make_env, choices)}
    rolled[RANDOM] = _policy(make_env(), None, choices)
    for rival, (settings, loop) in OURS.items():
        rolled[rival] = _plan(world, plan_team(world, world.starts, settings), loop, choices)
    for planner, plan in plans.items():
        rolled |= {f"{planner}, {loop} loop": _plan(world, plan, loop, choices) for loop in ("open", "closed")}
    best = None if world.doubt is not None else optimum(world, world.starts)
    return Played(name, len(world.starts), cells, most_cells(world, world.starts, flow=True), best, rolled)


def _own(own: Own, world: World, make_env: Any, choices: RolloutChoices) -> Rolled:
    assert world.starts is not None
    policy = own.load()
    try:
        if isinstance(policy, Rule):
            return _plan(world, plan_team(world, world.starts, Settings(policy=policy)), "closed", choices)
        return _policy(make_env(actions=own.actions), policy, choices)
    except InputError as error:
        raise InputError(f"{own.said} on {world.source}: {error}") from error


def _policy(env: Any, policy: Any, choices: RolloutChoices) -> Rolled:
    visited, lost, _ = roll_policy(env, policy, choices.seed, choices.rollouts)
    return Rolled(visited, lost)


def _plan(world: World, plan: Plan, loop: Any, choices: RolloutChoices) -> Rolled:
    found = make_singles(world, plan, replace(choices, loop=loop))(0, choices.rollouts)
    return Rolled(found.visited.astype(np.int64), len(plan.robots) - found.alive.astype(np.int64))
