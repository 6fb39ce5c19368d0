"""README.md and the documents: the Python example runs as pasted, and files and modules that are named are there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import mrac_jax as mrac

ROOT = Path(__file__).parent.parent
DOCUMENTS = ("README.md", "CONTRIBUTING.md", *(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))


def test_the_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec", dont_inherit=True), {})
    (said,) = re.findall(r"print\(answer.visited.mean.*# ([0-9.]*[0-9])\.\.\.", code)
    assert f"\n{said}" in capsys.readouterr().out
    assert {"world.png", "runs.mcap"} <= {path.name for path in tmp_path.iterdir()}
    for name in re.findall(r"\bmrac\.(\w+)", code):
        assert name in mrac.__all__


@pytest.mark.parametrize("document", DOCUMENTS)
def test_what_is_named_is_there(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", text):
        assert ((ROOT / document).parent / target).exists(), target
    for named in re.findall(r"`(?:python -m )?((?:analysis|planner|mrac_jax)[./][\w./]+)", text):
        path = ROOT / named.removesuffix(".py").replace(".", "/")
        assert path.exists() or path.with_suffix(".py").exists(), named


def test_what_is_cited_is_what_is_released() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    released = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (cited["version"], cited["license"]) == (released["version"], released["license"])
