"""What a release says of itself: one version, the same dependencies everywhere, links that an index can follow."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

import mrac_jax as mrac

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


WITHOUT_JAX = """
import sys
from importlib.machinery import PathFinder
find = PathFinder.find_spec
PathFinder.find_spec = staticmethod(lambda name, *where: None if name.startswith("jax") else find(name, *where))
import mrac_jax as mrac
from analysis.cli.app import run
assert run(["evaluate", "example:paper", "--engine", "jax"]) == 2
try:
    mrac.evaluate(mrac.load("example:paper"), 1, engine="jax")
except mrac.InputError as error:
    assert str(error).startswith("jax is not installed"), error
else:
    raise AssertionError("no error")
assert run(["evaluate", "example:paper", "--rollouts", "100", "--json"]) == 0
assert run(["clear", sys.argv[1], "--rollouts", "16", "--out", sys.argv[2]]) == 0
assert "jax" not in sys.modules
"""


def test_without_jax_its_own_engine_alone_is_missed(tmp_path: Path) -> None:
    threat = np.zeros((4, 5), dtype=np.float32)
    threat[1, 1:4] = 0.2
    np.save(tmp_path / "small.npy", threat)
    words = [sys.executable, "-c", WITHOUT_JAX, str(tmp_path / "small.npy"), str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert "error: jax is not installed; pip install jax\n" in done.stderr
    assert (tmp_path / "out" / "risk_paid.png").exists()
