"""The leaderboard of policies on the benchmark suite, and the report of `mrac-jax suite`."""

from __future__ import annotations

import math
import runpy
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.inputs import EXAMPLE, input_path
from analysis.policy_evaluation.policy_evaluation import estimate_of, roll_policy, scores_of, share_of, wanted_for
from analysis.report.model import KeyFigure, Report, Section
from analysis.report.result import Result
from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.estimates import Estimate
from analysis.theory.flow_programme import optimum
from analysis.theory.upper_bound import most_cells
from analysis.utils.notes import ProgressCallback, quiet
from analysis.utils.pool import answers
from analysis.utils.progress import OnInterrupt, ask
from analysis.utils.tables import Column, csv_text, table_of, without_level
from planner.arguments import argument
from planner.errors import InputError, UsageError
from planner.files import Json, check_file
from planner.formatting import ceiled, counted, in_percent
from planner.make_plan import read_plan
from planner.open_loop import plan_team
from planner.plan.plan import Plan
from planner.policies.rules import Rule
from planner.rollouts.names import of_jax
from planner.settings import Settings
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World

# Results: coverage and score of each entry on each world, and the ranks.

RANDOM = "random walk"


class Rolled(NamedTuple):
    """Cells visited and robots lost in each rollout, int64 `[B]` each."""

    visited: NDArray[np.int64]
    lost: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class WorldResults:
    """A world with the rollouts of every entry.

    Attributes:
        robots: K. cells: number of accessible cells. bound: policy-independent upper bound of the expected cells
            visited, certified. optimum: the optimal expectation; None: unknown.
        rolled: by entry; rollout r of all entries has the same random numbers.
    """

    name: str
    robots: int
    cells: int
    bound: float
    optimum: float | None
    rolled: dict[str, Rolled]
    json_keys = "robots accessible=cells *limits entries"

    @property
    def entries(self) -> Json:
        """By entry: mean coverage, a fraction of the accessible cells, and mean share of the team that is lost."""
        return {name: {"coverage": self.coverage(name), "lost": self.lost(name)} for name in self.rolled}

    def coverage(self, entry: str) -> Estimate | None:
        """Mean visited coverage, a fraction of the accessible cells; None: no rollouts of this entry."""
        return share_of(self.rolled[entry].visited, self.cells) if entry in self.rolled else None

    def lost(self, entry: str) -> float:
        """Mean share of the team that is lost."""
        return float(self.rolled[entry].lost.mean()) / self.robots

    @property
    def limits(self) -> Json:
        """`bound` and `optimum` as fractions of the accessible cells."""
        best = None if self.optimum is None else self.optimum / self.cells
        return {"bound": self.bound / self.cells, "optimum": best}

    @cached_property
    def scores(self) -> dict[str, NDArray[np.float64]]:
        """By entry, float64 `[B]`, see `scores_of`; empty if the bound is not above the random walk."""
        walk, bound = self.rolled[RANDOM].visited / self.cells, self.bound / self.cells
        found = {name: scores_of(of.visited / self.cells, walk, bound) for name, of in self.rolled.items()}
        return {name: scores for name, scores in found.items() if scores is not None}

    @property
    def first(self) -> set[str]:
        """The entries that no other is significantly ahead of: the best, and those not significantly behind it."""
        best = max(self.rolled.values(), key=lambda of: float(of.visited.mean())).visited
        apart = {name: (best - of.visited).astype(np.float64) for name, of in self.rolled.items()}
        return {name for name, more in apart.items() if len(more) < 2 or estimate_of(more).ci95[0] <= 0}


@dataclass(frozen=True)
class Row:
    """Summary of an entry over all worlds.

    Attributes:
        rank: by score, from 1; None: it lacks rollouts on some worlds. worlds: number of worlds with rollouts.
        score: mean over these worlds of (J - J_random) / (bound - J_random). behind: the first entry's score minus this
            one's, with common random numbers.
        coverage: mean visited coverage over these worlds. lost: mean share of the team that is lost.
        first: number of worlds on which no entry is significantly ahead of it.
    """

    name: str
    rank: int | None
    worlds: int
    score: Estimate
    behind: Estimate | None
    coverage: float
    lost: float
    first: int
    json_keys = "rank worlds score behind coverage lost first"


