"""A closed loop of robots that are not told the map, by the paper's rule, once more: written from docs/spec.md alone.

It shares no code with the simulators: cells are (row, col), sets are sets, every distance is asked for anew. For tiny
worlds; who is stopped is scripted. The allocation at t = 0 is data, as everywhere.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

Cell = tuple[int, int]
WALL = -1


def beside(cell: Cell) -> list[Cell]:
    row, col = cell
    return [(row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col)]


def pieces(cells: Iterable[Cell]) -> list[list[Cell]]:
    """Connected components, each sorted, by lowest cell."""
    left, found = set(cells), []
    while left:
        piece = {min(left)}
        while more := {other for cell in piece for other in beside(cell) if other in left} - piece:
            piece |= more
        left -= piece
        found.append(sorted(piece))
    return found


def crosses(start: Cell, end: Cell, cell: Cell) -> bool:
    """Whether the segment of two centres has a point strictly inside the cell: by a fine walk along it."""
    wide = abs(end[0] - start[0]) + abs(end[1] - start[1])
    # Between two places where the segment meets a grid line it is inside one cell: halfway between such places.
    marks = {0.0, 1.0}
    for axis in (0, 1):
        span = end[axis] - start[axis]
        marks |= {(k + 0.5) / abs(span) for k in range(abs(span))} if span else set()
    places = sorted(marks)
    for a, b in itertools.pairwise(places):
        if b - a > 1e-9 / max(wide, 1):
            at = [start[axis] + (end[axis] - start[axis]) * (a + b) / 2 for axis in (0, 1)]
            if all(abs(at[axis] - cell[axis]) < 0.5 - 1e-9 for axis in (0, 1)):
                return True
    return False


@dataclass
class Patch:
    level: int
    cells: set[Cell]
    owner: int | None = None
    over: bool = False


@dataclass
class Walker:
    at: Cell
    doing: str = "idle"
    patch: int | None = None
    way: list[Cell] = field(default_factory=list)
    todo: set[Cell] = field(default_factory=set)
    path: list[Cell] = field(default_factory=list)


class Twin:
    """One run. `believed`, `true`: p `[H, W]`, NaN = obstacle. `areas`: (level, robot or None, cells) at t = 0."""

    def __init__(
        self, believed: np.ndarray, true: np.ndarray, starts: list[Cell], reach: float, sight: bool,
        areas: list[tuple[int, int | None, list[Cell]]], stopped: Callable[[int, int, Cell], bool],
    ) -> None:  # fmt: skip
        self.reach, self.sight, self.stopped, self.cells = reach, sight, stopped, np.prod(true.shape)
        grid = list(np.ndindex(*true.shape))
        either = {c for c in grid if not math.isnan(believed[c]) or not math.isnan(true[c])}
        near = {c for piece in pieces(either) if set(piece) & set(starts) for c in piece}
        values = sorted({float(m[c]) for m in (believed, true) for c in near if m[c] > 0})
        self.scale = [0.0, *values]

        def level(chance: float) -> int:
            return WALL if math.isnan(chance) else self.scale.index(float(chance)) if chance in self.scale else 0

        self.map = {c: level(believed[c]) for c in grid}
        self.true = {c: level(true[c]) for c in grid}
        self.goal = {c for p in pieces(c for c in grid if self.true[c] != WALL) if set(p) & set(starts) for c in p}
        self.visited: set[Cell] = set()
        self.team = [Walker(start) for start in starts]
        for walker in self.team:
            self.map |= {c: self.true[c] for c in self.seen_from(walker.at)}
        self.patches = [Patch(level, set(cells), robot) for level, robot, cells in areas]
        for number, patch in enumerate(self.patches):
            if patch.owner is not None:
                self.team[patch.owner].patch, self.team[patch.owner].doing = number, "traveling"
        self.step, self.quiet, self.moved = 0, 0, False

    # --- what there is ---

    def seen_from(self, at: Cell) -> set[Cell]:
        found = set()
        for cell in self.true:
            if (cell[0] - at[0]) ** 2 + (cell[1] - at[1]) ** 2 <= self.reach**2:
                walls = [c for c, level in self.true.items() if level == WALL and c not in (at, cell)]
                if not (self.sight and any(crosses(at, cell, wall) for wall in walls)):
                    found.add(cell)
        return found

    def price(self, cell: Cell) -> int:
        level = self.map[cell]
        return 1 if level == 0 else math.floor(self.cells * self.scale[level] / self.scale[1] + 0.5)

    def costs(self, source: Cell) -> dict[Cell, int]:
        cost = {source: 0}
        while True:
            more = {}
            for cell in cost:
                for other in beside(cell):
                    if self.map.get(other, WALL) != WALL:
                        new = cost[cell] + self.price(other)
                        if new < min(cost.get(other, new + 1), more.get(other, new + 1)):
                            more[other] = new
            if not more:
                return cost
            cost |= more

    def way(self, source: Cell, target: Cell) -> list[Cell]:
        cost, back = self.costs(source), [target]
        while back[-1] != source:
            here = back[-1]
            back.append(next(c for c in beside(here) if cost.get(c, -1) == cost[here] - self.price(here)))
        return back[-2::-1]

    def open(self) -> list[int]:
        return [n for n, patch in enumerate(self.patches) if patch.owner is None and not patch.over]

    def left(self, number: int) -> set[Cell]:
        return self.patches[number].cells - self.visited

    # --- Algorithm 2 ---

    def run(self) -> str:
        while True:
            self.moved = False
            for number, walker in enumerate(self.team):
                self.turn(number, walker)
            self.look_about()
            self.quiet = 0 if self.moved else self.quiet + 1
            if ended := self.ended():
                return ended
            self.step += 1

    def ended(self) -> str:
        """How the run ends after this step; "": it goes on."""
        if self.goal <= self.visited:
            return "complete"
        if all(walker.doing == "dead" for walker in self.team):
            return "all_robots_lost"
        return "no_progress" if self.quiet >= 2 else ""

    def affords(self, walker: Walker, target: Cell) -> bool:
        """Whether the area of this target is there for the walker."""
        return True

    def turn(self, number: int, walker: Walker) -> None:
        if self.step == 0:
            self.enter(number, walker, walker.at)
            if walker.doing != "dead" and walker.patch is not None:
                self.set_out(walker)
                self.settle(number, walker)
        elif walker.doing in ("idle", "done"):
            if self.allocate(number, walker, share=False):
                self.settle(number, walker)
            walker.path.append(walker.at)
        elif walker.doing != "dead":
            self.enter(number, walker, walker.way.pop(0))
            if walker.doing != "dead":
                self.settle(number, walker)

    def enter(self, number: int, walker: Walker, cell: Cell) -> None:
        walker.at, self.moved = cell, True
        walker.path.append(cell)
        walker.todo.discard(cell)
        self.visited.add(cell)
        for patch in self.patches:
            if cell in patch.cells and not patch.cells - self.visited:
                patch.over = True
        if self.stopped(number, self.step, cell):
            walker.doing = "dead"
            if walker.patch is not None:
                self.replace(walker.patch, pieces(self.left(walker.patch)))

    def replace(self, number: int, parts: list[list[Cell]]) -> list[int]:
        """The parts become patches of their own; the patch keeps what is visited."""
        patch = self.patches[number]
        patch.cells &= self.visited
        patch.over = True
        self.patches += [Patch(patch.level, set(part)) for part in parts]
        return list(range(len(self.patches) - len(parts), len(self.patches)))

    def settle(self, number: int, walker: Walker) -> None:
        while not walker.way:
            if walker.doing == "traveling":
                walker.doing, walker.todo = "covering", self.left(walker.patch)
                self.cover(walker, walker.at)
            elif walker.doing == "covering":
                self.patches[walker.patch].over = True
                self.allocate(number, walker, share=True)
            else:
                return

    def cover(self, walker: Walker, here: Cell) -> None:
        """Legs to the cheapest of what is to do, one after the other."""
        todo = walker.todo - {here}
        while todo:
            cost = self.costs(here)
            target = min(todo, key=lambda cell: (cost[cell], cell))
            walker.way += self.way(here, target)
            todo, here = todo - {target}, target

    def nearest(self, here: Cell, number: int) -> tuple[int, Cell] | None:
        cost = self.costs(here)
        return min(((cost[c], c) for c in self.patches[number].cells if c in cost), default=None)

    def set_out(self, walker: Walker) -> None:
        _, target = self.nearest(walker.at, walker.patch)
        walker.way, walker.doing = self.way(walker.at, target), "traveling"

    def allocate(self, number: int, walker: Walker, *, share: bool) -> bool:
        seen = [(n, at) for n in self.open() if (at := self.nearest(walker.at, n))]
        found = [(self.patches[n].level, at[0], n) for n, at in seen if self.affords(walker, at[1])]
        if found:
            walker.patch = min(found)[2]
            self.patches[walker.patch].owner = number
            self.set_out(walker)
            self.moved = True
            return True
        if share and self.share(number, walker):
            return True
        if share:
            walker.doing, walker.patch, walker.way = "done", None, []
        return False

    def share(self, number: int, walker: Walker) -> bool:
        found = []
        for other, owner in enumerate(self.team):
            if other != number and owner.doing in ("traveling", "covering") and len(self.left(owner.patch)) >= 2:
                at = self.nearest(walker.at, owner.patch)
                near = at and len(self.way(walker.at, at[1])) <= len(self.left(owner.patch))
                if near and self.affords(walker, at[1]):
                    found.append((self.patches[owner.patch].level, at[0], owner.patch, other))
        if not found:
            return False
        *_, patch, other = min(found)
        parts = pieces(self.left(patch))
        new = self.replace(patch, sorted(halves(parts[0])) if len(parts) == 1 else parts)
        owner = self.team[other]
        pairs = [
            (self.nearest(owner.at, a)[0] + self.nearest(walker.at, b)[0], a, b) for a in new for b in new if a != b
        ]
        for who, robot, part in ((owner, other, min(pairs)[1]), (walker, number, min(pairs)[2])):
            who.patch, self.patches[part].owner = part, robot
            self.set_out(who)
        self.moved = True
        return True

    # --- section 15 ---

    def look_about(self) -> None:
        live = [walker for walker in self.team if walker.doing != "dead"]
        seen = {cell for walker in live for cell in self.seen_from(walker.at)}
        news = {cell for cell in seen if self.map[cell] != self.true[cell]}
        if not news:
            return
        self.moved = True  # a step in which the map changes is none without progress
        legs = {}
        for number, walker in enumerate(self.team):  # the leg that it is on, as it was found
            ends = [i for i, cell in enumerate(walker.way) if walker.doing == "traveling" or cell in walker.todo]
            legs[number] = walker.way[: (ends[-1] if walker.doing == "traveling" else ends[0]) + 1] if ends else []
        self.map |= {cell: self.true[cell] for cell in seen}
        near = {n: set(self.costs(walker.at)) for n, walker in enumerate(self.team) if walker.doing != "dead"}
        reached = set().union(*near.values())
        for number, patch in enumerate(list(self.patches)):
            owner = next((n for n, w in enumerate(self.team) if w.patch == number and w.doing in WORKING), None)
            if owner is not None:
                patch.cells = (patch.cells - news) & near[owner]
                self.team[owner].todo &= patch.cells
            elif not patch.over:
                apart = len({frozenset(one) for one in near.values() if one & patch.cells})
                if patch.cells & news or not patch.cells <= reached or apart > 1:
                    parts = pieces((patch.cells - news - self.visited) & reached)
                    patch.cells, patch.over = set(parts[0]) if parts else set(), not parts
                    self.patches += [Patch(patch.level, set(part)) for part in parts[1:]]
        self.take_in(reached)
        for number, walker in enumerate(self.team):
            if walker.doing in WORKING:
                self.set_right(number, walker, legs[number], news, near[number])

    def take_in(self, reached: set[Cell]) -> None:
        held = set().union(*(patch.cells for patch in self.patches))
        new = [cell for cell in reached - self.visited - held if self.map[cell] != WALL]
        parts = [
            part for level in {self.map[c] for c in new} for part in pieces(c for c in new if self.map[c] == level)
        ]
        for part in sorted(parts):
            round_about = {other for cell in part for other in beside(cell)}
            mine = [
                n
                for n in self.open()
                if self.patches[n].level == self.map[part[0]] and self.patches[n].cells & round_about
            ]
            if not mine:
                self.patches.append(Patch(self.map[part[0]], set(part)))
                continue
            for n in mine[1:]:
                self.patches[mine[0]].cells |= self.patches[n].cells
                self.patches[n].cells, self.patches[n].over = set(), True
            self.patches[mine[0]].cells |= set(part)

    def set_right(self, number: int, walker: Walker, leg: list[Cell], news: set[Cell], near: set[Cell]) -> None:
        if not self.left(walker.patch):
            self.patches[walker.patch].over, walker.way = True, []
            self.allocate(number, walker, share=True)
        elif set(leg) & news or not set(leg) <= near:
            if walker.doing == "traveling":
                self.set_out(walker)
            else:
                walker.way, walker.todo = [], self.left(walker.patch)
                self.cover(walker, walker.at)
        elif walker.doing == "covering":
            walker.way = list(leg)
            self.cover(walker, leg[-1])
        self.settle(number, walker)


WORKING = ("traveling", "covering")


def halves(cells: list[Cell]) -> list[list[Cell]]:
    """Two connected halves of a connected set (docs/spec.md, section 5)."""
    far = min(layers(cells, min(cells))[-1])
    goal, grown = (len(cells) + 1) // 2, []
    for layer in layers(cells, far):
        grown += sorted(layer)[: goal - len(grown)]
    rest = pieces(set(cells) - set(grown))
    stays = max(rest, key=lambda part: (len(part), [-c for c in part[0]]))
    return [sorted(set(cells) - set(stays)), stays]


def layers(cells: list[Cell], source: Cell) -> list[list[Cell]]:
    found, left = [[source]], set(cells) - {source}
    while more := {other for cell in found[-1] for other in beside(cell) if other in left}:
        left -= more
        found.append(list(more))
    return found
