"""Best start positions of a team: screened by an upper bound and eq. (4), then compared in simulation.

1. Every candidate: the upper bound `sum_c g_c` (`analysis.theory.bounds.reach_chances`), one search for each site.
2. One depot: eq. (4) of one robot's plan from PLANNED candidates, taken from the sites in rotation, best bound first.
   One start for each robot: teams chosen greedily by the bound, with each site as the first; and the depots.
3. The best SIMULATED of them and the present starts: successive halving on common random numbers
   (`analysis.estimators.racing`). The best depot and the present starts are never eliminated. The recommended place is
   compared with them on fresh rollouts.
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

from analysis.estimators.racing import Halving, Search, check_search, screened
from analysis.estimators.trial import Measured
from analysis.report.result import Searched, run_again
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate
from analysis.theory.bounds import best_survival
from analysis.theory.exact import CellValues, open_loop_exact
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.arguments import argument
from planner.errors import MapError, UsageError
from planner.files import check_file, read_csv_grid, read_npy, starts_with_header
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.plan.state_file import cell_columns
from planner.settings import Settings
from planner.world.points import read_table
from planner.world.start_rule import check_robots, place_starts
from planner.world.world import FOUR_NEIGHBOURS, MAX_CELLS, World

# Results: the places with their bounds and estimates, the best place, and the gain over the present starts.


@dataclass(frozen=True, eq=False)
class Place:
    """Start positions of a team, with bounds and estimates.

    Attributes:
        starts: int64 `[K, 2]`.
        screen: policy-independent upper bound of the expected cells visited (or of their value), `sum_c g_c` of
            `reach_chances`.
        one_robot: eq. (4): expected cells (or value) visited by one robot alone; None: not planned.
        coverage: by the team, in the metric of the choices, a fraction of the accessible cells; None: not simulated.
        value: visited, a fraction of the value of all free cells; None: the map has no values.
        losses: robots lost. rollouts: number of rollouts of the estimates.
        behind: interval of the best place's lead in coverage (or value); the intervals of one search are simultaneous
            95 % intervals.
        entered: it was selected for simulation. now: these are the present starts.
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
    json_keys = "starts screen one_robot coverage losses behind rollouts value?"

    @property
    def is_depot(self) -> bool:
        """All robots start in one cell."""
        return bool((self.starts == self.starts[0]).all())

    @property
    def counted(self) -> Estimate | None:
        """The figure that is compared, a fraction: value if the map has values, else coverage."""
        return self.coverage if self.value is None else self.value

    @property
    def at(self) -> str:
        """Coordinates for reports: one place for all robots, or one for each."""
        places = self.starts[:1] if self.is_depot else self.starts
        return " ".join(f"[{row}, {col}]" for row, col in places.tolist())


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Starts(Searched):
    """The result of `starts`; `words`: arguments of the command without the starts.

    Attributes:
        depot: one place for all robots.
        places: depots in order of screening, or teams of starts and depots; then the present starts.
        best: index of the best place found, among the depots if `depot`.
        gain: coverage (or value) of the best minus that of `here`, on fresh rollouts, a fraction.
        candidates: int64 `[C, 2]`, cells in which robots may start. rolled: number of rollouts of all places.
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
    json_keys = """
        depot choices.metric shown.coverage value?=shown.value stay gain now=present confirmed=confirmed
        confirmed.first_rollout=first_fresh candidates=listed_places command rolled
    """

    @property
    def shown(self) -> Place:
        """The recommended place, on fresh rollouts unless the search was interrupted."""
        return self.confirmed or self.chosen

    @property
    def present(self) -> Place | None:
        """The present starts; None: they lie in another component."""
        return None if self.here is None else self.places[self.here]

    @property
    def listed_places(self) -> tuple[Place, ...]:
        """All places; of a depot its cell alone."""
        return tuple(replace(place, starts=place.starts[:1]) for place in self.places) if self.depot else self.places

    @property
    def command(self) -> str | None:
        """The command that evaluates the best starts with the same options; None in Python."""
        at = ";".join(f"{row},{col}" for row, col in self.starts.tolist())
        ends = [] if self.choices.deadline is None else ["--deadline", str(self.choices.deadline)]
        return run_again(self.words, ["--starts", at, *ends], self.choices, exact=self.exact) if self.words else None

    @property
    def covered(self) -> str:
        """The quantity of the figures, for sentences."""
        if self.choices.metric != "visited":
            return self.choices.metric
        return "covered" if self.world.value is None else "of the value covered"

    @property
    def here(self) -> int | None:
        """Index of the present starts, those of the input or of its rule; None: they lie in another component."""
        return next((number for number, place in enumerate(self.places) if place.now), None)

    @property
    def stay(self) -> bool:
        """Whether no place found is significantly better than the present starts (95 %)."""
        return self.here is not None and (self.best == self.here or (self.gain is not None and self.gain.ci95[0] <= 0))

    @property
    def chosen(self) -> Place:
        """The recommended place: the present starts if `stay`, else the best; with `depot` always the best depot."""
        return self.places[self.here if self.here is not None and self.stay and not self.depot else self.best]

    @property
    def starts(self) -> NDArray[np.int64]:
        """Of the recommended place, int64 `[K, 2]`."""
        return self.chosen.starts

    @cached_property
    def simulated(self) -> tuple[Place, ...]:
        """The simulated places, the recommended first, then by the compared figure."""
        rest = [p for p in self.places if p.coverage is not None and p is not self.chosen]
        return (self.chosen, *sorted(rest, key=lambda p: -p.counted.mean if p.counted else 0.0))

    @property
    def beaten(self) -> int:
        """Number of other places that are significantly worse than the best found (simultaneous 95 %)."""
        return sum(p.behind is not None and p.behind[0] > 0 for p in self.places)

    @property
    def world_with_starts(self) -> World:
        """The map with these starts, to save or to evaluate."""
        return self.world.with_starts(self.starts)

    def plan(self) -> Plan:
        """The plan from the recommended place."""
        return make_plan(self.world, self.starts, self.settings)


# Candidates: the border of the map, a mask, or a list.
#
# A *site* is a set of candidates with the same upper bound: the candidates of one connected area without threat, in
# which moves are free of risk. A candidate with threat is its own site.

BORDER = "border"
Cells = NDArray[np.int64]
"""(row, col) of cells, int64 `[C, 2]`."""


def border(world: World) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells without threat on the edge of the map, or next to obstacles connected to it, like a sea."""
    around, _ = ndimage.label(np.pad(~world.free, 1, constant_values=True), structure=FOUR_NEIGHBOURS)
    near = ndimage.binary_dilation(around == around[0, 0], FOUR_NEIGHBOURS)[1:-1, 1:-1]
    # The border region includes obstacles that touch the edge, as a sea does.
    return near & (world.threat == 0)


