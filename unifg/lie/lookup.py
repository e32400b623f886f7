"""From a group to its compiled functions."""

from __future__ import annotations

from collections.abc import Hashable
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import cast

from unifg.lie.compiled_product import Part, Scalar, bend_side_by_side, components, side_by_side
from unifg.lie.manifold import Manifold
from unifg.lie.product import ProductGroup
from unifg.lie.rn import Rn
from unifg.lie.scalar import bend, rn

COMPILED = ("SO2", "SE2", "SO3", "SE3")
BENDS: dict[str, Scalar] = {"SO2": bend.none, "SE2": bend.se2, "SO3": bend.so3, "SE3": bend.se3}


def functions_of(manifold: Manifold) -> ModuleType | None:
    """The compiled functions of a group: a module of :mod:`unifg.lie.scalar`, or one made for a product of groups.

    None for manifolds that only have batched methods, for products with one of these, and for vectors, which callers
    treat by themselves.
    """
    if isinstance(manifold, ProductGroup):
        return _of_product(cast(Hashable, manifold))
    kind = type(manifold)
    if kind.__module__.startswith("unifg.lie.") and manifold.name in COMPILED:
        return import_module(f"unifg.lie.scalar.{manifold.name.lower()}")
    return None


@cache
def _of_product(product: Hashable) -> ModuleType | None:
    """Made once for all equal products."""
    assert isinstance(product, ProductGroup)
    parts: list[Part] = []
    for leaf in components(product):
        functions = rn if isinstance(leaf, Rn) else functions_of(leaf)
        if functions is None:
            return None
        parts.append((functions, leaf.storage, leaf.dim))
    return side_by_side(parts)


@cache
def bend_of(group: Hashable) -> Scalar | None:
    """``bend(d, v, out)``, the derivative of Jr^-1(d) v along d: of vectors, groups and products of them.

    None where :func:`functions_of` finds nothing either, but for vectors.
    """
    parts: list[tuple[Scalar, int]] = []
    for leaf in components(cast(Manifold, group)):
        if not isinstance(leaf, Rn) and functions_of(leaf) is None:
            return None
        parts.append((bend.none if isinstance(leaf, Rn) else BENDS[leaf.name], leaf.dim))
    return bend_side_by_side(parts)
