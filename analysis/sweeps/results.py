"""What a store holds, as rows: runs filtered and grouped by their labels, each group a mean over its maps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from analysis.report.answer import Answer
from analysis.sweeps.cases import RULES, Label, shown
from analysis.sweeps.older import EARLIER, MAP_LABELS, Older, is_older, older_note
from analysis.sweeps.pooled import Part, complete, map_of, moments_over, part_of, single_over
from analysis.sweeps.rows import Row
from analysis.sweeps.store.store import Run, Store
from planner.arguments import argument, check_word
from planner.errors import UsageError
from planner.shown import counted

MOST_VALUES = 8

Where = dict[str, tuple[str, ...]]
"""Values wanted of labels, as text."""


@dataclass(frozen=True, eq=False, repr=False)
class Results(Answer):
    """What was found: the rows in order of their labels, the labels that every run shares, and notes.

    `store`: its file. `runs`: how many the rows are made of. `pooled`: labels that vary within rows.
    """

    reported_by = "analysis.sweeps.report:report"
    listed, partial = "settings", False

    store: str
    rows: tuple[Row, ...]
    common: dict[str, Label]
    runs: int
    notes: tuple[str, ...]
    pooled: tuple[str, ...]


Group = dict[tuple[str, Label], list[Part]]
"""The runs of a row by map."""


def parse_where(texts: Iterable[str]) -> Where:
    """`robots=4`, `kind=contiguous,scattered` as values by name. Raises UsageError."""
    where: Where = {}
    for text in texts:
        name, equals, values = text.partition("=")
        if not equals or not name or not values:
            raise UsageError(
                f"{argument('where')} {text!r}", expected='NAME=VALUE, or NAME=VALUE,VALUE, as "robots=4,8"'
            )
        where[name] = tuple(values.split(","))
    return where


def select(store: Store, where: Where) -> Iterator[Run]:
    """The runs with rollouts whose labels have one of the values wanted."""
    older = Older(store)
    for run in map(older.labelled, store.runs()):
        fits = all(name in run.what and shown(run.what[name]) in values for name, values in where.items())
        if fits and run.sums is not None:
            yield run


def collect(store: Store, where: Where, by: Sequence[str] = ()) -> Results:
    """The store's runs as rows. `by`: labels that tell groups apart; none: all that vary, but for the map's.

    A row that pools settings is a mean over the maps that have all of them, and each map counts once
    (`analysis.sweeps.pooled`). Raises UsageError for a label that no run has, when nothing is found, or for a row of
    which no map has every setting.
    """
    seen = labels_of(store, where)
    for name in by:
        check_word("by", name, seen)
    # Rules tell settings apart only where some are of an earlier release, and are then never averaged.
    apart = EARLIER in seen.get(RULES, ())
    varying = [n for n, values in seen.items() if len(values) > 1 and n not in MAP_LABELS and (n != RULES or apart)]
    wanted = list(dict.fromkeys([*by, RULES] if apart else by)) if by else varying
    pooled = tuple(name for name in varying if name not in wanted)
    groups: dict[tuple[Label, ...], Group] = {}
    homes, older = dict[str, bool](), Counter[bool | None]()
    for run in select(store, where):
        if RULES not in run.what and not run.facts.get("rules"):
            older[is_older(run, store, homes)] += 1
        group = groups.setdefault(tuple(run.what.get(name) for name in wanted), {})
        group.setdefault(map_of(run), []).append(part_of(run, pooled))
    notes = _pooled_notes(seen, wanted, pooled) + older_note(older[True], older[None])
    rows, runs = [], 0
    for place in sorted(groups, key=lambda values: [_order(value) for value in values]):
        labels, group = dict(zip(wanted, place, strict=True)), _in_order(groups[place])
        maps = complete(group.values())
        said = ", ".join(f"{name} {shown(value)}" for name, value in labels.items()) or "all runs"
        if not maps:
            fix = f"use {argument('by', [*wanted, *pooled])}, or choose some with {argument('where')}"
            expected = "maps that have all of them"
            raise UsageError(f"{said}: no map has every {' and '.join(pooled)} of the row", expected=expected, fix=fix)
        if len(maps) < len(group):
            lack = counted(len(group) - len(maps), "map")
            notes.append(f"{said}: {lack} of {len(group):,} lack some of what is pooled and are left out")
        rows.append(_row(labels, maps, store))
        runs += sum(map(len, maps))
    common = {name: next(iter(values)) for name, values in seen.items() if len(values) == 1 and name not in wanted}
    return Results(str(store.path or "store"), tuple(rows), common, runs, tuple(notes), pooled)


def _in_order(group: Group) -> Group:
    """The maps by their labels, and the runs of each by theirs: sums do not depend on which was finished first."""
    told = {name: sorted(parts, key=lambda part: [_order(one) for one in (*part.setting, part.seed)])
            for name, parts in group.items()}  # fmt: skip
    return dict(sorted(told.items(), key=lambda one: (one[0][0], _order(one[0][1]))))


def _pooled_notes(seen: dict[str, set[Label]], wanted: Sequence[str], pooled: Sequence[str]) -> list[str]:
    """What every row pools, in words."""
    if not pooled:
        return []
    parts = []
    for name in pooled:
        values = [shown(value) or "none" for value in sorted(seen[name], key=_order)]
        parts.append(f"{name}: {', '.join(values)}{', ...' if len(values) == MOST_VALUES else ''}")
    apart = argument("by", [*wanted, *pooled])
    return [f"pooled over {'; '.join(parts)} (each map counts once; {apart} tells them apart)"]


def labels_of(store: Store, where: Where) -> dict[str, set[Label]]:
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


def _nothing(store: Store, where: Where) -> UsageError:
    """The error when no run fits: an empty store, an unknown name, or values that no run has."""
    source = store.path or "store"
    if not where or not any(True for _ in select(store, {})):
        return UsageError("holds no rollouts", source=source, fix="`mrac-jax sweep` fills it")
    seen = labels_of(store, {})
    for name in where:
        check_word("where", name, seen)
    name = next((n for n, values in where.items() if not set(map(shown, seen[n])) & set(values)), next(iter(where)))
    has = ", ".join(sorted(shown(value) for value in seen[name]))
    return UsageError(
        f"no run fits {argument('where')} {name}={','.join(where[name])}", source=source, expected=f"{name} of {has}"
    )


def _row(labels: dict[str, Label], maps: Sequence[Sequence[Part]], store: Store) -> Row:
    parts = [part for of_map in maps for part in of_map]
    single = {}
    if len(maps) == 1:
        found = [(part.setting, store.run(part.key), store.tally(part.key)) for part in parts]
        single = single_over([(s, run, tally) for s, run, tally in found if run is not None and tally is not None])
    rollouts, outcomes = sum(part.rollouts for part in parts), Counter[str]()
    for part in parts:
        outcomes.update(part.outcomes)
    return Row(labels, rollouts, outcomes, moments_over(maps), single=single)


def _order(value: Label) -> tuple[int, float, str]:
    if isinstance(value, int | float):
        return (0, float(value), "")
    return (1, 0.0, "" if value is None else str(value))
