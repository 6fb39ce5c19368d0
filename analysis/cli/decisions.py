"""The commands `starts`, `clear` and `attack` of `mrac-jax`: what can still be chosen before a mission."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Literal, get_args

from cyclopts import Group, Parameter

from analysis.cli.console import DONE, check_files, check_folder, deliver
from analysis.cli.options import (
    GOAL,
    OUTPUT,
    PLANNING,
    ROLLOUTS,
    TEAM,
    CellSize,
    CommonLuck,
    Input,
    Json,
    Number,
    OutPath,
    PlanningToTheEnd,
    Removed,
    Seed,
    Speed,
    StateFile,
    StepSeconds,
    Team,
    Text,
    Together,
    Whole,
    one_of,
    path,
)
from analysis.utils.notes import say
from planner.arguments import FRACTION, is_whole, whole
from planner.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from analysis.report.answer import Answer
    from planner.formatting import Pace


def starts(
    source: Input,
    /,
    *,
    depot: Annotated[bool, Parameter(group=GOAL, negative="")] = False,
    candidates: Annotated[Text, Parameter(group=GOAL)] = None,
    robots: Annotated[Whole, Parameter(group=TEAM)] = None,
    cell_size: CellSize = None,
    step_seconds: StepSeconds = None,
    speed: Speed = None,
    what: CommonLuck | None = None,
    planning: Together | None = None,
    scenario_out: OutPath = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """The best starts: one for each robot, or one depot for all.

    Candidates are screened by a bound and by eq. (4) of one robot, the best simulated on common random numbers, the
    better half of them with twice the rollouts, and so on, with the best depot and where the team stands now. The best
    found is compared with that on fresh rollouts, and named as a command; if it is not surely better, the answer is:
    stay.

    Args:
        depot: One place for all robots, not one each.
        candidates: Where robots may start: border, the safe cells on the border of the map; or a mask of the
            map or rows of row,col as .npy or .csv (default: border).
        robots: How many robots (default: as many as the input names, else 1).
        scenario_out: Write the scenario with the best starts (YAML) here.
        out: Write the page, the picture, the plan and JSON to this folder.
    """
    from analysis.inputs import input_path
    from analysis.search.start_positions import BORDER, find_starts, read_candidates, team_size
    from analysis.utils.progress import show_progress
    from planner.world.scenario import write_scenario

    what, planning = what or CommonLuck(), planning or Together()
    choices = what.choices()
    named = None if candidates in (None, BORDER) else Path(str(candidates))
    check_files(source, scenario_out, suffix=".yaml", beside=(named,))
    check_folder(out)
    given, notes = (BORDER, ()) if named is None else read_candidates(named)
    team = Team(cell_size=cell_size, step_seconds=step_seconds, speed=speed)
    asked = team.asked(source, planning.choices())
    world = asked.load()
    settings = asked.choices.settings(world.team.settings, world.pace, by=world.source)
    say((*world.notes, *(f"{named}: {note}" for note in notes)))
    with show_progress() as progress:
        answer = find_starts(
            world, team_size(world, robots), settings, choices, depot=depot, candidates=given,
            source=named or "", words=what.words(source, team, planning), progress=progress,
            doing=progress.doing,
        )  # fmt: skip
    if scenario_out is not None:
        write_scenario(scenario_out, input_path(source), answer.starts, settings, world.pace, cell_size)
        say([f"wrote {scenario_out}"])
    return deliver(answer, out=out, as_json=as_json, source=source, beside=(named,))


def clear(
    source: Input,
    /,
    *,
    count: Annotated[Whole, Parameter(group=GOAL)] = None,
    remove: Annotated[Removed, Parameter(group=GOAL)] = None,
    team: Team | None = None,
    what: CommonLuck | None = None,
    planning: Together | None = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Which threat to remove first: after replanning, and with the old plan.

    Threats are screened by the bound for every strategy; the best are planned
    for anew and simulated on common random numbers, and the pick is told on fresh rollouts.

    Args:
        count: How many threats to clear, one after the other (default: 1).
        remove: What a threat is: a connected area of danger, or a polygon, point or site of the scenario's
            threats (default: sources where there are several, else areas).
        out: Write the page, the pictures and JSON to this folder.
    """
    from analysis.search.threats import find_clearing

    search = partial(find_clearing, count=1 if count is None else count, remove=remove)
    return _of_threats(search, source, team, what, planning, out, as_json)


