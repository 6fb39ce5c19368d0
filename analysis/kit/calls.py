"""How a function of the door works on an answer: what it shows meanwhile, and what an interruption leaves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol, TypeVar

from analysis.kit.notes import Doing, Progress, quiet
from analysis.kit.progress import show_progress
from planner.arguments import argument, check_word
from planner.errors import UsageError

OnInterrupt = Literal["raise", "return"]


class Found(Protocol):
    """What may be interrupted."""

    @property
    def partial(self) -> bool:
        """It was, and holds what was done until then."""
        ...


Kind = TypeVar("Kind", bound=Found)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, or a notebook's stop button, while a function of the door was at work.

    Attributes:
        partial: the answer with what was done until then; None: that was nothing.
    """

    def __init__(self, partial: Found | None) -> None:
        super().__init__("interrupted" if partial is None else "interrupted: what was done is in `partial`")
        self.partial = partial


def ask(
    work: Callable[[Progress, Doing], Kind],
    progress: Progress | bool | None,
    on_interrupt: OnInterrupt,
    things: str = "rollouts",
) -> Kind:
    """The answer of `work(progress, doing)`.

    Args:
        progress: None: shown on a terminal and in a notebook; True: on a pipe too, in lines; False: nowhere; or a
            function to be called with (done, total, seconds) after every chunk, `total` 0 where it is not known.
        on_interrupt: "raise": an interruption is raised as `Interrupted`; "return": what was done is the answer, with
            `partial` true (where nothing was, it is raised all the same).
        things: what is counted.
    """
    check_word("on_interrupt", on_interrupt, ("raise", "return"))
    if not (progress is None or isinstance(progress, bool) or callable(progress)):
        raise UsageError(argument("progress", progress), expected="True, False, None or a function")
    try:
        if callable(progress) or progress is False:
            answer = work(progress or quiet, quiet)
        else:
            with show_progress(things, asked=progress is True) as watch:
                answer = work(watch, watch.doing)
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(None) from None
    if answer.partial and on_interrupt == "raise":
        raise Interrupted(answer)
    return answer
