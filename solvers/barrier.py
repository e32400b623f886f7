"""Newton steps of a primal-dual interior point with elastic inequalities, as compiled functions.

Every finite limit of an inequality row is a *side* c(x) >= 0, with c = g - lower or upper - g. It is relaxed by an
elastic variable e with price rho, and both carry a logarithmic barrier:

    min  f(x) + sum rho e - mu log s - mu log e     s.t.  c(x) + e - s = 0,   h(x) = 0

For given c the best s and e are known in closed form, so a side contributes a smooth function of x and no constraint;
its multiplier y lies between 0 and rho and is iterated with the rest (primal-dual). Eliminating s, e and y leaves one
scalar per side,

    (H + J' D J) dx + A' lambda+ = -(grad f - J' y) - J' D r,    A dx = -h,    1/D = s/y + e/(rho - y),

and one factorisation of the KKT matrix per iteration. The filter line search, its constants and the second-order
correction follow Waechter and Biegler, Math. Program. 106 (2006), sections 2 and 3; the closed form of s and e makes
a restoration phase for inequalities unnecessary.
"""

from __future__ import annotations

import math

from unifg.elimination.fronts import factor
from unifg.elimination.plan import NEGATIVE
from unifg.elimination.substitution import solve
from unifg.jit import compiled
from unifg.passes import add_constraints, times, transposed_times
from unifg.solvers.barrier_state import (
    ACCEPTED,
    AGAIN,
    ALPHA,
    ALPHA_DUAL,
    COMPLEMENTARITY,
    CONVERGED,
    CORRECTED,
    COST,
    DELTA,
    EXACT,
    FAILURES,
    FILTER,
    FILTERED,
    GAUSS_NEWTON,
    ITERATION,
    LIMIT,
    LIMIT_REACHED,
    MU,
    NOT_FINITE,
    PHI,
    RHO,
    SINGULAR,
    SLOPE,
    STALLED,
    STATIONARITY,
    STEP,
    TAKEN,
    THETA,
    THETA_LARGE,
    THETA_SMALL,
    TOLERANCE,
    TRIALS,
    TRY,
    VIOLATION,
    Iterate,
    Work,
)
from unifg.solvers.kkt_system import KktArrays, fill
from unifg.table import Terms
from unifg.typing import Array

KAPPA = 10.0  # a barrier problem is solved when its error is below KAPPA mu
ARMIJO = 1e-4
GAMMA = 1e-5
HALVINGS = 25
MOST_FAILURES = 8
FIRST_SHIFT, LARGEST_SHIFT, SHIFT_GROWTH = 1e-4, 1e12, 8.0
DUAL_SHIFT = 1e-9


@compiled
def slacks(c: float, mu: float, rho: float) -> tuple[float, float]:
    """The s and e with s - e = c that minimise rho e - mu log s - mu log e, without cancellation."""
    root = math.sqrt(4.0 * mu * mu + rho * rho * c * c)
    large = (2.0 * mu + rho * abs(c) + root) / (2.0 * rho)
    small = (2.0 * mu + 4.0 * mu * mu / (root + rho * abs(c))) / (2.0 * rho)
    return (large, small) if c >= 0.0 else (small, large)


@compiled
def barrier_value(work: Work, cost: float, constraints: Array) -> float:
    """The barrier function phi at constraint values, with the best slacks."""
    mu, rho = work.numbers[MU], work.numbers[RHO]
    total = cost
    for k in range(len(work.y)):
        c = work.side_sign[k] * (constraints[work.side_row[k]] - work.side_limit[k])
        s, e = slacks(c, mu, rho)
        total += rho * e - mu * (math.log(s) + math.log(e))
    return total


@compiled
def infeasibility(kkt: KktArrays, lower: Array, constraints: Array) -> float:
    """Sum of |h| over the equality rows."""
    total = 0.0
    for row in kkt.rows:
        total += abs(constraints[row] - lower[row])
    return total


