"""The answer for a graph: expected reward against expected robots home, and what lies beyond every team."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.graphs.certificate import Programme
from analysis.graphs.graph import ROBOTS, Graph, GraphError, Rules, read_graph
from analysis.graphs.teams import Point, area, search
from analysis.kit.notes import Doing, quiet
from analysis.report.answer import Answer
from planner.arguments import Numbers, whole

PLACES = whole(1, 100_000, "a whole number of places")
PRICES = (0.0, *(2.0 ** (half / 2) for half in range(-10, 5)))
"""Of a robot home, in shares of a robot's part of the reward."""
EACH_LEAVING = 6
"""Teams of up to so many robots are looked at by how many of them leave the base."""
USUAL_PLACES, ROUNDS, STEPS = 3000, 200, 4000
"""Places of the archive, rounds of the search at most; steps in which the outer area is added up, rounded upwards."""


@dataclass(frozen=True)
class HalfPlane:
    """`E[R] + price (E[S] - stay) <= most` for every team of which `stay` robots do not leave (None: any number)."""

    stay: int | None
    price: float
    most: float


@dataclass(frozen=True, eq=False, repr=False)
class GraphFront(Answer):
    """The front of a graph.

    Attributes:
        graph, robots, rules: what was asked. points: the plans found, none beaten by another, fewest home first.
        outer: half-planes; a team is within all of those of its own number of robots that stay.
    """

    graph: Graph
    robots: int
    rules: Rules
    points: tuple[Point, ...]
    outer: tuple[HalfPlane, ...]
    partial: bool = False

    listed = "points"

    @cached_property
    def area(self) -> float:
        """Below the points, a share of (total reward) x (robots)."""
        return area(self.points, self.graph.total, self.robots)

    @cached_property
    def outer_area(self) -> float:
        """Below the outer polygon: no set of plans has more."""
        rewards = np.linspace(0.0, self.graph.total, STEPS, endpoint=False)
        return float(np.maximum(self.most_home(rewards), 0.0).mean()) / self.robots

    @property
    def most_reward(self) -> float:
        """What no team exceeds."""
        return max((one.most for one in self.outer if one.price == 0.0), default=self.graph.total)

    def most_home(self, rewards: NDArray[np.float64]) -> NDArray[np.float64]:
        """Robots home that no team exceeds that fetches so much `[N]`; below 0 where none does."""
        found = np.where(rewards <= base_reward(self.graph, self.robots), float(self.robots), -1.0)
        for stay in {one.stay for one in self.outer}:
            home = np.full(len(rewards), float(self.robots))
            for one in self.outer:
                if one.stay == stay:
                    room = one.most - rewards
                    limit = room / one.price + (stay or 0) if one.price else np.where(room >= 0, self.robots, -1.0)
                    home = np.where(room < 0, -1.0, np.minimum(home, limit))
            found = np.maximum(found, home)
        return found


def base_reward(graph: Graph, robots: int) -> float:
    """What the base brings, where all robots are."""
    return float(graph.reward[graph.base]) * sum(graph.visits[:robots])


def find_front(
    source: Path,
    robots: int = 1,
    instance: str | None = None,
    nodes_once: bool = False,
    least_home: float = 0.0,
    places: int = USUAL_PLACES,
    doing: Doing = quiet,
) -> GraphFront:
    """The front of the graph in a file. Raises InputError.

    Args:
        instance: in a file that holds several. nodes_once, least_home: as of `Rules`.
        places: numbers of robots home that are told apart in the search; 1: the most reward is asked alone.
    """
    ROBOTS.check("robots", robots)
    PLACES.check("places", places)
    Numbers(0, 1, "a chance", below=True).check("least_home", least_home)
    graph, rules = read_graph(source, instance), Rules(nodes_once, least_home)
    if not graph.total > 0:
        raise GraphError("no visit of a node brings a reward", source=source, expected="a node with a reward above 0")
    doing("trails")
    points = search(graph, robots, rules, places, ROUNDS)
    each, outer = robots <= EACH_LEAVING, list[HalfPlane]()
    for leaving in range(1 if each else robots, robots + 1):
        doing(f"bound of {leaving} leaving")
        programme, stay = Programme(graph, leaving, rules, leave=each), robots - leaving
        for share in reversed(PRICES) if places > 1 else (0.0,):
            price = share * graph.total / robots
            most = programme.bound(price) + base_reward(graph, robots)
            outer.append(HalfPlane(stay if each else None, price, float(np.nextafter(most, np.inf))))
    return GraphFront(graph, robots, rules, tuple(points), tuple(outer))
