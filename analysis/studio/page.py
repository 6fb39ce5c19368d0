"""The studio's page: controls around an empty map, which its script fills with what the server tells it."""

from __future__ import annotations

from functools import cache

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_hex

from analysis.page.document import asset, page_head, policy, whole_script
from analysis.page.markup import Html, element
from analysis.pictures.style import COVERED, LOSSES, OBSTACLE, SAFE, SHADES, THREAT, UNREACHABLE
from planner.files import Json
from planner.policies import RULES
from planner.worlds.world import MAX_ROBOTS

SHARED = ("values.js", "choices.js", "cell_maps.js")
"""Of a report's script."""
SCRIPTS = ("board.js", "picture.js", "answer.js", "studio.js")
PAINTED = LinearSegmentedColormap.from_list("painted", [SAFE, *(to_hex(THREAT(x / 4)) for x in range(5))])
LAYERS = (("Threat", PAINTED, True), ("Coverage", COVERED, False), ("Losses", LOSSES, True))
"""Name, colours from the least to the largest, and whether small values are spread by a square root."""
HINT = (
    "Drag to paint; threats leave obstacles as they are. Move drags an enlarged map and paints nothing. With the "
    "keyboard: arrow keys go from cell to cell, space paints, with Shift all along the way; 1 to 5 choose the brush, "
    "Ctrl+Z takes back."
)


@cache
def _script() -> Html:
    return whole_script([*map(asset, SHARED), *(asset(name, "analysis.studio") for name in SCRIPTS)])


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
    return {"layers": layers, "obstacle": OBSTACLE, "unreachable": UNREACHABLE}


@cache
def studio_page() -> str:
    """The page as HTML; nothing of a map is in it."""
    styles = "\n".join((asset("page.css"), asset("studio.css", "analysis.studio")))
    head = page_head("mrac-jax studio", styles, policy(_script(), "'self'"))
    body = element(
        "body",
        element("a", "Skip to the map", class_="skip", href="#board"),
        element(
            "main",
            _said(),
            _map(),
            element("ul", id="figures", class_="figures"),
            _controls(),
            _saving(),
            class_="studio",
        ),
        element("div", id="tip", role="presentation", hidden=True),
        element("div", id="live", class_="unseen", aria_live="polite"),
        element("script", _script()),
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n{head}\n{body}\n</html>\n'


def _said() -> Html:
    return element(
        "header",
        element("p", "mrac-jax studio", class_="kind"),
        element("h1", "...", id="name"),
        element("p", "...", id="headline", class_="answer"),
        element("p", "Waiting for the first answer.", id="status", class_="note"),
        element("p", id="problem", class_="warning", role="alert", hidden=True),
    )


def _map() -> Html:
    box = element(
        "div",
        element("canvas", class_="cells", aria_hidden="true"),
        element("svg", class_="paths", preserveAspectRatio="none", aria_hidden="true"),
        element("div", class_="here", hidden=True),
        id="board", class_="grid-box", tabindex="0", role="application", aria_label="The map, to paint on",
    )  # fmt: skip
    tools = element(
        "div",
        element("div", id="brushes"),
        element("div", id="sizes"),
        _field("Chance", "chance", "% a visit", type="number", min="0.01", max="99.9", step="any", value="10"),
        class_="tools",
    )
    seen = element(
        "div",
        element("div", id="layers"),
        element(
            "div", _button("Undo", "undo"), _button("Redo", "redo"), _button("Start over", "again"), class_="buttons"
        ),
        class_="tools",
    )
    return element(
        "section",
        tools,
        seen,
        element("div", element("div", box, class_="view"), class_="map"),
        element("div", element("div", id="bar", class_="bar"), class_="bar-box", aria_hidden="true"),
        element("p", HINT, class_="note"),
        class_="bench",
        aria_label="Map",
    )


def _controls() -> Html:
    options = [element("option", name, value=name, data_limited=rule.limited) for name, rule in RULES.items()]
    return element(
        "section",
        element("h2", "Team"),
        _field("Robots", "robots", "by rule, upper-left", type="number", min="1", max=str(MAX_ROBOTS), step="1"),
        element("label", element("span", "Policy"), element("select", *options, id="policy")),
        _field("Reserve", "reserve", "share at risk", type="number", min="0.01", max="1", step="any"),
        _field("Worth", "worth", "new cells a robot", type="number", min="0.01", step="any"),
        _field("Deadline", "deadline", "step", type="number", min="1", step="1"),
        id="team",
        aria_label="Team",
    )


def _saving() -> Html:
    return element(
        "section",
        _button("Save", "save", class_="strong"),
        element("p", id="saved", class_="note", role="status"),
        element(
            "div",
            element("pre", element("code", id="command"), tabindex="0"),
            element("button", "Copy", type="button", class_="copy", hidden=True),
            class_="command",
            hidden=True,
        ),
        element("ul", id="notes", class_="findings"),
        class_="saving",
        aria_label="Save",
    )


def _field(name: str, key: str, unit: str, **attributes: str) -> Html:
    return element(
        "label", element("span", name), element("input", id=key, **attributes), element("small", unit, id=f"{key}-unit")
    )


def _button(name: str, key: str, **attributes: str) -> Html:
    return element("button", name, type="button", id=key, **attributes)
