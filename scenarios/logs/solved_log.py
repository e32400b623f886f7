"""Log of a plan that was solved once, as if it had been driven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.scenarios.logs.columns import column
from unifg.typing import Array

__all__ = ["SolvedLog", "held"]


@dataclass(kw_only=True)
class SolvedLog:
    """Nodes of a plan, the last control held at its end.

    Attributes:
        discs: x, y, radius of obstacles (n, 3) [m].
    """

    discs: Array
    time: Array = column("s")
    pose: Array = column("m, m, rad", 3)
    wanted: Array = column("m, m, rad", 3)
    """The path, or the place of a car that keeps to its profile."""
    speed: Array = column("m/s")
    control: Array = column("m/s, rad/s; of a car N", None)


def held(controls: Array) -> Array:
    """Controls (N, m) of the steps as those of the nodes (N + 1, m): the last one is held."""
    return np.concatenate([controls, controls[-1:]])
