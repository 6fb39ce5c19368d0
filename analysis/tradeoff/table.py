"""What `mrac-jax front` says: prices of coverage in sentences, the settings as a table, the JSON object."""

from __future__ import annotations

import shlex

from rich.console import Console
from rich.table import Table

from analysis.kit.face import json_end
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import between, counted, percent
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


def headline(front: Front) -> str:
    """The pick; or what costs next to no robot, and what all that can be covered costs. Figures of fresh rollouts."""
    if front.partial:
        return f"Interrupted after {counted(len(front.points), 'setting')}."
    if front.goal:
        return _picked(front)
    first, *most = front.priced
    said = f"{_percent(first)} covered on average costs {_lost(first)} ({first.setting})"
    return said + "".join(f"; {_percent(point)} costs {_lost(point)} ({point.setting})" for point in most) + "."


def _picked(front: Front) -> str:
    asked, again = _asked(front), front.confirmed
    if again is not None:
        said = f"{_percent(again)} covered, {_lost(again)} lost on average"
        return f"Best found with {asked}: {again.setting}. {said}; the limit is kept ({_surely(front)})."
    if front.goal.pick([point.figures for point in front.points]) is not None:
        return (
            f"No setting is sure to have {asked} (95 %): ask for a little {_other_way(front)}, or --rollouts for more."
        )
    if front.goal.losses is not None:
        least = min(front.points, key=lambda one: (one.losses.mean, -one.coverage.mean))
        return f"No setting has {asked}: the fewest are {least.losses.mean:.2f}, with {least.setting}."
    most = max(front.points, key=lambda one: one.coverage.mean)
    return f"No setting has {asked}: the most is {_percent(most)}, with {most.setting}."


def _asked(front: Front) -> str:
    goal = front.goal
    if goal.losses is None:
        return f"{100 * (goal.target or 0):g} % or more covered on average"
    return f"at most {goal.losses:g} of {counted(len(front.starts), 'robot')} lost on average"


def _other_way(front: Front) -> str:
    return "less" if front.goal.losses is None else "more"


def _surely(front: Front) -> str:
    """How far the bounds of the pick are from the limit."""
    again = front.confirmed
    assert again is not None
    if not again.coverage.half_width:
        return "exact"
    if front.goal.losses is None:
        return f"95 %: at least {100 * again.least:.2f} % covered"
    return f"95 %: at most {again.most:.2f} lost"


def _percent(point: Point) -> str:
    return percent(point.coverage.mean)


def _lost(point: Point) -> str:
    mean = point.losses.mean
    return "no robot" if mean == 0 else "less than 0.01 robots" if mean < 0.005 else f"{mean:.2f} robots"


def pick_lines(front: Front) -> list[str]:
    """How sure the figures of the headline are, and how to have them again."""
    told = [front.confirmed] if front.confirmed is not None else list(front.priced)
    lines = [f"{'Fresh rollouts' if len(told) == 1 else point.setting}: {fresh_words(point)}." for point in told]
    if front.tried > 1 and front.confirmed is not None:
        lines.append(f"It is the {_ordinal(front.tried)} that was tried there; the 95 % holds with all tries.")
    if front.words and told:
        lines.append(f"run it: {shlex.join(command_of(front, told[0]))}")
    if front.confirmed is not None and front.confirmed.setting.deadline is not None:
        end = front.confirmed.setting.deadline
        lines.append(f"The mission ends at step {end:,}, and so does its plan: bring the team home then.")
    return lines


def fresh_words(point: Point) -> str:
    """Coverage and losses with their intervals."""
    if not point.coverage.half_width:
        return f"every run is the same, {point.coverage.said(100, ' %')} covered"
    return f"{point.coverage.said(100, ' %')} covered, {point.losses.said()} robots lost"


def _ordinal(number: int) -> str:
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def command_of(front: Front, point: Point) -> list[str]:
    """The command that rolls out a point by another seed, whose luck had no part in the choice."""
    choices = front.choices
    closed = [] if front.settings.plan_for == "closed" else ["--plan-for", "closed"]
    how = ["--plan", front.plan_file] if front.plan_file else [*closed, *point.setting.options()]
    return ["mrac-jax", "evaluate", *front.words, *how, "--rollouts", str(choices.rollouts),
            "--seed", str(choices.next_seed)]  # fmt: skip


def print_front(front: Front, console: Console) -> None:
    """Print the answer, what was looked at, and what coverage costs: prices, or with a goal the settings around it."""
    print_lines(console, (headline(front), *pick_lines(front), *heading(front)))
    console.print(points_table(front) if front.goal else prices_table(front))
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


