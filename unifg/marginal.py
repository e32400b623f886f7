"""Marginalisation of a few variables by a dense Schur complement, for sliding windows.

Only the named costs are used, at the linearisation point of the solution: a window keeps what the past measured
and forgets what the future wished for.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unifg.errors import GraphError
from unifg.lie import Manifold
from unifg.linearization import Linearization
from unifg.program import Program
from unifg.typing import Array, IntArray
from unifg.variables import Variable, as_selection


def information(
    program: Program, lin: Linearization, terms: Sequence[str], columns: IntArray, touching: IntArray | None = None
) -> tuple[Array, Array]:
    """Information matrix and gradient of some costs over some columns.

    Args:
        program: the compiled graph.
        lin: where it was linearised.
        terms: names of the costs that count.
        columns: (k,) full tangent columns.
        touching: count only rows with an entry in these columns; None for all rows.

    Returns:
        (k, k) J'J and (k,) J'r.

    Raises:
        GraphError: for an unknown cost, or when a counted row reaches outside ``columns``.
    """
    rows = program.cost_rows(terms)
    entries = np.flatnonzero(rows[program.costs.rows])
    if touching is not None:
        wanted = np.isin(program.costs.columns[entries], touching)
        rows = np.isin(np.arange(program.costs.count), program.costs.rows[entries[wanted]])
        entries = np.flatnonzero(rows[program.costs.rows])
    place = np.full(program.columns.width, -1, dtype=np.intp)
    place[columns] = np.arange(len(columns))
    local = place[program.costs.columns[entries]]
    outside = (local < 0) & (program.columns.unknown[program.costs.columns[entries]] >= 0)
    if outside.any():
        family, index = program.columns.name(int(program.costs.columns[entries[np.argmax(outside)]]))
        raise GraphError(
            f"the costs {', '.join(terms)} also depend on {family}[{index}]: include it, or name fewer costs",
            family=family,
            index=index,
        )
    kept = local >= 0
    number = np.cumsum(rows) - 1
    dense = np.zeros((int(rows.sum()), len(columns)))
    np.add.at(dense, (number[program.costs.rows[entries[kept]]], local[kept]), lin.jacobian[entries[kept]])
    return dense.T @ dense, dense.T @ lin.residual[rows]


def marginal_prior(
    program: Program, lin: Linearization, terms: Sequence[str], remove: Variable, keep: Variable
) -> tuple[Array, Array]:
    """What costs that touch ``remove`` say about ``keep`` once ``remove`` is eliminated.

    Args:
        program: the compiled graph.
        lin: linearisation at the point where the prior is frozen.
        terms: costs that count; those of them that do not touch ``remove`` stay in the graph and are left out.
        remove: variables that leave.
        keep: one variable that stays, connected to them.

    Returns:
        Reference (1, storage) and information (d, d) of a ``fg.prior`` on ``keep``.

    Raises:
        GraphError: when the costs reach other variables, or ``remove`` is not determined.
    """
    leaving, staying = as_selection(remove), as_selection(keep)
    gone = program.columns.of(leaving).ravel()
    kept = program.columns.of(staying).ravel()
    matrix, gradient = information(program, lin, terms, np.concatenate([gone, kept]), touching=gone)
    k = len(gone)
    try:
        factor = np.linalg.cholesky(matrix[:k, :k])
    except np.linalg.LinAlgError as error:
        raise GraphError(
            f"{leaving.family.name}[{leaving.indices[0]}] cannot be eliminated: the costs {', '.join(terms)} do not "
            "determine it",
            family=leaving.family.name,
            index=int(leaving.indices[0]),
        ) from error
    cross = np.linalg.solve(factor, matrix[:k, k:])
    schur = matrix[k:, k:] - cross.T @ cross
    pull = gradient[k:] - cross.T @ np.linalg.solve(factor, gradient[:k])
    schur = 0.5 * (schur + schur.T)
    shift = -np.linalg.pinv(schur, hermitian=True) @ pull
    here = lin.values[staying.family][staying.indices][:, staying.storage]
    manifold: Manifold = staying.manifold
    return manifold.retract(here, shift[None, :]), schur
