"""HTML that cannot be broken by what stands in it: templates escape every text that is not HTML already."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup as Html

from analysis.page.tables import parted
from planner.errors import visible


def _shown(value: Any) -> Any:
    """A value as a template puts it in, before it is escaped: invisible, unpaired and turning characters are named."""
    return value if isinstance(value, Html) else "" if value is None else visible(str(value))


def with_code(text: str) -> Html:
    """A sentence; what stands between backticks is code."""
    if isinstance(text, Html):
        return text
    parts = visible(text).split("`")
    if len(parts) % 2 == 0:  # one of them has no partner
        return Html.escape("`".join(parts))
    return Html().join(Html("<code>{}</code>").format(part) if at % 2 else part for at, part in enumerate(parts))


TEMPLATES = Environment(
    loader=PackageLoader("analysis.page"), autoescape=True, finalize=_shown, undefined=StrictUndefined,
    trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip
TEMPLATES.filters |= {"parted": parted, "with_code": with_code}
TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}


def block(name: str, *values: object) -> Html:
    """A macro of `templates/blocks.html`; nothing of one that has nothing to say."""
    macro = getattr(TEMPLATES.get_template("blocks.html").module, name)
    return Html(macro(*values).strip())
