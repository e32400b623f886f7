"""The filter line search of the interior point: test a trial, correct it, take it, or look for another direction.

After Waechter and Biegler, Math. Program. 106 (2006), sections 2.3 and 2.4.
"""

from __future__ import annotations

import math

from unifg.codegen.function_pointers import linked, parts, run
from unifg.solvers.interior_point.barrier import merit
from unifg.solvers.interior_point.state import ACCEPTED, AGAIN, FILTER, STALLED, TRY

ARMIJO = 1e-4
GAMMA_THETA, GAMMA_PHI = 1e-5, 1e-8
HALVINGS = 20
FAR = 1e3  # times the violation
FEW_FAILURES, MOST_FAILURES = 2, 8  # of line searches in a row, before equalities become elastic and for good
SHORT_STEP = 0.05  # length of one


@linked
def judge(address: int) -> None:
    """Filter test of a trial point: accept it, shorten the step, correct it, or ask for another direction."""
    filter, links, pairs, penalties, row_units = parts(address, "filter links pairs penalties row_units")
    rows, scalars, sides, terms = parts(address, "rows scalars sides terms")
    now = scalars[0]
    (constraints,) = parts(address, "trial_constraints")
    alpha, theta, phi, slope = now.alpha, now.theta, now.phi, now.slope
    cost, lower = now.trial_cost, terms.lower
    phi_trial, theta_trial = merit(now, sides, pairs, penalties, row_units, rows, lower, cost, constraints, alpha)
    finite = math.isfinite(phi_trial) and math.isfinite(theta_trial)
    slack = 1e-13 * max(now.cost_unit, abs(phi))
    switch = slope < 0.0 and alpha * (-slope / now.cost_unit) ** 2.3 > theta**1.1 and theta <= now.theta_small
    armijo = phi_trial <= phi + ARMIJO * alpha * slope + slack
    # With the least mu no step need lead far from the constraints, however long singular arcs make it.
    most = min(now.theta_large, max(now.theta_small, FAR * theta)) if now.settled == 1 else now.theta_large
    good = finite and theta_trial <= most
    if good:
        if switch:
            good = armijo
        else:
            good = (
                theta_trial <= (1.0 - GAMMA_THETA) * theta
                or phi_trial <= phi - GAMMA_PHI * now.cost_unit * theta + slack
            )
            good = good or theta_trial <= 1e-12
    if good:
        for k in range(now.filtered):
            if theta_trial >= filter[k, 0] and phi_trial >= filter[k, 1] + slack:
                good = theta_trial <= 1e-12 and good and armijo
    if good:
        now.descent = switch and armijo
        run(links[0].accept, (address,))
        now.answer = ACCEPTED
        return
    now.trials += 1
    now.answer = TRY
    if now.trials == 1 and finite and theta_trial >= theta:
        run(links[0].correct, (address,))
        return
    if now.corrected == 1:
        run(links[0].restore, (address,))
    now.alpha *= 0.5
    if now.trials > HALVINGS:
        now.failures += 1
        now.delta = max(1e-3, 100.0 * now.delta)
        now.answer = AGAIN
        if now.failures > (MOST_FAILURES if now.elastic == 1 else FEW_FAILURES):
            if now.elastic == 1 or now.violated == 0:
                now.answer = STALLED
            else:
                run(links[0].relax, (address,))


