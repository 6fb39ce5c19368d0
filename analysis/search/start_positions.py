"""The best starts of a team: screened by a bound and by eq. (4), the best of those simulated on common luck.

1. Every candidate: the *reach bound* `sum_c g_c` (`analysis.theory.bounds.reach_chances`), one search a site.
2. One depot: eq. (4) of one robot's plan from PLANNED candidates, the sites in turn, the best bound first.
   One start each: teams chosen greedily by the bound, from every site as the first; and the depots.
3. The best SIMULATED of them, and where the team stands now: `analysis.estimators.racing`. The best depot and the
starts
   of now go on to the end, and what is recommended is held against these on fresh rollouts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice, zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from analysis.estimators.racing import Halving, check_search, screened
from analysis.estimators.trial import Measured, Trial
from analysis.report.answer import Searched
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate
from analysis.theory.bounds import best_survival
from analysis.theory.exact import Worth, open_loop_exact
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.arguments import argument
from planner.errors import MapError, UsageError
from planner.files import check_file, read_csv_grid, read_npy, starts_with_header
from planner.make_plan import allocated_plan, make_plan
from planner.plan.plan import Plan
from planner.rollouts.engine import choose_engine
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.world.levels import check_robots, place_starts
from planner.world.points import read_table
from planner.world.world import FOUR_NEIGHBOURS, MAX_CELLS, World

# What a search for starts holds: the places that were looked at, how good each is, the best and how sure that is.


@dataclass(frozen=True, eq=False)
class Place:
    """A team's starts, and what is known of them.

    Attributes:
        starts: int64 `[K, 2]`.
        screen: expected cells visited (or their value) that no strategy exceeds from there, `sum_c g_c` of
            `reach_chances`.
        one_robot: eq. (4): expected cells (or value) visited by one robot alone; None: it was not planned for.
        coverage: visited by the team, a fraction of the accessible cells; None: it was not simulated.
        value: visited, a fraction of what all free cells are worth; None: nobody said what that is.
        losses: robots lost. rollouts: behind both.
        behind: points of coverage (or value) that the best found is ahead, an interval; all of one search hold together
            with 95 %.
        entered: it was simulated. now: the team stands there now.
    """

    starts: NDArray[np.int64]
    screen: float
    one_robot: float | None = None
    coverage: Estimate | None = None
    value: Estimate | None = None
    losses: Estimate | None = None
    rollouts: int = 0
    behind: tuple[float, float] | None = None
    entered: bool = False
    now: bool = False

    @property
    def is_depot(self) -> bool:
        """All robots start in one cell."""
        return bool((self.starts == self.starts[0]).all())

    @property
    def counted(self) -> Estimate | None:
        """What is gone by, a fraction: value where there is any, else coverage."""
        return self.coverage if self.value is None else self.value

    @property
    def at(self) -> str:
        """Where, in words: one place for all, or one each."""
        places = self.starts[:1] if self.is_depot else self.starts
        return " ".join(f"[{row}, {col}]" for row, col in places.tolist())


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Starts(Searched):
    """The answer; `words`: without the starts.

    Attributes:
        depot: one place for all robots.
        places: looked at: depots in order of screening, or teams of starts and depots; then where the team stands.
        best: place of the best found, of the depots with `depot`.
        gain: how much more is covered (or of the value) from the best than from `here`, on fresh rollouts, a fraction.
        candidates: cells that robots may start at. rolled: rollouts of all places.
        confirmed: `chosen` on fresh rollouts, ids from `choices.rollouts` on.
    """

    reported_by = "analysis.search.place_reports:starts_report"
    listed = "candidates"

    depot: bool
    places: tuple[Place, ...]
    best: int
    candidates: NDArray[np.int64]
    rolled: int
    gain: Estimate | None = None
    confirmed: Place | None = None

    @property
    def covered(self) -> str:
        """What the figures are shares of, in a word."""
        return "covered" if self.world.value is None else "of the value covered"

    @property
    def here(self) -> int | None:
        """The place where the team stands now, by the input's starts or its rule; None: in another part of the map."""
        return next((number for number, place in enumerate(self.places) if place.now), None)

    @property
    def stay(self) -> bool:
        """Whether nothing found is better than where the team stands now, with 95 %."""
        return self.here is not None and (self.best == self.here or (self.gain is not None and self.gain.ci95[0] <= 0))

    @property
    def chosen(self) -> Place:
        """What is recommended: where the team stands if it is to stay, else the best found; with `depot` the latter."""
        return self.places[self.here if self.here is not None and self.stay and not self.depot else self.best]

    @property
    def starts(self) -> NDArray[np.int64]:
        """Of that place, int64 `[K, 2]`."""
        return self.chosen.starts

    @cached_property
    def simulated(self) -> tuple[Place, ...]:
        """Those that were rolled out, the best first, then by coverage."""
        rest = [p for p in self.places if p.coverage is not None and p is not self.chosen]
        return (self.chosen, *sorted(rest, key=lambda p: -p.counted.mean if p.counted else 0.0))

    @property
    def beaten(self) -> int:
        """How many of the others the best found surely beats, all together with 95 %."""
        return sum(p.behind is not None and p.behind[0] > 0 for p in self.places)

    @property
    def world_with_starts(self) -> World:
        """The map with these starts, to save or to evaluate."""
        return self.world.with_starts(self.starts)

    def plan(self) -> Plan:
        """The plan from there."""
        return make_plan(self.world, self.starts, self.settings)


