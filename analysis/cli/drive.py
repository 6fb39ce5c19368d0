"""The command `drive` of `mrac-jax`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

from cyclopts import Parameter

from analysis.cli.console import check_files
from analysis.cli.deliver import DONE
from analysis.cli.groups import PlanningToTheEnd, Team
from analysis.cli.options import PLANNING, ROLLOUTS, Input, Number, OutPath, Whole, path
from analysis.kit.notes import say
from analysis.report.minutes import with_minutes
from planner.arguments import FRACTION, whole
from planner.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from planner.files import Json
    from planner.pace import Pace


def drive(
    source: Input,
    /,
    *,
    team: Team | None = None,
    planning: PlanningToTheEnd | None = None,
    plan: Annotated[
        Path | None, Parameter(group=PLANNING, converter=path, help="Drive by this plan file instead of planning.")
    ] = None,
    state: Annotated[
        OutPath, Parameter(help="Keep the mission in this file (.json), and go on from it if it is there.")
    ] = None,
    patience: Annotated[
        Whole,
        Parameter(group=PLANNING, help="Steps without progress, after which a robot's work is others' (default: 20)."),
    ] = None,
    gain: Annotated[
        Number,
        Parameter(
            group=PLANNING,
            help="Robots turn round where that saves more than this share of the way (default: 1, never).",
        ),
    ] = None,
    outlook: Annotated[
        bool, Parameter(group=ROLLOUTS, negative="", help="Say what will come, at the start and after what changes it.")
    ] = False,
) -> int:
    """Drive a mission: orders on standard output, reports on standard input, a JSON object a line.

    INPUT may be a plan file that `plan INPUT --out` wrote: it names its map.
    Reports: {"type": "report", "robot": 0, "cell": [3, 4]}, with "stopped", "found", "moves_left", "seen" or "step"
    where they apply; {"type": "step"} ends a step before all have reported; {"type": "close", "cells": [[3, 5]]} makes
    a no-go zone; {"type": "outlook"} and {"type": "orders"} ask. A line that is wrong is answered by an error, and
    changes nothing. Where --state cannot be written it ends, and goes on from there when it is started again.
    docs/mission.md has all keys.
    """
    from analysis.cli.progress import load_or_make_plan
    from analysis.driving.dialogue import Dialogue
    from analysis.driving.outlook import DrivenMission
    from analysis.inputs import check_team
    from planner.missions.mission import PATIENCE
    from planner.missions.saved import ended

    team, planning = team or Team(), planning or PlanningToTheEnd()
    whole(1).check("patience", patience, optional=True)
    FRACTION.check("gain", gain, optional=True)
    check_files(source, state, suffix=".json", beside=(plan,))
    if sys.stdin is None:
        raise UsageError("standard input is closed", expected="reports there, a JSON object a line")
    asked = team.asked(source, planning.choices())
    world, made, notes = load_or_make_plan(asked, plan)
    say(notes)
    how: dict[str, Any] = {"patience": patience or PATIENCE, "gain": 1.0 if gain is None else gain}
    if state is not None and state.exists():
        over = ended(state, world, made)
        if over is not None:
            _tell([{"type": "end", **over}], world.pace)
            return DONE
        mission = DrivenMission.resume(state, world, made, **how)
        check_team(asked, mission.robots, state)
        say([f"going on from {state}, {world.pace.step(mission.step)}"])
    else:
        mission = DrivenMission(world, made, **how)
    if outlook:
        mission.check_foreseen()  # before any order
    talk = Dialogue(mission, state, lambda: mission.outlook().to_json(), unasked=outlook)
    _tell(talk.begin(), world.pace)
    for line in _lines(sys.stdin.buffer):
        _tell(talk.hear(line), world.pace)
    return DONE


def _lines(stream: BinaryIO) -> Iterator[str]:
    """Lines, each as far as it is read: of a longer one the rest is no line of its own."""
    from analysis.driving.dialogue import LONGEST

    while line := stream.readline(LONGEST + 2):
        rest = line
        while len(rest) > LONGEST and not rest.endswith(b"\n"):
            rest = stream.readline(LONGEST + 2)
        yield line.decode("utf-8", "replace")


def _tell(lines: Iterable[Json], pace: Pace) -> None:
    for line in lines:
        print(json.dumps(with_minutes(line, pace), allow_nan=False, separators=(",", ":")), flush=True)  # noqa: T201
