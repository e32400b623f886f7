"""Newton directions of the interior point: eliminate the sides, factorise with the right inertia, solve.

The formulas are derived in :mod:`unifg.solvers.interior_point.barrier`.
"""

from __future__ import annotations

import math

from unifg.codegen.function_pointers import holds, linked, parts, run
from unifg.elimination.plan import NEGATIVE
from unifg.problem.evaluation import times, transposed_times
from unifg.problem.systems import fill_stacked
from unifg.solvers.interior_point.state import AGAIN, EXAMINED, NO, SINGULAR, TRY, UNKNOWN, YES

FIRST_SHIFT, LARGEST_SHIFT, FIRST_GROWTH, SHIFT_GROWTH, SHIFT_DECAY = 1e-4, 1e20, 100.0, 8.0, 3.0
LEAST_SHIFT, SINGULAR_SHIFT = 1e-12, 1e-8  # less leaves singular arcs of costs without squares without any curvature
DUAL_SHIFT = 1e-11
SHORT = 0.01  # length of a step
LEAST_SHARE = 0.2  # of the second derivatives, before they are left out
FLAT = 1e-9  # curvature relative to the largest that counts as none; without equalities, to that along each unknown


@linked
def direct(address: int) -> None:
    """Factorise with the right inertia and find the Newton step and how far it may be taken."""
    constraints, data, free = parts(address, "constraints data free")
    links, multipliers, pairs, plan = parts(address, "links multipliers pairs plan")
    penalties, rests, row_units, row_weights = parts(address, "penalties rests row_units row_weights")
    rows, scalars, shift, sides, step, terms = parts(address, "rows scalars shift sides step terms")
    (units,) = parts(address, "units")
    now = scalars[0]
    n, equalities = len(free), len(rows)
    for row in range(len(row_weights)):
        row_weights[row] = 0.0
    for k in range(now.sides):
        row, y = sides[k].row, sides[k].y
        weight = 1.0 / (sides[k].s / y + sides[k].e / (penalties[row] - y))
        sides[k].weight = weight
        row_weights[row] += weight
        sides[k].rest = sides[k].sign * (constraints[row] - sides[k].border) + sides[k].e - sides[k].s
    dual, unit = DUAL_SHIFT / now.cost_unit, now.cost_unit
    for k in range(equalities):
        row = rows[k]
        rests[row], shift[n + k] = constraints[row] - terms.lower[row], -dual * row_units[row] ** 2
        if now.elastic == 1:
            p, q, multiplier = pairs[k].p, pairs[k].n, multipliers[row]
            rests[row] += q - p
            shift[n + k] -= p / (penalties[row] - multiplier) + q / (penalties[row] + multiplier)
    now.share = 1.0 if now.bending == 1 and now.failures < 2 else 0.0
    delta = now.delta if now.failures > 0 else 0.0
    # Less of the second derivatives may mean less curvature, and a step that was cut very short had too little.
    blend = now.taken > SHORT or now.iteration == 0
    now.answer = TRY
    while True:
        now.gauss_newton = 1 if now.share == 0.0 else 0
        run(links[0].assemble, (address,))
        for k in range(n):
            shift[k] = delta * unit / units[free[k]] ** 2
        factorised = holds(links[0].factor, (plan, data, shift))
        if factorised and plan.state[NEGATIVE] == equalities:
            run(links[0].steer, (address,))
            largest = 0.0
            for k in range(n + equalities):
                largest = max(largest, abs(step[k]))
            if math.isfinite(largest):
                break
        if now.share > 0.0 and blend:
            if now.definite == UNKNOWN:
                run(links[0].examine, (address,))
            if now.definite == YES:
                if delta == 0.0 and not factorised:  # nothing curves an unknown that comes before its equality
                    delta = LEAST_SHIFT
                    continue
                now.share = 0.5 * now.share if now.share > LEAST_SHARE else 0.0
                continue
        if delta == 0.0:
            last = now.last_delta
            least = SINGULAR_SHIFT if now.definite == NO else LEAST_SHIFT
            delta = FIRST_SHIFT if last == 0.0 else max(least, last / SHIFT_DECAY)
        else:
            delta *= FIRST_GROWTH if now.last_delta == 0.0 else SHIFT_GROWTH
        if delta > LARGEST_SHIFT:
            now.answer = SINGULAR
            if now.elastic == 0 and now.violated == 1:
                run(links[0].relax, (address,))
                now.answer = AGAIN
            return
    now.delta = delta
    if delta > 0.0:
        now.last_delta = delta


@linked
def assemble(address: int) -> None:
    """Write the KKT matrix with a share of the second derivatives, and unless it is examined with the sides."""
    constraint_jacobian, curvature, data = parts(address, "constraint_jacobian curvature data")
    doubles, entries, hessian, row_weights = parts(address, "doubles entries hessian row_weights")
    scalars, terms = parts(address, "scalars terms")
    share, normal = scalars[0].share, len(hessian)
    for k in range(normal):
        data[k] = curvature[k] if share == 1.0 else hessian[k]
        if 0.0 < share < 1.0:
            data[k] += share * (curvature[k] - hessian[k])
    sides = scalars[0].definite != EXAMINED
    fill_stacked(terms, entries, doubles, constraint_jacobian, row_weights, normal, sides, data)


