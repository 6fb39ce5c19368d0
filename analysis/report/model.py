"""What a report is made of. Charts, maps and pictures are drawn when a medium asks for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analysis.page.document import Chart
from planner.formatting import UNPACED, Pace
from planner.world.world import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from analysis.page.maps import CellLayer, Run
    from planner.files import Json
    from planner.plan.plan import Plan


@dataclass(frozen=True)
class KeyFigure:
    """A figure that the reader takes away: "72.0 %", what it is, and how sure."""

    value: str
    name: str
    note: str = ""


@dataclass(frozen=True, eq=False)
class CellMaps:
    """Values by cell of one map: side by side on a page; a picture is of the first.

    Attributes:
        world: the map. starts: int64 `[K, 2]`, which are marked. layers: the values.
        parts: (name, cells int64 `[n]`, whether it stands out) of what a picture outlines; the first are named.
        lines: what a picture lists beside the map.
        plan: whose paths a page draws over the cells. runs: what it plays there, and words about them.
        anchor: the id of the maps on a page. values_of: that of maps of the same cells whose values are told too.
    """

    world: World
    starts: NDArray[np.int64]
    layers: Sequence[CellLayer]
    parts: Sequence[tuple[str, NDArray[np.int64], bool]] = ()
    lines: tuple[str, ...] = ()
    plan: Plan | None = None
    runs: tuple[Sequence[Run], str] = ((), "")
    anchor: str | None = None
    values_of: str | None = None


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan on its map, for a picture; `more`: words that end its second line."""

    world: World
    plan: Plan
    more: str = ""


Drawn: TypeAlias = "Chart | CellMaps"
Pictured: TypeAlias = "Figure | Planned | CellMaps | Sequence[Chart]"


@dataclass(frozen=True, eq=False)
class Part:
    """A section: tables, which a terminal prints too, and what only a page can draw.

    Attributes:
        title: its heading. tables: in order. notes: how to read them.
        drawn: charts and maps above the tables, made when a page is. lead: a line below the heading.
        whole: tables that a page, which has room, shows in the place of `tables`.
        unfolded: of a page's tables, whether the first is shown at once however long it is.
        fold: words that unfold the part on a page; "": it is always shown.
        aside: a terminal, which has no room for everything, leaves it out.
    """

    title: str
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    drawn: Callable[[], Sequence[Drawn]] = tuple
    lead: str = ""
    whole: Sequence[Table] = ()
    unfolded: bool = False
    fold: str = ""
    aside: bool = False


@dataclass(frozen=True, eq=False)
class Report:
    """What there is to say.

    Attributes:
        name: of the files that hold it. kind: the command. title: the question. headline: the answer in a sentence.
        findings: sentences below it. figures: the few that a reader takes away. heading: what was looked at, lines.
        picture: what stands beside the answer on a page. below: charts below its sentences.
        parts: in order. notes: what a user should know.
        warnings: what must not be overlooked. settings: names and values of a page, beside `heading`.
        took: how long it took, for a terminal alone: the same answer has the same page.
        last: what was looked at and how long it took, in the place of `heading` and `took` but below the tables.
        again: on what makes the same figures again, where that is not plain.
        json: the JSON object.
        pictures: by file name, drawn when they are written. files: the texts of others.
        faults: what makes the command fail. pace: how long a step takes, if that is known: for the JSON object.
    """

    name: str
    kind: str
    title: str
    headline: str
    json: Callable[[], Json]
    findings: Sequence[str] = ()
    figures: Sequence[KeyFigure] = ()
    heading: Sequence[str] = ()
    picture: Callable[[], Chart | CellMaps] | None = None
    below: Callable[[], Sequence[Chart]] = tuple
    parts: Sequence[Part] = ()
    notes: Sequence[str] = ()
    warnings: Sequence[str] = ()
    settings: Mapping[str, object] = field(default_factory=dict)
    took: Sequence[str] = ()
    last: Sequence[str] = ()
    again: str = ""
    pictures: Mapping[str, Callable[[], Pictured]] = field(default_factory=dict)
    files: Mapping[str, Callable[[], str | bytes]] = field(default_factory=dict)
    faults: Sequence[Any] = ()
    pace: Pace = UNPACED
