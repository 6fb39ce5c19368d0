"""Small missions by everything that can happen: a robot among movers, the best strategy, a team in one row."""

import itertools
from collections import Counter
from dataclasses import dataclass, field
from math import inf

import numpy as np

from planner.world.world import World

# One robot on a given path among movers, by every way that things can go: plain Python, no engine, no theory.
#
# A history is where every mover is and which cells the robot has visited and survived; each step multiplies it. The
# rules are those of docs/spec.md, section 16, read anew. Chances are floats, maps lists of rows with None for
# obstacles.

Cell = tuple[int, int]


@dataclass(frozen=True)
class Threat:
    """A mover: h, and how it goes. start: a cell, or None: anywhere."""

    h: float
    stay: float = 0.0
    start: Cell | None = None
    route: tuple[Cell, ...] = ()


def beside(grid: list[list[float | None]], cell: Cell) -> list[Cell]:
    row, col = cell
    places = [(row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col)]
    return [(r, c) for r, c in places if 0 <= r < len(grid) and 0 <= c < len(grid[0]) and grid[r][c] is not None]


def begins(grid: list[list[float | None]], threat: Threat) -> list[tuple[int | Cell, float]]:
    """Where it may be before it first moves: (place on its route, or cell; chance)."""
    if threat.route:
        places = [i for i, cell in enumerate(threat.route) if threat.start in (None, cell)]
        places = places if threat.start is None else places[:1]
        return [(place, 1 / len(places)) for place in places]
    if threat.start is not None:
        return [(threat.start, 1.0)]
    free = [(r, c) for r, line in enumerate(grid) for c, p in enumerate(line) if p is not None]
    weight = {cell: max(len(beside(grid, cell)), 1) for cell in free}
    return [(cell, weight[cell] / sum(weight.values())) for cell in free]


def goes(grid: list[list[float | None]], threat: Threat, place: int | Cell) -> list[tuple[int | Cell, float]]:
    if threat.route:
        return [((place + 1) % len(threat.route), 1.0)]
    ways = beside(grid, place)
    if not ways:
        return [(place, 1.0)]
    return [(place, threat.stay), *((way, (1 - threat.stay) / len(ways)) for way in ways)]


def outcomes(grid: list[list[float | None]], path: list[Cell], threats: list[Threat]) -> tuple[float, float, float]:
    """(expected cells visited, survived, chance to be alive at the end); it stands still where a cell comes twice."""
    visited = survived = alive = 0.0
    firsts = [list(begins(grid, threat)) for threat in threats]
    for start in itertools.product(*firsts):
        weight = 1.0
        for _, chance in start:
            weight *= chance
        stack = [(0, tuple(place for place, _ in start), weight)]
        while stack:
            step, places, weight = stack.pop()
            cell = path[step]
            seen = set(path[: step + 1])
            moves = step == 0 or cell != path[step - 1]
            p = grid[cell[0]][cell[1]] if moves else 0.0
            before = set(path[:step])
            visited += weight * p * len(seen)
            survived += weight * p * len(before)
            for after in itertools.product(*(goes(grid, t, at) for t, at in zip(threats, places, strict=True))):
                share, passes = weight * (1 - p), 1.0
                for _, chance in after:
                    share *= chance
                there = [t.route[at] if t.route else at for t, (at, _) in zip(threats, after, strict=True)]
                for threat, at in zip(threats, there, strict=True):
                    passes *= 1 - threat.h if at == cell else 1.0
                visited += share * (1 - passes) * len(seen)
                survived += share * (1 - passes) * len(before)
                if step + 1 < len(path):
                    stack.append((step + 1, tuple(at for at, _ in after), share * passes))
                else:
                    visited += share * passes * len(seen)
                    survived += share * passes * len(seen)
                    alive += share * passes
    return visited, survived, alive


# The best strategy of one robot, by iteration over (where it is, what it has visited): no search, no state joined.
#
# Of a robot that comes home, over the moves that it has left too: it goes nowhere from where it could not come home.


def best_of_one_robot(world: World) -> float:
    """The most that a robot from [0, 0] can cover on average, however it decides: value, or cells where none has it."""
    width, count = world.shape[1], world.threat.size
    passed = 1.0 - np.nan_to_num(world.threat.ravel(), nan=1.0).astype(float)
    value = np.ones(count) if world.value is None else world.value.ravel()
    places = np.argwhere(world.free)
    moves = [(a, b) for a in places for b in places if np.abs(a - b).sum() == 1]
    best, masks = np.zeros((count, 2**count)), np.arange(2**count)
    while True:
        new = np.zeros_like(best)
        for here, there in np.array(moves).reshape(-1, 2, 2) @ (width, 1):
            gained = np.where(masks >> there & 1, 0.0, value[there])
            new[here] = np.maximum(new[here], gained + passed[there] * best[there][masks | 1 << there])
        if np.abs(new - best).max() < 1e-12:
            return float(value[0] + passed[0] * best[0, 1])
        best = new


