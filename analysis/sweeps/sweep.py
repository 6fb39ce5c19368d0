"""A sweep: its jobs run into a store, map by map, until all maps are done or the widest interval is narrow enough.

The interval of a setting's mean comes from the variance between maps (`analysis.sweeps.results`); rollout noise within
maps is mostly a small share of it. `precision` therefore adds maps, doubling their number at each check, and adds
rollouts only if the input is a single map. The share is reported.
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
from planner.formatting import counted
from planner.simulator.codes import Outcome

Watch = Callable[[int, int, float, str], None]
"""`watch(jobs, total, seconds, more)`: jobs done of the total, seconds since the start, a text with the half-width of
the widest 95 % interval of mean visited coverage, "" before there is one."""


@dataclass(frozen=True, eq=False, repr=False)
class Sweep(Swept):
    """The result of a sweep. `rows` are in the order of the settings; partial: interrupted.

    `reached`: whether the intervals are within the requested `precision`; None: none was requested.
    """

    reported_by = "analysis.sweeps.report:of_sweep"
    listed = "settings"

    spec: Spec
    rows: tuple[Row, ...]
    finished: Finished
    precision: float | None = None
    reached: bool | None = None
    json_keys = """
        spec=spec.source spec.maps first_seed spec.rollouts seed settings=rows precision widest within_share partial
        precision_reached=reached notes
    """

    @property
    def first_seed(self) -> int | None:
        """Seed of the first random map; None: a single map."""
        return None if self.spec.maps is None else self.spec.first_seed

    @property
    def seed(self) -> int:
        """Seed of the rollouts on the first map."""
        return int(self.spec.base["seed"])

    @property
    def notes(self) -> list[str]:
        """Notes on precision: the source of the spread, and whether the target was reached."""
        notes, share = list[str](), self.within_share
        if share is not None:
            what = "more maps" if share < 0.5 else "more rollouts a map, or more maps,"
            noise = f"{100 * share:.1f} % of the spread between maps is noise of the rollouts"
            notes.append(f"where the interval is widest, {noise}: {what} narrow it")
        if self.reached is False and not self.partial:
            notes.append(f"{argument('precision')} was not reached with the largest numbers of maps and rollouts")
        for outcome in (Outcome.STEP_LIMIT, Outcome.DEADLINE):
            cut = sum(row.outcomes[outcome.word] for row in self.rows)
            if cut:
                notes.append(f"{counted(cut, 'rollout')} ended by {outcome.word}: the mission {outcome.clause}")
        return notes

    @property
    def widest_row(self) -> Row | None:
        """The setting with the widest interval of mean visited coverage."""
        return max(self.rows, key=lambda row: row.estimate("visited").half_width, default=None)

    @property
    def widest(self) -> float:
        """Half-width of that interval; NaN if there is none."""
        return math.nan if self.widest_row is None else self.widest_row.estimate("visited").half_width

    @property
    def within_share(self) -> float | None:
        """Share of rollout noise in the variance of the map means, for the widest interval."""
        return None if self.widest_row is None else self.widest_row.within_share


class _Table:
    """The rows of all settings that have a map; some 12 kB each, whatever the number of maps.

    Jobs are added in order of their tags, so that sums do not depend on the order in which they finish.
    """

    def __init__(self, spec: Spec, store: Store) -> None:
        self.spec, self.store = spec, store
        self.found: dict[int, Row] = {}
        self.waiting: list[tuple[int, tuple[str, ...]]] = []
        self.next = 0
        self.first = (-1, np.empty(0))

    def add(self, tag: int, keys: tuple[str, ...]) -> None:
        """Add a finished job by the keys of its runs."""
        heapq.heappush(self.waiting, (tag, keys))
        # Sums of floats depend on their order, so jobs are added by tag.
        while self.waiting and self.waiting[0][0] == self.next:
            self._add(*heapq.heappop(self.waiting))
            self.next += 1

    def rows(self) -> tuple[Row, ...]:
        """Every setting that has a map; after an interruption also jobs that wait for earlier ones."""
        while self.waiting:
            self._add(*heapq.heappop(self.waiting))
        return tuple(self.found[setting] for setting in sorted(self.found))

    def _add(self, tag: int, keys: tuple[str, ...]) -> None:
        number, case = divmod(tag, len(self.spec.cases))
        for model, key in enumerate(keys):
            setting, run = case * len(self.spec.models) + model, self.store.run(key)
            if run is None or run.sums is None:
                raise StoreError(f"run {key[:12]} is missing", source=self.store.path or "store")
            if setting not in self.found:
                self.found[setting] = Row(self.spec.labels(case, model))
            row, (means, errors) = self.found[setting], figures_of(run)
            if setting == 0:
                self.first = (number, means)
            # Differences are paired map by map with the first setting.
            row.first = self.found[0].moments if 0 in self.found else None
            row.add(means, errors, run.rollouts - 1, self.first[1] if self.first[0] == number else None)
            row.rollouts += run.rollouts
            row.outcomes.update(outcomes_of(run))
            tally = self.store.tally(key) if row.maps == 1 else None
            row.single = {} if tally is None else single_map(run, tally)

    def widest(self) -> float:
        """Half-width of the widest interval of mean visited coverage; NaN if there is none yet."""
        known = (row for row in self.found.values() if row.maps > 1 or self.spec.maps is None)
        return max((row.estimate("visited").half_width for row in known), default=math.nan)


def run_sweep(
    spec: Spec, store: Store, *, precision: float | None = None, watch: Watch | None = None, **where: Any
) -> Sweep:
    """Run a sweep into a store; stored rollouts are not simulated again.

    Args:
        spec: the sweep. store: for the results. where: `processes`, `scheduler` as in `run_cases`.
        precision: continue until the half-width of the widest 95 % interval of mean visited coverage, a fraction of the
            accessible cells, is below this: each check doubles the maps, or the rollouts of a single map.
        watch: called after every job.

    Returns:
        The result. After an interruption: the settings done so far, `partial`.

    Raises:
        InputError: a setting out of range. KeyboardInterrupt: before the first result.
    """
    check_precision(precision)
    clock, sums = time.perf_counter(), Finished(0, 0, 0, 0.0)
    for asked, maps in _stretches(spec):
        if maps.start == 0:  # a single map's table is rebuilt with more rollouts
            table = _Table(asked, store)
        finished = _run_stretch(table, maps, sums, clock, watch, where)
        sums = Finished(
            sums.jobs + finished.jobs,
            sums.rollouts + finished.rollouts,
            sums.reused + (finished.reused if maps.start or not sums.jobs else 0),
            time.perf_counter() - clock,
            finished.partial,
        )
        narrow = precision is None or bool(table.next and table.widest() < precision)
        if sums.partial or narrow:
            break
    rows = table.rows()
    if sums.partial and not rows:
        raise KeyboardInterrupt
    return Sweep(asked, rows, sums, precision, None if precision is None else narrow)


def check_precision(precision: float | None) -> None:
    """Raise UsageError for a precision out of range."""
    if precision is not None and not 0 < precision < 1:
        raise UsageError(argument("precision", precision), expected="a fraction of the accessible cells in (0, 1)")


def _stretches(spec: Spec) -> Iterator[tuple[Spec, range]]:
    """The stages between two checks: twice the maps each time, or a single map with twice the rollouts."""
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
    """Run the jobs of some maps, and add them to the table."""
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
