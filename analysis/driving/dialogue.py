"""A mission by lines of JSON: orders out, reports in. Every line is checked; one that is wrong changes nothing."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from planner.arguments import whole
from planner.errors import InputError, UsageError
from planner.files import Json
from planner.missions.mission import Mission
from planner.missions.orders import Order
from planner.missions.saved import hand_on
from planner.worlds.keys import Key

FORMAT, VERSION = "mrac-drive", 1
LONGEST = 2**20
"""Characters of a line that is read."""
KINDS = ("report", "step", "close", "call_off", "orders", "outlook")


class Dialogue:
    """What is answered to each line.

    Orders of a step are said at its start, and stay whatever is reported of it: who answers each line that is said is
    never a line behind, and after a crash they are the same.

    Args:
        mission: that is driven. state: the file that it is kept in, written before orders are given; None: in none.
        outlook: says what will come, when it is asked for. unasked: also at the start, and after what changes it.
    """

    def __init__(
        self, mission: Mission, state: Path | None, outlook: Callable[[], Json], *, unasked: bool = False
    ) -> None:
        self.mission, self._state, self._outlook, self._unasked = mission, state, outlook, unasked
        self._line, self._told = 0, dict[int, Order]()

    def begin(self) -> Iterator[Json]:
        """The first lines: orders, or that the mission is over."""
        return self._go_on(asked=True)

    def hear(self, line: str) -> Iterator[Json]:
        """What is said to a line."""
        self._line += 1
        if len(line) <= LONGEST and not line.strip():
            return
        try:
            said = self._answer(Key(_parsed(line, f"line {self._line}"), "", f"line {self._line}", UsageError))
        except InputError as error:
            said = iter([{"type": "error", "line": self._line, "error": str(error)}])
        yield from said

    def _answer(self, key: Key) -> Iterator[Json]:
        """What is said to a line that is right. Raises InputError for another, before anything changes."""
        top = key.mapping(("type",), strict=False)
        kind, rest = top["type"].choice(KINDS), {name: value for name, value in key.value.items() if name != "type"}
        given = Key(rest, "", key.source, UsageError)
        if kind == "report":
            before, over = (self.mission.said(), self.mission.sees), self.mission.outcome is not None
            hand_on(self.mission.report, given)
            if (self.mission.said(), self.mission.sees) == before:
                return iter(())
            told = bool(rest.get("stopped") or rest.get("found") or "moves_left" in rest or rest.get("seen"))
            return self._go_on(changed=told, step=over)
        if kind == "close":
            self.mission.close(given.mapping(("cells",))["cells"].value)
            return self._go_on(asked=True)
        if kind == "step":
            now = whole(0, self.mission.step, what="a step that is not to come")
            of = given.mapping(defaults={"step": self.mission.step})["step"].number(now)
            return self._go_on(step=True) if of == self.mission.step else iter(())
        given.mapping()
        if kind == "call_off":
            self.mission.call_off()
            return self._go_on(asked=True)
        return iter([self._said() if kind == "orders" else self._foreseen()])

    def _go_on(self, *, asked: bool = False, changed: bool = False, step: bool = False) -> Iterator[Json]:
        """End steps in which nobody is waited for, keep the mission, and say what is to be done if that is new.

        `asked`: orders are said in any case, by what is known now. `changed`: what will come is another.
        Raises StateError where the mission cannot be kept: no orders are given then that a file does not know.
        """
        mission, before = self.mission, self.mission.step
        if asked:
            self._told = mission.first_orders()
        while step or (mission.outcome is None and not mission.awaited_of(self._told)):
            mission.advance()
            self._told, step = mission.orders(), False
        if self._state is not None:
            mission.save(self._state)
        if asked or mission.step > before:
            yield self._said()
        if (asked or changed) and self._unasked and mission.outcome is None:
            yield self._foreseen()

    def _foreseen(self) -> Json:
        """What will come."""
        return self._outlook() | {"type": "outlook", "step": self.mission.step}

    def _said(self) -> Json:
        """Orders, or that the mission is over."""
        mission = self.mission
        if mission.outcome is not None:
            return {"type": "end", **mission.known()}
        orders = [order.to_json() for order in self._told.values()]
        return {"type": "orders", "format": FORMAT, "version": VERSION, **mission.known(), "orders": orders}


def _parsed(line: str, source: str) -> Any:
    """A line's JSON object; UsageError for what is none."""
    expected = f'a JSON object with "type": {", ".join(KINDS)}'
    if len(line) > LONGEST:
        raise UsageError(f"a line of {len(line)} characters", source=source, expected=f"at most {LONGEST}")
    try:
        found = json.loads(line, parse_constant=lambda name: math.nan)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"no JSON ({str(error)[:60]})", source=source, expected=expected) from None
    if not isinstance(found, dict):
        raise UsageError("no JSON object", source=source, expected=expected)
    return found
