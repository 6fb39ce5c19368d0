"""The console of tables, headlines and progress: it shows what text from files holds, and obeys none of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from planner.errors import visible


class SafeConsole(Console):
    """A rich console for text that is not ours: control characters are shown as escapes, and nothing is markup.

    A broken pipe is left to the caller.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"markup": False, "emoji": False, **options})

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError."""
        raise BrokenPipeError

    def render_str(self, text: str, **options: Any) -> Text:
        """The text with escapes, so that tables and wrapped lines make room for them."""
        return super().render_str(visible(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Every piece of text on its way out; codes of the console's own (colours, cursor) are no text."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else visible(text), style, control)
