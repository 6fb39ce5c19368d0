"""Files for viewers, ground stations and GIS, and recordings read back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from analysis.api.plans import Loop, plan_of
from analysis.kit.calls import OnInterrupt, ask
from analysis.kit.notes import Doing, Progress
from planner.arguments import as_whole
from planner.plans.plan import Plan
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.recording.pick import Pick
    from analysis.recording.record import Recorded
    from analysis.recording.rollouts import RecordedOutcomes, RecordedRollout


PICKS = ("worst", "median", "best")


def record(
    world: World,
    plan: Plan | str | Path | int | None,
    path: str | Path,
    *,
    pick: Iterable[str] = (),
    ids: Iterable[int] = (),
    rollouts: int = 10_000,
    loop: Loop | None = None,
    seed: int = 0,
    step_seconds: float | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Recorded:
    """Rollouts in full as an MCAP file, for Foxglove, Lichtblick and Rerun; read back with `read_rollouts`.

    Args:
        plan: as of `evaluate`. path: of the file (.mcap); a layout for Foxglove and Lichtblick is written beside it.
        ids: rollouts to record; or `pick`: some of `rollouts` evaluated ones, of "worst", "median", "best", ...
            (default: those three).
        step_seconds: how long a step takes in the viewer; None: as long as the world says, or 1.
        loop, seed, progress, on_interrupt: as of `evaluate`.
    """
    from analysis.recording.names import SUFFIX, check_name, layout_name
    from analysis.recording.pick import parse_picks
    from analysis.recording.record import record as record_rollouts
    from analysis.recording.rolling import Request
    from analysis.recording.viewers.layout import write_layout

    check_name(Path(path), SUFFIX)
    chosen, names = tuple(ids), tuple(pick)
    picks: tuple[Pick, ...] = () if chosen and not names else tuple(parse_picks(",".join(names or PICKS)))
    count = as_whole(rollouts) if picks else 0

    def work(tell: Progress, doing: Doing) -> Recorded:
        given = plan_of(world, plan)
        made = not given.is_foreign
        seconds = world.with_pace(step_seconds).pace.seconds or 1.0
        how: Any = {"loop": loop or given.usual_loop, "seed": seed, "step_seconds": seconds, "made": made}
        request = Request(chosen, picks, count, **how)
        done = record_rollouts(world, given, request, path, progress=tell, doing=doing)
        write_layout(layout_name(done.path), world, len(given.robots))
        return done

    return ask(work, progress, on_interrupt)


def read_rollouts(path: str | Path) -> Iterator[RecordedRollout]:
    """The rollouts of a recording, one after the other; one is held at a time.

    Of a partial or recovered recording, rollouts that are not all there are left out.
    """

    from analysis.recording import rollouts

    return rollouts.read_rollouts(path)


def read_outcomes(path: str | Path) -> RecordedOutcomes:
    """Every outcome that `record --outcomes` wrote, none if it did not."""

    from analysis.recording import rollouts

    return rollouts.read_outcomes(path)


def export(
    world: World,
    plan: Plan | str | Path | int | None,
    out: str | Path,
    *,
    to: Literal["qgc", "nav2", "geojson", "kml", "gpx", "csv", "geotiff"] | None = None,
    altitude: float | None = None,
    speed: float | None = None,
) -> list[Path]:
    """The plan for ground stations, nav2 and GIS; returns the files.

    Args:
        plan: as of `evaluate`. out: a file or a folder. to: the format; None: by the suffix of `out`.
        altitude: QGroundControl: metres above take-off (default 20), 0 for robots on the ground. speed: metres a
            second (default: as the world says, or 3).
    """
    from analysis.exporting.export import choose_format
    from analysis.exporting.export import export as write
    from analysis.exporting.mission import make_mission

    form = choose_format(Path(out), to)
    return write(make_mission(world, plan_of(world, plan), altitude, speed), Path(out), form)
