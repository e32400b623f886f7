"""Many arrays handed to compiled code as one number.

Every array that Python hands to a compiled function is unpacked and typed, half a microsecond each; compiled functions
hand on seven words for each, and count references with atomic operations. Where nine arrays go to functions that work
for a microsecond, that is most of the time. So they are described by one array of integers, of which an address is
handed on, and views of them own nothing: they are good for as long as someone else keeps the arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import count
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numba.extending import intrinsic

from unifg.typing import IntArray

T = TypeVar("T")
WORD = ir.IntType(64)


class Form(NamedTuple):
    """A named tuple of arrays.

    Attributes:
        made: what makes one.
        parts: dtypes of flat arrays, dtypes and numbers of columns of others, and forms of named tuples.
    """

    made: Callable[..., Any]
    parts: Sequence[Any]


def _kind(part: Any) -> Any:
    """Type of a part, or of all, for compiled code."""
    if isinstance(part, Form):
        return types.NamedTuple(list(map(_kind, part.parts)), part.made)
    dtype, *columns = part if isinstance(part, tuple) else (part,)
    return types.Array(from_dtype(dtype), 1 + len(columns), "C")


def described(arrays: Iterable[Any]) -> IntArray:
    """Addresses and lengths of arrays, as read by the function made by :func:`opener`."""
    return np.array([[array.ctypes.data, len(array)] for array in arrays], dtype=np.int64).ravel()


def opener(form: Callable[..., T], parts: Sequence[Any]) -> Callable[[int], T]:
    """Function for compiled code that opens a named tuple of arrays by the address of their description.

    What it does not use of them costs nothing.

    Numba's cache does not see the dtypes: call it from a compiled function in the file where they stand.

    Args:
        form: what makes one.
        parts: as of :class:`Form`.
    """
    whole = Form(form, parts)

    def opened(typing: Any, where: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            from numba.np import arrayobj  # a fortieth of a second, for what is compiled alone

            data, words = builder.inttoptr(values[0], WORD.as_pointer()), count()

            def load(part: Any) -> Any:
                if isinstance(part, Form):
                    return context.make_tuple(builder, _kind(part), list(map(load, part.parts)))
                dtype, *columns = part if isinstance(part, tuple) else (part,)
                begin, length = (builder.load(cgutils.gep(builder, data, next(words))) for _ in range(2))
                array = context.make_array(_kind(part))(context, builder)
                shape = [length, *map(WORD, columns)]
                sizes = [WORD(width * dtype.itemsize) for width in (*columns, 1)]
                pointer, item = builder.inttoptr(begin, cast(ir.PointerType, array.data.type)), WORD(dtype.itemsize)
                arrayobj.populate_array(array, data=pointer, shape=shape, strides=sizes, itemsize=item, meminfo=None)
                return array._getvalue()

            return load(whole)

        return _kind(whole)(types.int64), generate

    return cast(Callable[[int], T], intrinsic(opened))


def _redescribe(typing: Any, where: Any, place: Any, array: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data = builder.inttoptr(values[0], WORD.as_pointer())
        view = context.make_array(signature.args[2])(context, builder, values[2])
        first = builder.shl(values[1], WORD(1))
        builder.store(builder.ptrtoint(view.data, WORD), builder.gep(data, [first]))
        builder.store(view.nitems, builder.gep(data, [builder.add(first, WORD(1))]))
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, array), generate


redescribe = cast(Callable[[int, int, Any], None], intrinsic(_redescribe))
"""Put another array in a place of the description at an address; the caller keeps it."""
