"""A plan's closed loop, ready to roll out: compiled by `planner.rollouts.closed_loop`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import UsageError
from planner.failure_model import PLAIN, FailureModel
from planner.plan.state import MissionState
from planner.policies.rules import Rule
from planner.rollout_sampling import first_places
from planner.rollouts.tables import kinds_of, visit_tables, write_mission_state
from planner.simulator.codes import NO_AREA
from planner.simulator.policy import Policy
from planner.simulator.state import AREA_BITS, DETECTS, OUT, TRUTH, State, Tables, first_state
from planner.tally import Tally, tally_key
from planner.world.moving_threats import MovingThreats
from planner.world.uncertain_maps import Uncertain
from planner.world.world import World

# The programs that missions run: one for common missions, one for other plain ones, one for the rest.
#
# A program is compiled for the types of its arguments. A feature that none of its missions uses is None: no code is
# compiled for it.

Arrays = TypeVar("Arrays", bound=tuple)

FEATURES = {
    "follows": "given", "walks": "entry", "searches": "entry", "uncertain": "own_counter", "spends": "spent",
    "wears": "times", "moving": "moving_threats", "mixed": "type_of", "paced": "pace", "radio": "reach",
    "returns": "home_cost", "learns": "truths", "estimates": "odds", "phased": "phases",
}  # fmt: skip
"""The features, and the table of each, which is empty where a mission does not use it."""
PROGRAMS = 0, list(FEATURES).index("wears"), len(FEATURES)
"""How many of the FEATURES each program has: none; those of large or uncertain maps and of external paths; all. A
further program would have to be compiled for its missions only."""


def with_features(tables: Tables) -> Tables:
    """The tables of the smallest program with all features of the mission.

    Args:
        tables: without features.
    """
    has: dict[str, Any] = {name: len(getattr(tables, table)) > 0 for name, table in FEATURES.items()}
    has["searches"] &= not len(tables.cost_to)
    # A feature within the program's size that the mission does not use is False, not None: the types are the program's.
    known = min(size for size in PROGRAMS if not any(list(has.values())[size:]))
    features: dict[str, Any] = dict.fromkeys(has) | dict(list(has.items())[:known])
    return tables._replace(**features)


def typed(given: Arrays) -> Arrays:
    """The named tuple with contiguous, writable arrays: the types that programs are compiled for."""
    # `np.require` takes microseconds for each of some hundred arrays, most of which are as required.
    arrays = (
        np.require(one, requirements=["C", "A", "W"]) if isinstance(one, np.ndarray) and not one.flags.carray else one
        for one in given
    )
    return type(given)(*arrays)


NO_COUNTS = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Weights:
    """Values of cells, summed up in each rollout: `RolloutResults.value_covered` and `value_found`.

    Attributes:
        covered: int64 `[A]`, value of each visited cell.
        found: int64 `[A, MOST_PASSES + 1]`, value by survived visits; the last column is for that many or more.
    """

    covered: NDArray[np.int64]
    found: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plan's closed loop, ready to roll out. Axis `A` = accessible cells.

    Attributes:
        identity: hash of everything that its rollouts depend on, the seed excluded.
        shape: (H, W). cells: int64 `[A]`, index of each accessible cell.
        tables: read by every rollout. max_steps: T_max. first_only: `threat_checks="first_visit"`.
        stay_inside: `transit="area"`. policy: of a rule that re-evaluates; None: the paper's rule. rule: of both.
        weights: values of cells, summed up in single rollouts; survived visits are then counted too.
        bearing: the failure model.
        purpose: of the key under which an uncertain map is drawn (`planner.world.uncertain_maps.Draws`).
        state: of the mission that rollouts resume; None: they begin at t = 0.
        moving_threats: moving threats, whose positions are kept for each rollout; None: there are none.
        uncertainty: candidates of the true map, of which each rollout draws one; None: there is one true map.
        in_area: a user's order of the cells of an area, `(here, cell, cost) -> anything that Python can compare`,
            with cells as indices in `cells`; None: the planner's. Not supported by compiled programs.
    """

    identity: str
    shape: tuple[int, int]
    cells: NDArray[np.int64]
    tables: Tables
    max_steps: int
    first_only: bool
    stay_inside: bool
    rule: Rule
    policy: Policy | None = None
    state: MissionState | None = None
    weights: Weights | None = None
    purpose: int = 0
    failure_model: FailureModel = PLAIN
    moving_threats: MovingThreats | None = None
    uncertainty: Uncertain | None = None
    in_area: Callable[[int, int, int], Any] | None = None

    @property
    def accessible(self) -> int:
        """Number of cells that can be visited on the true map."""
        return self.tables.goal

    @property
    def learns(self) -> bool:
        """True if the robots' map may change."""
        return len(self.tables.truths) > 0

    @property
    def comes_home(self) -> bool:
        """True if robots return to base."""
        return len(self.tables.home_cost) > 0

    @property
    def delivers(self) -> bool:
        """True if cells delivered are counted: robots return to base, and a resumed mission knows what they carry."""
        return self.comes_home and (self.state is None or self.state.delivered is not None)

    @property
    def runs_alone(self) -> bool:
        """True if each rollout is a separate group: no two have the same detector readings."""
        return bool(self.tables.evidence[DETECTS:].any())

    @property
    def robots(self) -> int:
        """K."""
        return len(self.tables.starts)

    @property
    def tabled(self) -> bool:
        """True if distances come from all-pairs tables."""
        return len(self.tables.cost_to) > 0

    @property
    def is_uncertain(self) -> bool:
        """True if the map is drawn in each rollout."""
        return len(self.tables.own_counter) > 0

    @property
    def keeps_apart(self) -> bool:
        """True if some state is kept for every rollout."""
        return self.is_uncertain or self.moving_threats is not None or self.runs_alone

    def on_grid(self, values: NDArray[Any], other: Any = 0) -> NDArray[Any]:
        """Values of the accessible cells on the whole grid.

        Args:
            values: `[A]`.
            other: value of the other cells.

        Returns:
            `[N]`, of the type of `values`.
        """
        grid = np.full(self.shape[0] * self.shape[1], other, dtype=values.dtype)
        grid[self.cells] = values
        return grid

    def flagged(self, raw: State, flag: int) -> NDArray[np.bool_]:
        """bool `[N]`: accessible cells with this flag in the state, VISITED or SURVIVED."""
        has_it = raw.home[:-1] & flag != 0
        # While robots learn the map, an unvisited cell in no area has both flags.
        return self.on_grid(has_it & (raw.known & OUT == 0) if self.learns else has_it)

    def area_of(self, raw: State) -> NDArray[np.int32]:
        """int32 `[N]`: the area of each cell in the state, the last one of a completed run; NO_AREA if in none."""
        found = (raw.home[:-1] >> AREA_BITS).astype(np.int32)
        # In online missions the last number stands for no area.
        return self.on_grid(np.where(found == len(raw.areas) - 1, NO_AREA, found) if self.learns else found, NO_AREA)

    @cached_property
    def _first(self) -> dict[int, State]:
        return {}

    def first_state(self, room: int) -> State:
        """The state that every group begins with, made once for each `room` (areas); one level for each true map."""
        if room not in self._first:
            first = first_state(self.tables, room, self.weights is not None)
            first = first._replace(undelivered=first.undelivered[: len(first.undelivered) * self.delivers])
            if self.state is not None:
                write_mission_state(self.state, first, self.tables, self.cells)
            levels = 1 if self.uncertainty is None else len(self.tables.truths)
            rows = (row[None] if levels == 1 else np.repeat(row[None], levels, axis=0) for row in first)
            self._first[room] = typed(State._make(rows))
            if self.learns:
                self._first[room].mind[:, TRUTH] = np.arange(levels)
        return self._first[room]

    def again(self, **changes: Any) -> ClosedLoop:
        """A copy with these changes, which must not affect the state at t = 0: it is shared."""
        other = replace(self, **changes)
        # `replace` makes a new instance, whose cache would be empty: a state of a large map takes long to make.
        other.__dict__["_first"] = self._first
        return other

    def first_places(self, seed: int, ids: NDArray[np.uint32]) -> NDArray[np.int64]:
        """`planner.simulator.state.Work.at` of these rollouts at t = 0, int64 `[B, M]`."""
        assert self.moving_threats is not None
        places = first_places(self.moving_threats, seed, ids)
        walks = np.array([not one.patrols for one in self.moving_threats.members])
        number = self.on_grid(np.arange(len(self.cells)), len(self.cells))
        # Walking threats are numbered by accessible cells; those on routes keep their index on the route.
        places[:, walks] = number[places[:, walks]]
        return places

    def empty_tally(self, seed: int) -> Tally:
        """The tally of no rollouts."""
        key = tally_key(self.identity, "closed", seed)
        return Tally.empty(key, self.shape, self.robots, self.accessible)

    def truncated_at(self, step: int) -> ClosedLoop:
        """The closed loop truncated at the end of `step`: its rollouts are the first steps of the whole ones.

        Raises:
            UsageError: the mission's state is at that step or later.
        """
        if self.state is not None and step <= self.state.step:
            raise UsageError(argument("deadline", step), expected=f"a step after the state's, {self.state.step}")
        cut = min(step, self.max_steps)
        return replace(self, identity=f"{self.identity}@{cut}", max_steps=cut)

    def with_threat(self, world: World) -> ClosedLoop:
        """The same decisions under the threats of `world`, a map of the same cells."""
        kinds = kinds_of(world, self.failure_model.types, self.robots)
        tables = self.tables._replace(**visit_tables(kinds, self.cells))
        return replace(
            self, identity=f"{self.identity}~{world.randomness_sha256}", tables=tables, purpose=purpose_of(world)
        )

    def scoring(self) -> ClosedLoop:
        """The same rollouts, counted also for `planner.rollouts.coverage_gradient`."""
        return replace(self, identity=f"{self.identity}#scores", tables=self.tables._replace(scores=True))

    def with_cell_weights(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> ClosedLoop:
        """The same rollouts with survived visits counted and values summed up.

        Args:
            covered: int64 `[N]`, as in `Weights`.
            found: int64 `[N, MOST_PASSES + 1]`, as in `Weights`.
        """
        weights = Weights(covered[self.cells], found[self.cells])
        return replace(self, identity=f"{self.identity}#passes", weights=weights)


def purpose_of(world: World) -> int:
    """Purpose of the key under which an uncertain map is drawn; 0 for a certain map."""
    return 0 if world.draws is None else world.draws.purpose


def known_cells(loop: ClosedLoop) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(visited, survived): cells covered before rollouts begin, int64; they count from step 0 on."""
    return (NO_COUNTS, NO_COUNTS) if loop.state is None else (loop.state.visited, loop.state.survived)
