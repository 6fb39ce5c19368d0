"""The closed loop of robots that are told the map, once more: the paper's rule and `per_cell`, from docs/spec.md alone.

Sections 1, 3, 5 and 11, and nothing beyond them: no values, limits, ranges, types or maps in doubt. It shares no code
with the product. Cells are (row, col), sets are sets. The allocation at t = 0 is data, and so is who is stopped.
"""

import heapq
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Self

import numpy as np

Cell = tuple[int, int]
Judge = Callable[[int, int, Cell], bool]
"""`(robot, step, cell)`: is it stopped there?"""
WALL = -1
WORKING = ("traveling", "covering")


def beside(cell: Cell) -> list[Cell]:
    """The four cells next to it, in the order of their indices."""
    row, col = cell
    return [(row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col)]


def pieces(cells: Iterable[Cell]) -> list[list[Cell]]:
    """Connected components, each sorted, by lowest cell."""
    left, found = set(cells), []
    while left:
        piece = {cell for layer in layers(left, min(left)) for cell in layer}
        left -= piece
        found.append(sorted(piece))
    return found


def layers(cells: Iterable[Cell], source: Cell) -> list[list[Cell]]:
    """Cells by their number of moves from the source."""
    found, left = [[source]], set(cells) - {source}
    while more := {other for cell in found[-1] for other in beside(cell) if other in left}:
        left -= more
        found.append(list(more))
    return found


def halves(cells: list[Cell]) -> list[list[Cell]]:
    """Two connected halves of a connected set (section 5)."""
    far = min(layers(cells, min(cells))[-1])
    goal, grown = (len(cells) + 1) // 2, []
    for layer in layers(cells, far):
        grown += sorted(layer)[: goal - len(grown)]
    rest = pieces(set(cells) - set(grown))
    stays = max(rest, key=lambda part: (len(part), [-c for c in part[0]]))
    return sorted([sorted(set(cells) - set(stays)), stays])


@dataclass
class Patch:
    """An area. `over`: completed. `owner`: who has it, or had it."""

    level: int
    cells: frozenset[Cell]
    owner: int | None = None
    over: bool = False


@dataclass
class Walker:
    """A robot. `way`: cells ahead, the next one first. `todo`: what its coverage has yet to visit."""

    at: Cell
    doing: str = "idle"
    patch: int | None = None
    way: list[Cell] = field(default_factory=list)
    todo: frozenset[Cell] = frozenset()
    path: list[Cell] = field(default_factory=list)


