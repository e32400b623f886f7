"""Manifolds and Lie groups: batched, in float64, right perturbation, translation before rotation.

``SE2`` and ``SO2`` are ready-made objects, ``Rn(n)`` and ``Product(name=manifold, ...)`` make equal objects
from equal arguments. A new group is a file of its own that derives from :class:`LieGroup`. Conventions are
collected in ``docs/conventions.md``.
"""

from unifg.lie.manifold import LieGroup, Manifold
from unifg.lie.product import Component, Product, ProductGroup
from unifg.lie.rn import Rn
from unifg.lie.se2 import SE2
from unifg.lie.so2 import SO2, wrap_angle

__all__ = ["SE2", "SO2", "Component", "LieGroup", "Manifold", "Product", "ProductGroup", "Rn", "wrap_angle"]
