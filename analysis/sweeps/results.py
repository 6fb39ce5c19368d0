"""Results of a store: rows of means over maps, flat files of runs, and figures map by map for paired comparisons."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, product
from math import isfinite, nan
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from analysis.report.result import Result
from analysis.statistics.estimates import MISSED, Z95, Estimate
from analysis.statistics.variance_reduction import FIGURES as CONTROLLED
from analysis.statistics.variance_reduction import (
    NEGLIGIBLE,
    TERMS,
    complete_chance,
    tally_mean,
    weights_of,
    with_controls,
)
from analysis.sweeps.cases import RULES, Label, format_label
from analysis.sweeps.engine import EARLIER, MAP_LABELS, runs_by_rules
from analysis.sweeps.spec import WORLD, is_path
from analysis.sweeps.store import Run, Store
from planner.arguments import MAX_STEP, MOST_ROLLOUTS, argument, check_word
from planner.errors import UsageError
from planner.files import Json, atomic_write
from planner.formatting import counted
from planner.simulator.codes import Outcome
from planner.tally import Tally, counts_by_word

# Means over maps, with intervals from the variance between maps.
#
# The mean of one map is one observation. The interval is Student's t of the map means, so it includes the noise of the
# rollouts within each map. The control variate reduces that noise (`analysis.statistics.variance_reduction`). The share
# of the variance within maps tells whether more maps or more rollouts narrow the interval.


class Moments:
    """Map means of several figures with control variates, added map by map in constant memory.

    Axes: `F` figures, `L` TERMS: the figure, then its control variates.

    Attributes:
        maps: number. mean: of the map means, float64 `[F, L]`.
        scatter, lean: second and third central moments of the map means, as sums, `[F, L, L]`, `[F, L, L, L]`.
        within: sum of the error covariances of the map means, `[F, L, L]`.
        freedom: degrees of freedom of the slopes, each map's rollouts less one.
        shared: squared standard error of the mean from random numbers that maps share, which `scatter` lacks, `[F]`.
    """

    def __init__(self, figures: int, columns: int = TERMS) -> None:
        """`columns`: L."""
        self.maps = self.freedom = 0
        self.mean, self.scatter, self.lean = (np.zeros((figures, *(columns,) * power)) for power in (1, 2, 3))
        self.within, self.shared = np.zeros_like(self.scatter), np.zeros(figures)

    def add(self, means: NDArray[np.float64], errors: NDArray[np.float64] | float, freedom: int = 0) -> None:
        """Add a map: its means `[F, L]`, the covariances of their errors `[F, L, L]`, and its share of `freedom`."""
        self.maps += 1
        self.freedom += freedom
        step = means - self.mean
        share = step / self.maps
        grows = np.einsum("fa,fb->fab", step, share) * (self.maps - 1)
        turned = np.einsum("fa,fbc->fabc", share, self.scatter)
        # Update formulas of Pebay (2008) for the second and third central moments.
        self.mean += share
        self.lean += np.einsum("fa,fbc->fabc", share, grows) * (self.maps - 2)
        self.lean -= turned + turned.transpose(0, 2, 1, 3) + turned.transpose(0, 2, 3, 1)
        self.scatter += grows
        self.within += errors

    def weights(self, place: int) -> NDArray[np.float64]:
        """(1, -b) `[L]` of the figure at `place`; no control variate if maps share random numbers."""
        return weights_of(self.within[place], 0 if self.shared.any() else self.freedom)

    def within_share(self, place: int) -> float | None:
        """Share of the variance of the map means that is noise of the rollouts within maps; None if unknown."""
        weights = self.weights(place)
        scatter, within = (float(weights @ of[place] @ weights) for of in (self.scatter, self.within))
        if self.maps < 2 or scatter <= 0:
            return None
        return min(1.0, within / self.maps / (scatter / (self.maps - 1)))

    def estimate(self, place: int, low: float, high: float, weights: NDArray[np.float64] | None = None) -> Estimate:
        """Mean over maps of the figure at `place`, its standard error and 95 % interval, clipped to `low .. high`.

        With two maps or more: Student's t, widened for rare kinds of maps, by the figure with or without the control
        variate, as in `analysis.statistics.estimates.mean_estimate`; if all maps agree, the rule of three. With one
        map: the noise of its rollouts, for that map alone. `weights` replaces the figure's own weights.
        """
        if self.maps == 0:
            raise ValueError("no maps to estimate from")
        maps, shared = self.maps, float(self.shared[place])
        by = self.weights(place) if weights is None else weights
        mean, terms = float(self.mean[place] @ by), self.scatter[place] * np.outer(by, by)
        scatter = 0.0 if terms.sum() <= NEGLIGIBLE * abs(terms).sum() else float(terms.sum())
        if maps == 1:
            se = math.sqrt(by @ self.within[place] @ by)
            half = Z95 * se
        else:
            squared, half = scatter / (maps - 1) / maps, 3.0 * (high - low) / maps
            if scatter > 0:
                rare = float(np.einsum("abc,a,b,c", self.lean[place], by, by, by)) / scatter / maps
                alone = self.lean[place, 0, 0, 0] / max(self.scatter[place, 0, 0], NEGLIGIBLE * scatter) / maps
                missed = MISSED * max(rare**2, alone**2)  # the control variate does not reveal unseen rare maps
                half = float(stdtrit(maps - 1, 0.975)) * math.sqrt(squared + missed)
            se = math.hypot(math.sqrt(squared), math.sqrt(shared))
            half = math.hypot(half, Z95 * math.sqrt(shared))
        mean = min(max(mean, low), high)
        return Estimate(mean, se, (max(mean - half, low), min(mean + half, high)))


# Rows of results: one setting with its figures as means over maps, for `sweep` and `results`.

Figure = Literal["visited", "survived", "visited_of_free", "survived_of_free", "complete", "time", "alive"]
FIGURES: tuple[Figure, ...] = get_args(Figure)
"""Figures of runs: coverage as a fraction of the accessible or of the free cells, the fraction of rollouts that covered
everything, time in steps, robots alive at the end."""
FRACTIONS = FIGURES[:4]
EXACT = ("visited", "survived")
REACH = {"alive": "robots", "time": "longest"}
"""Facts of a run that bound a figure; coverage and chances are at most 1."""
KEPT = {name: place for place, name in enumerate((*FIGURES, *(f"exact {n}" for n in EXACT), "ideal", *REACH.values()))}
"""Index of each mean in a row's moments. `exact`: of the open loop; `ideal`: upper bound of the team's coverage."""
DIFFERENCES = ("visited", "time")


@dataclass(eq=False)
class Row:
    """The results of one setting.

    Attributes:
        labels: of the setting. rollouts: number. outcomes: rollouts by outcome. moments: of KEPT.
        apart: of DIFFERENCES from the first row on the same maps, with the control variates of both. first: that row's
            moments.
        single: estimates of a single map's rollouts, by figure; empty if there are several maps.
    """

    labels: dict[str, Label]
    rollouts: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    moments: Moments = field(default_factory=lambda: Moments(len(KEPT)))
    apart: Moments = field(default_factory=lambda: Moments(len(DIFFERENCES), 2 * TERMS - 1))
    first: Moments | None = None
    single: dict[str, Estimate] = field(default_factory=dict)
    json_keys = """
        setting=labels maps rollouts outcomes *figures open_loop_exact ideal_team difference_from_first=differences
        within_share
    """

    def add(
        self,
        means: NDArray[np.float64],
        errors: NDArray[np.float64],
        freedom: int,
        first: NDArray[np.float64] | None = None,
    ) -> None:
        """Add a map, see `Moments.add`; `first`: the first row's means on it."""
        self.moments.add(means, errors, freedom)
        if first is not None:
            here, there = (of[[KEPT[name] for name in DIFFERENCES]] for of in (means, first))
            self.apart.add(np.hstack([here[:, :1] - there[:, :1], here[:, 1:], there[:, 1:]]), 0.0)

    @property
    def maps(self) -> int:
        """Number of maps."""
        return self.moments.maps

    def estimate(self, name: str) -> Estimate:
        """The mean over maps of one of KEPT, or of a figure over the rollouts of a single map."""
        return self.single.get(name) or self.moments.estimate(KEPT[name], 0.0, self.reach(name))

    def known(self, name: str) -> Estimate | None:
        """The mean over maps of one of KEPT that is exact for the plan; None if it is unknown."""
        found = self.estimate(name)
        return found if isfinite(found.mean) else None

    def reach(self, name: str) -> float:
        """Upper bound of a figure on maps of this row."""
        return float(self.moments.mean[KEPT[REACH[name]], 0]) if name in REACH else 1.0

    def difference(self, name: str) -> Estimate | None:
        """ "visited" or "time" minus that of the first row, on the maps that both have; None for the first row."""
        if self.apart.maps < 2 or self.first is None or self.first is self.moments:
            return None
        reach, (mine, theirs) = self.reach(name), (of.weights(KEPT[name]) for of in (self.moments, self.first))
        weights = np.concatenate([mine, -theirs[1:]])
        return self.apart.estimate(DIFFERENCES.index(name), -reach, reach, weights)

    @property
    def figures(self) -> dict[Figure, Estimate]:
        """Every figure."""
        return {name: self.estimate(name) for name in FIGURES}

    @property
    def open_loop_exact(self) -> dict[str, Estimate | None]:
        """Coverage of the open loop by meaning, where it is known."""
        return {name: self.known(f"exact {name}") for name in EXACT}

    @property
    def ideal_team(self) -> Estimate | None:
        """Upper bound of the team's coverage, where it is known."""
        return self.known("ideal")

    @property
    def differences(self) -> dict[str, Estimate | None]:
        """Each of DIFFERENCES from the first row."""
        return {name: self.difference(name) for name in DIFFERENCES}

    @property
    def within_share(self) -> float | None:
        """Share of rollout noise in the variance of the map means of visited coverage."""
        return self.moments.within_share(KEPT["visited"])


