"""The tables and the picture of `docs/search.md`: drones that search SAREnv's probability maps, and lose drones.

python docs/examples/search.py FOLDER [RUNS [PICTURE]]; 16 runs a map are behind the figures, 0: no drone is lost.
FOLDER holds `N/heatmap.npy` of SAREnv's data set (float64, cells of 30 m, sum 1); missing maps and Git LFS pointers are
left out.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import mrac_jax as mrac
from analysis.pictures import ROBOT_COLOURS, picture_style
from planner.failure_model import exp1_thresholds, exposure_of

Cell = tuple[int, int]
PIXEL, DISC = 30.0, 1800.0
"""Metres: side of a heat map's cell, radius of size "medium" in flat temperate country."""
SIGHT = 80 * np.tan(np.radians(22.5))
"""Metres: radius that a camera sees at a height of 80 m with a field of view of 45 degrees."""
SIDES = (66.0, 60.0)
"""Metres: sides of our cells. One swath (2 SIGHT = 66.3 m), and two pixels, where there is budget for all."""
TEAMS = ((1, 100), (2, 100), (5, 100), (5, 250), (5, 300))
"""Drones, and km of all drones together. Losses are simulated for teams of MOST."""
MOST = 5
LOST = (0.1, 0.3, 0.5)
RING = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
"""The eight blocks about the block in the centre."""


def medium(file: Path) -> NDArray[np.float64]:
    """The disc of 1.8 km about the middle of a heat map, float64 `[120, 120]`: zero outside, not normalised."""
    whole = np.load(file)
    row, col = whole.shape[0] / 2, whole.shape[1] / 2
    reach = DISC / PIXEL
    rows, cols = (np.arange(int(middle - reach), int(middle + reach)) for middle in (row, col))
    inside = (rows[:, None] - row) ** 2 + (cols - col) ** 2 <= reach**2
    return np.where(inside, whole[np.ix_(rows, cols)], 0)


def corner(side: float, shape: Sequence[int]) -> float:
    """Metres from the heat map's corner to that of our cells: an odd number of blocks of 2 x 2 about its middle."""
    return (shape[0] * PIXEL - blocks_across(side, shape) * 2 * side) / 2


def blocks_across(side: float, shape: Sequence[int]) -> int:
    """Blocks of 2 x 2 cells in a row of the map, an odd number."""
    return 2 * int(np.ceil(shape[0] * PIXEL / (4 * side) - 0.5)) + 1


