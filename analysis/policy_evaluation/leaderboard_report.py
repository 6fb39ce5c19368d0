"""What `mrac-jax suite` says: the ranks, and what everybody covers on every world."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from rich.table import Table

from analysis.policy_evaluation.leaderboard import RANDOM, Played, Row, Standing, suite_world
from analysis.report.answer import json_end
from analysis.report.model import KeyFigure, Part, Report
from analysis.statistics.estimates import Estimate
from analysis.utils.folder import csv_text
from analysis.utils.tables import make_table, without_level
from planner.files import Json
from planner.formatting import ceiled, counted, in_percent

RANKS = ("rank", "", "score, %", "behind, points", "visited, %", "lost, %", "first on", "worlds")
NOTES = (
    "score: (J - random walk) / (bound - random walk) of mean coverage J, averaged over worlds; ± half the 95 % "
    "interval over rollouts, in brackets its ends",
    "behind: of the first in score, on common luck; first on: worlds where nobody is surely ahead",
    "bound: what no strategy exceeds on average, proven; optimum: what the best one reaches, on tiny worlds",
)


def report(standing: Standing) -> Report:
    """Ranks, worlds; both as Markdown, every figure as CSV, and the worlds as files."""
    count = counted(len(standing.worlds), "world")
    mine = [row for row in standing.entries if row.name == standing.own]
    return Report(
        "suite", "suite", "Who covers most of dangerous worlds?", headline(standing), partial(_json, standing),
        figures=[KeyFigure(f"{row.rank} of {len(standing.entries)}", f"rank of {row.name}") for row in mine],
        heading=[f"{count}, {counted(standing.rollouts, 'rollout')} each, seed {standing.seed}"],
        took=[f"{standing.seconds:.0f} s"],
        parts=[
            Part("Ranks", [_table(RANKS, map(_ranked, standing.entries))], NOTES[:2]),
            Part("Visited on every world, %", [_table(_columns(standing), _worlds(standing))], NOTES[2:]),
        ],
        warnings=("Interrupted: the worlds that were done.",) if standing.partial else (),
        files={
            "suite.md": lambda: "\n".join(
                [*_markdown(RANKS, map(_ranked, standing.entries)), "",
                 *_markdown(_columns(standing), _worlds(standing)), ""]),
            "suite.csv": lambda: csv_text(CSV, _lines(standing)),
            **{f"worlds/{played.name}.npz": suite_world(played.name).to_bytes for played in standing.worlds},
        },
    )  # fmt: skip


def headline(standing: Standing) -> str:
    """Who is first, and where the policy that was given stands."""
    ranked = [row for row in standing.entries if row.rank is not None]
    if not ranked:
        return "Nobody has a score: it takes two rollouts, and room between the random walk and the bound."
    first, mine = ranked[0], [row for row in ranked if row.name == standing.own and row.rank != 1]
    gained = without_level(first.score.said(100, " %"))
    said = f"{first.name} is first: it gains {gained} of what lies between a random walk and the bound"
    said += "".join(
        f"; {row.name} is number {row.rank} of {len(ranked)}, {_half(row.behind)} points behind" for row in mine
    )
    return f"{said}."


def _half(estimate: Estimate | None, most: int | None = None) -> str:
    """ "97.3 ± .2", times 100."""
    if estimate is None or not np.isfinite(estimate.mean):
        return "-"
    return estimate.around(100, most=most, digits=max(1, estimate.digits(100)))


def _ranked(row: Row) -> tuple[str, ...]:
    behind = "" if row.rank == 1 else _half(row.behind)
    rank = "-" if row.rank is None else str(row.rank)
    shares = (in_percent(row.coverage), in_percent(row.lost))
    return rank, row.name, _half(row.score), behind, *shares, str(row.first), str(row.worlds)


def _columns(standing: Standing) -> tuple[str, ...]:
    names = [row.name for row in standing.entries if row.name != RANDOM]
    return ("world", "cells", "bound", "optimum", RANDOM, *names)


def _worlds(standing: Standing) -> Iterator[tuple[str, ...]]:
    names = _columns(standing)[4:]
    for played in standing.worlds:
        optimum = "" if played.optimum is None else in_percent(played.optimum / played.cells, 2)
        bound = ceiled(played.bound / played.cells, unit="")
        yield played.name, f"{played.cells:,}", bound, optimum, *(_half(played.coverage(name), 100) for name in names)


def _table(columns: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> Table:
    table = make_table(columns, left=("", "world"), padding=(0, 1, 0, 0))
    for row in rows:
        table.add_row(*row)
    return table


def _markdown(columns: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(columns)} |"
    yield "|" + "|".join("---" if name in ("", "world") else "---:" for name in columns) + "|"
    for row in rows:
        yield f"| {' | '.join(row)} |"


CSV = ("world", "robots", "cells", "bound", "optimum", "entry", "visited", "low", "high", "lost")


def _lines(standing: Standing) -> Iterator[tuple[object, ...]]:
    """Fractions of the accessible cells, and of the team."""
    for played in standing.worlds:
        for name in played.rolled:
            found = played.coverage(name)
            assert found is not None
            best = "" if played.optimum is None else played.optimum / played.cells
            of = (played.name, played.robots, played.cells, played.bound / played.cells, best)
            yield *of, name, found.mean, *found.ci95, played.lost(name)


def _world_json(played: Played) -> Json:
    entries = {name: {"coverage": played.coverage(name), "lost": played.lost(name)} for name in played.rolled}
    best = None if played.optimum is None else played.optimum / played.cells
    bound = played.bound / played.cells
    return {"robots": played.robots, "accessible": played.cells, "bound": bound, "optimum": best, "entries": entries}


def _json(standing: Standing) -> Json:
    """Coverage, bound and optimum: fractions of the accessible cells; lost: of the team."""
    return {
        "answer": headline(standing),
        "rollouts": standing.rollouts,
        "seed": standing.seed,
        "entries": {row.name: {key: value for key, value in vars(row).items() if key != "name"}
                    for row in standing.entries},
        "worlds": {played.name: _world_json(played) for played in standing.worlds},
        **json_end(standing),
    }  # fmt: skip
