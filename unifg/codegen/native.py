"""Functions written instruction by instruction, callable like any that Numba has compiled.

They take contiguous float arrays and return nothing, keep Numba's calling convention, and are generated without Numba's
front end: what is straight-line code needs no types to be found. What is written is text in LLVM's language, for an
object of Python for each instruction costs more than generating it.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import llvmlite
import llvmlite.binding as binding
import numba
from llvmlite import ir
from numba import types
from numba.core.registry import cpu_target

POINTER = str(ir.DoubleType().as_pointer())
"""Address of floats in LLVM's language."""
LONG = 20_000  # lines
SOURCES = (__file__, str(Path(__file__).with_name("calls.py")))
"""Files that say what is generated."""
_MARK = "the body"
NAME = "derived"  # of every function: each has an engine of its own


class Native:
    """Machine code of one function, which is there for as long as this object is, and no longer.

    Whoever keeps its address keeps this object too, or what keeps it, for as long as a compiled loop that calls it may
    run: such loops do not stop other threads.

    Attributes:
        address: where it stands.
    """

    def __init__(self, code: bytes) -> None:
        """Load.

        Args:
            code: what :func:`generated` returned, in this process or in another one on such a processor.
        """
        # An engine of its own, and in it what generates code, though it will not: an engine takes that along when it
        # goes. Libraries of one engine for all would be loaded sooner, and leave ten kilobytes each behind.
        machine = binding.Target.from_triple(_processor()[0]).create_target_machine()
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
        self._engine.add_object_file(binding.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        self.address = int(self._engine.get_function_address(NAME))

    def __reduce__(self) -> NoReturn:
        """Refuse: in a copy the address would be good for nothing."""
        raise TypeError("machine code is neither copied nor pickled: its owner generates it anew")


class Source(NamedTuple):
    """A function in LLVM's language.

    Attributes:
        text: of its module.
        loops: whether it has any.
    """

    text: str
    loops: bool

    def module(self, context: Any, machine: Any) -> Any:
        """The module, optimised for a processor.

        The optimiser runs only where there are loops, for their vectors: what is written states nothing twice and has
        nothing to move.
        """
        module = binding.parse_assembly(self.text, context)
        module.triple, module.data_layout = machine.triple, str(machine.target_data)
        if self.loops:
            options = binding.create_pipeline_tuning_options(speed_level=2)
            options.loop_vectorization = True
            passes = binding.create_pass_builder(machine, options)
            passes.getModulePassManager().run(module, passes)
        return module

    @property
    def level(self) -> int:
        """Level of code generation.

        The second gives code no quicker than the first, the lowest four times slower code ten times sooner, which
        serves functions so long that the first takes seconds.
        """
        return 0 if self.text.count("\n") > LONG else 1


def source(
    arguments: tuple[Any, ...], body: Sequence[str], declarations: Iterable[str] = (), loops: bool = False
) -> Source:
    """One function.

    Args:
        arguments: Numba types of the arrays it takes.
        body: instructions. They find the numbers of the k-th array at ``%data<k>`` and the length of its a-th axis
            in ``%shape<k>_<a>``, and leave by the end.
        declarations: of the functions that the body calls, as they stand in a module.
        loops: whether the body has any.
    """
    head, before, after = _frame(arguments)
    return Source("\n".join((*declarations, head.replace(_MARK, NAME), before, *body, after)), loops)


def generated(written: Source) -> bytes:
    """Object code of one function for this processor."""
    machine = _machine(written.level)
    with written.module(binding.create_context(), machine) as module:  # numbers stay with a context for ever
        return bytes(machine.emit_object(module))


@cache
def generation() -> str:
    """Digest of what object code depends on, besides the sources of what writes it: versions and the processor."""
    return hashlib.sha256(repr((llvmlite.__version__, numba.__version__, *_processor())).encode()).hexdigest()


def number(value: float) -> str:
    """A float as LLVM reads it without loss."""
    return f"0x{struct.unpack('>Q', struct.pack('>d', value))[0]:016x}"


@cache
def _frame(arguments: tuple[Any, ...]) -> tuple[str, str, str]:
    """The lines of a function around its body: its head, what names the arrays, and its return."""
    context = cpu_target.target_context
    module = ir.Module(_MARK, context=ir.Context())
    function = ir.Function(module, context.call_conv.get_function_type(types.none, arguments), _MARK)
    function.attributes.add("nounwind")  # and no tables for unwinding
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
def _processor() -> tuple[str, str, str]:
    """Target of generated code: triple, name and features, those that Numba is told by its variables if any."""
    name, features = numba.config.CPU_NAME, numba.config.CPU_FEATURES
    return (
        binding.get_default_triple(),
        binding.get_host_cpu_name() if name is None else name,
        binding.get_host_cpu_features().flatten() if features is None else features,
    )


@cache
def _machine(level: int) -> Any:
    """Code generator for this processor."""
    triple, name, features = _processor()
    return binding.Target.from_triple(triple).create_target_machine(cpu=name, features=features, opt=level)


def target_machine(triple: str, level: int = 3) -> Any:
    """Code generator for shared objects; for this processor, or for all of a triple.

    Raises:
        RuntimeError: the triple is unknown.
    """
    own, name, features = _processor()
    if triple:
        binding.initialize_all_targets()
        binding.initialize_all_asmprinters()
        own, name, features = triple, "", ""
    return binding.Target.from_triple(own).create_target_machine(
        cpu=name, features=features, opt=level, reloc="pic", codemodel="default"
    )
