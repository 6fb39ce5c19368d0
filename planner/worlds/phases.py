"""Threats that change with time: p of a visit is that of the phase that its step is in (SPEC section 16).

Axis letters: `P` phases, `N` = H * W cells.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import is_whole
from planner.errors import WorldError
from planner.limits import MAX_STEP

Foresight = Literal["now", "first", "worst"]
PLAN_ON: tuple[Foresight, ...] = get_args(Foresight)
MOST_PHASES = 1024
SAID = {
    "now": "all robots know of a change as it comes",
    "first": "robots plan on the first map alone",
    "worst": "robots plan on the worst of each cell",
}


@dataclass(frozen=True, eq=False)
class Phases:
    """The maps, and from when on each holds.

    Attributes:
        begins: int64 `[P]`, the step at which each phase begins, rising, the first 0.
        threats: float32 `[P, H, W]`, p of a visit in each; NaN = obstacle, the same in all.
        plan_on: "now": at the end of the step before a phase begins all robots believe its map; "first", "worst": they
            go by the first map, or by the cell-wise maximum, for good.
    """

    begins: NDArray[np.int64]
    threats: NDArray[np.float32]
    plan_on: Foresight = "now"

    @property
    def said(self) -> str:
        """They in words."""
        steps = ", ".join(map(str, self.begins[1:5].tolist())) + ", ..." * (len(self.begins) > 5)
        return f"threats that change at step {steps}; {SAID[self.plan_on]}"

    @property
    def told(self) -> bool:
        """Whether robots are told of changes as they come."""
        return self.plan_on == "now"

    @property
    def planned(self) -> NDArray[np.float32]:
        """float32 `[H, W]`: what robots plan on at first."""
        threat = self.most if self.plan_on == "worst" else self.threats[0].copy()
        threat.setflags(write=False)
        return threat

    @property
    def most(self) -> NDArray[np.float32]:
        """float32 `[H, W]`: the cell-wise maximum."""
        return np.asarray(self.threats.max(axis=0))

    def number_at(self, steps: ArrayLike) -> NDArray[np.int64]:
        """int64: the phase that each of these steps is in."""
        return np.asarray(np.searchsorted(self.begins, steps, side="right") - 1, dtype=np.int64)

    def to_json(self) -> dict[str, Any]:
        """When they begin, and what robots plan on."""
        return {"from": self.begins.tolist(), "plan_on": self.plan_on}

    @property
    def sha256(self) -> str:
        """Hash of all of it."""
        digest = hashlib.sha256(self.plan_on.encode())
        for array in (self.begins.astype("<i8"), self.threats.astype("<f4")):
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def draws(self) -> None:
        """Nothing is in doubt."""
        return

    def arrays(self) -> dict[str, NDArray]:
        """What the world file holds of them."""
        return {
            "phases_from": self.begins.astype("<i8"),
            "phases_threat": self.threats,
            "phases_plan_on": np.array(self.plan_on),
        }


def check_phases(begins: Sequence[Any], threats: NDArray[np.float32], free: NDArray[np.bool_], source: str) -> None:
    """Raise WorldError unless phases can begin at these steps; `threats` `[P, H, W]` are maps of worlds."""
    if not 0 < len(begins) <= MOST_PHASES:
        raise WorldError(f"{len(begins)} phases", source=source, expected=f"1 to {MOST_PHASES}")
    for number, begin in enumerate(begins):
        name, least = f"phases[{number}]", 0 if number == 0 else int(begins[number - 1]) + 1
        if not is_whole(begin, least, MAX_STEP):
            expected = f"a step, {least} to {MAX_STEP}" + ": phases are in order of time" * (number > 0)
            raise WorldError(f"{name}.from is {begin!r:.40}", source=source, expected=expected)
        differ = np.isnan(threats[number]) == free
        if differ.any():
            row, col = np.argwhere(differ)[0].tolist()
            problem = f"{name} has {'an obstacle' if free[row, col] else 'none'} at [{row}, {col}]"
            raise WorldError(problem, source=source, expected="the obstacles of the map: threats alone change")


def phases_in(arrays: Mapping[str, NDArray], threat: NDArray[np.float32], source: str) -> Phases | None:
    """The phases in the arrays of a world file; None if it names none. Raises WorldError."""
    if "phases_threat" not in arrays:
        return None
    maps, begins = arrays["phases_threat"], arrays.get("phases_from", np.zeros(0))
    plan_on = str(arrays.get("phases_plan_on", ""))
    fits = begins.ndim == 1 and begins.dtype.kind == "i" and maps.shape == (len(begins), *threat.shape)
    sound = maps.dtype == np.float32 and bool((np.isnan(maps) | ((maps >= 0) & (maps < 1))).all())
    if not (fits and sound and plan_on in PLAN_ON and len(begins) and begins[0] == 0):
        raise WorldError("phases_* do not fit the map", source=source, expected="arrays as World.save writes them")
    check_phases(begins.tolist(), maps, ~np.isnan(threat), source)
    found = Phases(begins.astype(np.int64), maps, next(word for word in PLAN_ON if word == plan_on))
    if not np.array_equal(found.planned, threat, equal_nan=True):
        raise WorldError(
            "`threat` is not what its phases say", source=source, expected="arrays as World.save writes them"
        )
    return found
