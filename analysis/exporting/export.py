"""One door to all formats: by name or by the file's suffix, into a file or a folder, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from analysis.exporting.features import geojson
from analysis.exporting.geotiff import geotiff
from analysis.exporting.markup import gpx, kml
from analysis.exporting.mission import Mission
from analysis.exporting.nav2 import nav2_poses
from analysis.exporting.qgc import qgc_plan
from planner.arguments import argument, did_you_mean
from planner.errors import UsageError
from planner.files import atomic_write, check_new, printable
from planner.plans.waypoints import waypoints_csv
from planner.worlds.world import World

Content = str | bytes


@dataclass(frozen=True)
class Format:
    """A way out.

    Attributes:
        suffixes: of its files, the usual one first.
        whole: what a file of the team holds; or `each`: what the file of a robot holds.
        on_earth: it holds longitudes and latitudes. figures: what of the open loop's exact values is in it.
    """

    suffixes: tuple[str, ...]
    whole: Callable[[Mission], Content] | None = None
    each: Callable[[Mission, int], Content] | None = None
    on_earth: bool = True
    figures: tuple[str, ...] = ()

    def check(self, world: World) -> None:
        """Raise MapError for a world of which it cannot be written, before there is a plan."""
        if self.on_earth:
            world.to_lonlat((0, 0))

    def names(self, out: Path, robots: int) -> list[Path]:
        """The files that it writes for `out`: a folder, or a file (numbered where each of several robots has one)."""
        folder, suffix = is_folder(out), self.suffixes[0]
        if self.each is None:
            return [out / f"plan{suffix}"] if folder else [out]
        if folder:
            return [out / f"robot-{robot}{suffix}" for robot in range(robots)]
        return [out.with_stem(f"{out.stem}-{robot}") for robot in range(robots)] if robots > 1 else [out]

    def contents(self, mission: Mission) -> list[Content]:
        """What those files hold."""
        if self.each is not None:
            return [self.each(mission, robot) for robot in range(len(mission.plan.robots))]
        assert self.whole is not None
        return [self.whole(mission)]


FORMATS = {
    "qgc": Format((".plan",), each=qgc_plan),
    "nav2": Format((".yaml", ".yml"), each=nav2_poses, on_earth=False),
    "geojson": Format((".geojson", ".json"), geojson, figures=("covered", "losses", "chance_of_loss")),
    "kml": Format((".kml",), kml, figures=("covered", "losses", "chance_of_loss")),
    "gpx": Format((".gpx",), gpx, figures=("chance_of_loss",)),
    "csv": Format((".csv",), lambda mission: waypoints_csv(mission.plan, mission.world), on_earth=False),
    "geotiff": Format((".tif", ".tiff"), geotiff, on_earth=False, figures=("covered", "losses", "residual")),
}
"""Every way out, by its name."""


def is_folder(out: Path) -> bool:
    """True for a folder that is there, and for a name without a suffix."""
    return out.is_dir() or not out.suffix


def choose_format(out: Path, to: str | None, name: str = "out") -> Format:
    """The format called `to`, else that of the suffix of `out`; UsageError naming the argument `name`."""
    if to is not None and to not in FORMATS:
        raise UsageError(argument("to", to), expected=" or ".join(FORMATS), fix=did_you_mean(to, FORMATS))
    suffix = "" if is_folder(out) else out.suffix.lower()
    if to is not None:
        if suffix and suffix not in FORMATS[to].suffixes:
            expected = f"{' or '.join(FORMATS[to].suffixes)} for {to}, or a folder"
            raise UsageError(f"{argument(name, str(out))} ends in {suffix!r}", expected=expected)
        return FORMATS[to]
    found = [one for one in FORMATS.values() if suffix in one.suffixes]
    if not found:
        known = " ".join(one.suffixes[0] for one in FORMATS.values())
        problem = f"{argument(name, printable(out))}: no format has the suffix {suffix!r}"
        raise UsageError(problem, expected=known, fix=f"or say {argument('to')} {'|'.join(FORMATS)}" * (name == "out"))
    return found[0]


def export(mission: Mission, out: Path, form: Format, spare: Iterable[Path] = (), *, force: bool = True) -> list[Path]:
    """Write the mission; returns the files. Nothing is written unless all of it can be made.

    Raises InputError: a map that nobody has put on the Earth, an altitude that cannot be flown, a file that cannot be
    written, or that is the map or `spare`, other files that were read; without `force` one that is there already.
    """
    names = form.names(out, len(mission.plan.robots))
    check_new(*names, force=force)
    read = {file.resolve() for file in (Path(mission.world.source), *spare)}
    for name in names:
        if name.resolve() in read:
            raise UsageError(f"{printable(name)} is an input, and would be written", expected="a file of its own")
    contents = form.contents(mission)
    if is_folder(out):
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            problem = f"{argument('out', printable(out))} cannot be made ({error.strerror})"
            raise UsageError(problem, expected="a folder to write to") from error
    for name, content in zip(names, contents, strict=True):
        with atomic_write(name, "wb" if isinstance(content, bytes) else "w") as file:
            file.write(content)
    return names
