"""What the robot can know of obstacles that are not on the map: discs tracked over lidar scans.

`unifg.scenarios.seeing.discs` finds discs in one scan; here they become tracks. Each track runs two small Kalman
filters side by side, one of a disc that stands still and one of a disc at constant velocity (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, chapter 6). A track is still until
its velocity is beyond doubt. Things out of view are remembered while they stand still, and forgotten soon
once they move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.models.distance_map import DistanceMap
from unifg.scenarios.seeing.discs import DiscFinder, Discs
from unifg.scenarios.worlds.plane import Scan
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["Tracker", "Tracks", "nearest"]

_GATE = 0.4  # [m]; a disc farther than this from where a track is expected is another disc
_SPEED_FLOOR = 0.1  # [m/s]; slower counts as standing still
_ACCELERATION = 0.3  # [m/s^2]; standard deviation of the acceleration of a disc that has not moved yet
_BRISK = 0.45  # [m/s^2]; of one that has: it stops, turns round and goes on from one moment to the next
_SURPRISE = 6.0  # squared innovation, in variances, that only a change of motion explains
_FIRST_SPEED = 0.2  # [m/s]; standard deviation of the velocity of a new track, per axis
_DRIFT = 0.03  # [m/sqrt(s)]; how fast the memory of a standing disc fades
_CLEAR_LIMIT = 3  # scans in a row that see through a remembered disc before it is dropped
_PATIENCE = 1.5  # [s]; a mover unseen for longer is forgotten
_RADIUS_SIGMA_FLOOR = 0.008  # [m]; a radius is never held for better known


@dataclass(frozen=True)
class Tracks:
    """Obstacles the robot believes in, world frame.

    Attributes:
        centre: (m, 2) [m].
        velocity: (m, 2) [m/s]; zero for discs that stand still.
        radius: (m,) [m].
        identity: (m,) number of the track, kept for its lifetime.
        unseen: (m,) time since the track was last seen [s].
        mover: (m,) whether it has ever moved; what stands now may go on.
    """

    centre: Array
    velocity: Array
    radius: Array
    identity: IntArray
    unseen: Array
    mover: BoolArray

    def __len__(self) -> int:
        """Number of tracks."""
        return len(self.radius)

    def at(self, index: IntArray | BoolArray) -> Tracks:
        """The tracks chosen by an index array or a mask."""
        return Tracks(
            self.centre[index],
            self.velocity[index],
            self.radius[index],
            self.identity[index],
            self.unseen[index],
            self.mover[index],
        )


def nearest(tracks: Tracks, position: ArrayLike, count: int, horizon: float = 1.5) -> Tracks:
    """The tracks that matter most at a place: those whose hulls are, or will soon be, nearest to it.

    Args:
        tracks: all tracks.
        position: (2,) or (3,), of which x and y count [m].
        count: greatest number of tracks returned.
        horizon: how far ahead moving tracks are followed [s].

    Returns:
        At most ``count`` tracks, nearest first.
    """
    place = np.asarray(position, dtype=np.float64)[:2]
    offset = place - tracks.centre
    travel = horizon * tracks.velocity
    along = np.sum(offset * travel, axis=1) / np.maximum(np.sum(travel**2, axis=1), 1e-12)
    closest = offset - np.clip(along, 0.0, 1.0)[:, None] * travel
    hull = np.linalg.norm(closest, axis=1) - tracks.radius
    return tracks.at(np.argsort(hull, kind="stable")[:count])


class Tracker:
    """Keeps track of discs that the map does not show, scan by scan.

    Position and velocity covariances are the same along x and y, so one 2 x 2 covariance (position, velocity)
    per track serves both axes, and all tracks are filtered together.
    """

    def __init__(self, distance_map: DistanceMap, *, finder: DiscFinder | None = None) -> None:
        """Start without tracks.

        Args:
            distance_map: distance to the surfaces of the map the robot was given.
            finder: how discs are found in a scan; None for the usual settings.
        """
        self.finder = finder or DiscFinder(distance_map)
        self._next_identity = 0
        self._mean = np.zeros((0, 2, 2))  # [:, 0] position, [:, 1] velocity
        self._covariance = np.zeros((0, 2, 2))
        self._anchor = np.zeros((0, 2))  # position if standing still
        self._anchor_variance = np.zeros(0)
        self._radius = np.zeros(0)
        self._radius_information = np.zeros(0)
        self._identity = np.zeros(0, dtype=np.intp)
        self._hits = np.zeros(0, dtype=np.intp)
        self._unseen = np.zeros(0)
        self._clear = np.zeros(0, dtype=np.intp)
        self._moving = np.zeros(0, dtype=bool)
        self._has_moved = np.zeros(0, dtype=bool)

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
        self._correct(track, disc, discs)
        missed = np.ones(len(self._identity), dtype=bool)
        missed[track] = False
        self._review(missed, scan, place, dt)
        new = np.ones(len(discs.radius), dtype=bool)
        new[disc] = False
        if new.any():
            self._open(discs, new)
        return self.tracks()

    def tracks(self) -> Tracks:
        """The confirmed tracks as they stand."""
        confirmed = self._hits >= 2
        moving, has_moved = self._moving[confirmed, None], self._has_moved[confirmed, None]
        return Tracks(  # a mover that stands is not averaged over time: it would lag behind when it goes on
            centre=np.where(has_moved, self._mean[confirmed, 0], self._anchor[confirmed]),
            velocity=np.where(moving, self._mean[confirmed, 1], 0.0),
            radius=self._radius[confirmed],
            identity=self._identity[confirmed],
            unseen=self._unseen[confirmed],
            mover=self._has_moved[confirmed],
        )

    def _predict(self, dt: float) -> None:
        transition = np.array([[1.0, dt], [0.0, 1.0]])
        agility = np.where(self._has_moved, _BRISK, _ACCELERATION)[:, None, None]
        noise = agility**2 * np.array([[dt**4 / 4.0, dt**3 / 2.0], [dt**3 / 2.0, dt**2]])
        self._mean = transition @ self._mean
        self._covariance = transition @ self._covariance @ transition.T + noise
        self._anchor_variance = self._anchor_variance + _DRIFT**2 * dt

    def _associate(self, discs: Discs) -> tuple[IntArray, IntArray]:
        """Pairs (track, disc), nearest first, each used once, none farther apart than the gate."""
        expected = np.where(self._has_moved[:, None], self._mean[:, 0], self._anchor)
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

    def _correct(self, track: IntArray, disc: IntArray, discs: Discs) -> None:
        if track.size == 0:
            return
        seen = discs.centre[disc]
        variance = _centre_variance(discs.distance[disc])
        covariance = self._covariance[track]
        innovation = seen - self._mean[track, 0]
        # A mover that turns round surprises the filter: let its velocity go rather than lag behind.
        surprise = np.sum(innovation**2, axis=1) / (covariance[:, 0, 0] + variance) > _SURPRISE
        covariance[surprise, 1, 1] += _FIRST_SPEED**2
        covariance[surprise, 0, 0] += 0.05**2
        gain = covariance[:, :, 0] / (covariance[:, 0, 0] + variance)[:, None]
        self._mean[track] += gain[:, :, None] * innovation[:, None, :]
        self._covariance[track] = covariance - gain[:, :, None] * covariance[:, None, 0, :]

        anchor_gain = self._anchor_variance[track] / (self._anchor_variance[track] + variance)
        self._anchor[track] += anchor_gain[:, None] * (seen - self._anchor[track])
        self._anchor_variance[track] *= 1.0 - anchor_gain

        information = discs.radius_sigma[disc] ** -2.0
        total = self._radius_information[track] + information
        self._radius[track] += information / total * (discs.radius[disc] - self._radius[track])
        self._radius_information[track] = np.minimum(total, _RADIUS_SIGMA_FLOOR**-2)

        self._hits[track] += 1
        self._unseen[track] = 0.0
        self._clear[track] = 0
        self._judge_motion(track, variance)

    def _judge_motion(self, track: IntArray, variance: Array) -> None:
        """Decide which tracks move: velocity beyond doubt to begin, plainly slow to end."""
        speed = np.linalg.norm(self._mean[track, 1], axis=1)
        spread = np.sqrt(self._covariance[track, 1, 1])
        begins = (speed > _SPEED_FLOOR) & (speed > 3.0 * spread) & (self._hits[track] >= 4)
        moving = np.where(self._moving[track], speed > _SPEED_FLOOR, begins)
        self._moving[track] = moving
        self._has_moved[track] |= moving
        moved = track[moving]
        self._anchor[moved] = self._mean[moved, 0]
        self._anchor_variance[moved] = variance[moving]

    def _review(self, missed: BoolArray, scan: Scan, pose: Array, dt: float) -> None:
        """Age the tracks that were not seen; drop those seen through, gone or found by chance."""
        if not missed.any():
            return
        self._unseen[missed] += dt
        through = np.zeros_like(missed)
        through[missed] = self._seen_through(missed, scan, pose)
        self._clear[through] += 1
        limit = np.where(self._moving, 2, _CLEAR_LIMIT)
        gone = (self._hits < 2) | (self._clear >= limit) | (self._moving & (self._unseen > _PATIENCE))
        if (gone & missed).any():
            self._keep(~(gone & missed))

    def _seen_through(self, which: BoolArray, scan: Scan, pose: Array) -> BoolArray:
        """(n,) True for tracks through whose middle most beams pass clear and that no beam meets nearer."""
        centre = np.where(self._moving[which, None], self._mean[which, 0], self._anchor[which])
        offset = centre - pose[:2]
        distance = np.linalg.norm(offset, axis=1)
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
        spacing = 2.0 * np.pi / len(scan.angles)
        half = np.maximum(0.5 * self._radius[which] / np.maximum(distance, 0.1), 0.6 * spacing)
        away = np.abs((scan.angles - bearing[:, None] + np.pi) % (2.0 * np.pi) - np.pi)
        aimed = (away < half[:, None]) & ~np.isnan(scan.ranges)
        clear = aimed & (scan.ranges > (distance + 0.1)[:, None])
        aimed_count = aimed.sum(axis=1)
        through: BoolArray = (aimed_count > 0) & (clear.sum(axis=1) > 0.7 * aimed_count)
        through &= distance < self.finder.range_max
        return through

    def _open(self, discs: Discs, new: BoolArray) -> None:
        """Begin a track for every disc that no track explains."""
        count = int(np.count_nonzero(new))
        variance = _centre_variance(discs.distance[new])
        mean = np.zeros((count, 2, 2))
        mean[:, 0] = discs.centre[new]
        covariance = np.zeros((count, 2, 2))
        covariance[:, 0, 0] = variance
        covariance[:, 1, 1] = _FIRST_SPEED**2
        identity = self._next_identity + np.arange(count, dtype=np.intp)
        self._next_identity += count
        self._mean = np.concatenate([self._mean, mean])
        self._covariance = np.concatenate([self._covariance, covariance])
        self._anchor = np.concatenate([self._anchor, discs.centre[new]])
        self._anchor_variance = np.concatenate([self._anchor_variance, variance])
        self._radius = np.concatenate([self._radius, discs.radius[new]])
        self._radius_information = np.concatenate([self._radius_information, discs.radius_sigma[new] ** -2.0])
        self._identity = np.concatenate([self._identity, identity])
        self._hits = np.concatenate([self._hits, np.ones(count, dtype=np.intp)])
        self._unseen = np.concatenate([self._unseen, np.zeros(count)])
        self._clear = np.concatenate([self._clear, np.zeros(count, dtype=np.intp)])
        self._moving = np.concatenate([self._moving, np.zeros(count, dtype=bool)])
        self._has_moved = np.concatenate([self._has_moved, np.zeros(count, dtype=bool)])

    def _keep(self, keep: BoolArray) -> None:
        self._mean, self._covariance = self._mean[keep], self._covariance[keep]
        self._anchor, self._anchor_variance = self._anchor[keep], self._anchor_variance[keep]
        self._radius, self._radius_information = self._radius[keep], self._radius_information[keep]
        self._identity, self._hits = self._identity[keep], self._hits[keep]
        self._unseen, self._clear = self._unseen[keep], self._clear[keep]
        self._moving, self._has_moved = self._moving[keep], self._has_moved[keep]


def _centre_variance(distance: Array) -> Array:
    """Variance per axis of a disc's centre [m^2]: fit and pose, and the heading error over the distance."""
    variance: Array = 0.03**2 + (0.01 * distance) ** 2
    return variance