@dataclass(frozen=True, eq=False, repr=False)
class Leaderboard(Result):
    """The leaderboard.

    Attributes:
        worlds: in the suite's order. rollouts, seed: of each entry. own: name of the given policy.
        seconds: run time. partial: it was interrupted and lacks some worlds.
    """

    reported_by = "analysis.policy_evaluation.leaderboard:report"
    listed = "entries"

    worlds: tuple[WorldResults, ...]
    rollouts: int
    seed: int
    own: str | None
    seconds: float
    partial: bool = False
    json_keys = "answer=summary rollouts seed entries=by_name worlds=by_world"

    @property
    def by_name(self) -> dict[str, Row]:
        """All entries by name."""
        return {row.name: row for row in self.entries}

    @property
    def by_world(self) -> dict[str, WorldResults]:
        """The worlds by name."""
        return {played.name: played for played in self.worlds}

    @cached_property
    def entries(self) -> tuple[Row, ...]:
        """All entries by rank, then those that lack rollouts on some worlds."""
        names = list(dict.fromkeys(name for played in self.worlds for name in played.rolled))
        scores = {name: [played.scores[name] for played in self.worlds if name in played.scores] for name in names}
        # The mean is taken by rollout id: worlds share random numbers, so their errors are correlated.
        mean = {name: np.mean(of, axis=0) for name, of in scores.items() if of}
        most = max(map(len, scores.values()), default=0)
        ranked = sorted((name for name in mean if len(scores[name]) == most), key=lambda name: -mean[name].mean())
        rank = {name: place for place, name in enumerate(ranked, start=1)}
        order = sorted(names, key=lambda name: rank.get(name, math.inf))
        return tuple(self._row(name, rank.get(name), mean.get(name), mean[ranked[0]] if ranked else None)
                     for name in order)  # fmt: skip

    def _row(self, name: str, rank: int | None, mean: NDArray | None, best: NDArray | None) -> Row:
        played = [one for one in self.worlds if name in one.rolled]
        coverage = float(np.mean([one.rolled[name].visited.mean() / one.cells for one in played]))
        unknown = Estimate(math.nan, math.nan, (math.nan, math.nan))
        return Row(
            name, rank, len(played), unknown if mean is None else estimate_of(mean),
            None if rank is None or mean is None or best is None else estimate_of(best - mean),
            coverage, float(np.mean([one.lost(name) for one in played])), sum(name in one.first for one in played),
        )  # fmt: skip


# Entries in addition to the planner: a policy from a file or a function, and plans of other planners.

WANTED = "policy"
"""The name that a policy's file must define."""


@dataclass(frozen=True)
class GivenPolicy:
    """A given policy.

    Attributes:
        name: in the table. description: in errors.
        given: the function, the planner's `Rule`, or the file that defines one as `policy`.
        actions: actions of a function, see `mrac.env`.
    """

    name: str
    description: str
    given: Callable[..., Any] | Rule | Path
    actions: Literal["moves", "areas"] = "moves"

    def load(self) -> Callable[..., Any] | Rule:
        """The function or rule. Raises InputError."""
        return load_policy(self.given) if isinstance(self.given, Path) else self.given


def own_of(given: Callable[..., Any] | Rule | str | Path, actions: Literal["moves", "areas"]) -> GivenPolicy:
    """The given policy, loaded once as a check. Raises InputError."""
    if isinstance(given, str | Path):
        load_policy(Path(given))
        return GivenPolicy(Path(given).stem, str(given), Path(given), actions)
    if isinstance(given, Rule):
        return GivenPolicy(given.name, given.name, given)
    if not callable(given):
        raise UsageError(argument("policy", given), expected="a function of observations, a Rule, or a file")
    name = getattr(given, "__name__", type(given).__name__)
    return GivenPolicy(name, name, given, actions)


