"""Robots on a map: lanes of their paths, labels of those that start together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_LEVELS = 16
"""Levels shown of another planner's plan, which names none (the planner's own default)."""


MOST_LABELS = 10
"""Robots with an entry of their own in the legend."""


LABEL_HEIGHT = 13.0
"""Of the markers at the starts, in points."""


def lane(robot: int, robots: int) -> float:
    """How far right and down of the cells' centres a robot's path is drawn, so that shared corridors can be read."""
    return 0.62 * ((robot + 0.5) / robots - 0.5)


@dataclass(frozen=True)
class Label:
    """A marker for several cells: their numbers, its text ("3", "0-15", "9 robots") and its place (row, col)."""

    members: list[int]
    name: str
    place: tuple[float, float]


def robots_name(group: list[int]) -> str:
    """What several robots are called."""
    text = ranges(group)
    return text if len(text) <= 9 else f"{len(group)} robots"


def ranges(numbers: list[int]) -> str:
    """Increasing numbers as "0-3,7"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], number]
        else:
            runs.append([number])
    return ",".join("-".join(map(str, run)) for run in runs)


def group_labels(
    cells: NDArray[np.int64],
    shape: tuple[int, int],
    points: float,
    name_of: Callable[[list[int]], str] = robots_name,
) -> list[Label]:
    """Labels for `cells` `[M, 2]` that neither overlap nor leave a map of `shape`; `points`: the side of a cell.

    `name_of`: the text for a group of them. A cell joins the first group whose first cell is near; near grows until no
    two labels overlap.
    """
    reach = LABEL_HEIGHT / points
    while True:
        groups = _near_groups(cells, reach)
        names = [name_of(group) for group in groups]
        size = np.array([(LABEL_HEIGHT, label_width(name)) for name in names]) / points
        room = np.maximum(size / 2, 0.5) - 0.5
        places = np.minimum(np.maximum(cells[[group[0] for group in groups]], room), np.subtract(shape, 1) - room)
        gap = np.abs(places[:, None] - places[None, :])
        if (gap < (size[:, None] + size[None, :]) / 2).all(axis=-1).sum() == len(groups):
            where = ((float(row), float(col)) for row, col in places)
            return [Label(*label) for label in zip(groups, names, where, strict=True)]
        reach *= 1.4


def _near_groups(cells: NDArray[np.int64], reach: float) -> list[list[int]]:
    groups: list[list[int]] = []
    for number, cell in enumerate(cells):
        near = (g for g in groups if np.abs(cells[g[0]] - cell).max() < reach)
        group = next(near, None)
        if group is None:
            groups.append([number])
        else:
            group.append(number)
    return groups


def label_width(text: str) -> float:
    """Width of a marker with `text` in points, its frame included."""
    return max(LABEL_HEIGHT, 4.8 * len(text) + 6.0)
