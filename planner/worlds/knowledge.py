"""Robots that are not told the map: what is true, and how far they see (SPEC section 15).

A world's `threat` is what its robots believe, and plan on; its `knowledge` is what they meet. What is drawn for each
rollout (`World.doubt`) may be their truth too: then its obstacles are those of `Knowledge.truth`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.errors import WorldError
from planner.files import Json
from planner.none import NO_STEP
from planner.worlds.sight import RANGE, Sense


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What is true while robots believe `World.threat`.

    Attributes:
        truth: float32 `[H, W]`, NaN = obstacle; where maps are in doubt the one that stands for them all.
        sense: what robots see of it.
    """

    truth: NDArray[np.float32]
    sense: Sense

    @property
    def free(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that truly are no obstacles."""
        return ~np.isnan(self.truth)

    def may_be_blind(self, told: NDArray[np.bool_]) -> bool:
        """Whether they are told all obstacles, `told` `[H, W]` being free: else who does not look may run into one."""
        return bool((self.free == told).all())

    @property
    def said(self) -> str:
        """It in words."""
        return f"robots are not told the map; {self.sense.said}"

    @property
    def sha256(self) -> str:
        """Hash of all of it."""
        digest = hashlib.sha256(np.ascontiguousarray(self.truth, dtype="<f4").tobytes())
        digest.update(repr((float(self.sense.range), self.sense.sight)).encode())
        return digest.hexdigest()

    def first_seen(self, cells: NDArray[np.integer], alive: NDArray[np.bool_]) -> NDArray[np.int32]:
        """int32 `[N]`: the step at which each cell is first seen, NO_STEP if never.

        `cells`, `alive`: `[T, K]`, where each robot is at the end of each step, and whether it still looks.
        """
        when = np.full(self.truth.size, NO_STEP, dtype=np.int32)
        places, first = np.unique(cells[alive], return_index=True)
        steps = np.nonzero(alive)[0][first]
        begin, seen = self.sense.views(self.free, places.astype(np.int64))
        for number in np.argsort(-steps, kind="stable"):  # who came first is written last
            when[seen[begin[number] : begin[number + 1]]] = steps[number]
        return when

    def arrays(self) -> dict[str, Any]:
        """What the world file holds of it."""
        return {"truth": self.truth, "sense": np.array([self.sense.range, self.sense.sight], dtype=np.float64)}


def make_sense(given: float | Sense | Mapping[str, Any], source: str) -> Sense:
    """A checked sense from a range, or `{range, sight}`. Raises WorldError."""
    if isinstance(given, Sense):
        given = {"range": given.range, "sight": given.sight}
    keys: Json = dict(given) if isinstance(given, Mapping) else {"range": given}
    cells, sight = keys.pop("range", None), keys.pop("sight", False)
    if keys or not isinstance(sight, bool | np.bool_):
        raise WorldError(f"sense is {given!r:.60}", source=source, expected="a range, or {range, sight: true or false}")
    if not (cells == inf or (RANGE.accepts(cells) and not 0 < cells < 1)):
        raise WorldError(f"sense is {cells!r:.60}", source=source, expected=RANGE.expected)
    return Sense(float(cells), bool(sight))


def make_knowledge(belief: NDArray[np.float32], truth: NDArray[np.float32], sense: Sense, source: str) -> Knowledge:
    """What is true `[H, W]` beside a belief `[H, W]`. Raises WorldError for another shape, and who would bump."""
    if belief.shape != truth.shape:
        problem = f"the truth has shape {list(truth.shape)}"
        raise WorldError(problem, source=source, expected=f"the cells that robots are told of, {list(belief.shape)}")
    differ = np.isnan(belief) != np.isnan(truth)
    if sense.range == 0 and differ.any():
        row, col = np.argwhere(differ)[0].tolist()
        problem = (
            f"robots that see nothing are wrong about an obstacle at [{row}, {col}] ({int(differ.sum())} such cells)"
        )
        raise WorldError(problem, source=source, expected="the same obstacles", fix="let them sense 1 or more")
    return Knowledge(truth, sense)


def knowledge_in(arrays: Mapping[str, NDArray], belief: NDArray[np.float32], source: str) -> Knowledge | None:
    """What the arrays of a world file say is true beside its threats; its chances are checked. Raises WorldError."""
    if "truth" not in arrays:
        return None
    said = arrays.get("sense", np.zeros(2))
    if said.shape != (2,) or said.dtype.kind != "f" or said[1] not in (0, 1):
        raise WorldError("sense is no pair", source=source, expected="[range, 0 or 1]")
    sense = make_sense({"range": float(said[0]), "sight": bool(said[1])}, source)
    return make_knowledge(belief, arrays["truth"], sense, source)
