"""Constants in the place of elements of a manifold: validated, and normalised where they are slightly off."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from math import pi
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.factors.residuals import Residual
from unifg.lie import SE2, SO2, Manifold
from unifg.lie.manifold import ManifoldBase
from unifg.lie.product import leaves
from unifg.lie.se3 import SE3Group
from unifg.lie.se23 import ExtendedPoses
from unifg.lie.so3 import SO3Group
from unifg.modeling.duplicates import doubles
from unifg.modeling.variables import Data, Selection
from unifg.typing import Array, BoolArray

logger = logging.getLogger("unifg")
NEAR = 1e-3  # distance to the manifold that rounding in files and messages explains
QUATERNIONS = (SO3Group, SE3Group, ExtendedPoses)


def elements_of(residual: Residual) -> dict[int, Manifold]:
    """The manifold of every argument that is an element of one, by its place."""
    kernel = residual.kernel.arguments if residual.kernel is not None else ()
    return {k: a for k, a in enumerate(kernel) if not isinstance(a, int | tuple)} | dict(residual.elements)


def particular(manifold: Manifold) -> bool:
    """Test whether finite numbers may be no element."""
    return any(getattr(type(leaf), "is_valid", None) is not ManifoldBase.is_valid for leaf, _, _ in leaves(manifold))


def quaternions_of(manifold: Manifold) -> list[int] | None:
    """Starts of the unit quaternions in a stored element; None where other conditions hold, too."""
    parts = [(leaf, start) for leaf, start, _ in leaves(manifold) if particular(leaf)]
    known = all(isinstance(leaf, QUATERNIONS) for leaf, _ in parts)
    return [start + leaf.storage - 4 for leaf, start in parts] if known else None


def on_manifolds(name: str, residual: Residual, arguments: Sequence[Any], active: Any) -> tuple[Any, ...]:
    """The arguments of a term, its constant elements normalised; misshapen ones are left to later checks.

    Args:
        name: of the term.
        residual: of the term.
        arguments: of the term, families as selections.
        active: (n,) booleans, data or None; rows that are not active are not looked at.

    Raises:
        GraphError: naming term, argument and row of what is not on its manifold, or of a measurement that is NaN.
    """
    result = list(arguments)
    elements = elements_of(residual)
    wanted: BoolArray | None = active.value.astype(bool) if isinstance(active, Data) else active
    for place, given in enumerate(arguments):
        if isinstance(given, Selection) or not (place in elements or residual.kernel is not None):
            continue
        what = f"term '{name}': argument {place} of {residual.name}"
        array = given.value if isinstance(given, Data) else doubles(what, given, term=name)
        if place in elements and array.ndim and array.shape[-1] == elements[place].storage:
            array = nearest(what, elements[place], array, wanted, name)
            if residual.name == "prior":
                _notice_degrees(name, elements[place], np.atleast_2d(array))
        elif np.isnan(array).any():
            row = int(np.argwhere(np.isnan(array))[0][0]) if array.ndim > 1 else 0
            if wanted is None or len(wanted) != len(np.atleast_1d(array)) or wanted[row]:
                raise GraphError(f"{what}, row {row}, is not finite: {array[row : row + 1]}", term=name, index=row)
        if not isinstance(given, Data):
            result[place] = array
    return tuple(result)


def nearest(what: str, manifold: Manifold, given: Array, active: BoolArray | None, term: str) -> Array:
    """Elements (..., storage) with those normalised that are off their manifold by up to 1e-3.

    Args:
        what: they are, the subject of the message.
        manifold: theirs.
        given: (storage,) or (n, storage); not changed.
        active: (n,) rows to look at; None for all.
        term: for the error.

    Raises:
        GraphError: a row is not finite, or farther off.
    """
    if np.all(manifold.is_valid(given)):
        return given
    result = given.copy()
    rows = result.reshape(-1, manifold.storage)
    wanted = np.ones(len(rows), dtype=bool) if active is None or len(active) != len(rows) else active
    for leaf, start, _ in leaves(manifold):
        part = rows[:, start : start + leaf.storage]
        wrong = np.flatnonzero(wanted & ~leaf.is_valid(part))
        if not len(wrong):
            continue
        here = part[wrong]
        with np.errstate(all="ignore"):
            moved = np.asarray(leaf.retract(here, np.zeros((len(wrong), leaf.dim))))
            off = np.sqrt(np.minimum((moved - here) ** 2, (moved + here) ** 2).sum(axis=1))  # of either sign
        bad = np.flatnonzero(~(leaf.is_valid(moved) & (off <= NEAR)))
        if len(bad):
            k, finite = int(wrong[bad[0]]), np.isfinite(here[bad[0]]).all()
            said = f"is not on {leaf.name}" if finite else "is not finite"
            shown = ", ".join(f"{number:.6g}" for number in here[bad[0]].tolist())
            maker = "SO3" if isinstance(leaf, ExtendedPoses) else leaf.name
            hint = f"; its quaternion is to be w first, norm 1: {maker}.from_quaternion converts others"
            raise GraphError(
                f"{what}, row {k}, {said}: [{shown}]{hint if isinstance(leaf, QUATERNIONS) else ''}",
                term=term,
                index=k,
            )
        part[wrong] = moved
    return result


def _notice_degrees(name: str, manifold: Manifold, rows: Array) -> None:
    """Warn of headings beyond a turn: what a compass or a file gives in degrees."""
    for leaf, start, _ in leaves(manifold):
        if leaf in (SO2, SE2):
            heading = rows[:, start + leaf.storage - 1]
            beyond = np.flatnonzero(np.abs(heading) > 2.0 * pi)
            if len(beyond):
                k = int(beyond[0])
                logger.warning(
                    "term '%s': the heading of row %d is %g rad, more than a turn: headings are in radians; "
                    "np.deg2rad converts degrees",
                    name, k, heading[k],
                )  # fmt: skip