# Places where robots may start: the border of the map, a mask, or a list; which of them are worth a plan.
#
# A *site* is a set of candidates from which every strategy can do the same: those of one safe area, in which moves are
# free of risk; a dangerous candidate is a site of its own.

BORDER = "border"
Cells = NDArray[np.int64]
"""(row, col) of cells, int64 `[C, 2]`."""


def border(world: World) -> NDArray[np.bool_]:
    """bool `[H, W]`: safe cells on the edge of the map, or beside obstacles that reach to it, as a sea does."""
    around, _ = ndimage.label(np.pad(~world.free, 1, constant_values=True), structure=FOUR_NEIGHBOURS)
    near = ndimage.binary_dilation(around == around[0, 0], FOUR_NEIGHBOURS)[1:-1, 1:-1]
    return near & (world.threat == 0)


def read_candidates(path: Path) -> tuple[NDArray, tuple[str, ...]]:
    """What a file of candidates holds, a mask or a list: .npy, or .csv of numbers; and notes. Raises InputError."""
    if path.suffix.lower() not in (".npy", ".csv"):
        problem = f"{argument('candidates')} {path} is neither {BORDER!r} nor such a file"
        raise UsageError(problem, expected="a mask of the map or rows of row,col as .npy or .csv")
    check_file(path, "a mask of the map, or rows of row,col")
    if path.suffix.lower() == ".npy":
        return read_npy(path, MAX_CELLS), ()
    if not starts_with_header(path):
        return read_csv_grid(path, MAX_CELLS)
    table = read_table(path, "lines row, col")
    row, col = table.column("row"), table.column("col", "column")
    if row is None or col is None:
        raise MapError(f"has the columns {', '.join(table.names)[:80]}", source=path, expected="row and col")
    cells = [[table.number(one, row, "row"), table.number(one, col, "col")] for one in table.rows]
    return np.array(cells), table.notes


def candidate_cells(world: World, given: ArrayLike, source: object = "") -> tuple[Cells, tuple[str, ...]]:
    """Candidates in one connected part of the map, in order of index, and notes.

    Args:
        given: "border"; a mask `[H, W]`, non-zero where robots may start; or a list of (row, col) `[C, 2]`.
            Two columns of numbers are a list, unless they are booleans.
        source: the file that it comes from, for errors.

    Robots start in one part of the map: of several, the largest that has a candidate. Raises UsageError.
    """
    cells = _cells(world, given, str(source))
    labels = world.components
    part = labels[tuple(cells.T)]
    size = np.bincount(labels.ravel())
    best = min(set(part.tolist()), key=lambda name: (-size[name], name))
    kept = cells[part == best]
    left_out = len(cells) - len(kept)
    note = f"{left_out} of {len(cells)} candidates lie in smaller parts of the map that cannot be reached from the rest"
    return kept, (f"{note}: left out",) if left_out else ()


