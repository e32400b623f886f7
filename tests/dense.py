"""A dense Gauss-Newton solver over the same statements: slow, short, and independent of every elimination order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numba
import numpy as np

import unifg as fg
from unifg.modeling.model import complete
from unifg.pose_graphs.pose_graph import Edges, PoseGraph
from unifg.typing import Array

Model = tuple[Any, Sequence[int], Sequence[Any], Any]
"""Residual, numbers of its variables, parameters, standard deviations."""


class Batch:
    """Variables with one manifold each, or all with the last one named, and factors that are never forgotten."""

    def __init__(self, manifolds: Sequence[Any]) -> None:
        self.manifolds = list(manifolds)
        self.values: list[Array] = []
        self.statements: list[Model] = []

    def manifold(self, i: int) -> Any:
        return self.manifolds[min(i, len(self.manifolds) - 1)]

    def minimize(self, function: Any, variables: Sequence[int], parameters: Sequence[Any], sigma: Any) -> None:
        self.statements.append((function, variables, parameters, sigma))

    def add(self, value: Any) -> None:
        self.values.append(np.asarray(value, dtype=float))

    def stack(self) -> Array:
        return np.array(self.values)

    def starts(self) -> Array:
        return np.cumsum([0, *(self.manifold(i).dim for i in range(len(self.values)))])

    def hessian(self) -> tuple[Array, Array]:
        """J'J and J'r."""
        starts = self.starts()
        H, g = np.zeros((starts[-1], starts[-1])), np.zeros(starts[-1])
        for function, variables, parameters, sigma in self.statements:
            arguments = [self.values[i][None] for i in variables] + [np.asarray(p)[None] for p in parameters]
            r = self._residual(function, variables, arguments)[0] / sigma
            blocks = self._complete(function, variables).jacobian(*arguments)  # type: ignore[misc]
            columns = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in variables])
            J = np.concatenate(blocks, axis=2)[0] / np.broadcast_to(sigma, r.shape)[:, None]
            H[np.ix_(columns, columns)] += J.T @ J
            g[columns] += J.T @ r
        return H, g

    def step(self) -> None:
        H, g = self.hessian()
        self.move(np.asarray(-np.linalg.solve(H, g), dtype=np.float64))

    def move(self, d: Array) -> None:
        starts = self.starts()
        for i, value in enumerate(self.values):
            self.values[i] = self.manifold(i).retract(value, d[starts[i] : starts[i + 1]])

    def cost(self) -> float:
        total = 0.0
        for function, variables, parameters, sigma in self.statements:
            arguments = [self.values[i][None] for i in variables] + [np.asarray(p)[None] for p in parameters]
            total += 0.5 * float(np.sum((self._residual(function, variables, arguments)[0] / sigma) ** 2))
        return total

    def _complete(self, function: Any, variables: Sequence[int]) -> fg.Residual:
        family = fg.Family("any", self.manifold(variables[0]), 1)
        return complete(function, (family,))

    def _residual(self, function: Any, variables: Sequence[int], arguments: list[Array]) -> Array:
        return self._complete(function, variables)(*arguments)


def state(smoother: Any, family: Any, statements: Iterable[Model]) -> None:
    """State to a smoother what is said of members of one family."""
    for function, variables, parameters, sigma in statements:
        smoother.minimize(function, *[family[i] for i in variables], *parameters, sigma=sigma)


@numba.njit  # type: ignore[untyped-decorator]
def seen_once(pose: Array, point: Array, measured: Array, r: Array) -> None:
    """A point seen from a pose of the plane, in the frame of the pose."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = point[0] - pose[0], point[1] - pose[1]
    r[0] = c * dx + s * dy - measured[0]
    r[1] = c * dy - s * dx - measured[1]


def drive(group: Any, rng: np.random.Generator, count: int) -> Iterator[list[Model]]:
    """Statements that arrive with each pose of a noisy drive with loop closures and a few priors."""
    truth = [group.identity()]
    for k in range(count):
        if k:
            truth.append(group.compose(truth[-1], group.exp(0.3 * rng.standard_normal(group.dim))))
        statements: list[Model] = []
        if k == 0:
            statements.append((fg.prior, [0], [truth[0]], 0.01 + np.zeros(group.dim)))
        others = [k - 1] if k else []
        if k > 2 and rng.random() < 0.4:
            others += rng.choice(k - 1, size=min(k - 1, int(rng.integers(1, 4))), replace=False).tolist()
        for i in others:
            noise = group.exp(0.03 * rng.standard_normal(group.dim))
            measured = group.compose(group.between(truth[i], truth[k]), noise)
            first, second = (i, k) if rng.random() < 0.7 else (k, i)
            if first == k:
                measured = group.inverse(measured)
            statements.append((fg.between, [first, second], [measured], rng.uniform(0.05, 0.2, group.dim)))
        if rng.random() < 0.1:
            statements.append((fg.prior, [k], [truth[k]], 0.3 + np.zeros(group.dim)))
        yield statements


def one_by_one(graph: PoseGraph) -> Iterator[tuple[Array, Edges]]:
    """For each pose its measured odometry (for the first its value), and the edges that end at it."""
    later = np.maximum(graph.edges.first, graph.edges.second)
    order = np.argsort(later, kind="stable")
    bounds = np.searchsorted(later[order], np.arange(len(graph.poses) + 1))
    for k in range(len(graph.poses)):
        edges = graph.edges[order[bounds[k] : bounds[k + 1]]]
        odometry = edges.measured[(edges.first == k - 1) & (edges.second == k)]
        yield (graph.poses[0] if k == 0 else odometry[0]), edges
