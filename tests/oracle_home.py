"""Robots that come home, once more: a twin written from docs/spec.md, sections 4 and 19, alone.

What robots do with their areas is `oracle_unknown`'s; threats may change (`oracle_phases`). Cells are (row, col).
"""

from __future__ import annotations

import numpy as np
from oracle_phases import Areas, Judge, Timed
from oracle_unknown import WALL, WORKING, Cell, Walker, beside, pieces

MANY = 10**9


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
                        offer = (cost + self.price(cell), moves + 1)
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
            cell = next(o for o in beside(cell) if o in at and at[o] == (cost - self.price(o), moves - 1))
            way.append(cell)
        return way

    def far(self, number: int, cell: Cell) -> int:
        """h, less than nothing where no base is in reach."""
        return self.home(number).get(cell, (0, -1))[1]

    # --- what it can afford ---

    def affords(self, walker: Walker, target: Cell) -> bool:
        number = self.team.index(walker)
        h = self.far(number, target)
        moves = min(self.left_moves[number], self.last - self.step)
        return h < 0 or not self.thrifty or len(self.way(walker.at, target)) + h <= moves

    def goes_on(self, number: int, moves: int) -> bool:
        """Whether it could turn at every cell up to the end of its leg, with so many moves left."""
        walker = self.team[number]
        ends = [place for place, cell in enumerate(walker.way) if cell in walker.todo]
        leg = walker.way if walker.doing == "traveling" else walker.way[: ends[0] + 1]
        return all(self.far(number, cell) <= moves - k for k, cell in enumerate(leg, 1))

    def turn_home(self, number: int, *, charged: bool) -> None:
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
        walker.doing, walker.patch, walker.way, walker.todo = "done", None, [], set()

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
        self.turn_home(number, charged=True)
        return True

    # --- a turn ---

    def turn(self, number: int, walker: Walker) -> None:
        if walker.doing == "charging":
            self.moved = True
            if self.step >= self.ready[number]:
                self.left_moves[number], self.turned[number], walker.doing = self.limit[number], False, "idle"
                self.allocate(number, walker, share=True)
                self.settle(number, walker)
            walker.path.append(walker.at)
            return
        if self.step > 0 and walker.doing in WORKING:
            moves = self.left_moves[number]
            if not self.goes_on(number, min(moves, self.last - self.step + 1)):
                self.turn_home(number, charged=not self.goes_on(number, moves))
        waits = walker.doing in ("idle", "done") and (self.turned[number] or not self.left_moves[number])
        if self.step > 0 and (waits or walker.doing == "charging"):
            walker.path.append(walker.at)
            return
        super().turn(number, walker)

    def allocate(self, number: int, walker: Walker, *, share: bool) -> bool:
        return super().allocate(number, walker, share=share) or (self.rests(number) and False)

    def enter(self, number: int, walker: Walker, cell: Cell) -> None:
        self.left_moves[number] -= self.step > 0
        super().enter(number, walker, cell)

    def settle(self, number: int, walker: Walker) -> None:
        if walker.doing == "returning":
            if self.far(number, walker.at) == 0:
                self.arrive(number)
            elif not self.left_moves[number]:
                walker.doing, walker.way = "done", []
        elif not self.left_moves[number] and walker.doing in WORKING:
            if self.far(number, walker.at) == 0:
                self.turn_home(number, charged=True)
            else:
                self.lay_down(walker)
        else:
            super().settle(number, walker)

    # --- the end of a step ---

    def look_about(self) -> None:
        super().look_about()
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
                self.turn_home(number, charged=False)
        away = any(walker.doing == "returning" for walker in self.team)
        dead = all(walker.doing == "dead" for walker in self.team)
        ended = "all_robots_lost" if dead else "" if away else self.over
        ended = ended or ("step_limit" if self.step >= self.last else "")
        return "complete" if ended and self.goal <= self.visited else ended

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
