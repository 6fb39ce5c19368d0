"""A world made ready for planning: levels, costs, safest paths, and the policy's limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from planner.arguments import MAX_STEP, argument
from planner.errors import PlanError, WorldError
from planner.mrac.areas import connected_parts, sides_first
from planner.mrac.home_paths import Homeward, OwnMaps, own_maps, ways_home, ways_to
from planner.plan.plan import Area, Plan
from planner.policies import Rule, rule_of
from planner.policies.rules import refusal_threshold
from planner.settings import Settings
from planner.simulator.codes import BLOCKED, NO_ROBOT
from planner.simulator.offers import Offer
from planner.simulator.searches import SafestPaths, safest_paths
from planner.world.features import as_planned
from planner.world.levels import NO_LEVEL, ThreatLevels, entry_costs, find_levels, level_costs, levels_of_maps
from planner.world.map_knowledge import Evidence, Knowledge, Sense
from planner.world.moving_threats import Phases
from planner.world.uncertain_maps import Hazard, Uncertain
from planner.world.world import FOUR_NEIGHBOURS, World, check_starts

# What robots that are not told the map believe at first, and what may be true: levels on one scale (SPEC section 15).
#
# Robots that learn about hazards believe one of several classes of each cell, whatever is true.


@dataclass(frozen=True, eq=False)
class Unknown:
    """What is believed and true. Axes: `N` = H * W cells, `M` maps of which one is true, `L` levels.

    Attributes:
        knowledge: of the world. values: float64 `[L]`, of all maps together; quantised: as of `ThreatLevels`.
        belief: int16 `[N]`, level of each cell that is believed free, NO_LEVEL of an obstacle: before the first step.
        truths: int16 `[M, N]`, the same truly; of hazards, what each class of the evidence makes robots believe; of
            phases, what is true in each.
        within: bool `[N]`, cells that robots may come to reach, whatever they learn.
        accessible: bool `[N]`, those that they truly can reach.
        evidence: what robots that learn about hazards go by; None: they see what is true.
        phases: of threats that change, of which robots are told as they do; None: nothing changes.
    """

    knowledge: Knowledge
    values: NDArray[np.float64]
    quantised: bool
    belief: NDArray[np.int16]
    truths: NDArray[np.int16]
    within: NDArray[np.bool_]
    accessible: NDArray[np.bool_]
    evidence: Evidence | None = None
    phases: Phases | None = None

    @property
    def looks(self) -> bool:
        """Whether robots look about, for cells that nobody has seen yet."""
        return self.evidence is None and self.phases is None

    @cached_property
    def learns(self) -> bool:
        """Whether anything is left to learn, and somebody looks."""
        differ = (self.truths != self.belief)[:, self.within]
        return (not self.looks or self.knowledge.sense.range > 0) and bool(differ.any())

    @cached_property
    def last_update(self) -> int:
        """The step from which the last announced phase holds that changes a level which robots know of; 0: none."""
        if self.phases is None:
            return 0
        changes = (self.truths[1:] != self.truths[:-1])[:, self.within].any(axis=1)
        return int(self.phases.begins[1:][changes].max(initial=0))

    @property
    def dearest(self) -> ThreatLevels:
        """Every cell that may be reached at the highest level that it may have."""
        most = np.maximum(self.truths.max(axis=0), self.belief)
        return ThreatLevels(self.values, np.where(self.within, most, NO_LEVEL).astype(np.int16), self.quantised)

    @cached_property
    def views(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """What is seen from each cell that may be reached, of such cells (`Sense.views`), in order of the cells."""
        begin, seen = self.knowledge.sense.views(self.knowledge.free, np.flatnonzero(self.within))
        kept = self.within[seen]
        return np.append(0, np.cumsum(kept))[begin], seen[kept]


def unknown_of(world: World, starts: NDArray[np.int64], most: int) -> Unknown | None:
    """Of robots at `starts` `[K, 2]` and at most so many levels; None where they are told the map."""
    known = world.knowledge
    if world.learned_hazard is not None:
        return _of_hazards(world, world.learned_hazard.evidence, starts, most)
    if world.phases is not None and world.phases.told:
        return _of_phases(world, world.phases, starts, most)
    if known is None:
        return None
    told = as_planned(world, starts).threat
    if isinstance(world.doubt, Uncertain) and world.doubt.whole:
        true = np.stack([world.doubt.threat_at(row).ravel() for row in range(world.doubt.count)])
    else:
        true = known.truth.reshape(1, -1)
    free = known.free | ~np.isnan(world.threat)
    within = reached(free, starts[:, 0] * world.shape[1] + starts[:, 1])
    # On the scale of what was believed before anybody looked, and of all that may be true: it tells no place.
    values, of_cell, quantised = levels_of_maps(np.concatenate([world.threat.reshape(1, -1), true]), within, most)
    looked = ((told != world.threat) & ~(np.isnan(told) & np.isnan(world.threat))).ravel()
    belief = np.where(looked, of_cell[1], of_cell[0]).astype(np.int16)
    return Unknown(known, values, quantised, belief, of_cell[1:], within, world.accessible(starts).ravel())


def _of_hazards(world: World, evidence: Evidence, starts: NDArray[np.int64], most: int) -> Unknown | None:
    """Of robots that learn about hazards; None where nothing that happens changes what they plan on."""
    within = world.accessible(starts).ravel()
    classes, first = evidence.chances, world.threat.ravel()
    if np.array_equal(classes[:, within], np.broadcast_to(first[within], classes[:, within].shape), equal_nan=True):
        return None
    values, of_cell, quantised = levels_of_maps(classes, within, most)
    detector = evidence.detector
    known = Knowledge(world.threat, Sense() if detector is None else detector.sense)
    belief = of_cell[evidence.class_of(evidence.prior, np.arange(len(first))), np.arange(len(first))]
    return Unknown(known, values, quantised, belief, of_cell, within, within, evidence)


def _of_phases(world: World, phases: Phases, starts: NDArray[np.int64], most: int) -> Unknown | None:
    within = world.accessible(starts).ravel()
    if (world.by_phase == world.by_phase[0])[:, within].all():
        return None
    values, of_cell, quantised = levels_of_maps(world.by_phase, within, most)
    known = Knowledge(world.threat, Sense())
    return Unknown(known, values, quantised, of_cell[0], of_cell, within, within, phases=phases)


def reached(free: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """bool `[N]`: the free cells, bool `[H, W]`, in a connected part with one of these."""
    part = ndimage.label(free, FOUR_NEIGHBOURS)[0].ravel()
    return (part > 0) & np.isin(part, part[cells])


NO_LIMIT = 2**40
"""More moves than a run has steps."""
MOST_WORTH = 1000
"""What decisions count a cell of the largest value by."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A world made ready for planning with given starts. Axis `N` = H * W cells.

    Attributes:
        world, settings: what was asked. starts: int64 `[K]`, cell index of each robot.
        levels: the threat levels of the accessible cells. costs: int64 `[N]`, entry costs of eq. (3).
        paths: safest paths over the accessible cells.
        part: int32 `[N]`, connected part of the accessible cells that each of them is in, from 1; 0 elsewhere.
        range: int64 `[K]`, moves that each robot can make; NO_LIMIT of them where nothing limits it.
        rule: the policy's. entry: int64 `[L]`, cost of entering a cell of each level (1 where a level has none).
        given: paths of another planner, int64 `[steps + 1]` each, that the robots follow first; empty: none.
        sides: int64 `[N, 4]`, which neighbour goes first on coverage paths (`planner.mrac.areas`).
        value: int64 `[N]`, what attentive robots count cells by; None: 1 each.
        unknown: what robots are not told of the map, None: nothing. Levels, costs, paths and parts are of what they
            believe, and all that is accessible is what they believe that one of them can reach.
        home: the ways home of robots that come home (SPEC section 19); None: they do not.
        own: the maps of robots that differ in type (SPEC section 22), None: they are alike. `entry` is then by level of
            their common scale, `costs` and `paths` those of the type that pays most for each cell.
    """

    world: World
    settings: Settings
    starts: NDArray[np.int64]
    levels: ThreatLevels
    costs: NDArray[np.int64]
    paths: SafestPaths
    part: NDArray[np.int32]
    range: NDArray[np.int64]
    rule: Rule
    entry: NDArray[np.int64]
    sides: NDArray[np.int64]
    given: tuple[NDArray[np.int64], ...] = ()
    value: NDArray[np.int64] | None = None
    unknown: Unknown | None = None
    home: Homeward | None = None
    own: OwnMaps | None = None

    @cached_property
    def bases(self) -> NDArray[np.int64]:
        """int64 `[B, 2]`, (row, col): starts, and where robots come home to: who takes over is in touch with one."""
        home = self.settings.return_to
        listed = () if home is None or isinstance(home, str) else home
        cells = self.starts if self.home is None else np.concatenate([self.starts, self.home.starts])
        own = np.stack(np.divmod(np.unique(cells), self.world.shape[1]), axis=1)
        return np.concatenate([own, np.array(listed, dtype=np.int64).reshape(-1, 2)])

    @cached_property
    def back(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Ways to where a robot is in touch, home or to the nearest start: of each robot `[K]` which of them it takes,
        and what is entered next from each cell `[S, N]`, NO_CELL at the end.
        """
        if self.home is not None:
            return self.home.of, self.home.onward
        of = np.zeros(len(self.starts), dtype=np.int64) if self.own is None else self.own.of
        kinds = [(self.paths, self.costs)] if self.own is None else zip(self.own.paths, self.own.costs, strict=True)
        bases = np.unique(self.starts)
        return of, np.stack([ways_to(bases, *kind)[2] for kind in kinds])

    def paths_of(self, robot: int) -> SafestPaths:
        """The robot's safest paths."""
        return self.paths if self.own is None else self.own.paths[self.own.of[robot]]

    @property
    def max_steps(self) -> int:
        """T_max of the run (SPEC section 5) or its deadline, at most what the random-number counter can address."""
        levels = self.levels if self.unknown is None else self.unknown.dearest
        return most_steps(self.settings, levels, max(map(len, self.given), default=1) - 1)

    @property
    def learns(self) -> bool:
        """Whether robots may come to believe another map than at first."""
        return self.unknown is not None and self.unknown.learns

    def believing(self, belief: NDArray[np.int16], cells: NDArray[np.int64]) -> Problem:
        """The same as robots in these cells believe it, by the level `[N]` of each cell, NO_LEVEL of an obstacle."""
        near = reached((belief != NO_LEVEL).reshape(self.world.shape), cells)
        levels = replace(self.levels, of_cell=np.where(near, belief, NO_LEVEL).astype(np.int16))
        costs = np.where(near, self.entry[belief], BLOCKED)
        part = _parts(levels, self.world.shape)
        paths = safest_paths(self.world.shape, costs)
        home = None if self.home is None else self.home.believing(paths, costs)
        return replace(self, levels=levels, costs=costs, paths=paths, part=part, home=home)

    def is_for(self, world: World, settings: Settings, accessible: NDArray[np.bool_]) -> bool:
        """Whether all but starts and ranges is that of robots in `world` that reach the `accessible` cells `[H, W]`.

        Never where they learn, differ, come home, count values or follow given paths.
        """
        if self.given or any(own is not None for own in (self.unknown, self.own, self.home, self.value, world.value)):
            return False
        mine = self.world.shape == world.shape and self.world.luck_sha256 == world.luck_sha256
        return mine and self.settings == settings and np.array_equal(self.levels.accessible, accessible.ravel())

    @property
    def stay_inside(self) -> bool:
        """`transit="area"`: legs of a coverage path stay inside the area."""
        return self.settings.transit == "area"

    @property
    def scale(self) -> int:
        """What one cell of the largest value counts."""
        return 1 if self.value is None else MOST_WORTH

    @cached_property
    def beyond(self) -> int:
        """More than the price of any area where cells have a value, else 0."""
        if self.value is None:
            return 0
        costs = self.costs if self.unknown is None else self.entry[self.unknown.dearest.of_cell[self.unknown.within]]
        return _beyond(int(costs.sum()), self.costs.size, self.entry)

    @cached_property
    def theta(self) -> int:
        """From which price per new cell on a dangerous area is refused (`robot_value`); NO_REFUSAL if none is."""
        values = self.levels.values if self.own is None else self.own.values
        least = float(values[1]) if len(values) > 1 else 0.0
        return refusal_threshold(self.settings.robot_value, self.costs.size, least, self.settings.risk)


