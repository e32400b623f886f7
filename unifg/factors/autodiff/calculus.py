"""Exact derivatives of what stands on a tape, forwards and backwards, first and second.

Forwards every node carries its derivative along one tangent coordinate; backwards every node collects the derivative
of one output by it (Griewank and Walther 2008, sections 3.1 and 3.2). Both write more nodes on the same tape, where
what is said twice stands once. A choice passes on the derivatives of what it chooses and multiplies nothing else: the
partial of what is not chosen may be infinite.

Where a function has a kink or a jump its slope is fixed: of |x| zero at zero, of the least and the greatest of equals
that of the first named, of a choice that of what is chosen, of what jumps (sign, floor, rint, comparisons, a number
read from a table) zero. Remainders move with what is divided.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass

from unifg.factors.autodiff.operations import GROUPED, STEADY, Op
from unifg.factors.autodiff.tape import Tape

_FLAT = STEADY | GROUPED  # no derivatives of their own
Partials = list[tuple[int, int]]
WAIST = 1  # waists that a node may depend on without being one


def jacobian(tape: Tape, outputs: Sequence[int], width: int) -> dict[tuple[int, int], int]:
    """Derivatives of the outputs by ``width`` tangent coordinates: those that are not zero, by (row, column).

    Forwards and backwards give the same numbers; the shorter of the two is returned, counted once the tangent
    coordinates are zero.
    """
    swept = (_forwards(tape, outputs, width), _backwards(tape, outputs))
    if len(outputs) == 0:
        return {}
    lengths = [len(tape.at_rest(list(entries.values()))[0]) for entries in swept]
    return swept[0] if lengths[0] < lengths[1] else swept[1]


def hessian(tape: Tape, outputs: Sequence[int], width: int) -> dict[tuple[int, int], int]:
    """Second derivatives of the sum of weights times outputs: those on and above the diagonal that are not zero.

    Backwards over the waists, every pair of them once (Gower and Mello 2012, edge pushing): what two waists bend by
    goes to those they depend on, along their slopes, and a waist adds the bend of its own slopes, as much as it weighs.
    """
    rows = bent(tape, outputs)
    weighted = tape.zero
    for row, output in enumerate(outputs):
        if rows[row]:
            weighted = tape.add(weighted, tape.multiply(tape.leaf(Op.WEIGHT, row), output))
    waists = _waists(tape, [weighted])
    adjoint = dict[int, int]()
    bends = dict[int, dict[int, int]]()  # by two waists, either way round

    def bend(a: int, b: int, node: int) -> None:
        if node != tape.zero:
            for one, other in ((a, b), (b, a)) if a != b else ((a, b),):
                row = bends.setdefault(one, {})
                row[other] = tape.add(row.get(other, tape.zero), node)

    def create(i: int, weight: int, slopes: dict[int, int]) -> None:
        seconds = _between(tape, i, slopes)
        for a, slope in slopes.items():
            adjoint[a] = tape.add(adjoint.get(a, tape.zero), tape.scaled(weight, slope))
            for b, second in seconds.get(slope, {}).items():
                if a <= b:
                    bend(a, b, tape.scaled(weight, second))

    create(weighted, tape.one, waists.outputs[0])
    for i in reversed(waists.order):
        if tape.op[i] == Op.TANGENT:
            continue
        slopes, pairs = waists.slopes[i], bends.pop(i, {})
        own = pairs.pop(i, tape.zero)
        for other, node in pairs.items():
            bends[other].pop(i)
            for a, slope in slopes.items():
                pushed = tape.scaled(node, slope)
                bend(a, other, tape.add(pushed, pushed) if a == other else pushed)
        for a, slope in slopes.items():
            once = tape.scaled(own, slope)
            for b, other_slope in slopes.items():
                if a <= b:
                    bend(a, b, tape.scaled(once, other_slope))
        if i in adjoint:
            create(i, adjoint[i], slopes)
    return {
        (j, k): node
        for (a, row) in bends.items()
        for b, node in row.items()
        if (j := tape.a[a]) <= (k := tape.a[b]) and node != tape.zero
    }


def bent(tape: Tape, outputs: Sequence[int]) -> list[bool]:
    """Outputs with second derivatives: those that are not made of linear pieces."""
    degree = dict[int, int]()  # 0 constant, 1 made of linear pieces, 2 neither
    for i in tape.live(outputs):
        op, a, b = tape.op[i], tape.a[i], tape.b[i]
        if op <= Op.TANGENT or op in STEADY:
            degree[i] = 1 if op == Op.TANGENT else 0
        elif op in GROUPED:
            continue
        elif op == Op.ENTRY:
            matrix, right = tape.system(a)
            degree[i] = 2 if any(degree[j] for row in (*matrix, right) for j in row) else 0
        elif op == Op.SELECT:
            degree[i] = max(degree[b], degree[tape.c[i]])
        elif op in (Op.ADD, Op.SUBTRACT, Op.MINIMUM, Op.MAXIMUM):
            degree[i] = max(degree[a], degree[b])
        elif op in (Op.NEGATE, Op.ABSOLUTE):
            degree[i] = degree[a]
        elif op == Op.MULTIPLY:
            degree[i] = min(2, degree[a] + degree[b])
        elif op in (Op.DIVIDE, Op.FMOD):
            degree[i] = 2 if degree[b] else degree[a]
        else:
            degree[i] = 2 if degree[a] or (b >= 0 and degree[b]) else 0
    return [degree[output] == 2 for output in outputs]


@dataclass(frozen=True)
class _Waists:
    """Narrow places in the outputs' dependence on the tangent coordinates, and derivatives between them.

    Most nodes depend on all tangent coordinates by way of one or two others, as all of a power series on its argument.
    Their derivatives by these are worked out once, and only the waists are swept.

    Attributes:
        order: waists, as they stand on the tape; all tangent coordinates are.
        slopes: of every waist but those, its derivatives by waists before it.
        outputs: of every output, its derivatives by waists.
    """

    order: list[int]
    slopes: dict[int, dict[int, int]]
    outputs: list[dict[int, int]]


def _waists(tape: Tape, outputs: Sequence[int]) -> _Waists:
    order, slopes, by = list[int](), dict[int, dict[int, int]](), dict[int, dict[int, int]]()
    for i in tape.live(outputs):
        op = tape.op[i]
        if op == Op.TANGENT:
            order.append(i)
            by[i] = {i: tape.one}
        elif op > Op.TANGENT and op not in _FLAT:
            found = _moving(tape, i, by)
            if len(found) > WAIST:
                order.append(i)
                slopes[i], found = found, {i: tape.one}
            if found:
                by[i] = found
    return _Waists(order, slopes, [by.get(output, {}) for output in outputs])


def _between(tape: Tape, i: int, slopes: dict[int, int]) -> dict[int, dict[int, int]]:
    """Derivatives of the slopes of a waist by the same waists.

    They are all that the slopes move with: a slope is stated by what the waist takes, and by the waist itself.
    """
    return _swept(tape, tape.live(slopes.values(), slopes), slopes, {i: slopes})


def _swept(
    tape: Tape, nodes: Sequence[int], begin: Container[int], by: dict[int, dict[int, int]]
) -> dict[int, dict[int, int]]:
    """Derivatives of nodes by those that ``begin`` holds; ``by`` has what is known."""
    for i in nodes:
        if i in begin:
            by[i] = {i: tape.one}
        elif tape.op[i] > Op.TANGENT and tape.op[i] not in _FLAT and i not in by and (found := _moving(tape, i, by)):
            by[i] = found
    return by


def _moving(tape: Tape, i: int, by: dict[int, dict[int, int]]) -> dict[int, int]:
    """Derivatives of a node, from those of its arguments."""
    return _chosen(tape, i, by) if tape.op[i] == Op.SELECT else _chained(tape, i, by)


def _chosen(tape: Tape, i: int, by: dict[int, dict[int, int]]) -> dict[int, int]:
    first, second = by.get(tape.b[i], {}), by.get(tape.c[i], {})
    return {
        waist: tape.select(tape.a[i], first.get(waist, tape.zero), second.get(waist, tape.zero))
        for waist in (*first, *(waist for waist in second if waist not in first))
    }


def _chained(tape: Tape, i: int, by: dict[int, dict[int, int]]) -> dict[int, int]:
    if tape.op[i] != Op.ENTRY and not any(j in by for j in (tape.a[i], tape.b[i])):
        return {}
    found = dict[int, int]()
    for argument, partial in _solution_partials(tape, i, by) if tape.op[i] == Op.ENTRY else _partials(tape, i):
        for waist, slope in by.get(argument, {}).items():
            found[waist] = tape.add(found.get(waist, tape.zero), tape.scaled(slope, partial))
    return found


def derivatives_by(tape: Tape, outputs: Sequence[int], leaf: int) -> list[int]:
    """Derivative of every output by one leaf."""
    by = _swept(tape, tape.live(outputs), (leaf,), {})
    return [by.get(output, {}).get(leaf, tape.zero) for output in outputs]


def _forwards(tape: Tape, outputs: Sequence[int], width: int) -> dict[tuple[int, int], int]:
    waists = _waists(tape, outputs)
    found = dict[tuple[int, int], int]()
    for k in range(width):
        along = dict[int, int]()

        def total(slopes: dict[int, int], along: dict[int, int] = along) -> int:
            node = tape.zero
            for waist, slope in slopes.items():
                if waist in along:
                    node = tape.add(node, tape.scaled(along[waist], slope))
            return node

        for i in waists.order:
            if tape.op[i] != Op.TANGENT:
                node = total(waists.slopes[i])
                if node != tape.zero:
                    along[i] = node
            elif tape.a[i] == k:
                along[i] = tape.one
        for row, slopes in enumerate(waists.outputs):
            node = total(slopes)
            if node != tape.zero:
                found[row, k] = node
    return found


def _backwards(tape: Tape, outputs: Sequence[int]) -> dict[tuple[int, int], int]:
    waists = _waists(tape, outputs)
    found = dict[tuple[int, int], int]()
    for row, slopes in enumerate(waists.outputs):
        for i, node in _adjoints(tape, waists, slopes).items():
            if tape.op[i] == Op.TANGENT and node != tape.zero:
                found[row, tape.a[i]] = node
    return found


def _adjoints(tape: Tape, waists: _Waists, slopes: dict[int, int]) -> dict[int, int]:
    """Derivative of one output by every waist; its derivatives by the last of them are given."""
    adjoint = dict(slopes)
    for i in reversed(waists.order):
        if i not in adjoint or tape.op[i] == Op.TANGENT:
            continue
        for waist, slope in waists.slopes[i].items():
            adjoint[waist] = tape.add(adjoint.get(waist, tape.zero), tape.scaled(adjoint[i], slope))
    return adjoint


def _partials(tape: Tape, i: int) -> Partials:
    """Derivative of a node by each of its arguments; empty where it is constant almost everywhere."""
    op, a, b = tape.op[i], tape.a[i], tape.b[i]
    one, t = tape.one, tape
    if op == Op.ADD:
        return [(a, one), (b, one)]
    if op == Op.SUBTRACT:
        return [(a, one), (b, t.minus_one)]
    if op == Op.NEGATE:
        return [(a, t.minus_one)]
    if op == Op.MULTIPLY:
        return [(a, b), (b, a)]
    if op == Op.DIVIDE:
        return [(a, t.divide(one, b)), (b, t.negate(t.divide(i, b)))]
    if op == Op.ARCTAN2:
        square = t.add(t.multiply(a, a), t.multiply(b, b))
        return [(a, t.divide(b, square)), (b, t.negate(t.divide(a, square)))]
    if op == Op.POWER:
        lower = t.power(a, t.subtract(b, one))
        found = [(a, t.multiply(b, lower))]
        return found if t.is_constant(b) else [*found, (b, t.multiply(i, t.apply(Op.LOG, a)))]
    if op == Op.COS and (length := _vanishing_length(t, a)) is not None:
        # The cosine of a length has derivatives where that is zero, which the length has not: by its power series.
        scale, square = length
        return [(square, t.constant(-0.5 * scale)), (square, t.multiply(square, t.constant(scale * scale / 12.0)))]
    if op == Op.FMOD:
        ratio = t.divide(a, b)
        whole = t.multiply(t.apply(Op.SIGN, ratio), t.apply(Op.FLOOR, t.apply(Op.ABSOLUTE, ratio)))
        return [(a, one)] if t.is_constant(b) else [(a, one), (b, t.negate(whole))]
    if op in STEADY:
        return []
    if op in (Op.MINIMUM, Op.MAXIMUM):  # of equals the first moves
        first = t.apply(Op.LESS_EQUAL, *((a, b) if op == Op.MINIMUM else (b, a)))
        return [(a, t.select(first, one, t.zero)), (b, t.select(first, t.zero, one))]
    slope = _SLOPES[op](tape, i, a)
    return [] if slope == t.zero else [(a, slope)]


def _solution_partials(tape: Tape, i: int, by: Container[int]) -> Partials:
    """Derivatives of an entry of x, A x = b, by what ``by`` holds: of dx = A^-1 (db - dA x), where A' y = e gives y."""
    t, solved, place = tape, tape.a[i], int(tape.value[tape.b[i]])
    matrix, right = t.system(solved)
    size = range(len(right))
    if not any(j in by for row in (*matrix, right) for j in row):
        return []
    turned = t.solve([[matrix[k][j] for k in size] for j in size], [t.one if k == place else t.zero for k in size])
    x = t.solve(matrix, right)
    found = [(right[k], turned[k]) for k in size]
    return found + [(matrix[j][k], t.negate(t.multiply(turned[j], x[k]))) for j in size for k in size]


