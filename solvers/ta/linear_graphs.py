"""Ta's primal and dual linear graphs (Ta et al. 2014, section IV and Fig. 2), to look at and to solve.

The primal linear graph is eq. 18 written as factors over tangent steps: every cost as linear rows, every equality as
linear rows that must hold, and with the exact Hessian one more factor for each constraint with a multiplier, its
curvature. The dual linear graph is eq. 19: one variable for the multipliers of each constraint, and for each primal
variable that a constraint touches one factor, which says that the gradients there add up to nothing:

    sum_j A_j' lambda_j = - gradient of the unconstrained factors at the step

Eq. 19 as printed lacks the minus, which the Lagrangian and eq. 18 require. Both are solved by variable elimination
(:mod:`unifg.solvers.ta.elimination`). For equalities only. Plain NumPy, one factor at a time: a reference for
the engine, not a replacement.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Literal

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.elimination.symmetric import Symmetric
from unifg.errors import BackendError, GraphError
from unifg.factors.differences import convexified
from unifg.modeling.terms import Cost
from unifg.modeling.variables import Data, Family
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import loss_curvature, row_weights
from unifg.problem.linearization import Rows
from unifg.problem.term import CompiledTerm
from unifg.solution.capabilities import require
from unifg.solution.graph import Graph
from unifg.solution.guess import Guess
from unifg.solution.solution import Solution
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer, qp_error, subproblem
from unifg.solvers.ta.elimination import (
    Contradiction,
    Elimination,
    Factor,
    Kind,
    LinearFactor,
    QuadraticFactor,
    Undetermined,
    eliminate,
)
from unifg.typing import Array, Axes, BoolArray, IntArray, Numbers


@dataclass(frozen=True, eq=False)
class LinearGraph:
    """Linear and quadratic factors over named vectors.

    Attributes:
        title: what it is.
        sizes: dimension of each variable, by name.
        factors: in the order they were made.
    """

    title: str
    sizes: Mapping[str, int]
    factors: Sequence[Factor] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            GraphError: when a factor names a variable that does not exist.
        """
        for factor in self.factors:
            unknown = [name for name in factor.variables if name not in self.sizes]
            if unknown:
                raise GraphError(f"{self.title}: factor '{factor.name}' has no variable '{unknown[0]}' to stand on")

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the variables."""
        return tuple(self.sizes)

    @property
    def constraints(self) -> tuple[LinearFactor, ...]:
        """Factors whose rows must hold."""
        return tuple(f for f in self.factors if isinstance(f, LinearFactor) and f.kind == "constraint")

    @property
    def unconstrained(self) -> tuple[Factor, ...]:
        """All others."""
        return tuple(f for f in self.factors if f.kind != "constraint")

    def factor(self, name: str, kind: Kind | None = None) -> Factor:
        """The first factor of that name (and kind).

        Raises:
            GraphError: when there is none.
        """
        for factor in self.factors:
            if factor.name == name and kind in (None, factor.kind):
                return factor
        raise GraphError(f"{self.title}: no factor is called '{name}'" + ("" if kind is None else f" ({kind})"))

    def factors_of(self, variable: str) -> tuple[Factor, ...]:
        """Factors that stand on a variable."""
        return tuple(factor for factor in self.factors if variable in factor.variables)

    def engine_order(self) -> tuple[str, ...]:
        """The order in which the engine would eliminate the variables."""
        number = {name: k for k, name in enumerate(self.sizes)}
        if not number:
            return ()
        pairs = [
            sorted((number[a], number[b])) for factor in self.factors for a, b in combinations(factor.variables, 2)
        ]
        first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
        sizes = np.array(list(self.sizes.values()))
        starts = np.concatenate([[0], np.cumsum(sizes)])
        factorization = Factorization(
            Symmetric.of_blocks(starts, first, second), np.repeat(np.arange(len(sizes)), sizes)
        )
        names = self.variables
        return tuple(names[int(node)] for node in factorization.tree.order)

    def eliminate(
        self, order: Iterable[str] | None = None, *, undetermined: Literal["refuse", "zero"] = "refuse"
    ) -> Elimination:
        """Eliminate the variables, by default in the engine's order.

        Arguments and errors as for :func:`unifg.solvers.ta.elimination.eliminate`.
        """
        names = tuple(order) if order is not None else self.engine_order()
        if sorted(names) != sorted(self.variables):
            raise GraphError(f"{self.title}: the order must name each of its {len(self.sizes)} variables once")
        return eliminate(self.sizes, self.factors, names, undetermined=undetermined)

    def draw(self, ax: Axes) -> None:
        """Draw on a matplotlib axes: circles are variables, crosses constraints, squares all other factors."""
        draw(self.variables, self.factors, ax)
        ax.set_title(self.title)

    def __str__(self) -> str:
        """Variables with their dimensions, then the factors, a line each."""
        head = f"{self.title}: {len(self.sizes)} variables, {len(self.factors)} factors"
        variables = "  variables: " + ", ".join(f"{name} ({size})" for name, size in self.sizes.items())
        return "\n".join([head, variables, *(f"  {factor}" for factor in self.factors)])


def dual_graph(primal: LinearGraph, step: Mapping[str, Array]) -> LinearGraph:
    """The graph of the multipliers, given the step that solves the primal graph (Ta eq. 19 with its minus).

    Args:
        primal: a graph with constraints.
        step: (d_v,) per variable.
    """
    sizes = {factor.name: factor.rows for factor in primal.constraints}
    blocks: dict[str, dict[str, Array]] = {}
    for factor in primal.constraints:
        for variable, block in factor.blocks.items():
            blocks.setdefault(variable, {})[factor.name] = block.T
    right = {variable: np.zeros(primal.sizes[variable]) for variable in blocks}
    for other in primal.unconstrained:
        for variable, gradient in other.gradient_at(step).items():
            if variable in right:
                right[variable] -= gradient
    factors = [
        LinearFactor(variable, "balance", own, right[variable], max(float(np.abs(b).max()) for b in own.values()))
        for variable, own in blocks.items()
    ]
    return LinearGraph("dual linear graph", sizes, tuple(factors))


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
        start: Mapping[Family, Numbers] | Guess | Solution,
        *,
        data: Mapping[Data, Numbers] | None = None,
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


def variable_names(program: CompiledProblem) -> tuple[str, ...]:
    """family[member] for each variable with an unknown, in the order of the unknowns."""
    columns = program.columns
    return tuple("{}[{}]".format(*columns.name(int(columns.free[k]))) for k in _first(program))


def stacked_step(program: CompiledProblem, step: Mapping[str, Array]) -> Array:
    """(n,) tangent step of the program from the values of a primal graph."""
    return np.concatenate([np.zeros(0), *(step[name] for name in variable_names(program))])


def equality_rows(qp: QP) -> dict[str, IntArray]:
    """Rows of each equality factor, by name."""
    found = _blocks(qp.program, qp.program.constraints, qp.program.constraint_terms, qp.jacobian, qp.lower == qp.upper)
    return {name: rows for _, name, rows, _ in found}


def _blocks(
    program: CompiledProblem, pattern: Rows, terms: list[CompiledTerm], entries: Array, chosen: BoolArray
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
        assert qp.curved_by is not None
        weights = row_weights(program, term, lin, qp.curved_by)
        if term.is_bound or not weights.any():
            continue
        hessian = term.second_derivatives(lin.values, weights)
        if isinstance(term.term, Cost) and term.term.robust is not None:
            hessian = hessian + loss_curvature(term, lin)
        factors += _quadratic(program, term, "curvature", hessian, np.zeros(hessian.shape[:2]), names, first)
    return factors


def _quadratic(
    program: CompiledProblem,
    term: CompiledTerm,
    kind: Literal["cost", "curvature"],
    hessian: Array,
    gradient: Array,
    names: tuple[str, ...],
    first: IntArray,
) -> list[Factor]:
    """Factors of (n, D, D) Hessians and (n, D) gradients over the full columns of a term; those of zeros left out."""
    full = np.concatenate(term.columns, axis=1)
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


def _first(program: CompiledProblem) -> IntArray:
    """First unknown of each variable that has unknowns."""
    return np.unique(program.blocks, return_index=True)[1]


def _largest(blocks: Mapping[str, Array]) -> float:
    return max((float(np.abs(block).max(initial=0.0)) for block in blocks.values()), default=0.0)


def _index(name: str) -> int:
    """The factor's number in its name."""
    return int(name[name.rindex("[") + 1 : -1])


