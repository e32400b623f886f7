"""BLAS and LAPACK inside SciPy's wheel, called by address from compiled code.

The addresses travel as integers in an array, so compiled code that calls through them may be cached on disk.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import scipy.linalg.cython_blas
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from unifg.typing import IntArray

GEMM, SYRK, TRSM = range(3)
# Letters of the Fortran interface, as the numbers their first byte stands for.
LOWER, LEFT, RIGHT, PLAIN, TRANSPOSED, GENERAL = (ord(letter) for letter in "LLRNTN")


def routines() -> IntArray:
    """Addresses of dgemm, dsyrk, dtrsm."""
    name = ctypes.pythonapi.PyCapsule_GetName
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    capsules = scipy.linalg.cython_blas.__pyx_capi__
    return np.array([pointer(capsules[k], name(capsules[k])) for k in ("dgemm", "dsyrk", "dtrsm")], dtype=np.int64)


def _fortran(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call the subroutine at an address with a tuple of arguments, each by reference.

    Integers become 32-bit integers (characters are their codes), floats doubles; an array passes its first element.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        pointers = []
        for number, kind in enumerate(signature.args[1].types):
            value = builder.extract_value(values[1], number)
            if isinstance(kind, types.Array):
                pointer = context.make_array(kind)(context, builder, value).data
            else:
                if isinstance(kind, types.Integer):
                    value = builder.trunc(value, ir.IntType(32))
                pointer = cgutils.alloca_once_value(builder, value)  # type: ignore[no-untyped-call]
            pointers.append(builder.bitcast(pointer, ir.IntType(8).as_pointer()))
        subroutine = ir.FunctionType(ir.VoidType(), [p.type for p in pointers])
        builder.call(builder.inttoptr(values[0], subroutine.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, arguments), generate


fortran = cast(Callable[[Any, tuple[Any, ...]], None], intrinsic(_fortran))
