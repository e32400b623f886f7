"""Positions and velocities of obstacles from noisy sightings, and their uncertainty.

The last looks at M obstacles are factors on place and velocity of now, one graph for all of them: what goes straight
on, or falls, was at c + s v + s^2/2 a when it was seen at the time s. Noise is the same along every axis, so place and
velocity of an obstacle have a covariance of two by two, the same along every axis, and the distance from where it will
be has the variance

    P_cc + 2 t P_cv + t^2 P_vv

in any direction: k of its standard deviations are kept beyond what is to be kept (:attr:`Obstacles.doubt`; it is
:func:`unifg.models.barriers.uncertain` with a root that is the same along every axis). What turns is believed late, by
half of what is remembered.

The vehicle is not quite where it is believed to be either, and a distance is as unsure as both of its ends. By how much
it is not, o, is an unknown of the graph with the variance that the vehicle's own past gives it. Looks that say where a
thing is in the world have nothing to do with o: the variances add up. Looks from the vehicle are of c - o: c and o are
coupled, and in the distance, which is of c - o as well, o drops out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.scenarios.options import AtLeastOne, Positive, Settings
from unifg.scenarios.quadrotor.cbf_mpc import Obstacles
from unifg.solvers import GaussNewton
from unifg.typing import Array

__all__ = ["SightingSettings", "Sightings"]

SUREST = 1e-6  # least standard deviation of the vehicle's place [m]


@dataclass(frozen=True)
class SightingSettings(Settings):
    """Numbers of looks, and of who believes them.

    Attributes:
        noise: standard deviation of a place as it is seen, along each axis [m].
        believed: what it is taken for [m].
        looks: that are remembered.
        fast: standard deviation of velocities before anything was seen [m/s].
        k: standard deviations that are kept beyond what is to be kept.
    """

    noise: float = 0.02
    believed: Positive[float] = 0.02
    looks: AtLeastOne = 20
    fast: Positive[float] = 3.0
    k: float = 3.0


def missed(centre: Array, velocity: Array, own: Array, since: Array, fall: Array, seen: Array, beside: float) -> Array:
    """(n, 3) innovation of a look at an obstacle taken ``since`` (n, 1) seconds ago [m].

    Args:
        centre: (n, 3) where it is believed to be now [m].
        velocity: (n, 3) [m/s].
        own: (n, 3) by which the vehicle is beside where it is believed to be [m].
        since: (n, 1) time of the look, counted from now [s].
        fall: (n, 3) acceleration of what falls [m/s^2].
        seen: (n, 3) where it was seen [m].
        beside: 1 where looks are from the vehicle, 0 where they say a place in the world.
    """
    return centre + since * velocity + 0.5 * since * since * fall - seen - beside * own


class Sightings:
    """Remembers looks at M obstacles.

    Attributes:
        settings: the numbers.
        relative: whether looks say where a thing is beside the vehicle.
    """

    def __init__(self, settings: SightingSettings, obstacles: Obstacles, relative: bool = False) -> None:
        """State the graph for obstacles like these; nothing was seen yet."""
        s, m = settings, len(obstacles.keep)
        self.settings, self._like, self.relative = s, obstacles, relative
        self._times, self._seen = np.full(s.looks, np.nan), np.zeros((s.looks, m, 3))
        graph = fg.Graph()
        self.place, self.speed = graph.variables("place", fg.Rn(3), m), graph.variables("speed", fg.Rn(3), m)
        every = np.tile(np.arange(m), s.looks)
        n = len(every)
        self._since = graph.data("since", np.zeros((n, 1)), each=True)
        self._looks = graph.data("seen", np.zeros((n, 3)), each=True)
        self._active = graph.data("remembered", np.zeros(n, dtype=bool), each=True)
        self.own = graph.variables("own", fg.Rn(3), 1)
        ends = self.place[every], self.speed[every], self.own[np.zeros(n, dtype=np.intp)]
        looks = self._since, np.tile(obstacles.fall, (s.looks, 1)), self._looks, float(relative)
        graph.minimize(missed, *ends, *looks, sigma=s.believed, active=self._active, name="looks")
        graph.minimize(fg.prior, self.speed, np.zeros(3), sigma=s.fast, name="fast")
        self._unsure = graph.data("unsure", np.ones(3))
        graph.minimize(fg.prior, self.own, np.zeros(3), sigma=self._unsure, name="own place")
        self._run = GaussNewton(max_iterations=3).prepare(graph)

    def see(self, now: float, places: Array, here: Array, unsure: float) -> Obstacles:
        """Take in places as they are seen now; what is believed of the obstacles.

        Args:
            now: [s].
            places: (M, 3) in the world; beside the vehicle where looks are relative [m].
            here: (3,) where the vehicle is believed to be [m]. What it is beside that is taken for the same at all
                looks that are remembered, for it changes little in that time.
            unsure: its standard deviation [m].
        """
        s, like = self.settings, self._like
        places = places + here if self.relative else places
        self._times, self._seen = np.roll(self._times, -1), np.roll(self._seen, -1, axis=0)
        self._times[-1], self._seen[-1] = now, places
        known = np.repeat(np.isfinite(self._times), len(places))
        since = np.repeat(np.nan_to_num(self._times - now), len(places))[:, None]
        data = {
            self._since: since, self._looks: self._seen.reshape(-1, 3), self._active: known,
            self._unsure: np.full(3, max(unsure, SUREST)),
        }  # fmt: skip
        guess = {self.place: places, self.speed: np.zeros_like(places), self.own: np.zeros((1, 3))}
        solution = self._run.solve(guess, data=data)
        # All are looked at alike, and along all axes; distances are of place less own place.
        joint = solution.covariance(self.place[0], self.speed[0], self.own[0])[::3, ::3] * s.k**2
        apart = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        spread = apart @ joint @ apart.T
        doubt = np.tile([spread[0, 0], 2.0 * spread[0, 1], spread[1, 1]], (len(places), 1))
        return Obstacles(solution[self.place], solution[self.speed], like.keep, like.upright, like.falls, doubt)
