"""``solution.explain()``: plain sentences from numbers that a solution has anyway."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from time import perf_counter

import numpy as np

from unifg.codegen.inner import inner
from unifg.modeling.soft import SLACK
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.term import CompiledTerm
from unifg.solution.check import dependent, listed, members_of, null_direction
from unifg.solution.conditioning import cheap
from unifg.solution.fit import Fit
from unifg.typing import Array, BoolArray

SMALL = 1e-6  # a multiplier of which nothing is said, relative to the largest one
UNLIKELY = 1e-3  # probability of the largest of all residuals of a term, by its weights
WEAK = 1e-8  # curvature, relative to the diagonal, of a direction that is hardly determined
NOTHING = 1e-13  # of one that is not determined at all
SAVED = 1e-4  # share of the cost
MUCH = 0.1  # share of the time
MOST = 3  # sentences of a kind
COMPARED = 500  # rows whose gradients are compared with each other, at most


def violated(program: CompiledProblem, worst: tuple[str, int] | None, violation: float) -> Iterator[str]:
    """Sentence about the term that an answer without success violates most."""
    if worst is not None and violation > SMALL:
        name, factor = worst
        where = members(_term(program, name), factor)
        yield f"'{name}' is violated most, by {violation:.3g} in factor {factor} ({where})."


def tolerated(
    cost: float, multipliers: Array, constraints: Array, lower: Array, upper: Array, tolerance: float
) -> Iterator[str]:
    """Sentence about the share of the cost that an answer saves by violations within its tolerance.

    Args:
        cost: objective.
        multipliers: (M,).
        constraints: (M,) with limits ``lower`` and ``upper``.
        lower: limits.
        upper: limits.
        tolerance: of the solve; less than a thousandth of it is rounding.
    """
    outside = constraints - constraints.clip(lower, upper)
    saved = inner(multipliers, np.where(np.abs(outside) > 1e-3 * tolerance, outside, 0.0))
    if saved > SAVED * abs(cost):
        yield (
            f"Constraints are violated by up to {np.abs(outside).max():.1g}, within the tolerance: held exactly they "
            f"would add about {saved:.3g} to the cost. Solve with a smaller feasibility_tolerance where that counts."
        )


def members(term: CompiledTerm, factor: int) -> str:
    """Variables of a factor by family and index."""
    chosen = term.term.selections
    return ", ".join(
        f"{s.family.name}[{int(s.indices[factor % len(s)])}]" for s in chosen if SLACK not in s.family.name
    )


def _term(program: CompiledProblem, name: str) -> CompiledTerm:
    return next(term for term in program.terms if term.name == name)


def holding(program: CompiledProblem, multipliers: Array, equality: BoolArray, held: BoolArray) -> Iterator[str]:
    """Constraints that hold the solution, by the largest multiplier of each term.

    Args:
        program: that was solved.
        multipliers: (M,).
        equality: (M,) rows that are equalities.
        held: (M,) those and active inequalities.
    """
    found = []
    sizes = np.where(held, np.abs(multipliers), 0.0)
    for name, rows, _ in program.places:
        sizes[rows] *= not name.endswith(SLACK)
    least = SMALL * max(1.0, float(sizes.max(initial=0.0)))
    for name, rows, (_, size) in program.places:
        row = rows.start + int(sizes[rows].argmax())
        if sizes[row] > least:
            found.append(
                (float(sizes[row]), row, name, divmod(row - rows.start, size), int((sizes[rows] > least).sum()))
            )
    for gain, row, name, (factor, own), count in sorted(found, reverse=True)[:MOST]:
        place = f"factor {factor}, row {own} ({members(_term(program, name), factor)})"
        if equality[row]:
            yield (
                f"The equality '{name}' costs most in {place}: shifted by one of its units in the right direction, it "
                f"would save about {gain:.3g} of the cost."
            )
        else:
            yield (
                f"'{name}' holds the solution in {count} row{'s' if count > 1 else ''}, most in {place}: each unit by "
                f"which its {'upper' if multipliers[row] > 0.0 else 'lower'} limit is loosened saves about {gain:.3g} "
                "of the cost."
            )


def ambiguous(program: CompiledProblem, lin: Linearization, held: BoolArray) -> Iterator[str]:
    """Sentence about rows that hold the solution and say the same as others, so that any of them has the multiplier."""
    rows = np.flatnonzero(held)
    if lin.finite and 0 < len(rows) <= COMPARED and (found := dependent(program, lin, rows)):
        name, factor = program.row_name(found[0])
        yield (
            f"'{name}', factor {factor}, depends on other constraints that hold the solution: their multipliers are "
            "not unique, and loosening one of them alone may save nothing. State each condition once."
        )


def disagreeing(program: CompiledProblem, fit: Fit) -> Iterator[str]:
    """Measurements whose residuals their weights do not explain."""
    from scipy.special import chdtrc  # slow to load

    for name, factor, squared in fit.worst:
        term = _term(program, name)
        if chdtrc(term.size, squared) * term.count < UNLIKELY:
            times = (squared / term.size) ** 0.5
            yield (
                f"Measurement '{name}', factor {factor} ({members(term, factor)}) disagrees with the others: its "
                f"residual is {times:.3g} times as large as its weight says."
            )
    if fit.far:
        yield f"{fit.sentence()}."


def weak(program: CompiledProblem, lin: Linearization, rows: BoolArray) -> Iterator[str]:
    """The direction that costs and active constraints curve least, where that is hardly at all."""
    if not (lin.finite and program.size and cheap(program)):
        return
    entries = program.normal_entries(lin, rows.astype(np.float64))
    pattern, diagonal = program.normal, entries[program.normal.diagonal]
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    data = entries * scale[pattern.indices] * scale[pattern.columns]
    data[pattern.diagonal] = np.where(diagonal > 0.0, 1.0 + NOTHING, NOTHING)
    with program.systems.borrowed() as factorization:
        if not factorization.factor(data):
            return
        direction = null_direction(factorization, program.size)
    along = pattern.times(data, direction)
    length = inner(direction, direction)
    curvature = inner(direction, along) / length - NOTHING
    if curvature > WEAK:
        return
    step = direction * scale
    found = members_of(program, np.flatnonzero(np.abs(direction) > 0.3))  # of the largest
    what = " with ".join(listed(family, own) for family, own in found.items())
    if curvature <= NOTHING:
        yield f"Nothing determines {what}: add a prior, another measurement or a fix."
        return
    moved = float(np.abs(step).max()) / (curvature * length) ** 0.5
    text = f"Hardly anything determines {what}: moved by {moved:.3g} (in tangent units), the cost grows by 1/2 only"
    if program.cost_terms:
        felt = program.costs.times(lin.jacobian, step)
        none: Array = np.zeros(0)
        shares = {t.name: float((program.rows_of(t, felt, none) ** 2).sum()) for t in program.cost_terms}
        text += f"; most of that is '{max(shares, key=lambda name: shares[name])}'"
    yield f"{text}."


def slow(
    program: CompiledProblem, lin: Linearization, seconds: float, in_python: float, parts: Mapping[str, float]
) -> Iterator[str]:
    """Share of the time by parts, and how a term that Python evaluates is written for compiled code."""
    times: dict[str, float] = {}
    for name in program.left_to_python if in_python > MUCH * seconds else ():
        with suppress(Exception), program.lock:  # data may have changed since, to what the function does not take
            began = perf_counter()
            _term(program, name).residual(lin.values)
            times[name] = perf_counter() - began
    if times:
        name = max(times, key=lambda own: times[own])
        yield (
            f"{100.0 * in_python / seconds:.0f} % of the time went into functions in Python, most of "
            f"it into '{name}' ({_term(program, name).route}). Written in NumPy that can be traced, or for one factor "
            "as fg.residual(function, rows=...) with Numba, it is compiled."
        )
    elif parts:
        part = max(parts, key=lambda own: parts[own])
        yield f"{100.0 * parts[part] / seconds:.0f} % of the time went into: {part}."
