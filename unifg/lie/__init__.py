"""Manifolds and Lie groups: batched, in float64, right perturbation, translation before rotation.

``SO2``, ``SE2``, ``SO3``, ``SE3`` and ``SE23`` are ready-made objects, ``Rn(n)`` and ``Product(name=manifold, ...)``
make equal objects from equal arguments. Each group is one file: its formulas as compiled functions of one element, and
the class that states them (:func:`elementwise`). A manifold of one's own derives from :class:`ManifoldBase`, a group
from :class:`LieGroup`. Conventions are collected in ``docs/reference/conventions.md``.
"""

from unifg.lie.axioms import Axioms, check_manifold
from unifg.lie.elementwise import elementwise
from unifg.lie.manifold import LieGroup, Manifold, ManifoldBase
from unifg.lie.product import Product
from unifg.lie.rn import Rn
from unifg.lie.se2 import SE2
from unifg.lie.se3 import SE3
from unifg.lie.se23 import SE23
from unifg.lie.so2 import SO2, wrap_angle
from unifg.lie.so3 import SO3

__all__ = [
    "SE2",
    "SE3",
    "SE23",
    "SO2",
    "SO3",
    "Axioms",
    "LieGroup",
    "Manifold",
    "ManifoldBase",
    "Product",
    "Rn",
    "check_manifold",
    "elementwise",
    "wrap_angle",
]


__dir__ = __all__.copy
