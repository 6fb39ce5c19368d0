"""Runs of a store as flat files, one row a run: CSV, and Parquet with `pyarrow`. Constant memory."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from itertools import islice, product
from pathlib import Path
from typing import Any

from analysis.sweeps.cases import Label
from analysis.sweeps.results import Where, labels_of, select
from analysis.sweeps.rows import FIGURES, KEPT, exact_of, figures_of, outcomes_of
from analysis.sweeps.store.store import Run, Store
from planner.arguments import argument
from planner.errors import UsageError
from planner.files import Json, atomic_write
from planner.tally import Outcome

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
