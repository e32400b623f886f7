"""The filter line search of the interior point: test a trial, correct it, take it, or look for another direction.

After Waechter and Biegler, Math. Program. 106 (2006), sections 2.3 and 2.4.
"""

from __future__ import annotations

import math

from unifg.machine.links import linked, parts, run
from unifg.solvers.interior_point.barrier import merit
from unifg.solvers.interior_point.state import (
    ACCEPT,
    ACCEPTED,
    AGAIN,
    ALPHA,
    ALPHA_DUAL,
    ANSWER,
    BORDER,
    CORRECT,
    CORRECTED,
    COST_UNIT,
    DE,
    DELTA,
    DESCENT,
    DN,
    DP,
    DS,
    DY,
    ELASTIC,
    FAILURES,
    FILTER,
    FILTERED,
    ITERATION,
    MU,
    PHI,
    RELAX,
    REST,
    RESTORE,
    SAVED_ALPHA,
    SAVED_DE,
    SAVED_DN,
    SAVED_DP,
    SAVED_DS,
    SAVED_DUAL,
    SAVED_DY,
    SAVED_SLOPE,
    SHORT_STEPS,
    SIDES,
    SIGN,
    SLOPE,
    STALLED,
    STEER,
    STEP,
    TAKEN,
    THETA,
    THETA_LARGE,
    THETA_SMALL,
    TOLERANCE,
    TRIAL_COST,
    TRIALS,
    TRY,
    VIOLATION,
    E,
    N,
    P,
    S,
    Y,
)

ARMIJO = 1e-4
GAMMA_THETA, GAMMA_PHI = 1e-5, 1e-8
HALVINGS = 20
FEW_FAILURES, MOST_FAILURES = 2, 8  # of line searches in a row, before equalities become elastic and for good
SHORT_STEP = 0.05  # length of one


@linked
def judge(address: int) -> None:
    """Filter test of a trial point: accept it, shorten the step, correct it, or ask for another direction."""
    counts, filter, links, numbers, rows, side_row = parts(address, "counts filter links numbers rows side_row")
    pairs, prices, row_units, sides, terms = parts(address, "pairs prices row_units sides terms")
    (constraints,) = parts(address, "trial_constraints")
    alpha, theta, phi, slope = numbers[ALPHA], numbers[THETA], numbers[PHI], numbers[SLOPE]
    cost, lower = numbers[TRIAL_COST], terms.lower
    phi_trial, theta_trial = merit(
        numbers, counts, sides, side_row, pairs, prices, row_units, rows, lower, cost, constraints, alpha
    )
    finite = math.isfinite(phi_trial) and math.isfinite(theta_trial)
    slack = 1e-13 * max(1.0, abs(phi))
    switch = slope < 0.0 and alpha * (-slope / numbers[COST_UNIT]) ** 2.3 > theta**1.1 and theta <= numbers[THETA_SMALL]
    armijo = phi_trial <= phi + ARMIJO * alpha * slope + slack
    good = finite and theta_trial <= numbers[THETA_LARGE]
    if good:
        if switch:
            good = armijo
        else:
            good = theta_trial <= (1.0 - GAMMA_THETA) * theta or phi_trial <= phi - GAMMA_PHI * theta + slack
            good = good or theta_trial <= 1e-12
    if good:
        for k in range(counts[FILTERED]):
            if theta_trial >= filter[k, 0] and phi_trial >= filter[k, 1] + slack:
                good = theta_trial <= 1e-12 and good and armijo
    if good:
        counts[DESCENT] = switch and armijo
        run(links[ACCEPT], (address,))
        counts[ANSWER] = ACCEPTED
        return
    counts[TRIALS] += 1
    counts[ANSWER] = TRY
    if counts[TRIALS] == 1 and finite and theta_trial >= theta:
        run(links[CORRECT], (address,))
        return
    if counts[CORRECTED] == 1:
        run(links[RESTORE], (address,))
    numbers[ALPHA] *= 0.5
    if counts[TRIALS] > HALVINGS:
        counts[FAILURES] += 1
        numbers[DELTA] = max(1e-3, 100.0 * numbers[DELTA])
        counts[ANSWER] = AGAIN
        if counts[FAILURES] > (MOST_FAILURES if counts[ELASTIC] == 1 else FEW_FAILURES):
            if counts[ELASTIC] == 1 or numbers[VIOLATION] <= numbers[TOLERANCE]:
                counts[ANSWER] = STALLED
            else:
                run(links[RELAX], (address,))


