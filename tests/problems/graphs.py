"""The graph that most tests begin with: one family, and nothing stated of it yet."""

from __future__ import annotations

import unifg as fg


def graph_with(manifold: fg.Manifold, count: int = 1, name: str = "x") -> tuple[fg.Graph, fg.Family]:
    """An empty graph and its one family of variables."""
    graph = fg.Graph()
    return graph, graph.variables(name, manifold, count)
