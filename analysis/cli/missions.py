"""The commands that make and drive plans, `plan`, `export`, `drive`, and those of recordings, `record`, `inspect`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from analysis import api
from analysis.cli import console
from analysis.cli.options import ANY_POLICY, INPUT, PLANNING, THE_TEAM, Given, command, file, of, option
from analysis.recording.names import SUFFIX, check_name, check_names, growing_name, layout_name, state_name
from analysis.utils.notes import say
from planner.errors import UsageError
from planner.settings import OPTIONS, OUTPUT, ROLLOUTS, TIMELINE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from planner.formatting import Pace

DRIVE, RECORD, TRACKS = "Drive", "Record", "Tracks"
ALTITUDE = option(OUTPUT, "qgc, wpml: metres above take-off, 0 for ground robots (default: 20).", "number")


@command(
    DRIVE, api.plan, THE_TEAM, PLANNING, "deadline state",
    policy=ANY_POLICY,
    out="Write the plan file (JSON) to this file.",
    waypoints=option(OUTPUT, "Write paths: .csv .plan .yaml .geojson .kml .gpx .tif, as `export` does.", "path"),
    altitude=ALTITUDE,
    seconds=of(
        "seconds", group="Planning", help="End the search (--plan-for open_loop, --policy best) after this time."
    ),
    force=OPTIONS["force"],
    json="Print the plan file's JSON object.",
)  # fmt: skip
def plan(source: INPUT, /, given: Given) -> int:
    """The plan of a team: print it, and write it as a file or as waypoints."""
    from analysis.exporting import choose_format
    from analysis.exporting import export as write
    from analysis.exporting.mission import make_mission
    from analysis.inputs import read_files

    out, waypoints, state = given.out, given.waypoints, given.state
    if given.altitude is not None and waypoints is None:
        raise UsageError("--altitude without --waypoints", fix="add --waypoints")
    console.check_files(source, out, waypoints, also_read=(state,))
    if not console.may_replace(out, given.force):
        return console.DONE
    form = None if waypoints is None else choose_format(waypoints, None, "waypoints")
    first = None if form is None else form.check
    world, made = given.planned(source, seconds=given.seconds, first=first)
    written = [] if out is None else [out]
    if waypoints is not None and form is not None:
        spare = read_files(source, state, out)
        files, notes = write(make_mission(world, made, given.altitude, given.speed), waypoints, form, spare=spare)
        written += files
        say(notes)
    if out is not None:
        made.save(out, force=True)
    if given.json:
        console.print_json(made.to_json())
    else:
        console.print_plan(made, world, console.output_console())
    say([f"wrote {file}" for file in written])
    return console.DONE


@command(
    DRIVE, api.export, THE_TEAM, PLANNING, "deadline plan state", "Output: to altitude terrain battery",
    policy=ANY_POLICY,
    plan="Export this plan file instead of planning.",
    out=of("out", help="File or folder to write.", default=...),
)  # fmt: skip
def export(source: INPUT, /, given: Given) -> int:
    """A plan as a file for ground stations, DJI drones, TAK, nav2 and GIS.

    qgc, nav2 and wpml write one file per robot: FILE-0.plan, FILE-1.plan, or robot-0.plan in a folder. All but nav2,
    nav2_route, csv and geotiff need a georeferenced map. Robots move at --speed, or a cell per --step-seconds (default:
    3 m/s).
    """
    from analysis.exporting import choose_format
    from analysis.exporting import export as write
    from analysis.exporting.mission import make_mission
    from analysis.inputs import read_files

    form = choose_format(given.out, given.to)
    spare = read_files(source, given.plan, given.state, given.terrain)
    mission = make_mission(*given.planned(source), given.altitude, given.speed, given.terrain, given.battery)
    files, notes = write(mission, given.out, form, spare=spare)
    say([*notes, *(f"wrote {file}" for file in files)])
    return console.DONE


@command(
    DRIVE, api.drive, THE_TEAM, PLANNING, "deadline plan", "Planning: patience gain",
    policy=ANY_POLICY,
    plan="Drive by this plan file instead of planning.",
    state=of("state", group=OUTPUT, help="Keep the mission in this file (.json), and resume it if the file exists."),
    outlook=option(ROLLOUTS, "Print expected results at the start and after changes.", "flag", default=False),
)  # fmt: skip
def drive(source: INPUT, /, given: Given) -> int:
    """A mission: orders on standard output, reports on standard input, one JSON object per line.

    INPUT may be a plan file that `plan INPUT --out` wrote: it names its map.
    Reports: {"type": "report", "robot": 0, "cell": [3, 4]}, with "stopped", "found", "moves_left", "seen" or "step"
    where they apply; {"type": "step"} ends a step before all have reported; {"type": "close", "cells": [[3, 5]]} makes
    a no-go zone; {"type": "outlook"} and {"type": "orders"} ask. An invalid line is answered by an error and changes
    nothing. The command ends if --state cannot be written, and resumes from there. docs/mission.md has all keys.
    """
    from analysis.inputs import check_team
    from analysis.mission_protocol import Dialogue
    from planner.mission.map_updates import ended

    state, goes_on = given.state, given.state is not None and given.state.exists()
    console.check_files(source, state, suffix=".json", also_read=(given.plan,))
    if sys.stdin is None:
        raise UsageError("standard input is closed", expected="reports there, a JSON object a line")
    asked = given.asked(source)
    world, made, notes = console.load_or_make_plan(asked, given.plan)
    say(notes)
    if goes_on and (over := ended(state, world, made)) is not None:
        _tell([{"type": "end", **over}], world.pace)
        return console.DONE
    mission = given.call(api.drive, world, made, plan=None, state=state if goes_on else None)
    if goes_on:
        check_team(asked, mission.robots, state)
        say([f"going on from {state}, {world.pace.step(mission.step)}"])
    if given.outlook:
        mission.require_outlook()  # before any order
    talk = Dialogue(mission, state, lambda: mission.outlook().to_json(), unasked=given.outlook)
    _tell(talk.begin(), world.pace)
    for line in _lines(sys.stdin.buffer):
        _tell(talk.hear(line), world.pace)
    return console.DONE


def _lines(stream: BinaryIO) -> Iterator[str]:
    """Lines, cut at a maximum length; the rest of a longer line is discarded."""
    from analysis.mission_protocol import LONGEST

    while line := stream.readline(LONGEST + 2):
        rest = line
        while len(rest) > LONGEST and not rest.endswith(b"\n"):
            rest = stream.readline(LONGEST + 2)
        yield line.decode("utf-8", "replace")


def _tell(lines: Iterable[dict[str, Any]], pace: Pace) -> None:
    from analysis.report.result import with_minutes

    for line in lines:
        print(json.dumps(with_minutes(line, pace), allow_nan=False, separators=(",", ":")), flush=True)  # noqa: T201


@command(
    DRIVE, api.debrief, "tracks plan lost cell_size step_seconds speed", "out json",
    tracks=option(TRACKS, "Tracks: .csv .gpx .geojson .mcap, with times.", "path", default=...),
    plan=of("plan", group=TRACKS, help="The plan file that was to be flown."),
    lost=option(TRACKS, "Robots that were lost: 2,5 (default: those that the tracks say).", "names"),
    out="Write the page, state.json, the plan of the rest, flown.geojson and JSON to this folder.",
)  # fmt: skip
def debrief(source: INPUT, /, given: Given) -> int:
    """Tracks compared with the map and the plan: coverage, gaps, observed loss rate, and a plan for the rest.

    Places are joined by straight lines, but not across a time of more than five usual intervals. With --speed or
    --step-seconds, places within half a step are averaged, so that noise below half a cell adds few visits. Each
    robot's own clock counts.
    """
    console.check_folder(given.out)
    world = given.asked(source).load()
    say(world.notes)
    answer = given.call(api.debrief, world)
    read = (given.tracks, given.plan)
    return console.deliver(answer, out=given.out, as_json=given.json, source=source, also_read=read)


# Recordings.

RECORDING = "Recording"
EVALUATED = 4096
"""Default number of evaluated rollouts."""


@command(
    RECORD, api.record, THE_TEAM, PLANNING, "deadline plan state", "Recording: ids pick rollouts outcomes",
    "loop seed engine threat_checks", "Output: state_at picture animation force json",
    ids=option(RECORDING, 'Record these rollouts: "0,5,7-9".', "ids"),
    pick=option(
        RECORDING, "Record the worst, median, best, random or quantile:0.05 rollout by coverage; several by commas "
        "(default: median; not with --ids).", "picks",
    ),
    rollouts="Number of evaluated rollouts (default: 4096; with --ids and without --outcomes none).",
    policy=ANY_POLICY,
    plan="Record this plan file instead of planning.",
    picture=option(OUTPUT, "Write a picture of the first rollout's end (.png).", "path"),
    animation=option(OUTPUT, "Write an animation of the first rollout (.gif).", "path"),
    out=of("out", help="Recording to write (.mcap).", default=...),
)  # fmt: skip
def record(source: INPUT, /, given: Given) -> int:
    """Rollouts as an MCAP file for Foxglove, Lichtblick and Rerun.

    The file holds everything that `inspect --replay` needs. A layout for Foxglove and Lichtblick is written next to it,
    as NAME.layout.json.
    """
    from analysis.recording.pictures import save_pictures
    from analysis.recording.replay import interrupted_lines

    out, read = given.out, (given.plan, given.state)
    # Refuse files that cannot be written, have a wrong suffix, or are an input, before any work.
    check_names(out, given.picture, given.animation)
    cut_to = None if given.state_at is None else state_name(out)
    console.check_files(source, out, layout_name(out), given.picture, given.animation, cut_to, also_read=read)
    if not console.may_replace(out, given.force):
        return console.DONE
    if given.ids is not None and given.pick is not None:
        raise UsageError("both --ids and --pick are given", expected="one of them")
    world, plan = given.planned(source)
    own: dict[str, Any] = {"plan": plan, "path": out, "force": True, "made": read == (None, None)}
    if given.ids is None:
        own["pick"] = given.pick or ("median",)
    if given.rollouts is None and (given.ids is None or given.outcomes):
        own["rollouts"] = EVALUATED
    try:
        done = given.call(api.record, world, **own)
    except KeyboardInterrupt:
        say([nothing_recorded(out)])
        return console.INTERRUPTED
    lines = [*interrupted_lines(done, out), *(f"wrote {file}" for file in done.files)]
    status = console.deliver(done, as_json=given.json, notes=lines)
    drawn = [str(file) for file in (given.picture, given.animation) if file is not None]
    if drawn and not done.partial:
        say([f"drawing {' and '.join(drawn)} ..."])
        try:
            for drawing in save_pictures(done.first, done.stage, given.picture, given.animation):
                say([f"wrote {drawing}"])
        except KeyboardInterrupt:
            say([f"interrupted while drawing; {done.path} is whole"])
            return console.INTERRUPTED
    return status


def nothing_recorded(out: Path) -> str:
    """The note on an interruption before a rollout is complete; a second one can leave the growing file."""
    growing = growing_name(out)
    if growing.exists():
        return f"interrupted: {growing} holds the rollouts so far; `mrac-jax inspect --repair OUT {growing}` saves them"
    return "interrupted: nothing was recorded"


@command(
    RECORD, api.inspect, "events", "Rollouts: replay engine all", "Output: repair", "json",
    engine=of("engine", rare=False, help="With --replay: simulator to use (default: auto)."),
    events=option(
        TIMELINE, "Events to list for each rollout: at most 40 (main), all, or none (default: main).", "",
        "main", "all", "none", default="main",
    ),
)  # fmt: skip
def inspect(path: file("FILE", "A recording (.mcap)."), /, given: Given) -> int:  # type: ignore[valid-type]
    """Contents of a recording: topics, attachments, and a timeline of each rollout."""
    from analysis.recording import replay
    from analysis.utils.progress import show_progress

    if given.repair is not None and not given.replay:
        check_name(given.repair, SUFFIX)
        console.check_files(str(path), given.repair, suffix=SUFFIX)
    with show_progress() as progress:
        found = given.call(api.inspect, path, progress=progress)
    most = {"main": replay.MOST_LINES, "all": None, "none": 0}[given.events]
    if given.replay:
        console.show(replay.replayed(found), given.json)
        return console.DONE if found.identical else console.CHECK_FAILED
    if given.repair is None:
        console.show(replay.inspected(found, most), given.json)
        return console.DONE
    console.show(replay.recovered(found), given.json)
    say([f"wrote {given.repair}"])
    return console.DONE if found.complete else console.CHECK_FAILED
