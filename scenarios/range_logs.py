"""Logs of lasers on the command line: opened with what the user says of them, and what was made of one."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from unifg.files.range_log import RangeLog, aligned, read_range_log
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2
from unifg.models.odometry import OdometryNoise
from unifg.models.planar import base_of
from unifg.scenarios.logs.drive_metrics import nees, pose_errors
from unifg.scenarios.options import Settings, existing, option, pose
from unifg.typing import Array

__all__ = ["BASE", "EXPLAINED", "FAILED", "WHEELS", "LogRun", "LogSettings", "step_of"]

WHEELS = OdometryNoise(0.1, 0.1, 0.04)  # of wheels that nobody has calibrated
BASE = base_of("omnidirectional")  # of a log, which does not tell
FAILED = {  # in words, by what was made
    "map": "wrong: the map explains less than half of the beams that it was made of",
    "localise": "lost: the map does not explain the last scans",
}
EXPLAINED = 0.5  # share of beams below which a place or a map is not believed
SCALE, NOISE = 0.05, 0.02  # of odometry that is made of corrected poses, as in `OdometryModel`


@dataclass(frozen=True)
class LogSettings(Settings):
    """Settings of everything that reads a log.

    Attributes:
        log: log with scans and odometry: CARMEN, CSV, MCAP, rosbag2 or drive.npz.
        mount: pose of the laser on the robot, where the odometry is that of the robot [m, m, rad].
        simulated_odometry: the poses in the log are corrected ones: odometry is made of them, with 5 % of scale error
            and 2 % of noise, and they are what errors are counted from.
        seed: of everything random.
    """

    log: Path = option(text=existing("a log of a laser", folders=True), metavar="LOG")
    _: KW_ONLY
    mount: tuple[float, float, float] | None = option(None, text=pose, metavar="X,Y,TH")
    simulated_odometry: bool = option(False)
    seed: int = option(0, metavar="S")

    def opened(self) -> RangeLog:
        """The log, with the odometry that is wanted.

        Raises:
            FileFormatError: the file cannot be read.
        """
        log = read_range_log(self.log)
        if self.mount is not None:
            log = log.mounted(np.array(self.mount))
        if not self.simulated_odometry:
            return log
        corrected = log.odometry if log.corrected is None else log.corrected
        steps, rng = SE2.between(corrected[:-1], corrected[1:]), np.random.default_rng(self.seed)
        scale = 1.0 + SCALE * rng.standard_normal(2)
        told = steps * (scale[[0, 0, 1]] + NOISE * rng.standard_normal(steps.shape))
        odometry = [corrected[0]]
        for step in told:
            odometry.append(SE2.compose(odometry[-1], step))
        return replace(log, odometry=np.array(odometry), corrected=corrected)


@dataclass(frozen=True, eq=False)
class LogRun:
    """A log with the poses that were found, on a map.

    Attributes:
        log: that was read.
        kind: "map" or "localise".
        occupancy: the map, made or given.
        poses: (n, 3) of the laser [m, m, rad].
        share: (n,) of the beams of each scan that the map explains.
        covariance: (n, 3, 3) of the poses in their tangent spaces; None where they are not known one by one.
        hypotheses: (n,) that were held at each scan.
        details: further numbers and words, for the metrics.
        closures: (k, 2) positions of the poses that loop closures join.
        verdict: on the map, in a sentence.
        succeeded: whether the result is to be trusted.
        interrupted: whether the user stopped it.
        seconds: that it took.
    """

    log: RangeLog
    kind: str
    occupancy: OccupancyMap
    poses: Array
    share: Array
    covariance: Array | None = None
    hypotheses: Array = field(default_factory=lambda: np.zeros(0))
    details: dict[str, Any] = field(default_factory=dict)
    closures: Array = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    verdict: str = ""
    succeeded: bool = True
    interrupted: bool = False
    seconds: float = 0.0

    @property
    def odometry(self) -> Array:
        """(n, 3) the way of the wheels from the first pose that was found."""
        start = self.log.odometry[: len(self.poses)]
        return SE2.compose(self.poses[0], SE2.between(start[0], start))

    @cached_property
    def truth(self) -> Array | None:
        """(n, 3) corrected poses of the log, as far as poses were found; None where it has none."""
        return None if self.log.corrected is None else self.log.corrected[: len(self.poses)]

    @cached_property
    def errors(self) -> tuple[Array, Array] | None:
        """(n,) distances from the corrected poses [m], and (n,) from headings [rad]; None without these."""
        return None if self.truth is None else pose_errors(self.poses, self.truth)

    @property
    def nees(self) -> Array:
        """(n,) squared errors against the corrected poses, after alignment, by the covariances; empty without these."""
        if self.covariance is None or self.truth is None:
            return np.zeros(0)
        return nees(aligned(self.poses, self.truth), self.truth, self.covariance)


def step_of(log: RangeLog, begin: int, end: int) -> Array:
    """(3,) motion by the wheels between two scans, as body velocities of one second [m/s, m/s, rad/s]."""
    x, y, turn = SE2.between(log.odometry[begin], log.odometry[end]).tolist()
    cosine, sine = math.cos(0.5 * turn), math.sin(0.5 * turn)
    return np.array([cosine * x + sine * y, cosine * y - sine * x, turn])
