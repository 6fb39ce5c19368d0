"""Teams that come home, by everything that can happen to them: a twin written from the rules, against all engines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from oracle_home import MANY, Homing, allocation
from oracle_phases import mean_of
from oracle_unknown import Cell

from planner.ids import NO_ROBOT
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import Problem, prepare
from planner.mrac.simulate import simulate
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.simulator.exact_tree import WHOLE, grow_tree
from planner.world.changing_maps import with_phases
from planner.world.generate import Stream
from planner.world.world import World

HOMES: list[dict[str, Any]] = [
    {"return_to": "home"},
    {"return_to": "nearest"},
    {"return_to": "home", "range": 6},
    {"return_to": "nearest", "deadline": 7},
    {"return_to": "home", "range": 9, "deadline": 8},
    {"return_to": "nearest", "range": 5, "recharge": 2, "deadline": 30},
    {"return_to": ((0, 0),), "range": 8, "recharge": 1, "deadline": 24},
]
DANGERS = 3


def tiny(number: int) -> tuple[World, list[tuple[int, np.ndarray]], list[Cell]]:
    """2 x 3 to 3 x 3 cells, three dangerous ones at most, two or three robots; every fourth map has a second phase."""
    stream = Stream(number, 1919)
    shape = (2 + stream.below(2), 3)
    p = np.zeros(shape, dtype=np.float32)
    for _ in range(DANGERS):
        p.flat[stream.below(p.size)] = (0.1, 0.3)[stream.below(2)]
    if stream.below(3) == 0:
        p.flat[1 + stream.below(p.size - 1)] = np.nan
    world, maps = World.create(p), [(0, p)]
    if number % 4 == 3:
        later = np.where(np.isnan(p), np.nan, np.roll(np.nan_to_num(p), 1 + stream.below(p.size))).astype(np.float32)
        maps.append((2 + stream.below(4), later))
        world = with_phases(world, maps[1:])
    free = np.argwhere(world.components == world.components[0, 0])
    starts = [tuple(free[stream.below(len(free))].tolist()) for _ in range(2 + stream.below(2))]
    return world, maps, starts


class Both:
    """A twin's run and the simulator's, by the same judge of visits."""

    def __init__(self, number: int) -> None:
        self.world, self.maps, self.starts = tiny(number)
        asked = HOMES[number % len(HOMES)]
        bases = {"home": [[start] for start in self.starts], "nearest": [self.starts] * len(self.starts)}
        to = asked["return_to"]
        self.rules = (
            bases[to] if isinstance(to, str) else [list(to)] * len(self.starts),
            [asked.get("range", MANY)] * len(self.starts), asked.get("deadline", MANY), asked.get("recharge", 0),
        )  # fmt: skip
        self.plan: Plan = make_plan(self.world, self.starts, Settings(**asked))
        self.problem: Problem = prepare(self.world, self.starts, self.plan.settings or Settings())
        width = self.world.shape[1]
        self.areas = [
            (a.level, None if a.robot == NO_ROBOT else a.robot, [divmod(c, width) for c in a.cells.tolist()])
            for a in self.plan.areas
        ]
        assert len(self.maps) > 1 or allocation(self.maps[0][1], self.starts) in (None, self.areas)

    def play(self, judge: Any) -> tuple[float, ...]:
        """(visited, alive, so many home with chance 1, ...) of the twin, which the simulator's run is, step by step."""
        decided: dict[tuple[int, int, Cell], bool] = {}

        def asked(robot: int, step: int, cell: Cell) -> bool:
            return decided.setdefault((robot, step, cell), judge(robot, step, cell))

        twin, width = Homing(self.maps, self.starts, self.areas, asked, *self.rules), self.world.shape[1]
        outcome = twin.run()
        run = simulate(
            self.problem, self.plan.areas, truth=0,
            hit=lambda robot, step, cell: decided[robot, step, divmod(cell, width)],
        )  # fmt: skip
        assert (run.outcome.word, run.time) == (outcome, twin.step)
        assert [tuple(cell) for cell in np.argwhere(run.visited.reshape(self.world.shape)).tolist()] == sorted(
            twin.visited
        )
        assert run.home.tolist() == twin.at_home()
        for path, walker in zip(run.paths, twin.team, strict=True):
            cells = [divmod(cell, width) for cell in path.tolist()]
            assert cells == walker.path[: len(cells)] and {*walker.path[len(cells) :]} <= {cells[-1]}
        home = sum(twin.at_home())
        alive = sum(walker.doing != "dead" for walker in twin.team)
        return len(twin.visited), alive, *(float(home == m) for m in range(len(self.starts) + 1))


def check(number: int) -> int:
    """All that can happen is what the simulator does, the tree says and rollouts come to; in how many is one lost."""
    both = Both(number)
    visited, alive, *home, survived = mean_of(both.play, both.maps)
    loop = compile_closed_loop(both.plan, both.world)
    tree = grow_tree(loop, 0.0, 10**6)
    assert tree is not None and not tree.left
    np.testing.assert_allclose(
        (*tree.covered("visited"), *tree.covered("survived")), [visited] * 2 + [survived] * 2, rtol=1e-6
    )
    np.testing.assert_allclose(tree.mean_alive, alive, rtol=1e-6)
    np.testing.assert_allclose(tree.counts.home / WHOLE, home, atol=1e-7)
    tally = run_range(loop, number, 0, 4096, threads=1)[0]
    error = np.sqrt(np.array(home) * (1 - np.array(home)) / 4096)
    assert (np.abs(tally.home / 4096 - home) <= 5 * error + 1e-9).all(), number
    return int(alive < len(both.starts))


def test_all_that_can_happen_to_teams_that_come_home() -> None:
    assert sum(check(number) for number in range(56)) > 30


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_so_it_is_on_many_more_maps(part: int) -> None:
    assert sum(check(number) for number in range(56 + part, 656, 4)) > 80
