"""Exact derivatives of what stands on a tape, forwards and backwards, first and second.

Forwards every node carries its derivative along one tangent coordinate; backwards every node collects the derivative
of one output by it (Griewank and Walther 2008, sections 3.1 and 3.2). Both write more nodes on the same tape, where
what is said twice stands once. A choice passes on the derivatives of what it chooses and multiplies nothing else: the
partial of what is not chosen may be infinite.
"""

from __future__ import annotations

from collections.abc import Sequence

from unifg.kernels.derive.operations import STEADY, Op
from unifg.kernels.derive.tape import Tape

Partials = list[tuple[int, int]]


def jacobian(tape: Tape, outputs: Sequence[int], width: int) -> dict[tuple[int, int], int]:
    """Derivatives of the outputs by ``width`` tangent coordinates: those that are not zero, by (row, column).

    Forwards and backwards give the same numbers; the shorter of the two is returned, counted once the tangent
    coordinates are zero.
    """
    swept = (_forwards(tape, outputs, width), _backwards(tape, outputs))
    if len(outputs) == 0:
        return {}
    lengths = [len(_rest(tape, list(entries.values()))) for entries in swept]
    return swept[0] if lengths[0] < lengths[1] else swept[1]


def gradient(tape: Tape, outputs: Sequence[int], rows: Sequence[bool]) -> dict[int, int]:
    """Derivative of the sum of weights times some outputs by every tangent coordinate where it is not zero."""
    weighted = tape.zero
    for row, output in enumerate(outputs):
        if rows[row]:
            weighted = tape.add(weighted, tape.multiply(tape.leaf(Op.WEIGHT, row), output))
    return _by_tangent(tape, _adjoints(tape, weighted))


def hessian(tape: Tape, outputs: Sequence[int], width: int) -> dict[tuple[int, int], int]:
    """Second derivatives of the sum of weights times outputs: those on and above the diagonal that are not zero."""
    first = gradient(tape, outputs, bent(tape, outputs))
    slopes = [first.get(k, tape.zero) for k in range(width)]
    entries = _forwards(tape, slopes, width)
    return {(j, k): node for (j, k), node in entries.items() if j <= k}


def bent(tape: Tape, outputs: Sequence[int]) -> list[bool]:
    """Which outputs have second derivatives: those that are not made of linear pieces."""
    degree = dict[int, int]()  # 0 constant, 1 made of linear pieces, 2 neither
    for i in tape.live(outputs):
        op, a, b = tape.op[i], tape.a[i], tape.b[i]
        if op <= Op.TANGENT or op in STEADY:
            degree[i] = 1 if op == Op.TANGENT else 0
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


def _forwards(tape: Tape, outputs: Sequence[int], width: int) -> dict[tuple[int, int], int]:
    live = tape.live(outputs)
    depends = _dependence(tape, live)
    found = dict[tuple[int, int], int]()
    partials = dict[int, Partials]()
    for k in range(width):
        bit = 1 << k
        along = dict[int, int]()
        for i in live:
            if not depends[i] & bit:
                continue
            op = tape.op[i]
            if op == Op.TANGENT:
                along[i] = tape.one
            elif op == Op.SELECT:
                chosen, other = along.get(tape.b[i], tape.zero), along.get(tape.c[i], tape.zero)
                along[i] = tape.select(tape.a[i], chosen, other)
            else:
                if i not in partials:
                    partials[i] = _partials(tape, i)
                total = tape.zero
                for argument, partial in partials[i]:
                    if argument in along:
                        total = tape.add(total, tape.scaled(along[argument], partial))
                along[i] = total
        for row, output in enumerate(outputs):
            node = along.get(output, tape.zero)
            if node != tape.zero:
                found[row, k] = node
    return found


def _backwards(tape: Tape, outputs: Sequence[int]) -> dict[tuple[int, int], int]:
    found = dict[tuple[int, int], int]()
    for row, output in enumerate(outputs):
        for k, node in _by_tangent(tape, _adjoints(tape, output)).items():
            found[row, k] = node
    return found


