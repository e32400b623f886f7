"""Discs that go to and fro where nothing else stands, drawn by seed."""

from __future__ import annotations

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.worlds.layouts import Layout
from unifg.scenarios.worlds.unmapped import Obstacle
from unifg.typing import Array

__all__ = ["random_movers"]

_FREE = 1.5  # of every mover's whole path around start and target [m]
_GAP = 0.1  # between a mover's hull and what stands [m]


def random_movers(layout: Layout, count: int, rng: np.random.Generator) -> tuple[Obstacle, ...]:
    """Draw discs that move on straight segments between start and target.

    Radii are uniform in 0.3 to 0.5 m, speeds in 0.3 to 0.8 m/s, lengths of the segments in 1.5 to 4 m; the middle of
    a segment is uniform over the layout's ground between start and target, its direction uniform. A segment is drawn
    again if on it the disc would come within 0.1 m of a cylinder or a wall, leave the ground, or come nearer than
    1.5 m to start or target. Movers may cross each other.

    Args:
        layout: what stands.
        count: number of movers.
        rng: source of all numbers.

    Raises:
        ScenarioError: if ``count`` is negative or a thousand draws find no room for a mover.
    """
    if count < 0:
        raise ScenarioError(f"the number of movers must not be negative, got {count}")
    return tuple(_random_mover(layout, index, rng) for index in range(count))


def _random_mover(layout: Layout, index: int, rng: np.random.Generator) -> Obstacle:
    ends = np.stack([layout.start[:2], layout.target[:2]])
    low, high = layout.size
    left, right = np.sort(ends[:, 0])
    for _ in range(1000):
        radius, speed, length = rng.uniform(0.3, 0.5), rng.uniform(0.3, 0.8), rng.uniform(1.5, 4.0)
        centre = np.array([rng.uniform(left, right), rng.uniform(low[1], high[1])])
        angle = rng.uniform(0.0, 2.0 * np.pi)
        half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
        path: Array = centre + np.linspace(-1.0, 1.0, 41)[:, None] * half
        if (path < low + radius).any() or (path > high - radius).any():
            continue
        # Between samples, at most 0.1 m apart, the distance is at most 0.05 m smaller.
        if layout.distance(path).min() < radius + _GAP + 0.05:
            continue
        if np.linalg.norm(path[:, None, :] - ends[None], axis=2).min() < radius + _FREE + 0.05:
            continue
        return Obstacle(centre=path[0], radius=float(radius), end=path[-1], speed=float(speed))
    raise ScenarioError(
        f"layout {layout.name!r} has no room for mover {index}: 1000 draws met a cylinder, a wall, start or target; "
        "ask for fewer movers or place them yourself"
    )
