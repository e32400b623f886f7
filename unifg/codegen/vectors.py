"""Four doubles at a time: the vector type the dense kernels are written in.

Explicit vectors give small fronts, where loops are too short to vectorise by themselves, the speed of a tuned
kernel, and compile in a fraction of the time. Offsets are neither wrapped nor checked: callers guarantee
``0 <= offset`` and ``offset + 4 <= len(array)``. Where an array is read or written its address will do; kernels take
addresses from each other, because handing over an array costs two atomic operations on its count of references.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import Parameter, Signature
from typing import Any, TypeAlias, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from unifg.typing import Array, IntArray

WIDTH = 4
Vector: TypeAlias = Any  # a value of `kind`, inside compiled code only
Address: TypeAlias = int  # of doubles, or of integers, that an array keeps alive
LANES = ir.VectorType(ir.DoubleType(), WIDTH)
INDEX = ir.IntType(64)
FLAGS = ("contract", "reassoc", "nsz")


class VectorType(types.Type):  # type: ignore[misc]
    """Type of a vector inside compiled code."""

    def __init__(self) -> None:
        """There is only one."""
        super().__init__(name="Vector4")


kind = VectorType()


@register_model(VectorType)
class VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    """A register."""

    def __init__(self, manager: Any, frontend: Any) -> None:
        """Represent the type by LLVM's vector."""
        super().__init__(manager, frontend, LANES)


ANY, ELEMENT = "any", "element"  # in signatures: an array or an address; the type of its elements


