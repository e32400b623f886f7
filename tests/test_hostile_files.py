"""Files that lie: every reader reads them rightly, or refuses with the file and what was found, within limits."""

from __future__ import annotations

import gzip
import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hostile import CARMEN, PGM, PLANAR, PROFILE, READERS, SPATIAL, TUM, YAML, Reader, at_most, bomb, trouble
from scripts import CHECKOUT, run_script
from unifg.atomic_write import replacing, write_atomically
from unifg.errors import FileFormatError
from unifg.files.carmen import read_carmen
from unifg.files.contents import Limits, legible, read_bytes, read_text
from unifg.files.g2o import read_g2o, write_g2o
from unifg.files.ros_map import load_map
from unifg.files.tum import read_tum
from unifg.pose_graphs import PoseGraph
from unifg.scenarios import pose_graph
from unifg.scenarios.command import main
from unifg.scenarios.planning.speed_profile import read_profile

NUMBERS = range(40)
KEPT: dict[str, tuple[int, ...]] = {"carmen": (1967,), "euroc": (1770, 4702), "map": (1388,)}
"""Numbers of mutations that once ended wrongly, by reader."""


@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    reader = READERS[name]
    for file, content in reader.files.items():
        put(tmp_path, file, content)
    reader.read(tmp_path / next(iter(reader.files)))  # the right one is read
    for number in (*NUMBERS, *KEPT.get(name, ())):
        assert trouble(reader, tmp_path, number) == "", number


def test_the_fuzzer_sees_what_is_wrong(tmp_path: Path) -> None:
    def careless(path: Path) -> float:
        return float(path.read_text(encoding="utf-8", errors="replace").split()[0])

    reader = Reader(careless, {"n.txt": b"1.5 2\n"}, ("n.txt",))
    found = [trouble(reader, tmp_path, number) for number in range(60)]
    assert any(said.startswith("ValueError") for said in found) and "" in found


def put(tmp_path: Path, name: str, content: bytes) -> Path:
    path = tmp_path / name
    path.write_bytes(content)
    return path


PACKED = gzip.compress(PLANAR, mtime=0)  # is part of names of tests, which must not depend on the time


