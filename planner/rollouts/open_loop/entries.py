"""Every entry of the nominal paths, as columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Entries:
    """Every entry of a cell on the nominal paths, robot by robot in order of time; start cells included.

    Attributes:
        robot, step, cell: int64 `[entries]`.
        passed: int64 `[entries]`, dangerous entries of that robot before this one: it is made iff outcome >= passed.
        dangerous: bool `[entries]`, whether the cell can stop the robot.
        first: bool `[entries]`, whether it is the robot's first entry of the cell.
    """

    robot: NDArray[np.int64]
    step: NDArray[np.int64]
    cell: NDArray[np.int64]
    passed: NDArray[np.int64]
    dangerous: NDArray[np.bool_]
    first: NDArray[np.bool_]
