"""Types of robots and threats: p of a visit is a matrix's factor, for the two types, times the map's p (SPEC 22)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument, did_you_mean
from planner.errors import PlanError, WorldError
from planner.worlds.quantities import first_of


@dataclass(frozen=True, eq=False)
class RobotTypes:
    """What stops robots of each type: float32 `[Y, H, W]`, NaN = obstacle, in the order of `names`.

    `team`: of which type the robots are that the input places, all or each; none: it does not say.
    """

    names: tuple[str, ...]
    threat: NDArray[np.float32]
    team: str | tuple[str, ...] = ()

    @property
    def sha256(self) -> str:
        """Hash of names and threats."""
        digest = hashlib.sha256("\0".join(self.names).encode())
        digest.update(np.ascontiguousarray(self.threat, dtype="<f4").tobytes())
        return digest.hexdigest()

    @property
    def said(self) -> str:
        """Which there are, in words."""
        return f"robots of the types {', '.join(self.names)}"

    def number(self, name: str, source: str) -> int:
        """The place of a type. Raises PlanError, naming `source`."""
        if name not in self.names:
            expected, fix = "one of " + ", ".join(self.names), did_you_mean(name, self.names)
            raise PlanError(argument("types", name), source=source, expected=expected, fix=fix)
        return self.names.index(name)

    def arrays(self) -> dict[str, Any]:
        """What a world file holds of them."""
        team = {"types_team": np.array(self.team)} if self.team else {}
        return {"types": np.array(self.names), "types_threat": self.threat} | team


def types_in(arrays: Mapping[str, NDArray], free: NDArray[np.bool_], source: str) -> RobotTypes | None:
    """The types in the arrays of a world file whose free cells are `free` `[H, W]`. Raises WorldError."""
    if "types" not in arrays:
        return None
    names, threat = arrays["types"], arrays.get("types_threat")
    shape = (names.size, *free.shape)
    if names.ndim != 1 or names.dtype.kind != "U" or len(set(names.tolist())) != names.size or names.size == 0:
        raise WorldError("types are not names", source=source, expected="the name of each type of robot, once")
    if threat is None or threat.shape != shape or threat.dtype.kind not in "fiu":
        raise WorldError("types without their threats", source=source, expected=f"types_threat {shape}")
    found = checked_types(tuple(names.tolist()), threat.astype(np.float64), free, source)
    if "types_team" not in arrays:
        return found
    team = arrays["types_team"]
    if team.ndim > 1 or team.size == 0 or not set(team.ravel().tolist()) <= set(found.names):
        expected = f"a type, or one for each robot, of {', '.join(found.names)}"
        raise WorldError("types_team are not types of robots", source=source, expected=expected)
    return replace(found, team=tuple(team.tolist()) if team.ndim else str(team))


def checked_types(
    names: tuple[str, ...], threat: NDArray[np.float64], free: NDArray[np.bool_], source: str
) -> RobotTypes:
    """Types with these threats `[Y, H, W]`, each below 1 in free cells. Raises WorldError."""
    rounded = np.where(free, threat, np.nan).astype(np.float32)
    for name, one in zip(names, rounded, strict=True):
        wrong = free & ~((one >= 0) & (one < 1))
        if wrong.any():
            at, where = first_of(wrong)
            problem = f"a robot of type {name} is stopped with p = {one[at]:g} {where}"
            raise WorldError(problem, source=source, expected="0 <= p < 1", fix="give a smaller factor")
    rounded.setflags(write=False)
    return RobotTypes(names, rounded)
