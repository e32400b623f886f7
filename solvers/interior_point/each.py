"""The compiled loop over many instances of one graph, without Python between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.codegen.calls import vector
from unifg.codegen.function_pointers import Memory, all_of, linked_to, run
from unifg.lie.so3 import all_unit
from unifg.problem.guess import settle
from unifg.problem.linearization import all_finite
from unifg.solution.export import REFUSED
from unifg.solution.multipliers import SUSPICIOUS
from unifg.solution.solve_state import UNBOUNDED_COST
from unifg.solvers.interior_point.state import (
    CONVERGED,
    LIMIT_REACHED,
    MOVED,
    NOT_FINITE,
    SINGULAR,
    STALLED,
    STOPPED,
    VIOLATED,
)
from unifg.typing import Array, IntArray, Records

ANSWER, ITERATIONS, COST, SUSPICION, STATIONARITY, VIOLATION, COMPLEMENTARITY, NUMBERS = range(8)
"""Columns of ``Instances.numbers``, and how many there are."""
WORDS = CONVERGED, STOPPED, LIMIT_REACHED, SINGULAR, STALLED, NOT_FINITE
"""Words of answers, besides REFUSED."""


class Instances(NamedTuple):
    """Arguments of :func:`solve_each`.

    Attributes:
        functions: addresses of ``solve_once`` and of its arrays.
        now: (1,) their scalars, with the options written.
        starts: (2,) first mu and first rho.
        rows: (K, D) numbers of all data.
        sources, targets, parameters: places in a row, places in the parameters of kernels, these.
        fixed_sources, fixed_targets, fixed: the same for the values of fixed variables.
        places: where those are stored.
        elements, quaternions: places where they start in a row and among stored values; no instance is solved where one
            is not of norm 1.
        guesses: (K or 1, S) stored values.
        duals: (K or 1, M) multipliers.
        values, multipliers, kkt: of ``Work``.
        found: (K, S) answers.
        found_multipliers: (K, M) theirs.
        numbers: (K, NUMBERS) word of the answer, iterations, cost, size of the multipliers, KKT numbers.
    """

    functions: IntArray
    now: Records
    starts: Array
    rows: Array
    sources: IntArray
    targets: IntArray
    parameters: Array
    fixed_sources: IntArray
    fixed_targets: IntArray
    fixed: Array
    places: IntArray
    elements: IntArray
    quaternions: IntArray
    guesses: Array
    duals: Array
    values: Array
    multipliers: Array
    kkt: Array
    found: Array
    found_multipliers: Array
    numbers: Array


instances = Memory()
all_at = all_of(instances)


@linked_to(instances)
def solve_each(address: int) -> None:
    """Solve one instance after the other.

    The word of an answer is CONVERGED where the judge of all backends would say so, STOPPED where the stop rule has
    ended the loop, REFUSED without a solve, else what ended it.

    Args:
        address: of :class:`Instances`.
    """
    given = all_at(address)
    functions, state, kkt = given.functions, given.now[0], given.kkt
    values, multipliers = given.values, given.multipliers
    width = given.rows.shape[1]
    for k in range(len(given.rows)):
        row, number = vector(given.rows, k * width, width), vector(given.numbers, k * NUMBERS, NUMBERS)
        for p in range(len(given.sources)):
            given.parameters[given.targets[p]] = row[given.sources[p]]
        for p in range(len(given.fixed_sources)):
            given.fixed[given.fixed_targets[p]] = row[given.fixed_sources[p]]
        guess = k if len(given.guesses) > 1 else 0
        for i in range(len(values)):
            values[i] = given.guesses[guess, i]
        for i in range(len(multipliers)):
            multipliers[i] = given.duals[guess, i]
        known = settle(values, given.places, given.fixed, given.quaternions) and all_finite(multipliers)
        for i in range(width):
            known = known and row[i] == row[i]
        number[ANSWER] = REFUSED
        if not (known and all_unit(row, given.elements)):
            continue
        state.mu, state.rho, state.going_on, state.stage = given.starts[0], given.starts[1], 0, MOVED
        run(functions[0], (functions[1],))
        for i in range(len(values)):
            given.found[k, i] = values[i]
        for i in range(len(multipliers)):
            given.found_multipliers[k, i] = multipliers[i]
        finite, answer = kkt[4] > 0.0 and abs(state.cost) < np.inf, state.answer
        met = max(kkt[0], kkt[2]) <= state.tolerance and kkt[1] <= state.feasible
        if not finite:
            answer = NOT_FINITE
        elif met and state.suspicion <= SUSPICIOUS and state.cost >= UNBOUNDED_COST:
            answer = CONVERGED
        elif answer == CONVERGED or answer == VIOLATED or state.cost < UNBOUNDED_COST:
            answer = STALLED
        number[ANSWER], number[ITERATIONS] = answer, state.iteration
        number[COST], number[SUSPICION] = state.cost, state.suspicion
        number[STATIONARITY], number[VIOLATION], number[COMPLEMENTARITY] = kkt[0], kkt[1], kkt[2]
