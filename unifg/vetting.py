"""What is asked of a user's function beside its shape: numbers it can be differentiated with, and clean hands."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.errors import GraphError
from unifg.jit import is_compiled
from unifg.kernels import Kernel, evaluate_rows, side_by_side
from unifg.terms import ScalarCost
from unifg.typing import Array

if TYPE_CHECKING:
    from unifg.columns import Values
    from unifg.compiled import CompiledTerm

logger = logging.getLogger("unifg")
FLOAT64 = np.dtype(np.float64)


def as_float64(name: str, result: Any) -> Array:
    """The result of a function as an array.

    Raises:
        GraphError: when it is not made of doubles; of coarser numbers differences are noise.
    """
    array = result if isinstance(result, np.ndarray) else np.asarray(result)
    if array.dtype != FLOAT64:
        raise GraphError(
            f"term '{name}': its function returned {array.dtype}, expected float64: differences of anything else are "
            "noise; convert its inputs, not its result",
            term=name,
        )
    return array


def as_jacobian(name: str, block: Any) -> Array:
    """A block of an attached Jacobian as an array; whole numbers are exact.

    Raises:
        GraphError: when it is made of coarser or complex numbers.
    """
    array = np.asarray(block)
    if array.dtype != FLOAT64 and array.dtype.kind not in "iub":
        raise GraphError(f"term '{name}': its attached Jacobian returned {array.dtype}, expected float64", term=name)
    return np.asarray(array, dtype=np.float64)


def notice_no_information(name: str, whitener: Array) -> None:
    """Say that a term counts for nothing: an infinite sigma may be meant, and a matrix that was never filled is not.

    Of constants only: data switch terms off and on, and the status of a solve says whether anything is missing then.
    """
    if whitener.size and not whitener.any():
        logger.warning("term '%s': its information is zero for every factor, so it counts for nothing", name)


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
