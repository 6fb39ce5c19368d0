"""Reads a page as a browser would, strictly: tags that close, addresses, headings, the data under the pointer."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from io import BytesIO
from typing import Any

from PIL import Image

_FILE = BytesIO()
Image.new("RGB", (3, 2), "#c5464a").save(_FILE, format="png")
PNG = _FILE.getvalue()
"""A picture of 3 x 2 pixels, as a file."""
VOID = {"br", "col", "hr", "img", "input", "link", "meta"}
"""Elements without an end tag."""
ASKING = ("fetch(", "XMLHttpRequest", "WebSocket", "EventSource", "sendBeacon", "import(", "importScripts", "Worker(",
          "eval(", "innerHTML", "outerHTML", "document.write", "insertAdjacentHTML")  # fmt: skip
"""What a script could ask others with, or turn data into markup with."""

ADDRESSES = {"src", "href", "srcset", "action", "poster", "data", "formaction", "background", "ping", "manifest"}


class Reader(HTMLParser):
    """The page taken apart; raises AssertionError where tags do not close in order."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.styles: list[str] = []
        self.headings: list[tuple[int, str]] = []
        self.feed(page)
        self.close()
        assert self.open == [], self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names)), (tag, names)
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append((dict(attrs), ""))
        if tag in ("h1", "h2", "h3", "h4"):
            self.headings.append((int(tag[1]), ""))

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, tag

    def handle_data(self, words: str) -> None:
        inside = self.open[-1] if self.open else ""
        if inside == "script":
            self.scripts[-1] = (self.scripts[-1][0], self.scripts[-1][1] + words)
        elif inside == "style":
            self.styles.append(words)
        else:
            self.text += words.replace("\N{NO-BREAK SPACE}", " ")
            if self.open and self.headings and any(tag in ("h1", "h2", "h3") for tag in self.open):
                level, heading = self.headings[-1]
                self.headings[-1] = (level, heading + words)

    def all(self, tag: str, look: str = "") -> list[dict[str, str | None]]:
        """Attributes of every such element."""
        return [attrs for name, attrs in self.tags if name == tag and look in ["", *(attrs.get("class") or "").split()]]

    def data(self) -> list[Any]:
        """What the script reads."""
        return [json.loads(text) for attrs, text in self.scripts if attrs.get("type") == "application/json"]


def check_page_is_sound(page: str, asks: str = "") -> Reader:
    """Well-formed, asks nobody (but by what `asks` names), can be read by all; returns the page taken apart."""
    assert page.startswith("<!DOCTYPE html>")
    page.encode("utf-8")
    reader = Reader(page)
    _asks_nobody(reader, asks)
    _is_accessible(reader)
    return reader


def _asks_nobody(reader: Reader, asks: str) -> None:
    addresses = [value or "" for _, attrs in reader.tags for name, value in attrs.items() if name in ADDRESSES]
    for address in addresses:
        assert re.match(r"(#[a-z0-9-]+$|data:image/(png|svg\+xml)[;,])", address), address
    for _, attrs in reader.tags:
        assert not [name for name in attrs if name.startswith("on")]
        assert "url(" not in (attrs.get("style") or "")
    css = "".join(reader.styles)
    assert "url(" not in css and "@import" not in css and "http" not in css
    code = [text for attrs, text in reader.scripts if attrs.get("type") != "application/json"]
    assert (
        len(code) == 1 and not [word for word in ASKING if word in code[0] and word != asks] and "http" not in code[0]
    )
    policy = next(attrs["content"] for attrs in reader.all("meta") if attrs.get("http-equiv"))
    assert policy is not None and "default-src 'none'" in policy and "unsafe-eval" not in policy
    digest = base64.b64encode(hashlib.sha256(code[0].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in policy and "img-src data:;" in policy
    assert not {"iframe", "object", "embed", "form", "base"} & {tag for tag, _ in reader.tags}


def _is_accessible(reader: Reader) -> None:
    assert reader.all("html")[0]["lang"] == "en"
    assert any(attrs.get("name") == "viewport" for attrs in reader.all("meta"))
    assert [level for level, _ in reader.headings].count(1) == 1 and reader.headings[0][0] == 1
    for (level, _), (following, _) in zip(reader.headings, reader.headings[1:], strict=False):
        assert following <= level + 1
    assert all(image.get("alt") for image in reader.all("img"))
    names = [attrs["id"] for _, attrs in reader.tags if "id" in attrs]
    assert len(names) == len(set(names))
    asked = [attrs["aria-labelledby"] for _, attrs in reader.tags if "aria-labelledby" in attrs]
    asked += [(attrs["href"] or "")[1:] for attrs in reader.all("a") if (attrs["href"] or "").startswith("#")]
    assert set(asked) <= set(names)
    assert all(attrs.get("aria-label") for _, attrs in reader.tags if attrs.get("tabindex") == "0" and "role" in attrs)
    assert all(attrs.get("scope") for attrs in reader.all("th"))
