"""Declared columns in one file that any program with NumPy opens: an ``.npz`` of plain arrays, without pickles.

A column is an array of its name with one row per tick; one of arrays of several lengths is stored end to end, with
their lengths as ``NAME_lengths``; words are an array of text. ``about`` is a JSON text: the units of all columns, and
what was known before the first tick or after the last and is no array.
"""

from __future__ import annotations

import json
import os
import zipfile
from typing import Any

import numpy as np

from unifg.atomic_write import replacing
from unifg.errors import FileFormatError
from unifg.scenarios.log.columns import columns

__all__ = ["load_columns", "save_columns"]


def save_columns(path: str | os.PathLike[str], log: Any, kind: str, known: dict[str, Any]) -> None:
    """Write the columns of a log.

    Args:
        path: file to write.
        log: with declared columns.
        kind: what it is, with the version of its format; :func:`load_columns` asks for the same.
        known: what else there is: arrays, and values that JSON knows.
    """
    arrays: dict[str, Any] = {}
    for name in columns(log):
        values = getattr(log, name)
        if isinstance(values, np.ndarray):
            arrays[name] = values
        elif values and isinstance(values[0], str):
            arrays[name] = np.array(values)
        elif values:
            arrays[name] = np.concatenate(values)
            arrays[f"{name}_lengths"] = np.array([len(part) for part in values], dtype=np.int64)
    arrays |= {name: value for name, value in known.items() if isinstance(value, np.ndarray)}
    rest = {name: value for name, value in known.items() if not isinstance(value, np.ndarray)}
    about = {"kind": kind, "units": {name: column.unit for name, column in columns(log).items()}, **rest}
    with replacing(path) as own, open(own, "wb") as file:  # numpy adds a suffix to a name, not to a file
        np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)


def load_columns(path: str | os.PathLike[str], log: type, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a file written by :func:`save_columns`.

    Args:
        path: of the file.
        log: class whose columns are declared.
        kind: that is asked for.

    Returns:
        Columns by name, and what else was known.

    Raises:
        FileFormatError: if the file is something else, or a column is missing.
    """
    where = os.fspath(path)
    try:
        with open(path, "rb") as own, np.load(own, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        about: dict[str, Any] = json.loads(str(stored.pop("about")))
        if about.pop("kind") != kind:
            raise FileFormatError(f"{where} is no {kind}")
        del about["units"]
        found: dict[str, Any] = {}
        for name in columns(log):
            values = stored.pop(name)
            lengths = stored.pop(f"{name}_lengths", None)
            if lengths is not None:
                found[name] = np.split(values, np.cumsum(lengths)[:-1])
            else:
                found[name] = values.tolist() if values.dtype.kind == "U" else values
    except (KeyError, ValueError, TypeError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{where} is no {kind}: {error}") from error
    return found, {**about, **stored}
