"""Calling compiled functions through their addresses, and views that cost nothing.

A graph holds many residuals; one compiled loop runs them all when each is a number, the address of its machine
code. The functions keep Numba's own calling convention, so they take arrays like any other, and the cache on disk
stays valid because no address is ever compiled into a caller.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary, ref

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

VECTOR = types.Array(types.float64, 1, "C")
MATRIX = types.Array(types.float64, 2, "C")
RESIDUAL = (VECTOR, VECTOR, VECTOR, VECTOR, MATRIX)
"""Types of a residual: variables, parameters, table, residual (written), Jacobian (written)."""
RETRACTION = (VECTOR, VECTOR, VECTOR)
"""Types of a retraction: point, step, moved point (written)."""
_addresses: WeakKeyDictionary[Callable[..., Any], dict[tuple[Any, ...], int]] = WeakKeyDictionary()
_libraries: dict[int, tuple[ref[Any], str]] = {}


def address(function: Callable[..., Any], arguments: tuple[Any, ...]) -> int:
    """Address of the machine code of a compiled function, for the given argument types.

    The caller keeps ``function`` alive for as long as the address is used.
    """
    known = _addresses.setdefault(function, {})
    if arguments not in known:
        known[arguments] = placed(function, types.void, arguments)
    return known[arguments]


def placed(function: Any, result: Any, arguments: tuple[Any, ...]) -> int:
    """Compile for arguments and a result of the given types and return the address of the machine code."""
    function.compile(result(*arguments))
    library, name = (overload := function.overloads[arguments]).library, overload.fndesc.llvm_func_name
    found = int(library.get_pointer_to_function(name))
    _libraries[found] = ref(library), name
    return found


def code_at(where: int) -> tuple[Any, str] | None:
    """LLVM's module and the name of the function at an address; None where no compiled function stands."""
    library, name = _libraries.get(where, (lambda: None, ""))
    return None if (found := library()) is None else (found._get_module_for_linking(), name)


def _primitive(generator: Callable[..., Any]) -> Any:
    """Function for compiled code that Numba replaces by the instructions ``generator`` emits."""
    primitive = intrinsic(prefer_literal=True)(generator)
    # Kernels are pickled with what they call. Numba would rebuild a primitive that no longer sees literals.
    primitive.__class__ = type("Primitive", (type(primitive),), {"__reduce__": lambda self: self._name})
    return primitive


def _caller(arguments: tuple[Any, ...]) -> Any:
    """Generate code that calls an address with arguments of the given types."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        pointer = context.call_conv.get_function_type(types.none, arguments).as_pointer()
        function = builder.inttoptr(values[0], pointer)
        context.call_conv.call_function(builder, function, types.none, arguments, values[1:])
        return context.get_dummy_value()

    return generate


@_primitive
def call_residual(
    typing: Any, function: Any, variables: Any, parameters: Any, table: Any, residual: Any, jacobian: Any
) -> Any:
    """Run the residual at an address."""
    return types.void(types.int64, *RESIDUAL), _caller(RESIDUAL)


@_primitive
def call_retraction(typing: Any, function: Any, point: Any, step: Any, moved: Any) -> Any:
    """Run the retraction at an address."""
    return types.void(types.int64, *RETRACTION), _caller(RETRACTION)


def _view(context: Any, builder: Any, kind: Any, data: Any, shape: list[Any]) -> Any:
    """Build an array that borrows memory: no reference is counted."""
    from numba.np.arrayobj import populate_array  # a fortieth of a second, for what is compiled alone

    array = cgutils.create_struct_proxy(kind)(context, builder)
    item = context.get_constant(types.intp, 8)
    strides = [item] if len(shape) == 1 else [builder.mul(item, shape[1]), item]
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=item, meminfo=None)
    return array._getvalue()


def _borrow(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array = cgutils.create_struct_proxy(signature.args[0])(context, builder, values[0])
    return _view(context, builder, signature.return_type, builder.gep(array.data, [values[1]]), list(values[2:]))


def _borrow_address(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    data = builder.inttoptr(values[0], ir.DoubleType().as_pointer())
    return _view(context, builder, signature.return_type, data, [values[1]])


@_primitive
def vector(typing: Any, array: Any, start: Any, length: Any) -> Any:
    """``array[start:start + length]`` of a contiguous float array, without counting references."""
    return VECTOR(array, types.int64, types.int64), _borrow


@_primitive
def matrix(typing: Any, array: Any, start: Any, rows: Any, columns: Any) -> Any:
    """``array[start:start + rows * columns]`` as rows by columns, without counting references."""
    return MATRIX(array, types.int64, types.int64, types.int64), _borrow


@_primitive
def vector_at(typing: Any, where: Any, length: Any) -> Any:
    """The float array of a given length at an address."""
    return VECTOR(types.int64, types.int64), _borrow_address


def _allocate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    sizes = [argument.literal_value for argument in signature.args]
    total = 1
    for size in sizes:
        total *= size
    data = cgutils.alloca_once(builder, ir.DoubleType(), size=total)
    shape = [context.get_constant(types.intp, size) for size in sizes]
    return _view(context, builder, signature.return_type, data, shape)


@_primitive
def local_vector(typing: Any, length: Any) -> Any:
    """A float array on the stack, of a length known when the function is compiled; it must not outlive the call."""
    return VECTOR(length), _allocate


@_primitive
def local_matrix(typing: Any, rows: Any, columns: Any) -> Any:
    """Rows by columns on the stack, both known when the function is compiled; it must not outlive the call."""
    return MATRIX(rows, columns), _allocate