def _emitted(result: Any, *arguments: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a function for compiled code of the function that emits its instructions.

    Args:
        result: its Numba type, or ELEMENT.
        *arguments: those of its arguments, of which the first may be ANY, and others ELEMENT.
    """

    def made(emit: Callable[..., Any]) -> Any:
        def typed(typing_context: Any, *given: Any) -> Any:
            kinds = [kind if wanted == ANY else wanted for wanted, kind in zip(arguments, given, strict=True)]
            element: Any = types.float64 if isinstance(given[0], types.Integer) else getattr(given[0], "dtype", None)
            *kinds, found = (element if kind == ELEMENT else kind for kind in (*kinds, result))
            return found(*kinds), emit

        names = ["typing_context", *(f"argument{k}" for k in range(len(arguments)))]
        parameters = [Parameter(name, Parameter.POSITIONAL_OR_KEYWORD) for name in names]
        typed.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        typed.__name__ = emit.__name__
        return intrinsic(typed)

    return made


def _address(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    """Pointer to an element of a contiguous array, or of doubles at an address."""
    if isinstance(array_type, types.Integer):
        return builder.gep(builder.inttoptr(array, ir.DoubleType().as_pointer()), [offset])
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [offset])


@_emitted(types.int64, ANY)
def _address_of(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.ptrtoint(context.make_array(signature.args[0])(context, builder, values[0]).data, INDEX)


def _spread(builder: Any, scalar: Any) -> Any:
    """The same number in every lane."""
    undefined = ir.Constant(LANES, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, undefined, mask)


@_emitted(kind, ANY, types.int64)
def _load(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    pointer = _address(context, builder, signature.args[0], values[0], values[1])
    return builder.load(builder.bitcast(pointer, LANES.as_pointer()), align=8)


@_emitted(types.void, ANY, types.int64, kind)
def _store(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    pointer = _address(context, builder, signature.args[0], values[0], values[1])
    builder.store(values[2], builder.bitcast(pointer, LANES.as_pointer()), align=8)
    return context.get_dummy_value()


@_emitted(ELEMENT, ANY, types.int64)
def _get(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.load(_address(context, builder, signature.args[0], values[0], values[1]))


@_emitted(types.void, ANY, types.int64, ELEMENT)
def _put(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    builder.store(values[2], _address(context, builder, signature.args[0], values[0], values[1]))
    return context.get_dummy_value()


@_emitted(kind, types.float64)
def _splat(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return _spread(builder, values[0])


@_emitted(kind, kind, types.float64, kind)
def _minus(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    product = builder.fmul(_spread(builder, values[1]), values[2], flags=FLAGS)
    return builder.fsub(values[0], product, flags=FLAGS)


@_emitted(kind, kind, types.float64, kind)
def _plus(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    product = builder.fmul(_spread(builder, values[1]), values[2], flags=FLAGS)
    return builder.fadd(values[0], product, flags=FLAGS)


@_emitted(kind, types.float64, kind)
def _times(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.fmul(_spread(builder, values[0]), values[1], flags=FLAGS)


@_emitted(kind, kind, kind, types.int64)
def _blend(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    lanes = ir.Constant(ir.VectorType(INDEX, WIDTH), list(range(WIDTH)))
    empty = ir.Constant(lanes.type, ir.Undefined)
    wanted = builder.insert_element(empty, values[2], ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    inside = builder.icmp_signed("<", lanes, builder.shuffle_vector(wanted, empty, mask))
    return builder.select(inside, values[0], values[1])


@_emitted(kind, kind, kind, kind)
def _plus_products(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.fadd(values[0], builder.fmul(values[1], values[2], flags=FLAGS), flags=FLAGS)


@_emitted(kind, *[types.float64] * WIDTH)
def _pack(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    result = ir.Constant(LANES, ir.Undefined)
    for k, value in enumerate(values):
        result = builder.insert_element(result, value, ir.Constant(ir.IntType(32), k))
    return result


@_emitted(types.float64, kind, types.int64)
def _lane(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return builder.extract_element(values[0], values[1])


@_emitted(kind, kind)
def _inverse_root(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    unary = ir.FunctionType(LANES, [LANES])
    root = cgutils.get_or_insert_function(builder.module, unary, "llvm.sqrt.v4f64")
    size = cgutils.get_or_insert_function(builder.module, unary, "llvm.fabs.v4f64")
    below = builder.call(root, [builder.call(size, [values[0]])])
    return builder.fdiv(ir.Constant(LANES, [1.0] * WIDTH), below)


@_emitted(types.int64, ANY, types.int64)
def _advance(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    pointer = builder.gep(builder.inttoptr(values[0], INDEX.as_pointer()), [values[1]])
    return builder.atomic_rmw("add", pointer, ir.Constant(INDEX, 1), "seq_cst")


@_emitted(types.int64, ANY, types.int64)
def _present(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    pointer = builder.gep(builder.inttoptr(values[0], INDEX.as_pointer()), [values[1]])
    return builder.load_atomic(pointer, "seq_cst", 8)


@_emitted(types.float64, kind)
def _total(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    lanes = [builder.extract_element(values[0], ir.Constant(ir.IntType(32), k)) for k in range(WIDTH)]
    return builder.fadd(builder.fadd(lanes[0], lanes[2]), builder.fadd(lanes[1], lanes[3]))


address = cast(Callable[[Array | IntArray], Address], _address_of)  # of the first element
load = cast(Callable[[Array | Address, int], Vector], _load)  # array[offset : offset + 4]
store = cast(Callable[[Array | Address, int, Vector], None], _store)  # array[offset : offset + 4] = vector
get = cast(Callable[[Any, int], Any], _get)  # array[offset]
put = cast(Callable[[Any, int, Any], None], _put)  # array[offset] = value
splat = cast(Callable[[float], Vector], _splat)
minus = cast(Callable[[Vector, float, Vector], Vector], _minus)  # start - scalar * vector
plus = cast(Callable[[Vector, float, Vector], Vector], _plus)  # start + scalar * vector
times = cast(Callable[[float, Vector], Vector], _times)
blend = cast(Callable[[Vector, Vector, int], Vector], _blend)  # the first lanes of one, then the other's
plus_products = cast(Callable[[Vector, Vector, Vector], Vector], _plus_products)
pack = cast(Callable[[float, float, float, float], Vector], _pack)
lane = cast(Callable[[Vector, int], float], _lane)
inverse_root = cast(Callable[[Vector], Vector], _inverse_root)  # 1 / sqrt(abs(vector))
total = cast(Callable[[Vector], float], _total)
# Of 64-bit integers at an address that other threads may read and write at the same time.
advance = cast(Callable[[Address, int], int], _advance)  # integers[offset] += 1; what it was
present = cast(Callable[[Address, int], int], _present)  # integers[offset], and all that was written before
