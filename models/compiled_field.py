"""Vector fields F(x, u, ...) on a group, compiled with Numba: for one state at a time, and for batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import numpy as np

from unifg.errors import ModelError
from unifg.machine.jit import compiled
from unifg.typing import Array


@dataclass(frozen=True)
class CompiledField:
    """A field for one state at a time, compiled with Numba; called with arrays it is a batched field.

    What drives the field beside the state, its inputs, may come from several families of variables: controls,
    disturbances, parameters to be estimated. Compiled code sees them side by side in one vector u.

    Attributes:
        function: ``F(x, u, out)`` writes the (dim,) velocity in the body frame at a state (storage,) under the inputs
            (controls,).
        dim: of the group [-].
        inputs: length of the control, or of every input in the order in which they lie in u: ``(4, 6, 1)`` for a
            field F(x, u, w, m) [-].
        derivative: ``dF(x, u, by_x, by_u)`` writes the derivatives (dim, dim) along the right perturbation of x and
            (dim, controls) along u. None: by differences.
    """

    function: Callable[[Array, Array, Array], None]
    dim: int
    inputs: int | tuple[int, ...]
    derivative: Callable[[Array, Array, Array, Array], None] | None = None

    @property
    def lengths(self) -> tuple[int, ...]:
        """Of the inputs, in order."""
        return (self.inputs,) if isinstance(self.inputs, int) else self.inputs

    @property
    def controls(self) -> int:
        """Length of u: of all inputs side by side."""
        return sum(self.lengths)

    def __call__(self, x: Array, *inputs: Array) -> Array:
        """(n, dim) velocities of states (n, storage) and one (n, length) array per input.

        Arguments with a single row are shared by all.

        Raises:
            ModelError: when there are fewer or more inputs, or one has another length.
        """
        x, u = self._rows(x, inputs)
        velocity = np.empty((len(u), self.dim))
        _velocities(self.function)(x, u, velocity)
        return velocity

    def jacobian(self, x: Array, *inputs: Array) -> list[Array]:
        """(n, dim, dim) derivatives along x, and (n, dim, length) along every input.

        Raises:
            ModelError: when the field has none, or the inputs do not fit.
        """
        if self.derivative is None:
            raise ModelError("this compiled field has no derivative: give CompiledField(..., derivative=)")
        x, u = self._rows(x, inputs)
        by_x, by_u = np.empty((len(u), self.dim, self.dim)), np.empty((len(u), self.dim, self.controls))
        _derivatives(self.derivative)(x, u, by_x, by_u)
        ends = np.cumsum((0, *self.lengths))
        return [by_x, *(by_u[:, :, start:end] for start, end in pairwise(ends))]

    def for_one(self) -> Callable[..., Array]:
        """The field as a batched function that can be traced."""
        return partial(_one_by_one, self.function, self.dim)

    def _rows(self, x: Array, inputs: Sequence[Array]) -> tuple[Array, Array]:
        """States and inputs side by side: contiguous, as many rows in both."""
        if len(inputs) != len(self.lengths):
            raise ModelError(f"this compiled field takes {len(self.lengths)} inputs, found {len(inputs)}")
        for place, (given, length) in enumerate(zip(inputs, self.lengths, strict=True)):
            if np.ndim(given) != 2 or given.shape[1] != length:
                what = "controls have" if len(inputs) == 1 else f"input {place} has"
                raise ModelError(f"{what} shape {np.shape(given)}, expected (n, {length})", index=place)
        count = max(len(part) for part in (x, *inputs))
        u = np.empty((count, self.controls))
        at = 0
        for given, length in zip(inputs, self.lengths, strict=True):
            u[:, at : at + length] = given
            at += length
        states = np.broadcast_to(np.asarray(x, dtype=np.float64), (count, x.shape[1]))
        return np.ascontiguousarray(states), u


def _one_by_one(function: Callable[..., None], dim: int, x: Array, *inputs: Array) -> Array:
    """(n, dim) velocities, state by state."""
    velocity = np.zeros((len(x), dim))
    for i in range(len(x)):
        function(x[i], np.concatenate([part[i] for part in (*inputs, np.zeros((len(x), 0)))]), velocity[i])
    return velocity


@cache
def _velocities(field: Callable[..., None]) -> Callable[..., None]:
    """Loop of a field over rows."""

    @compiled
    def loop(x: Array, u: Array, velocity: Array) -> None:
        for i in range(len(u)):
            field(x[i], u[i], velocity[i])

    return loop


@cache
def _derivatives(derivative: Callable[..., None]) -> Callable[..., None]:
    """Loop of a field's derivative over rows."""

    @compiled
    def loop(x: Array, u: Array, by_x: Array, by_u: Array) -> None:
        for i in range(len(u)):
            derivative(x[i], u[i], by_x[i], by_u[i])

    return loop
