"""Residuals every robot shares: priors, relative measurements, differences.

They exist on any manifold: ``prior``, ``between`` and ``difference`` are completed with the manifold of the
variables they are given. Jacobians are in right perturbation, X Exp(d); equation numbers are those of Sola et al.,
"A micro Lie theory", arXiv:1812.01537.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from unifg.lie import LieGroup, Manifold, Rn
from unifg.residuals import Residual
from unifg.typing import Array


@dataclass(frozen=True)
class ManifoldResidual:
    """A residual defined on every manifold; :meth:`on` completes it.

    Attributes:
        name: shown in tables and messages.
        build: makes the residual for one manifold.
    """

    name: str
    build: Callable[[Manifold], Residual]

    def on(self, manifold: Manifold) -> Residual:
        """The residual for variables on ``manifold``."""
        return self.build(manifold)


class _OnManifold:
    """A picklable function of values on one manifold."""

    def __init__(self, manifold: Manifold) -> None:
        self.manifold = manifold

    @property
    def group(self) -> LieGroup:
        """The manifold, known to be a group where Jacobians are attached."""
        assert isinstance(self.manifold, LieGroup)
        return self.manifold


class _Prior(_OnManifold):
    def __call__(self, x: Array, reference: Array) -> Array:
        return np.atleast_2d(self.manifold.local(reference, x))

    def jacobian(self, x: Array, reference: Array) -> list[Array]:
        return [_right_inverse(self.group, self(x, reference), len(x))]


class _Between(_OnManifold):
    def __call__(self, x: Array, y: Array, measured: Array) -> Array:
        return self.group.log(self.group.between(measured, self.group.between(x, y)))

    def jacobian(self, x: Array, y: Array, measured: Array) -> list[Array]:
        group = self.group
        after = _right_inverse(group, self(x, y, measured), len(x))
        return [-after @ group.adjoint(group.between(y, x)), after]


class _Difference(_OnManifold):
    def __call__(self, x: Array, y: Array) -> Array:
        return self.manifold.local(x, y)

    def jacobian(self, x: Array, y: Array) -> list[Array]:
        group = self.group
        after = _right_inverse(group, self(x, y), len(x))
        return [-after @ group.adjoint(group.between(y, x)), after]


def _right_inverse(group: LieGroup, tangent: Array, count: int) -> Array:
    """(n, d, d) inverse right Jacobians (eq. 79: J_log), the identity for vectors."""
    if isinstance(group, Rn):
        return np.broadcast_to(np.eye(group.dim), (count, group.dim, group.dim))
    return np.broadcast_to(group.right_jacobian_inverse(tangent), (count, group.dim, group.dim))


def _build_prior(manifold: Manifold) -> Residual:
    function = _Prior(manifold)
    return Residual(function, function.jacobian if isinstance(manifold, LieGroup) else None, "prior")


def _build_between(manifold: Manifold) -> Residual:
    if not isinstance(manifold, LieGroup):
        raise TypeError(f"between needs a Lie group, found {manifold.name}; use difference")
    function = _Between(manifold)
    return Residual(function, function.jacobian, "between")


def _build_difference(manifold: Manifold) -> Residual:
    function = _Difference(manifold)
    return Residual(function, function.jacobian if isinstance(manifold, LieGroup) else None, "difference")


prior = ManifoldResidual("prior", _build_prior)
"""``prior(x, reference)``: Log(reference^-1 x), with reference (storage,) or (n, storage)."""

between = ManifoldResidual("between", _build_between)
"""``between(x, y, measured)``: Log(measured^-1 x^-1 y), with x_T_y measured, (storage,) or (n, storage)."""

difference = ManifoldResidual("difference", _build_difference)
"""``difference(x, y)``: Log(x^-1 y), zero when both agree; for rates and smoothness."""
