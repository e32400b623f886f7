"""Errors of compiled code that is read from files: who reads it provides them, so that no file says what is raised.

Numba's compiled code returns the address of a record that describes an error. In code that comes with the library these
records are symbols from outside, one for each class of errors.
"""

from __future__ import annotations

import ctypes
import hashlib
import pickle
import re

from llvmlite import binding as llvm

from unifg.errors import UnifgError

PREFIX = "unifg_raise_"
MESSAGES: dict[type[Exception], str] = {
    MemoryError: "a compiled function could not allocate an array",
    ValueError: "a compiled function was given arrays of other sizes than it takes",
    AssertionError: "an assertion of a compiled function does not hold",
    IndexError: "a compiled function reached beyond the end of a list",
    NotImplementedError: "a compiled function was given an array in another order than it takes",
}
_RECORD = re.compile(
    r'^@"?(\.const\.picklebuf\.[\w.]+)"? = [^@]*@"?(\.const\.pickledata\.[\w.]+?)"?, .*\n', re.MULTILINE
)
_DATA = re.compile(r'^@"?(\.const\.pickledata\.[\w.]+)"? = .*\n', re.MULTILINE)
_TYPE = "{ ptr, i32, ptr, ptr, i32 }"


class _Record(ctypes.Structure):
    _fields_ = [
        ("data", ctypes.c_char_p),
        ("length", ctypes.c_int32),
        ("digest", ctypes.c_char_p),
        ("function", ctypes.c_void_p),
        ("allocated", ctypes.c_int32),
    ]


def _provided() -> list[_Record]:
    """Make the symbols known to the linker, for as long as the records are kept."""
    records = []
    for kind, message in MESSAGES.items():
        data = pickle.dumps((kind, (message,), None))
        record = _Record(data, len(data), hashlib.sha1(data, usedforsecurity=False).digest(), None, 0)
        llvm.add_symbol(PREFIX + kind.__name__, ctypes.addressof(record))
        records.append(record)
    return records


_records = _provided()


def without_errors(text: str) -> str:
    """Code in LLVM's language whose records of errors are symbols from outside.

    Raises:
        UnifgError: it raises an error of another class, or one with numbers of its own.
    """
    names = {kind.__name__ for kind in MESSAGES}
    data = {match[1]: match[0] for match in _DATA.finditer(text)}
    records = {
        match[1]: next((n for n in names if f"{n}\\94" in data[match[2]]), match[2]) for match in _RECORD.finditer(text)
    }
    wrong = set(records.values()) - names
    if wrong:
        raise UnifgError(f"raises something else: {data[min(wrong)][-200:]}")
    text = _DATA.sub("", _RECORD.sub("", text))
    if "@.const.pickledata" in text:
        raise UnifgError("raises errors with numbers of their own, as for slices of other sizes")
    for record in sorted(records, key=len, reverse=True):
        text = re.sub(rf'@"?{re.escape(record)}"?(?![\w.])', f"@{PREFIX}{records[record]}", text)
    declared = [f"@{PREFIX}{name} = external constant {_TYPE}\n" for name in sorted(set(records.values()))]
    head, mark, rest = text.partition("\ntarget triple")
    line, _, rest = rest.partition("\n")
    return f"{head}{mark}{line}\n{''.join(declared)}{rest}"
