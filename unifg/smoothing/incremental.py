"""Incremental smoothing: every update solves the whole history, and works only on what changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from unifg.errors import GraphError
from unifg.locks import synchronized
from unifg.modeling.model import AnyResidual
from unifg.smoothing.factors import FIELD, Staged
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.revocable import LEAST, Revocable, Revocables, limit_of
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
        self._revocables = Revocables()

    def _watch(self, item: Staged) -> None:
        """Remember revocable factors."""
        self._revocables.add(self, item)

    @synchronized
    def minimize(self, function: AnyResidual, *arguments: Any, revocable: float | None = None, **options: Any) -> None:
        """State factors as :meth:`Smoother.minimize` does, which may be revocable.

        Args:
            function: residual.
            *arguments: members, data and constants.
            revocable: threshold c of |W r|, for closures that may be wrong: they count while the rest agrees, and are
                taken back where it does not (:mod:`unifg.smoothing.revocable`). None for factors that always count.
            **options: sigma, information, robust, active and name.

        Raises:
            GraphError: when arguments do not fit; for a threshold that is not positive, a robust loss besides it, or a
                function that cannot be compiled.
        """
        if revocable is None:
            super().minimize(function, *arguments, **options)
            return
        if options.get("robust") is not None:
            raise GraphError("a revocable factor has the truncated loss: leave robust out")
        if options.get("information") is None:
            options["sigma"] = 1.0 if options.get("sigma") is None else options["sigma"]
        super().minimize(function, *arguments, **options)
        staged = self._staged.pop()
        row = self._types.fields[staged.kind]
        if staged.term is not None or not row[FIELD["whitening"]]:
            raise GraphError(
                f"term '{staged.name}': a revocable factor needs a function that can be traced or compiled",
                term=staged.name,
            )
        staged.limit = limit_of(revocable, staged.name)
        staged.data = staged.data.copy()
        staged.data[:, int(row[FIELD["parameters"]]) :] *= LEAST**0.5
        self._staged.append(staged)

    @property
    @synchronized
    def revocable(self) -> list[Revocable]:
        """Revocable factors in the order in which they came, and which of them count."""
        return self._revocables.listed(self)

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
                determines. Factors are kept for another try, and values in the last case.
        """
        self._update(values, None, iterations)
        if len(self._revocables):
            self._revocables.settle(self, iterations > 1)
        return self._effort()