def _adjoints(tape: Tape, output: int) -> dict[int, int]:
    """Derivative of one output by every node it depends on that moves with the tangent coordinates."""
    live = tape.live([output])
    depends = _dependence(tape, live)
    adjoint = {output: tape.one}
    for i in reversed(live):
        if i not in adjoint or not depends[i] or tape.op[i] == Op.TANGENT:
            continue
        weight = adjoint[i]
        if tape.op[i] == Op.SELECT:
            condition = tape.a[i]
            contributions = [
                (tape.b[i], tape.select(condition, weight, tape.zero)),
                (tape.c[i], tape.select(condition, tape.zero, weight)),
            ]
        else:
            contributions = [(j, tape.scaled(weight, partial)) for j, partial in _partials(tape, i) if depends[j]]
        for argument, contribution in contributions:
            adjoint[argument] = tape.add(adjoint.get(argument, tape.zero), contribution)
    return adjoint


def _by_tangent(tape: Tape, adjoint: dict[int, int]) -> dict[int, int]:
    return {tape.a[i]: node for i, node in adjoint.items() if tape.op[i] == Op.TANGENT and node != tape.zero}


def _dependence(tape: Tape, live: Sequence[int]) -> dict[int, int]:
    """For every node, the tangent coordinates it moves with, as bits."""
    depends = dict[int, int]()
    for i in live:
        op = tape.op[i]
        if op <= Op.TANGENT or op in STEADY:
            depends[i] = 1 << tape.a[i] if op == Op.TANGENT else 0
        else:
            bits = depends[tape.a[i]] if op != Op.SELECT else 0
            for j in (tape.b[i], tape.c[i]):
                if j >= 0:
                    bits |= depends[j]
            depends[i] = bits
    return depends


def _rest(tape: Tape, outputs: list[int]) -> Tape:
    """The outputs where all tangent coordinates are zero."""
    return tape.at_rest(outputs)[0]


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
    if op == Op.FMOD:
        ratio = t.divide(a, b)
        whole = t.multiply(t.apply(Op.SIGN, ratio), t.apply(Op.FLOOR, t.apply(Op.ABSOLUTE, ratio)))
        return [(a, one)] if t.is_constant(b) else [(a, one), (b, t.negate(whole))]
    if op in STEADY:
        return []
    if op in (Op.MINIMUM, Op.MAXIMUM):  # of equals the first moves
        first = t.apply(Op.LESS_EQUAL, *((a, b) if op == Op.MINIMUM else (b, a)))
        return [(a, t.select(first, one, t.zero)), (b, t.select(first, t.zero, one))]
    slope = _slope(tape, op, i, a)
    return [] if slope == t.zero else [(a, slope)]


def _slope(t: Tape, op: int, i: int, a: int) -> int:
    """Derivative of a function of one argument; ``i`` is its value."""
    one = t.one
    if op == Op.SQRT:
        return t.divide(t.constant(0.5), i)
    if op == Op.SIN:
        return t.apply(Op.COS, a)
    if op == Op.COS:
        return t.negate(t.apply(Op.SIN, a))
    if op == Op.TAN:
        return t.add(one, t.multiply(i, i))
    if op in (Op.ARCSIN, Op.ARCCOS):
        slope = t.divide(one, t.apply(Op.SQRT, t.multiply(t.subtract(one, a), t.add(one, a))))
        return slope if op == Op.ARCSIN else t.negate(slope)
    if op == Op.ARCTAN:
        return t.divide(one, t.add(one, t.multiply(a, a)))
    if op == Op.SINH:
        return t.apply(Op.COSH, a)
    if op == Op.COSH:
        return t.apply(Op.SINH, a)
    if op == Op.TANH:
        return t.subtract(one, t.multiply(i, i))
    if op == Op.EXP:
        return i
    if op == Op.EXPM1:
        return t.add(i, one)
    if op == Op.LOG:
        return t.divide(one, a)
    if op == Op.LOG1P:
        return t.divide(one, t.add(one, a))
    if op == Op.ABSOLUTE:
        return t.apply(Op.SIGN, a)
    raise AssertionError(f"no derivative of {Op(op).name}")