def _stacked(program: CompiledProblem, known: Mapping[str, Array]) -> Array:
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


class EliminationRoute:
    """Variable elimination with enforced constraints; for equalities only.

    The graph is built of the factors of the linearisation, so squares that make H convex for other routes have no
    part in it: constraints are enforced before anything is minimised.

    Attributes:
        name: "elimination".
    """

    name = "elimination"

    def __init__(self, program: CompiledProblem) -> None:
        """Remember the program."""
        self.program = program

    def begin(self) -> None:
        """Nothing is left of a solve."""

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve and measure; a direct method needs neither ``multipliers`` to start from nor an ``accuracy``."""
        primal = primal_graph(qp)
        try:
            step = primal.eliminate().solve()
            dual = dual_graph(primal, step).eliminate(undetermined="zero").solve()
        except (Contradiction, Undetermined) as error:
            zero = np.zeros(self.program.size)
            return QPAnswer(zero, multipliers, self.name, 0, np.inf, isinstance(error, Contradiction))
        found = np.zeros(len(qp.lower))
        for name, rows in equality_rows(qp).items():
            found[rows] = dual[name]
        flat = stacked_step(self.program, step)
        return QPAnswer(flat, found, self.name, 1, qp_error(qp, flat, found))


# ---------------------------------------------------------------- pictures, as in Fig. 2

ASIDE = 0.32  # from a variable to the factors that stand on it alone
SHORT, ABOVE = 7, 0.24  # names from this length on stand above their circles
TURN = 2.4  # [rad] between factors that would cover each other: the golden angle spreads any number


def draw(variables: Iterable[str], factors: Iterable[Factor], ax: Axes) -> None:
    """Draw circles for variables, crosses for constraints, squares for other factors.

    Families run from left to right, one below the other. Curvature factors hang on dashed lines, as in the paper;
    damping is left out.

    Args:
        variables: names, as "family[member]".
        factors: what joins them.
        ax: a matplotlib axes; its limits and frame are changed.
    """
    at = _places(variables)
    taken: dict[tuple[float, float], int] = {}
    for factor in factors:
        if factor.kind == "damping" or not factor.variables:
            continue
        x, y = _place(factor, at, taken)
        dashed = factor.kind == "curvature"
        for name in factor.variables:
            ax.plot(
                [at[name][0], x],
                [at[name][1], y],
                color="0.6",
                linewidth=0.8,
                zorder=1,
                linestyle="--" if dashed else "-",
            )
        if factor.kind == "constraint":
            ax.scatter([x], [y], marker="x", s=24, c="tab:red", zorder=2, linewidths=1.2)
        else:
            colour = "white" if dashed else "black"
            ax.scatter([x], [y], marker="s", s=24, c=colour, edgecolors="black", zorder=2, linewidths=1.2)
    for name, (x, y) in at.items():
        ax.scatter([x], [y], s=420, c="white", edgecolors="tab:blue", zorder=3)
        above = 0.0 if len(name) < SHORT else ABOVE
        ax.text(x, y + above, name, ha="center", va="center", fontsize=6, zorder=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.1)
    ax.set_axis_off()


def _places(variables: Iterable[str]) -> dict[str, Array]:
    """(2,) where each variable stands: its member number to the right, its family downwards."""
    families: dict[str, int] = {}
    places: dict[str, Array] = {}
    for name in variables:
        family, _, member = name[:-1].rpartition("[")
        lane = families.setdefault(family, len(families))
        places[name] = np.array([float(member) + 0.5 * (lane % 2), -1.2 * lane])
    return places


def _place(factor: Factor, at: dict[str, Array], taken: dict[tuple[float, float], int]) -> tuple[float, float]:
    """Between the variables of a factor, aside of what stands there already."""
    centre = np.mean([at[name] for name in factor.variables], axis=0)
    key = (round(float(centre[0]), 6), round(float(centre[1]), 6))
    before = taken.get(key, 0)
    taken[key] = before + 1
    if len(factor.variables) == 1 or before:
        angle = -0.5 * np.pi + TURN * before
        centre = centre + ASIDE * np.array([np.cos(angle), np.sin(angle)])
    return float(centre[0]), float(centre[1])
