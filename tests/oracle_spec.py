"""Closed loops once more, written from docs/spec.md alone: unknown maps, phases, returns home, learned hazards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import Any, Self

import numpy as np
from oracle_simulator import WALL, WORKING, Cell, Judge, Paper, Patch, Walker, beside, pieces

MANY = 10**9

# A closed loop of robots that are not told the map, by the paper's rule, once more: written from docs/spec.md alone.
#
# It shares no code with the product; what the paper itself says is `oracle_simulator`'s. For tiny worlds; who is
# stopped is scripted. The allocation at t = 0 is data, as everywhere.


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


class Twin(Paper):
    """One run. `believed`, `true`: p `[H, W]`, NaN = obstacle. `areas`: (level, robot or None, cells) at t = 0."""

    def __init__(
        self, believed: np.ndarray, true: np.ndarray, starts: list[Cell], reach: float, sight: bool,
        areas: list[tuple[int, int | None, list[Cell]]], stopped: Judge,
    ) -> None:  # fmt: skip
        super().__init__(true, starts, areas, MANY)
        self.reach, self.sight, self.stopped = reach, sight, stopped
        grid = list(np.ndindex(*true.shape))
        either = {c for c in grid if not math.isnan(believed[c]) or not math.isnan(true[c])}
        near = {c for piece in pieces(either) if set(piece) & set(starts) for c in piece}
        values = sorted({float(m[c]) for m in (believed, true) for c in near if m[c] > 0})
        self.scale = [0.0, *values]

        def level(chance: float) -> int:
            return WALL if math.isnan(chance) else self.scale.index(float(chance)) if chance in self.scale else 0

        self.map = {c: level(believed[c]) for c in grid}
        self.true = {c: level(true[c]) for c in grid}
        for walker in self.team:
            self.map |= {c: self.true[c] for c in self.seen_from(walker.at)}

    def run(self) -> str:
        """All of it."""
        return super().run(self.stopped)

    # --- what there is ---

    def seen_from(self, at: Cell) -> set[Cell]:
        found = set()
        for cell in self.true:
            if (cell[0] - at[0]) ** 2 + (cell[1] - at[1]) ** 2 <= self.reach**2:
                walls = [c for c, level in self.true.items() if level == WALL and c not in (at, cell)]
                if not (self.sight and any(crosses(at, cell, wall) for wall in walls)):
                    found.add(cell)
        return found

    # --- section 15 ---

    def end_step(self) -> None:
        self.sense_cells()
        super().end_step()

    def sense_cells(self) -> None:
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
        self.map, self.known = self.map | {cell: self.true[cell] for cell in seen}, {}
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
                    patch.cells, patch.over = frozenset(parts[0] if parts else ()), not parts
                    self.patches += [Patch(patch.level, frozenset(part)) for part in parts[1:]]
        self.add_reachable(reached)
        for number, walker in enumerate(self.team):
            if walker.doing in WORKING:
                self.repair_plan(number, walker, legs[number], news, near[number])

    def add_reachable(self, reached: set[Cell]) -> None:
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
                self.patches.append(Patch(self.map[part[0]], frozenset(part)))
                continue
            for n in mine[1:]:
                self.patches[mine[0]].cells |= self.patches[n].cells
                self.patches[n].cells, self.patches[n].over = frozenset(), True
            self.patches[mine[0]].cells |= set(part)

    def repair_plan(self, number: int, walker: Walker, leg: list[Cell], news: set[Cell], near: set[Cell]) -> None:
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
        self.after_move(number, walker)


# Threats that change with time, by everything that can happen: a closed loop by the paper's rule, and given paths.
#
# Written from docs/spec.md, sections 15 and 16, on the twin of section 15, which shares no code with the product.
# Maps are float arrays, NaN = obstacle; cells are (row, col).

Areas = list[tuple[int, "int | None", list[Cell]]]


class Timed(Twin):
    """One run in which all robots know of each map when it begins; `maps`: [(first step, p)], the first from 0."""

    def __init__(self, maps: list[tuple[int, np.ndarray]], starts: list[Cell], areas: Areas, stopped: Judge) -> None:
        first = maps[0][1]
        super().__init__(first, first, starts, 0, False, areas, stopped)
        chances = {float(p[cell]) for _, p in maps for cell in self.goal}
        self.scale = sorted({0.0} | chances)
        self.levels = {begin: {c: self.level_of(p[c]) for c in np.ndindex(*p.shape)} for begin, p in maps}
        self.map, self.true = self.levels[0].copy(), self.levels[0]
        begins = sorted(self.levels)
        self.last_change = max(
            (now for before, now in pairwise(begins)
             if any(self.levels[before][c] != self.levels[now][c] for c in self.goal)),
            default=0,
        )  # fmt: skip

    def level_of(self, chance: float) -> int:
        return self.scale.index(float(chance)) if float(chance) in self.scale else -1

    def seen_from(self, at: Cell) -> set[Cell]:
        return self.goal

    def can_act(self, number: int) -> bool:
        return self.team[number].doing != "dead"

    def ended(self) -> str:
        """No team is stuck while a robot that can act waits for a change that is still to come."""
        waits = self.step + 1 < self.last_change and any(map(self.can_act, range(len(self.team))))
        end = super().ended()
        return "" if end == "no_progress" and waits else end

    def sense_cells(self) -> None:
        self.true = getattr(self, "levels", {}).get(self.step + 1, self.true)
        super().sense_cells()


def met(maps: list[tuple[int, np.ndarray]], step: int, cell: Cell) -> float:
    return float([p for begin, p in maps if begin <= step][-1][cell])


def mean_of(play: Callable[[Judge], tuple[float, ...]], maps: list[tuple[int, np.ndarray]]) -> np.ndarray:
    """Expected values of what `play` gives, and of cells survived after it, over all that can happen."""
    total, left = np.zeros(1), [([], 1.0)]
    while left:
        decided, weight = left.pop()
        made: list[bool] = []
        safely: set[Cell] = set()
        chance = [weight]

        def judge(
            robot: int, step: int, cell: Cell,
            decided: list[bool] = decided, made: list[bool] = made, safely: set[Cell] = safely,
            chance: list[float] = chance,
        ) -> bool:  # fmt: skip
            p = met(maps, step, cell)
            if p > 0:
                if len(made) < len(decided):
                    made.append(decided[len(made)])
                else:
                    left.append(([*made, True], chance[0] * p))
                    chance[0] *= 1 - p
                    made.append(False)
                if made[-1]:
                    return True
            safely.add(cell)
            return False

        told = play(judge)
        total = total + chance[0] * np.array([*told, len(safely)])
    return total


def closed_loop(maps: list[tuple[int, np.ndarray]], starts: list[Cell], areas: Areas, judge: Judge) -> tuple[int, int]:
    """(visited, alive) of one run."""
    run = Timed(maps, starts, areas, judge)
    run.run()
    return len(run.visited), sum(walker.doing != "dead" for walker in run.team)


def open_loop(paths: list[list[Cell]], judge: Judge) -> tuple[int, int]:
    """The same of given paths; who waits visits nothing."""
    visited, alive = set(), set(range(len(paths)))
    for step in range(max(map(len, paths))):
        for robot, path in enumerate(paths):
            if robot in alive and step < len(path) and (step == 0 or path[step] != path[step - 1]):
                visited.add(path[step])
                if judge(robot, step, path[step]):
                    alive.remove(robot)
    return len(visited), len(alive)


class Following(Paper):
    """One run of robots that follow given paths, one list a robot, a cell for each step, and then the paper's rule.

    The cells that a robot is the first to visit are its areas, one a level, which nobody shares; if it is stopped, what
    is unvisited of them is cut into connected areas. Cells on nobody's path are areas of nobody.
    """

    def __init__(self, threat: np.ndarray, paths: list[list[Cell]]) -> None:
        super().__init__(threat, [path[0] for path in paths], [])
        self.last += max(map(len, paths)) - 1
        first: dict[Cell, int] = {}
        for step in range(max(map(len, paths))):
            for robot, path in enumerate(paths):
                first.setdefault(path[min(step, len(path) - 1)], robot)
        levels = range(len(self.scale))
        for robot in range(len(paths)):
            own = ({cell for cell, who in first.items() if who == robot and self.map[cell] == n} for n in levels)
            self.patches += [Patch(n, frozenset(cells), robot) for n, cells in enumerate(own) if cells]
        for n in levels:
            parts = pieces(cell for cell in self.goal - {*first} if self.map[cell] == n)
            self.patches += [Patch(n, frozenset(part)) for part in parts]
        for walker, path in zip(self.team, paths, strict=True):
            walker.doing, walker.way = "following", path[1:]

    def decide(self, number: int) -> Cell | None:
        walker = self.team[number]
        if self.step == 0 or walker.doing != "following" or walker.way[0] != walker.at:
            return super().decide(number)
        walker.path.append(walker.way.pop(0))  # a step of waiting
        self.moved = True
        self.after_move(number, walker)
        return None

    def after_move(self, number: int, walker: Walker) -> None:
        if walker.doing == "following" and not walker.way:
            self.allocate(number, walker, share=True)
        super().after_move(number, walker)

    def lose(self, number: int) -> None:
        super().lose(number)
        if self.team[number].patch is None:
            for area, patch in enumerate(self.patches[:]):
                if patch.owner == number and not patch.over:
                    self.leave(number, area)


# Robots that come home, once more: a twin written from docs/spec.md, sections 4 and 19, alone.
#
# What robots do with their areas is the twin's; threats may change (`Timed`). Cells are (row, col).


OWN = ("left_moves", "turned", "charges", "ready")
"""What robots that come home have each."""


class Homing(Timed):
    """One run of robots that come home to `bases`, one list a robot; `limit`: moves of each, `last`: the deadline."""

    def __init__(
        self, maps: list[tuple[int, np.ndarray]], starts: list[Cell], areas: Areas, stopped: Judge,
        bases: list[list[Cell]], limit: list[int], last: int, recharge: int,
    ) -> None:  # fmt: skip
        super().__init__(maps, starts, areas, stopped)
        self.bases, self.limit, self.last, self.recharge = bases, limit, last, recharge
        self.left_moves, self.turned, self.charges = list(limit), [False] * len(starts), [False] * len(starts)
        self.ready, self.over, self.thrifty, self.homes = [0] * len(starts), "", True, {}

    # --- ways home ---

    def home(self, number: int) -> dict[Cell, tuple[int, int]]:
        """(cost, moves) of the way home from each cell, as the map is believed now."""
        known = tuple(sorted(self.map.items())), tuple(self.bases[number])
        if known not in self.homes:
            found = {base: (0, 0) for base in self.bases[number] if self.map[base] != WALL}
            while True:
                offers = {}
                for cell, (cost, moves) in found.items():
                    for other in (one for one in beside(cell) if self.map.get(one, WALL) != WALL):
                        offer = (cost + self.price(self.map[cell]), moves + 1)
                        if offer < min(found.get(other, (MANY, 0)), offers.get(other, (MANY, 0))):
                            offers[other] = offer
                if not offers:
                    break
                found |= offers
            self.homes[known] = found
        return self.homes[known]

    def way_home(self, number: int, cell: Cell) -> list[Cell]:
        at, way = self.home(number), []
        while at.get(cell, (0, 0))[1] > 0:
            cost, moves = at[cell]
            cell = next(o for o in beside(cell) if o in at and at[o] == (cost - self.price(self.map[o]), moves - 1))
            way.append(cell)
        return way

    def far(self, number: int, cell: Cell) -> int:
        """h, less than nothing where no base is in reach."""
        return self.home(number).get(cell, (0, -1))[1]

    # --- what it can afford ---

    def offers(self, walker: Walker, areas: Iterable[int]) -> Iterator[tuple[Any, int, int, Cell]]:
        return (offer for offer in super().offers(walker, areas) if self.is_within_range(walker, offer[-1]))

    def is_within_range(self, walker: Walker, target: Cell) -> bool:
        number = self.team.index(walker)
        h = self.far(number, target)
        moves = min(self.left_moves[number], self.last - self.step)
        return h < 0 or not self.thrifty or len(self.way(walker.at, target)) + h <= moves

    def goes_on(self, number: int, moves: int) -> bool:
        """Whether it could turn at every cell up to the end of its leg, with so many moves left."""
        walker = self.team[number]
        if self.far(number, walker.at) < 0:
            return True  # no base is left to be reached
        ends = [place for place, cell in enumerate(walker.way) if cell in walker.todo]
        leg = walker.way if walker.doing == "traveling" else walker.way[: ends[0] + 1]
        return all(self.far(number, cell) <= moves - k for k, cell in enumerate(leg, 1))

    def start_return(self, number: int, *, charged: bool) -> None:
        walker = self.team[number]
        self.charges[number] = charged and self.recharge > 0 and self.left_moves[number] < self.limit[number]
        self.lay_down(walker)
        self.turned[number], walker.way = True, self.way_home(number, walker.at)
        if walker.way:
            walker.doing = "returning"
        elif self.far(number, walker.at) == 0:
            self.arrive(number)

    def lay_down(self, walker: Walker) -> None:
        if walker.patch is not None:
            self.replace(walker.patch, pieces(self.left(walker.patch)))
        walker.doing, walker.patch, walker.way, walker.todo = "done", None, [], frozenset()

    def arrive(self, number: int) -> None:
        self.team[number].doing, self.team[number].way = "done", []
        if self.charges[number] and not self.over:
            self.team[number].doing, self.ready[number] = "charging", self.step + self.recharge

    def rests(self, number: int) -> bool:
        """Nothing is left that it can afford: it turns to be charged if there were something with moves enough."""
        walker = self.team[number]
        if not self.recharge or self.left_moves[number] == self.limit[number]:
            return False
        if not any(self.nearest(walker.at, n) for n in self.open()):
            return False
        self.start_return(number, charged=True)
        return True

    # --- a turn ---

    def decide(self, number: int) -> Cell | None:
        walker = self.team[number]
        if walker.doing == "charging":
            self.moved = True
            if self.step >= self.ready[number]:
                self.left_moves[number], self.turned[number], walker.doing = self.limit[number], False, "idle"
                self.allocate(number, walker, share=True)
                self.after_move(number, walker)
            walker.path.append(walker.at)
            return None
        if self.step > 0 and walker.doing in WORKING:
            moves = self.left_moves[number]
            if not self.goes_on(number, min(moves, self.last - self.step + 1)):
                self.start_return(number, charged=not self.goes_on(number, moves))
        waits = walker.doing in ("idle", "done") and (self.turned[number] or not self.left_moves[number])
        if self.step > 0 and (waits or walker.doing == "charging"):
            walker.path.append(walker.at)
            return None
        return super().decide(number)

    def allocate(self, number: int, walker: Walker, *, share: bool) -> bool:
        return super().allocate(number, walker, share=share) or (self.rests(number) and False)

    def enter(self, number: int) -> None:
        self.left_moves[number] -= self.step > 0
        super().enter(number)

    def after_move(self, number: int, walker: Walker) -> None:
        if walker.doing == "returning":
            if self.far(number, walker.at) == 0:
                self.arrive(number)
            elif not self.left_moves[number]:
                walker.doing, walker.way = "done", []
        elif not self.left_moves[number] and walker.doing in WORKING:
            if self.far(number, walker.at) == 0:
                self.start_return(number, charged=True)
            else:
                self.lay_down(walker)
        else:
            super().after_move(number, walker)

    # --- the end of a step ---

    def sense_cells(self) -> None:
        super().sense_cells()
        for number, walker in enumerate(getattr(self, "turned", ()) and self.team):
            if walker.doing == "returning":
                walker.way = self.way_home(number, walker.at)
                walker.doing = "returning" if walker.way else "done"

    def can_act(self, number: int) -> bool:
        return super().can_act(number) and self.left_moves[number] > 0 and not self.turned[number]

    def ended(self) -> str:
        self.over = self.over or super().ended()
        for number, walker in enumerate(self.team):
            if walker.doing == "charging" and self.over:
                walker.doing = "done"
            late = walker.doing in ("idle", "done") and 0 < self.far(number, walker.at) >= self.last - self.step
            if self.can_act(number) and (self.over or late):
                self.start_return(number, charged=False)
        away = any(walker.doing == "returning" for walker in self.team)
        dead = all(walker.doing == "dead" for walker in self.team)
        ended = "all_robots_lost" if dead else "" if away else self.over
        ended = ended or ("step_limit" if self.step >= self.last else "")
        return "complete" if ended and self.goal <= self.visited else ended

    def fork(self) -> Self:
        other = super().fork()
        for name in OWN:
            setattr(other, name, getattr(self, name)[:])
        return other

    def state_key(self) -> tuple[Any, ...]:
        todo = (walker.todo for walker in self.team)
        return *super().state_key(), self.over, *todo, *(tuple(getattr(self, name)) for name in OWN)

    def at_home(self) -> list[bool]:
        return [w.doing != "dead" and w.at in self.bases[n] for n, w in enumerate(self.team)]


def allocation(p: np.ndarray, starts: list[Cell]) -> Areas | None:
    """Algorithm 1 with a density of 4; None where a safe area has several robots, which METIS is to split."""
    goal = {
        c for part in pieces(c for c in np.ndindex(*p.shape) if not np.isnan(p[c])) if {*part} & {*starts} for c in part
    }
    scale = sorted({0.0, *(float(p[c]) for c in goal)})
    areas = [
        (level, part) for level, value in enumerate(scale) for part in pieces(c for c in goal if float(p[c]) == value)
    ]
    twin, has = Timed([(0, p)], starts, [(0, None, part) for _, part in areas], lambda *_: False), {}
    for robot, start in enumerate(starts):
        safe = [n for n, (level, _) in enumerate(areas) if level == 0 and twin.nearest(start, n)]
        for n in sorted(safe, key=lambda n: (twin.nearest(start, n)[0], n)):
            if 4 * sum(1 for owner in has.values() if owner == n) <= len(areas[n][1]):
                has[robot] = n
                break
    if len({*has.values()}) < len(has):
        return None
    return [
        (level, next((r for r, owner in has.items() if owner == n), None), part)
        for n, (level, part) in enumerate(areas)
    ]


# Robots that learn about hazards, once more: a twin written from docs/spec.md alone, by Bayes' rule in floats.
#
# It shares no code with the product; what robots do with what they believe is the twin's.


class Pupil(Twin):
    """One run. `q`, `h`: `[H, W]`, NaN = obstacle; `detector`: (range, detect, false alarm) or None.

    `alarm(robot, step, cell)`: its readings. Other arguments as of `Twin`.
    """

    def __init__(
        self, q: np.ndarray, h: np.ndarray, consumed: bool, starts: list[Cell],
        areas: list[tuple[int, int | None, list[Cell]]], stopped: Judge,
        detector: tuple[float, float, float] | None = None, alarm: Judge | None = None,
    ) -> None:  # fmt: skip
        super().__init__(q * h, q * h, starts, 0, False, areas, stopped)
        self.hits, self.consumed, self.detector, self.alarm = h, consumed, detector, alarm
        self.first = {c: float(q[c]) for c in self.true if not math.isnan(q[c])}
        self.chance, self.passed = dict(self.first), dict.fromkeys(self.first, 0)
        near = {c for c in self.goal if self.first[c] > 0}
        values = {self.planned(c, k) for c in near for k in self.classes()} | {
            h[c] for c in near if self.may_be_sure(c)
        }
        self.scale = [0.0, *sorted({float(f"{value:.5g}") for value in values if 0 < value < 1})]
        self.true = {c: self.level(c) for c in self.true}
        self.map = dict(self.true)

    def classes(self) -> range:
        return range(-4, 5) if self.detector else range(4)

    def may_be_sure(self, cell: Cell) -> bool:
        surely = self.detector is not None and self.detector[2] == 0
        return self.first[cell] == 1 or not self.consumed or surely

    def planned(self, cell: Cell, k: int) -> float:
        """p of the class k of a cell: k survived visits, or k nats less."""
        q, h = self.first[cell], float(self.hits[cell])
        if q in (0, 1):
            return q * h
        if self.detector:
            odds = q / (1 - q) * math.exp(-k)
            return h * odds / (1 + odds)
        for _ in range(k):
            q = q * (1 - h) / (1 - q * h)
        return q * h

    def level(self, cell: Cell) -> int:
        """That of what robots believe of the cell by now."""
        if cell not in self.first:
            return WALL
        q, now, h = self.first[cell], self.chance[cell], float(self.hits[cell])
        if now in (0, 1) or q in (0, 1):
            p = now * h
        elif self.detector:
            nats = math.log(q / (1 - q)) - math.log(now / (1 - now))
            p = self.planned(cell, max(-4, min(4, math.trunc(nats + math.copysign(1e-6, nats)))))
        else:
            p = self.planned(cell, min(3, self.passed[cell]))
        if p == 1:
            return WALL
        return min(range(len(self.scale)), key=lambda level: abs(self.scale[level] - p))

    def seen_from(self, at: Cell) -> set[Cell]:
        return set(self.true)  # what is known all know: `true` is what the evidence says

    def lose(self, number: int) -> None:
        super().lose(number)
        self.chance[self.team[number].at] = 0.0 if self.consumed else 1.0

    def survive(self, number: int) -> None:
        cell = self.team[number].at
        q, h = self.chance[cell], float(self.hits[cell])
        if q < 1:
            self.chance[cell] = q * (1 - h) / (1 - q * h)
            self.passed[cell] += 1
        super().survive(number)

    def sense_cells(self) -> None:
        for number, walker in enumerate(self.team):
            if self.detector and walker.doing != "dead":
                self.read(number, walker)
        self.true |= {c: self.level(c) for c in self.chance}
        super().sense_cells()

    def read(self, number: int, walker: Walker) -> None:
        reach, b, a = self.detector
        for cell, q in self.chance.items():
            if cell in self.goal and (cell[0] - walker.at[0]) ** 2 + (cell[1] - walker.at[1]) ** 2 <= reach**2:
                right, wrong = (b, a) if self.alarm(number, self.step, cell) else (1 - b, 1 - a)
                if 0 < q < 1:
                    self.chance[cell] = q * right / (q * right + (1 - q) * wrong)