def most_steps(settings: Settings, levels: ThreatLevels, given: int = 0) -> int:
    """T_max, or the step at which the settings end a run; `given`: steps of paths that are followed first."""
    if settings.last_step is not None:
        return settings.last_step
    slowest = max(settings.paces, default=1)
    return min(slowest * (8 * len(levels.values) * int(levels.accessible.sum()) + 64) + given, MAX_STEP)


def prepare(
    world: World,
    starts: ArrayLike,
    settings: Settings,
    given: tuple[NDArray[np.int64], ...] = (),
    homes: NDArray[np.int64] | None = None,
    before: Problem | None = None,
) -> Problem:
    """Levels, costs and safest paths of a world for robots at `starts` `[K, 2]`. Raises WorldError.

    `homes`: cells `[K]` where robots that come home started, of a mission under way. `before`: another team's problem,
    of which all is taken over that does not depend on the team, if it is of the same world and settings.
    """
    settings.check()
    if settings.paces or settings.radio is not None:
        world.check_told("a team of several speeds, or with radio,")
        if world.phases is not None:
            said = f"a team of several speeds, or with radio, presumes threats that stay: {world.phases.said}"
            raise PlanError(said, source=world.source, fix="leave `phases` out")
    checked = check_starts(starts, world.met, world.source)
    settings.check_team(len(checked), world.source)
    worlds = world.of_robots(settings.types, len(checked))
    own, mixed = None, len(set(worlds)) > 1
    world = world if mixed else worlds[0]
    unknown = unknown_of(world, checked, settings.levels)
    told = unknown is None
    rule, cells = rule_of(settings.policy), checked[:, 0] * world.shape[1] + checked[:, 1]
    given_range = NO_LIMIT if settings.range is None else settings.range
    moves = np.broadcast_to(np.asarray(given_range, dtype=np.int64), len(cells))
    if before is not None and not given and before.is_for(world, settings, world.accessible(checked)):
        return replace(before, world=world, starts=cells, range=moves)
    if mixed:
        levels, entry, own = own_maps(worlds, world.accessible(checked), settings)
        costs = own.costs.max(axis=0)
    else:
        levels = find_levels(world, world.accessible(checked), settings.levels) if unknown is None else unknown.dearest
        costs = entry_costs(levels, settings.risk, world.source)
        entry = level_costs(levels.values, costs.size, settings.risk).astype(np.int64)
    value = worth_of(world, levels.accessible, settings.priority) if rule.attentive else None
    if own is None:
        _check_comparisons(rule, levels, costs, entry, value, world.source, apart=told)
    else:  # what another type would pay less is added to what an area costs
        most = entry[own.level.max(axis=0)]
        _check_comparisons(rule, levels, 2 * costs, most, value, world.source, apart=True)
    part = _parts(levels, world.shape)
    paths = safest_paths(world.shape, costs)
    safe = (levels.of_cell if unknown is None else unknown.belief).reshape(world.shape) == 0
    sides = sides_first(settings.in_area, safe)
    problem = Problem(
        world, settings, cells, levels, costs, paths, part, moves, rule, entry, sides, given, value, unknown, None, own
    )
    problem = problem if unknown is None else problem.believing(unknown.belief, cells)
    home = ways_home(settings, cells, world.shape, problem.paths, problem.costs, homes, own)
    return problem if home is None else replace(problem, home=home)


