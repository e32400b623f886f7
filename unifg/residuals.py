"""What a user writes: plain batched functions, with or without their Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from unifg.kernels import Kernel
from unifg.typing import Array

Function: TypeAlias = Callable[..., Array]
JacobianFunction: TypeAlias = Callable[..., Sequence[Array]]


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
        search_kernel: the same with ``search`` in the place of the Jacobian.
    """

    function: Function
    jacobian: JacobianFunction | None = None
    name: str = ""
    search: JacobianFunction | None = None
    kernel: Kernel | None = None
    search_kernel: Kernel | None = None

    def __call__(self, *arguments: Any) -> Array:
        """Evaluate the residual."""
        return self.function(*arguments)


def residual(
    function: Function | Kernel,
    jacobian: JacobianFunction | None = None,
    name: str = "",
    search: JacobianFunction | Kernel | None = None,
) -> Residual:
    """Attach a Jacobian and a name to a plain function.

    Args:
        function: batched residual, ``(n, ...) -> (n, m)``; or a kernel, which brings its own Jacobian and name.
        jacobian: returns one (n, m, d_k) array for each argument that may be a variable, in order and right
            perturbation. Blocks of arguments that a term gives as constants are dropped. ``graph.check``
            compares the rest with numerical differentiation.
        name: defaults to the function's own name.
        search: same shapes as ``jacobian``; stands in for it in the steps of the first
            ``Solver.search_iterations`` iterations (none by default), for fields that are the gradient of no cost.
            Costs, KKT numbers and all later steps use the true derivatives; ``graph.check`` does not look at it.
    """
    search_kernel = search if isinstance(search, Kernel) else None
    looked_in = search.jacobian if isinstance(search, Kernel) else search
    if isinstance(function, Kernel):
        return Residual(function, function.jacobian, name or function.name, looked_in, function, search_kernel)
    return Residual(function, jacobian, name or getattr(function, "__name__", "residual"), looked_in)


def as_residual(function: Function | Kernel | Residual) -> Residual:
    """Wrap a plain function or a kernel; leave a :class:`Residual` as it is."""
    return function if isinstance(function, Residual) else residual(function)
