"""What every report has: findings, settings, how to reproduce it, versions, and the pictures of the folder."""

from __future__ import annotations

import base64
import io
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath

from PIL import Image

from analysis.page.document import LIBRARIES, KeyFigure, Page, Section, known_version
from analysis.page.markup import Html, element, items, join, paragraphs
from analysis.page.tables import TableData, tables_html

ABOUT = {
    "world": "The map by threat level, with the borders of the areas and every robot's nominal path",
    "covered": "The chance that each cell is covered",
    "losses": "Expected robots lost in each cell, the worst cells numbered",
    "left": "Expected value left in each cell: its value times the chance that it is not found",
    "rest": "What was done before, what the range cuts off, and the chance to cover the rest",
    "distribution": "Share of the rollouts by coverage, with means, quantiles and ideals",
    "over_time": "Coverage by the end of each step, with the band of single rollouts",
    "check": "Every formula on one scale of expected cells, with the truth of both loops as lines",
    "bound_against_truth": "Each formula's value against the truth, one point a world and team",
    "starts": "Coverage by where the robots start, on the map by threat",
    "clear": "Cells gained by clearing each threat, after replanning",
    "risk_paid": "Where risk is paid: cells lost for each percent of threat more in a cell, open loop, same paths",
    "over_robots": "How often formulas fail, and coverage with what bounds it, over the number of robots",
}
"""What the pictures show, by name."""
UNFOLDED = 3
"""Pictures that are shown at once."""
COLOURS = 128
"""Of a picture in the page: enough for letters, and a third of the file's bytes."""


def answer_page(
    title: str,
    answer: str,
    sections: Sequence[Section],
    command: str,
    pictures: Mapping[str, bytes],
    files: Sequence[str],
    *,
    kind: str,
    findings: Sequence[object],
    settings: Mapping[str, object],
    heading: Sequence[str] = (),
    figures: Sequence[KeyFigure] = (),
    warnings: Sequence[str] = (),
    words: Sequence[str] = (),
    picture: Html | None = None,
    below: Html | None = None,
    broad: bool = False,
    note: str = "",
) -> str:
    """A whole page as HTML: what was found, the answer's own sections, then how it came about.

    Args:
        title: what was looked at. answer: what came out, in a sentence; `words`: sentences below it.
        sections: between findings and settings. command: the command line that made it.
        pictures: PNG files by name, put into the page. files: names of the files beside it.
        kind: the command's name. figures: tiles below the answer. warnings: what must not be overlooked.
        picture: what stands beside the answer, or below it if it is `broad`.
        below: what stands below the sentences. heading: of the settings, lines.
        note: on what makes the same figures again.
    """
    end = (settings_section(settings, heading), pictures_section(pictures), reproduce_section(command, files, note))
    found = (findings_section(findings),) if findings else ()
    shown = (tuple(figures), tuple(warnings), tuple(words), picture or Html(), broad, below or Html())
    return Page(title, answer, (*found, *sections, *end), kind, *shown).html()


def noted_tables(tables: Sequence[TableData], notes: Iterable[str]) -> Html:
    """Tables, and small print below them."""
    return join((tables_html(tables), paragraphs(notes, class_="note")))


def findings_section(findings: Sequence[object]) -> Section:
    """What was found, a sentence each."""
    return Section("Findings", items(findings, class_="findings"))


def settings_section(settings: Mapping[str, object], heading: Sequence[str] = ()) -> Section:
    """What was looked at in lines, and names and values as a list of pairs."""
    pairs = [element("div", element("dt", name), element("dd", value)) for name, value in settings.items()]
    return Section("Settings", join((paragraphs(heading), element("dl", *pairs) if pairs else Html())))


def reproduce_section(command: str, files: Sequence[str] = (), note: str = "") -> Section:
    """The command line that makes this folder again, the versions, and the other files."""
    said = note or "The same command with the same versions gives the same figures: rollouts are numbered, not drawn."
    versions = [f"mrac-jax {known_version('mrac-jax')}", f"Python {platform.python_version()}"]
    versions += [f"{library} {known_version(library)}" for library in LIBRARIES]
    names = join((element("code", name) for name in files), ", ")
    return Section(
        "How to reproduce",
        join(
            (
                element(
                    "div",
                    element("pre", element("code", command), tabindex="0"),
                    element("button", "Copy", type="button", class_="copy", hidden=True),
                    class_="command",
                ),
                element("p", said),
                element("p", "Versions: ", ", ".join(versions), "."),
                element("p", "Written beside this page: ", names, ".") if files else None,
            )
        ),
    )


def pictures_section(pictures: Mapping[str, bytes]) -> Section:
    """The pictures, PNG files by name, each with a caption, in the page itself; many are folded away."""
    shown = []
    for name, png in pictures.items():
        stem = PurePath(name).stem
        words = ABOUT.get(stem, stem.replace("_", " "))
        image = element("img", src=png_address(png), alt=words, decoding="async")
        caption = element("figcaption", words, " (", element("code", PurePath(name).name), ")")
        shown.append(element("figure", image, caption))
    lead = "For slides and papers; in full colour as the PNG files that were written beside this page." if shown else ""
    return Section("Pictures", element("div", *shown, class_="pictures") if shown else Html(), lead,
                   f"{len(shown)} pictures of what is above" if len(shown) > UNFOLDED else "")  # fmt: skip


def png_address(png: bytes) -> Html:
    """A PNG file as a data address, in fewer colours; the same bytes of the same file."""
    out = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        few = image.convert("RGB").quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(out, format="png", optimize=True)
    return Html("data:image/png;base64," + base64.b64encode(out.getvalue()).decode())


def input_name(source: str) -> str:
    """The file's name alone: a report is passed on, and whose folder it lay in is nobody's business."""
    return PurePath(source).name or source