def load_policy(path: Path) -> Callable[..., Any] | Rule:
    """The object that a Python file defines as `policy`; the file may import from its folder. Raises InputError."""
    check_file(path, f"a Python file that defines `{WANTED}`")
    if str(path.parent.resolve()) not in sys.path:
        sys.path.append(str(path.parent.resolve()))
    try:
        found = runpy.run_path(str(path), run_name=path.stem).get(WANTED)
    except (Exception, SystemExit) as error:
        raise UsageError(f"raised {type(error).__name__}: {error}", source=path, expected="a Python file") from error
    if not (callable(found) or isinstance(found, Rule)):
        problem = f"defines no `{WANTED}`" if found is None else f"`{WANTED}` is {found!r}"
        raise UsageError(problem, source=path, expected=f"`def {WANTED}(observations)`, or a planner's Rule")
    return found


def plan_files(plans: Mapping[str, str | Path], names: tuple[str, ...]) -> dict[str, dict[str, Path]]:
    """By planner and world, the files ID.* of the folders. Raises UsageError for a folder without any of them."""
    found = {}
    for planner, folder in plans.items():
        files = {path.stem: path for path in sorted(Path(folder).glob("*")) if path.stem in names}
        if not files:
            raise UsageError(f"no plan of {planner}", source=folder, expected=f"files named {names[0]}.json, ...")
        found[planner] = files
    return found


def _read_external(path: Path, world: World) -> Plan:
    """An external plan for the robots of the world. Raises PlanError, UsageError."""
    plan = read_plan(path, world)
    assert world.starts is not None
    if sorted(plan.starts.tolist()) != sorted(world.starts.tolist()):
        problem = f"its robots start at {plan.starts.tolist()[:8]}"
        raise UsageError(problem, source=path, expected=f"{world.starts.tolist()[:8]}, the starts of {world.source}")
    return plan


# The thirty worlds of the suite, each generated from its name. They never change: a test checks their hashes.
#
# Random worlds are the paper's (`planner.world.generate`, 25 % obstacles), the n-th in the list with seed FIRST_SEED +
# n; robots start upper-left. Do not change a line of PLACES: add worlds at the end, under new names.

FIRST_SEED = 3201
HIT = 0.8
"""Latent hazards: probability that a visit to an existing one destroys the robot; it exists with p / HIT."""


@dataclass(frozen=True)
class Place:
    """Parameters of a random world.

    Attributes:
        kind: of the random threats. side: in cells. percent: share of cells with a threat.
        robots: team size. hazard: "": independent visits, else a kind of `with_hazard`.
    """

    kind: Kind
    side: int
    percent: int
    robots: int
    hazard: str = ""

    @property
    def name(self) -> str:
        """ "scattered-20-15-k4"."""
        before = f"{self.hazard}-" if self.hazard else ""
        return f"{before}{self.kind}-{self.side}-{self.percent:02}-k{self.robots}"

    def make(self, seed: int) -> World:
        """The world, without starts."""
        world = random_world(self.side, self.side, ThreatPattern(self.kind, seed=seed), threats=self.percent / 100)
        return world.with_latent_hazard(self.hazard, np.array(world.threat) / HIT, HIT) if self.hazard else world


PLACES = (
    Place("contiguous", 10, 5, 1), Place("contiguous", 10, 15, 1), Place("contiguous", 10, 25, 2),
    Place("scattered", 10, 5, 2), Place("scattered", 10, 15, 1), Place("scattered", 10, 25, 3),
    Place("contiguous", 20, 5, 2), Place("contiguous", 20, 15, 8), Place("contiguous", 20, 25, 20),
    Place("scattered", 20, 5, 4), Place("scattered", 20, 15, 4), Place("scattered", 20, 25, 8),
    Place("contiguous", 40, 5, 4), Place("contiguous", 40, 15, 12), Place("contiguous", 40, 25, 8),
    Place("scattered", 40, 5, 8), Place("scattered", 40, 15, 20), Place("scattered", 40, 25, 12),
    Place("contiguous", 64, 5, 5), Place("contiguous", 64, 15, 10), Place("contiguous", 64, 25, 20),
    Place("scattered", 64, 5, 10), Place("scattered", 64, 15, 20), Place("scattered", 64, 25, 16),
    Place("contiguous", 20, 15, 4, "persistent"), Place("scattered", 20, 25, 8, "persistent"),
    Place("contiguous", 20, 15, 4, "consumed"), Place("scattered", 20, 25, 8, "consumed"),
)  # fmt: skip
TERRAIN = {"terrain-k2": 2, "terrain-k8": 8}
"""The shipped landscape, by team size."""
SEEDS = {place.name: (place, FIRST_SEED + number) for number, place in enumerate(PLACES)}
NAMES = (*SEEDS, *TERRAIN)


