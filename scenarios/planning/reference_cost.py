"""Cost of leaving a reference, a term of any robot's horizon."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.horizon import Context, tree_of
from unifg.modeling.model import AnyResidual
from unifg.typing import ArrayLike

__all__ = ["ReferenceCost"]


@dataclass(frozen=True)
class ReferenceCost:
    """Cost of leaving a reference at nodes of the horizon.

    Attributes:
        name: of the term.
        sigma: standard deviations in the residual's units, for all nodes or for each.
        wanted: ``wanted(now)`` gives the reference of a tick, (n, k) of its n stages or (k,) for all nodes.
        component: of the state, as "p"; None for all of it.
        ends: True for the end of the horizon, or of each of its tails, alone; False for the nodes before it; None for
            all. Never for the present.
        residual: ``residual(x, wanted)``: (n, m).
        size: k; 0 for points of the manifold.
    """

    name: str
    sigma: ArrayLike
    wanted: Callable[[Context[Any]], ArrayLike]
    component: str | None = None
    ends: bool | None = None
    residual: AnyResidual = fg.prior
    size: int = 0

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the cost."""
        tree = tree_of(x)
        nodes = x[1:] if self.ends is None else x[tree.leaves if self.ends else tree.inner]
        where = nodes if self.component is None else getattr(nodes, self.component)
        blank = np.zeros(self.size) if self.size else where.manifold.identity()
        wanted = graph.data(f"{self.name}: wanted", np.tile(blank, (len(where), 1)), each=True)
        graph.minimize(self.residual, where, wanted, sigma=self.sigma, name=self.name)

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """The reference; that of a stage for all nodes of the stage."""
        wanted, tree = self.wanted(now), now.tree
        if tree is not None and not self.ends and np.ndim(wanted) == 2:
            nodes = slice(1, None) if self.ends is None else tree.inner
            wanted = np.asarray(wanted)[tree.depths[nodes] - 1]
        return {f"{self.name}: wanted": wanted}
