"""Compiled code for programs without Python: one object file with machine code, arrays and a C function.

Compiled functions work on arrays that refer to each other by addresses. An image of these arrays is a constant of the
object file. The C function copies the image to memory of its caller, the workspace, once, and writes the addresses of
that workspace and of the functions of the object where Python's stood. Functions reach nothing beside it: two threads
with two workspaces share nothing that is written to.

An array that a function allocates is taken from the end of the workspace, which is empty again when no such array is
in use.
"""

from __future__ import annotations

import ctypes
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import binding as llvm

from unifg.codegen.calls import code_at
from unifg.codegen.clock import clock
from unifg.codegen.errors import PREFIX
from unifg.codegen.native import NAME, Source, number, target_machine
from unifg.codegen.precompiled import MATHEMATICS, leave_out_unused
from unifg.errors import UnifgError
from unifg.typing import Array, IntArray

LINE = 64  # bytes of a line of memory, at which every array begins; the first line of a workspace is that of its words
NO_ROOM = -2
ADDRESSES = 2**32  # integers from here on can only be addresses
OUTSIDE = re.compile(rf"llvm\.(?!x86)|(frexp|ldexp|{MATHEMATICS})$")
ALIASES = re.compile(r"@numba_(frexp|ldexp)\b")
COUNTING = re.compile(r"^define [^\n]*@(NRT_(?:inc|dec)ref)\(.*?^}\n", re.MULTILINE | re.DOTALL)
RAISED = re.compile(rf"^(@{PREFIX}\w+) = external (?:\w+ )*constant (\{{[^}}\n]*\}})", re.MULTILINE)
MEMORY = """
@workspace = thread_local(initialexec) global ptr null
define ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 %align) {{
  %w = load ptr, ptr @workspace
  %used = getelementptr i64, ptr %w, i64 1
  %live = getelementptr i64, ptr %w, i64 2
  %first = load i64, ptr %used
  %more = add i64 %size, 127
  %lines = and i64 %more, -64
  %end = add i64 %first, %lines
  %over = icmp ugt i64 %end, {room}
  br i1 %over, label %short, label %found
short:
  %told = getelementptr i64, ptr %w, i64 3
  store i64 1, ptr %told
  ret ptr null
found:
  store i64 %end, ptr %used
  %before = load i64, ptr %live
  %now = add i64 %before, 1
  store i64 %now, ptr %live
  %place = add i64 %first, {size}
  %header = getelementptr i8, ptr %w, i64 %place
  %data = getelementptr i8, ptr %header, i64 64
  store i64 1, ptr %header
  %p = getelementptr i64, ptr %header, i64 3
  store ptr %data, ptr %p
  %q = getelementptr i64, ptr %header, i64 4
  store i64 %size, ptr %q
  ret ptr %header
}}
define void @NRT_incref(ptr %header) {{
  %none = icmp eq ptr %header, null
  br i1 %none, label %done, label %counted
counted:
  %before = load i64, ptr %header
  %now = add i64 %before, 1
  store i64 %now, ptr %header
  ret void
done:
  ret void
}}
define void @NRT_decref(ptr %header) {{
  %none = icmp eq ptr %header, null
  br i1 %none, label %done, label %counted
counted:
  %before = load i64, ptr %header
  %now = sub i64 %before, 1
  store i64 %now, ptr %header
  %held = icmp ne i64 %now, 0
  br i1 %held, label %done, label %freed
freed:
  %w = load ptr, ptr @workspace
  %live = getelementptr i64, ptr %w, i64 2
  %many = load i64, ptr %live
  %fewer = sub i64 %many, 1
  store i64 %fewer, ptr %live
  %still = icmp ne i64 %fewer, 0
  br i1 %still, label %done, label %empty
empty:
  %used = getelementptr i64, ptr %w, i64 1
  store i64 0, ptr %used
  ret void
done:
  ret void
}}
"""
"""Numba's memory in LLVM's language: words 1 to 3 of a workspace are the bytes and the arrays in use, and a failure.

Numba's description of an allocated array begins with the count of references; the fourth word is its address.
"""
FUNCTION = """
@image = internal constant [{bytes} x i8] c"{image}", align 64
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)
define i32 @{name}_solve({parameters}, ptr %w) {{
  %result = alloca ptr
  %raised = alloca ptr
  %base = ptrtoint ptr %w to i64
  %loaded = ptrtoint ptr @image to i64
  %here = xor i64 %base, %loaded
  %own = xor i64 %here, {mark}
  %found = load i64, ptr %w
  %known = icmp eq i64 %own, %found
  br i1 %known, label %ready, label %begin
begin:
  call void @llvm.memset.p0.i64(ptr %w, i8 0, i64 {size}, i1 0)
  %image = getelementptr i8, ptr %w, i64 {line}
  call void @llvm.memcpy.p0.p0.i64(ptr %image, ptr @image, i64 {bytes}, i1 0)
{placed}
  store i64 %own, ptr %w
  br label %ready
ready:
{given}
  store ptr %w, ptr @workspace
  %short = getelementptr i64, ptr %w, i64 3
  store i64 0, ptr %short
  %argument = add i64 %base, {argument}
  call i32 @f0(ptr %result, ptr %raised, i64 %argument)
  %failed = load i64, ptr %short
  %missing = icmp ne i64 %failed, 0
  %word = load double, ptr %p{report}
  %answer = fptosi double %word to i32
  %told = select i1 %missing, i32 {short}, i32 %answer
  ret i32 %told
}}
"""