def figures_of(run: Run) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means of KEPT on a run's map with control variates `[KEPT, L]`, and the covariances of their errors."""
    facts, ideal = run.facts, run.facts["ideal_team"]
    assert run.sums is not None
    done = run.sums["outcomes"][Outcome.COMPLETE]
    sums = [(done, done) if name == "complete" else tuple(run.sums[name]) for name in CONTROLLED]
    found = with_controls(run.rollouts, sums, run.sums.get("luck", ()), facts["robots"])
    means, errors = (np.zeros((len(KEPT), *one.shape[1:])) for one in found)
    for name in FIGURES:
        place, unit = CONTROLLED.index(name.removesuffix("_of_free")), unit_of(run, name)
        own = np.array([unit, *(1.0,) * (TERMS - 1)])
        means[KEPT[name]], errors[KEPT[name]] = found[0][place] * own, found[1][place] * np.outer(own, own)
    known = [exact_of(run, name) for name in EXACT]
    known.append(nan if ideal is None else ideal / facts["cells"]["accessible"])
    means[len(FIGURES) :, 0] = [*known, facts["robots"], longest_of(run)]
    return means, errors


def outcomes_of(run: Run) -> Counter[str]:
    """Rollouts by outcome.

    The run's facts hold whether the deadline ended rollouts; stores of 0.3 hold a deadline only as a label.
    """
    deadline = "deadline" in run.facts or run.what.get("deadline") is not None
    return Counter(counts_by_word(() if run.sums is None else run.sums["outcomes"], deadline))


