"""Incremental smoothing: every update solves the whole history, and works only on what changed."""

from __future__ import annotations

from collections.abc import Mapping

from unifg.locks import synchronized
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.smoother import Effort, Smoother
from unifg.typing import Numbers


class Incremental(Smoother):
    """Gauss-Newton on a growing graph, one step per update, eliminating anew only what a change reaches.

    The elimination tree of the graph is kept with all its fronts. A new factor, or a variable whose linearisation
    point moves, takes the cliques between itself and the root out of the tree; subtrees below them keep the update
    matrices they passed on. What was taken out is ordered afresh (minimum degree, the newest variable last and alone,
    so that odometry touches one variable) and eliminated. The idea is that of M. Kaess et al., "iSAM2", IJRR 31
    (2012).

    With ``relinearize=0`` and ``wildfire=0`` an update is a full Gauss-Newton step of the batch problem.
    """

    def __init__(self, relinearize: float = 0.1, every: int = 1, wildfire: float = 1e-4) -> None:
        """Start without variables.

        Args:
            relinearize: a variable is relinearised when an entry of its step exceeds this, in the units of its tangent.
            every: linearisation points are looked at in every so many updates.
            wildfire: back-substitution stops where steps change by less, in the units of the tangent.

        Raises:
            GraphError: when a number is out of range.
        """
        super().__init__(relinearize, every, wildfire)

    @synchronized
    def update(self, values: Mapping[GrowingFamily, Numbers] | None = None, *, iterations: int = 1) -> Effort:
        """Take in what was stated since the last update and improve all estimates.

        Args:
            values: initial values of new members, (storage,) for one or (n, storage), appended to their families.
            iterations: passes; the second and later ones only relinearise.

        Returns:
            What the last pass did.

        Raises:
            GraphError: naming a member without value, a value that is not on its manifold, or a member that no factor
                determines. Only in the last case are values and factors kept, for another try.
        """
        self._update(values, None, iterations)
        return self._effort()
