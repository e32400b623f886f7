"""Information matrices: those that are none, repairs of them, and bounds from below that a relaxation can hold."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.factors.whitening import quick_roots
from unifg.typing import Array, BoolArray

__all__ = ["REPAIRS", "Repair", "bounded_below", "indefinite", "repaired", "require_repair"]

Repair: TypeAlias = Literal["zero", "project"]
REPAIRS: tuple[Repair, ...] = ("zero", "project")
NEGATIVE = 1e-9  # of the largest eigenvalue; what a graph refuses
SHARES = np.concatenate([np.linspace(0.0, 0.95, 20), 1.0 - np.geomspace(0.03, 1e-9, 12), [1.0]])  # of an eigenvalue
ROUNDING = 1e-14  # of the greatest entry of an information matrix
FLOOR = 1e-6  # of an eigenvalue: where it counts as lost


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


def bounded_below(information: Array, dim: int) -> tuple[Array, Array]:
    """Block diagonal matrices diag(tau I, Omega) that lie below information matrices [[A, B], [B', C]].

    With tau below the least eigenvalue of A, the difference is positive semi-definite where Omega is the Schur
    complement C - B' (A - tau I)^-1 B. A coupling costs rotation what tau gains: of a grid of tau, the one is taken
    whose ellipsoid is the least. In space, Omega's greatest eigenvalue is then lowered to the sum of the others, beyond
    which no chordal cost has it.

    Args:
        information: (m, d, d) positive semi-definite, translation before rotation.
        dim: of the translation.

    Returns:
        (m,) tau, and (m, k, k) Omega.
    """
    if len(information) > 1 and (information == information[0]).all():  # as where one sensor has measured everything
        one, own = bounded_below(information[:1], dim)
        return np.repeat(one, len(information)), np.repeat(own, len(information), axis=0)
    lengths, axes = np.linalg.eigh(information[:, :dim, :dim])
    turning, least = information[:, dim:, dim:], np.maximum(lengths[:, 0], 0.0)
    greatest = np.maximum(np.abs(turning).max(axis=(1, 2), initial=0.0), np.finfo(np.float64).tiny)
    sound = np.linalg.eigvalsh(turning)[:, 0] >= -ROUNDING * greatest
    tau, omega = np.where(sound, least, 0.0), turning.copy()  # without a coupling, all of tau is free
    some = np.flatnonzero(information[:, :dim, dim:].any(axis=(1, 2)))
    cross = np.swapaxes(axes[some], 1, 2) @ information[some, :dim, dim:]
    coupled, best = (cross != 0.0).any(axis=2), np.full(len(some), -np.inf)
    for share in SHARES if len(some) else ():
        left = lengths[some] - share * least[some, None]
        open_ = left > 0.0
        inverse = np.where(open_, 1.0 / np.where(open_, left, 1.0), 0.0)
        schur = turning[some] - np.swapaxes(cross, 1, 2) @ (inverse[:, :, None] * cross)
        bends = np.linalg.eigvalsh(schur) / greatest[some, None]
        size = dim * np.log(share + FLOOR) + np.sum(np.log(np.maximum(bends, 0.0) + FLOOR), axis=1)
        better = (size > best) & (((bends[:, 0] >= -ROUNDING) & (open_ | ~coupled).all(axis=1)) | (share == 0.0))
        taken = some[better]
        tau[taken], omega[taken], best[better] = share * least[taken], schur[better], size[better]
    own, frames = np.linalg.eigh(omega)
    own = np.maximum(own, 0.0)
    if own.shape[1] == 3:
        own[:, 2] = np.minimum(own[:, 2], own[:, 0] + own[:, 1])
    return tau, frames @ (own[:, :, None] * np.swapaxes(frames, 1, 2))