def read_candidates(path: Path) -> tuple[NDArray, tuple[str, ...]]:
    """A mask or a list of cells from a .npy or .csv file, and notes. Raises InputError."""
    if path.suffix.lower() not in (".npy", ".csv"):
        problem = f"{argument('candidates')} {path} is neither {BORDER!r} nor such a file"
        raise UsageError(problem, expected="a mask of the map or rows of row,col as .npy or .csv")
    check_file(path, "a mask of the map, or rows of row,col")
    if path.suffix.lower() == ".npy":
        return read_npy(path, MAX_CELLS), ()
    if not starts_with_header(path):
        return read_csv_grid(path, MAX_CELLS)
    table = read_table(path, "lines row, col")
    if not (columns := cell_columns(table)):
        raise MapError(table.described, source=path, expected="row and col")
    return table.places(columns, ("row", "col")), table.notes


def candidate_cells(world: World, given: ArrayLike, source: object = "") -> tuple[Cells, tuple[str, ...]]:
    """Candidates in one connected part of the map, in order of index, and notes.

    Args:
        given: "border"; a mask `[H, W]`, non-zero where robots may start; or a list of (row, col) `[C, 2]`.
            Two columns of numbers are a list, unless they are booleans.
        source: the file that it comes from, for errors.

    Robots start in one component of the map: the largest that has a candidate. Raises UsageError.
    """
    cells = _cells(world, given, str(source))
    labels = world.components
    part = labels[tuple(cells.T)]
    size = np.bincount(labels.ravel())
    # Ties between equal components are broken by label, so that the result is reproducible.
    best = min(set(part.tolist()), key=lambda name: (-size[name], name))
    kept = cells[part == best]
    left_out = len(cells) - len(kept)
    note = f"{left_out} of {len(cells)} candidates lie in smaller components of the map, out of reach of the others"
    return kept, (f"{note}: omitted",) if left_out else ()


