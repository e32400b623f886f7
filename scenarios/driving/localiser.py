"""Where am I? One pose, one odometry prior, 360 beams on the distance map (Bazzana et al. 2022, section IV)."""

from __future__ import annotations

import numpy as np

import unifg as fg
from unifg.models import lidar, odometry
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.seeing.readings import Scan
from unifg.solvers import GaussNewton
from unifg.typing import Array

BEAM_SIGMA = 0.1  # [m]; beams share the errors of the map's cells, so each counts for less than its own noise
MATCHING = fg.Tukey(lidar.DISCARD_BEYOND / BEAM_SIGMA)
"""Weight of a beam by its distance to the map, from one on the surface to none at 0.3 m.

Bazzana et al. (section VII-A) count a quarter within one cell and one beyond: a disc beside a wall then pulls four
times as hard as the wall, and the steps of the weights keep Gauss-Newton from converging. Beside unmapped discs that
moved the estimate along a corridor by up to 0.12 m; with a loss that falls steadily it is 0.03 m.
"""
FEWEST_BEAMS = 20
LARGEST_JUMP = 0.5  # [m]; a correction beyond this is a mistake of the matching, not of the wheels


class Localiser:
    """A compiled localisation graph, solved anew each tick.

    Attributes:
        pose: (3,) estimate [m, m, rad].
        covariance: (3, 3) in the tangent space at the estimate.
        iterations: Gauss-Newton iterations of the last update.
        refused: why the last scan has not corrected the estimate, "" where it has.
    """

    def __init__(self, distance_map: DistanceMap, pose: Array, sigma: Array, beams: int) -> None:
        """State the graph.

        Args:
            distance_map: signed distance of the map.
            pose: (3,) initial estimate [m, m, rad].
            sigma: (3,) its standard deviations [m, m, rad].
            beams: number of beams in a scan.
        """
        self.pose = np.asarray(pose, dtype=np.float64)
        self.covariance = np.diag(np.asarray(sigma, dtype=np.float64) ** 2)
        self.iterations, self.refused = 0, ""
        self._noise = odometry.OdometryNoise()
        graph = fg.Graph()
        self._x = graph.variables("robot", fg.SE2, 1)
        self._prior = graph.data("predicted pose", np.zeros(3))
        self._information = graph.data("information", np.eye(3))
        self._beams = graph.data("end-points", np.zeros((beams, 2)), each=True)
        self._seen = graph.data("seen", np.ones(beams, dtype=bool), each=True)
        graph.minimize(fg.prior, self._x, self._prior, information=self._information, name="odometry")
        graph.minimize(
            lidar.endpoint(distance_map),
            self._x,
            self._beams,
            sigma=BEAM_SIGMA,
            robust=MATCHING,
            active=self._seen,
            name="lidar",
        )
        self._run = GaussNewton(max_iterations=12, step_tolerance=1e-5).prepare(graph)

    def update(self, scan: Scan | None, odometry: Array | None, dt: float) -> None:
        """Move by odometry (2,) since the last scan, None for none, and register a scan, if there is one."""
        if odometry is not None:
            self.predict(odometry, dt)
        if scan is None:
            self.iterations, self.refused = 0, "no scan"
        else:
            self.correct(scan)

    def reset(self, pose: Array, sigma: Array) -> None:
        """Begin anew at a pose (3,), believed with ``sigma`` (3,)."""
        self.pose, self.covariance = pose.copy(), np.diag(sigma**2)

    def predict(self, u: Array, dt: float) -> None:
        """Move the estimate by the wheels' measured velocities (2,) [m/s, rad/s]."""
        self.pose, self.covariance = odometry.predict(self.pose, self.covariance, u, dt, self._noise)

    def correct(self, scan: Scan) -> None:
        """Register a scan on the map; a scan that says too little leaves the prediction, and ``refused`` says so."""
        seen = lidar.usable(scan.ranges)
        self.iterations, self.refused = 0, ""
        if seen.sum() < FEWEST_BEAMS:
            self.refused = "too few beams"
            return
        solution = self._run.solve(
            {self._x: self.pose[None, :]},
            data={
                self._prior: self.pose,
                self._information: np.linalg.inv(self.covariance),
                self._beams: lidar.beam_endpoints(scan.ranges, scan.angles),
                self._seen: seen,
            },
        )
        self.iterations = solution.iterations
        corrected = solution[self._x][0]
        jump = float(np.hypot(*(corrected - self.pose)[:2]))
        if not jump <= LARGEST_JUMP:
            self.refused = "it would move the estimate by more than the wheels can be wrong"
            return
        self.pose, self.covariance = corrected, solution.covariance(self._x)
