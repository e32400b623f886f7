"""Speeds to follow: read from a file, or a drive cycle of our own."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError, ScenarioError
from unifg.files.contents import LIMITS, Limits, legible, read_text
from unifg.files.text import number_of
from unifg.typing import Array

__all__ = ["Profile", "drive_cycle", "read_profile"]

SPEED_COLUMNS = ("v_ref_mps", "v_mps", "speed", "v")
TIME_COLUMNS = ("t_s", "time", "t")
SLOPE_COLUMNS = ("slope_rad",)
FASTEST = 1000.0  # [m/s]
LONGEST_STEP = 3600.0  # [s]

# Time [s] and speed [km/h] where the drive cycle turns a corner: a village, a town, a country road, and the way back.
CORNERS = (
    (0, 0), (4, 0), (16, 30), (42, 32), (52, 0), (62, 0), (78, 50), (112, 48), (121, 15), (127, 15), (140, 50),
    (156, 51), (167, 0), (179, 0), (203, 70), (232, 72), (254, 100), (292, 98), (314, 62), (334, 64), (348, 30),
    (364, 30), (376, 0), (388, 0),
)  # fmt: skip
SMOOTHING = 2.0  # standard deviation of what rounds the corners [s]


@dataclass(frozen=True)
class Profile:
    """Reference speeds.

    Attributes:
        name: where they come from.
        speed: (K,) at times 0, dt, 2 dt, ... [m/s]; the first one is not used, a drive starts where it starts.
        slope: (K,) of the road [rad], positive uphill.
        dt: sampling time [s].
    """

    name: str
    speed: Array
    slope: Array
    dt: float

    def first(self, length: int) -> Profile:
        """The first ``length`` steps.

        Raises:
            ScenarioError: when there are not so many.
        """
        if not 1 <= length < len(self.speed):
            raise ScenarioError(
                f"a drive of {length} steps was asked for, and the profile {self.name} has "
                f"{len(self.speed) - 1} after its start: choose a length between 1 and {len(self.speed) - 1}"
            )
        return Profile(self.name, self.speed[: length + 1], self.slope[: length + 1], self.dt)


def drive_cycle(length: int) -> Profile:
    """A drive cycle made for this package: stops, a town and a country road in 388 s, repeated; 1 s samples.

    Args:
        length: steps wanted; one speed more is returned.
    """
    corners = np.array(CORNERS, dtype=np.float64)
    period = corners[-1, 0]
    reach = np.arange(-4, 5) * 0.5 * SMOOTHING
    weight = np.exp(-0.5 * (reach / SMOOTHING) ** 2)
    time = np.arange(length + 1, dtype=np.float64)[:, None] + reach
    raw = np.interp(np.mod(np.maximum(time, 0.0), period), corners[:, 0], corners[:, 1] / 3.6)
    return Profile("drive cycle of unifg", raw @ weight / weight.sum(), np.zeros(length + 1), 1.0)


def read_profile(path: Path, limits: Limits = LIMITS) -> Profile:
    """Read a CSV file with a header: a column of speeds, one of times, and perhaps one of slopes.

    Args:
        path: columns ``v_ref_mps`` [m/s], ``t_s`` [s] (evenly spaced; without it 1 s apart) and ``slope_rad`` [rad]
            (without it level); others are ignored.
        limits: of what the file may hold.

    Raises:
        FileFormatError: naming the line of what is missing, no number, or no speed, time or slope of a road; also where
            two columns hold the same, or one seems to hold it in another unit, as ``slope_deg``.
    """
    name = legible(path)
    try:
        lines = list(csv.reader(io.StringIO(read_text(path, limits), newline="")))
    except csv.Error as error:
        raise FileFormatError(f"{name}: cannot be read as CSV ({error})") from error
    head = [word.strip() for word in lines[0]] if lines else []
    speed = _column(name, head, lines, SPEED_COLUMNS, (0.0, FASTEST))
    if speed is None:
        columns = ", ".join(head)[:200]
        raise FileFormatError(f"{name}, line 1: no column '{SPEED_COLUMNS[0]}' of speeds (there are: {columns})")
    if len(speed) < 2:
        raise FileFormatError(f"{name}: holds {len(speed)} speeds; a drive needs 2 at least")
    time = _column(name, head, lines, TIME_COLUMNS, (-1e12, 1e12))
    slope = _column(name, head, lines, SLOPE_COLUMNS, (-0.5 * math.pi, 0.5 * math.pi))
    dt = 1.0
    if time is not None:
        steps = np.diff(time)
        dt = float(steps[0])
        uneven = np.flatnonzero(np.abs(steps - dt) > 1e-6 * abs(dt))
        if not 0.0 < dt <= LONGEST_STEP or len(uneven):
            line = 3 + (int(uneven[0]) if len(uneven) else 0)
            text = f"times must grow by the same step throughout, of at most {LONGEST_STEP:g} s"
            raise FileFormatError(f"{name}, line {line}: {text}")
    return Profile(path.name, speed, np.zeros_like(speed) if slope is None else slope, dt)


def _column(
    file: str, head: list[str], lines: list[list[str]], names: tuple[str, ...], within: tuple[float, float]
) -> Array | None:
    """The one of the named columns that is there, with numbers within a range."""
    matching = [k for k, name in enumerate(head) if name in names]
    if not matching and (
        alike := [name for name in head if name.split("_")[0] in {own.split("_")[0] for own in names}]
    ):
        raise FileFormatError(
            f"{file}, line 1: the column '{alike[0]}' is not read: convert it to '{names[0]}', as its unit is another, "
            "or call it otherwise"
        )
    if not matching:
        return None
    if len(matching) > 1:
        both = " and ".join(f"'{head[k]}'" for k in matching[:2])
        raise FileFormatError(f"{file}, line 1: the columns {both} both hold the same: leave one out")
    numbers = []
    for number, line in enumerate(lines[1:], start=2):
        if not any(word.strip() for word in line):
            continue
        value = number_of(line[matching[0]]) if matching[0] < len(line) else None
        if value is None or not math.isfinite(value):
            raise FileFormatError(f"{file}, line {number}: no finite number in column '{head[matching[0]]}'")
        if not within[0] <= value <= within[1]:
            text = f"{value:g} in column '{head[matching[0]]}' is not between {within[0]:g} and {within[1]:g}"
            raise FileFormatError(f"{file}, line {number}: {text}")
        numbers.append(value)
    return np.array(numbers, dtype=np.float64)
