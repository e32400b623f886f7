"""Problems of "Bundle Adjustment in the Large": one text file of numbers.

The first line counts cameras, points and observations. A line for each observation follows: camera, point, x, y. Then
come the numbers of every camera (rotation vector, translation, focal length, two coefficients of distortion) and of
every point, one in a line as a rule.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, legible, read_text, require_finite, write_text
from unifg.files.text import number_of
from unifg.lie import SO3
from unifg.models.bundle_adjustment import BundleAdjustment

__all__ = ["read_bal", "write_bal"]


def read_bal(path: str | Path, limits: Limits = LIMITS) -> BundleAdjustment:
    """Read a problem.

    Args:
        path: the file, gzipped or not.
        limits: of what it may hold.

    Raises:
        FileFormatError: the file is missing, a word is no finite number, their number is not what the first line says,
            or an observation is of no camera or point, with its line.
    """
    name, text = legible(path), read_text(path, limits)
    words = text.split()
    try:
        numbers = np.array(words if text.isascii() and "_" not in text else [], dtype=np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if not len(numbers):
        numbers = np.array([number_of(word) for word in words], dtype=np.float64)  # NaN for none
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if wrong.size:
        raise FileFormatError(f"{name}, line {_line(text, int(wrong[0]))}: '{words[wrong[0]]}' is no finite number")
    if len(numbers) < 3 or (numbers[:3] < 0.0).any() or (numbers[:3] % 1.0 != 0.0).any():
        raise FileFormatError(f"{name}, line 1: expected the numbers of cameras, points and observations")
    cameras, points, count = (int(number) for number in numbers[:3])
    expected = 3 + 4 * count + 9 * cameras + 3 * points
    if len(numbers) != expected:
        stated = f"{cameras} cameras, {points} points and {count} observations are {expected}"
        raise FileFormatError(f"{name}: holds {len(numbers)} numbers, where {stated}")
    seen, known = numbers[3 : 3 + 4 * count].reshape(-1, 4), numbers[3 + 4 * count :]
    for column, most, what in ((0, cameras, "camera"), (1, points, "point")):
        index = seen[:, column]
        off = np.flatnonzero((index < 0) | (index >= most) | (index % 1.0 != 0.0))
        if off.size:
            line = _line(text, 3 + 4 * int(off[0]))
            raise FileFormatError(f"{name}, line {line}: there is no {what} {index[off[0]]:g}, but {most} of them")
    by_camera = known[: 9 * cameras].reshape(-1, 9)
    poses = np.column_stack([by_camera[:, 3:6], SO3.exp(by_camera[:, :3])])
    numbered = seen[:, :2].astype(np.int64)
    return BundleAdjustment(
        numbered[:, 0], numbered[:, 1], seen[:, 2:].copy(), poses, by_camera[:, 6:].copy(),
        known[9 * cameras :].reshape(-1, 3).copy(),
    )  # fmt: skip


def write_bal(path: str | Path, problem: BundleAdjustment) -> Path:
    """Write a problem; numbers have seventeen digits.

    Returns:
        The path written.

    Raises:
        FileFormatError: a number is not finite.
    """
    cameras = np.column_stack([SO3.log(problem.poses[:, 3:]), problem.poses[:, :3], problem.intrinsics])
    for what, rows in (("observation", problem.pixels), ("camera", cameras), ("point", problem.points)):
        require_finite(path, what, rows)
    seen = [
        f"{camera:d} {point:d} {x:.17g} {y:.17g}"
        for camera, point, (x, y) in zip(problem.camera, problem.point, problem.pixels.tolist(), strict=True)
    ]
    numbers = np.concatenate([cameras.ravel(), problem.points.ravel()])
    lines = [
        f"{len(cameras)} {len(problem.points)} {len(problem.camera)}",
        *seen,
        *map("{:.17g}".format, numbers.tolist()),
    ]
    return write_text(Path(path), "\n".join(lines) + "\n")


def _line(text: str, place: int) -> int:
    """Line of a word, counted from 1."""
    for number, line in enumerate(text.split("\n"), start=1):
        place -= len(line.split())
        if place < 0:
            return number
    return 0
