"""Interfaces of a manifold and of a Lie group.

Source of symbols and formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unifg.codegen.fingerprint import is_compiled
from unifg.errors import UnifgError
from unifg.lie.defaults import RULES
from unifg.lie.elementwise import LAYOUTS, One, Two, method, stated
from unifg.typing import Array, ArrayLike, BoolArray

WHOLE = 1e-12  # from a whole number that an entry of small adjoints stands for


@runtime_checkable
class Manifold(Protocol):
    """The small protocol behind every variable; write your own without inheriting from anything.

    ``storage`` numbers describe a point, ``dim`` numbers a step in its tangent space; they may differ. All
    methods accept any leading (batch) axes and broadcast them as NumPy does. Manifolds that behave alike
    should compare equal, hash alike and pickle.
    """

    @property
    def name(self) -> str:
        """Short name for tables and messages."""

    @property
    def storage(self) -> int:
        """Length of the vector that stores a point."""

    @property
    def dim(self) -> int:
        """Dimension of the tangent space."""

    def identity(self) -> Array:
        """Return the (storage,) point to start from when nothing better is known."""

    def retract(self, x: Array, d: Array, /) -> Array:
        """Move (..., storage) points by (..., dim) steps: ``x [+] d``."""

    def local(self, x: Array, y: Array, /) -> Array:
        """Return the (..., dim) step ``d`` with ``x [+] d = y``."""

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, storage) points that reach every part of the manifold."""

    def is_valid(self, x: Array, /) -> BoolArray:
        """Tell for each of (..., storage) vectors whether it is a point of the manifold."""


class ManifoldBase(ABC):
    """Base of manifolds written as classes: values, equal by kind and size, hashable, picklable, stateless.

    A manifold of one's own states ``retract`` and ``local`` by compiled functions
    (:func:`unifg.lie.elementwise.elementwise`) or as ordinary methods for batches; where they are compiled, solvers and
    smoothers run them like those of the groups here.

    Attributes:
        name: short name for tables and messages.
        storage: length of the vector that stores a point.
        dim: dimension of the tangent space.
    """

    name: str
    storage: int
    dim: int

    @abstractmethod
    def identity(self) -> Array:
        """Return the (storage,) point to start from when nothing better is known; of a group, the identity."""

    @abstractmethod
    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Move (..., storage) points by (..., dim) steps: ``x [+] d``, (..., storage)."""

    @abstractmethod
    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return the (..., dim) step ``d`` with ``x [+] d = y``."""

    @abstractmethod
    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, storage) points that reach every part; of a group, uniform rotations, normal translations."""

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., storage) vectors whether it is a point: here, whether it is finite."""
        return np.asarray(np.isfinite(x).all(axis=-1))

    def __eq__(self, other: object) -> bool:
        """Compare by kind and size."""
        return self is other or (type(self) is type(other) and self.__dict__ == other.__dict__)

    def __hash__(self) -> int:
        """Hash by kind and size."""
        return hash((type(self), self.name, self.storage, self.dim))

    def __repr__(self) -> str:
        """Return the name."""
        return self.name

    def __reduce__(self) -> Any:
        """Pickle by name what its module knows by name, such as ``SE2``."""
        known = getattr(sys.modules.get(type(self).__module__), self.name, None)
        return self.name if known is self else super().__reduce__()


