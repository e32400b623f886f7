"""The optimality test every backend is judged by.

For min f(x) s.t. l <= g(x) <= u with L = f + lambda' g, at a point and multipliers:

- stationarity: max |grad f + A' lambda| over the unknowns (tangent coordinates, right perturbation);
- violation: max distance of g outside [l, u];
- complementarity: max |lambda_i| times the distance of g_i to the limit its sign points at; a multiplier pointing at a
  limit that does not exist has the wrong sign, and the distance is one. The slack of a soft constraint has to be what
  its limit is violated by: what it does not pay for is a distance of its own, if larger, and counts as one of that row.

Stationarity and complementarity are divided by max(c, mean|lambda| / 100), with c the largest slope or curvature of the
costs or, if less, one (`cost_size` of :mod:`unifg.problem.units`); or they are relative, whichever is less: the
gradient to s, the size of what it is a sum of along the coordinate of a family (`find_sizes` there), and lambda_i to
what makes its force as large. For complementarity, which has the unit of costs, c is also at least the largest slope
squared over its curvature or, if less, one (`worth_of_costs` there). Limits of slacks do not count in the mean
(`mean_force` there). Where numbers are large, relative ones alone can be met. So no unit of cost decides, nor one of
rows and unknowns where numbers are large. The violation is in the graph's units, with a tolerance of its own, which
tells the unit of rows.

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
from unifg.problem.table import COLUMN, COST, COUNT, DIFFERENCED, ENTRY, KIND, ROW, ROWS, SLACKS, WIDTH, TermArrays
from unifg.problem.units import cost_size, find_sizes, mean_force, worth_of_costs
from unifg.solution.relative_offset import Factored, relative_offset
from unifg.solution.violation import ViolationModel
from unifg.typing import Array, IntArray

LAST = 4 * EPSILON  # of the value of a row: what prices do not multiply
NUMBERS = 6  # that :func:`kkt_numbers` writes


class Tolerances(NamedTuple):
    """Tolerances of the KKT test.

    Attributes:
        kkt: of stationarity and complementarity.
        violation: of the violation, in the units of the constraints.
        violation_unit: unit of the constraint rows in the mean, which a stated tolerance tells; 0 where it is not.
    """

    kkt: float
    violation: float
    violation_unit: float = 0.0


class Optimality(NamedTuple):
    """KKT numbers at a point.

    Attributes:
        stationarity, violation, complementarity: as defined in the module's docstring.
        worst_row: constraint row with the largest violation, or -1 without constraints.
        finite: whether everything could be evaluated.
        determined: whether no unknown may be moved freely; looked at for least squares only.
        rounding: by how much differences may be wrong about the stationarity.
        weakest: of least squares, the smallest pivot of the Hessian relative to its diagonal; 1 where nobody looked.
        slope: gradient that counts as one, at least; 1 for least squares.
    """

    stationarity: float
    violation: float
    complementarity: float
    worst_row: int
    finite: bool
    determined: bool = True
    rounding: float = 0.0
    weakest: float = 1.0
    slope: float = 1.0

    def holds(self, tolerances: Tolerances) -> bool:
        """Test whether all three numbers are within their tolerances."""
        return self.finite and self.feasible(tolerances) and self.stationarity <= tolerances.kkt

    def feasible(self, tolerances: Tolerances) -> bool:
        """Test whether violation and complementarity are."""
        return self.violation <= tolerances.violation and self.complementarity <= tolerances.kkt

    def passes(self, tolerances: Tolerances) -> bool:
        """Test whether all three numbers are known to be within their tolerances, at a point that is determined."""
        return self.determined and self.holds(tolerances) and self.rounding <= tolerances.kkt

    def blurred(self, tolerances: Tolerances) -> bool:
        """Test whether rounding above its tolerance is all that differences still see of the stationarity."""
        sound = self.finite and self.feasible(tolerances)
        return sound and self.stationarity <= self.rounding and self.rounding > tolerances.kkt


def optimality(
    program: CompiledProblem,
    lin: Linearization,
    multipliers: Array,
    enough: float = 0.0,
    lent: Factored | None = None,
    guess: Array | None = None,
    violation_unit: float = 0.0,
) -> Optimality:
    """Measure the KKT conditions at a linearised point.

    Args:
        program: the compiled graph with its data bound.
        lin: linearisation at the point, whose gradient is the true one, robust losses included.
        multipliers: (M,) one per constraint row.
        enough: tolerance. Of least squares, a relative offset above it may be a lower bound, which takes no
            factorisation; of others, relative numbers are looked for above it.
        lent: of least squares, a backend's factorisation near this point.
        guess: of least squares, the stored values that the solve began with.
        violation_unit: what constraint rows are measured in, in the mean, as of :class:`Tolerances`.
    """
    if program.least_squares:
        offset = relative_offset(program, lin, enough, lent, guess)
        if not (offset.finite and np.isfinite(lin.cost)):
            return Optimality(np.inf, np.inf, np.inf, -1, False)
        rounding = _relative_rounding(program, lin, multipliers) if program.differenced else 0.0
        return Optimality(offset.value, 0.0, 0.0, -1, True, offset.determined, rounding, offset.weakest)
    columns = program.columns
    gradient, found, sizes = np.empty(len(lin.gradient)), np.empty(NUMBERS), np.zeros(columns.dimensions)
    kkt_numbers(
        program.arrays, columns.free, columns.coordinates, sizes, violation_unit,
        -1.0 if program.differenced else enough, lin.gradient, program.normal.diagonal, lin.hessian, lin.residual,
        lin.jacobian, lin.constraints, lin.constraint_jacobian, multipliers, gradient, found,
    )  # fmt: skip
    measured = read_numbers(found, lin.cost)
    if not measured.finite:
        return measured
    rounding = 0.0
    if program.differenced:
        uncertain = gradient_rounding(program, lin, multipliers)
        least = cost_size(program.normal.diagonal, lin.hessian, lin.gradient)
        scale = max(least, mean_force(program.arrays, multipliers, np.ones(len(multipliers))))
        own = np.maximum(sizes[columns.coordinates[columns.free]], np.finfo(float).tiny)
        with np.errstate(over="ignore"):
            relative = float((uncertain / own).max(initial=0.0))
        rounding = min(relative, float(uncertain.max(initial=0.0)) / scale)
    return measured._replace(rounding=rounding)


def read_numbers(found: Array, cost: float) -> Optimality:
    """Numbers that :func:`kkt_numbers` has written."""
    stationarity, violation, complementarity, worst, finite, slope = found.tolist()
    if finite == 0.0 or not math.isfinite(cost):
        return Optimality(np.inf, np.inf, np.inf, -1, False)
    return Optimality(stationarity, violation, complementarity, int(worst), True, True, 0.0, 1.0, slope)


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
def unpaid(terms: TermArrays, t: int, k: int, constraints: Array) -> float:
    """Violation of a soft constraint that its k-th slack, limited by term t, does not pay for; zero for other rows."""
    fields = terms.fields
    if fields[t, SLACKS] == 0:
        return 0.0
    count, m = fields[t - 1, COUNT], fields[t - 1, ROWS]
    each = fields[t, COUNT] * fields[t, ROWS] // max(count, 1)
    row = fields[t - 1, ROW] + k // each * m + k % each % m
    outside: float = max(constraints[row] - terms.upper[row], terms.lower[row] - constraints[row])
    return outside if outside > LAST * abs(constraints[row]) else 0.0


@compiled
def _complementarity(
    terms: TermArrays,
    shares: tuple[IntArray, Array, float, float],
    constraints: Array,
    entries: Array,
    multipliers: Array,
) -> float:
    coordinates, sizes, violation_unit, worth = shares
    fields, columns, lower, upper, result = terms.fields, terms.columns, terms.lower, terms.upper, 0.0
    unit = violation_unit if violation_unit > 0.0 else 1.0
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] == COST:
            continue
        count = term[COUNT] * term[ROWS]
        own = fields[t - 1 if term[SLACKS] != 0 else t]  # what slacks are limited by tells what their row is worth
        m, width = own[ROWS], own[WIDTH]
        each = count // max(own[COUNT], 1)  # rows of a factor, with slacks of one side or both
        for k in range(count):
            at = term[ROW] + k
            if lower[at] == upper[at] or multipliers[at] == 0.0:
                continue
            column = own[COLUMN] + k // each * width
            entry = own[ENTRY] + (k // each * m + k % each % m) * width
            share = 0.0  # of the force of the row in the gradients
            for d in range(width):
                size = sizes[coordinates[columns[column + d]]]
                if size > 0.0:
                    share = max(share, abs(entries[entry + d]) / size)
            limit = upper[at] if multipliers[at] > 0.0 else lower[at]
            slack = max(abs(constraints[at] - limit), unpaid(terms, t, k, constraints))
            slack = slack if math.isfinite(limit) else unit
            share = min(share / unit, 1.0 / worth) if share > 0.0 else 1.0 / worth
            result = max(result, abs(multipliers[at]) * slack * share)
    return result


@compiled
def kkt_numbers(
    terms: TermArrays,
    free: IntArray,
    coordinates: IntArray,
    sizes: Array,
    violation_unit: float,
    enough: float,
    slope: Array,
    diagonal: IntArray,
    hessian: Array,
    residual: Array,
    jacobian: Array,
    constraints: Array,
    entries: Array,
    multipliers: Array,
    gradient: Array,
    found: Array,
) -> None:
    """Write the KKT numbers, the worst row, whether everything is finite, and the least size.

    Args:
        terms: of the program.
        free: columns that are unknown.
        coordinates: (width,) number of the coordinate that each column belongs to.
        sizes: (coordinates,) memory.
        violation_unit: of the rows in the mean; 0 where nothing tells it.
        enough: where absolute numbers are below, relative ones are not looked for.
        slope: (width,) gradient of the objective.
        diagonal: places of the curvatures of the unknowns in the next.
        hessian: entries of that of Gauss-Newton.
        residual: (C,) of its squares.
        jacobian: entries of theirs.
        constraints: (M,) values.
        entries: of the constraint Jacobian.
        multipliers: (M,).
        gradient: (width,) memory, for the gradient of the Lagrangian.
        found: (6,) result.
    """
    stationarity, violation, complementarity = 0.0, 0.0, 0.0
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
        outside = max(max(value - upper[row], lower[row] - value), 0.0)
        if worst < 0 or outside > violation:
            worst, violation = row, outside
        if lower[row] != upper[row]:
            limit = upper[row] if multiplier > 0.0 else lower[row]
            slack = abs(value - limit) if math.isfinite(limit) else 1.0
            complementarity = max(complementarity, abs(multiplier) * slack)
    for t in range(len(terms.fields)):
        if terms.fields[t, SLACKS] != 0:
            for k in range(terms.fields[t, COUNT] * terms.fields[t, ROWS]):
                force = abs(multipliers[terms.fields[t, ROW] + k])
                complementarity = max(complementarity, force * unpaid(terms, t, k, constraints))
    size, force = cost_size(diagonal, hessian, slope), mean_force(terms, multipliers, np.ones(count))
    scale, worth = max(size, force), max(worth_of_costs(size, diagonal, free, hessian, slope), force)
    stationarity, complementarity, least = stationarity / scale, complementarity / worth, scale
    if not max(stationarity, complementarity) <= enough and finite:
        find_sizes(terms, coordinates, residual, jacobian, multipliers, entries, sizes)
        least, relative = math.inf, 0.0
        for k in range(len(free)):
            size, force = sizes[coordinates[free[k]]], abs(gradient[free[k]])
            least = min(least, size)
            if force > 0.0:
                relative = max(relative, force / size if size > 0.0 else math.inf)
        stationarity, least = min(stationarity, relative), max(least, scale)
        shares = coordinates, sizes, violation_unit, worth
        complementarity = _complementarity(terms, shares, constraints, entries, multipliers)
    found[0], found[1], found[2] = stationarity, violation, complementarity
    found[3], found[4], found[5] = worst, finite, least


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
