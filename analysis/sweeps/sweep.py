"""A sweep: its jobs run into a store, map by map, until all maps are done or the widest interval is narrow enough.

What precision buys: the interval of a setting's mean is the spread between maps (`analysis.sweeps.results`), of which
the rollouts' noise within each map is mostly a small share. So `precision` takes more maps, twice as many at each look,
and more rollouts only where the input is a single map. The share is reported.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.sweeps.cases import MOST_MAPS
from analysis.sweeps.engine import Done, Finished, Swept, run_cases
from analysis.sweeps.results import Row, figures_of, outcomes_of, single_map
from analysis.sweeps.spec import Spec
from analysis.sweeps.store import Store, StoreError
from planner.arguments import BLOCK, MOST_ROLLOUTS, argument
from planner.errors import UsageError
from planner.files import Json

Watch = Callable[[int, int, float, str], None]
"""`watch(jobs, total, seconds, more)`: jobs done of so many, seconds since the start, and in words how wide the widest
95 % interval of mean visited coverage is so far, "" before there is one."""


@dataclass(frozen=True, eq=False, repr=False)
class Sweep(Swept):
    """A sweep's answer. `rows` in the order of the settings; partial: interrupted."""

    reported_by = "analysis.sweeps.report:report"
    listed = "settings"

    spec: Spec
    rows: tuple[Row, ...]
    finished: Finished
    precision: float | None = None
    reached: bool = True

    @property
    def widest_row(self) -> Row | None:
        """The setting with the widest interval of mean visited coverage."""
        return max(self.rows, key=lambda row: row.estimate("visited").half_width, default=None)

    @property
    def widest(self) -> float:
        """Half the width of that interval; NaN if there is none."""
        return math.nan if self.widest_row is None else self.widest_row.estimate("visited").half_width

    @property
    def within_share(self) -> float | None:
        """Share of the rollouts' noise in the variance of the map means, where the interval is widest."""
        return None if self.widest_row is None else self.widest_row.within_share


class _Table:
    """The rows of the settings that have a map, by setting; some 12 kB each, however many maps.

    Jobs are added in order of their tags, whoever finished first, so that the sums do not depend on the engine.
    """

    def __init__(self, spec: Spec, store: Store) -> None:
        self.spec, self.store = spec, store
        self.found: dict[int, Row] = {}
        self.waiting: list[tuple[int, tuple[str, ...]]] = []
        self.next = 0
        self.first = (-1, np.empty(0))

    def add(self, tag: int, keys: tuple[str, ...]) -> None:
        """A finished job, by the keys of its runs."""
        heapq.heappush(self.waiting, (tag, keys))
        while self.waiting and self.waiting[0][0] == self.next:
            self._add(*heapq.heappop(self.waiting))
            self.next += 1

    def rows(self) -> tuple[Row, ...]:
        """Every setting that has a map, also of jobs that wait for others that will not come: it was interrupted."""
        while self.waiting:
            self._add(*heapq.heappop(self.waiting))
        return tuple(self.found[setting] for setting in sorted(self.found))

    def _add(self, tag: int, keys: tuple[str, ...]) -> None:
        number, case = divmod(tag, len(self.spec.cases))
        for model, key in enumerate(keys):
            setting, run = case * len(self.spec.models) + model, self.store.run(key)
            if run is None or run.sums is None:
                raise StoreError(f"run {key[:12]} has gone", source=self.store.path or "store")
            if setting not in self.found:
                self.found[setting] = Row(self.spec.labels(case, model))
            row, (means, errors) = self.found[setting], figures_of(run)
            if setting == 0:
                self.first = (number, means)
            row.first = self.found[0].moments if 0 in self.found else None
            row.add(means, errors, run.rollouts - 1, self.first[1] if self.first[0] == number else None)
            row.rollouts += run.rollouts
            row.outcomes.update(outcomes_of(run))
            tally = self.store.tally(key) if row.maps == 1 else None
            row.single = {} if tally is None else single_map(run, tally)

    def widest(self) -> float:
        """Half the width of the widest interval of mean visited coverage; NaN where there is none yet."""
        known = (row for row in self.found.values() if row.maps > 1 or self.spec.maps is None)
        return max((row.estimate("visited").half_width for row in known), default=math.nan)


def run_sweep(
    spec: Spec,
    store: Store,
    *,
    precision: float | None = None,
    watch: Watch | None = None,
    **where: Any,
) -> Sweep:
    """Run a sweep into a store; what the store has is not run again.

    Args:
        spec: what. store: where results go. where: `processes`, `scheduler` as of `run_cases`.
        precision: go on until half the width of the widest 95 % interval of mean visited coverage, a fraction of the
            accessible cells, is below this: with twice the maps at each look, or twice the rollouts of a single map.
        watch: called after every job.

    An interruption ends it with what was done so far, `partial`; if that is nothing, KeyboardInterrupt is raised.
    Raises InputError.
    """
    check_precision(precision)
    clock, sums = time.perf_counter(), Finished(0, 0, 0, 0.0)
    for asked, maps in _stretches(spec):
        if maps.start == 0:  # a single map's are looked at anew when it has more rollouts
            table = _Table(asked, store)
        finished = _run_stretch(table, maps, sums, clock, watch, where)
        sums = Finished(
            sums.jobs + finished.jobs,
            sums.rollouts + finished.rollouts,
            sums.reused + (finished.reused if maps.start or not sums.jobs else 0),
            time.perf_counter() - clock,
            finished.partial,
            max(sums.earlier, finished.earlier) if asked.maps is None else sums.earlier + finished.earlier,
        )
        narrow = precision is None or bool(table.next and table.widest() < precision)
        if sums.partial or narrow:
            break
    rows = table.rows()
    if sums.partial and not rows:
        raise KeyboardInterrupt
    return Sweep(asked, rows, sums, precision, narrow)


def check_precision(precision: float | None) -> None:
    """Raise UsageError for what is no precision that can be asked for."""
    if precision is not None and not 0 < precision < 1:
        raise UsageError(argument("precision", precision), expected="a fraction of the accessible cells in (0, 1)")


def _stretches(spec: Spec) -> Iterator[tuple[Spec, range]]:
    """What is run from one look to the next: twice the maps each time, or a single map with twice the rollouts."""
    first, maps = 0, spec.maps
    while maps is not None and first < maps:
        yield replace(spec, maps=maps), range(first, maps)
        first, maps = maps, min(2 * maps, MOST_MAPS)
    rollouts = 0
    while spec.maps is None and rollouts < spec.rollouts:
        yield spec, range(1)
        rollouts = spec.rollouts
        spec = replace(spec, rollouts=min(max(BLOCK, 2 * rollouts), MOST_ROLLOUTS))


def _run_stretch(
    table: _Table, maps: range, before: Finished, clock: float, watch: Watch | None, where: Json
) -> Finished:
    """Run the jobs of some maps, into the table too."""
    spec, total = table.spec, len(maps) * len(table.spec.cases)
    looked, widest = 0.0, math.nan

    def done(step: Done) -> None:
        nonlocal looked, widest
        table.add(step.job.tag, step.keys)
        if watch is None:
            return
        now = time.perf_counter() - clock
        if now - looked > 0.5 or step.jobs == total:
            looked, widest = now, table.widest()
        more = "" if math.isnan(widest) else f"widest ± {100 * widest:.2f} points: "
        watch(before.jobs + step.jobs, before.jobs + total, now, more)

    return run_cases(spec.jobs(maps.start, maps.stop), table.store, total=total, progress=done, **where)
