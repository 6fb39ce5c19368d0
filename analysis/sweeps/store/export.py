"""Runs of a store as flat files, one row a run: CSV, and Parquet with `pyarrow`. Constant memory."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from analysis.sweeps.results import Where, labels_of, select
from analysis.sweeps.rows import FIGURES, exact_of, figure_of
from analysis.sweeps.store.store import Run, Store
from planner.arguments import argument
from planner.errors import UsageError
from planner.files import Json, atomic_write
from planner.tally import Outcome

BATCH = 1000
OUTCOMES = tuple(outcome.name.lower() for outcome in Outcome)
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
    row |= {"rollouts": run.rollouts} | dict.fromkeys(OUTCOMES, 0)
    row |= zip(OUTCOMES, run.sums["outcomes"], strict=False)  # older blocks lack the outcomes that came later
    row |= {"height": run.facts["shape"][0], "width": run.facts["shape"][1], "makespan": run.facts["makespan"]}
    row |= {name: cells[name] for name in ("accessible", "free", "dangerous")}
    for name in FIGURES:
        mean, squared = figure_of(run, name)
        row[f"{name}_mean"], row[f"{name}_se"] = mean, math.sqrt(squared)
    for name in ("visited", "survived", "time"):
        row[f"open_loop_exact_{name}"] = exact_of(run, name)
    ideal = run.facts["ideal_team"]
    row["ideal_team"] = None if ideal is None else ideal / cells["accessible"]
    return row | {"key": run.key, "world": run.facts["world"], "ids": str([list(pair) for pair in run.ids])}


def write_csv(store: Store, where: Where, path: Path) -> int:
    """Write the runs that fit as CSV, whole or not at all; returns how many. Raises InputError."""
    labels = list(labels_of(store, where))
    columns = [*labels, *COUNTS, *NUMBERS, *TEXTS]
    total = 0
    with atomic_write(path) as out:
        writer = csv.DictWriter(out, columns, lineterminator="\n")
        writer.writeheader()
        for run in select(store, where):
            writer.writerow(flat(run, labels))
            total += 1
    return total


def write_parquet(store: Store, where: Where, path: Path) -> int:
    """The same as Parquet: labels of whole numbers as int64, of numbers as float64, of others as text."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise UsageError(
            f"{argument('parquet')} needs pyarrow, which is not installed",
            fix=f'pip install "mrac-jax[parquet]", or use {argument("csv")}',
        ) from None
    kinds = _label_kinds(store, where)
    types = {"int": pyarrow.int64(), "float": pyarrow.float64(), "text": pyarrow.string(), "big": pyarrow.uint64()}
    schema = pyarrow.schema(
        [(name, types[kind]) for name, kind in kinds.items()]
        + [(name, types["int"]) for name in COUNTS]
        + [(name, types["float"]) for name in NUMBERS]
        + [(name, types["text"]) for name in TEXTS]
    )
    total = 0
    with atomic_write(path, "wb") as out, parquet.ParquetWriter(out, schema) as writer:
        for batch in _batches(store, where):
            rows = [_typed(flat(run, list(kinds)), kinds) for run in batch]
            writer.write_table(pyarrow.Table.from_pylist(rows, schema=schema))
            total += len(rows)
    return total


def _batches(store: Store, where: Where) -> Iterator[list[Run]]:
    runs = select(store, where)
    while batch := list(islice(runs, BATCH)):
        yield batch


def _label_kinds(store: Store, where: Where) -> dict[str, str]:
    """The narrowest kind that holds every value of each label."""
    kinds = dict.fromkeys(labels_of(store, where), "int")
    for run in select(store, where):
        for name in kinds:
            value = run.what.get(name)
            if isinstance(value, str | bool):
                kinds[name] = "text"
            elif isinstance(value, float) and kinds[name] != "text":
                kinds[name] = "float"
            elif isinstance(value, int) and value >= 2**63 and kinds[name] == "int":
                kinds[name] = "big"
    return kinds


def _typed(row: Json, kinds: dict[str, str]) -> Json:
    for name, kind in kinds.items():
        value = row[name]
        if value is not None and kind != "int" and kind != "big":
            row[name] = str(value) if kind == "text" else float(value)
    return row
