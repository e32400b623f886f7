"""Maps in ROS format: what is read, what is written, what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from unifg.errors import FileFormatError, ModelError
from unifg.files.ros_map import OccupancyMap, load_map, save_map
from unifg.typing import Array, BoolArray

HEADER = (
    "image: m.pgm\nresolution: 0.1\norigin: [1.0, 2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)


def write(folder: Path, pixels: list[list[int]], header: str = HEADER) -> Path:
    rows = np.array(pixels, dtype=np.uint8)
    (folder / "m.pgm").write_bytes(f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode() + rows.tobytes())
    path = folder / "m.yaml"
    path.write_text(header, encoding="utf-8")
    return path


def random_map(seed: int, yaw: float = 0.4) -> OccupancyMap:
    kind = np.random.default_rng(seed).integers(0, 3, size=(7, 11))
    return OccupancyMap(kind == 0, kind == 1, 0.1 + 1e-17, (1.0 / 3.0, -2e-7, yaw), "plan")


def test_image_row_zero_is_the_top_and_grey_is_unknown(tmp_path: Path) -> None:
    occupancy = load_map(write(tmp_path, [[0, 254, 205], [254, 254, 0]]))
    assert occupancy.occupied.tolist() == [[False, False, True], [True, False, False]]
    assert occupancy.free.tolist() == [[True, True, False], [False, True, False]]
    assert occupancy.name == "m"
    assert occupancy.shape == (2, 3)


def test_negate_turns_black_into_free(tmp_path: Path) -> None:
    occupancy = load_map(write(tmp_path, [[0, 255]], HEADER.replace("negate: 0", "negate: 1")))
    assert occupancy.free.tolist() == [[True, False]]
    assert occupancy.occupied.tolist() == [[False, True]]


def test_thresholds_are_exclusive_and_come_from_the_file(tmp_path: Path) -> None:
    # p of 204, 102, 51 is 0.2, 0.6, 0.8; a cell exactly at a threshold stays unknown.
    header = HEADER.replace("0.65", "0.6").replace("0.196", "0.2")
    occupancy = load_map(write(tmp_path, [[204, 205, 102, 101, 51]], header))
    assert occupancy.free.tolist() == [[False, True, False, False, False]]
    assert occupancy.occupied.tolist() == [[False, False, False, True, True]]


def test_keys_that_no_map_has_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A misspelt threshold was the default without a word."""
    load_map(write(tmp_path, [[0, 254]]))
    assert not caplog.messages
    load_map(write(tmp_path, [[0, 254]], HEADER.replace("free_thresh", "free_threshold")))
    assert "m.yaml: keys that are not read: ['free_threshold']; those of a map: image" in caplog.text


