"""What a store holds, as rows: runs filtered and grouped by their labels, each group a mean over its maps."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from analysis.sweeps.cases import Label
from analysis.sweeps.rows import KEPT, NUMBERS, Row, figures_of, moments_of, put, single_map
from analysis.sweeps.rows_report import shown
from analysis.sweeps.store.store import Run, Store
from planner.errors import UsageError
from planner.tally import Outcome

MAP_LABELS = ("map", "rollout_seed")
"""Labels that tell the maps of a setting apart; all others tell settings apart."""
MOST_VALUES = 8

Where = dict[str, tuple[str, ...]]
"""Values wanted of labels, as text."""


@dataclass(frozen=True, eq=False)
class Results:
    """What was found: the rows in order of their labels, the labels that every run shares, and notes."""

    rows: tuple[Row, ...]
    common: dict[str, Label]
    runs: int
    notes: tuple[str, ...] = ()


@dataclass(eq=False)
class _Group:
    """One group in the making; `values` as of `rows.put`."""

    labels: dict[str, Label]
    values: NDArray[np.float64] = field(default_factory=lambda: np.zeros((len(KEPT), NUMBERS)))
    rollouts: int = 0
    timeouts: int = 0
    key: str = ""

    def add(self, run: Run) -> None:
        """One more map."""
        assert run.sums is not None
        for name, (mean, error) in figures_of(run).items():
            put(self.values[KEPT.index(name)], mean, error)
        self.rollouts += run.rollouts
        self.timeouts += run.sums["outcomes"][Outcome.TIMEOUT]
        self.key = run.key


def parse_where(texts: Iterable[str]) -> Where:
    """`robots=4`, `kind=contiguous,scattered` as values by name. Raises UsageError."""
    where: Where = {}
    for text in texts:
        name, equals, values = text.partition("=")
        if not equals or not name or not values:
            raise UsageError(f"--where {text!r}", expected='NAME=VALUE, or NAME=VALUE,VALUE, as "robots=4,8"')
        where[name] = tuple(values.split(","))
    return where


def select(store: Store, where: Where) -> Iterator[Run]:
    """The runs with rollouts whose labels have one of the values wanted."""
    for run in store.runs():
        fits = all(name in run.what and shown(run.what[name]) in values for name, values in where.items())
        if fits and run.sums is not None:
            yield run


def collect(store: Store, where: Where, by: Sequence[str] = ()) -> Results:
    """The store's runs as rows. `by`: labels that tell groups apart; none: all that vary, but for the map's.

    Raises UsageError for a label that no run has, or when nothing is found.
    """
    seen = labels_of(store, where)
    wanted = list(by) or [name for name, values in seen.items() if name not in MAP_LABELS and len(values) > 1]
    groups: dict[tuple[Label, ...], _Group] = {}
    for run in select(store, where):
        place = tuple(run.what.get(name) for name in wanted)
        if place not in groups:
            groups[place] = _Group({name: run.what.get(name) for name in wanted})
        groups[place].add(run)
    ordered = sorted(groups.values(), key=lambda group: [_order(value) for value in group.labels.values()])
    common = {name: next(iter(values)) for name, values in seen.items() if len(values) == 1 and name not in wanted}
    mixed = [n for n, values in seen.items() if len(values) > 1 and n not in (*wanted, *MAP_LABELS)]
    notes = [f"every row mixes settings that differ in {', '.join(mixed)}: add them to --by"] if mixed else []
    return Results(tuple(_row(group, store) for group in ordered), common, sum(_maps(g) for g in ordered), tuple(notes))


def labels_of(store: Store, where: Where, also: Sequence[str] = ()) -> dict[str, set[Label]]:
    """The labels of the runs that fit, with up to a few values each. Raises UsageError if there are none."""
    seen: dict[str, set[Label]] = {}
    found = 0
    for found, run in enumerate(select(store, where), start=1):
        for name in dict.fromkeys((*seen, *run.what)):
            values = seen.setdefault(name, {None} if found > 1 else set())
            if len(values) < MOST_VALUES:
                values.add(run.what.get(name))
    if found == 0:
        raise _nothing(store, where)
    return seen


def check_names(seen: dict[str, set[Label]], names: Iterable[str], option: str) -> None:
    """Raise UsageError for a label that no run has."""
    for name in names:
        if name not in seen:
            close = difflib.get_close_matches(name, list(seen), n=1)
            fix = f"did you mean {close[0]!r}?" if close else ""
            raise UsageError(f"{option} {name}: no run has it", expected=f"one of {', '.join(seen)}", fix=fix)


def _nothing(store: Store, where: Where) -> UsageError:
    """The error when no run fits: an empty store, an unknown name, or values that no run has."""
    source = store.path or "store"
    if not where or not any(True for _ in select(store, {})):
        return UsageError("holds no rollouts", source=source, fix="`mrac-jax sweep` fills it")
    seen = labels_of(store, {})
    check_names(seen, where, "--where")
    name = next((n for n, values in where.items() if not set(map(shown, seen[n])) & set(values)), next(iter(where)))
    has = ", ".join(sorted(shown(value) for value in seen[name]))
    return UsageError(f"no run fits --where {name}={','.join(where[name])}", source=source, expected=f"{name} of {has}")


def _row(group: _Group, store: Store) -> Row:
    moments = {name: moments_of(group.values[at]) for at, name in enumerate(KEPT)}
    single = {}
    if moments["visited"].maps == 1:
        run, tally = store.run(group.key), store.tally(group.key)
        if run is not None and tally is not None:
            single = single_map(run, tally)
    return Row(group.labels, moments["visited"].maps, group.rollouts, group.timeouts, moments, single)


def _maps(group: _Group) -> int:
    return int(group.values[0, 0])


def _order(value: Label) -> tuple[int, float, str]:
    if isinstance(value, int | float):
        return (0, float(value), "")
    return (1, 0.0, "" if value is None else str(value))
