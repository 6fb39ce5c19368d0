"""The paper's random worlds (SPEC section 8), contiguous and scattered, and random threats on a given map.

Random numbers are Threefry words under keys that no rollout uses: the two words under the seed's own key at counter
(WORLD_TAG, purpose), with one purpose each for obstacles, contiguous and scattered threats. So worlds and rollouts of
one seed share no stream, and the contiguous and the scattered world of one seed have the same obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.arguments import FRACTION, SEED, Numbers, check_word, whole
from planner.errors import WorldError
from planner.failure_model import key_of
from planner.simulator.thresholds import threefry2x32
from planner.world.keys import PROBABILITY
from planner.world.world import FOUR_NEIGHBOURS, MAX_CELLS, World

PAPER_LEVELS = (0.04, 0.08, 0.12, 0.16, 0.20)
"""The paper's threat levels."""
LEAST_LEVEL = 1e-30
"""Smallest threat level: below it 32-bit numbers and path costs cannot distinguish a threat from safety."""
LEVEL = Numbers(LEAST_LEVEL, PROBABILITY.most, below=True, text=f"probabilities {LEAST_LEVEL:g} <= p < 1")
WORLD_TAG = 0x574F524C
"""First counter word of the key derivation ("WORL" in ASCII)."""
OBSTACLES, CONTIGUOUS, SCATTERED = 0, 1, 2
"""Purposes: second counter word of the key derivation."""
DRAWS = 1024
"""Numbers drawn at a time."""

Kind = Literal["contiguous", "scattered"]


@dataclass(frozen=True)
class ThreatPattern:
    """Layout of random threats.

    Attributes:
        kind: "contiguous" areas, or "scattered" over single cells.
        areas: number of contiguous areas of equal size (with fewer dangerous cells than areas each is an area); at
            most one per cell of the map, but always up to the default; unused for scattered threats.
        levels: probabilities, taken in turn by area or cell.
        seed: 0 <= seed < 2**64.
    """

    kind: Kind = "contiguous"
    areas: int = 10
    levels: tuple[float, ...] = PAPER_LEVELS
    seed: int = 0


class Stream:
    """Stream of whole numbers from Threefry: the n-th draw is the words of counter (n, 0) under the stream's key.

    Args:
        seed: 0 <= seed < 2**64.
        purpose: second counter word of the key derivation.
    """

    def __init__(self, seed: int, purpose: int) -> None:
        words = threefry2x32(key_of(seed), WORLD_TAG, purpose)
        self._key = (int(words[0]), int(words[1]))
        self._next = 0
        self._buffer: list[int] = []

    def words(self, count: int) -> NDArray[np.uint64]:
        """The next `count` draws, uint64 `[count]`: x1 above x0."""
        # Counters continue: the draws do not depend on how many are taken at a time.
        x0, x1 = threefry2x32(self._key, np.arange(self._next, self._next + count, dtype=np.uint32), 0)
        self._next += count
        return (x1.astype(np.uint64) << np.uint64(32)) | x0.astype(np.uint64)

    def below(self, bound: int) -> int:
        """A whole number in [0, bound), uniform to within bound / 2**64."""
        if not self._buffer:
            self._buffer = self.words(DRAWS)[::-1].tolist()
        # A multiplication instead of a remainder: no rejection, and the same on every platform.
        return (self._buffer.pop() * bound) >> 64

    def sample(self, count: int, size: int) -> NDArray[np.int64]:
        """`count` different numbers of [0, size) in random order, int64 `[count]`."""
        # Stable, so that equal words (improbable) have a defined order.
        return np.argsort(self.words(size), kind="stable")[:count]


def random_world(
    height: int = 20,
    width: int = 20,
    pattern: ThreatPattern | None = None,
    *,
    obstacles: float = 0.25,
    threats: float = 0.25,
) -> World:
    """A random world of the paper's experiments: exactly `round(ratio * H * W)` obstacles, and dangerous cells.

    Obstacles are random cells (they may disconnect the map); then the threats of `pattern` are placed on free cells.
    Both ratios are of *all* cells, as in the paper.

    Args:
        height, width: H, W.
        pattern: None: the paper's 10 contiguous areas.
        obstacles, threats: ratios.

    Raises:
        WorldError: invalid sizes, ratios or pattern.

    Source: paper, section 5; SPEC section 8.
    """
    pattern = ThreatPattern() if pattern is None else pattern
    _check_size(height, width)
    for name, ratio in (("obstacles", obstacles), ("threats", threats)):
        FRACTION.check(name, ratio, WorldError, "generate")
    blocked, dangerous = round(obstacles * height * width), round(threats * height * width)
    if blocked + dangerous > height * width or blocked == height * width:
        raise WorldError(
            f"{blocked} obstacles and {dangerous} threats of {height * width} cells",
            source="generate",
            expected="a free cell at least, and room for all threats",
        )
    check_pattern(pattern)
    free = np.ones(height * width, dtype=bool)
    # A separate stream: the same obstacles for contiguous and scattered threats.
    free[Stream(pattern.seed, OBSTACLES).sample(blocked, height * width)] = False
    threat = random_threats(free.reshape(height, width), dangerous, pattern)
    name = f"{pattern.kind}-{height}x{width}-seed{pattern.seed}"
    return World.create(np.where(free.reshape(height, width), threat, np.nan), source=name)