def swapped(content: bytes, old: bytes, new: bytes) -> bytes:
    assert content.count(old) >= 1
    return content.replace(old, new, 1)


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (read_g2o, swapped(SPATIAL, b"0.6 0.8\nEDGE", b"6e199 8e199\nEDGE"), "line 3: the quaternion .* has norm 1e"),
        (read_g2o, swapped(PLANAR, b"0.1 0.2\nFIX", b"1e-200 0.2\nFIX"), "line 8: BR: standard deviations"),
        (read_g2o, swapped(PLANAR, b"VERTEX_SE2 1", b"VERTEX_SE2 +-5"), "line 2: .*not a number"),
        (read_g2o, swapped(PLANAR, b"500 0 0", b"5_00 0 0"), "line 5: .*I11 is '5_00', not a number"),
        (read_g2o, swapped(PLANAR, b"500", b"5" * 500), "line 5: a word of 500 characters"),
        (read_g2o, PACKED[:-9], "cannot be read"),
        (read_g2o, PACKED[:20] + b"xxxx" + PACKED[24:], "cannot be read"),
        (read_tum, swapped(TUM, b"0 1\n", b"0 1\x0c"), "line 2: the control character 0x0c"),
        (read_tum, swapped(TUM, b"0 1\n", b"0 1\xe2\x80\xa8"), "line 2: the separator"),
        (read_tum, swapped(TUM, b"0 1\n", b"0 1\r"), "line 2: a carriage return"),
        (read_tum, swapped(TUM, b"0.6 0.8", b"6e200 8e200"), "line 3: the quaternion .* has norm 1e"),
        (read_profile, swapped(PROFILE, b"2.5", b"-2.5"), "line 3: -2.5 in column 'v_ref_mps'"),
        (read_profile, swapped(PROFILE, b"slope_rad", b"speed"), "line 1: the columns 'v_ref_mps' and 'speed'"),
        (read_profile, swapped(PROFILE, b"slope_rad", b"v_ref_mps"), "line 1: the columns"),
        (read_profile, b"t_s,v\n0,0\n1e300,1\n", r"line 3: 1e\+300 in column 't_s'"),
        (read_profile, b"t_s,v\n0,0\n1e9,1\n2e9,1\n", "line 3: times must grow by the same step"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(read: object, content: bytes, message: str, tmp_path: Path) -> None:
    path = put(tmp_path, "file.txt", content)
    with pytest.raises(FileFormatError, match=rf"file\.txt(, |: ){message}"):
        read(path)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        (swapped(YAML, b"0.05", b"2001-99-99"), "not readable as YAML"),
        (swapped(YAML, b"0.05", b"!!int x"), "not readable as YAML"),
        (swapped(YAML, b"0.05", b"!!timestamp x"), "not readable as YAML"),
        (swapped(YAML, b"0.05", b"9" * 399), "resolution is 9"),
        (swapped(YAML, b"0.05", b"1.0e+9"), "no map of a place"),
        (swapped(YAML, b"-1.0", b"1.0e+300"), "no map of a place"),
        (swapped(YAML, b"0.05", b"[" * 5000 + b"]" * 5000), "a word of 10000 characters"),
        (swapped(YAML, b"0.05", b"[ " * 5000 + b"] " * 5000), "line 3: nested too deeply"),
        (YAML + b"\nresolution: 0.1\n", "the key 'resolution' is given twice"),
        (
            swapped(YAML, b"negate: 0", b"negate: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]"),
            "an alias, of which a map",
        ),
        (swapped(YAML, b"trinary", b"[1, 2]"), "unknown mode"),
        (b"just words", "expected lines"),
    ],
)
def test_headers_of_maps_are_refused_in_time(yaml: bytes, message: str, tmp_path: Path) -> None:
    put(tmp_path, "m.pgm", PGM)
    with at_most(5), pytest.raises(FileFormatError, match=message) as refused:
        load_map(put(tmp_path, "m.yaml", yaml))
    assert len(str(refused.value)) < 1000


def test_limits_are_named_and_raised(tmp_path: Path) -> None:
    packed = put(tmp_path, "b.gz", bomb(2**24))
    with pytest.raises(FileFormatError, match=r"more than 1000000 bytes .*Limits\(unpacked"):
        read_bytes(packed, Limits(unpacked=10**6))
    assert len(read_bytes(packed, Limits(unpacked=2**24))) == 2**24
    path = put(tmp_path, "m.yaml", YAML)
    put(tmp_path, "m.pgm", b"P5\n100000 100000\n255\n" + bytes(10))
    with pytest.raises(FileFormatError, match=r"100000 x 100000 pixels: limits=Limits\(pixels"):
        load_map(path)
    put(tmp_path, "m.pgm", PGM)
    with pytest.raises(FileFormatError, match="4 x 3 pixels"):
        load_map(path, Limits(pixels=11))
    assert load_map(path, Limits(pixels=12)).shape == (3, 4)
    long = put(tmp_path, "long.tum", swapped(TUM, b"2.5e0", b"2." + b"5" * 500))
    with pytest.raises(FileFormatError, match="a word of 502 characters"):
        read_tum(long)
    assert read_tum(long, Limits(digits=600)).position[2, 0] == pytest.approx(2.5 + 0.5 / 9)


def test_a_byte_order_mark_is_no_part_of_the_first_word(tmp_path: Path) -> None:
    marked = read_g2o(put(tmp_path, "m.g2o", b"\xef\xbb\xbf" + PLANAR.replace(b"\n", b"\r\n")))
    np.testing.assert_array_equal(marked.poses, read_g2o(put(tmp_path, "g.g2o", PLANAR)).poses)
    with pytest.raises(FileFormatError, match="line 1: cannot be read as text"):
        read_text(put(tmp_path, "wide.txt", PLANAR.decode().encode("utf-16")))


