"""Map files of every kind, maps in logs, other planners' instances."""

import json
import math
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType, Writer
from PIL import Image
from rosbags.typesys import Stores, get_typestore

import mrac_jax as mrac
from analysis.recording.container import recover
from analysis.recording.replay import inspect
from planner.errors import InputError, MapError, ScenarioError, WorldError
from planner.plan.state_file import read_state
from planner.world.frame import Frame
from planner.world.grid import FREE, OCCUPIED, UNKNOWN, Grid, coarsen
from planner.world.image_files import read_ros_map
from planner.world.map_files import load_map, read_movingai
from planner.world.scenario import load_input
from planner.world.world import World

# Maps of every kind: nav2's rules, MovingAI, pictures, and coarsening to cells, all on maps that are not square.

GREYS = np.array([[0, 89, 90, 127, 205], [191, 192, 254, 255, 100]], dtype=np.uint8)


def ros(folder: Path, picture: np.ndarray = GREYS, drop: str = "", **changes: object) -> Path:
    """A map_server map in `folder`; `changes` replace keys of its YAML file, `drop` leaves one out."""
    Image.fromarray(picture).save(folder / "m.png")
    keys = {"image": "m.png", "resolution": 0.05, "origin": [0.0, 0.0, 0.0], "negate": 0}
    keys |= {"occupied_thresh": 0.65, "free_thresh": 0.25} | changes
    path = folder / "m.yaml"
    path.write_text("".join(f"{name}: {value}\n" for name, value in keys.items() if name != drop))
    return path


def test_trinary_is_the_default_and_follows_the_thresholds(tmp_path: Path) -> None:
    values = read_ros_map(ros(tmp_path)).occupancy
    p = (255 - GREYS.astype(float)) / 255
    assert values.tolist() == np.where(p >= 0.65, 100, np.where(p <= 0.25, 0, -1)).tolist()
    assert values.tolist() == [[100, 100, -1, -1, 0], [-1, 0, 0, 0, -1]]


def test_scale_fills_in_between_the_thresholds(tmp_path: Path) -> None:
    values = read_ros_map(ros(tmp_path, mode="scale")).occupancy
    expected = [[round(100 * min(1, max(0, ((255 - g) / 255 - 0.25) / 0.4))) for g in row] for row in GREYS.tolist()]
    assert values.tolist() == expected
    assert values.tolist() == [[100, 100, 99, 63, 0], [0, 0, 0, 0, 89]]


def test_a_scale_map_as_the_map_says_what_it_is_meant_for(tmp_path: Path) -> None:
    said = "its `mode:` is meant for threats (`layer:` in a scenario): as a map, its 3 pixels between free and occupied"
    assert any(note.startswith(said) for note in load_input(ros(tmp_path, mode="scale")).notes)
    assert not any("layer" in note for note in load_input(ros(tmp_path)).notes)


def test_coloured_pixels_are_named_with_what_they_became(tmp_path: Path) -> None:
    """Red and blue have a third of white's brightness, yellow two thirds; JPEG's tints of grey are no colours."""
    picture = np.full((4, 6, 3), 255, dtype=np.uint8)
    picture[0, :2], picture[1, 0], picture[2, :3], picture[3, 0] = (255, 0, 0), (0, 0, 255), (255, 255, 0), 0
    picture[3, 1] = (250, 240, 235)
    Image.fromarray(picture).save(tmp_path / "m.png")
    found = load_input(tmp_path / "m.png")
    said = "coloured pixels are read by their brightness only: 3 as obstacle, 3 as unknown;"
    assert found.notes[0] == f"{said} threats belong in a scenario"
    assert any(note.startswith("coloured pixels") for note in load_input(ros(tmp_path, picture)).notes)
    picture[..., 1:] = picture[..., :1]
    Image.fromarray(picture).save(tmp_path / "m.png")
    assert not any("coloured" in note for note in load_input(tmp_path / "m.png").notes)


def test_raw_bytes_are_the_values_and_above_100_is_unknown(tmp_path: Path) -> None:
    image = np.array([[0, 1, 99], [100, 101, 255]], dtype=np.uint8)
    values = read_ros_map(ros(tmp_path, image, mode="raw", negate=1)).occupancy
    assert values.tolist() == [[0, 1, 99], [100, -1, -1]]


def test_negate_swaps_black_and_white(tmp_path: Path) -> None:
    straight = read_ros_map(ros(tmp_path)).occupancy
    mirrored = read_ros_map(ros(tmp_path, 255 - GREYS, negate=1)).occupancy
    assert straight.tolist() == mirrored.tolist()


def alpha_image() -> np.ndarray:
    """Black and white by rows, of alpha 255, 254, 128 and 0 by columns."""
    image = np.zeros((2, 4, 4), dtype=np.uint8)
    image[1, :, :3] = 255
    image[..., 3] = [255, 254, 128, 0]
    return image


def test_trinary_averages_alpha_into_the_brightness(tmp_path: Path) -> None:
    """map_server's arithmetic: the mean of red, green, blue and alpha; black of alpha 255 has p = 0.75."""
    read = read_ros_map(ros(tmp_path, alpha_image(), free_thresh=0.196))
    assert read.occupancy.tolist() == [[100, 100, 100, 100], [0, 0, 0, -1]]
    assert read.notes == (
        "mode: trinary averages alpha into the brightness, as map_server does: 1 pixel unknown by it",
    )
    nearly = np.dstack([np.full((3, 4), 254, np.uint8)] * 4)
    assert load_input(ros(tmp_path, nearly, free_thresh=0.196)).free.all()
    grey = np.dstack([np.full((3, 4), 205, np.uint8)] * 3 + [np.full((3, 4), 255, np.uint8)])
    notes = load_input(ros(tmp_path, grey, free_thresh=0.196)).notes
    assert notes[0].endswith("12 pixels free by it")
    assert "with `free_thresh: 0.147`" in notes[1]


