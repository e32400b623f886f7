"""Measurements that a robust loss left out, compared with what the others say about them.

Far from the answer a right measurement may have a large residual only because nothing else holds the variables it
connects. Its innovation tells: with r the whitened residual, J its Jacobian and S the covariance of the unknowns from
all measurements that count, r' (I + J S J')^-1 r follows the chi-squared distribution of a right measurement, whatever
the odometry drifted in between. This is the individual gate of data association (Bar-Shalom and Fortmann, "Tracking
and data association", 1988), with the marginals of the whole graph.
"""

from __future__ import annotations

import numpy as np

from unifg.compiled import CompiledTerm
from unifg.elimination.factorization import Factorization
from unifg.linearization import Linearization
from unifg.program import Program
from unifg.table import ENTRY, ROW, WIDTH
from unifg.touched import term_columns
from unifg.typing import Array, BoolArray, IntArray

TOGETHER = 256  # right-hand sides solved at once


class Innovations:
    """What the measurements that count say about others.

    Attributes:
        determined: whether they determine every unknown.
    """

    def __init__(self, program: Program, solver: Factorization, information: Array) -> None:
        """Factorise.

        Args:
            program: the compiled graph.
            solver: for matrices in the pattern ``program.normal``.
            information: entries of the Hessian of the measurements that count.
        """
        self._program, self._solver = program, solver
        self.determined = solver.factor(information) and solver.definite

    def squared(self, term: CompiledTerm, lin: Linearization, chosen: BoolArray) -> Array:
        """(k,) normalised squared innovations r' (I + J S J')^-1 r.

        Args:
            term: a cost of the graph.
            lin: linearisation without losses, where S was taken.
            chosen: (n,) factors that do not count.
        """
        program, size, width = self._program, term.size, int(term.place[WIDTH])
        row, entry, count = int(term.place[ROW]), int(term.place[ENTRY]), term.count
        residual = lin.residual[row : row + count * size].reshape(count, size)[chosen]
        jacobian = lin.jacobian[entry : entry + count * size * width].reshape(count, size, width)[chosen]
        columns = program.columns.unknown[np.concatenate(term_columns(program.columns, term), axis=1)[chosen]]
        result = np.empty(len(residual))
        step = max(1, TOGETHER // size)
        for at in range(0, len(residual), step):
            part = slice(at, at + step)
            result[part] = self._some(residual[part], jacobian[part], columns[part])
        return result

    def _some(self, residual: Array, jacobian: Array, columns: IntArray) -> Array:
        count, size, _ = jacobian.shape
        free = columns >= 0
        rows = np.zeros((self._program.size, count * size))
        places = np.broadcast_to(columns[:, None, :], jacobian.shape)
        across = np.broadcast_to(np.arange(count * size).reshape(count, size, 1), jacobian.shape)
        held = np.broadcast_to(free[:, None, :], jacobian.shape)
        np.add.at(rows, (places[held], across[held]), jacobian[held])
        solved = self._solver.solve(rows).T.reshape(count, size, -1)
        seen = np.take_along_axis(solved, np.broadcast_to(np.where(free, columns, 0)[:, None, :], jacobian.shape), 2)
        spread = np.einsum("nia,nja->nij", jacobian * free[:, None, :], seen)
        innovation = np.eye(size) + 0.5 * (spread + spread.transpose(0, 2, 1))
        squared: Array = np.einsum("ni,ni->n", residual, np.linalg.solve(innovation, residual[:, :, None])[:, :, 0])
        return squared
