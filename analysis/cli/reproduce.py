"""The command `mrac-jax reproduce`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from analysis.cli.console import check_folder
from analysis.cli.deliver import deliver
from analysis.cli.options import OUTPUT, Json, OutPath, Text, Whole, one_of, path
from planner.errors import UsageError

NAMES = ("fig4", "fig5", "fig6", "fig7", "all", "policies", "online", "moving")
MAPS, ROLLOUTS = 500, 20
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
    from analysis.knowing.study import study_knowing
    from analysis.policies.study import study_policies
    from analysis.reproduction.reproduce import reproduce as run_experiments
    from analysis.sweeps.engine import check_where
    from analysis.sweeps.store.store import Store
    from analysis.sweeps.worlds import check_maps
    from planner.policies import DEFAULT, RULES

    check_folder(out)
    count = USUAL.get(figure, ROLLOUTS) if rollouts is None else rollouts
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