@compiled
def measure(terms: Terms, kkt: KktArrays, work: Work, at: Iterate) -> float:
    """KKT numbers of the problem, and the error of the barrier problem."""
    numbers, lower, upper = work.numbers, terms.lower, terms.upper
    mu, rho = numbers[MU], numbers[RHO]
    for k in range(len(work.y)):
        work.multipliers[work.side_row[k]] = 0.0
    for k in range(len(work.y)):
        work.multipliers[work.side_row[k]] -= work.side_sign[k] * work.y[k]
    work.full[:] = at.gradient
    transposed_times(terms, False, at.constraint_jacobian, work.multipliers, work.full)
    stationarity = violation = complementarity = size = barrier = 0.0
    for column in work.free:
        stationarity = max(stationarity, abs(work.full[column]))
    for row in range(len(at.constraints)):
        value, multiplier = at.constraints[row], work.multipliers[row]
        size += abs(multiplier)
        violation = max(violation, max(value - upper[row], lower[row] - value))
        if lower[row] != upper[row]:
            limit = upper[row] if multiplier > 0.0 else lower[row]
            slack = abs(value - limit) if math.isfinite(limit) else 1.0
            complementarity = max(complementarity, abs(multiplier) * slack)
    for k in range(len(work.y)):
        c = work.side_sign[k] * (at.constraints[work.side_row[k]] - work.side_limit[k])
        s, e = slacks(c, mu, rho)
        work.s[k], work.e[k] = s, e
        barrier = max(barrier, abs(work.y[k] * s - mu), abs((rho - work.y[k]) * e - mu))
    scale = max(1.0, size / max(1, len(at.constraints)) / 100.0)
    numbers[COST], numbers[STATIONARITY] = at.cost[0], stationarity / scale
    numbers[VIOLATION], numbers[COMPLEMENTARITY] = violation, complementarity / scale
    equality = 0.0
    for row in kkt.rows:
        equality = max(equality, abs(at.constraints[row] - lower[row]))
    return max(stationarity / scale, barrier / scale, equality)


@compiled
def begin(terms: Terms, kkt: KktArrays, work: Work, at: Iterate, warm: bool) -> None:
    """Choose mu and the multipliers of the sides; ``warm`` keeps what the multipliers of the rows say."""
    numbers, rho = work.numbers, work.numbers[RHO]
    if warm:
        for k in range(len(work.y)):
            suggested = -work.side_sign[k] * work.multipliers[work.side_row[k]]
            work.y[k] = min(max(suggested, 1e-8), 0.9 * rho)
        numbers[MU] = 1e-9
        error = measure(terms, kkt, work, at)
        error = max(numbers[STATIONARITY], numbers[VIOLATION], numbers[COMPLEMENTARITY])
        numbers[MU] = min(max(0.1 * error, 0.1 * numbers[TOLERANCE]), 0.1)
    mu = numbers[MU]
    for k in range(len(work.y)):
        c = work.side_sign[k] * (at.constraints[work.side_row[k]] - work.side_limit[k])
        s, e = slacks(c, mu, rho)
        centred = mu / s
        work.y[k] = min(max(work.y[k], 0.1 * centred), 0.5 * (centred + rho)) if warm else centred
    theta = infeasibility(kkt, terms.lower, at.constraints)
    numbers[THETA_SMALL], numbers[THETA_LARGE] = 1e-4 * max(1.0, theta), 1e4 * max(1.0, theta)
    work.counts[FILTERED] = 0


@compiled
def newton(terms: Terms, kkt: KktArrays, work: Work, at: Iterate) -> int:
    """Test the iterate, lower mu, find the Newton step and its first trial length."""
    numbers, counts = work.numbers, work.counts
    error = measure(terms, kkt, work, at)
    if counts[FAILURES] == 0:
        _record(work)
    tolerance = numbers[TOLERANCE]
    worst = max(numbers[STATIONARITY], numbers[VIOLATION], numbers[COMPLEMENTARITY])
    if not math.isfinite(worst) or not math.isfinite(numbers[COST]):
        return NOT_FINITE
    if worst <= tolerance:
        return CONVERGED
    if counts[ITERATION] >= counts[LIMIT]:
        return LIMIT_REACHED
    smallest = 0.1 * tolerance
    while error <= KAPPA * numbers[MU] and numbers[MU] > smallest:
        numbers[MU] = max(smallest, min(0.2 * numbers[MU], numbers[MU] ** 1.5))
        counts[FILTERED] = 0
        error = measure(terms, kkt, work, at)
    if error <= KAPPA * numbers[MU] and numbers[VIOLATION] > tolerance and numbers[RHO] < 1e9:
        numbers[RHO] *= 10.0  # the elastic variables are too cheap
        counts[FILTERED] = 0
        numbers[MU] = min(100.0 * numbers[MU], 0.1)
        error = measure(terms, kkt, work, at)
    numbers[THETA] = infeasibility(kkt, terms.lower, at.constraints)
    numbers[PHI] = barrier_value(work, at.cost[0], at.constraints)
    if not _direction(terms, kkt, work, at):
        return SINGULAR
    _lengths(terms, work, at)
    counts[TRIALS], counts[CORRECTED] = 0, 0
    return TRY


