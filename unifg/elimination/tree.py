"""The elimination tree as something to look at: the Bayes tree of the graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from unifg.typing import IntArray


@dataclass(frozen=True)
class EliminationTree:
    """Supernodes, in the order of elimination: children come before parents.

    In the language of inference each is a clique, the density of its own nodes given those of its separator.

    Attributes:
        parent: (S,) parent of each supernode, -1 for a root.
        pivots: (S,) scalars each eliminates.
        rows: (S,) scalars of its separator.
        order: (nodes,) nodes in the order of elimination.
        bounds: (S + 1,) where the nodes of each supernode begin in ``order``.
        separators: (S,) nodes of each separator.
        kind: how the order was found.
        names: of the nodes; numbers when empty.
    """

    parent: IntArray
    pivots: IntArray
    rows: IntArray
    order: IntArray
    bounds: IntArray
    separators: tuple[IntArray, ...]
    kind: str
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of supernodes."""
        return len(self.parent)

    def nodes(self, supernode: int) -> IntArray:
        """Nodes a supernode eliminates, in order."""
        return self.order[self.bounds[supernode] : self.bounds[supernode + 1]]

    @property
    def fill(self) -> int:
        """Entries of the factor."""
        return int((self.pivots * (self.pivots + 1) // 2 + self.pivots * self.rows).sum())

    @property
    def flops(self) -> float:
        """Additions and multiplications of a factorisation."""
        w, r = self.pivots.astype(float), self.rows.astype(float)
        return float((w**3 / 3.0 + w * w * r + w * r * r).sum())

    @property
    def height(self) -> int:
        """Supernodes on the longest path from a root to a leaf."""
        depth = self._depths()
        return int(depth.max(initial=-1)) + 1

    def _depths(self) -> IntArray:
        depth = np.zeros(len(self), dtype=np.intp)
        for s in range(len(self) - 1, -1, -1):
            if self.parent[s] >= 0:
                depth[s] = depth[self.parent[s]] + 1
        return depth

    def text(self, name: Callable[[int], str] | None = None, limit: int = 60) -> str:
        """Indented outline, roots first: the nodes of each supernode, then ``|`` and its separator.

        Args:
            name: what to call a node; by default ``names``, or its number.
            limit: supernodes shown at most.
        """
        if name is None:
            name = self.names.__getitem__ if self.names else str
        head = (
            f"{len(self)} supernodes of {len(self.order)} nodes, height {self.height}, {self.fill} entries, "
            f"{self.flops:.3g} flops, {self.kind}"
        )
        lines, depth = [head], self._depths()
        for s in range(len(self) - 1, max(-1, len(self) - 1 - limit), -1):
            own = " ".join(name(int(k)) for k in self.nodes(s))
            given = " ".join(name(int(k)) for k in self.separators[s])
            lines.append("  " * int(depth[s]) + own + (f" | {given}" if given else ""))
        if len(self) > limit:
            lines.append(f"... {len(self) - limit} more")
        return "\n".join(lines)

    def __str__(self) -> str:
        """Outline with node numbers."""
        return self.text()
