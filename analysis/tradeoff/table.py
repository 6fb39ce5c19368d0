"""What `mrac-jax front` says: prices of coverage in sentences, the settings as a table, the JSON object."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from analysis.kit.face import json_end
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import counted, percent
from analysis.statistics.estimate import Estimate
from analysis.tradeoff.front import Front, Point
from analysis.tradeoff.rules import LANDMARKS
from planner.files import Json

TITLES = {
    "mrac": "mrac, ended early",
    "per_cell": "per_cell, ended early",
    "reserve": "per_cell with reserve",
    "worth": "per_cell with worth",
}
PRICED = {
    ("mrac",): TITLES["mrac"],
    ("per_cell",): TITLES["per_cell"],
    ("reserve", "worth"): "per_cell with reserve or worth",
}
"""Columns of the table of prices, by the families in them."""
CHEAP = 0.05
"""Robots lost on average of which no sentence is made."""


def headline(front: Front) -> str:
    """The pick; or where the prices of the policies lie farthest apart."""
    if front.partial:
        return f"Interrupted after {counted(len(front.points), 'setting')}."
    if front.goal:
        return _picked(front)
    prices = list(_prices(front))
    if not prices:
        one = max(front.points, key=lambda point: point.coverage.mean)
        return f"{_percent(one)} is covered at most, at {_lost(one)} ({one.setting})."
    return price_words(*max(prices, key=lambda price: price[1].losses.mean - price[2].losses.mean))


def _prices(front: Front) -> Iterator[tuple[float, Point, Point]]:
    """(coverage, the cheapest way of `mrac` to it, the cheapest of all)."""
    for mark in LANDMARKS:
        theirs, best = front.cheapest(mark, "mrac"), front.cheapest(mark)
        if theirs is not None and best is not None:
            yield mark, theirs, best


def price_words(mark: float, theirs: Point, best: Point) -> str:
    """What so much coverage costs."""
    costs = f"{100 * mark:g} % covered on average costs {_lost(best)} with {best.setting}"
    return f"{costs}." if theirs is best else f"{costs}; {theirs.losses.mean:.2f} with {theirs.setting}."


def _picked(front: Front) -> str:
    goal, point = front.goal, front.picked
    robots = len(front.starts)
    if goal.losses is not None:
        asked = f"at most {goal.losses:g} of {counted(robots, 'robot')} lost on average"
        if point is None:
            least = min(front.points, key=lambda one: (one.losses.mean, -one.coverage.mean))
            return f"No setting has {asked}: the fewest are {least.losses.mean:.2f}, with {least.setting}."
        return f"{point.setting} covers the most with {asked}: {_percent(point)} at {_lost(point)}."
    asked = f"{100 * (goal.target or 0):g} % or more covered on average"
    if point is None:
        most = max(front.points, key=lambda one: one.coverage.mean)
        return f"No setting has {asked}: the most is {_percent(most)}, with {most.setting}."
    return f"{point.setting} loses the fewest robots with {asked}: {point.losses.mean:.2f} at {_percent(point)}."


def _percent(point: Point) -> str:
    return percent(point.coverage.mean)


def _lost(point: Point) -> str:
    return f"{point.losses.mean:.2f} robots"


def findings(front: Front) -> list[str]:
    """Prices of coverage, a sentence each, where it costs robots at all."""
    return [price_words(*price) for price in _prices(front) if price[1].losses.mean > CHEAP]


def pick_lines(front: Front) -> list[str]:
    """How sure the pick is, and how to run it."""
    point, again = front.picked, front.confirmed
    if point is None:
        return []
    lines = []
    if again is not None:
        first = front.choices.rollouts
        lines.append(
            f"On {first:,} rollouts that had no part in the choice (ids {first:,} to {2 * first - 1:,}): "
            f"{again.coverage.said(100, ' %')} covered, {again.losses.said()} robots lost."
            if again.coverage.half_width
            else f"Every run is the same: {again.coverage.said(100, ' %')} covered."
        )
        lines += _doubts(front, again)
    if front.words:
        lines.append(f"run it: {shlex.join(command_of(front, point))}")
    if point.setting.deadline is not None:
        lines.append(f"Its plan does not know that the mission ends: bring the team home at {point.setting.deadline}.")
    return lines


def _doubts(front: Front, again: Point) -> Iterator[str]:
    """Whether the other rollouts bear the pick out."""
    goal = front.goal
    if goal.losses is not None and again.losses.ci95[0] > goal.losses:
        yield "On these it loses more than was asked for: ask for a little less."
    if goal.target is not None and again.coverage.ci95[1] < goal.target:
        yield "On these it covers less than was asked for: ask for a little more."


def command_of(front: Front, point: Point) -> list[str]:
    """The command that rolls out a point as it was here."""
    choices = front.choices
    closed = [] if front.settings.plan_for == "closed" else ["--plan-for", "closed"]
    return ["mrac-jax", "evaluate", *front.words, *closed, *point.setting.options(),
            "--rollouts", str(choices.rollouts), "--seed", str(choices.seed)]  # fmt: skip


def print_front(front: Front, console: Console) -> None:
    """Print the answer, what was looked at, prices and all settings."""
    print_lines(console, (headline(front), *pick_lines(front), *heading(front)))
    console.print(prices_table(front))
    console.print(points_table(front))
    print_lines(console, footnotes(front))


def heading(front: Front) -> list[str]:
    """What was looked at."""
    ends = "" if front.choices.deadline is None else f", every mission ended at step {front.choices.deadline:,}"
    return [
        f"{front.world.source}: {front.cells:,} accessible cells, {counted(len(front.starts), 'robot')}; "
        f"{counted(len(front.points), 'setting')} on the same {counted(front.choices.rollouts, 'rollout')} each, seed "
        f"{front.choices.seed}, {front.engine}{ends}"
    ]


def prices_table(front: Front) -> Table:
    """The fewest robots lost for so much coverage."""
    table = make_table(("covered, % or more", *PRICED.values()), "Fewest robots lost on average", left=())
    for mark in LANDMARKS:
        found = [front.cheapest(mark, *families) for families in PRICED]
        if any(found):
            table.add_row(f"{100 * mark:g}", *("" if one is None else _price(one) for one in found))
    return table


def _price(point: Point) -> str:
    setting = point.setting
    at = ", ".join(f"{name} {value:g}" for name, value in setting.limits.items())
    if not at:
        at = "whole" if setting.deadline is None else f"step {setting.deadline:,}"
    return f"{point.losses.mean:.2f} ({at})"


def points_table(front: Front) -> Table:
    """Every setting; those that nothing beats are marked."""
    valued = front.world.value is not None
    columns = ("policy", "reserve", "worth", "ends at", "visited, %", "from .. to", *["value, %"] * valued, "lost",
               "from .. to", "steps", "")  # fmt: skip
    table = make_table(columns, "All settings; *: nothing beats it", left=("policy", ""), padding=(0, 1, 0, 0))
    for point, best in zip(front.points, front.efficient, strict=True):
        setting, limits = point.setting, (point.setting.reserve, point.setting.worth)
        shown = ("" if value is None else f"{value:g}" for value in limits)
        end = "" if setting.deadline is None else f"{setting.deadline:,}"
        worth = () if point.value is None else (f"{100 * point.value.mean:.2f}",)
        figures = (*_columns(point.coverage, 100), *worth, *_columns(point.losses, 1), f"{point.time.mean:,.0f}")
        table.add_row(setting.policy, *shown, end, *figures, "*" * best)
    return table


def _columns(estimate: Estimate, scale: float) -> tuple[str, str]:
    low, high = (f"{scale * end:.2f}" for end in estimate.ci95)
    return f"{scale * estimate.mean:.2f}", "exact" if estimate.ci95[0] == estimate.ci95[1] else f"{low}..{high}"


def footnotes(front: Front) -> list[str]:
    """How to read it."""
    lines = [
        "lost: robots; from .. to: 95 % intervals. A setting is beaten by one that covers as much, loses as few and "
        "takes as few steps, and is better in one of these, on the same luck.",
    ]
    if not front.goal:
        best = "A price is that of the best of many settings on these rollouts, so it flatters a little"
        lines.append(f"{best}: --losses or --target pick one, and check it on others.")
    return lines + [f"note: {note}" for note in front.notes]


def rows(front: Front) -> list[tuple[str, str]]:
    """For a console or a notebook: the pick, and prices of coverage."""
    again = front.confirmed
    shown = [] if again is None else [("the pick on other rollouts", f"{again.coverage.said(100, ' %')} covered, "
                                       f"{again.losses.said()} robots lost")]  # fmt: skip
    for mark, theirs, best in _prices(front):
        shown.append((f"{100 * mark:g} % covered", f"{_lost(best)} ({best.setting}); mrac {theirs.losses.mean:.2f}"))
    shown.append(("settings", f"{len(front.points)}, {sum(front.efficient)} that nothing beats"))
    return shown + [("note", note) for note in front.notes]


def front_json(front: Front) -> Json:
    """The JSON object of `front`; coverage values are fractions of the accessible cells."""
    pick, again = front.picked, front.confirmed
    return {
        "points": [
            _point_json(point) | {"efficient": best} for point, best in zip(front.points, front.efficient, strict=True)
        ],
        "pick": front.pick,
        "asked": {"losses": front.goal.losses, "target": front.goal.target},
        "confirmed": None if again is None else _point_json(again) | {"first_rollout": front.choices.rollouts},
        "command": shlex.join(command_of(front, pick)) if pick is not None and front.words else None,
        "robots": len(front.starts),
        "starts": front.starts.tolist(),
        "accessible": front.cells,
        "rollouts": front.choices.rollouts,
        "seed": front.choices.seed,
        "engine": front.engine,
        **json_end(front, front.notes),
    }


def _point_json(point: Point) -> Json:
    figures = {"coverage": point.coverage, "losses": point.losses, "time": point.time}
    figures |= {} if point.value is None else {"value": point.value}
    return point.setting._asdict() | {name: estimate.to_json() for name, estimate in figures.items()}