@compiled
def _record(work: Work) -> None:
    """One row of the history."""
    numbers, counts = work.numbers, work.counts
    row = work.log[min(counts[ITERATION], len(work.log) - 1)]
    row[0], row[1], row[2], row[3] = numbers[COST], numbers[STATIONARITY], numbers[VIOLATION], numbers[COMPLEMENTARITY]
    row[4], row[5], row[6], row[7] = numbers[STEP], numbers[TAKEN], numbers[MU], numbers[DELTA]
    row[8] = counts[GAUSS_NEWTON]


@compiled
def _direction(terms: Terms, kkt: KktArrays, work: Work, at: Iterate) -> bool:
    """Factorise with the right inertia and solve for the Newton step."""
    numbers, counts = work.numbers, work.counts
    mu, rho = numbers[MU], numbers[RHO]
    n, equalities = kkt.size[0], kkt.size[1]
    work.row_weights[:] = 0.0
    for row in range(len(work.row_terms)):
        work.row_terms[row] = 0.0
    for row in kkt.rows:
        work.row_terms[row] = work.multipliers[row]
    for k in range(len(work.y)):
        row, sign, y = work.side_row[k], work.side_sign[k], work.y[k]
        weight = 1.0 / (work.s[k] / y + work.e[k] / (rho - y))
        c = work.s[k] - work.e[k]
        r = c + mu / (rho - y) - mu / y
        work.row_weights[row] += weight
        work.row_terms[row] += sign * (weight * r - y)
    work.full[:] = at.gradient
    transposed_times(terms, False, at.constraint_jacobian, work.row_terms, work.full)
    for k in range(n):
        work.right[k] = -work.full[work.free[k]]
    for k in range(equalities):
        work.right[n + k] = -(at.constraints[kkt.rows[k]] - terms.lower[kkt.rows[k]])
    exact = counts[EXACT] == 1 and counts[FAILURES] < 2
    delta = numbers[DELTA] if counts[FAILURES] > 0 else 0.0
    while True:
        counts[GAUSS_NEWTON] = 0 if exact else 1
        work.matrix[:] = at.curvature if exact else at.hessian
        add_constraints(terms, at.constraint_jacobian, work.row_weights, work.matrix)
        fill(kkt, work.matrix, at.constraint_jacobian, work.data)
        largest = 0.0
        for k in range(n):
            work.shift[k] = delta
        for k in range(equalities):
            work.shift[n + k] = -DUAL_SHIFT
        if factor(kkt.plan, work.data, work.shift) and kkt.plan.state[NEGATIVE] == equalities:
            solve(kkt.plan, work.right, work.step)
            for k in range(n + equalities):
                largest = max(largest, abs(work.step[k]))
            if math.isfinite(largest):
                break
        if exact:
            exact = False
        else:
            delta = FIRST_SHIFT if delta == 0.0 else delta * SHIFT_GROWTH
            if delta > LARGEST_SHIFT:
                return False
    numbers[DELTA] = delta
    return True


@compiled
def _lengths(terms: Terms, work: Work, at: Iterate) -> None:
    """Steps of the multipliers of sides, the slope of the barrier function, and how far the slacks let us go."""
    numbers = work.numbers
    mu, rho = numbers[MU], numbers[RHO]
    n = len(work.free)
    times(terms, False, at.constraint_jacobian, work.step, work.row_moves)
    slope = 0.0
    for k in range(n):
        slope += at.gradient[work.free[k]] * work.step[k]
    keep = 1.0 - max(0.99, 1.0 - mu)
    primal = dual = 1.0
    for k in range(len(work.y)):
        s, e, y = work.s[k], work.e[k], work.y[k]
        move = work.side_sign[k] * work.row_moves[work.side_row[k]]
        slope -= mu / s * move
        total = s / y + e / (rho - y)
        r = s - e + mu / (rho - y) - mu / y
        dy = -(move + r) / total
        work.dy[k] = dy
        ds = mu / y - s - s / y * dy
        de = mu / (rho - y) - e + e / (rho - y) * dy
        if ds < 0.0:
            primal = min(primal, -(1.0 - keep) * s / ds)
        if de < 0.0:
            primal = min(primal, -(1.0 - keep) * e / de)
        if dy < 0.0:
            dual = min(dual, -(1.0 - keep) * y / dy)
        elif dy > 0.0:
            dual = min(dual, (1.0 - keep) * (rho - y) / dy)
    numbers[SLOPE], numbers[ALPHA], numbers[ALPHA_DUAL] = slope, primal, dual


