"""From a graph and a point on it to Ta's primal and dual linear graphs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from unifg.answers.graph import Graph
from unifg.answers.requirements import require
from unifg.answers.solution import Guess, Solution
from unifg.errors import BackendError, GraphError
from unifg.kernels.differentiation import convexified
from unifg.language.terms import Cost
from unifg.language.variables import Data, Family
from unifg.program.program import Program
from unifg.program.rows import Rows
from unifg.program.term import CompiledTerm
from unifg.program.touched import term_columns
from unifg.solvers.linear_factors import Factor, LinearFactor, QuadraticFactor
from unifg.solvers.linear_graphs import LinearGraph, dual_graph
from unifg.solvers.qp import QP, subproblem
from unifg.typing import Array, ArrayLike, BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class LinearGraphs:
    """Both linear graphs at one point, and what they say.

    Attributes:
        primal: over the tangent steps; a variable is called family[member], a factor term[factor].
        step: (d_v,) tangent step of each variable that is not fixed.
        dual: over the multipliers of the equality factors.
        multipliers: (m,) next multipliers of each equality factor.
    """

    primal: LinearGraph
    step: Mapping[str, Array]
    dual: LinearGraph
    multipliers: Mapping[str, Array]

    @classmethod
    def at(
        cls,
        graph: Graph,
        start: Mapping[Family, ArrayLike] | Guess | Solution,
        *,
        data: Mapping[Data, ArrayLike] | None = None,
        hessian: Literal["gauss-newton", "exact"] = "gauss-newton",
    ) -> LinearGraphs:
        """Linearise a graph, and solve both linear graphs in the engine's order.

        Args:
            graph: with equalities only.
            start: where; a guess or solution brings the multipliers that the exact Hessian weighs curvature with.
            data: for this linearisation.
            hessian: of eq. 18, "exact" as printed or "gauss-newton".

        Raises:
            BackendError: naming the first inequality.
            GraphError: when the graph, the start or its multipliers are malformed.
            Contradiction: when the linearised constraints cannot all hold.
            Undetermined: when the primal graph has no unique minimum.
        """
        if hessian not in ("exact", "gauss-newton"):
            raise BackendError(f"LinearGraphs: hessian must be 'exact' or 'gauss-newton', found '{hessian}'")
        program = graph.compile()
        program.bind(data or {})
        require(program, "LinearGraphs", "equalities")
        known = {} if isinstance(start, Mapping) else start.multipliers
        lin = program.linearize(program.values_from(start if isinstance(start, Mapping) else start.values))
        qp = subproblem(program, lin, 0.0)
        if hessian == "exact":
            qp = qp.with_curvature(_stacked(program, known))
        primal = primal_graph(qp)
        step = primal.eliminate().solve()
        dual = dual_graph(primal, step)
        return cls(primal, step, dual, dual.eliminate(undetermined="zero").solve())


def primal_graph(qp: QP) -> LinearGraph:
    """The equality-constrained subproblem as factors (Ta eq. 18), one for each factor of the graph.

    Factors of fixed variables alone, and factors that are switched off, have no part in it.
    """
    program, lin = qp.program, qp.lin
    names, first = variable_names(program), _first(program)
    sizes = dict(zip(names, np.diff([*first.tolist(), program.size]).tolist(), strict=True))
    factors: list[Factor] = []
    everything = np.ones(program.costs.count, dtype=bool)
    for term, name, rows, blocks in _blocks(program, program.costs, program.cost_terms, lin.jacobian, everything):
        if blocks and (term.active is None or term.active[_index(name)]):
            factors.append(LinearFactor(name, "cost", blocks, -lin.residual[rows], _largest(blocks)))
    factors += _scalar_costs(qp, names, first)
    roots = np.sqrt(np.broadcast_to(qp.damping, program.size))
    if roots.any():
        for (name, size), start in zip(sizes.items(), first.tolist(), strict=True):
            own = roots[start : start + size]
            factors.append(
                LinearFactor(f"damping of {name}", "damping", {name: np.diag(own)}, np.zeros(size), float(own.max()))
            )
    for _, name, rows, blocks in _blocks(
        program, program.constraints, program.constraint_terms, qp.jacobian, qp.lower == qp.upper
    ):
        factors.append(LinearFactor(name, "constraint", blocks, qp.lower[rows], _largest(blocks)))
    if qp.curved_by is not None:
        factors += _curvature(qp, names, first)
    return LinearGraph("primal linear graph", sizes, tuple(factors))


def variable_names(program: Program) -> tuple[str, ...]:
    """family[member] for each variable with an unknown, in the order of the unknowns."""
    columns = program.columns
    return tuple("{}[{}]".format(*columns.name(int(columns.free[k]))) for k in _first(program))


def stacked_step(program: Program, step: Mapping[str, Array]) -> Array:
    """(n,) tangent step of the program from the values of a primal graph."""
    return np.concatenate([np.zeros(0), *(step[name] for name in variable_names(program))])


def equality_rows(qp: QP) -> dict[str, IntArray]:
    """Rows of each equality factor, by name."""
    found = _blocks(qp.program, qp.program.constraints, qp.program.constraint_terms, qp.jacobian, qp.lower == qp.upper)
    return {name: rows for _, name, rows, _ in found}


def _blocks(
    program: Program, pattern: Rows, terms: list[CompiledTerm], entries: Array, chosen: BoolArray
) -> Iterator[tuple[CompiledTerm, str, IntArray, dict[str, Array]]]:
    """Term, name, chosen rows and blocks per variable of each factor that has chosen rows."""
    names, first = variable_names(program), _first(program)
    order = np.argsort(pattern.free_rows, kind="stable")
    rows, columns, numbers = (a[order] for a in (pattern.free_rows, pattern.free_columns, entries[pattern.free]))
    owner = np.searchsorted(first, columns, side="right") - 1
    sizes = np.diff([*first.tolist(), program.size])
    at = 0
    for term in terms:
        for i in range(term.count):
            own = np.flatnonzero(chosen[at : at + term.size])
            begin, end = np.searchsorted(rows, [at, at + term.size])
            blocks: dict[str, Array] = {}
            for variable in dict.fromkeys(owner[begin:end].tolist()):
                block = np.zeros((term.size, sizes[variable]))
                mine = begin + np.flatnonzero(owner[begin:end] == variable)
                np.add.at(block, (rows[mine] - at, columns[mine] - first[variable]), numbers[mine])
                blocks[names[variable]] = block[own]
            if len(own):
                yield term, f"{term.name}[{i}]", at + own, blocks
            at += term.size


def _scalar_costs(qp: QP, names: tuple[str, ...], first: IntArray) -> list[Factor]:
    """Costs that are no squares, as quadratic factors."""
    factors: list[Factor] = []
    for term in qp.program.scalar_terms:
        gradient, hessian, _ = term.scalar_derivatives(qp.lin.values)
        if qp.curved_by is None:
            hessian = convexified(hessian)
        factors += _quadratic(qp.program, term, "cost", hessian, gradient, names, first)
    return factors


def _curvature(qp: QP, names: tuple[str, ...], first: IntArray) -> list[Factor]:
    """Second derivatives of residuals and, with the multipliers, of constraints: Ta's "new unconstrained factors"."""
    program, lin = qp.program, qp.lin
    factors: list[Factor] = []
    for term in (*program.cost_terms, *program.constraint_terms):
        if isinstance(term.term, Cost):
            if term.term.robust is not None:
                continue
            weights = term.carry_back(program.rows_of(term, lin.residual, lin.constraints))
        else:
            assert qp.curved_by is not None
            weights = program.rows_of(term, lin.residual, qp.curved_by)
        if term.is_bound or not weights.any():
            continue
        hessian = term.second_derivatives(lin.values, weights)
        factors += _quadratic(program, term, "curvature", hessian, np.zeros(hessian.shape[:2]), names, first)
    return factors