@cache
def suite_world(name: str) -> World:
    """The world of that name, with starts."""
    if name in TERRAIN:
        world, robots = load_input(input_path(f"{EXAMPLE}terrain")), TERRAIN[name]
    else:
        place, seed = SEEDS[name]
        world, robots = place.make(seed), place.robots
    return replace(world.with_starts(place_starts(world, robots)[0]), source=name)


def choose(only: str | Sequence[str] | None) -> tuple[str, ...]:
    """The names, in the suite's order, that are given or match a pattern ("contiguous-10-*"); None: all.

    A text may hold several patterns, separated by commas. Raises UsageError for a pattern without a match.
    """
    asked = NAMES if only is None else only.split(",") if isinstance(only, str) else only
    for wanted in asked:
        if not any(fnmatchcase(name, str(wanted).strip()) for name in NAMES):
            problem = f"{argument('only')}: no world {wanted!r}"
            raise UsageError(problem, expected=f"a pattern, or one of {', '.join(NAMES)}")
    return tuple(name for name in NAMES if any(fnmatchcase(name, str(wanted).strip()) for wanted in asked))


# Rollouts of all entries on all worlds with common random numbers.

TIMES = 4
"""A mission ends after this number of steps for each accessible cell."""
RISK_CAP = 0.25
PER_CELL = Settings(policy="per_cell")
PLANNER_ENTRIES = {
    "mrac": (Settings(), "closed"),
    "mrac, open loop": (Settings(), "open"),
    "per_cell": (PER_CELL, "closed"),
    "per_cell+reserve": (replace(PER_CELL, risk_cap=RISK_CAP), "closed"),
}
"""The planner's entries: settings, and the loop in which the plan is simulated."""


def run_suite(
    names: tuple[str, ...],
    own: GivenPolicy | None,
    plans: Mapping[str, str | Path],
    rollouts: int,
    seed: int,
    processes: int | None = None,
    progress: ProgressCallback = quiet,
) -> Leaderboard:
    """The leaderboard on these worlds; `processes` (None: one for each core) does not change the figures.

    An interruption (KeyboardInterrupt) leaves the worlds done so far; if there are none, it is raised again. Raises
    InputError.
    """
    if own is not None and own.name in (RANDOM, *PLANNER_ENTRIES):
        raise UsageError(
            f"a policy with the name {own.name!r}", source=own.description, expected="a name of no other entry"
        )
    task = partial(play, RolloutChoices(rollouts=rollouts, seed=seed), own, plan_files(plans, names))
    wanted = wanted_for(None if own is None else own.given, processes, len(names))
    begun, found, partial_answer = time.monotonic(), {}, False
    # Large worlds first: a late large world would leave other processes idle.
    largest = sorted(names, key=lambda name: -suite_world(name).threat.size)
    try:
        for name, played in answers(task, largest, wanted):
            found[name] = played
            progress(len(found), len(names), time.monotonic() - begun)
    except KeyboardInterrupt:
        if not found:
            raise
        partial_answer = True
    worlds = tuple(found[name] for name in names if name in found)
    return Leaderboard(
        worlds, rollouts, seed, None if own is None else own.name, time.monotonic() - begun, partial_answer
    )


