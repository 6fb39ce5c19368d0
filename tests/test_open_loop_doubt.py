"""The open loop where hazards are there or not, or the map is one of several: engines, traces, exact values."""

from __future__ import annotations

import numpy as np
import pytest
from doubt import open_loop

from mrac_jax.engine import Rolling, make_engine, open_loop_engine
from mrac_jax.open_loop.compiled import compile_plan
from planner.errors import UsageError
from planner.luck import Luck
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.plans.settings import Settings
from planner.worlds.generate import ThreatPattern, random_world
from planner.worlds.starts import place_starts
from planner.worlds.world import World
from planner.worlds.wrong_maps import with_hazard, with_maps, with_spread

BASE = random_world(9, 9, ThreatPattern("scattered", 4, (0.04, 0.12, 0.2), 5), obstacles=0.2, threats=0.3)
DANGER = np.where(BASE.threat > 0, 1.0, 0.0)
WORLDS = {
    "persistent": with_hazard(BASE, "persistent", 0.3 * DANGER, 0.5),
    "consumed": with_hazard(BASE, "consumed", 0.6 * DANGER, 0.9),
    "maps": with_maps(BASE, [BASE.threat, np.minimum(4 * BASE.threat, np.float32(0.9)), 0 * BASE.threat]),
    "level": with_spread(BASE, "beta", 4.0, "level"),
}
TINY = World.create([[0.0, 0.2, 0.0, 0.25, 0.0]], [[0, 2], [0, 2], [0, 1]])


def plan_of(world: World) -> Plan:
    return make_plan(world, place_starts(world, 5)[0], Settings())


@pytest.mark.parametrize("name", WORLDS)
def test_engines_count_what_the_readable_luck_says(name: str) -> None:
    world = WORLDS[name]
    plan = plan_of(world)
    engine = make_engine(plan, world, Rolling("open", seed=4), "numba")
    tally, found = engine.run(0, 200)
    play = open_loop(plan, world)
    for rollout in range(200):
        visited, survived, alive = play(Luck(world, 4, rollout).hits)
        assert [found.visited[rollout], found.survived[rollout], found.alive[rollout]] == [visited, survived, alive]
    assert np.count_nonzero(tally.visited) > 4
    parts = open_loop_engine(compile_plan(plan, world), 4, "step", "numba", threads=2)
    assert parts.tally(0, 77) + parts.tally(77, 123) == tally
    trace = next(iter(engine.traces([9])))
    assert len(np.unique(trace.cells)) == found.visited[9]
    with pytest.raises(UsageError, match="use mode step"):
        open_loop_engine(compile_plan(plan, world), 4, "fast", "numba")