@linked
def correct(address: int) -> None:
    """Solve again for the constraints as the trial found them, and keep the step in case this does not help."""
    counts, links, numbers, rests, rows, saved = parts(address, "counts links numbers rests rows saved")
    pairs, side_row, sides, step, terms = parts(address, "pairs side_row sides step terms")
    (constraints,) = parts(address, "trial_constraints")
    alpha = numbers[ALPHA]
    for k in range(len(step)):
        saved[k] = step[k]
    numbers[SAVED_SLOPE], numbers[SAVED_ALPHA], numbers[SAVED_DUAL] = numbers[SLOPE], alpha, numbers[ALPHA_DUAL]
    for k in range(counts[SIDES]):
        sides[SAVED_DY, k], sides[SAVED_DS, k], sides[SAVED_DE, k] = sides[DY, k], sides[DS, k], sides[DE, k]
        c = sides[SIGN, k] * (constraints[side_row[k]] - sides[BORDER, k])
        s, e = sides[S, k] + alpha * sides[DS, k], sides[E, k] + alpha * sides[DE, k]
        sides[REST, k] = alpha * sides[REST, k] + c + e - s
    for k in range(len(rows)):
        row = rows[k]
        rests[row] = alpha * rests[row] + constraints[row] - terms.lower[row]
        if counts[ELASTIC] == 1:
            pairs[SAVED_DP, k], pairs[SAVED_DN, k] = pairs[DP, k], pairs[DN, k]
            rests[row] += pairs[N, k] + alpha * pairs[DN, k] - pairs[P, k] - alpha * pairs[DP, k]
    run(links[STEER], (address,))
    numbers[SLOPE] = numbers[SAVED_SLOPE]
    counts[CORRECTED] = 1


@linked
def restore(address: int) -> None:
    """Go back to the step before its correction."""
    counts, numbers, pairs, saved, sides, step = parts(address, "counts numbers pairs saved sides step")
    for k in range(len(step)):
        step[k] = saved[k]
    numbers[ALPHA], numbers[ALPHA_DUAL] = numbers[SAVED_ALPHA], numbers[SAVED_DUAL]
    for k in range(counts[SIDES]):
        sides[DY, k], sides[DS, k], sides[DE, k] = sides[SAVED_DY, k], sides[SAVED_DS, k], sides[SAVED_DE, k]
    if counts[ELASTIC] == 1:
        for k in range(pairs.shape[1]):
            pairs[DP, k], pairs[DN, k] = pairs[SAVED_DP, k], pairs[SAVED_DN, k]
    counts[CORRECTED] = 0


@linked
def accept(address: int) -> None:
    """Move multipliers and slacks and, unless the step was one of descent, remember where it came from."""
    counts, filter, free, multipliers, numbers, rows = parts(address, "counts filter free multipliers numbers rows")
    pairs, prices, side_row, sides, step = parts(address, "pairs prices side_row sides step")
    (trial_constraints,) = parts(address, "trial_constraints")
    alpha, dual, n = numbers[ALPHA], numbers[ALPHA_DUAL], len(free)
    mu = numbers[MU]
    total = 0.0
    for k in range(n):
        total += step[k] ** 2
    elastic = counts[ELASTIC] == 1
    for k in range(len(rows)):
        row = rows[k]
        multipliers[row] += (dual if elastic else alpha) * step[n + k]
        if elastic:
            for which in range(2):
                pairs[P + which, k] += alpha * pairs[DP + which, k]
            over, under = 1e-10 * mu / pairs[P, k], 1e-10 * mu / pairs[N, k]
            multipliers[row] = min(max(multipliers[row], under - prices[row]), prices[row] - over)
            pairs[DP, k] = pairs[DN, k] = 0.0
    for k in range(counts[SIDES]):
        s, e = sides[S, k] + alpha * sides[DS, k], sides[E, k] + alpha * sides[DE, k]
        c = sides[SIGN, k] * (trial_constraints[side_row[k]] - sides[BORDER, k])
        s = max(s, c + e)  # a longer slack costs nothing
        y = sides[Y, k] + dual * sides[DY, k]
        y = min(max(y, 1e-10 * mu / s), 1e10 * mu / s)  # eq. 16
        sides[Y, k], sides[S, k], sides[E, k] = min(y, prices[side_row[k]] - 1e-10 * mu / e), s, e
        sides[DS, k] = sides[DE, k] = 0.0
    if counts[DESCENT] == 0 and counts[FILTERED] < FILTER:
        filter[counts[FILTERED], 0] = (1.0 - GAMMA_THETA) * numbers[THETA]
        filter[counts[FILTERED], 1] = numbers[PHI] - GAMMA_PHI * numbers[THETA]
        counts[FILTERED] += 1
    numbers[STEP], numbers[TAKEN] = alpha * math.sqrt(total), alpha
    counts[SHORT_STEPS] = counts[SHORT_STEPS] + 1 if alpha < SHORT_STEP else 0
    counts[ITERATION] += 1
    counts[FAILURES] = 0
