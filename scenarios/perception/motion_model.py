"""Motion of movers, learned from their tracks: one goes on, has stopped, or goes to and fro between two places.

Each hypothesis foretells where a disc will be; its weight follows from how far off that was over the last seconds. To
and fro is a triangular wave along a line, fitted to the track by Gauss-Newton, once it was seen to turn round twice.
Going on is the hypothesis of a track that nothing else explains: such a mover may stop or turn at any time. Whichever
it does, a mover may yield: it stops before a robot in its way, and is told apart by what it does there alone. Once that
is likely enough its motion is no longer taken as known, for it depends on what the robot does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from unifg.scenarios.perception.tracks import Tracks, to_and_fro
from unifg.typing import Array, IntArray

__all__ = ["UNLIKELY", "MotionModel", "Past"]

UNLIKELY = 0.02  # weight of a hypothesis that need not be kept off
MEMORY = 160  # places of a track that are kept
AHEAD = 5  # scans ahead that a hypothesis is held against; so many errors in a row are one
SIGMA = 0.1  # [m] of what a right hypothesis foretells
WORST = 3.0  # errors, in SIGMA, beyond which they tell no more
LATELY = 20  # places where a mover that may turn round may soon be again
SHORTEST = 0.4  # [m] between ends
ASIDE = 0.12  # [m] off the line, root mean square, that is still a line
GONE = 30.0  # [s] after which the motion of a track that was lost is forgotten
ADOPTED = 0.4  # [m] from the line of a lost track at which a new one goes on with its past
BOTH = 3  # scans before and after a turn that show it
STARTS = 40  # places on the round trip from which the fit may begin
STEPS = 4  # of Gauss-Newton
GOES_ON = np.array([0.0, 1.0, 0.0, 0.0])
BRAKING = 1.0  # [m/s^2] of a mover that yields
BEFORE = 1.0  # [m] from the robot's centre at which it stops
BESIDE = 0.65  # [m] from the line ahead of a mover to the centre of a robot that is in its way
SELDOM = 0.01  # probability that a mover yields, before it has met the robot


@dataclass
class Past:
    """Places (n, 2) and velocities (n, 2) of a track at times (n,), and of the robot; the last ones are kept."""

    times: Array
    places: Array
    velocities: Array
    robots: Array
    wave: Array | None = None  # (4,) first and last place along the line, round trip made now [m], speed [m/s]
    axis: Array | None = None  # (2, 2) middle of the line, and its direction
    weights: Array = field(default_factory=lambda: GOES_ON)  # row of `Tracks.weights`

    @classmethod
    def none(cls) -> Past:
        """Nothing has been seen."""
        return cls(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)))

    def add(self, time: float, place: Array, velocity: Array, robot: Array) -> None:
        """Take in where the track and the robot are now, and judge the hypotheses again."""
        self.times = np.append(self.times, time)[-MEMORY:]
        self.places = np.vstack([self.places, place])[-MEMORY:]
        self.velocities = np.vstack([self.velocities, velocity])[-MEMORY:]
        self.robots = np.vstack([self.robots, robot])[-MEMORY:]
        self._fit()
        self._judge()

    def _fit(self) -> None:
        """Fit a triangular wave; none where the track is no line, short, or has not turned round twice."""
        self.wave = None
        if len(self.times) < 3 * AHEAD:
            return
        middle = self.places.mean(axis=0)
        _, spread, axes = np.linalg.svd(self.places - middle, full_matrices=False)
        along, since = (self.places - middle) @ axes[0], self.times - self.times[-1]
        low, high = along.min(), along.max()
        if spread[1] > ASIDE * np.sqrt(len(along)) or high - low < SHORTEST:
            return
        pace = np.abs(self.velocities @ axes[0])
        speed = np.median(pace[pace >= 0.5 * pace.max()])
        starts = np.linspace(0.0, 2.0 * (high - low), STARTS, endpoint=False)
        errors = np.minimum(np.abs(to_and_fro(low, high, starts[:, None], speed, since) - along), WORST * SIGMA)
        guess = np.array([low, high, starts[int(np.argmin(errors.sum(axis=1)))], speed])
        wave = self._improved(guess, along, since)
        length = wave[1] - wave[0]
        first, last = np.floor((wave[2] + wave[3] * since[[BOTH, -BOTH - 1]]) / length)  # its ways are counted
        if length >= SHORTEST and last - first >= 2.0:
            wave[2] %= 2.0 * length
            self.wave, self.axis = wave, np.stack([middle, axes[0]])

    @staticmethod
    def _improved(wave: Array, along: Array, since: Array) -> Array:
        """The wave (4,) nearer to places along the line at times before now [s]; far ones do not count."""
        for _ in range(STEPS):
            length = max(wave[1] - wave[0], SHORTEST)
            turns = np.floor((wave[2] + wave[3] * since) / length)
            back = turns % 2.0
            rising = 1.0 - 2.0 * back
            folds = back - rising * turns  # on its k-th way the wave is at low + rising (u + v t) + folds length
            slopes = np.column_stack([1.0 - folds, folds, rising, rising * since])
            error = along - to_and_fro(wave[0], wave[0] + length, wave[2], wave[3], since)
            counts = (np.abs(error) < WORST * SIGMA).astype(np.float64)
            normal = (slopes * counts[:, None]).T @ slopes + 1e-6 * np.eye(4)
            wave = wave + np.linalg.solve(normal, slopes.T @ (counts * error))
        return wave

    def _judge(self) -> None:
        """Weights of the hypotheses, by the errors of what they foretell."""
        self.weights = GOES_ON
        if len(self.times) <= AHEAD:
            return
        lag = (self.times[AHEAD:] - self.times[:-AHEAD])[:, None]
        before, velocity = self.places[:-AHEAD], self.velocities[:-AHEAD]
        errors = np.full((5, len(before)), np.inf)
        ways = lag * velocity, np.zeros((1, 2)), _yielding(before, velocity, self.robots[:-AHEAD], lag)
        for row, way in zip(errors[1:4], ways, strict=True):
            row[:] = np.hypot(*(before + way - self.places[AHEAD:]).T)
        if self.wave is not None and self.axis is not None:
            middle, direction = self.axis
            low, high, made, speed = self.wave.tolist()
            along = to_and_fro(low, high, made, speed, self.times - self.times[-1])
            off = np.hypot(*(middle + along[:, None] * direction - self.places).T)
            if off[-2:].max() <= WORST * SIGMA / 2.0:  # else it has just done something else
                errors[0] = off[AHEAD:]
        errors[4] = np.minimum(errors[0], errors[1])  # it does not yield
        errors[3] = np.where(np.isnan(errors[3]), errors[4], errors[3])
        costs = (np.minimum(errors / SIGMA, WORST) ** 2).sum(axis=1) / (2.0 * AHEAD)
        yields = SELDOM / (SELDOM + (1.0 - SELDOM) * np.exp(costs[3] - costs[4]))
        weights = np.where(np.isfinite(errors[:3, -1]), np.exp(costs[:3].min() - costs[:3]), 0.0)
        self.weights = np.append(weights / weights.sum(), yields)

    @property
    def round_trip(self) -> Array:
        """(6,) row of `Tracks.wave`."""
        if self.wave is None or self.axis is None:
            return np.full(6, np.nan)
        low, high, made, speed = self.wave
        middle, direction = self.axis
        return np.concatenate([middle + low * direction, middle + high * direction, [made, speed]])

    @property
    def sweep(self) -> Array:
        """(6,) row of `Tracks.sweep`: where another hypothesis is likely enough, only the ends of its last places."""
        if self.weights[0] >= 1.0 - UNLIKELY and self.weights[3] <= UNLIKELY:
            return self.round_trip
        last = self.places[-LATELY:]
        far = int(np.argmax(np.hypot(*(last - last[-1]).T)))
        return np.concatenate([last[far], last[-1], [np.nan, np.nan]])


def _yielding(place: Array, velocity: Array, robot: Array, time: Array) -> Array:
    """Ways (n, 2) in times (n, 1) [s] of movers at places (n, 2) that stop before a robot (n, 2) in their way [m].

    Not a number where it is not in their way.
    """
    speed = np.maximum(np.hypot(*velocity.T), 1e-9)[:, None]
    heading, offset = velocity / speed, robot - place
    ahead = (offset * heading).sum(axis=1, keepdims=True)
    aside = np.hypot(*(offset - ahead * heading).T)[:, None]
    braking = np.minimum(time, speed / BRAKING)
    stopped = np.maximum(ahead - BEFORE, (speed - 0.5 * BRAKING * braking) * braking)
    way: Array = np.where((ahead > 0.0) & (aside < BESIDE), np.minimum(speed * time, stopped), np.nan) * heading
    return way


class MotionModel:
    """Pasts of movers by the numbers of their tracks; those of lost ones are kept for tracks that begin there."""

    def __init__(self) -> None:
        """Begin without a past."""
        self._now = 0.0
        self._pasts: dict[int, Past] = {}

    def update(self, tracks: Tracks, dt: float, robot: Array) -> Tracks:
        """The tracks, with the sweeps of movers that go to and fro.

        Args:
            tracks: as they are now.
            dt: time since the last update [s].
            robot: (2,) its place now [m].
        """
        self._now += dt
        self._pasts = {name: past for name, past in self._pasts.items() if self._now - past.times[-1] < GONE}
        sweep, wave, weights = tracks.sweep.copy(), tracks.wave.copy(), tracks.weights.copy()
        for k in np.flatnonzero(tracks.mover).tolist():
            name = int(tracks.identity[k])
            if name not in self._pasts:
                self._pasts[name] = self._adopted(tracks.centre[k], tracks.identity)
            past = self._pasts[name]
            if not (tracks.unseen[k] and len(past.times)):
                past.add(self._now, tracks.centre[k], tracks.velocity[k], robot)
            sweep[k], wave[k], weights[k] = past.sweep, past.round_trip, past.weights
            for row in (sweep[k], wave[k]):
                row[4] += row[5] * (self._now - past.times[-1])
        tracks, hidden = replace(tracks, sweep=sweep, wave=wave, weights=weights), tracks.unseen > 0.0
        tracks.centre[hidden & tracks.sweeps] = tracks.at(hidden & tracks.sweeps).swept(np.zeros(1))[0]
        return tracks

    def _adopted(self, place: Array, names: IntArray) -> Past:
        """The past of a lost track on whose line a new one begins, or none."""
        for name, past in self._pasts.items():
            if name not in names and past.axis is not None and past.wave is not None:
                offset = place - past.axis[0]
                along = float(np.clip(offset @ past.axis[1], *past.wave[:2]))
                if np.hypot(*(offset - along * past.axis[1])) < ADOPTED:
                    return self._pasts.pop(name)
        return Past.none()