def _cells(world: World, given: ArrayLike, source: str) -> Cells:
    name = source or argument("candidates")
    if isinstance(given, str):
        if given != BORDER:
            raise UsageError(argument("candidates", given), expected=f"{BORDER!r}, a mask of the map, or cells")
        found = np.argwhere(border(world))
        if not len(found):
            raise UsageError("no cell on the border of the map is safe", fix="name candidates in a file")
        return found
    array = np.asarray(given)
    if array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] == 2:
        return _listed(world, array, name)
    if array.shape != world.shape or array.dtype.kind not in "bfiu":
        raise UsageError(
            f"{name}: has shape {array.shape}",
            expected=f"a mask of the map, {world.shape}, or rows of row,col",
        )
    chosen = np.nan_to_num(array.astype(np.float64)) != 0
    if not chosen.any():
        raise UsageError(f"{name}: names no cell", expected="a candidate or more")
    return _checked(world, np.argwhere(chosen), name)


def _listed(world: World, array: NDArray, name: str) -> Cells:
    if not np.isfinite(array).all() or (array != np.round(array)).any() or np.abs(array).max(initial=0) >= 2**31:
        raise UsageError(f"{name}: holds numbers that are no cells", expected="row,col in whole numbers")
    cells = np.unique(array.astype(np.int64), axis=0)
    if not len(cells):
        raise UsageError(f"{name}: names no cell", expected="a candidate or more")
    off = ((cells < 0) | (cells >= world.shape)).any(axis=1)
    if off.any():
        row, col = cells[off][0].tolist()
        height, width = world.shape
        expected = f"row 0..{height - 1} and col 0..{width - 1}"
        raise UsageError(f"{name}: [{row}, {col}] lies off the map", expected=expected)
    return _checked(world, cells, name)


def _checked(world: World, cells: Cells, name: str) -> Cells:
    blocked = ~world.free[tuple(cells.T)]
    if blocked.any():
        row, col = cells[blocked][0].tolist()
        problem = f"{name}: [{row}, {col}] is an obstacle ({int(blocked.sum())} such of {len(cells)})"
        raise UsageError(problem, expected="free cells", fix="leave it out")
    return cells


def sites_of(world: World, cells: Cells) -> list[Cells]:
    """The candidates by site, each spread out: its first ones lie far from each other."""
    areas, count = ndimage.label(world.threat == 0, structure=FOUR_NEIGHBOURS)
    site = areas[tuple(cells.T)].astype(np.int64)
    dangerous = site == 0
    site[dangerous] = count + 1 + np.arange(int(dangerous.sum()))
    return [spread_out(cells[site == name]) for name in np.unique(site)]


def spread_out(cells: Cells, most: int = 256) -> Cells:
    """The cells in an order in which each is the farthest from all before it; those after the first `most` as given."""
    left = np.sum((cells - cells.mean(axis=0)) ** 2, axis=1)
    order: list[int] = []
    while len(order) < min(most, len(cells)):
        order.append(int(np.argmax(left)))
        apart = np.sum((cells - cells[order[-1]]) ** 2, axis=1)
        left = np.minimum(left, apart) if len(order) > 1 else apart.astype(np.float64)
        left[order] = -1.0
    rest = np.setdiff1d(np.arange(len(cells)), order)
    return cells[np.concatenate([np.array(order, dtype=np.int64), rest])]


def in_turn(sites: Sequence[NDArray[np.int64]]) -> Iterator[NDArray[np.int64]]:
    """The first item of every site, then the second of every one, ..."""
    for row in zip_longest(*map(list, sites)):
        yield from (item for item in row if item is not None)


# Which places are worth simulating: screened by a bound, depots by eq. (4) of one robot too, teams chosen greedily.

