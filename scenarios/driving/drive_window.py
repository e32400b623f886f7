"""The past as a sliding window: odometry and lidar over the last poses, and a prior for what has left.

The window's terms can stand in any graph that has the present pose as a variable: alone, where they are a
fixed-lag smoother, or joined to a control horizon (see :mod:`unifg.scenarios.driving.drive_joint`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import unifg as fg
from unifg.models import lidar, odometry, unicycle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.driving.localiser import BEAM_SIGMA
from unifg.scenarios.horizon.part import Given
from unifg.scenarios.horizon.past import Window
from unifg.scenarios.seeing.readings import Scan
from unifg.typing import Array, BoolArray

PAST_TERMS = ("arrival", "odometry", "lidar")
NOW_TERMS = tuple(f"{name} now" for name in PAST_TERMS)
STRIDE = 4  # of a past scan every fourth beam is kept, at four times the information
IDLE_INFORMATION = 1.0  # holds places of the window that no pose has entered yet


class PoseWindow(Window):
    """The last poses, oldest first, then the present one, and what was measured there.

    Attributes:
        poses: (L + 1, 3) present beliefs [m, m, rad].
        beams: (L + 1, B, 2) end-points in the body frame [m].
        seen: (L + 1, B) which of them take part.
        steps: (L, 3) odometry's pose of the next one seen from each.
        trust: (L, 3, 3) information of that measurement; zero when there is none.
        arrival: (3,) reference and (3, 3) information about the oldest pose.
    """

    def __init__(self, length: int, pose: Array, covariance: Array, beams: int) -> None:
        """Begin with the present alone."""
        super().__init__(length)
        self.poses = np.tile(np.asarray(pose, dtype=np.float64), (length + 1, 1))
        self.beams, self.seen = np.zeros((length + 1, beams, 2)), np.zeros((length + 1, beams), dtype=bool)
        self.steps, self.trust = np.zeros((length, 3)), np.zeros((length, 3, 3))
        self.arrival = self.departure = self.present.copy(), inverse(covariance)
        self._noise = odometry.OdometryNoise()

    @property
    def present(self) -> Array:
        """(3,) present pose [m, m, rad]."""
        pose: Array = self.poses[-1]
        return pose

    def look(self, scan: Scan) -> None:
        """Attach a scan to the present."""
        self.beams[-1] = lidar.beam_endpoints(scan.ranges, scan.angles)
        self.seen[-1] = lidar.usable(scan.ranges)

    def move(self, u: Array, dt: float) -> None:
        """Push the present into the past and predict the next pose by the wheels' velocities ``u`` (2,)."""
        self.shift(self.poses, self.beams, self.seen, self.steps, self.trust)
        self.steps[-1] = unicycle.step(np.zeros((1, 3)), u[None], dt)[0]
        self.trust[-1] = inverse(self._noise.covariance(u, dt))
        self.poses[-1] = fg.SE2.compose(self.poses[-2], self.steps[-1])
        self.beams[-1], self.seen[-1] = 0.0, False

    def guess(self) -> Array:
        """(L, 3) guess for the past: the present where no pose has entered yet."""
        poses = self.poses[:-1].copy()
        poses[: self.empty] = self.present
        return poses


