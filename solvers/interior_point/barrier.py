"""Newton steps of a primal-dual interior point with elastic constraints, as compiled functions.

Every finite limit of an inequality row is a *side* c(x) >= 0, with c = g - lower or upper - g. It has a slack s and an
elastic variable e with price rho, and both carry a logarithmic barrier:

    min  f(x) + sum rho e - mu log s - mu log e     s.t.  c(x) + e - s = 0,   h(x) = 0

With the multiplier y of a side and z = rho - y, the conditions s y = mu and e z = mu are linearised as they stand
(primal-dual). Eliminating ds, de and dy leaves one scalar per side,

    (H + J' D J) dx + A' lambda+ = -(grad f - J' y) - J' D r,    A dx = -h,    1/D = s/y + e/z,
    r = c + mu/z - mu/y,   dy = -D (J dx + r),   ds = mu/y - s - (s/y) dy,   de = mu/z - e + (e/z) dy,

and one factorisation of the KKT matrix per iteration. The filter line search, its constants, the second-order
correction and the correction of the inertia follow Waechter and Biegler, Math. Program. 106 (2006), sections 2 and 3.
A row that cannot be satisfied has y = rho and e > 0.

Equalities hold as they stand, h(x) = 0, until steps become short or fail. From then on they are elastic too, h = p - n
with p, n > 0 at the price rho: p (rho - lambda) = mu, n (rho + lambda) = mu, and

    A dx - (p / (rho - lambda) + n / (rho + lambda)) dlambda = -h + mu / (rho - lambda) - mu / (rho + lambda).

The phase begins where all of its constraints hold (`_split`), at a mu in proportion to price and violation: an l1
penalty with a smooth edge, which needs no restoration. Its answers are those of the problem as long as no multiplier
is at its price; where one is, the price is raised, until the pull of the objective is small beside the forces that the
constraints exert on each other. Then violation is what is left to minimise, and whoever runs the loop has to find out
whether less of it is to be had (`VIOLATED`); compare Curtis, Schenk and Waechter, SIAM J. Optim. 20 (2010), and Thierry
and Biegler, Optim. Methods Softw. 35 (2020).

s y and e z are the same in any unit of a row. Units (`_find_units`) therefore enter only where numbers of different
rows or unknowns meet: prices, first slacks, sums of violations, shifts of the diagonals, and the error of a barrier
problem.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.machine.jit import compiled
from unifg.machine.links import linked, parts, run
from unifg.program.passes import transposed_times
from unifg.program.table import BOUND, COLUMN, COUNT, ENTRY, KIND, ROW, ROWS, WIDTH, TermArrays
from unifg.solvers.interior_point.state import (
    ANSWER,
    ASKED,
    BORDER,
    COLD,
    COMPLEMENTARITY,
    CONVERGED,
    CORRECTED,
    COST,
    COST_UNIT,
    DE,
    DELTA,
    DN,
    DP,
    DS,
    DY,
    ELASTIC,
    FAILURES,
    FILTERED,
    FORCE,
    GAP,
    GAUSS_NEWTON,
    ITERATION,
    KEPT,
    LAST_DELTA,
    LEAST,
    LIMIT,
    LIMIT_REACHED,
    MEASURE,
    MOST,
    MU,
    NOT_FINITE,
    PAID,
    PHI,
    RAISES,
    RELAX,
    RHO,
    SCALE,
    SCALING,
    SHORT_STEPS,
    SIDES,
    SIGN,
    STALLED,
    STATIONARITY,
    STEP,
    STEP_TOLERANCE,
    STOPPED,
    TAKEN,
    THETA,
    THETA_LARGE,
    THETA_SMALL,
    TOLERANCE,
    TRIALS,
    TRY,
    VIOLATED,
    VIOLATION,
    VIOLATION_TOLERANCE,
    E,
    N,
    P,
    S,
    Y,
)
from unifg.typing import Array, IntArray

OBJECTIVE = 0  # table.COST
KAPPA = 50.0  # mu is lowered when the error of the barrier problem is below KAPPA mu
SOLVED = 50.0  # prices are looked at when it is below SOLVED mu
MOST_SHORT_STEPS = 5  # in a row, before equalities become elastic
RELAXED_MU = 1e-2  # of price times violation: first mu with elastic equalities
LATE_MU = 1e-3  # the same: largest mu at which a violation is taken seriously
AT_PRICE = 0.9  # share of the price from which on a multiplier is at it
SMALL_PULL = 1e-2  # share of the constraints' forces below which the objective's force counts for nothing
MOST_RAISES = 6  # of prices, tenfold each
LARGE_PULL = 1e3  # force of the objective from which on mu and prices are in proportion to it
FAR = 100.0  # from one: largest entry of a row that calls for other units
SWEEPS = 8
BOTTOMLESS = -1e12  # an objective below it, while constraints are violated
FIRST_SLACK = 1e-2  # smallest slack of a cold start
WARM_MU = 1e-5  # largest first mu of a start with multipliers: what is active has been found


@compiled
def merit(
    numbers: Array,
    counts: IntArray,
    sides: Array,
    side_row: IntArray,
    pairs: Array,
    prices: Array,
    row_units: Array,
    rows: IntArray,
    lower: Array,
    cost: float,
    constraints: Array,
    alpha: float,
) -> tuple[float, float]:
    """Barrier function, and violation of sides and equality rows, after a step of what makes them elastic."""
    elastic, logarithms, product, theta = 0.0, 0.0, 1.0, 0.0
    for k in range(counts[SIDES]):
        s, e = sides[S, k] + alpha * sides[DS, k], sides[E, k] + alpha * sides[DE, k]
        row = side_row[k]
        c = sides[SIGN, k] * (constraints[row] - sides[BORDER, k])
        theta += abs(c + e - s) / row_units[row]
        elastic += prices[row] * e
        product *= s * e
        if k & 3 == 3:  # one logarithm for eight factors, each of moderate size
            logarithms += math.log(product)
            product = 1.0
    logarithms += math.log(product)
    if counts[ELASTIC] == 0:
        for row in rows:
            theta += abs(constraints[row] - lower[row]) / row_units[row]
    else:
        product = 1.0
        for k in range(len(rows)):
            row, p, n = rows[k], pairs[P, k] + alpha * pairs[DP, k], pairs[N, k] + alpha * pairs[DN, k]
            theta += abs(constraints[row] - lower[row] - p + n) / row_units[row]
            elastic += prices[row] * (p + n)
            product *= p * n
            if k & 3 == 3:
                logarithms += math.log(product)
                product = 1.0
        logarithms += math.log(product)
    return cost + elastic - numbers[MU] * logarithms, theta


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
    constraint_jacobian, constraints, counts, free = parts(address, "constraint_jacobian constraints counts free")
    full, gradient, multipliers, numbers, side_row = parts(address, "full gradient multipliers numbers side_row")
    pairs, prices, row_units, rows, sides = parts(address, "pairs prices row_units rows sides")
    terms, units = parts(address, "terms units")
    lower, upper, constraints, full = terms.lower, terms.upper, constraints, full
    gap, least, most = 0.0, math.inf, -math.inf
    for k in range(counts[SIDES]):
        multipliers[side_row[k]] = 0.0
    for k in range(counts[SIDES]):
        row, y = side_row[k], sides[Y, k]
        multipliers[row] -= sides[SIGN, k] * y
        sy, ez = sides[S, k] * y, sides[E, k] * (prices[row] - y)
        least, most = min(least, min(sy, ez)), max(most, max(sy, ez))
        c = sides[SIGN, k] * (constraints[row] - sides[BORDER, k])
        gap = max(gap, abs(c + sides[E, k] - sides[S, k]) / row_units[row])
    for k in range(len(full)):
        full[k] = gradient[k]
    transposed_times(terms, False, constraint_jacobian, multipliers, full)
    stationarity = force = violation = paid = complementarity = size = 0.0
    for column in free:
        if not abs(full[column]) <= stationarity:  # NaN stays
            stationarity = abs(full[column])
        force = max(force, abs(full[column]) * units[column])
    for row in range(len(constraints)):
        value, multiplier = constraints[row], multipliers[row]
        size += abs(multiplier)
        outside = max(value - upper[row], lower[row] - value)
        if not outside <= violation:
            violation = outside
        paid = max(paid, outside * prices[row])
        if lower[row] != upper[row]:
            limit = upper[row] if multiplier > 0.0 else lower[row]
            slack = abs(value - limit) if math.isfinite(limit) else 1.0
            complementarity = max(complementarity, abs(multiplier) * slack)
    if counts[ELASTIC] == 0:
        for row in rows:
            gap = max(gap, abs(constraints[row] - lower[row]) / row_units[row])
    else:
        for k in range(len(rows)):
            row, p, n = rows[k], pairs[P, k], pairs[N, k]
            pz, nz = p * (prices[row] - multipliers[row]), n * (prices[row] + multipliers[row])
            least, most = min(least, min(pz, nz)), max(most, max(pz, nz))
            gap = max(gap, abs(constraints[row] - lower[row] - p + n) / row_units[row])
    scale = max(1.0, size / max(1, len(constraints)) / 100.0)
    numbers[SCALE], numbers[STATIONARITY], numbers[VIOLATION] = scale, stationarity / scale, violation
    numbers[COMPLEMENTARITY], numbers[GAP], numbers[LEAST], numbers[MOST] = complementarity / scale, gap, least, most
    numbers[FORCE], numbers[PAID] = force / scale, paid


@compiled
def _error(numbers: Array) -> float:
    """Error of the barrier problem."""
    centring = max(numbers[MOST] - numbers[MU], numbers[MU] - numbers[LEAST]) / numbers[SCALE]
    error: float = max(max(numbers[FORCE], numbers[GAP]), centring)
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


@compiled
def _far_from_one(terms: TermArrays, jacobian: Array) -> bool:
    """Whether some row of the constraint Jacobian has its largest entry far from one."""
    fields = terms.fields
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] == OBJECTIVE or term[KIND] == BOUND:
            continue
        width, entry = term[WIDTH], term[ENTRY]
        for _ in range(term[COUNT] * term[ROWS]):
            largest = 0.0
            for d in range(width):
                largest = max(largest, abs(jacobian[entry + d]))
            if not (FAR > largest > 1.0 / FAR or largest == 0.0):
                return True
            entry += width
    return False


@compiled
def _find_units(
    terms: TermArrays, jacobian: Array, row_units: Array, units: Array, row_size: Array, column_size: Array
) -> None:
    """Units of rows and unknowns in which the largest entries of the constraint Jacobian are near one (Ruiz 2001).

    They are one where no row has its largest entry far from one, those of fixed variables included.
    """
    fields, columns, unknowns = terms.fields, terms.columns, terms.unknown
    for row in range(len(row_units)):
        row_units[row] = 1.0
    for column in range(len(units)):
        units[column] = 1.0
    if not _far_from_one(terms, jacobian):
        return
    for _ in range(SWEEPS):
        for row in range(len(row_size)):
            row_size[row] = 0.0
        for column in range(len(column_size)):
            column_size[column] = 0.0
        for t in range(len(fields)):
            term = fields[t]
            if term[KIND] == OBJECTIVE:
                continue
            m, width, entry = term[ROWS], term[WIDTH], term[ENTRY]
            for i in range(term[COUNT]):
                for a in range(m):
                    row = term[ROW] + i * m + a
                    largest = 0.0
                    for d in range(width):
                        column = columns[term[COLUMN] + i * width + d]
                        if unknowns[column] >= 0:
                            size = 1.0 if term[KIND] == BOUND else abs(jacobian[entry + (i * m + a) * width + d])
                            size *= units[column] / row_units[row]
                            largest = max(largest, size)
                            column_size[column] = max(column_size[column], size)
                    row_size[row] = largest
        for row in range(len(row_size)):
            if 0.0 < row_size[row] < math.inf:
                row_units[row] *= math.sqrt(row_size[row])
        for column in range(len(column_size)):
            if 0.0 < column_size[column] < math.inf:
                units[column] /= math.sqrt(column_size[column])


@linked
def begin(address: int) -> None:
    """Find the sides; choose mu, slacks and multipliers of a start that has been linearised."""
    constraints, counts, links, multipliers, numbers = parts(address, "constraints counts links multipliers numbers")
    constraint_jacobian, free, gradient, pairs, prices = parts(
        address, "constraint_jacobian free gradient pairs prices"
    )
    full, row_units, rows, side_row, sides = parts(address, "full row_units rows side_row sides")
    terms, units = parts(address, "terms units")
    lower, upper = terms.lower, terms.upper
    count = 0
    for row in range(len(lower)):
        if lower[row] != upper[row]:
            for which in range(2):
                limit = lower[row] if which == 0 else upper[row]
                if math.isfinite(limit):
                    side_row[count] = row
                    sides[SIGN, count], sides[BORDER, count] = 1.0 - 2.0 * which, limit
                    count += 1
    counts[SIDES], counts[ELASTIC] = count, 0 if len(rows) else 1
    numbers[COST_UNIT] = 1.0
    if counts[SCALING] == 1:
        _find_units(terms, constraint_jacobian, row_units, units, prices, full)
        pull = 0.0
        for column in free:
            pull = max(pull, abs(gradient[column]) * units[column])
        if pull > LARGE_PULL:
            unit = numbers[COST_UNIT] = pull / LARGE_PULL
            numbers[RHO] *= unit
            numbers[MU] *= unit
    largest = 0.0
    for row in range(len(lower)):
        largest = max(largest, abs(multipliers[row]) * row_units[row])
    warm = largest > 0.0
    counts[COLD] = 0 if warm else 1
    if largest > 0.5 * numbers[RHO]:
        numbers[RHO] = 10.0 * largest
    for row in range(len(lower)):
        prices[row] = numbers[RHO] / row_units[row]
    if warm:
        for k in range(count):
            c = sides[SIGN, k] * (constraints[side_row[k]] - sides[BORDER, k])
            y = min(max(-sides[SIGN, k] * multipliers[side_row[k]], 0.0), 0.9 * prices[side_row[k]])
            sides[Y, k], sides[S, k], sides[E, k] = y, c, 0.0
        run(links[MEASURE], (address,))
        error = max(max(numbers[STATIONARITY], numbers[VIOLATION]), numbers[COMPLEMENTARITY])
        numbers[MU] = max(min(0.1 * error, WARM_MU), 0.1 * numbers[TOLERANCE])
    mu = numbers[MU]
    for k in range(count):
        row = side_row[k]
        unit, price = row_units[row], prices[row]
        c = sides[SIGN, k] * (constraints[row] - sides[BORDER, k])
        if warm:
            s = max(c, min(mu / max(sides[Y, k], 1e-3 * mu / unit), FIRST_SLACK * unit))
            y = max(sides[Y, k], mu / s)
        else:
            s = max(c, FIRST_SLACK * unit)
            y = mu / s
        y = min(y, 0.9 * price)
        sides[Y, k], sides[S, k], sides[E, k] = y, s, mu / (price - y)
        sides[DS, k] = sides[DE, k] = sides[DY, k] = 0.0
    theta = merit(numbers, counts, sides, side_row, pairs, prices, row_units, rows, lower, 0.0, constraints, 0.0)[1]
    numbers[THETA_SMALL], numbers[THETA_LARGE] = 1e-4 * max(1.0, theta), 1e4 * max(1.0, theta)
    counts[FILTERED] = counts[FAILURES] = counts[SHORT_STEPS] = 0
    numbers[DELTA] = numbers[LAST_DELTA] = numbers[STEP] = numbers[TAKEN] = 0.0
    run(links[MEASURE], (address,))


@linked
def test(address: int) -> None:
    """Test the iterate; if there is to be a step, lower mu and measure what the line search compares with."""
    constraints, counts, links, log, numbers, rows = parts(address, "constraints counts links log numbers rows")
    constraint_jacobian, free, full, gradient, kept = parts(address, "constraint_jacobian free full gradient kept")
    multipliers, pairs, prices, row_units = parts(address, "multipliers pairs prices row_units")
    side_row, sides = parts(address, "side_row sides")
    terms, values = parts(address, "terms values")
    if counts[FAILURES] == 0:
        row = log[min(counts[ITERATION], len(log) - 1)]
        row[0], row[1], row[2] = numbers[COST], numbers[STATIONARITY], numbers[VIOLATION]
        row[3], row[4], row[5] = numbers[COMPLEMENTARITY], numbers[STEP], numbers[TAKEN]
        row[6], row[7], row[8] = numbers[MU], numbers[DELTA], counts[GAUSS_NEWTON]
    tolerance = numbers[TOLERANCE]
    worst = max(max(numbers[STATIONARITY], numbers[VIOLATION]), numbers[COMPLEMENTARITY])
    if not math.isfinite(numbers[STATIONARITY] + numbers[VIOLATION] + numbers[COST]):
        counts[ANSWER] = NOT_FINITE
        return
    guessed = counts[COLD] == 1 and counts[ITERATION] == 0 and counts[SIDES] > 0  # large multipliers hide forces
    if worst <= tolerance and not guessed:
        counts[ANSWER] = CONVERGED
        return
    # With a larger mu, what is active has not been found, and short steps are those towards another problem's answer.
    if numbers[STEP] < numbers[STEP_TOLERANCE] * numbers[TAKEN] and numbers[MU] <= WARM_MU:
        if numbers[VIOLATION] < numbers[VIOLATION_TOLERANCE]:
            counts[ANSWER] = STOPPED
            return
    if numbers[VIOLATION] <= tolerance:
        counts[KEPT] = 1
        for k in range(len(values)):
            kept[k] = values[k]
    if counts[ITERATION] >= counts[LIMIT]:
        counts[ANSWER] = LIMIT_REACHED
        return
    if numbers[COST] < BOTTOMLESS * numbers[COST_UNIT] and numbers[VIOLATION] > tolerance:
        counts[ANSWER] = STALLED  # no price holds back an objective that falls faster than violation grows
        return
    if counts[SHORT_STEPS] >= MOST_SHORT_STEPS and counts[ELASTIC] == 0 and numbers[VIOLATION] > tolerance:
        run(links[RELAX], (address,))
    smallest = 0.1 * tolerance
    bound = False
    if _error(numbers) <= SOLVED * numbers[MU] and numbers[VIOLATION] > tolerance:
        # Whether something is violated because its price is too low, or because it has to be. With the least mu that
        # is told by a solved problem: a step before, equalities without a price may still be on their way.
        bound = numbers[MU] <= smallest and _error(numbers) <= tolerance
        if numbers[MU] <= LATE_MU * min(numbers[PAID], numbers[RHO]):
            for k in range(counts[SIDES]):
                bound = bound or (sides[Y, k] > AT_PRICE * prices[side_row[k]] and sides[E, k] > tolerance)
            for k in range(len(rows) if counts[ELASTIC] == 1 else 0):
                row, away = rows[k], max(pairs[P, k], pairs[N, k])
                bound = bound or (abs(multipliers[row]) > AT_PRICE * prices[row] and away > tolerance)
        if bound:
            pull, push = _forces(terms, free, gradient, multipliers, constraint_jacobian, full)
            run(links[MEASURE], (address,))  # it was written over
            highest = counts[RAISES] >= MOST_RAISES
            if numbers[ASKED] < numbers[RHO] and (highest or pull <= SMALL_PULL * push):
                numbers[ASKED], counts[ANSWER] = numbers[RHO], VIOLATED
                return
            if highest:
                counts[ANSWER] = STALLED
                return
            counts[RAISES] += 1
            numbers[RHO] *= 10.0
            for row in range(len(prices)):
                prices[row] *= 10.0
            numbers[PAID] *= 10.0
            run(links[RELAX], (address,))
    while not bound and _error(numbers) <= KAPPA * numbers[MU] and numbers[MU] > smallest:
        less = min(0.2 * numbers[MU], numbers[MU] ** 1.5)
        numbers[MU] = less if less > tolerance else smallest
        counts[FILTERED] = 0
    cost, lower = numbers[COST], terms.lower
    phi, theta = merit(numbers, counts, sides, side_row, pairs, prices, row_units, rows, lower, cost, constraints, 0.0)
    numbers[PHI], numbers[THETA] = phi, theta
    counts[TRIALS], counts[CORRECTED], counts[ANSWER] = 0, 0, TRY


@linked
def relax(address: int) -> None:
    """Make the equalities elastic: what the iterate violates is paid for, and the path to the answer begins anew."""
    constraints, counts, links, multipliers, numbers = parts(address, "constraints counts links multipliers numbers")
    pairs, prices, row_units, rows, side_row = parts(address, "pairs prices row_units rows side_row")
    sides, terms = parts(address, "sides terms")
    counts[ELASTIC], counts[FILTERED], counts[FAILURES], counts[SHORT_STEPS] = 1, 0, 0, 0
    numbers[DELTA] = numbers[LAST_DELTA] = 0.0
    mu = numbers[MU] = max(numbers[MU], RELAXED_MU * min(numbers[PAID], numbers[RHO]))
    for k in range(counts[SIDES]):
        row = side_row[k]
        c = sides[SIGN, k] * (constraints[row] - sides[BORDER, k])
        s, e = _split(c, prices[row], mu)
        sides[S, k], sides[E, k], sides[Y, k] = s, e, mu / s
        sides[DS, k] = sides[DE, k] = sides[DY, k] = 0.0
    for k in range(len(rows)):
        row = rows[k]
        p, n = _split(constraints[row] - terms.lower[row], 2.0 * prices[row], mu)
        # p (price - multiplier) = mu and n (price + multiplier) = mu
        multipliers[row] = prices[row] - mu / p if p > n else mu / n - prices[row]
        pairs[P, k], pairs[N, k], pairs[DP, k], pairs[DN, k] = p, n, 0.0, 0.0
    run(links[MEASURE], (address,))
    theta = merit(numbers, counts, sides, side_row, pairs, prices, row_units, rows, terms.lower, 0.0, constraints, 0.0)[
        1
    ]
    numbers[THETA_LARGE] = max(numbers[THETA_LARGE], 1e4 * max(1.0, theta))
