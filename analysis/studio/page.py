"""The studio's page: controls around an empty map, which its script fills with what the server tells it."""

from __future__ import annotations

from functools import cache

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_hex

from analysis.page.document import asset, page_head, policy, whole_script
from analysis.page.markup import TEMPLATES, Html
from analysis.pictures.style import COVERED, FOG, LOSSES, OBSTACLE, SAFE, SHADES, THREAT, UNREACHABLE
from planner.files import Json
from planner.policies import RULES
from planner.worlds.world import MAX_ROBOTS

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
