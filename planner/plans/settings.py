"""The planner's settings, each said once: options, files, sweeps, checks and pages are derived from the line here."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, make_dataclass
from typing import Any, Literal

from planner.arguments import check_word, is_real, is_whole
from planner.errors import PlanError
from planner.limits import MAX_STEP

MOST_LEVELS = 1024
MOST_DENSITY = 1e6


@dataclass(frozen=True)
class Setting:
    """What a setting may be, and how it is spoken of.

    Attributes:
        kind: "whole", "number" (above `least`) or "word" (one of `words`).
        title: on pages. help: of its option.
        least, most: of a number. unset: what None means, on pages; "": it is never None.
    """

    kind: Literal["whole", "number", "word"]
    title: str
    help: str
    least: float = 0
    most: float = 0
    words: tuple[str, ...] = ()
    unset: str = ""

    @property
    def expected(self) -> str:
        """What is accepted, in words."""
        if self.kind == "word":
            return " or ".join(f'"{word}"' for word in self.words)
        least = f"{self.least:g} to" if self.kind == "whole" else f"above {self.least:g}, at most"
        return f"a {'whole ' * (self.kind == 'whole')}number, {least} {self.most:.10g}" + ", or null" * bool(self.unset)

    def accepts(self, value: Any) -> bool:
        """True for a value that the setting may have."""
        if value is None or self.kind == "word":
            return value in self.words if value is not None else bool(self.unset)
        if self.kind == "whole":
            return is_whole(value, int(self.least), int(self.most))
        return is_real(value) and self.least < value <= self.most

    def shown(self, value: Any) -> str:
        """A value, on pages."""
        return self.unset if value is None else value if self.kind == "word" else f"{value:,g}"


def _setting(default: Any, kind: Literal["whole", "number", "word"], title: str, option: str, **more: Any) -> Any:
    return field(default=default, metadata={"setting": Setting(kind, title, option, **more)})


@dataclass(frozen=True)
class Settings:
    """The choices that a plan depends on (SPEC sections 1-5); they are saved with it.

    Attributes:
        levels: most threat levels, `p = 0` counted; a map with more distinct values is quantised for planning.
        density: d of Algorithm 1, the least cells a robot of a safe area is to have; above 1.
        risk: "paper", eq. (3), or "log", costs that make the safest path the one most likely survived.
        transit: "grid": legs inside an area may cross others; "area": they stay inside.
        max_steps: T_max; None = 8 * levels * accessible cells + 64.
    """

    levels: int = _setting(
        16, "whole", "threat levels at most", "Most threat levels, safe counted (default: the input's, else 16).",
        least=2, most=MOST_LEVELS,
    )  # fmt: skip
    density: float = _setting(
        4.0, "number", "density d", "Least cells a robot of a safe area is to have, d (default: 4).",
        least=1, most=MOST_DENSITY,
    )  # fmt: skip
    risk: Literal["paper", "log"] = _setting(
        "paper", "word", "risk", "Cost of a dangerous cell: as in the paper, or by log-survival (default: paper).",
        words=("paper", "log"),
    )  # fmt: skip
    transit: Literal["grid", "area"] = _setting(
        "grid", "word", "transit", "Legs inside an area may cross others (grid) or not (area) (default: grid).",
        words=("grid", "area"),
    )  # fmt: skip
    max_steps: int | None = _setting(
        None, "whole", "limit of steps", "End an unfinished run at this step (default: 8 * levels * cells + 64).",
        least=1, most=MAX_STEP, unset="8 x levels x cells + 64",
    )  # fmt: skip

    def check(self, source: str = "") -> None:
        """Raise PlanError, naming `source`, for an unknown word or a value out of range."""
        for name, setting in SETTINGS.items():
            value = getattr(self, name)
            if setting.kind == "word":
                check_word(name, value, setting.words, PlanError, source)
            elif not setting.accepts(value):
                shown = f"{value:g}" if setting.kind == "number" and is_real(value) else repr(value)
                raise PlanError(f"{name} is {shown}", source=source, expected=setting.expected)

    def shown(self) -> dict[str, str]:
        """Every setting by its title, for pages."""
        return {setting.title: setting.shown(getattr(self, name)) for name, setting in SETTINGS.items()}


SETTINGS: dict[str, Setting] = {item.name: item.metadata["setting"] for item in fields(Settings)}
_Given: Any = make_dataclass("_Given", [(name, Any, None) for name in SETTINGS], frozen=True)


class Choices(_Given):
    """The settings as given by a user, by name; None = not given."""

    def given(self) -> dict[str, Any]:
        """The choices that the user made."""
        values = {name: getattr(self, name) for name in SETTINGS}
        return {name: value for name, value in values.items() if value is not None}
