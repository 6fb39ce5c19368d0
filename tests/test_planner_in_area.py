"""Orders within areas: which neighbour goes first, in every engine alike; elsewhere all is as it was."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from closed_loop_worlds import survey_worlds
from test_planner_policies import compare_traces

import mrac_jax as mrac
from planner.errors import WorldError
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.tally import EventKind
from planner.world.world import World

WIDE = [
    "......",
    "..#...",
    "......",
]  # fmt: skip
PATHS = {
    "nearest": [0, 1, 2, 3, 4, 5, 11, 10, 9, 15, 14, 13, 7, 6, 12, 13, 14, 15, 16, 17],
    "rows": [0, 1, 2, 3, 4, 5, 11, 10, 9, 15, 14, 13, 12, 6, 7, 13, 14, 15, 16, 17],
    "columns": [0, 6, 12, 13, 7, 1, 2, 3, 9, 15, 14, 15, 16, 10, 4, 5, 11, 17],
}
"""By hand, from SPEC section 20, of a robot that begins upper left."""


def drawn(rows: list[str]) -> World:
    """`.` is safe, `#` an obstacle, a digit so many tenths of danger."""
    values = {".": 0.0, "#": np.nan} | {str(n): n / 10 for n in range(1, 10)}
    return World.create(np.array([[values[one] for one in row] for row in rows], dtype=np.float32))


@pytest.mark.parametrize("order", PATHS)
def test_paths_by_hand(order: str) -> None:
    world = drawn(WIDE)
    assert mrac.plan(world, 1, in_area=order).robots[0].path.tolist() == PATHS[order]


def test_boustrophedon_goes_along_those_straight_runs_of_which_there_are_fewer() -> None:
    wide = mrac.plan(drawn(WIDE), 1, in_area="boustrophedon").robots[0].path.tolist()
    high = drawn(["".join(column) for column in zip(*WIDE, strict=True)])
    found = mrac.plan(high, 1, in_area="boustrophedon").robots[0].path.tolist()
    assert wide == PATHS["rows"]  # 4 runs in rows, 7 in columns
    assert found == mrac.plan(high, 1, in_area="columns").robots[0].path.tolist() != wide
    square = mrac.plan(drawn(["...", "...", "..."]), 1, in_area="boustrophedon").robots[0].path.tolist()
    assert square == [0, 1, 2, 5, 4, 3, 6, 7, 8]  # as many: rows
    # of two safe areas each goes by its own shape
    both = drawn(["....1..", "....1..", "##111..", "#####.."])
    path = mrac.plan(both, 1, in_area="boustrophedon").robots[0].path.tolist()
    assert path[:8] == [0, 1, 2, 3, 10, 9, 8, 7]
    assert [cell for cell in path if cell % 7 >= 5] == [12, 5, 6, 13, 20, 27, 26, 19]


def test_dangerous_areas_are_covered_as_before() -> None:
    """A robot that comes in from above into a dangerous field: the order is for safe areas alone."""
    world = drawn(["...", "222", "222", "222"])
    paths = [mrac.plan(world, 1, in_area=order).robots[0].path.tolist() for order in PATHS]
    assert [path[:3] for path in paths] == [[0, 1, 2]] * 3
    assert len({tuple(path[3:]) for path in paths}) == 1


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_compiled_runs_are_the_readable_ones_event_for_event(policy: str) -> None:
    counts, differ = np.zeros(len(EventKind), dtype=np.int64), 0
    for number, one in enumerate(survey_worlds()[5::17]):
        transit: Any = ("grid", "area")[number % 2]
        order = ("boustrophedon", "rows", "columns")[number % 3]
        asked = replace(one.settings, policy=policy, transit=transit, in_area=order)
        try:
            plan = make_plan(one.world, one.starts, asked)
        except WorldError as error:
            assert "too dear" in str(error)
            continue
        usual = make_plan(one.world, one.starts, replace(asked, in_area="nearest"))
        differ += any(not np.array_equal(a.path, b.path) for a, b in zip(plan.robots, usual.robots, strict=True))
        counts += compare_traces(one.world, plan, range(1), one.first_only)
    assert differ >= 6
    assert counts[EventKind.SHARED] > 10


def test_a_scenario_a_plan_file_and_an_identity_know_it(tmp_path: Any) -> None:
    np.save(tmp_path / "field.npy", np.zeros((3, 6)))
    (tmp_path / "field.yaml").write_text("map: field.npy\nin_area: columns\n")
    world = mrac.load(tmp_path / "field.yaml")
    plan = mrac.plan(world, 2)
    assert plan.settings.in_area == "columns"
    plan.save(tmp_path / "plan.json")
    assert mrac.read_plan(tmp_path / "plan.json", world).settings == plan.settings
    assert "in_area" not in Settings().to_json()
    assert Settings(in_area="rows").to_json()["in_area"] == "rows"
