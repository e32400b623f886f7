"""One more factor of a kind that was stated before: only its numbers are new, and nothing else is looked at.

A robot states the same few kinds of factors at every step. What the first of a kind has taught - its type, where its
parameters stand, how it is whitened - holds for all that have the same function, families, shapes and loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np

from unifg.factors.robust import Loss, form_of
from unifg.factors.whitening import DIAGONAL, FULL, quick_roots
from unifg.modeling.variables import Selection
from unifg.problem.traced import Trace
from unifg.smoothing.families import GrowingFamily
from unifg.typing import Array

UNIT = 1e-9  # of squared norms, half of what the groups allow
Key = tuple[Any, ...]


class Kind(NamedTuple):
    """Data shared by single factors of one kind.

    Attributes:
        number: of their type.
        families: of their variables, in order.
        variables: places of these among the arguments.
        parameters: places of the others that the kernel takes, in its order, and where their numbers begin and end.
        whitening: 0, DIAGONAL or FULL.
        size: rows.
        first: where the whitener begins.
        length: of all numbers.
        name: for messages.
        function: known to the key by its id, which stays its own for as long as it lives.
        trace: what the kernel was derived from, which may change.
        quaternions: where those begin that must have norm one.
    """

    number: int
    families: list[GrowingFamily]
    variables: tuple[int, ...]
    parameters: tuple[tuple[int, int, int], ...]
    whitening: int
    size: int
    first: int
    length: int
    name: str
    function: Any
    trace: Trace | None
    quaternions: tuple[int, ...]


def key_of(
    function: Any, arguments: Sequence[Any], sigma: Any, information: Any, robust: Loss | None, name: str | None
) -> Key | None:
    """Key of the kind of single factors; None where a statement has to be looked at."""
    whitening, form = whitening_of(sigma, information), None if robust is None else form_of(robust)
    if whitening < 0 or (form is None and robust is not None):
        return None
    parts: list[Any] = [id(function), form, name, whitening]
    for argument in arguments:
        if type(argument) is Selection and argument.count == 1:
            parts += id(argument.family), argument.component
        elif type(argument) is np.ndarray and argument.dtype == np.float64:
            parts.append(argument.shape)
        else:
            return None
    return tuple(parts)


def whitening_of(sigma: Any, information: Any) -> int:
    """Of a statement with these weights; -1 where they have to be looked at."""
    if sigma is None:
        if information is None:
            return 0
        plain = type(information) is np.ndarray and information.ndim == 2 and information.dtype == np.float64
        return FULL if plain else -1
    if information is not None:
        return -1
    plain = type(sigma) is float or (type(sigma) is np.ndarray and sigma.ndim == 1 and sigma.dtype == np.float64)
    return DIAGONAL if plain else -1


def numbers_of(kind: Kind, arguments: Sequence[Any], sigma: Any, information: Any) -> Array | None:
    """(1, length) parameters and whitener of one factor; None where these or the kind have to be looked at."""
    if kind.trace is not None and kind.trace.outdated:
        return None
    data = np.empty((1, kind.length))
    row = data[0]
    for place, begin, end in kind.parameters:
        given = arguments[place]
        row[begin:end] = given if given.ndim == 1 else given.ravel()
    if kind.whitening == DIAGONAL:
        if type(sigma) is float:
            least = most = sigma
        elif len(sigma) == kind.size:
            found = sigma.tolist()
            least, most = min(found), max(found)
        else:
            return None
        if not (least > 0.0 and most < inf):
            return None
        row[kind.first :] = 1.0 / sigma
    elif kind.whitening == FULL:
        stack = np.array(information, ndmin=3, order="C")
        if stack.shape[1] != kind.size or stack.shape[2] != kind.size or not quick_roots(stack, data[:, kind.first :]):
            return None
    found = row.tolist()
    for k in kind.quaternions:
        w, x, y, z = found[k : k + 4]
        if not abs(w * w + x * x + y * y + z * z - 1.0) < UNIT:
            return None
    return data if isfinite(sum(found)) else None  # a sum that overflows is looked at
