"""Bounds of a term between consecutive factors: a proof that what holds at nodes holds between them."""

from __future__ import annotations

import numpy as np

from unifg.errors import GraphError
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.intervals import bounds
from unifg.factors.kernel import side_by_side
from unifg.lie import SE2, SO2, Manifold, Product, Rn
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.typing import Array, BoolArray


def tube(program: CompiledProblem, values: Values, name: str, pieces: int) -> Array:
    """(n - 1, m, 2) bounds; arguments and errors as of :meth:`unifg.Solution.tube`."""
    known = {term.name: term for term in program.terms}
    if name not in known:
        raise GraphError(f"no term is called '{name}' (there are: {', '.join(known)})", term=name)
    term = known[name]
    if (kernel := term.kernel) is None or not isinstance(expression := getattr(kernel, "expression", None), Expression):
        raise GraphError(f"tube: term '{name}' has no tape: it takes a function that is traced", term=name)
    variables, parameters, _ = kernel.split(term._for_kernel(term.points(values)), term.count)
    angles = [_angles(manifold) for manifold in kernel.manifolds]
    numbers = side_by_side(variables, term.count), side_by_side(parameters, term.count)
    ends = []
    for nodes, turned in zip(numbers, (np.concatenate(angles), np.zeros(numbers[1].shape[1], dtype=bool)), strict=True):
        step = np.diff(nodes, axis=0)
        step -= np.where(turned, 2.0 * np.pi * np.round(step / (2.0 * np.pi)), 0.0)
        between = nodes[:-1] + np.linspace(0.0, 1.0, pieces + 1)[:, None, None] * step
        shape = pieces * (term.count - 1), nodes.shape[1]
        pair = between[:-1].reshape(shape), between[1:].reshape(shape)
        ends.append((np.minimum(*pair), np.maximum(*pair)))
    low, high = bounds(expression, *ends)
    gaps = pieces, term.count - 1, term.size
    return np.stack([low.reshape(gaps).min(axis=0), high.reshape(gaps).max(axis=0)], axis=-1)


def _angles(manifold: Manifold) -> BoolArray:
    """Flags of the stored numbers that are angles.

    Raises:
        GraphError: straight lines between stored numbers leave the manifold.
    """
    if isinstance(manifold, Product):
        return np.concatenate([_angles(part.manifold) for part in manifold.components.values()])
    flags: BoolArray = np.zeros(manifold.storage, dtype=bool)
    if manifold in (SE2, SO2):
        flags[-1] = True
    elif not isinstance(manifold, Rn):
        raise GraphError(f"tube: straight lines between stored numbers leave {manifold.name}; take vectors, SO2 or SE2")
    return flags
