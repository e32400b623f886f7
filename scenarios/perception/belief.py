"""Belief that the estimator gives the planner: present state, parameters, landmarks seen so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.models import quadrotor
from unifg.scenarios.perception.rows import Rows
from unifg.typing import Array, IntArray


@dataclass(frozen=True)
class Landmarks(Rows):
    """Cylinders and walls' corners as far as they have been seen; one row each, in the order of first sight.

    Attributes:
        ids: (K,) names the estimator gave them; those of the sensor where association is known.
        positions: (K, 2) in the world's ground plane [m].
        covariances: (K, 2, 2) [m^2].
        radii: (K,) of the cylinders [m], 0 for corners.
        kinds: (K,) ``CYLINDER`` or ``CORNER``.
    """

    ids: IntArray
    positions: Array
    covariances: Array
    radii: Array
    kinds: IntArray

    CYLINDER = 0
    CORNER = 1

    @staticmethod
    def none() -> Landmarks:
        """Nothing has been seen."""
        empty = np.zeros(0, dtype=np.intp)
        return Landmarks(empty, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), empty)

    @property
    def cylinders(self) -> Landmarks:
        """Those with a body to keep clear of."""
        return self.at(self.kinds == Landmarks.CYLINDER)


@dataclass(frozen=True)
class Belief:
    """Estimate of everything at one tick.

    Attributes:
        state: (10,) position, quaternion (w, x, y, z), velocity.
        covariance: (9, 9) of the state's right perturbation, ordered (p, R, v) [m, rad, m/s].
        parameters: mass, drag, wind and updraft believed.
        parameters_sigma: (7,) standard deviations in the order of ``parameters.packed``; 0 for what is not estimated.
        landmarks: what has been seen.
    """

    state: Array
    covariance: Array
    parameters: quadrotor.Parameters
    parameters_sigma: Array
    landmarks: Landmarks

    @property
    def sigma(self) -> Array:
        """(9,) standard deviations of the state's right perturbation."""
        return np.sqrt(np.diag(self.covariance))
