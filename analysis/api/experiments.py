"""Many maps: sweeps, the paper's experiments, what a store holds."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.kit.calls import OnInterrupt, ask
from analysis.kit.notes import Doing, Progress

if TYPE_CHECKING:
    from distributed import Client

    from analysis.reproduction.reproduce import Reproduction
    from analysis.sweeps.results import Results
    from analysis.sweeps.sweep import Sweep


def sweep(
    spec: str | Path,
    store: str | Path | None = None,
    *,
    precision: float | None = None,
    processes: int | None = None,
    scheduler: str | Client | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Sweep:
    """A sweep file run, on all cores, into a store that resumes (default: NAME.store beside you).

    Args:
        precision: more maps until every interval of mean coverage is within so much of it. processes: at a time.
        scheduler: a dask.distributed scheduler to run on instead: its address, "tcp://host:8786", or an open Client.
            No result depends on it.
        progress, on_interrupt: as of `evaluate`; jobs are counted.
    """
    from analysis.sweeps.engine import check_where
    from analysis.sweeps.spec import read_spec
    from analysis.sweeps.store.store import Store
    from analysis.sweeps.sweep import check_precision, run_sweep

    asked = read_spec(Path(spec))
    check_precision(precision)

    def work(tell: Progress, doing: Doing) -> Sweep:
        check_where(processes, scheduler)
        with Store.open(Path(f"{asked.source.stem}.store") if store is None else Path(store)) as opened:
            how: Any = {"precision": precision, "processes": processes, "scheduler": scheduler}
            return run_sweep(asked, opened, watch=lambda *now: tell(*now[:3]), **how)

    return ask(work, progress, on_interrupt, "jobs")


def reproduce(
    figure: Literal["fig4", "fig5", "fig6", "fig7", "all"] = "all",
    *,
    maps: int = 500,
    rollouts: int = 20,
    seed: int = 0,
    store: str | Path | None = None,
    processes: int | None = None,
    scheduler: str | Client | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Reproduction:
    """The paper's experiments again, with intervals; results are kept in `store` if one is named.

    Args:
        maps: of each setting; rollouts: of each map. processes, scheduler: as of `sweep`.
        progress, on_interrupt: as of `evaluate`; jobs are counted.
    """
    from analysis.reproduction.reproduce import reproduce as run_experiments
    from analysis.sweeps.engine import check_where
    from analysis.sweeps.store.store import Store
    from analysis.sweeps.worlds import check_maps

    check_maps(maps, seed)

    def work(tell: Progress, doing: Doing) -> Reproduction:
        check_where(processes, scheduler)
        with nullcontext() if store is None else Store.open(Path(store)) as kept:
            how: Any = {"maps": maps, "rollouts": rollouts, "seed": seed, "store": kept, "processes": processes}
            return run_experiments(figure, **how, scheduler=scheduler, progress=tell)

    return ask(work, progress, on_interrupt, "jobs")


def results(store: str | Path, *, by: Sequence[str] = (), where: dict[str, Any] | None = None) -> Results:
    """What a store holds, as rows: a mean over maps for each setting.

    Args:
        by: labels that tell rows apart (default: all that vary). where: values wanted of labels, one or several each.
    """
    from analysis.sweeps.results import collect
    from analysis.sweeps.store.store import Store

    def texts(value: object) -> tuple[str, ...]:
        several = value if isinstance(value, list | tuple | set | np.ndarray) else [value]
        return tuple(str(one) for one in several)

    wanted = {name: texts(value) for name, value in (where or {}).items()}
    with Store.open(Path(store), write=False) as opened:
        return collect(opened, wanted, list(by))
