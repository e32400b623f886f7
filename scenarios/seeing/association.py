"""Which landmark was that? By its name, where the sensor tells it, or by gating in units of what both are uncertain.

The gate is on the Mahalanobis distance of bearing and range from what is expected, with the covariance of state,
landmark and sensor together (Neira and Tardos, IEEE Trans. Robotics and Automation 17 (2001), section II: individual
compatibility and nearest neighbour).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.lie import SO3, wrap_angle
from unifg.models import landmarks
from unifg.typing import Array, BoolArray, IntArray

NEW = -1
"""Seen for the first time."""

DOUBTFUL = -2
"""Near no landmark, but not far enough from all of them: better not used."""


@dataclass(frozen=True)
class Gates:
    """Squared Mahalanobis distances of two degrees of freedom.

    Attributes:
        match: greatest of a sighting that is taken for a landmark; 13.8 lets 1 in 1000 right ones out.
        new: least to every landmark of its kind of a sighting that begins a new one.
    """

    match: float = 13.8
    new: float = 50.0


def expected(state: Array, covariance: Array, positions: Array, columns: IntArray, noise: Array) -> tuple[Array, Array]:
    """Bearings and ranges as they should be, and how far from that a sighting may be.

    Args:
        state: (10,) predicted.
        covariance: (D, D) of the state, in its first nine rows, and landmarks.
        positions: (K, 2) of the landmarks [m].
        columns: (K,) first column of each landmark in ``covariance``.
        noise: (2,) standard deviations of bearing [rad] and range [m].

    Returns:
        (K, 2) and innovation covariances (K, 2, 2).
    """
    count = len(positions)
    derivative = landmarks.bearing_range.jacobian
    assert derivative is not None
    of_state, of_landmark = derivative(np.tile(state, (count, 1)), positions, np.zeros(2))
    J = np.concatenate([of_state, of_landmark], axis=2)
    place = np.concatenate([np.tile(np.arange(9), (count, 1)), columns[:, None], columns[:, None] + 1], axis=1)
    joint = covariance[place[:, :, None], place[:, None, :]]
    return landmarks.observe(state, positions), J @ joint @ np.swapaxes(J, 1, 2) + np.diag(np.square(noise))


def nearest(seen: Array, forecast: Array, innovation: Array, possible: BoolArray, gates: Gates) -> IntArray:
    """Pair sightings with landmarks, nearest pairs first, each landmark once.

    Args:
        seen: (M, 2) bearings and ranges.
        forecast: (K, 2) those expected of the landmarks.
        innovation: (K, 2, 2) covariances of the difference.
        possible: (M, K) which pairs are of one kind.
        gates: how near is near.

    Returns:
        (M,) index of a landmark, ``NEW`` or ``DOUBTFUL``.
    """
    found = np.full(len(seen), NEW, dtype=np.intp)
    if not len(seen) or not len(forecast):
        return found
    difference = seen[:, None] - forecast[None]
    difference[..., 0] = wrap_angle(difference[..., 0])
    distance = np.einsum("mka,kab,mkb->mk", difference, np.linalg.inv(innovation), difference)
    distance[~possible] = np.inf
    found[distance.min(axis=1) < gates.new] = DOUBTFUL
    while True:
        m, k = np.unravel_index(int(np.argmin(distance)), distance.shape)
        if not distance[m, k] <= gates.match:
            return found
        found[m] = k
        distance[m], distance[:, k] = np.inf, np.inf


def places(state: Array, bearings: Array, ranges: Array) -> Array:
    """(K, 2) where sightings (K,) from a state (10,) put what was seen [m]."""
    forward = SO3.matrix(state[None, 3:7])[0, :, 0]
    angles = np.arctan2(forward[1], forward[0]) + bearings
    found: Array = state[:2] + ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return found