def random_threats(free: NDArray[np.bool_], count: int, pattern: ThreatPattern) -> NDArray[np.float32]:
    """Random dangerous cells on the free cells.

    Contiguous: `pattern.areas` areas of equal size (up to one cell), levels in turn, each grown from a random seed cell
    by a random frontier cell. An area keeps apart from others of its level (not 4-adjacent) and starts where it fits in
    one piece. If no place is large enough, it continues from another seed cell when enclosed; if no cells are left, it
    may touch areas of its level. Scattered: random free cells, levels in turn. Cost: O(areas * H * W + count).

    Args:
        free: bool `[H, W]`.
        count: dangerous cells.
        pattern: the layout.

    Returns:
        float32 `[H, W]`, 0 in other cells.

    Raises:
        WorldError: `count` exceeds the free cells, or the pattern is invalid.
    """
    check_pattern(pattern)
    cells = np.flatnonzero(free)
    if not 0 <= count <= len(cells):
        raise WorldError(
            f"{count} dangerous cells on {len(cells)} free ones", source="generate", fix="lower the threat ratio"
        )
    if pattern.kind == "contiguous" and pattern.areas > most_areas(free.size):
        raise WorldError(
            f"{pattern.areas} areas on {free.size} cells", source="generate", expected=f"1..{most_areas(free.size)}"
        )
    threat = np.zeros(free.size, dtype=np.float32)
    levels = np.array(pattern.levels, dtype=np.float32)
    if pattern.kind == "scattered":
        chosen = cells[Stream(pattern.seed, SCATTERED).sample(count, len(cells))]
        threat[chosen] = levels[np.arange(count) % len(levels)]
        return threat.reshape(free.shape)
    stream = Stream(pattern.seed, CONTIGUOUS)
    taken = np.full(free.shape, -1, dtype=np.int64)
    for area in range(min(pattern.areas, count)):
        size = count // pattern.areas + (area < count % pattern.areas)
        grown = _grow(size, area % len(levels), taken, free, stream)
        taken.reshape(-1)[grown] = area % len(levels)
        threat[grown] = levels[area % len(levels)]
    return threat.reshape(free.shape)


def _grow(size: int, level: int, taken: NDArray[np.int64], free: NDArray[np.bool_], stream: Stream) -> list[int]:
    """Cells of one area, `size` of them; `taken` `[H, W]` holds the level index of earlier areas, -1 elsewhere."""
    same, untaken = taken == level, free & (taken < 0)
    touching = np.zeros_like(same)
    for one, other in ((touching, same), (touching.T, same.T)):
        one[1:] |= other[:-1]
        one[:-1] |= other[1:]
    grown: list[int] = []
    # First apart from areas of the same level, which would merge with this one; then anywhere.
    for open_cells in (untaken & ~touching, untaken):
        if len(grown) < size:
            _spread(grown, size, open_cells, stream)
    return grown


def _spread(grown: list[int], size: int, open_cells: NDArray[np.bool_], stream: Stream) -> None:
    """Grow `grown` over the open cells `[H, W]` up to `size` cells, with a new seed cell whenever it is enclosed."""
    width = open_cells.shape[1] + 1
    closed = np.zeros((len(open_cells) + 2, width), dtype=np.bool_)  # a closed border: no edge tests below
    closed[1:-1, :-1] = open_cells
    available = bytearray(closed.tobytes())
    seeds = [cell + width + cell // (width - 1) for cell in _roomy(open_cells, size - len(grown)).tolist()]
    frontier: list[int] = []

    def reach(cell: int) -> None:
        for near in (cell - width, cell - 1, cell + 1, cell + width):
            if available[near] == 1:
                available[near] = 2  # in the frontier
                frontier.append(near)

    for cell in grown:
        padded = cell + width + cell // (width - 1)
        available[padded] = 0
        reach(padded)
    while len(grown) < size and (frontier or seeds):
        cell = _take(frontier or seeds, stream)
        if available[cell]:
            available[cell] = 0
            row, col = divmod(cell, width)
            grown.append((row - 1) * (width - 1) + col)
            reach(cell)


def _roomy(open_cells: NDArray[np.bool_], size: int) -> NDArray[np.int64]:
    """Open cells from which an area of `size` cells can grow in one piece, or all of them if there are none; int64."""
    labels, _ = ndimage.label(open_cells, structure=FOUR_NEIGHBOURS)
    fits = (np.bincount(labels.reshape(-1)) >= size)[labels] & open_cells
    return np.flatnonzero(fits if fits.any() else open_cells)


def _take(cells: list[int], stream: Stream) -> int:
    """Remove a random element, in constant time."""
    index = stream.below(len(cells))
    cells[index], cells[-1] = cells[-1], cells[index]
    return cells.pop()


def check_pattern(pattern: ThreatPattern) -> None:
    """Check a pattern.

    Raises:
        WorldError: kind, areas, levels or seed are invalid.
    """
    check_word("kind", pattern.kind, ("contiguous", "scattered"), WorldError, "generate")
    whole(1, MAX_CELLS).check("areas", pattern.areas, WorldError, "generate")
    if not pattern.levels or not all(map(LEVEL.accepts, pattern.levels)):
        raise WorldError(f"levels are {pattern.levels}", source="generate", expected=LEVEL.expected)
    SEED.check("seed", pattern.seed, WorldError, "generate")


def most_areas(cells: int) -> int:
    """Most contiguous areas on a map: one per cell, and at least the default."""
    return max(cells, ThreatPattern.areas)


def _check_size(height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise WorldError(f"size is {height} x {width}", source="generate", expected="at least 1 x 1")
    if height * width > MAX_CELLS:
        raise WorldError(f"{height} x {width} cells", source="generate", expected=f"at most {MAX_CELLS}")
