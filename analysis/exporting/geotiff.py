"""The map and what is known of its cells as a GeoTIFF, in the CRS that the map came in."""

from __future__ import annotations

import math

import numpy as np

from analysis.exporting.mission import Mission
from planner.worlds.georeference import Georeference, rasterio_for
from planner.worlds.world import World

BANDS = {
    "threat": "chance that one visit stops a robot",
    "covered": "chance that the cell is visited (open loop, exact)",
    "losses": "robots expected to be lost in the cell (open loop, exact)",
    "residual": "residual risk: threat * (1 - covered)",
}


def geotiff(mission: Mission) -> bytes:
    """Four bands of float32, NaN on obstacles (BANDS). A map that nobody has put on the Earth has no CRS in it either.

    Raises MapError without rasterio.
    """
    rasterio = rasterio_for("a GeoTIFF", mission.world.source)
    world, shape = mission.world, mission.world.shape
    threat, covered = world.threat.astype(np.float64), mission.exact.visited_by_cell.reshape(shape)
    losses = mission.exact.stops_by_cell.reshape(shape)
    bands = np.where(world.free, np.stack([threat, covered, losses, threat * (1 - covered)]), np.nan)
    crs = None if world.georeference is None else world.georeference.crs
    height, width = shape
    with (
        rasterio.io.MemoryFile() as memory,
        memory.open(
            driver="GTiff", width=width, height=height, count=len(BANDS), dtype="float32", nodata=math.nan,
            crs=crs, transform=rasterio.Affine(*transform(world)), compress="deflate",
        ) as data,
    ):  # fmt: skip
        data.write(bands.astype(np.float32))
        for band, (name, words) in enumerate(BANDS.items(), start=1):
            data.set_band_description(band, name)
            data.update_tags(band, meaning=words)
        data.close()
        return bytes(memory.read())


def transform(world: World) -> tuple[float, ...]:
    """(a, b, c, d, e, f): a pixel's (col, row) becomes x = a col + b row + c, y = d col + e row + f, in the CRS."""
    place = world.georeference or Georeference("")
    corner, right, down = place.to_crs(world.at([0, 0, 1], [0, 1, 0]))
    (a, d), (b, e) = right - corner, down - corner
    return tuple(map(float, (a, b, corner[0], d, e, corner[1])))
