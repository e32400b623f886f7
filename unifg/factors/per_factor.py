"""A user's ``@njit`` function of one factor, made into a kernel.

The function takes the arguments of one factor and writes its residual into the last one: variables as the (storage,)
arrays of their manifolds, parameters as numbers or arrays. Derivatives come from the user's own compiled function, or
from central differences along the right perturbation of every variable, in compiled code.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from functools import lru_cache
from math import prod
from typing import Any, cast

import numpy as np

from unifg.codegen.calls import local_matrix, local_vector, matrix, vector
from unifg.codegen.jit import written
from unifg.errors import GraphError
from unifg.factors.autodiff.captured import captured_by
from unifg.factors.kernel import Kernel
from unifg.factors.steps import (
    FAR,
    FIRST,
    OTHER,
    TURN,
    VECTOR,
    Part,
    largest,
    move,
    parts_of,
    rotation,
    step_for,
    step_of,
    to_body,
    uncertainty,
)
from unifg.lie import Manifold
from unifg.lie.functions import functions_of


def per_factor(
    function: Any,
    jacobian: Any,
    rows: int,
    arguments: Sequence[Manifold | int],
    shapes: Sequence[tuple[int, ...]],
    name: str,
) -> Kernel:
    """Write, compile and wrap the loop body that calls ``function``; once for all terms that use it alike.

    Args:
        function: compiled, ``function(*arguments, r)``.
        jacobian: compiled, ``jacobian(*arguments, *blocks)`` with one (m, d_k) block per variable, or None.
        rows: m.
        arguments: manifold of each variable, number of axes of each parameter.
        shapes: of the parameters, for one factor.
        name: for messages.

    Raises:
        GraphError: when a manifold has no compiled retraction, or a parameter more than two axes.
    """
    return _compiled(_Alike(function), _Alike(jacobian), rows, tuple(arguments), tuple(shapes), name)


class _Alike:
    """A function, equal to all that compute the same: what Numba has compiled is never taken back."""

    def __init__(self, function: Any) -> None:
        self.function = function
        known = None if function is None else captured_by(function).key
        self._key: Hashable = id(function) if known is None else known

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Alike) and self._key == other._key


@lru_cache(maxsize=256)
def _compiled(
    functions: _Alike,
    jacobians: _Alike,
    rows: int,
    arguments: tuple[Hashable, ...],
    shapes: tuple[tuple[int, ...], ...],
    name: str,
) -> Kernel:
    function, jacobian = functions.function, jacobians.function
    names: dict[str, Any] = {"function": function, "jacobian": jacobian, "vector": vector, "matrix": matrix}
    names |= {"local_vector": local_vector, "local_matrix": local_matrix}
    names |= {"step_of": step_of, "step_for": step_for, "largest": largest, "uncertainty": uncertainty, "np": np}
    names |= {"move": move, "rotation": rotation, "to_body": to_body}
    sizes = iter(shapes)
    at = offset = 0
    parts: list[str] = []  # of the call, {} standing for the array the variables are read from
    slots: list[tuple[int, Manifold]] = []
    for argument in cast(tuple[Manifold | int, ...], arguments):
        if isinstance(argument, int):
            shape = next(sizes)
            parts.append(_parameter(name, offset, shape))
            offset += prod(shape)
        else:
            parts.append(f"vector({{0}}, {at}, {argument.storage})")
            slots.append((at, argument))
            at += argument.storage
    call = ", ".join(parts)
    lines = [
        "def kernel(v, p, table, r, J):",
        f"    function({call.format('v')}, r)",
        "    if len(J) == 0:",
        "        return",
    ]
    if jacobian is not None:
        lines += _attached(call, slots, rows)
    else:
        lines += _differences(call, slots, rows, at, name, names)
    kernel = written("kernel", lines, names, name)
    return Kernel(kernel, cast(tuple[Manifold | int, ...], arguments), rows, name=name, differenced=jacobian is None)


def _parameter(name: str, offset: int, shape: tuple[int, ...]) -> str:
    """One parameter as the function takes it."""
    if not shape:
        return f"p[{offset}]"
    if len(shape) == 1:
        return f"vector(p, {offset}, {shape[0]})"
    if len(shape) == 2:
        return f"matrix(p, {offset}, {shape[0]}, {shape[1]})"
    raise GraphError(f"{name}: a parameter has shape {shape} for one factor; compiled residuals take two axes at most")


def _attached(call: str, slots: Sequence[tuple[int, Manifold]], rows: int) -> Iterator[str]:
    """Call the user's derivatives and copy the blocks side by side."""
    for k, (_, manifold) in enumerate(slots):
        yield f"    m{k} = local_vector({rows * manifold.dim})"
        yield f"    b{k} = matrix(m{k}, 0, {rows}, {manifold.dim})"
    yield f"    jacobian({call.format('v')}, {', '.join(f'b{k}' for k in range(len(slots)))})"
    column = 0
    for k, (_, manifold) in enumerate(slots):
        yield f"    for a in range({rows}):"
        yield f"        for d in range({manifold.dim}):"
        yield f"            J[a, {column} + d] = b{k}[a, d]"
        column += manifold.dim


