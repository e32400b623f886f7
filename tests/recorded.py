"""Logs of a lidar in made buildings: corridors with doors, wheels that err, people before the beams."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from unifg.files.range_log import RangeLog
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2, wrap_angle
from unifg.models.distance_map import DistanceMap
from unifg.typing import Array

SIDE = 2.4  # [m] width of the corridors


def corridors(size: tuple[float, float] = (22.0, 14.0), seed: int = 0) -> tuple[OccupancyMap, Array]:
    """A loop of corridors with rooms on both sides of the long ones, and corners (k, 2) of a way twice around."""
    rng, cell, margin = np.random.default_rng(seed), 0.05, 6.0
    width, height = size
    occupied = np.ones((round((height + 2 * margin) / cell), round((width + 2 * margin) / cell)), dtype=bool)

    def fill(left: float, low: float, right: float, top: float, solid: bool = False) -> None:
        a, b, c, d = (round((value + margin) / cell) for value in (low, top, left, right))
        occupied[a:b, c:d] = solid

    fill(0, 0, width, height)
    fill(SIDE, SIDE, width - SIDE, height - SIDE, solid=True)
    for wall, out in ((0.0, -1), (SIDE, 1), (height - SIDE, -1), (height, 1)):
        left = SIDE + 0.8
        while left < width - SIDE - 4.0:
            wide, deep, door = *rng.uniform(2.5, 4.0, 2), rng.uniform(0.3, 1.5)
            low, top = sorted((wall + 0.15 * out, wall + deep * out))
            fill(left, low, left + wide, top)
            low, top = sorted((wall, wall + 0.2 * out))
            fill(left + door, low, left + door + 0.9, top)
            left += wide + 0.3
    middle = 0.5 * SIDE
    around = [(middle, middle), (width - middle, middle), (width - middle, height - middle), (middle, height - middle)]
    name = f"corridors {seed}"
    return OccupancyMap(occupied, ~occupied, cell, (-margin, -margin, 0.0), name), np.array(
        [*around, *around, around[0]]
    )


def way(corners: Array, step: float, rng: np.random.Generator) -> Array:
    """Poses (n, 3) about every step [m] from corner to corner, and while turning there."""
    poses: list[Array] = []
    for begin, end in pairwise(corners):
        heading, length = math.atan2(*(end - begin)[::-1]), float(np.hypot(*(end - begin)))
        if poses:
            turn = float(wrap_angle(heading - poses[-1][2]))
            poses += [np.array([*poses[-1][:2], poses[-1][2] + share * turn]) for share in (0.3, 0.3, 0.5)]
        for share in np.arange(0.0, 1.0, step / length):
            aside = 0.15 * math.sin(12.0 * share) * np.array([-math.sin(heading), math.cos(heading)])
            poses.append(np.array([*(begin + share * (end - begin) + aside), heading + rng.normal(0.0, 0.05)]))
    return np.array(poses)


def cast(field: DistanceMap, poses: Array, angles: Array, reach: float) -> Array:
    """True ranges (n, b) [m], infinite beyond the reach, by marching along the distance field."""
    bearing = poses[:, 2:] + angles
    ahead, ranges = np.stack([np.cos(bearing), np.sin(bearing)], axis=2), np.zeros(bearing.shape)
    for _ in range(400):
        free = field.distance(poses[:, None, :2] + ranges[:, :, None] * ahead)
        moving = (free > 0.01) & (ranges < reach)
        if not moving.any():
            break
        ranges += np.where(moving, np.maximum(free, 0.01), 0.0)
    return np.where(ranges < reach, ranges, np.inf)


def wheels(poses: Array, rng: np.random.Generator, noise: float = 0.03, scale: float = 0.05, slips: int = 0) -> Array:
    """Odometry (n, 3) with errors of scale and noise, and sudden slips."""
    steps = SE2.between(poses[:-1], poses[1:])
    told = steps * (1.0 + scale * rng.standard_normal(2))[[0, 0, 1]] * (1.0 + noise * rng.standard_normal(steps.shape))
    told[:, 2] += 0.5 * noise * np.hypot(*steps[:, :2].T) * rng.standard_normal(len(steps))
    told[rng.choice(len(steps), slips, replace=False)] += [0.25, 0.0, 0.12]
    odometry = [poses[0]]
    for step in told:
        odometry.append(SE2.compose(odometry[-1], step))
    return np.array(odometry)


def recorded(
    occupancy: OccupancyMap, corners: Array, seed: int = 0, *, step: float = 0.7, beams: int = 180,
    view: float = math.pi, reach: float = 30.0, noise: float = 0.03, slips: int = 0,
) -> RangeLog:  # fmt: skip
    """A log whose corrected poses are the truth."""
    rng = np.random.default_rng(seed)
    field = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    poses, angles = way(corners, step, rng), view * (np.arange(beams) / beams - 0.5)
    ranges = cast(field, poses, angles, reach) + 0.02 * rng.standard_normal((len(poses), beams))
    for row in ranges[rng.random(len(poses)) < 0.2]:
        first = int(rng.integers(beams - 10))
        row[first : first + 10] = np.minimum(row[first : first + 10], rng.uniform(0.6, 2.0))
    ranges[rng.random(ranges.shape) < 0.01] = np.nan
    return RangeLog(
        "made", np.arange(len(poses), dtype=np.float64), angles, ranges, wheels(poses, rng, noise, slips=slips), poses
    )


def write_csv(path: Path, log: RangeLog, unit: float = 1.0) -> None:
    """Write a log as a table; ``unit`` of times over seconds."""
    header = [
        "time",
        "x",
        "y",
        "theta",
        "corrected_x",
        "corrected_y",
        "corrected_theta",
        *map(str, log.angles.tolist()),
    ]
    assert log.corrected is not None
    rows = np.column_stack([unit * log.time, log.odometry, log.corrected, log.ranges])
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows.tolist()])
