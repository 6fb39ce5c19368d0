"""The command `export` of `mrac-jax`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

from cyclopts import Group, Parameter

from analysis.cli.deliver import DONE
from analysis.cli.groups import PlanningToTheEnd, Team
from analysis.cli.options import OUTPUT, PLANNING, Input, Number, StateFile, one_of, path
from analysis.kit.notes import say

DRIVING = Group("Driving", sort_key=3)
Way = Literal["qgc", "nav2", "geojson", "kml", "gpx", "csv", "geotiff"]
"""Names of `analysis.exporting.export.FORMATS`, which `--help` has no time to import."""
To = Annotated[Way | None, Parameter(converter=one_of(*get_args(Way)))]
Altitude = Annotated[
    Number, Parameter(group=DRIVING, help="qgc: metres above take-off, 0 for robots on the ground (default: 20).")
]


def export(
    source: Input,
    /,
    *,
    to: Annotated[To, Parameter(group=OUTPUT)] = None,
    team: Team | None = None,
    planning: PlanningToTheEnd | None = None,
    plan: Annotated[Path | None, Parameter(group=PLANNING, converter=path)] = None,
    state: StateFile = None,
    altitude: Altitude = None,
    out: Annotated[Path, Parameter(group=OUTPUT, converter=path)],
) -> int:
    """A plan for ground stations, nav2 and GIS: QGroundControl, poses, GeoJSON, KML, GPX, CSV, GeoTIFF.

    qgc and nav2 have a file a robot: FILE-0.plan, FILE-1.plan, ..., or robot-0.plan, ... in a folder. All but nav2, csv
    and geotiff need a map that is georeferenced. qgc's robots drive at --speed, or a cell in --step-seconds (default: 3
    m/s).

    Args:
        out: File or folder to write.
        to: qgc, nav2, geojson, kml, gpx, csv or geotiff (default: by --out's suffix).
        plan: Export this plan file instead of planning.
    """
    from analysis.cli.progress import load_or_make_plan
    from analysis.exporting.export import choose_format
    from analysis.exporting.export import export as export_mission
    from analysis.exporting.mission import make_mission
    from analysis.inputs import read_files

    team, planning = team or Team(), planning or PlanningToTheEnd()
    form, chosen = choose_format(out, to), planning.choices()
    world, made, notes = load_or_make_plan(team.asked(source, chosen), plan, state)
    say(notes)
    mission = make_mission(world, made, altitude, team.speed)
    written = export_mission(mission, out, form, spare=read_files(source, plan, state))
    say([*mission.unknown(form.figures), *(f"wrote {file}" for file in written)])
    return DONE
