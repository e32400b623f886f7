"""Information matrices with negative eigenvalues, which are none: which they are, and what can be made of them."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.kernels.whitening import quick_roots
from unifg.typing import Array, BoolArray

__all__ = ["REPAIRS", "Repair", "indefinite", "repaired", "require_repair"]

Repair: TypeAlias = Literal["zero", "project"]
REPAIRS: tuple[Repair, ...] = ("zero", "project")
NEGATIVE = 1e-9  # of the largest eigenvalue; what a graph refuses


def indefinite(information: Array) -> BoolArray:
    """(m,) which of (m, d, d) symmetric matrices have an eigenvalue below zero by more than rounding."""
    count, dim = information.shape[:2]
    whole = np.ascontiguousarray(information, dtype=np.float64)
    if not count or quick_roots(whole, np.empty((count, dim * dim))):  # nearly all files
        return np.zeros(count, dtype=np.bool_)
    lengths = np.linalg.eigvalsh(whole)
    below: BoolArray = lengths[:, 0] < -NEGATIVE * np.abs(lengths).max(axis=1)
    return below


def require_repair(how: str) -> None:
    """See that a word names a repair.

    Raises:
        GraphError: it does not.
    """
    if how not in REPAIRS:
        raise GraphError(f"repair is {how!r}: expected {' or '.join(map(repr, REPAIRS))}")


def repaired(information: Array, how: Repair) -> Array:
    """Information matrices (m, d, d), the indefinite ones among them replaced.

    Args:
        information: (m, d, d).
        how: "zero" by nothing: the measurement has no say; "project" by the nearest positive semi-definite matrix in
            the Frobenius norm: negative eigenvalues are set to zero, so what the measurement says of other directions
            counts.

    Raises:
        GraphError: on another word.
    """
    require_repair(how)
    wrong = indefinite(information)
    result = np.array(information, dtype=np.float64)
    result[wrong] = 0.0
    if how == "project" and wrong.any():
        lengths, axes = np.linalg.eigh(information[wrong])
        halves = axes * np.sqrt(np.maximum(lengths, 0.0))[:, None, :]
        result[wrong] = halves @ np.swapaxes(halves, 1, 2)
    return result
