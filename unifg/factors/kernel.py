"""Residuals compiled for one factor at a time: what a shipped family is, and what a user's ``@njit`` function becomes.

A kernel is a compiled function ``f(v, p, table, r, J)`` of one factor:

- v: (X,) storage of its variables, one after the other;
- p: (P,) its parameters (measurements, sampling times), one after the other;
- table: what all factors share and no solve changes, such as the cells of a map;
- r: (m,) the residual, to be written;
- J: (m, D) derivatives along the right perturbations of the variables, to be written unless J has no rows.

One compiled loop runs the kernels of all terms of a graph; called with arrays, a kernel is a batched function.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from typing import Any, TypeAlias

import numpy as np

from unifg.codegen.calls import RESIDUAL, address, call_residual, matrix, vector
from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.lie import Manifold
from unifg.typing import Array

Argument: TypeAlias = Manifold | int | tuple[int, ...]
Rows: TypeAlias = int | Callable[..., int]
NOTHING = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Kernel:
    """A compiled residual and what it expects.

    Attributes:
        function: compiled, as described in the module's docstring.
        arguments: in the order of the residual's arguments, the manifold of each variable, and of each parameter the
            shape that it has for one factor, or the number of axes (0 for a number, 1 for a vector of any length).
        rows: m, or a function from the shapes of the parameters (for one factor) to m.
        table: flat array that all factors share.
        name: for messages.
        linear: whether r is linear in tangent steps, so that it has no second derivatives.
        second: compiled ``second(v, p, table, w, S)`` that writes the (D, D) Hessian of t -> w' r(x Exp(t)) at
            t = 0, for solvers that use it; differences take its place.
        differenced: whether J is made of differences of r, or of a part of it.
    """

    function: Callable[..., None]
    arguments: tuple[Argument, ...]
    rows: Rows
    table: Array = field(default_factory=lambda: NOTHING)
    name: str = "kernel"
    linear: bool = False
    second: Callable[..., None] | None = None
    differenced: bool = False

    def __post_init__(self) -> None:
        """Compiled code reads the table as it lies in memory."""
        table = np.ascontiguousarray(self.table, dtype=np.float64)
        object.__setattr__(self, "table", table if table.ndim == 1 else table.ravel())

    @cached_property
    def address(self) -> int:
        """Of the machine code; compiles it if need be."""
        return address(self.function, RESIDUAL)

    @cached_property
    def second_address(self) -> int:
        """Of the machine code of ``second``, 0 without."""
        return 0 if self.second is None else address(self.second, RESIDUAL)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without addresses, which mean nothing to another process."""
        return {name: value for name, value in self.__dict__.items() if name not in ("address", "second_address")}

    @property
    def derived(self) -> bool:
        """True if second derivatives are generated when they are first asked for."""
        return False

    @property
    def manifolds(self) -> list[Manifold]:
        """Of the variables, in order."""
        return [argument for argument in self.arguments if not isinstance(argument, int | tuple)]

    def size(self, shapes: Sequence[tuple[int, ...]]) -> int:
        """The number of rows m, given the shape of each parameter for one factor."""
        return self.rows if isinstance(self.rows, int) else int(self.rows(*shapes))

    def of_shapes(self, shapes: Sequence[tuple[int, ...]]) -> Kernel:
        """The kernel for parameters of these shapes, for one factor: itself, unless code depends on them."""
        return self

    def knowing(self, places: Container[int]) -> Kernel | None:
        """The kernel that takes the elements of manifolds at these places as parameters; None where there is none."""
        return None

    def rows_of(self, arguments: Sequence[Any]) -> list[Any]:
        """The arguments with one row per factor or a single one.

        Raises:
            GraphError: when a shape does not fit.
        """
        if len(arguments) != len(self.arguments):
            raise GraphError(f"{self.name} takes {len(self.arguments)} arguments, found {len(arguments)}")
        found = []
        for place, (expected, given) in enumerate(zip(self.arguments, arguments, strict=True)):
            array = given if isinstance(given, np.ndarray) else np.asarray(given)
            if isinstance(expected, int | tuple):
                axes, shape = (expected, None) if isinstance(expected, int) else (len(expected), expected)
                rows = array if array.ndim == axes + 1 else array[None]
                if rows.ndim != axes + 1 or shape not in (None, rows.shape[1:]):
                    wanted = f"{axes} axes" if shape is None else str(shape)
                    raise GraphError(
                        f"{self.name}: argument {place} has shape {array.shape}, expected {wanted}, or one axis more "
                        "with a row for each factor"
                    )
            else:
                rows = array if array.ndim == 2 else array[None]
                if rows.ndim != 2 or rows.shape[1] != expected.storage:
                    raise GraphError(
                        f"{self.name}: argument {place} has shape {np.shape(given)}, expected (n, {expected.storage}) "
                        f"for {expected.name}"
                    )
            found.append(rows)
        return found

    def split(self, arguments: Sequence[Any], count: int | None) -> tuple[list[Array], list[Array], int]:
        """Variables and parameters as arrays with one row per factor or a single one.

        Args:
            arguments: as the residual is called.
            count: number of factors; None to find it from the arguments.

        Returns:
            Variables (n or 1, storage), parameters (n or 1, ...), and n.

        Raises:
            GraphError: when a shape does not fit.
        """
        rows = self.rows_of([np.asarray(given, dtype=np.float64) for given in arguments])
        variables = [row for row, a in zip(rows, self.arguments, strict=True) if not isinstance(a, int | tuple)]
        parameters = [row for row, a in zip(rows, self.arguments, strict=True) if isinstance(a, int | tuple)]
        lengths = {len(array) for array in (*variables, *parameters)} - {1}
        if count is not None and count > 1:
            lengths.add(count)
        if len(lengths) > 1:
            raise GraphError(f"{self.name}: its arguments speak of {sorted(lengths)} factors")
        if count == 1 and lengths:
            raise GraphError(f"{self.name}: its parameters speak of {max(lengths)} factors, its variables of one")
        return variables, parameters, lengths.pop() if lengths else 1

    def __call__(self, *arguments: Any) -> Array:
        """(n, m) residuals of batched arguments."""
        return self._run(arguments, False)[0]

    def jacobian(self, *arguments: Any) -> list[Array]:
        """One (n, m, d_k) array per variable argument."""
        return self.both(*arguments)[1]

    def both(self, *arguments: Any) -> tuple[Array, list[Array]]:
        """Residuals and Jacobian at once."""
        residual, blocks = self._run(arguments, True)
        ends = np.cumsum([manifold.dim for manifold in self.manifolds])
        return residual, np.split(blocks, ends[:-1], axis=2)

    def second_derivatives(self, weights: Array, *arguments: Any) -> Array:
        """(n, D, D) Hessians of weights' r, weights (n, m), of a kernel that comes with them or is linear."""
        variables, parameters, _ = self.split(arguments, len(weights))
        width = sum(manifold.dim for manifold in self.manifolds)
        second = np.zeros((len(weights), width, width))
        where = self.of_shapes([part.shape[1:] for part in parameters]).second_address if len(weights) else 0
        if where:
            packed, shared = side_by_side(variables, len(weights)), side_by_side(parameters)
            evaluate_rows(where, packed, shared, self.table, np.ascontiguousarray(weights), second)
        return second

    def _run(self, arguments: Sequence[Any], derive: bool) -> tuple[Array, Array]:
        variables, parameters, count = self.split(arguments, None)
        kernel = self.of_shapes(shapes := [parameter.shape[1:] for parameter in parameters])
        m = kernel.size(shapes)
        residual = np.empty((count, m))
        jacobian = np.empty((count, m, sum(manifold.dim for manifold in self.manifolds)) if derive else (0, 0, 0))
        if count:
            packed, shared = side_by_side(variables, count), side_by_side(parameters)
            evaluate_rows(kernel.address, packed, shared, self.table, residual, jacobian)
        return residual, jacobian


def side_by_side(parts: Sequence[Array], count: int = 1) -> Array:
    """(n, K) of several (n or 1, ...) arrays, n = 1 where all are shared."""
    rows = max([len(part) for part in parts] + [count])
    sizes = [prod(part.shape[1:]) for part in parts]
    joined, at = np.empty((rows, sum(sizes))), 0
    for part, size in zip(parts, sizes, strict=True):
        joined[:, at : at + size] = part.reshape(len(part), size)
        at += size
    return joined


@compiled
def evaluate_rows(
    where: int, variables: Array, parameters: Array, table: Array, residual: Array, jacobian: Array
) -> None:
    """Run one kernel, or its second derivatives, over rows of its arguments."""
    count, rows = residual.shape
    v, p, r, J = variables.ravel(), parameters.ravel(), residual.reshape(count * rows), jacobian.ravel()
    storage, size, width = variables.shape[1], parameters.shape[1], jacobian.shape[2]
    shared = parameters.shape[0] == 1
    derive = jacobian.shape[1]
    for i in range(count):
        call_residual(
            where,
            vector(v, i * storage, storage),
            vector(p, 0 if shared else i * size, size),
            table,
            vector(r, i * rows, rows),
            matrix(J, i * derive * width, derive, width),
        )
