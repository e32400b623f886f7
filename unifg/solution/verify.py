"""``solution.verify()``: an answer judged anew, by the functions as they were written.

They are evaluated by :mod:`unifg.solution.as_written`. Of the solve, only values, multipliers and cost are taken, as
claims. Multipliers are also made anew: those that minimise |grad f + A' lambda|^2 + sum (s lambda)^2 over multipliers
of the right signs, with s the distance of a row from its limit, so that both stationarity and complementarity are as
small as any multipliers make them. The signs are found by block principal pivoting (Kim and Park, SIAM J. Sci. Comput.
33, 2011), over a sparse LU of SciPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from unifg.errors import GraphError, require_positive
from unifg.modeling.terms import Constraint, ScalarCost
from unifg.modeling.variables import Data, Family
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solution.as_written import WrittenTerm, moved_fix, off_manifold
from unifg.solution.optimality import LAST
from unifg.typing import Array, IntArray

ROUNDS = 30  # of pivoting
NEAR = 1e-3  # slack of a row that has a multiplier to begin with
FAR = 1e12  # a row so far from its limit has no multiplier
DAMPING = 1e-13  # relative, of the rows that depend on each other
NOTHING = 1e-10  # of the largest slope, where the slack is small: a multiplier is not worth it
FLAT = 1e-11  # curvature, relative to the diagonal, of a direction of which differences say nothing
FITS = 100.0  # times the rounding of the variables: residuals that are nothing else
SYMMETRIC = "MMD_AT_PLUS_A"  # ordering
COST = 1e-8  # relative difference of costs
SHARE = 0.01  # of the largest product that a gradient is a sum of: what its size is


@dataclass(frozen=True)
class Numbers:
    """KKT numbers with some multipliers.

    Attributes:
        stationarity: as that of a solution: scaled or relative, and of least squares the relative offset.
        bound: by how much differences may be wrong about it.
        complementarity: scaled or relative.
        variable: family and member with the largest slope; None where nothing is unknown.
        row: of the largest complementarity, -1 without constraints.
    """

    stationarity: float
    bound: float
    complementarity: float
    variable: tuple[str, int] | None
    row: int

    def fails(self, tolerance: float) -> bool:
        """Test whether a number exceeds the tolerance beyond doubt."""
        return not max(self.stationarity - self.bound, self.complementarity) <= tolerance


@dataclass(frozen=True)
class Verified:
    """Outcome of an independent check; true where it passes.

    Attributes:
        verdict: "passes", "fails", or "undecided" where differences cannot tell.
        sentence: the reason, with the place.
        cost: found anew; NaN where it could not be evaluated.
        violation: largest distance of a row outside its limits.
        worst: term, factor and row of it; None without constraints.
        claimed: KKT numbers with the multipliers of the solution.
        least: those with the multipliers made anew.
        multipliers: (n, m) made anew, by the names of the terms.
    """

    verdict: str
    sentence: str
    cost: float = np.nan
    violation: float = np.nan
    worst: tuple[str, int, int] | None = None
    claimed: Numbers | None = None
    least: Numbers | None = None
    multipliers: dict[str, Array] | None = None

    def __bool__(self) -> bool:
        """Test whether the answer passes."""
        return self.verdict == "passes"

    def __str__(self) -> str:
        """Verdict and reason."""
        return f"{self.verdict}: {self.sentence}"


class Entries(NamedTuple):
    """Entries of a matrix over the unknowns; those of the same place add up.

    Attributes:
        numbers, errors: (E,) each with the bound of its error.
        rows, columns: (E,) places.
    """

    numbers: Array
    errors: Array
    rows: IntArray
    columns: IntArray

    @classmethod
    def of(cls, parts: Sequence[tuple[Array, Array, IntArray, IntArray]]) -> Entries:
        """Join arrays that broadcast, without zeros known to be that and negative places, those of fixed variables."""
        flat = [[np.zeros(0), np.zeros(0), np.zeros(0, np.intp), np.zeros(0, np.intp)]]
        flat += [[array.ravel() for array in np.broadcast_arrays(*part)] for part in parts]
        numbers, errors, rows, columns = (np.concatenate(arrays) for arrays in zip(*flat, strict=True))
        counted = (rows >= 0) & (columns >= 0) & ((numbers != 0.0) | (errors != 0.0))
        return cls(numbers[counted], errors[counted], rows[counted], columns[counted])


class Conditions:
    """KKT conditions of a graph at an answer, with all slopes found by differences.

    Attributes:
        program: the graph.
        cost: objective.
        g, lower, upper: (M,) constraint rows and their limits.
        gradient, least: (size,) of the objective, and the force that counts as one, after :meth:`differentiate`.
        violation, worst: largest distance of a row outside its limits, and the row; -1 without constraints.
    """

    def __init__(self, program: CompiledProblem, terms: list[WrittenTerm]) -> None:
        """Evaluate costs and constraints, without slopes."""
        self.program = program
        self._own = [t for t in terms if isinstance(t.term, Constraint)]
        self._costs = [(t, *t.cost()) for t in terms if not isinstance(t.term, Constraint)]
        self.cost = float(sum(values.sum() for _, values, _, _ in self._costs))
        limits = [t.limits() for t in self._own]
        none = np.zeros(0)
        self.g = np.concatenate([none, *(t.rows.ravel() for t in self._own)])
        self.lower, self.upper = (np.concatenate([none, *(pair[k].ravel() for pair in limits)]) for k in (0, 1))
        self._worth = np.arange(len(self.g))  # row that tells how much another matters: of slacks, the one they are in
        at = 0
        for before, t in zip([None, *self._own], self._own, strict=False):
            if before is not None and isinstance(t.term, Constraint) and t.term.limits_slacks:
                (count, m), k = before.rows.shape, np.arange(t.rows.size)
                each = t.rows.size // max(count, 1)
                self._worth[at : at + len(k)] = at - count * m + k // each * m + k % each % m
            at += t.rows.size
        self._counted = self._worth == np.arange(len(self.g))
        outside = np.maximum(np.maximum(self.g - self.upper, self.lower - self.g), 0.0)
        self.violation, self.worst = float(outside.max(initial=0.0)), int(outside.argmax()) if len(outside) else -1
        seen = np.where(outside > LAST * np.abs(self.g), outside, 0.0)
        self._unpaid = np.where(self._counted, 0.0, seen[self._worth])  # by slacks: it costs the price of one, too

    def differentiate(self) -> None:
        """Find gradient, Jacobian of the constraints and, of least squares, the Gauss-Newton matrix."""
        unknown, size = self.program.columns.unknown, self.program.size
        slope, doubtful, curved, blocks, squares = *np.zeros((3, size + 1)), [], 0.0  # the last, of what is fixed
        self._forces = np.zeros(size + 1)
        for term, _, force, weights in self._costs:
            slopes, doubt, bend = term.slopes()
            own = unknown[term.columns]
            np.add.at(slope, own, np.einsum("nmd,nm->nd", slopes, force))
            np.maximum.at(self._forces, own, np.abs(slopes * force[:, :, None]).max(axis=1, initial=0.0))
            square = np.einsum("nad,nab,nbd->nd", slopes, weights, slopes)  # zero for scalar costs
            bent = np.maximum(bend[:, 0], 0.0) if isinstance(term.term, ScalarCost) else 0.0
            np.add.at(curved, own, square + bent)
            rounding = np.abs(weights).sum(axis=2) * term.rounding
            squares += float((rounding * term.rounding).sum())
            np.add.at(doubtful, own, np.einsum("nmd,nm->nd", doubt, np.abs(force)))
            np.add.at(doubtful, own, np.einsum("nmd,nm->nd", np.abs(slopes), rounding))
            if self.program.least_squares:
                block = np.einsum("nad,nab,nbe->nde", slopes, weights, slopes)
                blocks.append((block, block, own[:, :, None], own[:, None, :]))
        self.gradient, self._doubt, self._rounding = slope[:size], doubtful[:size], float(np.sqrt(squares))
        largest = float(max(np.abs(slope[:size]).max(initial=0.0), curved[:size].max(initial=0.0)))
        self.least = largest if 0.0 < largest < 1.0 else 1.0
        curved, square = np.where(curved > 0.0, curved, np.inf)[:size], np.square(slope[:size])
        self._worth_of_costs = max(self.least, min(1.0, float((square / curved).max(initial=0.0))))
        self._hessian, at, parts = Entries.of(blocks), 0, []
        for term in self._own:
            numbers = at + np.arange(term.rows.size).reshape(*term.rows.shape, 1)
            parts.append((*term.slopes()[:2], numbers, unknown[term.columns][:, None, :]))
            at += term.rows.size
        self._jacobian = Entries.of(parts)

    def numbers(self, multipliers: Array, tolerance: float) -> Numbers:
        """KKT numbers with these multipliers (M,)."""
        A, size = self._jacobian, self.program.size
        slope = self.gradient + np.bincount(A.columns, A.numbers * multipliers[A.rows], size)
        doubt = self._doubt + np.bincount(A.columns, A.errors * np.abs(multipliers[A.rows]), size)
        counted = np.abs(multipliers[self._counted])
        force = float(counted.mean()) / 100.0 if len(counted) else 0.0
        scale, worth = max(self.least, force), max(self._worth_of_costs, force)
        sizes = self._sizes(multipliers)
        either = [
            tuple(float(np.abs(part / size).max(initial=0.0)) for part in (slope, doubt)) for size in (scale, sizes)
        ]
        stationarity, bound = min(either, key=lambda pair: (max(pair) > tolerance, pair))  # one of them suffices
        if self.program.least_squares and len(slope):
            stationarity, bound = self._offset(slope, doubt)
        limit = np.where(multipliers > 0.0, self.upper, self.lower)
        slack = np.where(np.isfinite(limit), np.abs(self.g - np.where(np.isfinite(limit), limit, 0.0)), 1.0)
        slack = np.maximum(slack, self._unpaid)
        shares = np.zeros(len(multipliers))
        np.maximum.at(shares, A.rows, np.abs(A.numbers) / sizes[A.columns])
        shares = np.where(shares > 0.0, np.minimum(shares, 1.0 / worth), 1.0 / worth)[self._worth]
        wrong = np.where(self.lower != self.upper, np.abs(multipliers) * slack * shares, 0.0)
        columns = self.program.columns
        at = columns.name(int(columns.free[np.abs(slope).argmax()])) if len(slope) else None
        row = int(wrong.argmax()) if len(wrong) else -1
        return Numbers(stationarity, bound, float(wrong.max(initial=0.0)), at, row)

    def _sizes(self, multipliers: Array) -> Array:
        """(size,) sizes of gradients, the same for all members along a coordinate of a family; infinite where none."""
        A, columns = self._jacobian, self.program.columns
        forces, kinds = self._forces[:-1].copy(), columns.coordinates[columns.free]
        np.maximum.at(forces, A.columns, np.abs(A.numbers * multipliers[A.rows]))
        sizes = np.zeros(kinds.max(initial=-1) + 1)
        np.maximum.at(sizes, kinds, SHARE * forces)
        return np.where(sizes > 0.0, sizes, np.inf)[kinds]

    def _offset(self, slope: Array, doubt: Array) -> tuple[float, float]:
        """Relative offset of least squares, and by how much it may be wrong."""
        import scipy.sparse as sp
        import scipy.sparse.linalg as spl

        length = float(np.sqrt(sum((t.rows * force).sum() for t, _, force, _ in self._costs)))  # as losses weigh
        if length <= FITS * self._rounding:  # everything fits
            return 0.0, 0.0
        H = self._hessian
        scale = np.sqrt(np.bincount(H.rows, np.where(H.rows == H.columns, H.numbers, 0.0), len(slope)))
        scale = np.where(scale > 0.0, scale, 1.0)
        matrix = sp.csc_matrix((H.numbers / scale[H.rows] / scale[H.columns], (H.rows, H.columns)))
        factors = spl.splu((matrix + DAMPING * sp.identity(len(slope))).tocsc(), SYMMETRIC)
        square = ((slope / scale) * factors.solve(slope / scale)).sum()
        bound = float(np.sqrt(((doubt / scale) ** 2).sum())) / length
        flat = np.abs(factors.U.diagonal()).min() < FLAT  # some step is as long as errors make it
        return float(np.sqrt(max(square, 0.0))) / length, np.inf if flat else bound

    def multipliers(self) -> Array:
        """(M,) multipliers that balance the gradient best, with their signs."""
        import scipy.sparse as sp
        import scipy.sparse.linalg as spl

        A, count, size = self._jacobian, len(self.g), self.program.size
        multipliers = np.zeros(count)
        if not (count and size):
            return multipliers
        equality = self.lower == self.upper
        above, below = self.upper - self.g, self.g - self.lower
        sign = np.where(equality, 0.0, np.where(above <= below, 1.0, -1.0))
        slack = np.where(equality, 0.0, np.minimum(np.abs(above), np.abs(below)))
        candidate = np.isfinite(slack)
        free = slack <= NEAR
        held = np.minimum(slack, FAR) ** 2 + DAMPING * np.maximum(np.bincount(A.rows, A.numbers**2, count), 1e-12)
        largest, both = float(np.abs(self.gradient).max(initial=0.0)), np.arange(size + count)
        worth = NOTHING * largest * np.maximum(slack / NEAR, 1.0)
        for _ in range(ROUNDS):  # of [[I, A'], [A, -s^2]] [rest; multipliers] = [-gradient; 0], with the free rows of A
            number, kept = size - 1 + np.cumsum(free), free[A.rows]
            rows, columns, entries = number[A.rows[kept]], A.columns[kept], A.numbers[kept]
            diagonal, right = np.append(np.ones(size), -held[free]), np.append(-self.gradient, 0.0 * held[free])
            own = both[: len(right)]
            places = np.concatenate([own, rows, columns]), np.concatenate([own, columns, rows])
            matrix = sp.csc_matrix((np.concatenate([diagonal, entries, entries]), places))
            found = spl.splu(matrix, relax=1, panel_size=1).solve(right)
            multipliers = np.where(free, found[number], 0.0)
            gain = sign * np.bincount(A.rows, A.numbers * found[A.columns], count)
            wrong = np.where(free, sign * multipliers < 0.0, candidate & (gain > worth))
            if not wrong.any():
                break
            free ^= wrong
        return np.where(sign * multipliers < 0.0, 0.0, multipliers)


def require_tolerance(tolerance: float) -> None:
    """Refuse what is no positive number.

    Raises:
        GraphError: with what was found.
    """
    require_positive("verify", GraphError, finite=False, tolerance=tolerance)


def verified(
    program: CompiledProblem,
    values: Mapping[Family, Array],
    multipliers: Array,
    cost: float,
    data: Mapping[Data, Array],
    tolerance: float,
) -> Verified:
    """Check an answer; see :meth:`unifg.Solution.verify`.

    Args:
        program: the graph as it was solved, soft constraints with their slacks.
        values: of the answer.
        multipliers: (M,) of the answer.
        cost: as the solution has it.
        data: of that solve.
        tolerance: of all numbers.
    """
    place = off_manifold(values)
    if place is not None:
        return Verified("fails", f"{place[0]}[{place[1]}] is no point of its manifold")
    terms: list[WrittenTerm] = []
    for compiled in program.terms:
        try:
            with np.errstate(all="ignore"):
                terms.append(WrittenTerm(compiled.term, program.columns, values, data))
        except Exception as error:  # of the user's function, at an answer that may be anything
            return Verified("fails", f"term '{compiled.name}' raises {type(error).__name__}: {error}")
        bad = ~np.isfinite(terms[-1].rows).all(axis=1)
        if bad.any():
            return Verified("fails", f"term '{compiled.name}', factor {int(bad.argmax())} is not finite")
    with np.errstate(all="ignore"):
        here = Conditions(program, terms)
    if not np.isfinite(here.cost):
        return Verified("fails", "the cost is not finite: look at standard deviations, information and prices")
    worst = program.row_place(here.worst) if here.worst >= 0 else None
    measured: dict[str, Any] = {"cost": here.cost, "violation": here.violation, "worst": worst}
    for fix in program.graph.fixes:
        if (far := moved_fix(fix, values, data)) > tolerance:
            return Verified("fails", f"what '{fix.name}' fixes is {far:.3g} away from its value", **measured)
    try:
        with np.errstate(all="ignore"):
            here.differentiate()
            made = here.multipliers()
            claimed, least = here.numbers(multipliers, tolerance), here.numbers(made, tolerance)
    except Exception as error:  # a function may raise beside an answer, and SciPy at a singular matrix
        return Verified("undecided", f"slopes cannot be found: {type(error).__name__}: {error}", **measured)
    measured |= {"claimed": claimed, "least": least, "multipliers": dict(program.by_term(made))}
    if not abs(here.cost - cost) <= COST * max(here.least, abs(cost)) and here.violation <= tolerance:
        return Verified("fails", f"the cost is {here.cost:.9g} where the solution says {cost:.9g}", **measured)
    apart = int(np.abs(made - multipliers).argmax()) if len(made) else -1
    return Verified(*_judged(here, claimed, least, apart, tolerance), **measured)


def _judged(here: Conditions, claimed: Numbers, least: Numbers, apart: int, tolerance: float) -> tuple[str, str]:
    """Verdict, and the sentence that gives its reason; ``apart`` is the row whose two multipliers differ most."""
    if not here.violation <= tolerance:
        name, factor, row = here.program.row_place(here.worst)
        return "fails", f"term '{name}', factor {factor}, row {row} is {here.violation:.3g} outside its limits"
    if claimed.fails(tolerance) and not least.fails(tolerance):
        name, factor, row = here.program.row_place(apart)
        return "fails", (
            f"the values pass, the multipliers do not: with them stationarity is {claimed.stationarity:.3g} and "
            f"complementarity {claimed.complementarity:.3g}; farthest from what they should be is that of '{name}', "
            f"factor {factor}, row {row}"
        )
    if claimed.fails(tolerance):
        if claimed.stationarity - claimed.bound > tolerance and claimed.variable is not None:
            family, member = claimed.variable
            known = f"{claimed.stationarity:.3g} (known to {claimed.bound:.1g})"
            return "fails", f"the cost can still fall: stationarity is {known}, most at {family}[{member}]"
        name, factor, row = here.program.row_place(claimed.row)
        return "fails", f"complementarity is {claimed.complementarity:.3g} in '{name}', factor {factor}, row {row}"
    numbers = (
        f"violation {here.violation:.1e}, stationarity {claimed.stationarity:.1e} (known to {claimed.bound:.1e}), "
        f"complementarity {claimed.complementarity:.1e}"
    )
    if claimed.bound > tolerance:
        return "undecided", f"differences cannot tell stationarity to {tolerance:.1g}: {numbers}"
    return "passes", numbers
