"""Symbolic analysis: choose an order, build the tree, lay out the fronts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from unifg.elimination.chain import stages
from unifg.elimination.dissection import separators
from unifg.elimination.layout import lay_out
from unifg.elimination.metis import installed, metis_order
from unifg.elimination.ordering import block_graph, indistinguishable
from unifg.elimination.plan import LARGEST, PANEL, PIVOTS, ROWS, SCALARS, Plan
from unifg.elimination.symbolic import cliques, postordered, predicted_cost
from unifg.errors import UnifgError
from unifg.typing import IntArray

Ordering: TypeAlias = Literal["auto", "minimum-degree", "nested-dissection", "metis", "natural"] | IntArray
SLACK = 16  # numbers the kernels may read beyond the last matrix
DISSECT = 4e6, 3e3  # predicted nanoseconds, in all and per node, from which nested dissection is tried
FILL = 1.4  # see :func:`_fits`
NOTHING = np.zeros(0)


Tree: TypeAlias = tuple[IntArray, IntArray, IntArray, IntArray]
"""Nodes front after front, pointers to it, parents, and the scalars each front passes on."""


class Graph(NamedTuple):
    """Graph of the nodes of a matrix.

    Attributes:
        weight: (nodes,) scalars of each node.
        pointer, neighbours: the symmetric graph.
    """

    weight: IntArray
    pointer: IntArray
    neighbours: IntArray

    def tree(self, order: IntArray | None = None, stage: IntArray | None = None, last: int = 0) -> Tree:
        """Elimination tree of a given order, or of minimum degree within stages; dense nodes come last.

        So many of the ``last`` nodes come after all others.
        """
        nodes, degree = len(self.weight), np.diff(self.pointer)
        stage = np.zeros(nodes, np.int64) if stage is None else stage
        if order is None:
            stage[degree > 16 + int(10.0 * np.sqrt(nodes))] = stage.max(initial=0) + 1
            stage[nodes - last :] = stage.max(initial=0) + 1
        first = np.repeat(np.arange(nodes), degree)
        pairs = np.column_stack([first, self.neighbours])[self.neighbours > first]
        given = np.zeros(0, np.int64) if order is None else order
        pointer = np.arange(0, pairs.size + 1, 2)
        found = cliques(self.weight, stage, np.zeros(nodes, np.bool_), given, True, pairs.ravel(), pointer)
        return postordered(*found[:4])


class Structure(NamedTuple):
    """Result of the symbolic analysis.

    Attributes:
        plan: arguments of the compiled kernels, without memory to work in.
        numbers: how many a factorisation works in.
        starts: (nodes + 1,) first scalar of each node.
        order: (nodes,) nodes in the order of elimination.
        bounds: (S + 1,) where the nodes of each front begin in ``order``.
        parent: (S,) parent of each front or -1.
        kind: how the order was found.
    """

    plan: Plan
    numbers: int
    starts: IntArray
    order: IntArray
    bounds: IntArray
    parent: IntArray
    kind: str

    def with_memory(self) -> Plan:
        """The plan with memory of its own: whoever factorises needs one."""
        plan = self.plan
        size, largest = int(plan.shape[SCALARS]), int(plan.shape[LARGEST])
        return plan._replace(
            numbers=np.zeros(self.numbers),
            pivots=np.ones(size + 3),
            signs=np.ones(size + 3),
            work=np.zeros(size + largest + SLACK),
            state=np.array([0, 0, 0, -1]),
        )


def analyse(
    indptr: IntArray, indices: IntArray, blocks: IntArray | None, ordering: Ordering, last: int = 0
) -> Structure:
    """Analyse a pattern; arguments as for `factorization.Factorization`, the pattern as its two arrays.

    Raises:
        UnifgError: labels or permutation are not what they should be.
    """
    size = len(indptr) - 1
    label = indistinguishable(indptr, indices) if blocks is None else _labels(blocks, size)
    first = size - last
    if 0 < first < size and label[first] == label[first - 1]:  # a node is of the first or of the last
        label[first:] += 1
    nodes = int(label[-1]) + 1 if size else 0
    starts = np.searchsorted(label, np.arange(nodes + 1))
    weight = np.diff(starts)
    pointer, neighbours = block_graph(indptr, indices, label, nodes)
    kind: str = ordering if isinstance(ordering, str) else "given order"
    graph = Graph(weight, pointer, neighbours)
    if not isinstance(ordering, str):
        tree = graph.tree(_permutation(ordering, nodes))
    elif ordering == "natural":
        tree = graph.tree(np.arange(nodes))
    elif ordering == "nested-dissection":
        tree = graph.tree(stage=separators(pointer, neighbours, weight))
    elif ordering == "metis":
        kind, tree = "METIS", graph.tree(metis_order(pointer, neighbours, weight))
    elif ordering == "minimum-degree":
        tree = graph.tree()
    elif ordering == "auto":
        kind, tree = _cheapest(graph, nodes - int(label[first]) if last else 0)
    else:
        raise UnifgError(
            f"ordering {ordering!r} is unknown: choose auto, minimum-degree, nested-dissection, metis, natural or "
            "give a permutation"
        )
    order, bounds, parent, passed = tree
    table, scalar_order, rows, relative, runs, slots, part, waiting = lay_out(
        indptr, indices, starts, pointer, neighbours, order, bounds, parent, passed
    )
    largest = int((table[:, PIVOTS] + table[:, ROWS]).max(initial=0))
    panels = int(table[-1, PANEL])
    plan = Plan(
        shape=np.array([size, len(parent), largest, panels]),
        fronts=table,
        order=scalar_order,
        rows=rows,
        relative=relative,
        runs=runs,
        slots=slots,
        numbers=NOTHING,
        pivots=NOTHING,
        signs=NOTHING,
        work=NOTHING,
        state=np.zeros(0, np.int64),
        part=part,
    )
    return Structure(plan, panels + waiting + SLACK, starts, order, bounds, parent, kind)


def _cheapest(graph: Graph, last: int) -> tuple[str, Tree]:
    """The order of least predicted cost, and its name; so many nodes come ``last``."""
    weight, pointer, neighbours = graph
    chain, line, least = stages(pointer, neighbours, weight)
    chain &= last == 0
    if chain and _fits(graph, line):
        return "chain", line
    kind, tree = "minimum-degree", graph.tree(last=last)
    cost = predicted_cost(weight, tree[0], tree[1], tree[3])
    candidates: list[tuple[str, Callable[[], Tree]]] = []
    if cost > max(DISSECT[0], DISSECT[1] * len(weight)):
        candidates.append(
            ("nested-dissection", lambda: graph.tree(stage=separators(pointer, neighbours, weight), last=last))
        )
        if installed() and last == 0:
            candidates.append(("METIS", lambda: graph.tree(metis_order(pointer, neighbours, weight))))
    for name, make in candidates:
        other = make()
        if (less := predicted_cost(weight, other[0], other[1], other[3])) < cost:
            kind, tree, cost = name, other, less
    return ("chain", line) if chain and least <= cost else (kind, tree)


def _fits(graph: Graph, line: Tree) -> bool:
    """Test whether a chain's fronts take about what each node would with the neighbours that it begins with.

    Then hardly anything fills in, and no other order need be looked for: of 1600 graphs those for which minimum degree
    is better are at 1.7 or more, plans of robots at 0.5 to 1.3.
    """
    weight, pointer, neighbours = graph
    order, bounds, _, passed = line
    own = np.diff(_sums(weight[order])[bounds])
    beside = weight + np.diff(_sums(weight[neighbours])[pointer])
    return bool((own * (own + passed) ** 2).sum() <= FILL * (weight * beside**2).sum())


def _sums(numbers: IntArray) -> IntArray:
    """(n + 1,) sums of the first numbers."""
    return np.concatenate([[0], np.cumsum(numbers)])


def _labels(blocks: IntArray, size: int) -> IntArray:
    """Consecutive labels from 0, checked."""
    blocks = np.asarray(blocks)
    if blocks.shape != (size,):
        raise UnifgError(f"blocks has shape {blocks.shape} where one label per scalar, ({size},), is needed")
    change = np.diff(blocks)
    if (change < 0).any():
        at = int(np.argmax(change < 0)) + 1
        raise UnifgError(f"blocks decreases at scalar {at}; number the nodes in the order of their scalars")
    result = np.zeros(size, np.int64)
    np.cumsum(change != 0, out=result[1:])
    return result


def _permutation(order: IntArray, nodes: int) -> IntArray:
    """A permutation of the nodes, checked."""
    order = np.asarray(order, dtype=np.int64)
    if order.shape != (nodes,) or not np.array_equal(np.sort(order), np.arange(nodes)):
        raise UnifgError(f"ordering is not a permutation of the {nodes} nodes; name each node once")
    return order
