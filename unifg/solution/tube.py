"""Bounds of a term between consecutive factors: a proof that what holds at nodes holds between them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.errors import GraphError
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.intervals import bounds
from unifg.factors.kernel import side_by_side
from unifg.factors.steps import ANGLE, OTHER, TURN, parts_of
from unifg.modeling.variables import Data
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solution.gains import REPLACED
from unifg.typing import Array


def tube(program: CompiledProblem, values: Values, data: Mapping[Data, Array], name: str, pieces: int) -> Array:
    """(n - 1, m, 2) bounds; arguments and errors as of :meth:`unifg.Solution.tube`."""
    term = program.term_named(name)
    if (kernel := term.kernel) is None or not isinstance(expression := getattr(kernel, "expression", None), Expression):
        raise GraphError(f"tube: term '{name}' has no tape: it takes a function that is traced", term=name)
    if not all(np.array_equal(data[handle], program.binding.present[handle]) for handle in term.term.data):
        raise GraphError(f"tube: term '{name}': {REPLACED}")
    variables, parameters, _ = kernel.split(term._for_kernel(term.points(values)), term.count)
    numbers = side_by_side(variables, term.count), side_by_side(parameters, term.count)
    turned, ends = np.zeros(numbers[0].shape[1], dtype=bool), []
    for part, leaf in parts_of(*kernel.manifolds):
        if part.kind in (TURN, OTHER):
            raise GraphError(f"tube: straight lines between stored numbers leave {leaf.name}; take vectors, SO2 or SE2")
        turned[part.start] = part.kind == ANGLE
    for nodes, angles in zip(numbers, (turned, np.zeros(numbers[1].shape[1], dtype=bool)), strict=True):
        step = np.diff(nodes, axis=0)
        step -= np.where(angles, 2.0 * np.pi * np.round(step / (2.0 * np.pi)), 0.0)
        between = nodes[:-1] + np.linspace(0.0, 1.0, pieces + 1)[:, None, None] * step
        shape = pieces * (term.count - 1), nodes.shape[1]
        pair = between[:-1].reshape(shape), between[1:].reshape(shape)
        ends.append((np.minimum(*pair), np.maximum(*pair)))
    low, high = bounds(expression, *ends)
    gaps = pieces, term.count - 1, term.size
    return np.stack([low.reshape(gaps).min(axis=0), high.reshape(gaps).max(axis=0)], axis=-1)
