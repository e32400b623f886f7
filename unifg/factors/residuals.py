"""Residuals: plain batched functions, with or without their Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from inspect import cleandoc, getdoc
from types import FunctionType
from typing import Any, Literal, TypeAlias

from unifg.codegen.fingerprint import is_compiled
from unifg.errors import GraphError
from unifg.factors.kernel import Kernel
from unifg.lie import Manifold
from unifg.typing import Array

Function: TypeAlias = Callable[..., Array]
JacobianFunction: TypeAlias = Callable[..., Sequence[Array]]
Derivatives: TypeAlias = Literal["trace", "differences"]


@dataclass(frozen=True)
class Residual:
    """A batched residual together with its Jacobians.

    Attributes:
        function: maps batched arguments to (n, m) residuals.
        jacobian: maps the same arguments to one (n, m, d_k) array per *variable* argument, in order,
            each the derivative along the right perturbation ``X Exp(d)``.
        name: shown in tables and messages.
        search: like ``jacobian``, but not a derivative: a direction to look in during the first
            ``Solver.search_iterations`` iterations. Answers are never judged by it.
        kernel: ``function`` and ``jacobian`` for one factor, compiled; graphs run it in one loop with all others.
        rows: m, of a ``function`` that a user has compiled for one factor.
        derivatives: "trace" to insist on exact ones, "differences" to refuse them, empty for what is possible.
        elements: place and manifold of arguments that are elements of one, where a kernel does not say so.
        takes: units and frame of each argument, as in ``"m, m, rad in W_T_B"``; None for any.
    """

    function: Function
    jacobian: JacobianFunction | None = None
    name: str = ""
    search: JacobianFunction | None = None
    kernel: Kernel | None = None
    rows: int = 0
    derivatives: str = ""
    elements: tuple[tuple[int, Manifold], ...] = field(default=(), compare=False, repr=False)
    takes: tuple[str | None, ...] = field(default=(), compare=False, repr=False)

    def __call__(self, *arguments: Any) -> Array:
        """Evaluate the residual."""
        return self.function(*arguments)


def residual(
    function: Function | Kernel,
    jacobian: JacobianFunction | None = None,
    name: str = "",
    search: JacobianFunction | None = None,
    rows: int = 0,
    derivatives: Derivatives | None = None,
    about: str = "",
    takes: Sequence[str | None] = (),
) -> Residual:
    """Attach a Jacobian and a name to a function.

    Args:
        function: batched residual, ``(n, ...) -> (n, m)``; or a kernel, which brings its own Jacobian and name.
        jacobian: returns one (n, m, d_k) array for each argument that may be a variable, in order and right
            perturbation. Blocks of arguments that a term gives as constants are dropped. ``graph.check``
            compares the rest with numerical differentiation.
        name: defaults to the function's own name.
        search: same shapes as ``jacobian``; stands in for it in the steps of the first
            ``Solver.search_iterations`` iterations (none by default), for fields that are the gradient of no cost.
            Costs, KKT numbers and all later steps use the true derivatives; ``graph.check`` does not look at it.
        rows: m, needed (and only then) when ``function`` is compiled with Numba. Such a function sees one factor:
            ``function(x, y, ..., measured, ..., r)`` with (storage,) arrays for variables, a number, vector or matrix
            for each parameter, and the (m,) residual to be written last. A parameter array with two axes holds one
            row per factor, and numbers and vectors are shared, unless declared by ``fg.each`` or ``fg.shared``.
            ``jacobian``, if given, is compiled too and takes one (m, d_k) block per variable in the place of r.
        derivatives: of a function without a Jacobian. None: it is traced (run once on symbols, differentiated
            exactly and made into machine code) where that is possible, and differenced where it is not, which
            ``graph.check`` and the log say. "trace" makes the second an error, and also traces functions
            that reach what cannot be watched (its present content is compiled in) and those with a Jacobian, which
            then only serves comparison. "differences" leaves the function as it is.
        about: what ``help`` says of the residual; defaults to the docstring of the function.
        takes: units and frame of each argument, ``"m, m, rad in W_T_B"``, ``"rad"`` or ``"in W"``; None for any. A
            single capital letter stands for one frame, whichever, in all arguments; the two of ``W_T_B`` differ.
            ``*`` stands for any units, alike in all arguments that have it. Compared with what ``graph.variables``,
            ``graph.data``, ``fg.each`` and ``fg.shared`` declare, when a term is added.

    Raises:
        GraphError: for a compiled function without ``rows``.
    """
    if derivatives not in (None, "trace", "differences"):
        raise GraphError(f"derivatives must be 'trace' or 'differences', found {derivatives!r}")
    own = is_compiled(function)
    about = about or getdoc(function) or "" if isinstance(function, FunctionType) else about
    if own and rows < 1:
        raise GraphError(
            f"the residual '{getattr(function, '__name__', name)}' is compiled: say how many numbers it writes, rows="
        )
    if isinstance(function, Kernel) and jacobian is None:
        made = Residual(function, function.jacobian, name or function.name, search, function, takes=tuple(takes))
    else:
        made = Residual(
            function,
            jacobian,
            name or getattr(function, "__name__", "residual"),
            search,
            rows=rows if own else 0,
            derivatives=derivatives or "",
            takes=tuple(takes),
        )
    if about:  # help shows it instead of the text of the class
        object.__setattr__(made, "__doc__", cleandoc(about))
    return made


def as_residual(function: Function | Kernel | Residual) -> Residual:
    """Wrap a plain function or a kernel; leave a :class:`Residual` as it is."""
    return function if isinstance(function, Residual) else residual(function)
