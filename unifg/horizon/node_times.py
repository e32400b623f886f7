"""Times of the nodes of a horizon."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unifg.errors import GraphError
from unifg.horizon.robot import Robot
from unifg.horizon.terms import Dynamics, Term
from unifg.horizon.tree import Tree
from unifg.horizon.window import Window
from unifg.modeling.duplicates import doubles
from unifg.typing import Array, ArrayLike


def node_times(
    times: ArrayLike | None, tree: Tree, robot: Robot, terms: Sequence[Term], window: Window | None
) -> Array:
    """(N + 1,) times of the nodes, with which the steps of dynamics agree, and the first one with those of the past."""
    given = tree.depths * (robot.tick or 1.0) if times is None else times
    nodes, count = doubles("the times of the nodes", given).copy(), len(tree) + 1
    growing = nodes.shape == (count,) and nodes[0] == 0.0 and np.isfinite(nodes).all()
    if not (growing and (nodes[1:] > nodes[tree.begins]).all()):
        raise GraphError(f"the times must be {count} growing numbers from 0 on, one for each node; got {nodes}")
    if times is not None and robot.predict is not None and robot.tick is None:
        raise GraphError("node times need the robot's tick: its predict(x, u, seconds) is given the length of a step")
    if robot.tick is not None and not np.isclose(robot.tick, nodes[1], rtol=1e-9, atol=0.0):
        raise GraphError(f"the first step must be as long as a tick of the robot ({robot.tick} s), got {nodes[1]} s")
    lengths = None if times is None and robot.tick is None else nodes[1:] - nodes[tree.begins]
    stepping = [(term, lengths) for term in terms]
    if window is not None and lengths is not None:
        stepping += [(term, lengths[:1]) for term in window.terms]
    for term, apart in stepping:
        if isinstance(term, Dynamics):
            term.require_step(apart)
    return nodes
