"""From a tape to machine code: one straight line of instructions, with nothing to decide at run time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from unifg.codegen.calls import MATRIX, RESIDUAL, VECTOR
from unifg.codegen.native import POINTER, generated, number
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.tape import Tape

_INSTRUCTIONS = {Op.ADD: "fadd", Op.SUBTRACT: "fsub", Op.MULTIPLY: "fmul", Op.DIVIDE: "fdiv"}
_LIBRARY = {  # functions of the C library, and those that processors know
    Op.TAN: "tan", Op.ARCSIN: "asin", Op.ARCCOS: "acos", Op.ARCTAN: "atan", Op.ARCTAN2: "atan2", Op.SINH: "sinh",
    Op.COSH: "cosh", Op.TANH: "tanh", Op.ARCSINH: "asinh", Op.ARCCOSH: "acosh",
    Op.ARCTANH: "atanh", Op.ERF: "erf", Op.EXPM1: "expm1", Op.LOG1P: "log1p", Op.POWER: "pow", Op.SIN: "sin",
    Op.COS: "cos", Op.EXP: "exp", Op.LOG: "log", Op.SQRT: "llvm.sqrt.f64", Op.ABSOLUTE: "llvm.fabs.f64",
    Op.FLOOR: "llvm.floor.f64", Op.RINT: "llvm.rint.f64", Op.FMOD: "fmod",
}  # fmt: skip
_COMPARISONS = {Op.LESS: "olt", Op.LESS_EQUAL: "ole", Op.EQUAL: "oeq"}
_ONE, _MINUS, _ZERO = number(1.0), number(-1.0), number(0.0)


def residual_code(tape: Tape, rows: Sequence[int], slopes: dict[tuple[int, int], int], width: int) -> bytes:
    """``f(v, p, table, r, J)``: the rows, and their derivatives unless J has no rows."""
    line = _Line(tape, {Op.VARIABLE: "%data0", Op.PARAMETER: "%data1"})
    line.compute(rows)
    for row, node in enumerate(rows):
        line.store("%data3", row, node)
    line.contract()
    line.write("%wanted = icmp ne i64 %shape4_0, 0", "br i1 %wanted, label %slopes, label %done", "slopes:")
    line.compute(slopes.values())
    for place in range(len(rows) * width):
        line.store("%data4", place, slopes.get(divmod(place, width), tape.zero))
    line.write("br label %done", "done:")
    return line.generated(RESIDUAL)


def second_code(tape: Tape, entries: dict[tuple[int, int], int], width: int) -> bytes:
    """``second(v, p, table, w, S)``: the symmetric matrix whose upper half is given."""
    line = _Line(tape, {Op.VARIABLE: "%data0", Op.PARAMETER: "%data1", Op.WEIGHT: "%data3"})
    line.contract()
    line.compute(entries.values())
    for place in range(width * width):
        row, column = divmod(place, width)
        line.store("%data4", place, entries.get((min(row, column), max(row, column)), tape.zero))
    return line.generated((VECTOR, VECTOR, VECTOR, VECTOR, MATRIX))


class _Line:
    """Instructions for the nodes of a tape, each written once."""

    def __init__(self, tape: Tape, sources: dict[int, str]) -> None:
        self._tape, self._sources = tape, sources
        self._lines: list[str] = []
        self._values: dict[int, str] = {}  # what stands for a node
        self._truths: dict[int, str] = {}  # of comparisons: one bit
        self._solutions: dict[int, list[str]] = {}
        self._called = dict[str, int]()  # number of arguments
        self._liberty = ""

    def generated(self, arguments: tuple[object, ...]) -> bytes:
        """Object code of the expression."""
        declarations = [
            f"declare double @{called}({', '.join(['double'] * count)}) nounwind readnone"
            for called, count in self._called.items()
        ]
        return generated(arguments, self._lines, declarations)

    def write(self, *lines: str) -> None:
        """Put down instructions."""
        self._lines.extend(lines)

    def contract(self) -> None:
        """From here on a product and a sum may be rounded once, which derivatives gain from and rows need not."""
        self._liberty = " contract"

    def compute(self, outputs: Iterable[int]) -> None:
        """Write what the outputs need and is not there yet."""
        for i in self._tape.live(outputs):
            if i not in self._values and i not in self._truths and i not in self._solutions:
                self._instruction(i)

    def store(self, array: str, place: int, node: int) -> None:
        """Put a node into an array."""
        value = _ZERO if node == self._tape.zero else self._number(node)
        self._lines.append(f"%p{len(self._lines)} = getelementptr inbounds double, {POINTER} {array}, i64 {place}")
        self._lines.append(f"store double {value}, {POINTER} %p{len(self._lines) - 1}")

    def _instruction(self, i: int) -> None:
        tape = self._tape
        op, a, b = tape.op[i], tape.a[i], tape.b[i]
        name = f"%n{i}"
        if op == Op.CONSTANT:
            self._values[i] = number(tape.value[i])
            return
        if op == Op.LIST:
            return
        if op == Op.SOLVE:
            matrix, right = tape.system(i)
            rows = [[self._number(j) for j in (*row, b)] for row, b in zip(matrix, right, strict=True)]
            self._solutions[i] = self._solved(i, rows)
            return
        if op == Op.ENTRY:
            self._values[i] = self._solutions[a][int(tape.value[b])]
            return
        if op <= Op.TANGENT:
            self.write(
                f"%p{len(self._lines)} = getelementptr inbounds double, {POINTER} {self._sources[op]}, i64 {a}",
                f"{name} = load double, {POINTER} %p{len(self._lines)}",
            )
        elif op in (Op.AND, Op.OR, Op.NOT):
            other = "true" if op == Op.NOT else self._truth(b)
            verb = {Op.AND: "and", Op.OR: "or", Op.NOT: "xor"}[Op(op)]
            self.write(f"{name} = {verb} i1 {self._truth(a)}, {other}")
        elif op == Op.SELECT:
            condition, x, y = self._truth(a), self._number(b), self._number(tape.c[i])
            self.write(f"{name} = select i1 {condition}, double {x}, double {y}")
        elif op == Op.GATHER:  # whatever the index is, the number read lies in the tables
            last, x = number(float(self._tape.size - 1)), self._number(a)
            self.write(
                f"{name}_l = fcmp ogt double {x}, {_ZERO}",
                f"{name}_m = select i1 {name}_l, double {x}, double {_ZERO}",
                f"{name}_u = fcmp olt double {name}_m, {last}",
                f"{name}_k = select i1 {name}_u, double {name}_m, double {last}",
                f"{name}_i = fptosi double {name}_k to i64",
                f"{name}_p = getelementptr inbounds double, {POINTER} %data2, i64 {name}_i",
                f"{name} = load double, {POINTER} {name}_p",
            )
        else:
            x, y = self._number(a), "" if b < 0 else self._number(b)
            if op in _INSTRUCTIONS:
                self.write(f"{name} = {_INSTRUCTIONS[Op(op)]}{self._liberty} double {x}, {y}")
            elif op == Op.NEGATE:
                self.write(f"{name} = fneg double {x}")
            elif op in _COMPARISONS:
                self.write(f"{name} = fcmp {_COMPARISONS[Op(op)]} double {x}, {y}")
            elif op == Op.SIGN:  # NaN stays
                self.write(
                    f"{name}_b = fcmp olt double {x}, {_ZERO}",
                    f"{name}_n = select i1 {name}_b, double {_MINUS}, double {x}",
                    f"{name}_a = fcmp ogt double {x}, {_ZERO}",
                    f"{name} = select i1 {name}_a, double {_ONE}, double {name}_n",
                )
            elif op in (Op.MINIMUM, Op.MAXIMUM):  # NaN of either is the answer, as in NumPy
                self.write(
                    f"{name}_f = fcmp {'ule' if op == Op.MINIMUM else 'uge'} double {x}, {y}",
                    f"{name}_s = select i1 {name}_f, double {x}, double {y}",
                    f"{name}_n = fcmp uno double {y}, {y}",
                    f"{name} = select i1 {name}_n, double {y}, double {name}_s",
                )
            else:
                called, given = _LIBRARY[Op(op)], [f"double {v}" for v in (x, y) if v]
                self._called[called] = len(given)
                self.write(f"{name} = call double @{called}({', '.join(given)})")
        (self._truths if op in _COMPARISONS or op in (Op.AND, Op.OR, Op.NOT) else self._values)[i] = name

    def _solved(self, i: int, rows: list[list[str]]) -> list[str]:
        """Solution of a linear system by elimination with partial pivoting, written out; rows end with b."""
        size, count = len(rows), 0

        def put(instruction: str) -> str:
            nonlocal count
            count += 1
            self.write(f"%n{i}_{count} = {instruction}")
            return f"%n{i}_{count}"

        self._called[_LIBRARY[Op.ABSOLUTE]] = 1
        for k in range(size):
            for below in range(k + 1, size):  # the largest entry of the column comes up
                lengths = [put(f"call double @llvm.fabs.f64(double {rows[r][k]})") for r in (below, k)]
                larger = put(f"fcmp ogt double {lengths[0]}, {lengths[1]}")
                for j in range(k, size + 1):
                    low, high = rows[below][j], rows[k][j]
                    rows[k][j] = put(f"select i1 {larger}, double {low}, double {high}")
                    rows[below][j] = put(f"select i1 {larger}, double {high}, double {low}")
            for below in range(k + 1, size):
                factor = put(f"fdiv double {rows[below][k]}, {rows[k][k]}")
                for j in range(k + 1, size + 1):
                    rows[below][j] = put(f"fsub double {rows[below][j]}, {put(f'fmul double {factor}, {rows[k][j]}')}")
        x: list[str] = [""] * size
        for k in reversed(range(size)):
            rest = rows[k][size]
            for j in range(k + 1, size):
                rest = put(f"fsub double {rest}, {put(f'fmul double {rows[k][j]}, {x[j]}')}")
            x[k] = put(f"fdiv double {rest}, {rows[k][k]}")
        return x

    def _number(self, i: int) -> str:
        value = self._values.get(i)
        if value is None:
            value = self._values[i] = f"%f{i}"
            self.write(f"{value} = uitofp i1 {self._truths[i]} to double")
        return value

    def _truth(self, i: int) -> str:
        truth = self._truths.get(i)
        if truth is None:
            truth = self._truths[i] = f"%t{i}"
            self.write(f"{truth} = fcmp une double {self._values[i]}, {_ZERO}")
        return truth
