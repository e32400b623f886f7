"""Derivatives of the KKT conditions at a point with respect to a datum or fixed variables, term by term.

Of each term r and J are known exactly, and their derivatives with respect to an argument p are taken from central
differences of these first-order quantities at a fixed point, at four points (error h^4, h = 1e-4 of the number); where
steps of h and 2 h disagree in slope or curvature, there is a kink or a jump, and nothing is returned. What weights,
losses, limits and multipliers make of r and J is derived by hand. With M = W'W, s = r'M r, w = rho'(s), b = rho''(s)
and u = w M r a cost has the gradient J'u, and

    d(J'u) = dJ'u + J'du,    du = w (M dr + dM r) + b (2 r'M dr + r'dM r) M r.

Elements of manifolds move by right perturbations, other data number by number.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.factors.differences import scalar_slopes, slopes
from unifg.factors.robust import bend_of, form_of
from unifg.lie import Manifold, Rn
from unifg.modeling.elements import elements_of
from unifg.modeling.probing import blocks_of
from unifg.modeling.soft import Slack
from unifg.modeling.terms import Constraint, Cost, ScalarCost
from unifg.modeling.variables import Data, Selection
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.term import CompiledTerm, resolve
from unifg.typing import Array, BoolArray, IntArray

STEP, SMALL = 1e-4, 1e-4  # of a number; numbers are no smaller than this part of the largest
SMOOTH = 1e-3  # relative difference of slopes from two steps above which there is a kink
ROUNDING = 1e-9  # of r and J: slopes below this over the step are noise
TIMES = np.array([0.0, 1.0, -1.0, 2.0, -2.0])
LONGEST = 20_000  # factors in one call


class Parameter(NamedTuple):
    """A datum or fixed variables, by which derivatives are taken.

    Attributes:
        name: for messages.
        handle: the datum, None for fixed variables.
        manifold: of its rows; None for plain numbers.
        shape: of its coordinates.
        numbers: (width,) which coordinate moves a full tangent column, -1 where none does.
        fixed: whether it moves any.
    """

    name: str
    handle: Data | None
    manifold: Manifold | None
    shape: tuple[int, ...]
    numbers: IntArray
    fixed: bool


class Part(NamedTuple):
    """Effect of one argument, weight or limit of a term.

    Attributes:
        numbers: (n, k) coordinates of the parameter; -1 for none.
        slopes: (n, D, k) of the gradient of the Lagrangian by the term's columns.
        rows: (n, m, k) of the constraints less their limits.
        heights: (n, k) of the Lagrangian.
    """

    numbers: IntArray
    slopes: Array
    rows: Array
    heights: Array


def datum(program: CompiledProblem, handle: Data) -> Parameter:
    """A datum as a parameter.

    Raises:
        GraphError: it has no derivative, or stands for elements of different manifolds.
    """
    if handle.value.dtype == bool:
        raise GraphError(f"sensitivity: data '{handle.name}' are booleans, which have no derivative")
    fixes = [fix for fix in program.graph.fixes if fix.value is handle]
    found = {fix.selection.manifold for fix in fixes}
    for term in program.terms:
        elements = elements_of(term.term.residual)
        found |= {elements[k] for k, a in enumerate(term.term.arguments) if a is handle and k in elements}
    if len(found) > 1:
        names = " and of ".join(sorted(manifold.name for manifold in found))
        raise GraphError(f"sensitivity: data '{handle.name}' are elements of {names}: declare one for each")
    manifold, shape = (found.pop() if found else None), handle.value.shape
    if manifold is not None:
        shape = (*shape[:-1], manifold.dim)
    numbers = np.full(program.columns.width, -1)
    for fix in fixes:
        columns = program.columns.fixed[fix.name]
        numbers[columns] = np.broadcast_to(np.arange(np.prod(shape, dtype=int)).reshape(shape), columns.shape)
    return Parameter(handle.name, handle, manifold, shape, numbers, bool(fixes))


def fixed_variables(program: CompiledProblem, selection: Selection) -> Parameter:
    """Fixed variables as a parameter.

    Raises:
        GraphError: one of them is unknown.
    """
    columns, name = program.columns.of(selection), selection.family.name
    if (program.columns.unknown[columns] >= 0).any():
        raise GraphError(
            f"sensitivity: family '{name}' is solved for: wrt= takes data and fixed variables", family=name
        )
    numbers = np.full(program.columns.width, -1)
    numbers[columns] = np.arange(columns.size).reshape(columns.shape)
    return Parameter(name, None, None, columns.shape, numbers, bool(columns.size))


def parts_of(
    program: CompiledProblem, values: Values, multipliers: Array, wrt: Parameter
) -> Iterator[tuple[int, Part]]:
    """Parts of all terms that a datum moves, each with the number of its term; fixed variables are no part of this.

    Args:
        program: the compiled graph, with its data bound.
        values: where.
        multipliers: (M,) there.
        wrt: the parameter.

    Raises:
        GraphError: naming a term that has no derivative there.
    """
    starts, handle = iter(program.slices), wrt.handle
    for number, term in enumerate(program.terms if handle is not None and handle.value.size else ()):
        own = next(starts) if isinstance(term.term, Constraint) else None
        forces = np.ones((term.count, 1)) if own is None else multipliers[own].reshape(term.count, term.size)
        for place, argument in enumerate(term.term.arguments):
            if argument is wrt.handle and place in term._inputs:
                family, squares = term.term.selections[0].family, isinstance(term.term, Cost)
                slack = next((s for s in program.soft.values() if squares and s.family is family), None)
                priced = _squared(term, values, slack, handle) if slack and handle else None
                yield number, priced or _moved(term, values, forces, place, wrt)
        if handle is None or handle not in term.term.shaping:
            continue
        if isinstance(term.term, Cost):
            yield number, _weighed(term, values, handle)
        elif own is not None:
            yield number, _limited(term, forces, program.equality[own].reshape(forces.shape), handle)


def _squared(term: CompiledTerm, values: Values, slack: Slack, handle: Data) -> Part:
    """The part of square prices of slacks: they enter by their root, which has no slope at zero."""
    given = values[slack.family]
    n, m = slack.signed(given).shape
    numbers = np.broadcast_to(np.arange(handle.value.size).reshape(handle.value.shape), (n, m))
    slopes = given[:, :, None] * (np.arange(given.shape[1])[:, None] % m == np.arange(m))
    return _part(term, numbers, slopes, np.zeros((n, 0, m)), 0.5 * (slopes * given[:, :, None]).sum(axis=1))


def _moved(term: CompiledTerm, values: Values, forces: Array, place: int, wrt: Parameter) -> Part:
    """The part of an argument of a term's function."""
    points = term.points(values)
    base = np.asarray(term._batched.fill(points)[place], dtype=np.float64)
    each = _has_rows(term, points, place)
    manifold = wrt.manifold or Rn(base.size // (term.count if each else 1))
    rows, dim = base.reshape(-1, manifold.storage), manifold.dim
    own = np.arange(len(rows) * dim).reshape(-1, dim if each else len(rows) * dim)
    if each:
        steps = np.broadcast_to(np.eye(dim)[:, None], (dim, len(rows), dim))
    else:
        steps, own = np.eye(len(rows) * dim).reshape(-1, len(rows), dim), np.repeat(own, term.count, axis=0)
    steps = steps * (_lengths(rows) if isinstance(manifold, Rn) else STEP)
    chunk, found = max(1, LONGEST // (len(TIMES) * term.count)), []
    for first in range(0, len(steps), chunk):
        part = steps[first : first + chunk]
        moves = (TIMES[:, None, None] * part[:, None]).reshape(-1, dim)
        many = np.broadcast_to(rows, (len(TIMES) * len(part), *rows.shape)).reshape(-1, manifold.storage)
        there = np.asarray(manifold.retract(many, moves)).reshape(-1, *base.shape)
        length = part.max(axis=2)
        length = length if each else np.repeat(length.max(axis=1)[:, None], term.count, axis=1)
        values_there, jacobians = _evaluated(term, points, place, there)
        r, J = values_there[0], jacobians[0]  # at the point itself
        found.append([_slope(term, wrt.name, f, length) for f in (values_there, jacobians)])
    residual, jacobian = found[0] if len(found) == 1 else (np.concatenate(f, axis=-1) for f in zip(*found, strict=True))
    if isinstance(term.term, Cost):
        return _of_cost(term, own, J, r, jacobian, residual, np.zeros((1, 1, 1, 1)))
    limited = residual if isinstance(term.term, Constraint) else residual[:, :0]
    height = np.einsum("nmk,nm->nk", residual, forces)
    return _part(term, own, np.einsum("nmdk,nm->ndk", jacobian, forces), limited, height)


def _part(term: CompiledTerm, numbers: IntArray, *made: Array) -> Part:
    """A part, without what factors that are not active do."""
    return Part(numbers, *map(term._masked, made))


def _lengths(rows: Array) -> Array:
    """Steps of numbers: in proportion, of large ones to the root."""
    size = np.abs(rows)
    size = np.maximum(size, SMALL * (size.max(initial=0.0) or 1.0))
    return STEP * np.minimum(size, np.sqrt(size))


def _slope(term: CompiledTerm, name: str, found: Array, length: Array) -> Array:
    """(n, ..., K) derivatives from (5 K, n, ...) values at `TIMES` of (K, n) steps.

    Raises:
        GraphError: two steps disagree.
    """
    out, (count, factors) = np.empty((*found.shape[1:], len(length))), length.shape
    wanted = np.ones(factors, dtype=bool) if term.active is None else term.active
    shape = count, len(TIMES), factors, -1
    index = slopes_of(found.reshape(shape), np.ascontiguousarray(length), wanted, out.reshape(*shape[2:], count))
    if index >= 0:
        raise GraphError(
            f"sensitivity: term '{term.name}' has a kink or a jump near the present '{name}' (factor {index}), and no "
            "derivative there: smooth the function, or ask elsewhere",
            term=term.name,
            index=index,
        )
    return out


@compiled
def slopes_of(found: Array, length: Array, wanted: BoolArray, out: Array) -> int:
    """Write (n, w, K) derivatives from (K, 5, n, w) values; the first factor with a kink or a jump, -1 for none."""
    count, _, factors, width = found.shape
    steepest = largest = 0.0
    for k in range(count):
        for i in range(factors):
            h = length[k, i]
            for c in range(width):
                near = (found[k, 1, i, c] - found[k, 2, i, c]) / (2.0 * h)
                far = (found[k, 3, i, c] - found[k, 4, i, c]) / (4.0 * h)
                out[i, c, k] = (4.0 * near - far) / 3.0
                if wanted[i]:
                    steepest, largest = max(steepest, abs(near)), max(largest, abs(found[k, 0, i, c]))
    for k in range(count):
        for i in range(factors):
            h, doubt = length[k, i], SMOOTH * steepest + ROUNDING * largest / length[k, i]
            for c in range(width):
                ahead, behind = found[k, 1, i, c], found[k, 2, i, c]
                two_ahead, two_behind = found[k, 3, i, c], found[k, 4, i, c]
                turned = abs((ahead - behind) / (2.0 * h) - (two_ahead - two_behind) / (4.0 * h))
                bent = abs(two_ahead + two_behind + 6.0 * found[k, 0, i, c] - 4.0 * (ahead + behind)) / (4.0 * h)
                if wanted[i] and not (turned <= doubt and bent <= doubt):
                    return i
    return -1


def _has_rows(term: CompiledTerm, points: list[Array], place: int) -> bool:
    """Test whether a datum is known to have a row for each factor."""
    if term.kernel is None:
        return place in term._batched._each
    return len(term.kernel.rows_of(term._for_kernel(points))[term._inputs.index(place)]) == term.count > 1


def _evaluated(term: CompiledTerm, points: list[Array], place: int, there: Array) -> tuple[Array, Array]:
    """(T, n, m) values and (T, n, m, D) Jacobians of a term, for T values (T, ...) of an argument."""
    times, count, m, kernel = len(there), term.count, term.size, term.kernel
    if kernel is not None:
        rows, slot = kernel.rows_of(term._for_kernel(points)), term._inputs.index(place)
        own = there.reshape(times, *rows[slot].shape)
        own = own if own.shape[1] == count else np.repeat(own, count, axis=1)
        chosen = np.tile(np.arange(count), times)
        given = [row[chosen] if len(row) > 1 else row for row in rows]
        given[slot] = own.reshape(-1, *own.shape[2:])
        variable = [
            term._inputs[k] in term._places for k, a in enumerate(kernel.arguments) if not isinstance(a, int | tuple)
        ]
        r, blocks = kernel.both(*given)
        J = np.concatenate([block for block, kept in zip(blocks, variable, strict=True) if kept], axis=2)
        return r.reshape(times, count, m), J.reshape(times, count, m, -1)
    residual, jacobian = np.empty((times, count, m)), np.empty((times, count, m, sum(term.dims)))
    kept = term._arguments
    try:
        for k, value in enumerate(there):
            now = [value if place == p else point for p, point in zip(term._places, points, strict=True)]
            term._arguments = [*kept[:place], value, *kept[place + 1 :]]
            term._bind_batched(term._batched)
            residual[k] = term._batched.at(now).reshape(count, m)
            if isinstance(term.term, ScalarCost):
                found = [scalar_slopes(term._batched, term._directions, now)[0][:, None]]
            elif term._jacobian is None:
                found = slopes(term._batched, term._directions, now)
            else:
                blocks_there = term._jacobian(*term._batched.fill(now))
                found = blocks_of(term.name, blocks_there, term.term.arguments, count, m)
            jacobian[k] = np.concatenate(found, axis=2)
    finally:
        term._arguments = kept
        term._bind_batched(term._batched)
    return residual, jacobian


def _of_cost(
    term: CompiledTerm,
    numbers: IntArray,
    J: Array,
    r: Array,
    jacobian: Array,
    residual: Array,
    metric: Array,
) -> Part:
    """The part of a cost, of the derivatives (n, m, D, k) of J, (n, m, k) of r and (n, m, m, k) of M."""
    cost, m = term.term, term.size
    assert isinstance(cost, Cost)
    M = np.eye(m)
    if cost.information is not None:
        M = resolve(cost.information, term._data)
    elif cost.sigma is not None:
        M = np.eye(m) / np.square(np.broadcast_to(resolve(cost.sigma, term._data), (term.count, m)))[:, None]
    M = np.broadcast_to(M, (term.count, m, m))
    Mr = np.einsum("nab,nb->na", M, r)
    squared, form = np.einsum("na,na->n", r, Mr), form_of(cost.robust)
    assert form is not None
    w = np.ones(len(r)) if cost.robust is None else cost.robust.weight(squared)
    b = np.array([bend_of(*form, s) for s in squared])
    dMr = np.einsum("nabk,nb->nak", metric, r)
    bent = np.einsum("na,nak->nk", r, dMr)
    moved = 2.0 * np.einsum("na,nak->nk", Mr, residual) + bent
    du = w[:, None, None] * (np.einsum("nab,nbk->nak", M, residual) + dMr)
    du += b[:, None, None] * Mr[:, :, None] * moved[:, None]
    slopes = np.einsum("nmdk,nm->ndk", jacobian, w[:, None] * Mr) + np.einsum("nmd,nmk->ndk", J, du)
    empty = np.zeros((len(r), 0, numbers.shape[1]))
    return _part(term, numbers, slopes, empty, 0.5 * w[:, None] * moved)


def _weighed(term: CompiledTerm, values: Values, handle: Data) -> Part:
    """The part of sigma or information; of a matrix, of both entries across the diagonal alike."""
    cost, (n, m) = term.term, (term.count, term.size)
    assert isinstance(cost, Cost)
    present = resolve(handle, term._data)
    own = np.arange(present.size).reshape(present.shape)
    if handle is cost.information:
        metric = np.eye(m * m).reshape(m, m, m * m)
        metric, numbers = 0.5 * (metric + metric.swapaxes(0, 1))[None], np.broadcast_to(own, (n, m, m)).reshape(n, -1)
    elif handle is cost.sigma:
        alone = np.einsum("ab,bk->abk", np.eye(m), np.eye(m))
        sigma, numbers = np.broadcast_to(present, (n, m)), np.broadcast_to(own, (n, m))
        metric = -2.0 * alone * sigma[:, None, None] ** -3.0
    J, r = np.concatenate(term.jacobians(values), axis=2), term.residual(values)
    return _of_cost(term, numbers, J, r, np.zeros((1, 1, 1, 1)), np.zeros((n, m, 1)), metric)


def _limited(term: CompiledTerm, forces: Array, equality: BoolArray, handle: Data) -> Part:
    """The part of limits: of equalities both, of an inequality that its multiplier points at.

    Raises:
        GraphError: one limit of an equality would move without the other.
    """
    constraint, (n, m) = term.term, (term.count, term.size)
    assert isinstance(constraint, Constraint)
    numbers = np.broadcast_to(np.arange(handle.value.size).reshape(handle.value.shape), (n, m))
    both = constraint.lower is constraint.upper
    if not both and equality.any():
        index = int(np.argmax(equality.any(axis=1)))
        raise GraphError(
            f"sensitivity: data '{handle.name}' is one limit of the equality '{term.name}' (factor {index}), which "
            "moves with both: give the same data as lower= and upper=",
            term=term.name,
            index=index,
        )
    there = both | (forces > 0.0 if constraint.upper is handle else forces < 0.0)
    rows = -np.eye(m)[None] * there[:, :, None]
    D = sum(term.dims)
    return _part(term, numbers, np.zeros((n, D, m)), rows, np.einsum("nmk,nm->nk", rows, forces))
