"""From a tape to machine code: straight lines of instructions, and loops over copies of expressions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

from unifg.codegen.calls import MATRIX, RESIDUAL, VECTOR
from unifg.codegen.native import POINTER, Source, number, source
from unifg.factors.autodiff.loops import INVARIANT, Repeats, Slot, Sum, Template
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.tape import Tape

Key: TypeAlias = int | tuple[int, int]
"""A node, or a loop and a slot of its template."""

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


def residual_code(tape: Tape, rows: Sequence[int], slopes: dict[tuple[int, int], int], width: int) -> Source:
    """``f(v, p, table, r, J)``: the rows, and their derivatives unless J has no rows."""
    line = _Writer(tape, {Op.VARIABLE: "%data0", Op.PARAMETER: "%data1"}, [*rows, *slopes.values()])
    loops = line.repeated(rows, slopes, width)
    looped = {row for loop in loops for row in loop.rows}
    straight = [row for row in range(len(rows)) if row not in looped]
    line.compute(rows[row] for row in straight)
    for row in straight:
        line.store("%data3", row, rows[row])
    for loop in loops:
        line.prepare(loop.template, [loop.value])
    line.write("%wanted = icmp ne i64 %shape4_0, 0", "br i1 %wanted, label %slopes, label %values")
    line.begin("values")
    for loop in loops:
        line.loop(loop.template, [Store("%data3", loop.rows, loop.value)], [])
    line.write("br label %done")
    line.begin("slopes")
    for loop in loops:
        stores = [Store("%data3", loop.rows, loop.value)]
        for column, slot in enumerate(loop.slopes):
            first, stride = loop.rows.start * width + column, loop.rows.step * width
            stores.append(Store("%data4", range(first, first + len(loop.rows) * stride, stride), slot))
        line.loop(loop.template, stores, [])
    line.contract()
    line.compute(slopes[place] for place in slopes if place[0] not in looped)
    for row in straight:
        for column in range(width):
            line.store("%data4", row * width + column, slopes.get((row, column), tape.zero))
    line.write("br label %done", "done:")
    return line.source(RESIDUAL)


def second_code(tape: Tape, entries: dict[tuple[int, int], int], width: int) -> Source:
    """``second(v, p, table, w, S)``: the symmetric matrix whose upper half is given."""
    sources = {Op.VARIABLE: "%data0", Op.PARAMETER: "%data1", Op.WEIGHT: "%data3"}
    line = _Writer(tape, sources, list(entries.values()))
    line.contract()
    line.compute(entries.values())
    for place in range(width * width):
        row, column = divmod(place, width)
        line.store("%data4", place, entries.get((min(row, column), max(row, column)), tape.zero))
    return line.source((VECTOR, VECTOR, VECTOR, VECTOR, MATRIX))


class Rows(NamedTuple):
    """Rows of a residual that are one loop.

    Attributes:
        template: their expressions.
        rows: places.
        value: slot of the rows.
        slopes: of each column of the Jacobian, its slot, or None where it is zero.
    """

    template: Template
    rows: range
    value: int
    slopes: list[int | None]


class Store(NamedTuple):
    """Numbers of a loop that are stored.

    Attributes:
        array: where.
        places: of the copies.
        slot: what; None for zero.
    """

    array: str
    places: range
    slot: int | None


class _Writer:
    """Instructions for the nodes of a tape, each written once; copies of expressions are written as loops."""

    def __init__(self, tape: Tape, sources: Mapping[Op, str], outputs: Sequence[int]) -> None:
        self._tape, self._sources = tape, {int(op): array for op, array in sources.items()}
        self._repeats = Repeats(tape, outputs)
        self._lines: list[str] = []
        self._block, self._count = "entry", 0
        self._values: dict[Key, str] = {}  # what stands for a node
        self._truths: dict[Key, str] = {}  # of comparisons: one bit
        self._solutions: dict[int, list[str]] = {}
        self._written: set[int] = set()  # nodes
        self._called = dict[str, int]()  # number of arguments
        self._liberty = ""

    def source(self, arguments: tuple[object, ...]) -> Source:
        """The function of the expression."""
        declarations = [
            f"declare double @{called}({', '.join(['double'] * count)}) nounwind readnone"
            for called, count in self._called.items()
        ]
        return source(arguments, self._lines, declarations, self._count > 0)

    def write(self, *lines: str) -> None:
        """Put down instructions."""
        self._lines.extend(lines)

    def begin(self, block: str) -> None:
        """Begin a block."""
        self._block = block
        self.write(f"{block}:")

    def contract(self) -> None:
        """Permit that a product and a sum are rounded once, which derivatives gain from and rows need not."""
        self._liberty = " contract"

    def repeated(self, rows: Sequence[int], slopes: dict[tuple[int, int], int], width: int) -> list[Rows]:
        """Rows that are copies of each other, and whose derivatives are."""
        found = []
        for places in self._repeats.rows(rows):
            template = Template(self._tape, len(places))
            columns = [[slopes.get((row, column)) for row in places] for column in range(width)]
            value = template.add([rows[row] for row in places])
            slots = [_added(template, nodes) for nodes in columns]
            zero = [all(node is None for node in nodes) for nodes in columns]
            if value is not None and all(slot is not None or empty for slot, empty in zip(slots, zero, strict=True)):
                found.append(Rows(template, places, value, slots))
        return found

    def compute(self, outputs: Iterable[int]) -> None:
        """Write what the outputs need and is not there yet."""
        tape, sums = self._tape, self._repeats.sums
        needed = tape.live(outputs, self._written | sums.keys())
        for i in needed:
            if i in self._written:
                continue
            if i in sums:
                self._sums([(j, sums[j]) for j in needed if j in sums and sums[j].loop == sums[i].loop])
            else:
                self._instruction(i, tape.op[i], (tape.a[i], tape.b[i], tape.c[i]), "")

    def store(self, array: str, place: int, node: int) -> None:
        """Put a node into an array."""
        self._put(array, str(place), _ZERO if node == self._tape.zero else self._number(node))

    def prepare(self, template: Template, outputs: Sequence[int]) -> list[tuple[int, Slot]]:
        """Write what is the same in all copies, before the block of the loop; return the slots of outputs."""
        reached = [(slot, template.slots[slot]) for slot in template.reached(outputs)]
        self.compute([found.a for _, found in reached if found.op == INVARIANT])
        for slot in outputs:
            if template.slots[slot].op == INVARIANT:
                self._number(template.slots[slot].a)
        for _, found in reached:
            for place, taken in enumerate(found[1:] if found.op > Op.TANGENT else ()):
                if taken >= 0 and template.slots[taken].op == INVARIANT:
                    convert = self._truth if _takes_truth(found.op, place) else self._number
                    convert(template.slots[taken].a)
        return reached

    def loop(self, template: Template, stores: Sequence[Store], sums: Sequence[tuple[int, Sum]]) -> None:
        """Write a loop over copies: numbers that are stored, and sums with their nodes."""
        outputs = [store.slot for store in stores if store.slot is not None]
        outputs += [slot for _, found in sums for slot, _ in found.terms]
        reached = self.prepare(template, outputs)
        initial = [self._added(_ZERO, found.first) for _, found in sums]
        self._count += 1
        index, before, block = f"%k{self._count}", self._block, f"loop{self._count}"
        keys: dict[int, Key] = {-1: -1}
        self.write(f"br label %{block}")
        self.begin(block)
        self.write(f"{index} = phi i64 [ 0, %{before} ], [ {index}_n, %{block} ]")
        totals = [f"%s{node}_{self._count}" for node, _ in sums]
        for total, value in zip(totals, initial, strict=True):
            self.write(f"{total} = phi double [ {value}, %{before} ], [ {total}_n, %{block} ]")
        for slot, found in reached:
            keys[slot] = found.a if found.op == INVARIANT else (self._count, slot)
            if found.op == INVARIANT:
                continue
            taken = found[1:] if found.op <= Op.TANGENT else tuple(keys[part] for part in found[1:])
            self._instruction(keys[slot], found.op, taken, index)
        for store in stores:
            place = self._place(index, store.places.start, store.places.step)
            self._put(store.array, place, _ZERO if store.slot is None else self._number(keys[store.slot]))
        for total, (_, summed) in zip(totals, sums, strict=True):
            value = total
            for number_of, (slot, negative) in enumerate(summed.terms):
                name = f"{total}_n" if number_of == len(summed.terms) - 1 else f"{total}_{number_of}"
                verb, free = "fsub" if negative else "fadd", f"{self._liberty} reassoc" if self._liberty else ""
                self.write(f"{name} = {verb}{free} double {value}, {self._number(keys[slot])}")
                value = name
        self.write(
            f"{index}_n = add nuw nsw i64 {index}, 1",
            f"{index}_m = icmp ult i64 {index}_n, {template.count}",
            f"br i1 {index}_m, label %{block}, label %after{self._count}",
        )
        self.begin(f"after{self._count}")
        for total, (node, summed) in zip(totals, sums, strict=True):
            self._values[node] = self._added(f"{total}_n", summed.last)
            self._written.add(node)

    def _sums(self, chosen: Sequence[tuple[int, Sum]]) -> None:
        """Write sums that are one loop."""
        self.compute([node for _, found in chosen for node, _ in (*found.first, *found.last)])
        self.loop(self._repeats.templates[chosen[0][1].loop], [], chosen)

    def _added(self, value: str, terms: Sequence[tuple[int, bool]]) -> str:
        """A number and terms of a sum that are not in its loop."""
        for node, negative in terms:
            name = f"%p{len(self._lines)}"
            self.write(f"{name} = {'fsub' if negative else 'fadd'}{self._liberty} double {value}, {self._number(node)}")
            value = name
        return value

    def _place(self, index: str, first: int, stride: int) -> str:
        name = f"%p{len(self._lines)}"
        self.write(f"{name}_s = mul nsw i64 {index}, {stride}", f"{name} = add nsw i64 {name}_s, {first}")
        return name

    def _put(self, array: str, place: str, value: str) -> None:
        name = f"%p{len(self._lines)}"
        self.write(
            f"{name} = getelementptr inbounds double, {POINTER} {array}, i64 {place}",
            f"store double {value}, {POINTER} {name}",
        )

    def _instruction(self, key: Key, op: int, taken: Sequence[Key], index: str) -> None:
        """Write a node, or a slot of a loop whose copies ``index`` counts."""
        tape = self._tape
        a, b, c = taken
        name = f"%n{key}" if isinstance(key, int) else f"%l{key[0]}_{key[1]}"
        if isinstance(key, int):
            self._written.add(key)
        if op == Op.LIST:
            return
        if isinstance(key, int) and op in (Op.CONSTANT, Op.SOLVE, Op.ENTRY):
            if op == Op.CONSTANT:
                self._values[key] = number(tape.value[key])
            elif op == Op.SOLVE:
                matrix, right = tape.system(key)
                rows = [[self._number(j) for j in (*row, b)] for row, b in zip(matrix, right, strict=True)]
                self._solutions[key] = self._solved(key, rows)
            else:
                self._values[key] = self._solutions[tape.a[key]][int(tape.value[tape.b[key]])]
            return
        if op <= Op.TANGENT:
            assert isinstance(a, int) and isinstance(b, int)
            place = self._place(index, a, b) if index else str(a)
            self.write(
                f"{name}_p = getelementptr inbounds double, {POINTER} {self._sources[op]}, i64 {place}",
                f"{name} = load double, {POINTER} {name}_p",
            )
        elif op in (Op.AND, Op.OR, Op.NOT):
            other = "true" if op == Op.NOT else self._truth(b)
            verb = {Op.AND: "and", Op.OR: "or", Op.NOT: "xor"}[Op(op)]
            self.write(f"{name} = {verb} i1 {self._truth(a)}, {other}")
        elif op == Op.SELECT:
            condition, x, y = self._truth(a), self._number(b), self._number(c)
            self.write(f"{name} = select i1 {condition}, double {x}, double {y}")
        elif op in (Op.GATHER, Op.TAKE):
            assert op == Op.GATHER or isinstance(c, int)
            count = tape.size if op == Op.GATHER else int(tape.value[c])  # type: ignore[index]
            self._read(name, self._number(a), count, "%data2" if op == Op.GATHER else f"{self._values[b]}_p")
        elif op == Op.SEARCH:
            assert isinstance(c, int)
            self._search(name, self._number(a), b, int(tape.value[c]))
        else:
            x, y = self._number(a), "" if b == -1 else self._number(b)
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
        (self._truths if op in _COMPARISONS or op in (Op.AND, Op.OR, Op.NOT) else self._values)[key] = name

    def _read(self, name: str, x: str, count: int, array: str) -> None:
        """Read the x-th of some numbers; whatever x is, one of them is read."""
        last = number(float(count - 1))
        self.write(
            f"{name}_l = fcmp ogt double {x}, {_ZERO}",
            f"{name}_m = select i1 {name}_l, double {x}, double {_ZERO}",
            f"{name}_u = fcmp olt double {name}_m, {last}",
            f"{name}_k = select i1 {name}_u, double {name}_m, double {last}",
            f"{name}_i = fptosi double {name}_k to i64",
            f"{name}_p = getelementptr inbounds double, {POINTER} {array}, i64 {name}_i",
            f"{name} = load double, {POINTER} {name}_p",
        )

    def _search(self, name: str, x: str, begin: Key, count: int) -> None:
        """Bisect increasing numbers: as many steps as their number has binary digits, without a jump."""
        if isinstance(begin, int) and self._tape.is_constant(begin):
            array = f"{name}_b"
            start = int(self._tape.value[begin])
            self.write(f"{array} = getelementptr inbounds double, {POINTER} %data2, i64 {start}")
        else:
            array = f"{self._values[begin]}_p"
        place, left, step = "0", count - 1, 0
        while left > 1:
            half, own = left // 2, f"{name}_{step}"
            self.write(
                f"{own}_h = add nuw nsw i64 {place}, {half}",
                f"{own}_p = getelementptr inbounds double, {POINTER} {array}, i64 {own}_h",
                f"{own}_v = load double, {POINTER} {own}_p",
                f"{own}_c = fcmp ole double {own}_v, {x}",
                f"{own} = select i1 {own}_c, i64 {own}_h, i64 {place}",
            )
            place, left, step = own, left - half, step + 1
        self.write(f"{name} = sitofp i64 {place} to double")

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

    def _number(self, i: Key) -> str:
        value = self._values.get(i)
        if value is None:
            value = self._values[i] = f"%p{len(self._lines)}"
            self.write(f"{value} = uitofp i1 {self._truths[i]} to double")
        return value

    def _truth(self, i: Key) -> str:
        truth = self._truths.get(i)
        if truth is None:
            truth = self._truths[i] = f"%p{len(self._lines)}"
            self.write(f"{truth} = fcmp une double {self._values[i]}, {_ZERO}")
        return truth


def _takes_truth(op: int, place: int) -> bool:
    """Test whether the argument of an operation is a truth value."""
    return op in (Op.AND, Op.OR, Op.NOT) or (op == Op.SELECT and place == 0)


def _added(template: Template, nodes: Sequence[int | None]) -> int | None:
    """Slot of nodes that are all there."""
    there = [node for node in nodes if node is not None]
    return template.add(there) if len(there) == len(nodes) else None
