"""Fields whose rows run in a direction, and that are driven by swaths: what is covered is counted on smaller cells."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import mrac_jax as mrac
from planner.errors import InputError


def scenario(folder: Path, rings: list[list[list[float]]], *lines: str) -> Path:
    (folder / "farm.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": rings}))
    (folder / "farm.yaml").write_text("\n".join(lines))
    return folder / "farm.yaml"


def test_rows_run_in_the_direction_that_is_asked_for(tmp_path: Path) -> None:
    """A rectangle of 40 x 20 m that lies askew: by its own rows it is cut into whole cells, all of them within it."""
    turn = math.radians(30)
    along, across = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    corners = [5000 + a * along + b * across for a, b in ((0, 0), (40, 0), (40, 20), (0, 20), (0, 0))]
    rings = [[corner.tolist() for corner in corners]]
    world = mrac.load(scenario(tmp_path, rings, "map: {polygons: farm.geojson, direction: 30}", "cell_size: 2"))
    assert world.shape == (10, 20) and world.free.all()
    places = world.to_xy(np.arange(200)) - 5000
    row, col = np.divmod(np.arange(200), 20)
    np.testing.assert_allclose(places @ along, 2 * col + 1, atol=1e-6)
    np.testing.assert_allclose(places @ across, 19 - 2 * row, atol=1e-6)
    askew = mrac.load(scenario(tmp_path, rings, "map: {polygons: farm.geojson}", "cell_size: 2"))
    assert askew.free.sum() < 180


def test_swaths_are_driven_and_the_field_s_cells_are_counted(tmp_path: Path) -> None:
    """By hand: 10 x 10 m in swaths of 4 m from the upper left; half a swath is enough, a quarter is not."""
    square = [[[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]]
    lines = ("map: {polygons: farm.geojson, swath: 4}", "cell_size: 1")
    world = mrac.load(scenario(tmp_path, square, *lines))
    assert (world.shape, world.cell_size) == ((3, 3), 4.0)
    assert np.where(world.free, world.value, 0).tolist() == [[16, 16, 8], [16, 16, 8], [8, 8, 0]]
    assert not world.free[2, 2]
    assert any("hold 96.00 % of the field's cells of 1 m" in note for note in world.notes)
    np.testing.assert_allclose(world.to_xy([0, 8]), [[2, 8], [10, 0]])
    plan = mrac.plan(world, starts=[[0, 0]], deadline=3)
    answer = mrac.evaluate(world, plan, rollouts=8, advice=False)
    fine = np.zeros((12, 12), dtype=bool)  # visit by visit: what lies within half a swath of its centre
    for cell in plan.robots[0].path.tolist():
        (x, y), at = world.to_xy([cell])[0], np.arange(12) + 0.5
        fine |= (abs(10 - at - y) <= 2)[:, None] & (abs(at - x) <= 2)
    covered = fine[:10, :10].sum()
    assert answer.outputs["value"].as_json()["covered"]["mean"] == pytest.approx(covered) and covered < 96


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("map: {polygons: farm.geojson, swath: 2.5}", r"`map.swath` is 2.5 m; expected a whole number of cells of 1 m"),
        ("map: {polygons: farm.geojson, swath: 0.5}", r"`map.swath` is 0.5 m"),
        ("map: {polygons: farm.geojson, direction: 200}", r"`map.direction` is 200; expected degrees, -180 to 180"),
        ("map: {polygons: farm.geojson, swath: 2}\nvalue: 3", r"`value` is 3; expected none of a map with a swath"),
        ("map: {file: farm.geojson, swath: 2}", "swath"),
    ],
)
def test_swaths_and_directions_that_are_none(tmp_path: Path, line: str, said: str) -> None:
    square = [[[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]]
    with pytest.raises(InputError, match=said):
        mrac.load(scenario(tmp_path, square, line, "cell_size: 1"))
