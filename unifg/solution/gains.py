"""Feedback gains of an optimal control problem at its solution: what each control does about a deviation of its state.

In a problem of stages, what is optimal from stage k on depends on what came before through the state x_k (and, with
costs of changes, the control before it). Held there with all that is earlier, the KKT conditions of the rest,

    [H  A'] [dz]        [H_x]
    [A  0 ] [dl]  = -   [A_x] dx_k,

H being the Hessian of the Lagrangian and A the equalities and the inequalities that are active, give du_k = K_k dx_k
(the sensitivities of A. Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming", 1983; of
a linear-quadratic problem it is Riccati's recursion). All stages share one structure: what is held becomes rows of the
identity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unifg.errors import GraphError
from unifg.modeling.soft import SlackFamily
from unifg.modeling.variables import Selection
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.linearization import Linearization
from unifg.problem.systems import KktSystem, fill
from unifg.solution.covariance import SOLVED
from unifg.solution.multipliers import size_of_costs
from unifg.typing import Array, BoolArray, IntArray

REPLACED = "the data of this solution have been replaced since; ask before the next solve"
SAME = 1e-8  # relative difference of linearisations that belong to the same data
LINEARIZED = "cost", "gradient", "hessian", "constraints", "constraint_jacobian"


def feedback_gains(
    program: CompiledProblem,
    lin: Linearization,
    multipliers: Array,
    held: BoolArray,
    states: Sequence[Selection],
    controls: Sequence[Selection],
) -> Array:
    """Gains (N, m, d) of N stages; arguments and errors as of :meth:`unifg.Solution.gains`.

    Args:
        program: the compiled graph, with the data of the solution bound.
        lin: linearisation at the solution.
        multipliers: (M,) there.
        held: (M,) rows that are equalities there.
        states: N members of each family.
        controls: N members of each family.
    """
    columns = np.concatenate([program.columns.of(selection).ravel() for selection in states])
    with program.lock:
        twin, here = unfixed(program, columns, lin)
    system = twin.systems.kkt(held)
    entries = np.zeros(system.pattern.nnz)
    hessian = lagrangian_hessian(twin, here, multipliers) / size_of_costs(program, lin)  # gains have no unit of costs
    fill(system.arrays, hessian, here.constraint_jacobian, entries)

    def numbered(selection: Selection) -> IntArray:
        return twin.columns.unknown[twin.columns.of(selection)]

    state, control = (np.concatenate([numbered(s) for s in part], axis=1) for part in (states, controls))
    slack = np.zeros(system.pattern.size, dtype=bool)
    for own in twin.families:
        if isinstance(own, SlackFamily):
            slack[numbered(own[:])] = True
    members = [(s.indices + last, numbered(s.family[:])) for part, last in ((states, 1), (controls, 0)) for s in part]
    found = []
    for k in range(len(control)):
        earlier = np.concatenate([rows[: ends[k]].ravel() for ends, rows in members])
        gain = _gain(twin, system, entries, earlier[earlier >= 0], slack, state[k], control[k])
        if gain is None:
            family, index = controls[0].family.name, int(controls[0].indices[k])
            raise GraphError(
                f"gains: {family}[{index}] has none: costs and active constraints leave it free, or from another state "
                "the active constraints cannot all be kept; ask for the stages before it alone, as gains(x[:1], u[:1])",
                family=family,
                index=index,
            )
        found.append(gain)
    return np.array(found)


def require_data(program: CompiledProblem, lin: Linearization) -> None:
    """Raise unless the data that are bound make of the values of a solution what it was linearised as."""
    here = program.linearize(program.columns.values(lin.values))
    pairs = [(getattr(here, name), getattr(lin, name)) for name in LINEARIZED]
    if not all(np.allclose(a, b, rtol=SAME, atol=SAME) for a, b in pairs):
        raise GraphError(REPLACED)


def unfixed(program: CompiledProblem, columns: IntArray, lin: Linearization) -> tuple[CompiledProblem, Linearization]:
    """The problem with the variables unknown that it fixes, found once; and how it is linearised, with the same data.

    Args:
        program: the compiled graph, with its data bound.
        columns: full tangent columns that are not to be fixed.
        lin: linearisation of a solution.
    """
    dropped = frozenset(name for name, part in program.columns.fixed.items() if np.isin(part, columns).any())
    known = program.once(_known)
    if dropped not in known:
        graph = program.graph.snapshot()
        graph.fixes = [fix for fix in graph.fixes if fix.name not in dropped]
        known[dropped] = CompiledProblem(graph)
    twin = known[dropped]
    twin.bind({handle: value for handle, value in program.binding.present.items() if handle in twin.binding.present})
    values = twin.columns.values(lin.values)
    twin.values_from(values.flat)  # functions are traced again that have changed since
    return twin, twin.linearize(values)


def _known(_: CompiledProblem) -> dict[frozenset[str], CompiledProblem]:
    """Nothing is known of a program to begin with."""
    return {}


def _gain(
    program: CompiledProblem,
    system: KktSystem,
    entries: Array,
    held: IntArray,
    slack: BoolArray,
    state: IntArray,
    control: IntArray,
) -> Array | None:
    """(m, d) gain of one stage; None where it does not exist."""
    pattern, n = system.pattern, program.size
    out = np.zeros(pattern.size, dtype=bool)
    out[held] = True
    number, later = np.full(program.constraints.count, -1), np.zeros(program.constraints.count, dtype=bool)
    number[system.arrays.rows] = n + np.arange(len(system.arrays.rows))
    own, columns = program.constraints.free_rows, program.constraints.free_columns
    later[own[~(out | slack)[columns]]] = True
    out |= slack
    out[columns[later[own] & slack[columns]]] = False  # slacks of limits of what is held give way with it
    rows = number[own]
    out[n:] = True
    out[rows[(rows >= 0) & ~out[columns]]] = False  # rows that nothing later is part of say nothing about it
    if not system.saddle.factor(system.without(entries, out)):
        return None
    free, gain = control >= 0, np.zeros((len(control), len(state)))
    for j, column in enumerate((*state, *control[free])):
        right = np.zeros(pattern.size)
        right[column] = 1.0  # a force on a control tells whether that is determined
        if j < len(state):
            right = -pattern.times(entries, right)
        right[out] = 0.0
        solution, _ = system.saddle.solve(right)
        if (
            not np.abs(system.saddle.residual(solution, right)).max()
            <= SOLVED * np.abs(system.saddle.scale * right).max()
        ):
            return None
        if j < len(state):
            gain[free, j] = solution[control[free]]
    return gain
