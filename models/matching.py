"""Data association: gating in units of the innovation's covariance, then the nearest landmark.

The gate is on the Mahalanobis distance of bearing and range from what is expected, with the covariance of state,
landmark and sensor together (Neira and Tardos, IEEE Trans. Robotics and Automation 17 (2001), section II: individual
compatibility and nearest neighbour).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.errors import ModelError, require_kinds
from unifg.lie import wrap_angle
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["NEW", "Gates", "nearest"]

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

    def __post_init__(self) -> None:
        """Refuse gates that let nothing through.

        Raises:
            ModelError: not 0 < match <= new.
        """
        require_kinds("gates", ModelError, Gates.__annotations__, vars(self))
        if not 0.0 < self.match <= self.new:
            raise ModelError(f"gates need 0 < match <= new, found {self.match} and {self.new}")


def nearest(seen: Array, forecast: Array, innovation: Array, possible: BoolArray, gates: Gates) -> IntArray:
    """Pair sightings with landmarks, nearest pairs first, each landmark once.

    Args:
        seen: (M, 2) bearings and ranges.
        forecast: (K, 2) those expected of the landmarks.
        innovation: (K, 2, 2) covariances of the difference.
        possible: (M, K) which pairs are of one kind.
        gates: how near is near.

    Returns:
        (M,) index of a landmark, ``NEW`` or ``DOUBTFUL``, as for a sighting that is no number.
    """
    found = np.full(len(seen), NEW, dtype=np.intp)
    if not len(seen) or not len(forecast):
        return found
    difference = seen[:, None] - forecast[None]
    difference[..., 0] = wrap_angle(difference[..., 0])
    distance = np.einsum("mka,kab,mkb->mk", difference, np.linalg.inv(innovation), difference)
    distance[~possible] = np.inf
    found[~(distance.min(axis=1) >= gates.new)] = DOUBTFUL
    distance[np.isnan(distance)] = np.inf
    while True:
        m, k = np.unravel_index(int(np.argmin(distance)), distance.shape)
        if not distance[m, k] <= gates.match:
            return found
        found[m] = k
        distance[m], distance[:, k] = np.inf, np.inf
