"""The commands on many maps and on formulas: `sweep`, `results`, `check`, `generate`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from analysis import api
from analysis.cli.console import DONE, check_files, check_folder, deliver
from analysis.cli.options import PLANNING, VERBATIM, Given, command, file, of, option
from analysis.utils.notes import say
from planner.errors import UsageError
from planner.settings import OUTPUT, SURVEY

RESEARCH = "Research"
FIGURES = ("visited", "survived", "visited_of_free", "survived_of_free", "complete", "time", "alive")
"""Names of `analysis.sweeps.results`, which is too slow to import for `--help`."""


@command(
    RESEARCH, api.sweep, "store", "Many maps: precision", "processes scheduler out json",
    out="Write the page, pictures, CSV and JSON to this folder.",
)  # fmt: skip
def sweep(spec: file("SPEC", "Sweep file (YAML)."), /, given: Given) -> int:  # type: ignore[valid-type]
    """A scenario with lists of settings, on many maps; stored results are reused.

    Every setting is run on the same maps and the same random numbers.
    """
    check_folder(given.out)
    answer = given.call(api.sweep, spec)
    kept = given.store or Path(f"{spec.stem}.store")
    say([f"results are in {kept}"])
    line = ["mrac-jax", "sweep", str(spec), "--store", str(kept)]
    line += [] if given.precision is None else ["--precision", f"{given.precision:g}"]
    return deliver(answer, out=given.out, as_json=given.json, command=shlex.join(line), also_read=(spec,))


@command(
    RESEARCH, api.results, "where by figure", "Output: plot csv parquet merge", "json",
    where=option(SURVEY, "Only runs with NAME=VALUE[,VALUE]; may be repeated.", "texts"),
    by=option(SURVEY, 'Labels that define the rows: "robots,kind" (default: all that vary).', "text"),
    figure=option(OUTPUT, "Figure of the picture (default: visited).", "", *FIGURES, default="visited"),
    merge=option(OUTPUT, "First copy the intact results of this store into STORE; may be repeated.", "texts"),
)  # fmt: skip
def results(
    store: file("STORE", "Store that `sweep` or `check --paper` wrote."),  # type: ignore[valid-type]
    /,
    given: Given,
) -> int:
    """Contents of a store: table, filter, picture, export, and union with other stores."""
    from analysis.sweeps.results import parse_where

    written = {".csv": given.csv, ".parquet": given.parquet, ".png": given.plot}
    for suffix, out in written.items():
        check_files(str(store), out, suffix=suffix)
    found = given.call(api.results, store, where=parse_where(given.where or []))
    return deliver(found, as_json=given.json, notes=[f"wrote {out}" for out in written.values() if out is not None])


@command(
    RESEARCH, api.check, "starts cell_size", PLANNING, "plan rollouts seed engine threat_checks",
    "Many maps: worlds paper maps kind size", "processes store scheduler bound", "Output: theory",
    "out json",
    robots=of(
        "robots", form="wholes",
        help='Number of robots (default: as in the input, else 1); with --worlds team sizes (default: "1,2,4,8,20").',
    ),
    plan="Check this plan file instead of planning.",
    seed="Seed of the rollouts, and of the first map of --worlds and --paper (default: 0).",
    out="Write pictures, JSON, and with --worlds the worst maps, to this folder.",
)  # fmt: skip
def check(
    source: Annotated[str | None, Parameter(name="INPUT", converter=VERBATIM, help="As INPUT of `evaluate`.")] = None,
    /,
    given: Given = None,  # type: ignore[assignment]
) -> int:
    """Check the paper's formulas on one map or on random maps, or its experiments.

    Expected values of the open loop are exact. Those of the closed loop are exact where that is cheap, else sampled,
    with simultaneous 95 % intervals. The exit status is 1 if a formula that is marked as proven fails. --paper repeats
    the experiments of the paper in some minutes on two cores.
    """
    mode = api.check_mode(given.values | {"world": source})
    check_folder(given.out)
    robots = given.robots
    if mode != "world" or source is None:
        answer = given.call(api.check, robots=(robots,) if isinstance(robots, int) else robots)
        return deliver(answer, out=given.out, as_json=given.json)
    from analysis.checking.check import check_world

    if isinstance(robots, tuple):
        raise UsageError(f"--robots {','.join(map(str, robots))}", expected="a whole number")
    world, made = given.planned(source, first=check_world)
    own = dict.fromkeys((*PLANNING.split(), "robots", "plan")) | {"bound": given.bound or None}
    answer = given.call(api.check, world, made, **own)
    return deliver(answer, out=given.out, as_json=given.json, source=source, also_read=(given.plan,))


@command(
    RESEARCH, api.generate, "Many maps: map kind size obstacles ratio areas levels seed robots cell_size",
)  # fmt: skip
def generate(out: file("OUT", "World file (.npz) to write."), /, given: Given) -> int:  # type: ignore[valid-type]
    """A random world of the paper, or a map with random threats."""
    source = None if given.map is None else str(given.map)
    check_files(source, out, suffix=".npz")
    world = given.call(api.generate)
    world.save(out, force=True)
    say([*world.notes, f"wrote {out}"])
    return DONE