class PoseTerms:
    """The window's terms in one graph, and the data that fill them: each stated once, for the past and for the present.

    Attributes:
        past: family of past poses.
        present: selection of the present pose.
    """

    def __init__(
        self, graph: fg.Graph, present: fg.Selection, distance_map: DistanceMap, length: int, beams: int
    ) -> None:
        """Add priors, odometry and lidar factors for ``length`` past poses and the present."""
        self.present = present
        self.past = past = graph.variables("past", fg.SE2, length)
        kept = len(range(0, beams, STRIDE))
        which = past[np.repeat(np.arange(length), kept)]
        arrival, odometry_, lidar_ = PAST_TERMS
        arrival_now, odometry_now, lidar_now = NOW_TERMS
        self._arrival = _measured(graph, fg.prior, past, name=arrival)
        self._arrival_now = _measured(graph, fg.prior, present, name=arrival_now)
        self._steps = _measured(graph, fg.between, past[:-1], past[1:], name=odometry_)
        self._step_now = _measured(graph, fg.between, past[-1], present, name=odometry_now)
        self._beams = _registered(graph, which, length * kept, distance_map, lidar_)
        self._beams_now = _registered(graph, present, beams, distance_map, lidar_now)

    def data(self, window: PoseWindow) -> Given:
        """What the window knows, with empty places held where they are by a weak prior.

        Which beams count, and by how much, is decided here at the present beliefs and holds for the whole solve: a
        beam that changes its weight from one iteration to the next can keep a solver going round for ever, and a long
        step of the plan could throw out every beam that ties the estimate to the map.
        """
        length, oldest = window.length, window.empty
        means, weights = np.tile(window.present, (length + 1, 1)), np.zeros((length + 1, 3, 3))
        weights[:oldest] = IDLE_INFORMATION * np.eye(3)
        means[oldest], weights[oldest] = window.arrival
        points, seen = window.beams[:-1, ::STRIDE], window.seen[:-1, ::STRIDE]
        poses = np.repeat(window.guess(), points.shape[1], axis=0)
        return {
            **self._arrival(means[:-1], weights[:-1]),
            **self._arrival_now(means[-1:], weights[-1:]),
            **self._steps(window.steps[:-1], window.trust[:-1]),
            **self._step_now(window.steps[-1:], window.trust[-1:]),
            **self._beams(poses, points.reshape(-1, 2), seen.ravel(), STRIDE),
            **self._beams_now(window.present[None], window.beams[-1], window.seen[-1], 1),
        }

    def move(self, window: PoseWindow, solution: fg.Solution) -> None:
        """Take the estimate from a solution."""
        window.poses[window.empty : -1] = solution[self.past][window.empty :]
        window.poses[-1] = solution[self.present][0]

    def accept(self, window: PoseWindow, solution: fg.Solution) -> None:
        """Take the estimate from a solution; marginalise the oldest pose if the next move drops it."""
        self.move(window, solution)
        if window.full:
            mean, weight = solution.marginal_prior(PAST_TERMS, self.past[0], self.past[1])
            window.departure = mean[0], weight

    def covariance(self, solution: fg.Solution) -> Array:
        """(3, 3) covariance of the present pose from the past's terms alone, whatever else the graph wishes."""
        matrix = solution.information((*PAST_TERMS, *NOW_TERMS), self.past, self.present)
        return inverse(matrix)[-3:, -3:]


def _measured(
    graph: fg.Graph, residual: Any, *variables: fg.Family | fg.Selection, name: str
) -> Callable[[Array, Array], Given]:
    """A residual with a measured pose and its information, zero where nothing is known."""
    count = len(variables[0])
    measured = graph.data(f"{name}: measured", np.zeros((count, 3)), each=True)
    information = graph.data(f"{name}: information", np.zeros((count, 3, 3)), each=True)
    graph.minimize(residual, *variables, measured, information=information, name=name)
    return lambda values, weights: {measured: values, information: weights}


def _registered(
    graph: fg.Graph, poses: fg.Selection, count: int, distance_map: DistanceMap, name: str
) -> Callable[[Array, Array, BoolArray, int], Given]:
    """End-points on the map, each with its weight: by poses, points (n, 2), whether seen, beams each stands for."""
    loss = lidar.endpoint_loss(BEAM_SIGMA, distance_map.resolution)
    points = graph.data(f"{name}: end-points", np.zeros((count, 2)), each=True)
    counting = graph.data(f"{name}: which count", np.zeros(count, dtype=bool), each=True)
    weights = graph.data(f"{name}: information", np.zeros((count, 1, 1)), each=True)
    endpoint = lidar.endpoint(distance_map)
    graph.minimize(endpoint, poses, points, information=weights, active=counting, name=name)

    def data(at: Array, ends: Array, seen: BoolArray, share: int) -> Given:
        # Information [1/m^2] by the weights of Bazzana et al., section VII-A.
        distance = distance_map.distance(lidar.in_world(at, ends))
        information = loss.weight((distance / BEAM_SIGMA) ** 2) / BEAM_SIGMA**2 * share
        return {points: ends, counting: seen & (information > 0.0), weights: information[:, None, None]}

    return data


def inverse(matrix: Array) -> Array:
    """Inverse of a covariance or information matrix."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