def attack(
    source: Input,
    /,
    *,
    count: Annotated[Whole, Parameter(group=GOAL)] = None,
    p: Annotated[Number, Parameter(group=GOAL)] = None,
    team: Team | None = None,
    what: CommonLuck | None = None,
    planning: Together | None = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Where threats would cost the team most: if robots know of them and plan anew, and if they do not.

    A threat is placed in the cell where fewest are visited on common random numbers, one after the other; then each is
    moved while that costs more. What they cost is told on fresh rollouts.

    Args:
        count: How many threats are placed (default: 1).
        p: The chance that a visit of one stops a robot, beside what else is there (default: 0.2).
        out: Write the page, the pictures, JSON and both maps (known.yaml, hidden.npz) to this folder.
    """
    from analysis.search.threats import find_attack

    search = partial(find_attack, count=1 if count is None else count, p=0.2 if p is None else p)
    return _of_threats(search, source, team, what, planning, out, as_json)


def _of_threats(
    search: Callable[..., Answer],
    source: str,
    team: Team | None,
    what: CommonLuck | None,
    planning: Together | None,
    out: Path | None,
    as_json: bool,
) -> int:
    """Run a search for threats, and show its answer."""
    from analysis.inputs import load_task
    from analysis.utils.progress import show_progress

    team, what, planning = team or Team(), what or CommonLuck(), planning or Together()
    choices = what.choices()
    check_folder(out)
    task = load_task(team.asked(source, planning.choices()))
    say(task.notes)
    with show_progress() as progress:
        answer = search(task.world, task.starts, task.settings, choices, progress=progress, doing=progress.doing)
    return deliver(answer, out=out, as_json=as_json, source=source)


# The command `drive` of `mrac-jax`.


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
    from analysis.cli.console import load_or_make_plan
    from analysis.inputs import check_team
    from analysis.mission_protocol import Dialogue, DrivenMission
    from planner.mission.map_updates import ended
    from planner.mission.mission import PATIENCE

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
    from analysis.mission_protocol import LONGEST

    while line := stream.readline(LONGEST + 2):
        rest = line
        while len(rest) > LONGEST and not rest.endswith(b"\n"):
            rest = stream.readline(LONGEST + 2)
        yield line.decode("utf-8", "replace")


def _tell(lines: Iterable[dict[str, Any]], pace: Pace) -> None:
    from analysis.report.answer import with_minutes

    for line in lines:
        print(json.dumps(with_minutes(line, pace), allow_nan=False, separators=(",", ":")), flush=True)  # noqa: T201


# The command `export` of `mrac-jax`.

DRIVING = Group("Driving", sort_key=3)
Way = Literal["qgc", "nav2", "geojson", "kml", "gpx", "csv", "geotiff"]
"""Names of `analysis.exporting.FORMATS`, which `--help` has no time to import."""
To = Annotated[Way | None, Parameter(converter=one_of(*get_args(Way)))]
Altitude = Annotated[
    Number, Parameter(group=DRIVING, help="qgc: metres above take-off, 0 for robots on the ground (default: 20).")
]


def export(
    source: Input,
    /,
    *,
    to: Annotated[To, Parameter(group=OUTPUT)] = None,
    team: Team | None = None,
    planning: PlanningToTheEnd | None = None,
    plan: Annotated[Path | None, Parameter(group=PLANNING, converter=path)] = None,
    state: StateFile = None,
    altitude: Altitude = None,
    out: Annotated[Path, Parameter(group=OUTPUT, converter=path)],
) -> int:
    """A plan for ground stations, nav2 and GIS: QGroundControl, poses, GeoJSON, KML, GPX, CSV, GeoTIFF.

    qgc and nav2 have a file a robot: FILE-0.plan, FILE-1.plan, ..., or robot-0.plan, ... in a folder. All but nav2, csv
    and geotiff need a map that is georeferenced. qgc's robots drive at --speed, or a cell in --step-seconds (default: 3
    m/s).

    Args:
        out: File or folder to write.
        to: qgc, nav2, geojson, kml, gpx, csv or geotiff (default: by --out's suffix).
        plan: Export this plan file instead of planning.
    """
    from analysis.cli.console import load_or_make_plan
    from analysis.exporting import choose_format, make_mission
    from analysis.exporting import export as export_mission
    from analysis.inputs import read_files

    team, planning = team or Team(), planning or PlanningToTheEnd()
    form, chosen = choose_format(out, to), planning.choices()
    world, made, notes = load_or_make_plan(team.asked(source, chosen), plan, state)
    say(notes)
    mission = make_mission(world, made, altitude, team.speed)
    written = export_mission(mission, out, form, spare=read_files(source, plan, state))
    say([*mission.unknown(form.figures), *(f"wrote {file}" for file in written)])
    return DONE


# The command `studio` of `mrac-jax`.

SUFFIX = ".yaml"


def studio(
    source: Input,
    /,
    *,
    team: Team | None = None,
    seed: Seed = None,
    port: Annotated[Whole, Parameter(group=OUTPUT)] = None,
    out: OutPath = None,
) -> int:
    """Paint threats, obstacles and starts on a local page that answers every stroke; Ctrl-C ends it.

    The page is served on this machine alone, to whoever opens the address that is printed (the extra `studio`).

    Args:
        port: Of the page (default: a free one).
        out: Scenario (.yaml) that Save writes, its cells beside it (default: INPUT-studio.yaml).
    """
    try:
        import tornado  # noqa: F401
    except ImportError:
        raise UsageError("tornado is not installed", fix='pip install "mrac-jax[studio]"') from None
    from analysis.inputs import input_path, load_task
    from analysis.sampling import RolloutChoices
    from analysis.studio.server import Sketch, Studio, raster_of, serve
    from analysis.utils.progress import ANNOUNCER, lines_now_and_then, notice_compiling, run_loop
    from planner.settings import Choices

    team = team or Team()
    if port is not None and not is_whole(port, 1, 65535):
        raise UsageError(f"--port {port}", expected="a port, 1 to 65535")
    path = input_path(source)
    RolloutChoices(seed=seed or 0)  # refuses a seed that is none
    target = Path(f"{path.stem}-studio{SUFFIX}") if out is None else out
    check_files(source, target, suffix=SUFFIX)
    check_files(source, raster_of(target))
    task = load_task(team.asked(source, Choices()))
    say(task.notes)
    first = Sketch.of(task.world, len(task.starts), task.settings)
    room = Studio(first, PurePath(source).name, target, seed or 0)
    notice_compiling()
    try:
        with lines_now_and_then(lambda _: ANNOUNCER.line()):
            run_loop(serve(room, port or 0, lambda address: say([f"open {address}", "Ctrl-C ends it"])))
    except KeyboardInterrupt:
        say(["studio ended"])
    return DONE