def play(
    choices: RolloutChoices, own: GivenPolicy | None, files: Mapping[str, Mapping[str, Path]], name: str
) -> WorldResults:
    """All entries on one world. Raises InputError that names a policy and the world.

    `own`: the given policy, or None. `files`: plans of other planners, by world.
    """
    world = suite_world(name)
    assert world.starts is not None
    cells = int(world.accessible(world.starts).sum())
    # Plans and policies end at the same step, so that their coverage is comparable.
    choices = replace(choices, deadline=TIMES * cells)
    make_env = partial(of_jax("environment"), world, max_steps=TIMES * cells)
    plans = {planner: _read_external(of[name], world) for planner, of in files.items() if name in of}
    rolled = {} if own is None else {own.name: _own(own, world, make_env, choices)}
    rolled[RANDOM] = _policy(make_env(), None, choices)
    for rival, (settings, loop) in PLANNER_ENTRIES.items():
        rolled[rival] = _plan(world, plan_team(world, world.starts, settings), loop, choices)
    for planner, plan in plans.items():
        rolled |= {f"{planner}, {loop} loop": _plan(world, plan, loop, choices) for loop in ("open", "closed")}
    best = None if world.uncertainty is not None else optimum(world, world.starts)
    return WorldResults(name, len(world.starts), cells, most_cells(world, world.starts, flow=True), best, rolled)


def _own(own: GivenPolicy, world: World, make_env: Any, choices: RolloutChoices) -> Rolled:
    assert world.starts is not None
    policy = own.load()
    try:
        if isinstance(policy, Rule):
            return _plan(world, plan_team(world, world.starts, Settings(policy=policy)), "closed", choices)
        return _policy(make_env(actions=own.actions), policy, choices)
    except InputError as error:
        raise InputError(f"{own.description} on {world.source}: {error}") from error


def _policy(env: Any, policy: Any, choices: RolloutChoices) -> Rolled:
    visited, lost, _ = roll_policy(env, policy, choices.seed, choices.rollouts)
    return Rolled(visited, lost)


def _plan(world: World, plan: Plan, loop: Any, choices: RolloutChoices) -> Rolled:
    found = make_singles(world, plan, replace(choices, loop=loop))(0, choices.rollouts)
    return Rolled(found.visited.astype(np.int64), len(plan.robots) - found.alive.astype(np.int64))


# The suite as one object: worlds by name, and `judge`, which evaluates entries on them.


