"""A mission as lines of JSON: orders out, reports in. Every line is checked; an invalid line changes nothing."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.estimates import Estimate, mean_estimate, mean_of, proportion
from analysis.statistics.variance_reduction import Paired, difference
from planner.arguments import MOST_ROLLOUTS, POSITIVE, whole
from planner.errors import InputError, UsageError
from planner.files import Json
from planner.json_objects import WithKeys
from planner.mission.map_updates import hand_on
from planner.mission.mission import Mission
from planner.mission.team_control import Order
from planner.rollouts.tables import AllPairs
from planner.simulator.codes import Outcome
from planner.tally import RolloutResults
from planner.world.keys import Key

FORMAT, VERSION = "mrac-drive", 1
LONGEST = 2**20
"""Largest number of characters of a line."""
KINDS = ("report", "step", "close", "call_off", "orders", "outlook")


class Dialogue:
    """The replies to each line.

    Orders of a step are written at its start and do not change with reports on the step. A client that replies to each
    line is therefore never a line behind, and gets the same orders after a crash.

    Args:
        mission: the mission to drive. state: file in which it is saved before orders are written; None: no file.
        outlook: computes the outlook on request. unasked: also at the start, and after a change of the outlook.
    """

    def __init__(
        self, mission: Mission, state: Path | None, outlook: Callable[[], Json], *, unasked: bool = False
    ) -> None:
        self.mission, self._state, self._outlook, self._unasked = mission, state, outlook, unasked
        self._line, self._orders = 0, dict[int, Order]()

    def begin(self) -> Iterator[Json]:
        """The first lines: orders, or the end of the mission."""
        return self._proceed(asked=True)

    def hear(self, line: str) -> Iterator[Json]:
        """The replies to a line."""
        self._line += 1
        if len(line) <= LONGEST and not line.strip():
            return
        try:
            said = self._answer(Key(_parsed(line, f"line {self._line}"), "", f"line {self._line}", UsageError))
        except InputError as error:
            said = iter([{"type": "error", "line": self._line, "error": str(error)}])
        yield from said

    def _answer(self, key: Key) -> Iterator[Json]:
        """The replies to a valid line. Raises InputError for an invalid one, before anything changes."""
        top = key.mapping(("type",), strict=False)
        kind, rest = top["type"].choice(KINDS), {name: value for name, value in key.value.items() if name != "type"}
        given = Key(rest, "", key.source, UsageError)
        if kind == "report":
            # A repeated report changes nothing and has no reply.
            before, over = (self.mission.as_json(), self.mission.sees), self.mission.outcome is not None
            hand_on(self.mission.report, given)
            if (self.mission.as_json(), self.mission.sees) == before:
                return iter(())
            changed = bool(rest.get("stopped") or rest.get("found") or "moves_left" in rest or rest.get("seen"))
            return self._proceed(changed=changed, step=over)
        if kind == "close":
            self.mission.close(given.mapping(("cells",))["cells"].value)
            return self._proceed(asked=True)
        if kind == "step":
            now = whole(0, self.mission.step, what="a step that has begun")
            of = given.mapping(defaults={"step": self.mission.step})["step"].number(now)
            return self._proceed(step=True) if of == self.mission.step else iter(())
        given.mapping()
        if kind == "call_off":
            self.mission.call_off()
            return self._proceed(asked=True)
        return iter([self._orders_line() if kind == "orders" else self._outlook_line()])

    def _proceed(self, *, asked: bool = False, changed: bool = False, step: bool = False) -> Iterator[Json]:
        """End steps that wait for no robot, save the mission, and write new orders.

        Args:
            asked: orders are written in any case, for the present map. changed: the outlook has changed.

        Raises StateError if the mission cannot be saved: then no orders are written, as they would be lost in a crash.
        """
        mission, before = self.mission, self.mission.step
        if asked:
            self._orders = mission.first_orders()
        # Steps in which no robot has an order to confirm end at once.
        while step or (mission.outcome is None and not mission.awaited_of(self._orders)):
            mission.advance()
            self._orders, step = mission.orders(), False
        # Save before orders leave: after a crash the same orders must be written again.
        if self._state is not None:
            mission.save(self._state)
        if asked or mission.step > before:
            yield self._orders_line()
        if (asked or changed) and self._unasked and mission.outcome is None:
            yield self._outlook_line()

    def _outlook_line(self) -> Json:
        """The outlook."""
        return self._outlook() | {"type": "outlook", "step": self.mission.step}

    def _orders_line(self) -> Json:
        """The orders, or the end of the mission."""
        mission = self.mission
        if mission.outcome is not None:
            return {"type": "end", **mission.known()}
        orders = [order.to_json() for order in self._orders.values()]
        return {"type": "orders", "format": FORMAT, "version": VERSION, **mission.known(), "orders": orders}


def _parsed(line: str, source: str) -> Any:
    """A line's JSON object. Raises UsageError for other text."""
    expected = f'a JSON object with "type": {", ".join(KINDS)}'
    if len(line) > LONGEST:
        raise UsageError(f"a line of {len(line)} characters", source=source, expected=f"at most {LONGEST}")
    try:
        found = json.loads(line, parse_constant=lambda name: math.nan)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"not JSON ({str(error)[:60]})", source=source, expected=expected) from None
    if not isinstance(found, dict):
        raise UsageError("not a JSON object", source=source, expected=expected)
    return found


