"""Formulas on one scale: a row each, a mark at its value, the truths as upright lines. Boxes alone, no drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from analysis.page.markup import Html, element, join
from analysis.page.tables import LOOKS, judged


@dataclass(frozen=True)
class Mark:
    """A value; `name`: of what. verdicts: (where, verdict), the one that matters most first. upper: a bound above."""

    name: str
    value: float
    verdicts: tuple[tuple[str, str], ...]
    upper: bool


@dataclass(frozen=True)
class Truth:
    """An upright line. look: "open" or "closed"."""

    name: str
    value: float
    look: str


def strip_html(marks: Sequence[Mark], truths: Sequence[Truth], most: float, note: str) -> Html:
    """Rows from 0 to `most`, with a grey margin on both sides for values that nothing can have."""
    if not marks or most <= 0:
        return Html()
    low = max(min(0.0, *(mark.value for mark in marks)), -0.25 * most)
    high = min(max(most, *(mark.value for mark in marks)), 1.25 * most)
    low, high = low - 0.03 * most, high + 0.03 * most

    def at(value: float) -> str:
        return f"{100 * (min(max(value, low), high) - low) / (high - low):.2f}%"

    rows = []
    for mark in marks:
        look = f"m-{LOOKS[mark.verdicts[0][1]]}"
        off = None
        if not low <= mark.value <= high:
            side = "left" if mark.value < low else "right"
            off = element("span", f"{mark.value:,.0f}", class_="off", style=f"{side}:.7rem")
        track = element(
            "span",
            element("i", class_="zone", style=f"left:0;width:{at(0)}"),
            element("i", class_="zone", style=f"left:{at(most)};right:0"),
            *(element("i", class_=f"truth {truth.look}", style=f"left:{at(truth.value)}") for truth in truths),
            element("i", class_="dot upper" if mark.upper else "dot", style=f"left:{at(mark.value)}"),
            off,
            class_=f"track {look}",
        )
        said = join((judged(f"{where}: {verdict}") for where, verdict in mark.verdicts), "; ")
        said = join((f"{mark.value:,.2f}; ", said))
        name = element("span", mark.name, element("span", said, class_="said"), class_="name")
        rows.append(element("li", name, track))
    chips = [(f"line-{truth.look}", f"{truth.name}: {truth.value:,.2f}") for truth in truths]
    chips += [("dot m-holds", "lower bound"), ("dot upper m-holds", "upper bound"), ("zone", "what nothing can have")]
    key = [element("li", element("i", class_=f"chip {look}", aria_hidden="true"), name) for look, name in chips]
    return element(
        "div",
        element("ul", *key, class_="legend key"),
        element("ol", *rows, class_="strip"),
        element("p", note, class_="note") if note else None,
    )
