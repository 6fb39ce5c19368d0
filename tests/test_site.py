"""The built site (`make docs`): every link leads somewhere, and nothing on a page asks another host for anything."""

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from page_reader import Browser, needs_browser

ROOT = Path(__file__).parent.parent
SITE = ROOT / "out" / "site"
FETCHED = ("src", "srcset", "data", "poster")
"""Attributes by which a page asks for something; `href` does on elements other than `a`."""
PAGES = ("index.html", "start.html", "inputs.html", "commands.html", "reference.html", "notebooks/first-answer.html")
CUT = """[...document.querySelectorAll('.highlight-sh pre, .highlight-yaml pre, .highlight-python pre')]
    .filter(block => block.scrollWidth > block.clientWidth).map(block => block.textContent)"""
"""What commands, files and programs say that stands beyond the edge of their blocks."""

pytestmark = pytest.mark.skipif(not (SITE / "index.html").exists(), reason="the site is built by `make docs`")


class Links(HTMLParser):
    """What a page fetches, where it leads, and the places that it names."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.leads: list[str] = []
        self.places: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.places.add(value)
            elif value and (name in FETCHED or (name == "href" and tag not in ("a", "use"))):
                self.fetched.append(value)
            elif name == "href" and value and tag == "a":
                self.leads.append(value)


@pytest.fixture(scope="module")
def pages() -> dict[Path, Links]:
    return {path: Links(path) for path in sorted(SITE.rglob("*.html"))}


def test_every_page_is_there(pages: dict[Path, Links]) -> None:
    written = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    assert written <= {path.relative_to(SITE) for path in pages}


def test_every_link_leads_somewhere(pages: dict[Path, Links]) -> None:
    for page, links in pages.items():
        for lead in links.leads + links.fetched:
            parts = urlsplit(lead)
            if parts.scheme or not (parts.path or parts.fragment):
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            assert target.exists(), (page.name, lead)
            if parts.fragment and target in pages:
                assert unquote(parts.fragment) in pages[target].places, (page.name, lead)


def test_no_page_asks_another_host(pages: dict[Path, Links]) -> None:
    for page, links in pages.items():
        asked = [
            address for address in links.fetched if urlsplit(address).scheme not in ("", "data") or address[:2] == "//"
        ]
        assert not asked, page.name
    for sheet in SITE.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert not re.search(r"url\(\s*['\"]?(?:https?:)?//|@import", text), sheet.name


def test_notebooks_show_every_plot() -> None:
    """A cell that ends in a figure has a picture below it, not the figure's name in words."""
    plots = 0
    for source in sorted((ROOT / "docs" / "notebooks").glob("*.md")):
        cells = re.findall(r"^```{code-cell}\n(.*?)^```", source.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        wanted = sum(cell.rstrip().splitlines()[-1].startswith("mrac.plots.") for cell in cells)
        page = (SITE / "notebooks" / source.with_suffix(".html").name).read_text(encoding="utf-8")
        assert len(re.findall(r'<div class="cell_output[^>]*>\s*<img', page)) == wanted, source.name
        assert "Axes&gt;" not in page, source.name
        plots += wanted
    assert plots >= 4


@needs_browser
@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_asks_for_files_alone(tmp_path: Path, width: int) -> None:
    with Browser(tmp_path) as browser:
        for page in (*PAGES, "search.html"):
            browser.open(SITE / page, width=width, dark=width == 390)
            wider = "document.documentElement.scrollWidth > document.documentElement.clientWidth"
            assert not browser.run(wider), page
            assert not browser.run(CUT), page
            assert page != "index.html" or len(browser.stops()) > 30
        assert not [address for address in browser.asked if not address.startswith(("file:", "data:"))]
        assert not browser.noticed


@pytest.mark.parametrize("page", ["how-it-works", "notebooks/first-answer", "notebooks/geotiff-to-qgc"])
def test_pictures_of_notebooks_show(page: str) -> None:
    """A figure that a cell draws is an image in its page, not the name of its class."""
    drawn = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").count("_figure(answer)\n")
    text = (SITE / f"{page}.html").read_text(encoding="utf-8")
    assert text.count("<img") >= max(drawn, 1)
    assert "&lt;Figure size" not in text
