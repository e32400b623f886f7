"""Structure of stacked terms: their rows, and the blocks of the Hessian that they fill."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from unifg.elimination.symmetric import Symmetric
from unifg.errors import GraphError
from unifg.problem.columns import Columns
from unifg.problem.term import CompiledTerm
from unifg.typing import Array


def require_touched(terms: Sequence[CompiledTerm], columns: Columns) -> None:
    """Raise unless every unknown is part of some term.

    Raises:
        GraphError: naming the first variable that is not.
    """
    touched = np.zeros(columns.width, dtype=bool)
    for term in terms:
        for part in term.columns:
            touched[part] = True
    idle = columns.free[~touched[columns.free]]
    if len(idle):
        family, index = columns.name(int(idle[0]))
        raise GraphError(
            f"{family}[{index}] is in no cost or constraint and is not fixed: {len(idle)} tangent coordinates "
            "are free to be anything; add a term, fix it, or make the family shorter",
            family=family,
            index=index,
        )


def block_pattern(terms: Sequence[CompiledTerm], columns: Columns) -> Symmetric:
    """Pattern of a Hessian: every two variables of a factor share a block."""
    variable, starts = columns.nodes()
    first, second = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for term in terms:
        members = [variable[part[:, 0]] for part in term.columns]
        for k, a in enumerate(members):
            for b in members[:k]:
                first.append(np.minimum(a, b))
                second.append(np.maximum(a, b))
    return Symmetric.of_blocks(starts, np.concatenate(first), np.concatenate(second))


def row_slices(terms: Sequence[CompiledTerm]) -> list[slice]:
    """Rows of each term in the stack."""
    ends = np.cumsum([0] + [term.count * term.size for term in terms]).tolist()
    return [slice(start, end) for start, end in pairwise(ends)]


def side_by_side(parts: list[Array]) -> Array:
    """One flat array, also of nothing."""
    return np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0)
