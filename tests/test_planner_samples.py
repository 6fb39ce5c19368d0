"""Samples of a survey interpolated over a map, held against a kriging system of its own, and every way to be none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from planner.errors import InputError
from planner.world.scenario import load_input
from planner.world.world import World

RANDOM = np.random.default_rng(3)
SAMPLES = np.column_stack([RANDOM.uniform((0, 0), (30, 20), (40, 2)), RANDOM.uniform(1, 9, 40)])
RULE = {"kind": "exposure", "rate": 0.02}


def survey(folder: Path, samples: NDArray[np.float64] | list[Any], header: str = "x_m,y_m,counts,rate_cps") -> None:
    """Rows of x, y, something else, value."""
    lines = [f"{x!r},{y!r},7,{value!r}" for x, y, value in np.asarray(samples, dtype=float).tolist()]
    (folder / "survey.csv").write_text("\n".join([header, *lines]) + "\n")


def scenario(folder: Path, **source: Any) -> World:
    given = {"points": "survey.csv", "strength": "rate_cps", "rule": RULE} | source
    source = {key: value for key, value in given.items() if value is not None}
    keys = {"map": "grid.npz", "threats": [source]}
    np.savez(folder / "grid.npz", threat=np.zeros((10, 15), dtype=np.float32), cell_size=2.0)
    (folder / "s.yaml").write_text(yaml.safe_dump(keys))
    return load_input(folder / "s.yaml")


def values(world: World) -> NDArray[np.float64]:
    """What was interpolated, from p = 1 - exp(-rate * value)."""
    return -np.log1p(-world.threat.astype(np.float64)) / RULE["rate"]


def centres() -> NDArray[np.float64]:
    rows, cols = np.meshgrid(np.arange(10), np.arange(15), indexing="ij")
    return np.stack([2 * cols + 1, 2 * (9 - rows) + 1], axis=-1).reshape(-1, 2).astype(float)


def kriged(samples: NDArray[np.float64], places: NDArray[np.float64], nugget: float) -> NDArray[np.float64]:
    """The textbook's system: variogram h, less the error's variance on the diagonal, weights of sum 1."""
    count = len(samples)
    system = np.ones((count + 1, count + 1))
    between = np.linalg.norm(samples[:, None, :2] - samples[None, :, :2], axis=2)
    system[:count, :count], system[count, count] = between - nugget * np.eye(count), 0
    right = np.ones((count + 1, len(places)))
    right[:count] = np.linalg.norm(samples[:, None, :2] - places[None, :, :], axis=2)
    return samples[:, 2] @ np.linalg.solve(system, right)[:count]


@pytest.mark.parametrize("nugget", [None, 3.0])
def test_kriging_is_the_textbooks(tmp_path: Path, nugget: float | None) -> None:
    survey(tmp_path, SAMPLES)
    how = {"kind": "kriging"} | ({} if nugget is None else {"nugget": nugget})
    world = scenario(tmp_path, interpolate=how)
    expected = np.clip(kriged(SAMPLES, centres(), nugget or 0.0), SAMPLES[:, 2].min(), SAMPLES[:, 2].max())
    np.testing.assert_allclose(values(world).ravel(), expected, rtol=2e-6)
    assert any("threats[0]: 40 samples, interpolated; the farthest free cell is" in note for note in world.notes)


@pytest.mark.parametrize(("power", "near"), [(None, None), (1.0, 3), (3.0, 40)])
def test_inverse_distances(tmp_path: Path, power: float | None, near: int | None) -> None:
    """Also of a sample in the very centre of a cell, which has its value."""
    samples = np.vstack([SAMPLES, [5.0, 3.0, 8.5]])
    survey(tmp_path, samples)
    asked = {"power": power, "neighbours": near}
    how = {"kind": "idw"} | {key: value for key, value in asked.items() if value is not None}
    found = values(scenario(tmp_path, interpolate=how))
    distance = np.linalg.norm(centres()[:, None, :] - samples[None, :, :2], axis=2)
    for place, away in enumerate(distance):
        order = np.argsort(away)[: near or 12]
        weight = np.maximum(away[order], 1e-12) ** -(power or 2.0)
        expected = weight @ samples[order, 2] / weight.sum()
        assert found.ravel()[place] == pytest.approx(expected, rel=2e-6)
    assert found[8, 2] == pytest.approx(8.5, rel=2e-6)


@pytest.mark.parametrize("kind", ["idw", "kriging"])
def test_samples_at_one_place_count_as_their_mean(tmp_path: Path, kind: str) -> None:
    survey(tmp_path, [[5, 5, 2.0], [5, 5, 4.0]])
    np.testing.assert_allclose(values(scenario(tmp_path, interpolate={"kind": kind})), 3.0, rtol=2e-6)


def test_columns_by_name(tmp_path: Path) -> None:
    """As the scenario says, whatever they are called; the error names those that there are."""
    survey(tmp_path, SAMPLES, "Easting,Northing,n,dose")
    survey_of = {"x": "Easting", "y": "northing", "strength": "dose", "interpolate": {"kind": "idw"}}
    named = scenario(tmp_path, **survey_of)
    survey(tmp_path, SAMPLES)
    np.testing.assert_array_equal(named.threat, scenario(tmp_path, interpolate={"kind": "idw"}).threat)
    (tmp_path / "survey.csv").write_text("east,north,p\n5,5,0.5\n")
    disc = {"falloff": {"kind": "disc", "radius": 1.5}, "rule": None}
    world = scenario(tmp_path, x="east", y="north", strength="p", **disc)
    assert world.threat[7, 2] == 0.5 and (world.threat > 0).sum() == 1


HEADER = "x_m,y_m,counts,rate_cps\n"


@pytest.mark.parametrize(
    ("text", "source", "said"),
    [
        (HEADER + "1,1,2,3\n", {"strength": None}, "expected x, y and strength; say which it is, beside the file: "
         "`strength: counts | rate_cps`"),
        (HEADER + "1,1,2,3\n", {"strength": "rate"}, "expected 'rate' among them (strength)"),
        (HEADER + "1,1,2,3\n", {"strength": "rate_cp"}, "did you mean 'rate_cps'?"),
        (HEADER + "1,1,2,3\n", {"strength": 3}, "the name of a column"),
        ("1,1,3\n", {}, "has no header"),
        (HEADER, {}, "has a header and no points"),
        ("", {}, "is empty"),
        (HEADER + "1,1,2,\n", {}, "line 2: strength is ''"),
        (HEADER + "1,1,2,nan\n", {}, "line 2: strength is 'nan'"),
        (HEADER + "1,1,2,-3\n", {}, "values must not be negative"),
        (HEADER + "1,1,2,3\n", {"rule": None}, "gives p = 3"),
        (HEADER + "600000,1,2,3\n", {}, "lie off the map"),
        (HEADER + "11.57549,48.13743,2,3\n", {}, "look like longitude and latitude"),
        ("lon,lat,rate_cps\n11.5,48.1,3\n", {}, "expected x, y in metres"),
        (HEADER + "1,1,2,3\n" * 10**6, {}, "at most 131072 points"),
        (HEADER + "".join(f"{n % 64}.5,{n // 64}.5,2,3\n" for n in range(2100)), {}, "up to 2048"),
        (HEADER + "1,1,2,3\n", {"interpolate": {"kind": "spline"}}, "expected idw or kriging"),
        (HEADER + "1,1,2,3\n", {"interpolate": {"kind": "idw", "nugget": 3}}, "`threats[0].interpolate.nugget`"),
        (HEADER + "1,1,2,3\n", {"interpolate": {"kind": "idw", "power": -1}}, "a number above 0"),
        (HEADER + "1,1,2,3\n", {"falloff": {"kind": "disc", "radius": 2}}, "none beside interpolate"),
        (HEADER + "1,1,2,.3\n", {"interpolate": None, "falloff": {"kind": "disc", "radius": 2}}, "none beside falloff"),
        (HEADER + "1,1,2,3\n", {"interpolate": None}, "interpolate: {kind: idw | kriging}"),
    ],
)  # fmt: skip
def test_what_is_no_survey(tmp_path: Path, text: str, source: dict[str, Any], said: str) -> None:
    (tmp_path / "survey.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        scenario(tmp_path, **({"interpolate": {"kind": "kriging"}} | source))
    assert said in str(caught.value) and "\n" not in str(caught.value)
