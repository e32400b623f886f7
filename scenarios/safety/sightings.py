"""Where obstacles are and how fast, from looks that are not exact; and how far that is to be believed.

The last looks at M obstacles are factors on place and velocity of now, one graph for all of them: what goes straight
on, or falls, was at c + s v + s^2/2 a when it was seen at the time s. Noise is the same along every axis, so place and
velocity of an obstacle have a covariance of two by two, the same along every axis, and the distance from where it will
be has the variance

    P_cc + 2 t P_cv + t^2 P_vv

in any direction: k of its standard deviations are kept beyond what is to be kept (:attr:`Obstacles.doubt`; it is
:func:`unifg.models.barriers.uncertain` with a root that is the same along every axis). What turns is believed late, by
half of what is remembered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.models import quadrotor
from unifg.scenarios.safety.keeper import Obstacles
from unifg.solvers import GaussNewton
from unifg.typing import Array

__all__ = ["SightingSettings", "Sightings"]


@dataclass(frozen=True)
class SightingSettings:
    """Numbers of looks, and of who believes them.

    Attributes:
        noise: standard deviation of a place as it is seen, along each axis [m].
        believed: what it is taken for [m].
        looks: that are remembered.
        fast: standard deviation of velocities before anything was seen [m/s].
        k: standard deviations that are kept beyond what is to be kept.
    """

    noise: float = 0.02
    believed: float = 0.02
    looks: int = 20
    fast: float = 3.0
    k: float = 3.0


def missed(centre: Array, velocity: Array, since: Array, fall: Array, seen: Array) -> Array:
    """(n, 3) by what what is believed of an obstacle misses a look at it, ``since`` (n, 1) seconds ago [m]."""
    found: Array = centre + since * velocity + 0.5 * since * since * fall - seen
    return found


class Sightings:
    """Remembers looks at M obstacles.

    Attributes:
        settings: the numbers.
    """

    def __init__(self, settings: SightingSettings, obstacles: Obstacles) -> None:
        """State the graph for obstacles like these; nothing was seen yet."""
        s, m = settings, len(obstacles.keep)
        self.settings, self._like = s, obstacles
        self._times, self._seen = np.full(s.looks, np.nan), np.zeros((s.looks, m, 3))
        fall = np.array([0.0, 0.0, -quadrotor.GRAVITY]) * obstacles.falls[:, None]
        graph = fg.Graph()
        self.place, self.speed = graph.variables("place", fg.Rn(3), m), graph.variables("speed", fg.Rn(3), m)
        every = np.tile(np.arange(m), s.looks)
        n = len(every)
        self._since = graph.data("since", np.zeros((n, 1)), each=True)
        self._looks = graph.data("seen", np.zeros((n, 3)), each=True)
        self._active = graph.data("remembered", np.zeros(n, dtype=bool), each=True)
        looks = self._since, np.tile(fall, (s.looks, 1)), self._looks
        graph.minimize(
            missed, self.place[every], self.speed[every], *looks, sigma=s.believed, active=self._active, name="looks"
        )
        graph.minimize(fg.prior, self.speed, np.zeros(3), sigma=s.fast, name="fast")
        self._run = GaussNewton(max_iterations=3).prepare(graph)

    def see(self, now: float, places: Array) -> Obstacles:
        """Take in places (M, 3) as they are seen now [m]; what is believed of the obstacles."""
        s, like = self.settings, self._like
        self._times, self._seen = np.roll(self._times, -1), np.roll(self._seen, -1, axis=0)
        self._times[-1], self._seen[-1] = now, places
        known = np.repeat(np.isfinite(self._times), len(places))
        since = np.repeat(np.nan_to_num(self._times - now), len(places))[:, None]
        data = {self._since: since, self._looks: self._seen.reshape(-1, 3), self._active: known}
        found = self._run.solve({self.place: places, self.speed: np.zeros_like(places)}, data=data)
        # All are looked at alike, and along all axes.
        spread = found.covariance(self.place[0], self.speed[0])[::3, ::3] * s.k**2
        doubt = np.tile([spread[0, 0], 2.0 * spread[0, 1], spread[1, 1]], (len(places), 1))
        return Obstacles(found[self.place], found[self.speed], like.keep, like.upright, like.falls, doubt)
