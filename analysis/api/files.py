"""Files for viewers, ground stations and GIS, and recordings read back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from analysis.api.options import Loop
from analysis.api.plans import plan_of
from analysis.kit.calls import OnInterrupt, ask
from analysis.kit.notes import Doing, Progress
from planner.arguments import as_whole
from planner.files import check_new
from planner.luck_names import LuckName
from planner.plans.plan import Plan
from planner.rollouts.names import EngineName
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
    outcomes: bool = False,
    loop: Loop | None = None,
    seed: int = 0,
    engine: EngineName = "auto",
    luck: LuckName = "tolerance",
    first_visit: bool = False,
    step_seconds: float | None = None,
    force: bool = False,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Recorded:
    """Rollouts in full as an MCAP file, for Foxglove, Lichtblick and Rerun; read back with `read_rollouts`.

    Args:
        plan: as of `evaluate`. path: of the file (.mcap); a layout for Foxglove and Lichtblick is written beside it.
        ids: rollouts to record; or `pick`: some of `rollouts` evaluated ones, of "worst", "median", "best", ...
            (default: those three). outcomes: keep what each of the `rollouts` came to (`read_outcomes`).
        step_seconds: how long a step takes in the viewer; None: as long as the world says, or 1.
        force: replace a recording or layout that is there already; without it that is an InputError.
        loop, seed, engine, luck, first_visit, progress, on_interrupt: as of `evaluate`.
    """
    from analysis.recording.names import SUFFIX, check_name, layout_name
    from analysis.recording.pick import parse_picks
    from analysis.recording.record import record as record_rollouts
    from analysis.recording.rolling import Request
    from analysis.recording.viewers.layout import write_layout

    check_name(Path(path), SUFFIX)
    check_new(path, layout_name(Path(path)), force=force)
    chosen, names = tuple(ids), tuple(pick)
    picks: tuple[Pick, ...] = () if chosen and not names else tuple(parse_picks(",".join(names or PICKS)))
    count = as_whole(rollouts) if picks or outcomes else 0

    def work(tell: Progress, doing: Doing) -> Recorded:
        of, given = plan_of(world, plan)
        made = not given.is_foreign
        seconds = of.with_pace(step_seconds).pace.seconds or 1.0
        how: Any = {"loop": loop or given.usual_loop, "seed": seed, "step_seconds": seconds, "made": made}
        how |= {"outcomes": outcomes, "engine": engine, "luck": luck, "first_only": first_visit}
        request = Request(chosen, picks, count, **how)
        done = record_rollouts(of, given, request, path, progress=tell, doing=doing)
        write_layout(layout_name(done.path), of, len(given.robots))
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
    force: bool = False,
) -> list[Path]:
    """The plan for ground stations, nav2 and GIS; returns the files.

    Args:
        plan: as of `evaluate`. out: a file or a folder. to: the format; None: by the suffix of `out`.
        altitude: QGroundControl: metres above take-off (default 20), 0 for robots on the ground. speed: metres a
            second (default: as the world says, or 3).
        force: replace files that are there already; without it that is an InputError, and nothing is written.
    """
    from analysis.exporting.export import choose_format
    from analysis.exporting.export import export as write
    from analysis.exporting.mission import make_mission

    form = choose_format(Path(out), to)
    return write(make_mission(*plan_of(world, plan), altitude, speed), Path(out), form, force=force)
