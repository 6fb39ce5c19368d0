"""What robots are told, and what they tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from planner.files import Json
from planner.none import NO_AREA

Why = Literal["travel", "cover", "follow", "return", "hold", "idle"]
"""`travel` to its area, `cover` it, `follow` another planner's path, `return` home; `hold`: it waits its turn, has no
moves left or makes no progress; `idle`: nothing is left for it."""
Cell = tuple[int, int]


@dataclass(frozen=True)
class Order:
    """What a robot is to do in the step that is under way.

    Attributes:
        robot: its number. cell: (row, col), where it is to be at the end of the step.
        path: cells that it is to enter after that one, as things stand.
        area: the id of the area that it works on, or NO_AREA. why: what it does.
    """

    robot: int
    cell: Cell
    path: tuple[Cell, ...] = ()
    area: int = NO_AREA
    why: Why = "idle"

    def to_json(self) -> Json:
        """As a JSON object."""
        path = [list(cell) for cell in self.path]
        return {"robot": self.robot, "cell": list(self.cell), "path": path, "area": self.area, "why": self.why}


@dataclass(frozen=True)
class Report:
    """What a robot, or who watches it, said of the step that is under way.

    Attributes:
        cell: index of the cell where it is. stopped: it is lost there. found: it was lost before, and is back.
        moves_left: that it can still make; None: as known.
    """

    cell: int
    stopped: bool = False
    found: bool = False
    moves_left: int | None = None
