"""A user's ``@njit`` function of one factor, made into a kernel.

The function takes the arguments of one factor and writes its residual into the last one: variables as the (storage,)
arrays of their manifolds, parameters as numbers or arrays. Derivatives come from the user's own compiled function, or
from central differences along the right perturbation of every variable, in compiled code.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import Any

import numba

from unifg.calls import local_vector, matrix, vector
from unifg.differentiation import FIRST_STEP
from unifg.errors import GraphError
from unifg.jit import LIBERTIES
from unifg.kernels import Kernel
from unifg.lie import Manifold, Rn
from unifg.lie.lookup import functions_of
from unifg.lie.product import leaves
from unifg.lie.scalar import rn

logger = logging.getLogger("unifg")


def per_factor(
    function: Any,
    jacobian: Any,
    rows: int,
    arguments: Sequence[Manifold | int],
    shapes: Sequence[tuple[int, ...]],
    name: str,
) -> Kernel:
    """Write, compile and wrap the loop body that calls ``function``.

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
    names: dict[str, Any] = {"function": function, "jacobian": jacobian, "vector": vector, "matrix": matrix}
    names |= {"local_vector": local_vector, "H": FIRST_STEP}
    sizes = iter(shapes)
    at = offset = 0
    parts: list[str] = []  # of the call, {} standing for the array the variables are read from
    slots: list[tuple[int, Manifold]] = []
    for argument in arguments:
        if isinstance(argument, int):
            shape = next(sizes)
            parts.append(_parameter(name, offset, shape))
            offset += _product(shape)
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
        lines += _differences(call, slots, rows, at, names, name)
    exec(compile("\n".join(lines), f"<kernel of {name}>", "exec"), names)
    logger.info("compiling the residual '%s', once in this process", name)
    kernel = numba.njit(error_model="numpy", fastmath=LIBERTIES)(names["kernel"])
    return Kernel(kernel, tuple(arguments), rows, name=name)


def _parameter(name: str, offset: int, shape: tuple[int, ...]) -> str:
    """How the function sees one parameter."""
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
    call: str, slots: Sequence[tuple[int, Manifold]], rows: int, storage: int, names: dict[str, Any], name: str
) -> Iterator[str]:
    """Central differences along every tangent direction of every variable."""
    widest = max(manifold.dim for _, manifold in slots)
    yield f"    moved, step = local_vector({storage}), local_vector({widest})"
    yield f"    ahead, behind = local_vector({rows}), local_vector({rows})"
    yield f"    for k in range({storage}):"
    yield "        moved[k] = v[k]"
    column = 0
    for at, manifold in slots:
        for leaf, stored, tangent in leaves(manifold, at):
            module = rn if isinstance(leaf, Rn) else functions_of(leaf)
            if module is None:
                raise GraphError(
                    f"{name}: {leaf.name} has no compiled retraction, which a compiled residual needs for its "
                    "derivatives; attach a compiled Jacobian, or write the residual as a batched NumPy function"
                )
            retract = f"retract_{leaf.name.split('(')[0]}"
            names[retract] = module.retract
            move = f"{retract}(vector(v, {stored}, {leaf.storage}), vector(step, 0, {leaf.dim}), "
            move += f"vector(moved, {stored}, {leaf.storage}))"
            yield f"    for d in range({leaf.dim}):"
            yield f"        for k in range({leaf.dim}):"
            yield "            step[k] = 0.0"
            for sign, target in (("", "ahead"), ("-", "behind")):
                yield f"        step[d] = {sign}H"
                yield f"        {move}"
                yield f"        function({call.format('moved')}, {target})"
            yield f"        for a in range({rows}):"
            yield f"            J[a, {column + tangent} + d] = (ahead[a] - behind[a]) / (2.0 * H)"
            yield f"    for k in range({stored}, {stored + leaf.storage}):"
            yield "        moved[k] = v[k]"
        column += manifold.dim


def _product(shape: tuple[int, ...]) -> int:
    """Numbers in an array."""
    total = 1
    for length in shape:
        total *= length
    return total
