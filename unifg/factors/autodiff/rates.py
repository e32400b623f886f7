"""Rate of a result along a direction: a derivative that is part of a function, itself differentiated.

What a barrier asks for is d/ds f(x(s)) at s = 0, and whoever solves with it asks for two derivatives more. While a
function is traced the parameter s is a leaf of the tape like a tangent coordinate: the result is differentiated by it,
and s is zero in what remains. Called with numbers it is worked out on a tape of its own, so both are the same lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from unifg.factors.autodiff.calculus import derivatives_by
from unifg.factors.autodiff.expression import generating
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.symbols import Symbol, TraceError, node_of, symbols
from unifg.factors.autodiff.tape import Tape
from unifg.factors.autodiff.trace import BORROWED, Rebound


def rate(path: Callable[..., Any], *arguments: Any) -> Any:
    """``d/ds path(s, *arguments)`` at s = 0, exact; for batched functions, which may be traced.

    Args:
        path: batched function of a number s and of the arguments, whatever shape it returns.
        *arguments: handed on.

    Returns:
        What the path returns, differentiated.

    Raises:
        TraceError: the path does what cannot be traced.
    """
    with generating:
        tape = Tape()
        nodes, shape = _slopes(tape, Rebound().callable(path), arguments)
        if not all(tape.evaluate(tape.required, (), ())):
            path(0.0, *arguments)  # which raises its exception
        return np.reshape(tape.evaluate(nodes, (), ()), shape)


def _while_traced(path: Callable[..., Any], *arguments: Any) -> Any:
    for argument in arguments:
        for entry in np.ravel(np.asarray(argument, dtype=object)):
            if isinstance(entry, Symbol):
                nodes, shape = _slopes(entry.tape, path, arguments)
                found = symbols(shape)
                found.ravel()[...] = [Symbol.of(entry.tape, node) for node in nodes]
                return found
    raise TraceError("asks how fast something changes that depends on nothing unknown")


BORROWED[id(rate)] = _while_traced


def _slopes(tape: Tape, path: Callable[..., Any], arguments: Sequence[Any]) -> tuple[list[int], tuple[int, ...]]:
    """Nodes of the derivatives, and the shape of what the path returns."""
    start = tape.leaf(Op.TANGENT, -1 - len(tape))  # no other leaf has that place
    result = np.asarray(path(Symbol(tape, start), *arguments), dtype=object)
    nodes = [node_of(tape, entry) for entry in result.ravel()]
    return tape.where_zero(derivatives_by(tape, nodes, start), start), result.shape
