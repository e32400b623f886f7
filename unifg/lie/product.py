"""Named components side by side: the manifold of a state made of several parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, overload

import numpy as np

from unifg.errors import UnifgError
from unifg.lie.elementwise import DIM, LAYOUTS, MATRIX, POINT, STORAGE
from unifg.lie.manifold import LieGroup, Manifold
from unifg.typing import Array, ArrayLike, BoolArray


@dataclass(frozen=True, eq=False)
class Component:
    """One part of a product and where it lives.

    Attributes:
        name: name within the product.
        manifold: manifold of the part.
        storage: slice of the product's storage.
        tangent: slice of the product's tangent.
    """

    name: str
    manifold: Manifold
    storage: slice
    tangent: slice


class Product:
    """A manifold of named components, stored one after the other in the order given.

    Each component moves by its own retraction, so ``Product(p=Rn(2), R=SO2)`` is not ``SE2``. Components may
    be products. When all of them are groups the result is a :class:`ProductGroup` with all group operations;
    otherwise it is a manifold only.

    Attributes:
        name: for tables and messages.
        storage: sum of the components' storage.
        dim: sum of the components' dimensions.
        components: name to :class:`Component`, in order.

    Raises:
        UnifgError: when there is no component, or one is not a manifold.
    """

    name: str
    storage: int
    dim: int
    components: Mapping[str, Component]

    @overload
    def __new__(cls, /, **components: LieGroup) -> ProductGroup: ...
    @overload
    def __new__(cls, /, **components: Manifold) -> Product: ...
    def __new__(cls, /, **components: Manifold) -> Product:
        """Place the components one after the other."""
        _check(components)
        group = all(isinstance(part, LieGroup) for part in components.values())
        self = object.__new__(ProductGroup if group else Product)
        placed: dict[str, Component] = {}
        storage = dim = 0
        for name, part in components.items():
            stored, moved = slice(storage, storage + part.storage), slice(dim, dim + part.dim)
            placed[name] = Component(name, part, stored, moved)
            storage, dim = stored.stop, moved.stop
        self.components = MappingProxyType(placed)
        self.storage, self.dim = storage, dim
        self.name = "Product(" + ", ".join(f"{name}={part.name}" for name, part in components.items()) + ")"
        if isinstance(self, ProductGroup):
            self._place_actions()
        return self

    def component(self, name: str) -> Component:
        """Return a component by name.

        Raises:
            UnifgError: when there is none of that name; the message lists those there are.
        """
        try:
            return self.components[name]
        except KeyError:
            known = ", ".join(self.components)
            raise UnifgError(f"{self.name} has no component '{name}': it has {known}") from None

    def pack(self, /, **parts: ArrayLike) -> Array:
        """Join one (..., storage_k) array per component, broadcast, into (..., storage).

        Raises:
            UnifgError: when the names are not those of the components, or a part has the wrong length.
        """
        if parts.keys() != self.components.keys():
            given = ", ".join(parts) or "nothing"
            raise UnifgError(f"{self.name} packs {', '.join(self.components)}; got {given}")
        arrays = {name: np.asarray(part, dtype=np.float64) for name, part in parts.items()}
        for name, array in arrays.items():
            needed = self.components[name].manifold.storage
            if array.ndim == 0 or array.shape[-1] != needed:
                raise UnifgError(f"component '{name}' of {self.name} stores {needed} numbers; got shape {array.shape}")
        batch = np.broadcast_shapes(*(array.shape[:-1] for array in arrays.values()))
        result = np.empty((*batch, self.storage))
        for name, array in arrays.items():
            result[..., self.components[name].storage] = array
        return result

    def unpack(self, x: ArrayLike, /) -> dict[str, Array]:
        """Split (..., storage) into views, one per component."""
        x = self._sized(STORAGE, x)
        return {name: x[..., part.storage] for name, part in self.components.items()}

    def identity(self) -> Array:
        """Return the (storage,) identities of the components."""
        return np.concatenate([part.manifold.identity() for part in self.components.values()])

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        """Move each component by its own retraction, (..., storage)."""
        x, d = self._sized(STORAGE, x), self._sized(DIM, d)
        return self._join(lambda c: c.manifold.retract(x[..., c.storage], d[..., c.tangent]))

    def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
        """Return the step of each component, (..., dim)."""
        x, y = self._sized(STORAGE, x), self._sized(STORAGE, y)
        return self._join(lambda c: c.manifold.local(x[..., c.storage], y[..., c.storage]))

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        """Draw each component on its own, (*shape, storage)."""
        return self._join(lambda c: c.manifold.random(rng, shape))

    def is_valid(self, x: ArrayLike, /) -> BoolArray:
        """Tell for each of (..., storage) vectors whether all its components are valid."""
        x = np.asarray(x, dtype=np.float64)
        verdicts = [part.manifold.is_valid(x[..., part.storage]) for part in self.components.values()]
        return np.asarray(np.logical_and.reduce(verdicts))

    def _sized(self, size: str, x: ArrayLike) -> Array:
        """(..., n) numbers: slices of what is longer or shorter would be elements of something else."""
        array, length = np.asarray(x, dtype=np.float64), getattr(self, size)
        if array.shape[-1:] != (length,):
            raise UnifgError(f"{self.name} takes (..., {length}) arrays, for its {size}; got shape {array.shape}")
        return array

    def _join(self, of: Callable[[Component], Array]) -> Array:
        """Put the components' results side by side."""
        return np.concatenate([of(part) for part in self.components.values()], axis=-1)

    def _key(self) -> tuple[object, ...]:
        return tuple((name, part.manifold) for name, part in self.components.items())

    def __eq__(self, other: object) -> bool:
        """Compare names, manifolds and order of the components."""
        return self is other or (isinstance(other, Product) and self._key() == other._key())

    def __hash__(self) -> int:
        """Hash names, manifolds and order of the components."""
        return hash((Product, self._key()))

    def __repr__(self) -> str:
        """Return the name."""
        return self.name

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as the call that makes an equal product."""
        return _rebuild, ({name: part.manifold for name, part in self.components.items()},)


def _componentwise(name: str) -> Callable[..., Array]:
    """Make the method of a product that does the same to every component."""
    sizes, square = LAYOUTS[name][0], len(LAYOUTS[name][1]) == 2

    def each(self: Any, *arguments: ArrayLike) -> Array:
        arrays = [self._sized(size, x) for size, x in zip(sizes, arguments, strict=True)]
        found = [of(*(x[..., at] for x, at in zip(arrays, parts, strict=True))) for of, *parts in self._of(name)]
        return self._diagonal(name, found) if square else np.concatenate(found, axis=-1)

    return each


COMPONENTWISE = (
    "exp", "log", "compose", "inverse", "act", "matrix", "hat", "adjoint", "ad", "right_jacobian",
    "right_jacobian_inverse",
)  # fmt: skip


class ProductGroup(Product, LieGroup, methods={name: _componentwise(name) for name in COMPONENTWISE}):
    """A product whose components are all groups; ``Product(...)`` makes it.

    Matrices, adjoints and Jacobians are block diagonal. ``act`` moves concatenated points, each component its
    own.
    """

    _places: tuple[tuple[LieGroup, dict[str, slice]], ...]
    _methods: dict[str, list[tuple[Any, ...]]]

    def _place_actions(self) -> None:
        """Lay out the points and matrices of the components."""
        places = []
        self.point_dim = self.matrix_dim = 0
        for part in self.components.values():
            group = part.manifold
            assert isinstance(group, LieGroup)
            points = slice(self.point_dim, self.point_dim + group.point_dim)
            rows = slice(self.matrix_dim, self.matrix_dim + group.matrix_dim)
            places.append((group, {STORAGE: part.storage, DIM: part.tangent, POINT: points, MATRIX: rows}))
            self.point_dim, self.matrix_dim = points.stop, rows.stop
        self._places, self._methods = tuple(places), {}

    def _of(self, name: str) -> list[tuple[Any, ...]]:
        """A method of every component, and where its arguments stand."""
        if name not in self._methods:
            given, _ = LAYOUTS[name]
            self._methods[name] = [(getattr(group, name), *(at[size] for size in given)) for group, at in self._places]
        return self._methods[name]

    def _diagonal(self, name: str, blocks: list[Array]) -> Array:
        """Square blocks on the diagonal of (..., n, n) zeros."""
        size = LAYOUTS[name][1][0]
        result = np.zeros((*blocks[0].shape[:-2], getattr(self, size), getattr(self, size)))
        for (_, at), block in zip(self._places, blocks, strict=True):
            result[..., at[size], at[size]] = block
        return result


def leaves(manifold: Manifold, storage: int = 0, tangent: int = 0) -> Iterator[tuple[Manifold, int, int]]:
    """The components of products, down to manifolds that are none, and where each begins in storage and tangent."""
    if not isinstance(manifold, Product):
        yield manifold, storage, tangent
        return
    for part in manifold.components.values():
        yield from leaves(part.manifold, storage + part.storage.start, tangent + part.tangent.start)


def _check(components: Mapping[str, Manifold]) -> None:
    """Refuse what cannot be a product."""
    if not components:
        raise UnifgError("Product() has no components: name at least one, as in Product(p=Rn(2), R=SO2)")
    for name, part in components.items():
        if isinstance(part, type) or not isinstance(part, Manifold):
            raise UnifgError(f"component '{name}' of Product is {part!r}: give a manifold such as SE2")
        if name.startswith("_"):
            raise UnifgError(f"component '{name}' of Product starts with an underscore: drop the underscore")


def _rebuild(components: dict[str, Manifold]) -> Product:
    return Product(**components)
