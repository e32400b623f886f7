"""Logs of robots that see barcodes or hear beacons: read as they are meant, refused by file and line where they lie."""

from __future__ import annotations

import gzip
import io
import logging
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import unifg as fg
from hostile import MRCLAM, PLAZA
from problems.graphs import graph_of
from unifg.errors import FileFormatError, ModelError
from unifg.files.contents import Limits
from unifg.files.mrclam import NOBODY, MrclamLog, read_mrclam, write_mrclam
from unifg.files.plaza import PlazaLog, read_plaza, write_plaza
from unifg.models.odometry import driven, held
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array


def put(folder: Path, files: dict[str, bytes], **changed: tuple[bytes, bytes]) -> Path:
    """Write files, one word of some of them replaced."""
    for name, content in files.items():
        old, new = changed.get(name.removesuffix(".dat").removesuffix(".txt"), (b"", b""))
        assert old in content
        (folder / name).write_bytes(content.replace(old, new, 1))
    return folder


def plaza(folder: Path, **changed: tuple[bytes, bytes]) -> PlazaLog:
    put(folder, PLAZA, **changed)
    return read_plaza(folder / "DR.txt", folder / "TD.txt")


# ---------------------------------------------------------------- MRCLAM


def test_a_log_as_it_is_published(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Barcodes become subjects, ranges and bearings change places, and what was misread is said."""
    with caplog.at_level(logging.WARNING, logger="unifg"):
        log = read_mrclam(put(tmp_path, MRCLAM))
    assert log.barcodes == {1: 5, 6: 72, 7: 27} and log.landmark_ids.tolist() == [6, 7]
    assert log.subject.tolist() == [6, NOBODY, 1] and log.barcode.tolist() == [72, 4, 5]
    assert log.measured.tolist() == [[-0.25, 2.5], [0.1, 1.0], [0.3, 4.0]]
    assert log.velocity.tolist() == [[0.0, 0.0], [0.5, -0.1]] and log.truth.tolist() == [[1.0, 2.0, 0.5]]
    assert log.odometry_time[0] == 1248272272.841 and log.landmarks.tolist() == [[1.5, -2.0], [3.0, 4.0]]
    assert (
        len(caplog.messages) == 1
        and "Robot1_Measurement.dat: 1 sightings of barcodes that nobody bears: 4" in caplog.text
    )


def test_the_truth_may_be_missing(tmp_path: Path) -> None:
    (put(tmp_path, MRCLAM) / "Robot1_Groundtruth.dat").unlink()
    assert read_mrclam(tmp_path).truth.shape == (0, 3)
    with pytest.raises(FileFormatError, match=r"Robot2_Odometry\.dat: no such file"):
        read_mrclam(tmp_path, robot=2)


def test_true_headings_beyond_a_turn_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Degrees were radians without a word; unwrapped radians are right, and stay."""
    log = read_mrclam(put(tmp_path, MRCLAM, Robot1_Groundtruth=(b"1 2 0.5", b"1 2 -135")))
    assert log.truth.tolist() == [[1.0, 2.0, -135.0]]
    assert "Robot1_Groundtruth.dat: headings of up to 135 are read as radians: are they degrees?" in caplog.text


def test_times_that_run_backwards_are_sorted_with_what_belongs_to_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(tmp_path, MRCLAM, Robot1_Measurement=(b"1248272273.500", b"1248272279.500"))
    with caplog.at_level(logging.WARNING, logger="unifg"):
        log = read_mrclam(tmp_path)
    assert log.subject.tolist() == [NOBODY, 1, 6] and log.measured[2].tolist() == [-0.25, 2.5]
    assert "Robot1_Measurement.dat, line 3: time runs backwards, here and 0 times more" in caplog.text


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("Barcodes", b"6 72", b"1 72", r"Barcodes\.dat, line 3: subject 1 is defined twice, first in line 2"),
        ("Barcodes", b"7 27", b"7 72", r"Barcodes\.dat, line 4: barcode 72 is defined twice, first in line 3"),
        ("Barcodes", b"6 72", b"6.5 72", r"Barcodes\.dat, line 3: field subject is '6\.5', not an integer"),
        ("Barcodes", b"6 72", b"6 72 1", r"Barcodes\.dat, line 3: 3 fields, expected 2 \(subject barcode\)"),
        ("Landmark_Groundtruth", b"7 3", b"6 3", r"line 3: landmark 6 is defined twice, first in line 2"),
        ("Landmark_Groundtruth", b"0.0002", b"-0.0002", r"line 2: a standard deviation is below zero"),
        ("Robot1_Odometry", b"0.5", b"0_5", r"Robot1_Odometry\.dat, line 3: field forward is '0_5', not a number"),
        ("Robot1_Odometry", b"0.5", b"nan", r"line 3: field forward is 'nan', not a finite number"),
        ("Robot1_Measurement", b" 72 ", b" 72.5 ", r"line 2: field barcode is 72\.5, not a whole number"),
        ("Robot1_Measurement", b" 72 ", b" 1e300 ", r"line 2: field barcode is 1e\+300, not a whole number"),
        ("Robot1_Measurement", b"2.5", b"-2.5", r"line 2: the range is below zero"),
        ("Robot1_Measurement", b"-0.25", b"-45", r"line 2: the bearing is beyond a turn: is it in radians\?"),
        ("Robot1_Groundtruth", b"1 2 0.5", b"1 2", r"line 1: 3 fields, expected 4"),
    ],
)
def test_what_is_wrong_in_a_room_is_named(tmp_path: Path, file: str, old: bytes, new: bytes, message: str) -> None:
    put(tmp_path, MRCLAM, **{file: (old, new)})
    with pytest.raises(FileFormatError, match=message):
        read_mrclam(tmp_path)


