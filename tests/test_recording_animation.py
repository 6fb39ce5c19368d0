"""The picture and the animation of a rollout: what they show, how large they are, and that they are repeatable."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import pytest
from PIL import Image
from recordings import foreign_plan

from analysis.estimators.racing import plan_best
from analysis.inputs import Asked, load_or_make_plan
from analysis.pictures.style import OBSTACLE, SAFE, house_style
from analysis.recording import pictures as animation
from analysis.recording.frames import event_line
from analysis.recording.pictures import RolloutPicture, animation_gif, boxes_for, durations, picture_png, shown_steps
from analysis.recording.viewers.topics import Stage
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan
from planner.settings import Choices
from planner.simulator.closed_loop import compile_closed_loop, trace_rollouts
from planner.tally import EventKind, Trace
from planner.world.world import World


def rollout(world: World, starts: Sequence[Sequence[int]], seed: int = 0) -> tuple[Trace, Plan, World]:
    plan = make_plan(world, np.array(starts))
    return trace_rollouts(compile_closed_loop(plan, world), seed, [0])[0], plan, world


def small(height: int = 5, width: int = 9, threat: float = 0.3, robots: int = 3) -> tuple[Trace, Plan, World]:
    cells = np.zeros((height, width))
    cells[1:, 2:5] = threat
    cells[0, width - 1] = np.nan
    return rollout(World.create(cells), [[0, 0]] * robots)


@pytest.fixture(scope="module")
def paper() -> tuple[Trace, Plan, World]:
    world, plan, _ = load_or_make_plan(Asked("example:paper", Choices(), 8), find_best=plan_best)
    return trace_rollouts(compile_closed_loop(plan, world), 0, [3])[0], plan, world


def stage(plan: Plan, world: World, loop: str = "closed") -> Stage:
    return Stage(world, plan, loop, 0)


def opened(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data))


def test_picture_of_any_step_and_the_last_one_by_default(paper: tuple[Trace, Plan, World]) -> None:
    trace, plan, world = paper
    last = picture_png(trace, stage(plan, world))
    assert opened(last).size[0] == 1200
    assert last == picture_png(trace, stage(plan, world), trace.time)
    assert last != picture_png(trace, stage(plan, world), 0)
    assert len(last) < 300_000


@pytest.mark.parametrize("step", [-1, 10**6])
def test_a_step_that_is_none_is_named(step: int) -> None:
    trace, plan, world = small()
    with pytest.raises(UsageError, match=f"step {step}"):
        picture_png(trace, stage(plan, world), step)


@pytest.fixture(scope="module")
def three_frames() -> bytes:
    return animation_gif(small()[0], stage(*small()[1:]), most_frames=3)


def test_animation_shows_first_to_last_and_is_repeatable(three_frames: bytes) -> None:
    trace, plan, world = small()
    gif = opened(three_frames)
    assert gif.n_frames == 3 < trace.time + 1
    assert gif.size[0] == 800
    assert gif.info["loop"] == 0
    assert three_frames == animation_gif(trace, stage(plan, world), most_frames=3)


def test_frames_are_what_the_pictures_show(three_frames: bytes) -> None:
    trace, plan, world = small()
    gif = opened(three_frames)
    with house_style():
        picture = RolloutPicture(trace, stage(plan, world), animation.ANIMATION_DPI)
        for index, step in enumerate(shown_steps(trace, 3)):
            picture.show(step)
            gif.seek(index)
            shown = np.asarray(gif.convert("RGB")).astype(int)
            pixels = picture.pixels()
            assert np.abs(shown - pixels).mean() < 0.2
            for colour in ("#ffffff", SAFE, OBSTACLE):
                fill = (pixels == tuple(bytes.fromhex(colour[1:]))).all(axis=2)
                assert fill.any()
                assert (shown[fill] == pixels[fill]).all()


def test_long_rollouts_keep_first_last_and_losses(paper: tuple[Trace, Plan, World]) -> None:
    trace, _, _ = paper
    losses = set(trace.events[trace.events[:, 2] == EventKind.HIT, 0].tolist())
    assert losses
    for most in (12, 50, 10_000):
        steps = shown_steps(trace, most)
        assert steps == sorted(set(steps))
        assert len(steps) == min(most, trace.time + 1)
        assert {0, trace.time} | losses <= set(steps)
        times = durations(trace, steps)
        assert times[-1] == animation.AT_END
        assert all(ms % 10 == 0 and ms >= animation.FASTEST for ms in times)
    assert shown_steps(trace, 2) == [0, trace.time]
    with pytest.raises(UsageError, match="1 frames"):
        animation_gif(paper[0], stage(*paper[1:]), most_frames=1)


@pytest.mark.parametrize("shape", [(1, 1), (1, 60), (40, 2), pytest.param((7, 30), marks=pytest.mark.slow), (120, 130)])
def test_every_shape_of_map_has_its_place(shape: tuple[int, int]) -> None:
    boxes = boxes_for(shape)
    for left, bottom, width, height in boxes.axes:
        assert left > 0 and bottom > 0 and width > 0 and height > 0
        assert left + width <= boxes.size[0]
        assert bottom + height < boxes.size[1]
    cells = [box[2] / shape[1] - box[3] / shape[0] for box in boxes.axes[:2]]
    assert cells == pytest.approx([0, 0])
    trace, plan, world = rollout(World.create(np.zeros(shape)), [[0, 0]])
    assert opened(picture_png(trace, stage(plan, world), 0)).size[0] in (1200, 1800)


def test_row_0_is_at_the_top() -> None:
    trace, plan, world = small()
    with house_style():
        picture = RolloutPicture(trace, stage(plan, world), 100)
        image = picture.pixels()
    left, bottom, width, height = (100 * length for length in boxes_for(world.shape).axes[0])
    cell = width / world.shape[1]
    row = round(len(image) - bottom - height + cell / 2)
    assert tuple(image[row, round(left + width - cell / 2)]) == tuple(bytes.fromhex(OBSTACLE[1:]))


def test_it_only_moves_on() -> None:
    trace, plan, world = small()
    with house_style():
        picture = RolloutPicture(trace, stage(plan, world), 50)
        picture.show(trace.time)
        with pytest.raises(ValueError, match="step"):
            picture.show(trace.time + 1)


def test_plans_without_areas_and_many_robots() -> None:
    trace, plan, world = small(robots=60)
    none = Trace(
        trace.rollout,
        trace.cells,
        trace.doing,
        np.full_like(trace.areas, -1),
        trace.events[trace.events[:, 2] == EventKind.HIT],
        np.full_like(trace.area_of, -1),
        trace.outcome,
    )
    assert picture_png(none, stage(foreign_plan(world, plan), world, "open")) != picture_png(trace, stage(plan, world))


def test_events_in_words() -> None:
    world = World.create(np.full((4, 10), 0.05))

    def said(*event: int) -> tuple[str, str]:
        line = event_line(np.array(event), world)
        return line.short, line.text

    lost = "robot 3 is lost at [2, 5]"
    assert said(12, 3, EventKind.HIT, 7, 25) == (lost, f"{lost}, threat 5 %; its area was 7")
    assert said(12, 3, EventKind.HIT, -1, 25) == (lost, f"{lost}, threat 5 %")
    assert said(12, 3, EventKind.REALLOCATED, 7, 1)[0] == "area 7 is free again, in 1 part"
    assert said(12, 3, EventKind.SHARED, 7, 2)[0] == "robot 3 shares area 7, in 2 parts"
    for kind in EventKind:
        assert len(said(9_999, 99, kind, 999, 12)[0]) <= 38, "more than there is room for"