def exact_of(run: Run, name: str) -> float:
    """The open loop's exact mean of a figure of a run; NaN if unknown."""
    value = run.facts["exact"][name.removesuffix("_of_free")]
    return nan if value is None else float(value) * unit_of(run, name)


def unit_of(run: Run, name: str) -> float:
    """The factor from cells, steps or robots to the unit of a figure."""
    if name not in FRACTIONS:
        return 1.0
    cells = run.facts["cells"]
    return 1.0 / float(cells["free" if name.endswith("_of_free") else "accessible"])


def longest_of(run: Run) -> int:
    """Upper bound of a rollout's steps; older stores lack it: then T_max for the largest possible number of levels."""
    facts, cells = run.facts, run.facts["cells"]
    if "longest" in facts:
        return int(facts["longest"])
    return min(8 * (cells["dangerous"] + 1) * cells["accessible"] + 64 + facts["makespan"], MAX_STEP)


def single_map(run: Run, tally: Tally) -> dict[str, Estimate]:
    """Estimates of one run's rollouts as in `evaluate`, valid for rare events."""
    found = {"complete": complete_chance(tally)}
    for name in FIGURES:
        if name != "complete":
            # The bound of the time guards its interval against unseen values.
            most = longest_of(run) if name == "time" else None
            found[name] = tally_mean(tally, name.removesuffix("_of_free"), unit_of(run, name), most)
    return found


