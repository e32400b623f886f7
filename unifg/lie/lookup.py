"""From a group to its compiled functions."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from unifg.lie.manifold import Manifold

COMPILED = ("SO2", "SE2", "SO3", "SE3")


def functions_of(manifold: Manifold) -> ModuleType | None:
    """The module of :mod:`unifg.lie.scalar` for a group; None for manifolds that only have batched methods."""
    kind = type(manifold)
    if kind.__module__.startswith("unifg.lie.") and manifold.name in COMPILED:
        return import_module(f"unifg.lie.scalar.{manifold.name.lower()}")
    return None
