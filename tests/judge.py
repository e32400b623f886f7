"""An independent judge of optimality: nothing but term functions and dense central differences.

It shares no code with the compiled program: it reads what the graph states, moves one tangent coordinate at a
time, and measures the KKT conditions of L = f + lambda' g.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.modeling.terms import Constraint, Cost, ScalarCost
from unifg.modeling.variables import Data, Selection
from unifg.typing import Array

STEP = 1e-5
WIDE = 2e-4  # of second differences
FLAT = 1e-5  # singular values below it, relative to the largest, are as good as none
ROUNDING = 1e-12  # of the residuals of graphs that fit exactly, numbers of order one


@dataclass
class KktNumbers:
    """KKT numbers found by the judge."""

    stationarity: float
    violation: float
    complementarity: float
    wrong_sign: float

    def worst(self) -> float:
        """The largest of them."""
        return max(self.stationarity, self.violation, self.complementarity, self.wrong_sign)


def judge(graph: fg.Graph, solution: fg.Solution, data: dict[Data, Array] | None = None) -> KktNumbers:
    """Measure the KKT conditions of ``graph`` at ``solution``."""
    data = data or {}
    values = solution.values
    moved = [(family, row, column) for family, row, column in _free(graph)]
    if all(isinstance(term, Cost) for term in graph.terms):
        return KktNumbers(_relative_offset(graph, values, moved, data), 0.0, 0.0, 0.0)
    beside = np.array([[_f(graph, _at(values, m, step), data) for step in (STEP, -STEP)] for m in moved])
    gradient = (beside[:, 0] - beside[:, 1]) / (2.0 * STEP)
    bend = np.abs(beside.sum(axis=1) - 2.0 * _f(graph, values, data)) / STEP**2
    most = max(float(np.abs(gradient).max(initial=0.0)), float(bend.max(initial=0.0)))
    least = most if 0.0 < most < 1.0 else 1.0  # size of costs
    duals = _duals(graph, solution)
    force = float(np.abs(duals).mean()) / 100.0 if len(duals) else 0.0
    worth = max(least, min(1.0, float((gradient**2 / np.where(bend > 0.0, bend, np.inf)).max(initial=0.0))))
    scale, worth = max(least, force), max(worth, force)
    # Or relative, to a hundredth of the largest of what a gradient is a sum of.
    sizes, shares = np.maximum(0.01 * np.abs(gradient), scale), np.full(len(duals), 1.0 / worth)
    if len(duals):
        columns = [(_g(graph, _at(values, m, STEP), data) - _g(graph, _at(values, m, -STEP), data)) for m in moved]
        slopes = np.array(columns) / (2.0 * STEP)
        gradient = gradient + slopes @ duals
        sizes = np.maximum(sizes, 0.01 * np.abs(slopes * duals).max(axis=1, initial=0.0))
        shares = np.minimum(shares, (np.abs(slopes) / sizes[:, None]).max(axis=0, initial=0.0))
    lower, upper = _limits(graph, data)
    g = _g(graph, values, data)
    outside = np.maximum(np.maximum(g - upper, lower - g), 0.0)
    wrong = np.where((duals > 0.0) & np.isinf(upper) | (duals < 0.0) & np.isinf(lower), np.abs(duals), 0.0)
    limit = np.where(duals > 0.0, upper, lower)
    slack = np.where(np.isfinite(limit) & (lower != upper), np.abs(g - np.where(np.isfinite(limit), limit, 0.0)), 0.0)
    return KktNumbers(
        float((np.abs(gradient) / sizes).max(initial=0.0)),
        float(outside.max(initial=0.0)),
        float((np.abs(duals) * slack * shares).max(initial=0.0)),
        float(wrong.max(initial=0.0)),
    )


def _relative_offset(
    graph: fg.Graph,
    values: dict[fg.Family, Array],
    moved: list[tuple[fg.Family, int, int]],
    data: dict[Data, Array],
) -> float:
    """|P r| / |r| of least squares, P projecting onto the columns of a dense Jacobian by differences."""
    here, weights = _whitened(graph, values, data)
    columns = [
        _whitened(graph, _at(values, m, STEP), data)[0] - _whitened(graph, _at(values, m, -STEP), data)[0]
        for m in moved
    ]
    jacobian = np.sqrt(weights)[:, None] * np.array(columns).T / (2.0 * STEP)
    here = np.sqrt(weights) * here
    lengths = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / np.where(lengths > 0.0, lengths, 1.0), compute_uv=False)
    if len(singular) and singular[-1] < FLAT * singular[0] and np.linalg.norm(here) > ROUNDING:
        hessian = _second(graph, values, moved, data)
        # Curvature may determine what slopes do not.
        if np.linalg.eigvalsh(hessian / np.outer(lengths, lengths))[0] > FLAT:
            gradient = jacobian.T @ here
            promised = max(float(gradient @ np.linalg.solve(hessian, gradient)), 0.0)
            return float(np.sqrt(promised) / np.linalg.norm(here))
    share = float(np.linalg.norm(jacobian @ np.linalg.lstsq(jacobian, here, rcond=None)[0]))
    return 0.0 if share <= ROUNDING else share / float(np.linalg.norm(here))


def _second(
    graph: fg.Graph,
    values: dict[fg.Family, Array],
    moved: list[tuple[fg.Family, int, int]],
    data: dict[Data, Array],
) -> Array:
    """Dense Hessian of the cost by differences."""
    result = np.empty((len(moved), len(moved)))
    for i, first in enumerate(moved):
        for j, second in enumerate(moved[: i + 1]):
            corners = [
                a * b * _f(graph, _at(_at(values, first, a * WIDE), second, b * WIDE), data)
                for a in (1.0, -1.0)
                for b in (1.0, -1.0)
            ]
            result[i, j] = result[j, i] = sum(corners) / (4.0 * WIDE**2)
    return result


def _whitened(graph: fg.Graph, values: dict[fg.Family, Array], data: dict[Data, Array]) -> tuple[Array, Array]:
    """Stacked whitened residuals of all costs, and the weight that its loss gives each of them."""
    parts, weights = [np.zeros(0)], [np.zeros(0)]
    for term in graph.terms:
        assert isinstance(term, Cost)
        r = _call(term, values, data)
        if term.sigma is not None:
            r = r / _parameter(term.sigma, data)
        elif term.information is not None:
            omega = np.broadcast_to(_parameter(term.information, data), (len(r), r.shape[1], r.shape[1]))
            r = np.einsum("nji,nj->ni", np.linalg.cholesky(omega), r)
        squared = (r**2).sum(axis=1)
        weight = np.ones(len(r)) if term.robust is None else term.robust.weight(squared)
        parts.append(r.ravel())
        weights.append(np.repeat(np.where(_active(term, data), weight, 0.0), r.shape[1]))
    return np.concatenate(parts), np.concatenate(weights)


def _free(graph: fg.Graph) -> list[tuple[fg.Family, int, int]]:
    held = {
        (fix.selection.family.name, int(row), column)
        for fix in graph.fixes
        for row in fix.selection.indices
        for column in range(fix.selection.tangent.start, fix.selection.tangent.stop)
    }
    return [
        (family, row, column)
        for family in graph.families.values()
        for row in range(family.count)
        for column in range(family.manifold.dim)
        if (family.name, row, column) not in held
    ]


def _at(values: dict[fg.Family, Array], moved: tuple[fg.Family, int, int], size: float) -> dict[fg.Family, Array]:
    family, row, column = moved
    direction = np.zeros(family.manifold.dim)
    direction[column] = size
    array = values[family].copy()
    array[row] = family.manifold.retract(array[row], direction)
    return {**values, family: array}


def _call(term: Any, values: dict[fg.Family, Array], data: dict[Data, Array]) -> Array:
    arguments: list[Any] = []
    for argument in term.arguments:
        if isinstance(argument, Selection):
            part = values[argument.family][argument.indices][:, argument.storage]
            arguments.append(np.repeat(part, term.count, axis=0) if len(part) == 1 and term.count > 1 else part)
        elif isinstance(argument, Data):
            arguments.append(data.get(argument, argument.value))
        else:
            arguments.append(argument)
    return np.asarray(term.residual.function(*arguments), dtype=np.float64)


def _active(term: Any, data: dict[Data, Array]) -> Array:
    mask = term.active
    if isinstance(mask, Data):
        mask = data.get(mask, mask.value)
    return np.ones(term.count, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)


def _parameter(value: Any, data: dict[Data, Array]) -> Array:
    return np.asarray(data.get(value, value.value) if isinstance(value, Data) else value, dtype=np.float64)


def _f(graph: fg.Graph, values: dict[fg.Family, Array], data: dict[Data, Array]) -> float:
    total = 0.0
    for term in graph.terms:
        if isinstance(term, ScalarCost):
            total += float(_call(term, values, data)[_active(term, data)].sum())
        if isinstance(term, Cost):
            r = _call(term, values, data)
            if term.sigma is not None:
                squared = ((r / _parameter(term.sigma, data)) ** 2).sum(axis=1)
            elif term.information is not None:
                omega = np.broadcast_to(_parameter(term.information, data), (len(r), r.shape[1], r.shape[1]))
                squared = np.array([row @ matrix @ row for row, matrix in zip(r, omega, strict=True)])
            else:
                squared = (r**2).sum(axis=1)
            if term.robust is not None:
                squared = term.robust.value(squared)
            total += 0.5 * float(squared[_active(term, data)].sum())
    return total


def _constraints(graph: fg.Graph) -> list[Constraint]:
    return [term for term in graph.terms if isinstance(term, Constraint)]


def _g(graph: fg.Graph, values: dict[fg.Family, Array], data: dict[Data, Array]) -> Array:
    parts = [np.where(_active(t, data)[:, None], _call(t, values, data), 0.0).ravel() for t in _constraints(graph)]
    return np.concatenate(parts) if parts else np.zeros(0)


def _limits(graph: fg.Graph, data: dict[Data, Array]) -> tuple[Array, Array]:
    lower, upper = [], []
    for term in _constraints(graph):
        shape = _call_shape(term, data)
        mask = _active(term, data)[:, None]
        lower.append(np.where(mask, np.broadcast_to(_parameter(term.lower, data), shape), -np.inf).ravel())
        upper.append(np.where(mask, np.broadcast_to(_parameter(term.upper, data), shape), np.inf).ravel())
    return (np.concatenate(lower), np.concatenate(upper)) if lower else (np.zeros(0), np.zeros(0))


def _call_shape(term: Constraint, data: dict[Data, Array]) -> tuple[int, ...]:
    values = {s.family: np.tile(s.family.manifold.identity(), (s.family.count, 1)) for s in term.selections}
    with np.errstate(all="ignore"):
        return _call(term, values, data).shape


def _duals(graph: fg.Graph, solution: fg.Solution) -> Array:
    parts = [solution.dual(term.name).ravel() for term in _constraints(graph)]
    return np.concatenate(parts) if parts else np.zeros(0)
