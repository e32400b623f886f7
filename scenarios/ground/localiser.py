"""Localiser: one pose, one odometry prior, 360 beams on the distance map (Bazzana et al. 2022, section IV)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import unifg as fg
from unifg.lie import SE2
from unifg.models import lidar, odometry, unicycle
from unifg.models.distance_map import DistanceMap
from unifg.models.planar import Base
from unifg.scenarios.ground.hypotheses import REACH, Hypothesis, gathered, mixed, weighed
from unifg.scenarios.perception.explaining import explained
from unifg.scenarios.perception.readings import Scan
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
LEAST = 0.01  # [m] of a beam's standard deviation, whatever the residuals of a scan say
WITHIN = odometry.OdometryNoise(floor=(0.0, 0.0, 0.0))  # of the wheels within a turn of the lidar
FARTHEST, LEVER = 1e3, 1.0  # [m] standard deviation, and per radian, of what a scan says nothing about
LARGEST_JUMP = 0.5  # [m]; a correction beyond this is a mistake of the matching, not of the wheels
SURE = 0.12, 0.06  # [m, rad]; a prediction that is less sure than this begins at several places
FITS = 0.6  # share of the beams that the map explains, below which there may be a better place
FOUND = 0.85  # share that it has to explain at another place
ASTRAY = np.diag([0.15, 0.15, 0.06]) ** 2  # that a scan which does not fit adds to the covariance [m, m, rad]
ABOUT = 0.3  # [m] of a match, within which a mean is that of its draws
OFTEN, SELDOM = 10, 5  # scans in a row that do not fit, after which only every so many is tried at other places
CERTAIN = 0.98  # share of the belief of a hypothesis that stands alone


class Localiser:
    """A compiled localisation graph, solved anew each tick.

    The prior of a tick is that of beams of ``BEAM_SIGMA``: it holds the estimate against scans that fit elsewhere. How
    sure the estimate is says ``covariance``, by the residuals.

    Attributes:
        pose: (3,) estimate [m, m, rad].
        covariance: (3, 3) in the tangent space at the estimate.
        iterations: Gauss-Newton iterations of the last update.
        refused: why the last scan has not corrected the estimate, "" where it has.
    """

    def __init__(
        self,
        distance_map: DistanceMap,
        pose: Array,
        sigma: Array,
        beams: int,
        base: Base = unicycle.BASE,
        noise: odometry.OdometryNoise | None = None,
        sure: tuple[float, float] = SURE,
    ) -> None:
        """State the graph.

        Args:
            distance_map: signed distance of the map.
            pose: (3,) initial estimate [m, m, rad].
            sigma: (3,) its standard deviations [m, m, rad].
            beams: number of beams in a scan.
            base: that the odometry is of.
            noise: of the odometry; None for that of good wheels.
            sure: standard deviations [m, rad] up to which a prediction is one place to begin at.
        """
        self.pose = np.asarray(pose, dtype=np.float64)
        self.covariance = self._held = np.diag(np.asarray(sigma, dtype=np.float64) ** 2)
        self.iterations, self.refused = 0, ""
        self._believed: list[Hypothesis] = []
        self._misses = 0
        self._sure = sure
        self._rng = np.random.default_rng(0)
        self._map, self._skew = distance_map, np.zeros((3, 3))
        self._noise, self._base = noise or odometry.OdometryNoise(), base
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
        several = np.zeros((2, 3))  # what hypotheses need is loaded here, not in the tick that first has them
        SE2.compose(several, SE2.exp(SE2.local(several, several)))

    @property
    def hypotheses(self) -> int:
        """Number of poses that may be right."""
        return max(1, len(self._believed))

    def update(self, scan: Scan | None, odometry: Array | None, dt: float) -> None:
        """Move by odometry (m,) since the last scan, None for none, and register a scan, if there is one."""
        if odometry is not None:
            self.predict(odometry, dt)
            scan, self._skew = deskewed(scan, self._base.of(odometry))
        if scan is None:
            self.iterations, self.refused = 0, "no scan"
        else:
            self.correct(scan)

    def reset(self, pose: Array, sigma: Array) -> None:
        """Begin anew at a pose (3,), believed with ``sigma`` (3,)."""
        self.pose, self._believed, self._misses = pose.copy(), [], 0
        self.covariance = self._held = np.diag(sigma**2)

    def predict(self, u: Array, dt: float) -> None:
        """Move the estimate, and what else may be right, by the wheels' measured controls (m,)."""
        moved = (
            (odometry.predict(one.pose, one.covariance, u, dt, self._noise, self._base), one.weight)
            for one in self._believed
        )
        self._believed = [Hypothesis(*predicted, weight) for predicted, weight in moved]
        self.covariance = odometry.predict(self.pose, self.covariance, u, dt, self._noise, self._base)[1]
        self.pose, self._held = odometry.predict(self.pose, self._held, u, dt, self._noise, self._base)

    def correct(self, scan: Scan) -> None:
        """Register a scan on the map; a scan that says too little leaves the prediction, and ``refused`` says so."""
        self.iterations, self.refused = 0, ""
        if lidar.usable(scan.ranges).sum() < FEWEST_BEAMS:
            self.refused = "too few beams"
            return
        kept = self.pose, self.covariance, self._held
        elsewhere, self._misses = self._misses < OFTEN or not self._misses % SELDOM, self._misses + 1
        if elsewhere and (self._believed or not self._is_sure()):
            self.spread_out(scan)
            if explained(self._map, scan, self.pose).share >= FITS:
                self._misses = 0
                return
            (self.pose, self.covariance, self._held), self._believed = kept, []
        corrected, held = self._solve(scan, self.pose, self._held, lidar.DROP_BEYOND)
        if not float(np.hypot(*(corrected - self.pose)[:2])) <= LARGEST_JUMP:
            self.refused = "it would move the estimate by more than the wheels can be wrong"
            return
        if explained(self._map, scan, corrected).share >= FITS:
            self._misses = 0
        elif elsewhere:
            self.spread_out(scan, [Hypothesis(self.pose, self.covariance + ASTRAY)])
            if explained(self._map, scan, self.pose).share >= FOUND:
                self._misses = 0
                return
            self._believed = []  # a map that is wrong fits somewhere a little better, too
        seen = scan_covariance(self._map, scan, corrected) + self._skew
        self.pose, self.covariance, self._held = corrected, least(kept[1], seen), held

    def _is_sure(self) -> bool:
        """Test whether a prediction is as good as one place to begin at."""
        spread = float(np.linalg.eigvalsh(self.covariance[:2, :2])[-1])
        return spread <= self._sure[0] ** 2 and float(self.covariance[2, 2]) <= self._sure[1] ** 2

    def _solve(self, scan: Scan, pose: Array, held: Array, reach: float) -> tuple[Array, Array]:
        """Pose (3,) and covariance (3, 3) that a scan makes of a prediction."""
        information = np.linalg.inv(held)
        solution = self._run.solve(
            {self._x: pose[None, :]},
            data={
                self._prior: pose,
                self._information: 0.5 * (information + information.T),
                self._beams: lidar.beam_endpoints(scan.ranges, scan.angles, reach),
                self._seen: lidar.usable(scan.ranges, reach),
            },
        )
        self.iterations += solution.iterations
        return solution[self._x][0], solution.covariance(self._x)

    def spread_out(self, scan: Scan, believed: Sequence[Hypothesis] = ()) -> None:
        """Weigh draws from all that may be right, or from what is given, and register a scan where they gather."""
        believed = believed or self._believed or [Hypothesis(self.pose, self.covariance)]
        found = gathered(*weighed(self._map, scan, believed, self._rng))
        better = []
        for one in found:
            pose = self._solve(scan, one.pose, one.covariance, REACH)[0]
            better.append(replace(one, pose=pose, covariance=one.covariance + self._skew))
        # The mean of draws about a match is nearer than the match, which leans on the kinks of the field.
        again = gathered(*weighed(self._map, scan, better, self._rng))
        for number, one in enumerate(better):
            nearest = min(again, key=lambda other: float(np.hypot(*(other.pose - one.pose)[:2])))
            if np.hypot(*(nearest.pose - one.pose)[:2]) < ABOUT:
                better[number] = replace(one, pose=nearest.pose)
        self.pose, self._held, self.covariance = better[0].pose, better[0].covariance, mixed(better)
        self._believed = better if better[0].weight < CERTAIN * sum(one.weight for one in better) else []


