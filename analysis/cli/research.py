"""The commands on many maps and on formulas: `sweep`, `results`, `check`, `generate`."""

from __future__ import annotations

import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from analysis.cli.console import DONE, check_files, check_folder, deliver, load_or_make_plan, show_pool_progress
from analysis.cli.options import PLANNING, Given, command, file, of, option, parse_whole, verbatim
from analysis.utils.notes import say
from planner.errors import UsageError
from planner.formatting import counted
from planner.settings import OPTIONS, OUTPUT, SURVEY

RESEARCH = "Research"
FIGURES = ("visited", "survived", "visited_of_free", "survived_of_free", "complete", "time", "alive")
"""Names of `analysis.sweeps.results`, which is too slow to import for `--help`."""


@command(
    RESEARCH,
    "store",
    store="Keep results in this file, and reuse those that it has (default: NAME.store).",
    precision=of(
        "precision", group=SURVEY, help="Add maps until every 95 % interval of mean coverage is this narrow."
    ),
    processes=OPTIONS["processes"],
    scheduler=OPTIONS["scheduler"],
    out="Write the page, pictures, CSV and JSON to this folder.",
    json=OPTIONS["json"],
)  # fmt: skip
def sweep(spec: file("SPEC", "Sweep file (YAML)."), /, given: Given) -> int:  # type: ignore[valid-type]
    """A scenario with lists of settings, on many maps; stored results are reused.

    Every setting is run on the same maps and the same random numbers.
    """
    from analysis.sweeps.engine import check_where
    from analysis.sweeps.spec import read_spec
    from analysis.sweeps.store import Store
    from analysis.sweeps.sweep import check_precision, run_sweep

    check_folder(given.out)
    asked, precision = read_spec(spec), given.precision
    check_precision(precision)
    where = {"processes": given.processes, "scheduler": given.scheduler}
    check_where(**where)
    kept = Path(f"{spec.stem}.store") if given.store is None else given.store
    with Store.open(kept) as opened, show_pool_progress("jobs", asked.policies) as watch:
        answer = run_sweep(asked, opened, precision=precision, watch=watch, **where)
    say([f"results are in {kept}"])
    line = ["mrac-jax", "sweep", str(spec), "--store", str(kept)]
    line += [] if precision is None else ["--precision", f"{precision:g}"]
    return deliver(answer, out=given.out, as_json=given.json, command=shlex.join(line), also_read=(spec,))


@command(
    RESEARCH,
    where=option(SURVEY, "Only runs with NAME=VALUE[,VALUE]; may be repeated.", "texts"),
    by=option(SURVEY, 'Labels that define the rows: "robots,kind" (default: all that vary).', "text"),
    figure=option(OUTPUT, "Figure of the picture (default: visited).", "", *FIGURES, default="visited"),
    plot=option(OUTPUT, "Write a picture (.png) of the figure over the first numeric label.", "path"),
    csv=option(OUTPUT, "Write one line per run (.csv).", "path"),
    parquet=option(OUTPUT, "Write one row per run (.parquet).", "path"),
    merge=option(OUTPUT, "First copy the intact results of this store into STORE; may be repeated.", "texts"),
    json=OPTIONS["json"],
)  # fmt: skip
def results(
    store: file("STORE", "Store that `sweep` or `check --paper` wrote."),  # type: ignore[valid-type]
    /,
    given: Given,
) -> int:
    """Contents of a store: table, filter, picture, export, and union with other stores."""
    from analysis.sweeps.report import rows_chart
    from analysis.sweeps.results import collect, parse_where, write_csv, write_parquet
    from analysis.sweeps.store import Store

    plot, csv, parquet = given.plot, given.csv, given.parquet
    for out, suffix in ((plot, ".png"), (csv, ".csv"), (parquet, ".parquet")):
        check_files(str(store), out, suffix=suffix)
    wanted, names = parse_where(given.where or []), [name for name in (given.by or "").split(",") if name]
    if given.by is not None and not names:
        raise UsageError(f"--by {given.by!r}", expected='names of labels, "robots,kind"')
    if given.merge:
        _merge(store, list(map(Path, given.merge)))
    with Store.open(store, write=False) as opened:
        found = collect(opened, wanted, names)
        for out, write in ((csv, write_csv), (parquet, write_parquet)):
            if out is not None:
                write(opened, wanted, out)
    if plot is not None:
        from analysis.page.charts import charts_figure
        from analysis.pictures import png_of
        from planner.files import atomic_write

        with atomic_write(plot, "wb") as stream:
            stream.write(png_of(charts_figure, [rows_chart(found.rows, given.figure)]))
    notes = [f"wrote {out}" for out in (csv, parquet, plot) if out is not None]
    return deliver(found, as_json=given.json, notes=notes)


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


PAPER = ("fig4", "fig5", "fig6", "fig7", "all")
MAPS, ROLLOUTS_OF_A_MAP = 500, 20
KIND = option(SURVEY, "Pattern of the threats (default: contiguous).", "", "contiguous", "scattered")
SIZE = option(SURVEY, "Size of a map, HxW in cells (default: 20x20).", "text")


