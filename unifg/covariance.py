"""Covariance of selected unknowns: a block of the inverse Hessian, or of the inverse KKT matrix.

With constraints the (1, 1) block of [[H, A'], [A, 0]]^-1 is taken, A being the active rows: a direction that an
active constraint forbids has no variance.
"""

from __future__ import annotations

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.errors import GraphError
from unifg.linearization import Linearization
from unifg.program import Program
from unifg.sparse import Symmetric
from unifg.typing import Array, BoolArray, IntArray

REGULARISATION = 1e-9


def covariance(program: Program, lin: Linearization, columns: IntArray, active: BoolArray) -> Array:
    """Covariance over full tangent ``columns``.

    Args:
        program: the compiled graph.
        lin: linearisation at the solution.
        columns: (k,) full tangent columns, all of them unknowns.
        active: (M,) rows held as equalities.

    Returns:
        (k, k) covariance.

    Raises:
        GraphError: when a column is fixed or the information is singular.
    """
    chosen = program.columns.unknown[columns]
    if (chosen < 0).any():
        family, index = program.columns.name(int(columns[np.argmax(chosen < 0)]))
        raise GraphError(f"{family}[{index}] is fixed: it has no covariance", family=family, index=index)
    n = program.size
    hessian = program.hessian.matrix(program.hessian_entries(lin)).tocoo()
    jacobian = program.constraints.matrix(lin.constraint_jacobian)[active].tocoo()
    total = n + jacobian.shape[0]
    pattern = Symmetric(total, [(hessian.row, hessian.col), (jacobian.col, n + jacobian.row)])
    data = np.zeros(pattern.nnz)
    np.add.at(data, pattern.positions(hessian.row, hessian.col), hessian.data)
    np.add.at(data, pattern.positions(jacobian.col, n + jacobian.row), jacobian.data)
    exact = pattern.matrix(data.copy())
    scale = max(float(np.abs(hessian.data).max(initial=0.0)), 1e-300)
    signs = np.where(np.arange(total) < n, 1.0, -1.0)
    factorization = Factorization(pattern)
    if not factorization.factor(exact.data, REGULARISATION * scale * signs):
        raise GraphError("the covariance does not exist: the Hessian is not finite")
    symmetric = exact + exact.T
    symmetric.setdiag(exact.diagonal())
    result = np.empty((len(chosen), len(chosen)))
    for k, column in enumerate(chosen):
        right = np.zeros(total)
        right[column] = 1.0
        solution = factorization.refine(exact.data, right, steps=20)
        if np.abs(right - symmetric @ solution).max() > 1e-6:
            raise GraphError(
                "the covariance does not exist: some direction is not determined by the costs; run graph.check(guess)"
            )
        result[:, k] = solution[chosen]
    return 0.5 * (result + result.T)
