"""The command `studio` of `mrac-jax`."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Annotated

from cyclopts import Parameter

from analysis.cli.console import check_files
from analysis.cli.deliver import DONE
from analysis.cli.groups import Team
from analysis.cli.options import OUTPUT, Input, OutPath, Seed, Whole
from analysis.kit.notes import say
from planner.arguments import is_whole
from planner.errors import UsageError

SUFFIX = ".yaml"


def studio(
    source: Input,
    /,
    *,
    team: Team | None = None,
    seed: Seed = None,
    port: Annotated[Whole, Parameter(group=OUTPUT)] = None,
    out: OutPath = None,
) -> int:
    """Paint threats, obstacles and starts on a local page that answers every stroke; Ctrl-C ends it.

    The page is served on this machine alone, to whoever opens the address that is printed (the extra `studio`).

    Args:
        port: Of the page (default: a free one).
        out: Scenario (.yaml) that Save writes, its cells beside it (default: INPUT-studio.yaml).
    """
    try:
        import tornado  # noqa: F401
    except ImportError:
        raise UsageError("tornado is not installed", fix='pip install "mrac-jax[studio]"') from None
    from analysis.inputs import input_path, load_task
    from analysis.kit.compiling import ANNOUNCER, notice_compiling
    from analysis.kit.loops import run_loop
    from analysis.kit.progress import lines_now_and_then
    from analysis.sampling import RolloutChoices
    from analysis.studio.server import Studio, serve
    from analysis.studio.sketch import Sketch, raster_of
    from planner.settings import Choices

    team = team or Team()
    if port is not None and not is_whole(port, 1, 65535):
        raise UsageError(f"--port {port}", expected="a port, 1 to 65535")
    path = input_path(source)
    RolloutChoices(seed=seed or 0)  # refuses a seed that is none
    target = Path(f"{path.stem}-studio{SUFFIX}") if out is None else out
    check_files(source, target, suffix=SUFFIX)
    check_files(source, raster_of(target))
    task = load_task(team.asked(source, Choices()))
    say(task.notes)
    first = Sketch.of(task.world, len(task.starts), task.settings)
    room = Studio(first, PurePath(source).name, target, seed or 0)
    notice_compiling()
    try:
        with lines_now_and_then(lambda _: ANNOUNCER.line()):
            run_loop(serve(room, port or 0, lambda address: say([f"open {address}", "Ctrl-C ends it"])))
    except KeyboardInterrupt:
        say(["studio ended"])
    return DONE
