"""Horizons that branch: controls shared at first, then a tail of nodes for each future that is possible.

Contingency and branch model-predictive control (J. P. Alsterda, M. Brown and J. C. Gerdes, "Contingency model
predictive control for automated vehicles", 2019; Y. Chen, U. Rosolia, W. Ubellacker, N. Csomay-Shanklin and A. D. Ames,
"Interactive multi-modal motion planning with branch model predictive control", 2022). Constraints hold in every tail,
costs count by the probability of their node, so that the expected cost is minimised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import index

import numpy as np

from unifg.errors import GraphError
from unifg.horizon.robot import require_steps
from unifg.modeling.duplicates import doubles
from unifg.modeling.terms import Cost, ScalarCost, Term
from unifg.modeling.variables import Data, Family, Index, Selection
from unifg.solution.graph import Graph
from unifg.typing import Array, ArrayLike, IntArray

__all__ = ["BranchedSelection", "ExpectedCost", "Tree", "tree_of"]

LEAST = 1e-3  # probability that a cost counts by at least, so that no tail is left undetermined


@dataclass(frozen=True)
class Tree:
    """Order of the nodes of a horizon.

    Attributes:
        parents: N numbers; node k + 1 follows the node ``parents[k]``, which has a smaller number. Node 0 is the
            present, and control k leads to node k + 1.
    """

    parents: tuple[int, ...]

    def __post_init__(self) -> None:
        """Refuse what is no tree whose first control is shared.

        Raises:
            GraphError: when a node follows none that is before it, or several follow the present.
        """
        try:
            object.__setattr__(self, "parents", tuple(index(parent) for parent in self.parents))
        except TypeError as error:
            raise GraphError(
                f"a tree is made of whole numbers, the node that each step begins at, as Tree((0, 1, 1)); found "
                f"{self.parents!r}"
            ) from error
        for node, parent in enumerate(self.parents, start=1):
            if not 0 <= parent < node:
                raise GraphError(f"node {node} of the tree must follow one of 0 ... {node - 1}, found {parent}")
        if self.parents.count(0) != 1:
            raise GraphError(
                f"{self.parents.count(0)} nodes of the tree follow the present: one, for the first control is shared"
            )

    @classmethod
    def branched(cls, shared: int, tails: Sequence[int]) -> Tree:
        """Tree of ``shared`` steps, from the last node of which tails of so many steps each begin.

        Raises:
            GraphError: unless a step is shared and each tail has one.
        """
        if not isinstance(tails, Sequence | np.ndarray):
            raise GraphError(f"the tails of a tree are a list of their numbers of steps, found {tails!r}")
        require_steps("a tree", "shared", shared)
        for length in tails:
            require_steps("each tail of a tree", "tails", length)
        parents = list(range(shared))
        for length in tails:
            parents += [shared, *range(len(parents) + 1, len(parents) + length)]
        return cls(tuple(parents))

    def __len__(self) -> int:
        """Number of steps N."""
        return len(self.parents)

    @cached_property
    def begins(self) -> IntArray:
        """(N,) nodes at which the steps begin; step k ends at node k + 1."""
        return np.array(self.parents, dtype=np.intp)

    @cached_property
    def later(self) -> IntArray:
        """(M,) steps that follow another step, all but the first."""
        return np.flatnonzero(self.begins > 0)

    @cached_property
    def earlier(self) -> IntArray:
        """(M,) steps that these follow."""
        return self.begins[self.later] - 1

    @cached_property
    def paths(self) -> list[IntArray]:
        """Nodes from the present to each leaf, by the numbers of the leaves."""
        found = []
        for leaf in sorted(set(range(len(self) + 1)) - set(self.parents)):
            path = [leaf]
            while path[-1]:
                path.append(self.parents[path[-1] - 1])
            found.append(np.array(path[::-1], dtype=np.intp))
        return found

    @cached_property
    def leaves(self) -> IntArray:
        """(L,) nodes at which the tails end."""
        return np.array([path[-1] for path in self.paths], dtype=np.intp)

    @cached_property
    def inner(self) -> IntArray:
        """(N - L,) nodes between the present and the leaves."""
        return np.unique(self.begins)[1:]

    @cached_property
    def depths(self) -> IntArray:
        """(N + 1,) number of steps from the present to each node."""
        found = np.zeros(len(self) + 1, dtype=np.intp)
        for path in self.paths:
            found[path] = np.arange(len(path))
        return found

    def probabilities(self, leaves: ArrayLike) -> Array:
        """(N + 1,) of the nodes, from those of the leaves (L,), whose sum becomes 1.

        Raises:
            GraphError: when they are not as many, or not finite, not negative and not all zero.
        """
        given = doubles("the probabilities of the tails", leaves)
        if given.shape != self.leaves.shape or not (np.isfinite(given).all() and (given >= 0.0).all() and given.any()):
            raise GraphError(
                f"a tree with {len(self.leaves)} tails needs as many probabilities, finite ones that are not negative "
                f"nor all zero; found {leaves!r}"
            )
        found = np.zeros(len(self) + 1)
        for path, probability in zip(self.paths, given / given.sum(), strict=True):
            found[path] += probability
        return found


class BranchedSelection(Selection):
    """Nodes or controls of a horizon that branches; neighbours by number are not neighbours in time.

    Attributes:
        tree: order of the nodes.
    """

    def __init__(self, selection: Selection, tree: Tree) -> None:
        """Select the same as ``selection``."""
        super().__init__(selection.family, selection.indices, selection.component)
        self.tree = tree

    def __getitem__(self, index: Index) -> Selection:
        """Select again.

        Raises:
            GraphError: for what means neighbours or the end in a horizon without branches, as ``x[:-1]`` and ``x[-1]``.
        """
        if isinstance(index, slice):
            ambiguous = index not in (slice(None), slice(1, None))
        else:
            ambiguous = isinstance(index, int | np.integer) and index < 0
        if ambiguous:
            raise GraphError(
                f"this horizon branches, so '{self.family.name}' is not selected by {index}: tree = tree_of(x) names "
                "what follows what: tree.begins, tree.earlier, tree.later, tree.leaves",
                family=self.family.name,
            )
        found = super().__getitem__(index)
        return BranchedSelection(found, self.tree) if isinstance(index, slice) else found

    def __getattr__(self, name: str) -> Selection:
        """Select a component of a product manifold by its name."""
        return BranchedSelection(super().__getattr__(name), self.tree)


def tree_of(x: Selection) -> Tree:
    """Tree of the nodes that a term is given, a chain where they do not branch."""
    return x.tree if isinstance(x, BranchedSelection) else Tree(tuple(range(len(x) - 1)))


class ExpectedCost:
    """Costs of a horizon that branches, each weighted by the probability of its node."""

    def __init__(self, graph: Graph, terms: Sequence[Term], tree: Tree, x: Selection, u: Family) -> None:
        """Let the weights of the costs among stated terms be data.

        Raises:
            GraphError: for a cost that is not a square, is robust or whose weights are data, and for one with unknowns
                of which there are neither as many as nodes nor as controls.
        """
        self._tree = tree
        self._weights: list[tuple[Data, Array, IntArray, bool]] = []
        for term in terms:
            plain = not isinstance(term, ScalarCost)
            if isinstance(term, Cost):
                plain = (
                    term.robust is None and not isinstance(term.sigma, Data) and not isinstance(term.information, Data)
                )
            if not plain:
                raise GraphError(
                    f"term '{term.name}' cannot be weighted by the probability of its node: costs of a horizon that "
                    "branches are squares, without a robust loss or weights that are data",
                    term=term.name,
                )
            if isinstance(term, Cost):
                self._weigh(graph, term, self._nodes(term, x, u))

    def _nodes(self, term: Cost, x: Selection, u: Family) -> IntArray:
        """(n,) node of each factor: of those that it is about the one that is farthest from the present."""
        count, found = len(self._tree), np.zeros(term.count, dtype=np.intp)
        for selection in term.selections:
            family, places = selection.family, selection.indices
            if family is x.family:
                nodes = places - x.indices[0]
            elif family is u or len(family) == count:
                nodes = places + 1
            elif len(family) == count + 1:
                nodes = places
            elif len(family) == 1:
                continue
            else:
                raise GraphError(
                    f"term '{term.name}': '{family.name}' has {len(family)} members: {count + 1} nodes or {count} "
                    "controls tell which tail each belongs to",
                    term=term.name,
                )
            deeper = self._tree.depths[nodes] > self._tree.depths[found]
            found = np.where(deeper, nodes, found)
        return found

    def _weigh(self, graph: Graph, term: Cost, nodes: IntArray) -> None:
        shape: tuple[int, ...] = (term.count, term.size)
        matrix = term.information is not None
        stated = term.information if matrix else 1.0 if term.sigma is None else term.sigma
        shape = (*shape, term.size) if matrix else shape
        handle = graph.data(f"{term.name}: by probability", np.broadcast_to(np.asarray(stated), shape), each=True)
        if matrix:
            term.information = handle
        else:
            term.sigma = handle
        self._weights.append((handle, handle.value.copy(), nodes, matrix))

    def data(self, nodes: Array) -> dict[Data, ArrayLike]:
        """Weights for the probabilities (N + 1,) of the nodes."""
        found: dict[Data, ArrayLike] = {}
        for handle, stated, places, is_information in self._weights:
            weight = np.maximum(nodes[places], LEAST)
            if is_information:
                found[handle] = stated * weight[:, None, None]
            else:
                found[handle] = stated / np.sqrt(weight)[:, None]
        return found
