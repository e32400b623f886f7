"""Adaptive mesh: nodes of a horizon where the plan needs them, so that it holds between the nodes as well.

A plan knows its nodes only. Between them the dynamics are off by the error of their integration, and a constraint that
holds at two nodes may be violated. Both are looked at where the robot's model leads from each node in substeps of the
step (step doubling; E. Hairer, S. Norsett and G. Wanner, "Solving Ordinary Differential Equations I", II.4; mesh
refinement of J. Betts, "Practical Methods for Optimal Control", section 4.7). Steps that are off are divided, and the
plan on the old nodes, interpolated, is where the next solve begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unifg.errors import GraphError, require_kinds
from unifg.horizon.decision import Plan
from unifg.horizon.initial_guesses import InitialGuesses
from unifg.horizon.receding_horizon import RecedingHorizon
from unifg.horizon.robot import Robot
from unifg.horizon.terms import Context, Term
from unifg.modeling.duplicates import doubles
from unifg.solution.solution import Solution
from unifg.solution.solver import Solver
from unifg.typing import Array, ArrayLike

MOST_PARTS = 4  # of a step in one round


@dataclass(frozen=True)
class MeshPlan:
    """A plan, and the nodes it needed.

    Attributes:
        plan: on the last mesh.
        solution: of its solve.
        times: (N + 1,) of its nodes [s].
        defects: (N,) largest coordinate by which the model in substeps misses the next node, in its tangent space.
        violations: (N,) largest violation of what is to hold between nodes.
        met: whether both are within their tolerances in every step, of a plan that was accepted.
        steps: N of every round.
    """

    plan: Plan
    solution: Solution
    times: Array
    defects: Array
    violations: Array
    met: bool
    steps: tuple[int, ...]


def plan_on_mesh(
    robot: Robot,
    terms: Sequence[Term],
    times: ArrayLike,
    present: ArrayLike,
    given: Any = None,
    *,
    solver: Solver,
    between: Callable[[Array], Array] | None = None,
    defect: float = 1e-3,
    violation: float = 1e-3,
    substeps: int = 8,
    rounds: int = 8,
    cold: Callable[[Context[Any]], tuple[Array, Array]] | None = None,
) -> MeshPlan:
    """Plan once, with nodes added until the plan holds between them.

    Args:
        robot: with a model ``predict(x, u, seconds)``.
        terms: of the future, for any number of nodes; ``Dynamics`` without a step, weights by ``now.times``.
        times: (N + 1,) of the first mesh [s].
        present: (storage,) where the plan begins.
        given: what terms ask for in ``now.given``.
        solver: of every round.
        between: ``between(x)`` for states (n, storage) gives (n, M) numbers that must not be negative, as clearances.
        defect: permitted defect of the dynamics over a step, in every tangent coordinate.
        violation: permitted violation of ``between`` on the way from node to node.
        substeps: into which each step is divided to look at it.
        rounds: solves before giving up.
        cold: first guess on the first mesh, as of :class:`unifg.horizon.InitialGuesses`.

    Raises:
        GraphError: for a robot without a model, options that no plan could meet, and as
            :class:`unifg.horizon.RecedingHorizon`.
    """
    options = {"defect": defect, "violation": violation, "substeps": substeps, "rounds": rounds}
    stated = {"robot": robot, "between": between, **options}
    require_kinds("plan_on_mesh", GraphError, plan_on_mesh.__annotations__, stated, Robot)
    if robot.predict is None:
        raise GraphError("a mesh needs a robot that predicts: its model says what happens between nodes")
    if not (defect > 0.0 and violation > 0.0 and substeps > 1 and rounds > 0):
        raise GraphError(f"plan_on_mesh: takes positive numbers, and at least two substeps, found {options}")
    nodes, start, made = doubles("the times of the nodes", times).copy(), cold, list[int]()
    if nodes.ndim != 1 or len(nodes) < 2 or not 0.0 < nodes[1] < np.inf:
        raise GraphError(f"the times must be growing numbers from 0 on, at least two of them; got {times!r}")
    while True:
        made.append(len(nodes) - 1)
        moving = replace(robot, tick=float(nodes[1]))
        loop = RecedingHorizon(moving, made[-1], terms, times=nodes, solver=solver, starts=InitialGuesses(cold=start))
        plan = loop.plan(present, given)
        assert loop.solution is not None
        defects, violations = _looked_at(moving, plan, nodes, between, substeps)
        excess = np.maximum(defects / defect, violations / violation)
        met = plan.source == "solved" and bool((excess <= 1.0).all())
        if met or plan.source != "solved" or len(made) == rounds:
            return MeshPlan(plan, loop.solution, nodes, defects, violations, met, tuple(made))
        parts = np.where(excess > 1.0, np.clip(np.ceil(np.sqrt(excess)), 2, MOST_PARTS), 1).astype(np.int64)
        finer = np.concatenate([nodes[k] + np.arange(n) / n * (nodes[k + 1] - nodes[k]) for k, n in enumerate(parts)])
        finer = np.append(finer, nodes[-1])
        prolonged = moving.between(nodes, plan.states, plan.controls, finer)
        nodes, start = finer, _constant(prolonged)


def _constant(guess: tuple[Array, Array]) -> Callable[[Context[Any]], tuple[Array, Array]]:
    return lambda now: guess


def _looked_at(
    robot: Robot, plan: Plan, times: Array, between: Callable[[Array], Array] | None, substeps: int
) -> tuple[Array, Array]:
    """(N,) defects and (N,) violations of the steps of a plan."""
    defects, violations = np.zeros(len(plan.controls)), np.zeros(len(plan.controls))
    for k, (control, length) in enumerate(zip(plan.controls, np.diff(times), strict=True)):
        shares = np.full(substeps, length / substeps)
        way = robot.rollout(plan.states[k], np.tile(control, (substeps, 1)), shares)
        defects[k] = np.abs(robot.state.local(plan.states[k + 1], way[-1])).max()
        if between is not None:
            room = doubles("what between gives", between(way[1:-1]))
            if np.isnan(room).any():
                raise GraphError(f"between must give numbers, found {room} at the states {way[1:-1]}")
            violations[k] = max(-float(room.min(initial=np.inf)), 0.0)
    return defects, violations