class LieGroup(ManifoldBase):
    """A manifold whose points can be composed; satisfies :class:`Manifold`.

    The retraction is the group's own: ``x [+] d = x Exp(d)`` (Sola eq. 25) and ``local(x, y) = Log(x^-1 y)``
    (eq. 26). Jacobians are named for the side of the perturbation:
    ``Exp(d + e) = Exp(d) Exp(Jr(d) e) = Exp(Jl(d) e) Exp(d)`` to first order in e.

    A subclass states ``identity``, ``random`` and, by compiled functions, ``exp``, ``log``, ``compose`` and
    ``inverse``: all else follows (``lie/defaults.py``), and is stated only where a closed form is quicker. What is
    stated as an ordinary method is run by NumPy, and so is what follows from it; adjoint and Jacobians then have to be
    stated.

    Attributes:
        name: short name for tables and messages.
        storage: length of the vector that stores an element.
        dim: dimension of the tangent space.
        point_dim: dimension of the points that :meth:`act` moves; 0 where it moves none.
        matrix_dim: size of :meth:`matrix`; 0 where there is none.
        generators: (dim, matrix_dim, matrix_dim) matrices of the unit tangent vectors, of which :meth:`hat` is made.
    """

    point_dim: int = 0
    matrix_dim: int = 0
    generators: Array | None = None

    def __init_subclass__(cls, methods: Mapping[str, Any] | None = None, **options: Any) -> None:
        """Add the methods given, and derive what follows from the compiled functions that the class states or inherits.

        Args:
            methods: compiled functions of one element, or batched methods, by the names in ``LAYOUTS``; others are
                ignored, so a module that names its formulas like methods passes ``globals()``.
            **options: of other bases.
        """
        super().__init_subclass__(**options)
        for name in LAYOUTS.keys() & (methods or {}).keys():
            made = methods[name]  # type: ignore[index]
            setattr(cls, name, method(cls, name, made) if is_compiled(made) else made)
        for name, (needs, make) in RULES.items():
            if not getattr(getattr(cls, name), "follows", getattr(cls, name) is getattr(LieGroup, name)):
                continue
            parts = [stated(cls, need) for need in needs]
            if all(parts) and isinstance(getattr(cls, "storage", None), int):
                made = method(cls, name, make(cls.storage, cls.dim, *parts))
                made.follows = True  # type: ignore[attr-defined]
            else:
                made = getattr(LieGroup, name)
            setattr(cls, name, made)

    # Every group states these.

    @abstractmethod
    def exp(self, d: ArrayLike, /) -> Array:
        """Map (..., dim) tangent vectors to (..., storage) elements."""

    @abstractmethod
    def log(self, x: ArrayLike, /) -> Array:
        """Map (..., storage) elements to their shortest (..., dim) tangent vectors."""

    @abstractmethod
    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Multiply: ``x y``, (..., storage)."""

    @abstractmethod
    def inverse(self, x: ArrayLike, /) -> Array:
        """Invert (..., storage) elements."""

    # These follow where those are compiled.

    def adjoint(self, x: ArrayLike, /) -> Array:
        """Return the (..., dim, dim) adjoints: ``x Exp(d) x^-1 = Exp(Ad(x) d)``."""
        raise self._missing("adjoint")

    def right_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) ``Jr(d)``: ``Exp(d)^-1 Exp(d + e) = Exp(Jr(d) e)`` to first order."""
        raise self._missing("right_jacobian")

    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) ``Jr(d)^-1 = I + ad/2 + ad^2/12 - ...`` in closed form."""
        raise self._missing("right_jacobian_inverse")

    def _missing(self, name: str) -> UnifgError:
        return UnifgError(
            f"{self.name} has no {name}: state it, or exp, log, compose and inverse by compiled functions, of which it "
            "follows"
        )

    # These follow in any case; a group states them where it can do the same with fewer calls.

    def between(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``x^-1 y``, (..., storage): y seen from x."""
        return self.compose(self.inverse(x), y)

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Move elements by tangent steps on the right: ``x Exp(d)``, (..., storage)."""
        return self.compose(x, self.exp(d))

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return ``Log(x^-1 y)``, (..., dim): the step d with ``x [+] d = y``."""
        return self.log(self.between(x, y))

    def left_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) ``Jl(d)``: ``Exp(d + e) Exp(d)^-1 = Exp(Jl(d) e)`` to first order."""
        return self.right_jacobian(np.negative(d))

    def left_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) ``Jl(d)^-1 = I - ad/2 + ad^2/12 - ...`` in closed form."""
        return self.right_jacobian_inverse(np.negative(d))

    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) small adjoints: ``Ad(Exp(d)) = expm(ad(d))``, ``ad(a) b = [a, b]``."""
        found: Array = np.einsum("...k,kij->...ij", np.asarray(d, dtype=np.float64), _small_adjoints(self))
        return found

    # A group that moves points, or has matrices, states these.

    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Move (..., point_dim) points; leading axes of elements and points broadcast."""
        raise UnifgError(f"{self.name} moves no points: it states no act")

    def matrix(self, x: ArrayLike, /) -> Array:
        """Represent elements by (..., matrix_dim, matrix_dim) matrices: products go to products."""
        raise UnifgError(f"{self.name} states no matrix")

    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., matrix_dim, matrix_dim) algebra matrices: ``matrix(Exp(d)) = expm(hat(d))``."""
        if self.generators is None:
            raise UnifgError(f"{self.name} states neither hat nor generators")
        found: Array = np.einsum("...k,kij->...ij", np.asarray(d, dtype=np.float64), self.generators)
        return found


class CompiledGroup(LieGroup):
    """Base of the groups whose modules state their formulas as compiled functions with the names of the methods."""

    exp: One
    log: One
    compose: Two
    inverse: One


def identities(like: Array, dim: int) -> Array:
    """Return fresh (..., dim, dim) identity matrices for the batch axes of ``like``, (..., k)."""
    result = np.zeros((*like.shape[:-1], dim, dim))
    diagonal = np.arange(dim)
    result[..., diagonal, diagonal] = 1.0
    return result


@cache
def _small_adjoints(group: LieGroup) -> Array:
    """(dim, dim, dim) small adjoints of the unit tangent vectors; entries that are whole but for rounding are whole."""
    unit = np.eye(group.dim)
    forward = group.adjoint(group.exp(0.25 * unit))
    z = np.linalg.solve(forward + unit, forward - unit)  # log A = 2 artanh((A + I)^-1 (A - I))
    basis: Array = 8.0 * np.sum([np.linalg.matrix_power(z, k) / k for k in range(1, 25, 2)], axis=0)
    whole = np.round(basis)
    return np.where(np.abs(basis - whole) < WHOLE, whole, basis)
