"""Covariances of the present from the past's terms alone, whatever else a graph wishes for."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from unifg.errors import GraphError
from unifg.modeling.variables import Family, Variable, as_selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.systems import fill
from unifg.solution.covariance import Covariances
from unifg.typing import Array

SHIFT = 1e-10  # constraints are softened by a standard deviation of 1e-5, in their own units
VAGUE, SMALL = 3e4, 1e-3  # standard deviation of what only the shift holds; share of one that may be wrong
ENOUGH = 1e-8  # residual of the test of it


class JointCovariance:
    """A block of the inverse KKT matrix of a graph whose constraints are equalities: structure once."""

    def __init__(self, program: CompiledProblem, *variables: Variable) -> None:
        """Choose the variables, in the order of the rows and columns; fixed ones have no variance."""
        columns = np.concatenate([program.columns.of(as_selection(variable)).ravel() for variable in variables])
        unknown = program.columns.unknown[columns]
        self._program = program
        self._free = np.flatnonzero(unknown >= 0)
        self._chosen = unknown[self._free].astype(np.int64)
        self._columns, self._size = columns, len(columns)
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
        block, covariance = self._system.factorization.inverse_block(self._chosen), np.zeros((self._size, self._size))
        if self._held.any() and self._softened(block):
            with suppress(GraphError):  # some of it has not been measured
                return Covariances(self._program, lin, self._held).joint(self._columns)
        covariance[np.ix_(self._free, self._free)] = block
        return covariance

    def _softened(self, block: Array) -> bool:
        """Test by one random combination, in standard deviations, whether the shift and rounding show in a block."""
        root, right = np.sqrt(np.abs(block.diagonal())), np.zeros(self._system.pattern.size)
        known = root < VAGUE
        right[self._chosen] = mixed = np.random.default_rng(0).choice([-1.0, 1.0], len(root)) / root
        if not self._system.saddle.factor(self._data):
            return False
        change = (self._system.saddle.solve(right, ENOUGH)[0][self._chosen] - block @ mixed) / root
        return not (known.any() and np.abs(change[known]).max() < SMALL)
