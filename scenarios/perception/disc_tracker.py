"""Discs that are not on the map, tracked over lidar scans.

`unifg.scenarios.perception.discs` finds discs in one scan; here they become tracks. Each track runs two small Kalman
filters side by side, one of a disc that stands still and one of a disc at constant velocity (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, chapter 6). A track is still until
its velocity is beyond doubt, and again once it was seen in one place for long: a disc half hidden behind another
seems to move while the robot passes, and the robot should not wait for it ever after. Things out of view are remembered
while they stand still, and forgotten soon once they move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.models.distance_map import DistanceMap
from unifg.scenarios.perception.discs import DiscFinder, Discs
from unifg.scenarios.perception.motion_model import MotionModel
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.rows import Rows
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["DiscTracker"]

_GATE = 0.4  # [m]; a disc farther than this from where a track is expected is another disc
_SPEED_FLOOR = 0.1  # [m/s]; slower counts as standing still
_ACCELERATION = 0.3  # [m/s^2]; standard deviation of the acceleration of a disc that has not moved yet
_BRISK = 0.45  # [m/s^2]; of one that has: it stops, turns round and goes on from one moment to the next
_SURPRISE = 6.0  # squared innovation, in variances, that only a change of motion explains
_FIRST_SPEED = 0.2  # [m/s]; standard deviation of the velocity of a new track, per axis
_DRIFT = 0.03  # [m/sqrt(s)]; how fast the memory of a standing disc fades
_CLEAR_LIMIT = 3  # scans in a row that see through a remembered disc before it is dropped
_SETTLED = 10.0  # [s]; what was seen for so long ...
_HOME = 0.15  # [m]; ... no farther than this from one place stands still, whatever it did before
_PATIENCE = 1.5  # [s]; a mover unseen for longer is forgotten
_RADIUS_SIGMA_FLOOR = 0.008  # [m]; a radius is never held for better known


@dataclass(frozen=True)
class _Filters(Rows):
    """Both filters of every track, and what has become of it so far."""

    mean: Array  # (m, 2, 2); [:, 0] position, [:, 1] velocity
    covariance: Array  # (m, 2, 2)
    anchor: Array  # (m, 2) position if standing still
    anchor_variance: Array
    radius: Array
    radius_information: Array
    identity: IntArray
    hits: IntArray
    unseen: Array
    clear: IntArray
    moving: BoolArray
    has_moved: BoolArray
    home: Array  # (m, 2) the place it has not left for the time stayed, while it was seen
    stayed: Array

    @staticmethod
    def of(discs: Discs, identity: IntArray) -> _Filters:
        """New tracks of discs."""
        count = len(identity)
        variance = _centre_variance(discs.distance)
        mean, covariance = np.zeros((count, 2, 2)), np.zeros((count, 2, 2))
        mean[:, 0] = discs.centre
        covariance[:, 0, 0], covariance[:, 1, 1] = variance, _FIRST_SPEED**2
        return _Filters(
            mean, covariance, discs.centre.copy(), variance, discs.radius.copy(), discs.radius_sigma**-2.0, identity,
            np.ones(count, dtype=np.intp), np.zeros(count), np.zeros(count, dtype=np.intp),
            np.zeros(count, dtype=bool), np.zeros(count, dtype=bool), discs.centre.copy(), np.zeros(count),
        )  # fmt: skip


class DiscTracker:
    """Keeps track of discs that the map does not show, scan by scan.

    Position and velocity covariances are the same along x and y, so one 2 x 2 covariance (position, velocity)
    per track serves both axes, and all tracks are filtered together.
    """

    def __init__(self, distance_map: DistanceMap) -> None:
        """Start without tracks.

        Args:
            distance_map: distance to the surfaces of the map the robot was given.
        """
        self.finder = DiscFinder(distance_map)
        self._next_identity, self._motion = 0, MotionModel()
        self._rows = _Filters.of(Discs.none(), np.zeros(0, dtype=np.intp))

    def update(self, scan: Scan, pose: ArrayLike, dt: float) -> Tracks:
        """Take in one scan.

        Args:
            scan: one turn of the lidar.
            pose: (3,) estimated world_T_body at the time of the scan [m, m, rad].
            dt: time since the last update [s].

        Returns:
            The confirmed tracks: those seen at least twice.
        """
        place = np.asarray(pose, dtype=np.float64)
        discs = self.finder.find(scan, place)
        self._predict(dt)
        track, disc = self._associate(discs)
        self._correct(track, disc, discs, dt)
        self._review(~np.isin(np.arange(len(self._rows)), track), scan, place, dt)
        new = ~np.isin(np.arange(len(discs)), disc)
        if new.any():  # no track explains them
            fresh = discs.at(new)
            identity = self._next_identity + np.arange(len(fresh), dtype=np.intp)
            self._next_identity += len(fresh)
            self._rows = self._rows.followed_by(_Filters.of(fresh, identity))
        return self._motion.update(self.tracks(), dt, place[:2])

    def tracks(self) -> Tracks:
        """The confirmed tracks as they stand."""
        rows = self._rows
        confirmed = rows.hits >= 2
        moving, has_moved = rows.moving[confirmed, None], rows.has_moved[confirmed, None]
        return Tracks(  # a mover that stands is not averaged over time: it would lag behind when it goes on
            centre=np.where(has_moved, rows.mean[confirmed, 0], rows.anchor[confirmed]),
            velocity=np.where(moving, rows.mean[confirmed, 1], 0.0),
            radius=rows.radius[confirmed],
            identity=rows.identity[confirmed],
            unseen=rows.unseen[confirmed],
            mover=rows.has_moved[confirmed],
        )

    def _predict(self, dt: float) -> None:
        rows = self._rows
        transition = np.array([[1.0, dt], [0.0, 1.0]])
        agility = np.where(rows.has_moved, _BRISK, _ACCELERATION)[:, None, None]
        noise = agility**2 * np.array([[dt**4 / 4.0, dt**3 / 2.0], [dt**3 / 2.0, dt**2]])
        rows.mean[:] = transition @ rows.mean
        rows.covariance[:] = transition @ rows.covariance @ transition.T + noise
        rows.anchor_variance[:] += _DRIFT**2 * dt

    def _associate(self, discs: Discs) -> tuple[IntArray, IntArray]:
        """Pairs (track, disc), nearest first, each used once, none farther apart than the gate."""
        rows = self._rows
        expected = np.where(rows.has_moved[:, None], rows.mean[:, 0], rows.anchor)
        apart = np.linalg.norm(expected[:, None, :] - discs.centre[None, :, :], axis=2)
        pairs: list[tuple[int, int]] = []
        for flat in np.argsort(apart, axis=None, kind="stable"):
            track, disc = divmod(int(flat), apart.shape[1])
            if apart[track, disc] > _GATE:
                break
            if all(track != t and disc != d for t, d in pairs):
                pairs.append((track, disc))
        chosen = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        return chosen[:, 0], chosen[:, 1]

    def _correct(self, track: IntArray, disc: IntArray, discs: Discs, dt: float) -> None:
        if track.size == 0:
            return
        rows = self._rows
        seen = discs.centre[disc]
        variance = _centre_variance(discs.distance[disc])
        covariance = rows.covariance[track]
        innovation = seen - rows.mean[track, 0]
        # A mover that turns round surprises the filter: let its velocity go rather than lag behind, by as much as the
        # surprise asks for if it is that of one step. When it turned is not known, so the place tells nothing yet.
        away = np.sum(innovation**2, axis=1)
        surprise = away / (covariance[:, 0, 0] + variance) > _SURPRISE
        covariance[surprise, 0, 0] += away[surprise]
        covariance[surprise, 1, 1] += away[surprise] / dt**2
        gain = covariance[:, :, 0] / (covariance[:, 0, 0] + variance)[:, None]
        rows.mean[track] += gain[:, :, None] * innovation[:, None, :]
        rows.covariance[track] = covariance - gain[:, :, None] * covariance[:, None, 0, :]

        anchor_gain = rows.anchor_variance[track] / (rows.anchor_variance[track] + variance)
        rows.anchor[track] += anchor_gain[:, None] * (seen - rows.anchor[track])
        rows.anchor_variance[track] *= 1.0 - anchor_gain

        information = discs.radius_sigma[disc] ** -2.0
        total = rows.radius_information[track] + information
        rows.radius[track] += information / total * (discs.radius[disc] - rows.radius[track])
        rows.radius_information[track] = np.minimum(total, _RADIUS_SIGMA_FLOOR**-2)

        rows.hits[track] += 1
        rows.unseen[track] = rows.clear[track] = 0
        self._judge_motion(track, variance)
        self._count_rest(track, dt)

    def _judge_motion(self, track: IntArray, variance: Array) -> None:
        """Decide which tracks move: velocity beyond doubt to begin, plainly slow to end."""
        rows = self._rows
        speed = np.linalg.norm(rows.mean[track, 1], axis=1)
        spread = np.sqrt(rows.covariance[track, 1, 1])
        begins = (speed > _SPEED_FLOOR) & (speed > 3.0 * spread) & (rows.hits[track] >= 4)
        moving = np.where(rows.has_moved[track], speed > _SPEED_FLOOR, begins)
        rows.moving[track] = moving
        rows.has_moved[track] |= moving
        moved = track[moving]
        rows.anchor[moved] = rows.mean[moved, 0]
        rows.anchor_variance[moved] = variance[moving]

    def _count_rest(self, track: IntArray, dt: float) -> None:
        """Take for standing what has not left its place for long."""
        rows = self._rows
        left = np.linalg.norm(rows.mean[track, 0] - rows.home[track], axis=1) > _HOME
        rows.home[track[left]] = rows.mean[track[left], 0]
        rows.stayed[track] = np.where(left, 0.0, rows.stayed[track] + dt)
        resting = track[rows.has_moved[track] & (rows.stayed[track] > _SETTLED)]
        rows.has_moved[resting] = rows.moving[resting] = False
        rows.mean[resting, 1] = 0.0
        rows.covariance[resting, 0, 1] = rows.covariance[resting, 1, 0] = 0.0
        rows.covariance[resting, 1, 1] = _FIRST_SPEED**2
        rows.anchor[resting] = rows.mean[resting, 0]
        rows.anchor_variance[resting] = rows.covariance[resting, 0, 0]

    def _review(self, missed: BoolArray, scan: Scan, pose: Array, dt: float) -> None:
        """Age the tracks that were not seen; drop those seen through, gone or found by chance."""
        if not missed.any():
            return
        rows = self._rows
        rows.unseen[missed] += dt
        rows.clear[missed] += self._seen_through(missed, scan, pose)
        limit = np.where(rows.moving, 2, _CLEAR_LIMIT)
        gone = (rows.hits < 2) | (rows.clear >= limit) | (rows.moving & (rows.unseen > _PATIENCE))
        if (gone & missed).any():
            self._rows = rows.at(~(gone & missed))

    def _seen_through(self, which: BoolArray, scan: Scan, pose: Array) -> BoolArray:
        """(n,) True for tracks through whose middle most beams pass clear and that no beam meets nearer."""
        rows = self._rows
        centre = np.where(rows.moving[which, None], rows.mean[which, 0], rows.anchor[which])
        offset = centre - pose[:2]
        distance = np.linalg.norm(offset, axis=1)
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
        half = np.maximum(0.5 * rows.radius[which] / np.maximum(distance, 0.1), 0.6 * scan.spacing)
        away = np.abs((scan.angles - bearing[:, None] + np.pi) % (2.0 * np.pi) - np.pi)
        aimed = (away < half[:, None]) & ~np.isnan(scan.ranges)
        clear = aimed & (scan.ranges > (distance + 0.1)[:, None])
        count, within = aimed.sum(axis=1), distance < self.finder.range_max
        through: BoolArray = within & (count > 0) & (clear.sum(axis=1) > 0.7 * count)
        return through


def _centre_variance(distance: Array) -> Array:
    """Variance per axis of a disc's centre [m^2]: fit and pose, and the heading error over the distance."""
    return 0.03**2 + (0.01 * distance) ** 2
