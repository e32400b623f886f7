"""Functions of CasADi as residuals: their scalar instructions as a function of NumPy, differentiated like any other."""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.errors import ModelError
from unifg.factors.residuals import Residual, residual

_WRITTEN = {  # instruction -> what it computes of {0} and {1}; truth values are the numbers 0 and 1
    "ASSIGN": "{0}", "LIFT": "{0}", "ADD": "{0} + {1}", "SUB": "{0} - {1}", "MUL": "{0} * {1}", "DIV": "{0} / {1}",
    "NEG": "-{0}", "TWICE": "2.0 * {0}", "SQ": "{0} * {0}", "INV": "1.0 / {0}", "POW": "np.power({0}, {1})",
    "CONSTPOW": "np.power({0}, {1})", "REMAINDER": "{0} - {1} * np.rint({0} / {1})", "FMOD": "np.fmod({0}, {1})",
    "LT": "1.0 * ({0} < {1})", "LE": "1.0 * ({0} <= {1})", "EQ": "1.0 * ({0} == {1})", "NE": "1.0 * ({0} != {1})",
    "NOT": "1.0 * np.logical_not({0})", "AND": "1.0 * np.logical_and({0}, {1})", "ERF": "erf({0})",
    "OR": "1.0 * np.logical_or({0}, {1})", "IF_ELSE_ZERO": "np.where({0} != 0.0, {1}, 0.0)",
    "FMIN": "np.minimum({0}, {1})", "FMAX": "np.maximum({0}, {1})", "FABS": "np.absolute({0})",
    "ATAN2": "np.arctan2({0}, {1})", "HYPOT": "np.hypot({0}, {1})", "COPYSIGN": "np.copysign({0}, {1})",
    "ASIN": "np.arcsin({0})", "ACOS": "np.arccos({0})", "ATAN": "np.arctan({0})", "ASINH": "np.arcsinh({0})",
    "ACOSH": "np.arccosh({0})", "ATANH": "np.arctanh({0})",
}  # fmt: skip
_SAME = ("exp", "log", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "floor", "ceil", "sign", "log1p", "expm1")


def from_casadi(function: Any) -> Residual:
    """A CasADi function as a residual, with exact derivatives by the same route as any other function.

    Its inputs are the arguments of the residual, in order: variables, by their storage, and parameters: a number, a
    vector or a matrix, for all factors or one for each. Its one output, (m, 1) or (1, m), is the residual. Nothing of
    CasADi is called afterwards.

    Args:
        function: a ``casadi.Function`` of SX or of MX, which is expanded.

    Raises:
        ModelError: without the package casadi (the extra of that name); when it is no such function, has no input,
            other than one output or a matrix of outputs, calls what is not made of scalars, or contains an instruction
            that has no derivative here.
    """
    try:
        import casadi
    except ImportError as error:
        raise ModelError("a function of CasADi needs the package casadi: pip install unifg[casadi]") from error
    if not isinstance(function, casadi.Function):
        raise ModelError(f"from_casadi takes a casadi.Function, found {type(function).__name__}")
    name = function.name()
    sizes = [function.size_out(k) for k in range(function.n_out())]
    if len(sizes) != 1 or 1 not in sizes[0] or function.n_in() == 0:
        raise ModelError(f"the CasADi function '{name}' has {function.n_in()} inputs and returns {sizes}, not a vector")
    try:
        scalar = function if function.is_a("SXFunction") else function.expand()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise ModelError(f"the CasADi function '{name}' is not made of scalars: {reason}") from error
    names = {getattr(casadi, op): op.removeprefix("OP_") for op in dir(casadi) if op.startswith("OP_")}
    written = {**_WRITTEN, **{op.upper(): f"np.{op}({{0}})" for op in _SAME}}
    places = [_places(scalar.sparsity_in(k)) for k in range(scalar.n_in())]
    rows = [row * scalar.size2_out(0) + column for row, column in _places(scalar.sparsity_out(0))]

    arguments = [f"x{k}" for k in range(scalar.n_in())]
    lines = [f"def {name}({', '.join(arguments)}):"]
    lines += [f"    x{k} = rows_of(x{k}, {scalar.size1_in(k)}, {scalar.size2_in(k)})" for k in range(scalar.n_in())]
    lines.append(f"    r = np.zeros((max({', '.join(f'len({x})' for x in arguments)}, 0), {max(sizes[0])}))")
    lines.append("    with np.errstate(all='ignore'):")
    for k in range(scalar.n_instructions()):
        op = names.get(scalar.instruction_id(k), str(scalar.instruction_id(k)))
        operands, given = scalar.instruction_input(k), scalar.instruction_output(k)
        if op == "CONST":
            value = float(scalar.instruction_constant(k))
            lines.append(
                f"        w{given[0]} = {value!r}" if np.isfinite(value) else f"        w{given[0]} = np.{value}"
            )
        elif op == "INPUT":
            row, column = places[operands[0]][operands[1]]
            lines.append(f"        w{given[0]} = x{operands[0]}[:, {row}, {column}]")
        elif op == "OUTPUT":
            lines.append(f"        r[:, {rows[given[1]]}] = w{operands[0]}")
        elif op in written:
            lines.append(f"        w{given[0]} = {written[op].format(*(f'w{i}' for i in operands))}")
        else:
            raise ModelError(f"the CasADi function '{name}' contains the instruction {op}, which is not known here")
    from scipy.special import erf  # not before a function is written: it takes a tenth of a second to load

    known: dict[str, Any] = {"np": np, "erf": erf, "rows_of": rows_of, "__name__": __name__}
    exec(compile("\n".join([*lines, "    return r"]), f"<CasADi function {name}>", "exec"), known)
    return residual(known[name], name=name)


def _places(sparsity: Any) -> list[tuple[int, int]]:
    """Row and column of every entry that is stored."""
    return list(zip(*sparsity.get_triplet(), strict=True))


def rows_of(argument: Any, height: int, width: int) -> Any:
    """An argument of a residual as (n or 1, height, width).

    Raises:
        ModelError: when its numbers are not as many.
    """
    array = np.asarray(argument)
    if height * width == 1:
        return array.reshape(-1, 1, 1)
    if 1 in (height, width) and array.ndim in (1, 2) and array.shape[-1] == height * width:
        return array.reshape(-1, height, width)
    if array.ndim in (2, 3) and array.shape[-2:] == (height, width):
        return array.reshape(-1, height, width)
    raise ModelError(f"a CasADi function takes {height} by {width} numbers here, found an array of shape {array.shape}")