def _vanishing_length(tape: Tape, i: int) -> tuple[float, int] | None:
    """Of c sqrt(u), with u zero where all tangent coordinates are: the number c^2, and u."""
    scale = 1.0
    if tape.op[i] == Op.MULTIPLY:
        for factor, rest in ((tape.a[i], tape.b[i]), (tape.b[i], tape.a[i])):
            if tape.is_constant(factor):
                scale, i = tape.value[factor], rest
                break
    if tape.op[i] != Op.SQRT:
        return None
    still, (node,) = tape.at_rest([tape.a[i]])
    return (scale * scale, tape.a[i]) if node == still.zero else None


def _squares(t: Tape, a: int) -> bool:
    """Test whether a node is a sum of squares: its root is a norm, whose slope at zero is taken for zero."""
    if t.op[a] == Op.ADD:
        return _squares(t, t.a[a]) and _squares(t, t.b[a])
    return t.op[a] == Op.MULTIPLY and t.a[a] == t.b[a]


def _root_slope(t: Tape, i: int, a: int) -> int:
    slope = t.divide(t.constant(0.5), i)
    return t.select(t.apply(Op.EQUAL, i, t.zero), t.zero, slope) if _squares(t, a) else slope


def _arcsine_slope(t: Tape, i: int, a: int) -> int:
    return t.divide(t.one, t.apply(Op.SQRT, t.multiply(t.subtract(t.one, a), t.add(t.one, a))))


