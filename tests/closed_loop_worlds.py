"""The worlds on which closed-loop engines are compared: some 220, of many kinds, in few compiled shapes.

Everything is drawn with Threefry (`planner.world.generate.Stream`) from numbers written here, so that the set is the
same everywhere; a test pins its hash. Axis letters: `K` robots.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.loop import ClosedLoop
from planner.settings import Settings
from planner.simulator.codes import NO_ROBOT
from planner.world.generate import PAPER_LEVELS, Stream, ThreatPattern, random_threats, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

CELL_BUCKETS = (64, 160, 448)
ROBOT_BUCKETS = (4, 8, 20)
"""Places for accessible cells (one of them stays free) and for robots; a pair of them is a compiled shape."""
PURPOSE = 1000
"""First purpose of the streams drawn here: no generated world uses it."""
FAINT = (0.002, 0.005, 0.01)
MILD = (0.01, 0.02, 0.04, 0.08)
HARSH = (0.1, 0.2, 0.3, 0.45)
STRENGTHS = (PAPER_LEVELS, MILD, FAINT, PAPER_LEVELS, HARSH)

Draft = tuple[NDArray, NDArray[np.int64] | None]
"""The threat array `[H, W]` of a world, and its starts `[K, 2]` or None for the rule `upper-left`."""
Drafter = Callable[[int, int, Stream], Draft]
"""`drafter(number within its kind, robots, stream)`."""


@dataclass(frozen=True, eq=False)
class SurveyWorld:
    """One world of the survey, and how it is planned and rolled out.

    Attributes:
        name: unique; kind: one of `KINDS`.
        world: the map. starts: int64 `[K, 2]`. settings: the planner's.
        first_only: `threat_checks="first_visit"`. seed: of its rollouts.
    """

    name: str
    kind: str
    world: World
    starts: NDArray[np.int64]
    settings: Settings
    first_only: bool
    seed: int

    @property
    def robots(self) -> int:
        """K."""
        return len(self.starts)

    @property
    def accessible(self) -> int:
        """Accessible cells."""
        return int(self.world.accessible(self.starts).sum())

    @property
    def parts(self) -> int:
        """Parts of the map, not reachable from each other, that hold robots."""
        return len(np.unique(self.world.components[tuple(self.starts.T)]))

    def plan(self) -> Plan:
        """Algorithm 1's allocation and the nominal run."""
        return make_plan(self.world, self.starts, self.settings)

    def loop(self, plan: Plan | None = None) -> ClosedLoop:
        """The compiled classical simulator of the plan (None: of its own)."""
        return compile_closed_loop(plan or self.plan(), self.world, first_only=self.first_only)


def idle_at_start(plan: Plan) -> int:
    """Robots that Algorithm 1 gives no area."""
    return len(plan.robots) - sum(area.robot != NO_ROBOT for area in plan.areas)


# --- maps without threats: bool [H, W], True = free ---


