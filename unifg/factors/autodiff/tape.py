"""The tape: expressions of numbers as rows of integers, each stated once and simplified where that costs no digit.

A node is an operation and the nodes it takes, all of which stand before it. Two nodes never say the same. What is
simplified holds for every finite number: x + 0, 1 x, x - x, constants among themselves, a choice between equals.
Products with zero are zero, whatever the other factor, as in any exact differentiation, and the square of a root is
what stands under it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Sequence
from typing import Any

import numpy as np

from unifg.factors.autodiff.operations import UNARY, Op
from unifg.typing import Array, ArrayLike


def _erf(x: ArrayLike) -> Array:
    """SciPy's error function; its module takes a tenth of a second to load, and few need it."""
    from scipy.special import erf

    found: Array = erf(x)
    return found


NUMPY: dict[Op, Callable[..., Any]] = {
    Op.NEGATE: np.negative, Op.ADD: np.add, Op.SUBTRACT: np.subtract, Op.MULTIPLY: np.multiply, Op.DIVIDE: np.divide,
    Op.SQRT: np.sqrt, Op.SIN: np.sin, Op.COS: np.cos, Op.TAN: np.tan, Op.ARCSIN: np.arcsin, Op.ARCCOS: np.arccos,
    Op.ARCTAN: np.arctan, Op.ARCTAN2: np.arctan2, Op.SINH: np.sinh, Op.COSH: np.cosh, Op.TANH: np.tanh,
    Op.ARCSINH: np.arcsinh, Op.ARCCOSH: np.arccosh, Op.ARCTANH: np.arctanh, Op.ERF: _erf,
    Op.EXP: np.exp, Op.EXPM1: np.expm1, Op.LOG: np.log, Op.LOG1P: np.log1p, Op.POWER: np.power, Op.FMOD: np.fmod,
    Op.ABSOLUTE: np.absolute, Op.SIGN: np.sign, Op.FLOOR: np.floor, Op.RINT: np.rint, Op.MINIMUM: np.minimum,
    Op.MAXIMUM: np.maximum, Op.LESS: np.less, Op.LESS_EQUAL: np.less_equal, Op.EQUAL: np.equal,
    Op.AND: np.logical_and, Op.OR: np.logical_or, Op.NOT: np.logical_not,
}  # fmt: skip
"""Function of NumPy that computes each operation."""

_COMMUTES = frozenset({Op.ADD, Op.MULTIPLY, Op.EQUAL, Op.AND, Op.OR})