# Rows that pool several runs of a map: each map is averaged first, and counts once.
#
# Runs of a map are pooled over settings (with equal weights) and, within a setting, over rollout seeds (by rollouts).
# Settings share random numbers, so their errors may be perfectly correlated: the errors of one seed are added linearly,
# an upper bound for any correlation. Errors of different seeds are independent and add in squares.

Setting = tuple[Label, ...]
"""A run's values of the pooled labels."""


@dataclass(frozen=True, eq=False)
class Part:
    """Data of a run for its row.

    Attributes:
        key: of the run. setting: its values of the pooled labels. seed: of its rollouts.
        rollouts: number. outcomes: rollouts by outcome. means, errors: see `figures_of`.
    """

    key: str
    setting: Setting
    seed: Label
    rollouts: int
    outcomes: Counter[str]
    means: NDArray[np.float64]
    errors: NDArray[np.float64]


def part_of(run: Run, pooled: Sequence[str]) -> Part:
    """The part of a row from one run; `pooled`: names of labels that vary within rows."""
    setting = tuple(run.what.get(name) for name in pooled if name != "input" or "map" in run.what)
    return Part(run.key, setting, run.what.get("rollout_seed"), run.rollouts, outcomes_of(run), *figures_of(run))


def map_of(run: Run) -> tuple[str, Label]:
    """Identity of a run's map, the same for all settings of a sweep.

    A generated map is identified by its seed: worlds of one seed share obstacles and random numbers. Other maps are
    identified by the world's content, or by the input if the sweep changes its scenario.
    """
    if run.what.get("map") is not None:
        return "map", run.what["map"]
    if any(name in WORLD or is_path(name) for name in run.what):
        return "input", run.what.get("input")
    return "world", run.facts["world"]


def complete(maps: Iterable[list[Part]]) -> list[list[Part]]:
    """The maps that have all settings that occur."""
    maps = list(maps)
    settings = {part.setting for parts in maps for part in parts}
    return [parts for parts in maps if {part.setting for part in parts} == settings]


def pooling_weights(parts: Sequence[tuple[Setting, int]]) -> NDArray[np.float64]:
    """Weights of a map's (setting, rollouts), float64 that sum to 1: equal for settings, within one by rollouts."""
    totals: dict[Setting, int] = {}
    for setting, rollouts in parts:
        totals[setting] = totals.get(setting, 0) + rollouts
    return np.array([rollouts / totals[setting] / len(totals) for setting, rollouts in parts])


