"""The commands `sweep` and `results` of `mrac-jax`."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from cyclopts import Parameter

from analysis.cli.console import check_files, check_folder, deliver
from analysis.cli.options import OUTPUT, Json, Number, OutPath, Seed, Text, Whole, one_of, path, verbatims
from analysis.utils.notes import say
from planner.errors import UsageError
from planner.formatting import counted

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
    from analysis.cli.progress import show_pool_progress
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
    from analysis.cli.progress import show_pool_progress
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
    from analysis.cli.progress import show_pool_progress
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
