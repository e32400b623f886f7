"""Which tangent columns a term reaches, and the refusal of unknowns that no term does."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from unifg.errors import GraphError
from unifg.program.columns import Columns
from unifg.program.term import CompiledTerm
from unifg.typing import IntArray


def term_columns(columns: Columns, term: CompiledTerm) -> list[IntArray]:
    """(n, d_k) full columns of each variable argument of a term."""
    parts = [columns.of(selection) for selection in term.term.selections]
    return [np.broadcast_to(part, (term.count, part.shape[1])) for part in parts]


def require_touched(columns: Columns, terms: Iterable[CompiledTerm]) -> None:
    """Raise unless every unknown is part of some term.

    Raises:
        GraphError: naming the first variable that is not.
    """
    touched = np.zeros(columns.width, dtype=bool)
    for term in terms:
        for part in term_columns(columns, term):
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
