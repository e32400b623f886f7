"""SQP with the Hessian of the Lagrangian: quadratic convergence, and when Gauss-Newton stands in."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import drawn_to, graph_with, program_of
from problems.hock_schittkowski import SMALL
from problems.known import PROBLEMS, Guess, Problem, ecg2o, ecg2o_inequality, hs6, pose_beside_disc, short_drive
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers import SQP
from unifg.solvers.quadratic_programs.exact_hessian import ExactHessian, holds
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.quadratic_programs.osqp_route import OsqpRoute
from unifg.solvers.quadratic_programs.piqp_route import ElasticRoute, PiqpRoute
from unifg.solvers.quadratic_programs.qpsolvers_route import QpsolversRoute
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.subproblem import QP, Route, qp_error, solve_convex, subproblem
from unifg.solvers.ta.linear_graphs import EliminationRoute
from unifg.typing import Array

CASES = {case.name: case for case in SMALL}


def two_rotations() -> tuple[fg.Graph, Guess]:
    """Two attitudes with priors, one axis of the first held, and a given angle between the axes of both."""
    graph, r = graph_with(fg.SO3, 2, "r")
    graph.minimize(fg.prior, r, fg.SO3.exp(np.array([[0.3, -0.5, 0.8], [0.2, 0.9, -0.1]])), sigma=0.5)
    graph.minimize(fg.between, r[0], r[1], fg.SO3.exp(np.array([0.1, 0.2, -0.3])))
    graph.constrain(lambda q: fg.SO3.matrix(q)[:, 2, :2], r[0], lower=[0.6, 0.3], upper=[0.6, 0.3], name="axis")

    def cosine(p: Array, q: Array) -> Array:
        return np.asarray(np.einsum("ni,ni->n", fg.SO3.matrix(p)[:, :, 0], fg.SO3.matrix(q)[:, :, 0])[:, None])

    graph.constrain(cosine, r[0], r[1], lower=0.2, upper=0.2, name="angle")
    return graph, {r: fg.SO3.exp(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.7]]))}


def saddle(equality: bool, level: float = 0.3) -> tuple[fg.Graph, Guess]:
    """x y, a saddle, where x - y = level, or -0.2 <= x - y <= level: 4 x y = (x + y)^2 - (x - y)^2."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(lambda p: p[:, 0] * p[:, 1], x, name="saddle")
    graph.constrain(lambda p: p[:, :1] - p[:, 1:], x, lower=level if equality else -np.inf, upper=level, name="gap")
    if not equality:
        graph.constrain(lambda p: p[:, :1] - p[:, 1:], x, lower=-0.2, name="other side")
    return graph, {x: np.array([[0.5, 0.1]])}


QUADRATIC: dict[str, Callable[[], tuple[fg.Graph, Guess]]] = {
    "pose beside disc": pose_beside_disc,
    "circle and ellipse": ecg2o_inequality,
    "HS6": hs6,
    "HS7": CASES["HS7"].build,
    "HS39": CASES["HS39"].build,
    "HS40": CASES["HS40"].build,
    "ecg2o(2, 2)": partial(ecg2o, (2.0, 2.0)),
    "ecg2o(-1.2, -1)": partial(ecg2o, (-1.2, -1.0)),
    "two rotations": two_rotations,
    "short drive": short_drive,
}


def errors(build: Callable[[], tuple[fg.Graph, Guess]], hessian: str) -> list[float]:
    """Largest tangent distance of every iterate from a more accurate answer."""
    graph, guess = build()
    exact = SQP(hessian="exact", qp="graph", tolerance=1e-10, max_iterations=60).solve(graph, guess)
    answer = exact.values
    solver = SQP(hessian=hessian, qp="graph", tolerance=1e-8, keep_values=True)  # type: ignore[arg-type]
    solution = solver.solve(graph, guess, check=True)
    found = []
    for row in solution.history:
        assert row.values is not None
        found.append(max(float(np.abs(f.manifold.local(answer[f], row.values[f])).max()) for f in guess))
    return found


