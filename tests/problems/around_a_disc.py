"""README's first graph, with its start as data."""

from __future__ import annotations

import numpy as np

import unifg as fg
from problems.graphs import graph_of
from unifg.models import unicycle
from unifg.typing import Array


def around_a_disc() -> tuple[fg.Graph, dict[fg.Family, Array], fg.Data]:
    """Graph, guess and start."""
    graph, x, u = graph_of(("x", fg.SE2, 21), ("u", fg.Rn(2), 20))
    start = graph.data("start", [0.0, 0.0, 0.0])
    graph.fix(x[0], start)
    graph.minimize(fg.prior, x[-1], [2, 1, 0], sigma=0.01, name="goal")
    graph.minimize(fg.prior, u, [0, 0], name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
    graph.constrain(lambda p: np.hypot(p[:, 0] - 1, p[:, 1] - 0.5)[:, None], x[1:], lower=0.4, name="disc")
    graph.bound(u, lower=-2, upper=2, name="limits")
    return graph, {x: np.linspace([0, 0, 0], [2, 1, 0], 21), u: np.zeros((20, 2))}, start
