"""Reads a page as a browser would, strictly; a real browser without a window; what a refused command says."""

import base64
import hashlib
import json
import re
import shutil
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import pytest
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from analysis.cli.app import run

# Reads a page as a browser would, strictly: tags that close, addresses, headings, the data under the pointer.

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
    assert len(code) == 1 and "http" not in code[0]
    assert not [word for word in ASKING if word in code[0] and word != asks]
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


# A real browser without a window: the system's Chromium, driven by Selenium.

BROWSERS, DRIVERS = ("chromium", "chromium-browser", "google-chrome"), ("chromedriver", "chromium.chromedriver")
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
         "--force-color-profile=srgb", "--disable-background-networking", "--disable-component-update",
         "--disable-sync", "--no-first-run")  # fmt: skip
FOCUSED = """(async () => {
  const e = document.activeElement, outline = (x) => x ? getComputedStyle(x).outlineStyle !== "none" : false;
  if (!e || e === document.body) return null;
  const seen = () => {
    const b = e.getBoundingClientRect();
    return b.bottom > 0 && b.right > 0 && b.top < innerHeight && b.left < innerWidth;
  };
  for (let frame = 0; frame < 60 && !seen(); frame++) await new Promise(requestAnimationFrame);
  return [e.outerHTML.slice(0, 80), seen() && (outline(e) || outline(e.nextElementSibling))];
})()"""
"""What has the focus, and whether it can be seen that it has, soon."""


def has_browser() -> bool:
    """Whether Chromium and its driver are installed."""
    return all(any(map(shutil.which, names)) for names in (BROWSERS, DRIVERS))


def needs_browser(test: Any) -> Any:
    """Marks a test that needs a browser: `make test-browser` runs these alone, and a machine without one none."""
    return pytest.mark.browser(pytest.mark.skipif(not has_browser(), reason="no Chromium with chromedriver")(test))


class Browser:
    """One page in a browser."""

    def __init__(self, profile: Path) -> None:
        """`profile`: an empty folder."""
        options = webdriver.ChromeOptions()
        options.binary_location = next(filter(None, map(shutil.which, BROWSERS)))
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        service = Service(next(filter(None, map(shutil.which, DRIVERS))))
        self._driver = webdriver.Chrome(options, service)
        self._driver.set_script_timeout(60)
        self._driver.get("about:blank")
        self._driver.get_log("performance")  # of the browser's own first tab
        self._messages: list[str] = []
        self._requests: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self._driver.quit()

    def clear(self) -> None:
        """Leave the page, and forget what was noticed and asked."""
        self._driver.get("about:blank")
        self.call("Emulation.setTouchEmulationEnabled", enabled=False)
        self.noticed.clear()
        self.asked.clear()

    @property
    def noticed(self) -> list[str]:
        """Errors and messages of the console so far."""
        self._messages += [entry["message"] for entry in self._driver.get_log("browser")]
        return self._messages

    @property
    def asked(self) -> list[str]:
        """Addresses that pages requested so far."""
        events = (json.loads(entry["message"])["message"] for entry in self._driver.get_log("performance"))
        self._requests += [
            event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"
        ]
        return self._requests

    def call(self, method: str, **words: Any) -> Any:
        """The answer to one command of the DevTools protocol."""
        return self._driver.execute_cdp_cmd(method, words)

    def open(self, page: Path | str, width: int = 1280, dark: bool = False, height: int = 900) -> None:
        """Load a page, a file or an address, in a window so many CSS pixels wide."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
                  mobile=width < 600)  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", media="", features=[scheme])
        address = page if isinstance(page, str) else page.as_uri()
        self._driver.get(address)
        # A new document may come from another process of the browser: scripts must not run in the old one.
        self.until(f"document.readyState === 'complete' && location.pathname === {json.dumps(urlsplit(address).path)}")

    def run(self, script: str) -> Any:
        """The value of an expression in the page, awaited."""
        found = self._driver.execute_async_script(
            f"const done = arguments[0]; (async () => ({script}))().then((it) => done([it]), (it) => done(String(it)));"
        )
        assert isinstance(found, list), found
        return found[0]

    def until(self, condition: str) -> None:
        """Wait until an expression holds, 20 seconds at most."""
        look = f"() => ({condition}) ? ok() : Date.now() > end ? no(Error('waited in vain')) : setTimeout(look, 10)"
        self.run(f"new Promise((ok, no) => {{ const end = Date.now() + 20000, look = {look}; look(); }})")

    def key(self, name: str, text: str = "") -> None:
        """Press a key."""
        code = {"ArrowRight": 39, "ArrowLeft": 37, "ArrowDown": 40, "Tab": 9, "Home": 36, " ": 32, "2": 50}[name]
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=name,
                windowsVirtualKeyCode=code,
                text=text * (kind == "keyDown"),
            )

    def stops(self, most: int = 400) -> list[str]:
        """What the Tab key reaches until it leaves the page; every stop can be seen."""
        found: list[str] = []
        while len(found) < most:
            self.key("Tab")
            focused = self.run(FOCUSED)
            if focused is None:
                return found
            assert focused[1], focused[0]
            found.append(focused[0])
        raise AssertionError(f"the keyboard is caught: {found[-3:]}")

    def drag(self, selector: str, *places: tuple[float, float]) -> None:
        """Press at the first place in an element, parts of its width and height, move over the others, let go."""
        spots = self._spots(selector, places)
        kinds = ("mousePressed", *("mouseMoved" for _ in spots[1:]), "mouseReleased")
        for kind, (x, y) in zip(kinds, (*spots, spots[-1]), strict=True):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def swipe(self, selector: str, *places: tuple[float, float]) -> None:
        """The same with one finger."""
        self.call("Emulation.setTouchEmulationEnabled", enabled=True)
        for number, (x, y) in enumerate(self._spots(selector, places)):
            kind = "touchMove" if number else "touchStart"
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y}])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def _spots(self, selector: str, places: tuple[tuple[float, float], ...]) -> list[tuple[float, float]]:
        box = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        left, top, width, height = self.run(
            f"(() => {{ const b = {box}; return [b.left, b.top, b.width, b.height] }})()"
        )
        return [(left + across * width, top + down * height) for across, down in places]


# What every command does with bad input: one line, and status 2.


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line on standard error of a command that exits with 2, but for "planning ..." on a slow machine."""
    assert run(list(words)) == 2
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if not re.fullmatch(r"\w+ \.\.\. \(\d+ s\)", line)]
    assert said.out == "" and len(lines) == 1 and lines[0].startswith("error: ")
    return lines[0]
