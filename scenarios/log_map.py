"""A map of a log: scans registered on those before, loops closed where old ones are seen again, one pose graph.

Every keyframe is registered on the last ones (:class:`~unifg.scenarios.ground.localiser.Localiser`: a prior by the
wheels, a factor for every beam); pose and covariance become an edge to the keyframe before. Where older keyframes are
as near as the drift since the last closure may have carried the robot, the last few scans together are searched for
among theirs (Olson, *Real-time correlative scan matching*, ICRA 2009), and registered there: a loop closure. Where the
best place has a rival, as in a corridor, the closure says nothing of the direction to it. The graph is solved whenever
closures have come, at the end with graduated non-convexity, and judged.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from unifg.errors import ScenarioError
from unifg.factors.robust import DCS, TruncatedLeastSquares
from unifg.files.range_log import RangeLog
from unifg.lie import SE2
from unifg.models import lidar
from unifg.models.distance_map import DistanceMap
from unifg.pose_graphs import Edges, PoseGraph
from unifg.scenarios.episode import Progress, silent
from unifg.scenarios.ground.hypotheses import Hypothesis
from unifg.scenarios.ground.localiser import Localiser
from unifg.scenarios.ground.relocalise import nearest_fit
from unifg.scenarios.options import option, positive
from unifg.scenarios.perception.explaining import explained
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.scan_map import field_of, mapped
from unifg.scenarios.pose_graph import OUTLIER_WEIGHT, threshold
from unifg.scenarios.range_logs import BASE, EXPLAINED, WHEELS, LogRun, LogSettings, step_of
from unifg.solvers import GaussNewton, GraduatedNonConvexity
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["MapSettings", "map_log"]

MOVED = np.array([0.4, 0.4, 0.3])  # motion between keyframes [m, m, rad]
RECENT = 15  # keyframes that the next one is registered on
VIEW = 20.0  # [m] of beams that are registered on others
OLD = 8.0  # [m] driven, after which a place is come back to
TOGETHER = 4  # keyframes that look for a closure together
POINTS = 360  # of theirs
NEAR = 6.0  # [m] from a place, within which keyframes have seen it
FEWEST, MOST = 4, 60  # of them
DRIFT = (0.7, 0.04, 4.0)  # [m] and its growth with the way since the last closure, up to
TURNED = (0.1, 0.01, 0.6)  # [rad]
SLIP, SLIPS = (0.3, 0.36), 0.1  # [m, rad] and the share of belief of wheels that have slipped
FOUND = np.diag([0.3, 0.3, 0.04]) ** 2  # of a place that a search has found
BEST = 0.75  # share of points that have to end at old ones
ENDS = 0.12  # [m] from them
TURNS = 1.0  # [rad] by the wheels, from which on those of the map are compared with them
OPEN = "no loop was closed: the map is as good as the registration of one scan on the next"
EVERY = 5  # closures after which the graph is solved
SHIFT, TURN = 0.2, 0.05  # [m, rad] by which a closure moves the last pose, after which it is solved at once


@dataclass(frozen=True)
class MapSettings(LogSettings):
    """A log to be made a map of.

    Attributes:
        resolution: side of a cell [m].
        reach: of the beams that make the map [m].
    """

    resolution: float = option(0.05, text=positive, metavar="M")
    reach: float = option(12.0, text=positive, metavar="M")


def map_log(log: RangeLog, settings: MapSettings, progress: Progress = silent) -> tuple[LogRun, PoseGraph]:
    """Make a map of a log; an interrupt makes it of what has been read so far.

    Args:
        log: that was read.
        settings: of how.
        progress: called with the share done, and a line of text; may raise KeyboardInterrupt.

    Returns:
        The map with the poses of all scans, and the solved pose graph of the keyframes.

    Raises:
        ScenarioError: the lidar has seen nothing.
        KeyboardInterrupt: when stopped before there are two keyframes.
    """
    if not lidar.usable(log.ranges, VIEW).any():
        raise ScenarioError(f"{log.name}: no beam of it came back from within {VIEW:g} m: see its ranges [m]")
    began = time.perf_counter()
    start = (log.odometry if log.corrected is None else log.corrected)[0]
    mapper, chosen, interrupted = Mapper(log.angles, start), [0], False
    mapper.add(log.ranges[0], np.zeros(3))
    try:
        for k in range(1, len(log)):
            step = step_of(log, chosen[-1], k)
            if (np.abs(step) > MOVED).any() or (k == len(log) - 1 and len(chosen) == 1):
                mapper.add(log.ranges[k], step)
                chosen.append(k)
                closed = len(mapper.edges) + 1 - len(chosen)
                progress(0.9 * k / len(log), f"scan {k} of {len(log)}, {closed} loop closures")
    except KeyboardInterrupt:
        if len(mapper.poses) < 2:
            raise
        interrupted, chosen = True, chosen[: len(mapper.poses)]
    graph, kept = mapper.solved()
    joined = np.column_stack([graph.edges.first, graph.edges.second])[~graph.edges.odometry & kept]
    verdict = graph.verdict(effort="cheap", used=kept, tolerance=1e-4) if len(joined) else None
    number = len(log) if not interrupted else chosen[-1] + 1
    nearest = np.searchsorted(chosen, np.arange(number), side="right") - 1
    frames = np.array(chosen)[nearest]
    poses = SE2.compose(graph.poses[nearest], SE2.between(log.odometry[frames], log.odometry[:number]))
    occupancy = mapped(log.angles, log.ranges[chosen], graph.poses, settings.resolution, settings.reach)
    around = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    share = [explained(around, Scan(log.angles, log.ranges[k]), poses[k]).share for k in range(number)]
    wheels, turns = (SE2.between(poses[:-1], poses[1:])[:, 2] for poses in (log.odometry[chosen], graph.poses))
    ratio = float(turns @ wheels / (wheels @ wheels)) if np.abs(wheels).sum() > TURNS else 1.0
    numbers = {
        "keyframes": len(chosen), "loop_closures": len(joined), "outliers": int((~kept).sum()),
        "chi2": float(graph.squared_errors()[kept].sum()), "degrees_of_freedom": 3 * len(joined),
        "claim": verdict.claim if verdict else "", "searches": mapper.searches, "turns_over_wheels": ratio,
    }  # fmt: skip
    run = LogRun(
        log, "map", occupancy, poses, np.array(share), details=numbers, closures=np.array(chosen)[joined],
        verdict=verdict.sentence() if verdict else OPEN, succeeded=bool(np.mean(share) >= EXPLAINED),
        interrupted=interrupted, seconds=time.perf_counter() - began,
    )  # fmt: skip
    return run, graph


@dataclass
class Mapper:
    """Keyframes and edges, in the making.

    Attributes:
        angles: (b,) of the beams [rad].
        start: (3,) first pose [m, m, rad].
        points: of each keyframe, (k, 2) in its frame [m].
        poses: of each keyframe, (3,).
        way: [m] driven until each keyframe.
        edges: positions of two keyframes, the pose of the second seen from the first, its covariance (3, 3).
        closed: way at the last loop closure [m].
        waiting: closures since the graph was solved.
        searches: for closures.
    """

    angles: Array
    start: Array
    points: list[Array] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    way: list[float] = field(default_factory=list)
    edges: list[tuple[int, int, Array, Array]] = field(default_factory=list)
    closed: float = 0.0
    waiting: int = 0
    searches: int = 0

    def add(self, ranges: Array, step: Array) -> None:
        """Add a keyframe, its scan (b,) taken after body velocities (3,) of one second since the one before."""
        scan, number = Scan(self.angles, ranges), len(self.poses)
        seen = lidar.usable(ranges, VIEW)
        self.points.append(lidar.beam_endpoints(ranges[seen], self.angles[seen], VIEW))
        if not number:
            self.poses.append(self.start)
            self.way.append(0.0)
            return
        predicted, covariance = BASE.step(self.poses[-1][None], step[None], 1.0)[0], WHEELS.covariance(step, 1.0)
        known, pose = self._seen_from(np.arange(max(0, number - RECENT), number)), predicted
        if len(known) and seen.any():  # else the wheels alone know
            around = field_of(known)
            slipped, _ = nearest_fit(around, scan, predicted, *SLIP)
            believed = [Hypothesis(predicted, covariance), Hypothesis(slipped, FOUND, SLIPS)]
            pose, covariance = registered(around, scan, believed)
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
        self.searches += 1
        last = np.arange(max(0, number - TOGETHER + 1), number + 1)
        known = self._seen_from(near[np.argsort(away[near])[:MOST]])
        view = SE2.act(SE2.inverse(here), self._seen_from(last))
        if not len(view) or not len(known):
            return
        view = view[np.linspace(0, len(view) - 1, min(POINTS, len(view))).astype(np.intp)]
        scan = Scan(np.arctan2(view[:, 1], view[:, 0]), np.hypot(*view.T))
        around = field_of(known)
        found, aside = nearest_fit(around, scan, here, drift, turned)
        pose, covariance = registered(around, scan, [Hypothesis(found, FOUND)])
        ends = np.abs(around.distance(SE2.act(pose, view))) <= ENDS
        if ends.mean() < BEST:
            return
        if aside.any():  # nobody knows where along a corridor
            along = np.array([*SE2.act(np.array([0.0, 0.0, -pose[2]]), aside[None])[0] / np.hypot(*aside), 0.0])
            covariance = covariance + (drift + 1.0) ** 2 * np.outer(along, along)
        other = int(near[np.argmin(np.hypot(*(poses[near, :2] - pose[:2]).T))])
        self.edges.append((other, number, SE2.between(self.poses[other], pose), covariance))
        self.closed, self.waiting = self.closed if aside.any() else self.way[number], self.waiting + 1
        off = np.abs(SE2.between(here, pose))
        if self.waiting >= EVERY or off[:2].max() > SHIFT or off[2] > TURN:
            graph, x, guess = self.graph().graph(robust=DCS(1.0))
            self.poses, self.waiting = list(GaussNewton().solve(graph, guess)[x]), 0

    def graph(self) -> PoseGraph:
        """Pose graph of what has been measured so far."""
        first, second, measured, covariance = (np.array(part) for part in zip(*self.edges, strict=True))
        edges = Edges(first, second, measured, np.linalg.inv(covariance))
        return PoseGraph(np.arange(len(self.poses)), np.array(self.poses), edges)

    def solved(self) -> tuple[PoseGraph, BoolArray]:
        """The solved pose graph, and which edges (m,) it keeps."""
        before, loss = self.graph(), TruncatedLeastSquares(threshold(SE2.dim))
        if len(self.edges) < len(self.poses):
            return before, before.edges.odometry  # nothing contradicts the chain
        graph, x, guess = before.graph(robust=loss)
        after = before.with_poses(GraduatedNonConvexity().solve(graph, guess)[x])
        weights = np.asarray(loss.weight(after.squared_errors()))
        return after, (weights >= OUTLIER_WEIGHT) | after.edges.odometry


def registered(around: DistanceMap, scan: Scan, believed: Sequence[Hypothesis]) -> tuple[Array, Array]:
    """Pose (3,) and covariance (3, 3) of a scan on a field, from where it may be."""
    localiser = Localiser(around, believed[0].pose, np.ones(3), len(scan.angles))
    localiser.spread_out(scan, believed)
    return localiser.pose, localiser.covariance
