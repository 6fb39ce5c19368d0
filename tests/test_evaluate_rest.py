"""What a range cuts off and what a state leaves: on the page and in the picture, and nowhere else."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
import pytest
from page_reader import Reader

import mrac_jax as mrac
from analysis.evaluation.figures import BEFORE, BEYOND, TO_DO, rest_of
from analysis.evaluation.report import report, rest_words
from planner.plan.state import MissionState
from planner.plan.state_file import load_state
from planner.world.world import World

QUIET = {"rollouts": 200, "bound": False, "advice": False, "engine": "numba"}
LAND = np.zeros((5, 9))
LAND[1:, 4], LAND[2, 7] = np.nan, 0.3
WORLD = World.create(LAND, [[4, 0], [0, 0]])


def moves_to(world: World, start: tuple[int, int]) -> np.ndarray:
    """Fewest moves from a cell, by breadth-first search; inf where there is no way."""
    away = np.full(world.shape, np.inf)
    away[start] = 0
    queue = deque([start])
    while queue:
        row, col = queue.popleft()
        for near in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
            if 0 <= near[0] < 5 and 0 <= near[1] < 9 and world.free[near] and np.isinf(away[near]):
                away[near] = away[row, col] + 1
                queue.append(near)
    return away


@pytest.mark.parametrize("moves", [(1, 1), (3, 6), (12, 2)])
def test_what_is_too_far_is_further_than_every_robot_has_moves_for(moves: tuple[int, int]) -> None:
    plan = mrac.plan(WORLD, range=moves)
    rest = rest_of(WORLD, plan)
    assert rest is not None and rest.step is None and rest.title == "What the range leaves"
    near = [moves_to(WORLD, start) <= most for start, most in zip(((4, 0), (0, 0)), moves, strict=True)]
    accessible = WORLD.accessible(plan.starts)
    np.testing.assert_array_equal(rest.kinds == BEYOND, accessible & ~near[0] & ~near[1])
    answer = mrac.evaluate(WORLD, plan, **QUIET)  # type: ignore[arg-type]
    assert not answer.expected.visited_by_cell[(rest.kinds == BEYOND).ravel()].any()
    said = list(rest_words(answer, rest))
    assert f"{int((rest.kinds == BEYOND).sum())} accessible cells" in said[0] and "are too far for" in said[0]
    who = {0: "no robot uses", 1: "1 of 2 robots uses", 2: "both robots use"}[rest.ended]
    assert f"{who} up " in said[1]


@pytest.mark.parametrize("moves", [(6, 14), (12, 9)])
@pytest.mark.parametrize("to", ["home", "nearest", ((0, 2), (4, 8))])
def test_of_robots_that_come_home_the_way_home_counts(moves: tuple[int, int], to: str | tuple) -> None:
    """Moves there and back are together too many for either robot; in the words and the layer too."""
    starts = ((4, 0), (0, 0))
    plan = mrac.plan(WORLD, range=moves, return_to=to)
    rest = rest_of(WORLD, plan)
    assert rest is not None and rest.returns
    of = {"home": [[start] for start in starts], "nearest": [starts] * 2}.get(str(to), [to] * 2)
    back = [np.min([moves_to(WORLD, base) for base in bases], axis=0) for bases in of]
    near = [moves_to(WORLD, start) + home <= most for start, home, most in zip(starts, back, moves, strict=True)]
    beyond = WORLD.accessible(plan.starts) & ~near[0] & ~near[1]
    np.testing.assert_array_equal(rest.kinds == BEYOND, beyond)
    answer = mrac.evaluate(WORLD, plan, **QUIET)  # type: ignore[arg-type]
    assert not answer.expected.visited_by_cell[beyond.ravel()].any()
    (said,) = rest_words(answer, rest)
    if beyond.any():
        assert f"{beyond.sum()} accessible cells" in said
        assert said.endswith("too far for any robot to visit and come home.")
    else:
        assert said == "Every accessible cell is near enough for some robot to visit and come home."
    assert answer.layers.to_do[0].about.endswith("violet: too far for any robot to visit and come home.")


def state(folder: Path) -> MissionState:
    cells = "[[4, 0], [3, 0], [2, 0], [0, 0], [0, 1]]"
    robots = '[{"cell": [2, 0]}, {"cell": [0, 1], "status": "dead"}]'
    text = (
        f'{{"format": "mrac-state", "version": 1, "world": {{"shape": [5, 9], "sha256": "{WORLD.sha256}"}}, "step": 7,'
    )
    (folder / "now.json").write_text(f'{text} "visited": {cells}, "robots": {robots}}}')
    return load_state(folder / "now.json", WORLD)


@pytest.mark.usefixtures("one_picture")
def test_a_state_is_told_and_drawn_and_whole_missions_are_as_they_were(tmp_path: Path) -> None:
    answer = mrac.evaluate(WORLD, state=state(tmp_path), **QUIET)  # type: ignore[arg-type]
    rest = rest_of(answer.world, answer.plan)
    assert rest is not None and rest.title == "Going on from step 7" and (rest.kinds != BEYOND).all()
    assert np.flatnonzero(rest.kinds == BEFORE).tolist() == [0, 1, 18, 27, 36]
    cells = int(WORLD.accessible(WORLD.starts).sum())
    left = answer.expected.visited_by_cell[(rest.kinds == TO_DO).ravel()].sum()
    (said,) = rest_words(answer, rest)
    assert (
        said.startswith(f"By step 7, where this goes on, 5 of {cells} accessible cells")
        and "1 of 2 robots lost" in said
    )
    assert f"Of the {cells - 5} left {left:,.1f} are visited" in said
    answer.save(tmp_path / "out")
    page = Reader((tmp_path / "out" / "index.html").read_text()).text
    assert said in page and "rest.png" in page and (tmp_path / "out" / "rest.png").stat().st_size > 10_000
    whole = mrac.evaluate(WORLD, 2, **QUIET)  # type: ignore[arg-type]
    assert rest_of(WORLD, whole.plan) is None and "rest.png" not in report(whole).pictures


def test_a_robot_that_is_lost_reaches_nothing_and_moves_made_are_spent(tmp_path: Path) -> None:
    plan = mrac.plan(WORLD, state=state(tmp_path), range=4)
    rest = rest_of(WORLD, plan)
    assert rest is not None and rest.title == "Going on from step 7, what the range leaves"
    near = moves_to(WORLD, (2, 0)) <= 4 - plan.state.robots[0].moves  # type: ignore[union-attr]
    beyond = WORLD.free & WORLD.accessible(plan.starts) & ~near
    beyond.reshape(-1)[[0, 1, 18, 27, 36]] = False
    np.testing.assert_array_equal(rest.kinds == BEYOND, beyond)
