"""Settings on the same random maps with the same luck: figures of each, map by map, to compare them map by map.

Map number i of every setting has the same seed, and so have its rollouts.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice, product
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices
from analysis.statistics.variance_reduction import put_right
from analysis.sweeps.cases import Case, Label
from analysis.sweeps.engine import Done, Finished, Job, run_cases
from analysis.sweeps.results import FIGURES, KEPT, Where, exact_of, figures_of, is_exact, labels_of, outcomes_of, select
from analysis.sweeps.store import Memory, Run, Store
from analysis.utils.notes import ProgressCallback
from planner.arguments import argument
from planner.errors import UsageError
from planner.files import Json, atomic_write
from planner.tally import Outcome

Setting = TypeVar("Setting")
Columns = dict[str, NDArray[np.float64]]
"""Float64 `[M]` by figure, M maps: means of each map's rollouts, put right by their luck, or exact. "visited" and
"complete" are fractions, "losses" robots, "time" steps; "se": the standard error of "visited"; "exact": 1 where the
figures are known exactly."""
OfMap = tuple[NDArray[np.float64], NDArray[np.float64], bool]
"""Means and errors of `figures_of`, and whether they are exact."""
MAP_FIGURES = ("visited", "losses", "time", "complete")
EXACT_TEAM, EXACT_SECONDS = 2, 0.01
"""Robots whose tree takes about as long as some hundred rollouts (four take a second a map), and what it may take."""


class ByMap(Generic[Setting]):
    """The figures of settings, map by map, as they come.

    Args:
        cases: of a map's number, its settings with the case of each. seed: of the first map and its rollouts.
        rollouts: of each map and setting. exact: whether the exact values of teams of up to EXACT_TEAM are looked for.
    """

    def __init__(
        self, cases: Callable[[int], Iterable[tuple[Setting, Case]]], seed: int, rollouts: int, exact: bool = False
    ) -> None:
        self._cases, self._seed, self._rollouts, self._exact = cases, seed, rollouts, exact
        self._under_way: dict[Case, tuple[Setting, int]] = {}
        self._found: dict[Setting, dict[int, OfMap]] = {}

    def run(
        self, maps: int, total: int, store: Store | None, progress: ProgressCallback | None, **where: Any
    ) -> Finished:
        """Run `maps` maps, `total` jobs, into the store if there is one.

        `where`: `processes` and `scheduler` of `run_cases`.
        """
        held = Memory() if store is None else store

        def take(done: Done) -> None:
            setting, number = self._under_way.pop(done.job.case)
            run = held.run(done.keys[0])
            assert run is not None
            self._found.setdefault(setting, {})[number] = (*figures_of(run), is_exact(run))
            if store is None:
                held.forget(done.keys)
            if progress is not None:
                progress(done.jobs, done.total, done.seconds)

        return run_cases(self._jobs(maps), held, total=total, progress=take, **where)

    def _jobs(self, maps: int) -> Iterator[Job]:
        """Map after map, so that an interruption leaves whole maps."""
        for number in range(maps):
            for setting, case in self._cases(number):
                self._under_way[case] = (setting, number)
                small = self._exact and case.robots is not None and case.robots <= EXACT_TEAM
                model = RolloutChoices(seed=self._seed + number)
                yield Job(case, (model,), self._rollouts, exact_seconds=EXACT_SECONDS if small else 0.0)

    def columns(self, settings: Sequence[Setting]) -> dict[Setting, Columns]:
        """Of the maps, from the first on, that all of these settings have; nothing if there is none."""
        whole = 0
        while settings and all(whole in self._found.get(setting, ()) for setting in settings):
            whole += 1
        return {
            setting: _columns([self._found[setting][n] for n in range(whole)], self._rollouts)
            for setting in settings
            if whole
        }


def _columns(maps: Sequence[OfMap], rollouts: int) -> Columns:
    means, errors, exact = (np.array(of_all) for of_all in zip(*maps, strict=True))
    names, freedom = ("visited", "alive", "time", "complete"), len(maps) * (rollouts - 1)
    found = {name: put_right(means[:, KEPT[name]], errors[:, KEPT[name]], freedom) for name in names}
    (visited, se), (alive, _), (time, _), (complete, _) = (found[name] for name in names)
    losses = means[:, KEPT["robots"], 0] - alive
    figures = {"visited": visited, "losses": losses, "time": time, "complete": complete}
    return figures | {"se": se, "exact": exact.astype(np.float64)}


# Runs of a store as flat files, one row a run: CSV, and Parquet with `pyarrow`. Constant memory.

BATCH = 1000
WHOLE, LARGE, NUMBER, TEXT = range(4)
"""Kinds of columns, the narrower first."""
OUTCOMES = tuple(outcome.word for outcome in Outcome)
COUNTS = ("rollouts", *OUTCOMES, "height", "width", "accessible", "free", "dangerous", "makespan")
NUMBERS = (
    *(f"{name}_{part}" for name in FIGURES for part in ("mean", "se")),
    "open_loop_exact_visited",
    "open_loop_exact_survived",
    "open_loop_exact_time",
    "ideal_team",
)
TEXTS = ("key", "world", "ids")


def flat(run: Run, labels: list[str]) -> Json:
    """A run as one row: labels first; coverage as fractions, time in steps."""
    assert run.sums is not None
    cells = run.facts["cells"]
    row: Json = {name: run.what.get(name) for name in labels}
    row |= {"rollouts": run.rollouts} | outcomes_of(run)
    row |= {"height": run.facts["shape"][0], "width": run.facts["shape"][1], "makespan": run.facts["makespan"]}
    row |= {name: cells[name] for name in ("accessible", "free", "dangerous")}
    means, errors = figures_of(run)
    for name in FIGURES:
        row[f"{name}_mean"] = float(means[KEPT[name], 0])
        row[f"{name}_se"] = math.sqrt(errors[KEPT[name], 0, 0])
    for name in ("visited", "survived", "time"):
        row[f"open_loop_exact_{name}"] = exact_of(run, name)
    ideal = run.facts["ideal_team"]
    row["ideal_team"] = None if ideal is None else ideal / cells["accessible"]
    return row | {"key": run.key, "world": run.facts["world"], "ids": str([list(pair) for pair in run.ids])}


def write_csv(store: Store, where: Where, path: Path) -> None:
    """Write the runs that fit as CSV, whole or not at all. Raises InputError."""
    labels = list(labels_of(store, where))
    with atomic_write(path) as out:
        writer = csv.DictWriter(out, [*labels, *COUNTS, *NUMBERS, *TEXTS], lineterminator="\n")
        writer.writeheader()
        writer.writerows(flat(run, labels) for run in select(store, where))


def write_parquet(store: Store, where: Where, path: Path) -> None:
    """The same as Parquet: labels of whole numbers as int64, of numbers as float64, of others as text."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise UsageError(
            f"{argument('parquet')} needs pyarrow, which is not installed",
            fix=f'pip install "mrac-jax[parquet]", or use {argument("csv")}',
        ) from None
    types = (pyarrow.int64(), pyarrow.uint64(), pyarrow.float64(), pyarrow.string())
    kinds = _label_kinds(store, where)
    columns = kinds | dict.fromkeys(COUNTS, WHOLE) | dict.fromkeys(NUMBERS, NUMBER) | dict.fromkeys(TEXTS, TEXT)
    schema = pyarrow.schema([(name, types[kind]) for name, kind in columns.items()])
    cast: dict[int, Callable[[Any], Any]] = {NUMBER: float, TEXT: str}
    rows = (flat(run, list(kinds)) for run in select(store, where))
    with atomic_write(path, "wb") as out, parquet.ParquetWriter(out, schema) as writer:
        while batch := list(islice(rows, BATCH)):
            for row, (name, kind) in product(batch, kinds.items()):
                if row[name] is not None and kind in cast:
                    row[name] = cast[kind](row[name])
            writer.write_table(pyarrow.Table.from_pylist(batch, schema=schema))


def _label_kinds(store: Store, where: Where) -> dict[str, int]:
    """The narrowest kind that holds every value of each label."""
    kinds = dict.fromkeys(labels_of(store, where), WHOLE)
    for run in select(store, where):
        for name in kinds:
            kinds[name] = max(kinds[name], _kind(run.what.get(name)))
    return kinds


def _kind(value: Label) -> int:
    if isinstance(value, str | bool):
        return TEXT
    return NUMBER if isinstance(value, float) else LARGE if value is not None and value >= 2**63 else WHOLE