def _parts(levels: ThreatLevels, shape: tuple[int, int]) -> NDArray[np.int32]:
    """`Problem.part`."""
    return ndimage.label(levels.accessible.reshape(shape), FOUR_NEIGHBOURS)[0].ravel()


def worth_of(
    world: World, accessible: NDArray[np.bool_], priority: int | tuple[int, ...] | None = None
) -> NDArray[np.int64] | None:
    """What decisions count cells by, int64 `[N]`: round(1000 w / max w), at least 1 where w > 0 (SPEC section 13).

    w is a cell's value times its priority. The largest is that of the accessible cells, bool `[N]`; the others count
    nothing. None where no cell has either. Raises PlanError.
    """
    if world.value is None and priority is None:
        return None
    if isinstance(priority, tuple) and len(priority) != accessible.size:
        expected = f"one number, or one for each of {accessible.size} cells"
        raise PlanError(f"{argument('priority')} of {len(priority)} cells", source=world.source, expected=expected)
    value = np.where(accessible, 1.0 if world.value is None else world.value.ravel(), 0.0) * np.asarray(priority or 1)
    share = np.rint(MOST_WORTH * (value / (value.max() or 1.0))).astype(np.int64)
    return np.where(value > 0, np.maximum(share, 1), 0)


def _beyond(longest: int, cells: int, entry: NDArray[np.int64]) -> int:
    return 1 + longest + cells * int(entry.max())


