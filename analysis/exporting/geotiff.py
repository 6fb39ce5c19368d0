"""The map and what is known of its cells as a GeoTIFF, in the CRS that the map came in."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from analysis.exporting.mission import Mission
from planner.worlds.georeference import Georeference, rasterio_for
from planner.worlds.grid import Frame
from planner.worlds.warp import affine
from planner.worlds.world import World

BANDS = {
    "threat": "chance that one visit stops a robot",
    "covered": "chance that the cell is visited (open loop, exact)",
    "losses": "robots expected to be lost in the cell (open loop, exact)",
    "residual": "residual risk: threat * (1 - covered)",
}


def geotiff(mission: Mission) -> bytes:
    """The bands BANDS, but for those that are known of no cell. Raises MapError without rasterio.

    Of robots that are not told the map, `believed_threat` and `believed_residual`: with what they believe of it.
    """
    world, shape = mission.world, mission.world.shape
    threat, covered = world.threat.astype(np.float64), mission.exact.visited_by_cell.reshape(shape)
    losses = mission.exact.stops_by_cell.reshape(shape)
    bands = dict(zip(BANDS, (threat, covered, losses, threat * (1 - covered)), strict=True))
    known = {name: band for name, band in bands.items() if np.isfinite(band).any()}
    names = {name: BANDS[name] for name in known}
    if mission.believed:
        names = {f"believed_{n}" if n in ("threat", "residual") else n: words for n, words in names.items()}
    return raster(world, names, np.stack(list(known.values())))


def raster(world: World, names: Mapping[str, str], bands: NDArray[np.float64]) -> bytes:
    """Bands `[B, H, W]` as float32, NaN on obstacles; `names`: of each, and what it means.

    A map that nobody has put on the Earth has no CRS in it either. Raises MapError without rasterio.
    """
    rasterio, shape, bands = rasterio_for("a GeoTIFF", world.source), world.shape, np.where(world.free, bands, np.nan)
    frame, place = Frame(shape, world.cell_size, world.origin), world.georeference or Georeference("")
    height, width = shape
    with (
        rasterio.io.MemoryFile() as memory,
        memory.open(
            driver="GTiff", width=width, height=height, count=len(names), dtype="float32", nodata=math.nan,
            crs=place.crs or None, transform=rasterio.Affine(*affine(frame, place)), compress="deflate",
        ) as data,
    ):  # fmt: skip
        data.write(bands.astype(np.float32))
        for band, (name, words) in enumerate(names.items(), start=1):
            data.set_band_description(band, name)
            data.update_tags(band, meaning=words)
        data.close()
        return bytes(memory.read())