def _quadratic(
    program: Program,
    term: CompiledTerm,
    kind: Literal["cost", "curvature"],
    hessian: Array,
    gradient: Array,
    names: tuple[str, ...],
    first: IntArray,
) -> list[Factor]:
    """Factors of (n, D, D) Hessians and (n, D) gradients over the full columns of a term; those of zeros left out."""
    full = np.concatenate(
        [np.broadcast_to(c, (term.count, c.shape[1])) for c in term_columns(program.columns, term)], 1
    )
    unknown = program.columns.unknown[full]
    sizes = np.diff([*first.tolist(), program.size])
    factors: list[Factor] = []
    for i in range(term.count):
        keep = np.flatnonzero(unknown[i] >= 0)
        mine = unknown[i, keep]
        owner = np.searchsorted(first, mine, side="right") - 1
        own = {names[v]: int(sizes[v]) for v in dict.fromkeys(owner.tolist())}
        start = dict(zip(own, np.cumsum([0, *own.values()]).tolist(), strict=False))
        where = np.array([start[names[v]] + k - first[v] for v, k in zip(owner, mine, strict=True)], dtype=np.intp)
        width = sum(own.values())
        G, g = np.zeros((width, width)), np.zeros(width)
        np.add.at(G, np.ix_(where, where), hessian[i][np.ix_(keep, keep)])
        np.add.at(g, where, gradient[i, keep])
        if G.any() or g.any():
            factors.append(QuadraticFactor(f"{term.name}[{i}]", kind, own, G, g))
    return factors


def _first(program: Program) -> IntArray:
    """First unknown of each variable that has unknowns."""
    return np.unique(program.blocks, return_index=True)[1]


def _largest(blocks: Mapping[str, Array]) -> float:
    return max((float(np.abs(block).max(initial=0.0)) for block in blocks.values()), default=0.0)


def _index(name: str) -> int:
    """The factor's number in its name."""
    return int(name[name.rindex("[") + 1 : -1])


def _stacked(program: Program, known: Mapping[str, Array]) -> Array:
    """(M,) multipliers by term name, zero where not given."""
    multipliers = np.zeros(program.constraints.count)
    for term, rows in zip(program.constraint_terms, program.slices, strict=True):
        if term.name in known:
            given = np.asarray(known[term.name], dtype=np.float64)
            if given.size != rows.stop - rows.start:
                raise GraphError(
                    f"multipliers of '{term.name}' have shape {given.shape}, expected {(term.count, term.size)}",
                    term=term.name,
                )
            multipliers[rows] = given.ravel()
    return multipliers