def _check_comparisons(
    rule: Rule,
    levels: ThreatLevels,
    costs: NDArray[np.int64],
    entry: NDArray[np.int64],
    value: NDArray[np.int64] | None,
    source: str,
    apart: bool,
) -> None:
    """Raise WorldError if two areas of this world might not be comparable in 64 bits (SPEC sections 11 and 13).

    `apart`: cells have these levels; else any cell may come to be of any.
    """
    found = np.bincount(levels.of_cell[levels.accessible], minlength=len(entry))
    counts = np.maximum(found if apart else np.full_like(found, found.sum()), 1).tolist()
    number, longest = len(entry), int(costs.sum())
    beyond = 0 if value is None else _beyond(longest, costs.size, entry)
    most = counts if value is None else [MOST_WORTH * n for n in counts]
    shown = [costs.size if rule.looks_ahead else 0] * number
    dearest = list(
        map(Offer, range(number), [longest] * number, counts, entry.tolist(), most, [beyond] * number, shown)
    )
    if value is not None:
        dearest += [offer._replace(value=0) for offer in dearest]
    if rule.largest(dearest) >= 2**63:
        raise WorldError(
            f"threat levels up to {levels.values[-1]:g} make areas too dear for policy {rule.name} to compare",
            source=source,
            expected="path costs times cells below 2**63",
            fix="raise the smallest threats or set them to 0, or use policy mrac",
        )


