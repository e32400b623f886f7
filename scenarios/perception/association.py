"""Association: expected sightings of landmarks from an uncertain state, and positions of sightings."""

from __future__ import annotations

import numpy as np

from unifg.lie import SO3
from unifg.models import landmarks
from unifg.typing import Array, IntArray


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


def places(state: Array, bearings: Array, ranges: Array) -> Array:
    """(K, 2) where sightings (K,) from a state (10,) put what was seen [m]."""
    forward = SO3.matrix(state[None, 3:7])[0, :, 0]
    angles = np.arctan2(forward[1], forward[0]) + bearings
    found: Array = state[:2] + ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return found
