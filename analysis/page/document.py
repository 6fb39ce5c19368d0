"""The page: a title, the answer, sections with headings, and nothing that needs another file to be read."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files

from analysis.page.markup import Html, element, join, paragraphs

LIBRARIES = ("numpy", "scipy", "numba", "jax", "pymetis")
"""What the figures depend on, beside the program itself."""
SCRIPTS = ("values.js", "choices.js", "curves.js", "cell_maps.js", "replay.js", "player.js", "start.js")
"""The script's files, one a concern, in the order in which they are put together."""
LONG = 240
"""Characters from which an answer is set smaller."""
LOGO = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 4 4'%3E%3Cpath fill='%231f5fa8' "
    "d='M0 0h4v4H0z'/%3E%3Cpath fill='%239fd0c0' d='M0 0h2v1h1v1H2v2H0z'/%3E%3C/svg%3E"
)


@dataclass(frozen=True)
class Section:
    """A part of the page: its heading, what stands under it, one line below the heading.

    fold: the words that unfold it; "" for what is always shown.
    """

    title: str
    body: Html
    lead: str = ""
    fold: str = ""

    @property
    def anchor(self) -> str:
        """Its address in the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "part"


@dataclass(frozen=True)
class KeyFigure:
    """A figure that the reader takes away: "72.0 %", what it is, and how sure."""

    value: str
    name: str
    note: str = ""


@dataclass(frozen=True)
class Page:
    """A report.

    Attributes:
        title: what it is about. kind: the command in a word or two, above the title.
        answer: the answer in a sentence. words: sentences below it. figures: the few that matter.
        below: what stands below the sentences. picture: what stands beside the answer.
        broad: the picture is wider than high, and stands below the answer.
        warnings: what must not be overlooked.
        sections: in order; those with nothing in them are left out.
    """

    title: str
    answer: str
    sections: tuple[Section, ...]
    kind: str = "report"
    figures: tuple[KeyFigure, ...] = ()
    warnings: tuple[str, ...] = field(default=())
    words: tuple[str, ...] = ()
    picture: Html = field(default_factory=Html)
    broad: bool = False
    below: Html = field(default_factory=Html)

    def html(self) -> str:
        """The whole file: its pictures are in it, it needs no other. The same page gives the same bytes."""
        shown = [section for section in self.sections if section.body]
        script = whole_script()
        head = page_head(f"{self.title} - mrac-jax", asset("page.css"), policy(script))
        body = element(
            "body",
            element("a", "Skip to the report", class_="skip", href="#report"),
            self._header(),
            _contents(shown),
            element("main", *(_section(section) for section in shown), id="report"),
            element("footer", f"Made by mrac-jax {known_version('mrac-jax')}. It is self-contained "
                    "and works offline."),
            element("div", id="tip", role="presentation", hidden=True),
            element("div", id="live", class_="unseen", aria_live="polite"),
            element("script", script),
        )  # fmt: skip
        return f'<!DOCTYPE html>\n<html lang="en">\n{head}\n{body}\n</html>\n'

    def _header(self) -> Html:
        tiles = [
            element("li", element("strong", f.value), element("span", f.name), element("small", f.note))
            for f in self.figures
        ]
        said = (
            element("p", f"mrac-jax {self.kind}", class_="kind"),
            element("h1", self.title),
            element("p", self.answer, class_="answer long" if len(self.answer) > LONG else "answer"),
            paragraphs(self.words, class_="words"),
            paragraphs(self.warnings, class_="warning"),
            self.below,
        )
        figures = element("ul", *tiles, class_="figures") if tiles else None
        if not self.picture:
            return element("header", *said, figures)
        return element(
            "header",
            element("div", *said, class_="said"),
            element("div", self.picture, class_="picture"),
            figures,
            class_="beside broad" if self.broad else "beside",
        )


def page_head(title: str, styles: str, rules: str) -> Html:
    """The head of a page; `rules`: its content security policy."""
    return element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=rules),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", name="generator", content=f"mrac-jax {known_version('mrac-jax')}"),
        element("title", title),
        element("link", rel="icon", href=Html(LOGO)),
        element("style", Html(styles)),
    )


def policy(script: str, connect: str = "'none'") -> str:
    """What the browser itself enforces: this one script, the pictures in the page, and no request but to `connect`."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        f"connect-src {connect}; base-uri 'none'; form-action 'none'"
    )


def whole_script(parts: Iterable[str] | None = None) -> Html:
    """A page's one script, of these texts (default: a report's); nothing of it is seen outside."""
    texts = map(asset, SCRIPTS) if parts is None else parts
    return Html("\n".join(('"use strict";\n(() => {', *texts, "})();\n")))


def asset(name: str, package: str = "analysis.page") -> str:
    """A file of this package, or of another."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def known_version(library: str) -> str:
    """Its version, or "not installed"."""
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"


def _section(section: Section) -> Html:
    heading = f"{section.anchor}-heading"
    lead = element("p", section.lead, class_="lead") if section.lead else None
    title = element("h2", section.title, id=heading)
    body = section.body
    if section.fold:
        body = element("details", element("summary", section.fold), body)
    return element("section", title, lead, body, id=section.anchor, aria_labelledby=heading)


def _contents(sections: Sequence[Section]) -> Html:
    links = [element("li", element("a", section.title, href=f"#{section.anchor}")) for section in sections]
    return element("nav", element("ul", *links), aria_label="Contents") if len(links) > 1 else join(())
