"""Units of unknowns, constraint rows and cost in which a solve goes the same way, whatever units a graph is written in.

A block is the part of a constraint row that belongs to one coordinate of a family, over all factors of a term. With a
its largest entry, u the unit of the coordinate, r that of the row and k that of the cost, whose largest curvature along
the coordinate is h, the logarithms of the units minimise

    sum (log a + log u - log r)^2 + sum (log h + 2 log u - log k)^2

(Curtis and Reid, IMA J. Appl. Math. 10, 1972). The sum has no other constants in it, so multiplying rows, unknowns or
the cost by a number multiplies their units by the same. One degree of freedom is left. Where the tolerance of the
violation is stated, it tells the unit of the rows: their median is what it is relative to the tolerance of the other
conditions. Else the median of the units of unknowns is one, and that
of rows if it may as well be. Without constraints but bounds, unknowns are measured in
their distances to these.

Where the largest entries of all rows are within a factor of a hundred of each other, and curvatures within 1e9, as in
graphs in usual units, all rows have one unit and all unknowns another.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from unifg.codegen.jit import compiled
from unifg.problem.columns import Columns
from unifg.problem.table import (
    BOUND,
    COLUMN,
    CONSTRAINT,
    COST,
    COUNT,
    ENTRY,
    KIND,
    ROW,
    ROWS,
    SLACKS,
    WIDTH,
    TermArrays,
)
from unifg.typing import Array, IntArray


class Units(NamedTuple):
    """Units of unknowns and rows, and where to find what they are made of.

    Attributes:
        coordinates: (width,) number of the coordinate of a family that each column belongs to.
        free: (n,) columns that are unknown.
        diagonal: (n,) places of their curvatures among the entries of the Hessian.
        blocks, logs, sums: memory.
        rows: (M,) units of the constraint rows.
        unknowns: (width,) of the unknowns.
    """

    coordinates: IntArray
    free: IntArray
    diagonal: IntArray
    blocks: Array
    logs: Array
    sums: Array
    rows: Array
    unknowns: Array


def unit_memory(columns: Columns, diagonal: IntArray, blocks: int, rows: int) -> Units:
    """Units of one, and memory to find others."""
    coordinates, count = columns.coordinates, columns.dimensions
    memory = np.empty(blocks), np.empty(max(blocks, count)), np.empty((5, count))
    return Units(coordinates, columns.free, diagonal, *memory, np.ones(rows), np.ones(columns.width))


NO_DISTANCE = 1e-10  # of an unknown to a bound: it is there
LARGE_PULL = 1e3  # times the curvatures: slopes of the cost from which on it is they that count
LEAST_SHARE = 1e-4  # of the largest curvature, below which a mean of all is not believed
UNIT, CURVATURE, POWER, TOTAL, WEIGHT = range(5)  # rows of memory for each coordinate
SHARE = 0.01  # of the largest product that a gradient is a sum of
SWEEPS = 20  # of the minimisation, one variable after the other
SMALLEST = -14.0  # logarithm of an entry, relative to others, from which on it counts as zero
MODEST = 4.6  # logarithm of a hundred
UNEVEN, OVERFLOW = 20.7, 200.0  # logarithms of ratios of curvatures: below 1e9 they may be weights that are meant
SMALL_FORCES = 100.0  # times the cost: multipliers from which on it is they that count


@compiled
def cost_unit(units: Units, hessian: Array, concavity: Array, gradient: Array) -> float:
    """Geometric mean of the magnitudes of the curvatures of the cost along the unknowns.

    Where nothing is curved it is that of the largest slope and of the sum of all. Slopes far above curvatures count,
    too, and a mean far below the largest curvature does not. One where the cost has neither.

    Args:
        units: of the unknowns.
        hessian: entries of that of Gauss-Newton.
        concavity: what the second derivatives of scalar costs add to them; empty without such costs.
        gradient: (width,) of the cost.
    """
    free, diagonal = units.free, units.diagonal
    logarithms, product, count, pull, slopes, steepest = 0.0, 1.0, 0, 0.0, 0.0, 0.0
    for k in range(len(free)):
        unit = units.unknowns[free[k]]
        slope = abs(gradient[free[k]]) * unit
        pull, slopes = max(pull, slope), slopes + slope
        curvature = abs(hessian[diagonal[k]] + (concavity[diagonal[k]] if len(concavity) else 0.0))
        curvature *= unit**2
        if 0.0 < curvature < math.inf:
            steepest = max(steepest, curvature)
            product *= curvature
            count += 1
            if not 1e-100 < product < 1e100:  # one logarithm for many factors
                logarithms += math.log(product)
                product = 1.0
    if not slopes < math.inf:
        pull = slopes = 0.0
    if count > 0:
        mean = math.exp((logarithms + math.log(product)) / count)
        return max(max(mean, LEAST_SHARE * steepest), pull / LARGE_PULL)
    return math.sqrt(pull * slopes) if pull > 0.0 else 1.0


@compiled
def find_units(
    terms: TermArrays,
    units: Units,
    violation_unit: float,
    hessian: Array,
    concavity: Array,
    gradient: Array,
    slopes: Array,
    constraints: Array,
    jacobian: Array,
) -> None:
    """Write the units of the module's docstring.

    Args:
        terms: of the program.
        units: which are written.
        violation_unit: of the rows in the mean; 0: that of the unknowns is one.
        hessian: of the cost, as for :func:`cost_unit`.
        concavity: the same.
        gradient: the same.
        slopes: entries of the Jacobian of the costs that are squares.
        constraints: (M,) values.
        jacobian: entries of their Jacobian.
    """
    coordinates, blocks, sums = units.coordinates, units.blocks, units.sums
    row_units, unknowns = units.rows, units.unknowns
    fields = terms.fields
    _log_blocks(terms, jacobian, blocks)
    for k in range(sums.shape[1]):
        sums[UNIT, k] = 0.0
    far = _log_rows(terms, units) > MODEST
    bounded = not sums[TOTAL, 0] < math.inf  # at most
    sloped = _log_curvatures(units, hessian, concavity, gradient)
    far = far or _uneven(terms, units, slopes)
    if far or (sloped and not bounded):
        _forget_small(terms, units)
        for _ in range(SWEEPS):
            _sweep(terms, units)
        far = far or _spread(sums) > MODEST
        for k in range(0 if far else sums.shape[1]):
            sums[UNIT, k] = 0.0
        _log_rows(terms, units)
    middle, shift = sums[TOTAL, 0], 0.0
    if bounded:
        middle, shift = 0.0, _bounded(terms, constraints, coordinates, sums)
    elif violation_unit > 0.0:
        shift = math.log(violation_unit) - middle
    elif far:
        shift = -_middle(units)
    elif abs(middle) < MODEST:
        middle = 0.0
    for column in range(len(unknowns)):
        unknowns[column] = math.exp(sums[UNIT, coordinates[column]] + shift)
    for t in range(len(fields)):
        term = fields[t]
        first, m = term[ROW], term[ROWS]
        for row in range(first, first + term[COUNT] * m):
            if term[KIND] == BOUND:
                row_units[row] = unknowns[terms.columns[term[COLUMN] + row - first]]
            elif term[KIND] == CONSTRAINT and row >= first + m:
                row_units[row] = row_units[row - m]
            elif term[KIND] == CONSTRAINT:
                row_units[row] = math.exp((row_units[row] if far and row_units[row] > -math.inf else middle) + shift)


@compiled
def _middle(units: Units) -> float:
    """Median of the logarithms of the units of all coordinates that count."""
    sums, logs, count = units.sums, units.logs, 0
    for k in range(sums.shape[1]):
        if sums[WEIGHT, k] > 0.0:
            logs[count], count = sums[UNIT, k], count + 1
    middle: float = _median(logs, count) if count > 0 else 0.0
    return middle


@compiled
def _median(numbers: Array, count: int) -> float:
    """Median of the first so many, which are sorted."""
    for k in range(1, count):
        number, at = numbers[k], k
        while at > 0 and numbers[at - 1] > number:
            numbers[at] = numbers[at - 1]
            at -= 1
        numbers[at] = number
    middle: float = 0.5 * (numbers[count // 2] + numbers[(count - 1) // 2])
    return middle


@compiled
def _log_rows(terms: TermArrays, units: Units) -> float:
    """Write the logarithm of the largest entry of each row, and into ``sums[TOTAL, 0]`` their median or infinity.

    Returns:
        Largest distance of one from the median.
    """
    fields, sums, logs = terms.fields, units.sums, units.logs
    count, first = 0, 0
    for t in range(len(fields)):
        if fields[t, KIND] == CONSTRAINT:
            for row in range(fields[t, ROW], fields[t, ROW] + fields[t, ROWS]):
                largest = -math.inf
                for d in range(fields[t, WIDTH]):
                    at = units.coordinates[terms.columns[fields[t, COLUMN] + d]]
                    largest = max(largest, units.blocks[first + d] + sums[UNIT, at])
                first += fields[t, WIDTH]
                units.rows[row] = largest
                if largest > -math.inf:
                    logs[count], count = largest, count + 1
    if count == 0:
        sums[TOTAL, 0] = math.inf
        return 0.0
    middle = sums[TOTAL, 0] = _median(logs, count)
    distance: float = max(logs[count - 1] - middle, middle - logs[0])
    return distance


@compiled
def _forget_small(terms: TermArrays, units: Units) -> None:
    """Take blocks for zero whose entries are tiny beside others of their row and of their coordinate."""
    fields, sums = terms.fields, units.sums
    for k in range(sums.shape[1]):
        sums[TOTAL, k] = -math.inf
    for forget in (False, True):
        first = 0
        for t in range(len(fields)):
            if fields[t, KIND] != CONSTRAINT:
                continue
            for row in range(fields[t, ROW], fields[t, ROW] + fields[t, ROWS]):
                for d in range(fields[t, WIDTH]):
                    at = units.coordinates[terms.columns[fields[t, COLUMN] + d]]
                    if not forget:
                        sums[TOTAL, at] = max(sums[TOTAL, at], units.blocks[first + d])
                    elif units.blocks[first + d] < min(sums[TOTAL, at], units.rows[row]) + SMALLEST:
                        units.blocks[first + d] = -math.inf
                first += fields[t, WIDTH]


@compiled
def _log_blocks(terms: TermArrays, jacobian: Array, blocks: Array) -> None:
    """Write the logarithm of the largest entry of each block."""
    fields, first = terms.fields, 0
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] != CONSTRAINT:
            continue
        size, entry = term[ROWS] * term[WIDTH], term[ENTRY]
        for b in range(first, first + size):
            blocks[b] = 0.0
        for _ in range(term[COUNT]):
            for b in range(size):
                magnitude = abs(jacobian[entry + b])
                if blocks[first + b] < magnitude < math.inf:
                    blocks[first + b] = magnitude
            entry += size
        for b in range(first, first + size):
            blocks[b] = math.log(blocks[b]) if blocks[b] > 0.0 else -math.inf
        first += size


@compiled
def _log_curvatures(units: Units, hessian: Array, concavity: Array, gradient: Array) -> bool:
    """Write the logarithms of the largest curvature of the cost along each coordinate, or else of its slope.

    Returns:
        Whether the cost has a slope somewhere where it has no curvature.
    """
    free, diagonal, coordinates, sums, sloped = units.free, units.diagonal, units.coordinates, units.sums, False
    for k in range(sums.shape[1]):
        sums[CURVATURE, k] = sums[POWER, k] = 0.0
    for power in (2, 1):
        for k in range(len(free)):
            at = coordinates[free[k]]
            size = abs(gradient[free[k]])
            if power == 2:
                size = abs(hessian[diagonal[k]] + (concavity[diagonal[k]] if len(concavity) else 0.0))
            if sums[POWER, at] <= power and sums[CURVATURE, at] < size < math.inf:
                sums[CURVATURE, at], sums[POWER, at] = size, power
    for k in range(sums.shape[1]):
        sloped = sloped or sums[POWER, k] == 1.0
        if sums[POWER, k] > 0.0:
            sums[CURVATURE, k] = math.log(sums[CURVATURE, k])
    return sloped


@compiled
def _uneven(terms: TermArrays, units: Units, jacobian: Array) -> bool:
    """Test whether curvatures along coordinates differ by more than weights do, and by less than overflow.

    A coordinate whose entries are all next to nothing beside others of their rows has a curvature by accident: a
    heading of 1e-9 lets an error across see the way ahead.
    """
    fields, columns, sums = terms.fields, terms.columns, units.sums
    share = math.exp(-0.5 * UNEVEN)
    for k in range(sums.shape[1]):
        sums[WEIGHT, k] = -1.0
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] != COST:
            continue
        m, width, entry, column = term[ROWS], term[WIDTH], term[ENTRY], term[COLUMN]
        for _ in range(term[COUNT]):
            for first in range(entry, entry + m * width, width):
                most = 0.0
                for d in range(width):
                    most = max(most, abs(jacobian[first + d]))
                for d in range(width):
                    at = units.coordinates[columns[column + d]]
                    sums[WEIGHT, at] = max(sums[WEIGHT, at], 1.0 if abs(jacobian[first + d]) > share * most else 0.0)
            entry += m * width
            column += width
    least, greatest = math.inf, -math.inf
    for k in range(sums.shape[1]):
        if sums[POWER, k] == 2.0 and sums[WEIGHT, k] != 0.0:
            least, greatest = min(least, sums[CURVATURE, k]), max(greatest, sums[CURVATURE, k])
    return UNEVEN < greatest - least < OVERFLOW


@compiled
def _spread(sums: Array) -> float:
    """Largest distance of the logarithm of a unit from the mean of the least and the largest."""
    least, most = math.inf, -math.inf
    for k in range(sums.shape[1]):
        if sums[WEIGHT, k] > 0.0:
            least, most = min(least, sums[UNIT, k]), max(most, sums[UNIT, k])
    return 0.5 * (most - least)


@compiled
def _sweep(terms: TermArrays, units: Units) -> None:
    """Minimise over the unit of the cost, then over those of all rows, then over those of all coordinates."""
    fields, columns, coordinates = terms.fields, terms.columns, units.coordinates
    blocks, sums, row_units = units.blocks, units.sums, units.rows
    cost, count, first = 0.0, 0, 0
    for k in range(sums.shape[1]):
        if sums[POWER, k] > 0.0:
            cost += sums[CURVATURE, k] + sums[POWER, k] * sums[UNIT, k]
            count += 1
    for k in range(sums.shape[1]):
        power = sums[POWER, k]
        sums[TOTAL, k] = power * (cost / max(count, 1) - sums[CURVATURE, k])
        sums[WEIGHT, k] = power**2
    for t in range(len(fields)):
        term = fields[t]
        if term[KIND] != CONSTRAINT:
            continue
        for row in range(term[ROW], term[ROW] + term[ROWS]):
            total, seen = 0.0, 0
            for d in range(term[WIDTH]):
                if blocks[first + d] > -math.inf:
                    at = coordinates[columns[term[COLUMN] + d]]
                    total += blocks[first + d] + sums[UNIT, at]
                    seen += 1
            row_units[row] = total / max(seen, 1)
            for d in range(term[WIDTH]):
                if blocks[first + d] > -math.inf:
                    at = coordinates[columns[term[COLUMN] + d]]
                    sums[TOTAL, at] += row_units[row] - blocks[first + d]
                    sums[WEIGHT, at] += 1.0
            first += term[WIDTH]
    for k in range(sums.shape[1]):
        if sums[WEIGHT, k] > 0.0:
            sums[UNIT, k] = sums[TOTAL, k] / sums[WEIGHT, k]


@compiled
def _bounded(terms: TermArrays, values: Array, coordinates: IntArray, sums: Array) -> float:
    """Logarithm of a tenth of the mean distance of unknowns to their bounds, or between these; zero without any.

    The power mean of exponent 1/4: neither unknowns at their bounds nor bounds that are never met tell much.
    """
    total, count = 0.0, 0
    for t in range(len(terms.fields)):
        term = terms.fields[t]
        for k in range(term[COUNT] if term[KIND] == BOUND else 0):
            row, unit = term[ROW] + k, sums[UNIT, coordinates[terms.columns[term[COLUMN] + k]]]
            lower, upper = terms.lower[row], terms.upper[row]
            distance = upper - lower
            if not distance < math.inf:
                distance = min(abs(values[row] - lower), abs(upper - values[row]))
            if NO_DISTANCE < distance < math.inf:
                total += math.sqrt(math.sqrt(distance * math.exp(-unit)))
                count += 1
    return 4.0 * math.log(total / count) - math.log(10.0) if total > 0.0 else 0.0


@compiled
def mean_force(terms: TermArrays, multipliers: Array, units: Array) -> float:
    """Mean magnitude of the multipliers of constraints, each times a unit, in :data:`SMALL_FORCES`.

    Limits of slacks do not count: the price of a soft constraint presses on each, violated or not.
    """
    fields, total, count = terms.fields, 0.0, 0
    for t in range(len(fields)):
        if fields[t, KIND] == COST or fields[t, SLACKS] != 0:
            continue
        for row in range(fields[t, ROW], fields[t, ROW] + fields[t, COUNT] * fields[t, ROWS]):
            total += abs(multipliers[row]) * units[row]
            count += 1
    return total / max(count, 1) / SMALL_FORCES


@compiled
def cost_size(diagonal: IntArray, hessian: Array, slope: Array) -> float:
    """Largest slope or curvature of the costs; one where it is larger, or nothing.

    A slope or a multiplier over it is that of costs in a unit in which they are of order one.

    Args:
        diagonal: (n,) places of the curvatures of the unknowns among the entries of the Hessian.
        hessian: entries of that of Gauss-Newton.
        slope: (width,) gradient of the costs.
    """
    size = 0.0
    for k in range(len(diagonal)):
        size = max(size, abs(hessian[diagonal[k]]))
    for k in range(len(slope)):
        size = max(size, abs(slope[k]))
    return size if 0.0 < size < 1.0 else 1.0


@compiled
def worth_of_costs(size: float, diagonal: IntArray, free: IntArray, hessian: Array, slope: Array) -> float:
    """Largest decrease of the costs along one unknown by their model; at least their size, and at most one.

    A product of a multiplier and a distance has the unit of costs, whatever the unknowns are measured in.

    Args:
        size: as of :func:`cost_size`.
        diagonal: (n,) as there.
        free: (n,) columns of the unknowns.
        hessian: as there.
        slope: as there.
    """
    worth = size
    for k in range(len(free)):
        curvature, square = abs(hessian[diagonal[k]]), slope[free[k]] ** 2
        if curvature > 0.0:
            worth = max(worth, min(square / curvature, 1.0))
    return worth


@compiled
def find_sizes(
    terms: TermArrays,
    coordinates: IntArray,
    residual: Array,
    jacobian: Array,
    multipliers: Array,
    constraint_jacobian: Array,
    sizes: Array,
) -> None:
    """Write the sizes of gradients along each coordinate, which no unit enters.

    It is a hundredth of the largest product that a gradient is a sum of: of a residual or a multiplier and an entry of
    its Jacobian.

    Args:
        terms: of the program.
        coordinates: (width,) number of the coordinate that each column belongs to.
        residual: (C,) of all costs.
        jacobian: entries of theirs.
        multipliers: (M,).
        constraint_jacobian: entries of that of the constraints.
        sizes: (coordinates,) result.
    """
    for k in range(len(sizes)):
        sizes[k] = 0.0
    _raise_sizes(terms, coordinates, True, residual, jacobian, sizes)
    _raise_sizes(terms, coordinates, False, multipliers, constraint_jacobian, sizes)


@compiled
def _raise_sizes(
    terms: TermArrays, coordinates: IntArray, costs: bool, values: Array, jacobian: Array, sizes: Array
) -> None:
    """Raise sizes to the largest product of a value of a row and an entry of its Jacobian."""
    fields, columns = terms.fields, terms.columns
    for t in range(len(fields)):
        term = fields[t]
        if (term[KIND] == COST) != costs:
            continue
        m, width, entry, row, column = term[ROWS], term[WIDTH], term[ENTRY], term[ROW], term[COLUMN]
        for _ in range(term[COUNT]):
            for a in range(row, row + m):
                value = SHARE * abs(values[a])
                if value > 0.0:
                    for d in range(width):
                        at = coordinates[columns[column + d]]
                        sizes[at] = max(sizes[at], value * abs(jacobian[entry + d]))
                entry += width
            row += m
            column += width
