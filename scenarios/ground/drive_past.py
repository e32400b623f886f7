"""The driving robot's past: odometry and lidar over the last poses, a fixed-lag smoother that registers scans on a map.

Alone, or joined to the horizon, where the plan and the estimate share the present pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import unifg as fg
from unifg.horizon import Context, Robot, Window
from unifg.models import lidar, odometry, unicycle
from unifg.models.distance_map import DistanceMap
from unifg.models.odometry import predict
from unifg.models.planar import Base
from unifg.scenarios.ground.localiser import (
    BEAM_SIGMA,
    FEWEST_BEAMS,
    MATCHING,
    deskewed,
    least,
    scan_covariance,
)
from unifg.scenarios.perception.readings import Scan
from unifg.solvers import GaussNewton
from unifg.typing import Array, ArrayLike, IntArray

WINDOW = 4  # past poses
STRIDE = 4  # of a past scan every fourth beam is kept, at four times the information
ROUNDS = 8  # of choosing the beams that count and moving the estimate
STEADY = 0.01  # [m, rad]; an estimate that moves less has found its beams


def robot(dt: float, base: Base = unicycle.BASE) -> Robot:
    """A base that is at a pose (3,) [m, m, rad], with a control (m,) held over ``dt`` [s]."""
    return Robot(fg.SE2, fg.Rn(base.size), predict=lambda x, u: base.step(x[None], u[None], dt)[0])


@dataclass(frozen=True)
class Odometry:
    """The wheels' measured velocities, which stand for the controls that were applied, between consecutive poses."""

    dt: float
    base: Base = unicycle.BASE
    noise: odometry.OdometryNoise = field(default_factory=odometry.OdometryNoise)

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add a relative measurement for every step."""
        steps = len(x) - 1
        measured = graph.data("odometry: measured", np.zeros((steps, 3)), each=True)
        information = graph.data("odometry: information", np.zeros((steps, 3, 3)), each=True)
        graph.minimize(fg.between, x[:-1], x[1:], measured, information=information, name="odometry")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """The next pose seen from each, and how surely."""
        controls, empty = now.past.controls, now.past.empty
        information = np.zeros((len(controls), 3, 3))
        covariances = [self.noise.covariance(self.base.of(u), self.dt) for u in controls[empty:]]
        if covariances:
            information[empty:] = np.linalg.inv(covariances)
        steps = self.base.step(np.zeros((len(controls), 3)), controls, self.dt)
        return {"odometry: measured": steps, "odometry: information": information}


@dataclass(frozen=True)
class Registration:
    """End-points of the beams on the map, all those of the present scan and some of the past ones.

    Which beams count, and by how much, is decided at the present beliefs and holds for the whole solve: a beam that
    changes its weight from one iteration to the next can keep a solver going round for ever, and a long step of the
    plan could throw out every beam that ties the estimate to the map.
    """

    distance_map: DistanceMap
    beams: int

    @property
    def records(self) -> Mapping[str, tuple[int, ...]]:
        """A scan: end-points in the body frame [m], and whether a beam takes part."""
        return {"scan": (self.beams, 3)}

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add a factor for every beam."""
        which = self._poses(len(x))
        points = graph.data("lidar: end-points", np.zeros((len(which), 2)), each=True)
        counting = graph.data("lidar: which count", np.zeros(len(which), dtype=bool), each=True)
        weights = graph.data("lidar: information", np.zeros((len(which), 1, 1)), each=True)
        endpoint = lidar.endpoint(self.distance_map)
        graph.minimize(endpoint, x[which], points, information=weights, active=counting, name="lidar")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """End-points, and their information [1/m^2]."""
        scans, seen = now.past.recorded("scan")
        which = self._poses(len(scans))
        rows = np.concatenate([scans[:-1, ::STRIDE].reshape(-1, 3), scans[-1]])
        share = np.where(which == len(scans) - 1, 1.0, float(STRIDE))
        distance = self.distance_map.distance(lidar.in_world(now.past.states[which], rows[:, :2]))
        information = MATCHING.weight((distance / BEAM_SIGMA) ** 2) / BEAM_SIGMA**2 * share
        counting = (rows[:, 2] > 0.0) & seen[which] & (information > 0.0)
        return {
            "lidar: end-points": rows[:, :2],
            "lidar: which count": counting,
            "lidar: information": information[:, None, None],
        }

    def _poses(self, count: int) -> IntArray:
        """Of every factor, for ``count`` poses."""
        kept = len(range(0, self.beams, STRIDE))
        return np.concatenate([np.repeat(np.arange(count - 1), kept), np.full(self.beams, count - 1)])


class Smoother:
    """A window that takes scans and odometry.

    Attributes:
        window: the past.
        covariance: (3, 3) of the present pose, in the tangent space, by what the scans leave unexplained.
    """

    def __init__(
        self, distance_map: DistanceMap, pose: Array, sigma: ArrayLike, beams: int, dt: float, length: int = WINDOW,
        base: Base = unicycle.BASE,
    ) -> None:  # fmt: skip
        """Begin at a pose (3,), believed with ``sigma`` (3,) or a covariance (3, 3)."""
        self.window = Window(
            robot(dt, base), length, [Odometry(dt, base), Registration(distance_map, beams)], start=pose, sigma=sigma,
            solver=GaussNewton(max_iterations=12, step_tolerance=1e-3), rounds=ROUNDS, steady=STEADY,
        )  # fmt: skip
        self._looked = True
        self._map, self._noise, self._base = distance_map, odometry.OdometryNoise(), base
        self.covariance = self.window.state_covariance

    @property
    def pose(self) -> Array:
        """(3,) present pose by the past alone [m, m, rad]."""
        return self.window.present

    @property
    def iterations(self) -> int:
        """Gauss-Newton iterations of the last registration."""
        return self.window.iterations

    @property
    def refused(self) -> str:
        """Why the last scan has not corrected the estimate, "" where it has."""
        return "" if self._looked else "no scan"

    def update(self, scan: Scan | None, odometry: Array | None, dt: float) -> None:
        """Move the window by odometry (m,), None for none, attach the scan, if there is one, and register it."""
        skew = np.zeros((3, 3))
        if odometry is not None:
            self.covariance = predict(self.pose, self.covariance, odometry, dt, self._noise, self._base)[1]
            self.window.move(odometry)
            scan, skew = deskewed(scan, self._base.of(odometry))
        self._looked = scan is not None
        if scan is not None:
            self.look(scan)
        self.window.estimate()
        if scan is not None and lidar.usable(scan.ranges).sum() >= FEWEST_BEAMS:
            self.covariance = least(self.covariance, scan_covariance(self._map, scan, self.pose) + skew)

    def reset(self, pose: Array, sigma: Array) -> None:
        """Begin anew at a pose (3,), believed with ``sigma`` (3,)."""
        self.window.reset(pose, sigma)
        self.covariance = np.diag(sigma**2)

    def look(self, scan: Scan) -> None:
        """Attach a scan to the present."""
        usable = lidar.usable(scan.ranges)
        ends = lidar.beam_endpoints(scan.ranges, scan.angles)
        self.window.record("scan", np.column_stack([np.where(usable[:, None], ends, 0.0), usable]))
