"""The elements of a report. Charts, maps and pictures are drawn on demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from analysis.page.elements import CellLayer, Chart, Run
from planner.formatting import UNPACED, Pace
from planner.world.world import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure
    from rich.table import Table

    from planner.plan.plan import Plan


@dataclass(frozen=True)
class KeyFigure:
    """A key figure: its value ("72.0 %"), its name, and its interval."""

    value: str
    name: str
    note: str = ""


@dataclass(frozen=True, eq=False)
class CellMaps:
    """Values by cell of one map, shown side by side on a page; a picture shows the first layer.

    Attributes:
        world: the map. starts: int64 `[K, 2]`, marked on it. layers: the values.
        parts: (name, cells int64 `[n]`, highlighted) outlined in a picture; the first ones are labelled.
        lines: text lines next to the map in a picture.
        plan: plan whose paths a page draws. runs: the runs that the page plays, and their caption.
        anchor: HTML id of the maps. values_of: HTML id of other maps of the same cells, whose values are shown too.
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


Figure: TypeAlias = "Chart | CellMaps"
Pictured: TypeAlias = "MplFigure | CellMaps | Sequence[Chart]"


@dataclass(frozen=True, eq=False)
class Section:
    """A section: tables, which a terminal also prints, and charts and maps, which only a page draws.

    Attributes:
        title: heading. tables: in order. notes: how to read them.
        figures: makes the charts and maps above the tables. intro: a line below the heading.
        whole: longer tables that replace `tables` on a page.
        collapsed: label of the control that opens the section on a page; "": the section is always open.
        page_only: the section is not shown on a terminal.
    """

    title: str
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    figures: Callable[[], Sequence[Figure]] = tuple
    intro: str = ""
    whole: Sequence[Table] = ()
    collapsed: str = ""
    page_only: bool = False


@dataclass(frozen=True, eq=False)
class Report:
    """A report: everything that any medium shows of a result.

    Attributes:
        name: stem of its file names. kind: the command. title: the question. summary: the answer in one sentence.
        findings: sentences after it. figures: key figures. heading: lines on the input.
        picture: chart or map next to the answer on a page. below: charts after its sentences.
        parts: sections in order. notes: remarks for the user.
        warnings: important remarks. settings: names and values on a page, after `heading`.
        took: computing time, on a terminal only, so that equal results have equal pages.
        last: input and computing time, printed after the tables instead of `heading` and `took`.
        again: how to reproduce the figures, if the command alone is not sufficient.
        result: gives the JSON object, by the keys that its class declares.
        pictures: by file name, drawn when they are written. files: the contents of other files.
        faults: failures that make the command exit with an error. pace: length of a step if known, for the JSON object.
    """

    name: str
    kind: str
    title: str
    summary: str
    result: Any
    findings: Sequence[str] = ()
    figures: Sequence[KeyFigure] = ()
    heading: Sequence[str] = ()
    picture: Callable[[], Chart | CellMaps] | None = None
    below: Callable[[], Sequence[Chart]] = tuple
    parts: Sequence[Section] = ()
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
