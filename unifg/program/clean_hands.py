"""What is asked of a user's function at the guess: that it changes no arguments and writes every row."""

from __future__ import annotations

import numpy as np

from unifg.errors import GraphError
from unifg.kernels.kernel import Kernel, evaluate_rows, side_by_side
from unifg.language.terms import ScalarCost
from unifg.machine.jit import is_compiled
from unifg.program.columns import Values
from unifg.program.term import CompiledTerm
from unifg.typing import Array


def require_clean(term: CompiledTerm, values: Values) -> None:
    """Call a user's function once at the guess, and refuse one that changes its arguments or leaves rows out.

    Raises:
        GraphError: naming the term and the argument or row.
    """
    if term.is_bound:
        return
    points = [np.array(gather(values)) for gather in term.gathers]
    with np.errstate(all="ignore"):
        if term.kernel is None or isinstance(term.term, ScalarCost):
            _batched(term, points)
        elif is_compiled(term.term.residual.function):
            _one_by_one(term, term.kernel, points)


def _batched(term: CompiledTerm, points: list[Array]) -> None:
    arguments = [a.copy() if isinstance(a, np.ndarray) else a for a in term.fill(points)]
    before = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
    term.term.residual.function(*arguments)
    for place, (given, kept) in enumerate(zip(arguments, before, strict=True)):
        if isinstance(given, np.ndarray) and given.tobytes() != kept.tobytes():
            raise GraphError(_changes(term.name, place), term=term.name)


def _one_by_one(term: CompiledTerm, kernel: Kernel, points: list[Array]) -> None:
    variables, parameters, count = kernel.split(term.fill(points), term.count)
    packed, shared = side_by_side(variables, count), side_by_side(parameters)
    v, p = packed.copy(), shared.copy()
    twice = []
    for filled in (np.nan, 0.0):
        rows = np.full((count, term.size), filled)
        evaluate_rows(kernel.address, v, p, kernel.table, rows, np.empty((0, 0, 0)))
        twice.append(rows)
    if v.tobytes() != packed.tobytes() or p.tobytes() != shared.tobytes():
        place = 0 if v.tobytes() != packed.tobytes() else len(variables)
        raise GraphError(_changes(term.name, place), term=term.name)
    missing = np.isnan(twice[0]) & ~np.isnan(twice[1])
    if missing.any():
        index, row = (int(k) for k in np.argwhere(missing)[0])
        raise GraphError(
            f"term '{term.name}': its function does not write row {row} of factor {index}", term=term.name, index=index
        )


def _changes(name: str, place: int) -> str:
    """What to say of a function that writes where it should read."""
    return f"term '{name}': its function changes its argument {place}, which belongs to the solver: work on a copy"
