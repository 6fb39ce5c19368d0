"""README.md and the documents: examples run or parse as pasted, and files and modules that are named are there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from pkgutil import resolve_name

import pytest

import mrac_jax as mrac
from analysis.cli.app import app

ROOT = Path(__file__).parent.parent
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md"))
}
PYTHON = {
    name: "\n".join(blocks)
    for name, text in PAGES.items()
    if name != "CONTRIBUTING.md" and (blocks := re.findall(r"^```python\n(.*?)```", text, re.DOTALL | re.MULTILINE))
}
COMMANDS = [
    (name, line)
    for name, text in PAGES.items()
    for block in re.findall(r"^```(?:sh)?\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
    if line.startswith("mrac-jax")
]


START = pytest.param("docs/start.md", marks=pytest.mark.slow)  # 100,000 rollouts, five times the work of the others


@pytest.mark.parametrize("page", [*sorted(PYTHON.keys() - {"docs/start.md"}), START])
def test_the_python_examples_run(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every page by itself, in an empty folder; a figure that is said (`# 0.822...`) is what comes out."""
    monkeypatch.chdir(tmp_path)
    exec(compile(PYTHON[page], page, "exec", dont_inherit=True), {})
    out = capsys.readouterr().out
    for figure in re.findall(r"# ([0-9.]*[0-9])\.\.\.", PYTHON[page]):
        assert f"\n{figure}" in out
    for name in re.findall(r'"(\w+\.(?:png|mcap|geojson))"', PYTHON[page]):
        assert (tmp_path / name).exists(), name
    for name in re.findall(r"\bmrac\.(\w+)", PYTHON[page]):
        assert name in mrac.__all__


def test_every_guide_has_examples() -> None:
    assert {"README.md", "docs/start.md", "docs/compare.md", "docs/check.md"} <= set(PYTHON)
    assert len(COMMANDS) > 40


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_the_commands_parse(page: str, line: str) -> None:
    """By the command line's own parser: an option that is renamed or gone is an error here."""
    command, _, _ = app.parse_args(shlex.split(line, comments=True)[1:], exit_on_error=False, print_error=False)
    assert command.__module__.startswith("analysis.cli"), line


@pytest.mark.parametrize("document", PAGES)
def test_what_is_named_is_there(document: str) -> None:
    text = PAGES[document]
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", text):
        assert ((ROOT / document).parent / target).exists(), target
    for named in re.findall(r"`(?:python -m )?((?:analysis|planner|mrac_jax)[./][\w./]+)", text):
        path = ROOT / named.removesuffix(".py").replace(".", "/")
        assert any(found.exists() for found in (ROOT / named, path, path.with_suffix(".py"))), named


def test_the_reference_describes_what_is_there() -> None:
    """Names without a module are the front door's."""
    names = re.findall(r"^\.\. auto\w+:: (\S+)", PAGES["docs/reference.md"], re.MULTILINE)
    for name in names:
        resolve_name(name if "." in name else f"mrac_jax.{name}")
    assert len(names) > 40


def test_every_page_is_in_the_site() -> None:
    listed = re.findall(r"```{toctree}\n(.*?)```", PAGES["docs/index.md"], re.DOTALL)
    pages = {line for block in listed for line in block.splitlines() if line and not line.startswith(":")}
    assert pages | {"index"} == {name[5:-3] for name in PAGES if name.startswith("docs/")}


def test_the_home_page_lists_every_command() -> None:
    questions = "".join(line for line in PAGES["docs/index.md"].splitlines() if line.startswith("| "))
    commands = {name for name in app if not name.startswith("-")}
    assert len(commands) > 15
    assert {name for name in commands if not re.search(rf"`{name}\b", questions)} == set()


def test_the_readme_names_whose_work_it_stands_on() -> None:
    shipped = (ROOT / "analysis/examples/README.md").read_text(encoding="utf-8")
    assert "matplotlib" in shipped
    for credited in ("Yehoshua", "Agmon", "matplotlib", "Rongelap", "Moving AI", "MIT"):
        assert credited in PAGES["README.md"], credited
