"""The graphs that most tests begin with: their families, and nothing or one wish stated of them yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, overload

import numpy as np

import unifg as fg
from unifg.problem.compiled_problem import CompiledProblem
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.smoother import Smoother
from unifg.typing import Array

Members = tuple[str, fg.Manifold, int]
AnySmoother = TypeVar("AnySmoother", bound=Smoother)


def graph_with(manifold: fg.Manifold, count: int = 1, name: str = "x", **options: Any) -> tuple[fg.Graph, fg.Family]:
    """An empty graph and its one family of variables; options are those of the family."""
    graph = fg.Graph()
    return graph, graph.variables(name, manifold, count, **options)


def smoother_with(smoother: AnySmoother, manifold: fg.Manifold, name: str = "x") -> tuple[AnySmoother, GrowingFamily]:
    """A smoother and its one family of variables."""
    return smoother, smoother.variables(name, manifold)


@overload
def graph_of(first: Members, second: Members, /) -> tuple[fg.Graph, fg.Family, fg.Family]: ...
@overload
def graph_of(
    first: Members, second: Members, third: Members, /
) -> tuple[fg.Graph, fg.Family, fg.Family, fg.Family]: ...
def graph_of(*families: Members) -> tuple[Any, ...]:
    """An empty graph and its families of variables: of each the name, the manifold and how many there are."""
    graph = fg.Graph()
    return graph, *(graph.variables(*members) for members in families)


def drawn_to(target: Sequence[float], count: int = 1, **options: Any) -> tuple[fg.Graph, fg.Family]:
    """A graph of points that each wants to be at a target, and the points; options are those of the wish."""
    graph, x = graph_with(fg.Rn(len(target)), count)
    graph.minimize(fg.prior, x, target, **options)
    return graph, x


def program_of(graph: fg.Graph) -> CompiledProblem:
    """A graph compiled, its data at their defaults."""
    program = graph.compile()
    program.bind({})
    return program


def weighed_chain(seed: int, sigma: float, soft: float | None = None) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """A linear robot of two states and one bounded control, drawn to a goal with ``sigma``, and a guess at rest."""
    rng, graph = np.random.default_rng(seed), fg.Graph()
    x, u = graph.variables("x", fg.Rn(2), 9), graph.variables("u", fg.Rn(1), 8)
    A, B, start, goal = (rng.normal(size=size) for size in ((2, 2), (2, 1), 2, 2))
    graph.fix(x[0], start)
    graph.constrain(lambda a, b, c: c - a - 0.1 * (a @ A.T + b @ B.T), x[:-1], u, x[1:], lower=0.0, upper=0.0)
    graph.minimize(fg.prior, x[-1], goal, sigma=sigma, name="goal")
    graph.minimize(fg.prior, u, [0.0], sigma=30.0 * sigma, name="effort")
    graph.bound(u, upper=1.0)
    graph.constrain(lambda p: p[:, :1] - p[:, 1:], x[1:], lower=-2.0, upper=2.0, soft=soft, name="room")
    return graph, {x: np.tile(start, (9, 1)), u: np.zeros((8, 1))}