PLANNED, SIMULATED = 64, 48
"""Depots that eq. (4) is worked out for, and depots that are simulated, at most."""
SHARED = 24
"""Of the depots simulated, how many come from the sites in turn, so that no single site takes all."""
TEAMS = 24
"""Teams of free starts that are simulated, at most."""
MOST_CHANCES = 2**27
"""Most numbers kept of all sites' chances to reach all cells, a gigabyte."""


class Reached(NamedTuple):
    """Of a robot at each site, the most that can be made of the chance to visit each accessible cell, `[S, A]`.

    `value`: of those cells `[A]`; None: they count alike.
    """

    chances: NDArray[np.float64]
    value: NDArray[np.float64] | None

    def bound(self, world: World, starts: NDArray[np.int64]) -> float:
        """The bound of a team that starts anywhere, `[K, 2]`."""
        missed = 1.0 - best_survival(world, starts)[:, np.flatnonzero(world.accessible(starts))]
        return float(self.sum(1.0 - np.prod(missed, axis=0)))

    def sum(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Over the last axis, cells by their value."""
        total: NDArray[np.float64] = of_cells.sum(axis=-1) if self.value is None else of_cells @ self.value
        return total


def reached_from(world: World, sites: Sequence[NDArray[np.int64]]) -> Reached:
    accessible = np.flatnonzero(world.accessible(sites[0][:1]))
    if len(sites) * len(accessible) > MOST_CHANCES:
        most = MOST_CHANCES // len(accessible)
        problem = f"candidates in {len(sites):,} places with danger between them"
        raise UsageError(problem, expected=f"at most {most:,} on this map", fix="name fewer")
    chances = np.concatenate([best_survival(world, site[:1])[:, accessible] for site in sites])
    return Reached(chances, None if world.value is None else world.value.reshape(-1)[accessible])


def depots_of(
    world: World,
    robots: int,
    settings: Settings,
    sites: Sequence[NDArray[np.int64]],
    reached: Reached,
) -> list[Place]:
    """Every candidate as a depot, the best bound first; those that are planned for have eq. (4)."""
    bounds = reached.sum(1.0 - (1.0 - reached.chances) ** robots)
    order = np.argsort(-bounds, kind="stable").tolist()
    ordered = [sites[site] for site in order]
    planned = {}
    for cell in islice(in_turn(ordered), PLANNED):
        alone = make_plan(world, cell[None], settings.alone)
        known = open_loop_exact(alone, world)
        own = known.visited if world.value is None else float(Worth.of(world).value @ known.visited_by_cell)
        planned[tuple(cell.tolist())] = own
    return [
        Place(np.tile(cell, (robots, 1)), float(bounds[site]), planned.get(tuple(cell.tolist())))
        for site, cells in zip(order, ordered, strict=True)
        for cell in cells
    ]


def worth_simulating(places: Sequence[Place], sites: Sequence[NDArray[np.int64]]) -> list[int]:
    """Which depots are simulated: SHARED from the sites in turn, then those whose nearest planned one is best.

    Eq. (4) hardly differs within a site; depots that it does not tell apart are spread out.
    """
    at = {tuple(place.starts[0].tolist()): number for number, place in enumerate(places)}
    expected = np.full(len(places), -np.inf)
    leaders = []
    for site in sites:
        numbers = np.array([at[tuple(cell.tolist())] for cell in site])
        known = numbers[[places[number].one_robot is not None for number in numbers]]
        if len(known):
            values = np.array([places[number].one_robot for number in known])
            near = np.array([[np.abs(places[n].starts[0] - places[m].starts[0]).sum() for m in known] for n in numbers])
            expected[numbers] = values[near.argmin(axis=1)]
            leaders.append(known[np.argsort(-values, kind="stable")])
    leaders.sort(key=lambda numbers: (-expected[numbers[0]], numbers[0]))
    chosen = [int(number) for number in islice(in_turn(leaders), SHARED)]
    for value in np.unique(expected[np.isfinite(expected)])[::-1]:
        alike = np.setdiff1d(np.flatnonzero(expected == value), chosen)
        if len(alike) and len(chosen) < SIMULATED:
            spread = spread_out(np.array([places[number].starts[0] for number in alike]))
            chosen += [at[tuple(cell.tolist())] for cell in spread[: SIMULATED - len(chosen)]]
    return chosen


def teams_of(robots: int, sites: Sequence[NDArray[np.int64]], reached: Reached) -> list[Place]:
    """Teams with a start each: the rest chosen greedily by the bound after every site as the first; and all at one.

    The bound is submodular, so a greedy team's is at least 1 - 1/e of the best one's. It does not tell the cells of a
    site apart: there are several teams of the same sites, at other cells of theirs.
    """
    alone = np.argsort(-reached.sum(reached.chances), kind="stable").tolist()
    chosen = [_greedily(robots, first, reached) for first in alone[:TEAMS]] + [[site] * robots for site in alone[:2]]
    ways = sorted({tuple(sorted(way)): None for way in chosen}, key=lambda way: -_bound(reached, way))
    found: dict[bytes, Place] = {}
    for turn in range(TEAMS):
        for way in ways:
            starts = np.array([sites[site][(way[:place].count(site) + turn) % len(sites[site])]
                               for place, site in enumerate(way)])  # fmt: skip
            if len(found) < TEAMS:
                found.setdefault(starts.tobytes(), Place(starts, _bound(reached, way)))
    return list(found.values())


def _greedily(robots: int, first: int, reached: Reached) -> list[int]:
    """Sites: `first`, then each time the one that adds most to the bound."""
    chances, worth = reached.chances, 1.0 if reached.value is None else reached.value
    team, missed = [first], 1.0 - chances[first]
    while len(team) < robots:
        team.append(int(np.argmax(chances @ (missed * worth))))
        missed = missed * (1.0 - chances[team[-1]])
    return team


def _bound(reached: Reached, team: Sequence[int]) -> float:
    return float(reached.sum(1.0 - np.prod(1.0 - reached.chances[list(team)], axis=0)))


ELSEWHERE = "where the team stands now reaches other cells than the candidates: it is not compared"


def find_starts(
    world: World,
    robots: int,
    settings: Settings,
    choices: RolloutChoices,
    *,
    depot: bool = False,
    candidates: ArrayLike = BORDER,
    source: object = "",
    words: Sequence[str] = (),
    progress: ProgressCallback | None = None,
    doing: Doing | None = None,
) -> Starts:
    """The best starts of so many robots in `world`, for robots that take over from each other.

    Args:
        depot: one place for all, else one each. candidates, source: as of `candidate_cells`.
        choices: rollouts of the last two that are left, the same ids for all; the best is rolled out again on others.

    An interruption (KeyboardInterrupt) while they are simulated leaves the best so far, `partial`; before the first
    was, it is raised again. Raises InputError.
    """
    choices = choices.timed(world.pace)
    check_search(world, settings, choices, "a search for starts")
    say = doing or quiet
    cells, notes = candidate_cells(world, candidates, source)
    say("screening")
    places = _places(world, robots, settings, cells, depot)
    field = _Field(world, settings, choices, places, depot)
    stopped, fresh = False, dict[int, Measured]()
    say("simulating")
    try:
        field.race.run(progress)
        say("the best on fresh rollouts")
        fresh = {place: field.race.confirm(field.contender(place)) for place in {field.best, *field.now}}
    except KeyboardInterrupt:
        if not field.race.runs:
            raise
        stopped = True
    answer = Starts(
        world=world,
        settings=settings,
        depot=depot,
        choices=choices,
        places=field.figures(),
        best=field.best,
        candidates=cells,
        cells=field.cells,
        engine="" if field.race.exact else choose_engine(choices.engine).name,
        rolled=field.race.rolled + sum(found.rollouts for found in fresh.values()),
        gain=field.gain(fresh),
        words=tuple(words),
        partial=stopped,
        notes=notes + (() if field.now else (ELSEWHERE,)) + screened(settings),
    )
    at = answer.here if answer.chosen is not answer.places[answer.best] else answer.best
    return answer if at not in fresh else replace(answer, confirmed=field.known(answer.chosen, fresh[at]))


def team_size(world: World, robots: int | None) -> int:
    """How many robots: as asked for, else as many as the input's starts, else its count, else 1. Raises UsageError."""
    check_robots(robots)
    named = len(world.starts) if world.starts is not None else world.team.robots or 1
    return named if robots is None else robots


def _places(world: World, robots: int, settings: Settings, cells: NDArray[np.int64], depot: bool) -> list[Place]:
    """What may be simulated, `entered` where they are: depots, with teams of free starts unless a `depot` is asked for.

    The last is where the team stands now, if it can reach the same cells.
    """
    sites = sites_of(world, cells)
    reached = reached_from(world, sites)
    depots = depots_of(world, robots, settings, sites, reached)
    for place in worth_simulating(depots, sites):
        depots[place] = replace(depots[place], entered=True)
    found = {} if not depot else {place.starts.tobytes(): place for place in depots}
    if not depot:
        found = {place.starts.tobytes(): place for place in depots if place.entered}
        found |= {place.starts.tobytes(): replace(place, entered=True) for place in teams_of(robots, sites, reached)}
    now = standing(world, robots)
    if not np.array_equal(world.accessible(now), world.accessible(cells[:1])):
        return list(found.values())
    known = found.pop(now.tobytes(), None) or Place(now, reached.bound(world, now))
    return [*found.values(), replace(known, entered=True, now=True)]


def standing(world: World, robots: int) -> NDArray[np.int64]:
    """Where the team stands if nobody says otherwise: the first so many starts of the input, else by its rule."""
    if world.starts is not None and len(world.starts) >= robots:
        return world.starts[:robots]
    return place_starts(world, robots, world.team.start)[0]


class _Field:
    """The places that are simulated against each other, and what is known of them.

    Attributes:
        race: of those `entered`, in the order of the places. cells: accessible.
        now: the place where the team stands, or none.
    """

    def __init__(
        self, world: World, settings: Settings, choices: RolloutChoices, places: Sequence[Place], depot: bool
    ) -> None:
        self.places = places
        self.entered = [number for number, place in enumerate(places) if place.entered]
        self.now = [number for number in self.entered if places[number].now]
        self.cells = int(world.accessible(places[0].starts).sum())
        depots = {self.contender(number) for number in self.entered if places[number].is_depot}
        hers = {self.contender(number) for number in self.now}
        self.able = depots if depot else range(len(self.entered))
        pairs = AllPairs()

        def enter(number: int) -> Trial:
            return Trial(world, allocated_plan(world, places[number].starts, settings), choices, pairs)

        self.race = Halving(
            [partial(enter, number) for number in self.entered],
            choices.rollouts,
            kept=[group for group in (depots, hers) if group],
        )

    def contender(self, place: int) -> int:
        """Its number in the race."""
        return self.entered.index(place)

    @property
    def best(self) -> int:
        """The place of the best found, of the depots where one is asked for."""
        return self.entered[self.race.best_of(self.able)]

    def known(self, place: Place, found: Measured) -> Place:
        """A place with what it comes to."""
        return replace(
            place,
            coverage=found.mean("visited", 1.0 / self.cells),
            value=found.mean("value") if found.counted == "value" else None,
            losses=found.mean("lost"),
            rollouts=found.rollouts,
        )

    def figures(self) -> tuple[Place, ...]:
        """All places, those that were simulated with their figures, and how far the best is ahead of the others."""
        found, best = list(self.places), self.contender(self.best)
        for contender, number in enumerate(self.entered):
            if contender in self.race.runs:
                behind = None if contender == best else self.race.behind(contender, best)
                found[number] = replace(self.known(found[number], self.race.runs[contender]), behind=behind)
        return tuple(found)

    def gain(self, fresh: Mapping[int, Measured]) -> Estimate | None:
        """How much more is covered from the best than from where the team stands, on fresh rollouts."""
        if not self.now or self.now[0] == self.best or self.now[0] not in fresh:
            return None
        best = fresh[self.best]
        unit = 1.0 if best.counted == "value" else 1.0 / self.cells
        return best.ahead(fresh[self.now[0]], best.counted, unit)
