"""The system's clock in compiled code, through the address of a function of the C library."""

from __future__ import annotations

import ctypes
import time
from functools import cache
from typing import Any

from llvmlite import ir
from numba import types

from unifg.codegen.calls import _primitive

WORD = ir.IntType(64)


@cache
def clock() -> int:
    """Address of ``clock_gettime``; 0 where there is none."""
    try:
        return ctypes.cast(ctypes.CDLL(None).clock_gettime, ctypes.c_void_p).value or 0
    except (OSError, TypeError, AttributeError):
        return 0


@_primitive
def seconds(typing: Any, where: Any) -> Any:
    """Time from some moment on by the clock at an address [s]; 0 without one."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        known = builder.icmp_unsigned("!=", values[0], WORD(0))
        with builder.if_else(known) as (then, otherwise):
            with then:
                moment = builder.alloca(WORD, 2)
                kind = ir.FunctionType(ir.IntType(32), [ir.IntType(32), moment.type])
                function = builder.inttoptr(values[0], kind.as_pointer())
                builder.call(function, [ir.IntType(32)(time.CLOCK_MONOTONIC), moment])
                parts = [builder.load(builder.gep(moment, [WORD(k)])) for k in range(2)]
                whole, rest = (builder.sitofp(part, ir.DoubleType()) for part in parts)
                now = builder.fadd(whole, builder.fmul(rest, ir.DoubleType()(1e-9)))
                read = builder.block
            with otherwise:
                skipped = builder.block
        result = builder.phi(ir.DoubleType())
        result.add_incoming(now, read)
        result.add_incoming(ir.DoubleType()(0.0), skipped)
        return result

    return types.float64(types.int64), generate
