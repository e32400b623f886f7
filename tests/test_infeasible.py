"""Statuses of backends where constraints contradict each other, and where they only seem to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.models import obstacles, unicycle
from unifg.solution.optimality import infeasible_stationary
from unifg.solvers import SQP, AugmentedLagrangian
from unifg.solvers.globalize.feasibility_restoration import least_violation
from unifg.typing import Array
from units import drive
from variants import CONSTRAINED

BACKENDS = CONSTRAINED
LEAST = 0.00253189415  # squared, of a drive whose end is out of reach
Problem = tuple[fg.Graph, dict[fg.Family, Array]]


def two_values(weight: float) -> Problem:
    """x = 0 and weight (x - 1) = 0."""
    graph, x = drawn_to([5.0])
    graph.constrain(fg.prior, x, [0.0], lower=0.0, upper=0.0, name="zero")
    graph.constrain(lambda v: weight * (v - 1.0), x, lower=0.0, upper=0.0, name="one")
    return graph, {x: np.array([[3.0]])}


def chain() -> Problem:
    """A chain of points whose ends are given; one in the middle is to have a square of -1."""
    graph, x = graph_with(fg.Rn(2), 4)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0])
    graph.constrain(fg.prior, x[0], [0.0, 0.0], lower=0.0, upper=0.0, name="start")
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x[2], lower=-1.0, upper=-1.0, name="square")
    graph.constrain(lambda p: p[:, :1], x[3], lower=3.0, upper=3.0, name="end")
    return graph, {x: np.ones((4, 2))}


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize(("weight", "meeting"), [(1.0, 0.5), (1e3, 1e6 / (1e6 + 1.0))])
def test_contradicting_equalities_end_at_the_least_violation(name: str, weight: float, meeting: float) -> None:
    """The least squares of both violations, and the worse of the two by its name."""
    graph, guess = two_values(weight)
    solution = BACKENDS[name].solve(graph, guess)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE, solution.report()
    assert solution[graph.families["x"]][0, 0] == pytest.approx(meeting, abs=1e-6)
    if weight > 1.0:
        assert solution.worst == ("zero", 0)
    assert "Largest violation" in solution.report()


@pytest.mark.parametrize("name", [name for name in BACKENDS if name != "kkt full"])
def test_one_impossible_row_among_others_is_named(name: str) -> None:
    graph, guess = chain()
    solution = BACKENDS[name].solve(graph, guess)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE, solution.report()
    assert solution.worst == ("square", 0)
    assert solution.violation == pytest.approx(1.0, abs=1e-5)
    x = graph.families["x"]
    np.testing.assert_allclose(solution[x][0], 0.0, atol=1e-4)
    assert solution[x][3, 0] == pytest.approx(3.0, abs=1e-4)


def saddle(away: float = 0.0) -> Problem:
    """1 + x^2 = y^2: at the origin the violation is stationary, yet along y it falls."""
    graph, x = drawn_to([0.0, 0.5])
    graph.constrain(lambda p: 1.0 + p[:, :1] ** 2 - p[:, 1:] ** 2, x, lower=0.0, upper=0.0, name="hyperbola")
    return graph, {x: np.array([[away, 0.0]])}


@pytest.mark.parametrize("name", [name for name in BACKENDS if name != "kkt full"])
def test_a_saddle_of_the_violation_is_not_taken_for_its_minimum(name: str) -> None:
    graph, guess = saddle()
    solution = BACKENDS[name].solve(graph, guess)
    assert solution.status is not fg.Status.LOCALLY_INFEASIBLE, solution.report()
    assert solution.violation < 1e-5


@pytest.mark.parametrize(
    "build", [lambda: two_values(1e3), chain, lambda: saddle(0.3)], ids=["values", "chain", "saddle"]
)
def test_least_violation_is_stationary_or_none(build: Callable[[], Problem]) -> None:
    graph, guess = build()
    program = graph.compile()
    lin = program.linearize(program.values_from(guess))
    found = least_violation(program, lin, 1e-6)
    outside = np.abs(program.violation(found.constraints)).max()
    assert outside <= 1e-6 or infeasible_stationary(program, found, 1e-6)
    stopped = least_violation(program, lin, 1e-6, out_of_time=lambda: True)
    np.testing.assert_array_equal(stopped.values.flat, lin.values.flat)


def bay() -> Problem:
    """x^3 - 3 x + 3 = 0 has its root at -2.1; at 1, where the cost pulls, it is 1 and no nearer root is in sight."""
    graph, x = drawn_to([1.0], sigma=0.01)
    graph.constrain(lambda p: p**3 - 3.0 * p + 3.0, x, lower=0.0, upper=0.0, name="cubic")
    return graph, {x: np.array([[np.roots([1.0, 0.0, -3.0, 3.0])[0].real]])}


@pytest.mark.parametrize("name", BACKENDS)
def test_what_was_feasible_once_is_not_called_infeasible(name: str) -> None:
    """Whatever valley a backend goes astray in: it started where the constraint holds."""
    graph, guess = bay()
    assert BACKENDS[name].solve(graph, guess).status is not fg.Status.LOCALLY_INFEASIBLE
    if name != "kkt full":  # full steps come across the root
        x = graph.families["x"]
        assert BACKENDS[name].solve(graph, {x: [[1.5]]}).status is fg.Status.LOCALLY_INFEASIBLE  # this start is not


@pytest.mark.parametrize("unit", [1e-8, 1e-4, 1.0, 1e4, 1e8])
@pytest.mark.product(1)
def test_the_unit_of_an_unknown_does_not_decide_what_is_infeasible(unit: float) -> None:
    """Neither the verdict on a point where steps still help, nor the way to the least violation."""
    graph, guess = drive(position=unit)
    program = graph.compile()
    assert not infeasible_stationary(program, program.linearize(program.values_from(guess)), 1e-6)
    for name in ("sqp", "sqp graph", "ipm"):
        assert BACKENDS[name].solve(graph, guess).status is not fg.Status.LOCALLY_INFEASIBLE, name
    graph, guess = drive(position=unit, blocked=True)
    program = graph.compile()
    found = least_violation(program, program.linearize(program.values_from(guess)), 1e-6)
    assert infeasible_stationary(program, found, 1e-6)
    outside = program.violation(found.constraints)
    assert outside @ outside == pytest.approx(LEAST, rel=1e-6)
    solution = SQP().solve(graph, guess)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE
    assert solution.violation == pytest.approx(np.abs(outside).max(), rel=1e-4)


def corridor(length: float) -> Problem:
    """A unicycle, a goal behind two discs that close a corridor, and a straight guess through them."""
    count, dt = 20, 0.2
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.constrain(fg.prior, x[-1], [length, 0.0, 0.0], lower=0.0, upper=0.0, name="goal")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0.0, upper=0.0, name="dynamics")
    graph.bound(u, lower=[-1.2, -1.5], upper=[1.2, 1.5], name="limits")
    centres, radii = np.array([[0.5 * length, 0.5], [0.5 * length, -0.5]]), np.array([0.55, 0.55])
    graph.constrain(obstacles.disc_clearance, x[1:], centres, radii, lower=0.0, name="discs")
    graph.constrain(lambda p: p[:, 1:2], x[1:], lower=-0.6, upper=0.6, name="walls")
    ahead = np.linspace(0.0, 1.0, count + 1)[:, None] * [length, 0.0, 0.0]
    return graph, {x: ahead, u: np.tile([length / (count * dt), 0.0], (count, 1))}


@pytest.mark.parametrize("length", [2.5, 3.0, 3.5])
@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
def test_a_blocked_corridor_is_told_early(hessian: Literal["exact", "gauss-newton"], length: float) -> None:
    """Penalties that grow without end creep towards the least violation; it is looked for when they do."""
    solution = AugmentedLagrangian(hessian=hessian).solve(*corridor(length))
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE, solution.report()
    assert solution.iterations <= (80 if hessian == "exact" else 120)
    assert solution.violation > 1e-2


def shelves(seed: int) -> Problem:
    """A robot at rest among shelves, which is a plan that violates nothing, and a goal behind some of them."""
    count, dt = 20, 0.2
    rng = np.random.default_rng(seed)
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    start = np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)])
    heading = rng.uniform(-np.pi, np.pi)
    goal = np.array([3.0 * np.cos(heading), 3.0 * np.sin(heading), heading])
    places = rng.uniform(-4.0, 4.0, (40, 2))
    centres = places[np.hypot(*places.T) > 0.75]
    graph.fix(x[0], start)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=1.0)
    graph.minimize(unicycle.tracking, x[1:], goal, sigma=1.0)
    graph.minimize(unicycle.tracking, x[-1], goal, sigma=0.1)
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0.0, upper=0.0, name="dynamics")
    graph.bound(u, lower=[-0.2, -1.5], upper=[1.0, 1.5], name="limits")
    radii = np.full(len(centres), 0.65)
    graph.constrain(obstacles.disc_clearance, x[1:], centres, radii, lower=0.0, name="shelves")
    return graph, {x: np.tile(start, (count + 1, 1)), u: np.zeros((count, 2))}


@pytest.mark.parametrize("seed", [0, 14, 35, 38])
def test_a_plan_is_found_from_one_that_violates_nothing(seed: int) -> None:
    """Led astray through shelves, the augmented Lagrangian goes back to where it was feasible, and starts anew."""
    graph, guess = shelves(seed)
    assert SQP().solve(graph, guess).converged
    solution = AugmentedLagrangian().solve(graph, guess, check=True)
    assert solution.cost < 0.9 * solution.history[0].cost
