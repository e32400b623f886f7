"""Newton directions of the interior point: eliminate the sides, factorise with the right inertia, solve.

The formulas are derived in :mod:`unifg.solvers.interior_point.barrier`.
"""

from __future__ import annotations

import math

from unifg.elimination.plan import NEGATIVE
from unifg.machine.links import holds, linked, parts, run
from unifg.program.passes import add_constraints, times, transposed_times
from unifg.solvers.interior_point.state import (
    AGAIN,
    ALPHA,
    ALPHA_DUAL,
    ANSWER,
    BORDER,
    COLD,
    COST_UNIT,
    DE,
    DELTA,
    DN,
    DP,
    DS,
    DY,
    ELASTIC,
    EXACT,
    FACTOR,
    FAILURES,
    GAUSS_NEWTON,
    ITERATION,
    LAST_DELTA,
    MU,
    RELAX,
    REST,
    SIDES,
    SIGN,
    SINGULAR,
    SLOPE,
    SOLVE,
    STEER,
    TAKEN,
    TOLERANCE,
    TRY,
    VIOLATION,
    WEIGHT,
    E,
    N,
    P,
    S,
    Y,
)

FIRST_SHIFT, LARGEST_SHIFT, FIRST_GROWTH, SHIFT_GROWTH, SHIFT_DECAY = 1e-4, 1e20, 100.0, 8.0, 3.0
DUAL_SHIFT = 1e-9
SHORT = 0.01  # length of a step
LEAST_SHARE = 0.2  # of the second derivatives, before they are left out


