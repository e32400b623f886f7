"""A map of a log: scans registered on those before, loops closed where old ones are seen again, one pose graph.

Every keyframe is registered on the last ones (:class:`~unifg.scenarios.ground.localiser.Localiser`: a prior by the
wheels, a factor for every beam); pose and covariance become an edge to the keyframe before. Where older keyframes are
near, as near as the drift since the last closure may have carried them, the last few scans together are searched for
among theirs (Olson, *Real-time correlative scan matching*, ICRA 2009), and registered there: a loop closure. The graph is
solved whenever closures have come, at the end with graduated non-convexity, and judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from unifg.factors.robust import DCS, TruncatedLeastSquares
from unifg.files.range_log import RangeLog, read_range_log
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2, wrap_angle
from unifg.models import lidar
from unifg.models.distance_map import DistanceMap
from unifg.models.odometry import OdometryNoise
from unifg.pose_graphs import Edges, PoseGraph
from unifg.pose_graphs.verdict import Verdict
from unifg.scenarios.episode import Progress, silent
from unifg.scenarios.ground.localiser import Localiser
from unifg.scenarios.ground.relocalise import nearest_fit
from unifg.scenarios.options import existing, option
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.scan_map import field_of, mapped
from unifg.solvers import GaussNewton, GraduatedNonConvexity
from unifg.typing import Array, BoolArray, IntArray

WHEELS = OdometryNoise(0.1, 0.1, 0.04)
MOVED = np.array([0.4, 0.4, 0.3])  # motion between keyframes [m, m, rad]
RECENT = 15  # keyframes that the next one is registered on
VIEW = 12.0  # [m] of beams that are registered on others
OLD = 8.0  # [m] driven, after which a place is come back to
TOGETHER = 4  # keyframes that look for a closure together
POINTS = 360  # of theirs
NEAR = 6.0  # [m] from a place, within which keyframes have seen it
FEWEST = 4  # of them
DRIFT = (0.3, 0.04, 4.0)  # [m] and its growth with the way since the last closure, up to
TURNED = (0.1, 0.01, 0.6)  # [rad]
BEST = 0.75  # share of points that have to end at old ones
ENDS = 0.12  # [m] from them
EVERY = 5  # closures after which the graph is solved


@dataclass
class Mapper:
    """Keyframes and edges, in the making."""

    angles: Array
    scans: list[Scan] = field(default_factory=list)
    points: list[Array] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    way: list[float] = field(default_factory=list)
    edges: list[tuple[int, int, Array, Array]] = field(default_factory=list)
    closed: float = 0.0
    waiting: int = 0
    tries: int = 0

    def add(self, ranges: Array, step: Array) -> None:
        """Add a keyframe, its scan (b,) taken a step (3,) by the wheels after the one before."""
        scan, number = Scan(self.angles, ranges), len(self.poses)
        self.scans.append(scan)
        seen = lidar.usable(ranges, VIEW)
        self.points.append(lidar.beam_endpoints(ranges[seen], self.angles[seen], VIEW))
        if not number:
            self.poses.append(np.zeros(3))
            self.way.append(0.0)
            return
        predicted, covariance = SE2.compose(self.poses[-1], step), WHEELS.covariance(step, 1.0)
        recent = self._seen_from(np.arange(max(0, number - RECENT), number))
        pose, covariance = registered(field_of(recent), scan, predicted, covariance)
        self.edges.append((number - 1, number, SE2.between(self.poses[-1], pose), covariance))
        self.way.append(self.way[-1] + float(np.hypot(*step[:2])))
        self.poses.append(pose)
        self._close(number)

    def _seen_from(self, keyframes: IntArray) -> Array:
        """(n, 2) points that keyframes have seen, where they are believed to be."""
        return np.concatenate([SE2.act(self.poses[k], self.points[k]) for k in keyframes.tolist()])

    def _close(self, number: int) -> None:
        """Look for older keyframes about the last one."""
        since = self.way[number] - self.closed
        drift, turned = (min(a + b * since, most) for a, b, most in (DRIFT, TURNED))
        here, poses = self.poses[number], np.array(self.poses)
        old = np.array(self.way) < self.way[number] - max(OLD, 2.0 * drift)
        away = np.hypot(*(poses[:, :2] - here[:2]).T)
        if not old.any() or away[old].min() > 1.0 + drift:
            return
        near = np.flatnonzero(old & (away < NEAR + drift))
        if len(near) < FEWEST:
            return
        self.tries += 1
        last = np.arange(max(0, number - TOGETHER + 1), number + 1)
        view = SE2.act(SE2.inverse(here), self._seen_from(last))
        view = view[np.linspace(0, len(view) - 1, min(POINTS, len(view))).astype(np.intp)]
        scan = Scan(np.arctan2(view[:, 1], view[:, 0]), np.hypot(*view.T))
        around = field_of(self._seen_from(near[np.argsort(away[near])[:60]]))
        found = nearest_fit(around, scan, here, drift, turned)
        pose, covariance = registered(around, scan, found, np.diag([0.1, 0.1, 0.04]) ** 2)
        ends = np.abs(around.distance(SE2.act(pose, view))) <= ENDS
        if ends.mean() < BEST:
            return
        other = int(near[np.argmin(np.hypot(*(poses[near, :2] - pose[:2]).T))])
        self.edges.append((other, number, SE2.between(self.poses[other], pose), covariance))
        self.closed, self.waiting = self.way[number], self.waiting + 1
        off = np.abs(SE2.between(here, pose))
        if self.waiting >= EVERY or off[:2].max() > 0.2 or off[2] > 0.05:
            self.poses, self.waiting = list(self.solved(DCS(1.0)).poses), 0

    def graph(self) -> PoseGraph:
        """Pose graph of what has been measured so far."""
        first, second, measured, covariance = (np.array(part) for part in zip(*self.edges, strict=True))
        edges = Edges(first, second, measured, np.linalg.inv(covariance))
        return PoseGraph(np.arange(len(self.poses)), np.array(self.poses), edges)

    def solved(self, loss) -> PoseGraph:
        before = self.graph()
        graph, x, guess = before.graph(robust=loss)
        return before.with_poses(GaussNewton().solve(graph, guess)[x])


def registered(around: DistanceMap, scan: Scan, pose: Array, covariance: Array) -> tuple[Array, Array]:
    """Pose (3,) and covariance (3, 3) of a scan on a field, from what is predicted."""
    localiser = Localiser(around, pose, np.ones(3), len(scan.angles))
    localiser.covariance = covariance
    localiser.spread_out(scan)
    return localiser.pose, localiser.covariance
