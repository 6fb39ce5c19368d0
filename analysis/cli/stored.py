"""The commands about what is kept: `sweep` and `results`; `record`, `replay`, `inspect` and `recover`."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from cyclopts import Group, Parameter

from analysis.cli.console import CHECK_FAILED, DONE, INTERRUPTED, check_files, check_folder, deliver, may_replace, show
from analysis.cli.options import (
    OUTPUT,
    PLANNING,
    ROLLOUTS,
    Engine,
    Force,
    Input,
    Json,
    Number,
    OutPath,
    PlanningToTheEnd,
    Recording,
    Seed,
    StateFile,
    Team,
    Text,
    Whole,
    one_of,
    path,
    verbatims,
)
from analysis.recording.names import SUFFIX, check_name, growing_name, layout_name, left_over, state_name
from analysis.utils.notes import say
from planner.errors import InputError, UsageError
from planner.formatting import counted

# The commands `sweep` and `results` of `mrac-jax`.

Figure = Literal["visited", "survived", "visited_of_free", "survived_of_free", "complete", "time", "alive"]
"""Those of `analysis.sweeps.results`, which is too heavy to import for `--help`."""


def sweep(
    spec: Annotated[Path, Parameter(name="SPEC", converter=path)],
    /,
    *,
    store: Annotated[Path | None, Parameter(converter=path)] = None,
    precision: Number = None,
    processes: Whole = None,
    scheduler: Text = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Cross any scenario with lists of settings, on many maps; what the store has is not run again.

    Every setting meets the same maps and the same random numbers, so that differences between settings are sharp.

    Args:
        spec: Sweep file (YAML).
        store: Keep results in this file, and take from it what it has (default: NAME.store).
        precision: More maps until every 95 % interval of mean visited coverage is within this of its mean.
        processes: Processes of this machine (default: one a core).
        scheduler: Run on this dask.distributed scheduler instead, as tls://host:8786 or tcp://host:8786.
        out: Write the page, pictures, CSV and JSON to this folder.
    """
    from analysis.cli.console import show_pool_progress
    from analysis.sweeps.engine import check_where
    from analysis.sweeps.spec import read_spec
    from analysis.sweeps.store import Store
    from analysis.sweeps.sweep import check_precision, run_sweep

    check_folder(out)
    asked = read_spec(spec)
    check_precision(precision)
    check_where(processes, scheduler)
    kept = Path(f"{spec.stem}.store") if store is None else store
    with Store.open(kept) as opened, show_pool_progress("jobs", asked.policies) as watch:
        answer = run_sweep(asked, opened, precision=precision, watch=watch, processes=processes, scheduler=scheduler)
    say([f"results are in {kept}"])
    command = ["mrac-jax", "sweep", str(spec), "--store", str(kept)]
    command += [] if precision is None else ["--precision", f"{precision:g}"]
    return deliver(answer, out=out, as_json=as_json, command=shlex.join(command), beside=(spec,))


def results(
    store: Annotated[Path, Parameter(name="STORE", converter=path)],
    /,
    *,
    where: Annotated[list[str] | None, Parameter(converter=verbatims)] = None,
    by: Text = None,
    figure: Annotated[Figure, Parameter(converter=one_of(*get_args(Figure)))] = "visited",
    plot: OutPath = None,
    csv: OutPath = None,
    parquet: OutPath = None,
    merge: Annotated[list[str] | None, Parameter(converter=verbatims, group=OUTPUT)] = None,
    as_json: Json = False,
) -> int:
    """What a store holds: table, filter, picture, export, and union with other stores.

    Args:
        store: A store that `sweep` or `reproduce` made.
        where: Only runs with NAME=VALUE[,VALUE].
        by: Labels that tell rows apart, "robots,kind" (default: all that vary).
        figure: Of the picture (default: visited).
        plot: Write a picture (.png) of the figure, over the first label of numbers.
        csv: Write one line a run here (.csv).
        parquet: The same as Parquet (.parquet).
        merge: First take over what is intact in this store; STORE is made if there is none.
    """
    from analysis.sweeps.report import rows_chart
    from analysis.sweeps.results import collect, parse_where, write_csv, write_parquet
    from analysis.sweeps.store import Store

    for file, suffix in ((plot, ".png"), (csv, ".csv"), (parquet, ".parquet")):
        check_files(str(store), file, suffix=suffix)
    wanted, names = parse_where(where or []), [name for name in (by or "").split(",") if name]
    if by is not None and not names:
        raise UsageError(f"--by {by!r}", expected='names of labels, "robots,kind"')
    if merge:
        _merge(store, list(map(Path, merge)))
    with Store.open(store, write=False) as opened:
        found = collect(opened, wanted, names)
        for file, write in ((csv, write_csv), (parquet, write_parquet)):
            if file is not None:
                write(opened, wanted, file)
    if plot is not None:
        from analysis.pictures import png_of
        from analysis.report.rendering import charts_figure
        from planner.files import atomic_write

        with atomic_write(plot, "wb") as out:
            out.write(png_of(charts_figure, [rows_chart(found.rows, figure)]))
    return deliver(found, as_json=as_json, notes=[f"wrote {file}" for file in (csv, parquet, plot) if file is not None])


def _merge(store: Path, others: list[Path]) -> None:
    """Union of blocks, into `store`."""
    from analysis.sweeps.store import Store

    for other in others:
        if other.resolve() == store.resolve():
            raise UsageError(f"--merge {other} is the store itself", expected="another one")
    for other in others:
        with Store.rescue(other) as source, Store.open(store) as target:
            count, notes = target.merge(source)
        say([f"{other}: {counted(count, 'run')} taken over", *(f"left out: {note}" for note in notes)])


# The command `mrac-jax reproduce`.