def moments_over(maps: Sequence[Sequence[Part]]) -> Moments:
    """Moments of KEPT over maps, each map an average over its parts.

    Maps with the same rollout seed may share random numbers. The variance between maps lacks that error, so it is added
    (`Moments.shared`).
    """
    found = Moments(len(KEPT))
    shared: dict[Label, list[NDArray[np.float64]]] = {}
    for parts in maps:
        weights = pooling_weights([(part.setting, part.rollouts) for part in parts])
        of_seed: dict[Label, list[tuple[float, Part]]] = {}
        for weight, part in zip(weights.tolist(), parts, strict=True):
            of_seed.setdefault(part.seed, []).append((weight, part))
        errors = {seed: _errors(each) for seed, each in of_seed.items()}
        freedom = sum(max(part.rollouts for _, part in each) - 1 for each in of_seed.values())
        means = np.tensordot(weights, [part.means for part in parts], 1)
        found.add(means, np.sum([*errors.values()], axis=0), freedom)
        for seed, error in errors.items():
            shared.setdefault(seed, []).append(np.sqrt(error[:, 0, 0]) / len(maps))
    for each in shared.values():
        if len(each) > 1:
            found.shared += sum(each) ** 2
    return found


def _errors(parts: Sequence[tuple[float, Part]]) -> NDArray[np.float64]:
    """The covariances `[KEPT, L, L]` of a map's errors with one seed, added linearly as if perfectly correlated."""
    alone = np.sum([weight**2 * part.errors for weight, part in parts], axis=0)
    apart = np.sqrt(alone[:, 0, 0])
    together = np.sum([weight * np.sqrt(part.errors[:, 0, 0]) for weight, part in parts], axis=0)
    scale: NDArray[np.float64] = np.divide(together, apart, out=np.ones_like(apart), where=apart > 0) ** 2
    return alone * scale[:, None, None]


def single_over(found: Sequence[tuple[Setting, Run, Tally]]) -> dict[str, Estimate]:
    """Estimates of one map's rollouts by name, as `single_map`, pooled over its runs.

    Runs that differ only in their seed form one sample. The half-widths of other runs are averaged, which is valid for
    any correlation.
    """
    samples: dict[tuple[Setting, str], tuple[Run, Tally]] = {}
    for number, (setting, run, tally) in enumerate(found):
        name = setting, tally.key.rpartition("/")[0]
        apart = number * MOST_ROLLOUTS  # other seeds give independent rollouts: shift their ids
        own = replace(tally, key=name[1], ids=tuple((start + apart, stop + apart) for start, stop in tally.ids))
        samples[name] = (run, samples[name][1] + own if name in samples else own)
    weights = pooling_weights([(setting, tally.rollouts) for (setting, _), (_, tally) in samples.items()])
    singles = [single_map(run, tally) for run, tally in samples.values()]
    return {name: _averaged([each[name] for each in singles], weights) for name in singles[0]}


def _averaged(estimates: Sequence[Estimate], weights: NDArray[np.float64]) -> Estimate:
    if len(estimates) == 1:
        return estimates[0]
    columns = np.array([(each.mean, each.se, *each.ci95) for each in estimates])
    mean, se, low, high = (weights @ columns).tolist()
    return Estimate(mean, se, (low, high))


MOST_VALUES = 8

Where = dict[str, tuple[str, ...]]
"""Wanted values of labels, as text."""


@dataclass(frozen=True, eq=False, repr=False)
class Results(Result):
    """The rows in order of their labels, the labels that every run shares, and notes.

    Attributes:
        store: its file. runs: number of runs in the rows. pooled: labels that vary within rows.
    """

    reported_by = "analysis.sweeps.report:of_results"
    listed, partial = "settings", False

    store: str
    rows: tuple[Row, ...]
    common: dict[str, Label]
    runs: int
    notes: tuple[str, ...]
    pooled: tuple[str, ...]
    json_keys = "store runs common pooled notes settings=rows"