class Entry(NamedTuple):
    """A compiled function of one address, and all that it works on.

    Attributes:
        function: its address.
        argument: array whose address it takes.
        arrays: that are worked on, in tuples of tuples; those that overlap here overlap there.
        addressing: those with addresses of functions and of other arrays, the argument among them.
        blank: those that begin with zeros.
        given: arrays that the caller of the C function provides, in this order; the last begins with the word of the
            answer.
        room: bytes for arrays that functions allocate; the answer is NO_ROOM where these do not suffice.
    """

    function: int
    argument: IntArray
    arrays: Any
    addressing: Sequence[Any]
    blank: Sequence[Any]
    given: Sequence[Any]
    room: int


def arrays_in(part: Any) -> Iterator[Any]:
    """All arrays of tuples of tuples."""
    if isinstance(part, tuple):
        for item in part:
            yield from arrays_in(item)
    else:
        yield part


class Layout:
    """Places of arrays in a workspace.

    Attributes:
        image: what a workspace begins with, behind its first line.
        size: bytes, without what functions allocate.
    """

    def __init__(self, entry: Entry) -> None:
        """Place blocks that keep their numbers before those that begin with zeros."""
        blanks, given = ({array.ctypes.data for array in part if array.size} for part in (entry.blank, entry.given))
        spans = sorted(
            (first, first + array.nbytes, first in blanks)
            for array in {id(array): array for array in (*arrays_in(entry.arrays), *entry.addressing)}.values()
            if array.size and (first := array.ctypes.data) not in given
        )
        blocks: list[tuple[int, int, bool]] = []
        for first, last, blank in spans:
            if blocks and first < blocks[-1][1]:
                before = blocks.pop()
                first, last, blank = before[0], max(last, before[1]), blank and before[2]
            blocks.append((first, last, blank))
        self._blocks: list[tuple[int, int, int]] = []
        self.image, self.size = bytearray(), LINE
        for first, last, blank in sorted(blocks, key=lambda block: block[2]):
            self._blocks.append((first, last, self.size))
            lines = -((first - last) // LINE) * LINE
            if not blank:
                self.image += ctypes.string_at(first, last - first).ljust(lines, b"\0")
            self.size += lines

    def place(self, address: int) -> int | None:
        """Place of what stands at an address in Python; None where it is no part of the workspace."""
        return next((place + address - first for first, last, place in self._blocks if first <= address < last), None)


def object_code(
    name: str, entry: Entry, sources: Mapping[int, Source], constants: Mapping[str, Array], target: str = ""
) -> tuple[bytes, int]:
    """Object file with the C function ``int <name>_solve(given ..., workspace)``, and the bytes of its workspace.

    Args:
        name: of the function, with ``_solve`` added.
        entry: what it runs.
        sources: functions that Numba has not compiled, by their addresses.
        constants: arrays of the object file, by what is added to its name.
        target: triple of a processor; empty for this one.

    Raises:
        UnifgError: code or arrays refer to something that a program without Python does not have.
    """
    layout, machine = Layout(entry), target_machine(target)
    functions, placed = {entry.function: 0}, []
    arrays = list(arrays_in(entry.arrays))
    empty = {clock(), *(array.ctypes.data for array in (*arrays, *entry.given) if not array.size)}  # time is not taken
    provided = {a.ctypes.data: k for k, a in enumerate(entry.given) if a.size}
    given = [f"  %p{k} = getelementptr i8, ptr %g{k}, i64 0" for k in range(len(entry.given))]
    bounds = [(array.ctypes.data, array.ctypes.data + array.nbytes) for array in entry.addressing]
    for array in arrays:
        inside = any(first <= array.ctypes.data < last for first, last in bounds)
        if not inside and any(abs(value) >= ADDRESSES for _, value in _integers(array)):
            raise UnifgError(f"an array of {array.shape} integers holds addresses where none are expected")
    for k, (address, value) in enumerate(w for array in entry.addressing for w in _integers(array) if w[1]):
        place, found = layout.place(address), layout.place(value)
        assert place is not None
        there = f"  %t{k} = getelementptr i8, ptr %w, i64 {place}"
        if value in provided:
            given += [there, f"  store ptr %g{provided[value]}, ptr %t{k}"]
        elif found is not None:
            placed += [there, f"  %a{k} = getelementptr i8, ptr %w, i64 {found}", f"  store ptr %a{k}, ptr %t{k}"]
        elif value in sources or code_at(value) is not None:
            placed += [there, f"  store ptr @f{functions.setdefault(value, len(functions))}, ptr %t{k}"]
        elif value not in empty and abs(value) < ADDRESSES:
            continue
        elif value not in empty:
            raise UnifgError(f"address {value:#x} is that of no function and no array that is known")
        layout.image[place - LINE : place - LINE + 8] = bytes(8)
    image = bytes(layout.image)  # a workspace knows its place, this layout, and where the object is loaded
    mark = int.from_bytes(hashlib.sha256(image + repr((placed, given)).encode()).digest()[:7], "little")
    text = MEMORY.format(room=entry.room, size=layout.size) + FUNCTION.format(
        name=name, bytes=len(image), image="".join(f"\\{byte:02x}" for byte in image), mark=mark, line=LINE,
        size=layout.size, placed="\n".join(placed), given="\n".join(given), report=len(entry.given) - 1,
        parameters=", ".join(f"ptr %g{k}" for k in range(len(entry.given))), short=NO_ROOM,
        argument=layout.place(entry.argument.ctypes.data),
    )  # fmt: skip
    text += "declare i32 @f0(ptr, ptr, i64)\n" + "".join(f"declare void @f{k}()\n" for k in range(1, len(functions)))
    for what, array in constants.items():
        numbers = ", ".join(f"double {number(value)}" for value in array.tolist())
        text += f"@{name}_{what} = constant [{array.size} x double] [{numbers}]\n"
    context = llvm.create_context()
    whole = _parsed(text, context, machine)
    for address, k in functions.items():
        whole.link_in(_function(address, f"f{k}", sources, context, machine, target))
    _keep_alone(whole, {f"{name}_{what}" for what in ("solve", *constants)}, machine)
    wanted = [part.name for part in (*whole.functions, *whole.global_variables) if part.is_declaration]
    if unknown := [symbol for symbol in wanted if not OUTSIDE.match(symbol)]:
        raise UnifgError(f"compiled code expects {', '.join(sorted(unknown))}, which is a part of Python or of Numba")
    return bytes(machine.emit_object(whole)), layout.size + entry.room


def _function(address: int, name: str, sources: Mapping[int, Source], context: Any, machine: Any, target: str) -> Any:
    """Module of the function at an address under another name, and what it calls hidden from other modules."""
    if (source := sources.get(address)) is not None:
        module, own = source.module(context, target_machine(target, source.level)), NAME
        if source.level == 0:
            for attribute in ("optnone", "noinline"):
                module.get_function(own).add_function_attribute(attribute)
    else:
        found = code_at(address)
        if found is None:
            raise UnifgError("a compiled function is gone: keep the prepared solver that is exported")
        text, own = ALIASES.sub(r"@\1", str(found[0])), found[1]
        text = COUNTING.sub(r"declare void @\1(ptr)\n", text)
        module = _parsed(RAISED.sub(r"\1 = internal constant \2 zeroinitializer", text), context, machine)
    _keep_alone(module, {own}, machine)
    module.get_function(own).name = name
    return module


def _parsed(text: str, context: Any, machine: Any) -> Any:
    """Module for a processor."""
    module = llvm.parse_assembly(text, context)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    return module


def _keep_alone(module: Any, names: set[str], machine: Any) -> None:
    """Hide all but some symbols, and leave out what nothing refers to."""
    for part in (*module.functions, *module.global_variables):
        if not part.is_declaration:
            part.linkage = llvm.Linkage.external if part.name in names else llvm.Linkage.internal
    leave_out_unused(module, machine)


def _integers(array: Any) -> Iterator[tuple[int, int]]:
    """Address and value of every integer of 64 bits in an array, of records in their fields."""
    first, kind = array.ctypes.data, array.dtype
    fields = [(array[name], kind.fields[name][1]) for name in kind.names] if kind.names else [(array, 0)]
    for part, offset in fields:
        if part.dtype == np.int64:
            places = range(first + offset, first + offset + array.nbytes, kind.itemsize)
            yield from zip(places, part.ravel().tolist(), strict=True)
