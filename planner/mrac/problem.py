"""A world prepared for planning: levels, costs, safest paths, the limits of the policy; and closed loops of plans."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from planner.arguments import MAX_STEP, argument
from planner.errors import PlanError, WorldError
from planner.mrac.areas import connected_parts, sides_first
from planner.mrac.home_paths import OwnMaps, WaysToBase, own_maps, ways_to, ways_to_base
from planner.plan.plan import Area, Plan
from planner.policies import Rule, rule_of
from planner.policies.rules import refusal_threshold
from planner.settings import Settings
from planner.simulator.codes import ALWAYS, BLOCKED, NO_ROBOT
from planner.simulator.offers import Offer
from planner.simulator.searches import SafestPaths, safest_paths
from planner.world.levels import NO_LEVEL, ThreatLevels, entry_costs, find_levels, level_costs, levels_of_maps
from planner.world.map_knowledge import Evidence, Knowledge, Sensor
from planner.world.moving_threats import Phases
from planner.world.start_rule import as_planned
from planner.world.uncertain_maps import Uncertain
from planner.world.world import FOUR_NEIGHBOURS, World, check_starts

# Unknown maps: the robots' first map and the candidates of the true map, with levels on one scale (SPEC section 15).
#
# With hazard estimates the candidates are classes of estimates, whatever is true.


@dataclass(frozen=True, eq=False)
class Unknown:
    """Prior and true maps. Axes: `N` = H * W cells, `M` candidates of the true map, `L` levels.

    Attributes:
        knowledge: of the world. values: float64 `[L]`, of all maps together. quantised: as in `ThreatLevels`.
        belief: int16 `[N]`, level of each cell of the robots' first map, NO_LEVEL for obstacles.
        truths: int16 `[M, N]`, the same of each true map; with hazard estimates of each class of estimates; with phases
            of each phase.
        within: bool `[N]`, cells that may become reachable on some map.
        accessible: bool `[N]`, cells that are reachable on the true map.
        evidence: of hazard estimates; None: robots see the true map.
        phases: of threats that change and become known as they do; None: nothing changes.
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
        """Whether sensors reveal cells not seen before."""
        return self.evidence is None and self.phases is None

    @cached_property
    def learns(self) -> bool:
        """Whether the robots' map may change."""
        differ = (self.truths != self.belief)[:, self.within]
        return (not self.looks or self.knowledge.sensor.range > 0) and bool(differ.any())

    @cached_property
    def last_update(self) -> int:
        """Begin of the last phase that changes a level of a reachable cell; 0: none."""
        if self.phases is None:
            return 0
        changes = (self.truths[1:] != self.truths[:-1])[:, self.within].any(axis=1)
        return int(self.phases.begins[1:][changes].max(initial=0))

    @property
    def highest(self) -> ThreatLevels:
        """The highest level that each reachable cell may have."""
        most = np.maximum(self.truths.max(axis=0), self.belief)
        return ThreatLevels(self.values, np.where(self.within, most, NO_LEVEL).astype(np.int16), self.quantised)

    @cached_property
    def views(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Reachable cells in sensor range of each reachable cell, in order of the cells (`Sensor.views`)."""
        begin, seen = self.knowledge.sensor.views(self.knowledge.free, np.flatnonzero(self.within))
        kept = self.within[seen]
        return np.append(0, np.cumsum(kept))[begin], seen[kept]


def unknown_map_of(world: World, starts: NDArray[np.int64], most: int) -> Unknown | None:
    """The unknown map of a team, or None if the map is known.

    Args:
        world: the map.
        starts: int64 `[K, 2]`, (row, col).
        most: levels, at most.
    """
    known = world.knowledge
    if world.learned_hazard is not None:
        return _of_changes(world, starts, most, world.learned_hazard.evidence.chances, world.learned_hazard.evidence)
    if world.phases is not None and world.phases.are_announced:
        return _of_changes(world, starts, most, world.by_phase, phases=world.phases)
    if known is None:
        return None
    planned = as_planned(world, starts).threat
    if isinstance(world.uncertainty, Uncertain) and world.uncertainty.whole:
        true = np.stack([world.uncertainty.threat_at(row).ravel() for row in range(world.uncertainty.count)])
    else:
        true = known.truth.reshape(1, -1)
    free = known.free | ~np.isnan(world.threat)
    within = reached(free, starts[:, 0] * world.shape[1] + starts[:, 1])
    # Levels of the prior map, before any cell was seen, and of all true maps: the scale reveals no place.
    values, of_cell, quantised = levels_of_maps(np.concatenate([world.threat.reshape(1, -1), true]), within, most)
    looked = ((planned != world.threat) & ~(np.isnan(planned) & np.isnan(world.threat))).ravel()
    belief = np.where(looked, of_cell[1], of_cell[0]).astype(np.int16)
    return Unknown(known, values, quantised, belief, of_cell[1:], within, world.accessible(starts).ravel())


def _of_changes(
    world: World, starts: NDArray[np.int64], most: int, maps: NDArray[np.float32],
    evidence: Evidence | None = None, phases: Phases | None = None,
) -> Unknown | None:  # fmt: skip
    """For hazard estimates, or for phases, with these maps `[M, N]`; None if no change affects the robots' plans."""
    within, cells = world.accessible(starts).ravel(), np.arange(world.threat.size)
    first = maps[0] if evidence is None else world.threat.ravel()
    if np.array_equal(maps[:, within], np.broadcast_to(first[within], maps[:, within].shape), equal_nan=True):
        return None
    values, of_cell, quantised = levels_of_maps(maps, within, most)
    belief = of_cell[0] if evidence is None else of_cell[evidence.class_of(evidence.prior, cells), cells]
    sensor = Sensor() if evidence is None or evidence.detector is None else evidence.detector.sensor
    return Unknown(
        Knowledge(world.threat, sensor), values, quantised, belief, of_cell, within, within, evidence, phases
    )


def _of_wrecks(world: World, starts: NDArray[np.int64], settings: Settings) -> Unknown | None:
    """For lost robots that become obstacles: estimates that a loss alone changes, on a map that is known otherwise.

    Raises:
        WorldError, PlanError: an unsupported combination.
    """
    said = argument("wrecks", "block")
    world.require_known_map(said)
    world.require_certain_map(said)
    settings.require_uniform(said)
    if settings.transit == "area":
        raise PlanError(f"{said} with {argument('transit', 'area')}", fix=f"leave {argument('transit')} out")
    p, nothing = world.threat.ravel(), np.zeros(world.threat.size, dtype=np.int64)
    # By class: never, after a loss, as planned. Nothing else is evidence.
    chances = np.stack([p, np.where(p > 0, np.nan, p), p]).astype(np.float32)
    return _of_changes(world, starts, settings.levels, chances, Evidence(nothing, nothing, ALWAYS, None, chances))


def reached(free: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """bool `[N]`: free cells in a connected part with one of some cells.

    Args:
        free: bool `[H, W]`.
        cells: int64.
    """
    part = ndimage.label(free, FOUR_NEIGHBOURS)[0].ravel()
    return (part > 0) & np.isin(part, part[cells])


NO_LIMIT = 2**40
"""More moves than a run has steps."""
VALUE_SCALE = 1000
"""Value of a cell of the largest value in decisions."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A world prepared for planning with given starts. Axis `N` = H * W cells.

    Attributes:
        world, settings: the input. starts: int64 `[K]`, cell index of each robot.
        levels: the threat levels of the accessible cells. costs: int64 `[N]`, entry costs of eq. (3).
        paths: safest paths over the accessible cells.
        part: int32 `[N]`, connected part of each accessible cell, from 1; 0 for others.
        range: int64 `[K]`, moves that each robot can make; NO_LIMIT without a limit.
        rule: of the policy. entry: int64 `[L]`, cost of entering a cell of each level (1 for an empty level).
        given: external paths, int64 `[steps + 1]` each, that the robots follow first; empty: none.
        sides: int64 `[N, 4]`, priority of neighbours on coverage paths (`planner.mrac.areas`).
        value: int64 `[N]`, values of cells in decisions of rules that re-evaluate; None: 1 each.
        unknown: the unknown map, None: the map is known. Levels, costs, paths and parts are those of the robots' map,
            and accessible cells are those that are reachable on it.
        home: the ways to base (SPEC section 19); None: robots do not return.
        own: the maps of robot types (SPEC section 22), None: one type. `entry` is then by level of their common scale,
            `costs` and `paths` are those of the type that pays most for each cell.
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
    home: WaysToBase | None = None
    own: OwnMaps | None = None

    @cached_property
    def bases(self) -> NDArray[np.int64]:
        """int64 `[B, 2]`, (row, col): starts and bases; radio contact with one of them is required to get an area."""
        home = self.settings.return_to
        listed = () if home is None or isinstance(home, str) else home
        cells = self.starts if self.home is None else np.concatenate([self.starts, self.home.starts])
        own = np.stack(np.divmod(np.unique(cells), self.world.shape[1]), axis=1)
        return np.concatenate([own, np.array(listed, dtype=np.int64).reshape(-1, 2)])

    @cached_property
    def back(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """(of int64 `[K]`, onward int32 `[S, N]`): ways back into radio contact, to base or to the nearest start.

        `of` is the way of each robot, `onward` its next cell, NO_CELL at the end.
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
        """T_max of the run (SPEC section 5) or its deadline, limited by the random-number counter."""
        levels = self.levels if self.unknown is None else self.unknown.highest
        return most_steps(self.settings, levels, max(map(len, self.given), default=1) - 1)

    @property
    def learns(self) -> bool:
        """Whether the robots' map may change."""
        return self.unknown is not None and self.unknown.learns

    def with_robot_map(self, belief: NDArray[np.int16], cells: NDArray[np.int64]) -> Problem:
        """The same problem on another map of the robots.

        Args:
            belief: int16 `[N]`, level of each cell, NO_LEVEL for obstacles.
            cells: int64 `[K]`, of the robots.
        """
        # Only cells that the team can reach on this map: others would make costs and parts depend on the unknown.
        near = reached((belief != NO_LEVEL).reshape(self.world.shape), cells)
        levels = replace(self.levels, of_cell=np.where(near, belief, NO_LEVEL).astype(np.int16))
        costs = np.where(near, self.entry[belief], BLOCKED)
        part = _parts(levels, self.world.shape)
        paths = safest_paths(self.world.shape, costs)
        home = None if self.home is None else self.home.with_robot_map(paths, costs)
        return replace(self, levels=levels, costs=costs, paths=paths, part=part, home=home)

    def is_for(self, world: World, settings: Settings, accessible: NDArray[np.bool_]) -> bool:
        """Whether the problem differs from another team's only in starts and ranges.

        Never for unknown maps, robot types, return to base, values or external paths.

        Args:
            world, settings: of the other team.
            accessible: bool `[H, W]`, cells that it can reach.
        """
        if self.given or any(own is not None for own in (self.unknown, self.own, self.home, self.value, world.value)):
            return False
        mine = self.world.shape == world.shape and self.world.randomness_sha256 == world.randomness_sha256
        return mine and self.settings == settings and np.array_equal(self.levels.accessible, accessible.ravel())

    @property
    def stay_inside(self) -> bool:
        """Whether legs of a coverage path stay inside the area (`transit="area"`)."""
        return self.settings.transit == "area"

    @property
    def scale(self) -> int:
        """Value of one cell of the largest value in decisions."""
        return 1 if self.value is None else VALUE_SCALE

    @cached_property
    def beyond(self) -> int:
        """More than the price of any area if cells have values, else 0."""
        if self.value is None:
            return 0
        costs = self.costs if self.unknown is None else self.entry[self.unknown.highest.of_cell[self.unknown.within]]
        return _beyond(int(costs.sum()), self.costs.size, self.entry)

    @cached_property
    def theta(self) -> int:
        """Price per new cell from which on a dangerous area is refused (`robot_value`); NO_REFUSAL if none is."""
        values = self.levels.values if self.own is None else self.own.values
        least = float(values[1]) if len(values) > 1 else 0.0
        return refusal_threshold(self.settings.robot_value, self.costs.size, least, self.settings.risk)


def most_steps(settings: Settings, levels: ThreatLevels, given: int = 0) -> int:
    """T_max, or the step at which the settings end a run (SPEC section 5).

    Args:
        settings: of the plan.
        levels: of the map.
        given: steps of external paths that are followed first.
    """
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
    """Prepare a world for planning.

    Args:
        world: the map.
        starts: `[K, 2]`, (row, col).
        settings: of the plan.
        given: external paths, int64 `[steps + 1]` each.
        homes: int64 `[K]`, first cells of the robots of a resumed mission.
        before: another team's problem; its parts that do not depend on the team are reused if world and settings agree.

    Raises:
        WorldError, PlanError: an unsupported combination.
    """
    settings.check()
    if settings.paces or settings.radio is not None:
        world.require_known_map("a team of several speeds, or with radio,")
        if world.phases is not None:
            said = f"several speeds, or radio, require threats that do not change; here: {world.phases.description}"
            raise PlanError(said, source=world.source, fix="leave `phases` out")
    checked = check_starts(starts, world.met, world.source)
    settings.check_team(len(checked), world.source)
    worlds = world.of_robots(settings.types, len(checked))
    own, mixed = None, len(set(worlds)) > 1
    world = world if mixed else worlds[0]
    unknown = unknown_map_of(world, checked, settings.levels)
    if settings.blocks:
        unknown = _of_wrecks(world, checked, settings)
    is_known = unknown is None
    rule, cells = rule_of(settings.policy), checked[:, 0] * world.shape[1] + checked[:, 1]
    given_range = NO_LIMIT if settings.range is None else settings.range
    moves = np.broadcast_to(np.asarray(given_range, dtype=np.int64), len(cells))
    # A search over team sizes and starts prepares many problems of one map.
    if before is not None and not given and before.is_for(world, settings, world.accessible(checked)):
        return replace(before, world=world, starts=cells, range=moves)
    if mixed:
        levels, entry, own = own_maps(worlds, world.accessible(checked), settings)
        costs = own.costs.max(axis=0)
    else:
        accessible = world.accessible(checked)
        levels = unknown.highest if unknown else find_levels(world.threat, accessible, settings.levels)
        costs = entry_costs(levels, settings.risk, world.source)
        entry = level_costs(levels.values, costs.size, settings.risk).astype(np.int64)
    value = decision_values(world, levels.accessible, settings.priority) if rule.replanning else None
    if own is None:
        _check_comparisons(rule, levels, costs, entry, value, world.source, apart=is_known)
    else:  # the surcharge over another type is part of an area's cost
        most = entry[own.level.max(axis=0)]
        _check_comparisons(rule, levels, 2 * costs, most, value, world.source, apart=True)
    part = _parts(levels, world.shape)
    paths = safest_paths(world.shape, costs)
    safe = (levels.of_cell if unknown is None else unknown.belief).reshape(world.shape) == 0
    sides = sides_first(settings.in_area, safe)
    problem = Problem(
        world, settings, cells, levels, costs, paths, part, moves, rule, entry, sides, given, value, unknown, None, own
    )
    problem = problem if unknown is None else problem.with_robot_map(unknown.belief, cells)
    home = ways_to_base(settings, cells, world.shape, problem.paths, problem.costs, homes, own)
    return problem if home is None else replace(problem, home=home)


def _parts(levels: ThreatLevels, shape: tuple[int, int]) -> NDArray[np.int32]:
    """`Problem.part`."""
    return ndimage.label(levels.accessible.reshape(shape), FOUR_NEIGHBOURS)[0].ravel()


def decision_values(
    world: World, accessible: NDArray[np.bool_], priority: int | tuple[int, ...] | None = None
) -> NDArray[np.int64] | None:
    """Values of cells in decisions: round(1000 w / max w), at least 1 for w > 0, w = value * priority.

    The maximum is over accessible cells; other cells have value 0.

    Args:
        world: the map.
        accessible: bool `[N]`.
        priority: of all cells, or of each.

    Returns:
        int64 `[N]`; None without values and priorities.

    Raises:
        PlanError: another number of priorities than cells.

    Source: SPEC section 13.
    """
    if world.value is None and priority is None:
        return None
    if isinstance(priority, tuple) and len(priority) != accessible.size:
        expected = f"one number, or one for each of {accessible.size} cells"
        raise PlanError(f"{argument('priority')} of {len(priority)} cells", source=world.source, expected=expected)
    value = np.where(accessible, 1.0 if world.value is None else world.value.ravel(), 0.0) * np.asarray(priority or 1)
    # Whole numbers, so that prices per value are compared exactly.
    share = np.rint(VALUE_SCALE * (value / (value.max() or 1.0))).astype(np.int64)
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
    """Raise WorldError if comparing two areas of this world might exceed 64 bits (SPEC sections 11 and 13).

    `apart`: cells have these levels; else any cell may get any level.
    """
    # The largest offer that each level can give: all its cells to do, at the longest path.
    found = np.bincount(levels.of_cell[levels.accessible], minlength=len(entry))
    counts = np.maximum(found if apart else np.full_like(found, found.sum()), 1).tolist()
    number, longest = len(entry), int(costs.sum())
    beyond = 0 if value is None else _beyond(longest, costs.size, entry)
    most = counts if value is None else [VALUE_SCALE * n for n in counts]
    shown = [costs.size if rule.looks_ahead else 0] * number
    highest = list(
        map(Offer, range(number), [longest] * number, counts, entry.tolist(), most, [beyond] * number, shown)
    )
    if value is not None:
        highest += [offer._replace(value=0) for offer in highest]
    if rule.largest(highest) >= 2**63:
        raise WorldError(
            f"threat levels up to {levels.values[-1]:g} make areas too expensive for policy {rule.name} to compare",
            source=source,
            expected="path costs times cells below 2**63",
            fix="raise the smallest threats or set them to 0, or use policy mrac",
        )


# Closed loops of plans: problem and areas at t = 0, of MRAC's plans and of external plans.
#
# Robots follow external paths first (ours; the paper has no such plans). The cells that a robot is the first to visit
# are its areas, one per level, which are never shared. If it is lost, their unvisited cells become connected areas for
# other robots, as in the paper's `Reallocate Area`. Cells on no path are unassigned areas from the start. A robot at
# the end of its path continues with Algorithm 2.


def ready_loop(plan: Plan, world: World) -> tuple[Problem, tuple[Area, ...]]:
    """The problem of a plan's closed loop, and its areas at t = 0.

    Args:
        plan: for this world.
        world: the map.

    Raises:
        PlanError: the plan is for another map.
        WorldError: the combination is not supported for unknown maps.
    """
    settings = plan.require(world)
    if plan.is_external:
        settings.require_uniform("the closed loop of an external plan")
    if plan.is_external or plan.state is not None:
        what = "the closed loop of an external plan" if plan.is_external else "a resumed mission"
        world.require_known_map(what)
        settings.require_no_wrecks(what)
    if settings.transit == "area":
        world.require_known_map('`transit="area"`, legs that stay in their area,')
    if not plan.is_external:
        homes = None if plan.state is None else plan.state.homes(settings.return_to)
        return prepare(world, plan.starts, settings, homes=homes), plan.areas
    problem = prepare(world, plan.starts, settings, given=tuple(robot.path for robot in plan.robots))
    return problem, areas_of_paths(problem)


def areas_of_paths(problem: Problem) -> tuple[Area, ...]:
    """The areas of robots on external paths: for each robot one per level, then the connected unassigned ones."""
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
    """The first robot on each cell in a run without losses, the lowest of several; int64 `[N]`, NO_ROBOT for none."""
    first = np.full(problem.costs.size, NO_ROBOT, dtype=np.int64)
    steps = np.concatenate([np.arange(len(path)) for path in problem.given])
    robots = np.repeat(np.arange(len(problem.given)), [len(path) for path in problem.given])
    # Written from the last visit to the first: the first visitor stays.
    latest_first = np.lexsort((robots, steps))[::-1]
    first[np.concatenate(problem.given)[latest_first]] = robots[latest_first]
    return first