def _cells(world: World, given: ArrayLike, source: str) -> Cells:
    """The candidates, sorted. Raises UsageError."""
    name = source or argument("candidates")
    if isinstance(given, str):
        if given != BORDER:
            raise UsageError(argument("candidates", given), expected=f"{BORDER!r}, a mask of the map, or cells")
        found = np.argwhere(border(world))
        if not len(found):
            raise UsageError("no cell on the border of the map is safe", fix="name candidates in a file")
        return found
    array = np.asarray(given)
    listed = array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] == 2
    if not listed and (array.shape != world.shape or array.dtype.kind not in "bfiu"):
        expected = f"a mask of the map, {world.shape}, or rows of row,col"
        raise UsageError(f"{name}: has shape {array.shape}", expected=expected)
    if listed and not (np.isfinite(array).all() and (array == np.round(array)).all() and (abs(array) < 2**31).all()):
        raise UsageError(f"{name}: holds numbers that are not cells", expected="row,col in whole numbers")
    # Both orders are by row, then by column.
    cells = np.unique(array.astype(np.int64), axis=0) if listed else np.argwhere(np.nan_to_num(array) != 0)
    if not len(cells):
        raise UsageError(f"{name}: names no cell", expected="a candidate or more")
    off = cells[((cells < 0) | (cells >= world.shape)).any(axis=1)]
    if len(off):
        expected = f"row 0..{world.shape[0] - 1} and col 0..{world.shape[1] - 1}"
        raise UsageError(f"{name}: {off[0].tolist()} lies off the map", expected=expected)
    blocked = cells[~world.free[tuple(cells.T)]]
    if len(blocked):
        problem = f"{name}: {blocked[0].tolist()} is an obstacle ({len(blocked)} such of {len(cells)})"
        raise UsageError(problem, expected="free cells", fix="remove it")
    return cells


def sites_of(world: World, cells: Cells) -> list[Cells]:
    """The candidates grouped by site; the first ones of each site are far from each other."""
    areas, count = ndimage.label(world.threat == 0, structure=FOUR_NEIGHBOURS)
    site = areas[tuple(cells.T)].astype(np.int64)
    dangerous = site == 0
    # Labels of single-cell sites follow those of the areas.
    site[dangerous] = count + 1 + np.arange(int(dangerous.sum()))
    return [spread_out(cells[site == name]) for name in np.unique(site)]


def spread_out(cells: Cells, most: int = 256) -> Cells:
    """Farthest-point order of the cells, starting far from the mean; after the first `most`, the given order."""
    left = np.sum((cells - cells.mean(axis=0)) ** 2, axis=1)
    order: list[int] = []
    while len(order) < min(most, len(cells)):
        order.append(int(np.argmax(left)))
        apart = np.sum((cells - cells[order[-1]]) ** 2, axis=1)
        left = np.minimum(left, apart) if len(order) > 1 else apart.astype(np.float64)
        # Cells already in the order must not be selected again.
        left[order] = -1.0
    rest = np.setdiff1d(np.arange(len(cells)), order)
    return cells[np.concatenate([np.array(order, dtype=np.int64), rest])]


