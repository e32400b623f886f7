"""Every Lie group with samples from every corner of its tangent space, and how to compare elements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.random import Generator
from scipy.linalg import expm

from unifg.lie import SE2, SE3, SE23, SO2, SO3, LieGroup, Product, Rn
from unifg.typing import Array

Batch: TypeAlias = tuple[int, ...]

PI = float(np.pi)
ALGEBRA = 2e-12  # rounding of a few products of entries up to about ten


@dataclass(frozen=True)
class Case:
    """A group, the slices of its tangent that are rotation vectors, the places where it stores angles."""

    group: LieGroup
    rotations: tuple[slice, ...]
    angles: list[int]


CASES = {
    "Rn(1)": Case(Rn(1), (), []),
    "Rn(3)": Case(Rn(3), (), []),
    "SO2": Case(SO2, (slice(0, 1),), [0]),
    "SE2": Case(SE2, (slice(2, 3),), [2]),
    "SO3": Case(SO3, (slice(0, 3),), []),
    "SE3": Case(SE3, (slice(3, 6),), []),
    "SE23": Case(SE23, (slice(6, 9),), []),
    "product": Case(Product(p=Rn(2), R=SO2, T=SE2), (slice(2, 3), slice(5, 6)), [2, 5]),
    "nested": Case(
        Product(robot=Product(T=SE2, v=Rn(2)), R=SO2, tool=Product(T=SE2)),
        (slice(2, 3), slice(5, 6), slice(8, 9)),
        [2, 5, 8],
    ),
    "space": Case(
        Product(T=SE3, arm=Product(R=SO3, v=Rn(3)), joint=SO2),
        (slice(3, 6), slice(6, 9), slice(12, 13)),
        [14],
    ),
}
BATCHES = [(), (1,), (5,), (3, 1, 2), (0,)]
BROADCASTS = [((), (5,)), ((5,), ()), ((3, 1, 2), (4, 1)), ((1,), (0,)), ((2, 1), (1, 3))]
REGIMES = ["random", "near identity", "pi - 1e-5", "pi - 1e-9", "exactly -pi"]


def tangents(case: Case, regime: str, batch: Batch, rng: Generator) -> Array:
    """Draw (*batch, dim) tangent vectors whose rotation vectors have the angle that the regime names."""
    d = rng.standard_normal((*batch, case.group.dim))
    if regime == "near identity":
        scale: Array = 10.0 ** rng.uniform(-9, -5, (*batch, 1))
        return d * scale
    for part in case.rotations:
        size = part.stop - part.start
        direction = rng.standard_normal((*batch, size))
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        if regime == "random":
            d[..., part] = rng.uniform(-PI, PI, (*batch, 1)) * direction
        elif regime == "exactly -pi":
            d[..., part] = -PI * (np.abs(direction) if size == 1 else direction)
        else:
            d[..., part] = (PI - float(regime.removeprefix("pi - "))) * direction
    return d


def elements(case: Case, regime: str, batch: Batch, rng: Generator) -> Array:
    """Draw (*batch, storage) elements of the regime."""
    if regime == "random":
        return case.group.random(rng, batch)
    return case.group.exp(tangents(case, regime, batch, rng))


def exponentials(matrices: Array) -> Array:
    """Return ``expm`` of (..., k, k) matrices; SciPy refuses empty batches on some versions."""
    if matrices.size == 0:
        return np.zeros_like(matrices)
    return np.asarray(expm(matrices))


def integrated(generators: Array, exponential: Callable[[Array], Any] = exponentials) -> Any:
    """Return the integral of expm(s G) over s in [0, 1]: the corner of expm([[G, I], [0, 0]])."""
    size = generators.shape[-1]
    block = np.zeros((*generators.shape[:-2], 2 * size, 2 * size))
    block[..., :size, :size] = generators
    block[..., :size, size:] = np.eye(size)
    return exponential(block)[..., :size, size:]


def times(matrices: Array, vectors: Array) -> Array:
    """Return matrix times vector over any batch."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def assert_close(actual: Array, desired: Array, tolerance: float = ALGEBRA) -> None:
    """Same shape, and equal up to ``tolerance`` relative to the largest entry (at least 1)."""
    assert actual.shape == desired.shape
    scale = max(1.0, float(np.abs(desired).max(initial=0.0)))
    np.testing.assert_allclose(actual, desired, rtol=0.0, atol=tolerance * scale)


def assert_same(group: LieGroup, actual: Array, desired: Array) -> None:
    """Compare elements through their matrices."""
    assert actual.shape == desired.shape
    assert_close(group.matrix(actual), group.matrix(desired))


def assert_on_group(case: Case, x: Array, batch: Batch) -> None:
    """Right shape and type, valid, and angles inside [-pi, pi)."""
    assert x.dtype == np.float64
    assert x.shape == (*batch, case.group.storage)
    assert np.all((x[..., case.angles] >= -PI) & (x[..., case.angles] < PI))
    verdict = case.group.is_valid(x)
    assert np.shape(verdict) == batch
    assert np.all(verdict)