class Suite(Mapping[str, World]):
    """Named worlds with starts, each created on access."""

    def __init__(self, only: str | Sequence[str] | None = None) -> None:
        """`only`: see `choose`. Raises UsageError."""
        self.names = choose(only)

    def __getitem__(self, name: str) -> World:
        if name not in self.names:
            raise KeyError(name)
        return suite_world(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"Suite of {counted(len(self), 'world')}: {', '.join(self)}"

    def judge(
        self,
        policy: Callable[..., Any] | Rule | str | Path | None = None,
        *,
        plans: Mapping[str, str | Path] | None = None,
        actions: Literal["moves", "areas"] = "moves",
        rollouts: int = 1000,
        seed: int = 0,
        processes: int | None = None,
        progress: ProgressCallback | bool | None = None,
        on_interrupt: OnInterrupt = "raise",
    ) -> Leaderboard:
        """The leaderboard of all entries on all worlds with common random numbers.

        Args:
            policy: a function as in `mrac.judge`, a planner's `Rule`, or a Python file that defines one as `policy`.
            plans: by planner's name, the folder of its plans: files ID.json for `read_plan`; each is simulated in the
                open and in the closed loop.
            actions: actions of a function.
            rollouts, seed: of every entry; every mission ends after 4 steps for each accessible cell.
            processes: worlds at a time; the figures do not depend on it. None: one for each core, if the policy can be
                imported.
            progress, on_interrupt: as in `mrac.evaluate`; worlds are counted.
        """
        own = None if policy is None else own_of(policy, actions)
        run = partial(run_suite, self.names, own, plans or {}, rollouts, seed, processes)
        return ask(lambda tell, doing: run(tell), progress, on_interrupt, "worlds")


# The report of `mrac-jax suite`.

RANKS = (
    Column("rank", lambda row: row.rank or "-"),
    Column("", lambda row: row.name, words=True),
    Column("score, %", lambda row: _half(row.score)),
    Column("behind, points", lambda row: "" if row.rank == 1 else _half(row.behind)),
    Column("visited, %", lambda row: in_percent(row.coverage)),
    Column("lost, %", lambda row: in_percent(row.lost)),
    Column("first on", lambda row: row.first),
    Column("worlds", lambda row: row.worlds),
)
"""Columns of the table of ranks."""
NOTES = (
    "score: (J - random walk) / (bound - random walk) of mean coverage J, averaged over worlds; ± half the 95 % "
    "interval over rollouts, in brackets its ends",
    "behind: the first entry, common random numbers; first on: worlds on which no entry is significantly ahead",
    "bound: policy-independent upper bound, certified; optimum: the best expectation of any policy, on tiny worlds",
)


def report(standing: Leaderboard) -> Report:
    """Ranks and worlds as tables; both as Markdown, all figures as CSV, and the worlds as files."""
    count = counted(len(standing.worlds), "world")
    mine = [row for row in standing.entries if row.name == standing.own]
    ranks = table_of(RANKS, standing.entries, padding=(0, 1, 0, 0))
    worlds = _worlds_table(standing)
    return Report(
        "suite", "suite", "Which policy covers most?", summary(standing), standing,
        figures=[KeyFigure(f"{row.rank} of {len(standing.entries)}", f"rank of {row.name}") for row in mine],
        heading=[f"{count}, {counted(standing.rollouts, 'rollout')} each, seed {standing.seed}"],
        took=[f"{standing.seconds:.0f} s"],
        parts=[Section("Ranks", [ranks], NOTES[:2]), Section("Visited on every world, %", [worlds], NOTES[2:])],
        warnings=("Interrupted: only the worlds that are done.",) if standing.partial else (),
        files={
            "suite.md": lambda: "\n".join([*_markdown(ranks), "", *_markdown(worlds), ""]),
            "suite.csv": lambda: csv_text(CSV, _lines(standing)),
            **{f"worlds/{played.name}.npz": suite_world(played.name).to_bytes for played in standing.worlds},
        },
    )  # fmt: skip


def summary(standing: Leaderboard) -> str:
    """The first entry, and the rank of the given policy."""
    ranked = [row for row in standing.entries if row.rank is not None]
    if not ranked:
        return "No entry has a score: a score needs two rollouts, and a bound above the random walk."
    first, mine = ranked[0], [row for row in ranked if row.name == standing.own and row.rank != 1]
    gained = without_level(first.score.describe(100, " %"))
    said = f"{first.name} is first: {gained} of the way from a random walk to the bound"
    said += "".join(
        f"; {row.name} has rank {row.rank} of {len(ranked)}, {_half(row.behind)} points behind" for row in mine
    )
    return f"{said}."


def _half(estimate: Estimate | None, most: int | None = None) -> str:
    """ "97.3 ± .2", times 100."""
    if estimate is None or not np.isfinite(estimate.mean):
        return "-"
    return estimate.around(100, most=most, digits=max(1, estimate.digits(100)))


def _worlds_table(standing: Leaderboard) -> Table:
    names = [RANDOM, *(row.name for row in standing.entries if row.name != RANDOM)]

    def covered(name: str) -> Column:
        return Column(name, lambda played: _half(played.coverage(name), 100))

    columns = (
        Column("world", lambda played: played.name, words=True),
        Column("cells", lambda played: f"{played.cells:,}"),
        Column("bound", lambda played: ceiled(played.limits["bound"], unit="")),
        Column("optimum", lambda played: None if played.optimum is None else in_percent(played.limits["optimum"], 2)),
        *map(covered, names),
    )
    return table_of(columns, standing.worlds, padding=(0, 1, 0, 0))


def _markdown(table: Table) -> Iterator[str]:
    names = [str(column.header) for column in table.columns]
    sides = ["---" if column.justify == "left" else "---:" for column in table.columns]
    yield from (f"| {' | '.join(names)} |", f"|{'|'.join(sides)}|")
    for row in zip(*(column.cells for column in table.columns), strict=True):
        yield f"| {' | '.join(map(str, row))} |"


CSV = ("world", "robots", "cells", "bound", "optimum", "entry", "visited", "low", "high", "lost")


def _lines(standing: Leaderboard) -> Iterator[tuple[object, ...]]:
    """Rows of the CSV file: fractions of the accessible cells, and of the team."""
    for played in standing.worlds:
        bound, best = played.limits.values()
        for name, found in played.entries.items():
            covered = found["coverage"]
            of = (played.name, played.robots, played.cells, bound, "" if best is None else best)
            yield *of, name, covered.mean, *covered.ci95, found["lost"]