Group = dict[tuple[str, Label], list[Part]]
"""Runs of a row by map."""


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
    """The runs with rollouts whose labels have a wanted value."""
    for run in runs_by_rules(store):
        fits = all(name in run.what and format_label(run.what[name]) in values for name, values in where.items())
        if fits and run.sums is not None:
            yield run


def collect(store: Store, where: Where, by: Sequence[str] = ()) -> Results:
    """The store's runs as rows.

    Args:
        where: wanted values of labels. by: labels that separate rows; none: all that vary, except those of the map.

    A row that pools settings is a mean over the maps that have all of them; each map counts once. Raises UsageError for
    an unknown label, if no run fits, or for a row of which no map has every setting.
    """
    seen = labels_of(store, where)
    for name in by:
        check_word("by", name, seen)
    # Rules separate rows only if some runs follow earlier rules; these are never averaged with others.
    apart = EARLIER in seen.get(RULES, ())
    varying = [n for n, values in seen.items() if len(values) > 1 and n not in MAP_LABELS and (n != RULES or apart)]
    wanted = list(dict.fromkeys([*by, RULES] if apart else by)) if by else varying
    pooled = tuple(name for name in varying if name not in wanted)
    groups: dict[tuple[Label, ...], Group] = {}
    for run in select(store, where):
        group = groups.setdefault(tuple(run.what.get(name) for name in wanted), {})
        group.setdefault(map_of(run), []).append(part_of(run, pooled))
    notes = _pooled_notes(seen, wanted, pooled)
    rows, runs = [], 0
    for place in sorted(groups, key=lambda values: [_order(value) for value in values]):
        labels, group = dict(zip(wanted, place, strict=True)), _in_order(groups[place])
        maps = complete(group.values())
        said = ", ".join(f"{name} {format_label(value)}" for name, value in labels.items()) or "all runs"
        if not maps:
            fix = f"use {argument('by', [*wanted, *pooled])}, or select some with {argument('where')}"
            expected = "maps that have all of them"
            raise UsageError(f"{said}: no map has every {' and '.join(pooled)} of the row", expected=expected, fix=fix)
        if len(maps) < len(group):
            lack = counted(len(group) - len(maps), "map")
            notes.append(f"{said}: {lack} of {len(group):,} lack some pooled settings and are omitted")
        rows.append(_row(labels, maps, store))
        runs += sum(map(len, maps))
    common = {name: next(iter(values)) for name, values in seen.items() if len(values) == 1 and name not in wanted}
    return Results(str(store.path or "store"), tuple(rows), common, runs, tuple(notes), pooled)


def _in_order(group: Group) -> Group:
    """Maps by their labels, and each map's runs by theirs, so that sums do not depend on the order of execution."""
    ordered = {name: sorted(parts, key=lambda part: [_order(one) for one in (*part.setting, part.seed)])
            for name, parts in group.items()}  # fmt: skip
    return dict(sorted(ordered.items(), key=lambda one: (one[0][0], _order(one[0][1]))))


def _pooled_notes(seen: dict[str, set[Label]], wanted: Sequence[str], pooled: Sequence[str]) -> list[str]:
    """Note on the labels that every row pools."""
    if not pooled:
        return []
    parts = []
    for name in pooled:
        values = [format_label(value) or "none" for value in sorted(seen[name], key=_order)]
        parts.append(f"{name}: {', '.join(values)}{', ...' if len(values) == MOST_VALUES else ''}")
    apart = argument("by", [*wanted, *pooled])
    return [f"pooled over {'; '.join(parts)} (each map counts once; {apart} separates them)"]


def labels_of(store: Store, where: Where) -> dict[str, set[Label]]:
    """The labels of the runs that fit, with a few values each. Raises UsageError if no run fits."""
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
    """The error if no run fits: an empty store, an unknown name, or values that no run has."""
    source = store.path or "store"
    if not where or not any(True for _ in select(store, {})):
        return UsageError("holds no rollouts", source=source, fix="run `mrac-jax sweep` first")
    seen = labels_of(store, {})
    for name in where:
        check_word("where", name, seen)
    name = next(
        (n for n, values in where.items() if not set(map(format_label, seen[n])) & set(values)), next(iter(where))
    )
    has = ", ".join(sorted(format_label(value) for value in seen[name]))
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


