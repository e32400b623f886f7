"""A small problem for every backend: a walk towards a goal that data move, stated as the backend takes it.

Its functions stand in a module, so that other processes find them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

import unifg as fg
from unifg.solvers import SQP, GraduatedNonConvexity
from unifg.solvers.names import TABLE, backend
from unifg.typing import Array

LENGTH = 12
BACKENDS: dict[str, Any] = {name: backend(name) for name in TABLE if name != "gnc"} | {
    "gnc": GraduatedNonConvexity(),
    "sqp graph": SQP(qp="graph"),
    "sqp exact": SQP(hessian="exact"),
}


def curved(x: Array, goal: Array) -> Array:
    """Offset from the goal, on a bent floor."""
    return np.asarray(0.1 * np.sin(x) + x - goal)


def low(x: Array) -> Array:
    """Value that must stay below a limit."""
    return np.asarray(x[:, :1] + 0.3 * x[:, 1:] ** 2)


class Walk:
    """The graph and where to begin.

    Attributes:
        graph: for one backend.
        x: its family.
        goal: (2,) data.
        guess: all zero.
    """

    def __init__(self, name: str) -> None:
        """State what the backend takes."""
        self.graph = fg.Graph()
        self.x = self.graph.variables("x", fg.Rn(2), LENGTH)
        self.goal = self.graph.data("goal", [0.0, 0.0])
        self.guess: Mapping[fg.Family, Array] = {self.x: np.zeros((LENGTH, 2))}
        kind = BACKENDS[name].constraints
        self.graph.minimize(fg.difference, self.x[:-1], self.x[1:], sigma=1.0, name="smooth")
        loss = fg.TruncatedLeastSquares(50.0) if name == "gnc" else None
        self.graph.minimize(curved, self.x, self.goal, sigma=0.5, robust=loss, name="pull")
        if kind != "none":
            self.graph.constrain(curved, self.x[0], self.goal, lower=0, upper=0, name="begin")
        if kind == "all":
            self.graph.constrain(low, self.x[::2], lower=-np.inf, upper=2.0, name="low")

    def solved(self, name: str, number: int) -> fg.Solution:
        """The solution for one of many goals."""
        solution: fg.Solution = BACKENDS[name].solve(self.graph, self.guess, data={self.goal: goal_of(number)})
        return solution


def goal_of(number: int) -> Array:
    """One of many goals."""
    return np.array([0.3, -0.2]) * number + 0.1


def solved_elsewhere(name: str, number: int) -> fg.Solution:
    """Solution that a process computes for one of many goals."""
    return Walk(name).solved(name, number)


def solved_as_sent(work: tuple[str, Walk, int]) -> fg.Solution:
    """The same for a graph that has come from another process."""
    name, walk, number = work
    return walk.solved(name, number)


def everything(numbers: int = 2) -> list[tuple[str, Walk, int]]:
    """Work for every backend."""
    return [(name, Walk(name), number) for name in BACKENDS for number in range(1, numbers)]
