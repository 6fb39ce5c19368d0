"""The commands `record`, `replay`, `inspect` and `recover` of `mrac-jax`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from analysis.cli.console import CHECK_FAILED, DONE, INTERRUPTED, check_files, deliver, may_replace, show
from analysis.cli.options import (
    OUTPUT,
    PLANNING,
    ROLLOUTS,
    Engine,
    Force,
    Input,
    Json,
    OutPath,
    PlanningToTheEnd,
    Recording,
    StateFile,
    Team,
    Whole,
    one_of,
    path,
)
from analysis.recording.names import SUFFIX, check_name, growing_name, layout_name, left_over, state_name
from analysis.utils.notes import say
from planner.errors import InputError

File = Annotated[Path, Parameter(name="FILE", converter=path, help="A recording (.mcap).")]
TIMELINE = Group("Timeline", sort_key=3)
Shown = Annotated[
    Literal["main", "all", "none"],
    Parameter(
        group=TIMELINE,
        converter=one_of("main", "all", "none"),
        help="Events shown of each rollout: at most 40, all, or none.",
    ),
]


def record(
    source: Input,
    /,
    *,
    what: Recording | None = None,
    team: Team | None = None,
    planning: PlanningToTheEnd | None = None,
    plan: Annotated[Path | None, Parameter(group=PLANNING, converter=path)] = None,
    state: StateFile = None,
    state_at: Annotated[Whole, Parameter(group=OUTPUT)] = None,
    picture: OutPath = None,
    animation: OutPath = None,
    force: Force = False,
    as_json: Json = False,
    out: Annotated[Path, Parameter(group=OUTPUT, converter=path)],
) -> int:
    """Record rollouts as an MCAP file for Foxglove, Lichtblick and Rerun, with all that it takes to replay them.

    A layout for Foxglove and Lichtblick is written beside the file, as NAME.layout.json.

    Args:
        out: Recording to write (.mcap).
        plan: Record this plan file instead of planning.
        state_at: Of one rollout (--ids): also its state at the end of this step, NAME.state.json.
        picture: Also a picture of the first rollout's end (.png).
        animation: Also an animation of the first rollout (.gif).
    """
    from analysis.cli.progress import load_or_make_plan
    from analysis.recording.pictures import save_pictures
    from analysis.recording.record import record as record_rollouts
    from analysis.recording.record import scenario_text, state_of_rollout
    from analysis.recording.replay import interrupted_lines
    from analysis.recording.viewers.topics import Stage, write_layout
    from analysis.utils.progress import show_progress

    what, team, planning = what or Recording(), team or Team(), planning or PlanningToTheEnd()
    cut_to = None if state_at is None else state_name(out)
    check_outputs(source, (plan, state), out, picture, animation, cut_to)
    if not may_replace(out, force):
        return DONE
    if plan is None:
        what.request(foreign=planning.plan_for == "open")
    world, made, notes = load_or_make_plan(team.asked(source, planning.choices()), plan, state)
    own = plan is None and state is None
    request = replace(what.request(made.is_foreign, world.pace.seconds), made=own, scenario=scenario_text(source))
    cut = None if state_at is None else state_of_rollout(world, made, request, state_at)
    say(notes)
    try:
        with show_progress() as progress:
            done = record_rollouts(world, made, request, out, progress=progress, doing=progress.doing)
    except KeyboardInterrupt:
        say([nothing_recorded(out)])
        return INTERRUPTED
    layout = layout_name(done.path)
    write_layout(layout, world, len(made.robots))
    written = [done.path, layout]
    if cut is not None:
        written.append(state_name(done.path))
        cut.save(written[-1], force=True)
    told = [*interrupted_lines(done, out), *(f"wrote {file}" for file in written)]
    status = deliver(done, as_json=as_json, notes=told)
    asked = [str(file) for file in (picture, animation) if file is not None]
    if asked and not done.partial:
        say([f"drawing {' and '.join(asked)} ..."])
        stage = Stage(world, made, request.loop, request.seed, request.first_only)
        try:
            for drawing in save_pictures(done.first, stage, picture, animation):
                say([f"wrote {drawing}"])
        except KeyboardInterrupt:
            say([f"interrupted while drawing; {done.path} is whole"])
            return INTERRUPTED
    return status


def nothing_recorded(out: Path) -> str:
    """What is said of an interruption before a rollout is complete; a second one can leave the growing file."""
    growing = growing_name(out)
    if growing.exists():
        return f"interrupted: {growing} holds what was done so far; recover it with `mrac-jax recover {growing}`"
    return "interrupted: nothing was recorded"


def check_outputs(
    source: str,
    beside: tuple[Path | None, ...],
    out: Path,
    picture: Path | None,
    animation: Path | None,
    cut_to: Path | None,
) -> None:
    """Refuse files that cannot be written, have other names than they should, or are an input, before any work."""
    for file, suffix in ((out, SUFFIX), (picture, ".png"), (animation, ".gif")):
        if file is not None:
            check_name(file, suffix)
    check_files(source, out, layout_name(out), picture, animation, cut_to, beside=beside)
    growing = growing_name(out)
    if growing.is_symlink() or growing.exists():
        raise left_over(growing)


def replay(
    file: File,
    /,
    *,
    engine: Annotated[Engine, Parameter(group=ROLLOUTS)] = "auto",
    everything: Annotated[bool, Parameter(name="--all", group=ROLLOUTS, negative="")] = False,
    as_json: Json = False,
) -> int:
    """Run a recording again from what is inside, and say whether every event is the same (exit status 1 if not).

    Of a file that is cut short, everything that is in it has to be the same.

    Args:
        engine: Engine to run with (default: auto).
        everything: Run all evaluated rollouts: tally, outcomes, picks.
    """
    from analysis.recording.replay import replay as replay_file
    from analysis.recording.replay import replayed
    from analysis.utils.progress import show_progress

    with show_progress() as progress:
        found = replay_file(file, engine, everything=everything, progress=progress)
    show(replayed(found), as_json)
    return DONE if found.identical else CHECK_FAILED


def inspect(file: File, /, *, events: Shown = "main", as_json: Json = False) -> int:
    """What is in a recording: topics, attachments, and each rollout with a timeline of its events."""
    from analysis.recording.replay import MOST_LINES, inspected
    from analysis.recording.replay import inspect as inspect_file

    most = {"main": MOST_LINES, "all": None, "none": 0}[events]
    show(inspected(inspect_file(file), most), as_json)
    return DONE


def recover(
    file: File,
    /,
    *,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Save everything that is intact in a damaged or cut recording; exit status 1 if something is lost.

    Args:
        out: File to write (default: NAME.recovered.mcap).
    """
    from analysis.recording.container import recover as recover_file
    from analysis.recording.replay import recovered

    target = default_recovered(file) if out is None else out
    check_name(target, SUFFIX)
    check_files(str(file), target, suffix=SUFFIX)
    found = recover_file(file, target)
    show(recovered(found), as_json)
    say([f"wrote {target}"])
    return DONE if found.complete else CHECK_FAILED


def default_recovered(file: Path) -> Path:
    """NAME.recovered.mcap beside NAME.mcap or NAME.mcap.partial."""
    name = file.name.removesuffix(".partial").removesuffix(SUFFIX)
    if not name:
        raise InputError("has no name to make another of", source=file, fix="give --out")
    return file.with_name(f"{name}.recovered{SUFFIX}")
