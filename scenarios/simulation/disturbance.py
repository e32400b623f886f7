"""Disturbances of the vehicle that no model knows: rate noise, acceleration noise and gusts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unifg.scenarios.options import Positive, Settings
from unifg.typing import Array

__all__ = ["DisturbanceModel", "Disturbances"]


@dataclass(frozen=True)
class DisturbanceModel(Settings):
    """Statistics of the disturbances; the steady wind is a parameter of the vehicle, not one of them.

    Attributes:
        rate_density: white noise of each body rate [rad/s per root Hz]; the mean over 50 ms has a standard deviation
            of 0.02 rad/s by default.
        acceleration_density: white noise of each world acceleration [m/s^2 per root Hz]; the mean over 50 ms has
            0.05 m/s^2 by default.
        gust: standard deviations along x, y, z of an Ornstein-Uhlenbeck acceleration [m/s^2].
        gust_time: its correlation time [s].
    """

    rate_density: float = 0.02 * math.sqrt(0.05)
    acceleration_density: float = 0.05 * math.sqrt(0.05)
    gust: tuple[float, float, float] = (0.1, 0.1, 0.05)
    gust_time: Positive[float] = 0.5

    @staticmethod
    def calm() -> DisturbanceModel:
        """Nothing disturbs the vehicle."""
        return DisturbanceModel(0.0, 0.0, (0.0, 0.0, 0.0))

    def white_sigma(self, dt: float) -> Array:
        """(6,) noise per step of a model that holds white noise over ``dt`` [s] and matches these statistics.

        Rates come first [rad/s], then accelerations [m/s^2]. A gust counts with its density at zero frequency,
        2 sigma^2 tau: what does harm over times longer than the correlation time.
        """
        gust = 2.0 * self.gust_time * np.square(self.gust)
        density = np.concatenate([np.full(3, self.rate_density**2), self.acceleration_density**2 + gust])
        return np.sqrt(density / dt)


class Disturbances:
    """One realisation: it depends on the seed and on the steps' lengths, not on what the vehicle does."""

    def __init__(self, model: DisturbanceModel, rng: np.random.Generator) -> None:
        """Draw the first gust from the stationary distribution; all noise comes from ``rng``."""
        self._model, self._rng = model, rng
        self._gust = np.array(model.gust) * rng.standard_normal(3)

    def draw(self, dt: float) -> Array:
        """(6,) noise of rates [rad/s] and accelerations [m/s^2], to be held for ``dt`` [s]; time moves on."""
        model, normal = self._model, self._rng.standard_normal(9)
        root = math.sqrt(dt)
        noise = np.empty(6)
        noise[:3] = model.rate_density / root * normal[:3]
        noise[3:] = model.acceleration_density / root * normal[3:6] + self._gust
        keep = math.exp(-dt / model.gust_time)
        self._gust = keep * self._gust + math.sqrt(1.0 - keep * keep) * np.array(model.gust) * normal[6:]
        return noise
