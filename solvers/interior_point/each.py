"""The compiled loop over many instances of one graph, without Python between them."""

from __future__ import annotations

from unifg.codegen.function_pointers import run
from unifg.codegen.jit import compiled
from unifg.lie.so3 import all_unit
from unifg.problem.linearization import all_finite
from unifg.solvers.interior_point.state import MOVED, Records
from unifg.typing import Array, IntArray


@compiled
def solve_each(
    functions: IntArray,
    address: int,
    now: Records,
    barrier: float,
    penalty: float,
    rows: Array,
    parameters: tuple[IntArray, IntArray, Array],
    fixed: tuple[IntArray, IntArray, Array, IntArray],
    quaternions: IntArray,
    guesses: Array,
    duals: Array,
    values: Array,
    multipliers: Array,
    kkt: Array,
    found: Array,
    found_multipliers: Array,
    numbers: Array,
) -> None:
    """Solve one instance after the other.

    Args:
        functions: addresses of ``reset``, ``loop`` and ``conclude``.
        address: of their arrays.
        now: (1,) their scalars, with the options written.
        barrier: first mu.
        penalty: first rho.
        rows: (K, D) numbers of all data.
        parameters: places in a row, places in the parameters of kernels, these.
        fixed: the same for the values of fixed variables, and where these are stored.
        quaternions: places where they start among stored values; no instance is solved where one is not of norm 1.
        guesses: (K or 1, S) stored values.
        duals: (K or 1, M) multipliers.
        values: (S,) of ``Work``.
        multipliers: (M,) of the same.
        kkt: of the same.
        found: (K, S) answers.
        found_multipliers: (K, M) theirs.
        numbers: (K, 8) answer of the loop, iterations, cost, size of the multipliers, KKT numbers but the worst row.
    """
    state = now[0]
    sources, targets, numbers_of_kernels = parameters
    fixed_sources, fixed_targets, fixed_values, places = fixed
    for k in range(len(rows)):
        for p in range(len(sources)):
            numbers_of_kernels[targets[p]] = rows[k, sources[p]]
        for p in range(len(fixed_sources)):
            fixed_values[fixed_targets[p]] = rows[k, fixed_sources[p]]
        guess = k if len(guesses) > 1 else 0
        for i in range(len(values)):
            values[i] = guesses[guess, i]
        for i in range(len(multipliers)):
            multipliers[i] = duals[guess, i]
        for i in range(len(places)):
            values[places[i]] = fixed_values[i]
        if not (all_finite(values) and all_unit(values, quaternions)):
            numbers[k, 7] = 0.0
            continue
        run(functions[0], (address,))
        state.mu, state.rho, state.going_on, state.stage = barrier, penalty, 0, MOVED
        run(functions[1], (address,))
        run(functions[2], (address,))
        for i in range(len(values)):
            found[k, i] = values[i]
        for i in range(len(multipliers)):
            found_multipliers[k, i] = multipliers[i]
        numbers[k, 0], numbers[k, 1], numbers[k, 2], numbers[k, 3] = (
            state.answer, state.iteration, state.cost, state.suspicion,
        )  # fmt: skip
        numbers[k, 4], numbers[k, 5], numbers[k, 6], numbers[k, 7] = kkt[0], kkt[1], kkt[2], kkt[4]