def round_robin(sites: Sequence[NDArray[np.int64]]) -> Iterator[NDArray[np.int64]]:
    """The first item of every site, then the second of every one, ..."""
    for row in zip_longest(*map(list, sites)):
        yield from (item for item in row if item is not None)


# Selection for simulation: by the upper bound; depots also by eq. (4) of one robot; teams are chosen greedily.

PLANNED, SIMULATED = 64, 48
"""Largest number of depots for which eq. (4) is computed, and of depots that are simulated."""
SHARED = 24
"""Simulated depots that are taken from the sites in rotation, so that no site takes all."""
TEAMS = 24
"""Largest number of simulated teams with one start for each robot."""
MOST_CHANCES = 2**27
"""Largest number of (site, accessible cell) pairs whose probabilities are stored: 1 GiB."""


class Reached(NamedTuple):
    """Upper bounds of the probability that one robot from each site visits each accessible cell, `[S, A]`.

    `value`: of those cells, `[A]`; None: all cells count 1.
    """

    chances: NDArray[np.float64]
    value: NDArray[np.float64] | None

    def bound(self, world: World, starts: NDArray[np.int64]) -> float:
        """The upper bound for a team with starts `[K, 2]` in any cells."""
        # Robots are bounded independently: probability that each one misses each cell.
        missed = 1.0 - best_survival(world, starts)[:, np.flatnonzero(world.accessible(starts))]
        return float(self.sum(1.0 - np.prod(missed, axis=0)))

    def sum(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """The sum over the last axis, weighted by the cells' value."""
        total: NDArray[np.float64] = of_cells.sum(axis=-1) if self.value is None else of_cells @ self.value
        return total


def reached_from(world: World, sites: Sequence[NDArray[np.int64]]) -> Reached:
    accessible = np.flatnonzero(world.accessible(sites[0][:1]))
    if len(sites) * len(accessible) > MOST_CHANCES:
        most = MOST_CHANCES // len(accessible)
        problem = f"candidates in {len(sites):,} areas separated by threats"
        raise UsageError(problem, expected=f"at most {most:,} on this map", fix="name fewer")
    chances = np.concatenate([best_survival(world, site[:1])[:, accessible] for site in sites])
    return Reached(chances, None if world.value is None else world.value.reshape(-1)[accessible])


def depots_of(
    world: World, robots: int, settings: Settings, sites: Sequence[NDArray[np.int64]], reached: Reached
) -> list[Place]:
    """Every candidate as a depot, best bound first; `one_robot` is set for the first PLANNED of them."""
    # All robots start at the site, so each misses a cell with the same probability.
    bounds = reached.sum(1.0 - (1.0 - reached.chances) ** robots)
    order = np.argsort(-bounds, kind="stable").tolist()
    ordered = [sites[site] for site in order]
    planned = {}
    for cell in islice(round_robin(ordered), PLANNED):
        alone = make_plan(world, cell[None], settings.alone)
        known = open_loop_exact(alone, world)
        own = known.visited if world.value is None else float(CellValues.of(world).value @ known.visited_by_cell)
        planned[tuple(cell.tolist())] = own
    return [
        Place(np.tile(cell, (robots, 1)), float(bounds[site]), planned.get(tuple(cell.tolist())))
        for site, cells in zip(order, ordered, strict=True)
        for cell in cells
    ]


def depots_to_simulate(places: Sequence[Place], sites: Sequence[NDArray[np.int64]]) -> list[int]:
    """Indices of the depots to simulate: SHARED from the sites in rotation, then by eq. (4) of the nearest planned one.

    Eq. (4) hardly varies within a site; depots with equal values are spread out.
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
            # Unplanned candidates take eq. (4) of the nearest planned one in the same site.
            expected[numbers] = values[near.argmin(axis=1)]
            leaders.append(known[np.argsort(-values, kind="stable")])
    leaders.sort(key=lambda numbers: (-expected[numbers[0]], numbers[0]))
    chosen = [int(number) for number in islice(round_robin(leaders), SHARED)]
    for value in np.unique(expected[np.isfinite(expected)])[::-1]:
        alike = np.setdiff1d(np.flatnonzero(expected == value), chosen)
        if len(alike) and len(chosen) < SIMULATED:
            spread = spread_out(np.array([places[number].starts[0] for number in alike]))
            chosen += [at[tuple(cell.tolist())] for cell in spread[: SIMULATED - len(chosen)]]
    return chosen


def teams_of(robots: int, sites: Sequence[NDArray[np.int64]], reached: Reached) -> list[Place]:
    """Teams with one start for each robot, greedy by the bound for every first site; and all robots in one site.

    The bound is a submodular set function, so a greedy team's bound is at least 1 - 1/e of the best team's (Nemhauser,
    Wolsey, Fisher 1978). It is equal for all cells of a site, so several teams use the same sites with other cells.
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
                # Different rotations can give the same team.
                found.setdefault(starts.tobytes(), Place(starts, _bound(reached, way)))
    return list(found.values())


def _greedily(robots: int, first: int, reached: Reached) -> list[int]:
    """Sites: `first`, then in each step the site that adds most to the bound."""
    chances, values = reached.chances, 1.0 if reached.value is None else reached.value
    team, missed = [first], 1.0 - chances[first]
    while len(team) < robots:
        team.append(int(np.argmax(chances @ (missed * values))))
        # Marginal gains shrink by the probability that the team already reaches the cell.
        missed = missed * (1.0 - chances[team[-1]])
    return team


def _bound(reached: Reached, team: Sequence[int]) -> float:
    return float(reached.sum(1.0 - np.prod(1.0 - reached.chances[list(team)], axis=0)))


ELSEWHERE = "The present starts reach other cells than the candidates and are not compared"


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
    """The best start positions of a team in `world`, for closed-loop missions.

    Args:
        depot: one place for all robots, else one for each. candidates, source: see `candidate_cells`.
        choices: rollouts of the two finalists, the same ids for all places; the best is simulated again on fresh ids.

    Returns:
        The result. After an interruption (KeyboardInterrupt) of the simulations: the best so far, `partial`.

    Raises:
        InputError: no valid candidate, or an argument out of range.
        KeyboardInterrupt: before the first place was simulated.
    """
    check_search(world, settings, choices, "a search for starts")
    cells, notes = candidate_cells(world, candidates, source)
    (doing or quiet)("screening")
    places = _places(world, robots, settings, cells, depot)
    field = _Field(world, settings, choices, places, depot, doing)
    # The winner of a race is biased upward, so its figures come from fresh rollouts.
    fresh = dict[int, Measured]()
    field.doing("simulating")
    with field.stoppable(lambda: field.race.runs):
        field.race.run(progress)
        field.doing("the best on fresh rollouts")
        fresh = {place: field.race.confirm(field.contender(place)) for place in {field.best, *field.now}}
    field.exact = field.race.exact
    field.notes += notes + (() if field.now else (ELSEWHERE,)) + screened(settings, world)
    answer = Starts(
        **field.fields(),
        depot=depot,
        places=field.figures(),
        best=field.best,
        candidates=cells,
        rolled=field.race.rolled + sum(found.rollouts for found in fresh.values()),
        gain=field.gain(fresh),
        words=tuple(words),
    )
    at = answer.here if answer.chosen is not answer.places[answer.best] else answer.best
    return answer if at not in fresh else replace(answer, confirmed=field.known(answer.chosen, fresh[at]))


def team_size(world: World, robots: int | None) -> int:
    """The team's size: as given, else the number of the input's starts, else its count, else 1. Raises UsageError."""
    check_robots(robots)
    named = len(world.starts) if world.starts is not None else world.team.robots or 1
    return named if robots is None else robots


def _places(world: World, robots: int, settings: Settings, cells: NDArray[np.int64], depot: bool) -> list[Place]:
    """The places, `entered` if selected for simulation: depots, and with free starts also teams.

    The last one is the present starts, if they reach the same cells.
    """
    sites = sites_of(world, cells)
    reached = reached_from(world, sites)
    depots = depots_of(world, robots, settings, sites, reached)
    for place in depots_to_simulate(depots, sites):
        depots[place] = replace(depots[place], entered=True)
    found = {} if not depot else {place.starts.tobytes(): place for place in depots}
    if not depot:
        found = {place.starts.tobytes(): place for place in depots if place.entered}
        found |= {place.starts.tobytes(): replace(place, entered=True) for place in teams_of(robots, sites, reached)}
    now = standing(world, robots)
    if not np.array_equal(world.accessible(now), world.accessible(cells[:1])):
        return list(found.values())
    # The present starts come last and once, also if they are among the candidates.
    known = found.pop(now.tobytes(), None) or Place(now, reached.bound(world, now))
    return [*found.values(), replace(known, entered=True, now=True)]


def standing(world: World, robots: int) -> NDArray[np.int64]:
    """The present starts: the first of the input's starts, else those of its rule."""
    if world.starts is not None and len(world.starts) >= robots:
        return world.starts[:robots]
    return place_starts(world, robots, world.team.start)[0]


class _Field(Search):
    """The simulated places and their estimates.

    Attributes:
        race: of the places that are `entered`, in their order.
        now: index of the present starts, as a list of length 0 or 1.
    """

    def __init__(
        self,
        world: World,
        settings: Settings,
        choices: RolloutChoices,
        places: Sequence[Place],
        depot: bool,
        doing: Doing | None,
    ) -> None:
        super().__init__(world, places[0].starts, settings, choices, doing=doing)
        self.places = places
        self.entered = [number for number, place in enumerate(places) if place.entered]
        self.now = [number for number in self.entered if places[number].now]
        depots = {self.contender(number) for number in self.entered if places[number].is_depot}
        present = {self.contender(number) for number in self.now}
        self.able = depots if depot else range(len(self.entered))
        trials = [partial(self.trial, starts=places[number].starts) for number in self.entered]
        self.race = Halving(trials, choices.rollouts, kept=[group for group in (depots, present) if group])

    def contender(self, place: int) -> int:
        """Index of a place in the race."""
        return self.entered.index(place)

    @property
    def best(self) -> int:
        """Index of the best place, among the depots if one depot is needed."""
        return self.entered[self.race.best_of(self.able)]

    def known(self, place: Place, found: Measured) -> Place:
        """The place with its estimates."""
        return replace(
            place,
            coverage=found.mean(found.metric, 1.0 / self.cells),
            value=found.mean("value") if found.counted == "value" else None,
            losses=found.mean("lost"),
            rollouts=found.rollouts,
        )

    def figures(self) -> tuple[Place, ...]:
        """All places; those simulated with estimates and with the best place's lead over them."""
        found, best = list(self.places), self.contender(self.best)
        for contender, number in enumerate(self.entered):
            if contender in self.race.runs:
                behind = None if contender == best else self.race.behind(contender, best)
                found[number] = replace(self.known(found[number], self.race.runs[contender]), behind=behind)
        return tuple(found)

    def gain(self, fresh: Mapping[int, Measured]) -> Estimate | None:
        """Coverage (or value) of the best minus that of the present starts, on fresh rollouts."""
        if not self.now or self.now[0] == self.best or self.now[0] not in fresh:
            return None
        best = fresh[self.best]
        unit = 1.0 if best.counted == "value" else 1.0 / self.cells
        return best.ahead(fresh[self.now[0]], best.counted, unit)
