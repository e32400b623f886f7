"""A plan that is made now and then, and a barrier filter of one step below it that looks at every tick.

The paper proposes it for planners that do not keep barriers (Yang et al. 2025, IV-A1): a coarse way from above, a
filter that has the last word. Between two plans the vehicle follows the last one by differential flatness; what it
wants for that is what the filter (:mod:`unifg.scenarios.quadrotor.one_step`) changes as little as it can.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from unifg.scenarios.options import AtLeastOne, Settings
from unifg.scenarios.planning.flat_path import Flown
from unifg.typing import Array

__all__ = ["CascadeSettings", "Track"]


@dataclass(frozen=True)
class CascadeSettings(Settings):
    """Division of the work between plan and filter.

    Attributes:
        every: ticks from one plan to the next.
        barriers: whether the plan keeps barriers as well.
    """

    every: AtLeastOne = 5
    barriers: bool = False


@dataclass
class Track:
    """The way that a plan has laid, in between its nodes.

    Attributes:
        every: ticks from one plan to the next.
        ticks: since the last one was laid.
    """

    every: int
    ticks: int = 0
    _times: Array | None = None
    _nodes: Array | None = None

    def due(self) -> bool:
        """Return True if a plan is to be made in this tick; called once in each."""
        self.ticks += 1
        return self._nodes is None or self.ticks >= self.every

    def lay(self, times: Array, nodes: Array) -> None:
        """Keep a plan: positions and velocities (n, 6) at times (n,) from now on [s]."""
        self._times, self._nodes, self.ticks = times, nodes, 0

    def at(self, later: float, path: Callable[[Array], Flown]) -> Flown:
        """Reference ``later`` than the plan was made [s]; beyond its end, or without one, the path itself."""
        if self._times is None or self._nodes is None or later >= self._times[-1]:
            return path(np.array([later]))
        k = max(int(np.searchsorted(self._times, later, side="right")) - 1, 0)
        span, gone = self._times[k + 1] - self._times[k], later - self._times[k]
        (p, v), ahead = self._nodes[k].reshape(2, 3), self._nodes[k + 1, 3:]
        push = (ahead - v) / span
        parts = p + gone * v + 0.5 * gone * gone * push, v + gone * push, push, np.zeros(3)
        return Flown(*(part[None] for part in parts))