NAMES = ("fig4", "fig5", "fig6", "fig7", "all", "policies", "online", "moving")
MAPS, REPRODUCE_ROLLOUTS = 500, 20
USUAL = {"policies": 200, "online": 10, "moving": 40}
"""Rollouts of each map that the answers beside the paper's figures take."""


def reproduce(
    figure: Annotated[
        Literal["fig4", "fig5", "fig6", "fig7", "all", "policies", "online", "moving"],
        Parameter(name="FIGURE", converter=one_of(*NAMES)),
    ],
    /,
    *,
    maps: Whole = None,
    rollouts: Whole = None,
    seed: Whole = None,
    store: Annotated[Path | None, Parameter(converter=path)] = None,
    processes: Whole = None,
    scheduler: Text = None,
    out: Annotated[OutPath, Parameter(group=OUTPUT)] = None,
    as_json: Json = False,
) -> int:
    """The paper's experiments again, with intervals: which of its statements hold on random maps of its kind?

    500 maps and 20 rollouts of each take some minutes on two cores (policies, online, moving: a quarter of an hour).
    The result depends on maps, rollouts and seed alone.

    Args:
        figure: Of the paper's section on experiments, or all of them; policies: what other policies bring; online: what
            a map is worth that robots are not given; moving: what if its threats walk.
        maps: Random maps a point (default: 500, as in the paper).
        rollouts: Of each map (default: 20, of policies 200, online 10, moving 40; the paper ran one).
        seed: Of the first map and its rollouts (default: 0).
        store: Keep results in this file, and take from it what it has.
        processes: Maps at a time (default: one a core).
        scheduler: Run on this dask scheduler instead, as tls://host:port or tcp://host:port.
        out: Write pictures, tables, JSON and CSV to this folder.
    """
    from analysis.cli.console import show_pool_progress
    from analysis.experiments.information_value import study_knowing
    from analysis.experiments.policies import study_policies
    from analysis.experiments.reproduction import reproduce as run_experiments
    from analysis.sweeps.cases import check_maps
    from analysis.sweeps.engine import check_where
    from analysis.sweeps.store import Store
    from planner.policies import DEFAULT, RULES

    check_folder(out)
    count = USUAL.get(figure, REPRODUCE_ROLLOUTS) if rollouts is None else rollouts
    if not 1 <= count <= 2**32:
        raise UsageError(f"--rollouts {count}", expected="1 to 4294967296")
    check_maps(MAPS if maps is None else maps, seed or 0)
    check_where(processes, scheduler)
    kept = nullcontext() if store is None else Store.open(store)
    how: Any = {
        "maps": MAPS if maps is None else maps, "rollouts": count, "seed": seed or 0, "processes": processes,
        "scheduler": scheduler,
    }  # fmt: skip
    answer: Any
    with kept as held, show_pool_progress("jobs", list(RULES) if figure in USUAL else [DEFAULT]) as progress:
        how |= {"store": held, "progress": progress}
        if figure == "policies":
            answer = study_policies(**how)
        elif figure == "online" or figure == "moving":
            answer = study_knowing(figure, **how)
        else:
            answer = run_experiments(figure, **how)
    return deliver(answer, out=out, as_json=as_json)


# The command `mrac-jax suite`.

SUITE_ROLLOUTS = 1000


def suite(
    *,
    policy: Annotated[Path | None, Parameter(converter=path)] = None,
    actions: Annotated[Literal["moves", "areas"] | None, Parameter(converter=one_of("moves", "areas"))] = None,
    plans: Annotated[list[str] | None, Parameter(converter=verbatims, negative="")] = None,
    only: Text = None,
    rollouts: Whole = None,
    seed: Seed = None,
    processes: Whole = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Thirty named worlds, the same for everybody: who covers most, and how much is left to gain?

    The planner's policies, its open loop, a random walk, a policy of your own and plans of other planners, all on the
    same random numbers, with the proven bound for every strategy.

    Args:
        policy: A Python file that defines `policy`: a function of what the robots observe, as `mrac.judge` takes it,
            or a planner's Rule.
        actions: What the function chooses: a move of each robot, or the next area (default: moves).
        plans: NAME=FOLDER with another planner's plans, ID.json for the world ID; more than one may be given.
        only: Worlds by name or pattern, "contiguous-10-??-k1,terrain-k8" (default: all).
        rollouts: On each world (default: 1000).
        processes: Worlds at a time (default: one a core).
        out: Write the page, tables (Markdown, CSV), JSON and the worlds as files to this folder.
    """
    from analysis.cli.console import show_pool_progress
    from analysis.policy_evaluation.leaderboard import choose, own_of, run_suite
    from planner.policies import RULES

    check_folder(out)
    names, folders = choose(only), {}
    for given in plans or []:
        name, found, folder = given.partition("=")
        if not (name and found and folder):
            raise UsageError(f"--plans {given!r}", expected="NAME=FOLDER")
        if name in folders:
            raise UsageError(f"--plans {given!r}: {name!r} is named twice", expected="a name of its own for each")
        folders[name] = folder
    if policy is None and actions is not None:
        raise UsageError(f"--actions {actions} without --policy", fix="add --policy, or leave it out")
    own = None if policy is None else own_of(policy, actions or "moves")
    count = SUITE_ROLLOUTS if rollouts is None else rollouts
    with show_pool_progress("worlds", RULES) as progress:
        answer = run_suite(names, own, folders, count, seed or 0, processes, progress)
    return deliver(answer, out=out, as_json=as_json)


# The commands `record`, `replay`, `inspect` and `recover` of `mrac-jax`.

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
    from analysis.cli.console import load_or_make_plan
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
        what.request(foreign=planning.plan_for == "open_loop")
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
