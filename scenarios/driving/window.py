"""The past as a sliding window: odometry and lidar over the last poses, and a prior for what has left.

The window's terms can stand in any graph that has the present pose as a variable: alone, where they are a
fixed-lag smoother, or joined to a control horizon (see :mod:`unifg.scenarios.driving.joint`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.models import lidar, odometry, unicycle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.driving.localiser import BEAM_SIGMA
from unifg.scenarios.seeing.readings import Scan
from unifg.typing import Array, BoolArray

PAST_TERMS = ("arrival", "odometry", "lidar past")
NOW_TERMS = ("arrival now", "odometry now", "lidar now")
STRIDE = 4  # of a past scan every fourth beam is kept, at four times the information
IDLE_INFORMATION = 1.0  # holds slots of the window that no pose has entered yet


@dataclass
class Slot:
    """One pose of the window and what was measured there.

    Attributes:
        pose: (3,) present belief [m, m, rad].
        beams: (B, 2) end-points in the body frame [m].
        seen: (B,) which of them take part.
        step: (3,) odometry's pose of the next slot seen from this one.
        information: (3, 3) of that measurement; zero when there is none.
    """

    pose: Array
    beams: Array
    seen: BoolArray
    step: Array
    information: Array


class Window:
    """The last poses, oldest first; the present one is kept apart.

    Attributes:
        length: number of past poses kept.
        slots: at most ``length`` past poses.
        now: the present pose and its scan.
        arrival: (3,) reference and (3, 3) information about the oldest pose.
        departure: what ``arrival`` becomes when the oldest pose leaves.
    """

    def __init__(self, length: int, pose: Array, covariance: Array, beams: int) -> None:
        """Begin with the present alone.

        Raises:
            ScenarioError: when the window is shorter than two poses.
        """
        if length < 2:
            raise fg.ScenarioError(f"a window needs at least two past poses, found {length}")
        self.length = length
        self.slots: list[Slot] = []
        self.now = self._slot(np.asarray(pose, dtype=np.float64), beams)
        self.arrival: tuple[Array, Array] = (self.now.pose, inverse(covariance))
        self.departure = self.arrival
        self._noise = odometry.OdometryNoise()

    def look(self, scan: Scan) -> None:
        """Attach a scan to the present."""
        self.now.beams = lidar.beam_endpoints(scan.ranges, scan.angles)
        self.now.seen = lidar.usable(scan.ranges)

    def move(self, u: Array, dt: float) -> None:
        """Push the present into the past and predict the next pose by the wheels' velocities ``u`` (2,)."""
        here = np.zeros(3)
        self.now.step = unicycle.step(here[None], u[None], dt)[0]
        self.now.information = inverse(self._noise.covariance(u, dt))
        self.slots.append(self.now)
        self.now = self._slot(fg.SE2.compose(self.now.pose, self.now.step), len(self.now.beams))
        if len(self.slots) > self.length:
            self.slots.pop(0)
            self.arrival = self.departure

    @property
    def full(self) -> bool:
        """Whether the next move drops the oldest pose."""
        return len(self.slots) == self.length

    def _slot(self, pose: Array, beams: int) -> Slot:
        return Slot(pose, np.zeros((beams, 2)), np.zeros(beams, dtype=bool), np.zeros(3), np.zeros((3, 3)))


