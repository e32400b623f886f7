"""Compiled functions that are made ready no further than they are used.

Most functions are called by compiled ones alone, which link their code and optimise it anew: of these neither what
Python needs to call them is made, nor machine code. A quarter of a first compilation went into both. A function that is
asked for more later is compiled again, and its file on disk then serves every use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from types import FunctionType
from typing import Any

from numba.core.codegen import JITCPUCodegen
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.sigutils import normalize_signature

LINKED, ADDRESS, PYTHON = range(3)
"""Uses of a function: by compiled callers, through its address as well, from Python as well."""


class _LinkedCode(JITCPUCodegen):  # type: ignore[misc]
    """Numba's code generator, for modules that are linked into others and run nowhere by themselves."""

    def __init__(self, codegen: JITCPUCodegen) -> None:
        """Share all settings of another one."""
        self.__dict__.update(vars(codegen))

    def _add_module(self, module: Any) -> None:
        """Hand nothing to the engine, which would generate machine code."""

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: constants of Python that stand here are for errors, and kernels raise none."""


@cache
def linked_code() -> Any:
    """Code generator for functions that compiled callers link."""
    return _LinkedCode(cpu_target.target_context.codegen())


class _Pipeline(Compiler):  # type: ignore[misc]
    """Numba's compiler, up to the use that a function is compiled for."""

    def __init__(self, use: Callable[[], int], *arguments: Any) -> None:
        """Prepare like Numba.

        Args:
            use: that the function is compiled for.
            *arguments: of Numba's compiler.
        """
        super().__init__(*arguments)
        self._use = use()

    def compile_extra(self, func: FunctionType) -> Any:
        """Compile a function."""
        self.state.flags.no_cpython_wrapper = self._use < PYTHON
        if self._use == LINKED:
            self.state.library = linked_code().create_library(func.__qualname__)
        return super().compile_extra(func)


class UseDispatcher(CPUDispatcher):  # type: ignore[misc]
    """Numba's dispatcher, which tells its compiler and its cache by whom the function is called.

    Attributes:
        use: that the function is compiled for at the moment.
    """

    def __init__(self, py_func: FunctionType, locals: Any = None, targetoptions: Any = None) -> None:
        """Compile nothing yet."""
        self.use: int = ADDRESS
        super().__init__(py_func, locals, targetoptions, partial(_Pipeline, lambda: self.use))
        self._ready: dict[tuple[Any, ...], int] = {}

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile for a compiled caller."""
        with self._used(LINKED):
            return super().get_call_template(args, kws)

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        with self._used(PYTHON):
            return super()._compile_for_args(*args, **kws)

    def compile(self, sig: Any) -> Any:
        """Compile for the present use, unless that has been done."""
        with global_compiler_lock:
            arguments = tuple(normalize_signature(sig)[0])
            if self._ready.get(arguments, self.use) < self.use:
                del self.overloads[arguments]  # whose code, if any, Numba keeps for those who know its address
            return super().compile(sig)

    def add_overload(self, cres: Any) -> None:
        """Keep what was compiled for the present use."""
        arguments = tuple(cres.signature.args)
        if self.use == PYTHON:
            super().add_overload(cres)
        else:  # unknown to what looks up the types that Python calls with
            self.overloads[arguments] = cres
        self._ready[arguments] = self.use

    @contextmanager
    def _used(self, use: int) -> Iterator[None]:
        with global_compiler_lock:
            before, self.use = self.use, use
            try:
                yield
            finally:
                self.use = before
