"""A world made ready for planning: levels, costs, safest paths, and the policy's limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from planner.arguments import argument
from planner.errors import PlanError, WorldError
from planner.limits import MAX_STEP
from planner.mrac.costs import BLOCKED, entry_costs, level_costs
from planner.mrac.homeward import Homeward, ways_home, ways_to
from planner.mrac.own_maps import OwnMaps, own_maps
from planner.mrac.paths import SafestPaths, safest_paths
from planner.mrac.sides import sides_first
from planner.mrac.unknown import Unknown, reached, unknown_of
from planner.policies import Rule, rule_of
from planner.policies.limits import refusal_threshold
from planner.policies.offer import Offer
from planner.settings import Settings
from planner.worlds.levels import NO_LEVEL, ThreatLevels, find_levels
from planner.worlds.world import FOUR_NEIGHBOURS, World, check_starts

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
        sides: int64 `[N, 4]`, which neighbour goes first on coverage paths (`planner.mrac.sides`).
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

    def pace(self, robot: int) -> int:
        """Steps that a move of the robot takes."""
        return self.settings.paces[robot] if self.settings.paces else 1

    def paths_of(self, robot: int) -> SafestPaths:
        """The robot's safest paths."""
        return self.paths if self.own is None else self.own.paths[self.own.of[robot]]

    def level_for(self, robot: int, level: int) -> int:
        """What an area of this level is to the robot: a level of its own map, 0 = safe."""
        return level if self.own is None else int(self.own.level[self.own.of[robot], level])

    def is_dangerous(self, robot: int, levels: NDArray[np.int16]) -> bool:
        """Whether a cell of one of these levels is dangerous to the robot."""
        return bool(((levels if self.own is None else self.own.level[self.own.of[robot]][levels]) > 0).any())

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
        """From which price per new cell on a dangerous area is refused (`worth`); NO_REFUSAL if none is."""
        values = self.levels.values if self.own is None else self.own.values
        least = float(values[1]) if len(values) > 1 else 0.0
        return refusal_threshold(self.settings.worth, self.costs.size, least, self.settings.risk)


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
