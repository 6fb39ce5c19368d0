"""What `mrac-jax front` says: the pick, or the prices of coverage; every setting, as curves and in figures."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

from rich.table import Table

from analysis.kit.folder import json_text
from analysis.kit.tables import make_table
from analysis.kit.words import without_level
from analysis.page.series import Chart, Series
from analysis.report.blocks import KeyFigure, Part, Report
from analysis.report.words import (
    asked,
    luck_words,
    map_words,
    run_again,
    search_end,
    share_figure,
    sourced,
    team_figure,
)
from analysis.statistics.coverage import losses_said
from analysis.statistics.words import of_all
from analysis.tradeoff.front import Front, Point, settings_of
from analysis.tradeoff.rules import LANDMARKS, Setting
from planner.files import Json
from planner.shown import chance, counted, floored, in_percent, percent

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
PICK = "the pick"


def report(front: Front) -> Report:
    """What coverage costs, in robots and in steps; the plan of the pick."""
    choices, robots, picked = front.choices, len(front.starts), front.picked
    over_losses, over_time = _chart(front, "losses"), _chart(front, "time")
    prices = _prices(front)
    settings = settings_of(front.settings, Setting("mrac")).shown(front.world.pace)
    return Report(
        "front", "front", asked(front.world, robots, "what does coverage cost?"), headline(front),
        lambda: _json(front), pick_lines(front), _key_figures(front),
        heading=(
            f"{map_words(front.world, front.cells, robots)}; {counted(len(front.points), 'setting')}, "
            + luck_words(front.world, choices, front.engine,
                         f"on the same {counted(choices.rollouts, 'rollout')} each, "),
        ),
        picture=lambda: over_losses,
        parts=[
            Part("Prices and settings", [_points(front) if front.goal else prices], [_footnote(front)],
                 whole=[prices, _points(front, whole=True)]),
            Part("What coverage costs in steps", drawn=lambda: [over_time]),
        ],
        notes=front.notes,
        settings={name: value for name, value in settings.items() if name not in ("policy", "reserve", "worth")},
        pictures={"front.png": lambda: [over_losses, over_time]}, pace=front.world.pace,
        files={} if picked is None
        else {"plan.json": lambda: json_text(front.plan_of(picked).to_json(), compact=True)},
    )  # fmt: skip


def headline(front: Front) -> str:
    """Coverage and losses in one sentence, by fresh rollouts; `pick_lines` names the settings.

    Of the pick; or of the settings that cost next to no robot, are the best bargain, and cover most.
    """
    if front.partial:
        return f"Interrupted after {counted(len(front.points), 'setting')}."
    if front.goal:
        return _picked(front)
    said = [f"{_percent(point)} and lose {_lost(front, point)}" for point in front.priced]
    listed = said[0] if len(said) == 1 else f"{', '.join(said[:-1])}{',' * (len(said) > 2)} or {said[-1]}"
    return f"{_team(front)} can cover {listed}, on average{_exact(front.priced)}."


def _team(front: Front) -> str:
    return counted(len(front.starts), "robot")


def _exact(points: Sequence[Point]) -> str:
    return " (exact)" * all(point.exact for point in points)


def _picked(front: Front) -> str:
    goal, again = front.goal, front.confirmed
    by_losses = goal.losses is not None
    limit = f"{chance(goal.target or 0, 12)} or more covered on average"
    if by_losses:
        limit = f"at most {goal.losses:g} of {_team(front)} lost on average"
    if again is not None:
        can = f"{_team(front)} can cover {_percent(again)} and lose {_lost(front, again)}, on average"
        return f"{can}{_exact([again])}; asked for was {limit.removesuffix(' on average')}."
    if goal.pick([point.figures for point in front.points]) is not None:
        other = "more" if by_losses else "less"
        return (
            f"No setting is sure to have {limit} (confidence 0.95): ask for a little {other}, or --rollouts for more."
        )
    if by_losses:
        least = min(front.points, key=lambda one: (one.losses.mean, -one.coverage.mean))
        fewest = of_all(least.losses.mean, len(front.starts))
        return f"No setting has {limit}: the fewest are {fewest}, with {_named(front, least)}."
    most = max(front.points, key=lambda one: one.coverage.mean)
    return f"No setting has {limit}: the most is {_percent(most)}, with {_named(front, most)}."


def _named(front: Front, point: Point) -> str:
    return point.setting.said(front.world.pace)


def _percent(point: Point) -> str:
    return percent(point.coverage.mean)


def _lost(front: Front, point: Point) -> str:
    return losses_said(point.losses, len(front.starts), mean_only=True)


def _told(front: Front) -> list[Point]:
    """The settings that the headline speaks of, on fresh rollouts."""
    return list(front.priced) if front.confirmed is None else [front.confirmed]


def pick_lines(front: Front) -> list[str]:
    """Which settings the headline speaks of, how sure their figures are, and how to have them again."""
    told, again = _told(front), front.confirmed
    lines = [f"{_named(front, point)}: {_fresh(front, point)}{_exact([point])}." for point in told]
    if again is not None:
        found = sourced(not again.exact, f"{_fresh(front, again)}.")
        lines = [f"Best setting found: {_named(front, again)}. {found}", _kept(front, again)]
    if front.tried > 1 and again is not None:
        place = {2: "second", 3: "third"}.get(front.tried, f"{front.tried}th")
        lines.append(f"It is the {place} that was tried there; the confidence holds with all tries.")
    home = front.settings.return_to is not None
    if front.words and told:
        point = told[(len(told) - 1) // 2]
        lines.append(f"run it: {command_of(front, point)}")
    if again is not None and again.setting.deadline is not None:
        end = again.setting.deadline
        then = "robots turn so as to be home by then" if home else "bring the team home then"
        lines.append(f"The mission ends at {front.world.pace.step(end)}, and so does its plan: {then}.")
    return lines


def _kept(front: Front, again: Point) -> str:
    """How sure it is that the pick keeps the limit."""
    if again.exact:
        return "The limit is kept: these figures are exact."
    bound = f"{floored(again.least, 2)} or more is covered"
    if front.goal.losses is not None:
        bound = f"{ceil(100 * again.most) / 100:.2f} robots or fewer are lost"
    return f"The limit is kept with confidence 0.95: on average {bound}."


def _fresh(front: Front, point: Point) -> str:
    said = f"{point.coverage.said(100, ' %')} covered, {losses_said(point.losses, len(front.starts))} lost"
    return without_level(said).replace(" (exact)", "")


def command_of(front: Front, point: Point) -> str:
    """The command that evaluates a point, on other luck where that was sampled."""
    closed = [] if front.settings.plan_for == "closed" else ["--plan-for", "closed"]
    how = ["--plan", front.plan_file] if front.plan_file else [*closed, *point.setting.options()]
    return run_again(front.words, how, front.choices, exact=point.exact)


def _key_figures(front: Front) -> list[KeyFigure]:
    again = front.confirmed
    if again is None:
        return [
            share_figure(point.coverage, f"costs {_lost(front, point)}", f", {_named(front, point)}")
            for point in front.priced
        ]
    steps = again.time.mean
    return [
        share_figure(again.coverage, "visited on average", "" if again.exact else ", fresh rollouts"),
        team_figure(again.losses, len(front.starts)),
        KeyFigure(front.world.pace.steps(steps), "mean time", _named(front, again)),
    ]


def _chart(front: Front, which: str) -> Chart:
    """Coverage over robots lost, or over steps: a curve for each family through its settings, the pick as a mark."""
    goal, robots = front.goal, which == "losses"
    least = min(front.points[place].coverage.mean for place in _cheap(front))  # below it nothing is worth a look
    seen = [point for point in front.points if point.coverage.mean >= least]
    shown = [(name, [p for p in seen if p.setting.family == family]) for family, name in TITLES.items()]
    shown.append((PICK, [] if front.picked is None else [front.picked]))
    limit = ((goal.losses, f"at most {goal.losses:g} lost"),) if robots and goal.losses is not None else ()
    return Chart(
        title="What coverage costs in robots" if robots else "What coverage costs in steps",
        series=tuple(
            Series.of(
                name,
                [getattr(point, which).mean for point in points],
                [point.coverage for point in points],
                kind="points" if name == PICK else "line",
            )
            for name, points in shown
            if points
        ),
        x_name="robots lost on average" if robots else f"steps on average{front.world.pace.each}",
        y_name="visited, % of the accessible cells",
        unit="%",
        digits=2,
        x_digits=2 if robots else 0,
        x_whole=not robots,
        y_range=(0, 100),
        fit=True,
        at_x=limit,
        at_y=() if goal.target is None else ((100 * goal.target, f"{chance(goal.target, 12)} wanted"),),
        note="Farther up and to the left is better. Press a name to hide a curve.",
    )


def _prices(front: Front) -> Table:
    """The fewest robots lost for so much coverage."""
    table = make_table(("covered, % or more", *PRICED.values()), "Fewest robots lost on average", left=())
    for mark in LANDMARKS:
        found = [front.cheapest(mark, *families) for families in PRICED]
        if any(found):
            table.add_row(f"{100 * mark:g}", *("" if one is None else _price(front, one) for one in found))
    return table


def _price(front: Front, point: Point) -> str:
    setting, step = point.setting, front.world.pace.step
    at = ", ".join(f"{name} {value:g}" for name, value in setting.limits.items())
    lost = of_all(point.losses.mean, len(front.starts))
    return f"{lost} ({at or ('whole' if setting.deadline is None else step(setting.deadline))})"


def _points(front: Front, whole: bool = False) -> Table:
    """The settings that no other covers as much as with as few robots lost, and the pick; `whole`: all of them."""
    valued, pace = front.world.value is not None, front.world.pace
    columns = ("policy", "reserve", "worth", "ends at", "visited, %", "from .. to", *["value, %"] * valued, "lost",
               "from .. to", "steps", *["minutes"] * bool(pace), "")  # fmt: skip
    title = "All settings" if whole else "What coverage costs in robots"
    dropped = ("steps", "from .. to", "from .. to")
    table = make_table(columns, title, left=("policy", ""), dropped=dropped, padding=(0, 1, 0, 0))
    shown = range(len(front.points)) if whole else sorted(_cheap(front), key=lambda at: front.points[at].losses.mean)
    for place in shown:
        point, setting = front.points[place], front.points[place].setting
        limits = ("" if value is None else f"{value:g}" for value in (setting.reserve, setting.worth))
        end = "" if setting.deadline is None else f"{setting.deadline:,}{pace.also(setting.deadline)}"
        worth = () if point.value is None else (in_percent(point.value.mean, 2),)
        times = (f"{point.time.mean:,.0f}", *[f"{pace.minutes * point.time.mean:,.1f}"] * bool(pace))
        figures = (*point.coverage.columns(100.0, 100), *worth, *point.losses.columns(), *times)
        mark = "pick" if place == front.pick else "efficient" if whole and front.efficient[place] else ""
        table.add_row(setting.policy, *limits, end, *figures, mark)
    return table


def _cheap(front: Front) -> list[int]:
    """The places of what no other covers as much as with as few lost, and of the pick."""
    return [place for place, cheap in enumerate(front.cheap) if cheap or place == front.pick]


def _footnote(front: Front) -> str:
    settings, luck = counted(len(front.points), "setting"), ", common random numbers" if front.engine else ""
    if front.goal:
        of = f"{len(_cheap(front))} of {settings}"
        return f"{of}: no other covers as much with as few lost{luck}. --out and --json have all."
    flatters = (
        "A price is that of the cheapest of many settings on the rollouts that chose it, so it flatters a little. "
    )
    return f"{flatters * bool(front.engine)}All {settings}: --out, --json. --losses or --target pick one."


def _json(front: Front) -> Json:
    """Coverage values are fractions of the accessible cells."""
    again, sure = front.confirmed, Json()
    if again is not None:
        bound = again.most if front.goal.losses is not None else again.least
        sure = {"first_rollout": front.choices.rollouts, "bound": bound, "tried": front.tried}
    return {
        "points": [
            _point_json(point) | {"efficient": best} for point, best in zip(front.points, front.efficient, strict=True)
        ],
        "pick": front.pick,
        "asked": {"losses": front.goal.losses, "target": front.goal.target},
        "confirmed": None if again is None else _point_json(again) | sure,
        "fresh": [_point_json(point) | {"first_rollout": front.choices.rollouts} for point in front.priced],
        "command": command_of(front, again) if again is not None and front.words else None,
        **search_end(front),
    }


def _point_json(point: Point) -> Json:
    figures = {name: getattr(point, name) for name in ("coverage", "losses", "time")}
    return point.setting._asdict() | figures | ({} if point.value is None else {"value": point.value})