def test_no_odometry_and_limits(tmp_path: Path) -> None:
    put(tmp_path, MRCLAM)
    with pytest.raises(FileFormatError, match="holds more than 10 bytes"):
        read_mrclam(tmp_path, limits=Limits(unpacked=10))
    (tmp_path / "Robot1_Odometry.dat").write_text("# nothing\n\n")
    with pytest.raises(FileFormatError, match=r"Robot1_Odometry\.dat: no line holds odometry"):
        read_mrclam(tmp_path)


@pytest.mark.parametrize("kind", ["room", "empty"])
def test_what_is_written_is_read_to_the_last_bit(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    n, m = 5, 4 if kind == "room" else 0
    names = {2: 9, 30: 2**62} if m else {}
    barcode = rng.choice([9, 2**40, 77], m)
    log = MrclamLog(
        np.sort(rng.normal(1e9, 1e3, n)), rng.normal(size=(n, 2)), np.sort(rng.normal(1e9, 1.0, m)), barcode,
        np.where(barcode == 9, 2, NOBODY), np.abs(rng.normal(size=(m, 2))), names,
        np.array([30] if m else [], dtype=int), rng.normal(size=(m // 4, 2)), np.full((m // 4, 2), 1e-17),
        np.sort(rng.random(m)), rng.normal(size=(m, 3)),
    )  # fmt: skip
    again = read_mrclam(write_mrclam(tmp_path / "new" / "room", log, robot=3), robot=3)
    for part in fields(MrclamLog):
        np.testing.assert_array_equal(getattr(again, part.name), getattr(log, part.name), err_msg=part.name)


def test_what_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    log = read_mrclam(put(tmp_path, MRCLAM))
    with pytest.raises(FileFormatError, match=r"Odometry\.dat: row 1 is not finite"):
        write_mrclam(tmp_path / "a", replace(log, velocity=np.array([[0.0, 0.0], [np.inf, 0.0]])))
    with pytest.raises(FileFormatError, match=r"Odometry\.dat: columns of 1, 2 rows do not fit"):
        write_mrclam(tmp_path / "b", replace(log, velocity=np.zeros((1, 2))))


# ---------------------------------------------------------------- Plaza


def test_ranges_as_they_are_published(tmp_path: Path) -> None:
    """Numbers with exponents of three digits, names as decimals, tabulators at the ends of lines."""
    log = plaza(tmp_path)
    assert log.odometry_time.tolist() == [3857.0, 3857.25] and log.steps.tolist() == [[0.5, -0.25], [1.5, 0.125]]
    assert log.beacon.tolist() == [5, 6] and log.sender.tolist() == [2, 2] and log.measured.tolist() == [65.5, 35.75]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("TD", b"5.0000e+000", b"5.5000e+000", r"TD\.txt, line 1: field beacon is 5\.5, not a whole number"),
        ("TD", b"2.0000e+000", b"2.0000e+300", r"TD\.txt, line 1: field sender is 2e\+300, not a whole number"),
        ("TD", b"6.5500e+001", b"-6.5500e+001", r"TD\.txt, line 1: the range is below zero"),
        ("TD", b"6.5500e+001", b"", r"TD\.txt, line 1: 3 fields, expected 4 \(time sender beacon range\)"),
        ("DR", b"5.0000e-001", b"inf", r"DR\.txt, line 1: field distance is 'inf', not a finite number"),
    ],
)
def test_what_is_wrong_with_ranges_is_named(tmp_path: Path, file: str, old: bytes, new: bytes, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        plaza(tmp_path, **{file: (old, new)})


def test_ranges_are_written_and_read_to_the_last_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    log = PlazaLog(
        np.sort(rng.normal(3e3, 10.0, 6)), rng.normal(size=(6, 2)), np.sort(rng.normal(3e3, 1.0, 3)),
        np.array([2, 2, -3]), np.array([5, 2**52, 7]), rng.random(3) * 1e-9,
    )  # fmt: skip
    write_plaza(tmp_path / "d.txt.gz", tmp_path / "r.txt", log)
    again = read_plaza(tmp_path / "d.txt.gz", tmp_path / "r.txt")
    for part in fields(PlazaLog):
        np.testing.assert_array_equal(getattr(again, part.name), getattr(log, part.name), err_msg=part.name)
    assert gzip.decompress((tmp_path / "d.txt.gz").read_bytes()).startswith(b"# time distance turn\n")


# ---------------------------------------------------------------- where odometry leads


def test_arcs_are_exact(rng: np.random.Generator) -> None:
    steps = rng.normal(size=(7, 2))
    pose, expected = np.zeros(3), [np.zeros(3)]
    for way, turn in steps:
        pose = fg.SE2.compose(pose, fg.SE2.exp(np.array([way, 0.0, turn])))
        expected.append(pose)
    np.testing.assert_allclose(fg.SE2.local(np.array(expected), driven(steps)), 0.0, atol=1e-14)
    assert driven(np.zeros((0, 2))).tolist() == [[0.0, 0.0, 0.0]]


def test_velocities_hold_until_the_next() -> None:
    """Also those from before the first look; before the first there is rest, and after the last it holds on."""
    poses = held([1.0, 2.0, 2.0, 3.0], [[1.0, 0.0], [9.0, 9.0], [2.0, 0.0], [0.5, 0.0]], [0.0, 1.5, 1.5, 2.5, 5.0])
    np.testing.assert_allclose(poses[:, 0], [0.0, 0.5, 0.5, 2.0, 4.0], atol=1e-15)
    assert held([0.0], [[1.0, 0.0]], []).shape == (0, 3) and held([], np.zeros((0, 2)), [1.0]).tolist() == [[0.0] * 3]
    np.testing.assert_allclose(held([0.0], [[2.0, 0.0]], [1.0, 4.0]), [[0, 0, 0], [6, 0, 0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: driven(np.zeros((3, 3))), r"steps have shape \(3, 3\), expected \(n, 2\)"),
        (lambda: held([0.0], np.zeros((2, 2)), [0.0]), r"velocity \(2, 2\)"),
        (lambda: held([1.0, 0.0], np.zeros((2, 2)), [0.0]), "not fall"),
        (lambda: held([0.0, np.nan, 2.0], np.zeros((3, 2)), [0.0]), "must be numbers and not fall"),
        (lambda: held([0.0], np.zeros((1, 2)), [1.0, 0.0]), "not fall"),
    ],
)
def test_odometry_that_does_not_fit(call: object, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        call()  # type: ignore[operator]


@pytest.mark.data
def test_the_log_of_a_mower_without_a_map(shared_data: Path) -> None:
    """Plaza 1 whole, as in docs/guide/sensors.md: beacons, factor and offset of the ranges are unknown."""
    folder = shared_data / "landmarks"
    log = read_plaza(folder / "Plaza1_DR.txt.gz", folder / "Plaza1_TD.txt.gz")
    assert len(log.steps) == 9657 and np.unique(log.beacon).tolist() == [0, 1, 5, 6]
    assert log.measured[0] == 65.466007843625079 and log.steps[0, 1] == -5.2000000000163027e-05
    way = driven(log.steps)[1:]
    place = np.minimum(np.searchsorted(log.odometry_time, log.time), len(way) - 1)
    path, beacon = way[place], np.unique(log.beacon, return_inverse=True)[1]

    def ranged(x: Array, b: Array, long: Array, z: Array) -> Array:
        return np.asarray(long[:, :1] * np.linalg.norm(x[:, :2] - b, axis=1, keepdims=True) + long[:, 1:] - z)

    graph, x, b, long = graph_of(("x", fg.SE2, len(path)), ("b", fg.Rn(2), 4), ("long", fg.Rn(2), 1))
    graph.fix(x[0], path[0])
    spread = np.sqrt(np.maximum(np.diff(place), 1))[:, None] * [0.03, 0.03, 0.01]
    graph.minimize(fg.between, x[:-1], x[1:], fg.SE2.between(path[:-1], path[1:]), sigma=spread)
    graph.minimize(ranged, x, b[beacon], long, log.measured[:, None], sigma=0.7, robust=fg.Huber(1.345))
    graph.minimize(fg.prior, long, [1.0, 0.0], sigma=[0.1, 2.0])
    first = []
    for k in range(4):
        near = np.flatnonzero(beacon == k)[:150]
        A = np.column_stack([2.0 * path[near, :2], -np.ones(len(near))])
        target = np.sum(path[near, :2] ** 2, axis=1) - log.measured[near] ** 2
        first.append(np.linalg.lstsq(A, target, rcond=None)[0][:2])
    solution = LevenbergMarquardt().solve(graph, {x: path, b: np.array(first), long: [[1.0, 0.0]]})
    assert solution.status.name == "CONVERGED" and abs(solution[long][0, 0] - 1.066) < 2e-3

    with gzip.open(folder / "Plaza1_.mat.gz") as file:
        truth = loadmat(io.BytesIO(file.read()))
    there = truth["GT"][np.minimum(np.searchsorted(truth["GT"][:, 0], log.time), len(truth["GT"]) - 1), 1:3]
    p, q = solution[x][:, :2] @ [1.0, 1.0j], there @ [1.0, 1.0j]
    turn = np.exp(1j * np.angle(np.vdot(p - p.mean(), q - q.mean())))
    assert np.sqrt(np.mean(np.abs(turn * (p - p.mean()) - q + q.mean()) ** 2)) < 0.25  # dead reckoning: 1.47
    surveyed = truth["TL"][np.argsort(truth["TL"][:, 0]), 1:] @ [1.0, 1.0j]
    assert np.abs(turn * (solution[b] @ [1.0, 1.0j] - p.mean()) + q.mean() - surveyed).max() < 0.25
