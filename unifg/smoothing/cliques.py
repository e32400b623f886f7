"""Numeric work on one clique: assemble its front, eliminate its pivots, and find its step later.

A front is a square matrix, of which the upper triangle is used, and one more column for the right-hand side: pivots
first, then the separator. Eliminated, its first rows hold U and d of ``U step = d``, the others the update matrix
that the parent adds to its own front (J. Liu, "The multifrontal method", SIAM Review 34 (1992)).
"""

from __future__ import annotations

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address, address, get, splat, store
from unifg.elimination.assembly import add_products, add_update
from unifg.elimination.fronts import eliminate_front
from unifg.elimination.substitution import backward
from unifg.smoothing.memory import length_of_front, take_list, take_numbers
from unifg.smoothing.state import Record, opened
from unifg.typing import Array, IntArray


@compiled
def begin_clique(
    memory: Address, c: int, members: IntArray, order: IntArray, first: int, last: int, separator: IntArray,
    begin: int, end: int, size: int, place: IntArray,
) -> None:  # fmt: skip
    """Lay out a clique with an empty front; its children stay.

    Args:
        memory: address of the description of the smoother's arrays; there must be room.
        c: the clique.
        members: variables by their local numbers.
        order: local numbers in the order of elimination.
        first: where those it eliminates begin there.
        last: one past them.
        separator: local numbers of those that cliques touch beside.
        begin: where its own begin.
        end: one past them.
        size: scalars of all.
        place: receives the first row of each by its local number.
    """
    state = opened(memory)
    variables, lists, numbers, clique = state.variables, state.lists, state.numbers, state.cliques[c]
    clique.pivots, clique.count = last - first, last - first + end - begin
    clique.size, clique.stride, clique.marked, clique.prior, clique.filled = size, size + 1, 0, 0, 1
    clique.list, clique.front = take_list(memory, clique.count), take_numbers(memory, length_of_front(size))
    clique.parent, clique.sibling, row = -1, -1, 0
    for k in range(clique.count):
        local = order[first + k] if k < clique.pivots else separator[begin + k - clique.pivots]
        v = members[local]
        lists[clique.list + k], place[local] = v, row
        if k < clique.pivots:
            variables[v].clique, variables[v].place = c, row
            clique.pivot_rows = row + variables[v].dim
        row += variables[v].dim
    at, zero = clique.front, splat(0.0)
    for q in range(size):  # from the diagonal on, and where vectors that begin in the row above may end
        store(numbers, at, zero)
        for column in range(q, size + 1, 4):
            store(numbers, at + column, zero)
        at += size + 1
    store(numbers, at, zero)


@compiled
def add_factor(memory: Address, f: int, place: IntArray, clique: Record, rows: IntArray, dims: IntArray) -> None:
    """Add a linearised factor to a front; ``place`` has the first row of each variable by its local number."""
    state = opened(memory)
    lists, variables, factor = state.lists, state.variables, state.factors[f]
    kind = state.types[factor.type]
    for s in range(kind.slots):
        slot = state.slots[kind.slot + s]
        rows[s], dims[s] = place[variables[get(lists, factor.variables + s)].local] + slot.tangent, slot.dim
    add_products(
        address(state.numbers), factor.data + kind.numbers, kind.width, kind.slots, rows, dims, clique.front,
        clique.stride, clique.size,
    )  # fmt: skip


@compiled
def add_child(
    memory: Address, child: Record, place: IntArray, clique: Record, relative: IntArray, runs: IntArray
) -> None:
    """Add the update matrix of a child to the front of its parent."""
    state = opened(memory)
    variables, lists, count = state.variables, state.lists, 0
    for k in range(child.list + child.pivots, child.list + child.count):
        variable = variables[lists[k]]
        row = place[variable.local]
        for d in range(variable.dim):
            relative[count] = row + d
            count += 1
    relative[count] = clique.size
    add_update(
        address(state.numbers), child.front + child.pivot_rows * (child.stride + 1), child.stride, count,
        clique.front, clique.stride, relative, runs,
    )  # fmt: skip


@compiled
def eliminate_clique(memory: Address, clique: Record, scale: Array, pivots: Array, signs: Array) -> int:
    """Eliminate the pivots of an assembled front; returns -1, or the variable whose pivot vanished."""
    state = opened(memory)
    numbers, lists, variables = state.numbers, state.lists, state.variables
    front, stride, size, width = clique.front, clique.stride, clique.size, clique.pivot_rows
    at = 0
    for k in range(clique.list, clique.list + clique.pivots):
        variable = variables[lists[k]]
        dim = variable.dim
        start = variable.value + variable.storage + 2 * dim
        for d in range(dim):
            scale[at] = numbers[start + d]
            at += 1
    first = front - front  # zero, of which compiled code does not know it: functions are compiled anew for a literal
    failed = eliminate_front(
        address(numbers), front, stride, width, size + 1, front + width * (stride + 1), stride, size - width,
        address(scale), address(pivots), address(signs), first,
    )  # fmt: skip
    for i in range(width if failed < 0 else failed):
        if signs[i] < 0.0:
            failed = i
            break
    if failed < 0:
        return -1
    at = 0
    for k in range(clique.list, clique.list + clique.pivots):
        at += variables[lists[k]].dim
        if failed < at:
            return int(lists[k])
    return int(lists[clique.list])


@compiled
def substitute(
    memory: Address, clique: Record, threshold: float, limit: float, update: int, x: Array, pivots: Array
) -> None:
    """Find the step of the pivots, given that of the separator.

    Args:
        memory: address of the description of the smoother's arrays.
        clique: eliminated.
        threshold: variables that moved further than this since they last did are marked.
        limit: steps beyond it make a variable a candidate for relinearisation.
        update: number of this update.
        x: scratch, (size + 4,).
        pivots: the same.
    """
    state = opened(memory)
    numbers, lists, variables, counters = state.numbers, state.lists, state.variables, state.counters[0]
    front, stride, size, width = clique.front, clique.stride, clique.size, clique.pivot_rows
    for i in range(width):
        row = front + i * stride
        x[i], pivots[i] = numbers[row + size], 1.0 / numbers[row + i]
    at = width
    for k in range(clique.list + clique.pivots, clique.list + clique.count):
        variable = variables[lists[k]]
        step = variable.value + variable.storage
        for d in range(variable.dim):
            x[at] = numbers[step + d]
            at += 1
    zero = front - front  # see above
    backward(address(x), zero, address(numbers), front, stride, width, size, address(pivots), zero)
    at = 0
    for k in range(clique.list, clique.list + clique.pivots):
        v = lists[k]
        variable = variables[v]
        dim = variable.dim
        step = variable.value + variable.storage
        moved, largest = 0.0, 0.0
        for d in range(dim):
            numbers[step + d] = x[at]
            largest = max(largest, abs(x[at]))
            moved = max(moved, abs(x[at] - numbers[step + dim + d]))
            at += 1
        if moved > threshold:
            variable.changed = update
            for d in range(dim):
                numbers[step + dim + d] = numbers[step + d]
        if largest > limit and variable.candidate == 0 and variable.frozen != 1:
            variable.candidate = 1
            variable.next_candidate = counters.candidates
            counters.candidates = v