class Tape:
    """Nodes in the order they were stated.

    Attributes:
        op: operation of each node.
        a, b, c: nodes it takes; of a variable, a parameter, a weight or a tangent coordinate, a is its place.
        value: of constants.
        tables: flat arrays that look-ups read, side by side.
        truths: leaves that are truth values.
        decide: settles conditions while code that decides is run, see :mod:`unifg.factors.autodiff.branches`.
        required: conditions without which the code raises an exception.
    """

    def __init__(self) -> None:
        """Nothing is stated yet."""
        self.op: list[int] = []
        self.a: list[int] = []
        self.b: list[int] = []
        self.c: list[int] = []
        self.value: list[float] = []
        self.tables: list[Array] = []
        self.truths: set[int] = set()
        self.decide: Callable[[int], bool] | None = None
        self.required: list[int] = []
        self._found: dict[tuple[int, int, int, int], int] = {}
        self._constants: dict[tuple[float, float], int] = {}
        self.zero = self.constant(0.0)
        self.one = self.constant(1.0)
        self.minus_one = self.constant(-1.0)

    def __len__(self) -> int:
        """Number of nodes."""
        return len(self.op)

    # ---------------------------------------------------------------- leaves

    def constant(self, value: float) -> int:
        """A number."""
        key = (value, math.copysign(1.0, value))
        found = self._constants.get(key)
        if found is None:
            found = self._constants[key] = self._append(Op.CONSTANT, -1, -1, -1, value)
        return found

    def leaf(self, op: Op, place: int) -> int:
        """A variable, a parameter, a weight or a tangent coordinate."""
        return self._node(op, place)

    def table(self, numbers: Array) -> int:
        """Start of a flat array among the tables; it is kept once."""
        begin = 0
        for known in self.tables:
            if known is numbers or (known.shape == numbers.shape and known.tobytes() == numbers.tobytes()):
                return begin
            begin += len(known)
        self.tables.append(numbers)
        return begin

    @property
    def size(self) -> int:
        """Length of the tables."""
        return sum(len(known) for known in self.tables)

    def is_constant(self, i: int) -> bool:
        """Test whether a node is a number."""
        return self.op[i] == Op.CONSTANT

    # ---------------------------------------------------------------- operations

    def apply(self, op: int, a: int, b: int = -1, c: int = -1) -> int:
        """The node of an operation: a simpler one, or one that is there already, where that says the same."""
        simple = _SIMPLER.get(op)
        if simple is not None:
            return simple(self, a, b, c)
        kind = self.op
        if kind[a] == Op.CONSTANT and (b < 0 or kind[b] == Op.CONSTANT) and op < Op.GATHER:
            return self._fold(op, a, b)
        if op in _COMMUTES and b < a:
            a, b = b, a
        return self._node(op, a, b, c)

    def add(self, a: int, b: int) -> int:
        """The sum."""
        if a == self.zero:
            return b
        if b == self.zero:
            return a
        op = self.op
        first, second = op[a], op[b]
        if first == Op.CONSTANT and second == Op.CONSTANT:
            return self._fold(Op.ADD, a, b)
        if second == Op.NEGATE:
            return self.subtract(a, self.a[b])
        if first == Op.NEGATE:
            return self.subtract(b, self.a[a])
        if first == Op.SELECT and second == Op.SELECT and self.a[a] == self.a[b]:
            parts = (self.b[a], self.b[b], self.c[a], self.c[b])
            if self.zero in parts[:2] and self.zero in parts[2:]:
                return self.select(self.a[a], self.add(*parts[:2]), self.add(*parts[2:]))
        return self._node(Op.ADD, a, b) if a < b else self._node(Op.ADD, b, a)

    def subtract(self, a: int, b: int) -> int:
        """The difference."""
        if b == self.zero:
            return a
        if a == self.zero:
            return self.negate(b)
        if a == b:
            return self.zero
        if self.op[a] == Op.CONSTANT and self.op[b] == Op.CONSTANT:
            return self._fold(Op.SUBTRACT, a, b)
        if self.op[b] == Op.NEGATE:
            return self.add(a, self.a[b])
        return self._node(Op.SUBTRACT, a, b)

    def negate(self, a: int) -> int:
        """The opposite."""
        op = self.op[a]
        if op == Op.CONSTANT:
            return self.constant(-self.value[a]) if a != self.zero else a
        if op == Op.NEGATE:
            return self.a[a]
        if op == Op.SUBTRACT:
            return self._node(Op.SUBTRACT, self.b[a], self.a[a])
        return self._node(Op.NEGATE, a)

    def multiply(self, a: int, b: int) -> int:
        """The product."""
        if a == self.zero or b == self.zero:
            return self.zero
        if a == self.one:
            return b
        if b == self.one:
            return a
        if a == self.minus_one:
            return self.negate(b)
        if b == self.minus_one:
            return self.negate(a)
        op = self.op
        if op[a] == Op.CONSTANT and op[b] == Op.CONSTANT:
            return self._fold(Op.MULTIPLY, a, b)
        for root, other in ((a, b), (b, a)):
            if op[root] == Op.SQRT:  # whose square has derivatives at zero, as the root has not
                if not self._never_negative(self.a[root]):
                    continue
                if other == root:
                    return self.a[root]
                if op[other] == Op.MULTIPLY and root in (self.a[other], self.b[other]):
                    rest = self.b[other] if self.a[other] == root else self.a[other]
                    return self.multiply(rest, self.a[root])
        if op[a] == Op.NEGATE:
            return self.negate(self.multiply(self.a[a], b))
        if op[b] == Op.NEGATE:
            return self.negate(self.multiply(a, self.a[b]))
        return self._node(Op.MULTIPLY, a, b) if a < b else self._node(Op.MULTIPLY, b, a)

    def _never_negative(self, i: int) -> bool:
        """Test whether the form of an expression rules out negative values: a square, a sum of such, a length."""
        op, a, b = self.op[i], self.a[i], self.b[i]
        if op == Op.CONSTANT:
            return self.value[i] >= 0.0
        if op in (Op.ABSOLUTE, Op.EXP, Op.SQRT) or (op == Op.MULTIPLY and a == b):
            return True
        if op == Op.SELECT:
            return self._never_negative(b) and self._never_negative(self.c[i])
        return op in (Op.ADD, Op.MULTIPLY, Op.DIVIDE) and self._never_negative(a) and self._never_negative(b)

    def divide(self, a: int, b: int) -> int:
        """The quotient."""
        if b == self.one or a == self.zero:
            return a
        if b == self.minus_one:
            return self.negate(a)
        if self.op[a] == Op.CONSTANT and self.op[b] == Op.CONSTANT:
            return self._fold(Op.DIVIDE, a, b)
        return self._node(Op.DIVIDE, a, b)

    def power(self, a: int, b: int) -> int:
        """The power a^b; small whole powers and the root as products."""
        if self.op[b] == Op.CONSTANT:
            if self.op[a] == Op.CONSTANT:
                return self._fold(Op.POWER, a, b)
            exponent = self.value[b]
            if exponent == 0.5:
                return self.apply(Op.SQRT, a)
            if exponent == int(exponent) and abs(exponent) <= 4:
                product = self.one
                for _ in range(abs(int(exponent))):
                    product = self.multiply(product, a)
                return product if exponent >= 0 else self.divide(self.one, product)
        return self._node(Op.POWER, a, b)

    def select(self, condition: int, a: int, b: int) -> int:
        """The first where the condition holds, else the second."""
        if a == b:
            return a
        if self.op[condition] == Op.CONSTANT:
            return a if self.value[condition] != 0.0 else b
        if self.op[condition] == Op.NOT:
            return self.select(self.a[condition], b, a)
        return self._node(Op.SELECT, condition, a, b)

    def solve(self, matrix: Sequence[Sequence[int]], right: Sequence[int]) -> list[int]:
        """Solution of a linear system."""
        listed = self.one
        for node in (*(node for row in matrix for node in row), *right):
            listed = self._node(Op.LIST, listed, node)
        solved = self._node(Op.SOLVE, listed)
        return [self._node(Op.ENTRY, solved, self.constant(float(k))) for k in range(len(right))]

    def system(self, solved: int) -> tuple[list[list[int]], list[int]]:
        """Matrix and right-hand side of a SOLVE node."""
        listed, nodes = self.a[solved], list[int]()
        while self.op[listed] == Op.LIST:
            nodes.append(self.b[listed])
            listed = self.a[listed]
        size = math.isqrt(len(nodes))
        nodes.reverse()
        return [nodes[k * size : (k + 1) * size] for k in range(size)], nodes[size * size :]

    def scaled(self, a: int, partial: int) -> int:
        """A derivative times a partial derivative; not of what is not chosen: its partial may be infinite."""
        if self.op[a] == Op.SELECT:
            condition, b, c = self.a[a], self.b[a], self.c[a]
            if c == self.zero:
                return self.select(condition, self.scaled(b, partial), c)
            if b == self.zero:
                return self.select(condition, b, self.scaled(c, partial))
        if self.op[partial] == Op.SELECT:
            condition, b, c = self.a[partial], self.b[partial], self.c[partial]
            if c == self.zero:
                return self.select(condition, self.scaled(a, b), c)
            if b == self.zero:
                return self.select(condition, b, self.scaled(a, c))
        return self.multiply(a, partial)

    def stretch(self, begin: int, count: int, tables: Array, parameters: Sequence[float]) -> Array:
        """Numbers that a search or a take reads."""
        start = int(self.value[begin]) if self.is_constant(begin) else self.a[begin]
        source = tables if self.is_constant(begin) else np.asarray(parameters, dtype=np.float64)
        return source[start : start + int(self.value[count])]

    # ---------------------------------------------------------------- whole tapes

    def live(self, outputs: Iterable[int], ends: Container[int] = ()) -> list[int]:
        """Nodes that the outputs depend on, in order; of what ``ends`` depend on only them."""
        needed = set(outputs)
        waiting = list(needed)
        op, takes = self.op, (self.a, self.b, self.c)
        while waiting:
            i = waiting.pop()
            if op[i] <= Op.TANGENT or i in ends:
                continue
            for column in takes:
                j = column[i]
                if j >= 0 and j not in needed:
                    needed.add(j)
                    waiting.append(j)
        return sorted(needed)

    def at_rest(self, outputs: Sequence[int]) -> tuple[Tape, list[int]]:
        """A new tape of the outputs with every tangent coordinate zero, and the outputs on it."""
        new = Tape()
        new.tables = self.tables
        place: dict[int, int] = {}
        for i in self.live(outputs):
            op, a = self.op[i], self.a[i]
            if op == Op.CONSTANT:
                place[i] = new.constant(self.value[i])
            elif op == Op.TANGENT:
                place[i] = new.zero
            elif op <= Op.TANGENT:
                place[i] = new._node(op, a)
            else:
                b, c = self.b[i], self.c[i]
                place[i] = new.apply(op, place[a], place[b] if b >= 0 else -1, place[c] if c >= 0 else -1)
        return new, [place[i] for i in outputs]

    def where_zero(self, outputs: Sequence[int], leaf: int) -> list[int]:
        """The outputs, on the same tape, with one leaf zero."""
        place = {leaf: self.zero}
        for i in self.live(outputs):
            if self.op[i] > Op.TANGENT:
                operands = [j if j < 0 else place.get(j, j) for j in (self.a[i], self.b[i], self.c[i])]
                if operands != [self.a[i], self.b[i], self.c[i]]:
                    place[i] = self.apply(self.op[i], *operands)
        return [place.get(i, i) for i in outputs]

    def evaluate(self, outputs: Sequence[int], variables: Sequence[float], parameters: Sequence[float]) -> list[float]:
        """Run the tape in Python, all tangent coordinates zero and all weights one: slow, for small things."""
        given = {Op.VARIABLE: variables, Op.PARAMETER: parameters}
        tables = np.concatenate([np.zeros(0), *self.tables])
        found: dict[int, float] = {}
        solved: dict[int, Array] = {}
        with np.errstate(all="ignore"):
            for i in self.live(outputs):
                op, a, b = self.op[i], self.a[i], self.b[i]
                if op == Op.CONSTANT:
                    found[i] = self.value[i]
                elif op <= Op.TANGENT:
                    found[i] = float(given[Op(op)][a]) if op in given else float(op == Op.WEIGHT)
                elif op == Op.LIST:
                    continue
                elif op == Op.GATHER:
                    found[i] = float(tables[int(found[a])]) if 0 <= found[a] < len(tables) else np.nan
                elif op in (Op.SEARCH, Op.TAKE):
                    among = self.stretch(b, self.c[i], tables, parameters)
                    below = op == Op.SEARCH and not np.isnan(found[a])
                    place = int(np.searchsorted(among, found[a], side="right")) - 1 if below else 0
                    place = place if op == Op.SEARCH else int(np.nan_to_num(found[a]))
                    place = min(max(place, 0), len(among) - (2 if op == Op.SEARCH else 1))
                    found[i] = float(place if op == Op.SEARCH else among[place])
                elif op == Op.SOLVE:
                    matrix, right = self.system(i)
                    numbers = [[found[j] for j in row] for row in matrix], [found[j] for j in right]
                    solved[i] = np.linalg.solve(*map(np.array, numbers))
                elif op == Op.ENTRY:
                    found[i] = float(solved[a][int(self.value[b])])
                elif op == Op.SELECT:
                    found[i] = found[b] if found[a] != 0.0 else found[self.c[i]]
                else:
                    arguments = (found[a],) if op in UNARY else (found[a], found[b])
                    found[i] = float(NUMPY[Op(op)](*arguments))
        return [found[i] for i in outputs]

    def _fold(self, op: int, a: int, b: int) -> int:
        arguments = (self.value[a],) if b < 0 else (self.value[a], self.value[b])
        with np.errstate(all="ignore"):
            return self.constant(float(NUMPY[Op(op)](*arguments)))

    def _node(self, op: int, a: int, b: int = -1, c: int = -1) -> int:
        key = (op, a, b, c)
        found = self._found.get(key)
        if found is None:
            found = self._found[key] = self._append(op, a, b, c, 0.0)
        return found

    def _append(self, op: int, a: int, b: int, c: int, value: float) -> int:
        self.op.append(op)
        self.a.append(a)
        self.b.append(b)
        self.c.append(c)
        self.value.append(value)
        return len(self.op) - 1


_SIMPLER: dict[int, Callable[[Tape, int, int, int], int]] = {
    Op.ADD: lambda t, a, b, c: t.add(a, b),
    Op.SUBTRACT: lambda t, a, b, c: t.subtract(a, b),
    Op.NEGATE: lambda t, a, b, c: t.negate(a),
    Op.MULTIPLY: lambda t, a, b, c: t.multiply(a, b),
    Op.DIVIDE: lambda t, a, b, c: t.divide(a, b),
    Op.POWER: lambda t, a, b, c: t.power(a, b),
    Op.SELECT: lambda t, a, b, c: t.select(a, b, c),
}
