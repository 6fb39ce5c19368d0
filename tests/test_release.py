"""What a release says of itself: one version, the same dependencies everywhere, links that an index can follow."""

from __future__ import annotations

import re
import runpy
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

import mrac_jax as mrac
from analysis.cli.app import run
from planner.errors import UsageError

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
RELATIVE = r"\]\((?!https?:)"


def written(name: str) -> Any:
    text = (ROOT / name).read_text(encoding="utf-8")
    return yaml.safe_load(re.sub(r"\{\{.*?\}\}", "python", text))


def test_one_version() -> None:
    cited = written("CITATION.cff")
    assert (cited["version"], cited["license"]) == (PROJECT["version"], PROJECT["license"])
    assert written("conda/meta.yaml")["package"]["version"] == PROJECT["version"] == mrac.__version__
    assert f"\n## {PROJECT['version']}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_conda_installs_what_the_wheel_needs() -> None:
    recipe = written("conda/meta.yaml")
    wanted = [
        f"python {PROJECT['requires-python']}",
        *(re.sub(r"(?=[>=])", " ", one, count=1) for one in PROJECT["dependencies"]),
    ]
    assert [one.replace("matplotlib-base", "matplotlib") for one in recipe["requirements"]["run"]] == wanted
    assert recipe["about"]["summary"] == PROJECT["description"]


def test_an_index_shows_no_link_that_it_cannot_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setitem(sys.modules, "setuptools", SimpleNamespace(setup=given.update))
    index_readme = runpy.run_path(str(ROOT / "setup.py"))["index_readme"]
    assert re.search(RELATIVE, README)
    assert given["long_description"] == index_readme(README, PROJECT.get("urls", {}).get("Source", ""))
    bare, linked = index_readme(README), index_readme(README, "https://forge.example/raw/main/")
    for text in (bare, linked):
        assert not re.search(RELATIVE, text)
        assert len(text.splitlines()) > 40
    assert "![" not in bare
    assert "(https://forge.example/raw/main/docs/start.md)" in linked


def test_without_jax_what_needs_it_names_the_fix(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "jax", None)
    for words in (["evaluate", "example:paper", "--engine", "jax"], ["clear", "example:paper", "--out", "none"]):
        assert run(words) == 2
        assert capfd.readouterr().err == "error: jax is not installed; pip install jax\n"
    assert run(["evaluate", "example:paper", "--rollouts", "100", "--json"]) == 0
    with pytest.raises(UsageError, match="jax is not installed"):
        mrac.evaluate(mrac.load("example:paper"), 1, engine="jax")