@linked
def direct(address: int) -> None:
    """Factorise with the right inertia and find the Newton step and how far it may be taken."""
    constraint_jacobian, constraints, counts = parts(address, "constraint_jacobian constraints counts")
    curvature, data, doubles, entries, free, hessian = parts(address, "curvature data doubles entries free hessian")
    links, numbers, plan, rests, row_weights, rows = parts(address, "links numbers plan rests row_weights rows")
    pairs, prices, shift, side_row, sides = parts(address, "pairs prices shift side_row sides")
    multipliers, row_units, step, terms = parts(address, "multipliers row_units step terms")
    (units,) = parts(address, "units")
    n, equalities, normal = len(free), len(rows), len(hessian)
    for row in range(len(row_weights)):
        row_weights[row] = 0.0
    for k in range(counts[SIDES]):
        row, y = side_row[k], sides[Y, k]
        weight = 1.0 / (sides[S, k] / y + sides[E, k] / (prices[row] - y))
        sides[WEIGHT, k] = weight
        row_weights[row] += weight
        sides[REST, k] = sides[SIGN, k] * (constraints[row] - sides[BORDER, k]) + sides[E, k] - sides[S, k]
    dual, unit = DUAL_SHIFT / numbers[COST_UNIT], numbers[COST_UNIT]
    for k in range(equalities):
        row = rows[k]
        rests[row], shift[n + k] = constraints[row] - terms.lower[row], -dual * row_units[row] ** 2
        if counts[ELASTIC] == 1:
            p, q, multiplier = pairs[P, k], pairs[N, k], multipliers[row]
            rests[row] += q - p
            shift[n + k] -= p / (prices[row] - multiplier) + q / (prices[row] + multiplier)
    # Second derivatives need multipliers, and those of a cold start mean little.
    exact = counts[EXACT] == 1 and counts[FAILURES] < 2 and (counts[ITERATION] > 0 or counts[COLD] == 0)
    share = 1.0 if exact else 0.0  # of the second derivatives
    for k in range(normal):
        data[k] = curvature[k] if share > 0.0 else hessian[k]
    for k in range(len(entries)):
        data[normal + k] = constraint_jacobian[entries[k]]
    add_constraints(terms, constraint_jacobian, row_weights, data)
    for k in range(len(doubles) // 2):
        data[doubles[2 * k]] += data[doubles[2 * k + 1]]
    delta = numbers[DELTA] if counts[FAILURES] > 0 else 0.0
    # Less of the second derivatives may mean less curvature, and a step that was cut very short had too little.
    blend = numbers[TAKEN] > SHORT or counts[ITERATION] == 0
    counts[ANSWER] = TRY
    while True:
        counts[GAUSS_NEWTON] = 1 if share == 0.0 else 0
        for k in range(n):
            shift[k] = delta * unit / units[free[k]] ** 2
        factorised = holds(links[FACTOR], (plan, data, shift))
        if factorised and plan.state[NEGATIVE] == equalities:
            run(links[STEER], (address,))
            largest = 0.0
            for k in range(n + equalities):
                largest = max(largest, abs(step[k]))
            if math.isfinite(largest):
                break
        if share > 0.0 and blend:
            less = 0.5 * share if share > LEAST_SHARE else 0.0
            for k in range(normal):
                data[k] += (less - share) * (curvature[k] - hessian[k])
            share = less
            continue
        if delta == 0.0:
            last = numbers[LAST_DELTA]
            delta = FIRST_SHIFT if last == 0.0 else max(1e-12, last / SHIFT_DECAY)
        else:
            delta *= FIRST_GROWTH if numbers[LAST_DELTA] == 0.0 else SHIFT_GROWTH
        if delta > LARGEST_SHIFT:
            counts[ANSWER] = SINGULAR
            if counts[ELASTIC] == 0 and numbers[VIOLATION] > numbers[TOLERANCE]:
                run(links[RELAX], (address,))
                counts[ANSWER] = AGAIN
            return
    numbers[DELTA] = delta
    if delta > 0.0:
        numbers[LAST_DELTA] = delta


@linked
def steer(address: int) -> None:
    """Solve for the residuals in ``rests`` and REST: the step, those of the sides, the slope, and both lengths."""
    constraint_jacobian, counts, free, full = parts(address, "constraint_jacobian counts free full")
    gradient, links, numbers, plan, rests, right = parts(address, "gradient links numbers plan rests right")
    row_terms, rows, side_row, sides, step = parts(address, "row_terms rows side_row sides step")
    multipliers, pairs, prices, spread, terms = parts(address, "multipliers pairs prices spread terms")
    mu, elastic = numbers[MU], counts[ELASTIC] == 1
    n = len(free)
    for row in range(len(row_terms)):
        row_terms[row] = 0.0
    for k in range(counts[SIDES]):
        row, y = side_row[k], sides[Y, k]
        r = sides[REST, k] + sides[S, k] - sides[E, k] + mu / (prices[row] - y) - mu / y
        row_terms[row] += sides[SIGN, k] * sides[WEIGHT, k] * r
    for k in range(len(full)):
        spread[k] = full[k]
    transposed_times(terms, False, constraint_jacobian, row_terms, spread)
    for k in range(n):
        right[k] = -spread[free[k]]
    for k in range(len(rows)):
        row = rows[k]
        right[n + k] = -rests[row]
        if elastic:
            over, under = prices[row] - multipliers[row], prices[row] + multipliers[row]
            right[n + k] += pairs[N, k] - pairs[P, k] + mu / over - mu / under
    run(links[SOLVE], (plan, right, step))
    times(terms, False, constraint_jacobian, step, row_terms)
    slope = 0.0
    for k in range(n):
        slope += gradient[free[k]] * step[k]
    limit = max(0.99, 1.0 - mu)
    primal = dual = 0.0  # inverse step lengths
    for k in range(counts[SIDES]):
        s, e, y = sides[S, k], sides[E, k], sides[Y, k]
        row = side_row[k]
        z = prices[row] - y
        move = sides[SIGN, k] * row_terms[row]
        r = sides[REST, k] + s - e + mu / z - mu / y
        dy = -(move + r) * sides[WEIGHT, k]
        ds = mu / y - s - s / y * dy
        de = mu / z - e + e / z * dy
        sides[DY, k], sides[DS, k], sides[DE, k] = dy, ds, de
        slope += prices[row] * de - mu * (ds / s + de / e)
        primal = max(primal, max(-ds / s, -de / e))
        dual = max(dual, max(-dy / y, dy / z))
    if elastic:
        for k in range(len(rows)):
            row, p, q, move = rows[k], pairs[P, k], pairs[N, k], step[n + k]
            over, under = prices[row] - multipliers[row], prices[row] + multipliers[row]
            dp, dn = mu / over - p + p / over * move, mu / under - q - q / under * move
            pairs[DP, k], pairs[DN, k] = dp, dn
            slope += prices[row] * (dp + dn) - mu * (dp / p + dn / q)
            primal = max(primal, max(-dp / p, -dn / q))
            dual = max(dual, max(move / over, -move / under))
    numbers[SLOPE] = slope
    numbers[ALPHA] = min(1.0, limit / primal) if primal > 0.0 else 1.0
    numbers[ALPHA_DUAL] = min(1.0, limit / dual) if dual > 0.0 else 1.0
