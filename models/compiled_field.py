"""Vector fields F(x, u) on a group, compiled with Numba: for one state at a time, and for batches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import ModuleType

import numpy as np

from unifg.calls import local_vector
from unifg.differentiation import FIRST_STEP
from unifg.jit import compiled
from unifg.typing import Array


@dataclass(frozen=True)
class CompiledField:
    """A field for one state at a time, compiled with Numba; called with arrays it is a batched field.

    Attributes:
        function: ``F(x, u, out)`` writes the (dim,) velocity in the body frame at a state (storage,) under a
            control (controls,).
        dim: of the group [-].
        controls: length of a control [-].
        derivative: ``dF(x, u, by_x, by_u)`` writes the derivatives (dim, dim) along the right perturbation of x and
            (dim, controls) along u. None: by differences.
    """

    function: Callable[[Array, Array, Array], None]
    dim: int
    controls: int
    derivative: Callable[[Array, Array, Array, Array], None] | None = None

    def __call__(self, x: Array, u: Array) -> Array:
        """(n, dim) velocities of states (n, storage) and controls (n, controls).

        Raises:
            ValueError: when the controls have another length.
        """
        x, u = self._rows(x, u)
        velocity = np.empty((len(u), self.dim))
        _velocities(self.function)(x, u, velocity)
        return velocity

    def jacobian(self, x: Array, u: Array) -> list[Array]:
        """(n, dim, dim) and (n, dim, controls) derivatives.

        Raises:
            ValueError: when the field has none, or the controls have another length.
        """
        if self.derivative is None:
            raise ValueError("this compiled field has no derivative: give CompiledField(..., derivative=)")
        x, u = self._rows(x, u)
        by_x, by_u = np.empty((len(u), self.dim, self.dim)), np.empty((len(u), self.dim, self.controls))
        _derivatives(self.derivative)(x, u, by_x, by_u)
        return [by_x, by_u]

    def _rows(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Contiguous, as many rows in both."""
        if np.ndim(u) != 2 or u.shape[1] != self.controls:
            raise ValueError(f"controls have shape {np.shape(u)}, expected (n, {self.controls})")
        count = max(len(x), len(u))
        parts = [np.broadcast_to(np.asarray(a, dtype=np.float64), (count, a.shape[1])) for a in (x, u)]
        return np.ascontiguousarray(parts[0]), np.ascontiguousarray(parts[1])


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


def differences(field: CompiledField, functions: ModuleType, storage: int) -> Callable[..., None]:
    """``dF(x, u, by_x, by_u)`` of a field by central differences.

    Args:
        field: F.
        functions: of the group, from :mod:`unifg.lie.scalar`.
        storage: of the group.
    """
    function, retract = field.function, functions.retract
    dim, controls, step = field.dim, field.controls, FIRST_STEP

    @compiled
    def derivative(x: Array, u: Array, by_x: Array, by_u: Array) -> None:
        ahead, behind, direction = local_vector(dim), local_vector(dim), local_vector(dim)
        moved, control = local_vector(storage), local_vector(controls)
        for i in range(dim):
            direction[i] = 0.0
        for i in range(controls):
            control[i] = u[i]
        for j in range(dim):
            direction[j] = step
            retract(x, direction, moved)
            function(moved, control, ahead)
            direction[j] = -step
            retract(x, direction, moved)
            function(moved, control, behind)
            direction[j] = 0.0
            for i in range(dim):
                by_x[i, j] = (ahead[i] - behind[i]) / (2.0 * step)
        for j in range(controls):
            control[j] = u[j] + step
            function(x, control, ahead)
            control[j] = u[j] - step
            function(x, control, behind)
            control[j] = u[j]
            for i in range(dim):
                by_u[i, j] = (ahead[i] - behind[i]) / (2.0 * step)

    return derivative
