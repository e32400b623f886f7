"""The size of multipliers in units of the problem's own: what tells that constraints have lost their slope.

Where the gradients of active constraints vanish or become dependent, as of exp(x) = 0 or x^3 = 0, no multipliers
balance the cost, and a solve ends where large ones seem to: the KKT numbers hold, divided by the mean multiplier, at a
point that need not be an optimum. How large is a question of units. With the largest gradients of all rows and of the
cost that were seen on the way, unknowns, rows and cost are brought to one scale by taking square roots of the largest
entries out of both, again and again (Ruiz, RAL-TR-2001-034). The sum of the multipliers of that problem is the same for
any units, of the order of the number of active rows where all is well, and beyond `LARGEST` what no chain of rows
explains. Between `LARGE` and that it depends on the violation that is left: times its multiplier it is what the cost
would lose if the row were met exactly. Newton steps leave next to none where a row has a slope.

A solve that stalls may do so at an optimum, with multipliers that its last linear system made of nothing. There they
are estimated again, from the gradients alone.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.codegen.loops import largest
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.table import COST, COUNT, ENTRY, KIND, ROW, ROWS, WIDTH, TermArrays
from unifg.problem.units import cost_size
from unifg.typing import Array, BoolArray, IntArray

LARGEST = 1e6  # the least of it: costates of a long chain add up to the square of its rows
LARGE = 1e3  # of a single row
LEFT = 1e-3  # of the cost, times the violation that is left
SUSPICIOUS = 1e3  # in the graph's own units; below it nobody looks
PASSES = 12
DENSE = 1_000_000  # entries of A up to which multipliers are estimated, by dense algebra


class Slopes:
    """Largest slopes of constraints and cost along a solve.

    Attributes:
        jacobian: magnitudes of the entries of A.
        gradient: magnitudes over the full tangent space.
    """

    def __init__(self, program: CompiledProblem, jacobian: Array, gradient: Array) -> None:
        """Begin with those at the start, which are copied."""
        self._program = program
        self.jacobian, self.gradient = jacobian.copy(), gradient.copy()

    def see(self, jacobian: Array, gradient: Array) -> None:
        """Take note of another point."""
        raise_slopes(jacobian, gradient, self.jacobian, self.gradient)

    def excess(self, lin: Linearization, multipliers: Array, tolerance: float) -> float:
        """Sum of the multipliers where they are larger than constraints with a slope ever need; zero elsewhere.

        Args:
            lin: at the answer.
            multipliers: (M,).
            tolerance: of the KKT test; a cost whose gradient never exceeded it has no scale.
        """
        program, free = self._program, self._program.columns.free
        if not size_of(program.arrays, multipliers, self.jacobian, self.gradient, free, tolerance) > SUSPICIOUS:
            return 0.0
        gradient = np.abs(self.gradient[free])
        rows, columns = program.constraints.free_rows, program.constraints.free_columns
        entries = np.abs(self.jacobian[program.constraints.free])
        unknowns, steepest = np.ones(program.size), np.zeros(len(multipliers))
        np.maximum.at(steepest, rows, entries)
        scale = 1.0 / np.where(steepest > 0.0, steepest, 1.0)  # the same begin in any unit
        cost = 1.0 / (float(gradient.max(initial=0.0)) or 1.0)
        for _ in range(PASSES):
            scaled = entries * scale[rows] * unknowns[columns]
            sloped = cost * gradient * unknowns
            of_rows, of_unknowns, of_cost = np.zeros(len(scale)), sloped.copy(), float(sloped.max(initial=0.0))
            np.maximum.at(of_rows, rows, scaled)
            np.maximum.at(of_unknowns, columns, scaled)
            scale /= np.sqrt(np.where(of_rows > 0.0, of_rows, 1.0))
            unknowns /= np.sqrt(np.where(of_unknowns > 0.0, of_unknowns, 1.0))
            cost /= np.sqrt(of_cost or 1.0)
        sizes = cost * np.abs(multipliers) / scale
        left = np.abs(multipliers * program.violation(lin.constraints))[sizes > LARGE].sum()
        total = float(sizes.sum())
        return total if total > max(LARGEST, len(sizes) ** 2) or left > LEFT * abs(lin.cost) else 0.0


def estimated(program: CompiledProblem, lin: Linearization, tolerance: float) -> Array | None:
    """(M,) multipliers of active rows that balance the gradient best, with their signs; None for a large graph.

    The least squares problem min |grad f + A' lambda| with bounds (Stark and Parker, Comput. Stat. 10, 1995).

    Args:
        program: the compiled graph.
        lin: where.
        tolerance: distance from its limit at which an inequality is active.
    """
    from scipy.optimize import lsq_linear  # slow to load

    at_lower, at_upper = (np.abs(lin.constraints - limit) <= tolerance for limit in (program.lower, program.upper))
    active = np.flatnonzero(program.equality | at_lower | at_upper)
    if not len(active) or len(active) * program.size > DENSE:
        return None
    slopes = program.constraints.matrix(lin.constraint_jacobian)[active].toarray()
    free, either = lin.gradient[program.columns.free], program.equality | (at_lower & at_upper)
    least, most = np.where(either | at_lower, -np.inf, 0.0)[active], np.where(either | at_upper, np.inf, 0.0)[active]
    multipliers = np.zeros(program.constraints.count)
    with np.errstate(all="ignore"):  # slopes far from the answer overflow, which the judge of these finds
        multipliers[active] = lsq_linear(slopes.T, -free, (least, most), method="bvls").x
    return multipliers


@compiled
def raise_slopes(jacobian: Array, gradient: Array, most: Array, steepest: Array) -> None:
    """Keep the numbers of larger magnitude; what is not finite does not count."""
    for k in range(len(jacobian)):
        if abs(most[k]) < abs(jacobian[k]) < np.inf:
            most[k] = jacobian[k]
    for k in range(len(gradient)):
        if abs(steepest[k]) < abs(gradient[k]) < np.inf:
            steepest[k] = gradient[k]


@compiled
def size_of(
    terms: TermArrays, multipliers: Array, jacobian: Array, gradient: Array, free: IntArray, tolerance: float
) -> float:
    """Sum of the multipliers, each times the largest slope of its row, over the largest slope of the cost."""
    fields, total, steepest = terms.fields, 0.0, tolerance
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] == COST:
            continue
        width, entry, row = term[WIDTH], term[ENTRY], term[ROW]
        for k in range(term[COUNT] * term[ROWS]):
            slope = largest(jacobian, entry + k * width, entry + (k + 1) * width)
            total += abs(multipliers[row + k]) * slope
    for k in free:
        steepest = max(steepest, abs(gradient[k]))
    return total / steepest


@compiled
def weakest(
    constraints: Array,
    lower: Array,
    upper: Array,
    multipliers: Array,
    counted: BoolArray,
    equality: BoolArray,
    forces: Array,
    out: BoolArray,
    unit: float,
) -> tuple[int, float, float]:
    """Inequality that is closest to being active or not, by the larger of its two numbers.

    Args:
        constraints: (M,) rows.
        lower: limits.
        upper: limits.
        multipliers: (M,).
        counted: rows with an unknown.
        equality: rows that are equalities.
        forces: receives the multipliers of rows that are held.
        out: ends with the rows that are not.
        unit: size of the costs, or one.

    Returns:
        Its row, -1 without one; its distance from the nearer limit; its multiplier, scaled as the KKT test does.
    """
    total, first = 0.0, len(out) - len(multipliers)
    for multiplier in multipliers:
        total += abs(multiplier)
    scale = max(unit, total / 100.0 / max(len(multipliers), 1))
    row, least, slack = -1, np.inf, 0.0
    hold(constraints, lower, upper, multipliers, unit, out[first:])
    for k in range(len(multipliers)):
        held = counted[k] and (equality[k] or out[first + k])
        out[first + k], forces[k] = not held, multipliers[k] if held else 0.0
        if counted[k] and not equality[k]:
            own = min(abs(constraints[k] - lower[k]), abs(constraints[k] - upper[k]))
            if max(own, abs(multipliers[k]) / scale) < least:
                row, least, slack = k, max(own, abs(multipliers[k]) / scale), own
    return row, slack, abs(multipliers[row]) / scale if row >= 0 else 0.0


def size_of_costs(program: CompiledProblem, lin: Linearization) -> float:
    """Size of the costs at a point: :func:`unifg.problem.units.cost_size`."""
    return cost_size(program.normal.diagonal, lin.hessian, lin.gradient)


@compiled
def hold(constraints: Array, lower: Array, upper: Array, multipliers: Array, unit: float, held: BoolArray) -> None:
    """Write which inequalities are active: their multiplier, in ``unit``, outweighs the distance to its limit."""
    for k in range(len(held)):
        limit = upper[k] if multipliers[k] > 0.0 else lower[k]
        held[k] = abs(multipliers[k]) > unit * abs(constraints[k] - limit)
