"""What `mrac-jax graph` says: the front of reward against robots home, and what no team of trails exceeds."""

from __future__ import annotations

import numpy as np

from analysis.graphs.front import GraphFront, base_reward
from analysis.graphs.teams import Point
from analysis.kit.tables import make_table
from analysis.page.series import Chart, Series
from analysis.report.answer import json_end
from analysis.report.blocks import KeyFigure, Part, Report
from planner.files import Json
from planner.shown import counted

ROWS = 10


def report(front: GraphFront) -> Report:
    """The front, and the certified outer polygon."""
    graph = front.graph
    table = make_table(("reward", "robots home", "no team brings home", "no team fetches"))
    for point in _shown(front):
        table.add_row(f"{point.reward:.4g}", f"{point.home:.4g}", f"{_most_home(front, point):.4g}",
                      f"{most_reward(front, point.home):.4g}")  # fmt: skip
    rule = "each node visited once" if front.rules.nodes_once else "each arc driven once"
    least = f", each home with {front.rules.least_home:g} or more" if front.rules.least_home else ""
    note = "no team: with so much reward, and with so many robots home; trails decided in advance"
    return Report(
        "graph", "graph", f"{graph.name}: what can {counted(front.robots, 'robot')} fetch, and how many come home?",
        headline(front), lambda: _json(front),
        figures=[KeyFigure(f"{front.area:.3f}", "area of the front", f"certified: at most {front.outer_area:.3f}")],
        heading=(f"{counted(len(graph.names), 'node')}, {counted(len(graph.tail), 'arc')}, "
                 f"{graph.total:.4g} reward in all; {counted(front.robots, 'robot')}, {rule}{least}",),
        picture=lambda: _chart(front),
        parts=[Part(f"{ROWS} of {counted(len(front.points), 'plan')}" if len(front.points) > ROWS else "Plans",
                    [table], [note])],
    )  # fmt: skip


def headline(front: GraphFront) -> str:
    """The plan with the largest reward, its bound, and both areas."""
    best, sought = front.points[0], any(one.price for one in front.outer)
    areas = f" Area of the front: {front.area:.3f}; no front has more than {front.outer_area:.3f}." if sought else ""
    return (
        f"{best.reward:.4g} of {front.graph.total:.4g} reward can be fetched with {best.home:.4g} of "
        f"{counted(front.robots, 'robot')} home; no team of trails fetches more than {front.most_reward:.4g}.{areas}"
    )


def _shown(front: GraphFront) -> list[Point]:
    """The most reward, and what brings most robots home at each tenth less of it."""
    wanted = front.points[0].reward * (1 - np.arange(ROWS) / ROWS)
    shown = [max((one for one in front.points if one.reward >= least), key=lambda one: one.home) for least in wanted]
    return list(dict.fromkeys(shown))


def _most_home(front: GraphFront, point: Point) -> float:
    return float(front.most_home(np.array([point.reward]))[0])


def most_reward(front: GraphFront, home: float) -> float:
    """What no team exceeds that brings so many robots home: the largest of what the half-planes leave."""
    most = base_reward(front.graph, front.robots)  # of the team of which all stay, whose half-planes are not in `outer`
    for stay in {one.stay for one in front.outer}:
        rooms = (one.most - one.price * (home - (one.stay or 0)) for one in front.outer if one.stay == stay)
        most = max(most, min(rooms))
    return most


def _chart(front: GraphFront) -> Chart:
    rewards = np.linspace(0.0, front.most_reward, 200)
    found, home = [point.reward for point in front.points], [point.home for point in front.points]
    limit = front.most_home(rewards)
    curves = (
        Series("found", [0.0, *found[::-1]], [float(front.robots), *home[::-1]]),
        Series("no team beyond", rewards, np.where(limit >= 0, limit, np.nan), dashed=True),
    )
    return Chart("What the robots fetch, and how many come home", curves, "reward", "robots home", digits=2,
                 x_digits=2, x_whole=False)  # fmt: skip


def _json(front: GraphFront) -> Json:
    names = front.graph.names
    return {
        "answer": headline(front),
        "graph": front.graph.name,
        "nodes": len(names),
        "arcs": len(front.graph.tail),
        "robots": front.robots,
        "nodes_once": front.rules.nodes_once,
        "least_home": front.rules.least_home,
        "total": front.graph.total,
        "area": front.area,
        "outer_area": front.outer_area,
        "most_reward": front.most_reward,
        "points": [
            {
                "reward": one.reward,
                "home": one.home,
                "trails": [[names[node] for node in trail] for trail in one.trails],
            }
            for one in front.points
        ],
        "outer": front.outer,
        **json_end(front),
    }