def test_colours_are_averaged_not_weighted(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    # Luma of pure blue is 29 and of green 150; the mean of both is 85, p = 2/3.
    picture = np.array([[[0, 0, 255, 255], [0, 255, 0, 255], [0, 0, 0, 0]]], dtype=np.uint8)
    image.fromarray(picture).save(tmp_path / "m.png")
    path = tmp_path / "m.yaml"
    path.write_text(HEADER.replace("m.pgm", "m.png").replace("0.65", "0.66"), encoding="utf-8")
    occupancy = load_map(path)
    assert occupancy.occupied.tolist() == [[True, True, False]]
    assert not occupancy.free.any()


def test_numbers_written_without_a_point_are_numbers(tmp_path: Path) -> None:
    occupancy = load_map(write(tmp_path, [[0]], HEADER.replace("resolution: 0.1", "resolution: 5e-2")))
    assert occupancy.resolution == 0.05


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_grid_and_world_are_inverse_and_the_origin_is_the_corner(yaw: float) -> None:
    occupancy = random_map(0, yaw)
    points = np.random.default_rng(1).normal(size=(4, 5, 2))
    assert np.allclose(occupancy.grid_to_world(occupancy.world_to_grid(points)), points, atol=1e-13)
    one_column = occupancy.grid_to_world(np.array([1.0, 0.0])) - occupancy.origin[:2]
    assert np.allclose(one_column, 0.1 * np.array([math.cos(yaw), math.sin(yaw)]))
    sides = np.hypot(*np.diff(occupancy.bounds, axis=0).T)
    assert np.allclose(sides, [1.1, 0.7, 1.1])
    assert np.allclose(occupancy.bounds[0], occupancy.origin[:2])


@pytest.mark.parametrize("seed", range(4))
def test_a_saved_map_reads_back_identically(tmp_path: Path, seed: int) -> None:
    written = random_map(seed)
    save_map(tmp_path / "plan.yaml", written)
    read = load_map(tmp_path / "plan.yaml")
    assert (tmp_path / "plan.pgm").read_bytes().startswith(b"P5\n11 7\n255\n")
    assert np.array_equal(read.occupied, written.occupied)
    assert np.array_equal(read.free, written.free)
    assert (read.resolution, read.origin, read.name) == (written.resolution, written.origin, written.name)


def test_a_map_that_was_turned_round_and_round_reads_back(tmp_path: Path) -> None:
    save_map(tmp_path / "plan.yaml", random_map(0, 20.0))
    assert load_map(tmp_path / "plan.yaml").origin[2] == pytest.approx(20.0 - 6.0 * math.pi)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("resolution: 0.1\n", "", "'resolution' is missing"),
        ("resolution: 0.1", "resolution: -1", "resolution is -1"),
        ("resolution: 0.1", "resolution: wide", "resolution is 'wide'"),
        ("resolution: 0.1", "resolution: true", "resolution is True"),
        ("[1.0, 2.0, 0.0]", "[1.0, 2.0]", "origin is"),
        ("[1.0, 2.0, 0.0]", "[1.0, .nan, 0.0]", "origin is"),
        ("[1.0, 2.0, 0.0]", "7", "origin is 7"),
        ("[1.0, 2.0, 0.0]", "[1.0, 2.0, 90]", "yaw [rad], a turn at the most"),
        ("free_thresh: 0.196", "free_thresh: 0.9", "free_thresh 0.9"),
        ("negate: 0", "negate: 3", "negate is 3"),
        ("negate: 0", "mode: raw", "'raw' is not supported"),
        ("negate: 0", "mode: shiny", "unknown mode 'shiny'"),
        ("image: m.pgm", "image: gone.pgm", "gone.pgm does not exist"),
        ("image: m.pgm", "image: m.yaml", "not an image"),
        ("image: m.pgm", "image: ''", "'image' is ''"),
        (HEADER, "just words", "expected lines"),
        (HEADER, "a: [", "not readable as YAML"),
    ],
)
def test_a_bad_header_is_refused_with_what_and_where(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in HEADER
    path = write(tmp_path, [[0, 254]], HEADER.replace(old, new))
    with pytest.raises(FileFormatError) as caught:
        load_map(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_damaged_image_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, [[0, 254], [254, 254]])
    whole = (tmp_path / "m.pgm").read_bytes()
    (tmp_path / "m.pgm").write_bytes(whole[:-2])
    with pytest.raises(FileFormatError, match=r"m\.pgm .*damaged image"):
        load_map(path)
    with pytest.raises(FileFormatError, match="no such file"):
        load_map(tmp_path / "absent.yaml")
    with pytest.raises(FileFormatError, match="cannot be read"):
        load_map(tmp_path)


FULL, BARE = np.ones((2, 3), dtype=bool), np.zeros((2, 3), dtype=bool)


@pytest.mark.parametrize(
    ("free", "resolution", "x", "message"),
    [
        (FULL, 0.1, 0.0, "both occupied and free"),
        (BARE[:1], 0.1, 0.0, "one shape"),
        (BARE.astype(int), 0.1, 0.0, "int64.*must be bool arrays"),
        (BARE, 0.0, 0.0, "resolution"),
        (BARE, 0.1, math.inf, "origin"),
    ],
)
def test_impossible_maps_cannot_be_made(free: BoolArray, resolution: float, x: float, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        OccupancyMap(FULL, free, resolution, (0.0, x, 0.0))


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "shape", "occupied", "free", "far_corner"),
    [
        ("dis-B1-2011-09-27", (1070, 1010), 16217, 158248, (38.0463, 41.2387)),
        ("turtlebot3_world", (384, 384), 795, 7939, (9.2, 9.2)),
        ("tb3_sandbox", (384, 384), 870, 7903, (9.2, 9.2)),
        ("testmap", (10, 10), 29, 71, (1.6988313, 4.3817743)),
    ],
)
def test_real_maps(
    shared_data: Path, name: str, shape: tuple[int, int], occupied: int, free: int, far_corner: Array
) -> None:
    occupancy = load_map(shared_data / "maps" / f"{name}.yaml")
    assert occupancy.shape == shape
    assert int(occupancy.occupied.sum()) == occupied
    assert int(occupancy.free.sum()) == free
    assert np.allclose(occupancy.bounds[2], far_corner)


@pytest.mark.data
def test_places_of_the_department_map_are_where_they_should_be(shared_data: Path) -> None:
    occupancy = load_map(shared_data / "maps" / "dis-B1-2011-09-27.yaml")
    places = np.array([[2.3, 30.0], [10.0, 1.7], [26.0, 1.7], [20.0, 20.0]])
    columns, rows = np.floor(occupancy.world_to_grid(places)).astype(int).T
    assert occupancy.free[rows, columns].tolist() == [True, True, True, False]
    assert not occupancy.occupied[rows, columns].any()


def test_a_map_may_have_any_name(tmp_path: Path) -> None:
    cells = np.eye(3, dtype=bool)
    save_map(tmp_path / 'hall "3"\\ü.yaml', OccupancyMap(cells, ~cells, 0.05, (0.0, 0.0, 0.0)))
    np.testing.assert_array_equal(load_map(tmp_path / 'hall "3"\\ü.yaml').occupied, cells)
