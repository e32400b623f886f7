"""A log in one file that any program with NumPy opens: an ``.npz`` of plain arrays, without pickles.

A column is an array of its name with one row per tick; one of arrays of several lengths is stored end to end, with
their lengths as ``NAME_lengths``; words are an array of text. A field that is a dataclass is stored as ``NAME.FIELD``.
``about`` is a JSON text: the kind of the log, the units of all columns, and the fields that are no arrays.
"""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar, Self, get_origin, get_type_hints

import numpy as np

from unifg.atomic_write import replacing
from unifg.errors import FileFormatError, UnifgError
from unifg.scenarios.logs.columns import columns

__all__ = ["StoredLog"]


class StoredLog:
    """Base class of a dataclass with declared columns.

    Attributes:
        KIND: name and version of the file format.
    """

    KIND: ClassVar[str]

    @property
    def ticks(self) -> int:
        """Number of ticks recorded."""
        return len(getattr(self, next(iter(columns(self)))))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one compressed file."""
        declared, arrays, rest = columns(self), dict[str, Any](), dict[str, Any]()
        for name, column in declared.items():
            values = getattr(self, name)
            if column.ragged is not None:
                arrays[f"{name}_lengths"] = np.array([len(part) for part in values], dtype=np.int64)
                values = np.concatenate([column.ragged, *values])
            arrays[name] = np.array(values, dtype=str) if isinstance(values, list) else values
        for name, value in _flattened(self, declared.keys()).items():
            (arrays if isinstance(value, np.ndarray) else rest)[name] = value
        about = {"kind": self.KIND, "units": {name: column.unit for name, column in declared.items()}, **rest}
        with replacing(path) as own, open(own, "wb") as file:  # numpy adds a suffix to a name, not to a file
            np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file written by :meth:`save`.

        Raises:
            FileFormatError: if the file is something else or of another version, or a column is missing.
        """
        where = os.fspath(path)
        try:
            with open(path, "rb") as own, zipfile.ZipFile(own), np.load(own, allow_pickle=False) as file:
                stored = {name: file[name] for name in file.files}
            about: dict[str, Any] = json.loads(str(stored.pop("about")))
            if about.pop("kind") != cls.KIND:
                raise FileFormatError(f"{where} is no {cls.KIND}")
            del about["units"]
            found: dict[str, Any] = {}
            for name, column in columns(cls).items():
                values = stored.pop(name)
                if column.ragged is not None:
                    ends = np.cumsum(stored.pop(f"{name}_lengths"))
                    found[name] = np.split(values, ends[:-1]) if len(ends) else []
                else:
                    found[name] = values.tolist() if values.dtype.kind == "U" else values
            return cls(**found, **_nested(cls, {**about, **stored}))
        except FileFormatError:
            raise
        except (KeyError, ValueError, TypeError, EOFError, OSError, zipfile.BadZipFile, UnifgError) as error:
            raise FileFormatError(f"{where} is no {cls.KIND}: {error}") from error


def _flattened(log: Any, without: Any = ()) -> dict[str, Any]:
    """Fields of a dataclass, those of nested dataclasses as ``NAME.FIELD``."""
    found: dict[str, Any] = {}
    for declared in fields(log):
        if declared.name not in without:
            value = getattr(log, declared.name)
            inner = _flattened(value) if is_dataclass(value) else {"": value}
            found |= {f"{declared.name}.{name}".rstrip("."): part for name, part in inner.items()}
    return found


def _nested(kind: type, flat: dict[str, Any]) -> dict[str, Any]:
    """Fields of a dataclass from those of its file: tuples from lists, dataclasses from ``NAME.FIELD``."""
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        if is_dataclass(hint) and isinstance(hint, type):
            inner = {key.removeprefix(f"{name}."): value for key, value in flat.items() if key.startswith(f"{name}.")}
            found[name] = hint(**_nested(hint, inner))
        elif name in flat:
            found[name] = tuple(flat[name]) if get_origin(hint) is tuple else flat[name]
    if unknown := sorted(key for key in flat if key.partition(".")[0] not in found):
        raise UnifgError(f"no fields of a {kind.__name__}: {', '.join(unknown)}")
    return found