@linked
def correct(address: int) -> None:
    """Solve again for the constraints as the trial found them, and keep the step in case this does not help."""
    links, pairs, rests, rows, saved, scalars = parts(address, "links pairs rests rows saved scalars")
    sides, step, terms = parts(address, "sides step terms")
    now = scalars[0]
    (constraints,) = parts(address, "trial_constraints")
    alpha = now.alpha
    for k in range(len(step)):
        saved[k] = step[k]
    now.saved_slope, now.saved_alpha, now.saved_dual = now.slope, alpha, now.alpha_dual
    for k in range(now.sides):
        sides[k].saved_dy, sides[k].saved_ds, sides[k].saved_de = sides[k].dy, sides[k].ds, sides[k].de
        c = sides[k].sign * (constraints[sides[k].row] - sides[k].border)
        s, e = sides[k].s + alpha * sides[k].ds, sides[k].e + alpha * sides[k].de
        sides[k].rest = alpha * sides[k].rest + c + e - s
    for k in range(len(rows)):
        row = rows[k]
        rests[row] = alpha * rests[row] + constraints[row] - terms.lower[row]
        if now.elastic == 1:
            pairs[k].saved_dp, pairs[k].saved_dn = pairs[k].dp, pairs[k].dn
            rests[row] += pairs[k].n + alpha * pairs[k].dn - pairs[k].p - alpha * pairs[k].dp
    run(links[0].steer, (address,))
    now.slope = now.saved_slope
    now.corrected = 1


@linked
def restore(address: int) -> None:
    """Go back to the step before its correction."""
    pairs, saved, scalars, sides, step = parts(address, "pairs saved scalars sides step")
    now = scalars[0]
    for k in range(len(step)):
        step[k] = saved[k]
    now.alpha, now.alpha_dual = now.saved_alpha, now.saved_dual
    for k in range(now.sides):
        sides[k].dy, sides[k].ds, sides[k].de = sides[k].saved_dy, sides[k].saved_ds, sides[k].saved_de
    if now.elastic == 1:
        for k in range(len(pairs)):
            pairs[k].dp, pairs[k].dn = pairs[k].saved_dp, pairs[k].saved_dn
    now.corrected = 0


@linked
def accept(address: int) -> None:
    """Move multipliers and slacks and, unless the step was one of descent, remember where it came from."""
    filter, free, multipliers, pairs, penalties = parts(address, "filter free multipliers pairs penalties")
    rows, scalars, sides, step = parts(address, "rows scalars sides step")
    (trial_constraints,) = parts(address, "trial_constraints")
    now = scalars[0]
    alpha, dual, n = now.alpha, now.alpha_dual, len(free)
    mu = now.mu
    total = 0.0
    for k in range(n):
        total += step[k] ** 2
    elastic = now.elastic == 1
    for k in range(len(rows)):
        row = rows[k]
        multipliers[row] += (dual if elastic else alpha) * step[n + k]
        if elastic:
            pairs[k].p += alpha * pairs[k].dp
            pairs[k].n += alpha * pairs[k].dn
            over, under = 1e-10 * mu / pairs[k].p, 1e-10 * mu / pairs[k].n
            multipliers[row] = min(max(multipliers[row], under - penalties[row]), penalties[row] - over)
            pairs[k].dp = pairs[k].dn = 0.0
    for k in range(now.sides):
        s, e = sides[k].s + alpha * sides[k].ds, sides[k].e + alpha * sides[k].de
        c = sides[k].sign * (trial_constraints[sides[k].row] - sides[k].border)
        s = max(s, c + e)  # a longer slack costs nothing
        y = sides[k].y + dual * sides[k].dy
        y = min(max(y, 1e-10 * mu / s), 1e10 * mu / s)  # eq. 16
        sides[k].y, sides[k].s, sides[k].e = min(y, penalties[sides[k].row] - 1e-10 * mu / e), s, e
        sides[k].ds = sides[k].de = 0.0
    if now.descent == 0 and now.filtered < FILTER:
        filter[now.filtered, 0] = (1.0 - GAMMA_THETA) * now.theta
        filter[now.filtered, 1] = now.phi - GAMMA_PHI * now.cost_unit * now.theta
        now.filtered += 1
    now.step, now.taken = alpha * math.sqrt(total), alpha
    now.short_steps = now.short_steps + 1 if alpha < SHORT_STEP else 0
    now.iteration += 1
    now.failures = 0
