"""The viewer layout: valid, deterministic, naming only topics that are recorded, and showing all of the map."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.recording.viewers.topics import MOST_STATES, Stats, layout_json, topic_types, write_layout
from planner.errors import MapError
from planner.world.world import World

WORLD = World.create([[0.0, 0.1, np.nan], [0.0, 0.0, 0.3]], cell_size=2.0, origin=(10.0, -5.0, 0.4))


def strings(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [text for key, inner in value.items() for text in [key, *strings(inner)]]
    if isinstance(value, list):
        return [text for inner in value for text in strings(inner)]
    return [value] if isinstance(value, str) else []


def test_every_topic_that_it_names_is_recorded() -> None:
    named = [text for text in strings(json.loads(layout_json(WORLD, 3))) if re.match(r"/[a-z]", text)]
    recorded = topic_types()
    topics = {re.split(r"[.\[]", text)[0] for text in named}
    assert topics <= set(recorded), topics - set(recorded)
    assert {"/map/threat", "/map/obstacles", "/areas", "/robots/markers", "/driven", "/stats", "/events"} <= topics


def test_every_field_that_it_plots_is_in_the_message() -> None:
    fields = set(Stats.DESCRIPTOR.fields_by_name)
    plotted = [text for text in strings(json.loads(layout_json(WORLD, 3))) if text.startswith("/stats.")]
    assert {re.split(r"[.\[]", text)[1] for text in plotted} <= fields
    assert [text for text in plotted if "doing" in text] == [f"/stats.doing[{robot}]" for robot in range(3)]


def test_nothing_is_left_open() -> None:
    assert "null" not in layout_json(WORLD, 3)


def test_every_panel_is_placed_once_and_configured() -> None:
    layout = json.loads(layout_json(WORLD, 3))
    placed = [text for text in strings(layout["layout"]) if "!" in text]
    assert sorted(placed) == sorted(layout["configById"])
    assert len(set(placed)) == len(placed)


@pytest.mark.parametrize("shape", [(3, 40), (40, 3), (1, 1)])
def test_the_map_is_in_view_whichever_way_it_is_turned(shape: tuple[int, int]) -> None:
    world = World.create(np.zeros(shape), cell_size=0.5, origin=(100.0, 7.0, 1.2))
    camera = json.loads(layout_json(world, 1))["configById"]["3D!threat"]["cameraState"]
    corners = world.to_xy(np.arange(shape[0] * shape[1]))
    offset = np.abs(corners - camera["targetOffset"][:2]).max()
    assert offset < camera["distance"] / 2 < 3 * (offset + 0.5)
    assert camera["near"] < camera["distance"] < camera["far"]


def test_the_scale_of_threats_ends_at_the_largest() -> None:
    threat = json.loads(layout_json(WORLD, 1))["configById"]["3D!threat"]["topics"]["/map/threat"]
    assert threat["maxValue"] == pytest.approx(0.3)
    safe = World.create(np.zeros((2, 2)))
    assert json.loads(layout_json(safe, 1))["configById"]["3D!threat"]["topics"]["/map/threat"]["maxValue"] > 0


def test_many_robots_get_a_panel_of_bounded_size() -> None:
    panel = json.loads(layout_json(WORLD, 500))["configById"]["StateTransitions!doing"]
    assert len(panel["paths"]) == MOST_STATES


def test_same_input_same_bytes_and_written_whole(tmp_path: Path) -> None:
    write_layout(tmp_path / "a.layout.json", WORLD, 4)
    assert (tmp_path / "a.layout.json").read_text() == layout_json(WORLD, 4)
    assert [path.name for path in tmp_path.iterdir()] == ["a.layout.json"]
    with pytest.raises(MapError):
        write_layout(tmp_path / "none" / "a.json", WORLD, 4)
