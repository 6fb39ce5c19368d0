"""The command `mrac-jax reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from analysis.cli.console import check_folder
from analysis.cli.deliver import deliver
from analysis.cli.options import OUTPUT, Json, OutPath, Text, Whole, one_of, path
from planner.errors import UsageError

NAMES = ("fig4", "fig5", "fig6", "fig7", "all", "policies")
MAPS, ROLLOUTS, OF_POLICIES = 500, 50, 200


def reproduce(
    figure: Annotated[
        Literal["fig4", "fig5", "fig6", "fig7", "all", "policies"], Parameter(name="FIGURE", converter=one_of(*NAMES))
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

    500 maps and 50 rollouts of each take some minutes on two cores (policies: a quarter of an hour). The result depends
    on maps, rollouts and seed alone.

    Args:
        figure: Of the paper's section on experiments, or all of them; policies: what other policies bring.
        maps: Random maps a point (default: 500, as in the paper).
        rollouts: Of each map (default: 50, of policies 200; the paper ran one).
        seed: Of the first map and its rollouts (default: 0).
        store: Keep results in this file, and take from it what it has.
        processes: Maps at a time (default: one a core).
        scheduler: Run on this dask scheduler instead, as tls://host:port or tcp://host:port.
        out: Write pictures, tables, JSON and CSV to this folder.
    """
    from analysis.cli.progress import show_pool_progress
    from analysis.policies.study import study_policies
    from analysis.reproduction.reproduce import reproduce as run_experiments
    from analysis.sweeps.store.store import Store
    from planner.policies import DEFAULT, RULES

    check_folder(out)
    usual = OF_POLICIES if figure == "policies" else ROLLOUTS
    count = usual if rollouts is None else rollouts
    if not 1 <= count <= 2**32:
        raise UsageError(f"--rollouts {count}", expected="1 to 4294967296")
    kept = Store.memory() if store is None else Store.open(store)
    how: Any = {
        "maps": MAPS if maps is None else maps, "rollouts": count, "seed": seed or 0, "processes": processes,
        "scheduler": scheduler,
    }  # fmt: skip
    policies = list(RULES) if figure == "policies" else [DEFAULT]
    with kept, show_pool_progress("jobs", policies) as progress:
        if figure == "policies":
            study = study_policies(**how, store=kept, progress=progress)
            return deliver(study, out=out, as_json=as_json)
        answer = run_experiments(figure, **how, store=kept, progress=progress)
    return deliver(answer, out=out, as_json=as_json)
