"""The optimality test every backend is judged by.

For min f(x) s.t. l <= g(x) <= u with L = f + lambda' g, at a point and multipliers:

- stationarity: max |grad f + A' lambda| over the unknowns (tangent coordinates, right perturbation);
- violation: max distance of g outside [l, u];
- complementarity: max |lambda_i| times the distance of g_i to the limit its sign points at; a multiplier
  pointing at a limit that does not exist has the wrong sign and counts as |lambda_i|.

Stationarity and complementarity are divided by max(1, mean|lambda| / 100); the violation is not scaled.

Pure least squares, a graph without constraints and scalar costs, has a zero point of cost, and with it a measure that
does not depend on the unit of the information: there the stationarity is the relative offset of
:mod:`unifg.solution.relative_offset`, and the Hessian must be regular too: where it is not, some unknowns may be moved
freely.

A stationarity that is made of differences is known up to their rounding. Where that exceeds the tolerance nothing
passes: a derivative that rounding has left nothing of looks like zero. A function value f of a few operations is wrong
by eps |f|, and a difference over h makes eps |f| / h of that. Summed over the factors that touch an unknown, with the
weight w of each row in the gradient of the Lagrangian, this is

    sum eps |w_a r_a| / h:

w r of a whitened cost is |W r|^2, of a constraint lambda g. Terms with attached Jacobians and kernels with their own
add nothing. Roundings inside a function are not seen from outside; :mod:`unifg.factors.steps` chooses steps that keep
them small.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from unifg.codegen.inner import inner
from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to
from unifg.factors.steps import EPSILON, FIRST, step_for
from unifg.problem import evaluation
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.table import COLUMN, COST, COUNT, DIFFERENCED, KIND, ROW, ROWS, WIDTH, TermArrays
from unifg.solution.relative_offset import Factored, relative_offset
from unifg.solution.violation import ViolationModel
from unifg.typing import Array, IntArray

NUMBERS = 5  # that :func:`kkt_numbers` writes


class Optimality(NamedTuple):
    """KKT numbers at a point.

    Attributes:
        stationarity, violation, complementarity: as defined in the module's docstring.
        worst_row: constraint row with the largest violation, or -1 without constraints.
        finite: whether everything could be evaluated.
        determined: whether no unknown may be moved freely; looked at for least squares only.
        rounding: by how much differences may be wrong about the stationarity.
        weakest: of least squares, the smallest pivot of the Hessian relative to its diagonal; 1 where nobody looked.
    """

    stationarity: float
    violation: float
    complementarity: float
    worst_row: int
    finite: bool
    determined: bool = True
    rounding: float = 0.0
    weakest: float = 1.0

    def holds(self, tolerance: float) -> bool:
        """Test whether all three numbers are within ``tolerance``."""
        return self.finite and max(self.stationarity, self.violation, self.complementarity) <= tolerance

    def passes(self, tolerance: float) -> bool:
        """Test whether all three numbers are known to be within ``tolerance``, at a point that is determined."""
        return self.determined and self.holds(tolerance) and self.rounding <= tolerance

    def blurred(self, tolerance: float) -> bool:
        """Test whether rounding above ``tolerance`` is all that differences still see of the stationarity."""
        sound = self.finite and max(self.violation, self.complementarity) <= tolerance
        return sound and self.stationarity <= self.rounding and self.rounding > tolerance


def optimality(
    program: CompiledProblem,
    lin: Linearization,
    multipliers: Array,
    enough: float = 0.0,
    lent: Factored | None = None,
    guess: Array | None = None,
) -> Optimality:
    """Measure the KKT conditions at a linearised point.

    Args:
        program: the compiled graph with its data bound.
        lin: linearisation at the point, whose gradient is the true one, robust losses included.
        multipliers: (M,) one per constraint row.
        enough: of least squares, a relative offset above this may be a lower bound, which takes no factorisation.
        lent: of least squares, a backend's factorisation near this point.
        guess: of least squares, the stored values that the solve began with.
    """
    if program.least_squares:
        offset = relative_offset(program, lin, enough, lent, guess)
        if not (offset.finite and np.isfinite(lin.cost)):
            return Optimality(np.inf, np.inf, np.inf, -1, False)
        rounding = _relative_rounding(program, lin, multipliers) if program.differenced else 0.0
        return Optimality(offset.value, 0.0, 0.0, -1, True, offset.determined, rounding, offset.weakest)
    gradient, found = np.empty(len(lin.gradient)), np.empty(NUMBERS)
    kkt_numbers(
        program.arrays,
        program.columns.free,
        lin.gradient,
        lin.constraints,
        lin.constraint_jacobian,
        multipliers,
        gradient,
        found,
    )
    measured = read_numbers(found, lin.cost)
    if not measured.finite:
        return measured
    rounding = 0.0
    if program.differenced:
        rounding = float(gradient_rounding(program, lin, multipliers).max(initial=0.0))
        rounding /= max(1.0, float(np.abs(multipliers).mean()) / 100.0) if len(multipliers) else 1.0
    return measured._replace(rounding=rounding)


def read_numbers(found: Array, cost: float) -> Optimality:
    """Numbers that :func:`kkt_numbers` has written."""
    stationarity, violation, complementarity, worst, finite = found.tolist()
    if finite == 0.0 or not math.isfinite(cost):
        return Optimality(np.inf, np.inf, np.inf, -1, False)
    return Optimality(stationarity, violation, complementarity, int(worst), True)


def _relative_rounding(program: CompiledProblem, lin: Linearization, multipliers: Array) -> float:
    """Error bound of a relative offset found from differences."""
    rounding = gradient_rounding(program, lin, multipliers)
    size = math.sqrt(inner(lin.residual, lin.residual))
    if not len(rounding) or size == 0.0:
        return 0.0
    curvature = np.sqrt(lin.hessian[program.normal.diagonal])
    seen = curvature > 0.0
    with np.errstate(over="ignore"):
        return float((rounding[seen] / curvature[seen]).max(initial=0.0)) / size


def gradient_rounding(program: CompiledProblem, lin: Linearization, multipliers: Array) -> Array:
    """(size,) by how much the entries of the gradient of the Lagrangian may be wrong; empty without differences.

    Args:
        program: the compiled graph.
        lin: where.
        multipliers: (M,) one per constraint row.
    """
    if not program.differenced:
        return np.zeros(0)
    total = np.zeros(program.columns.width)
    if program.table.differenced:
        first, last, _ = program.columns.extents
        _add_rounding(
            program.arrays,
            lin.residual,
            lin.constraints,
            multipliers,
            total,
            lin.values.flat,
            first,
            last,
        )
    if program.scalar_terms:
        total += lin.rounding
    return total[program.columns.free]


@compiled
def _add_rounding(
    terms: TermArrays,
    residual: Array,
    constraints: Array,
    multipliers: Array,
    total: Array,
    values: Array,
    first: IntArray,
    last: IntArray,
) -> None:
    """Add the rounding of every differenced term over the full tangent space."""
    fields, columns = terms.fields, terms.columns
    for t in range(len(fields)):
        term = fields[t]
        if term[DIFFERENCED] == 0:
            continue
        m, width = term[ROWS], term[WIDTH]
        for i in range(term[COUNT]):
            row, size = term[ROW] + i * m, 0.0
            for a in range(row, row + m):
                size += residual[a] ** 2 if term[KIND] == COST else abs(multipliers[a] * constraints[a])
            if size == 0.0 or not math.isfinite(size):
                continue
            for d in range(width):
                column, largest = columns[term[COLUMN] + i * width + d], 0.0
                for k in range(first[column], last[column]):
                    largest = max(largest, abs(values[k]))
                total[column] += EPSILON * size / step_for(largest, FIRST)


@compiled
def kkt_numbers(
    terms: TermArrays,
    free: IntArray,
    slope: Array,
    constraints: Array,
    entries: Array,
    multipliers: Array,
    gradient: Array,
    found: Array,
) -> None:
    """Write stationarity, violation, complementarity, worst row, and whether everything is finite.

    Args:
        terms: of the program.
        free: columns that are unknown.
        slope: (width,) gradient of the objective.
        constraints: (M,) values.
        entries: of the constraint Jacobian.
        multipliers: (M,).
        gradient: (width,) memory, for the gradient of the Lagrangian.
        found: (5,) result.
    """
    stationarity, violation, complementarity, size = 0.0, 0.0, 0.0, 0.0
    worst, count, finite = -1, len(constraints), True
    lower, upper = terms.lower, terms.upper
    copy_to(slope, gradient)
    evaluation.transposed_times(terms, False, entries, multipliers, gradient)
    for k in range(len(free)):
        stationarity = max(stationarity, abs(gradient[free[k]]))
    for k in range(len(slope)):
        finite = finite and math.isfinite(slope[k])
    for k in range(len(entries)):
        finite = finite and math.isfinite(entries[k])
    for row in range(count):
        value, multiplier = constraints[row], multipliers[row]
        finite = finite and math.isfinite(value) and math.isfinite(multiplier)
        size += abs(multiplier)
        outside = max(max(value - upper[row], lower[row] - value), 0.0)
        if worst < 0 or outside > violation:
            worst, violation = row, outside
        if lower[row] != upper[row]:
            limit = upper[row] if multiplier > 0.0 else lower[row]
            slack = abs(value - limit) if math.isfinite(limit) else 1.0
            complementarity = max(complementarity, abs(multiplier) * slack)
    scale = max(1.0, size / max(count, 1) / 100.0)
    found[0], found[1], found[2] = stationarity / scale, violation, complementarity / scale
    found[3], found[4] = worst, finite


def infeasible_stationary(program: CompiledProblem, lin: Linearization, tolerance: float) -> bool:
    """Test whether an infeasible point is stationary for 1/2 |violation|^2, in whatever units the unknowns are.

    It is where the best step of :class:`unifg.solution.violation.ViolationModel` promises nothing. Bounds of
    the unknowns are kept, since they can be: a point outside them is looked at where it is brought back, and descent
    directions that they block do not count.
    """
    lin = within_bounds(program, lin)
    if np.abs(program.violation(lin.constraints)).max(initial=0.0) <= tolerance:
        return False
    return ViolationModel(program, lin).stationary(tolerance)


def within_bounds(program: CompiledProblem, lin: Linearization) -> Linearization:
    """The linearisation at the nearest point that respects every bound of an unknown; ``lin`` where it does."""
    values = program.within_bounds(lin.values)
    return lin if values is lin.values else program.linearize(values)
