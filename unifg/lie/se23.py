"""Position, velocity and orientation as one group, SE_2(3) (Barrau and Bonnabel 2017, section V, *extended poses*).

Storage ``(px, py, pz, vx, vy, vz, qw, qx, qy, qz)``, tangent ``(rho, nu, omega)``: of the position, of the velocity and
of the rotation, each of length 3.

Position and velocity are turned by one rotation and know nothing of each other, so every formula is that of SE(3)
twice: of (position, rotation) and of (velocity, rotation). Square results have the blocks of the two,

    A, 0, P
    0, A, N
    0, 0, A

with A, P the blocks of the first and A, N those of the second.
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.calls import local_matrix, local_vector
from unifg.codegen.jit import compiled
from unifg.errors import UnifgError
from unifg.lie import se3
from unifg.lie.defaults import RULES
from unifg.lie.elementwise import Scalar
from unifg.lie.manifold import CompiledGroup
from unifg.lie.so3 import SO3, write_matrix
from unifg.typing import Array, ArrayLike, BoolArray


@compiled
def take(x: Array, first: int, out: Array) -> None:
    """Write the three numbers at ``first`` and what follows the sixth: an element of SE(3), or a tangent of it."""
    for k in range(3):
        out[k] = x[first + k]
    for k in range(3, len(out)):
        out[k] = x[3 + k]


@compiled
def join(p: Array, v: Array, out: Array) -> None:
    """The reverse: the vectors of two elements of SE(3), or of two tangents, and the rotation of the first."""
    for k in range(3):
        out[k] = p[k]
        out[3 + k] = v[k]
    for k in range(3, len(p)):
        out[3 + k] = p[k]


@compiled
def join_blocks(p: Array, v: Array, out: Array) -> None:
    """Write the (9, 9) matrix of two (6, 6) ones of SE(3)."""
    for i in range(3):
        for k in range(3):
            same = p[i, k]
            out[i, k] = same
            out[3 + i, 3 + k] = same
            out[6 + i, 6 + k] = p[3 + i, 3 + k]
            out[i, 6 + k] = p[i, 3 + k]
            out[3 + i, 6 + k] = v[i, 3 + k]
            out[i, 3 + k] = out[3 + i, k] = out[6 + i, k] = out[6 + i, 3 + k] = 0.0


def _twice_of_one(function: Scalar, given: int, result: int) -> Scalar:
    """Compile ``f(x, out)`` of two vectors that turn as one from that of SE(3).

    Args:
        function: compiled, of SE(3).
        given: length of its argument.
        result: length of its result.
    """

    @compiled
    def twice(x: Array, out: Array) -> None:
        part, p, v = local_vector(given), local_vector(result), local_vector(result)
        take(x, 0, part)
        function(part, p)
        take(x, 3, part)
        function(part, v)
        join(p, v, out)

    return twice


def _twice_of_two(function: Scalar) -> Scalar:
    """Compile ``f(x, y, out)`` of elements from that of SE(3)."""

    @compiled
    def twice(x: Array, y: Array, out: Array) -> None:
        a, b, p, v = local_vector(7), local_vector(7), local_vector(7), local_vector(7)
        take(x, 0, a)
        take(y, 0, b)
        function(a, b, p)
        take(x, 3, a)
        take(y, 3, b)
        function(a, b, v)
        join(p, v, out)

    return twice


def _blocks(function: Scalar, given: int) -> Scalar:
    """Compile ``f(x, out)`` with a square result from that of SE(3), whose argument has this length."""

    @compiled
    def twice(x: Array, out: Array) -> None:
        part, p, v = local_vector(given), local_matrix(6, 6), local_matrix(6, 6)
        take(x, 0, part)
        function(part, p)
        take(x, 3, part)
        function(part, v)
        join_blocks(p, v, out)

    return twice


exp = _twice_of_one(se3.exp, 6, 7)
log = _twice_of_one(se3.log, 7, 6)
inverse = _twice_of_one(se3.inverse, 7, 7)
compose, between = _twice_of_two(se3.compose), _twice_of_two(se3.between)
local = RULES["local"].make(10, 9, between, log)
adjoint = _blocks(se3.adjoint, 7)
right_jacobian, right_jacobian_inverse = _blocks(se3.right_jacobian, 6), _blocks(se3.right_jacobian_inverse, 6)


@compiled
def act(x: Array, p: Array, out: Array) -> None:
    """Bring a (3,) point from the body frame to the world."""
    part = local_vector(7)
    take(x, 0, part)
    se3.act(part, p, out)


@compiled
def matrix(x: Array, out: Array) -> None:
    """Write ``[R, v, p; 0, 1, 0; 0, 0, 1]``, (5, 5)."""
    write_matrix(x[6], x[7], x[8], x[9], out, 0)
    for i in range(3):
        out[i, 3], out[i, 4] = x[3 + i], x[i]
        out[3, i] = out[4, i] = 0.0
    out[3, 3] = out[4, 4] = 1.0
    out[3, 4] = out[4, 3] = 0.0


class ExtendedPoses(CompiledGroup, methods=globals()):
    """Position, velocity and orientation that turn as one; use the ready-made object ``SE23``.

    Storage is ``(px, py, pz, vx, vy, vz, qw, qx, qy, qz)``: position [m] and velocity [m/s] in the world, then a
    rotation as ``SO3`` stores it. Tangent is ``(rho, nu, omega)`` [m, m/s, rad], in the axes of the body.
    """

    name = "SE23"
    storage = 10
    dim = 9
    point_dim = 3
    matrix_dim = 5
    generators = np.zeros((9, 5, 5))  # [[omega]x, nu, rho; 0, 0, 0; 0, 0, 0]
    generators[:3, :3, 4] = generators[3:6, :3, 3] = np.eye(3)
    generators[6:, :3, :3] = SO3.generators

    # Constructors, and back.

    def from_parts(self, position: ArrayLike, velocity: ArrayLike, rotation: ArrayLike, /) -> Array:
        """Join (..., 3) positions [m], (..., 3) velocities [m/s] and (..., 4) elements of ``SO3``.

        Raises:
            UnifgError: when a last axis has another length.
        """
        parts = [np.asarray(part, dtype=np.float64) for part in (position, velocity, rotation)]
        if [part.shape[-1:] for part in parts] != [(3,), (3,), (4,)]:
            shapes = ", ".join(str(part.shape) for part in parts)
            raise UnifgError(f"SE23.from_parts joins (..., 3), (..., 3) and (..., 4) arrays; got shapes {shapes}")
        batch = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return np.concatenate([np.broadcast_to(part, (*batch, part.shape[-1])) for part in parts], axis=-1)

    def position(self, x: ArrayLike, /) -> Array:
        """Return the (..., 3) positions [m], as a view of an array."""
        return np.asarray(x, dtype=np.float64)[..., :3]

    def velocity(self, x: ArrayLike, /) -> Array:
        """Return the (..., 3) velocities [m/s], as a view of an array."""
        return np.asarray(x, dtype=np.float64)[..., 3:6]

    def rotation(self, x: ArrayLike, /) -> Array:
        """Return the (..., 4) rotations, elements of ``SO3``, as a view of an array."""
        return np.asarray(x, dtype=np.float64)[..., 6:]

    # The group.

    def identity(self) -> Array:
        """Return (0, 0, 0, 0, 0, 0, 1, 0, 0, 0)."""
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, 10) elements: standard normal positions and velocities, uniform rotations."""
        position, velocity = rng.standard_normal((2, *shape, 3))
        return self.from_parts(position, velocity, SO3.random(rng, shape))

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., 10) vectors whether it is finite and its quaternion of unit norm to within 1e-9."""
        x = np.asarray(x, dtype=np.float64)
        return np.asarray(np.isfinite(x[..., :6]).all(axis=-1) & SO3.is_valid(x[..., 6:]))


SE23 = ExtendedPoses()
