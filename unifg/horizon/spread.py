"""Covariances of the present from the past's terms alone, whatever else a graph wishes for."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.modeling.variables import Family, Variable, as_selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.systems import fill
from unifg.typing import Array

SHIFT = 1e-10  # constraints are softened by a standard deviation of 1e-5, in their own units


class JointCovariance:
    """A block of the inverse KKT matrix of a graph whose constraints are equalities: structure once."""

    def __init__(self, program: CompiledProblem, *variables: Variable) -> None:
        """Choose the variables, in the order of the rows and columns; fixed ones have no variance."""
        columns = np.concatenate([program.columns.of(as_selection(variable)).ravel() for variable in variables])
        unknown = program.columns.unknown[columns]
        self._program = program
        self._free = np.flatnonzero(unknown >= 0)
        self._chosen = unknown[self._free].astype(np.int64)
        self._size = len(columns)
        self._held = program.equality.copy()
        self._arrange()

    def _arrange(self) -> None:
        """Lay the matrix out for the equalities that are held now."""
        self._system = self._program.systems.kkt(self._held)
        self._data = np.zeros(self._system.pattern.nnz)
        n, m = int(self._system.arrays.size[0]), int(self._system.arrays.size[1])
        self._shift = np.repeat([SHIFT, -SHIFT], [n, m])

    def __call__(self, values: Mapping[Family, Array]) -> Array | None:
        """(D, D) covariance at ``values``, with the data of the last solve; None when it does not exist."""
        with self._program.lock:
            return self._found(values)

    def _found(self, values: Mapping[Family, Array]) -> Array | None:
        if not np.array_equal(self._held, self._program.equality):  # some were switched on or off
            self._held = self._program.equality.copy()
            self._arrange()
        lin = self._program.linearize(values)
        fill(self._system.arrays, lin.hessian, lin.constraint_jacobian, self._data)
        if not self._system.factorization.factor(self._data, self._shift):
            return None
        covariance = np.zeros((self._size, self._size))
        covariance[np.ix_(self._free, self._free)] = self._system.factorization.inverse_block(self._chosen)
        return covariance
