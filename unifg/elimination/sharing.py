"""Numeric elimination by several threads.

All threads walk through the same phases: write the matrix, eliminate the parts of the tree, then one by one the fronts
above them. The chunks of a phase write to different places; whoever is free takes the next one, and nobody goes on
before all are done. A thread that comes late finds nothing left to do, and none waits for one that has not begun.

Factors are the same to the bit as those of one thread, whatever the number of threads.
"""

from __future__ import annotations

from functools import cache
from math import sqrt

import numpy as np
from numba import float64, int32, int64

from unifg.codegen.jit import compiled
from unifg.codegen.threads import share
from unifg.codegen.vectors import Address, address
from unifg.codegen.waiting import first_chunk, next_chunk, wait_for
from unifg.codegen.work_queue import arguments_at, arrays, bundle, entrance
from unifg.elimination.dense import complete, eliminate, subtract_signed
from unifg.elimination.fronts import (
    BLOCK,
    WIDE,
    add_child,
    begin_count,
    clear,
    clear_update,
    count_front,
    eliminate_front,
    eliminate_part,
    factor,
    scatter,
    size_up,
)
from unifg.elimination.plan import (
    CHILD,
    FAILED,
    FIRST,
    FRONTS,
    PANEL,
    PANELS,
    PIVOTS,
    ROWS,
    SIBLING,
    STRIDE,
    UPDATE,
    UPDATE_STRIDE,
    Plan,
)
from unifg.elimination.subtrees import PARTS
from unifg.typing import Array, IntArray

PLAN = bundle(
    Plan,
    (
        arrays(int64), arrays(int64, 2), arrays(int64), arrays(int32), arrays(int32), arrays(int32), arrays(int32),
        *[arrays(float64)] * 4, arrays(int64), arrays(int64),
    ),
)  # fmt: skip
"""Type of a plan."""
MOST = 16  # chunks of a phase
FEWEST = 20_000.0  # multiplications of a chunk
APART = 8  # columns and rows: kernels write back up to three numbers beyond a chunk's last one


@compiled
def chunks_of(work: float) -> int:
    """Number of chunks for so many multiplications."""
    return max(1, min(MOST, int(work / FEWEST)))


@compiled
def row_of(chunk: int, chunks: int, rows: int, columns: int) -> int:
    """First row of a chunk of the upper triangle of (rows, columns), of which all chunks hold as many entries."""
    if chunk >= chunks:
        return rows
    share = (rows * columns - 0.5 * rows * rows) * chunk / chunks
    row = int(columns - sqrt(max(0.0, float(columns) * columns - 2.0 * share))) // APART * APART
    return min(row, rows)


@compiled
def column_of(chunk: int, chunks: int, start: int, stop: int) -> int:
    """First column of a chunk of start..stop."""
    return stop if chunk >= chunks else start + (stop - start) * chunk // chunks // APART * APART


