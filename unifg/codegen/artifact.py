"""Compiled functions as plain data: machine code, what other functions link, and a header in JSON.

Nothing that is read runs: types are rebuilt from words, what Python needs to call a function is generated anew. A file
holds the digest of the rest, the header, the machine code and the code to link.
"""

from __future__ import annotations

import json
import struct
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from llvmlite import binding as llvm
from numba import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.funcdesc import FunctionDescriptor
from numba.core.lowering import Environment
from numba.core.runtime import rtsys
from numba.np.numpy_support import as_dtype, from_dtype

from unifg.codegen.dispatcher import LINKED, PYTHON, linked_code
from unifg.errors import UnifgError

LINKED_MANY_TIMES = "linkonce_odr"
_SCALARS = {
    str(kind): kind for kind in (types.none, types.boolean, types.int32, types.int64, types.uint8, types.float64)
}


class Artifact(NamedTuple):
    """A compiled function.

    Attributes:
        header: its symbol, names of its environment and arguments, its result, what the environment holds and the use.
        code: object code; none for functions that callers link.
        linkable: bitcode for functions that call it.
    """

    header: dict[str, Any]
    code: bytes
    linkable: bytes

    def packed(self) -> bytes:
        """All of it as bytes."""
        header = json.dumps(self.header).encode()
        return struct.pack("<2Q", len(header), len(self.code)) + header + self.code + self.linkable

    @classmethod
    def unpacked(cls, content: bytes) -> Artifact:
        """The same from bytes.

        Raises:
            UnifgError: they are of another form.
        """
        try:
            header, code = struct.unpack_from("<2Q", content)
            first = struct.calcsize("<2Q")
            found = json.loads(content[first : first + header])
        except (struct.error, ValueError) as error:
            raise UnifgError(f"a kept function is of another form: {error}") from error
        return cls(found, content[first + header : first + header + code], content[first + header + code :])


class _Kept(JITCodeLibrary):  # type: ignore[misc]
    """Machine code from a file; what a caller links is parsed when one is compiled, which seldom happens."""

    def __init__(self, codegen: Any, artifact: Artifact, symbols: tuple[str, ...]) -> None:
        """Hand the code to the engine; `symbols` are those it has."""
        super().__init__(codegen, artifact.header["symbol"])
        self._linkable = artifact.linkable
        self.enable_object_caching()
        self._set_compiled_object(artifact.code)
        self._finalize_final_module()
        codegen._engine._defined_symbols.update(symbols)

    def _get_module_for_linking(self) -> Any:
        self._shared_module: Any = self._shared_module or llvm.parse_bitcode(self._linkable)
        return self._shared_module


def header_of(result: Any, use: int) -> dict[str, Any] | None:
    """Header of what Numba has compiled; None where its types or its environment have no plain form."""
    described, environment = result.fndesc, result.environment
    try:
        return {
            "use": use,
            "symbol": described.mangled_name,
            "name": described.unique_name,
            "environment": described.env_name,
            "arguments": list(described.args),
            "result": _words(result.signature.return_type),
            "held": [_described(np.dtype(constant)) for constant in environment.consts],
        }
    except (TypeError, UnifgError):
        return None


def rebuilt(target: Any, artifact: Artifact, function: FunctionType, arguments: tuple[Any, ...]) -> Any:
    """Numba's result of a compilation, ready to run.

    Args:
        target: context.
        artifact: the function.
        function: in Python.
        arguments: types.

    Raises:
        ValueError, KeyError, TypeError: the header is of another form.
    """
    described, environment = _described_function(artifact.header, function, arguments)
    if not environment.consts:
        environment.consts.extend(_dtype(held) for held in artifact.header["held"])
    use = artifact.header["use"]
    if use == LINKED:
        target = target.subtarget(codegen=linked_code)
    symbols = (artifact.header["symbol"], described.llvm_cpython_wrapper_name)[:use]
    library = _Kept(target.codegen(), artifact, symbols)
    parts = {
        "target_context": target, "typing_context": target.typing_context, "library": library,
        "environment": environment, "entry_point": target.get_executable(library, described, environment),
        "fndesc": described, "type_annotation": "", "signature": described.restype(*arguments), "objectmode": False,
        "lifted": (), "reload_init": (), "referenced_envs": (),
    }  # fmt: skip
    return CompileResult(*map(parts.get, CompileResult._fields))


def finished(
    target: Any, header: dict[str, Any], text: str, function: FunctionType, arguments: tuple[Any, ...], use: int
) -> Artifact:
    """Generate what a use needs: machine code for this processor, and what Python calls.

    Args:
        target: context.
        header: of an artifact.
        text: LLVM's language, optimised.
        function: in Python.
        arguments: types.
        use: of the function.
    """
    codegen = target.codegen()
    module = llvm.parse_assembly(text)
    held: list[Any] = []
    if use == PYTHON:
        described, environment = _described_function(header, function, arguments)
        environment.consts.clear()
        wrapper = codegen.create_library("wrapper")
        counted = target.subtarget(enable_nrt=True)  # arrays are handed over with their counts of references
        counted.create_cpython_wrapper(wrapper, described, environment, None, release_gil=True)
        wrapper._final_module.link_in(rtsys.library._get_module_for_linking(), preserve=True)
        wrapper._optimize_final_module()
        held = [_described(np.dtype(constant)) for constant in environment.consts]
        module.link_in(wrapper._final_module)
    shared = module.clone()
    for defined in shared.functions:
        if not defined.is_declaration and defined.linkage == llvm.Linkage.external:
            defined.linkage = LINKED_MANY_TIMES
    code = b"" if use == LINKED else codegen._tm.emit_object(module)
    return Artifact({**header, "held": held, "use": use}, code, shared.as_bitcode())


def _described_function(
    header: dict[str, Any], function: FunctionType, arguments: tuple[Any, ...]
) -> tuple[FunctionDescriptor, Environment]:
    """Numba's description of a function, and its environment."""
    described = FunctionDescriptor(
        True, function.__module__, function.__qualname__, header["name"], "", None, _type(header["result"]), None,
        header["arguments"], (), mangler=lambda *_, **__: header["symbol"], argtypes=arguments,
        env_name=header["environment"],
    )  # fmt: skip
    return described, Environment.from_fndesc(described)


def _words(kind: Any) -> Any:
    """A type as JSON."""
    if str(kind) in _SCALARS:
        return str(kind)
    if isinstance(kind, types.Optional):
        return {"optional": _words(kind.type)}
    if isinstance(kind, types.Tuple | types.UniTuple):
        return {"tuple": [_words(part) for part in kind.types]}
    if isinstance(kind, types.Array):
        return {"array": _described(as_dtype(kind.dtype)), "axes": kind.ndim, "layout": kind.layout}
    raise UnifgError(f"a compiled function that returns {kind} is kept in no file")


def _type(words: Any) -> Any:
    """The type."""
    if isinstance(words, str):
        return _SCALARS[words]
    if "optional" in words:
        return types.Optional(_type(words["optional"]))
    if "tuple" in words:
        return types.Tuple([_type(part) for part in words["tuple"]])
    return types.Array(from_dtype(_dtype(words["array"])), words["axes"], words["layout"])


def _described(dtype: np.dtype[Any]) -> Any:
    """A dtype as JSON."""
    return dtype.str if dtype.names is None else {"fields": [[name, dtype[name].str] for name in dtype.names]}


def _dtype(words: Any) -> np.dtype[Any]:
    """The dtype."""
    if isinstance(words, str):
        return np.dtype(words)
    return np.dtype([(name, kind) for name, kind in words["fields"]], align=True)