def exponents(found: list[float]) -> list[float]:
    """log e_{k+1} / log e_k of the last errors that are small, but larger than what differences leave."""
    return [float(np.log(b) / np.log(a)) for a, b in pairwise(found) if 1e-5 < a < 0.05 and b > 1e-12]


@pytest.mark.parametrize("name", QUADRATIC)
def test_convergence_is_quadratic(name: str) -> None:
    found = errors(QUADRATIC[name], "exact")
    assert min(found) < 1e-7
    # From 1e-3 quadratic convergence needs two more steps to reach what differences leave, a rate of 1/8 seven or more.
    small = [e for e in found if e < 1e-3]
    assert len(small) <= 4, found
    assert all(exponent > 1.6 for exponent in exponents(found)[-1:]), found


@pytest.mark.parametrize("qp", ["osqp", "piqp", "graph"])
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
@pytest.mark.product(15)
def test_exact_solves_what_gauss_newton_solves(problem: Problem, qp: str) -> None:
    graph, guess = problem.build()
    solution = SQP(hessian="exact", qp=qp).solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    if np.isfinite(problem.cost):
        assert solution.cost == pytest.approx(problem.cost, abs=1e-7, rel=1e-6)
    for name, expected in problem.duals.items():
        np.testing.assert_allclose(solution.dual(name), expected, atol=1e-4)
    kinds = {str(row.details["hessian"]) for row in solution.history[1:]}
    assert kinds <= {"exact", "exact, with squares", "gauss-newton"}
    assert any(kind.startswith("exact") for kind in kinds)


# ---------------------------------------------------------------- convex for those who need it


def saddle_qp(equality: bool, multiplier: float, level: float = 0.3) -> tuple[CompiledProblem, QP]:
    """The exact subproblem of the saddle."""
    graph, guess = saddle(equality, level)
    program = program_of(graph)
    lin = program.linearize(program.values_from(guess))
    multipliers = np.zeros(program.constraints.count)
    multipliers[0] = multiplier
    return program, ExactHessian(program).subproblem(lin, multipliers, 0.0, Scaling.none(program))


def full(qp: QP) -> Array:
    """H as a dense matrix."""
    upper = qp.pattern.matrix(qp.hessian).toarray()
    return np.asarray(upper + np.triu(upper, 1).T)


def test_squares_of_constraints_make_the_hessian_definite() -> None:
    _, qp = saddle_qp(True, 0.0)
    assert qp.curved_by is not None
    assert qp.weights is not None
    np.testing.assert_allclose(full(qp), [[0.0, 1.0], [1.0, 0.0]], atol=1e-6)
    convex = qp.convex()
    A = np.array([[1.0, -1.0]])
    np.testing.assert_allclose(full(convex), full(qp) + qp.weights[0] * A.T @ A, atol=1e-9)
    assert np.linalg.eigvalsh(full(convex)).min() > 0.0
    # By hand: on x - y = 0.3 the minimum is at (0.15, -0.15), and y + lambda = 0 there.
    step = np.array([0.15 - 0.5, -0.15 - 0.1])
    assert qp_error(qp, step, np.array([0.15])) < 1e-6
    assert qp_error(convex, step, np.array([0.15])) < 1e-6, "step and multipliers of the convex problem are the same"


ROUTES: dict[str, Callable[[CompiledProblem], Route]] = {
    "osqp": lambda program: OsqpRoute(program, 4000),
    "piqp": PiqpRoute,
    "graph": GraphRoute,
    "qpsolvers": lambda program: QpsolversRoute(program, "piqp"),
    "elimination": EliminationRoute,
}


@pytest.mark.product(4)
@pytest.mark.parametrize(
    ("name", "equality"),
    [*((name, True) for name in ROUTES), *((name, False) for name in ROUTES if name != "elimination")],
)
def test_every_route_takes_an_indefinite_hessian(name: str, equality: bool) -> None:
    program, qp = saddle_qp(equality, 0.15 if equality else 0.9)
    if not equality:
        # x - y <= 0.3 where the present point has 0.4: active by its multiplier, which outweighs the distance.
        assert qp.weights is not None
        assert qp.weights[0] > 0.0
    answer = solve_convex(ROUTES[name](program), qp, np.zeros(program.constraints.count), 1e-9)
    assert answer.error < 1e-6
    np.testing.assert_allclose(answer.step, [-0.35, -0.25], atol=1e-6)
    assert answer.multipliers[0] == pytest.approx(0.15, abs=1e-5)
    assert holds(qp, answer, 1e-5)


