"""Functions written instruction by instruction, callable like any that Numba has compiled.

They take contiguous float arrays and return nothing, keep Numba's calling convention, and are generated without Numba's
front end: what is straight-line code needs no types to be found. What is written is text in LLVM's language, for an
object of Python for each instruction costs more than generating it.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import llvmlite.binding as binding
from llvmlite import ir
from numba import types
from numba.core.registry import cpu_target

POINTER = str(ir.DoubleType().as_pointer())
"""How LLVM's language spells the address of floats."""
LONG = 20_000  # lines
_MARK = "the body"
_count = itertools.count()
_engines: list[Any] = []  # own the machine code: nothing is ever taken back


class Native:
    """Machine code of one function.

    Attributes:
        address: where it stands, for as long as the process runs.
    """

    def __init__(
        self, name: str, arguments: tuple[Any, ...], body: Sequence[str], declarations: Iterable[str] = ()
    ) -> None:
        """Generate.

        Args:
            name: for profilers.
            arguments: Numba types of the arrays it takes.
            body: instructions. They find the numbers of the k-th array at ``%data<k>`` and the length of its a-th axis
                in ``%shape<k>_<a>``, and leave by the end.
            declarations: of the functions that the body calls, as they stand in a module.
        """
        unique = f"{''.join(c if c.isalnum() else '_' for c in name)}_{next(_count)}"
        head, before, after = _frame(arguments)
        function = "\n".join((head.replace(_MARK, unique), before, *body, after))
        self.address = _generated("\n".join((*declarations, function)), unique)


def number(value: float) -> str:
    """A float as LLVM reads it without loss."""
    return f"0x{struct.unpack('>Q', struct.pack('>d', value))[0]:016x}"


@cache
def _frame(arguments: tuple[Any, ...]) -> tuple[str, str, str]:
    """The lines of a function around its body: its head, what names the arrays, and its return."""
    context = cpu_target.target_context
    module = ir.Module(_MARK, context=ir.Context())
    function = ir.Function(module, context.call_conv.get_function_type(types.none, arguments), _MARK)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    nothing = ir.Constant(ir.IntType(64), 0)
    arrays = context.call_conv.decode_arguments(builder, arguments, function)
    for k, (given, array) in enumerate(zip(arguments, arrays, strict=True)):
        # Read from what was passed: an array put together in memory first costs more than short functions do.
        fields = context.data_model_manager[given]
        builder.gep(builder.extract_value(array, fields.get_field_position("data")), [nothing], name=f"data{k}")
        shape = builder.extract_value(array, fields.get_field_position("shape"))
        for axis in range(given.ndim):
            builder.add(builder.extract_value(shape, axis), nothing, name=f"shape{k}_{axis}")
    builder.comment(_MARK)
    context.call_conv.return_value(builder, context.get_dummy_value())
    head, brace, text = str(function).partition("{")
    before, _, after = text.partition(f"; {_MARK}")
    return head + brace, before, after


@cache
def _machine(level: int) -> Any:
    """What generates code for this processor."""
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(), features=binding.get_host_cpu_features().flatten(), opt=level
    )


def _generated(source: str, name: str) -> int:
    """Generate code; the address of the function.

    No optimiser runs: what is written states nothing twice and has nothing to move. The second level of code generation
    gives code no quicker than the first, the lowest four times slower code ten times sooner, which serves functions so
    long that the first takes seconds.
    """
    module = binding.parse_assembly(source)
    module.triple = binding.get_default_triple()
    machine = _machine(0 if source.count("\n") > LONG else 1)
    module.data_layout = str(machine.target_data)
    engine = binding.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    _engines.append(engine)
    return int(engine.get_function_address(name))
