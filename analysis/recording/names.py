"""Names of the files of a recording NAME.mcap, and errors about them."""

from __future__ import annotations

from pathlib import Path

from planner.errors import UsageError

SUFFIX, GROWING = ".mcap", ".partial"


def growing_name(recording: Path) -> Path:
    """NAME.mcap.partial: the recording while it is written."""
    return recording.with_name(recording.name + GROWING)


def interrupted_name(recording: Path) -> Path:
    """NAME.interrupted.mcap: an interrupted recording, if another file has its name."""
    return recording.with_name(f"{recording.stem}.interrupted{recording.suffix}")


def layout_name(recording: Path) -> Path:
    """NAME.layout.json."""
    return recording.with_suffix(".layout.json")


def state_name(recording: Path) -> Path:
    """NAME.state.json."""
    return recording.with_suffix(".state.json")


def left_over(growing: Path) -> UsageError:
    """The error for a partial file that exists before the work begins."""
    return UsageError(f"{growing} is left from an earlier run", fix=how_to_clear(growing))


def check_names(recording: Path, picture: Path | None = None, animation: Path | None = None) -> None:
    """Raise UsageError for a wrong suffix, and for a recording that an earlier run left unfinished."""
    for file, suffix in ((recording, SUFFIX), (picture, ".png"), (animation, ".gif")):
        if file is not None:
            check_name(file, suffix)
    growing = growing_name(recording)
    if growing.is_symlink() or growing.exists():
        raise left_over(growing)


def how_to_clear(growing: Path) -> str:
    """The fix for a partial file that no process writes."""
    recover = f"recover it with `mrac-jax inspect --repair OUT {growing}` or " if growing.suffix == GROWING else ""
    return f"{recover}remove it"


def check_name(file: Path, suffix: str) -> None:
    """Raise UsageError for a file without the suffix, or without a name before it."""
    if file.name == suffix:
        raise UsageError(f"{file} has no name before {suffix}", expected=f"a name, as run{suffix}")
    if file.suffix != suffix:
        raise UsageError(f"{file} does not end in {suffix}", expected=f"a {suffix} file")
