"""Exported solvers called in C, beside the compiled part of the same solves in Python."""

from __future__ import annotations

import ctypes
import re
import tempfile
import time
from collections.abc import Sequence

import numpy as np

import unifg as fg
from benchmarks.report import table
from benchmarks.runner import Timing
from benchmarks.timing import clocked, number
from problems.around_a_disc import around_a_disc
from problems.control import Problem, Quadrotor
from unifg.solvers import InteriorPoint
from unifg.typing import Array

CASES: tuple[Problem | None, ...] = (None, Quadrotor("goto", False, 20), Quadrotor("goto", True, 20))
STARTS = 8
Case = tuple[str, fg.Graph, fg.Guess, list[dict[fg.Data, Array]]]


def readme() -> Case:
    """README's first graph, with its start as data."""
    graph, guess, start = around_a_disc()
    starts = 0.1 * np.random.default_rng(0).standard_normal((STARTS, 3))
    return "README, N = 20", graph, fg.Guess(guess), [{start: one} for one in starts]


def stated(case: Problem) -> Case:
    """A control case with starts beside its own."""
    form, rng = case.formulation(), np.random.default_rng(0)
    steps = 0.1 * rng.standard_normal((STARTS, case.manifold.dim))
    starts = case.manifold.retract(np.tile(case.start, (STARTS, 1)), steps)
    return case.title, form.graph, form.guess, [form.data(start, 0) for start in starts]


def measure(case: Problem | None, rounds: int) -> tuple[str, ...]:
    """A row of the table: calls in C and solves in Python by turns."""
    title, graph, guess, each = readme() if case is None else stated(case)
    prepared = InteriorPoint(tolerance=1e-4).prepare(graph)
    prepared.solve(guess)
    with tempfile.TemporaryDirectory() as folder:
        header, *_, shared = prepared.export(folder)
        size = int(re.findall(r"_WORKSPACE = (\d+)", header.read_text(encoding="utf-8"))[0])
        call = ctypes.CDLL(str(shared)).solver_solve
    values, multipliers, _ = prepared.read(guess)
    arrays = values, multipliers, values.copy(), multipliers.copy(), np.zeros(7), np.zeros(size // 8 + 1)
    handles = prepared.program.binding.present
    in_c, compiled, whole = np.empty((3, rounds, len(each)))
    for place in np.ndindex(rounds, len(each)):
        data = each[place[1]]
        numbers = np.concatenate([np.ravel(data.get(handle, handle.value)) for handle in handles])
        given = [ctypes.c_void_p(array.ctypes.data) for array in (numbers, *arrays)]
        _, in_c[place] = clocked(call, *given, by=time.perf_counter)
        found = prepared.solve(guess, data=data)
        if not np.array_equal(
            arrays[2], np.concatenate([found[family].ravel() for family in prepared.program.families])
        ):
            raise AssertionError(f"{title}: an answer in C differs")
        compiled[place] = sum(part for name, part in found.times.items() if name != "Python")
        whole[place] = found.seconds
    middle: Sequence[Array] = [np.median(spent, axis=0) for spent in (in_c, compiled, whole)]
    shown = (*(1e6 * float(np.median(part)) for part in middle), float(np.median(middle[0] / middle[1])))
    return title, *map(number, shown), number(size / 1e3)


def tables(rounds: int) -> str:
    """All cases."""
    head = "solver", "C, us", "compiled part, us", "solve in Python, us", "C over compiled part", "workspace, kB"
    notes = (
        f"{STARTS} starts, normal deviations of 0.1, cold, tolerance 1e-4; medians of {rounds} rounds, calls in C and "
        "solves in Python by turns. The compiled part is that of `solution.times`. Answers have the bits of Python's."
    )
    return f"{table(head, [measure(case, rounds) for case in CASES], 1)}\n\n{notes}"


STUDY = Timing(tables, 40)
