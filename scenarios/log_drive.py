"""A log on a map: the localiser of the drive over recorded scans and odometry."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unifg.errors import ScenarioError
from unifg.files.range_log import RangeLog
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.episode import Progress, silent
from unifg.scenarios.ground.localiser import FEWEST_BEAMS, FITS, Localiser
from unifg.scenarios.ground.protocols import Estimator
from unifg.scenarios.ground.relocalise import Relocaliser, refine
from unifg.scenarios.options import existing, option, pose
from unifg.scenarios.perception.explaining import FARTHEST, explained
from unifg.scenarios.perception.monte_carlo import MonteCarlo, MonteCarloSettings
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.range_logs import BASE, EXPLAINED, WHEELS, LogRun, LogSettings, step_of
from unifg.typing import Array

__all__ = ["LocaliseSettings", "localise"]

SIGMA = np.array([0.1, 0.1, 0.05])  # of a pose to begin at [m, m, rad]
SURE = 0.05, 0.03  # [m, rad] of a prediction that is one place to begin at: scans of logs lie apart
STILL = 0.05  # [m] and [rad], up to which a robot has not moved, and sees nothing new
LOOKED = 30  # scans at most whose places are searched for on the map
RADIUS = 0.1  # [m] that a laser keeps from walls
LAST = 20  # of them


@dataclass(frozen=True)
class LocaliseSettings(LogSettings):
    """A log to be localised.

    Attributes:
        map: ROS map, its YAML file.
        start: pose of the laser at the first scan [m, m, rad]; without one that of the log where it fits the map, or
            the map is searched.
        localiser: that of this library, or a Monte Carlo localiser to compare with.
    """

    map: Path = option(text=existing("the YAML file of a ROS map"), metavar="MAP.yaml")
    start: tuple[float, float, float] | None = option(None, text=pose, metavar="X,Y,TH")
    localiser: str = option("graph", choices=("graph", "amcl"))


def localise(log: RangeLog, occupancy: OccupancyMap, settings: LocaliseSettings, progress: Progress = silent) -> LogRun:
    """Find the beginning of a log on a map, and follow it.

    Args:
        log: that was read.
        occupancy: the map.
        settings: of how.
        progress: called with the share done, and a line of text; may raise KeyboardInterrupt.

    Raises:
        ScenarioError: the place of the first scan on the map is not known.
        KeyboardInterrupt: when stopped before the first scan.
    """
    field = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    progress(0.0, "where the log begins")
    start = np.array(settings.start) if settings.start else beginning(log, occupancy, field)
    began, estimator = time.perf_counter(), _estimator(settings, occupancy, field, start, len(log.angles))
    poses, covariance, share, hypotheses, refused = [], [], [], [], dict[str, int]()
    last, interrupted = 0, False
    for k in range(len(log)):
        step, scan = step_of(log, last, k), Scan(log.angles, log.ranges[k])
        if not k or np.abs(step).max() > STILL:
            estimator.update(scan, step if k else None, 1.0)
            last = k
            if estimator.refused:
                refused[estimator.refused] = refused.get(estimator.refused, 0) + 1
        here = SE2.compose(estimator.pose, SE2.between(log.odometry[last], log.odometry[k]))
        poses.append(here)
        covariance.append(estimator.covariance)
        share.append(explained(field, scan, here).share)
        hypotheses.append(getattr(estimator, "hypotheses", 1))
        try:
            progress((k + 1) / len(log), f"scan {k + 1} of {len(log)}, {100 * share[-1]:.0f} % explained")
        except KeyboardInterrupt:
            interrupted = True
            break
    found = bool(np.mean(share[-LAST:]) >= EXPLAINED)
    return LogRun(
        log, "localise", occupancy, np.array(poses), np.array(share), np.array(covariance), np.array(hypotheses),
        {"localiser": settings.localiser, "refused": refused, "start": start.tolist()},
        succeeded=found, interrupted=interrupted, seconds=time.perf_counter() - began,
    )  # fmt: skip


def _estimator(
    settings: LocaliseSettings, occupancy: OccupancyMap, field: DistanceMap, start: Array, beams: int
) -> Estimator:
    if settings.localiser == "amcl":
        rng, trusted = np.random.default_rng(settings.seed), MonteCarloSettings(noise=(0.01,) * 4)
        return MonteCarlo(occupancy, field, start, SIGMA, rng, trusted, BASE)
    return Localiser(field, start, SIGMA, beams, BASE, WHEELS, SURE)


def beginning(log: RangeLog, occupancy: OccupancyMap, field: DistanceMap) -> Array:
    """Pose (3,) of the first scan: that of the log where it fits the map, otherwise the one a search finds.

    Raises:
        ScenarioError: no scan near the beginning has a place that is like no other.
    """
    scan = Scan(log.angles, log.ranges[0])
    for known in (log.corrected, log.odometry):
        if known is not None:
            near = refine(field, scan, known[0])
            if explained(field, scan, near).share >= FITS and np.abs(SE2.between(known[0], near))[:2].max() < 0.5:
                return near
    search, cause = Relocaliser(occupancy, field, RADIUS), ""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(log.odometry[:, :2], axis=0).T))])
    for k in np.unique(np.searchsorted(way, np.arange(LOOKED) * 0.5))[:LOOKED].tolist():
        if k == len(log):
            break
        scan = Scan(log.angles, log.ranges[k])
        if len(scan.within(FARTHEST)) < FEWEST_BEAMS:
            cause = "too few beams"
            continue
        search.begin(scan)
        while (found := search.search()) is None:
            pass
        if found.pose is not None:
            return SE2.compose(found.pose, SE2.between(log.odometry[k], log.odometry[0]))
        cause = cause or found.cause
    raise ScenarioError(f"{log.name}: where it begins on the map is not known, {cause}; give --start=X,Y,THETA")
