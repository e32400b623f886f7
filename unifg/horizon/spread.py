"""Covariances of the present from the past's terms alone, whatever else a graph wishes for."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from unifg.errors import GraphError
from unifg.modeling.variables import Family, Variable, as_selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.systems import KktSystem, fill
from unifg.solution.covariance import Covariances
from unifg.typing import Array, IntArray

SHIFT = 1e-10  # constraints are softened by a standard deviation of 1e-5, in their own units
VAGUE, SMALL = 3e4, 1e-3  # standard deviation of what only the shift holds; share of one that may be wrong
ENOUGH = 1e-8  # residual of the test of it


class JointCovariance:
    """A block of the inverse KKT matrix of a graph whose constraints are equalities."""

    def __init__(self, program: CompiledProblem, *variables: Variable) -> None:
        """Choose the variables, in the order of the rows and columns; fixed ones have no variance."""
        self._columns = np.concatenate([program.columns.of(as_selection(variable)).ravel() for variable in variables])
        self._program = program

    def __call__(self, values: Mapping[Family, Array]) -> Array | None:
        """(D, D) covariance at ``values``, with the data of the last solve; None when it does not exist."""
        program = self._program
        unknown = program.columns.unknown[self._columns]
        free, covariance = np.flatnonzero(unknown >= 0), np.zeros((len(unknown), len(unknown)))
        with program.lock, program.systems.structure(program.equality).borrowed() as system:
            lin, (n, m), system.loaded = program.linearize(values), system.arrays.size, None
            data, chosen = np.zeros(system.pattern.nnz), unknown[free].astype(np.int64)
            fill(system.arrays, lin.hessian, lin.constraint_jacobian, data)
            if not system.factorization.factor(data, np.repeat([SHIFT, -SHIFT], [n, m])):
                return None
            block = system.factorization.inverse_block(chosen)
            if m and _softened(system, data, chosen, block):
                with suppress(GraphError):  # some of it has not been measured
                    return Covariances(program, lin, program.equality).joint(self._columns)
        covariance[np.ix_(free, free)] = block
        return covariance


def _softened(system: KktSystem, data: Array, chosen: IntArray, block: Array) -> bool:
    """Test by one random combination, in standard deviations, whether the shift and rounding show in a block."""
    root, right = np.sqrt(np.abs(block.diagonal())), np.zeros(system.pattern.size)
    known = root < VAGUE
    right[chosen] = mixed = np.random.default_rng(0).choice([-1.0, 1.0], len(root)) / root
    if not system.saddle.factor(data):
        return False
    change = (system.saddle.solve(right, ENOUGH)[0][chosen] - block @ mixed) / root
    return not (known.any() and np.abs(change[known]).max() < SMALL)
