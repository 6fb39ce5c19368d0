"""The commands `sweep` and `results` of `mrac-jax`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Literal, get_args

from cyclopts import Parameter

from analysis.cli.console import check_files, check_folder
from analysis.cli.deliver import deliver
from analysis.cli.options import OUTPUT, Json, Number, OutPath, Text, Whole, one_of, path, verbatims
from analysis.kit.notes import say
from planner.errors import UsageError
from planner.shown import counted

Figure = Literal["visited", "survived", "visited_of_free", "survived_of_free", "complete", "time", "alive"]
"""Those of `analysis.sweeps.rows`, which is too heavy to import for `--help`."""


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
    from analysis.sweeps.store.store import Store
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
    from analysis.sweeps.results import collect, parse_where
    from analysis.sweeps.store.export import write_csv, write_parquet
    from analysis.sweeps.store.store import Store

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
        from analysis.pictures.style import png_of
        from analysis.report.picture import charts_figure
        from planner.files import atomic_write

        with atomic_write(plot, "wb") as out:
            out.write(png_of(charts_figure, [rows_chart(found.rows, figure)]))
    return deliver(found, as_json=as_json, notes=[f"wrote {file}" for file in (csv, parquet, plot) if file is not None])


def _merge(store: Path, others: list[Path]) -> None:
    """Union of blocks, into `store`."""
    from analysis.sweeps.store.store import Store

    for other in others:
        if other.resolve() == store.resolve():
            raise UsageError(f"--merge {other} is the store itself", expected="another one")
    for other in others:
        with Store.rescue(other) as source, Store.open(store) as target:
            count, notes = target.merge(source)
        say([f"{other}: {counted(count, 'run')} taken over", *(f"left out: {note}" for note in notes)])
