"""Threats by line of sight, and elevations."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from threat_sources import load, raster

from planner.errors import ScenarioError
from planner.world.raster_files import slope_degrees, visible


def test_sight_over_level_ground_reaches_its_range() -> None:
    for height in (0.0, 2.0):
        distance = visible(np.full((7, 11), 3.0), (2, 4), height, 35.0, 10.0)
        rows, cols = np.indices((7, 11))
        metres = 10 * np.hypot(rows - 2, cols - 4)
        assert np.where(metres <= 35, metres, np.inf).tolist() == distance.tolist()


def test_a_ridge_hides_what_lies_behind_it() -> None:
    ground = np.zeros((1, 9))
    ground[0, 3] = 5.0
    ground[0, 8] = 40.0
    distance = visible(ground, (0, 0), 2.0, 1000.0, 10.0)
    assert np.isfinite(distance[0]).tolist() == [True, True, True, True, False, False, False, False, True]
    seen_from_above = visible(ground, (0, 0), 50.0, 1000.0, 10.0)
    assert np.isfinite(seen_from_above).all()
    unknown = visible(np.where(ground == 5, np.nan, ground), (0, 0), 2.0, 1000.0, 10.0)
    assert np.flatnonzero(~np.isfinite(unknown)).tolist() == [3]


def test_sight_agrees_with_a_fine_walk_along_each_line() -> None:
    rng = np.random.default_rng(4)
    ground = np.cumsum(np.cumsum(rng.normal(size=(13, 17)), axis=0), axis=1)
    site, height, size = (6, 3), 1.0, 5.0
    seen = np.isfinite(visible(ground, site, height, 1e6, size))
    for row, col in np.ndindex(ground.shape):
        steps = max(abs(row - site[0]), abs(col - site[1]))
        highest = -np.inf
        for step in range(1, steps):
            r, c = site[0] + (row - site[0]) * step / steps, site[1] + (col - site[1]) * step / steps
            r0, c0 = min(int(r), 11), min(int(c), 15)
            corners = ground[r0 : r0 + 2, c0 : c0 + 2]
            z = np.array([1 - (r - r0), r - r0]) @ corners @ np.array([1 - (c - c0), c - c0])
            highest = max(highest, (z - ground[site] - height) / np.hypot(r - site[0], c - site[1]))
        away = math.hypot(row - site[0], col - site[1])
        slope = (ground[row, col] - ground[site] - height) / away if away else 0
        assert seen[row, col] == (steps == 0 or slope >= highest - 1e-9), (row, col)


def viewshed(folder: Path, elevation: np.ndarray, keys: dict, **more: object) -> np.ndarray:
    np.save(folder / "dem.npy", elevation)
    return load(folder, [{"viewshed": keys}], map={"elevation": "dem.npy", "resolution": 10}, **more)


def test_viewshed_on_the_cells_in_bands(tmp_path: Path) -> None:
    keys = {"sites": [[0, 0]], "bands": [[10, 0.3], [35, 0.1]], "height": 0}
    threat = viewshed(tmp_path, np.zeros((2, 6)), keys)
    assert threat == pytest.approx(np.array([[0.3, 0.3, 0.1, 0.1, 0, 0], [0.3, 0.1, 0.1, 0.1, 0, 0]]), abs=1e-7)
    two = viewshed(tmp_path, np.zeros((4, 12)), {"sites": [[0, 0], [0, 1]], "range": 25, "p": 0.2}, cell_size=20)
    assert two == pytest.approx(np.array([[0.36, 0.36, 0.2, 0, 0, 0], [0.2, 0.2, 0, 0, 0, 0]]), abs=1e-7)
    keys = {"sites": [[0, 0], [0, 1]], "range": 25, "p": 0.2}
    assert viewshed(tmp_path, np.zeros((4, 12)), keys, cell_size=20, combine="max").max() == np.float32(0.2)


@pytest.mark.parametrize(
    ("keys", "names"),
    [
        ({"sites": [], "range": 5, "p": 0.1}, "viewshed.sites"),
        (
            {"sites": [[0, 6]], "range": 5, "p": 0.1},
            "viewshed.sites[0][1]` is 6; expected a column, 0 to 5",
        ),
        ({"sites": [[0]], "range": 5, "p": 0.1}, "viewshed.sites[0]"),
        ({"sites": [[0.5, 1]], "range": 5, "p": 0.1}, "is 0.5"),
        ({"sites": [[0, 0]], "range": 0, "p": 0.1}, "viewshed.range"),
        ({"sites": [[0, 0]], "range": 5, "p": 1}, "viewshed.p"),
        ({"sites": [[0, 0]], "range": 5, "p": 0.1, "height": -1}, "viewshed.height"),
        ({"sites": [[0, 0]]}, "range and p, or bands"),
        ({"sites": [[0, 0]], "p": 0.1, "bands": [[5, 0.1]]}, "not both"),
        ({"sites": [[0, 0]], "bands": [[5, 0.1], [4, 0.2]]}, "rising"),
        ({"sites": [[0, 0]], "bands": [[5, math.nan]]}, "viewshed.bands[0][1]"),
    ],
)
def test_wrong_viewsheds(tmp_path: Path, keys: dict, names: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        viewshed(tmp_path, np.zeros((2, 6)), keys)
    assert names in str(caught.value)


def test_a_site_without_elevation(tmp_path: Path) -> None:
    ground = np.zeros((2, 6))
    ground[1, 2] = np.nan
    with pytest.raises(ScenarioError, match=r"sites\[0\]` is \[1, 2\]; expected a cell whose elevation is known"):
        viewshed(tmp_path, ground, {"sites": [[1, 2]], "range": 5, "p": 0.1})


def test_a_viewshed_needs_heights(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="needs heights"):
        load(tmp_path, [{"viewshed": {"sites": [[0, 0]], "range": 5, "p": 0.1}}])


def test_slopes_and_what_has_no_elevation_are_obstacles(tmp_path: Path) -> None:
    plane = np.arange(5)[:, None] * 10 + np.zeros((5, 8))
    assert slope_degrees(plane, 10.0) == pytest.approx(np.full((5, 8), 45.0))
    assert slope_degrees(plane[:1], 10.0) == pytest.approx(np.zeros((1, 8)))
    assert slope_degrees(plane.T[:1], 10.0) == pytest.approx(np.full((1, 5), 45.0))
    steep = np.zeros((5, 8))
    steep[2, 2:] = 100
    steep[0, 0] = np.nan
    np.save(tmp_path / "dem.npy", steep)
    free = ~np.isnan(load(tmp_path, [], map={"elevation": "dem.npy", "resolution": 10, "max_slope_deg": 30}))
    assert np.argwhere(~free).tolist() == [
        [0, 0],
        *([1, c] for c in range(2, 8)),
        [2, 1],
        [2, 2],
        *([3, c] for c in range(2, 8)),
    ]


@pytest.mark.parametrize("value", [1e300, -3.4e38])
def test_elevations_that_cannot_be(tmp_path: Path, value: float) -> None:
    """They are voids, which are obstacles; their neighbours do not slope towards them."""
    heights = np.zeros((6, 9))
    heights[2, 3] = value
    ground = {"elevation": raster(tmp_path, heights), "max_slope_deg": 30}
    assert np.argwhere(np.isnan(load(tmp_path, [], map=ground))).tolist() == [[2, 3]]
