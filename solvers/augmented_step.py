"""One step on the augmented objective: its model is minimised, and a step that does not lower it is damped.

With residuals and constraints linearised, the augmented objective is convex and piecewise quadratic: a row of an
inequality joins or leaves as the step grows. Newton steps that update the active rows, with a line search, find
its minimum in a few factorisations and without any new evaluation of the problem. A single Gauss-Newton step
would freeze the active rows at the linearisation point and overshoot every limit it runs into.

Second derivatives of residuals and constraints may join the model. They make it Newton's, and no longer convex by
construction: a model that turns out not to be positive definite is refused.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.function_pointers import linked_to
from unifg.codegen.inner import inner
from unifg.codegen.jit import compiled
from unifg.codegen.loops import copy_to, dot
from unifg.elimination.fronts import factor
from unifg.elimination.plan import NEGATIVE
from unifg.elimination.substitution import solve
from unifg.elimination.symmetric import add_times
from unifg.problem.columns import Values
from unifg.problem.evaluation import add_constraints, times, transposed_times
from unifg.problem.linearization import Linearization
from unifg.solvers.augmented_objective import DIAGONAL_FLOOR, Primal, arrays, barrier, held, update
from unifg.solvers.globalize.damping import LARGEST, SUFFICIENT, Damping, gain
from unifg.typing import Array, IntArray

NEWTON_STEPS = 12
SHORTEST = 1e-3
ARMIJO = 0.1
ROUNDING = 1e-14
LEAST_SHARE = 0.125  # of the second derivatives, before they are left out
WELL = 0.75  # of the predicted decrease: a step that brings less is corrected
CORRECTIONS = 3  # at most, of one trial
FAITHFUL = 1e-2  # error of the predicted decrease, up to which a step may go any way
CAUTIOUS = 1e3  # damping that makes any step short enough
HARDLY_DAMPED = 1.0  # up to which a cost that is no square is damped before its second derivatives are left out
STRAIGHT: Array = np.zeros(0)


def damped_step(
    primal: Primal,
    lin: Linearization,
    multipliers: Array,
    penalty: Array,
    damping: Damping,
    bend: Array = STRAIGHT,
    reach: Array = STRAIGHT,
) -> tuple[Values, Array, int] | None:
    """One accepted step on the augmented objective.

    A step of length d along curved constraints leaves them by some d^2, which costs rho d^4: the larger rho, the
    shorter the steps that damping allows. So where second derivatives are in the model, a trial that brings much less
    than predicted is followed by second-order corrections (Nocedal and Wright, section 18.3): the same model, with the
    values of the constraints found there.

    Args:
        primal: the augmented objective and its factorisation.
        lin: where.
        multipliers: (M,) of the augmented objective.
        penalty: (M,) rho of every row.
        damping: what it begins with, and what it learns.
        bend: (nnz,) second derivatives for the model; a share of them, or none, where they leave it indefinite.
        reach: (n,) beyond which a step is damped more, unless its model is faithful; empty for no limit.

    Returns:
        The new values, the tangent step and the number of rejected trials; None when no damping helps.
    """
    merit, scalars = primal.merit(lin, multipliers, penalty), primal.program.scalar_part(lin.values)
    # Least squares has no unit: what is rounding depends on the cost alone.
    slack = ROUNDING * (merit if primal.program.least_squares else max(1.0, abs(merit)))
    rows = primal.program.constraints
    rejected, rounded = 0, False
    damping.share = share = min(4.0 * damping.share, 1.0)
    while damping.value <= LARGEST:
        curved = len(bend) > 0 and share > 0.0
        chosen = (bend if share == 1.0 else share * bend) if curved else STRAIGHT
        found = model_step(primal, lin, multipliers, penalty, damping.value, chosen, scalars)
        # Where a cost is no square, second derivatives may be all the curvature there is: damped rather than left out.
        if found is None and curved and not (len(scalars[0]) and damping.value < HARDLY_DAMPED):
            damping.share = max(0.5 * share, LEAST_SHARE)
            share = 0.5 * share if share > LEAST_SHARE else 0.0
            continue
        if found is not None:
            step, predicted = found
            values, evaluation = primal.trial(lin, step)
            actual = merit - primal.merit(evaluation, multipliers, penalty)
            if not rounded and not actual >= SUFFICIENT * predicted - slack:
                slack, rounded = max(slack, primal.rounding(lin, multipliers, penalty)), True
            base = lin.constraints
            for _ in range(CORRECTIONS if len(bend) > 0 else 0):
                if not evaluation.finite or actual >= WELL * predicted - slack:
                    break
                # What the rows are at the trial, continued along their tangents back to no step.
                curved_base = evaluation.constraints - rows.times(lin.constraint_jacobian, step)
                again = model_step(primal, lin, multipliers, penalty, damping.value, chosen, scalars, curved_base)
                if again is None:
                    break
                moved, there = primal.trial(lin, again[0])
                better = merit - primal.merit(there, multipliers, penalty)
                if not (there.finite and better > actual):
                    break
                base, step, values, evaluation, actual = curved_base, again[0], moved, there, better
            gained = gain(actual, predicted, slack) if evaluation.finite else None
            beyond = len(reach) > 0 and damping.value < CAUTIOUS and bool((np.abs(step) > reach).any())
            if gained is not None and not (beyond and abs(gained - 1.0) > FAITHFUL):
                damping.accept(min(gained, 1.0))
                damping.base = base
                return values, step, rejected
        rejected += 1
        damping.reject()
    damping.value = LARGEST
    return None


def model_step(
    primal: Primal,
    lin: Linearization,
    multipliers: Array,
    penalty: Array,
    damping: float,
    bend: Array = STRAIGHT,
    scalars: tuple[Array, Array] = (STRAIGHT, STRAIGHT),
    constraints: Array | None = None,
) -> tuple[Array, float] | None:
    """Minimise the damped model.

    Args:
        primal: the augmented objective and its factorisation.
        lin: where the model is built.
        multipliers: (M,) of the augmented objective.
        penalty: (M,) rho of every row.
        damping: relative to the diagonal of the Hessian at ``lin``.
        bend: (nnz,) second-order terms, in the order of ``CompiledProblem.normal``; empty for none.
        scalars: of :meth:`CompiledProblem.scalar_part`.
        constraints: (M,) their values in the model where the step is zero; None takes those at ``lin``.

    Returns:
        The tangent step and the decrease the model predicts; None when a system cannot be factorised, or the second
        derivatives leave it indefinite.
    """
    primal.damping = damping
    if len(primal.curvatures):
        return _damped(primal, lin, damping)
    step = np.zeros(primal.program.size)
    predicted = minimize(
        primal.address,
        lin.residual,
        lin.jacobian,
        lin.constraints if constraints is None else constraints,
        lin.constraint_jacobian,
        lin.hessian,
        bend,
        *scalars,
        multipliers,
        penalty,
        damping,
        step,
    )
    primal.solver.adopt(not np.isnan(predicted))
    return None if np.isnan(predicted) else (step, predicted)


def _damped(primal: Primal, lin: Linearization, damping: float) -> tuple[Array, float] | None:
    """The same of least squares alone, whose model is one linear system."""
    gradient, diagonal = lin.gradient[primal.program.columns.free], lin.hessian[primal.program.normal.diagonal]
    with np.errstate(divide="ignore"):
        primal.damping = damping * float((primal.curvatures / diagonal).max(initial=1.0))  # of the unknown seen least
    if not primal.solver.factor(lin.hessian, damping * primal.curvatures):
        return None
    step = -primal.solver.solve(gradient)
    predicted = -0.5 * inner(gradient, step)
    return (step, predicted) if np.isfinite(predicted) else None


@linked_to(arrays)
def minimize(
    where: int,
    start_residual: Array,
    jacobian: Array,
    start_constraints: Array,
    constraint_jacobian: Array,
    hessian: Array,
    bend: Array,
    tilt: Array,
    bowl: Array,
    multipliers: Array,
    penalty: Array,
    damping: float,
    step: Array,
) -> float:
    """Newton's method on the piecewise quadratic; returns the predicted decrease, NaN when a system is singular."""
    terms, plan, free, indptr, indices, equality = held(where)
    curved = len(bend) > 0
    # Beside squares: what second derivatives add, and costs that are no squares.
    beyond = curved or len(bowl) > 0
    quadratic = np.zeros_like(hessian)
    if curved:
        quadratic += bend
    if len(bowl) > 0:
        quadratic += bowl
    # From where the model begins: a large penalty would multiply the rounding of a small step added to a value of one.
    lower, upper = terms.lower - start_constraints, terms.upper - start_constraints
    residual, constraints = start_residual.copy(), start_constraints - start_constraints
    residual_here, constraints_here = np.empty_like(residual), np.empty_like(constraints)
    residual_move, constraint_move = np.empty_like(residual), np.empty_like(constraints)
    after, weights = np.empty_like(constraints), np.empty_like(constraints)
    full, gradient, move = np.empty(len(terms.unknown)), np.empty_like(step), np.empty_like(step)
    added, curvature, here = np.empty_like(step), np.empty_like(hessian), np.empty_like(step)
    bent, bent_move, bow, bow_here = np.zeros_like(step), np.zeros_like(step), 0.0, 0.0  # of the second derivatives
    update(constraints, lower, upper, multipliers, penalty, after)
    # Equalities are there in every step: what they add to the curvature is found once.
    settled = hessian.copy()
    if curved:
        settled += bend
    for row in range(len(weights)):
        weights[row] = penalty[row] if equality[row] else 0.0
    add_constraints(terms, constraint_jacobian, weights, settled)
    for row in range(len(weights)):
        weights[row] = penalty[row] if not equality[row] and after[row] != 0.0 else 0.0
    value = 0.5 * float(dot(residual, residual)) + barrier(constraints, lower, upper, multipliers, penalty)
    start = value
    for newton in range(NEWTON_STEPS):
        full[:] = 0.0
        transposed_times(terms, True, jacobian, residual, full)
        transposed_times(terms, False, constraint_jacobian, after, full)
        copy_to(settled, curvature)
        add_constraints(terms, constraint_jacobian, weights, curvature)
        if newton == 0:
            _damping(curvature, indptr, tilt, damping, added)
        for k in range(len(step)):
            gradient[k] = -full[free[k]] - added[k] * step[k] - bent[k]
            if len(tilt) > 0:
                gradient[k] -= tilt[k]
        if not factor(plan, curvature, added) or (curved and plan.state[NEGATIVE] > 0):
            return np.nan
        solve(plan, gradient, move)
        times(terms, True, jacobian, move, residual_move)
        times(terms, False, constraint_jacobian, move, constraint_move)
        slope, length = -dot(gradient, move), 1.0
        if not np.isfinite(slope):
            return np.nan
        if beyond:
            bent_move[:] = 0.0
            add_times(indptr, indices, quadratic, move, bent_move)
        while True:
            for k in range(len(step)):
                here[k] = step[k] + length * move[k]
            for row in range(len(residual)):
                residual_here[row] = residual[row] + length * residual_move[row]
            for row in range(len(constraints)):
                constraints_here[row] = constraints[row] + length * constraint_move[row]
            value_here = 0.5 * float(dot(residual_here, residual_here))
            value_here += barrier(constraints_here, lower, upper, multipliers, penalty)
            for k in range(len(step)):
                value_here += 0.5 * added[k] * here[k] * here[k]
            if len(tilt) > 0:
                value_here += dot(tilt, here)
            if beyond:
                bow_here = bow + length * (dot(bent, move) + 0.5 * length * dot(bent_move, move))
                value_here += bow_here
            if value_here <= value + ARMIJO * length * slope + ROUNDING * abs(value) or length < SHORTEST:
                break
            length *= 0.5
        copy_to(here, step)
        copy_to(residual_here, residual)
        copy_to(constraints_here, constraints)
        value = value_here
        bent += length * bent_move
        bow = bow_here
        update(constraints, lower, upper, multipliers, penalty, after)
        same = True
        for row in range(len(weights)):
            weight = penalty[row] if not equality[row] and after[row] != 0.0 else 0.0
            same = same and weight == weights[row]
            weights[row] = weight
        if length == 1.0 and same:
            break
    return start - value


@compiled
def _damping(curvature: Array, indptr: IntArray, tilt: Array, damping: float, added: Array) -> None:
    """Marquardt's damping of the diagonal, which is last in every column; slopes count where nothing is curved."""
    largest, steepest = 0.0, 0.0
    for k in range(len(added)):
        largest = max(largest, curvature[indptr[k + 1] - 1])
    for slope in tilt:
        steepest = max(steepest, abs(slope))
    least = max(DIAGONAL_FLOOR * largest, steepest) + 1e-300
    for k in range(len(added)):
        added[k] = damping * max(curvature[indptr[k + 1] - 1], least)
