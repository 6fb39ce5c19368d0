"""The thirty worlds of the suite, each made from its name alone. They are stable for ever: a test holds their hashes.

Random worlds are the paper's (`planner.worlds.generate`, 25 % obstacles), the n-th of the list of seed FIRST_SEED + n;
robots start upper-left. Never change a line of PLACES: add worlds at the end, under new names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache

import numpy as np

from analysis.inputs import EXAMPLE, input_path
from planner.arguments import argument
from planner.errors import UsageError
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.scenario import load_input
from planner.worlds.starts import place_starts
from planner.worlds.world import World
from planner.worlds.wrong_maps import with_hazard

FIRST_SEED = 3201
HIT = 0.8
"""Where hazards are there or not: the chance that a visit to one stops the robot; it is there with p / HIT."""


@dataclass(frozen=True)
class Place:
    """How a world is made.

    Attributes:
        kind: of its random threats. side: in cells. percent: of all cells that are dangerous.
        robots: that start. hazard: "": every visit is drawn for itself, else a kind of `with_hazard`.
    """

    kind: Kind
    side: int
    percent: int
    robots: int
    hazard: str = ""

    @property
    def name(self) -> str:
        """ "scattered-20-15-k4"."""
        before = f"{self.hazard}-" if self.hazard else ""
        return f"{before}{self.kind}-{self.side}-{self.percent:02}-k{self.robots}"

    def make(self, seed: int) -> World:
        """The world, without starts."""
        world = random_world(self.side, self.side, ThreatPattern(self.kind, seed=seed), threats=self.percent / 100)
        return with_hazard(world, self.hazard, np.array(world.threat) / HIT, HIT) if self.hazard else world


PLACES = (
    Place("contiguous", 10, 5, 1), Place("contiguous", 10, 15, 1), Place("contiguous", 10, 25, 2),
    Place("scattered", 10, 5, 2), Place("scattered", 10, 15, 1), Place("scattered", 10, 25, 3),
    Place("contiguous", 20, 5, 2), Place("contiguous", 20, 15, 8), Place("contiguous", 20, 25, 20),
    Place("scattered", 20, 5, 4), Place("scattered", 20, 15, 4), Place("scattered", 20, 25, 8),
    Place("contiguous", 40, 5, 4), Place("contiguous", 40, 15, 12), Place("contiguous", 40, 25, 8),
    Place("scattered", 40, 5, 8), Place("scattered", 40, 15, 20), Place("scattered", 40, 25, 12),
    Place("contiguous", 64, 5, 5), Place("contiguous", 64, 15, 10), Place("contiguous", 64, 25, 20),
    Place("scattered", 64, 5, 10), Place("scattered", 64, 15, 20), Place("scattered", 64, 25, 16),
    Place("contiguous", 20, 15, 4, "persistent"), Place("scattered", 20, 25, 8, "persistent"),
    Place("contiguous", 20, 15, 4, "consumed"), Place("scattered", 20, 25, 8, "consumed"),
)  # fmt: skip
TERRAIN = {"terrain-k2": 2, "terrain-k8": 8}
"""The shipped landscape, and robots."""
SEEDS = {place.name: (place, FIRST_SEED + number) for number, place in enumerate(PLACES)}
NAMES = (*SEEDS, *TERRAIN)


@cache
def suite_world(name: str) -> World:
    """The world of that name, with its starts."""
    if name in TERRAIN:
        world, robots = load_input(input_path(f"{EXAMPLE}terrain")), TERRAIN[name]
    else:
        place, seed = SEEDS[name]
        world, robots = place.make(seed), place.robots
    return replace(world.with_starts(place_starts(world, robots)[0]), source=name)


def choose(only: str | Sequence[str] | None) -> tuple[str, ...]:
    """The names, in the suite's order, that are given or that a pattern ("contiguous-10-*") fits; None: all.

    A text may hold several between commas. Raises UsageError for what fits none.
    """
    asked = NAMES if only is None else only.split(",") if isinstance(only, str) else only
    for wanted in asked:
        if not any(fnmatchcase(name, str(wanted).strip()) for name in NAMES):
            problem = f"{argument('only')}: no world {wanted!r}"
            raise UsageError(problem, expected=f"a pattern, or of {', '.join(NAMES)}")
    return tuple(name for name in NAMES if any(fnmatchcase(name, str(wanted).strip()) for wanted in asked))
