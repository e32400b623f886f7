"""A residual tried on the variables it is stated for: does it take them, and how many rows has each factor?

A function is called once, at identity elements. A kernel says what it expects, and need not be called.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.factors.batched import Batched
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual
from unifg.modeling.duplicates import doubles
from unifg.modeling.variables import Data, Selection
from unifg.typing import Array

logger = logging.getLogger("unifg")


def rows_of(
    name: str,
    residual: Residual,
    arguments: Sequence[Any],
    count: int,
    scalar: bool = False,
    declared: Sequence[bool | None] = (),
) -> int:
    """The number of rows m of one factor.

    Args:
        name: of the term.
        residual: of the term.
        arguments: of the term, families as selections.
        count: factors n.
        scalar: whether the function is to return (n,) values instead of (n, m).
        declared: of each argument, whether it is declared to have a row for each factor.

    Raises:
        GraphError: naming the term, when the residual does not take these arguments or returns something else. Errors
            of the function itself say which term it was tried for.
    """
    if not callable(residual.function):
        raise GraphError(
            f"term '{name}': its residual must be a function of batches, found {residual.function!r}", term=name
        )
    if residual.kernel is not None and not scalar:
        return _rows_of_kernel(name, residual.kernel, arguments, count)
    if residual.rows and not scalar:
        return residual.rows
    batched = Batched(name, residual.function)
    places = [k for k, argument in enumerate(arguments) if isinstance(argument, Selection)]
    given = [argument.value if isinstance(argument, Data) else argument for argument in arguments]
    batched.bind(given, places, [])
    points = [np.tile(a.manifold.identity(), (count, 1)) for a in arguments if isinstance(a, Selection)]
    size = size_of(tried(batched, points, lambda: told(arguments, count)), name, arguments, count, scalar)
    if size == count > 1 and not scalar:
        known = zip(given, declared or [None] * len(given), strict=True)
        shapes = [np.shape(one) for one, rows in known if not isinstance(one, Selection) and rows is not False]
        if (count,) in shapes and not any(len(shape) > 1 and shape[0] == count for shape in shapes):
            logger.warning(
                "term '%s': each of its %d factors has %d rows, because a constant or data of shape (%d,) was taken "
                "as a row: a number for each factor is a column, z[:, None]; fg.shared(z) if a row is meant",
                name, count, size, count,
            )  # fmt: skip
    if residual.jacobian is not None and not scalar:
        _try_jacobian(name, residual.jacobian, batched.fill(points), arguments, (count, size))
    return size


def blocks_of(name: str, found: Any, arguments: Sequence[Any], count: int, size: int) -> list[Array]:
    """One (n, m, d_k) array for each variable of a term, of what an attached Jacobian returned.

    Blocks of arguments that are constants here are left out.

    Raises:
        GraphError: naming the term, when shapes or types are others.
    """
    places = [k for k, argument in enumerate(arguments) if isinstance(argument, Selection)]
    try:
        blocks = [_as_jacobian(name, block) for block in found]
    except TypeError:
        raise GraphError(
            f"term '{name}': the attached Jacobian returned {type(found).__name__}, expected one array for each "
            "variable",
            term=name,
        ) from None
    if len(blocks) > len(places) and len(blocks) > max(places):
        blocks = [blocks[place] for place in places]
    wanted = [(count, size, arguments[place].manifold.dim) for place in places]
    if [block.shape for block in blocks] != wanted:
        raise GraphError(
            f"term '{name}': the attached Jacobian returned shapes {[b.shape for b in blocks]}, expected {wanted}",
            term=name,
        )
    return blocks


def _try_jacobian(
    name: str, jacobian: Callable[..., Any], filled: Sequence[Any], arguments: Sequence[Any], shape: tuple[int, int]
) -> None:
    """Call an attached Jacobian once; at identity elements it may have none, which is no mistake."""
    try:
        with np.errstate(all="ignore"):
            found = jacobian(*filled)
    except Exception:
        return
    blocks_of(name, found, arguments, *shape)


def _as_jacobian(name: str, block: Any) -> Array:
    """A block of an attached Jacobian as an array; whole numbers are exact.

    Raises:
        GraphError: when it is made of coarser or complex numbers.
    """
    array = np.asarray(block)
    if array.dtype != np.float64 and array.dtype.kind not in "iub":
        raise GraphError(f"term '{name}': its attached Jacobian returned {array.dtype}, expected float64", term=name)
    return np.asarray(array, dtype=np.float64)


def tried(batched: Batched, points: Sequence[Array], arguments: Callable[[], str]) -> Array:
    """Result of a function; an error of its own is given a note about the arguments."""
    try:
        with np.errstate(all="ignore"):
            return batched.at(points)
    except GraphError:
        raise
    except Exception as error:
        shapes = arguments()
        flat = isinstance(error, IndexError) and re.search(r"\(\d+,\)", shapes)
        hint = "; one axis is passed on as it is: write c[None] for a row, c[:, None] for a column" if flat else ""
        error.add_note(f"it was called with {shapes}{hint}")
        raise


def size_of(found: Array, name: str, arguments: Sequence[Any], count: int, scalar: bool) -> int:
    """The number of rows m in what a function returned.

    Raises:
        GraphError: it has another shape than (n, m), or (n,) of a scalar cost.
    """
    if found.ndim != (1 if scalar else 2) or len(found) != count:
        expected = "(n,)" if scalar else "(n, m)"
        column = not scalar and found.shape == (count,)
        hint = "; a number for each factor is a column, (n, 1): return r[:, None]" if column else ""
        arrays = [a.value if isinstance(a, Data) else a for a in arguments if isinstance(a, Data | np.ndarray)]
        if found.ndim == 2 and any(array.shape[:1] == found.shape[:1] for array in arrays):
            said = "fg.each(array), graph.data(..., each=True)"
            hint = f"; where arrays have a row for each of {len(found)} factors, say so: {said}"
        raise GraphError(
            f"term '{name}': its function returned shape {found.shape}, expected {expected} with n = {count}{hint}; "
            f"arguments were {told(arguments, count)}",
            term=name,
        )
    return 1 if scalar else found.shape[1]


def _rows_of_kernel(name: str, kernel: Kernel, arguments: Sequence[Any], count: int) -> int:
    if len(kernel.arguments) != len(arguments):
        raise GraphError(
            f"term '{name}': {kernel.name} takes {len(kernel.arguments)} arguments, found {len(arguments)}: "
            f"{told(arguments, count)}",
            term=name,
        )
    filled: list[Any] = []
    for place, (argument, expected) in enumerate(zip(arguments, kernel.arguments, strict=True)):
        if isinstance(argument, Selection):
            _require_manifold(name, kernel, place, argument)
            filled.append(np.empty((1, argument.manifold.storage)))
        elif isinstance(argument, Data):
            filled.append(argument.value)
        else:
            what = "a parameter" if isinstance(expected, int | tuple) else f"an element of {expected.name}"
            filled.append(doubles(f"term '{name}': argument {place} of {kernel.name}, {what},", argument, term=name))
    try:
        _, parameters, _ = kernel.split(filled, count)
    except GraphError as error:
        flat = any(
            not isinstance(a, Selection) and np.shape(f) == (count,) for a, f in zip(arguments, filled, strict=True)
        )
        column = f"; a number for each of {count} factors is a column, ({count}, 1): z[:, None]" if flat else ""
        raise GraphError(f"term '{name}': {error}{column}", term=name) from None
    return kernel.size([parameter.shape[1:] for parameter in parameters])


def _require_manifold(name: str, kernel: Kernel, place: int, selection: Selection) -> None:
    expected = kernel.arguments[place]
    if expected != selection.manifold:
        wanted = "a parameter, not a variable" if isinstance(expected, int | tuple) else expected.name
        raise GraphError(
            f"term '{name}': argument {place} of {kernel.name} is {wanted}; found {selection!r} on "
            f"{selection.manifold.name}",
            term=name,
            family=selection.family.name,
        )


def told(arguments: Sequence[Any], count: int) -> str:
    """Shapes of all arguments, for messages."""
    shapes = []
    for argument in arguments:
        if isinstance(argument, Selection):
            shapes.append(f"{argument!r} as ({count}, {argument.manifold.storage})")
        elif isinstance(argument, Data):
            shapes.append(repr(argument))
        elif isinstance(argument, np.ndarray | list | tuple):
            shapes.append(f"constant {_shape(argument)}")
        else:
            shapes.append(f"{argument!r}"[:60])
    return ", ".join(shapes)


def _shape(argument: Any) -> str:
    try:
        return str(np.shape(argument))
    except ValueError:
        return f"{type(argument).__name__} of {len(argument)}, ragged"
