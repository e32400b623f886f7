"""What a graph needs from a manifold, and what a Lie group offers on top.

Source of symbols and formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol, runtime_checkable

import numpy as np

from unifg.typing import Array, ArrayLike, BoolArray


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
        ...

    @property
    def storage(self) -> int:
        """Length of the vector that stores a point."""
        ...

    @property
    def dim(self) -> int:
        """Dimension of the tangent space."""
        ...

    def identity(self) -> Array:
        """Return the (storage,) point to start from when nothing better is known."""
        ...

    def retract(self, x: Array, d: Array, /) -> Array:
        """Move (..., storage) points by (..., dim) steps: ``x [+] d``."""
        ...

    def local(self, x: Array, y: Array, /) -> Array:
        """Return the (..., dim) step ``d`` with ``x [+] d = y``."""
        ...

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, storage) points that reach every part of the manifold."""
        ...

    def is_valid(self, x: Array, /) -> BoolArray:
        """Tell for each of (..., storage) vectors whether it is a point of the manifold."""
        ...


class LieGroup(ABC):
    """A manifold whose points can be composed; satisfies :class:`Manifold`.

    The retraction is the group's own: ``x [+] d = x Exp(d)`` (Sola eq. 25) and ``local(x, y) = Log(x^-1 y)``
    (eq. 26). Jacobians are named for the side of the perturbation:
    ``Exp(d + e) = Exp(d) Exp(Jr(d) e) = Exp(Jl(d) e) Exp(d)`` to first order in e.

    Groups are values: equal by kind (and size), hashable, picklable, without state.

    Attributes:
        name: short name for tables and messages.
        storage: length of the vector that stores an element.
        dim: dimension of the tangent space.
        point_dim: dimension of the points that :meth:`act` moves.
        matrix_dim: size of :meth:`matrix`.
    """

    name: str
    storage: int
    dim: int
    point_dim: int
    matrix_dim: int

    # Every group defines these.

    @abstractmethod
    def identity(self) -> Array:
        """Return the (storage,) identity element."""

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

    @abstractmethod
    def act(self, x: ArrayLike, points: ArrayLike, /) -> Array:
        """Move (..., point_dim) points; leading axes of elements and points broadcast."""

    @abstractmethod
    def matrix(self, x: ArrayLike, /) -> Array:
        """Represent elements by (..., matrix_dim, matrix_dim) matrices: products go to products."""

    @abstractmethod
    def hat(self, d: ArrayLike, /) -> Array:
        """Return (..., matrix_dim, matrix_dim) algebra matrices: ``matrix(Exp(d)) = expm(hat(d))``."""

    @abstractmethod
    def adjoint(self, x: ArrayLike, /) -> Array:
        """Return the (..., dim, dim) adjoints: ``x Exp(d) x^-1 = Exp(Ad(x) d)``."""

    @abstractmethod
    def ad(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) small adjoints: ``Ad(Exp(d)) = expm(ad(d))``, ``ad(a) b = [a, b]``."""

    @abstractmethod
    def right_jacobian(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) ``Jr(d)``: ``Exp(d)^-1 Exp(d + e) = Exp(Jr(d) e)`` to first order."""

    @abstractmethod
    def right_jacobian_inverse(self, d: ArrayLike, /) -> Array:
        """Return (..., dim, dim) ``Jr(d)^-1 = I + ad/2 + ad^2/12 - ...`` in closed form."""

    @abstractmethod
    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw (*shape, storage) elements: rotations uniform, translations standard normal."""

    # These follow; a group overrides them where it can do the same with fewer calls.

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., storage) vectors whether it is an element: here, whether it is finite."""
        return np.asarray(np.isfinite(x).all(axis=-1))

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

    # Value semantics.

    def _key(self) -> tuple[object, ...]:
        """Return what, besides the class, tells two groups apart."""
        return ()

    def __eq__(self, other: object) -> bool:
        """Compare by kind and size."""
        if self is other:
            return True
        return isinstance(other, LieGroup) and type(self) is type(other) and self._key() == other._key()

    def __hash__(self) -> int:
        """Hash by kind and size."""
        return hash((type(self), self._key()))

    def __repr__(self) -> str:
        """Return the name."""
        return self.name


def identities(like: Array, dim: int) -> Array:
    """Return fresh (..., dim, dim) identity matrices for the batch axes of ``like``, (..., k)."""
    result = np.zeros((*like.shape[:-1], dim, dim))
    diagonal = np.arange(dim)
    result[..., diagonal, diagonal] = 1.0
    return result