def test_what_may_be_meant_is_warned_about_by_name(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "unifg"):
        read_tum(put(tmp_path, "back.tum", swapped(TUM, b"0.2 2.5", b"0.05 2.5")))
        read_carmen(put(tmp_path, "minus.clf", swapped(CARMEN, b"1.0 2.0", b"-1.0 2.0")))
        read_carmen(put(tmp_path, "odometry.clf", CARMEN + CARMEN.replace(b"1.5 host 0.0", b"1.5 host -1.0")))
        read_g2o(put(tmp_path, "alone.g2o", PLANAR + b"VERTEX_SE2 9 0 0 0\nVERTEX_XY 10 1 1\n"))
        read_g2o(put(tmp_path, "degrees.g2o", b"EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 -90 1 0 0 1 0 1\n"))
    said = [record.message for record in caplog.records]
    assert any("back.tum, line 4: time runs backwards" in text for text in said)
    assert any("minus.clf: 1 ranges of scans are negative" in text for text in said)
    assert any("odometry.clf: time runs backwards: 1 times in ODOM" in text for text in said)
    assert any("alone.g2o: nothing has measured 1 of the poses: 9" in text for text in said)
    assert any("alone.g2o: nothing has measured 1 of the landmarks: 10" in text for text in said)
    assert any("along 1 edge by more than a turn, first in line 2 (-90): radians are read" in text for text in said)


def test_a_map_is_solved_beside_what_nothing_has_measured(tmp_path: Path) -> None:
    path = put(tmp_path, "alone.g2o", PLANAR + b"VERTEX_SE2 9 0 0 0\nVERTEX_XY 10 1 1\n")
    assert main(["solve", str(path), "--out", str(tmp_path / "out")]) == 0
    np.testing.assert_array_equal(read_g2o(tmp_path / "out" / "graph.g2o").landmarks[-1], [1.0, 1.0])


def test_names_that_are_no_text_are_spelled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.g2o")
    assert legible(path).endswith("\\xff.g2o")
    assert main(["solve", path, "--out", str(tmp_path)]) == 2
    assert "\\xff.g2o: no such file" in capsys.readouterr().err
    Path(path).write_bytes(PLANAR)
    assert main(["solve", path, "--out", str(tmp_path / "out")]) == 0
    assert "\\xff.g2o" in capsys.readouterr().out


def test_streams_that_are_closed_or_lack_characters_take_what_is_said(tmp_path: Path) -> None:
    put(tmp_path, "g.g2o", PLANAR)
    script = (
        "import sys; sys.stderr = None; from unifg.scenarios.command import main; "
        "sys.exit(main(['solve', 'g.g2o', '--out', '\xfc']))"
    )
    said = run_script(script, cwd=tmp_path, variables={"PYTHONIOENCODING": "ascii"}).stdout
    assert "\\xfc/graph.g2o" in said and (tmp_path / "\xfc" / "graph.g2o").is_file()