class Paper:
    """One run by the paper's rule. In each step: of every robot in index order its turn, then `end_step`.

    A turn is `decide`; if that names a cell, `enter` it, and then `lose` or `survive`. `fork` may come in between.

    Args:
        threat: p `[H, W]`, NaN = obstacle. starts: of each robot. areas: (level, robot or None, cells) at t = 0.
        last: T_max, None for that of section 5. inside: `transit="area"`.

    Attributes:
        step: that which is being played, or in which the run ended. outcome: its word, "" while it goes on.
        goal, visited, survived: cells. events: (step, robot, what, area or None, other), as in `planner.tally.Trace`.
    """

    leg_by_leg = False

    def __init__(
        self, threat: np.ndarray, starts: Iterable[Cell], areas: Iterable[tuple[int, int | None, Collection[Cell]]],
        last: int | None = None, *, inside: bool = False,
    ) -> None:  # fmt: skip
        self.inside, self.cells = inside, threat.size
        self.team = [Walker(start) for start in starts]
        begun = {walker.at for walker in self.team}
        free = [cell for cell in np.ndindex(*threat.shape) if not math.isnan(threat[cell])]
        self.goal = {cell for piece in pieces(free) if begun & set(piece) for cell in piece}
        self.scale = sorted({0.0, *(float(threat[cell]) for cell in self.goal)})
        self.map = {cell: self.scale.index(float(threat[cell])) for cell in self.goal}
        self.last = 8 * len(self.scale) * len(self.goal) + 64 if last is None else last
        self.patches = [Patch(level, frozenset(cells), robot) for level, robot, cells in areas]
        for number, patch in enumerate(self.patches):
            if patch.owner is not None:
                self.team[patch.owner].patch, self.team[patch.owner].doing = number, "traveling"
        self.visited: set[Cell] = set()
        self.survived: set[Cell] = set()
        self.step, self.quiet, self.moved, self.outcome = 0, 0, False, ""
        self.events: list[tuple[int, int, str, int | None, Any]] = []
        self.known: dict[tuple[Cell, frozenset[Cell] | None], dict[Cell, int]] = {}

    # --- safest paths (section 3) ---

    def price(self, level: int) -> int:
        """The cost of entering a cell of the level."""
        return 1 if level == 0 else math.floor(self.cells * self.scale[level] / self.scale[1] + 0.5)

    def costs(self, source: Cell, within: frozenset[Cell] | None = None) -> dict[Cell, int]:
        """The cost of the safest path to each cell that can be reached, by cells `within` alone if any are given."""
        if (source, within) not in self.known:
            cost, due = {source: 0}, [(0, source)]
            while due:
                so_far, cell = heapq.heappop(due)
                for other in beside(cell) if so_far == cost[cell] else ():
                    if self.map.get(other, WALL) != WALL and (within is None or other in within):
                        new = so_far + self.price(self.map[other])
                        if new < cost.get(other, new + 1):
                            cost[other] = new
                            heapq.heappush(due, (new, other))
            self.known[source, within] = cost
        return self.known[source, within]

    def way(self, source: Cell, target: Cell, within: frozenset[Cell] | None = None) -> list[Cell]:
        """The cells entered on it."""
        cost, back = self.costs(source, within), [target]
        while back[-1] != source:
            before = cost[back[-1]] - self.price(self.map[back[-1]])
            back.append(next(cell for cell in beside(back[-1]) if cost.get(cell) == before))
        return back[-2::-1]

    def nearest(self, here: Cell, number: int) -> tuple[int, Cell] | None:
        """(cost, cell) of where a robot enters the area; None if it cannot reach it."""
        cost = self.costs(here)
        return min(((cost[cell], cell) for cell in self.goals(number) if cell in cost), default=None)

    def open(self) -> list[int]:
        """Those that nobody has."""
        return [number for number, patch in enumerate(self.patches) if patch.owner is None and not patch.over]

    def left(self, number: int) -> frozenset[Cell]:
        """The area's unvisited cells."""
        return self.patches[number].cells - self.visited

    def goals(self, number: int) -> frozenset[Cell]:
        """The cells that a robot may head for."""
        return self.patches[number].cells

    def key(self, number: int, cost: int) -> tuple[Any, ...]:
        """By this robots choose between areas."""
        return self.patches[number].level, cost

    # --- Algorithm 2 (section 5) ---

    def run(self, stopped: Judge) -> str:
        """All of the run."""
        while not self.outcome:
            self.play(stopped)
        return self.outcome

    def play(self, stopped: Judge) -> None:
        """The next step."""
        for number in range(len(self.team)):
            cell = self.decide(number)
            if cell is not None:
                self.enter(number)
                if stopped(number, self.step, cell):
                    self.lose(number)
                else:
                    self.survive(number)
        self.end_step()

    def decide(self, number: int) -> Cell | None:
        """The cell that the robot enters in this step, None if it stays."""
        walker = self.team[number]
        if walker.doing == "dead":
            return None
        if self.step == 0 or walker.way:
            return walker.way[0] if self.step else walker.at
        if self.allocate(number, walker, share=False):
            self.after_move(number, walker)
        walker.path.append(walker.at)
        return None

    def enter(self, number: int) -> None:
        """It is in the cell: that is visited, and may complete an area."""
        walker = self.team[number]
        walker.at = cell = walker.way.pop(0) if self.step else walker.at
        walker.path.append(cell)
        walker.todo -= {cell}
        self.moved = True
        self.visited.add(cell)
        for area, patch in enumerate(self.patches):
            if cell in patch.cells and not patch.over and patch.cells <= self.visited:
                patch.over = True
                self.note(number, "completed", area, cell)

    def lose(self, number: int) -> None:
        """It is stopped there."""
        walker = self.team[number]
        walker.doing = "dead"
        self.note(number, "hit", walker.patch, walker.at)
        if walker.patch is not None:
            self.leave(number, walker.patch)

    def leave(self, number: int, area: int) -> None:
        """`Reallocate Area`."""
        if parts := self.replace(area, pieces(self.left(area))):
            self.note(number, "reallocated", area, len(parts))

    def survive(self, number: int) -> None:
        """It goes on."""
        walker = self.team[number]
        self.survived.add(walker.at)
        if self.step == 0 and walker.patch is not None:
            walker.way = []
            if walker.at not in self.patches[walker.patch].cells:
                self.set_out(walker)
        self.after_move(number, walker)

    def end_step(self) -> None:
        """Every robot has had its turn."""
        self.quiet = 0 if self.moved else self.quiet + 1
        self.outcome = self.ended() or ("step_limit" if self.step >= self.last else "")
        if not self.outcome:
            self.step, self.moved = self.step + 1, False

    def ended(self) -> str:
        """How the run ends after this step; "": it goes on."""
        if self.goal <= self.visited:
            return "complete"
        if all(walker.doing == "dead" for walker in self.team):
            return "all_robots_lost"
        return "no_progress" if self.quiet >= 2 else ""

    def after_move(self, number: int, walker: Walker) -> None:
        """A path at its end goes over into the next one."""
        while not walker.way and walker.doing in WORKING:
            if walker.doing == "traveling" or self.left(walker.patch):
                walker.doing, walker.todo = "covering", self.left(walker.patch)
                self.cover(walker, walker.at)
            else:
                self.patches[walker.patch].over = True
                self.allocate(number, walker, share=True)

    def cover(self, walker: Walker, here: Cell) -> None:
        """`Area Coverage`: legs to the cheapest of what is to do, one after the other."""
        todo, within = walker.todo - {here}, self.patches[walker.patch].cells if self.inside else None
        while todo:
            cost = self.costs(here, within)
            target = min(todo, key=lambda cell: (cost[cell], cell))
            walker.way += self.way(here, target, within)
            todo, here = frozenset() if self.leg_by_leg else todo - {target}, target

    def set_out(self, walker: Walker) -> None:
        """To its area."""
        at = self.nearest(walker.at, walker.patch)
        walker.way, walker.doing = self.way(walker.at, at[1]) if at else [], "traveling"

    def give(self, number: int, area: int) -> None:
        """The robot has the area and sets out."""
        walker = self.team[number]
        walker.patch, self.patches[area].owner = area, number
        self.set_out(walker)
        self.moved = True
        self.note(number, "allocated", area, walker.way[-1] if walker.way else walker.at)

    def offers(self, walker: Walker, areas: Iterable[int]) -> Iterator[tuple[Any, int, int, Cell]]:
        """(key, area, cost, target) of those that it can have."""
        for area in areas:
            at = self.nearest(walker.at, area)
            if at:
                yield self.key(area, at[0]), area, *at

    def allocate(self, number: int, walker: Walker, *, share: bool) -> bool:
        """`Allocate Next Area`, and if it is asked for `Find Area To Share`, else done. True if it got an area."""
        found = min(self.offers(walker, self.open()), default=None)
        if found:
            self.give(number, found[1])
        elif share and not self.share(number, walker):
            walker.doing, walker.patch, walker.way = "done", None, []
        return walker.doing in WORKING

    def share(self, number: int, walker: Walker) -> bool:
        """`Find Area To Share`."""
        owners = {owner.patch: other for other, owner in enumerate(self.team) if owner.doing in WORKING}
        owners = {area: other for area, other in owners.items() if other != number and len(self.left(area)) >= 2}
        found = [
            (self.patches[area].level, cost, area)
            for _, area, cost, target in self.offers(walker, owners)
            if len(self.way(walker.at, target)) <= len(self.left(area))
        ]
        if not found:
            return False
        area = min(found)[-1]
        parts, owner = pieces(self.left(area)), owners[area]
        new = self.replace(area, halves(parts[0]) if len(parts) == 1 else parts)
        self.note(number, "shared", area, len(new))
        mine, theirs = ({a: self.nearest(self.team[one].at, a)[0] for a in new} for one in (number, owner))
        _, of_owner, of_helper = min((theirs[a] + mine[b], a, b) for a in new for b in new if a != b)
        self.give(owner, of_owner)
        self.give(number, of_helper)
        return True

    def replace(self, number: int, parts: Sequence[Iterable[Cell]]) -> list[int]:
        """The parts become areas of their own; the area keeps what is visited."""
        patch = self.patches[number]
        patch.cells &= self.visited
        patch.over = True
        self.patches += [Patch(patch.level, frozenset(part)) for part in parts]
        return list(range(len(self.patches) - len(parts), len(self.patches)))

    def note(self, robot: int, what: str, area: int | None, other: Any) -> None:
        """Write down what happened."""
        self.events.append((self.step, robot, what, area, other))

    # --- for who plays all that can happen ---

    def fork(self) -> Self:
        """A run that goes on from here; what it writes down (paths, events) begins here."""
        other = copy(self)
        other.visited, other.survived, other.events = set(self.visited), set(self.survived), []
        other.patches = [Patch(one.level, one.cells, one.owner, one.over) for one in self.patches]
        other.team = [Walker(one.at, one.doing, one.patch, one.way[:], one.todo) for one in self.team]
        return other

    def state_key(self) -> tuple[Any, ...]:
        """What all that follows depends on, but for the step. Areas are named by their order alone.

        Completed areas that no live robot has are left out.
        """
        alive = [walker for walker in self.team if walker.doing != "dead"]
        kept = {walker.patch for walker in alive} | {n for n, patch in enumerate(self.patches) if not patch.over}
        place = {number: index for index, number in enumerate(sorted(kept - {None}))}
        return (
            self.step == 0, self.quiet, self.moved, frozenset(self.visited), frozenset(self.survived),
            tuple(
                (one.at, one.doing, place.get(one.patch), *one.way) if one.doing != "dead" else None
                for one in self.team
            ),
            tuple((one.level, one.owner, one.over, one.cells) for one in (self.patches[number] for number in place)),
        )  # fmt: skip


class PerCell(Paper):
    """One run by `per_cell` (section 11)."""

    leg_by_leg = True

    def goals(self, number: int) -> frozenset[Cell]:
        return self.left(number)

    def key(self, number: int, cost: int) -> tuple[Any, ...]:
        count = len(self.left(number))
        return Fraction(cost + (count - 1) * self.price(self.patches[number].level), count), cost

    def decide(self, number: int) -> Cell | None:
        walker = self.team[number]
        if self.step > 0 and walker.doing in WORKING:
            self.look_up(number, walker)
        return super().decide(number)

    def look_up(self, number: int, walker: Walker) -> None:
        """Drop, look again, retarget."""
        if not self.left(walker.patch):
            self.allocate(number, walker, share=True)
            return
        if walker.doing == "traveling" and self.map[walker.way[0]] > 0:
            _, area, *_ = min(self.offers(walker, [*self.open(), walker.patch]))
            if area != walker.patch:
                self.note(number, "looked_again", walker.patch, walker.way[0])
                self.patches[walker.patch].owner = None
                self.give(number, area)
                return
        if walker.way[-1] in self.visited:
            walker.way = []
            if walker.doing == "traveling":
                self.set_out(walker)
            self.after_move(number, walker)