def test_elastic_route_takes_the_wider_pattern() -> None:
    program, qp = saddle_qp(True, 0.0)
    answer = ElasticRoute(program, program.normal).solve(qp.convex(), 1e3)
    assert answer.error == 0.0
    np.testing.assert_allclose(answer.step, [-0.35, -0.25], atol=1e-5)


def test_an_inequality_that_lets_go_is_noticed() -> None:
    """Its square pulls towards a limit that the answer leaves: the multiplier would need the wrong sign."""
    program, qp = saddle_qp(False, 0.9)
    assert qp.weights is not None
    # A gradient that pushes x - y down, away from the limit.
    away = QP(
        program, qp.lin, qp.pattern, qp.hessian, np.array([3.0, -3.0]), qp.jacobian, qp.lower, qp.upper,
        curved_by=qp.curved_by, weights=qp.weights,
    )  # fmt: skip
    answer = solve_convex(GraphRoute(program), away, np.zeros(2), 1e-9)
    assert qp.linear(answer.step)[0] < qp.upper[0] - 1e-3
    assert not holds(away, answer, 1e-5)


def test_wrong_inertia_takes_gauss_newton_and_right_inertia_does_not() -> None:
    """On the circle H = (1 + 2 lambda) I: negative along the tangent for lambda < -1/2."""
    graph, x = drawn_to([1.0, 0.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0, name="circle")
    program = program_of(graph)
    lin = program.linearize(program.values_from({x: np.array([[-0.8, 0.6]])}))
    exact = ExactHessian(program)
    right = exact.subproblem(lin, np.array([-0.4]), 0.0, Scaling.none(program))
    assert right.curved_by is not None
    np.testing.assert_allclose(full(right), 0.2 * np.eye(2), atol=1e-6)
    wrong = exact.subproblem(lin, np.array([-2.0]), 0.0, Scaling.none(program))
    assert wrong.curved_by is None
    np.testing.assert_allclose(full(wrong), np.eye(2), atol=1e-12)
    assert wrong.pattern is program.normal
    # From multipliers as wrong as these, a solve goes on all the same, and says what it did.
    start = fg.Guess({x: np.array([[-0.8, 0.6]])}, {"circle": np.array([[-2.0]])})
    solution = SQP(hessian="exact").solve(graph, start, check=True)
    np.testing.assert_allclose(solution[x], [[1.0, 0.0]], atol=1e-6)
    assert solution.history[1].details["hessian"] == "gauss-newton"
    assert str(solution.history[-1].details["hessian"]).startswith("exact")


@pytest.mark.parametrize("equality", [True, False])
def test_saddles_are_solved_and_curvature_is_not_clipped(equality: bool) -> None:
    graph, guess = saddle(equality)
    solution = SQP(hessian="exact").solve(graph, guess, check=True)
    x = graph.families["x"]
    np.testing.assert_allclose(solution[x], [[0.15, -0.15]], atol=1e-6)
    if equality:  # a quadratic problem: one Newton step, were it not for differences
        assert solution.iterations <= 2
        assert solution.history[1].details["hessian"] == "exact, with squares"


def test_gauss_newton_model_is_what_it_was() -> None:
    graph, guess = short_drive()
    program = program_of(graph)
    lin = program.linearize(program.values_from(guess))
    narrow, wide = subproblem(program, lin, 0.5), subproblem(program, lin, 0.5, program.normal)
    np.testing.assert_array_equal(full(narrow), full(wide))
    curved = wide.with_curvature(np.full(program.constraints.count, 0.7))
    assert np.abs(full(curved) - full(wide)).max() > 1e-3
    np.testing.assert_array_equal(full(curved.gauss_newton()), full(wide))