@linked
def examine(address: int) -> None:
    """Test whether the Hessian of Gauss-Newton is definite where the equalities leave freedom.

    Where it is, less of the second derivatives is more curvature. Where it is not, as with a cost that is no square,
    they are the only curvature of some direction, which would be left to the barrier alone.
    """
    data, free, hessian, links, measures = parts(address, "data free hessian links measures")
    plan, rows, scalars, shift, units = parts(address, "plan rows scalars shift units")
    now = scalars[0]
    share, largest, diagonal = now.share, 0.0, measures.diagonal
    for k in range(len(free)):
        largest = max(largest, abs(hessian[diagonal[k]]) * units[free[k]] ** 2)
    now.share, now.definite = 0.0, EXAMINED
    run(links[0].assemble, (address,))
    for k in range(len(free)):
        own = abs(hessian[diagonal[k]])
        shift[k] = -FLAT * (own if own > 0.0 and len(rows) == 0 else largest / units[free[k]] ** 2)
    definite = largest > 0.0 and holds(links[0].factor, (plan, data, shift)) and plan.state[NEGATIVE] == len(rows)
    now.share, now.definite = share, YES if definite else NO


@linked
def estimate(address: int) -> None:
    """Multipliers of the equalities by least squares, and with them second derivatives for the first step.

    Without them nothing would bound the step of a cost that is no square. Large ones say little, and are left at zero:
    Waechter and Biegler 2006, section 3.6.
    """
    constraint_jacobian, data, doubles = parts(address, "constraint_jacobian data doubles")
    entries, free, full, gradient = parts(address, "entries free full gradient")
    hessian, links, multipliers, plan = parts(address, "hessian links multipliers plan")
    right, row_units, rows, scalars = parts(address, "right row_units rows scalars")
    shift, step, terms, units = parts(address, "shift step terms units")
    now = scalars[0]
    n, normal, unit = len(free), len(hessian), now.cost_unit
    for k in range(normal):
        data[k] = 0.0
    for k in range(len(entries)):
        data[normal + k] = constraint_jacobian[entries[k]]
    for k in range(len(doubles) // 2):
        data[doubles[2 * k]] += data[doubles[2 * k + 1]]
    for k in range(len(full)):
        full[k] = gradient[k]
    transposed_times(terms, False, constraint_jacobian, multipliers, full)
    for k in range(n):
        shift[k] = unit / units[free[k]] ** 2
        right[k] = -full[free[k]]
    for k in range(len(rows)):
        shift[n + k] = -DUAL_SHIFT / unit * row_units[rows[k]] ** 2
        right[n + k] = 0.0
    now.estimated = 0
    if not holds(links[0].factor, (plan, data, shift)):
        return
    run(links[0].solve, (plan, right, step))
    largest = 0.0
    for k in range(len(rows)):
        largest = max(largest, abs(step[n + k]) * row_units[rows[k]])
    if largest <= now.rho:
        now.estimated = 1
        for k in range(len(rows)):
            multipliers[rows[k]] = step[n + k]


@linked
def steer(address: int) -> None:
    """Solve for the residuals in ``rests`` and REST: the step, those of the sides, the slope, and both lengths."""
    constraint_jacobian, free, full, gradient = parts(address, "constraint_jacobian free full gradient")
    links, multipliers, pairs, plan, penalties = parts(address, "links multipliers pairs plan penalties")
    rests, right, row_terms, rows, scalars, unequal = parts(address, "rests right row_terms rows scalars unequal")
    sides, spread, step, terms = parts(address, "sides spread step terms")
    now = scalars[0]
    mu, elastic = now.mu, now.elastic == 1
    n = len(free)
    for row in range(len(row_terms)):
        row_terms[row] = 0.0
    for k in range(now.sides):
        row, y = sides[k].row, sides[k].y
        r = sides[k].rest + sides[k].s - sides[k].e + mu / (penalties[row] - y) - mu / y
        row_terms[row] += sides[k].sign * sides[k].weight * r
    for k in range(len(full)):
        spread[k] = full[k]
    transposed_times(terms, False, constraint_jacobian, row_terms, spread)
    for k in range(n):
        right[k] = -spread[free[k]]
    for k in range(len(rows)):
        row = rows[k]
        right[n + k] = -rests[row]
        if elastic:
            over, under = penalties[row] - multipliers[row], penalties[row] + multipliers[row]
            right[n + k] += pairs[k].n - pairs[k].p + mu / over - mu / under
    run(links[0].solve, (plan, right, step))
    times(terms, False, constraint_jacobian, step, row_terms, unequal)
    slope = 0.0
    for k in range(n):
        slope += gradient[free[k]] * step[k]
    limit = max(0.99, 1.0 - mu / now.cost_unit)
    primal = dual = 0.0  # inverse step lengths
    for k in range(now.sides):
        s, e, y = sides[k].s, sides[k].e, sides[k].y
        row = sides[k].row
        z = penalties[row] - y
        move = sides[k].sign * row_terms[row]
        r = sides[k].rest + s - e + mu / z - mu / y
        dy = -(move + r) * sides[k].weight
        ds = mu / y - s - s / y * dy
        de = mu / z - e + e / z * dy
        sides[k].dy, sides[k].ds, sides[k].de = dy, ds, de
        slope += penalties[row] * de - mu * (ds / s + de / e)
        primal = max(primal, max(-ds / s, -de / e))
        dual = max(dual, max(-dy / y, dy / z))
    if elastic:
        for k in range(len(rows)):
            row, p, q, move = rows[k], pairs[k].p, pairs[k].n, step[n + k]
            over, under = penalties[row] - multipliers[row], penalties[row] + multipliers[row]
            dp, dn = mu / over - p + p / over * move, mu / under - q - q / under * move
            pairs[k].dp, pairs[k].dn = dp, dn
            slope += penalties[row] * (dp + dn) - mu * (dp / p + dn / q)
            primal = max(primal, max(-dp / p, -dn / q))
            dual = max(dual, max(move / over, -move / under))
    now.slope = slope
    now.alpha = min(1.0, limit / primal) if primal > 0.0 else 1.0
    now.alpha_dual = min(1.0, limit / dual) if dual > 0.0 else 1.0
