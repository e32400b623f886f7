"""Cost of leaving a reference, a term of any robot's horizon."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.horizon import Context
from unifg.modeling.model import AnyResidual
from unifg.typing import ArrayLike

__all__ = ["ReferenceCost"]


@dataclass(frozen=True)
class ReferenceCost:
    """Cost of leaving a reference at nodes of the horizon.

    Attributes:
        name: of the term.
        sigma: standard deviations in the residual's units, for all nodes or for each.
        wanted: ``wanted(now)`` gives the reference of a tick, (n, k) or (k,) for all nodes.
        component: of the state, as "p"; None for all of it.
        nodes: of the horizon, begin and end as of a slice; those after the present.
        residual: ``residual(x, wanted)``: (n, m).
        size: k; 0 for points of the manifold.
    """

    name: str
    sigma: ArrayLike
    wanted: Callable[[Context[Any]], ArrayLike]
    component: str | None = None
    nodes: tuple[int, int | None] = (1, None)
    residual: AnyResidual = fg.prior
    size: int = 0

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the cost."""
        nodes = x[slice(*self.nodes)]
        where = nodes if self.component is None else getattr(nodes, self.component)
        blank = np.zeros(self.size) if self.size else where.manifold.identity()
        wanted = graph.data(f"{self.name}: wanted", np.tile(blank, (len(where), 1)), each=True)
        graph.minimize(self.residual, where, wanted, sigma=self.sigma, name=self.name)

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """The reference."""
        return {f"{self.name}: wanted": self.wanted(now)}
