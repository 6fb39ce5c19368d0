"""The studio's page: controls around an empty map, which its script fills with what the server tells it."""

from __future__ import annotations

import base64
import binascii
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from matplotlib.colors import LinearSegmentedColormap, to_hex
from numpy.typing import NDArray

from analysis.estimators.trial import Measured
from analysis.page.document import TEMPLATES, Html, asset, page_head, policy, whole_script
from analysis.pictures import COVERED, FOG, LOSSES, OBSTACLE, SAFE, SHADES, THREAT, UNREACHABLE
from analysis.statistics.estimates import Estimate, losses_shown, lost_words
from analysis.theory.exact import OpenLoopExact
from analysis.utils.tables import without_level
from planner.arguments import exactly, whole
from planner.errors import UsageError, WorldError
from planner.files import Json, atomic_write
from planner.formatting import Pace, counted, percent
from planner.ids import MAX_STEP
from planner.policies import RULES
from planner.settings import Settings
from planner.world.features import with_truth
from planner.world.keys import PLACE, PROBABILITY, Key
from planner.world.levels import place_starts
from planner.world.map_knowledge import RANGE, Sense
from planner.world.scenario import said
from planner.world.world import MAX_ROBOTS, World

PACKAGE = "analysis.studio"
SHARED = ("values.js", "choices.js", "cell_maps.js")
"""Of a report's script."""
SCRIPTS = ("board.js", "picture.js", "answer.js", "studio.js")
PAINTED = LinearSegmentedColormap.from_list("painted", [SAFE, *(to_hex(THREAT(x / 4)) for x in range(5))])
LAYERS = (("Threat", PAINTED, True), ("Coverage", COVERED, False), ("Losses", LOSSES, True))
"""Name, colours from the least to the largest, and whether small values are spread by a square root."""


@cache
def _script() -> Html:
    return whole_script([*map(asset, SHARED), *(asset(name, PACKAGE) for name in SCRIPTS)])


def security_headers() -> dict[str, str]:
    """Of every answer: the browser itself keeps this page apart from all others."""
    return {
        "Content-Security-Policy": f"{policy(_script(), chr(39) + 'self' + chr(39))}; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }


def palettes() -> Json:
    """The layers' colours and those of cells that have none."""
    places = np.linspace(0, 1, SHADES)
    layers = [{"name": n, "colours": [to_hex(c) for c in colours(places)], "root": root} for n, colours, root in LAYERS]
    return {"layers": layers, "obstacle": OBSTACLE, "unreachable": UNREACHABLE, "unknown": FOG}


@cache
def studio_page() -> str:
    """The page as HTML; nothing of a map is in it."""
    styles = "\n".join((asset("page.css"), asset("studio.css", PACKAGE)))
    return TEMPLATES.from_string(asset("studio.html", PACKAGE)).render(
        head=page_head("mrac-jax studio", styles, policy(_script(), "'self'")),
        rules=RULES.values(),
        most=MAX_ROBOTS,
        script=_script(),
    )


# What is on the page's board: cells, robots and settings, read strictly, and saved as a scenario.

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


# What the studio says of an answer: a headline, and the few figures below it.

WAITING = "..."
"""In the place of a figure that is not known yet."""


class Figure(NamedTuple):
    """A figure to take away: its value, what it is, how sure."""

    value: str
    name: str
    note: str


def headline(robots: int, mean: Estimate, losses: Estimate, alone: bool = False) -> str:
    """The closed loop's answer in a sentence; `alone`: the open loop's, in which nobody takes over."""
    covers = f"{counted(robots, 'robot covers', 'robots cover')} {without_level(coverage(mean))} of what can be reached"
    if alone:
        covers = f"If nobody took over, {counted(robots, 'robot')} would cover {without_level(coverage(mean))}"
    lost = lost_words(losses.mean, robots, min(losses.digits(), 2))
    return f"{covers}; {lost} {'is' if robots == 1 else 'are'} lost."


def coverage(mean: Estimate) -> str:
    """A mean coverage in percent with its interval; an exact one says so."""
    return f"{percent(mean.mean, 2)} (exact)" if mean.half_width == 0 else mean.said(100.0, " %")


def figures(
    cells: int, robots: int, mean: Estimate | None, losses: Estimate | None, rollouts: int, exact: OpenLoopExact | None
) -> list[Figure]:
    """Covered, lost, and what the open loop comes to, if anybody drives it; None: not known yet."""
    runs = f"{counted(rollouts, 'rollout')}, {counted(cells, 'accessible cell')}" if rollouts else "rolling out"
    lost, sure = (WAITING, "") if losses is None else losses_shown(losses, robots)
    found = [
        Figure(WAITING if mean is None else coverage(mean), "covered on average", runs),
        Figure(lost, "robots lost", sure),
    ]
    if exact is not None:
        alone = f"exact; {lost_words(exact.expected_losses, robots)} lost"
        found.append(Figure(percent(exact.visited / cells, 2), "if nobody took over (open loop)", alone))
    return found


def knowledge_figures(found: Sequence[Measured]) -> list[Figure]:
    """What not to know the map costs, and what it is worth to look.

    `found`: the team told, as it is, and perhaps blind; empty: not known yet.
    """
    if not found:
        return [Figure(WAITING, "not knowing costs", "")]
    told, learning, *blind = found
    unit = 1.0 / told.largest("visited")

    def figure(more: Measured, less: Measured, names: tuple[str, str], known: str, team: Measured) -> Figure:
        alone, ahead = percent(team.mean("visited", unit).mean), more.ahead(less, "visited", unit)
        name, ahead = (names[0], ahead) if ahead.mean >= 0 else (names[1], ahead.negated)
        return Figure(ahead.said(100.0, " points"), name, f"{known}, they cover {alone}")

    costs = figure(told, learning, ("not knowing costs", "not knowing gains"), "told the map", told)
    looking = ("to look is worth", "to look costs")
    return [costs, *(figure(learning, one, looking, "blind", one) for one in blind)]


def deadline_figures(
    step: int | None, pace: Pace, mean: Estimate | None, exact: OpenLoopExact | None, cells: int
) -> list[Figure]:
    """Coverage by a deadline, if there is one."""
    if step is None:
        return []
    alone = "" if exact is None else f"open loop: {percent(exact.by_deadline(step)[0] / cells, 2)}, exact"
    return [Figure(WAITING if mean is None else coverage(mean), f"covered by {pace.step(step)}", alone)]


def command_words(out: Path, rollouts: int | None, precision: float, deadline: int | None, seed: int) -> str:
    """The command that repeats the answer to a saved board; without `rollouts` one that is as sure."""
    many = ("--precision", exactly(precision)) if rollouts is None else ("--rollouts", str(rollouts))
    more = (() if deadline is None else ("--deadline", str(deadline))) + (() if seed == 0 else ("--seed", str(seed)))
    return shlex.join(["mrac-jax", "evaluate", str(out), *many, *more])
