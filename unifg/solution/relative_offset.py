"""The convergence test of least squares: how far the residual is from being orthogonal to what steps can change.

With r the weighted, whitened residual, J its Jacobian and P the projection onto the columns of J, the relative offset
is |P r| / |r|: the cosine of the angle between the residual and its tangent space, between zero and one, whatever the
unit of the cost. Its square, g' H^-1 g / |r|^2 with g = J'r and H = J'J, is the share of the cost that a Gauss-Newton
step promises to remove (Bates and Watts, "A relative offset orthogonality convergence criterion for nonlinear least
squares", Technometrics 23(2), 1981). With robust losses r and J carry the square roots of the weights, so that g is
the true gradient and H is never indefinite.

Where residuals vanish at the solution, |P r| is compared with the rounding errors of r instead: those of numbers as
large as the variables, or as they were at the guess, seen through J.

Where H is singular, the curvature of the residuals may still determine every unknown: the solution of n equations that
cannot be met has a singular J. There the Hessian with that curvature takes the place of H, and what its Newton step
promises to remove is measured. Where it is singular too, the point is left a little along a free direction: it is
undetermined only if H stays singular there, which excludes a mere kink, and no minimum at all if the cost falls.

The offset is a share of the whole cost: beside a gross error, a part of the graph could be anywhere. A point that
passes is therefore tested once more, variable by variable. With d the Gauss-Newton step (Newton's where H is singular),
and over the factors f of one variable,

    sqrt(sum |J_f d|^2 / sum |r_f|^2)

must be within the same tolerance, or |J_f d| within the rounding of these residuals. A gradient alone would not show
the error of soft modes.

No matrix is factorised for a point that is far from stationary: the largest cosine between r and one column of J is a
lower bound. Near the end the factor of the last linearisation serves as preconditioner of a few conjugate-gradient
steps on H itself, whose energy bounds g' H^-1 g from below and is exact when the remainder vanishes. Only where that
factor is too old does H get a new one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from unifg.codegen.inner import inner
from unifg.codegen.jit import compiled
from unifg.elimination.factorization import WEAK, Factorization
from unifg.factors.steps import ANGLE, TURN
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.linearization import Linearization
from unifg.problem.table import COLUMN, COST, COUNT, ENTRY, KIND, ROW, ROWS, WIDTH, TermArrays
from unifg.typing import Array, BoolArray, IntArray

EPS = 2.0**-52
LARGEST = 1e308
ROUNDING = 4.0  # roundings in a residual, each of a number as large as the variables
FLAT = 1e-6  # the same of a Hessian whose second derivatives are differences
STEPS = 4  # conjugate-gradient steps before a new factor is cheaper
MANY_STEPS = 40  # the same where there is no better factor
SAME = 1e-4  # remainder, relative to the energy, at which an old factor is as good as a new one
SINGULAR_SHIFT = 1e-9  # of the diagonal: makes a singular Hessian a preconditioner
ASIDE = 1e-3  # of the largest number: a look beside a point with a singular Hessian
LESS = 1e-9  # of the cost: a fall that rounding and curved coordinates do not explain
DAMPED = 1e2  # a direction this many times stiffer than the damping is seen through it


class Factored(Protocol):
    """Factorisation of a matrix near the Hessian, lent by a backend.

    Attributes:
        solver: the factorisation.
        damping: what was added to the diagonal, relative to it.
    """

    @property
    def solver(self) -> Factorization: ...  # noqa: D102

    damping: float


@dataclass(frozen=True)
class Offset:
    """Result of the test at one point.

    Attributes:
        value: |P r| / |r|, zero where |P r| is rounding; above ``enough`` it may be a lower bound. Where that passes
            and the test of single variables does not, a ratio of one that fails; infinite at a maximum or saddle.
        determined: whether the costs determine every unknown.
        finite: whether everything could be evaluated.
        weakest: smallest pivot of the Hessian relative to its diagonal; 1 where nobody looked.
    """

    value: float
    determined: bool
    finite: bool
    weakest: float = 1.0


def relative_offset(
    program: CompiledProblem,
    lin: Linearization,
    enough: float = 0.0,
    lent: Factored | None = None,
    guess: Array | None = None,
) -> Offset:
    """Measure |P r| / |r| at a linearised point.

    Args:
        program: a compiled graph without constraints and scalar costs.
        lin: linearisation at the point.
        enough: the tolerance: a value above this need not be exact, and one below is tested at every variable. Zero
            for the exact value, without that test.
        lent: factorisation of a backend that may be reused, and overwritten.
        guess: stored values that the solve began with; unknowns that have shrunk since count as large as they were.
    """
    return program.once(Structure).measure(program, lin, enough, lent, guess)


class Structure:
    """Constants of one graph, the same at all points.

    Attributes:
        counted: (C,) rows that touch an unknown; empty when all do. Costs between fixed variables are constants.
        first, last: (n,) storage whose largest number is the size of each unknown coordinate.
        least: (n,) its size at least: one radian for angles.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Look at the terms and at the manifolds."""
        self.counted = _counted(program)
        self.variable = program.columns.nodes()[0]
        self.first, self.last, self.least = _extents(program)

    def measure(
        self, program: CompiledProblem, lin: Linearization, enough: float, lent: Factored | None, guess: Array | None
    ) -> Offset:
        """See :func:`relative_offset`."""
        values = lin.values.flat
        sizes = np.empty(program.size)
        size, cosine, rounding = _bounds(
            lin.residual,
            self.counted,
            lin.gradient,
            program.columns.free,
            lin.hessian,
            program.normal.diagonal,
            self.first,
            self.last,
            self.least,
            values,
            values if guess is None else guess,
            sizes,
        )
        if math.isnan(cosine):
            return Offset(np.inf, True, False)
        floor = ROUNDING * EPS * rounding + (EPS * EPS * math.sqrt(program.size) / size if size else 0.0)
        limit = max(enough, floor)
        if enough > 0.0 and cosine > limit:
            return Offset(cosine, True, True)
        local = Local(program, lin, self.variable, sizes, enough, (floor * size) ** 2)
        with program.systems.borrowed() as own:
            bound = (limit * size) ** 2 if enough > 0.0 else np.inf
            energy, determined = _energy(program, lin, bound, lent, own, local)
            used = own if lent is None else lent.solver
            weakest = 1.0
            if determined and (lent is None or lent.damping == 0.0) and used.definite:
                weakest = used.weakest(lin.hessian[program.normal.diagonal])
        value = math.sqrt(energy) / size if size else 0.0
        value = 0.0 if value <= floor else value
        return Offset(max(value, local.worst) if value <= enough else value, determined, True, weakest)


class Local:
    """The test of single variables at one point.

    Attributes:
        worst: largest ratio of a variable that does not pass; zero where all do.
        sizes, noise: see :meth:`__init__`.
    """

    def __init__(
        self,
        program: CompiledProblem,
        lin: Linearization,
        variable: IntArray,
        sizes: Array,
        enough: float,
        noise: float,
    ) -> None:
        """Nothing is computed until there is a step.

        Args:
            program: the compiled graph.
            lin: linearisation at the point.
            variable: (width,) the variable of every tangent coordinate.
            sizes: (n,) how large the numbers are, or were at the guess, that each unknown stands for.
            enough: the tolerance; zero for no test.
            noise: square of the rounding errors of r.
        """
        self._program, self._lin, self._variable, self.sizes, self._enough = program, lin, variable, sizes, enough
        self.noise = noise
        self.worst = 0.0

    def settled(self, step: Array, missing: Array | None = None) -> bool:
        """Test a step, and return whether the result is certain.

        Args:
            step: (n,) Gauss-Newton step, whatever its sign.
            missing: (n,) what it may lack; None for nothing.
        """
        if self._enough == 0.0:
            return True
        program, lin, rest = self._program, self._lin, np.zeros(0) if missing is None else missing
        diagonal = lin.hessian[program.normal.diagonal]
        self.worst, certain = _largest_ratio(
            program.arrays, self._variable, lin.residual, lin.jacobian, diagonal, self.sizes, step, rest, self._enough
        )
        return bool(certain)


def _energy(
    program: CompiledProblem, lin: Linearization, limit: float, lent: Factored | None, own: Factorization, local: Local
) -> tuple[float, bool]:
    """Return g' H^-1 g, or a lower bound above ``limit``; and whether H is regular.

    Args:
        program: the compiled graph.
        lin: linearisation at the point.
        limit: a bound above this is enough.
        lent: factorisation of a backend.
        own: to factorise with where that does not do.
        local: tests the step at every variable, unless the bound is above ``limit``.
    """
    gradient = lin.gradient[program.columns.free]
    diagonal = lin.hessian[program.normal.diagonal]
    if lent is not None and lent.solver.definite:
        energy, exact = _climb(program, lin.hessian, gradient, lent.solver, limit, local)
        if energy > limit:
            return energy, True
        # A loss may have taken away since then what held a variable.
        if exact and not program.table.robust and _regular(program, lin.hessian, diagonal, lent):
            return energy, True
    solver = own if lent is None else lent.solver
    if lent is not None:
        lent.damping = 0.0
    if solver.factor(lin.hessian) and solver.weakest(diagonal) > WEAK:
        return _promised(solver, gradient, local), True
    idle = _idle(program, diagonal)
    if idle.any():  # what no active factor touches is not asked for
        added = np.where(idle, 1.0, 0.0)
        if solver.factor(lin.hessian, added) and solver.weakest(diagonal + added) > WEAK:
            return _promised(solver, gradient, local), True
    if not len(diagonal):
        return 0.0, False
    unit = np.maximum(diagonal, 1e-9 * (diagonal.max() or 1.0))
    if not solver.factor(lin.hessian, SINGULAR_SHIFT * unit):
        return np.inf, False
    energy, _ = _climb(program, lin.hessian, gradient, solver, limit, local, MANY_STEPS)
    free = _free_direction(solver, unit)
    bent = _bent(program, lin, own)
    if bent is not None:
        return _promised(bent, gradient, local), True
    return _beside(program, lin, own, free, local, energy) if energy <= limit else (energy, False)


def _free_direction(solver: Factorization, unit: Array) -> Array:
    """(n,) a direction that the costs hardly see, by inverse iteration in units of curvature; largest entry 1."""
    vector = np.random.default_rng(0).standard_normal(len(unit)) / np.sqrt(unit)
    for _ in range(3):
        vector = solver.solve(unit * vector)
        vector /= np.abs(vector).max()
    return vector


def _beside(
    program: CompiledProblem, lin: Linearization, solver: Factorization, free: Array, local: Local, energy: float
) -> tuple[float, bool]:
    """Energy, infinite at a maximum or saddle, and whether the Hessian is regular a little further along ``free``."""
    step = ASIDE * (local.sizes[np.abs(free) > 0.1].max() or 1.0) * free
    sides = [program.linearize(program.retract(lin.values, sign * step)) for sign in (1.0, -1.0)]
    for side in sides:
        change = side.residual - lin.residual
        before = lin.residual[change != 0.0]  # however large the others are
        if inner(change, side.residual + lin.residual) < -max(LESS * inner(before, before), local.noise):
            return np.inf, True
    entries = sides[0].hessian
    regular = solver.factor(entries) and solver.weakest(entries[program.normal.diagonal]) > WEAK
    return energy, regular


def _promised(solver: Factorization, gradient: Array, local: Local) -> float:
    """Energy of the step of a factorised Hessian, which is tested."""
    step = solver.solve(gradient)
    local.settled(step)
    return inner(gradient, step)


def _bent(program: CompiledProblem, lin: Linearization, solver: Factorization) -> Factorization | None:
    """The Hessian with the curvature of the residuals, factorised; None where that is singular or indefinite."""
    hessian = lagrangian_hessian(program, lin, np.zeros(0))
    diagonal = hessian[program.normal.diagonal]
    regular = bool((diagonal > 0.0).all()) and solver.factor(hessian)
    return solver if regular and solver.weakest(diagonal) > FLAT else None


def _regular(program: CompiledProblem, hessian: Array, diagonal: Array, lent: Factored) -> bool:
    """Test whether a factor near the Hessian shows that every direction is determined."""
    if not (lent.solver.weakest(diagonal) > WEAK and diagonal.all()):
        return False
    if lent.damping == 0.0:
        return True
    # Inverse iteration: a direction without information would dominate after two solves through the damping.
    vector = np.random.default_rng(1).choice([-1.0, 1.0], program.size) / np.sqrt(diagonal)
    for _ in range(2):
        vector = lent.solver.solve(diagonal * vector)
        vector /= math.sqrt(inner(diagonal, np.square(vector)))
    return inner(vector, program.normal.times(hessian, vector)) > DAMPED * lent.damping


def _climb(
    program: CompiledProblem,
    hessian: Array,
    gradient: Array,
    solver: Factorization,
    limit: float,
    local: Local,
    steps: int = STEPS,
) -> tuple[float, bool]:
    """Energy of conjugate gradients on H x = g, preconditioned by a factor; and whether nothing is missing from it."""
    energy, rest, x = 0.0, gradient.copy(), np.zeros(len(gradient))
    z = solver.solve(rest)
    product = inner(rest, z)
    direction = z
    for _ in range(steps):
        if not product > 0.0:
            local.settled(x)
            return energy, product == 0.0
        curved = program.normal.times(hessian, direction)
        curvature = inner(direction, curved)
        if not curvature > 0.0:
            return energy, False
        length = product / curvature
        energy += length * product
        if energy > limit:
            return energy, False
        rest -= length * curved
        x += length * direction
        z = solver.solve(rest)
        before, product = product, inner(rest, z)
        if product <= SAME * energy and local.settled(x, z):
            return energy + max(product, 0.0), True
        direction = z + product / before * direction
    return energy, False


def _counted(program: CompiledProblem) -> BoolArray:
    """(C,) rows that touch an unknown, or nothing when all do."""
    if program.size == program.columns.width:
        return np.zeros(0, dtype=bool)
    rows = [np.zeros(0, dtype=bool)]
    for term in program.cost_terms:
        touching = np.zeros(term.count, dtype=bool)
        for columns in term.columns:
            touching |= (program.columns.unknown[columns] >= 0).any(axis=1)
        rows.append(np.repeat(touching, term.size))
    counted: BoolArray = np.concatenate(rows)
    return counted[:0] if counted.all() else counted


def _idle(program: CompiledProblem, diagonal: Array) -> BoolArray:
    """(n,) unknowns without information because every factor that could give some is switched off."""
    bare: BoolArray = diagonal == 0.0
    if not bare.any():
        return bare
    touched = np.zeros(program.columns.width, dtype=bool)
    for term in program.cost_terms:
        on = np.ones(term.count, dtype=bool) if term.active is None else term.active
        for columns in term.columns:
            touched[columns[on]] = True
    return bare & ~touched[program.columns.free]


def _extents(program: CompiledProblem) -> tuple[IntArray, IntArray, Array]:
    """Positions of numbers that give the scale of each unknown; none for angles, which have a least size."""
    first, last, kinds = (place[program.columns.free] for place in program.columns.extents)
    angles = (kinds == ANGLE) | (kinds == TURN)
    return np.where(angles, 0, first), np.where(angles, 0, last), angles.astype(np.float64)


@compiled
def _bounds(
    residual: Array,
    counted: BoolArray,
    gradient: Array,
    free: IntArray,
    hessian: Array,
    diagonal: IntArray,
    first: IntArray,
    last: IntArray,
    least: Array,
    values: Array,
    guess: Array,
    sizes: Array,
) -> tuple[float, float, float]:
    """|r|; the largest |g_k| / sqrt(H_kk) and the norm of sqrt(H_kk) times the size of coordinate k, both over |r|.

    The second is not a number when some derivative is not finite. Sizes are written to ``sizes``.
    """
    squares = cosine = rounding = 0.0
    if len(counted):
        for row in range(len(residual)):
            if counted[row]:
                squares += residual[row] * residual[row]
    else:
        for row in range(len(residual)):
            squares += residual[row] * residual[row]
    norm = math.sqrt(min(squares, LARGEST))
    for k in range(len(free)):
        slope, information, sizes[k] = gradient[free[k]], hessian[diagonal[k]], least[k]
        if not math.isfinite(slope) or not math.isfinite(information):
            return norm, math.nan, math.nan
        root = math.sqrt(information)
        for at in range(first[k], last[k]):
            sizes[k] = max(sizes[k], abs(values[at]), abs(guess[at]))
        if norm > 0.0:
            rounding += (root * sizes[k] / norm) ** 2
            if root > 0.0:
                cosine = max(cosine, abs(slope) / root / norm)
    return norm, cosine, math.sqrt(rounding)


@compiled
def _largest_ratio(
    terms: TermArrays,
    variable: IntArray,
    residual: Array,
    jacobian: Array,
    diagonal: Array,
    sizes: Array,
    step: Array,
    missing: Array,
    enough: float,
) -> tuple[float, bool]:
    """Largest sqrt(sum |J_f d|^2 / sum |r_f|^2) of variables that do not pass; and whether that is certain.

    The rounding of a factor is that of its residual, and of steps in its variables whose gradients are rounded as the
    residuals are that they are made of.
    """
    fields, columns, unknown = terms.fields, terms.columns, terms.unknown
    count, kept = variable[-1] + 1, len(missing)
    squares, moved, left, floor = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
    worst, certain = 0.0, True
    for rounding in range(2):  # which is looked at only where something does not pass without
        for t in range(len(fields)):
            term = fields[t]
            if term[KIND] != COST:
                continue
            m, width, row, entry, column = term[ROWS], term[WIDTH], term[ROW], term[ENTRY], term[COLUMN]
            for _ in range(term[COUNT]):
                square = change = lacking = rounded = 0.0
                for a in range(m):
                    along = short = 0.0
                    for d in range(width):
                        slope, k = jacobian[entry + a * width + d], unknown[columns[column + d]]
                        if k < 0 or slope == 0.0:
                            continue
                        if rounding:
                            gradient = squares[variable[columns[column + d]]] / diagonal[k]
                            rounded += slope * slope * (sizes[k] * sizes[k] + gradient)
                        along += slope * step[k]
                        if kept:
                            short += slope * missing[k]
                    square += residual[row + a] * residual[row + a]
                    change += along * along
                    lacking += short * short
                before = -1
                for d in range(width):
                    own = variable[columns[column + d]]
                    if own == before or unknown[columns[column + d]] < 0:
                        continue
                    before = own
                    if rounding:
                        floor[own] += rounded
                    else:
                        squares[own] += square
                        moved[own] += change
                        left[own] += lacking
                row, entry, column = row + m, entry + m * width, column + width
        worst, certain = 0.0, True
        for own in range(count):
            change, lacking = math.sqrt(moved[own]), math.sqrt(left[own])
            limit = max(enough * math.sqrt(squares[own]), ROUNDING * EPS * math.sqrt(floor[own]))
            if change > limit:
                worst = max(worst, change / math.sqrt(max(squares[own], moved[own])))
            if rounding and change - lacking > limit:
                return worst, True  # one is enough
            certain = certain and change + lacking <= limit
        if certain:
            break
    return worst, certain