class WindowTerms:
    """The window's terms in one graph, and the data that fill them.

    Attributes:
        past: family of past poses.
        present: selection of the present pose.
    """

    def __init__(
        self, graph: fg.Graph, present: fg.Selection, distance_map: DistanceMap, length: int, beams: int
    ) -> None:
        """Add priors, odometry and lidar factors for ``length`` past poses and the present."""
        kept = len(range(0, beams, STRIDE))
        self.length, self._kept, self._map = length, kept, distance_map
        self._loss = lidar.endpoint_loss(BEAM_SIGMA, distance_map.resolution)
        self.present = present
        self.past = past = graph.variables("past", fg.SE2, length)
        square = np.zeros((length, 3, 3))
        self._means = graph.data("arrival means", np.zeros((length, 3)), each=True)
        self._weights = graph.data("arrival information", square, each=True)
        self._mean = graph.data("arrival mean now", np.zeros(3))
        self._weight = graph.data("arrival information now", np.zeros((3, 3)))
        self._steps = graph.data("odometry steps", np.zeros((length - 1, 3)), each=True)
        self._trust = graph.data("odometry information", square[1:], each=True)
        self._step = graph.data("odometry step now", np.zeros(3))
        self._trust_now = graph.data("odometry information now", np.zeros((3, 3)))
        self._points = graph.data("past end-points", np.zeros((length * kept, 2)), each=True)
        self._seen = graph.data("past seen", np.zeros(length * kept, dtype=bool), each=True)
        self._points_now = graph.data("end-points now", np.zeros((beams, 2)), each=True)
        self._seen_now = graph.data("seen now", np.zeros(beams, dtype=bool), each=True)
        self._counts = graph.data("past beam information", np.zeros((length * kept, 1, 1)), each=True)
        self._counts_now = graph.data("beam information now", np.zeros((beams, 1, 1)), each=True)
        graph.minimize(fg.prior, past, self._means, information=self._weights, name="arrival")
        graph.minimize(fg.prior, present, self._mean, information=self._weight, name="arrival now")
        graph.minimize(fg.between, past[:-1], past[1:], self._steps, information=self._trust, name="odometry")
        graph.minimize(fg.between, past[-1], present, self._step, information=self._trust_now, name="odometry now")
        endpoint = lidar.endpoint(distance_map)
        which = np.repeat(np.arange(length), kept)
        for counts, poses, points, seen, name in (
            (self._counts, past[which], self._points, self._seen, "lidar past"),
            (self._counts_now, present, self._points_now, self._seen_now, "lidar now"),
        ):
            graph.minimize(endpoint, poses, points, information=counts, active=seen, name=name)

    def data(self, window: Window) -> dict[fg.Data, Array]:
        """What the window knows, with empty slots held in place by a weak prior.

        Which beams count, and by how much, is decided here at the present beliefs and holds for the whole solve: a
        beam that changes its weight from one iteration to the next can keep a solver going round for ever, and a long
        step of the plan could throw out every beam that ties the estimate to the map.
        """
        length, kept, count = self.length, self._kept, len(window.slots)
        empty = length - count
        means, weights = np.tile(window.now.pose, (length, 1)), np.zeros((length, 3, 3))
        weights[:empty] = IDLE_INFORMATION * np.eye(3)
        steps, trust = np.zeros((length, 3)), np.zeros((length, 3, 3))
        points, seen = np.zeros((length, kept, 2)), np.zeros((length, kept), dtype=bool)
        for k, slot in enumerate(window.slots, start=empty):
            steps[k], trust[k] = slot.step, slot.information
            points[k], seen[k] = slot.beams[::STRIDE], slot.seen[::STRIDE]
        now = window.now
        counts = self._information(np.repeat(self.poses(window), kept, axis=0), points.reshape(-1, 2)) * STRIDE
        counts_now = self._information(now.pose[None], now.beams)
        mean, weight = now.pose, np.zeros((3, 3))
        if count:
            means[empty], weights[empty] = window.arrival
        else:
            mean, weight = window.arrival
        return {
            self._means: means,
            self._weights: weights,
            self._mean: mean,
            self._weight: weight,
            self._steps: steps[:-1],
            self._trust: trust[:-1],
            self._step: steps[-1],
            self._trust_now: trust[-1],
            self._points: points.reshape(-1, 2),
            self._seen: seen.ravel() & (counts > 0.0),
            self._points_now: now.beams,
            self._seen_now: now.seen & (counts_now > 0.0),
            self._counts: counts[:, None, None],
            self._counts_now: counts_now[:, None, None],
        }

    def _information(self, x: Array, beams: Array) -> Array:
        """(n,) information of end-points (n, 2) [1/m^2] by the weights of Bazzana et al., section VII-A."""
        distance = self._map.distance(lidar.in_world(x, beams))
        return self._loss.weight((distance / BEAM_SIGMA) ** 2) / BEAM_SIGMA**2

    def poses(self, window: Window) -> Array:
        """(length, 3) guess for the past."""
        known = [slot.pose for slot in window.slots]
        return np.array([window.now.pose] * (self.length - len(known)) + known)

    def move(self, window: Window, solution: fg.Solution) -> None:
        """Take the estimate from a solution."""
        poses = solution[self.past]
        for slot, pose in zip(window.slots, poses[self.length - len(window.slots) :], strict=True):
            slot.pose = pose
        window.now.pose = solution[self.present][0]

    def accept(self, window: Window, solution: fg.Solution) -> None:
        """Take the estimate from a solution; marginalise the oldest pose if the next move drops it."""
        self.move(window, solution)
        if window.full:
            mean, weight = solution.marginal_prior(PAST_TERMS, self.past[0], self.past[1])
            window.departure = mean[0], weight

    def covariance(self, solution: fg.Solution) -> Array:
        """(3, 3) covariance of the present pose from the past's terms alone, whatever else the graph wishes."""
        matrix = solution.information((*PAST_TERMS, *NOW_TERMS), self.past, self.present)
        return inverse(matrix)[-3:, -3:]


def inverse(matrix: Array) -> Array:
    """Inverse of a covariance or information matrix."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