_SLOPES: dict[int, Callable[[Tape, int, int], int]] = {
    Op.SQRT: _root_slope,
    Op.SIN: lambda t, i, a: t.apply(Op.COS, a),
    Op.COS: lambda t, i, a: t.negate(t.apply(Op.SIN, a)),
    Op.TAN: lambda t, i, a: t.add(t.one, t.multiply(i, i)),
    Op.ARCSIN: _arcsine_slope,
    Op.ARCCOS: lambda t, i, a: t.negate(_arcsine_slope(t, i, a)),
    Op.ARCTAN: lambda t, i, a: t.divide(t.one, t.add(t.one, t.multiply(a, a))),
    Op.SINH: lambda t, i, a: t.apply(Op.COSH, a),
    Op.COSH: lambda t, i, a: t.apply(Op.SINH, a),
    Op.TANH: lambda t, i, a: t.subtract(t.one, t.multiply(i, i)),
    Op.ARCSINH: lambda t, i, a: t.divide(t.one, t.apply(Op.SQRT, t.add(t.one, t.multiply(a, a)))),
    Op.ARCCOSH: lambda t, i, a: t.divide(t.one, t.apply(Op.SQRT, t.multiply(t.subtract(a, t.one), t.add(a, t.one)))),
    Op.ARCTANH: lambda t, i, a: t.divide(t.one, t.multiply(t.subtract(t.one, a), t.add(t.one, a))),
    Op.ERF: lambda t, i, a: t.multiply(
        t.constant(2.0 / math.sqrt(math.pi)), t.apply(Op.EXP, t.negate(t.multiply(a, a)))
    ),
    Op.EXP: lambda t, i, a: i,
    Op.EXPM1: lambda t, i, a: t.add(i, t.one),
    Op.LOG: lambda t, i, a: t.divide(t.one, a),
    Op.LOG1P: lambda t, i, a: t.divide(t.one, t.add(t.one, a)),
    Op.ABSOLUTE: lambda t, i, a: t.apply(Op.SIGN, a),
}
"""Derivative of each function of one argument ``a``; ``i`` is its value."""
