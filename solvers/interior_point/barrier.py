"""Newton steps of a primal-dual interior point with elastic constraints, as compiled functions.

Every finite limit of an inequality row is a *side* c(x) >= 0, with c = g - lower or upper - g. It has a slack s and an
elastic variable e with penalty rho, and both carry a logarithmic barrier:

    min  f(x) + sum rho e - mu log s - mu log e     s.t.  c(x) + e - s = 0,   h(x) = 0

With the multiplier y of a side and z = rho - y, the conditions s y = mu and e z = mu are linearised as they stand
(primal-dual). Eliminating ds, de and dy leaves one scalar per side,

    (H + J' D J) dx + A' lambda+ = -(grad f - J' y) - J' D r,    A dx = -h,    1/D = s/y + e/z,
    r = c + mu/z - mu/y,   dy = -D (J dx + r),   ds = mu/y - s - (s/y) dy,   de = mu/z - e + (e/z) dy,

and one factorisation of the KKT matrix per iteration. The filter line search, its constants, the second-order
correction and the correction of the inertia follow Waechter and Biegler, Math. Program. 106 (2006), sections 2 and 3.
A row that cannot be satisfied has y = rho and e > 0.

Equalities hold as they stand, h(x) = 0, until steps become short or fail. From then on they are elastic too, h = p - n
with p, n > 0 at the penalty rho: p (rho - lambda) = mu, n (rho + lambda) = mu, and

    A dx - (p / (rho - lambda) + n / (rho + lambda)) dlambda = -h + mu / (rho - lambda) - mu / (rho + lambda).

The phase begins where all of its constraints hold (`_split`), at a mu in proportion to penalty and violation: an l1
penalty with a smooth edge, which needs no restoration. Its answers are those of the problem as long as no multiplier
is at its penalty; where one is, the penalty is raised, until the pull of the objective is small beside the forces that
the constraints exert on each other. Then violation is what is left to minimise, and the caller of the loop finds out
whether less of it is to be had (`VIOLATED`); compare Curtis, Schenk and Waechter, SIAM J. Optim. 20 (2010), and Thierry
and Biegler, Optim. Methods Softw. 35 (2020).

s y and e z are the same in any unit of a row. Units (`find_units`) therefore enter only where numbers of different
rows or unknowns meet: penalties, first slacks, sums of violations, shifts of the diagonals, and the error of a barrier
problem. The objective has a size (`unifg.problem.units`): first mu and penalties are in proportion to it, and so are
errors that are compared with mu. The KKT test has none, so a large cost is solved to more digits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from unifg.codegen.function_pointers import linked, parts, run
from unifg.codegen.jit import compiled
from unifg.problem.evaluation import transposed_times
from unifg.problem.table import TermArrays
from unifg.problem.units import cost_unit, find_units, mean_force
from unifg.solvers.interior_point.state import (
    CONVERGED,
    LIMIT_REACHED,
    NO,
    NOT_FINITE,
    RESTORE,
    STALLED,
    STOPPED,
    TRY,
    VIOLATED,
)
from unifg.typing import Array, IntArray, Records

KAPPA = 50.0  # mu is lowered when the error of the barrier problem is below KAPPA mu
SOLVED = 50.0  # penalties are looked at when it is below SOLVED mu
MOST_SHORT_STEPS = 5  # in a row, before equalities become elastic
RELAXED_MU = 1e-2  # of penalty times violation: first mu with elastic equalities
LATE_MU = 1e-3  # the same: largest mu at which a violation is taken seriously
AT_PENALTY = 0.9  # share of the penalty from which on a multiplier is at it
SMALL_PULL = 1e-2  # share of the constraints' forces below which the objective's force counts for nothing
MOST_RAISES = 6  # of penalties, tenfold each
LEAST_PENALTY = 3.0  # times the largest slope of the objective
WORTH = 0.25  # of the cost at the start: largest first mu
NOTHING = 1e-20  # of the size of the cost: one that is only rounding
BOTTOMLESS = -1e12  # an objective below it, while constraints are violated
FIRST_SLACK = 1e-2  # smallest slack of a cold start
FINER = 0.03  # times the least mu, where the KKT test asks for more
LEAST_FINER = 1e-10  # of the least mu, where the KKT test asks for more
STUCK = 30  # iterations in which nothing becomes better: the rest is rounding, and multipliers are estimated at the end
BETTER = 0.9  # times the violation, by which an iterate is better
SAME_MERIT = 1e-12  # of the barrier function, by which it does not change
WARM_MU = 1e-5  # largest first mu of a start with multipliers: what is active has been found


@compiled
def merit(
    now: Any,
    sides: Records,
    pairs: Records,
    penalties: Array,
    row_units: Array,
    rows: IntArray,
    lower: Array,
    cost: float,
    constraints: Array,
    alpha: float,
) -> tuple[float, float]:
    """Barrier function, and violation of sides and equality rows, after a step of what makes them elastic."""
    elastic, logarithms, product, theta = 0.0, 0.0, 1.0, 0.0
    for k in range(now.sides):
        s, e = sides[k].s + alpha * sides[k].ds, sides[k].e + alpha * sides[k].de
        row = sides[k].row
        c = sides[k].sign * (constraints[row] - sides[k].border)
        theta += abs(c + e - s) / row_units[row]
        elastic += penalties[row] * e
        product *= s * e
        if k & 3 == 3:  # one logarithm for eight factors, each of moderate size
            logarithms += math.log(product)
            product = 1.0
    logarithms += math.log(product)
    if now.elastic == 0:
        for row in rows:
            theta += abs(constraints[row] - lower[row]) / row_units[row]
    else:
        product = 1.0
        for k in range(len(rows)):
            row, p, n = rows[k], pairs[k].p + alpha * pairs[k].dp, pairs[k].n + alpha * pairs[k].dn
            theta += abs(constraints[row] - lower[row] - p + n) / row_units[row]
            elastic += penalties[row] * (p + n)
            product *= p * n
            if k & 3 == 3:
                logarithms += math.log(product)
                product = 1.0
        logarithms += math.log(product)
    return cost + elastic - now.mu * logarithms, theta


@compiled
def _split(c: float, rho: float, mu: float) -> tuple[float, float]:
    """Positive s and e with s - e = c that minimise rho e - mu log s - mu log e."""
    root = math.sqrt(4.0 * mu * mu + c * c * rho * rho)
    if c > 0.0:
        s = (2.0 * mu + c * rho + root) / (2.0 * rho)
        return s, mu * s / (rho * s - mu)
    e = (2.0 * mu - c * rho + root) / (2.0 * rho)
    return mu * e / (rho * e - mu), e


@linked
def measure(address: int) -> None:
    """KKT numbers of the problem at the present iterate, and what the error of the barrier problem is made of."""
    concavity, constraint_jacobian, constraints = parts(address, "concavity constraint_jacobian constraints")
    free, full, gradient, hessian, measures = parts(address, "free full gradient hessian measures")
    multipliers, pairs, penalties = parts(address, "multipliers pairs penalties")
    row_units, rows, scalars, sides, terms = parts(address, "row_units rows scalars sides terms")
    (units,) = parts(address, "units")
    now = scalars[0]
    lower, upper, constraints, full = terms.lower, terms.upper, constraints, full
    gap, least, most = 0.0, math.inf, -math.inf
    for k in range(now.sides):
        multipliers[sides[k].row] = 0.0
    for k in range(now.sides):
        row, y = sides[k].row, sides[k].y
        multipliers[row] -= sides[k].sign * y
        sy, ez = sides[k].s * y, sides[k].e * (penalties[row] - y)
        least, most = min(least, min(sy, ez)), max(most, max(sy, ez))
        c = sides[k].sign * (constraints[row] - sides[k].border)
        gap = max(gap, abs(c + sides[k].e - sides[k].s) / row_units[row])
    for k in range(len(full)):
        full[k] = gradient[k]
    transposed_times(terms, False, constraint_jacobian, multipliers, full)
    stationarity = violation = paid = complementarity = excess = 0.0
    for column in free:
        force = abs(full[column]) * units[column]
        if not force <= stationarity:  # NaN stays
            stationarity = force
    for row in range(len(constraints)):
        value, multiplier = constraints[row], multipliers[row]
        outside = max(value - upper[row], lower[row] - value)
        if not outside <= violation:
            violation = outside
        paid, excess = max(paid, outside * penalties[row]), max(excess, outside / row_units[row])
        if lower[row] != upper[row]:
            limit = upper[row] if multiplier > 0.0 else lower[row]
            slack = abs(value - limit) if math.isfinite(limit) else row_units[row]
            complementarity = max(complementarity, abs(multiplier) * slack)
    if now.elastic == 0:
        for row in rows:
            gap = max(gap, abs(constraints[row] - lower[row]) / row_units[row])
    else:
        for k in range(len(rows)):
            row, p, n = rows[k], pairs[k].p, pairs[k].n
            pz, nz = p * (penalties[row] - multipliers[row]), n * (penalties[row] + multipliers[row])
            least, most = min(least, min(pz, nz)), max(most, max(pz, nz))
            gap = max(gap, abs(constraints[row] - lower[row] - p + n) / row_units[row])
    now.size = cost_unit(measures, hessian, concavity, gradient)
    now.forces = max(now.size, mean_force(terms, multipliers, row_units))
    now.stationarity, now.complementarity = stationarity / now.forces, complementarity / now.forces
    # Rows in small units count, too, where a large tolerance says nothing of them.
    now.violation, now.excess = violation, excess
    now.violated = 1 if violation > now.feasible or excess > now.tolerance else 0
    now.gap, now.least, now.most, now.paid = gap, least, most, paid


@compiled
def _error(now: Any) -> float:
    """Error of the barrier problem, in units of the objective, and so comparable with mu."""
    centring = max(now.most - now.mu, now.mu - now.least) / now.forces
    error: float = max(max(now.stationarity, now.gap), centring) * now.size
    return error


@compiled
def _forces(
    terms: TermArrays, free: IntArray, gradient: Array, multipliers: Array, jacobian: Array, full: Array
) -> tuple[float, float]:
    """Largest force of the objective on an unknown, and of all constraints if none of them balanced another."""
    for k in range(len(full)):
        full[k] = 0.0
    transposed_times(terms, False, np.abs(jacobian), np.abs(multipliers), full)
    pull = push = 0.0
    for place in free:
        pull, push = max(pull, abs(gradient[place])), max(push, full[place])
    return pull, push


@linked
def begin(address: int) -> None:
    """Find the sides; choose mu, slacks and multipliers of a start that has been linearised."""
    concavity, constraint_jacobian, constraints = parts(address, "concavity constraint_jacobian constraints")
    free, gradient, heights, hessian = parts(address, "free gradient heights hessian")
    jacobian, links, measures = parts(address, "jacobian links measures")
    multipliers, pairs, penalties, row_units = parts(address, "multipliers pairs penalties row_units")
    rows, scalars, sides, terms, units = parts(address, "rows scalars sides terms units")
    now = scalars[0]
    lower, upper = terms.lower, terms.upper
    count = 0
    for row in range(len(lower)):
        if lower[row] != upper[row]:
            for which in range(2):
                limit = lower[row] if which == 0 else upper[row]
                if math.isfinite(limit):
                    sides[count].row = row
                    sides[count].sign, sides[count].border = 1.0 - 2.0 * which, limit
                    count += 1
    now.sides, now.elastic = count, 0 if len(rows) else 1
    if now.scaling == 1:
        derivatives = hessian, concavity, gradient, jacobian, constraints, constraint_jacobian
        find_units(terms, measures, now.violation_unit, *derivatives)
    size = cost_unit(measures, hessian, concavity, gradient)
    now.cost_unit = 1.0
    if now.scaling == 1:
        now.cost_unit = size
        pull = 0.0
        for column in free:
            pull = max(pull, abs(gradient[column]) * units[column])
        now.rho = max(now.rho * now.cost_unit, LEAST_PENALTY * pull)
        # No barrier need be worth as much as the cost, unless there is none to speak of.
        worth = WORTH * abs(now.cost)
        now.mu *= worth if NOTHING * now.cost_unit < worth < now.cost_unit else now.cost_unit
    most = 0.0
    for row in range(len(lower)):
        most = max(most, abs(multipliers[row]) * row_units[row])
    warm = most > 0.0
    now.cold = 0 if warm else 1
    if most > 0.5 * now.rho:
        now.rho = 10.0 * most
    for row in range(len(lower)):
        penalties[row] = now.rho / row_units[row]
    if warm:
        for k in range(count):
            c = sides[k].sign * (constraints[sides[k].row] - sides[k].border)
            y = min(max(-sides[k].sign * multipliers[sides[k].row], 0.0), 0.9 * penalties[sides[k].row])
            sides[k].y, sides[k].s, sides[k].e = y, c, 0.0
        error = 0.0
        for row in range(len(lower)):
            error = max(error, max(constraints[row] - upper[row], lower[row] - constraints[row]) / row_units[row])
        if 0.1 * error < WARM_MU:  # else the other numbers make no difference
            run(links[0].measure, (address,))
            error = max(max(now.stationarity, error), now.complementarity)
        now.mu = max(min(0.1 * error, WARM_MU), 0.1 * now.tolerance) * min(1.0, size)
    mu = now.mu
    for k in range(count):
        row = sides[k].row
        unit, penalty = row_units[row], penalties[row]
        c = sides[k].sign * (constraints[row] - sides[k].border)
        if warm:
            s = max(c, min(mu / max(sides[k].y, 1e-3 * mu / unit), FIRST_SLACK * unit))
            y = max(sides[k].y, mu / s)
        else:
            s = max(c, FIRST_SLACK * unit)
            y = mu / s
        y = min(y, 0.9 * penalty)
        sides[k].y, sides[k].s, sides[k].e = y, s, mu / (penalty - y)
        sides[k].ds = sides[k].de = sides[k].dy = 0.0
    theta = merit(now, sides, pairs, penalties, row_units, rows, lower, 0.0, constraints, 0.0)[1]
    now.theta_small = 1e-4 * max(1.0, theta)
    now.theta_large = min(1e3 * max(1.0, theta), max(now.theta_most, theta))
    now.filtered = now.failures = now.short_steps = 0
    now.delta = now.last_delta = now.step = now.taken = 0.0
    now.estimated, now.stuck_phi = 0, math.inf
    run(links[0].measure, (address,))
    if now.cold == 1 and now.exact == 1 and len(heights):
        run(links[0].examine, (address,))
        if now.definite == NO:
            run(links[0].estimate, (address,))
            run(links[0].measure, (address,))


@linked
def test(address: int) -> None:
    """Test the iterate; if there is to be a step, lower mu and measure what the line search compares with."""
    constraint_jacobian, constraints, free = parts(address, "constraint_jacobian constraints free")
    full, gradient, kept, kkt, links, log = parts(address, "full gradient kept kkt links log")
    multipliers, pairs, penalties, row_units = parts(address, "multipliers pairs penalties row_units")
    rows, scalars, sides, terms, values = parts(address, "rows scalars sides terms values")
    now = scalars[0]
    if now.failures == 0:
        row = log[min(now.iteration, len(log) - 1)]
        row[0], row[1], row[2] = now.cost, now.stationarity, now.violation
        row[3], row[4], row[5] = now.complementarity, now.step, now.taken
        row[6], row[7], row[8] = now.mu, now.delta, now.gauss_newton
    tolerance, feasible = now.tolerance, now.feasible
    now.concluded = 0
    worst = max(max(now.stationarity, now.complementarity), now.gap)
    if not math.isfinite(now.stationarity + now.violation + now.cost):
        now.answer = NOT_FINITE
        return
    guessed = now.cold == 1 and now.iteration == 0 and now.sides > 0  # large multipliers hide forces
    # The sizes that the KKT test divides by may be smaller or larger than that of the forces.
    if worst <= tolerance and now.violated == 0 and not guessed:
        run(links[0].conclude, (address,))
        if max(kkt[0], kkt[2]) <= tolerance:
            now.answer, now.concluded = CONVERGED, 1
            return
        now.finer = max(FINER * now.finer, LEAST_FINER)  # the units at the answer are others
        run(links[0].measure, (address,))  # it was written over
    # With a larger mu, what is active has not been found, and short steps are those towards another problem's answer.
    if now.step < now.step_tolerance * now.taken and now.mu <= WARM_MU * min(1.0, now.size):
        if now.violation < now.violation_tolerance:
            now.answer = STOPPED
            return
    if now.violation <= now.keeping:
        now.kept = 1
        for k in range(len(values)):
            kept[k] = values[k]
    if now.iteration >= now.limit:
        now.answer = LIMIT_REACHED
        return
    if now.cost < BOTTOMLESS * now.cost_unit and now.violated == 1:
        now.answer = STALLED  # no penalty holds back an objective that falls faster than violation grows
        return
    if now.short_steps >= MOST_SHORT_STEPS and now.elastic == 0 and now.violated == 1:
        if now.restores == 1 and now.cold == 1 and now.definite == NO:
            now.answer = RESTORE
            return
        run(links[0].relax, (address,))
    smallest = 0.1 * tolerance * now.finer * min(1.0, now.size)
    bound = False
    if _error(now) <= SOLVED * now.mu and now.violated == 1:
        # Whether something is violated because its penalty is too low, or because it has to be. With the least mu that
        # is told by a solved problem: a step before, equalities without a penalty may still be on their way.
        # Where the tolerance alone is violated, and not the unit of a row, digits are missing.
        bound = now.mu <= smallest and _error(now) <= tolerance * now.size and now.excess > tolerance
        if now.mu <= LATE_MU * min(now.paid, now.rho):
            for k in range(now.sides):
                bound = bound or (sides[k].y > AT_PENALTY * penalties[sides[k].row] and sides[k].e > feasible)
            for k in range(len(rows) if now.elastic == 1 else 0):
                row, away = rows[k], max(pairs[k].p, pairs[k].n)
                bound = bound or (abs(multipliers[row]) > AT_PENALTY * penalties[row] and away > feasible)
        if bound:
            pull, push = _forces(terms, free, gradient, multipliers, constraint_jacobian, full)
            run(links[0].measure, (address,))  # it was written over
            highest = now.raises >= MOST_RAISES
            if now.asked < now.rho and (highest or pull <= SMALL_PULL * push):
                now.asked, now.answer = now.rho, VIOLATED
                return
            if highest:
                now.answer = STALLED
                return
            now.raises += 1
            now.rho *= 10.0
            for row in range(len(penalties)):
                penalties[row] *= 10.0
            now.paid *= 10.0
            run(links[0].relax, (address,))
    if (now.violated == 0 or now.excess <= tolerance) and now.mu <= smallest and _error(now) <= now.mu:
        # All is done that can be done at these penalties. A multiplier near its own lets a row give way by
        # mu / (penalty - multiplier): no violation that counts, but too much for complementarity.
        near = False
        for k in range(now.sides):
            near = near or sides[k].y * sides[k].e > tolerance * now.forces
            near = near or (now.violated == 1 and sides[k].e > feasible)
        if near:
            if now.raises >= MOST_RAISES:
                now.answer = STALLED
                return
            run(links[0].increase_penalty, (address,))
    while not bound and _error(now) <= KAPPA * now.mu and now.mu > smallest:
        less = min(0.2 * now.mu, now.mu * math.sqrt(now.mu / now.size))
        now.mu = less if less > 10.0 * smallest else smallest
        now.filtered = 0
    now.settled = 1 if now.mu <= smallest else 0
    cost, lower = now.cost, terms.lower
    phi, theta = merit(now, sides, pairs, penalties, row_units, rows, lower, cost, constraints, 0.0)
    now.phi, now.theta = phi, theta
    now.trials, now.corrected, now.answer = 0, 0, TRY
    moved = abs(phi - now.stuck_phi) > SAME_MERIT * max(now.cost_unit, abs(phi))
    if moved or theta < BETTER * now.stuck_theta:
        now.stuck, now.stuck_phi, now.stuck_theta = now.iteration, phi, theta
    elif now.iteration >= now.stuck + STUCK:
        now.answer = STALLED


@linked
def increase_penalty(address: int) -> None:
    """Increase the penalty parameters and re-centre the elastic variables."""
    multipliers, pairs, penalties, links = parts(address, "multipliers pairs penalties links")
    rows, scalars, sides = parts(address, "rows scalars sides")
    now = scalars[0]
    now.raises += 1
    now.rho *= 10.0
    now.filtered = now.failures = 0
    for row in range(len(penalties)):
        penalties[row] *= 10.0
    for k in range(now.sides):
        sides[k].e = now.mu / (penalties[sides[k].row] - sides[k].y)
    if now.elastic == 1:
        for k in range(len(rows)):
            row = rows[k]
            pairs[k].p, pairs[k].n = (
                now.mu / (penalties[row] - multipliers[row]),
                now.mu / (penalties[row] + multipliers[row]),
            )
    run(links[0].measure, (address,))


@linked
def relax(address: int) -> None:
    """Make the equalities elastic: what the iterate violates is paid for, and the path to the answer begins anew."""
    constraints, links, multipliers, pairs = parts(address, "constraints links multipliers pairs")
    penalties, row_units, rows, scalars, sides = parts(address, "penalties row_units rows scalars sides")
    (terms,) = parts(address, "terms")
    now = scalars[0]
    now.elastic, now.filtered, now.failures, now.short_steps = 1, 0, 0, 0
    now.delta = now.last_delta = 0.0
    mu = now.mu = max(now.mu, RELAXED_MU * min(now.paid, now.rho))
    for k in range(now.sides):
        row = sides[k].row
        c = sides[k].sign * (constraints[row] - sides[k].border)
        s, e = _split(c, penalties[row], mu)
        sides[k].s, sides[k].e, sides[k].y = s, e, mu / s
        sides[k].ds = sides[k].de = sides[k].dy = 0.0
    for k in range(len(rows)):
        row = rows[k]
        p, n = _split(constraints[row] - terms.lower[row], 2.0 * penalties[row], mu)
        # p (penalty - multiplier) = mu and n (penalty + multiplier) = mu
        multipliers[row] = penalties[row] - mu / p if p > n else mu / n - penalties[row]
        pairs[k].p, pairs[k].n, pairs[k].dp, pairs[k].dn = p, n, 0.0, 0.0
    run(links[0].measure, (address,))
    theta = merit(now, sides, pairs, penalties, row_units, rows, terms.lower, 0.0, constraints, 0.0)[1]
    now.theta_large = max(now.theta_large, min(1e3 * max(1.0, theta), max(now.theta_most, theta)))