@compiled
def trial_step(work: Work, out: Array) -> None:
    """The tangent step to be tried."""
    alpha = work.numbers[ALPHA]
    source = work.corrected if work.counts[CORRECTED] == 1 else work.step
    for k in range(len(out)):
        out[k] = alpha * source[k]


@compiled
def judge(terms: Terms, kkt: KktArrays, work: Work, at: Iterate, cost: float, constraints: Array) -> int:
    """Filter test of a trial point: accept it, shorten the step, correct it, or ask for another direction."""
    numbers, counts = work.numbers, work.counts
    alpha, theta, phi = numbers[ALPHA], numbers[THETA], numbers[PHI]
    slope = numbers[SLOPE]
    finite = math.isfinite(cost)
    for row in range(len(constraints)):
        finite = finite and math.isfinite(constraints[row])
    theta_trial = infeasibility(kkt, terms.lower, constraints) if finite else math.inf
    phi_trial = barrier_value(work, cost, constraints) if finite else math.inf
    slack = 1e-13 * max(1.0, abs(phi))
    switch = slope < 0.0 and alpha * (-slope) ** 2.3 > theta**1.1 and theta <= numbers[THETA_SMALL]
    armijo = phi_trial <= phi + ARMIJO * alpha * slope + slack
    good = finite and theta_trial <= numbers[THETA_LARGE]
    if good:
        if len(kkt.rows) == 0 or switch:
            good = armijo
        else:
            good = theta_trial <= (1.0 - GAMMA) * theta or phi_trial <= phi - GAMMA * theta + slack
            good = good or theta_trial <= 1e-12
    if good:
        for k in range(counts[FILTERED]):
            if theta_trial >= work.filter[k, 0] and phi_trial >= work.filter[k, 1] + slack:
                good = theta_trial <= 1e-12 and good and armijo
    if good:
        _accept(terms, kkt, work, switch and armijo)
        return ACCEPTED
    counts[TRIALS] += 1
    if counts[TRIALS] == 1 and finite and theta_trial >= theta and len(kkt.rows) > 0:
        n = kkt.size[0]
        for k in range(len(kkt.rows)):
            row = kkt.rows[k]
            work.right[n + k] = alpha * work.right[n + k] - (constraints[row] - terms.lower[row])
        solve(kkt.plan, work.right, work.corrected)
        counts[CORRECTED] = 1
        return TRY
    counts[CORRECTED] = 0
    numbers[ALPHA] = 0.5 * alpha
    if counts[TRIALS] > HALVINGS:
        counts[FAILURES] += 1
        numbers[DELTA] = max(1e-3, 100.0 * numbers[DELTA])
        return STALLED if counts[FAILURES] > MOST_FAILURES else AGAIN
    return TRY


@compiled
def _accept(terms: Terms, kkt: KktArrays, work: Work, descent: bool) -> None:
    """Move the multipliers and, unless the step was one of descent, remember where it came from."""
    numbers, counts = work.numbers, work.counts
    alpha, n = numbers[ALPHA], kkt.size[0]
    source = work.corrected if counts[CORRECTED] == 1 else work.step
    total = 0.0
    for k in range(n):
        total += (alpha * source[k]) ** 2
    for k in range(len(kkt.rows)):
        work.multipliers[kkt.rows[k]] += alpha * source[n + k]
    for k in range(len(work.y)):
        work.y[k] += numbers[ALPHA_DUAL] * work.dy[k]
    if not descent and counts[FILTERED] < FILTER:
        work.filter[counts[FILTERED], 0] = (1.0 - GAMMA) * numbers[THETA]
        work.filter[counts[FILTERED], 1] = numbers[PHI] - GAMMA * numbers[THETA]
        counts[FILTERED] += 1
    numbers[STEP], numbers[TAKEN] = math.sqrt(total), alpha
    counts[ITERATION] += 1
    counts[FAILURES] = 0


@compiled
def safeguard(work: Work, constraints: Array) -> None:
    """Keep the multipliers of sides within reach of what the slacks suggest (Waechter and Biegler, eq. 16)."""
    mu, rho = work.numbers[MU], work.numbers[RHO]
    for k in range(len(work.y)):
        c = work.side_sign[k] * (constraints[work.side_row[k]] - work.side_limit[k])
        s, e = slacks(c, mu, rho)
        low, high = 1e-10 * mu / s, 1e10 * mu / s
        work.y[k] = min(max(work.y[k], low), high)
        work.y[k] = min(work.y[k], rho - 1e-10 * mu / e)
