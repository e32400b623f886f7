"""Slow states of a ground robot: angle of the lidar's mount, bias of its ranges, scale of its wheels.

Each is a random walk with a Kalman filter of its own, beside the pose. A lidar that is turned in its mount fits the map
at a heading that is wrong by as much: the robot then moves aside of where it believes to head. Over a way s that the
wheels predict, scans find the robot scale s farther ahead, and mount s to the right. A bias lengthens every beam; with
walls on several sides no pose explains that, so it is the fourth unknown of the least squares of a scan on the map,

    d_i + grad d_i . (dx, dtheta x arm_i - b ray_i) = 0.

Jumps are found sooner, at the pose that the wheels predict from the last one that was not in doubt: where a scan fits
there only when it is turned, or its beams are shortened, three times in a row, the state jumps. Such scans must not
move the estimate, so that it begins anew at this pose. By states that are named scans are put right.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from unifg.lie import SE2
from unifg.models import lidar
from unifg.models.distance_map import DistanceMap
from unifg.models.planar import Base
from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array

__all__ = ["Calibration"]

MOUNT, BIAS, SCALE = range(3)
FIRST = np.array([0.02, 0.02, 0.1])  # [rad, m, 1] standard deviations at the start
WALK = np.array([0.002, 0.002, 0.002])  # the same of the random walks, per root of a second
NAMED = np.array([0.04, 0.045])  # [rad, m]; less is a tolerance of a good robot
SURE = 4.0  # standard deviations that a state is from zero where it is named
GRID = (math.radians(2.0), 10), (0.1, 5)  # [rad, m] between mounts and biases that are tried, and how many each way
FINER = 17  # that are tried about one of them once a jump is sure
STRIDE = 4  # every fourth beam takes part
FAR = 0.3  # [m] from a surface; beams farther off count as that
GAIN = 0.03  # [m] by which a scan that is put right is nearer to the map, on average
FITS = 0.6  # of the distance that it has as it is
TIMES = 3  # ticks in a row
LOOK = 4  # ticks over which motion is compared
WAY = 0.2  # [m] of them, below which nothing is said
PLACE = 0.004  # [m] standard deviation of a place that a scan finds
SKID = 0.06  # [s] drift of a base that turns, per lateral acceleration
KNOWN = 0.03  # standard deviation of the scale, from which on a jump can be told
SCANNED = 0.03  # [m] standard deviation of the bias that a scan says: scans share the errors of the map


class Calibration:
    """Slow states of one robot.

    Attributes:
        state: (3,) mount, to the left [rad], bias [m], and scale of the wheels, as they are believed.
        variance: (3,) of it.
        used: (2,) mount and bias as far as they are named, by which scans are put right; zeros for a good lidar.
        scale_jump: by how much the wheels' scale has differed from the state in the last ticks, at least.
        pose: (3,) where wheels have taken the robot since its pose was last not in doubt; None where it is unknown.
    """

    def __init__(self, distance_map: DistanceMap, dt: float, base: Base) -> None:
        """Begin with a robot that is calibrated, on a map, with ticks of ``dt`` [s]."""
        self.state, self.variance, self.used = np.zeros(3), FIRST**2, np.zeros(2)
        self.scale_jump, self._off = 0.0, tuple[float, ...]()
        self.pose: Array | None = None
        self._map, self._dt, self._base = distance_map, dt, base
        self._doubt, self._change = 0, np.zeros(2)
        self._moved: deque[Array] = deque(maxlen=LOOK)

    def take_over(self, other: Calibration) -> None:
        """Go on with what another one, on another map, has learnt."""
        self.state, self.variance, self.used = other.state, other.variance, other.used

    def right(self, scan: Scan) -> Scan:
        """The scan as a good lidar had taken it."""
        mount, bias = self.used.tolist()
        if not (mount or bias):
            return scan
        return replace(scan, angles=scan.angles + mount, ranges=np.maximum(scan.ranges - bias, 0.0))

    def jumps(self, scan: Scan, wheels: Array) -> bool:
        """Move on by the wheels (m,) to the time of a scan, which has been put right; True where a state jumps."""
        self.variance = self.variance + WALK**2 * self._dt
        if self.pose is None:
            self._doubt = 0
            return False
        self.pose = self._base.step(self.pose[None], wheels[None], self._dt)[0]
        as_it_is = float(self._missed(scan, np.zeros((1, 2)))[0])
        change, missed = np.zeros(2), as_it_is
        if as_it_is > GAIN:
            change, missed = self._best(scan, *(step * np.arange(-most, most + 1.0) for step, most in GRID))
        again = bool((np.abs(change - self._change) < [1.5 * step for step, _ in GRID]).all())
        better = as_it_is - missed > GAIN and missed < FITS * as_it_is
        self._doubt = self._doubt + 1 if better and (again or not self._doubt) else 0
        self._change = change
        if self._doubt < TIMES:
            return False
        which = MOUNT if change[MOUNT] else BIAS
        finer = [np.zeros(0), np.zeros(0)]
        finer[which] = change[which] + GRID[which][0] * np.linspace(-1.0, 1.0, FINER)
        self.state[:2] += self._best(scan, *finer)[0]
        self.variance[which] = FIRST[which] ** 2
        self.used = np.where(np.abs(self.state[:2]) > 0.5 * NAMED, self.state[:2], 0.0)
        self._doubt = 0
        self._moved.clear()
        return True

    def _best(self, scan: Scan, mounts: Array, biases: Array) -> tuple[Array, float]:
        """Mount or bias (2,) with which a scan fits best at the pose by the wheels, and its distance to the map [m]."""
        tried = np.zeros((len(mounts) + len(biases), 2))
        tried[: len(mounts), MOUNT], tried[len(mounts) :, BIAS] = mounts, biases
        missed = self._missed(scan, tried)
        best = int(np.argmin(missed))
        return tried[best], float(missed[best])

    def _missed(self, scan: Scan, tried: Array) -> Array:
        """(k,) mean distances of the ends of beams to the map [m], by mounts and biases (k, 2)."""
        assert self.pose is not None
        beams = scan.within(lidar.DROP_BEYOND)[::STRIDE]
        bearing = self.pose[2] + scan.angles[beams] + tried[:, :1]
        ends = (scan.ranges[beams] - tried[:, 1:])[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        gaps = np.abs(self._map.distance((self.pose[:2] + ends).reshape(-1, 2))).reshape(len(tried), -1)
        missed: Array = np.minimum(gaps, FAR).sum(axis=1) / max(len(beams), 1)
        return missed

    def note(self, scan: Scan | None, predicted: Array, pose: Array, wheels: Array | None) -> None:
        """Take in a tick.

        Args:
            scan: that has been put right and has corrected the estimate; None where none has, or the pose is not known
                to a decimetre.
            predicted: (3,) pose by the wheels [m, m, rad].
            pose: (3,) pose after the scan.
            wheels: (m,) controls they have measured; None where they have not.
        """
        self.scale_jump, before = 0.0, self._off
        self._off = ()
        if self._doubt and self.pose is not None:
            self._moved.clear()
            return
        self.pose = None if scan is None else pose.copy()
        if scan is None or wheels is None:
            self._moved.clear()
            return
        self._learn(BIAS, self.used[BIAS] + self._bias(scan, pose), SCANNED**2)
        ahead, left, _ = SE2.local(predicted, pose)
        velocity = self._base.of(wheels)
        drift = SKID * abs(float(velocity[0] * velocity[-1]))
        self._moved.append(np.array([ahead, left, velocity[0] * self._dt, drift * self._dt]))
        ahead, left, way, drift = np.sum(self._moved, axis=0)
        if abs(way) < WAY or velocity[1:-1].any():
            return
        variance = LOOK * np.array([2.0 * PLACE**2 + drift**2, 2.0 * PLACE**2]) / way**2  # of windows that overlap
        if self.variance[SCALE] < KNOWN**2:
            self._off = (*before, abs(float(ahead / way - self.state[SCALE])))[-TIMES:]
            self.scale_jump = min(self._off) if len(self._off) == TIMES else 0.0
        self._learn(MOUNT, self.used[MOUNT] - left / way, variance[0])
        self._learn(SCALE, ahead / way, variance[1])

    def _bias(self, scan: Scan, pose: Array) -> float:
        """Bias that is left in a scan [m], by the least squares of pose (3,) and bias."""
        beams = scan.within(lidar.DROP_BEYOND)[::STRIDE]
        bearing = pose[2] + scan.angles[beams]
        ray = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        arm = scan.ranges[beams, None] * ray
        distance, slope = self._map.distance_and_gradient(pose[:2] + arm)
        weight = np.maximum(1.0 - np.square(distance / FAR), 0.0)[:, None]
        rows = weight * np.column_stack(
            [slope, slope[:, 1] * arm[:, 0] - slope[:, 0] * arm[:, 1], -(slope * ray).sum(axis=1)]
        )
        # Beams say nothing of a direction that they do not see: then it keeps still.
        return -float(np.linalg.solve(rows.T @ rows + np.eye(4), rows.T @ (weight[:, 0] * distance))[3])

    def _learn(self, which: int, measured: float, variance: float) -> None:
        """Correct a state by a measurement; one that is sure to be no tolerance is used."""
        gain = self.variance[which] / (self.variance[which] + variance)
        self.state[which] += gain * (measured - self.state[which])
        self.variance[which] *= 1.0 - gain
        if which == SCALE:
            return
        size = abs(self.state[which])
        if size > max(NAMED[which], SURE * math.sqrt(self.variance[which])):
            self.used[which] = self.state[which]
        elif size < 0.5 * NAMED[which]:
            self.used[which] = 0.0