# The outlook of a mission from its present state, and with changes, with common random numbers.

SECONDS = 0.5
"""Default time for an outlook."""
BLOCK = 512
"""Rollouts of a call. A default outlook has a multiple of it."""


@dataclass(frozen=True)
class Outlook(WithKeys):
    """Expectations at the end of a mission, from its present state.

    Attributes:
        rollouts: number of rollouts.
        covered: share of the accessible cells visited at the end, including those visited already.
        lost: further robots lost. steps: until the end. complete: probability that every cell is visited.
        home: robots at the base at the end; None: they need not return.
    """

    rollouts: int
    covered: Estimate
    lost: Estimate
    steps: Estimate
    complete: Estimate
    home: Estimate | None = None
    json_keys = "rollouts covered lost steps complete home?"


@dataclass(frozen=True)
class WhatIf(WithKeys):
    """The outlook of a mission with and without changes, with common random numbers.

    Attributes:
        now: without changes. then: with changes. covered, lost: differences, then - now.
    """

    now: Outlook
    then: Outlook
    covered: Estimate
    lost: Estimate
    json_keys = "now then difference.covered=covered difference.lost=lost"


class DrivenMission(Mission):
    """A mission with an outlook: compiled rollouts from the end of the last step."""

    def require_outlook(self) -> None:
        """Raise UsageError if the mission is over, PlanError for wrecks, WorldError for an uncertain map or phases."""
        if self.outcome is not None:
            raise UsageError("the mission is over", expected="a mission under way")
        if self.blocks:
            replace(self.settings, wrecks="block").require_no_wrecks("the rest of a mission")
        self.given.require_certain_map("the rest of a mission")

    def outlook(self, rollouts: int | None = None, seconds: float | None = None, seed: int = 0) -> Outlook:
        """Cells covered, robots lost and steps left, each with its 95 % interval.

        Args:
            rollouts: number; None: as many blocks of 512 as fit into `seconds` (default 0.5).
            seed: of the rollouts.

        Raises UsageError, PlanError for a user's rule, WorldError for hazards and uncertain maps.
        """
        (found,) = self._roll_out([{}], rollouts, seconds, seed)
        return self._seen(found)

    def what_if(
        self,
        *,
        without: Iterable[int] = (),
        call_off: bool = False,
        rollouts: int | None = None,
        seconds: float | None = None,
        seed: int = 0,
        **changes: Any,
    ) -> WhatIf:
        """The outlook without and with changes from here on, with common random numbers.

        Args:
            without: robots that get no more work. call_off: the mission ends here; robots that must return start now.
            changes: settings, as `policy="per_cell"`, `robot_value=12`.
            rollouts, seconds, seed: as in `outlook`.

        Raises UsageError for `call_off` together with changes, and as `outlook` does.
        """
        without = tuple(without)
        if call_off and (without or changes):
            raise UsageError("both call_off and changes are given", expected="one of the two")
        otherwise = [changes | {"without": without}]
        if call_off:
            otherwise = [{"call_off": True}] if self.settings.return_to is not None and self.step > 0 else []
        mine, *others = self._roll_out([{}, *otherwise], rollouts, seconds, seed)
        other = others[0] if others else self._ended(mine)
        cells, lost = self.accessible, [self._lost(found) for found in (mine, other)]
        covered = difference(Paired.of(mine.visited, other.visited), 1 / cells, 1 / cells, 1.0).estimate
        return WhatIf(
            self._seen(mine),
            self._seen(other),
            covered,
            difference(Paired.of(*lost), 1.0, 1.0, float(self._alive)).estimate,
        )

    @cached_property
    def _tables(self) -> AllPairs:
        """The distance tables of the map, computed once."""
        return AllPairs()

    @property
    def _past(self) -> int:
        """Number of completed steps; entering the starts, step 0, takes no time."""
        return max(self.step - 1, 0)

    @property
    def _alive(self) -> int:
        return self.robots - len(self.lost)

    def _roll_out(
        self, ways: list[dict[str, Any]], rollouts: int | None, seconds: float | None, seed: int
    ) -> list[RolloutResults]:
        """The same rollout ids for each set of changes (arguments of `rest`): `rollouts`, or blocks until `seconds`."""
        POSITIVE.check("seconds", seconds, optional=True)
        ends = time.monotonic() + (SECONDS if seconds is None else seconds)
        self.require_outlook()
        # Check all arguments before the first compilation.
        whole(1, MOST_ROLLOUTS).check("rollouts", rollouts, optional=True)
        choices = RolloutChoices(seed=seed, exact="never")
        rolls = [make_singles(self.world, self.rest(**way, nominal=False), choices, self._tables) for way in ways]
        if rollouts is not None:
            return [roll(0, rollouts) for roll in rolls]
        # All alternatives get the same ids, also under a time limit.
        parts = [[roll(0, BLOCK)] for roll in rolls]
        while time.monotonic() < ends:
            for roll, part in zip(rolls, parts, strict=True):
                part.append(roll(len(part) * BLOCK, BLOCK))
        return [RolloutResults.join(part) for part in parts]

    def _seen(self, found: RolloutResults) -> Outlook:
        """The estimates of rollouts."""
        count, step = len(found.visited), self._past
        lost = np.bincount(self._lost(found), minlength=self._alive + 1)
        # Times of rollouts count from t = 0, the outlook's from now.
        left = np.bincount(found.time - step)
        most = self.last_step - step
        values = np.flatnonzero(left)
        complete = int((found.outcome == Outcome.COMPLETE).sum())
        return Outlook(
            count,
            mean_estimate(np.bincount(found.visited, minlength=self.accessible + 1), 1 / self.accessible),
            mean_estimate(lost, 1.0),
            mean_of(values, left[values], 1.0, most),
            proportion(complete, count),
            None
            if self.settings.return_to is None
            else mean_estimate(np.bincount(found.home, minlength=self.robots + 1), 1),
        )

    def _lost(self, found: RolloutResults) -> NDArray[np.int64]:
        """int64 `[B]`: further robots lost."""
        return (self._alive - found.alive).astype(np.int64)

    def _ended(self, found: RolloutResults) -> RolloutResults:
        """The same rollouts for a mission that ends here."""
        fleet = self._fleet
        visited, survived = (int(np.count_nonzero(cells)) for cells in (fleet.visited, fleet.survived))
        same = {"visited": visited, "survived": survived, "time": self._past, "alive": self._alive}
        same["home"] = int(fleet.home.sum())
        # One row for each rollout, so that the comparison stays paired.
        ended = {name: np.full_like(getattr(found, name), value) for name, value in same.items()}
        return replace(found, outcome=np.full_like(found.outcome, Outcome.ENDED_BY_OPERATOR), **ended)