def best_that_comes_home(
    world: World, moves: int, bases: list[tuple[int, int]], charged: bool
) -> tuple[float, set[tuple[int, int]]]:
    """(cells, those that can be visited) of a robot from [0, 0] with so many moves, that always can come to a base.

    `charged`: at a base it has all its moves again. States are dictionaries, (cell, visited, moves left): value.
    """
    threat = world.threat.astype(float)
    free = {tuple(cell) for cell in np.argwhere(world.free).tolist()}
    ways = {(r, c): [n for n in ((r - 1, c), (r, c - 1), (r, c + 1), (r + 1, c)) if n in free] for r, c in free}
    back, edge = dict.fromkeys(bases, 0), list(bases)
    for cell in edge:
        for near in ways.get(cell, []):
            if near not in back:
                back[near] = back[cell] + 1
                edge.append(near)

    def left_at(cell: tuple[int, int], left: int) -> int:
        return moves if charged and cell in bases else left

    first = ((0, 0), frozenset([(0, 0)]), moves)
    follows: dict[tuple, list[tuple]] = {}
    due = [first]
    while due:
        state = due.pop()
        if state in follows:
            continue
        cell, visited, left = state
        nexts = [near for near in ways[cell] if back.get(near, moves + 1) <= left - 1]
        follows[state] = [(near, visited | {near}, left_at(near, left - 1)) for near in nexts]
        due += follows[state]
    best = dict.fromkeys(follows, 0.0)
    while True:
        change = 0.0
        for (cell, visited, left), after in follows.items():
            value = max(
                ((there[0] not in visited) + (1 - threat[there[0]]) * best[there] for there in after), default=0.0
            )
            change = max(change, value - best[cell, visited, left])
            best[cell, visited, left] = value
        if change < 1e-12:
            seen = set().union(*(visited for _, visited, _ in follows))
            return 1 + (1 - float(threat[0, 0])) * best[first], seen


# The closed loop on a map of one row, by plain lists: all that can happen to a team whose robots differ, enumerated.
#
# Written from the text of docs/spec.md for the rule `mrac` with a density so large that no area has two robots at
# first. It shares no code with the simulators.

NOBODY = -1


@dataclass
class Area:
    level: int
    cells: list[int]
    owner: int = NOBODY
    done: bool = False


@dataclass
class Robot:
    cell: int
    doing: str = "idle"
    area: int = NOBODY
    path: list[int] = field(default_factory=list)


class Script(Exception):
    """A dangerous visit that is not decided yet."""


