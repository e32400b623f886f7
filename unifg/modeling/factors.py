"""Residuals every robot shares: priors, relative measurements, differences.

They exist on any manifold: ``prior``, ``between`` and ``difference`` are completed with the manifold of the
variables they are given. Jacobians are in right perturbation, X Exp(d); equation numbers are those of Sola et al.,
"A micro Lie theory", arXiv:1812.01537.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from inspect import cleandoc
from typing import Any, cast

import numpy as np

from unifg.codegen.calls import RESIDUAL, address, local_matrix, local_vector, vector
from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.factors.autodiff.groups import GROUPS
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import Kernel
from unifg.factors.per_factor import per_factor
from unifg.factors.residuals import Residual, residual
from unifg.lie import LieGroup, Manifold, Rn, rn
from unifg.lie.functions import Functions, functions_of
from unifg.lie.product import leaves
from unifg.typing import Array


@dataclass(frozen=True)
class ManifoldResidual:
    """A residual defined on every manifold; :meth:`on` completes it.

    Attributes:
        name: shown in tables and messages.
        build: makes the residual for one manifold.
        about: what ``help`` says of it.
    """

    name: str
    build: Callable[[Manifold], Residual]
    about: str = field(default="", repr=False, compare=False)

    def __post_init__(self) -> None:
        """Give ``help`` its own text instead of that of the class."""
        if self.about:
            object.__setattr__(self, "__doc__", cleandoc(self.about))

    def on(self, manifold: Manifold) -> Residual:
        """The residual for variables on ``manifold``.

        Raises:
            GraphError: when it has no meaning there.
        """
        return self.build(manifold)


# ---------------------------------------------------------------- groups with compiled functions


def _relative(group: LieGroup, functions: Functions) -> Callable[..., None]:
    """Write Log(p^-1 x^-1 y) and its derivatives, with p a measured element or nothing."""
    storage, dim = group.storage, group.dim
    between, log, adjoint = functions.between, functions.log, functions.adjoint
    inverse_jacobian = functions.right_jacobian_inverse

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        x, y = vector(v, 0, storage), vector(v, storage, storage)
        seen, error = local_vector(storage), local_vector(storage)
        between(x, y, seen)
        if len(p):
            between(p, seen, error)
            log(error, r)
        else:
            log(seen, r)
        if len(J):
            after, transport = local_matrix(dim, dim), local_matrix(dim, dim)
            inverse_jacobian(r, after)  # eq. 79
            between(y, x, seen)
            adjoint(seen, transport)
            for i in range(dim):
                for k in range(dim):
                    total = 0.0
                    for j in range(dim):
                        total += after[i, j] * transport[j, k]
                    J[i, k] = -total
                    J[i, dim + k] = after[i, k]

    return kernel


def _deviation(group: LieGroup, functions: Functions) -> Callable[..., None]:
    """Write Log(p^-1 x) and its derivative."""
    deviation, inverse_jacobian = functions.log_between, functions.right_jacobian_inverse

    @compiled
    def kernel(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
        deviation(p, v, r)
        if len(J):
            inverse_jacobian(r, J)

    return kernel


@dataclass(frozen=True, eq=False)
class _Deviation(StatedKernel):
    """Log(p^-1 x), rows and slopes written by hand, its Hessian derived.

    Derived, the former take 1.3 to 1.6 times as long, the latter a third as long in space.

    Attributes:
        written: compiled, as a kernel's function.
    """

    written: Callable[..., None] = field(kw_only=True)

    @cached_property
    def address(self) -> int:
        """Of the machine code of what is written."""
        return address(self.written, RESIDUAL)


# ---------------------------------------------------------------- vectors


@compiled
def _vector_deviation(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """X - p."""
    for i in range(len(r)):
        r[i] = v[i] - p[i]
        if len(J):
            for k in range(len(r)):
                J[i, k] = 1.0 if i == k else 0.0


@compiled
def _vector_relative(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Y - x - p, or y - x."""
    dim = len(r)
    for i in range(dim):
        r[i] = rn.minus(rn.minus(v[dim + i], v[i]), p[i] if len(p) else 0.0)
        if len(J):
            for k in range(dim):
                J[i, k] = -1.0 if i == k else 0.0
                J[i, dim + k] = 1.0 if i == k else 0.0


# ---------------------------------------------------------------- any other manifold, evaluated by NumPy


def _deviations(manifold: Manifold, x: Array, reference: Array) -> Array:
    if isinstance(manifold, LieGroup):
        return np.atleast_2d(manifold.log(manifold.between(reference, x)))
    return np.atleast_2d(manifold.local(reference, x))


def _deviation_slopes(group: LieGroup, x: Array, reference: Array) -> list[Array]:
    after = group.right_jacobian_inverse(_deviations(group, x, reference))  # eq. 79
    return [np.broadcast_to(after, (len(x), group.dim, group.dim))]


def _relatives(manifold: Manifold, x: Array, y: Array, *measured: Array) -> Array:
    if not isinstance(manifold, LieGroup):
        return manifold.local(x, y)
    seen = manifold.between(x, y)
    return manifold.log(manifold.between(measured[0], seen) if measured else seen)