def deskewed(scan: Scan | None, velocity: Array) -> tuple[Scan | None, Array]:
    """A scan as it would look at its end, and the covariance (3, 3) that wrong body velocities (k,) give its pose.

    They move the middle of the turn, and the whole scan with it.
    """
    if scan is None or not scan.turn:
        return scan, np.zeros((3, 3))
    return scan.deskewed(velocity), WITHIN.covariance(velocity, 0.5 * scan.turn)


def scan_covariance(distance_map: DistanceMap, scan: Scan, pose: Array) -> Array:
    """Covariance (3, 3) in the tangent space of a pose (3,) where a scan fits best, by how well it fits.

    The variance of a beam is that of its own residuals. Beams count for as little as the autocorrelation of the
    residuals says, summed up to its first zero (Geyer 1992, *Practical Markov chain Monte Carlo*, section 3.3): they
    share the errors of the map. What is shared by all that is seen leaves no residual; it is taken for as large as what
    neighbours share.
    """
    seen = lidar.usable(scan.ranges)
    ends = lidar.beam_endpoints(scan.ranges[seen], scan.angles[seen])
    distance, gradient = distance_map.distance_and_gradient(SE2.act(pose, ends))
    weight = np.sqrt(MATCHING.weight((distance / BEAM_SIGMA) ** 2))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    along, across = c * gradient[:, 0] + s * gradient[:, 1], c * gradient[:, 1] - s * gradient[:, 0]
    slopes = np.column_stack([along, across, across * ends[:, 0] - along * ends[:, 1]]) * weight[:, None]
    error = weight * distance
    variance = max(float(error @ error) / max(float(weight @ weight) - 3.0, 1.0), LEAST**2)
    beams, shared = _correlated(error)
    information = slopes.T @ slopes / (variance * beams)
    scale = np.diag([1.0, 1.0, LEVER**-2]) / FARTHEST**2  # what nothing is seen of
    return np.linalg.inv(information + scale) + shared * variance * np.diag([1.0, 1.0, 0.0])


def _correlated(error: Array) -> tuple[float, float]:
    """Number of beams that say as much as one by itself would, and the share of the variance that neighbours share."""
    count = len(error)
    correlation = np.fft.irfft(np.abs(np.fft.rfft(error, 2 * count)) ** 2)[:count]
    if not correlation[0] > 0.0:
        return 1.0, 0.0
    correlation /= correlation[0]
    until = int(np.argmax(correlation <= 0.0)) or count
    by_chance = 2.0 / np.sqrt(count)
    return max(1.0, 1.0 + 2.0 * float(correlation[1:until].sum())), max(0.0, float(correlation[1]) - by_chance)


def least(one: Array, other: Array) -> Array:
    """Covariance (n, n) of who goes by the better of two in every direction, as their errors may be the same.

    Successive scans share the errors of the map, so that they do not average out. In the coordinates in which the first
    is the identity and the second diagonal, the lesser variances are taken.
    """
    root = np.linalg.cholesky(one)
    whitened = np.linalg.solve(root, np.linalg.solve(root, other).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    axes = root @ vectors
    found: Array = (axes * np.minimum(values, 1.0)) @ axes.T
    return found
