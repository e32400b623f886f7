"""Kept for a moment: see :mod:`unifg.elimination`."""

from unifg.elimination.factorization import Factorization

__all__ = ["Factorization"]
