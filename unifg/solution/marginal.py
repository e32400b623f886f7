"""Marginalisation by a Schur complement: dense for a few variables, as of sliding windows, sparse for submaps.

Only the named terms are used, at the linearisation point of the solution: a window keeps what the past measured
and forgets what the future wished for. Hard equalities among them leave together with what they tie: along the
directions they forbid, the removed variables follow the kept ones (Ta et al. 2014, section IV-B, the constrained
elimination of one variable), along the others the costs decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from unifg.elimination.reduction import Reduction
from unifg.elimination.symmetric import Symmetric, distinct, scatter
from unifg.errors import GraphError
from unifg.modeling.variables import Selection, Variable, as_selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization, Rows
from unifg.problem.table import rows_in_stack
from unifg.typing import Array, BoolArray, IntArray

Variables: TypeAlias = Variable | Sequence[Variable]

ROUNDING = 1e-13  # of a sum of squares
RANK = 1e-10  # smaller pivots of scaled constraints are rounding
MANY = 300  # removed unknowns from which on they are eliminated by the tree
NOTHING_KNOWN = 1e-12  # smaller eigenvalues of a scaled information matrix are rounding


@dataclass
class Dense:
    """Positions of the entries of some rows in a dense matrix over some columns.

    Attributes:
        rows: (m,) which rows of the stacked Jacobian.
        entries: which of its entries.
        places: where they go in the flattened (m, width) matrix.
        width: number of columns.
        distinct: whether no two entries share a place.
    """

    rows: IntArray
    entries: IntArray
    places: IntArray
    width: int
    distinct: bool

    def gather(self, jacobian: Array) -> Array:
        """(m, width) matrix of the present entries."""
        dense = np.zeros(len(self.rows) * self.width)
        if self.distinct:
            dense[self.places] = jacobian[self.entries]
        else:
            np.add.at(dense, self.places, jacobian[self.entries])
        return dense.reshape(len(self.rows), self.width)


@dataclass
class Removal:
    """Structure of one marginalisation.

    Attributes:
        costs: rows of the costs that touch what is removed.
        constraints: rows of the equalities that do.
        gone: number of unknown columns that are removed; they come first.
        kept: full tangent columns of what stays.
        free: which of those are unknown; fixed ones take part as constants.
        tree: elimination of many, once there was one.
    """

    costs: Dense
    constraints: Dense
    gone: int
    kept: IntArray
    free: BoolArray
    tree: tuple[Symmetric, Reduction] | None = None


def information(
    program: CompiledProblem, lin: Linearization, terms: Sequence[str], columns: IntArray
) -> tuple[Array, Array]:
    """Information matrix and gradient of some costs over some columns.

    Args:
        program: the compiled graph.
        lin: where it was linearised.
        terms: names of the costs that count.
        columns: (k,) full tangent columns.

    Returns:
        (k, k) J'J and (k,) J'r.

    Raises:
        GraphError: for an unknown cost, or when a counted row reaches outside ``columns``.
    """
    rows = _dense(program, program.costs, cost_rows(program, terms), columns, terms)
    dense = rows.gather(lin.jacobian)
    return dense.T @ dense, dense.T @ lin.residual[rows.rows]


def marginal_prior(
    program: CompiledProblem,
    lin: Linearization,
    terms: Sequence[str],
    remove: Variables,
    keep: Variables,
    equality: BoolArray | None = None,
    offset: bool = False,
) -> tuple[Array, Array]:
    """Marginal prior on ``keep`` of the terms that touch ``remove``, which is eliminated.

    Exact where the terms are linear. Elsewhere it is their quadratic model at ``lin``: costs by Gauss-Newton,
    constraints to first order, without the curvature of constraints that multipliers would weigh.

    Args:
        program: the compiled graph.
        lin: linearisation at the point where the prior is frozen.
        terms: costs and equality constraints that count; those of them that do not touch ``remove`` stay in the graph
            and are left out.
        remove: variables that leave, one selection or several.
        keep: variables that stay, one selection or several: all those that the terms connect to ``remove``.
        equality: (M,) which constraint rows held as equalities; the present ones by default.
        offset: whether the reference is the point of ``lin``, followed by the step (D,) from there to the lowest point,
            for ``fg.joint_prior(..., offset=True)``: the model as it was made, however far that point is.

    Returns:
        Reference (1, S), the storage of the kept variables side by side in the order given, and information (D, D)
        over their tangents, for ``fg.prior`` on one variable or ``fg.joint_prior`` on several. What the terms say
        nothing about keeps its value and has no information; so do fixed variables.

    Raises:
        GraphError: when the terms reach other variables, one of them is an inequality, ``remove`` is not determined,
            or the constraints tie the kept variables to each other exactly; when nothing leaves or stays, or something
            leaves twice, or stays as well.
    """
    leaving, staying = _selections(remove), _selections(keep)
    if not (leaving and staying):
        raise GraphError("marginal_prior: name at least one variable that leaves, and one that stays")
    terms = [terms] if isinstance(terms, str) else terms  # a name is no list of letters
    removal = _removal(program, tuple(terms), leaving, staying)
    r = lin.residual[removal.costs.rows]
    A, c = _equalities(program, lin, removal.constraints, program.equality if equality is None else equality)
    k = removal.gone
    if k >= MANY and not len(c):
        found = _schur_of_tree(removal, lin.jacobian, r)
    else:
        J = removal.costs.gather(lin.jacobian)
        gone, rest = J[:, :k], J[:, k:]
        if len(c):
            particular, basis = _follow(A, c, k, leaving)
            rest, r = rest - gone @ particular[:, 1:], r - gone @ particular[:, 0]
            gone = gone @ basis
        rest[:, ~removal.free] = 0.0
        found = _schur(gone, rest, r)
    if found is None:
        first = leaving[0]
        raise GraphError(
            f"{first.family.name}[{first.indices[0]}] cannot be eliminated: the terms {', '.join(terms)} do not "
            "determine it",
            family=first.family.name,
            index=int(first.indices[0]),
        )
    matrix, gradient, squared = found
    matrix, shift = _lowest(matrix, gradient, ROUNDING * squared)
    if offset:
        points = [lin.values[s.family][s.indices][:, s.storage].ravel() for s in staying]
        return np.concatenate([*points, shift])[None], matrix
    reference, at = [], 0
    for selection in staying:
        here = lin.values[selection.family][selection.indices][:, selection.storage]
        dim = selection.manifold.dim
        step = shift[at : at + len(selection) * dim].reshape(len(selection), dim)
        reference.append(np.atleast_2d(selection.manifold.retract(here, step)).ravel())
        at += step.size
    return np.concatenate(reference)[None], matrix


def cost_rows(program: CompiledProblem, names: Sequence[str]) -> BoolArray:
    """(C,) whether each cost row belongs to one of the named terms.

    Raises:
        GraphError: when no least-squares cost has such a name.
    """
    chosen, known = np.zeros(program.costs.count, dtype=bool), {term.name: term for term in program.cost_terms}
    for name in [names] if isinstance(names, str) else names:
        if name not in known:
            raise GraphError(f"no cost is called '{name}' (there are: {', '.join(known) or 'none'})", term=name)
        chosen[rows_in_stack(known[name])] = True
    return chosen


def _selections(variables: Variables) -> list[Selection]:
    return [as_selection(v) for v in (variables if isinstance(variables, Sequence) else [variables])]


def _removal(
    program: CompiledProblem, terms: tuple[str, ...], leaving: Sequence[Selection], staying: Sequence[Selection]
) -> Removal:
    """The structure, from the cache or anew."""
    key = (terms, *[(s.family.name, s.component, s.indices.tobytes()) for s in (*leaving, *staying)], len(leaving))
    known = program.once(_known)
    if key not in known:
        known[key] = _analyse(program, terms, leaving, staying)
    return known[key]


def _known(_: CompiledProblem) -> dict[object, Removal]:
    """Nothing is known of a program to begin with."""
    return {}


def _analyse(
    program: CompiledProblem, terms: Sequence[str], leaving: Sequence[Selection], staying: Sequence[Selection]
) -> Removal:
    gone = np.concatenate([program.columns.of(selection).ravel() for selection in leaving])
    gone = gone[program.columns.unknown[gone] >= 0]
    kept = np.concatenate([program.columns.of(selection).ravel() for selection in staying])
    columns = np.concatenate([gone, kept])
    if (twice := np.bincount(columns, minlength=1)[gone] > 1).any():
        family, index = program.columns.name(int(gone[np.argmax(twice)]))
        raise GraphError(f"{family}[{index}] is named twice: it leaves, once, or it stays", family=family, index=index)
    slices = dict(zip([term.name for term in program.constraint_terms], program.slices, strict=True))
    constrained = np.zeros(program.constraints.count, dtype=bool)
    for name in terms:
        if name in slices:
            constrained[slices[name]] = True
    costs = cost_rows(program, [name for name in terms if name not in slices])
    return Removal(
        _dense(program, program.costs, costs, columns, terms, gone),
        _dense(program, program.constraints, constrained, columns, terms, gone),
        len(gone),
        kept,
        program.columns.unknown[kept] >= 0,
    )


def _dense(
    program: CompiledProblem,
    stacked: Rows,
    rows: BoolArray,
    columns: IntArray,
    terms: Sequence[str],
    touching: IntArray | None = None,
) -> Dense:
    """Place the entries of some rows, those that touch some columns, in a dense matrix.

    Raises:
        GraphError: when a row reaches an unknown outside ``columns``.
    """
    if touching is not None:
        touched = np.isin(stacked.columns, touching)
        rows = rows & np.isin(np.arange(stacked.count), stacked.rows[touched])
    entries = np.flatnonzero(rows[stacked.rows])
    place = np.full(program.columns.width, -1, dtype=np.intp)
    place[columns] = np.arange(len(columns))
    local = place[stacked.columns[entries]]
    outside = (local < 0) & (program.columns.unknown[stacked.columns[entries]] >= 0)
    if outside.any():
        family, index = program.columns.name(int(stacked.columns[entries[np.argmax(outside)]]))
        raise GraphError(
            f"the terms {', '.join(terms)} also depend on {family}[{index}]: include it, or name fewer terms",
            family=family,
            index=index,
        )
    entries, local = entries[local >= 0], local[local >= 0]
    number = np.cumsum(rows) - 1
    places = number[stacked.rows[entries]] * len(columns) + local
    alone = len(distinct(places)) == len(places)
    return Dense(np.flatnonzero(rows), entries, places, len(columns), alone)


def _equalities(program: CompiledProblem, lin: Linearization, dense: Dense, equality: BoolArray) -> tuple[Array, Array]:
    """Jacobian and value of the equality rows that are switched on.

    Raises:
        GraphError: when one of the rows is an inequality.
    """
    on = equality[dense.rows]
    if not on.all():
        limits = np.isfinite(program.lower[dense.rows]) | np.isfinite(program.upper[dense.rows])
        wrong = np.flatnonzero(limits & ~on)
        if len(wrong):
            name, index = program.row_name(int(dense.rows[wrong[0]]))
            raise GraphError(
                f"the constraint '{name}' (factor {index}) is an inequality: only costs and equalities are "
                "marginalised; leave it out",
                term=name,
                index=index,
            )
    rows = dense.rows[on]
    return dense.gather(lin.constraint_jacobian)[on], lin.constraints[rows] - program.lower[rows]


def _follow(A: Array, c: Array, k: int, leaving: Sequence[Selection]) -> tuple[Array, Array]:
    """Solve A_g d_g + A_k d_k + c = 0 for what leaves: d_g = -P (1, d_k) + Z z.

    Args:
        A: (e, k + n) Jacobian, removed columns first.
        c: (e,) values.
        k: removed columns.
        leaving: for the message.

    Returns:
        P (k, 1 + n) and an orthonormal basis Z (k, k - e) of the directions left free.
    """
    scale = 1.0 / np.maximum(np.abs(A[:, :k]).max(axis=1), 1e-300)
    A, c = A * scale[:, None], c * scale
    e = len(c)
    rotation, triangle = np.linalg.qr(A[:, :k].T, mode="complete")
    pivots = np.abs(np.diag(triangle))
    if e > k or pivots.min() < RANK:
        first = leaving[0]
        raise GraphError(
            f"{first.family.name}[{first.indices[0]}] cannot be eliminated: the constraints fix more than the removed "
            "variables, so what is left would be a constraint and not a prior; remove more variables with it",
            family=first.family.name,
            index=int(first.indices[0]),
        )
    given = np.linalg.solve(triangle[:e].T, np.column_stack([c, A[:, k:]]))
    return rotation[:, :e] @ given, rotation[:, e:]


def _schur(gone: Array, rest: Array, r: Array) -> tuple[Array, Array, Array] | None:
    """Eliminate the first unknowns of |gone d_g + rest d_k + r|^2 / 2; None where they are not determined.

    Returns:
        Information and gradient of the others, and the squared norms of the columns of ``rest``.
    """
    matrix, gradient = rest.T @ rest, rest.T @ r
    squared = matrix.diagonal().copy()
    if gone.shape[1]:
        try:
            factor = np.linalg.cholesky(gone.T @ gone)
        except np.linalg.LinAlgError:
            return None
        solved = np.linalg.solve(factor, gone.T @ np.column_stack([r, rest]))
        matrix -= solved[:, 1:].T @ solved[:, 1:]
        gradient -= solved[:, 1:].T @ solved[:, 0]
    return 0.5 * (matrix + matrix.T), gradient, squared


def _schur_of_tree(removal: Removal, jacobian: Array, r: Array) -> tuple[Array, Array, Array] | None:
    """Eliminate as :func:`_schur` does, by an elimination tree whose root is what is kept."""
    import scipy.sparse as sp

    costs, k = removal.costs, removal.gone
    places, free = np.divmod(costs.places, costs.width), np.append(np.ones(k, bool), removal.free)
    J = sp.csc_array((jacobian[costs.entries], places), shape=(len(costs.rows), costs.width)) * free
    upper = sp.triu(J.T @ J, format="coo")
    if removal.tree is None:
        pattern = Symmetric(costs.width, [(upper.row, upper.col)])
        removal.tree = pattern, Reduction(pattern, costs.width - k)
    pattern, tree = removal.tree
    data = scatter(pattern.positions(upper.row, upper.col), upper.data, pattern.nnz)
    return (tree.matrix, tree.reduce(J.T @ r)[0], data[pattern.diagonal[k:]]) if tree.factor(data) else None


def _lowest(matrix: Array, gradient: Array, rounding: Array) -> tuple[Array, Array]:
    """Information without what rounding left of unknown directions, and the step to the lowest point."""
    shift = np.zeros(len(gradient))
    diagonal = np.diag(matrix)
    alive = np.flatnonzero(diagonal > rounding)
    clean = np.zeros_like(matrix)
    if not len(alive):
        return clean, shift
    scale = 1.0 / np.sqrt(diagonal[alive])
    block = matrix[np.ix_(alive, alive)] * np.outer(scale, scale)
    try:
        factor = np.linalg.cholesky(block)
    except np.linalg.LinAlgError:
        factor = np.zeros((1, 1))
    if np.square(np.diag(factor)).min() > NOTHING_KNOWN:
        pull = np.linalg.solve(factor, scale * gradient[alive])
        shift[alive] = -scale * np.linalg.solve(factor.T, pull)
    else:  # some direction is unknown
        eigenvalues, vectors = np.linalg.eigh(block)
        known = eigenvalues > NOTHING_KNOWN
        vectors, eigenvalues = vectors[:, known], eigenvalues[known]
        shift[alive] = -scale * (vectors @ ((vectors.T @ (scale * gradient[alive])) / eigenvalues))
        block = (vectors * eigenvalues) @ vectors.T
        block = 0.5 * (block + block.T)
    clean[np.ix_(alive, alive)] = block / np.outer(scale, scale)
    return clean, shift
