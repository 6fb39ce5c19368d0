"""A mission as a file, written whole and on the disk before orders are given: whatever ends the process, it goes on.

It is a state file (SPEC section 12) that also holds what was reported of the step under way, of which step each robot
reported last, for how many steps it has not moved, what was seen, what was closed, what robots said of their range,
which make no progress, and how the mission ended.
Before step 0 has ended there is no state, and the rest alone is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.arguments import whole
from planner.errors import StateError
from planner.files import Json, read_json, write_json
from planner.limits import MAX_PLAN_BYTES
from planner.missions.closing import closed_world
from planner.missions.seeing import Seen, seen_world
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.plans.reading import check_map
from planner.plans.state import FORMAT, VERSION
from planner.plans.state_file import parse_state
from planner.settings import SETTINGS, Settings
from planner.tally import WORDS_OF_0_3, Outcome
from planner.worlds.keys import Key
from planner.worlds.quantities import PROBABILITY
from planner.worlds.world import MAX_CELLS, World

DEFAULTS: dict[str, Any] = {
    "world": {},
    "begun": True,
    "closed": [],
    "seen": [],
    "sees": [],
    "odds": [],
    "range": None,
    "aside": [],
    "reports": [],
    "heard": [],
    "waits": [],
    "ended": None,
    "over": None,
}
"""What a file holds beside a state, or in its place, and may leave out."""
OF_REPORTS: dict[str, Any] = {
    "cell": None,
    "stopped": False,
    "found": False,
    "moves_left": None,
    "step": None,
    "seen": None,
}
"""What a report may leave out."""
ON_ITS_MAP = "give the map that the mission is on"
OF_END = ("outcome", "step", "covered", "lost")
"""What is known of a mission when it is over."""


def write_mission(path: str | Path, world: World, state: Json | None, more: Json) -> None:
    """Write the file; it is on the disk before this returns. `state`: None before there is one. Raises StateError."""
    where = state or {"world": {"shape": list(world.shape), "sha256": world.sha256}}
    known = {"format": FORMAT, "version": VERSION, "begun": state is not None}
    write_json(Path(path), known | where | more, MAX_PLAN_BYTES, StateError, sync=True)


def read_rest(path: str | Path, world: World, plan: Plan) -> tuple[World, Plan, dict[str, Key]]:
    """The world, with what was seen and closed, the plan of the rest by the settings of `plan`, and what else it holds.

    Raises StateError.
    """
    source, (data, keys) = str(path), _read(path)
    given, (world, changed) = world, _as_known(world, keys)
    settings = plan.settings or Settings()
    if "range" in data:  # what robots said of it; a state by hand says nothing
        settings = replace(settings, range=keys["range"].setting(SETTINGS["range"]))
    if keys["begun"].value is False:
        check_map(keys["world"], world, "state of", ON_ITS_MAP)
        same = not changed and settings == plan.settings
        return world, plan if same else make_plan(world, plan.starts, settings), keys
    state = parse_state(data, world, source, given)
    if state.over is not None:
        state = replace(state, over=_outcome(keys["over"], settings))
    return world, make_plan(replace(world, doubt=None), state.starts, settings, state=state), keys


def ended(path: str | Path, world: World, plan: Plan) -> Json | None:
    """How the mission in the file ended, as `drive` says it: outcome, step, covered, lost. None: it goes on.

    `plan`: that the mission is driven by. Raises StateError.
    """
    keys = _read(path)[1]
    if keys["ended"].value is None:
        return None
    check_map(keys["world"], _as_known(world, keys)[0], "state of", ON_ITS_MAP)
    known, settings = keys["ended"].mapping(OF_END), plan.settings or Settings()
    return {name: key.value for name, key in known.items()} | {"outcome": _outcome(known["outcome"], settings)}


def _outcome(key: Key, settings: Settings) -> str:
    """The outcome that a file names.

    Up to release 0.3 files did not say whether an operator had ended a mission or the rule, or whether a deadline cut
    it off: the settings tell, but for a mission with a `worth` that ended on the way home, which counts as the rule's.
    """
    if key.value == "called_off" and settings.worth is None:
        return Outcome.ENDED_BY_OPERATOR.word
    word = key.choice((outcome.word for outcome in Outcome), WORDS_OF_0_3)
    return Outcome[word.upper()].by_deadline(settings.ends_by_deadline).word


def _as_known(world: World, keys: dict[str, Key]) -> tuple[World, bool]:
    """The world as it was seen to be, without what was closed, and whether that is another one."""
    cell = whole(0, world.threat.size - 1, what="the index of a cell")
    closed, seen = (
        [one.number(cell) for one in keys["closed"].items("a list of cells", least=0)],
        read_seen(keys["seen"]),
    )
    for one in seen:
        cell.check("seen", one, StateError, str(keys["seen"].source))
    known = seen_world(world, seen) if seen else world
    return (closed_world(known, np.array(closed, dtype=np.int64)) if closed else known), bool(seen or closed)


def read_seen(key: Key) -> Seen:
    """p by cell, None of an obstacle, of `[[cell, p], ...]`. Raises StateError."""
    found: Seen = {}
    for item in key.items("a list of [cell, p]", least=0):
        cell, p = item.items("[cell, p]", exactly=2)
        found[cell.number(whole(0, MAX_CELLS))] = None if p.value is None else p.number(PROBABILITY)
    return found


def _read(path: str | Path) -> tuple[Json, dict[str, Key]]:
    """What is in the file, and its keys."""
    data = read_json(Path(path), MAX_PLAN_BYTES, StateError, "a state file (JSON)")
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise StateError("is no state of a mission", source=path, expected=f'an object with "format": "{FORMAT}"')
    return data, Key(data, "", str(path), StateError).mapping(defaults=DEFAULTS, strict=False)


def hand_on(report: Callable[..., None], key: Key) -> None:
    """Call `Mission.report` with what a file, or a line of `drive`, says. Raises StateError."""
    keys = key.mapping(("robot",), defaults=OF_REPORTS)
    flags = {name: keys[name].value for name in ("stopped", "found")}
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise keys[name].wrong("true or false")
    given = {name: keys[name].value for name in ("robot", "cell", "moves_left", "step", "seen")}
    report(**given, **flags)
