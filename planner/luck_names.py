"""How it is decided who is stopped: by the robot's tolerance (`planner.tolerance`), or by a number for every visit."""

from __future__ import annotations

from typing import Literal, get_args

LuckName = Literal["tolerance", "step"]
LUCKS: tuple[LuckName, ...] = get_args(LuckName)