# Runs of a store as flat files, one row a run: CSV, and Parquet with `pyarrow`. Constant memory.

BATCH = 1000
WHOLE, LARGE, NUMBER, TEXT = range(4)
"""Kinds of columns, narrowest first."""


def flat(run: Run, labels: Iterable[str]) -> Json:
    """A run as one row: labels, counts, figures, texts; coverage as fractions, time in steps."""
    facts, cells, ideal = run.facts, run.facts["cells"], run.facts["ideal_team"]
    row: Json = {name: run.what.get(name) for name in labels}
    row |= {"rollouts": run.rollouts} | outcomes_of(run)
    row |= {"height": facts["shape"][0], "width": facts["shape"][1]}
    row |= {name: cells[name] for name in ("accessible", "free", "dangerous")} | {"makespan": facts["makespan"]}
    means, errors = figures_of(run)
    for name, place in list(KEPT.items())[: len(FIGURES)]:
        row |= {f"{name}_mean": float(means[place, 0]), f"{name}_se": math.sqrt(errors[place, 0, 0])}
    row |= {f"open_loop_exact_{name}": exact_of(run, name) for name in ("visited", "survived", "time")}
    row["ideal_team"] = None if ideal is None else ideal / cells["accessible"]
    return row | {"key": run.key, "world": facts["world"], "ids": str([list(pair) for pair in run.ids])}


def write_csv(store: Store, where: Where, path: Path) -> None:
    """Write the runs that fit as CSV, completely or not at all. Raises InputError."""
    labels = labels_of(store, where)
    rows = (flat(run, labels) for run in select(store, where))
    with atomic_write(path) as out:
        writer = csv.writer(out, lineterminator="\n")
        for number, row in enumerate(rows):
            writer.writerows([row.values()] if number else [row.keys(), row.values()])


def write_parquet(store: Store, where: Where, path: Path) -> None:
    """As `write_csv` in Parquet: integer labels as int64, other numbers as float64, other labels as text."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        problem = f"{argument('parquet')} needs pyarrow, which is not installed"
        raise UsageError(problem, fix=f'pip install "mrac-jax[parquet]", or use {argument("csv")}') from None
    types = (pyarrow.int64(), pyarrow.uint64(), pyarrow.float64(), pyarrow.string())
    labels = _label_kinds(store, where)
    kinds = {name: _kind(0.0 if one is None else one) for name, one in flat(next(select(store, where)), ()).items()}
    schema = pyarrow.schema([(name, types[kind]) for name, kind in (labels | kinds).items()])
    cast: dict[int, Callable[[Any], Any]] = {NUMBER: float, TEXT: str}
    rows = (flat(run, labels) for run in select(store, where))
    with atomic_write(path, "wb") as out, parquet.ParquetWriter(out, schema) as writer:
        while batch := list(islice(rows, BATCH)):
            for row, (name, kind) in product(batch, labels.items()):
                if row[name] is not None and kind in cast:
                    row[name] = cast[kind](row[name])
            writer.write_table(pyarrow.Table.from_pylist(batch, schema=schema))


def _label_kinds(store: Store, where: Where) -> dict[str, int]:
    """The narrowest kind that holds all values of each label."""
    kinds = dict.fromkeys(labels_of(store, where), WHOLE)
    for run in select(store, where):
        for name in kinds:
            kinds[name] = max(kinds[name], _kind(run.what.get(name)))
    return kinds


def _kind(value: Label) -> int:
    if isinstance(value, str | bool):
        return TEXT
    return NUMBER if isinstance(value, float) else LARGE if value is not None and value >= 2**63 else WHOLE