def test_scale_takes_what_is_not_opaque_for_unknown_and_raw_takes_no_notice(tmp_path: Path) -> None:
    read = read_ros_map(ros(tmp_path, alpha_image(), mode="scale"))
    assert read.occupancy.tolist() == [[100, -1, -1, -1], [0, -1, -1, -1]]
    assert "mode: scale reads pixels that are not fully opaque as unknown" in read.notes[0]
    assert read_ros_map(ros(tmp_path, alpha_image() // 3, mode="raw")).occupancy.tolist() == [[0] * 4, [85] * 4]


def test_where_transparency_leaves_no_free_cell_the_error_says_so(tmp_path: Path) -> None:
    nearly = np.dstack([np.full((3, 4), 254, np.uint8)] * 4)
    with pytest.raises(WorldError, match=r"every cell is an obstacle; mode: scale reads pixels .* 12 pixels unk"):
        load_input(ros(tmp_path, nearly, mode="scale"))


def test_a_bare_picture_reads_alpha_as_trinary_and_hides_what_is_transparent(tmp_path: Path) -> None:
    Image.fromarray(alpha_image()).save(tmp_path / "a.png")
    grid = load_map(tmp_path / "a.png")
    assert grid.occupancy.tolist() == [[OCCUPIED] * 3 + [UNKNOWN], [FREE] * 3 + [UNKNOWN]]
    assert "2 pixels fully transparent: unknown" in grid.notes


@pytest.mark.parametrize("negate", [0, 1])
def test_greys_of_unknown_ground_that_the_thresholds_make_free_are_counted(tmp_path: Path, negate: int) -> None:
    grey = np.full((4, 6), 254, np.uint8)
    grey[1, 2], grey[2] = 0, 205
    grey = 255 - grey if negate else grey
    world = load_input(ros(tmp_path, grey, negate=negate, free_thresh=0.25))
    assert int(world.free.sum()) == 23
    shown = 50 if negate else 205
    assert world.notes[0] == (
        f"grey {shown}, which map_saver writes for unknown ground, is free in 6 pixels; with `free_thresh: 0.196` in a "
        "map_server YAML file it is unknown"
    )
    told = load_input(ros(tmp_path, grey, negate=negate, free_thresh=0.196))
    assert told.notes[0] == "6 unknown pixels count as obstacles" and int(told.free.sum()) == 17


def test_greys_of_unknown_ground_elsewhere(tmp_path: Path) -> None:
    """Of a bare picture, of another program, and as obstacles."""
    Image.fromarray(np.array([[0, 205, 254]], dtype=np.uint8)).save(tmp_path / "bare.pgm")
    note = load_input(tmp_path / "bare.pgm").notes[0]
    assert "grey 205, which map_saver writes for unknown ground, is free in 1 pixel;" in note
    other = np.array([[0, 128, 128, 255]], dtype=np.uint8)
    notes = load_input(ros(tmp_path, other, free_thresh=0.5)).notes
    assert notes[0].startswith(
        "grey 128, which cartographer writes for unknown ground, is free in 2 pixels; with `free"
    )
    assert read_ros_map(ros(tmp_path, other, free_thresh=0.498)).occupancy.tolist() == [[100, -1, -1, 0]]
    notes = load_input(ros(tmp_path, other, free_thresh=0.1, occupied_thresh=0.4)).notes
    assert "is an obstacle in 2 pixels; with `occupied_thresh: 0.65`" in notes[0]
    assert not read_ros_map(ros(tmp_path, other, free_thresh=0.5, mode="raw")).notes


@pytest.mark.parametrize(("grey", "free", "fix"), [(205, 0.25, "0.196"), (128, 0.5, "0.498")])
def test_greys_of_unknown_ground_in_a_scale_map(tmp_path: Path, grey: int, free: float, fix: str) -> None:
    """As in a trinary one, which it has to become for them to be unknown."""
    image = np.array([[0, 255] + [grey] * 6], dtype=np.uint8)
    (note,) = (one for one in load_input(ros(tmp_path, image, free_thresh=free, mode="scale")).notes if "mode" in one)
    assert note.startswith(f"grey {grey}, which ") and "is free in 6 pixels" in note
    assert f"with `mode: trinary` and `free_thresh: {fix}`" in note
    assert (read_ros_map(ros(tmp_path, image, free_thresh=float(fix))).occupancy == -1).sum() == 6


def test_colour_counts_by_its_mean_and_16_bits_as_well(tmp_path: Path) -> None:
    colour = np.zeros((1, 2, 3), dtype=np.uint8)
    colour[0, 1] = [255, 255, 100]
    assert read_ros_map(ros(tmp_path, colour)).occupancy.tolist() == [[100, 0]]
    deep = np.array([[0, 65535, 50000]], dtype=np.uint16)
    assert read_ros_map(ros(tmp_path, deep)).occupancy.tolist() == [[100, 0, 0]]


def test_row_0_is_the_top_of_the_picture_and_the_highest_y(tmp_path: Path) -> None:
    image = np.full((3, 5), 255, dtype=np.uint8)
    image[0, 4] = 0
    world = load_input(ros(tmp_path, image, origin="[10.0, -2.0, 0.0]"))
    assert world.shape == (3, 5)
    assert np.argwhere(~world.free).tolist() == [[0, 4]]
    assert world.to_xy(4).tolist() == pytest.approx([10 + 4.5 * 0.05, -2 + 2.5 * 0.05])
    assert world.to_cells([10.01, -1.99]).tolist() == [2, 0]


WRONG_KEYS = [
    ({"drop": "free_thresh", "occupied_thresh": 0.1}, "from 0 to below occupied_thresh (0.1)"),
    *(({"drop": name}, f"key `{name}` is missing") for name in ("occupied_thresh", "resolution", "origin")),
    ({"drop": "image"}, "neither"),
    ({"drop": "occupied_thresh", "occupied_tresh": 0.65}, "did you mean it by 'occupied_tresh'?"),
    ({"image": "gone.png"}, "gone.png"),
    *(({"resolution": n}, "`resolution` is ") for n in (0, -0.05, ".nan", "true", 1e300, "1.0e-320", "1:30")),
    *(({"origin": at}, "`origin") for at in ("[0, 0]", "[0, .inf, 0]", [1e308, 0, 0], [0, -1e17, 0])),
    ({"free_thresh": 0.7}, "free_thresh"),
    ({"occupied_thresh": 1.5}, "occupied_thresh"),
    ({"mode": "trinery"}, "did you mean 'trinary'"),
    ({"negate": "perhaps"}, "negate"),
]


@pytest.mark.parametrize(("changes", "names"), WRONG_KEYS)
def test_a_wrong_ros_map_names_the_key(tmp_path: Path, changes: dict, names: str) -> None:
    with pytest.raises(InputError) as caught:
        load_input(ros(tmp_path, **changes))
    assert names in str(caught.value)
    assert str(tmp_path / "m.yaml") in str(caught.value)


def test_a_ros_map_without_free_thresh_has_the_usual_one(tmp_path: Path) -> None:
    """0.196: of the greys 204.. (p = 0.2) is unknown with it, and free at 0.25."""
    greys = np.array([[0, 204, 206, 255]], dtype=np.uint8)
    read = read_ros_map(ros(tmp_path, greys, drop="free_thresh"))
    assert read.occupancy.tolist() == [[100, -1, 0, 0]]
    assert "names no free_thresh: 0.196 is used, as map_saver writes it" in read.notes
    assert not any("free_thresh" in note for note in read_ros_map(ros(tmp_path, greys)).notes)


def size_note(world: World) -> str:
    return " ".join(note for note in world.notes if "footprint" in note)


def test_pixels_smaller_than_robots_are_told(tmp_path: Path) -> None:
    """Whatever the way in, where nobody said how large a cell is: a map, a world file, a scenario."""
    path = ros(tmp_path, np.full((20, 20), 255, dtype=np.uint8))
    world = load_input(path)
    assert size_note(world) == (
        "20 x 20 = 400 cells: a cell is a pixel of 0.05 m, so a robot is 0.05 m wide; give its footprint, usually "
        "cell_size=0.5 (4 cells)"
    )
    world.save(tmp_path / "w.npz")
    assert size_note(load_input(tmp_path / "w.npz")) == size_note(world)
    for form in ("map: {}\n", "map: {{file: {}}}\nrobots: {{count: 2}}\n"):
        for name in ("m.yaml", "w.npz"):
            (tmp_path / "s.yaml").write_text(form.format(name))
            assert size_note(load_input(tmp_path / "s.yaml")) == size_note(world).replace(
                "cell_size=0.5", "`cell_size: 0.5` in the scenario"
            )
    (tmp_path / "s.yaml").write_text("map: m.yaml\ncell_size: 0.5\n")
    for quiet in (load_input(path, 0.5), load_input(tmp_path / "w.npz", 0.5), load_input(tmp_path / "s.yaml")):
        assert quiet.shape == (2, 2) and not size_note(quiet)


def test_many_cells_are_told_with_the_robot_that_they_mean(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The cell size that is suggested is a whole number of pixels, and is taken."""
    np.save(tmp_path / "large.npy", np.zeros((101, 100)))
    assert size_note(load_input(tmp_path / "large.npy")) == (
        "101 x 100 = 10,100 cells: a cell is a pixel of 1 m (presumed), so a robot is 1 m wide; give its footprint, "
        "cell_size=2.0 (2,500 cells)"
    )
    assert load_input(tmp_path / "large.npy", 2.0).shape == (50, 50)
    np.save(tmp_path / "enough.npy", np.zeros((100, 100)))
    assert not size_note(load_input(tmp_path / "enough.npy"))
    mrac.load(tmp_path / "large.npy")
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'large.npy'}: 101 x 100 = 10,100 cells: a cell is a pixel")
    (tmp_path / "large.yaml").write_text("map: large.npy\n")
    mrac.load(tmp_path / "large.yaml")
    assert "`cell_size: 2` in the scenario (2,500 cells)" in capsys.readouterr().err
    mrac.load(tmp_path / "large.npy", cell_size=2.0)
    mrac.load(tmp_path / "enough.npy")
    assert not capsys.readouterr().err
    fine = load_input(ros(tmp_path, np.full((120, 90), 255, dtype=np.uint8), resolution=0.03))
    assert "usually cell_size=0.51 (35 cells)" in size_note(fine)
    assert load_input(tmp_path / "m.yaml", 0.51).shape == (7, 5)


BROKEN_MAPS = [
    ("type octile\nheight 3\nwidth 5\nmap\n.....\n.....\n", "2 rows"),
    ("type octile\nheight 1\nwidth 5\nmap\n.....\n.....\n", "2 rows"),
    ("type octile\nheight 2\nwidth 5\nmap\n.....\n....\n", "line 6 has 4"),
    ("type octile\nheight 2\nwidth 5\nmap\n......\n.....\n", "line 5 has 6"),
    ("type octile\nheight 2\nwidth 0\nmap\n\n\n", "width 0"),
    ("type octile\nheight -2\nwidth 3\nmap\n...\n...\n", "height -2"),
    ("type octile\nheight nan\nwidth 3\nmap\n...\n", "nan"),
    ("type octile\nwidth 3\nmap\n...\n", "no header with height, width"),
    ("something else\n", "header"),
    ("", "header"),
    ("type octile-corner\nheight 1\nwidth 1\nmap\n..\n..\n", "line 1: 'type octile-corner'"),
    ("\nheight 1000000000\nmap\n", "line 2: 'height 1000000000'; expected one line `height N`"),
    ("height 999999999\nwidth 3\nmap\n...\n", "bytes claim 999999999 x 3 cells"),
    ("height " + "9" * 5000 + "\nmap\n", "whole numbers from 1"),
    ("height 2\nheight 2\nwidth 3\nmap\n...\n...\n", "line 2: 'height 2'; expected one line"),
]


@pytest.mark.parametrize(("text", "names"), BROKEN_MAPS)
def test_broken_movingai_maps(tmp_path: Path, text: str, names: str) -> None:
    (tmp_path / "a.map").write_text(text)
    with pytest.raises(MapError) as caught:
        load_map(tmp_path / "a.map")
    assert names in str(caught.value) and "b'" not in str(caught.value)


def test_a_picture_is_read_with_the_usual_thresholds(tmp_path: Path) -> None:
    Image.fromarray(GREYS).save(tmp_path / "p.pgm")
    grid = load_map(tmp_path / "p.pgm")
    assert grid.occupancy.tolist() == [
        [OCCUPIED, OCCUPIED, UNKNOWN, UNKNOWN, FREE],
        [UNKNOWN, FREE, FREE, FREE, UNKNOWN],
    ]
    assert grid.frame == Frame((2, 5), 1.0)
    assert "4 unknown pixels count as obstacles" in load_input(tmp_path / "p.pgm").notes


def huge_png(side: int) -> bytes:
    """A PNG of a few bytes whose header claims side x side pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b"")
    )


def npy_header(shape: tuple[int, ...]) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def npz(member: bytes) -> bytes:
    import io
    import zipfile

    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("threat.npy", member)
    return out.getvalue()


HUGE_CLAIMS = [
    ("a.map", b"type octile\nheight 90000\nwidth 90000\nmap\n....\n"),
    ("a.map", b"type octile\nheight 999999999999\nwidth 9\nmap\n....\n"),
    ("a.pgm", b"P5 8000 8000 255\n" + bytes(10)), ("a.pgm", b"P5 100000 100000 255\n" + bytes(10)),
    ("a.ppm", b"P2 8000 8000 255\n1 2 3\n"), ("a.png", huge_png(8000)), ("a.png", huge_png(100000)),
    ("a.npy", npy_header((8000, 8000)) + bytes(8)), ("a.npy", npy_header((10**9, 10**9)) + bytes(8)),
    ("a.npz", npz(npy_header((8000, 8000)) + bytes(8))), ("a.npz", npz(npy_header((10**9, 10**9)) + bytes(8))),
]  # fmt: skip


@pytest.mark.parametrize(("name", "data"), HUGE_CLAIMS)
def test_a_tiny_file_that_claims_to_be_huge_takes_no_memory(tmp_path: Path, name: str, data: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(MapError) as caught:
            load_input(path)
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.png", "a.npz", "a.npy", "a.map", "a.gif"])
def test_files_that_are_something_else(tmp_path: Path, name: str) -> None:
    for data in (b"", b"\xff" * 50, b"hello\n"):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(MapError, match=name):
            load_input(tmp_path / name)


def test_missing_unknown_and_folder(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"none\.map: no such file"):
        load_input(tmp_path / "none.map")
    with pytest.raises(MapError, match="is a folder"):
        load_input(tmp_path)
    (tmp_path / "a.docx").write_text("x")
    with pytest.raises(MapError, match=r"unknown map format '\.docx'"):
        load_input(tmp_path / "a.docx")


def random_grid(height: int, width: int, yaw: float = 0.0) -> Grid:
    state = np.random.default_rng(5).choice([FREE, OCCUPIED, UNKNOWN], (height, width), p=[0.9, 0.05, 0.05])
    return Grid(state, Frame((height, width), 0.05, (3.0, 4.0, yaw)), "grid")


@pytest.mark.parametrize("unknown_free", [False, True])
def test_coarsening_is_conservative_block_by_block(unknown_free: bool) -> None:
    grid = random_grid(14, 23)
    ground = coarsen(grid, 0.15, unknown_free)
    threat = np.random.default_rng(6).random((14, 23))
    largest = ground.largest(threat)
    assert ground.frame.shape == (4, 7)
    for row in range(4):
        for col in range(7):
            block = (slice(3 * row, 3 * row + 3), slice(3 * col, 3 * col + 3))
            free = (grid.occupancy[block] == FREE) | (unknown_free & (grid.occupancy[block] == UNKNOWN))
            assert ground.free[row, col] == free.all()
            assert largest[row, col] == threat[block][free].max()
    assert any("last 2 of 14 pixel rows and 2 of 23 pixel columns" in note for note in ground.notes)


def test_dropped_rows_move_the_origin_up_along_the_yawed_axis() -> None:
    yaw = math.radians(30)
    grid = random_grid(14, 23, yaw)
    ground = coarsen(grid, 0.15)
    assert ground.frame.origin == pytest.approx((3 - math.sin(yaw) * 0.1, 4 + math.cos(yaw) * 0.1, yaw))
    centre_of_block = grid.frame.centres()[3:6, 6:9].mean(axis=(0, 1))
    assert ground.frame.centres()[1, 2] == pytest.approx(centre_of_block)
    assert ground.frame.pixels(centre_of_block).tolist() == [1, 2]


@pytest.mark.parametrize("cell_size", [0.15, 0.05, 0.15000000001, 0.1 + 0.2])
def test_whole_ratios_pass_in_spite_of_rounding(cell_size: float) -> None:
    assert coarsen(random_grid(14, 23), cell_size).ratio == round(cell_size / 0.05)


WRONG_SIZES = [
    ((0.12, 0.1501), "pixels of 0.05 m; expected a whole number"),
    ((1e12, math.inf), "pixels of 0.05 m; expected a whole number"),
    ((0.03, 1e-9, 0.0499), r"maps are only coarsened; for example cell_size: 0\.05"),
    ((1.0,), "hold no cell of 1 m"),
]


@pytest.mark.parametrize(("sizes", "words"), WRONG_SIZES)
def test_sizes_of_cells_that_cannot_be(sizes: tuple[float, ...], words: str) -> None:
    for cell_size in sizes:
        with pytest.raises(MapError, match=words):
            coarsen(random_grid(14, 23), cell_size)


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_movingai(tmp_path: Path, ending: str, mark: bytes) -> None:
    """Characters, ends of lines, and a byte order mark."""
    path = tmp_path / "a.map"
    path.write_bytes(mark + ending.join(["type octile", "height 2", "width 5", "map", ".GS@T", "OW...", ""]).encode())
    assert read_movingai(path).occupancy.tolist() == [[FREE] * 3 + [OCCUPIED] * 2, [OCCUPIED] * 2 + [FREE] * 3]
    assert load_input(path).cell_size == 1.0


@pytest.mark.parametrize("shape", [(2**40, 2**40), (2**62, 4), (2**62, 4, 0), (-1, 3), (0, 2**62)])
@pytest.mark.parametrize("descr", ["<f4", "|V0"])
def test_headers_that_claim_the_world(tmp_path: Path, shape: tuple[int, ...], descr: str) -> None:
    data = npy_header(shape).replace(b"'<f4'", f"'{descr}'".encode()) + bytes(8)
    (tmp_path / "a.npy").write_bytes(data)
    (tmp_path / "a.npz").write_bytes(npz(data))
    for name in ("a.npy", "a.npz"):
        with pytest.raises(MapError, match=name):
            load_map(tmp_path / name)


@pytest.mark.parametrize("name", ["a.png", "b.png", "a.pgm", "a.ppm", "a.bmp", "a.gif", "a.jpg"])
@pytest.mark.parametrize("damage", [20, 5])
def test_truncated_pictures_are_refused(tmp_path: Path, name: str, damage: int) -> None:
    grey = np.random.default_rng(0).integers(0, 256, (30, 41)).astype(np.uint8)
    picture = np.dstack([grey] * 3) if name == "a.ppm" else grey.astype(np.uint16) * 257 if name == "b.png" else grey
    path = tmp_path / name
    Image.fromarray(picture).save(path)
    assert load_map(path).occupancy.shape == grey.shape
    data = path.read_bytes()
    path.write_bytes(data[:-damage])
    with pytest.raises(MapError, match=name):
        load_map(path)
    if path.suffix == ".png":
        path.write_bytes(data[:-damage] + bytes(damage))
        with pytest.raises(MapError, match=name):
            load_map(path)


# Maps in ROS 2 logs, written by rosbags and by the mcap library; damaged and hostile ones.

STORE = get_typestore(Stores.ROS2_HUMBLE)
KIND = "nav_msgs/msg/OccupancyGrid"


def grid(
    values: np.ndarray,
    frame: str = "map",
    turn: tuple[float, ...] = (0, 0, 0.5**0.5, 0.5**0.5),
    corner: tuple[float, float] = (-1.5, 2.0),
    size: float = 0.05,
) -> bytes:
    """A serialised OccupancyGrid, its first row at the bottom."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](1, 2)
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*corner, 0.0), types["geometry_msgs/msg/Quaternion"](*map(float, turn))
    )
    height, width = values.shape
    info = types["nav_msgs/msg/MapMetaData"](stamp, np.float32(size), width, height, pose)
    header = types["std_msgs/msg/Header"](stamp, frame)
    return bytes(STORE.serialize_cdr(types[KIND](header, info, values.astype(np.int8).ravel()), KIND))


def log(path: Path, *messages: tuple[Any, ...], kind: str = KIND, encoding: str = "cdr", **options: Any) -> Path:
    """A log of messages (topic, data), or (log time, topic, data), in the order of the file."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        schema = writer.register_schema(kind, "ros2msg", b"")
        channels = {topic: writer.register_channel(topic, encoding, schema) for *_, topic, _ in messages}
        for number, (*given, topic, data) in enumerate(messages):
            (time,) = given or [number]
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_map_in_a_chunk_of_any_compression(tmp_path: Path, compression: CompressionType) -> None:
    path = log(tmp_path / "a.mcap", ("/map", grid(np.zeros((30, 40)))), compression=compression)
    assert load_input(path).free.all()


@pytest.mark.parametrize("frame", ["", "m", "map", "odom", "a_map"])
def test_the_last_map_of_a_log(tmp_path: Path, frame: str) -> None:
    """Strings of all lengths: what follows them is aligned. Row 0 of a message is at the bottom."""
    values = np.array([[0, 25, 26], [-1, 64, 65], [100, 0, 0], [0, 0, 0]])
    path = log(
        tmp_path / "a.mcap", ("/map", grid(np.full((2, 2), 100))), ("/map", grid(values, frame)), ("/local", b"")
    )
    world = load_input(path)
    assert world.free[::-1].tolist() == [[True, True, False], [False] * 3, [False, True, True], [True] * 3]
    assert world.cell_size == 0.05 and world.origin == pytest.approx((-1.5, 2.0, np.pi / 2))


def test_logs_that_are_refused(tmp_path: Path) -> None:
    whole = grid(np.zeros((3, 4)))
    for messages, words in (
        (
            [("/a", whole), ("/b", whole)],
            r"holds several maps: /a \(nav_msgs/msg/OccupancyGrid\), /b \(nav_.*\); expected one, or /map among them; "
            r"choose one in a scenario: `map: {file: ..., topic: ...}`",
        ),
        ([("/map", whole[:-1])], "cut short"),
        ([("/map", whole[:40])], "cut short"),
        ([("/map", b"")], "cut short"),
        ([("/map", whole[:28] + struct.pack("<II", 2**31, 2**31) + whole[36:])], "its map"),
        ([("/map", grid(np.zeros((3, 4)), turn=(0.5, 0.5, 0.5, 0.5)))], "tilted"),
    ):
        with pytest.raises(MapError, match=words) as caught:
            load_input(log(tmp_path / "a.mcap", *messages))
        assert "a.mcap" in str(caught.value)
    for kind, encoding in (("nav_msgs/msg/Path", "cdr"), (KIND, "json")):
        with pytest.raises(MapError, match=f"holds no map, but /map .{kind}.*expected messages nav_"):
            load_input(log(tmp_path / "a.mcap", ("/map", whole), kind=kind, encoding=encoding))
    data = log(tmp_path / "a.mcap", ("/map", whole)).read_bytes()
    rng = np.random.default_rng(3)
    for size in (0, 7, 8, 40, len(data) // 2, len(data) - 9):
        (tmp_path / "a.mcap").write_bytes(data[:size])
        words = (
            r"is empty|is not an MCAP file"
            if size < 8
            else r"truncated.*try `mrac-jax inspect --repair OUT .*/a\.mcap`"
        )
        with pytest.raises(MapError, match=words):
            load_input(tmp_path / "a.mcap")
    for _ in range(60):  # damage anywhere: an error in one line, or a map
        damaged = bytearray(data)
        damaged[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        (tmp_path / "a.mcap").write_bytes(bytes(damaged))
        try:
            assert load_input(tmp_path / "a.mcap").shape == (3, 4)
        except MapError as error:
            assert "a.mcap" in str(error)


FIRST, LAST = np.zeros((3, 4)), np.zeros((3, 4))
FIRST[0, 0] = LAST[2, 3] = 100  # the bottom left, the top right


def timed(path: Path, *messages: tuple[int, str, np.ndarray], **options: Any) -> Path:
    """A log of grids: (log time, topic, values), in the order of the file."""
    grids = [(time, topic, grid(values, turn=(0, 0, 0, 1))) for time, topic, values in messages]
    return log(path, *grids, **options)


def obstacle(world: World) -> list[list[int]]:
    return np.argwhere(~world.free).tolist()


@pytest.mark.parametrize("chunk", [1, 2**20])
def test_the_latest_map_is_the_latest_by_log_time(tmp_path: Path, chunk: int) -> None:
    """In one chunk or in one each; of equal times the one that comes later in the file."""
    path = tmp_path / "a.mcap"
    assert obstacle(load_input(timed(path, (200, "/map", LAST), (100, "/map", FIRST), chunk_size=chunk))) == [[0, 3]]
    assert obstacle(load_input(timed(path, (100, "/map", LAST), (200, "/map", FIRST), chunk_size=chunk))) == [[2, 0]]
    assert obstacle(load_input(timed(path, (0, "/map", FIRST), (0, "/map", LAST), chunk_size=chunk))) == [[0, 3]]
    assert obstacle(load_input(timed(path, (0, "/map", LAST), (0, "/map", FIRST), use_chunking=False))) == [[2, 0]]


def test_a_topic_of_several_is_chosen_in_a_scenario(tmp_path: Path) -> None:
    timed(tmp_path / "a.mcap", (1, "/map", FIRST), (2, "/costmap", LAST))
    world = load_input(tmp_path / "a.mcap")
    assert obstacle(world) == [[2, 0]]
    assert world.notes[0] == (
        "/map is used of the maps /costmap (nav_msgs/msg/OccupancyGrid), /map (nav_msgs/msg/OccupancyGrid); choose "
        "one in a scenario: `map: {file: ..., topic: ...}`"
    )
    scenario = tmp_path / "s.yaml"
    for topic, cell in (("/map", [2, 0]), ("/costmap", [0, 3])):
        scenario.write_text(f"map: {{file: a.mcap, topic: {topic}}}\n")
        world = load_input(scenario)
        assert obstacle(world) == [cell] and not any("is used" in note for note in world.notes)
    scenario.write_text("map: {file: a.mcap, topic: /costmaps}\n")
    said = r"a\.mcap: holds no map on /costmaps; expected one of /costmap \(.*mean '/costmap'"
    with pytest.raises(MapError, match=said):
        load_input(scenario)
    np.save(tmp_path / "w.npy", np.zeros((3, 4)))
    scenario.write_text("map: {file: w.npy, topic: /map}\n")
    with pytest.raises(ScenarioError, match=r"`map.topic` is '/map'; expected none: the map is not in a log"):
        load_input(scenario)


def test_a_rosbag2_folder_is_the_logs_in_it(tmp_path: Path) -> None:
    """Split into two files, the latest map in the first by name; as INPUT, in a scenario, and as a state."""
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}\n")
    timed(bag / "bag_0.mcap", (300, "/map", LAST))
    timed(bag / "bag_1.mcap", (200, "/map", FIRST))
    assert obstacle(load_input(bag)) == [[0, 3]]
    (tmp_path / "s.yaml").write_text("map: {file: bag, topic: /map}\n")
    assert obstacle(load_input(tmp_path / "s.yaml")) == [[0, 3]]
    state, _ = read_state(bag, load_input(bag), [[1, 1]])
    assert state.visited.tolist() == [5]  # the start alone: what is occupied is no free cell
    with pytest.raises(InputError, match="it describes a rosbag2: name its folder"):
        load_input(bag / "metadata.yaml")


def test_other_storage_is_named_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "old_0.db3").write_bytes(b"SQLite format 3")
    for path in (tmp_path / "old", tmp_path / "old" / "old_0.db3"):
        said = r"not MCAP: old_0\.db3; expected .*; convert it: `ros2 bag convert -i .*old"
        with pytest.raises(MapError, match=said):
            load_input(path)
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "p_0.mcap.zstd").write_bytes(b"x")
    with pytest.raises(MapError, match=r"unpack it: `unzstd .*/p_0\.mcap\.zstd`"):
        load_input(tmp_path / "packed")
    (tmp_path / "none").mkdir()
    with pytest.raises(MapError, match="is a folder"):
        load_input(tmp_path / "none")


def test_other_storage_beside_mcap_is_not_left_out(tmp_path: Path) -> None:
    """A newer map may be in it; a packed log that lies unpacked beside itself holds nothing more."""
    timed(tmp_path / "x_0.mcap", (100, "/map", LAST))
    for name, fix in (("x_1.mcap.zstd", "unzstd"), ("x_1.db3", "ros2 bag convert"), ("x_0.db3", "ros2 bag convert")):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(MapError, match=rf"not MCAP: {name}; expected .*; .*`{fix}"):
            load_input(tmp_path)
        (tmp_path / name).unlink()
    (tmp_path / "x_0.mcap.zstd").write_bytes(b"x")
    assert obstacle(load_input(tmp_path)) == [[0, 3]]


def test_what_was_recovered_is_read_in_place_of_the_damaged_log(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    timed(bag / "x_0.mcap", (1, "/map", FIRST))
    path = timed(bag / "x_1.mcap", *[(2 + time, "/map", LAST) for time in range(200)], chunk_size=2000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(MapError, match="truncated or damaged"):
        load_input(bag)
    recover(path, bag / "x_1.recovered.mcap")
    world, note = load_input(bag), "x_1.recovered.mcap is read in place of x_1.mcap"
    assert obstacle(world) == [[0, 3]] and note in world.notes
    assert f"bag: {note}" in read_state(bag, world, [[1, 1]])[1]
    (bag / "x_1.mcap").unlink()
    world = load_input(bag)
    assert obstacle(world) == [[0, 3]] and note not in world.notes


def test_a_cut_log_names_what_saves_its_maps(tmp_path: Path) -> None:
    """`recover`, which then gives back the map, also from chunks without checksums; not from messages in no chunk."""
    messages = [(time, "/map", FIRST) for time in range(200)]
    data = timed(tmp_path / "whole.mcap", *messages, chunk_size=2000).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    for read in (load_input, lambda path: read_state(path, World.create(np.zeros((3, 4))), [[1, 1]]), inspect):
        said = r"truncated or damaged: .*; try `mrac-jax inspect --repair OUT .*/cut\.mcap`"
        with pytest.raises(InputError, match=said):
            read(cut)
    for options in ({}, {"enable_crcs": False}):
        data = timed(tmp_path / "whole.mcap", *messages, chunk_size=2000, **options).read_bytes()
        cut.write_bytes(data[: len(data) // 2])
        recover(cut, tmp_path / "new.mcap")
        assert obstacle(load_input(tmp_path / "new.mcap")) == [[2, 0]]
    data = timed(tmp_path / "whole.mcap", *messages, use_chunking=False).read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="holds nothing that can be saved"):
        recover(cut, tmp_path / "none.mcap")


def test_values_between_the_thresholds_of_a_logged_map_are_counted(tmp_path: Path) -> None:
    values = np.array([[0, 25, 26], [-1, 64, 65]])
    world = load_input(timed(tmp_path / "a.mcap", (0, "/map", values)))
    assert world.notes[:2] == (
        "unknown, since its value is between 25 and 65: 2 pixels", "3 unknown pixels count as obstacles",
    )  # fmt: skip


# Other planners' instances: MAPS, LS-MCPP and DORA-Explorer, as their own readers understand them.

MAPS = {
    "agents_placement": [[0, 2], [1, 3], [2, 0]], "n_agents": 2, "obstacles_location": [[1, 1], [0, 0]],
    "threat_location": [[0, 0, 0.3], [2.0, 3.0, 0.25], [1, 2, 1]], "torodial": False, "world_shape": [3, 4],
    "random_placement": False,
}  # fmt: skip
MAP = "type octile\nheight 3\nwidth 5\nmap\n.....\n.@@..\n.....\n"


def maps(folder: Path, **changes: Any) -> Path:
    (folder / "m.yaml").write_text(yaml.safe_dump(MAPS | changes))
    return folder / "m.yaml"


def test_a_maps_world(tmp_path: Path) -> None:
    """`adv_coverage.py`: an obstacle wins over a threat, the first n_agents of the placements are there."""
    world = load_input(maps(tmp_path))
    expected = np.zeros((3, 4), dtype=np.float32)
    expected[2, 3], expected[0, 0], expected[1, 1], expected[1, 2] = 0.25, np.nan, np.nan, np.nan
    np.testing.assert_array_equal(world.threat, expected)
    assert world.starts is not None and world.starts.tolist() == [[0, 2], [1, 3]]
    assert world.notes == ("cells that stop every visit (p = 1) and so count as obstacles: 1",)
    assert load_input(maps(tmp_path, random_placement=True)).starts is None
    (tmp_path / "s.yaml").write_text("map: m.yaml\nrobots: {count: 1, start: upper-left}\n")
    assert load_input(tmp_path / "s.yaml").team.robots == 1


def test_a_maps_world_of_several_types(tmp_path: Path) -> None:
    """`adv_coverage.py`: p of a threat of type b on an agent of type a is `types_matrix[a][b]` times its p."""
    threats = [[0, 1, 0.5, 0], [2, 3, 0.25, 1]]
    path = maps(tmp_path, threat_location=threats, types_matrix=[[1.0, 0.4], [0.0, 2.0]], agents_type=[1, 0, 0])
    world = load_input(path)
    assert world.types is not None and world.types.names == ("0", "1")
    found = {name: of[[0, 2], [1, 3]].tolist() for name, of in zip("01", world.types.threat, strict=True)}
    assert found == {"0": pytest.approx([0.5, 0.1]), "1": pytest.approx([0.0, 0.5])}
    assert world.team.settings == {"types": ("1", "0")}
    (tmp_path / "s.yaml").write_text("map: m.yaml\nrobots: {types: '1'}\n")
    assert load_input(tmp_path / "s.yaml").team.settings == {"types": "1"}


REFUSED_MAPS = [
    ({"world_shape": [3]}, r"`world_shape` is \[3\]; expected \[row, col\]"),
    ({"world_shape": [0, 4]}, "1 to 67108864 cells"),
    ({"world_shape": [10**9, 10**9]}, "`world_shape` is|world_shape"),
    ({"torodial": True}, "torodial"),
    ({"threat_location": [[0, 1, 1.5]]}, r"`threat_location\[0\]\[2\]` is 1.5"),
    ({"threat_location": [[0, 1]]}, r"`threat_location\[0\]` is \[0, 1\]; expected \[row, col, p\]"),
    ({"obstacles_location": [[3, 0]]}, r"`obstacles_location\[0\]\[0\]` is 3; expected \[row, col\], row 0..2"),
    ({"obstacles_location": [[0.5, 0]]}, r"is \[0.5, 0\]; expected"),
    ({"n_agents": 0}, "n_agents"),
    ({"agents_placement": [[1, 1]], "n_agents": 1}, "an obstacle"),
    ({"types_matrix": [[1.0], [1.0, 2.0]]}, "`types_matrix` is"),
    ({"types_matrix": [[1.0]]}, r"expected \[row, col, p, type\]"),
    ({"types_matrix": [[1.0]], "threat_location": [[0, 1, 0.5, 1]]}, r"`threat_location\[0\]\[3\]` is 1"),
    ({"types_matrix": [[3.0]], "threat_location": [[0, 1, 0.5, 0]]}, "p = 1.5 for a robot of type 0"),
]


@pytest.mark.parametrize(("changes", "words"), REFUSED_MAPS)
def test_maps_that_are_refused(tmp_path: Path, changes: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_input(maps(tmp_path, **changes))


def test_an_instance_of_ls_mcpp(tmp_path: Path) -> None:
    """`benchmark/instance.py`: root is [column, row], or column * height + row; maps lie in `gridmaps`."""
    for folder in ("instances/a", "gridmaps/a"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "gridmaps" / "a.map").write_text(MAP)
    (tmp_path / "gridmaps" / "a" / "0.1-2.map").write_text(MAP.replace(".@@", "@@@"))
    for name, root, obstacles in (("a", [[4, 0], [0, 2]], 2), ("a/0.1-2", [12, 2], 3)):
        (tmp_path / "instances" / f"{name}.mcpp").write_text(
            f"map: a\nroot: {root}\nweighted: False\nincomplete: True\n"
        )
        world = load_input(tmp_path / "instances" / f"{name}.mcpp")
        assert world.starts is not None and world.starts.tolist() == [[0, 4], [2, 0]]
        assert int((~world.free).sum()) == obstacles and world.threat[1, 3] == 0
    (tmp_path / "a.map").write_text(MAP)
    for text, words in (
        ("map: a\nroot: [[1, 1]]\n", r"robot 0 starts at \[1, 1\], an obstacle"),
        ("map: a\nroot: [[9, 1]]\n", r"robot 0 starts at \[1, 9\], outside the map"),
        ("map: a\nroot: [[0, 1, 2]]\n", r"`root\[0\]` is \[0, 1, 2\]; expected \[column, row\]"),
        ("map: a\nroot: [x]\n", r"`root\[0\]` is 'x'"),
        ("map: b\nroot: [[0, 1]]\n", "`map` is 'b'; expected a map b.map in its folder"),
        ("map: a\n", "`root` is missing"),
        ("map: a\nroot: [[0, 1", "line 2: expected"),
    ):
        (tmp_path / "a.mcpp").write_text(text)
        with pytest.raises(InputError, match=words) as caught:
            load_input(tmp_path / "a.mcpp")
        assert "a.mcpp" in str(caught.value)


def test_sources_of_dora_explorer(tmp_path: Path) -> None:
    """Cell by cell: a robot that drives 1 m at 0.8 m/s has 6.25 steps of 0.2 s, nine of ten of them with a check."""
    sources = [(-3.1, 0.5, 0.38), (6.0, -8.0, 0.9), (6.0, -7.5, 0.7)]
    text = {"sources": [{"x": x, "y": y, "intensity": strength} for x, y, strength in sources]}
    (tmp_path / "radiation_sources0.json").write_text(json.dumps(text))
    world = load_input(tmp_path / "radiation_sources0.json")
    assert world.shape == (17, 17) and world.cell_size == 1 and world.free.all()
    for row in range(17):
        for col in range(17):
            x, y = col - 8, 8 - row  # north is up
            i = sum(strength / (1 + 0.2 * ((x - a) ** 2 + (y - b) ** 2)) for a, b, strength in sources)
            p = min(max(0.0, (i - 0.2) / 0.8), 1.0)
            assert world.threat[row, col] == pytest.approx(1 - (1 - p) ** (6.25 * 0.9), abs=1e-6)
    assert 0 < world.threat[8, 5] < 1 and world.threat[0, 0] == 0 and 0.999 < world.threat[16, 14] < 1
    for wrong, words in (
        ({}, "holds no map"),
        ({"sources": []}, r"`sources` is \[\]"),
        ({"sources": [{"x": 0, "y": 0}]}, r"`sources\[0\].intensity` is missing"),
        ({"sources": [{"x": 0, "y": "a", "intensity": 1}]}, r"`sources\[0\].y` is 'a'; expected metres"),
        ({"sources": [{"x": 0, "y": 0, "intensity": -1}]}, "intensity` is -1"),
    ):
        (tmp_path / "s.json").write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=words):
            load_input(tmp_path / "s.json")
