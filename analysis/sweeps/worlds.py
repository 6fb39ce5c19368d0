"""The worlds of a sweep: the paper's random ones, and those that a scenario describes. Hashable; made when needed."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from planner.arguments import argument, is_whole
from planner.errors import UsageError
from planner.worlds.generate import PAPER_LEVELS, Kind, ThreatPattern, random_world
from planner.worlds.keys import Key
from planner.worlds.scenario import read_on, read_scenario
from planner.worlds.world import World

MOST_MAPS = 1_000_000
"""Random maps of one run."""
BESIDE = ("prior", "sense", "movers", "phases", "plan_on", "hazard", "uncertain")
"""Keys of a scenario that a random map may have: what robots know of it, and how its threats change."""


def check_maps(maps: int, seed: int) -> None:
    """Raise UsageError unless the seeds `seed .. seed + maps - 1` are those of random maps."""
    if not is_whole(maps, 1, MOST_MAPS):
        raise UsageError(argument("maps", maps), expected=f"1 to {MOST_MAPS}")
    if not 0 <= seed <= 2**64 - maps:
        raise UsageError(argument("seed", seed), expected=f"0 to 2**64 - {maps}")


@dataclass(frozen=True)
class Generated:
    """One of the paper's random worlds (SPEC section 8), told or not; `seed` is the world's.

    Attributes:
        kind, areas, threat_levels, seed: as of `planner.worlds.generate.ThreatPattern`. size: rows, columns.
        ratio, obstacles: fractions of all cells that are dangerous, and that are obstacles.
        unsaid: keys of a scenario, those of BESIDE, as canonical JSON.
    """

    kind: Kind = "contiguous"
    ratio: float = 0.25
    seed: int = 0
    size: tuple[int, int] = (20, 20)
    areas: int = ThreatPattern.areas
    threat_levels: tuple[float, ...] = PAPER_LEVELS
    obstacles: float = 0.25
    unsaid: str = "{}"

    def world(self) -> World:
        """The world. Raises InputError."""
        pattern = ThreatPattern(self.kind, self.areas, self.threat_levels, self.seed)
        world = random_world(*self.size, pattern, obstacles=self.obstacles, threats=self.ratio)
        unsaid = json.loads(self.unsaid)
        return read_on(world, Key(unsaid, "", "random map")) if unsaid else world


@dataclass(frozen=True)
class Written:
    """A world that a scenario describes.

    Attributes:
        scenario: the scenario file's keys as canonical JSON. source: the file that relative paths start from, and that
            messages name.
    """

    scenario: str
    source: str

    def world(self) -> World:
        """The world, with what the scenario says of its team. Raises InputError."""
        source = Path(self.source)
        return read_scenario(Key(json.loads(self.scenario), "", source), source)
