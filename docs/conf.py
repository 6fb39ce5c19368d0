"""The site, `make docs`: Markdown pages and notebooks, the reference from docstrings; nothing is asked of another host.

Sphinx with MyST-NB and furo. Warnings are errors: a link to a page or a heading that is not there is one. So is a cell
of a notebook that fails.
"""

from __future__ import annotations

import logging
import os
import re
from importlib import metadata
from pathlib import Path
from typing import Any

from jupyter_client.manager import KernelManager

project = "mrac-jax"
author = "The mrac-jax authors"
copyright = author
release = metadata.version("mrac-jax")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "cyclopts.ext.sphinx"]
root_doc = "index"

myst_heading_anchors = 3
myst_links_external_new_tab = False
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 900  # a cell; a busy machine may need minutes to compile
nb_execution_raise_on_error = True
nb_merge_streams = True
KernelManager.transport_encryption.default_value = "auto"  # what notebooks' kernels say goes over TCP: for nobody else
notebook_path = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]  # what they draw with: `five_by_five`
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, notebook_path))
logging.getLogger("traitlets").setLevel(logging.WARNING)

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("ArrayLike", "Policy", "InAreaOrder", "EngineName", "Loop", "Progress")}
python_use_unqualified_type_names = True
python_display_short_literal_types = True
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_use_ivar = True  # attributes of dataclasses are members too
suppress_warnings = ["ref.python"]  # attributes of one name in two classes: each is shown where it stands

html_theme = "furo"
html_title = f"mrac-jax {release}"
html_static_path = ["_static"]
html_css_files = ["focus.css"]
html_show_sourcelink = False
html_copy_source = False


def setup(app: Any) -> None:
    """Names of types as they stand in signatures: Sphinx 9 wraps those of `autodoc_type_aliases` in unions."""

    def unwrap(
        app: Any, what: str, name: str, thing: Any, options: Any, signature: str, returned: str
    ) -> tuple[str, str]:
        bare = [text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in (signature, returned)]
        return bare[0], bare[1]

    app.connect("autodoc-process-signature", unwrap)
