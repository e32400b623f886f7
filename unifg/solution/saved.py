"""Answers in files of NumPy: what ``solution.save(path)`` writes, and their check with the graph alone.

A file holds arrays by name: ``values/FAMILY`` (count, storage), ``multipliers/TERM`` (factors, rows), ``data/NAME`` and
``cost``. Any program may write one.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from unifg.atomic_write import replacing
from unifg.errors import FileFormatError, GraphError
from unifg.modeling.model import Model
from unifg.modeling.variables import Data, Family
from unifg.problem.compiled_problem import CompiledProblem, idle_problem
from unifg.solution.verify import Verified, require_tolerance, verified
from unifg.typing import Array

VALUES, MULTIPLIERS, DATA, COST = "values/", "multipliers/", "data/", "cost"


def write_answer(
    path: str | os.PathLike[str],
    program: CompiledProblem,
    values: Mapping[Family, Array],
    multipliers: Array,
    cost: float,
    data: Mapping[Data, Array],
) -> None:
    """Write an answer; arguments as of :func:`unifg.solution.verify.verified`.

    Raises:
        GraphError: the path is none.
    """
    if not isinstance(path, str | os.PathLike):
        raise GraphError(f"save: the path of a file is expected, found {f'{path!r}'[:80]}")
    arrays: dict[str, Any] = {COST: np.array(cost)}
    arrays |= {VALUES + family.name: own for family, own in values.items()}
    arrays |= {MULTIPLIERS + name: own for name, own in program.by_term(multipliers).items()}
    arrays |= {DATA + handle.name: own for handle, own in data.items()}
    with replacing(path) as own, open(own, "wb") as file:
        np.savez(file, **arrays)


def check_answer(graph: Model, path: str | os.PathLike[str], tolerance: float = 1e-6) -> Verified:
    """Check an answer in a file as :meth:`unifg.Solution.verify` does.

    Data that the file does not hold keep their defaults.

    Raises:
        FileFormatError: it cannot be read, or is no answer of this graph, with the name of what does not fit.
        GraphError: the tolerance is no positive number.
    """
    require_tolerance(tolerance)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            found = {name: stored[name] for name in stored.files}
    except OSError as error:
        raise FileFormatError(f"{os.fspath(path)}: {error.strerror or error}") from error
    except (ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        why = "" if "pickle" in str(error) else f": {error}"  # NumPy advises to load whatever it is
        raise FileFormatError(f"{os.fspath(path)} is no file of arrays as solution.save writes it{why}") from error
    program = idle_problem(graph)

    def take(name: str, shape: tuple[int, ...]) -> Array:
        if name not in found:
            raise FileFormatError(f"{os.fspath(path)} holds no '{name}', of shape {shape} in this graph")
        array = found.pop(name)
        if array.shape != shape or array.dtype.kind not in "bif":
            raise FileFormatError(
                f"{os.fspath(path)}: '{name}' is {array.dtype} of shape {array.shape}, in this graph of shape {shape}, "
                "of real numbers"
            )
        return np.array(array, dtype=np.float64)

    values = {family: take(VALUES + family.name, program.columns.place(family)[1]) for family in program.families}
    parts = [take(MULTIPLIERS + name, shape).ravel() for name, _, shape in program.places]
    data = {
        handle: take(name, own.shape).astype(own.dtype) if (name := DATA + handle.name) in found else handle.value
        for handle, own in program.binding.present.items()
    }
    cost = float(take(COST, ()))
    if found:
        raise FileFormatError(f"{os.fspath(path)} holds '{min(found)}', which is no part of this graph")
    return verified(program, values, np.concatenate([np.zeros(0), *parts]), cost, data, tolerance)
