"""Pages of the commands in Chromium, at the widths of a phone, a tablet and a desk: nothing is cut, all answers."""

from pathlib import Path

import numpy as np
import pytest
from page_reader import Browser, needs_browser

from analysis.cli.app import run
from planner.world.world import World

SWEEP = "base: {input: world.npz}\nsweep: {robots: [1, 2, 3]}\nrollouts: 64\n"
COMMANDS = {
    "evaluate": "evaluate {folder}/world.npz --robots 3 --rollouts 500",
    "front": "front {folder}/world.npz --robots 2 --rollouts 256",
    "sweep": "sweep {folder}/sweep.yaml --store {folder}/sweep.store --processes 1",
}
OVERFLOWING = """[...document.querySelectorAll('body *')].filter((e) => {
  const box = e.getBoundingClientRect();
  const out = box.width && (box.right > document.documentElement.clientWidth + 1 || box.left < -1);
  return out && (e.matches('.word') || !e.closest('.scroll, nav, pre, .view, .unseen, .skip, svg, details'));
}).map((e) => e.outerHTML.slice(0, 90))"""
"""Elements beyond the window that do not scroll by themselves. On a phone `innerWidth` would grow with them."""
OVERLAPPING = """(() => {
  const boxes = [...document.querySelectorAll('main h2, main p, main table, main figure, main li, header p, header h1')]
    .filter((e) => !e.closest('details:not([open])') && e.getClientRects().length)
    .map((e) => [e, e.getBoundingClientRect()]);
  const found = [];
  for (const [i, [a, one]] of boxes.entries()) for (const [b, other] of boxes.slice(i + 1))
    if (!a.contains(b) && !b.contains(a) && one.left < other.right - 1 && other.left < one.right - 1
        && one.top < other.bottom - 1 && other.top < one.bottom - 1)
      found.push([a.outerHTML.slice(0, 60), b.outerHTML.slice(0, 60)]);
  return found;
})()"""
"""Pairs of texts, tables and figures that lie over each other."""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The page of each command on a map of 9 x 14 cells with a dangerous block and a wall."""
    folder = tmp_path_factory.mktemp("pages")
    threat = np.zeros((9, 14))
    threat[2:6, 4:10], threat[7, 2:9] = 0.15, np.nan
    World.create(threat).save(folder / "world.npz")
    (folder / "sweep.yaml").write_text(SWEEP, encoding="utf-8")
    for name, words in COMMANDS.items():
        assert run([*words.format(folder=folder).split(), "--out", str(folder / name)]) == 0
    return {name: folder / name / "index.html" for name in COMMANDS}


@needs_browser
@pytest.mark.parametrize("width", [390, 768, 1280])
@pytest.mark.parametrize("name", list(COMMANDS))
def test_nothing_is_cut_or_overlaps(pages: dict[str, Path], browser: Browser, name: str, width: int) -> None:
    browser.open(pages[name], width=width, dark=width == 768)
    assert not browser.run("document.documentElement.scrollWidth > document.documentElement.clientWidth")
    assert browser.run(OVERFLOWING) == [] and browser.run(OVERLAPPING) == []
    assert browser.run("document.querySelectorAll('main section').length") > 1 and browser.noticed == []
    assert all(address.startswith(("file:", "data:", "blob:")) for address in browser.asked)


@needs_browser
def test_the_player_plays_to_its_end_and_shows_the_final_coverage(pages: dict[str, Path], browser: Browser) -> None:
    """Each run: the player stops at its last step, and the last count of covered cells is that of the run."""
    browser.open(pages["evaluate"])
    radios = "[...document.querySelectorAll('.player input[type=radio]')]"
    slider = "document.querySelector('.player input[type=range]')"
    said = "document.querySelector('.player output').textContent.replaceAll('\u00a0', ' ')"
    assert browser.run(f"{radios}.length") == 4
    for number in (0, 3):
        browser.run(f"{radios}[{number}].click()")
        browser.until(f"{radios}[{number}].checked && {slider}.value === {slider}.max && {said}.startsWith('Step ')")
        whole = browser.run(said)
        browser.run(f"(() => {{ {slider}.value = {slider}.max - 9; {slider}.dispatchEvent(new Event('input')); }})()")
        assert browser.run(said) != whole
        browser.run("document.querySelector('.player .play').click()")
        browser.until(f"{slider}.value === {slider}.max")
        assert browser.run(said) == whole
    assert browser.noticed == []


@needs_browser
@pytest.mark.parametrize("name", list(COMMANDS))
def test_the_keyboard_reaches_all_and_leaves(pages: dict[str, Path], browser: Browser, name: str) -> None:
    """Tab visits each control and scroll area once, shows where it is, and is caught nowhere."""
    browser.open(pages[name])
    wanted = browser.run(
        "[...document.querySelectorAll('button, select, input, summary, [tabindex=\"0\"]')]"
        ".filter((e) => e.getClientRects().length && !e.disabled && !e.closest('details:not([open]) > :not(summary)')"
        " && !(e.type === 'radio' && !e.checked)).length"
    )
    assert len(browser.stops()) >= wanted > 3 and browser.noticed == []