@compiled
def phases_of(plan: Plan) -> int:
    """Largest number of phases of :func:`work_on`."""
    count = 5
    for s in range(plan.shape[FRONTS]):
        if plan.part[s] == PARTS:
            count += 3 + 3 * (plan.fronts[s, PIVOTS] // BLOCK + 1)
            child = plan.fronts[s, CHILD]
            while child >= 0:
                count += 1
                child = plan.fronts[child, SIBLING]
    return count


@compiled
def work_on(plan: Plan, data: Array, added: Array, counters: Address, told: IntArray) -> None:
    """Work of one thread, see the module.

    Args:
        plan: with parts.
        data: as for :func:`fronts.factor`.
        added: as above.
        counters: of two integers for each phase, zero: chunks taken and chunks done.
        told: (PARTS + 1, 4) receives what ``plan.state`` holds, of each part and of the fronts above them.
    """
    numbers = address(plan.numbers)
    panels, entries, count = plan.shape[PANELS], len(plan.slots), plan.shape[FRONTS]
    k = first_chunk(counters, 0)
    while k < MOST:
        start, stop = panels * k // MOST // 4 * 4, panels * (k + 1) // MOST // 4 * 4
        clear(numbers, start, panels if k == MOST - 1 else stop)
        k = next_chunk(counters, 0)
    wait_for(counters, 0, MOST)
    k = first_chunk(counters, 1)
    while k < MOST:
        scatter(plan, numbers, data, entries * k // MOST, entries * (k + 1) // MOST)
        k = next_chunk(counters, 1)
    wait_for(counters, 1, MOST)
    k = first_chunk(counters, 2)
    while k < MOST:
        size_up(plan, numbers, added, count * k // MOST, count * (k + 1) // MOST)
        k = next_chunk(counters, 2)
    wait_for(counters, 2, MOST)
    k = first_chunk(counters, 3)
    while k < PARTS:
        eliminate_part(plan, k, told[k])
        k = next_chunk(counters, 3)
    wait_for(counters, 3, PARTS)
    phase = 4
    if first_chunk(counters, phase) == 0:
        begin_count(told[PARTS])
        next_chunk(counters, phase)
    wait_for(counters, phase, 1)
    phase += 1
    for s in range(count):
        if plan.part[s] == PARTS:
            phase = _front(plan, numbers, s, counters, phase, told[PARTS])


@compiled
def _front(plan: Plan, numbers: Address, s: int, counters: Address, phase: int, state: IntArray) -> int:
    """Take part in the elimination of a front above all parts; the next phase."""
    fronts, pivots, signs, scale = plan.fronts, address(plan.pivots), address(plan.signs), address(plan.work)
    first, width, rows, panel, stride, update, apart = (
        fronts[s, FIRST], fronts[s, PIVOTS], fronts[s, ROWS], fronts[s, PANEL], fronts[s, STRIDE], fronts[s, UPDATE],
        fronts[s, UPDATE_STRIDE],
    )  # fmt: skip
    columns = width + rows
    chunks = chunks_of(0.5 * rows * rows)
    k = first_chunk(counters, phase)
    while k < chunks:
        clear_update(plan, numbers, s, row_of(k, chunks, rows, rows), row_of(k + 1, chunks, rows, rows))
        k = next_chunk(counters, phase)
    wait_for(counters, phase, chunks)
    phase += 1
    child = fronts[s, CHILD]
    while child >= 0:
        size = fronts[child, ROWS]
        chunks = chunks_of(2.0 * size * size)
        k = first_chunk(counters, phase)
        while k < chunks:
            add_child(plan, numbers, s, child, row_of(k, chunks, size, size), row_of(k + 1, chunks, size, size))
            k = next_chunk(counters, phase)
        wait_for(counters, phase, chunks)
        phase += 1
        child = fronts[child, SIBLING]
    if columns <= WIDE:
        if first_chunk(counters, phase) == 0:
            failed = eliminate_front(
                numbers, panel, stride, width, columns, update, apart, rows, scale, pivots, signs, first
            )
            count_front(plan, s, failed, state)
            next_chunk(counters, phase)
        wait_for(counters, phase, 1)
        return phase + 1
    for begin in range(0, width, BLOCK):
        end = begin + BLOCK if begin + BLOCK < width else width
        if first_chunk(counters, phase) == 0:
            failed = eliminate(numbers, panel, stride, begin, end, end, scale, pivots, signs, first)
            if failed >= 0 or end == width:
                count_front(plan, s, failed, state)
            next_chunk(counters, phase)
        wait_for(counters, phase, 1)
        phase += 1
        if state[FAILED] >= 0:
            return phase
        beyond = columns - end
        chunks = chunks_of(0.5 * (end - begin) * (end - begin) * beyond)
        k = first_chunk(counters, phase)
        while k < chunks:
            start, stop = column_of(k, chunks, end, columns), column_of(k + 1, chunks, end, columns)
            complete(numbers, panel, stride, begin, end, start, stop, pivots, signs, first)
            k = next_chunk(counters, phase)
        wait_for(counters, phase, chunks)
        phase += 1
        if end < width:
            below = width - end
            chunks = chunks_of((below * beyond - 0.5 * below * below) * (end - begin))
            k = first_chunk(counters, phase)
            while k < chunks:
                subtract_signed(
                    numbers, panel + end * (stride + 1), stride, beyond, panel + begin * stride + end, stride,
                    end - begin, signs, first + begin, row_of(k, chunks, below, beyond),
                    row_of(k + 1, chunks, below, beyond),
                )  # fmt: skip
                k = next_chunk(counters, phase)
            wait_for(counters, phase, chunks)
            phase += 1
    chunks = chunks_of(0.5 * rows * rows * width)
    k = first_chunk(counters, phase)
    while k < chunks:
        subtract_signed(
            numbers, update, apart, rows, panel + width, stride, width, signs, first,
            row_of(k, chunks, rows, rows), row_of(k + 1, chunks, rows, rows),
        )  # fmt: skip
        k = next_chunk(counters, phase)
    wait_for(counters, phase, chunks)
    return phase + 1


_of_factor = arguments_at((PLAN, arrays(float64), arrays(float64), int64, arrays(int64, 2)))


@compiled
def _factor_share(where: Address) -> None:
    plan, data, added, counters, told = _of_factor(where)
    work_on(plan, data, added, counters, told)


@cache
def _entrance() -> Address:
    return entrance(_factor_share)


def factor_at_once(plan: Plan, data: Array, added: Array) -> bool:
    """Parallel :func:`fronts.factor`, with the same bits."""
    told = np.empty((PARTS + 1, len(plan.state)), np.int64)
    counters = np.zeros(2 * phases_of(plan), np.int64)
    share(_entrance(), (plan, data, added, counters.ctypes.data, told))
    if told[:, FAILED].max() >= 0:
        return bool(factor(plan, data, added))  # which stops where the first pivot vanishes, and says where
    plan.state[:] = told.sum(axis=0)
    plan.state[FAILED] = -1
    return True
