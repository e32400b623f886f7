"""Factors between two poses, by loops of fixed size: whitening, and adding up J'r and J'J.

Most factors of a map tie two poses of SE(2) or SE(3) together: m = d rows and D = 2 d columns, six or twelve. Loops
whose lengths the compiler knows are unrolled and work on four numbers at a time. And the places of their products in
the matrix of the normal equations need not be looked up one by one. Matrices of blocks, compressed by columns, store
the columns of a variable one after the other, each one number longer than the last: where the first column of a block
begins and how far the second is from it says where all of them are. Factors for which this holds are called paired.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

from unifg.codegen.calls import local_vector
from unifg.codegen.function_pointers import ADDRESS, NOTHING, link
from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address, get, load, plus, put, store, times
from unifg.typing import IntArray

PLANE, SPACE = 3, 6  # rows of the factors with loops of their own

Whiten: TypeAlias = Callable[[Address, int, Address, int, Address, int], None]
Add: TypeAlias = Callable[
    [Address, int, Address, int, Address, int, int, Address, int, int, int, int, int, int, int], None
]


@cache
def _whitening(dim: int) -> Whiten:
    """Compile W r and W J for d rows."""
    width, full = 2 * dim, 2 * dim // 4 * 4

    @compiled
    def whiten(whiteners: Address, first: int, residual: Address, row: int, jacobian: Address, entry: int) -> None:
        """W r and W J of one factor in place, W upper triangular.

        Args:
            whiteners: address of the array W stands in, row by row.
            first: its offset.
            residual: address of the array of r.
            row: its offset.
            jacobian: address of the array of J, row by row.
            entry: its offset.
        """
        for a in range(dim):
            weights, block_row = first + a * dim, entry + a * width
            own = get(whiteners, weights + a)
            total = own * get(residual, row + a)
            for b in range(a + 1, dim):
                total += get(whiteners, weights + b) * get(residual, row + b)
            put(residual, row + a, total)
            for c in range(0, full, 4):
                whitened = times(own, load(jacobian, block_row + c))
                for b in range(a + 1, dim):
                    whitened = plus(whitened, get(whiteners, weights + b), load(jacobian, entry + b * width + c))
                store(jacobian, block_row + c, whitened)
            for c in range(full, width):
                total = own * get(jacobian, block_row + c)
                for b in range(a + 1, dim):
                    total += get(whiteners, weights + b) * get(jacobian, entry + b * width + c)
                put(jacobian, block_row + c, total)

    return whiten


@cache
def _adding(dim: int) -> Add:
    """Compile the addition of J'r and J'J for d rows."""
    width, full, room = 2 * dim, 2 * dim // 4 * 4, 4 * dim * dim

    @compiled
    def add(
        residual: Address, row: int, jacobian: Address, entry: int,
        gradient: Address, first: int, second: int,
        hessian: Address, own: int, step: int, other: int, hop: int, shared: int, side: int, across: int,
    ) -> None:  # fmt: skip
        """Add J'r and the upper triangle of J'J of one factor.

        Args:
            residual: address of the array of r.
            row: its offset.
            jacobian: address of the array of J, row by row.
            entry: its offset.
            gradient: address of the gradient.
            first: offset there of the first variable.
            second: the same of the second.
            hessian: address of the entries of the matrix.
            own: place of the first variable's first entry on the diagonal, negative where the variable is fixed.
            step: from there to the second entry of its first row, a column later.
            other: the same of the second variable.
            hop: see above.
            shared: place of the first entry of both variables, negative where one is fixed.
            side: from there to the entry of the first variable's second coordinate: 1 where the first variable comes
                first in the matrix, else a column later.
            across: from the same place to the entry of the second variable's second coordinate.
        """
        products = local_vector(room)
        for d in range(width):
            for c in range(0, full, 4):
                if c <= d:
                    found = times(get(jacobian, entry + d), load(jacobian, entry + c))
                    for a in range(1, dim):
                        at = entry + a * width
                        found = plus(found, get(jacobian, at + d), load(jacobian, at + c))
                    store(products, d * width + c, found)
            for c in range(full, d + 1):
                total = 0.0
                for a in range(dim):
                    total += get(jacobian, entry + a * width + d) * get(jacobian, entry + a * width + c)
                products[d * width + c] = total
        for d in range(dim):
            total, beside = 0.0, 0.0
            for a in range(dim):
                at = entry + a * width + d
                total += get(jacobian, at) * get(residual, row + a)
                beside += get(jacobian, at + dim) * get(residual, row + a)
            put(gradient, first + d, get(gradient, first + d) + total)
            put(gradient, second + d, get(gradient, second + d) + beside)
        if own >= 0:
            at = own
            for d in range(dim):
                for e in range(d + 1):
                    put(hessian, at + e, get(hessian, at + e) + products[d * width + e])
                at += step + d
        if other >= 0:
            at = other
            for d in range(dim):
                for e in range(d + 1):
                    put(hessian, at + e, get(hessian, at + e) + products[(dim + d) * width + dim + e])
                at += hop + d
        if shared >= 0 and side == 1:
            at = shared
            for d in range(dim):
                for e in range(dim):
                    put(hessian, at + e, get(hessian, at + e) + products[(dim + d) * width + e])
                at += across + d
        elif shared >= 0:
            at = shared
            for e in range(dim):
                for d in range(dim):
                    put(hessian, at + d, get(hessian, at + d) + products[(dim + d) * width + e])
                at += side + e

    return add


@cache
def loops_of(dim: int) -> tuple[int, int]:
    """Addresses of what whitens and what adds up factors of d rows, compiled when first asked for."""
    return link(_whitening(dim), NOTHING, *[ADDRESS] * 6), link(_adding(dim), NOTHING, *[ADDRESS] * 15)


@compiled
def paired(columns: IntArray, positions: IntArray, dim: int) -> bool:
    """Test whether all places of factors with two variables of d columns each follow from those of a few.

    Args:
        columns: (n, 2 d) full tangent columns of the factors.
        positions: (n, d (2 d + 1)) places of every pair of columns, as in ``TermArrays``.
        dim: d.
    """
    corner = dim * (dim + 1) // 2
    below = corner + dim + 1  # of the second variable's second row
    for i in range(len(columns)):
        own, step = positions[i, 0], positions[i, 1] - positions[i, 0]
        shared, side = positions[i, corner], positions[i, corner + 1] - positions[i, corner]
        other, hop = positions[i, corner + dim], positions[i, below + dim] - positions[i, corner + dim]
        across = positions[i, below] - shared
        if own < -1 or other < -1 or shared < -1:
            return False
        for d in range(dim):
            if columns[i, d] != columns[i, 0] + d or columns[i, dim + d] != columns[i, dim] + d:
                return False
            top, base, grown = d * (d + 1) // 2, (dim + d) * (dim + d + 1) // 2, d * (d - 1) // 2
            for e in range(d + 1):
                if positions[i, top + e] != (own + d * step + grown + e if own >= 0 else -1):
                    return False
                if positions[i, base + dim + e] != (other + d * hop + grown + e if other >= 0 else -1):
                    return False
            for e in range(dim):
                at = -1
                if shared >= 0:
                    at = shared + (d * across + grown + e if side == 1 else e * side + e * (e - 1) // 2 + d)
                if positions[i, base + e] != at:
                    return False
    return True