def _differences(
    call: str, slots: Sequence[tuple[int, Manifold]], rows: int, storage: int, name: str, names: dict[str, Any]
) -> Iterator[str]:
    """Central differences along every tangent direction of every variable; see :mod:`unifg.factors.steps`."""
    manifolds = [manifold for _, manifold in slots]
    parts = parts_of(*manifolds)
    movers = _movers(parts, name)
    names |= {mover: function for mover, function in movers.values()}
    yield f"    moved, step = local_vector({storage}), local_vector({max(manifold.dim for manifold in manifolds)})"
    yield f"    ahead, behind, R = local_vector({rows}), local_vector({rows}), local_matrix(3, 3)"
    yield f"    found = local_matrix(3, {rows})"
    yield f"    for k in range({storage}):"
    yield "        moved[k] = v[k]"
    yield "    size = 0.0"
    for part, _ in parts:
        if part.kind in (VECTOR, OTHER):
            yield f"    size = largest(v, {part.start}, {part.storage}, size)"
    yield f"    wide, estimates = step_for(size, {FIRST}), 3 if size >= {FAR} else 1"
    for part, _ in parts:
        kind, start, stored, dim, column, turn = part
        yield f"    for k in range({dim}):"
        yield "        step[k] = 0.0"
        yield f"    for d in range({dim}):"
        yield f"        short = step_of(v, {kind}, {start}, {stored}, {turn}, d, {FIRST})"
        yield "        for e in range(estimates):"
        yield "            h = short if e == 0 else e * wide"
        for sign, target in (("", "ahead"), ("-", "behind")):
            yield f"            step[d] = {sign}h"
            if kind == OTHER:
                origin, destination = (f"vector({array}, {start}, {stored})" for array in ("v", "moved"))
                yield f"            {movers[start][0]}({origin}, vector(step, 0, {dim}), {destination})"
            else:
                yield f"            move(v, {kind}, {start}, {dim}, step, 0, moved)"
            yield f"            function({call.format('moved')}, {target})"
        stepped = "2.0 * h" if kind in (TURN, OTHER) else f"(v[{start} + d] + h) - (v[{start} + d] - h)"
        yield f"            stepped = {stepped}"
        yield f"            for a in range({rows}):"
        yield "                found[e, a] = (ahead[a] - behind[a]) / stepped"
        yield "        step[d] = 0.0"
        yield f"        for a in range({rows}):"
        yield f"            J[a, {column} + d] = found[0, a]"
        yield "        if estimates == 3:"
        yield "            doubt = np.inf if short == wide else uncertainty(size, short)"
        yield f"            for a in range({rows}):"
        yield "                fourth = (4.0 * found[1, a] - found[2, a]) / 3.0"
        yield "                if abs(fourth - found[0, a]) <= doubt:"
        yield f"                    J[a, {column} + d] = fourth"
        yield f"    for k in range({start}, {start + stored}):"
        yield "        moved[k] = v[k]"
        if turn >= 0:
            yield f"    rotation(v, {turn}, {dim}, R)"
            yield f"    to_body(R, {dim}, J, {rows}, {column})"


def _movers(parts: Sequence[tuple[Part, Manifold]], name: str) -> dict[int, tuple[str, Any]]:
    """Name and function of the retraction of every part that has its own, by where the part starts."""
    movers = {}
    for part, leaf in parts:
        if part.kind == OTHER:
            functions = functions_of(leaf)
            if functions is None:
                raise GraphError(
                    f"{name}: {leaf.name} has no compiled retraction, which a compiled residual needs for its "
                    "derivatives; state it by fg.elementwise, attach a compiled Jacobian, or write the residual as a "
                    "batched NumPy function"
                )
            movers[part.start] = f"retract{part.start}", functions.retract
    return movers