def _relative_slopes(group: LieGroup, x: Array, y: Array, *measured: Array) -> list[Array]:
    after = group.right_jacobian_inverse(_relatives(group, x, y, *measured))
    return [-after @ group.adjoint(group.between(y, x)), after]


@cache
def _complete(
    manifold: Hashable,
    name: str,
    arguments: tuple[Any, ...],
    vectors: Callable[..., None],
    groups: Any,
    batched: tuple[Any, Any],
    second: bool = False,
) -> Residual:
    """The kernel for vectors, for groups with compiled functions, or the batched function for all others."""
    assert isinstance(manifold, Manifold)
    functions = functions_of(manifold)
    if isinstance(manifold, Rn):
        made = residual(Kernel(vectors, arguments, manifold.dim, name=name, linear=True))
    elif isinstance(manifold, LieGroup) and functions is not None:
        written = groups(manifold, functions)
        if second and all(isinstance(leaf, Rn) or leaf in GROUPS for leaf, _, _ in leaves(manifold)):
            plain = partial(_deviations, manifold)
            made = residual(_Deviation(plain, arguments, manifold.dim, name=name, written=written))
        else:
            made = residual(Kernel(written, arguments, manifold.dim, name=name))
    elif functions is not None and not isinstance(manifold, LieGroup):
        made = _by_differences(manifold, functions, name)
    else:
        function, slopes = (partial(one, manifold) for one in batched)
        made = residual(function, slopes if isinstance(manifold, LieGroup) else None, name)
    between = name == "between" and not isinstance(manifold, Rn)
    frames = ("A_T_B", "A_T_C", "B") if between else ("A_T_B",) * 3
    takes = tuple(f"* in {frame}" for frame in frames[: len(arguments)])
    return replace(made, elements=tuple((place, manifold) for place in range(len(arguments))), takes=takes)


def _by_differences(manifold: Manifold, functions: Functions, name: str) -> Residual:
    """``prior`` and ``difference`` of points that cannot be composed: the local step between them."""
    local = functions.local
    if name == "difference":
        return residual(per_factor(local, None, manifold.dim, (manifold, manifold), (), name))

    @compiled
    def deviation(x: Array, reference: Array, r: Array) -> None:
        local(reference, x, r)

    return residual(per_factor(deviation, None, manifold.dim, (manifold, 1), ((manifold.storage,),), name))


def _build_prior(manifold: Manifold) -> Residual:
    return _complete(
        cast(Hashable, manifold),
        "prior",
        (manifold, (manifold.storage,)),
        _vector_deviation,
        _deviation,
        (_deviations, _deviation_slopes),
        True,
    )


def _build_between(manifold: Manifold) -> Residual:
    if not isinstance(manifold, LieGroup):
        raise GraphError(f"between needs a Lie group, found {manifold.name}; use difference")
    return _complete(
        cast(Hashable, manifold),
        "between",
        (manifold, manifold, (manifold.storage,)),
        _vector_relative,
        _relative,
        (_relatives, _relative_slopes),
    )


def _build_difference(manifold: Manifold) -> Residual:
    batched = _relatives, _relative_slopes
    return _complete(cast(Hashable, manifold), "difference", (manifold, manifold), _vector_relative, _relative, batched)


_PRIOR = """Difference of a variable from what is believed about it: Log(reference^-1 x) on any manifold.

    graph.minimize(fg.prior, x[0], [0.0, 0.0, 0.0], sigma=[0.1, 0.1, 0.05])

Args:
    x: variable or selection, n members of a manifold of dimension d.
    reference: elements of the manifold, (storage,) for all of them or (n, storage), as numbers or ``graph.data``.

Returns:
    (n, d) rows in the tangent space at the reference, in the manifold's own units (SE2: m, m, rad); plain differences
    x - reference for vectors. Weighted by ``sigma=``, ``covariance=`` or ``information=`` of the term.

Raises:
    GraphError: the manifold has no logarithm, or shapes do not fit.
"""
_BETWEEN = """A relative measurement: Log(measured^-1 x^-1 y), zero where y is seen from x as measured.

    graph.minimize(fg.between, x[:-1], x[1:], odometry, sigma=[0.05, 0.05, 0.02])

Args:
    x, y: variables or selections, n members each (or one, shared) of the same group of dimension d.
    measured: x^-1 y as measured, an element of the group, (storage,) for all or (n, storage), as numbers or
        ``graph.data``.

Returns:
    (n, d) rows in the tangent space, in the group's own units (SE2: m, m, rad; SE3: translation before rotation).
    y - x - measured for vectors. The residual of GTSAM's BetweenFactor.

Raises:
    GraphError: the manifold is no group, or shapes do not fit.
"""
_DIFFERENCE = """Log(x^-1 y), zero where both agree: for rates and smoothness.

    graph.minimize(fg.difference, u[:-1], u[1:], sigma=0.5)

Args:
    x, y: variables or selections, n members each (or one, shared) of the same manifold of dimension d.

Returns:
    (n, d) rows in the tangent space at x; y - x for vectors.

Raises:
    GraphError: the manifold has no logarithm, or shapes do not fit.
"""
prior = ManifoldResidual("prior", _build_prior, _PRIOR)
between = ManifoldResidual("between", _build_between, _BETWEEN)
difference = ManifoldResidual("difference", _build_difference, _DIFFERENCE)
