"""Repeated expressions of a tape: parts that differ in the places of their leaves alone, by equal strides.

A function of M obstacles is traced as M copies of one expression, whose k-th reads the parameters at p + s k. Such
copies become one loop: rows of a residual that are stored one after the other, and the terms of long sums.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.tape import Tape

FEWEST = 6  # copies that are worth a loop
LAGS = (1, 2, 3, 4, 6)  # kinds of copies that alternate
INVARIANT = -1  # operation of a slot that is the same node in every copy
_UNSUITABLE = frozenset({Op.CONSTANT, Op.LIST, Op.SOLVE, Op.ENTRY})
_COMMUTES = frozenset({Op.ADD, Op.MULTIPLY, Op.EQUAL, Op.AND, Op.OR})


class Slot(NamedTuple):
    """A node of the repeated expression.

    Attributes:
        op: operation, or `INVARIANT`.
        a, b, c: slots it takes, -1 for none; of a leaf, place in the first copy and stride; of an invariant, its node.
    """

    op: int
    a: int
    b: int = -1
    c: int = -1


class Template:
    """Expressions that are repeated equally often, as slots; what a slot takes stands before it.

    Attributes:
        count: copies.
        slots: of all expressions.
    """

    def __init__(self, tape: Tape, count: int) -> None:
        """Begin without an expression."""
        self.count = count
        self.slots: list[Slot] = []
        self._tape = tape
        self._found: dict[tuple[int, int], int | None] = {}

    def add(self, nodes: Sequence[int]) -> int | None:
        """Slot of an expression whose copies are nodes; None where they are no copies at equal strides."""
        slot = self._unify(nodes[0], nodes[1])
        if slot is None or not all(self.matches(slot, node, k) for k, node in enumerate(nodes[2:], start=2)):
            return None
        return slot

    def matches(self, slot: int, node: int, k: int) -> bool:
        """Test whether a node is the k-th copy of an expression."""
        try:
            return self._matches(slot, node, k, {})
        except RecursionError:  # an expression as deep as this is no obstacle's
            return False

    def reached(self, outputs: Iterable[int]) -> list[int]:
        """Slots that others depend on, in order."""
        needed, waiting = set(outputs), list(outputs)
        while waiting:
            slot = self.slots[waiting.pop()]
            for taken in () if slot.op <= Op.TANGENT else slot[1:]:
                if taken >= 0 and taken not in needed:
                    needed.add(taken)
                    waiting.append(taken)
        return sorted(needed)

    def _unify(self, first: int, second: int) -> int | None:
        """Slot of two nodes in the place of the first and the second copy."""
        if (first, second) not in self._found:
            try:
                self._found[first, second] = self._unified(first, second)
            except RecursionError:
                return None
        return self._found[first, second]

    def _unified(self, first: int, second: int) -> int | None:
        tape, op = self._tape, self._tape.op[first]
        if first == second:
            return self._append(Slot(INVARIANT, first))
        if op != tape.op[second] or op in _UNSUITABLE:
            return None
        if op <= Op.TANGENT:
            return self._append(Slot(op, tape.a[first], tape.a[second] - tape.a[first]))
        one, other = ((tape.a[i], tape.b[i], tape.c[i]) for i in (first, second))
        orders = [other, (other[1], other[0], other[2])] if op in _COMMUTES else [other]
        for order in orders:
            taken = [-1 if i < 0 else self._unify(i, j) for i, j in zip(one, order, strict=True)]
            if None not in taken:
                return self._append(Slot(op, *(slot for slot in taken if slot is not None)))
        return None

    def _append(self, slot: Slot) -> int:
        self.slots.append(slot)
        return len(self.slots) - 1

    def _matches(self, slot: int, node: int, k: int, known: dict[tuple[int, int], bool]) -> bool:
        """Test whether a node is the k-th copy of a slot; what is known is not compared again."""
        if (slot, node) not in known:
            known[slot, node] = self._compared(slot, node, k, known)
        return known[slot, node]

    def _compared(self, slot: int, node: int, k: int, known: dict[tuple[int, int], bool]) -> bool:
        tape, (op, a, b, c) = self._tape, self.slots[slot]
        if op == INVARIANT:
            return node == a
        if tape.op[node] != op:
            return False
        if op <= Op.TANGENT:
            return tape.a[node] == a + k * b
        given = tape.a[node], tape.b[node], tape.c[node]
        orders = [given, (given[1], given[0], given[2])] if op in _COMMUTES else [given]
        return any(
            all(s < 0 or self._matches(s, i, k, known) for s, i in zip((a, b, c), order, strict=True))
            for order in orders
        )


class Sum(NamedTuple):
    """A sum with terms in a loop.

    Attributes:
        loop: number of the template.
        terms: slots, and whether they are subtracted.
        first, last: other terms, nodes, and whether they are subtracted; what comes after the loop is added after it.
    """

    loop: int
    terms: list[tuple[int, bool]]
    first: list[tuple[int, bool]]
    last: list[tuple[int, bool]]


class Repeats:
    """Repeated parts of a tape: long sums, and on demand rows.

    Attributes:
        templates: one for each level of sums that depend on each other, and number of copies.
        sums: by their nodes.
    """

    def __init__(self, tape: Tape, outputs: Iterable[int]) -> None:
        """Find the sums that outputs depend on."""
        self._tape = tape
        self.templates: list[Template] = []
        self.sums: dict[int, Sum] = {}
        self._loops: dict[tuple[int, int], int] = {}
        outputs = list(outputs)
        live = tape.live(outputs)
        self._shapes = _shapes(tape, live)
        uses = Counter(outputs)
        for i in live:
            if tape.op[i] > Op.TANGENT:
                uses.update(j for j in (tape.a[i], tape.b[i], tape.c[i]) if j >= 0)
        before = {i: self._before(i, uses) for i in live if tape.op[i] in _SUMMED}
        inner = set(before.values())
        levels = dict.fromkeys(live, 0)
        for i in live:
            if tape.op[i] > Op.TANGENT:
                levels[i] = max(levels[j] for j in (tape.a[i], tape.b[i], tape.c[i]) if j >= 0)
            if i in before and i not in inner and self._sum(i, before, levels[i]):
                levels[i] += 1

    def rows(self, nodes: Sequence[int]) -> list[range]:
        """Ranges of places at which the nodes are copies of each other."""
        buckets = defaultdict[int, list[int]](list)
        for place, node in enumerate(nodes):
            buckets[self._shapes[node]].append(place)
        found = []
        for places in buckets.values():
            found += [range(run[0], run[-1] + 1, run[1] - run[0]) for run in self._runs(places, nodes) if _even(run)]
        return found

    def _runs(self, places: Sequence[int], nodes: Sequence[int]) -> list[list[int]]:
        """Disjoint lists of places whose nodes are copies."""
        if len(places) < FEWEST:
            return []
        for lag in LAGS:
            runs = [run for first in range(lag) if len(run := self._run(places[first::lag], nodes)) >= FEWEST]
            if runs:
                return runs
        return []

    def _run(self, places: Sequence[int], nodes: Sequence[int]) -> list[int]:
        """The longest list of copies among places, from the first."""
        template = Template(self._tape, 0)
        slot = template.add([nodes[place] for place in places[:2]]) if len(places) >= FEWEST else None
        if slot is None:
            return []
        count = 2
        while count < len(places) and template.matches(slot, nodes[places[count]], count):
            count += 1
        return list(places[:count])

    def _before(self, i: int, uses: Counter[int]) -> int:
        """The sum that a sum adds one term to, -1 for none: it has no other user."""
        tape = self._tape
        taken = (tape.a[i], tape.b[i]) if tape.op[i] == Op.ADD else (tape.a[i],)
        return max((j for j in taken if tape.op[j] in _SUMMED and uses[j] == 1), default=-1)

    def _sum(self, root: int, before: dict[int, int], level: int) -> bool:
        """Put down a sum if enough of its terms are copies."""
        tape, terms, i = self._tape, list[tuple[int, bool]](), root
        while i >= 0:
            a, b, last = tape.a[i], tape.b[i], before[i]
            if last != b:
                terms.append((b, tape.op[i] == Op.SUBTRACT))
            if last != a:
                terms.append((a, False))
            i = last
        if len(terms) < FEWEST:
            return False
        terms.reverse()
        if terms[2] < terms[0] < terms[1]:  # which of the first two came first is not kept
            terms[:2] = terms[1::-1]
        buckets = defaultdict[tuple[int, bool], list[int]](list)
        for i, negative in terms:
            buckets[self._shapes[i], negative].append(i)
        looped: list[tuple[list[int], bool]] = []
        for (_, negative), nodes in buckets.items():
            looped += [([nodes[k] for k in run], negative) for run in self._runs(range(len(nodes)), nodes)]
        if not looped:
            return False
        count = max(len(copies) for copies, _ in looped)
        looped = [(copies, negative) for copies, negative in looped if len(copies) == count]
        loop = self._loops.setdefault((level, count), len(self.templates))
        if loop == len(self.templates):
            self.templates.append(Template(tape, count))
        rest, slots = Counter(terms), list[tuple[int, bool]]()
        for copies, negative in looped:
            slot = self.templates[loop].add(copies)
            assert slot is not None
            slots.append((slot, negative))
            rest.subtract((i, negative) for i in copies)
        place = terms.index((looped[0][0][0], looped[0][1]))
        others = list(rest.elements())
        self.sums[root] = Sum(loop, slots, others[:place], others[place:])
        return True


_SUMMED = frozenset({Op.ADD, Op.SUBTRACT})


def _shapes(tape: Tape, live: Iterable[int]) -> dict[int, int]:
    """Hashes of expressions without the places of their leaves."""
    found: dict[int, int] = {}
    for i in live:
        op = tape.op[i]
        key: tuple[float, ...] = (op, tape.value[i])
        if op > Op.TANGENT:
            taken = [found[j] for j in (tape.a[i], tape.b[i], tape.c[i]) if j >= 0]
            key = (op, *(sorted(taken) if op in _COMMUTES else taken))
        found[i] = hash(key)
    return found


def _even(run: Sequence[int]) -> bool:
    """Test whether places lie at equal distances."""
    return list(run) == list(range(run[0], run[-1] + 1, run[1] - run[0]))