@pytest.mark.parametrize(
    ("reader", "message"), [("| true", ""), ("> /dev/full", "unifg: error: the output: cannot be written (No space")]
)
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is full")
def test_an_output_that_takes_no_more_is_no_traceback(reader: str, message: str) -> None:
    command = f"{sys.executable} -m unifg.scenarios.command cache {reader}"
    said = subprocess.run(["sh", "-c", command], cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert said.stderr.startswith(message) and said.stderr.count("\n") == bool(message), said.stderr
    assert message == "" or said.returncode == 2


# ---------------------------------------------------------------- writing


def test_a_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    path = put(tmp_path, "numbers.json", b"old")
    path.chmod(0o640)
    with pytest.raises(OSError, match="full"), replacing(path) as own:
        own.write_bytes(b"half")
        raise OSError("full")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    write_atomically(path, "new")
    assert path.read_bytes() == b"new" and path.stat().st_mode & 0o777 == 0o640
    (link := tmp_path / "link").symlink_to(path)
    write_atomically(link, "newer")
    assert link.is_symlink() and path.read_bytes() == b"newer"
    write_atomically("/dev/null", "anything")
    assert not Path("/dev/null").is_file()


WRITING = """
import sys, time, types
library = sys.modules["unifg"] = types.ModuleType("unifg")  # without all that it imports
library.__path__ = [sys.argv[2]]
from unifg.atomic_write import replacing
with replacing(sys.argv[1]) as own:
    with open(own, "wb") as file:
        file.write(b"half")
        file.flush()
        print("inside", flush=True)
        time.sleep(60)
"""


def test_a_kill_leaves_the_old_file(tmp_path: Path) -> None:
    path = put(tmp_path, "graph.g2o", b"old")
    command = [sys.executable, "-c", WRITING, str(path), str(CHECKOUT / "unifg")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as run:
        assert run.stdout is not None and run.stdout.readline() == b"inside\n"
        run.kill()
    assert path.read_bytes() == b"old"


def test_a_full_disk_leaves_the_last_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    graph = read_g2o(put(tmp_path, "g.g2o", PLANAR.replace(b"BR", b"#")))
    before = write_g2o(tmp_path / "graph.g2o", graph).read_bytes()

    def full(self: Path, data: bytes) -> int:
        with open(self, "wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        write_g2o(tmp_path / "graph.g2o", graph)
    assert (tmp_path / "graph.g2o").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["g.g2o", "graph.g2o"]
    assert main(["solve", str(tmp_path / "g.g2o"), "--out", str(tmp_path)]) == 2
    assert "cannot write the results" in capsys.readouterr().err


# ---------------------------------------------------------------- the command


@pytest.mark.parametrize(
    "words",
    [
        ["navigation", "--obstacles", "1000000000"],
        ["velocity-tracking", "--length", "1000000000"],
        ["quadrotor-mpc", "--movers", "1000000000"],
    ],
)
def test_numbers_without_end_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *words]) == 2
    assert "is more than" in capsys.readouterr().err


def test_sigterm_ends_with_the_results_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before, begin = signal.getsignal(signal.SIGTERM), pose_graph._Solve.__init__

    def stopping(self: pose_graph._Solve, settings: Any, loss: Any, clock: Any, progress: Any) -> None:
        def stop(done: float, text: str) -> None:
            if text.startswith("iteration 1,"):
                os.kill(os.getpid(), signal.SIGTERM)
            progress(done, text)

        begin(self, settings, loss, clock, stop)

    monkeypatch.setattr(pose_graph._Solve, "__init__", stopping)
    path = put(tmp_path, "g.g2o", PLANAR)
    assert main(["solve", str(path), "--out", str(tmp_path / "out")]) == 130
    numbers = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert numbers["interrupted"] and numbers["status"] == "INTERRUPTED" and numbers["iterations"] == 1
    assert (tmp_path / "out" / "graph.g2o").is_file() and signal.getsignal(signal.SIGTERM) is before


def test_an_end_asked_for_after_the_solve_keeps_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(PoseGraph, "verdict", stopped)
    edges = ("0 1 1 0 0", "1 2 1 0 1.57", "2 0 0.1 2 -1.57")
    text = "\n".join(f"EDGE_SE2 {edge} 1 0 0 1 0 1" for edge in edges)
    path = put(tmp_path, "g.g2o", ("".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(3)) + text).encode())
    assert main(["solve", str(path), "--out", str(tmp_path / "out")]) == 130
    numbers = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert numbers["interrupted"] and numbers["converged"] and numbers["verdict"] is None


WITHOUT = """
import sys
for name in ("tqdm", "matplotlib", "meshcat", "pymunk", "PIL", "yaml"):
    sys.modules[name] = None
from unifg.scenarios import pose_graph
from unifg.scenarios.command import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.product(2, of="processes of their own")
def test_numbers_need_nothing_but_the_library(tmp_path: Path) -> None:
    path = put(tmp_path, "g.g2o", PLANAR)
    run = run_script(WITHOUT, "solve", path, "--scene", "--out", tmp_path / "out")
    written = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert written == ["graph.g2o", "metrics.json", "trajectory.tum"]
    assert "pip install 'unifg[view]'" in run.stderr and "Traceback" not in run.stderr
