"""Vectors under addition, one at a time: storage and tangent are the vector; Sola 2018, appendix E."""

from __future__ import annotations

from unifg.machine.jit import compiled, in_order
from unifg.typing import Array


@in_order
def minus(a: float, b: float) -> float:
    """Return ``a - b`` as it stands: of (y - x) - b a compiler would make y - (x + b), which is rounded far out."""
    return a - b


@compiled
def exp(d: Array, out: Array) -> None:
    """Copy."""
    for i in range(len(d)):
        out[i] = d[i]


@compiled
def log(x: Array, out: Array) -> None:
    """Copy."""
    for i in range(len(x)):
        out[i] = x[i]


@compiled
def compose(x: Array, y: Array, out: Array) -> None:
    """Add."""
    for i in range(len(x)):
        out[i] = x[i] + y[i]


@compiled
def inverse(x: Array, out: Array) -> None:
    """Negate."""
    for i in range(len(x)):
        out[i] = -x[i]


@compiled
def between(x: Array, y: Array, out: Array) -> None:
    """``y - x``."""
    for i in range(len(x)):
        out[i] = minus(y[i], x[i])


@compiled
def retract(x: Array, d: Array, out: Array) -> None:
    """``x + d``."""
    for i in range(len(x)):
        out[i] = x[i] + d[i]


@compiled
def local(x: Array, y: Array, out: Array) -> None:
    """``y - x``."""
    for i in range(len(x)):
        out[i] = minus(y[i], x[i])


@compiled
def act(x: Array, p: Array, out: Array) -> None:
    """Translate an (n,) point."""
    for i in range(len(x)):
        out[i] = x[i] + p[i]


@compiled
def unit(out: Array) -> None:
    """Write an identity matrix of the size of ``out``."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 1.0 if i == j else 0.0


@compiled
def matrix(x: Array, out: Array) -> None:
    """Write the (n + 1, n + 1) homogeneous translation."""
    unit(out)
    for i in range(len(x)):
        out[i, len(x)] = x[i]


@compiled
def adjoint(x: Array, out: Array) -> None:
    """Write the (n, n) identity."""
    unit(out)


@compiled
def right_jacobian(d: Array, out: Array) -> None:
    """Write the (n, n) identity."""
    unit(out)


@compiled
def right_jacobian_inverse(d: Array, out: Array) -> None:
    """Write the (n, n) identity."""
    unit(out)


@compiled
def left_jacobian(d: Array, out: Array) -> None:
    """Write the (n, n) identity."""
    unit(out)


@compiled
def left_jacobian_inverse(d: Array, out: Array) -> None:
    """Write the (n, n) identity."""
    unit(out)
