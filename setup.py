"""What pyproject.toml cannot say: the description that a package index shows, README.md with links that work there.

An index resolves no relative link. Once [project.urls] has a `Source` (a forge's address that file names follow), they
become absolute; until then pictures are left out and links are their words.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup


def index_readme(text: str, source: str = "") -> str:
    """README.md for an index. `source`: what goes before relative targets; "": they are taken out."""
    relative = r"\]\((?!https?:|#)([^)]+)\)"
    if source:
        return re.sub(relative, rf"]({source.rstrip('/')}/\1)", text)
    text = re.sub(rf"^!\[[^]]*{relative}\n+", "", text, flags=re.MULTILINE)
    return re.sub(rf"\[([^]]*){relative}", r"\1", text)


here = Path(__file__).parent
urls = tomllib.loads((here / "pyproject.toml").read_text(encoding="utf-8"))["project"].get("urls", {})
readme = index_readme((here / "README.md").read_text(encoding="utf-8"), urls.get("Source", ""))
setup(long_description=readme, long_description_content_type="text/markdown")
