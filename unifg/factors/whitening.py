"""From standard deviations or information matrices to the W that makes 1/2 |W r|^2 of a cost."""

from __future__ import annotations

from math import sqrt

import numpy as np

from unifg.codegen.jit import compiled, inlined
from unifg.errors import GraphError
from unifg.typing import Array

DIAGONAL, FULL = 2, 4  # kinds of W; 1 is added when every factor has its own


@inlined
def whiten(kind: int, whiteners: Array, first: int, i: int, r: Array, J: Array) -> None:
    """W r and W J of factor i in place; a full W is upper triangular.

    Args:
        kind: of W, 0 for none.
        whiteners: reciprocal standard deviations, or whole W row by row.
        first: where that of factor 0 begins, which is everybody's if not every factor has its own.
        i: the factor.
        r: (m,).
        J: (m, D), or without rows where it is not wanted.
    """
    rows, width = len(r), J.shape[1]
    if kind & DIAGONAL:
        start = first + i * (kind & 1) * rows
        for a in range(rows):
            w = whiteners[start + a]
            r[a] *= w
            if len(J):
                for d in range(width):
                    J[a, d] *= w
    elif kind & FULL:
        start = first + i * (kind & 1) * rows * rows
        for a in range(rows):
            total = 0.0
            for b in range(a, rows):
                total += whiteners[start + a * rows + b] * r[b]
            r[a] = total
            if len(J):
                w = whiteners[start + a * rows + a]
                for d in range(width):
                    J[a, d] *= w
                for b in range(a + 1, rows):
                    w = whiteners[start + a * rows + b]
                    for d in range(width):
                        J[a, d] += w * J[b, d]


def whitener_of(name: str, sigma: Array | None, information: Array | None, count: int, size: int) -> tuple[int, Array]:
    """Kind of whitening, 0 for none, and what it multiplies by, see :func:`reciprocals` and :func:`square_roots`.

    Raises:
        GraphError: naming the term, when a weight does not fit.
    """
    if sigma is not None:
        return DIAGONAL, reciprocals(name, sigma, count, size)
    if information is not None:
        return FULL, square_roots(name, information, count, size)
    return 0, np.zeros((1, 0))


def reciprocals(name: str, sigma: Array, count: int, size: int) -> Array:
    """1 / sigma as (1, m) or (n, m).

    Raises:
        GraphError: naming the term, when sigma has another shape or is not positive.
    """
    if sigma.shape not in ((), (size,), (count, size)):
        each = "; repeat one number for each factor: sigma[:, None] * np.ones(m)" if sigma.shape[:1] == (count,) else ""
        raise GraphError(
            f"term '{name}': sigma has shape {sigma.shape}, expected (), ({size},) or {(count, size)}{each}", term=name
        )
    if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        place = tuple(int(k) for k in np.argwhere(~(np.isfinite(sigma) & (sigma > 0.0)))[0])
        at = f" at {place}" if place else ""
        raise GraphError(
            f"term '{name}': sigma must be positive and finite, found {sigma[place]:g}{at}; "
            "leave factors out with active=, hold rows exactly with constrain",
            term=name,
            index=place[0] if len(place) == 2 else None,
        )
    return np.array(np.broadcast_to(1.0 / sigma, (len(sigma) if sigma.ndim == 2 else 1, size)))


def square_roots(name: str, information: Array, count: int, size: int) -> Array:
    """Upper triangular W with W'W = information, (1, m, m) or (n, m, m); information may be singular.

    Raises:
        GraphError: naming the term and factor, when information is not symmetric positive semi-definite.
    """
    m = size
    if information.shape not in ((m, m), (count, m, m)):
        raise GraphError(
            f"term '{name}': information has shape {information.shape}, expected {(m, m)} or {(count, m, m)}",
            term=name,
        )
    stack = np.array(information, dtype=np.float64, order="C").reshape(-1, m, m)
    quick = np.empty((len(stack), m * m))
    if quick_roots(stack, quick):
        return quick.reshape(stack.shape)
    transposed, size_of = np.swapaxes(stack, -1, -2), np.sqrt(np.abs(np.einsum("nii->ni", stack)))
    # Beside an entry of two rows that depend on each other: rounding leaves no digit of one that is next to nothing.
    whole = np.maximum(np.abs(transposed), size_of[:, :, None] * size_of[:, None, :])
    unequal = ~(np.abs(stack - transposed) <= 1e-9 * whole) | ~np.isfinite(stack)
    if unequal.any():
        index, row, column = (int(k) for k in np.argwhere(unequal)[0])
        raise GraphError(
            f"term '{name}': information must be finite and symmetric, found {stack[index, row, column]!s} at "
            f"{(row, column)} and {stack[index, column, row]!s} at {(column, row)}"
            f"{f' of factor {index}' if len(stack) > 1 else ''}; of an inverse, which rounding leaves unsymmetric, "
            "give (S + S.T) / 2",
            term=name,
            index=index,
        )
    stack = 0.5 * (stack + transposed)
    try:
        lower = np.linalg.cholesky(stack)
    except np.linalg.LinAlgError:  # singular, or wrong
        eigenvalues, vectors = np.linalg.eigh(stack)
        lowest = eigenvalues.min(axis=-1) / np.maximum(np.abs(eigenvalues).max(axis=-1), 1e-300)
        if (lowest < -1e-9).any():
            index = int(np.argmin(lowest))
            raise GraphError(
                f"term '{name}': information of factor {index} has a negative eigenvalue, "
                f"{eigenvalues[index].min():g}: it must be positive semi-definite",
                term=name,
                index=index,
            ) from None
        roots = np.sqrt(np.maximum(eigenvalues, 0.0))[..., :, None] * np.swapaxes(vectors, -1, -2)
        return np.asarray(np.linalg.qr(roots, mode="r"))
    return np.ascontiguousarray(np.swapaxes(lower, -1, -2))


@compiled
def whiten_rows(kind: int, whiteners: Array, residual: Array, jacobian: Array) -> None:
    """Whiten (n, m) residuals and (n, m, D) Jacobians, or (0, m, D) where they are not wanted, in place."""
    flat = whiteners.ravel()
    for i in range(len(residual)):
        whiten(kind, flat, 0, i, residual[i], jacobian[i] if len(jacobian) else np.empty((0, 0)))


@compiled
def quick_roots(information: Array, out: Array) -> bool:
    """Upper triangular W with W'W of (n, m, m) matrices into (n, m m); False unless all are positive definite."""
    count, m = len(information), information.shape[1]
    for k in range(count):
        for i in range(m):
            for j in range(m):
                a, b = information[k, i, j], information[k, j, i]
                if not abs(a - b) <= 1e-9 * abs(b):
                    return False
                out[k, i * m + j] = a if j >= i else 0.0
        for i in range(m):
            pivot = out[k, i * m + i]
            if not 1e-13 * information[k, i, i] < pivot < np.inf:
                return False
            root = sqrt(pivot)
            for j in range(i, m):
                out[k, i * m + j] /= root
            for a in range(i + 1, m):
                for b in range(a, m):
                    out[k, a * m + b] -= out[k, i * m + a] * out[k, i * m + b]
    return True
