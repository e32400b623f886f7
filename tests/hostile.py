"""Files that lie: small right files for every reader, and what becomes of them by mutation.

Every mutation follows from a number, so one that found something is kept as its number.
"""

from __future__ import annotations

import gzip
import io
import math
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.bal import read_bal
from unifg.files.carmen import read_carmen
from unifg.files.contents import Limits
from unifg.files.euroc import read_euroc
from unifg.files.g2o import read_g2o
from unifg.files.kitti import read_kitti
from unifg.files.mrclam import read_mrclam
from unifg.files.plaza import read_plaza
from unifg.files.pose_graph import read_pose_graph
from unifg.files.range_log import read_range_log
from unifg.files.ros_map import load_map
from unifg.files.toro import read_toro
from unifg.files.tum import read_tum
from unifg.scenarios.planning.speed_profile import read_profile

SECONDS = 5  # a small file that takes longer is one too many
SMALL = Limits(unpacked=2**22, pixels=10**6)

PLANAR = b"""VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0.1
VERTEX_SE2 2 2 0.1 0.2
VERTEX_XY 7 1.5 2.5
EDGE_SE2 0 1 1 0 0.1 500 0 0 500 0 5000
EDGE_SE2 1 2 1 0 0.1 500 0 0 500 0 5000
EDGE_SE2_XY 1 7 0.5 2.4 10 0 10
BR 2 7 1.2 2.4 0.1 0.2
FIX 0
"""
SPATIAL = b"""# in space
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0.6 0.8
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0.6 0.8 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
"""
TORO = b"""VERTEX2 0 0 0 0
VERTEX2 1 1 0 0.1
EDGE2 0 1 1 0 0.1 500 0 500 5000 0 0
"""
TUM = b"""# t x y z qx qy qz qw
0.0 0 0 0 0 0 0 1
0.1 1 0 0 0 0 0.6 0.8
0.2 2.5e0 0 0 0 0 0.6 0.8
"""
CAMERAS = b"""1 1 1
0 0 1.5 -2.5
0.1
0.2
0.3
1
2
-9
800
-0.05
0.01
0.5
0.6
0.7
"""
VICTORIA = b"""ODOMETRY 0 1 1 0 0.1 0.0001 0 0 4e-06 0 4e-06
LANDMARK 1 2 11.5 -3.2 0.4 0 0.4
ODOMETRY 1 3 1 0 0.1 0.0001 0 0 4e-06 0 4e-06
LANDMARK 3 2 10.5 -3.2 0.4 0 0.4
"""
EUROC = b"""#timestamp, x, y, z, qw, qx, qy, qz
1403636580838555648,4.688319,-1.786938,0.783338,0.6,0,0,0.8,-0.02
1403636580843555648,4.688177,-1.786770,0.787350,0.6,0,0,0.8,-0.03
"""
KITTI = b"1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 2 0 0 1 3\n"
CARMEN = b"""# message
ODOM 0 0 0 0 0 0 1.5 host 0.0
FLASER 3 1.0 2.0 81.9 0 0 0 0 0 0 1.6 host 0.1
ROBOTLASER1 0 -1.57 3.14 1.57 81.9 0.01 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0.3 0.3 1e6 1.7 host 0.2
"""
MRCLAM = {
    "Barcodes.dat": b"# Subject # Barcode #\n1 5\n6 72\n7 27\n",
    "Landmark_Groundtruth.dat": b"# Subject x y\n6 1.5 -2 0.0001 0.0002\n7 3 4 0.0001 0.0003\n",
    "Robot1_Odometry.dat": b"# Time v w\n1248272272.841\t   0.000\t   0.000\n1248272272.856\t   0.5\t  -0.1\n",
    "Robot1_Measurement.dat": b"# t code r b\n1248272273.500 72 2.5 -0.25\n1248272273.6 4 1 0.1\n1248272274 5 4 0.3\n",
    "Robot1_Groundtruth.dat": b"1248272272.841 1 2 0.5\n",
}
PLAZA = {
    "DR.txt": b"  3.8570e+003\t  5.0000e-001\t -2.5000e-001\t\n  3.85725e+003\t  1.5000e+000\t  1.2500e-001\t\n",
    "TD.txt": b"  3.8580e+003\t  2.0000e+000\t  5.0000e+000\t  6.5500e+001\t\n3858.5 2 6 35.75\n",
}
PROFILE = b"t_s,v_ref_mps,slope_rad\n0,0,0\n1,2.5,0.01\n2,5,0.02\n"
YAML = b"""image: m.pgm
mode: trinary
resolution: 0.05
origin: [-1.0, 2, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
PGM = b"P5\n4 3\n255\n" + bytes([0, 254, 205, 0] * 3)


def drive_file(**others: Any) -> bytes:
    """The columns of a `drive.npz` of two ticks that a log is made of."""
    columns: dict[str, Any] = {
        "time": [0.0, 0.1], "scan_angles": [-1.0, 1.0], "scan": [[2.0, math.inf], [math.nan, 2.0]],
        "dead_reckoning": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], "true_pose": [[1.0, 0.0, 0.0], [1.1, 0.0, 0.0]],
    }  # fmt: skip
    written = io.BytesIO()
    np.savez_compressed(written, **(columns | others))
    return written.getvalue()


@dataclass(frozen=True)
class Reader:
    """Reader of one kind of files.

    Attributes:
        read: the function.
        files: right ones by name; the first is handed to the reader.
        mutated: names of those that are mutated.
    """

    read: Callable[[Path], Any]
    files: dict[str, bytes]
    mutated: tuple[str, ...]


def _one(read: Callable[..., Any], name: str, content: bytes) -> Reader:
    return Reader(lambda path: read(path, limits=SMALL), {name: content}, (name,))


READERS = {
    "g2o": _one(read_g2o, "graph.g2o", PLANAR),
    "g2o in space": _one(read_g2o, "graph.g2o", SPATIAL),
    "g2o gzipped": _one(read_g2o, "graph.g2o.gz", gzip.compress(PLANAR, mtime=0)),
    "toro": _one(read_toro, "graph.graph", TORO),
    "pose graph": _one(read_pose_graph, "graph.txt", PLANAR),
    "tum": _one(read_tum, "way.tum", TUM),
    "edges alone": _one(
        read_g2o, "graph.g2o", b"\n".join(line for line in PLANAR.split(b"\n") if b"VERTEX_S" not in line)
    ),
    "victoria": _one(read_pose_graph, "park.txt", VICTORIA),
    "euroc": _one(read_euroc, "data.csv", EUROC),
    "kitti": _one(read_kitti, "way.txt", KITTI),
    "carmen": _one(read_carmen, "log.clf", CARMEN),
    "map": Reader(lambda path: load_map(path, limits=SMALL), {"m.yaml": YAML, "m.pgm": PGM}, ("m.yaml",)),
    "image": Reader(lambda path: load_map(path, limits=SMALL), {"m.yaml": YAML, "m.pgm": PGM}, ("m.pgm",)),
    "barcodes": Reader(lambda path: read_mrclam(path.parent, limits=SMALL), MRCLAM, ("Barcodes.dat",)),
    "room": Reader(lambda path: read_mrclam(path.parent, limits=SMALL), MRCLAM, tuple(MRCLAM)),
    "ranges": Reader(lambda path: read_plaza(path, path.parent / "TD.txt", limits=SMALL), PLAZA, tuple(PLAZA)),
    "cameras": _one(read_bal, "problem.txt", CAMERAS),
    "drive": Reader(
        lambda path: read_range_log(path, limits=SMALL).odometry, {"drive.npz": drive_file()}, ("drive.npz",)
    ),
    "profile": _one(read_profile, "speeds.csv", PROFILE),
}
WORDS = (
    b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e400", b"1e-320", b"1e200", b"1e18", b"-1", b"0", b"1_000",
    b"0x1p3", b"9" * 30, b"9" * 500, b"9" * 5000, b"+-5", b"--5", b"", b"\xef\xbb\xbf", b"\xff\xfe", b"\x00", b"\x0c",
    b"\x0b", b"\x1c", b"\xc2\x85", b"\xe2\x80\xa8", b"\r", b"\r\n", b"\n", b"\t", b",", b"#", b"\xd9\xa3", b"[", b"]",
    b"{", b"}",
    b"!!int x", b"!!timestamp x", b"!!binary x", b"!!float x", b"2001-99-99", b"2001-01-01", b"&a [*a]", b"&a",
    b"*a",
    b"<<: *a", b"!!python/object:os.system", b": ", b"- ", b"? ", b"|", b">", b"%YAML 9", b"---", b"'", b'"', b"~",
    b"true", b"[" * 3000, b"- " * 3000, b"100000 100000", b"99999999999", b"P2", b"P6", b"BM", b"\x89PNG", b"GIF89a",
)  # fmt: skip
"""What stands where it should not."""


def mutated(content: bytes, number: int) -> bytes:
    """One of many wrong files."""
    rng = np.random.default_rng(number)
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 5))):
        at, kind = int(rng.integers(0, len(data) + 1)), int(rng.integers(0, 9))
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            data[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 2:
            del data[at : at + int(rng.integers(1, 12))]
        elif kind == 3:
            data[at:at] = WORDS[int(rng.integers(0, len(WORDS)))]
        elif kind == 4:  # a word for a word
            words = bytes(data).split(b" ")
            words[int(rng.integers(0, len(words)))] = WORDS[int(rng.integers(0, len(WORDS)))]
            data = bytearray(b" ".join(words))
        elif kind == 5:  # a line for another, twice, or not at all
            lines = bytes(data).split(b"\n")
            k, j = rng.integers(0, len(lines), 2)
            lines[int(k)] = lines[int(j)] if rng.random() < 0.7 else b""
            data = bytearray(b"\n".join(lines))
        elif kind == 6:
            del data[at:]
        elif kind == 7:
            data += data[: int(rng.integers(0, 4000))]
        else:
            data = bytearray(gzip.compress(bytes(data), mtime=0))
    return bytes(data)


class TooLong(Exception):
    """A reader does not come to an end."""


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Raise where a block takes longer, if this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
        raise TooLong(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def trouble(reader: Reader, folder: Path, number: int) -> str:
    """Description of a reader's fault on a mutated file; empty if it reads or refuses the file correctly."""
    for name, content in reader.files.items():
        (folder / name).write_bytes(mutated(content, number) if name in reader.mutated else content)
    first = folder / next(iter(reader.files))
    try:
        with at_most(SECONDS), warnings.catch_warnings():
            warnings.simplefilter("error")
            found = reader.read(first)
    except FileFormatError as error:
        named = any(name.split(".")[0] in str(error) for name in reader.mutated)
        return "" if named and len(str(error)) < 2000 else f"says {str(error)[:200]!r}"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return f"{type(error).__name__}: {str(error)[:200]}"
    return "" if _finite(found) else "numbers that are not finite"


def _finite(found: Any) -> bool:
    """Test whether all numbers in it are finite, except those that may be infinite."""
    if isinstance(found, np.ndarray):
        return found.dtype.kind != "f" or bool(np.isfinite(found).all())
    if isinstance(found, float):
        return not math.isnan(found)
    if isinstance(found, (list, tuple)):
        return all(map(_finite, found))
    return all(map(_finite, vars(found).values())) if hasattr(found, "__dataclass_fields__") else True


def bomb(size: int) -> bytes:
    """A gzipped file of zeros."""
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb", mtime=0) as file:
        for _ in range(size // 2**20):
            file.write(bytes(2**20))
    return packed.getvalue()
