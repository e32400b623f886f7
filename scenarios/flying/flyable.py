"""Whether a plan may be flown, judged without the graph: it moves as the vehicle does, and it keeps clear."""

from __future__ import annotations

import numpy as np

from unifg.models import quadrotor
from unifg.scenarios.flying.slots import Obstacles
from unifg.scenarios.ways.polyline import segment_distance
from unifg.typing import Array


def moves(controls: Array, states: Array, dt: float, parameters: quadrotor.Parameters, tolerance: float) -> bool:
    """Whether states (N + 1, 10) follow from controls (N, 4), each row of the dynamics to a tolerance."""
    if not (np.isfinite(controls).all() and np.isfinite(states).all()):
        return False
    defects = quadrotor.dynamics(states[:-1], controls, states[1:], parameters.packed, dt)
    return bool(np.abs(defects).max() <= tolerance)


def room(states: Array, obstacles: Obstacles, walls: Array) -> float:
    """Least distance of the nodes after the first beyond what they have to keep clear [m], negative in a violation.

    Args:
        states: (k, 10), the first being the present, k at most N + 1.
        obstacles: of the tick.
        walls: (W, 2, 2) segments [m].
    """
    ahead = states[1:, :2]
    count = len(ahead)
    gaps = np.hypot(*np.moveaxis(ahead[:, None] - obstacles.centres[:count], 2, 0)) - obstacles.radii
    beside = segment_distance(ahead, walls) - obstacles.wall_limits[:count]
    return float(min((gaps - obstacles.limits[:count]).min(initial=np.inf), beside.min(initial=np.inf)))