def maze(height: int, width: int, stream: Stream, openings: int) -> NDArray[np.bool_]:
    """A perfect maze of `height` x `width` rooms of one cell, grown depth first; then `openings` walls fall."""
    free = np.zeros((2 * height - 1, 2 * width - 1), dtype=np.bool_)
    trail = [(0, 0)]
    free[0, 0] = True
    while trail:
        row, col = trail[-1]
        sides = [(row - 2, col), (row + 2, col), (row, col - 2), (row, col + 2)]
        fresh = [(r, c) for r, c in sides if 0 <= r < free.shape[0] and 0 <= c < free.shape[1] and not free[r, c]]
        if not fresh:
            trail.pop()
            continue
        to = fresh[stream.below(len(fresh))]
        free[to] = free[(row + to[0]) // 2, (col + to[1]) // 2] = True
        trail.append(to)
    walls = np.argwhere(~free & (np.indices(free.shape).sum(axis=0) % 2 == 1))
    for wall in stream.sample(min(openings, len(walls)), len(walls)) if len(walls) else ():
        free[tuple(walls[wall])] = True
    return free


def rooms(height: int, width: int, side: int, stream: Stream) -> NDArray[np.bool_]:
    """Rooms of `side` x `side` cells behind walls of one cell, a door in every piece of wall between two of them."""
    free = np.ones((height, width), dtype=np.bool_)
    free[side :: side + 1] = free[:, side :: side + 1] = False
    for row, col in itertools.product(range(0, height, side + 1), range(0, width, side + 1)):
        if row + side + 1 < height:
            free[row + side, col + stream.below(min(side, width - col))] = True
        if col + side + 1 < width:
            free[row + stream.below(min(side, height - row)), col + side] = True
    return free


def spiral(height: int, width: int) -> NDArray[np.bool_]:
    """One corridor that winds inwards."""
    free = np.zeros((height, width), dtype=np.bool_)
    row, col, down, right, turned = 0, 0, 0, 1, 0
    free[0, 0] = True
    while turned < 2:
        near, far = (row + down, col + right), (row + 2 * down, col + 2 * right)
        inside = 0 <= near[0] < height and 0 <= near[1] < width
        beyond = 0 <= far[0] < height and 0 <= far[1] < width and free[far]
        if inside and not free[near] and not beyond:
            row, col = near
            free[near] = True
            turned = 0
        else:
            down, right, turned = right, -down, turned + 1
    return free


def comb(height: int, width: int, spine: int) -> NDArray[np.bool_]:
    """Teeth of one cell's width, two cells apart, on a spine along row `spine`."""
    free = np.zeros((height, width), dtype=np.bool_)
    free[:, ::2] = True
    free[spine] = True
    return free


# --- threats ---


def threaten(free: NDArray[np.bool_], ratio: float, n: int, seed: int) -> NDArray[np.float32]:
    """Threats on `ratio` of the free cells, contiguous and scattered, strong and weak in turn; obstacles are NaN."""
    kind = "scattered" if n % 3 == 2 else "contiguous"
    pattern = ThreatPattern(kind, min(3 + n % 5, free.size), STRENGTHS[n % len(STRENGTHS)], seed)
    threat = random_threats(free, round(ratio * int(free.sum())), pattern)
    return np.where(free, threat, np.float32(np.nan))


def any_cells(mask: NDArray[np.bool_], count: int, stream: Stream) -> NDArray[np.int64]:
    """`count` random cells of the mask, (row, col), different ones while there are enough."""
    cells = np.argwhere(mask)
    order = stream.sample(len(cells), len(cells))
    return cells[order[np.arange(count) % len(cells)]]


# --- the kinds ---

PAPER_SIZES = ((8, 10), (7, 9), (14, 14), (11, 18), (9, 9), (20, 20), (6, 13), (13, 16), (10, 8), (18, 23))


def _paper(kind: str) -> Drafter:
    def draft(n: int, robots: int, stream: Stream) -> Draft:
        height, width = PAPER_SIZES[n % len(PAPER_SIZES)]
        pattern = ThreatPattern(kind, 3 + n % 8, STRENGTHS[n // 2 % len(STRENGTHS)], 100 + n)  # type: ignore[arg-type]
        return random_world(height, width, pattern, threats=(0.25, 0.1, 0.35)[n % 3]).threat, None

    return draft


def _mazes(n: int, robots: int, stream: Stream) -> Draft:
    height, width = ((4, 6), (6, 5), (7, 9), (3, 10), (9, 10), (5, 5))[n % 6]
    free = maze(height, width, stream, openings=(0, 2, 6)[n % 3])
    return threaten(free, (0.1, 0.2, 0.3)[n // 2 % 3], n, 200 + n), any_cells(free, robots, stream) if n % 2 else None


def _rooms(n: int, robots: int, stream: Stream) -> Draft:
    height, width, side = ((8, 9, 3), (11, 15, 3), (14, 17, 5), (9, 11, 2), (11, 17, 7), (20, 21, 4))[n % 6]
    free = rooms(height, width, side, stream)
    return threaten(free, (0.05, 0.15, 0.3)[n // 2 % 3], n, 300 + n), any_cells(free, robots, stream) if n % 2 else None


def _spirals(n: int, robots: int, stream: Stream) -> Draft:
    free = spiral(*((9, 11), (7, 8), (15, 14), (20, 17))[n % 4])
    return threaten(free, (0.0, 0.1, 0.25)[n % 3], n, 400 + n), any_cells(free, robots, stream) if n % 2 else None


def _combs(n: int, robots: int, stream: Stream) -> Draft:
    height, width, spine = ((6, 15, 0), (9, 13, 4), (11, 21, 10), (5, 19, 2), (16, 25, 7))[n % 5]
    free = comb(height, width, spine)
    return threaten(free, (0.05, 0.15)[n % 2], n, 500 + n), any_cells(free, robots, stream) if n % 3 else None


def _crossings(n: int, robots: int, stream: Stream) -> Draft:
    """Open halls of hardly dangerous cells, crossed by safe corridors: the ways to the next area cut up the others'."""
    height, width, every = ((7, 9, 4), (10, 14, 5), (9, 16, 8), (17, 25, 6))[n % 4]
    threat = np.full((height, width), (0.003, 0.01, 0.0)[n % 3], dtype=np.float32)
    threat[every // 2 :: every] = threat[:, every // 2 :: every] = (0.0, 0.004, 0.002)[n % 3]
    return threat, any_cells(threat < 1, robots, stream)


def _strips(n: int, robots: int, stream: Stream) -> Draft:
    """Long and narrow, one row or column included."""
    height, width = ((1, 30), (40, 1), (2, 60), (60, 3), (3, 50), (5, 80), (1, 159), (4, 16))[n % 8]
    free = np.ones((height, width), dtype=np.bool_)
    if min(height, width) > 2:
        free[tuple(any_cells(free, height * width // 6, stream).T)] = False
    return threaten(free, (0.1, 0.25, 0.02)[n % 3], n, 600 + n), any_cells(free, robots, stream) if n % 2 else None


def _disconnected(n: int, robots: int, stream: Stream) -> Draft:
    """Two or three parts with robots, and parts that nobody reaches."""
    height, width = ((6, 10), (8, 18), (12, 15), (5, 13), (16, 22))[n % 5]
    free = random_world(height, width, ThreatPattern(seed=700 + n), obstacles=(0.1, 0.2)[n % 2], threats=0).free.copy()
    walls = ((width // 3,), (width // 3, 2 * width // 3))[n // 2 % 2]
    free[:, list(walls)] = False
    cuts = (0, *walls, width)
    columns = np.arange(width)
    halves = [free & (columns >= cuts[i]) & (columns < cuts[i + 1]) for i in range(len(cuts) - 1)]
    starts = np.stack([any_cells(halves[robot % len(halves)], 1, stream)[0] for robot in range(robots)])
    return threaten(free, (0.25, 0.4, 0.1)[n % 3], n + n // 5, 700 + n), starts


def _shared(n: int, robots: int, stream: Stream) -> Draft:
    """All robots start in one cell, or in two."""
    free = random_world(*PAPER_SIZES[n % len(PAPER_SIZES)], ThreatPattern(seed=800 + n), threats=0).free
    parts = World.create(np.where(free, 0.0, np.nan)).components
    largest = parts == 1 + np.argmax(np.bincount(parts[parts > 0])[1:])
    starts = any_cells(largest, 1 + n % 2, stream)
    return threaten(free, (0.2, 0.3)[n // 2 % 2], n, 800 + n), starts[np.arange(robots) % len(starts)]


def _threatened(n: int, robots: int, stream: Stream) -> Draft:
    """Every robot starts on a threat; the first ones share it."""
    height, width = ((6, 9), (10, 12), (14, 20), (7, 8))[n % 4]
    free = random_world(height, width, ThreatPattern(seed=900 + n), obstacles=0.15, threats=0).free
    threat = threaten(free, (0.3, 0.5)[n % 2], n + 1, 900 + n)
    starts = any_cells(threat > 0, robots, stream)
    starts[: 1 + n % 3] = starts[0]
    return threat, starts


def _safe(n: int, robots: int, stream: Stream) -> Draft:
    """No threats at all."""
    free = (
        np.ones(((5, 9), (1, 40), (8, 8))[n // 4 % 3], dtype=np.bool_),
        maze(5, 7, stream, 3),
        rooms(11, 15, 3, stream),
        random_world(12, 16, ThreatPattern(seed=1000 + n), threats=0).free,
    )[n % 4]
    return np.where(free, 0.0, np.nan), any_cells(free, robots, stream) if n % 2 else None


def _one_cell(n: int, robots: int, stream: Stream) -> Draft:
    """One accessible cell: the whole map, or closed in among others."""
    threat = np.full(((1, 1), (3, 3), (1, 3))[n // 2 % 3], np.nan)
    middle = (threat.shape[0] // 2, threat.shape[1] // 2)
    if threat.shape == (3, 3):
        threat[0, :] = 0.1
        threat[1, 1] = np.nan
        middle = (2, 2)
    threat[middle] = (0.0, 0.5, 0.9)[n % 3]
    return threat, np.array([middle] * robots)


def _crowded(n: int, robots: int, stream: Stream) -> Draft:
    """More robots than cells, all in one to three of them."""
    height, width = ((1, 2), (2, 2), (1, 5), (3, 3), (2, 4), (1, 7))[n % 6]
    free = np.ones((height, width), dtype=np.bool_)
    if (height, width) == (3, 3):
        free[1, 1] = False
    threat = threaten(free, (0.5, 0.25, 0.0)[n % 3], n, 1100 + n)
    starts = any_cells(free, 1 + n % 3, stream)
    return threat if n % 4 != 3 else np.where(free, 0.9, np.nan), starts[np.arange(robots) % len(starts)]


def _deadly(n: int, robots: int, stream: Stream) -> Draft:
    """No safe cell: nobody has an area at the start."""
    shape = ((2, 3), (5, 6), (8, 11), (12, 12))[n % 4]
    free = np.ones(shape, dtype=np.bool_)
    threat = threaten(free, 1.0, n, 1200 + n)
    return np.maximum(threat, np.float32((0.3, 0.05, 0.01)[n % 3])), any_cells(free, robots, stream) if n % 2 else None


def _many_levels(n: int, robots: int, stream: Stream) -> Draft:
    """A threat of its own for every cell of a slope: quantised for planning."""
    height, width = ((6, 9), (11, 13), (14, 18))[n % 3]
    rows, cols = np.indices((height, width))
    threat = np.maximum(0.0, (rows * width + 3 * cols - height * width / 3) / (height * width * 15))
    return threat.astype(np.float32), any_cells(threat >= 0, robots, stream) if n % 2 else None


def _extreme(n: int, robots: int, stream: Stream) -> Draft:
    """Threats a million times each other, almost certain ones, or so faint that costs need 64 bits."""
    free = random_world(7, 10, ThreatPattern(seed=1300 + n), obstacles=0.1, threats=0).free
    levels = ((1e-6, 0.9), (1e-7, 2e-7, 0.5), (0.999, 0.9999), (1e-5, 0.3, 0.99))[n % 4]
    pattern = ThreatPattern("scattered" if n % 2 else "contiguous", 6, levels, 1300 + n)
    threat = random_threats(free, round(0.5 * int(free.sum())), pattern)
    return np.where(free, threat, np.nan), None


def _short(n: int, robots: int, stream: Stream) -> Draft:
    """Ends at a small `max_steps`; the safe row is completed at that very step."""
    if n == 3:
        return np.zeros((1, LIMITS[n] + 1)), np.array([[0, 0]])
    return random_world(*((9, 12), (6, 8), (14, 16))[n % 3], ThreatPattern(seed=1400 + n), threats=0.1).threat, None


LIMITS = (1, 9, 25, 4, 40, 15)
"""`max_steps` of each world of the kind "short"."""
KINDS: dict[str, tuple[Drafter, tuple[int, ...]]] = {
    "contiguous": (_paper("contiguous"), (1, 4, 8, 2, 16, 8, 3, 5, 6, 7, 2, 9, 4, 20, 1, 4, 12, 7, 3, 10)),
    "scattered": (_paper("scattered"), (2, 1, 4, 8, 3, 1, 6, 11, 4, 5, 8, 13, 2, 7, 18, 6, 3, 20, 14, 2)),
    "mazes": (_mazes, (1, 3, 4, 8, 6, 2, 2, 7, 12, 4, 3, 5, 20, 1, 8, 15)),
    "rooms": (_rooms, (2, 4, 8, 1, 3, 7, 6, 19, 2, 5, 4, 4, 8, 12, 16, 3)),
    "spirals": (_spirals, (1, 4, 3, 8, 2, 6, 10, 7)),
    "combs": (_combs, (2, 4, 8, 3, 6, 1, 7, 12, 4, 5, 20, 8)),
    "crossings": (_crossings, (3, 4, 8, 6, 2, 7, 4, 8, 12, 20, 3, 5)),
    "strips": (_strips, (1, 3, 4, 8, 2, 6, 5, 20, 4, 2, 7, 9, 3, 8, 17, 4)),
    "disconnected": (_disconnected, (2, 4, 3, 8, 6, 3, 5, 7, 2, 12, 4, 20, 8, 9, 16, 6)),
    "shared": (_shared, (2, 4, 8, 3, 6, 7, 12, 20, 5, 4, 2, 8)),
    "threatened": (_threatened, (1, 4, 8, 2, 3, 6, 7, 12, 5, 4, 20, 14)),
    "safe": (_safe, (1, 4, 3, 8, 2, 6, 12, 7, 20, 5, 4, 1)),
    "one-cell": (_one_cell, (1, 2, 1, 5, 3, 20)),
    "crowded": (_crowded, (3, 6, 8, 20, 12, 9, 4, 5, 18, 11, 15, 10)),
    "deadly": (_deadly, (1, 2, 8, 4, 3, 5, 12, 6, 20, 7)),
    "many-levels": (_many_levels, (1, 4, 6, 8, 3, 12, 2, 7)),
    "extreme": (_extreme, (2, 3, 8, 4, 1, 6, 12, 7)),
    "short": (_short, (1, 3, 6, 1, 8, 12)),
}
"""What each kind is drafted by, and the robots of each of its worlds."""
MEMBERS = [(kind, n) for kind, (_, teams) in KINDS.items() for n in range(len(teams))]
"""All worlds, kind by kind."""


@cache
def survey_worlds() -> tuple[SurveyWorld, ...]:
    """All worlds, kind by kind."""
    return tuple(_build(number) for number in range(len(MEMBERS)))


def survey_world(name: str) -> SurveyWorld:
    """The one of this name: its kind, and its number among them."""
    kind, n = name.rsplit("-", 1)
    return _build(MEMBERS.index((kind, int(n))))


def first_worlds(count: int, cells: int = CELL_BUCKETS[1], robots: int = ROBOT_BUCKETS[1]) -> list[SurveyWorld]:
    """One world of each kind, then another, ...: `count` of at most so many accessible cells and robots."""
    fitting = [one for one in survey_worlds() if one.accessible < cells and one.robots <= robots]
    by_kind: list[list[SurveyWorld]] = []
    for number, kind in enumerate(KINDS):
        of_kind = [one for one in fitting if one.kind == kind]
        turn = number % max(1, len(of_kind))  # not everywhere the first: teams and settings differ
        by_kind.append(of_kind[turn:] + of_kind[:turn])
    in_turn = [one for turn in itertools.zip_longest(*by_kind) for one in turn if one is not None]
    return in_turn[:count]


def _build(number: int) -> SurveyWorld:
    """World `number` of all, with the settings that its number gives it."""
    kind, n = MEMBERS[number]
    drafter, teams = KINDS[kind]
    name = f"{kind}-{n}"
    threat, starts = drafter(n, teams[n], Stream(n, PURPOSE + list(KINDS).index(kind)))
    world = World.create(threat, source=name)
    settings = Settings(
        levels=(16, 16, 16, 2, 16, 3, 6)[number % 7],
        density=(4.0, 4.0, 2.0, 1.5, 8.0)[number % 5],
        risk="log" if number % 3 == 1 else "paper",
        max_steps=LIMITS[n] if kind == "short" else None,
    )
    placed = place_starts(world, teams[n])[0] if starts is None else np.asarray(starts, dtype=np.int64)
    return SurveyWorld(name, kind, world, placed, settings, number % 4 == 3, number + (number % 2 << 40))


def walled(walls: int) -> World:
    """A world of 8 x 9, none of the survey, with walls of danger to pass, each entered at a cost of 720 million."""
    threat = np.zeros((8, 9))
    threat[0, 0], threat[:, [1, 3, 5, 7][:walls]] = 72 * 0.5 / 7.2e8, 0.5
    return World.create(threat)


def limited(loop: ClosedLoop, nearby: int, wide: int, patience: int) -> ClosedLoop:
    """The loop with other ways to find distances."""
    return replace(loop, tables=loop.tables._replace(nearby=nearby, wide=wide, patience=patience))
