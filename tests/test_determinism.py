"""The same call gives the same answer, whatever a prepared solve was used for before, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with
from problems.known import Guess, short_drive
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
)
from unifg.solvers.names import backends
from unifg.typing import Array
from units import drive

CONSTRAINED: dict[str, fg.Solver] = {
    **backends("alm"),
    "alm, literal": AugmentedLagrangian(schedule="bazzana", penalty=10.0, max_iterations=50),
    "penalty": Penalty(max_iterations=30),
    **backends("ipm"),
    "ipm, gauss-newton": InteriorPoint(hessian="gauss-newton"),
    **backends("sqp"),
    "sqp, exact": SQP(hessian="exact"),
    "sqp, graph": SQP(qp="graph"),
    "sqp, piqp": SQP(qp="piqp", fallback="graph"),
    "sqp, osqp alone": SQP(qp="osqp", fallback=None, max_iterations=40),
    "sqp, osqp behind": SQP(qp="piqp", fallback="osqp"),
    "sqp, real time": SQP(max_iterations=1),
    "sqp, quadprog": SQP(qp="quadprog"),
    "sqp, clarabel": SQP(qp="clarabel"),
    "sqp, full steps": SQP(full_steps=True, max_iterations=30),
    "sqp, unscaled": SQP(scaling=False),
}
EQUALITIES: dict[str, fg.Solver] = {
    "kkt": KKT(),
    "kkt, full steps": KKT(full_steps=True),
    "sqp, elimination": SQP(qp="elimination"),
    "sqp, without inequalities": SQP(),
}
COSTS: dict[str, fg.Solver] = {
    "gauss-newton": GaussNewton(),
    "levenberg-marquardt": LevenbergMarquardt(),
    "dog leg": DogLeg(),
}


def beside_disc() -> tuple[fg.Graph, Guess, Guess]:
    """A drive past a disc, from afar."""
    graph, guess = short_drive()
    return graph, guess, _moved(guess, 0.4)


def far_units() -> tuple[fg.Graph, Guess, Guess]:
    """Another, in units that ask for scaling."""
    graph, guess = drive(position=1e-4, count=12)
    return graph, guess, _moved(guess, 0.2)


def priced() -> tuple[fg.Graph, Guess, Guess]:
    """Controls with a price that is no square, along equalities."""
    graph, x, u = graph_of(("x", fg.Rn(1), 6), ("u", fg.Rn(1), 5))
    graph.fix(x[0], [2.0])
    graph.minimize_scalar(lambda u: np.sqrt(1.0 + u[:, 0] ** 2) + u[:, 0], u, name="general")
    graph.minimize(lambda x: x, x[1:], sigma=0.5, name="state")
    motion = fg.residual(lambda x, u, y: y - x - 0.5 * np.sin(x) - u)
    graph.constrain(motion, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=-1.0, upper=1.0)
    guess = {x: np.full((6, 1), 2.0), u: np.zeros((5, 1))}
    return graph, guess, _moved(guess, 0.4)


def open_drive() -> tuple[fg.Graph, Guess, Guess]:
    """A drive with nothing but dynamics."""
    from unifg.models import unicycle

    graph, x, u = graph_of(("x", fg.SE2, 9), ("u", fg.Rn(2), 8))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(unicycle.tracking, x[-1], [1.2, 0.6, 0.4], sigma=0.1)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.2, lower=0.0, upper=0.0, name="dynamics")
    way = np.linspace(0.0, 1.0, 9)
    guess = {x: np.stack([1.2 * way, 0.3 * way, 0.4 * way], axis=1), u: np.tile([0.7, 0.1], (8, 1))}
    return graph, guess, _moved(guess, 0.3)


def ring() -> tuple[fg.Graph, Guess, Guess]:
    """Poses around a ring with one wrong closure."""
    count = 12
    graph, x = graph_with(fg.SE2, count)
    graph.fix(x[0], [0.0, 0.0, 0.0])
    after = (np.arange(count) + 1) % count
    graph.minimize(fg.between, x, x[after], [1.0, 0.0, 2.0 * np.pi / count], sigma=0.1, name="odometry")
    robust = fg.Huber(1.0)
    graph.minimize(fg.between, x[[1, 3]], x[[8, 6]], [0.5, 0.5, 0.0], sigma=0.1, robust=robust, name="closures")
    angle = 2.0 * np.pi * np.arange(count) / count
    guess = {x: np.stack([2.0 * np.sin(angle), 2.0 - 2.0 * np.cos(angle), angle], axis=1)}
    return graph, guess, _moved(guess, 0.2)


def _moved(guess: Guess, size: float) -> Guess:
    rng = np.random.default_rng(3)
    return {
        family: family.manifold.retract(array, size * rng.standard_normal((len(array), family.manifold.dim)))
        for family, array in guess.items()
    }


CASES = [
    *[(build, name, solver) for name, solver in CONSTRAINED.items() for build in (beside_disc, far_units)],
    *[(priced, name, solver) for name, solver in CONSTRAINED.items() if solver.scalar_costs],
    *[(open_drive, name, solver) for name, solver in EQUALITIES.items()],
    *[(ring, name, solver) for name, solver in COSTS.items()],
]


def bits(solution: fg.Solution) -> list[Array | float | str]:
    """All there is to compare."""
    values = [solution.values[family] for family in solution.values]
    numbers = [solution.cost, solution.stationarity, solution.violation, solution.complementarity]
    steps = [row.step_norm for row in solution.history]
    duals = [*solution.multipliers.values(), *solution.penalties.values()]
    return [*values, *duals, *numbers, *steps, str(solution.status)]


def same(one: fg.Solution, other: fg.Solution) -> None:
    first, second = bits(one), bits(other)
    assert one.iterations == other.iterations and len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("build", "name", "solver"), CASES, ids=[f"{name}, {b.__name__}" for b, name, _ in CASES])
@pytest.mark.product(1)
def test_a_prepared_solve_remembers_nothing(build: object, name: str, solver: fg.Solver) -> None:
    """After another solve, after one that failed, and in a run of its own."""
    assert callable(build)
    graph, guess, other = build()
    run = solver.prepare(graph)
    first = run.solve(guess)
    run.solve(other)
    same(run.solve(guess), first)
    hopeless = {family: np.where(np.isfinite(array), 1e3 * array + 7.0, 0.0) for family, array in other.items()}
    run.solve({family: family.manifold.retract(hopeless[family], np.zeros(family.manifold.dim)) for family in hopeless})
    same(run.solve(guess), first)
    same(solver.prepare(graph).solve(guess), first)
    warm = run.solve(first.shifted(*graph.families.values()))
    run.solve(other)
    same(run.solve(first.shifted(*graph.families.values())), warm)
