"""Manifolds as a user writes them: a sphere, extended poses, similarities, another order of storage, another step."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

import unifg as fg
from unifg.codegen.jit import compiled
from unifg.lie import se3, so3
from unifg.lie.se2 import SE2Group
from unifg.typing import Array, ArrayLike, BoolArray

Batch = tuple[int, ...]

# ---------------------------------------------------------------- the unit sphere, which is no group


@compiled
def along(x: Array, basis: Array) -> None:
    """Two directions across x, as rows; Duff et al. 2017, *Building an orthonormal basis, revisited*."""
    sign = 1.0 if x[2] >= 0.0 else -1.0
    a = -1.0 / (sign + x[2])
    b = x[0] * x[1] * a
    basis[0, 0], basis[0, 1], basis[0, 2] = 1.0 + sign * x[0] * x[0] * a, sign * b, -sign * x[0]
    basis[1, 0], basis[1, 1], basis[1, 2] = b, sign + x[1] * x[1] * a, -x[1]


@compiled
def sphere_retract(x: Array, d: Array, out: Array) -> None:
    basis, moved = np.empty((2, 3)), np.empty(3)
    along(x, basis)
    angle = math.hypot(d[0], d[1])
    c, s = math.cos(angle), math.sin(angle) / angle if angle > 1e-150 else 1.0
    for i in range(3):
        moved[i] = c * x[i] + s * (d[0] * basis[0, i] + d[1] * basis[1, i])
    length = math.sqrt(moved[0] ** 2 + moved[1] ** 2 + moved[2] ** 2)
    for i in range(3):
        out[i] = moved[i] / length


@compiled
def sphere_local(x: Array, y: Array, out: Array) -> None:
    basis = np.empty((2, 3))
    along(x, basis)
    first = basis[0, 0] * y[0] + basis[0, 1] * y[1] + basis[0, 2] * y[2]
    second = basis[1, 0] * y[0] + basis[1, 1] * y[1] + basis[1, 2] * y[2]
    sine, cosine = math.hypot(first, second), x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    scale = math.atan2(sine, cosine) / sine if sine > 1e-150 else 1.0
    out[0], out[1] = scale * first, scale * second


class SphereManifold(fg.ManifoldBase):
    """Unit vectors in space."""

    name, storage, dim = "S2", 3, 2
    retract = fg.elementwise(sphere_retract)
    local = fg.elementwise(sphere_local)

    def identity(self) -> Array:
        return np.array([0.0, 0.0, 1.0])

    def random(self, rng: Generator, /, shape: Batch = ()) -> Array:
        x = rng.standard_normal((*shape, 3))
        return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        return np.asarray(np.abs(np.linalg.norm(x, axis=-1) - 1.0) < 1e-9)


S2 = SphereManifold()


class Sphere:
    """The same in NumPy alone, inheriting from nothing."""

    name = "Sphere"
    storage = 3
    dim = 2

    def identity(self) -> Array:
        return np.array([0.0, 0.0, 1.0])

    def retract(self, x: Array, d: Array) -> Array:
        step = (self._basis(x) @ d[..., None])[..., 0]
        angle = np.linalg.norm(d, axis=-1, keepdims=True)
        return np.asarray(np.cos(angle) * x + np.sinc(angle / np.pi) * step)

    def local(self, x: Array, y: Array) -> Array:
        across = (np.swapaxes(self._basis(x), -1, -2) @ y[..., None])[..., 0]
        sine = np.linalg.norm(across, axis=-1, keepdims=True)
        angle = np.arctan2(sine, (x * y).sum(axis=-1, keepdims=True))
        return np.asarray(across / np.sinc(angle / np.pi))

    def random(self, rng: Generator, shape: Batch = ()) -> Array:
        x = rng.standard_normal((*shape, 3))
        return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))

    def is_valid(self, x: Array) -> BoolArray:
        return np.asarray(np.abs(np.linalg.norm(x, axis=-1) - 1.0) < 1e-9)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sphere)

    def __hash__(self) -> int:
        return hash(Sphere)

    @staticmethod
    def _basis(x: Array) -> Array:
        """Two orthonormal tangent directions, (..., 3, 2); Duff et al. 2017, equation 7."""
        sign = np.where(x[..., 2] < 0, -1.0, 1.0)
        a = -1.0 / (sign + x[..., 2])
        b = x[..., 0] * x[..., 1] * a
        first = np.stack([1 + sign * x[..., 0] ** 2 * a, sign * b, -sign * x[..., 0]], axis=-1)
        second = np.stack([b, sign + x[..., 1] ** 2 * a, -x[..., 1]], axis=-1)
        return np.stack([first, second], axis=-1)


# ---------------------------------------------------------------- position, velocity and orientation, which turn as one


@compiled
def pose(x: Array, first: int, turn: int, length: int) -> Array:
    """The vector at ``first`` and the rotation at ``turn``: an element of SE(3), or a tangent of it."""
    part = np.empty(3 + length)
    part[:3], part[3:] = x[first : first + 3], x[turn : turn + length]
    return part


@compiled
def moving_exp(d: Array, out: Array) -> None:
    found = np.empty((2, 7))
    for k in range(2):
        se3.exp(pose(d, 3 * k, 6, 3), found[k])
    out[:3], out[3:6], out[6:] = found[0, :3], found[1, :3], found[0, 3:]


@compiled
def moving_log(x: Array, out: Array) -> None:
    found = np.empty((2, 6))
    for k in range(2):
        se3.log(pose(x, 3 * k, 6, 4), found[k])
    out[:3], out[3:6], out[6:] = found[0, :3], found[1, :3], found[0, 3:]


@compiled
def moving_compose(x: Array, y: Array, out: Array) -> None:
    found = np.empty((2, 7))
    for k in range(2):
        se3.compose(pose(x, 3 * k, 6, 4), pose(y, 3 * k, 6, 4), found[k])
    out[:3], out[3:6], out[6:] = found[0, :3], found[1, :3], found[0, 3:]


@compiled
def moving_inverse(x: Array, out: Array) -> None:
    found = np.empty((2, 7))
    for k in range(2):
        se3.inverse(pose(x, 3 * k, 6, 4), found[k])
    out[:3], out[3:6], out[6:] = found[0, :3], found[1, :3], found[0, 3:]


class ExtendedPoses(fg.LieGroup):
    """SE_2(3): (p, v, q), with tangents (rho, nu, omega)."""

    name, storage, dim, matrix_dim = "SE_2(3)", 10, 9, 5
    exp = fg.elementwise(moving_exp)
    log = fg.elementwise(moving_log)
    compose = fg.elementwise(moving_compose)
    inverse = fg.elementwise(moving_inverse)

    def identity(self) -> Array:
        return np.array([0.0] * 6 + [1.0, 0.0, 0.0, 0.0])

    def random(self, rng: Generator, /, shape: Batch = ()) -> Array:
        return np.concatenate([rng.standard_normal((*shape, 6)), fg.SO3.random(rng, shape)], axis=-1)

    def matrix(self, x: ArrayLike, /) -> Array:
        x = np.asarray(x, dtype=np.float64)
        result = np.zeros((*x.shape[:-1], 5, 5)) + np.eye(5)
        result[..., :3, :3], result[..., :3, 3], result[..., :3, 4] = fg.SO3.matrix(x[..., 6:]), x[..., 3:6], x[..., :3]
        return result

    def hat(self, d: ArrayLike, /) -> Array:
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], 5, 5))
        result[..., :3, :3], result[..., :3, 3], result[..., :3, 4] = fg.SO3.hat(d[..., 6:]), d[..., 3:6], d[..., :3]
        return result


SE23 = ExtendedPoses()

# ---------------------------------------------------------------- similarities of space

NODES, WEIGHTS = (tuple(float(a) for a in part) for part in np.polynomial.legendre.leggauss(14))


@compiled
def stretch(d: Array, out: Array) -> None:
    """The integral of e^(t sigma) Exp(t omega) over t in [0, 1], which takes rho to the position."""
    R, q = np.empty((3, 3)), np.empty(4)
    out[:] = 0.0
    for n in range(len(NODES)):
        t = 0.5 * (1.0 + NODES[n])
        so3.exp(t * d[3:6], q)
        so3.matrix(q, R)
        out += 0.5 * WEIGHTS[n] * math.exp(t * d[6]) * R


@compiled
def similar_exp(d: Array, out: Array) -> None:
    V, q = np.empty((3, 3)), np.empty(4)
    stretch(d, V)
    so3.exp(d[3:6].copy(), q)
    p, scale = V @ d[:3], math.exp(d[6])
    out[:3], out[3:7], out[7] = p, q, scale


@compiled
def similar_log(x: Array, out: Array) -> None:
    V, d = np.empty((3, 3)), np.zeros(7)
    turn = np.empty(3)
    so3.log(x[3:7].copy(), turn)
    d[3:6], d[6] = turn, math.log(x[7])
    stretch(d, V)
    d[:3] = np.linalg.solve(V, x[:3].copy())
    out[:] = d


@compiled
def similar_compose(x: Array, y: Array, out: Array) -> None:
    px, py, pz = so3.rotate(x[3], x[4], x[5], x[6], y[0], y[1], y[2])
    q = np.empty(4)
    so3.compose(x[3:7].copy(), y[3:7].copy(), q)
    scale = x[7]
    out[0], out[1], out[2] = x[0] + scale * px, x[1] + scale * py, x[2] + scale * pz
    out[3:7], out[7] = q, scale * y[7]


@compiled
def similar_inverse(x: Array, out: Array) -> None:
    q = np.empty(4)
    so3.inverse(x[3:7].copy(), q)
    px, py, pz = so3.rotate(q[0], q[1], q[2], q[3], x[0], x[1], x[2])
    scale = 1.0 / x[7]
    out[0], out[1], out[2] = -scale * px, -scale * py, -scale * pz
    out[3:7], out[7] = q, scale


class Similarities(fg.LieGroup):
    """Sim(3): (p, q, s), with tangents (rho, omega, sigma)."""

    name, storage, dim, matrix_dim = "Sim(3)", 8, 7, 4
    exp = fg.elementwise(similar_exp)
    log = fg.elementwise(similar_log)
    compose = fg.elementwise(similar_compose)
    inverse = fg.elementwise(similar_inverse)

    def identity(self) -> Array:
        return np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])

    def random(self, rng: Generator, /, shape: Batch = ()) -> Array:
        scale = np.exp(0.5 * rng.standard_normal((*shape, 1)))
        return np.concatenate([rng.standard_normal((*shape, 3)), fg.SO3.random(rng, shape), scale], axis=-1)

    def matrix(self, x: ArrayLike, /) -> Array:
        x = np.asarray(x, dtype=np.float64)
        result = np.zeros((*x.shape[:-1], 4, 4)) + np.eye(4)
        result[..., :3, :3] = x[..., 7, None, None] * fg.SO3.matrix(x[..., 3:7])
        result[..., :3, 3] = x[..., :3]
        return result

    def hat(self, d: ArrayLike, /) -> Array:
        d = np.asarray(d, dtype=np.float64)
        result = np.zeros((*d.shape[:-1], 4, 4))
        result[..., :3, :3] = fg.SO3.hat(d[..., 3:6]) + d[..., 6, None, None] * np.eye(3)
        result[..., :3, 3] = d[..., :3]
        return result


SIM3 = Similarities()

# ---------------------------------------------------------------- rotations with the scalar last


@compiled
def last_exp(d: Array, out: Array) -> None:
    half = 0.5 * math.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
    s = 0.5 * math.sin(half) / half if half > 1e-150 else 0.5
    out[0], out[1], out[2], out[3] = s * d[0], s * d[1], s * d[2], math.cos(half)


@compiled
def last_log(x: Array, out: Array) -> None:
    length = math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    scale = 2.0 * math.atan2(length, abs(x[3])) / length if length > 1e-150 else 2.0
    scale = -scale if x[3] < 0.0 else scale
    out[0], out[1], out[2] = scale * x[0], scale * x[1], scale * x[2]


@compiled
def last_compose(x: Array, y: Array, out: Array) -> None:
    a, b, c, w = x
    e, f, g, v = y
    q = (w * e + a * v + b * g - c * f, w * f + b * v + c * e - a * g, w * g + c * v + a * f - b * e)
    r = w * v - a * e - b * f - c * g
    length = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + r**2)
    out[0], out[1], out[2], out[3] = q[0] / length, q[1] / length, q[2] / length, r / length


@compiled
def last_inverse(x: Array, out: Array) -> None:
    out[0], out[1], out[2], out[3] = -x[0], -x[1], -x[2], x[3]


class ScalarLast(fg.LieGroup):
    """SO(3) in quaternions (x, y, z, w) of either sign."""

    name, storage, dim, matrix_dim = "SO3 xyzw", 4, 3, 3
    exp = fg.elementwise(last_exp)
    log = fg.elementwise(last_log)
    compose = fg.elementwise(last_compose)
    inverse = fg.elementwise(last_inverse)

    def identity(self) -> Array:
        return np.array([0.0, 0.0, 0.0, 1.0])

    def random(self, rng: Generator, /, shape: Batch = ()) -> Array:
        return np.roll(fg.SO3.random(rng, shape), -1, axis=-1)

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        return fg.SO3.is_valid(x)

    def matrix(self, x: ArrayLike, /) -> Array:
        return fg.SO3.matrix(np.roll(x, 1, axis=-1))

    def hat(self, d: ArrayLike, /) -> Array:
        return fg.SO3.hat(d)


XYZW = ScalarLast()

# ---------------------------------------------------------------- SE(2) with straight steps


@compiled
def straight_retract(x: Array, d: Array, out: Array) -> None:
    c, s, theta = math.cos(x[2]), math.sin(x[2]), x[2] + d[2]
    out[0], out[1] = x[0] + c * d[0] - s * d[1], x[1] + s * d[0] + c * d[1]
    out[2] = (theta + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def straight_local(x: Array, y: Array, out: Array) -> None:
    c, s, px, py = math.cos(x[2]), math.sin(x[2]), y[0] - x[0], y[1] - x[1]
    turn = (y[2] - x[2] + math.pi) % (2.0 * math.pi) - math.pi
    out[0], out[1], out[2] = c * px + s * py, c * py - s * px, turn


class StraightSteps(SE2Group):
    """Poses of the plane that move along their axes, without the arc of the exponential."""

    name = "straight SE2"
    retract = fg.elementwise(straight_retract)
    local = fg.elementwise(straight_local)


STRAIGHT = StraightSteps()

GROUPS: list[fg.LieGroup] = [SE23, SIM3, XYZW, STRAIGHT]
OWN: list[fg.Manifold] = [S2, *GROUPS, fg.Product(pose=SE23, down=S2, scale=fg.Rn(1), heading=fg.SE2)]
