"""Write the data of the worked cases of docs/cases.md: `python docs/examples/cases.py FOLDER`."""

from __future__ import annotations

import json
import shutil
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np

REACTOR = """\
map: {file: building_map.yaml}
cell_size: 0.5
unknown: obstacle
threats:      # 2 s a visit, a mean dose to failure of 20 Sv: 2 / 3600 / 20 failures per visit and Sv/h
  - {raster: dose_rate.npy, rule: {kind: exposure, rate: 2.8e-5}}
weibull_shape: 3
robots: {count: 3, return_to: home}
"""
MINEFIELD = """\
map: {polygons: field.geojson, boundary: centre}
cell_size: 5
threats:
  - {polygons: field.geojson, p: 0.00005}        # a drone fails once in 28 hours; a cell takes 5 s
  - {polygons: power_line.geojson, p: 0.02}
value:                                           # expected mines
  - everywhere: 0.002
  - {points: reports.csv, falloff: {kind: gaussian, radius: 12}}
detect: 0.85
robots: {count: 3}
"""
SEARCH = """\
map: {file: hills.npy, resolution: 50}
threats:
  - {raster: gusts.npy}
value:
  - raster: probability.npy
detect: 0.7
robots: {count: 4, start: upper-left, range: 220, return_to: home, recharge: 30, deliver_every: 60}
policy: per_cell
"""
LON, LAT = 16.4, 43.9
METRE = 1 / 111_320


def degrees(points: list[tuple[float, float]]) -> list[list[float]]:
    """Longitude and latitude of points in metres from the field's corner."""
    return [[LON + x * METRE / np.cos(np.radians(LAT)), LAT + y * METRE] for x, y in points]


def polygon(file: Path, corners: list[tuple[float, float]]) -> None:
    """Write a polygon as GeoJSON."""
    ring = degrees([*corners, corners[0]])
    file.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))


def reactor(folder: Path) -> None:
    """A floor with two leaks: dose rates in Sv/h by the inverse square of the distance, 0.05 m a pixel."""
    for name in ("building_map.yaml", "building_map.pgm"):
        shutil.copy(str(files("analysis.examples") / name), folder / name)
    rows, cols = np.mgrid[:320, :480] * 0.05
    leaks = [(4.0, 18.0, 900.0), (12.0, 8.0, 2500.0)]  # metres from the top and from the left, Sv/h at 1 m
    rate = sum(strength / np.maximum((rows - row) ** 2 + (cols - col) ** 2, 1.0) for row, col, strength in leaks)
    np.save(folder / "dose_rate.npy", np.asarray(rate, dtype=np.float32))
    (folder / "reactor.yaml").write_text(REACTOR)


def minefield(folder: Path) -> None:
    """A field of 4 hectares under a power line, with five reports of mines."""
    polygon(folder / "field.geojson", [(0, 0), (260, 10), (240, 170), (120, 200), (10, 150)])
    polygon(folder / "power_line.geojson", [(70, -20), (80, -20), (200, 220), (190, 220)])
    reports = degrees([(40, 40), (60, 52), (150, 150), (205, 60), (215, 66)])
    rows = [f"{lon:.7f},{lat:.7f},0.3" for lon, lat in reports]
    (folder / "reports.csv").write_text("\n".join(["lon,lat,strength", *rows]) + "\n")
    (folder / "minefield.yaml").write_text(MINEFIELD)


def search(folder: Path) -> None:
    """Hills of 2 x 2 km in cells of 50 m: a person was last seen in the middle; wind is dangerous on a ridge."""
    rows, cols = np.mgrid[:40, :40]
    away = np.hypot(rows - 22, cols - 24) * 50
    likely = np.exp(-(((away - 500) / 300) ** 2)) * (1 + 0.8 * np.sin(cols / 4.0) * np.cos(rows / 5.0))
    ridge = np.abs(rows - 0.6 * cols - 6) < 2.5
    np.save(folder / "hills.npy", np.zeros((40, 40), dtype=np.float32))
    np.save(folder / "gusts.npy", np.where(ridge, 0.005, 0.0001).astype(np.float32))
    np.save(folder / "probability.npy", (likely / likely.sum()).astype(np.float32))
    (folder / "search.yaml").write_text(SEARCH)


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.mkdir(parents=True, exist_ok=True)
    for case in (reactor, minefield, search):
        case(target)
