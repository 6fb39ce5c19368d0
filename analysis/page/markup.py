"""HTML that cannot be broken by what stands in it: templates escape every text that is not HTML already."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup as Html

from analysis.page.tables import parted
from planner.errors import visible

_UNIT = re.compile(r"(?<=\d) (?=[%\w±])|(?<=%) (?=±)|(?<=[±<>]) (?=\d)")
"""The space between a number and what it counts, or a sign and its number."""
_OPTION = re.compile(r"(--[a-z][\w-]*(?: (?!-)[^\s;,()]+)?)")
"""An option with its value, if it has one."""


def _shown(value: Any) -> Any:
    """A value as a template puts it in, before it is escaped: invisible, unpaired and turning characters are named."""
    return value if isinstance(value, Html) else "" if value is None else visible(str(value))


def unbroken(text: object) -> str:
    """A text in which no line ends between a number and its unit, or between a sign and its number."""
    return text if isinstance(text, Html) else _UNIT.sub("\N{NO-BREAK SPACE}", str(_shown(text)))


def with_code(text: str) -> Html:
    """A sentence; what stands between backticks is code. An option and its value stay on one line."""
    if isinstance(text, Html):
        return text
    parts = visible(text).split("`")
    if len(parts) % 2 == 0:  # one of them has no partner
        return _with_options("`".join(parts), unbroken)
    code = Html("<code>{}</code>")
    return Html().join(
        code.format(_with_options(part, str)) if at % 2 else _with_options(part, unbroken)
        for at, part in enumerate(parts)
    )


def _with_options(text: str, rest: Callable[[str], str]) -> Html:
    """Options keep their spaces, so that they can be copied into a shell; `rest`: of what stands between them."""
    option = Html('<span class="whole">{}</span>')
    pieces = enumerate(_OPTION.split(text))
    return Html().join(option.format(piece) if at % 2 else rest(piece) for at, piece in pieces)


TEMPLATES = Environment(
    loader=PackageLoader("analysis.page"), autoescape=True, finalize=_shown, undefined=StrictUndefined,
    trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip
TEMPLATES.filters |= {"parted": parted, "with_code": with_code, "unbroken": unbroken}
TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}


def block(name: str, *values: object) -> Html:
    """A macro of `templates/blocks.html`; nothing of one that has nothing to say."""
    macro = getattr(TEMPLATES.get_template("blocks.html").module, name)
    return Html(macro(*values).strip())