class Row:
    """One run. `p[i][c]`: what stops robot i in cell c; `turn[i]`: steps a move; `radio`: how far robots hear."""

    def __init__(
        self, p: list[list[float]], starts: list[int], turn: list[int], radio: float, wrecks: bool, stops: list[bool]
    ) -> None:
        self.wrecks, self.blocked = wrecks, set[int]()
        self.p, self.turn, self.radio, self.stops, self.bases = p, turn, radio, stops, starts
        self.chance, self.asked, self.size = 1.0, 0, len(p[0])
        scale = sorted({x for row in p for x in row if x > 0})
        self.own = [[0 if x == 0 else 1 + scale.index(x) for x in row] for row in p]
        self.cost = [[1 if x == 0 else int(self.size * x / scale[0] + 0.5) for x in row] for row in p]
        kinds = list(dict.fromkeys(map(tuple, self.own)))
        mixes = sorted({tuple(kind[c] for kind in kinds) for c in range(self.size)} | {(0,) * len(kinds)})
        values = [0.0, *scale]
        share = [sum(tuple(mine) == kind for mine in self.own) / len(p) for kind in kinds]
        mixes.sort(key=lambda mix: sum(of * values[level] for of, level in zip(share, mix, strict=True)))
        self.of_cell = of_cell = [mixes.index(tuple(kind[c] for kind in kinds)) for c in range(self.size)]
        runs = self.runs(list(range(self.size)))
        self.areas = [Area(level, run) for level in range(len(mixes)) for run in runs if of_cell[run[0]] == level]
        self.mixes, self.kind = mixes, [kinds.index(tuple(mine)) for mine in self.own]
        self.robots = [Robot(cell) for cell in starts]
        self.visited: set[int] = set()
        self.survived: set[int] = set()
        for i in range(len(starts)):  # at most one robot an area: the density sees to that
            free = [n for n, area in enumerate(self.areas) if area.level == 0 and area.owner == NOBODY]
            if free:
                self.give(i, min(free, key=lambda n: (self.way(i, self.areas[n].cells)[0], n)))

    def runs(self, cells: list[int]) -> list[list[int]]:
        """The cells, increasing, as neighbours of one level."""
        found: list[list[int]] = []
        for c in cells:
            if found and found[-1][-1] == c - 1 and self.of_cell[c] == self.of_cell[c - 1]:
                found[-1].append(c)
            else:
                found.append([c])
        return found

    def to(self, i: int, cell: int) -> list[int]:
        here = self.robots[i].cell
        return list(range(here + 1, cell + 1)) if cell > here else list(range(here - 1, cell - 1, -1))

    def way(self, i: int, cells: list[int]) -> tuple[int, int]:
        """(cost, cell) of the cheapest cell that no wreck cuts off."""
        ways = ((self.to(i, cell), cell) for cell in cells)
        costs = ((sum(self.cost[i][c] for c in way), cell) for way, cell in ways if not self.blocked & {*way})
        return min(costs, default=(inf, NOBODY))  # type: ignore[return-value]

    def level(self, i: int, n: int) -> int:
        return self.mixes[self.areas[n].level][self.kind[i]]

    def left(self, n: int) -> list[int]:
        return [c for c in self.areas[n].cells if c not in self.visited]

    def give(self, i: int, n: int) -> None:
        self.areas[n].owner = i
        self.robots[i].area, self.robots[i].doing = n, "travel"
        self.robots[i].path = self.to(i, self.way(i, self.areas[n].cells)[1])

    def heard(self, i: int) -> bool:
        """Whether the robot is within reach of a base, by way of others that are alive."""
        near = {j for j, other in enumerate(self.robots) if other.doing != "dead"}
        known = {j for j in near if any(abs(self.robots[j].cell - base) <= self.radio for base in self.bases)}
        while True:
            more = {
                j for j in near - known
                if any(abs(self.robots[j].cell - self.robots[k].cell) <= self.radio for k in known)
            }  # fmt: skip
            if not more:
                return i in known
            known |= more

    def way_back(self, i: int) -> list[int]:
        """The way to the nearest base of a robot that is out of touch while there are areas that nobody has."""
        if self.heard(i) or all(area.owner != NOBODY or area.done for area in self.areas):
            return []
        ways = [self.to(i, base) for base in self.bases]
        return min(ways, key=lambda way: (sum(self.cost[i][c] for c in way), len(way), way[0]))

    def split(self, n: int) -> list[int]:
        """The parts of what is left of an area, as new areas; it is done."""
        parts, area = self.runs(self.left(n)), self.areas[n]
        area.cells, area.done, area.owner = [c for c in area.cells if c in self.visited], True, NOBODY
        first = len(self.areas)
        self.areas += [Area(area.level, part) for part in parts]
        return list(range(first, len(self.areas)))

    def next_area(self, i: int, idle: bool) -> bool:
        if not self.heard(i):
            return False
        free = [n for n, area in enumerate(self.areas) if area.owner == NOBODY and not area.done]
        free = [n for n in free if self.way(i, self.areas[n].cells)[0] < inf]
        if free:
            self.give(i, min(free, key=lambda n: (self.level(i, n), self.way(i, self.areas[n].cells)[0], n)))
            return True
        return False if idle else self.share(i)

    def share(self, i: int) -> bool:
        found = []
        for j, other in enumerate(self.robots):
            if j == i or other.doing not in ("travel", "cover") or not self.heard(j):
                continue
            left, (cost, cell) = len(self.left(other.area)), self.way(i, self.areas[other.area].cells)
            if cost < inf and left >= 2 and len(self.to(i, cell)) * self.turn[i] <= left * self.turn[j]:
                found.append((self.level(i, other.area), cost, other.area, j))
        if not found:
            return False
        *_, n, j = min(found)
        parts = self.split(n)
        if len(parts) == 1:
            whole = self.areas[parts[0]]
            half = len(whole.cells) // 2
            self.areas.append(Area(whole.level, whole.cells[half:]))
            whole.cells = whole.cells[:half]
            parts.append(len(self.areas) - 1)
        pairs = [(a, b) for a in parts for b in parts if a != b]
        mine, theirs = min(
            pairs,
            key=lambda ab: (self.way(j, self.areas[ab[0]].cells)[0] + self.way(i, self.areas[ab[1]].cells)[0], ab),
        )
        self.give(j, mine)
        self.give(i, theirs)
        return True

    def after_move(self, i: int) -> None:
        """A path at its end goes over into the next one."""
        me = self.robots[i]
        while not me.path and me.doing in ("travel", "cover"):
            if me.doing == "travel":
                me.doing, here, left = "cover", me.cell, self.left(me.area)
                while left:
                    target = self.way(i, left)[1]
                    me.path += self.to(i, target)
                    me.cell = target
                    left.remove(target)
                me.cell = here
            else:
                self.areas[me.area].done = True
                if not self.next_area(i, idle=False):
                    me.doing, me.area = "done", NOBODY

    def enter(self, i: int, cell: int) -> None:
        me = self.robots[i]
        me.cell = cell
        self.visited.add(cell)
        for n, area in enumerate(self.areas):
            area.done |= cell in area.cells and not self.left(n)
        p = self.p[i][cell]
        if p > 0:
            if self.asked == len(self.stops):
                raise Script
            self.chance *= p if self.stops[self.asked] else 1 - p
            self.asked += 1
            if self.stops[self.asked - 1]:
                me.doing = "dead"
                if me.area != NOBODY:
                    self.split(me.area)
                return
        self.survived.add(cell)
        self.after_move(i)

    def block(self) -> bool:
        """Where a lost robot is and no other one, the row has an obstacle; whether the map has changed (section 15)."""
        live = [me for me in self.robots if me.doing != "dead"]
        new = {me.cell for me in self.robots if me.doing == "dead"} - {me.cell for me in live} - self.blocked
        self.blocked |= new
        if not new or not live:
            return False

        def part(cell: int) -> int:
            return sum(wreck < cell for wreck in self.blocked)

        def kept(cells: list[int]) -> list[list[int]]:
            return self.runs([c for c in cells if c not in self.blocked | self.visited and part(c) in near])

        near = {part(me.cell) for me in live}
        for area in [area for area in self.areas if not area.done]:
            if area.owner != NOBODY:
                here = part(self.robots[area.owner].cell)
                area.cells = [c for c in area.cells if c not in new and part(c) == here]
            elif new & {*area.cells} or len({part(c) for c in area.cells}) > 1 or part(area.cells[0]) not in near:
                area.cells, *more = kept(area.cells) or [[]]
                area.done = not area.cells
                self.areas += [Area(area.level, cells) for cells in more]
        held = {c for area in self.areas if not area.done for c in area.cells}
        for cells in kept([c for c in range(self.size) if c not in held]):
            sides = {cells[0] - 1, cells[-1] + 1}
            free = [area for area in self.areas if not area.done and area.owner == NOBODY]
            touched = [area for area in free if area.level == self.of_cell[cells[0]] and sides & {*area.cells}]
            for area in touched[1:]:
                area.done = True
            if touched:
                touched[0].cells = sorted(sum((area.cells for area in touched), cells))
            else:
                self.areas.append(Area(self.of_cell[cells[0]], cells))
        for i, me in enumerate(self.robots):
            if me.doing not in ("travel", "cover"):
                continue
            if me.doing == "cover" or not self.left(me.area):
                me.doing, me.path = "travel", []
            elif self.blocked & {*me.path}:
                me.path = self.to(i, self.way(i, self.areas[me.area].cells)[1])
            self.after_move(i)
        return True

    def run(self) -> tuple[float, str, int, int, int, int]:
        """(chance, outcome, visited, survived, steps, alive)."""
        step = quiet = 0
        while True:
            moved = False
            for i, me in enumerate(self.robots):
                if me.doing == "dead" or step % self.turn[i]:
                    continue
                if step == 0:
                    self.enter(i, me.cell)
                    moved = True
                elif me.doing in ("idle", "done") and self.way_back(i):
                    self.enter(i, self.way_back(i)[0])
                    moved = True
                elif me.doing in ("idle", "done"):
                    if self.next_area(i, idle=True):
                        moved = True
                        self.after_move(i)
                else:
                    self.enter(i, me.path.pop(0))
                    moved = True
            moved |= self.wrecks and self.block()
            quiet = 0 if moved else quiet + 1
            alive = sum(me.doing != "dead" for me in self.robots)
            end = "complete" if len(self.visited) == self.size else "all_robots_lost" if alive == 0 else ""
            if not end and quiet >= 2 * max(self.turn):
                end = "no_progress"
            if end:
                return self.chance, end, len(self.visited), len(self.survived), step, alive
            step += 1


def everything(
    p: list[list[float]], starts: list[int], turn: list[int] | None = None, radio: float = inf, wrecks: bool = False
) -> dict[str, Counter[int | str]]:
    """The chance of each outcome, number of cells visited and survived, of steps, and of robots alive."""
    found: dict[str, Counter[int | str]] = {
        name: Counter() for name in ("outcome", "visited", "survived", "time", "alive")
    }
    due: list[list[bool]] = [[]]
    while due:
        stops = due.pop()
        try:
            chance, *what = Row(p, starts, turn or [1] * len(starts), radio, wrecks, stops).run()
        except Script:
            due += [[*stops, False], [*stops, True]]
            continue
        for counts, value in zip(found.values(), what, strict=True):
            counts[value] += chance  # type: ignore[assignment]
    return found
