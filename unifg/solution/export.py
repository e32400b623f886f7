"""``prepared.export(folder)``: a prepared solver as a C function, for programs without Python."""

from __future__ import annotations

import logging
import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from unifg.atomic_write import write_atomically
from unifg.codegen.standalone import NO_ROOM, Entry, object_code
from unifg.errors import BackendError, UnifgError
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.python_parts import python_parts
from unifg.solution.status import Status
from unifg.typing import Array

logger = logging.getLogger("unifg")

REPORT = ("status", "iterations", "cost", "multiplier_size", "stationarity", "violation", "complementarity")
REFUSED = -1
"""Answer of a solver that does not begin."""
OTHERS = {
    REFUSED: ("REFUSED", "Not solved: data hold NaN, a guess is not finite, or a quaternion is not of norm 1."),
    NO_ROOM: ("NO_ROOM", "The workspace had no room for arrays of compiled functions: please report it."),
}
HEADER = """\
/* {name}: a solver written by unifg, for {processor}.
 *
 * All arrays are doubles, those of several axes row by row (the last axis runs fastest). Data and residuals have the
 * units the graph was written in; angles of manifolds are in rad, quaternions of norm 1.
 *
 * Data, in this order:
{data}
 *
 * Values of variables (guess and answer), in this order:
{values}
 *
 * Multipliers, one for each row of the constraints, positive at an upper limit; zeros are a guess:
{multipliers}
 */
#ifndef {upper}_H
#define {upper}_H

#ifdef __cplusplus
extern "C" {{
#endif

enum {{
{sizes}
}};

/* Status of an answer. */
enum {{
{statuses}
}};

/* Places in a report. */
enum {{
{report}
}};

/* Data of the last solve before the export, its answer and the multipliers there: a start for the first call. */
extern const double {name}_data[], {name}_values[], {name}_multipliers[];

/* Solve once; returns the status.
 *
 * guess and answer may be the same array, and so may both arrays of multipliers.
 * report: {upper}_REPORT numbers, see above.
 * workspace: {upper}_WORKSPACE bytes at a multiple of 64. Its first 8 bytes are zero before the first call. It belongs
 *     to one call at a time: each thread brings its own.
 */
int {name}_solve(const double *data, const double *guess, const double *guess_multipliers, double *answer,
                 double *multipliers, double *report, void *workspace);

#ifdef __cplusplus
}}
#endif

#endif
"""


class Exported(NamedTuple):
    """A solver's loop for one instance.

    Attributes:
        entry: takes data, guesses of values and multipliers, room for both of the answer, and a report as in REPORT.
        statuses: of the words of an answer.
        values, multipliers: of the last one.
    """

    entry: Entry
    statuses: Mapping[int, Status]
    values: Array
    multipliers: Array


class Exportable(Protocol):
    """Prepared solver, :class:`unifg.solution.solver.Prepared`."""

    program: CompiledProblem

    def entry(self) -> Exported:
        """The solver's."""


def export(prepared: Exportable, folder: Path, name: str, target: str) -> list[Path]:
    """Write header, object file and shared object; arguments and errors as of ``Prepared.export``."""
    program = prepared.program
    if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
        raise BackendError(f"'{name}' is no name in C: letters, digits and underscores")
    parts = python_parts(program)
    if program.binding.rows({}, 1) is None:
        parts.append("data that are booleans, or elements of a manifold with conditions of its own")
    if parts:
        raise BackendError(f"this graph is not exported, because Python has a part in a solve: {'; '.join(parts)}")
    found = prepared.entry()
    data = np.concatenate([np.zeros(0), *(value.ravel() for value in program.binding.present.values())])
    constants = {"data": data, "values": found.values, "multipliers": found.multipliers}
    try:
        code, workspace = object_code(name, found.entry, program.table.sources, constants, target)
    except RuntimeError as error:
        raise BackendError(f"no code can be generated for '{target}': {error}") from error
    except UnifgError as error:
        raise BackendError(f"this graph is not exported: {error}") from error
    folder.mkdir(parents=True, exist_ok=True)
    header, made = folder / f"{name}.h", folder / f"{name}.o"
    write_atomically(header, _header(name, program, found, workspace, target))
    write_atomically(made, code)
    return [header, made] if target else [header, made, *_linked(made, folder / f"lib{name}.so")]


def _header(name: str, program: CompiledProblem, found: Exported, workspace: int, target: str) -> str:
    """The header in C."""
    upper, columns, data = name.upper(), program.columns, program.binding.present
    statuses = {word: (status.name, status.value) for word, status in found.statuses.items()} | OTHERS
    sizes = {"DATA": sum(value.size for value in data.values()), "VALUES": columns.stored}
    sizes |= {"MULTIPLIERS": len(program.lower), "REPORT": len(REPORT), "WORKSPACE": workspace}
    families = [(f.name, (f.count, f.manifold.storage), f.manifold.name) for f in columns.families]
    return HEADER.format(
        name=name,
        upper=upper,
        processor=target or "the processor it was exported on",
        data=_places([(handle.name, value.shape, "") for handle, value in data.items()]),
        values=_places(families),
        multipliers=_places([(term, shape, "factors and rows") for term, _, shape in program.places]),
        sizes=_words(upper, [(word, size, "") for word, size in sizes.items()]),
        statuses=_words(upper, [(word, k, f"  /* {text} */") for k, (word, text) in statuses.items()]),
        report=_words(upper, [(word.upper(), k, "") for k, word in enumerate(REPORT)]),
    )


def _places(parts: Iterable[tuple[str, tuple[int, ...], str]]) -> str:
    """Lines of a comment: names, which cannot end it, places and shapes of arrays side by side."""
    lines, first = [], 0
    for name, shape, what in parts:
        last, plain = first + int(np.prod(shape)), " ".join(name.split()).replace("*/", "* /").replace("/*", "/ *")
        lines.append(f" *   {first}..{last - 1}: {plain}, {' x '.join(map(str, shape)) or 'a number'} {what}".rstrip())
        first = last
    return "\n".join(lines) or " *   none"


def _words(upper: str, words: Iterable[tuple[str, int, str]]) -> str:
    """Lines of an enumeration: words, numbers and comments."""
    return "\n".join(f"  {upper}_{word} = {value},{comment}" for word, value, comment in words)


def _linked(made: Path, shared: Path) -> list[Path]:
    """Link a shared object, where there is a compiler."""
    compiler = shutil.which(os.environ.get("CC", "cc"))
    command = [compiler or "cc", "-shared", "-o", str(shared), str(made), "-lm"]
    if compiler is None:
        logger.warning("no C compiler is here: link it where there is one, by %s", " ".join(command))
        return []
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        raise BackendError(f"{' '.join(command)} failed: {ended.stderr.strip()}")
    return [shared]
