"""The values a solve starts from: a guess, checked, with fixed variables where they are fixed.

A user's functions are tried there too: whether they change no arguments and write every row.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.errors import GraphError
from unifg.kernels.kernel import Kernel, evaluate_rows, side_by_side
from unifg.language.statement import Statement
from unifg.language.terms import ScalarCost
from unifg.language.variables import Family
from unifg.lie import LieGroup, Manifold
from unifg.lie.product import leaves
from unifg.machine.jit import is_compiled
from unifg.program.columns import Columns, Values
from unifg.program.linearization import all_finite
from unifg.program.retraction import Retraction
from unifg.program.term import CompiledTerm
from unifg.typing import Array, ArrayLike


class GuessReader:
    """Reads guesses for the families of a graph."""

    def __init__(self, graph: Statement, columns: Columns, retraction: Retraction) -> None:
        """Find the parts of the families that need more of a look than whether they are finite."""
        self._graph = graph
        self._columns = columns
        self._retraction = retraction
        self._particular: list[tuple[Family, slice, Manifold]] = []
        for family in columns.families:
            for leaf, storage, _ in leaves(family.manifold):
                if getattr(type(leaf), "is_valid", None) is not LieGroup.is_valid:
                    self._particular.append((family, slice(storage, storage + leaf.storage), leaf))

    def __call__(self, guess: Mapping[Family, ArrayLike]) -> Values:
        """Copy and check a guess, and give fixed variables their values.

        Raises:
            GraphError: naming the family and index of what is missing, misshapen, NaN or off its manifold.
        """
        for family in guess:
            if not isinstance(family, Family) or self._graph.families.get(family.name) is not family:
                raise GraphError(f"the guess contains {family!r}, which is no family of this graph")
        values = Values(self._columns, np.empty(self._columns.stored))
        for family, own in values.items():
            given = guess.get(family)
            if given is None:
                if not self._columns.all_fixed(family):
                    raise GraphError(
                        f"the guess has no values for family '{family.name}': give an array of shape {own.shape}",
                        family=family.name,
                    )
                own[:] = family.manifold.identity()
                continue
            array = np.asarray(given, dtype=np.float64)
            if array.shape != own.shape:
                raise GraphError(
                    f"the guess for family '{family.name}' has shape {array.shape}, expected {own.shape}",
                    family=family.name,
                )
            own[:] = array
        self._retraction.fix(values)
        fine = all_finite(values.flat)
        if not (fine and all(leaf.is_valid(values[f][:, part]).all() for f, part, leaf in self._particular)):
            self._name_invalid(values)
        return values

    def _name_invalid(self, values: Values) -> None:
        for family, array in values.items():
            valid = family.manifold.is_valid(array)
            if not valid.all():
                index = int(np.flatnonzero(~valid)[0])
                raise GraphError(
                    f"the guess for {family.name}[{index}] is not on {family.manifold.name}: {array[index]}",
                    family=family.name,
                    index=index,
                )


def require_clean(term: CompiledTerm, values: Values) -> None:
    """Call a user's function once at the guess, and refuse one that changes its arguments or leaves rows out.

    Raises:
        GraphError: naming the term and the argument or row.
    """
    if term.is_bound:
        return
    points = [np.array(point) for point in term.points(values)]
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
