"""Moving a point of any manifold from compiled code: a sum for vectors, the retraction at an address for all others."""

from __future__ import annotations

from typing import Any, NamedTuple

from unifg.codegen.calls import RETRACTION, address, call_retraction, vector
from unifg.codegen.jit import inlined
from unifg.lie.functions import functions_of
from unifg.lie.manifold import Manifold
from unifg.lie.rn import Rn
from unifg.typing import Array

ADDITION = 0  # in the place of an address: the retraction is a sum


class Move(NamedTuple):
    """Compiled retraction of points of a manifold that is no product.

    Attributes:
        where: address of its retraction, or ADDITION.
        function: what stands there; to be kept for as long as the address is used.
    """

    where: int
    function: Any


def move_of(manifold: Manifold) -> Move | None:
    """Retraction of points of a manifold that is no product; None when it has only a batched one."""
    if isinstance(manifold, Rn):
        return Move(ADDITION, None)
    functions = functions_of(manifold)
    return None if functions is None else Move(address(functions.retract, RETRACTION), functions.retract)


@inlined
def move_point(
    where: int, values: Array, x: int, size: int, step: Array, d: int, dim: int, out: Array, at: int
) -> None:
    """Write the point at ``values[x:x + size]``, moved by ``step[d:d + dim]``, to ``out[at:at + size]``."""
    if where == ADDITION:
        for k in range(size):
            out[at + k] = values[x + k] + step[d + k]
    else:
        call_retraction(where, vector(values, x, size), vector(step, d, dim), vector(out, at, size))
