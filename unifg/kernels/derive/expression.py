"""A plain function as a kernel: its residual, its Jacobian and its second derivatives, exact and in machine code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from unifg.kernels.derive.calculus import bent, hessian, jacobian
from unifg.kernels.derive.emit import residual_code, second_code
from unifg.kernels.derive.manifolds import moved
from unifg.kernels.derive.operations import Op
from unifg.kernels.derive.symbols import Symbol, TraceError, node_of, symbols
from unifg.kernels.derive.tape import Tape
from unifg.kernels.derive.trace import Rebound, run
from unifg.kernels.kernel import Argument
from unifg.machine.jit import is_compiled
from unifg.machine.native import Native
from unifg.typing import Array


@dataclass(frozen=True)
class Expression:
    """A residual on a tape, with every variable moved along its tangent coordinates.

    Attributes:
        tape: the nodes.
        rows: node of each row.
        width: number of tangent coordinates.
        name: for messages.
    """

    tape: Tape
    rows: tuple[int, ...]
    width: int
    name: str

    @cached_property
    def linear_rows(self) -> tuple[bool, ...]:
        """Which rows have no second derivatives, being linear in the tangent coordinates or made of linear pieces."""
        return tuple(not row for row in bent(self.tape, self.rows))

    @property
    def linear(self) -> bool:
        """Whether no row has second derivatives: there is no need for :meth:`second`."""
        return all(self.linear_rows) or not self.curvature

    @cached_property
    def table(self) -> Array:
        """Numbers that look-ups read, flat: what the kernel is given as its table."""
        return np.concatenate([np.zeros(0), *self.tape.tables])

    @cached_property
    def slopes(self) -> dict[tuple[int, int], int]:
        """Nodes of the Jacobian's entries that are not zero, on the same tape."""
        return jacobian(self.tape, self.rows, self.width)

    @cached_property
    def curvature(self) -> dict[tuple[int, int], int]:
        """Nodes of the entries on and above the diagonal of the Hessian of ``w' r`` that are not zero."""
        return hessian(self.tape, self.rows, self.width)

    def residual(self) -> Native:
        """``f(v, p, table, r, J)`` as machine code."""
        tape, nodes = self.tape.at_rest([*self.rows, *self.slopes.values()])
        count = len(self.rows)
        slopes = dict(zip(self.slopes, nodes[count:], strict=True))
        return residual_code(self.name, tape, nodes[:count], slopes, self.width)

    def second(self) -> Native:
        """``second(v, p, table, w, S)`` as machine code."""
        tape, nodes = self.tape.at_rest(list(self.curvature.values()))
        return second_code(self.name, tape, dict(zip(self.curvature, nodes, strict=True)), self.width)


def traced(
    function: Callable[..., Any],
    arguments: Sequence[Argument],
    rows: int = 0,
    name: str = "",
    reached: Sequence[tuple[Array, bool]] = (),
) -> Expression:
    """Run a function once and keep what it computes.

    Args:
        function: batched NumPy, ``(1, storage)`` arrays of variables and ``(1, ...)`` arrays of parameters to
            ``(1, m)``; or compiled for one factor.
        arguments: the manifold of each variable, the shape of each parameter for one factor.
        rows: m of a compiled function.
        name: for messages.
        reached: arrays that the function has names for and that are parameters too, the last of ``arguments``; and
            whether each has a row for every factor.

    Raises:
        TraceError: the function does what cannot be traced, or returns another shape.
    """
    tape, rebound, given = Tape(), Rebound(), []
    stored = shared = width = 0
    single = is_compiled(function)
    for argument in arguments:
        if isinstance(argument, tuple):
            array = symbols(argument)
            for place in np.ndindex(argument):
                array[place] = Symbol(tape, tape.leaf(Op.PARAMETER, shared))
                shared += 1
            given.append((array.item() if argument == () else array) if single else array[None])
        elif isinstance(argument, int):
            raise TraceError("the shape of a parameter is not known")
        else:
            point = [Symbol(tape, tape.leaf(Op.VARIABLE, stored + k)) for k in range(argument.storage)]
            step = [Symbol(tape, tape.leaf(Op.TANGENT, width + k)) for k in range(argument.dim)]
            array = symbols((argument.storage,))
            try:
                array[:] = moved(argument, point, step, rebound.callable)
            except TraceError:
                raise
            except Exception as error:  # whatever a manifold of somebody else makes of symbols
                raise TraceError(f"a variable lies on {argument.name}: {type(error).__name__}: {error}") from error
            given.append(array if single else array[None])
            stored, width = stored + argument.storage, width + argument.dim
    first = len(given) - len(reached)
    for (array, each), numbers in zip(reached, given[first:], strict=True):
        rebound.given[id(array)] = numbers if each else numbers[0]
    result = np.asarray(run(function, given[:first], tape, rebound, rows), dtype=object)
    if not single and (result.ndim != 2 or len(result) != 1):
        raise TraceError(f"returns an array of shape {result.shape} for one factor, expected (1, m)")
    return Expression(tape, tuple(node_of(tape, entry) for entry in result.ravel()), width, name or "residual")