def points_table(front: Front, whole: bool = False) -> Table:
    """The settings that no other covers as much as with as few robots lost, and the pick; `whole`: all of them."""
    valued = front.world.value is not None
    columns = ("policy", "reserve", "worth", "ends at", "visited, %", "from .. to", *["value, %"] * valued, "lost",
               "from .. to", "steps", "")  # fmt: skip
    shown = [place for place, cheap in enumerate(front.cheap) if whole or cheap or place == front.pick]
    title = "All settings" if whole else "What coverage costs in robots"
    dropped = ("steps", "from .. to", "from .. to")
    table = make_table(columns, title, left=("policy", ""), dropped=dropped, padding=(0, 1, 0, 0))
    for place in sorted(shown, key=lambda place: (not whole) * front.points[place].losses.mean):
        point, setting = front.points[place], front.points[place].setting
        limits = ("" if value is None else f"{value:g}" for value in (setting.reserve, setting.worth))
        end = "" if setting.deadline is None else f"{setting.deadline:,}"
        worth = () if point.value is None else (f"{100 * point.value.mean:.2f}",)
        figures = (*_columns(point.coverage, 100), *worth, *_columns(point.losses, 1), f"{point.time.mean:,.0f}")
        mark = "pick" if place == front.pick else "efficient" if whole and front.efficient[place] else ""
        table.add_row(setting.policy, *limits, end, *figures, mark)
    return table


def _columns(estimate: Estimate, scale: float) -> tuple[str, str]:
    low, high = estimate.ci95
    return f"{scale * estimate.mean:.2f}", "exact" if low == high else between(scale * low, scale * high)


def footnotes(front: Front) -> list[str]:
    """How to read it."""
    lines = []
    if front.goal:
        shown = sum(cheap or place == front.pick for place, cheap in enumerate(front.cheap))
        of = f"{shown} of {counted(len(front.points), 'setting')}"
        lines.append(f"{of}: no other covers as much with as few lost, on the same luck. --out and --json have all.")
    else:
        lines.append(
            "A price is that of the cheapest of many settings on the rollouts that chose it, so it flatters a little. "
            f"All {counted(len(front.points), 'setting')}: --out, --json. --losses or --target pick one."
        )
    return lines + [f"note: {note}" for note in front.notes]


def rows(front: Front) -> list[tuple[str, str]]:
    """For a console or a notebook: the pick, and prices of coverage."""
    again = front.confirmed
    shown = [] if again is None else [("fresh rollouts", fresh_words(again))]
    for mark, theirs, best in front.prices():
        shown.append((f"{100 * mark:g} % covered", f"{_lost(best)} ({best.setting}); mrac {theirs.losses.mean:.2f}"))
    shown.append(("settings", f"{len(front.points)}, {sum(front.efficient)} efficient"))
    return shown + [("note", note) for note in front.notes]


def front_json(front: Front) -> Json:
    """The JSON object of `front`; coverage values are fractions of the accessible cells."""
    again = front.confirmed
    return {
        "points": [
            _point_json(point) | {"efficient": best} for point, best in zip(front.points, front.efficient, strict=True)
        ],
        "pick": front.pick,
        "asked": {"losses": front.goal.losses, "target": front.goal.target},
        "confirmed": None if again is None else _point_json(again) | _sure_json(front, again),
        "fresh": [_point_json(point) | {"first_rollout": front.choices.rollouts} for point in front.priced],
        "command": shlex.join(command_of(front, again)) if again is not None and front.words else None,
        "robots": len(front.starts),
        "starts": front.starts.tolist(),
        "accessible": front.cells,
        "rollouts": front.choices.rollouts,
        "seed": front.choices.seed,
        "engine": front.engine,
        **json_end(front, front.notes),
    }


def _sure_json(front: Front, again: Point) -> Json:
    """Where the rollouts of the pick begin, and the bound that keeps it within the limit with 95 %, all tries told."""
    bound = again.most if front.goal.losses is not None else again.least
    return {"first_rollout": front.choices.rollouts, "bound": bound, "tried": front.tried}


def _point_json(point: Point) -> Json:
    figures = {"coverage": point.coverage, "losses": point.losses, "time": point.time}
    figures |= {} if point.value is None else {"value": point.value}
    return point.setting._asdict() | {name: estimate.to_json() for name, estimate in figures.items()}
