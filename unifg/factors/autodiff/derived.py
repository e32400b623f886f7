"""Kernels made of plain functions: traced once for all terms that use a function alike, and kept for as long as needed.

A kernel is found again by what its function computes: its code and the values it reaches, the manifolds and shapes it
is used with. It keeps the tape and nothing of the function, so it can be pickled, and nothing in it grows old.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from typing import Any, NoReturn

import numpy as np

from unifg.codegen.fingerprint import is_compiled
from unifg.factors.autodiff.captured import Captured
from unifg.factors.autodiff.expression import Expression, generating
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.rows import Fixed, Given, argument_of, traced, traced_rows
from unifg.factors.autodiff.symbols import TraceError
from unifg.factors.autodiff.tape import Tape
from unifg.factors.autodiff.trace import Rebound, run
from unifg.factors.kernel import Argument, Kernel
from unifg.typing import Array

logger = logging.getLogger("unifg")
KEPT = 256  # kernels
LONGEST = 5000  # nodes of a residual; of more, machine code takes seconds
WIDEST = 2000  # parameters of one factor
NO_SLOPES = np.empty((0, 0, 0))  # for kernels of which values alone are wanted


def _nowhere(*_: Any) -> NoReturn:
    raise TraceError("a derived kernel is machine code; nothing compiled by Numba can call it")


@dataclass(frozen=True, eq=False)
class DerivedKernel(Kernel):
    """A kernel whose Jacobian and second derivatives are exact, because they were derived.

    Machine code is generated when its address is first asked for; that of second derivatives most programs never ask.
    It belongs to the expression, and so to the kernel.

    Attributes:
        expression: what it computes.
    """

    function: Callable[..., None] = _nowhere
    arguments: tuple[Argument, ...] = ()
    rows: int = 0
    expression: Expression = field(kw_only=True)

    @property
    def derived(self) -> bool:
        """They are."""
        return True

    @cached_property
    def address(self) -> int:
        """Of the machine code of residual and Jacobian."""
        return self.expression.residual().address

    @cached_property
    def second_address(self) -> int:
        """Of the machine code of second derivatives, 0 where all of them are zero."""
        if self.linear:
            return 0
        return self.expression.second().address


_kernels: OrderedDict[Hashable, DerivedKernel | TraceError] = OrderedDict()


def derived(
    function: Callable[..., Any],
    given: Sequence[Given],
    reach: Captured,
    rows: int = 0,
    scalar: bool = False,
    name: str = "",
    limit: bool = True,
    reached: Sequence[tuple[Array, bool]] = (),
    lengths: Sequence[int] = (1,),
) -> DerivedKernel:
    """The kernel of a plain function, traced once for all who use it alike.

    Args:
        function: batched NumPy, or compiled for one factor.
        given: what stands in the place of each argument.
        reach: what the function reaches.
        rows: m of a compiled function.
        scalar: whether a batched function returns (n,).
        name: for messages.
        limit: refuse functions whose code would take long to generate.
        reached: named arrays that the kernel is given after all arguments, and whether they have a row for each factor.
        lengths: of the batches that a batched function is traced with; see :func:`~.rows.traced_rows`.

    Raises:
        RowsError: rows of a batch depend on rows of other factors, or differ.
        TraceError: the function does what cannot be traced.
    """
    with generating:
        fixed = [part for part in given if isinstance(part, Fixed)]
        if reach.key is None or any(part.key is None for part in fixed):
            return _traced(function, given, rows, scalar, name, limit, reached, lengths)
        places = tuple(part.key if isinstance(part, Fixed) else part for part in given)
        parts = tuple((array.shape, each) for array, each in reached)
        key = reach.key, places, rows, scalar, limit, parts, tuple(lengths)
        found = _kernels.get(key)
        if found is None:
            try:
                found = _traced(function, given, rows, scalar, name, limit, reached, lengths)
            except TraceError as error:
                found = error.with_traceback(None)
            _kernels[key] = found
            while len(_kernels) > KEPT:
                _kernels.popitem(last=False)
        _kernels.move_to_end(key)
        if isinstance(found, TraceError):
            raise found.with_traceback(None)
        return found


def _traced(
    function: Callable[..., Any],
    given: Sequence[Given],
    rows: int,
    scalar: bool,
    name: str,
    limit: bool,
    reached: Sequence[tuple[Array, bool]],
    lengths: Sequence[int],
) -> DerivedKernel:
    arguments = [argument for part in given if (argument := argument_of(part)) is not None]
    arguments += [array.shape[1:] if each else array.shape for array, each in reached]
    numbers = sum(prod(argument) for argument in arguments if isinstance(argument, tuple))
    if limit and numbers > WIDEST:
        raise TraceError(f"its constants are {numbers} numbers for each factor")
    if is_compiled(function):
        expression = traced(function, arguments, rows, name)
    else:
        expression = traced_rows(function, given, reached, lengths, scalar, name)
    tape = expression.tape
    live = tape.live(expression.rows)
    if limit and len(live) > LONGEST:
        raise TraceError(f"it computes {len(live)} numbers for one factor")
    if is_compiled(function) and any(tape.op[i] == Op.CONSTANT and tape.value[i] != tape.value[i] for i in live):
        raise TraceError("some of its rows are not written, or read before they are")
    return DerivedKernel(
        arguments=tuple(arguments),
        rows=len(expression.rows),
        table=expression.table,
        name=name,
        linear=all(expression.linear_rows),
        expression=expression,
    )


def in_python(function: Callable[..., Any], arguments: Sequence[Any], rows: int) -> Array:
    """(m,) what a compiled function of one factor writes, found without compiling it."""
    with generating:
        return np.array(run(function, arguments, Tape(), Rebound(), rows), dtype=np.float64)