# A plan's closed loop made ready: its problem and the areas at t = 0, of MRAC's plans and of other planners' alike.
#
# Robots with paths of another planner follow them (ours; the paper has no such plans). The cells that a robot is the
# first to visit are its areas, one a level, which nobody shares; if it is stopped, what is unvisited of them is cut
# into
# connected areas for whoever is free, as the paper's `Reallocate Area` does. Cells that are on nobody's path are areas
# that nobody has from the start. A robot at the end of its path goes on as Algorithm 2 says.


def ready_loop(plan: Plan, world: World) -> tuple[Problem, tuple[Area, ...]]:
    """The problem that the plan's closed loop runs, and its areas at t = 0.

    Raises PlanError for another map, WorldError for what robots that are not told the map do not do.
    """
    settings = plan.require(world)
    if plan.is_foreign:
        settings.check_alike("a closed loop on another planner's paths")
    if plan.is_foreign or plan.state is not None:
        world.check_told("a closed loop on another planner's paths" if plan.is_foreign else "the rest of a mission")
    if settings.transit == "area":
        world.check_told('`transit="area"`, legs that stay in their area,')
    if not plan.is_foreign:
        homes = None if plan.state is None else plan.state.homes(settings.return_to)
        return prepare(world, plan.starts, settings, homes=homes), plan.areas
    problem = prepare(world, plan.starts, settings, given=tuple(robot.path for robot in plan.robots))
    return problem, areas_of_paths(problem)


def check_every_visit(world: World, first_only: bool) -> None:
    """Raise WorldError where robots would learn from visits that nobody checks."""
    if first_only and isinstance(world.doubt, Hazard):
        world.check_told(argument("threat_checks", "first_visit"))


def areas_of_paths(problem: Problem) -> tuple[Area, ...]:
    """The areas of robots that follow given paths: for each robot one a level, then the connected ones of nobody."""
    first, level = first_visitors(problem), problem.levels.of_cell
    areas = [
        Area(int(of), robot, np.flatnonzero((first == robot) & (level == of)))
        for robot in range(len(problem.given))
        for of in np.unique(level[first == robot])
    ]
    left = (first == NO_ROBOT) & problem.levels.accessible
    for of in np.unique(level[left]):
        parts = connected_parts(problem.world.shape, np.flatnonzero(left & (level == of)))
        areas += [Area(int(of), NO_ROBOT, part) for part in parts]
    return tuple(areas)


def first_visitors(problem: Problem) -> NDArray[np.int64]:
    """Of each cell the robot that is the first on it if nobody is stopped, the lowest of several; int64 `[N]`."""
    first = np.full(problem.costs.size, NO_ROBOT, dtype=np.int64)
    steps = np.concatenate([np.arange(len(path)) for path in problem.given])
    robots = np.repeat(np.arange(len(problem.given)), [len(path) for path in problem.given])
    latest_first = np.lexsort((robots, steps))[::-1]
    first[np.concatenate(problem.given)[latest_first]] = robots[latest_first]
    return first
