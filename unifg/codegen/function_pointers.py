"""Large compiled functions that call each other through their addresses, and find their arrays through one.

Numba compiles every callee anew into each of its callers, and unpacks every array of every argument in each of them.
Where both are large that is most of a minute. Here a function is a number, the address of its machine code, and so is
what it works on: the address of a block of memory that describes all arrays. Every function is compiled once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import typeof, types
from numba.core import cgutils
from numba.core.datamodel import default_manager

from unifg.codegen.calls import _primitive, placed
from unifg.codegen.jit import _Cache, compiled, spelled
from unifg.errors import UnifgError
from unifg.typing import IntArray

F = TypeVar("F", bound=Callable[..., Any])

NOTHING, TRUTH, NUMBER, ADDRESS = types.void, types.boolean, types.float64, types.int64


class _LinkedCache(_Cache):
    """A cache that also asks for what addresses of arrays mean."""

    def __init__(self, dispatcher: Any, arrays: Memory) -> None:
        super().__init__(dispatcher)
        self._arrays = arrays

    def _variant(self) -> tuple[str, ...]:
        return *super()._variant(), spelled(self._arrays.kind)


def linked_to(arrays: Memory) -> Callable[[F], F]:
    """Compile for calls with an address, by which the function finds its arrays."""

    def decorate(function: F) -> F:
        dispatcher: Any = compiled(function)
        dispatcher._cache = _LinkedCache(dispatcher, arrays)
        return cast(F, dispatcher)

    return decorate


def link(function: Callable[..., Any], result: Any, *arguments: Any) -> int:
    """Compile for arguments of the given types and say where the machine code stands.

    The caller keeps ``function`` alive for as long as the address is used.
    """
    return placed(function, result, arguments)


def link_like(function: Callable[..., Any], result: Any, *arguments: Any) -> int:
    """The same for arguments like these."""
    return link(function, result, *map(typeof, arguments))


def _calling(result: Any) -> Any:
    """Function for compiled code, ``f(address, (argument, ...))``; the arguments have the types of the tuple."""

    def primitive(typing: Any, where: Any, arguments: Any) -> Any:
        kinds = tuple(types.unliteral(kind) for kind in arguments.types)

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            parts = [
                context.cast(builder, builder.extract_value(values[1], k), given, kind)
                for k, (given, kind) in enumerate(zip(arguments.types, kinds, strict=True))
            ]
            pointer = context.call_conv.get_function_type(result, kinds).as_pointer()
            function = builder.inttoptr(values[0], pointer)
            _, answer = context.call_conv.call_function(builder, function, result, kinds, parts)
            return context.get_dummy_value() if result is types.none else answer

        return result(types.int64, arguments), generate

    return _primitive(primitive)


run = _calling(types.none)
"""Call a function that returns nothing."""

holds = _calling(types.boolean)
"""Call a function that returns a truth value."""

number = _calling(types.float64)
"""Call a function that returns a float."""


# ---------------------------------------------------------------- arrays by one address

LAYOUT = ("meminfo", "parent", "nitems", "itemsize", "data", "shape", "strides")


class Memory:
    """Tuples of tuples and arrays, all of one type, that compiled code finds by an address.

    Attributes:
        kind: their Numba type, that of the first ones described.
    """

    def __init__(self) -> None:
        """Nothing is described yet."""
        self.kind: Any = None
        self._known: list[object] = []  # the layouts that were last found to be of that type

    def __repr__(self) -> str:
        """The same in every process, since fingerprints of functions have it; the kind is a part of their keys."""
        return "Memory"

    def describe(self, arrays: Any) -> IntArray:
        """(words,) what Numba would keep in memory; without owner, so that nobody counts references.

        The caller keeps the arrays and the words alive.

        Raises:
            UnifgError: the arrays have other types than the first ones, or this version of Numba describes arrays in
                another way.
        """
        words: list[int] = []
        layouts: list[object] = []
        _describe(arrays, words, layouts)
        if layouts != self._known:  # Numba takes milliseconds to name the type
            found = tuple(default_manager[types.Array(types.float64, 1, "C")]._fields)
            if found != LAYOUT:
                raise UnifgError(f"Numba describes arrays by {found}, expected {LAYOUT}: use a version up to 0.68")
            kind = typeof(arrays)
            if self.kind is None:
                self.kind = kind
            if kind != self.kind:
                raise UnifgError(f"compiled for arrays of type {self.kind}, found {kind}")
            self._known = layouts
        return np.array(words, dtype=np.int64)


def _describe(part: Any, words: list[int], layouts: list[object]) -> None:
    """Append the words of all arrays in a part, and all that their Numba types depend on."""
    if isinstance(part, tuple):
        layouts += type(part), len(part)
        for item in part:
            _describe(item, words, layouts)
    else:
        flags = part.flags
        layouts += part.dtype, part.ndim, flags.c_contiguous or flags.num, flags.writeable, flags.aligned
        words += 0, 0, part.size, part.itemsize, part.ctypes.data, *part.shape, *part.strides


memory = Memory()
linked = linked_to(memory)


def all_of(arrays: Memory) -> Any:
    """Function for compiled code: everything that is described at an address."""

    def primitive(typing: Any, where: Any) -> Any:
        kind = arrays.kind

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return builder.load(builder.inttoptr(values[0], context.get_value_type(kind).as_pointer()))

        return kind(types.int64), generate

    return _primitive(primitive)


@_primitive
def parts(typing: Any, where: Any, names: Any) -> Any:
    """Some of the arrays, or tuples of arrays, that are described at an address, by their names with blanks between."""
    tuples = memory.kind.types
    places = []
    for name in names.literal_value.split():
        first = next(k for k, kind in enumerate(tuples) if name in kind.fields)
        places.append((first, tuples[first].fields.index(name)))
    kinds = types.Tuple([tuples[first].types[second] for first, second in places])

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        pointer = builder.inttoptr(values[0], context.get_value_type(memory.kind).as_pointer())
        found = [builder.load(cgutils.gep_inbounds(builder, pointer, 0, *place)) for place in places]
        return context.make_tuple(builder, kinds, found)

    return kinds(types.int64, names), generate