@command(
    RESEARCH, "starts cell_size", PLANNING, "plan rollouts seed engine threat_checks",
    robots=of(
        "robots", form="text",
        help='Number of robots (default: as in the input, else 1); with --worlds team sizes (default: "1,2,4,8,20").',
    ),
    plan="Check this plan file instead of planning.",
    rollouts="Number of closed-loop rollouts (default: 20000; 4096 a team with --worlds; 20 a map with --paper).",
    seed="Seed of the rollouts, and of the first map of --worlds and --paper (default: 0).",
    worlds=option(SURVEY, "Check this many random maps instead of an INPUT.", "whole"),
    paper=option(SURVEY, "Check the statements of the paper's experiments on random maps.", "", *PAPER),
    maps=option(SURVEY, "With --paper: random maps per setting (default: 500, as in the paper).", "whole"),
    kind=KIND,
    size=SIZE,
    processes=OPTIONS["processes"],
    store=OPTIONS["store"],
    scheduler=OPTIONS["scheduler"],
    bound=OPTIONS["bound"],
    theory=option(
        OUTPUT, "Table of an INPUT: main, a row per formula, or all readings and meanings (default: main).", "",
        "main", "all", default="main",
    ),
    out="Write pictures, JSON, and with --worlds the worst maps, to this folder.",
    json=OPTIONS["json"],
)  # fmt: skip
def check(
    source: Annotated[str | None, Parameter(name="INPUT", converter=verbatim, help="As INPUT of `evaluate`.")] = None,
    /,
    given: Given = None,  # type: ignore[assignment]
) -> int:
    """Check of the paper's formulas on a map, on random maps, or of its experiments.

    Expected values of the open loop are exact. Those of the closed loop are exact where that is cheap, else sampled,
    with simultaneous 95 % intervals. The exit status is 1 if a formula that is marked as proven fails. --paper repeats
    the experiments of the paper in some minutes on two cores.
    """
    from analysis.checking.check import check_input, check_world
    from analysis.inputs import check_mode
    from analysis.utils.progress import show_progress

    mode = check_mode(given.values | {"world": source})
    check_folder(given.out)
    if mode == "paper":
        return _check_paper(given)
    if mode == "worlds" or source is None:
        return _check_worlds(given)
    robots = None if given.robots is None else parse_whole(given.robots, "--robots")
    choices = given.rolled(20_000)
    asked = Given(given.values | {"robots": robots}).asked(source)
    world, made, notes = load_or_make_plan(asked, given.plan, first=check_world)
    say(notes)
    with show_progress() as progress:
        answer = check_input(world, made, choices, progress, given.bound or None, given.theory)
    return deliver(answer, out=given.out, as_json=given.json, source=source, also_read=(given.plan,))


def _check_worlds(given: Given) -> int:
    from analysis.checking.check import make_survey, run_survey

    choices = make_survey(given.worlds, given.kind, given.size, _team_sizes(given.robots), given.choices, given.bound)
    rollouts = given.rolled(4096)
    with show_pool_progress("worlds", [choices.settings.policy]) as progress:
        answer = run_survey(choices, rollouts, processes=given.processes, progress=progress)
    return deliver(answer, out=given.out, as_json=given.json)


def _team_sizes(text: str | None) -> tuple[int, ...]:
    """Team sizes of a survey, increasing."""
    text = "1,2,4,8,20" if text is None else text
    try:
        sizes = [parse_whole(part.strip(), "--robots") for part in text.split(",")]
    except UsageError:
        sizes = []
    if not sizes or not all(1 <= size <= 1024 for size in sizes):
        raise UsageError(f"--robots {text!r}", expected='team sizes 1..1024, as "1,2,4,8,20"')
    return tuple(sorted(set(sizes)))


def _check_paper(given: Given) -> int:
    from analysis.experiments.reproduction import reproduce
    from analysis.sweeps.cases import check_maps
    from analysis.sweeps.engine import check_where
    from analysis.sweeps.store import Store
    from planner.policies import DEFAULT

    count = ROLLOUTS_OF_A_MAP if given.rollouts is None else given.rollouts
    OPTIONS["rollouts"].numbers.check("rollouts", count)
    maps, seed = MAPS if given.maps is None else given.maps, given.seed or 0
    check_maps(maps, seed)
    where = {"processes": given.processes, "scheduler": given.scheduler}
    check_where(**where)
    kept = nullcontext() if given.store is None else Store.open(given.store)
    with kept as store, show_pool_progress("jobs", [DEFAULT]) as progress:
        answer = reproduce(given.paper, maps=maps, rollouts=count, seed=seed, store=store, progress=progress, **where)
    return deliver(answer, out=given.out, as_json=given.json)


@command(
    RESEARCH,
    map=option(SURVEY, "Put the threats on the free cells of this INPUT.", "text"),
    kind=KIND,
    size=SIZE,
    obstacles=option(SURVEY, "Fraction of the cells that are obstacles (default: 0.25).", "number"),
    ratio=option(SURVEY, "Fraction of dangerous cells; with --map, of its free cells (default: 0.25).", "number"),
    areas=option(SURVEY, "Number of contiguous areas of threats (default: 10).", "whole"),
    levels=option(SURVEY, "Threat levels, in turn (default: 0.04,0.08,0.12,0.16,0.20).", "text"),
    seed=of("seed", group=SURVEY, help="Seed of the map (default: 0)."),
    robots=of("robots", group=SURVEY, help="Also store the starts of this many robots, upper left."),
    cell_size=of("cell_size", group=SURVEY, help="With --map: side of a cell in metres; the map is coarsened."),
)  # fmt: skip
def generate(out: file("OUT", "World file (.npz) to write."), /, given: Given) -> int:  # type: ignore[valid-type]
    """A random world of the paper, or a map with random threats."""
    from analysis.inputs import generate_world

    check_files(given.map, out, suffix=".npz")
    asked = {name: value for name, value in given.values.items() if name != "map"}
    world, notes = generate_world(given.map, **asked | {"kind": given.kind or "contiguous"})
    world.save(out, force=True)
    say([*notes, f"wrote {out}"])
    return DONE
