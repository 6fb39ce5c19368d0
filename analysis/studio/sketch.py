"""What is on the page's board: cells, robots and settings, read strictly, and saved as a scenario."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from planner.arguments import whole
from planner.errors import UsageError, WorldError
from planner.files import Json, atomic_write
from planner.limits import MAX_STEP
from planner.policies import RULES
from planner.settings import Settings
from planner.worlds.keys import PLACE, Key
from planner.worlds.learning import with_truth
from planner.worlds.quantities import PROBABILITY
from planner.worlds.restart import said
from planner.worlds.sight import RANGE, Sense
from planner.worlds.starts import place_starts
from planner.worlds.world import MAX_ROBOTS, World

PAGE = Path("the page")
"""What errors about a request name as their source."""
LIMITS, KNOWN = ("reserve", "worth"), ("unknown", "believed", "sense")


USUAL = Sense(2.0)
"""What robots see where nobody has said it yet."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """A board.

    Attributes:
        world: its cells; its `starts` are set where they were painted. robots: how many, else placed by the rule.
        settings: to plan with. deadline: a step at which coverage is reported too, or None.
        believed: the chance that robots believe where they do not know what is there; sense: what they see.
    """

    world: World
    robots: int
    settings: Settings
    deadline: int | None = None
    believed: float = 0.04
    sense: Sense = USUAL

    @classmethod
    def of(cls, world: World, robots: int, settings: Settings) -> Sketch:
        """The board of an input. Raises WorldError where it cannot be painted on."""
        known, sketch = world.knowledge, cls(world, robots, settings)
        if world.doubt is not None or world.types is not None:
            world.check_settled("painting")
        if known is None:
            return sketch
        believed = np.unique(world.threat[sketch.unknown])
        if len(believed) > 1 or np.isnan(believed).any():
            problem = "robots believe several things of what they do not know"
            raise WorldError(problem, source=world.source, expected="one chance everywhere, to paint on")
        chance = float(believed[0]) if len(believed) else cls.believed
        return replace(sketch, believed=chance, sense=known.sense)

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that are not as robots believe."""
        told, true = self.world.threat, self.world.met
        return (told != true) & ~(np.isnan(told) & np.isnan(true))

    def starts(self) -> tuple[NDArray[np.int64], tuple[str, ...]]:
        """Starts int64 `[K, 2]`, painted ones or placed by the rule, and notes."""
        if self.world.starts is not None:
            return self.world.starts, ()
        return place_starts(self.world, self.robots)

    def to_json(self) -> Json:
        """As `read_sketch` takes it."""
        starts = None if self.world.starts is None else self.world.starts.tolist()
        cells, unknown = (
            base64.b64encode(of.tobytes()).decode() for of in (self.world.met.astype("<f4"), self.unknown)
        )
        sees = None if self.sense.range == inf else self.sense.range
        knows = {"unknown": unknown, "believed": float(f"{self.believed:.7g}"), "sense": sees}
        said = {name: getattr(self.settings, name) for name in ("policy", *LIMITS)}
        return {"cells": cells, "starts": starts, "robots": self.robots, "deadline": self.deadline} | said | knows

    def save(self, out: Path) -> tuple[Path, Path]:
        """Write the scenario `out` and the world file beside it that holds its cells; returns both."""
        raster = raster_of(out)
        starts = self.world.starts
        team: Json = {"count": self.robots} if starts is None else {"starts": starts.tolist()}
        keys = {"map": {"file": raster.name}} | said(team, self.settings, self.world.pace)
        text = yaml.safe_dump(keys, sort_keys=False)
        self.world.with_starts(None).save(raster, force=True)
        with atomic_write(out) as stream:
            stream.write(f"# Painted in mrac-jax studio.\n{text}")
        return out, raster


def raster_of(out: Path) -> Path:
    """The world file that goes with a saved scenario."""
    return out.with_suffix(".npz")


def read_sketch(body: bytes, first: Sketch) -> tuple[Sketch, Mapping[str, Key]]:
    """The board that a request's JSON holds, on the ground of the `first` one, and all keys of the request.

    `cells`: base64 of little-endian float32 `[H, W]`, NaN = obstacle. `starts`: `[[row, col], ...]`, or null for so
    many `robots` placed by the rule. `policy`, `reserve`, `worth`, `deadline` as the options of `evaluate`, null: none.
    `unknown`: base64 of a byte a cell, 1: robots do not know it, believe it free with the chance `believed`, and see
    `sense` cells far, null: everything. Raises InputError.
    """
    try:
        top = Key(json.loads(body), "", PAGE, UsageError)
    except (ValueError, RecursionError):
        raise UsageError("no JSON", source=PAGE, expected="a board as JSON") from None
    keys = top.mapping(("cells", "starts", "robots", "policy", *LIMITS, "deadline", *KNOWN), ("rollouts",))
    given = {name: keys[name].number(expected="a number, or null") for name in LIMITS if keys[name].value is not None}
    settings = Settings(
        **vars(first.settings) | dict.fromkeys(LIMITS) | given | {"policy": keys["policy"].choice(tuple(RULES))}
    )
    settings.check()
    robots = keys["robots"].number(whole(1, MAX_ROBOTS))
    ground, starts = first.world, _starts(keys["starts"])
    world = World.create(
        _cells(keys["cells"], ground.shape, "<f4"), starts, ground.cell_size, ground.origin, ground.source,
        georeference=ground.georeference, value=ground.value, detect=ground.detect,
    )  # fmt: skip
    world, deadline = replace(world, pace=ground.pace, measured=ground.measured), None
    if keys["deadline"].value is not None:
        step = ground.pace.last_step("deadline", keys["deadline"].value, str(PAGE))
        deadline = replace(keys["deadline"], value=step).number(whole(1, MAX_STEP, "a step"))
    believed, sees = keys["believed"].number(PROBABILITY), keys["sense"]
    sense = replace(first.sense, range=inf if sees.value is None else sees.number(RANGE))
    unknown = _cells(keys["unknown"], ground.shape, "u1").astype(np.bool_)
    if unknown.any():
        told = np.where(unknown, np.float32(believed), world.threat)
        with keys["sense"].naming():
            world = with_truth(replace(world, threat=told), world, sense)
    return Sketch(world, robots if starts is None else len(starts), settings, deadline, believed, sense), keys


def _cells(key: Key, shape: tuple[int, int], kind: str) -> NDArray:
    expected = f"{shape[0]} x {shape[1]} cells as base64 of {np.dtype(kind).name}"
    try:
        cells = np.frombuffer(base64.b64decode(key.text(expected), validate=True), dtype=kind)
    except (binascii.Error, ValueError):
        raise key.wrong(expected) from None
    if cells.size != shape[0] * shape[1]:
        raise key.wrong(expected)
    return cells.reshape(shape)


def _starts(key: Key) -> list[list[int]] | None:
    if key.value is None:
        return None
    items = key.items("a list of starts")
    if len(items) > MAX_ROBOTS:
        raise key.wrong(f"at most {MAX_ROBOTS} pairs [row, col]")
    return [item.numbers(PLACE, "[row, col], whole numbers", 2) for item in items]