def on_cells(heat: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    """The probability of each of our cells: pixels are shared out by area."""
    at = corner(side, heat.shape) + side * np.arange(2 * blocks_across(side, heat.shape) + 1)
    edges = np.clip(at / PIXEL, 0, len(heat))[:, None]
    shares = np.diff(np.clip(edges - np.arange(len(heat)), 0, 1), axis=0)
    return shares @ heat @ shares.T


def seen(paths: Iterable[NDArray[np.float64]], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The pixels that SAREnv counts as seen: their centre is within SIGHT of a point of a path, one every 15 m.

    `paths`: float64 `[N, 2]` each, metres from the corner of the heat map by row and column.
    """
    found = np.zeros(shape, dtype=np.bool_)
    for path in paths:
        gone = np.r_[0, np.cumsum(np.hypot(*np.diff(path, axis=0).T))]
        # A lost drone's path stands still at its end, and a path of one cell has no points: as theirs.
        if gone[-1] == 0:
            continue
        along = np.linspace(0, gone[-1], int(np.ceil(gone[-1] / (PIXEL / 2))) + 1)
        points = np.stack([np.interp(along, gone, path[:, axis]) for axis in (0, 1)], axis=1)
        for shift in np.ndindex(5, 5):
            pixels = (points / PIXEL).astype(np.int64) + shift - 2
            near = np.hypot(*((pixels + 0.5) * PIXEL - points).T) <= SIGHT
            near &= ((pixels >= 0) & (pixels < shape)).all(axis=1)
            found[tuple(pixels[near].T)] = True
    return found


def swept(heat: NDArray[np.float64], km: float) -> float:
    """The probability of the best pixels that fill the swept area: no path of this length sweeps more."""
    pixels = round(km * 1000 * 2 * SIGHT / PIXEL**2)
    return float(np.sort(heat, axis=None)[::-1][:pixels].sum())


def grown(values: NDArray[np.float64], roots: Sequence[Cell], most: Sequence[int]) -> list[set[Cell]]:
    """Connected blocks of each drone: the drone with the fewest takes the most probable block next to its own.

    Where none of these is probable at all (water, seen before) it goes towards the nearest block that is.
    `most`: blocks of each drone.
    """
    owned, open_for = [{root} for root in roots], set(range(len(roots)))
    taken = set(roots)
    wanted = set(zip(*np.nonzero(values), strict=True)) - taken
    while open_for and wanted:
        drone = min(open_for, key=lambda one: len(owned[one]))
        beside = {block for of in owned[drone] for block in neighbours(of, values.shape)} - taken
        if len(owned[drone]) >= most[drone] or not beside:
            open_for.remove(drone)
            continue
        if beside & wanted:
            best = max(beside & wanted, key=lambda block: (values[block], block))
        else:
            best = min(beside, key=lambda block: (distance(block, wanted), block))
        owned[drone].add(best)
        taken.add(best)
        wanted.discard(best)
    return owned


def distance(block: Cell, others: Iterable[Cell]) -> int:
    """Moves to the nearest of the other blocks."""
    return min(abs(block[0] - row) + abs(block[1] - col) for row, col in others)


def neighbours(block: Cell, shape: tuple[int, ...]) -> list[Cell]:
    """The blocks N, W, E and S of a block."""
    row, col = block
    beside = ((row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col))
    return [one for one in beside if 0 <= one[0] < shape[0] and 0 <= one[1] < shape[1]]


def circuit(blocks: set[Cell], along: int) -> dict[Cell, Cell]:
    """The next cell of each cell on the circuit around a spanning tree of blocks (spanning tree coverage).

    `along`: 0 or 1, the axis along which blocks are joined first: fewer turns, of which each leaves a corner unseen.
    """
    tree_of, joined = {block: block for block in blocks}, set()

    def root(block: Cell) -> Cell:
        while tree_of[block] != block:
            block = tree_of[block]
        return block

    for axis in (along, 1 - along):
        for row, col in sorted(blocks):
            other = (row + 1, col) if axis == 0 else (row, col + 1)
            if other in blocks and root((row, col)) != root(other):
                tree_of[root((row, col))] = root(other)
                joined |= {((row, col), other), (other, (row, col))}
    following = {}
    for row, col in blocks:
        north, south, west, east = (
            ((row, col), (row + down, col + right)) in joined for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1))
        )
        top, left = 2 * row, 2 * col
        # Counter-clockwise about the block, and across a side where a branch of the tree leaves.
        following[top, left] = (top, left - 1) if west else (top + 1, left)
        following[top + 1, left] = (top + 2, left) if south else (top + 1, left + 1)
        following[top + 1, left + 1] = (top + 1, left + 2) if east else (top, left + 1)
        following[top, left + 1] = (top - 1, left + 1) if north else (top, left)
    return following


@dataclass(frozen=True)
class Search:
    """Paths of drones over one heat map.

    Attributes:
        heat: float64 `[120, 120]`. side: metres of a cell. moves: of each drone's budget.
        paths: int64 `[N, 2]` of each drone, cells as (row, col).
    """

    heat: NDArray[np.float64]
    side: float
    moves: int
    paths: list[NDArray[np.int64]]

    def metres(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """The middles of cells, metres from the corner of the heat map by row and column."""
        return corner(self.side, self.heat.shape) + (cells + 0.5) * self.side

    def likelihood(self, paths: Iterable[NDArray[np.int64]]) -> float:
        """SAREnv's measure: the probability of the pixels that these paths see."""
        return float(self.heat[seen(map(self.metres, paths), self.heat.shape)].sum())

    def world(self, lost: float) -> mrac.World:
        """The map with probability as value: a drone that flies all its budget is lost with chance `lost`."""
        values = on_cells(self.heat, self.side)
        free = values > 0
        free[tuple(np.concatenate(self.paths).T)] = True
        # The hazard of a metre is the same everywhere. A start is a visit too.
        threat = 1 - (1 - lost) ** (1 / (self.moves + 1))
        return mrac.World.create(np.where(free, threat, np.nan), value=values, cell_size=self.side, source="search")

    def reallocated(self, lost: float, runs: int) -> NDArray[np.float64]:
        """The likelihood of rollouts in which survivors take over, each within its budget."""
        if min(map(len, self.paths)) > self.moves:
            # No drone has budget left at the end of its path.
            return self.fixed(lost, runs)
        return self.flown(lost, runs, "closed")

    def fixed(self, lost: float, runs: int) -> NDArray[np.float64]:
        """The likelihood of rollouts in which each drone follows its path: those of `flown` in the open loop."""
        last = self.last_moves(lost, runs)
        cut = ([path[: move + 1] for path, move in zip(self.paths, of, strict=True)] for of in last)
        return np.array([self.likelihood(paths) for paths in cut])

    def flown(self, lost: float, runs: int, loop: str) -> NDArray[np.float64]:
        """The likelihood of rollouts by this tool, in which every drone flies at most its budget."""
        world = self.world(lost)
        with TemporaryDirectory() as folder:
            file, log = Path(folder, "paths.json"), Path(folder, "runs.mcap")
            file.write_text(json.dumps({"paths": [path.tolist() for path in self.paths]}), encoding="utf-8")
            mrac.record(world, mrac.read_plan(file, world), log, ids=range(runs), loop=loop)
            cells = [run.trace.cells[: self.moves + 1] for run in mrac.read_rollouts(log)]
        return np.array([self.likelihood(np.stack(np.divmod(of.T, world.shape[1]), axis=2)) for of in cells])

    def last_moves(self, lost: float, runs: int) -> NDArray[np.int64]:
        """The move at which each drone is lost in each of these rollouts, int64 `[R, K]`, if its path goes that far.

        The hazard is the same in every cell, so the failure threshold alone determines it.
        """
        visit = exposure_of(np.nanmax(self.world(lost).threat))
        return -(-exp1_thresholds(0, np.arange(runs), len(self.paths)) // visit) - 1

    def replanned(self, lost: float, runs: int) -> NDArray[np.float64]:
        """The likelihood of these rollouts if this script plans the survivors' paths again after each loss."""
        return np.array([self.likelihood(self.with_losses(of)) for of in self.last_moves(lost, runs).tolist()])

    def with_losses(self, last: Sequence[int]) -> list[NDArray[np.int64]]:
        """The cells of each drone by step if it is lost at its move `last`, and the others plan again."""
        paths, alive = list(self.paths), set(range(len(self.paths)))
        while alive:
            ends = {drone: step_of(last[drone], paths[drone]) for drone in alive}
            drone = min(ends, key=lambda one: ends[one])
            step = ends[drone]
            if step >= len(paths[drone]):
                break
            alive.remove(drone)
            paths[drone] = paths[drone][: step + 1]
            flown = [path[: step + 1] for path in paths]
            heat = np.where(seen(map(self.metres, flown), self.heat.shape), 0, self.heat)
            # A drone whose path has ended waits: its time runs, and there is no hazard.
            left = sorted(alive)
            waited = [np.pad(flown[one], ((0, step + 1 - len(flown[one])), (0, 0)), mode="edge") for one in left]
            for one, path in zip(left, extended(replace(self, heat=heat, paths=waited)), strict=True):
                paths[one] = path
        return paths


def step_of(move: int, path: NDArray[np.int64]) -> int:
    """The step at which a drone makes its move of this number; beyond the path's end if it makes fewer."""
    moves = np.r_[0, np.cumsum((np.diff(path, axis=0) != 0).any(axis=1))]
    return int(np.searchsorted(moves, move))


def extended(search: Search) -> list[NDArray[np.int64]]:
    """The paths, each with a circuit from its last cell around blocks of high probability, within its budget."""
    across = blocks_across(search.side, search.heat.shape)
    values = on_cells(search.heat, search.side).reshape(across, 2, across, 2).sum(axis=(1, 3))
    left = [search.moves + 1 - len(path) for path in search.paths]
    roots = [(int(row) // 2, int(col) // 2) for row, col in (path[-1] for path in search.paths)]
    found = []
    for path, moves, blocks in zip(
        search.paths, left, grown(values, roots, [-(-(of + 1) // 4) for of in left]), strict=True
    ):
        ways = [way[: moves + 1] for along in (0, 1) for way in both_ways(circuit(blocks, along), path[-1])]
        found.append(np.concatenate([path[:-1], max(ways, key=lambda way: search.likelihood([way]))]))
    return found


def both_ways(following: dict[Cell, Cell], cell: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The circuit from a cell on, in either direction."""
    first = (int(cell[0]), int(cell[1]))
    around = [first]
    while (after := following[around[-1]]) != first:
        around.append(after)
    return [np.array(around), np.array([first, *around[:0:-1]])]


def planned(heat: NDArray[np.float64], drones: int, km: float, side: float) -> Search:
    """Paths of at most eight drones, from the block in the centre into as many of the blocks about it."""
    middle = blocks_across(side, heat.shape) // 2
    ways = []
    for down, right in [RING[8 * one // drones] for one in range(drones)] if drones > 1 else [(0, 0)]:
        row, col = 2 * middle + (down > 0), 2 * middle + (right > 0)
        way = [(row, col), (row, col + right), (row + down, col + right)]
        ways.append(np.array(list(dict.fromkeys(way))))
    search = Search(heat, side, int(km * 1000 / drones / side), ways)
    return replace(search, paths=extended(search))


def best(heat: NDArray[np.float64], drones: int, km: float) -> Search:
    """The better of the sides of cells."""
    return max((planned(heat, drones, km, side) for side in SIDES), key=lambda one: one.likelihood(one.paths))


def main(folder: str, runs: str = "16", picture: str = "") -> None:
    """Prints both tables, and draws the picture if it has a name."""
    files = sorted(Path(folder).glob("*/heatmap.npy"), key=lambda file: int(file.parent.name))
    maps = {file.parent.name: medium(file) for file in files if file.read_bytes()[:6] == b"\x93NUMPY"}
    if not maps:
        sys.exit(f"{folder}: no N/heatmap.npy with an array in it")
    found = {team: [best(heat, *team) for heat in maps.values()] for team in TEAMS}
    sys.stdout.write("| drones, km | likelihood | bound |\n|---|---:|---:|\n")
    for (drones, km), searches in found.items():
        likelihoods = [one.likelihood(one.paths) for one in searches]
        bound = np.mean([swept(heat, km) for heat in maps.values()])
        sys.stdout.write(f"| {drones}, {km} | {np.mean(likelihoods):.4f} | {bound:.4f} |\n")
    if picture:
        draw(found[5, 100], list(maps), picture)
    if not int(runs):
        return
    sys.stdout.write("| drones, km, lost | fixed paths | reallocation | planned again |\n|---|---:|---:|---:|\n")
    for (drones, km), searches in found.items():
        if drones < MOST:
            continue
        for lost in LOST:
            ways = (Search.fixed, Search.reallocated, Search.replanned)
            cells = [mean_of(np.array([of(one, lost, int(runs)) for one in searches])) for of in ways]
            sys.stdout.write(f"| {drones}, {km}, {100 * lost:g} % | {' | '.join(cells)} |\n")
            sys.stdout.flush()


def mean_of(values: NDArray[np.float64]) -> str:
    """The mean over maps and runs `[M, R]` with the standard error of the runs: the maps are given."""
    # The same failure thresholds serve every map: runs are independent, maps are not.
    error = values.mean(axis=0).std(ddof=1) / np.sqrt(values.shape[1])
    return f"{values.mean():.4f} ± {error:.4f}"


def draw(searches: Sequence[Search], names: Sequence[str], picture: str) -> None:
    """The maps on which least and most is seen, north up, with the drones' paths."""
    likelihoods = [one.likelihood(one.paths) for one in searches]
    with picture_style():
        figure = Figure((8, 4.6), layout="constrained")
        for number, axes in zip(np.argsort(likelihoods)[[0, -1]], figure.subplots(1, 2), strict=True):
            search, reach = searches[number], DISC / 1000
            # Row 0 of a heat map is its south.
            axes.imshow(
                np.sqrt(search.heat),
                cmap="Greys",
                vmax=1.8 * np.sqrt(search.heat.max()),
                origin="lower",
                extent=(-reach, reach, -reach, reach),
            )
            for path, colour in zip(search.paths, ROBOT_COLOURS, strict=False):
                rows, cols = (search.metres(path).T - DISC) / 1000
                axes.plot(cols, rows, color=colour, linewidth=1)
            axes.plot(0, 0, "^", color="#20242b", markersize=7)
            best = swept(search.heat, 100)
            axes.set(title=f"Map {names[number]}: {likelihoods[number]:.3f} of {best:.3f}", xlabel="km", aspect="equal")
        figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
