"""Sensitivities: differences of problems that are solved again, and refusals by name."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Mapping
from typing import Any

import numba
import numpy as np
import pytest

import unifg as fg
from problems.control import Problem, Unicycle, problems, sixteen
from problems.graphs import graph_of, graph_with
from unifg.models import unicycle
from unifg.pose_graphs import manhattan, sphere
from unifg.problem.fixed_columns import FixedColumns
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.parameters import datum
from unifg.problem.systems import KktStructure
from unifg.solution import sensitivity
from unifg.solution.gains import unfixed
from unifg.solvers import SQP, GaussNewton, GraduatedNonConvexity, InteriorPoint, LevenbergMarquardt
from unifg.solvers.names import TABLE, backend
from unifg.typing import Array

TIGHT, STEPS = 1e-10, (1e-2, 1e-3, 1e-4, 1e-5)  # of a number near one
CASES = list(dict.fromkeys([*problems(), *sixteen()]))


def vector(solution: fg.Solution, of: list[Any], origin: fg.Solution) -> Array:
    """Numbers that are asked for, values as steps from those of the origin."""
    parts = []
    for one in of:
        if isinstance(one, str):
            parts.append(np.ravel(solution.cost if one == "cost" else solution.dual(one)))
        else:
            selection = one if isinstance(one, fg.Selection) else one[:]
            parts.append(selection.manifold.local(origin[one], solution[one]).ravel())
    return np.concatenate(parts)


class Judge:
    """Columns of derivatives by differences of problems that are solved again."""

    def __init__(self, solver: fg.Solver, graph: Any, guess: Any, data: Mapping[fg.Data, Array] | None = None):
        self.run, self.data = solver.prepare(graph), dict(data or {})
        self.solution = self.run.solve(guess, data=self.data, check=True)

    def column(self, of: list[Any], handle: fg.Data, number: int, step: float) -> Array:
        """One column, of four problems."""
        value = np.array(self.data.get(handle, handle.value), dtype=float)
        parameter = datum(self.solution._program, handle)
        ends = []
        for times in (1.0, -1.0, 2.0, -2.0):
            move = np.zeros(parameter.shape)
            move.flat[number] = times * step
            if parameter.manifold is not None:
                moved = parameter.manifold.retract(value, move)
            elif (value.ndim == 3 and value.shape[1] == value.shape[2]) or handle.name == "information":
                moved = value + 0.5 * (move + np.swapaxes(move, -1, -2))
            else:
                moved = value + move
            again = self.run.solve(self.solution, data={**self.data, handle: moved}, check=True)
            ends.append(vector(again, of, self.solution))
        self.run.solve(self.solution, data=self.data)
        return np.asarray((8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * step))

    def agrees(self, of: list[Any], handle: fg.Data, count: int = 3, bound: float = 1e-5) -> None:
        """Assert that some columns are right, by forward and adjoint solves."""
        found = self.solution.sensitivity(of, handle)
        scale = max(1.0, float(np.abs(found).max()))
        sizes: Array = np.linalg.norm(found, axis=0)
        some = np.unique([int(np.argmax(sizes)), *np.linspace(0, len(sizes) - 1, count).astype(int)[1:]])
        for number in some.tolist():
            errors, expected = [], np.zeros(0)
            if not found[:, number].any():  # of what is not active
                assert np.linalg.norm(self.column(of, handle, number, 1e-3)) <= 1e-6 * scale
                continue
            for step in np.multiply(STEPS, min(1.0, float(np.abs(handle.value).max()) or 1.0)):
                expected = self.column(of, handle, number, step)
                errors.append(
                    np.linalg.norm(found[:, number] - expected) / max(float(np.linalg.norm(expected)), 1e-9 * scale)
                )
            assert min(errors) <= bound, (handle.name, number, errors)
        weights = np.random.default_rng(0).standard_normal(len(found))
        total, at = np.zeros(found.shape[1]), 0
        for one in of:
            size = len(vector(self.solution, [one], self.solution))
            shape = np.shape(self.solution.dual(one)) if isinstance(one, str) and one != "cost" else (len(one), -1)
            own = weights[at : at + size].reshape(() if one == "cost" else shape)
            total += self.solution.gradient({one: own}, handle).ravel()
            at += size
        np.testing.assert_allclose(total, weights @ found, rtol=1e-6, atol=1e-7 * scale * np.sqrt(len(found)))


@pytest.mark.parametrize("problem", CASES, ids=lambda p: p.title)
@pytest.mark.product(3)
def test_control_cases(problem: Problem) -> None:
    stated = problem.formulation()
    of: list[Any] = [stated.x, stated.u, "limits", "dynamics", "cost"]
    for offset in (0.0, 0.01, 0.02, 0.03):  # away from where some limit is about to act
        start = problem.manifold.retract(problem.start[None], np.full((1, problem.manifold.dim), offset))[0]
        judge = Judge(InteriorPoint(tolerance=TIGHT), stated.graph, stated.guess, {stated._start: start})
        try:
            judge.solution.sensitivity(stated.u[0], stated._start)
            break
        except fg.GraphError as error:
            assert "weakly active" in str(error)
    judge.agrees(of, stated._start, 9)
    judge.agrees(of, stated.graph._data["end" if isinstance(problem, Unicycle) else "end p"], 2)


def walk(state: Callable[..., Any]) -> tuple[fg.Graph, fg.Family]:
    """Five poses that are drawn to places, with whatever is stated besides."""
    graph, x = graph_with(fg.SE2, 5)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.1, 0.2], sigma=[0.2, 0.3, 0.1], name="steps")
    graph.minimize(fg.prior, x[0], [0.1, 0.0, 0.3], sigma=[0.4, 0.5, 0.3], name="first")
    state(graph, x)
    return graph, x


def place(x: Array, at: Array) -> Array:
    """Position less a place, a little bent."""
    return np.asarray(x[:, :2] - at + 0.1 * np.sin(x[:, :2] * at))


@numba.njit  # type: ignore[untyped-decorator]
def place_alone(x: Array, at: Array, r: Array) -> None:
    """The same of one factor."""
    for k in range(2):
        r[k] = x[k] - at[k] + 0.1 * np.sin(x[k] * at[k])


def height(x: Array, at: Array) -> Array:
    """A cost that is no square."""
    return np.asarray(np.log(1.0 + (x[:, 0] - at[0]) ** 2 + np.exp(0.3 * at[1]) * (x[:, 1] - at[1]) ** 2))


AT = np.array([[0.3, 0.1], [1.0, 0.6], [1.7, 0.2], [2.6, 1.2], [3.3, 1.6]])
SIGMAS = 0.3 + 0.05 * np.arange(10).reshape(5, 2)
PARAMETERS: dict[str, Callable[[fg.Graph, fg.Family], Any]] = {
    "shared": lambda g, x: g.minimize(place, x, g.data("p", [0.3, -0.2]), sigma=0.4),
    "each": lambda g, x: g.minimize(place, x, g.data("p", AT, each=True), sigma=0.4),
    "two terms": lambda g, x: (
        p := g.data("p", [0.4, 0.2]),
        g.minimize(place, x[1:3], p, sigma=0.4, name="a"),
        g.minimize(fg.residual(place, derivatives="differences"), x[3:], p, sigma=0.5, name="b"),
    ),
    "python": lambda g, x: g.minimize(
        fg.residual(place, derivatives="differences"), x, g.data("p", AT, each=True), sigma=0.4
    ),
    "one factor": lambda g, x: g.minimize(fg.residual(place_alone, rows=2), x, g.data("p", AT[1]), sigma=0.4),
    "one factor, differenced": lambda g, x: g.minimize(
        fg.residual(place_alone, rows=2, derivatives="differences"), x, g.data("p", AT), sigma=0.4
    ),
    "flags": lambda g, x: g.minimize(
        place, x, g.data("p", AT, each=True), sigma=0.4, active=g.data("on", [True, False, True, True, False])
    ),
    "scalar cost": lambda g, x: g.minimize_scalar(height, x, g.data("p", [0.4, 0.2])),
    "scalar cost in python": lambda g, x: g.minimize_scalar(
        fg.residual(height, derivatives="differences"), x[2:3], g.data("p", [0.4, 0.2])
    ),
    "element": lambda g, x: g.minimize(fg.prior, x[3:], g.data("p", [1.0, 2.0, 0.5]), sigma=0.4),
    "elements": lambda g, x: g.minimize(
        fg.between, x[0], x[2:4], g.data("p", [[1.5, 0.2, 0.5], [2.5, 0.9, 0.7]], each=True), sigma=0.2
    ),
    "sigma": lambda g, x: g.minimize(place, x, AT, sigma=g.data("p", 0.4)),
    "sigma of rows": lambda g, x: g.minimize(place, x, AT, sigma=g.data("p", [0.4, 0.7])),
    "sigma of each": lambda g, x: g.minimize(place, x, AT, sigma=g.data("p", SIGMAS)),
    "information": lambda g, x: g.minimize(place, x, AT, information=g.data("information", [[3.0, 1.0], [1.0, 2.0]])),
    "information of each": lambda g, x: g.minimize(
        place, x, AT, information=g.data("information", np.eye(2) + 0.1 * np.arange(5)[:, None, None])
    ),
    "limit": lambda g, x: (
        g.minimize(place, x, AT, sigma=0.4),
        g.constrain(place, x[1:4], AT[1:4], upper=g.data("p", [0.02, -0.1]), lower=-3.0, name="g"),
    ),
    "lower limit": lambda g, x: g.constrain(place, x[1:], AT[1:], lower=g.data("p", 0.5), name="g"),
    "equality": lambda g, x: (
        p := g.data("p", [0.2, 0.1]), g.constrain(place, x[2], AT[2], lower=p, upper=p, name="g")
    ),
    "argument of a constraint": lambda g, x: g.constrain(
        place, x[1:3], g.data("p", AT[1:3], each=True), lower=0.0, upper=0.0, name="g"
    ),
    "price": lambda g, x: g.constrain(place, x[2], AT[2], lower=1.0, soft=g.data("p", 0.4), name="g"),
    "soft limit": lambda g, x: g.constrain(place, x[2], AT[2], lower=g.data("p", 1.0), soft=0.1, name="g"),
    "fix": lambda g, x: (g.fix(x[2], g.data("p", [1.0, 0.5, 0.4])), g.minimize(place, x, AT, sigma=0.4)),
    "fix and argument": lambda g, x: (
        p := g.data("p", [1.0, 0.5, 0.4]), g.fix(x[2], p), g.minimize(fg.prior, x[4], p, sigma=0.4)
    ),
    "fixes": lambda g, x: g.fix(x[1:3], g.data("p", [[1.0, 0.5, 0.4], [2.0, 0.4, 0.6]])),
    "huber": lambda g, x: g.minimize(place, x, g.data("p", [0.3, -0.2]), sigma=0.4, robust=fg.Huber(1.0)),
    "cauchy sigma": lambda g, x: g.minimize(place, x, AT[1], sigma=g.data("p", [0.4, 0.7]), robust=fg.Cauchy(1.0)),
    "robust information": lambda g, x: g.minimize(
        place, x, AT + 0.5, information=g.data("information", [[3.0, 1.0], [1.0, 2.0]]), robust=fg.GemanMcClure(3.0)
    ),
    "truncated": lambda g, x: g.minimize(
        place, x, g.data("p", AT + np.eye(5, 2) * 20.0, each=True), sigma=0.4, robust=fg.TruncatedLeastSquares(5.0)
    ),
}  # fmt: skip


@pytest.mark.product(10)
@pytest.mark.parametrize("kind", PARAMETERS)
def test_every_kind_of_parameter(kind: str) -> None:
    graph, x = walk(PARAMETERS[kind])
    guess = {x: np.array([[k, 0.1 * k, 0.1 * k] for k in range(5)], dtype=float)}
    for family in graph.families.values():
        guess.setdefault(family, np.zeros((family.count, family.manifold.storage)))
    judge = Judge(InteriorPoint(tolerance=TIGHT), graph, guess)
    of: list[Any] = [x, "cost", *(["g"] if any(term.name == "g" for term in graph.terms) else [])]
    parameter = next(data for name, data in graph._data.items() if name != "on")
    judge.agrees(of, parameter, 4, 1e-5)
    judge.agrees([x[-1]], parameter, 2, 1e-5)


@pytest.mark.parametrize("name", [name for name in TABLE if name != "gnc"])
def test_every_backend_has_the_same(name: str) -> None:
    """Of its own answer at a tight tolerance, with the constraints that it takes."""
    solver = backend(name, tolerance=1e-6 if name == "penalty" else 1e-9)
    constraints = solver.constraints

    def state(graph: fg.Graph, x: fg.Family) -> None:
        p = graph.data("p", AT, each=True)
        graph.minimize(place, x, p, sigma=0.4, robust=fg.Huber(2.0) if constraints == "none" else None)
        if constraints != "none":
            graph.constrain(place, x[2], [1.5, 0.4], lower=0.0, upper=0.0, name="g")
        if constraints == "all":
            graph.constrain(lambda x: x[:, :1], x[1:], upper=2.5, name="wall")

    graph, x = walk(state)
    guess = {x: np.array([[k, 0.1 * k, 0.1 * k] for k in range(5)], dtype=float)}
    solution = solver.solve(graph, guess, check=True)
    reference = InteriorPoint(tolerance=TIGHT).solve(graph, guess, check=True)
    found, expected = (one.sensitivity([x, "cost"], "p") for one in (solution, reference))
    assert np.linalg.norm(found - expected, axis=0).max() <= 1e-5 * np.linalg.norm(expected, axis=0).max()
    if constraints == "all":
        assert abs(solution.dual("wall")).max() > 0.1
        Judge(InteriorPoint(tolerance=TIGHT), graph, guess).agrees([x, "g", "wall", "cost"], graph._data["p"], 4)


@pytest.mark.product(2)
@pytest.mark.parametrize("loss", [None, fg.Huber(1.0), fg.DCS(5.0)], ids=str)
@pytest.mark.parametrize("space", [False, True])
def test_measurements_of_a_pose_graph(space: bool, loss: Any) -> None:
    made = sphere(4, 8, seed=1) if space else manhattan(60, seed=1)
    edges, poses = made.pose_graph.edges, made.pose_graph.poses
    graph, x = graph_with(made.pose_graph.group, len(poses))
    graph.fix(x[0], poses[0])
    measured = graph.data("measured", edges.measured, each=True)
    sigma = graph.data("sigma", np.repeat([0.05, 0.02], 3 if space else [2, 1]))
    graph.minimize(fg.between, x[edges.first], x[edges.second], measured, sigma=sigma, robust=loss)
    judge = Judge(InteriorPoint(tolerance=TIGHT), graph, {x: made.truth})
    judge.agrees([x, "cost"], measured, 4)
    judge.agrees([x[-1]], sigma, 2)


def test_graduated_non_convexity_keeps_what_it_believes() -> None:
    made = manhattan(60, seed=1, outliers=0.2)
    edges = made.pose_graph.edges
    graph, x = graph_with(fg.SE2, 60)
    graph.fix(x[0], made.pose_graph.poses[0])
    measured = graph.data("measured", edges.measured, each=True)
    loss = fg.TruncatedLeastSquares(5.0)
    graph.minimize(fg.between, x[edges.first], x[edges.second], measured, sigma=[0.05, 0.05, 0.02], robust=loss)
    solution = GraduatedNonConvexity(solver=LevenbergMarquardt(tolerance=TIGHT)).solve(
        graph, {x: made.truth}, check=True
    )
    found = solution.sensitivity(x, measured).reshape(len(x), 3, -1, 3)
    wrong = np.flatnonzero(made.outliers)
    assert len(wrong) and not found[:, :, wrong].any(), "what is left out moves nothing"
    own = Judge(LevenbergMarquardt(tolerance=TIGHT), graph, solution)
    own.agrees([x, "cost"], measured, 2)


def past_and_future() -> tuple[fg.Graph, fg.Family, fg.Family, dict[fg.Family, Array]]:
    """A unicycle that has measured its places, whose wheel radius is shared with what it is about to do."""
    rng = np.random.default_rng(4)
    graph, x, u, slip = graph_of(("x", fg.SE2, 21), ("u", fg.Rn(2), 10), ("slip", fg.Rn(1), 1))
    driven = np.tile([1.0, 0.3], (10, 1))
    path = [np.zeros(3)]
    for control in driven:
        path.append(unicycle.step(path[-1][None], (0.9 * control)[None], 0.2)[0])
    places = np.array(path)[1:, :2] + 0.02 * rng.standard_normal((10, 2))
    graph.minimize(fg.prior, x[0], np.zeros(3), sigma=[0.1, 0.1, 0.05], name="start")
    graph.minimize(fg.prior, slip, [1.0], sigma=0.2, name="known slip")

    graph.minimize(moved_by, x[:10], graph.data("driven", driven, each=True), slip, x[1:11], sigma=0.03, name="past")
    graph.minimize(lambda x, z: x[:, :2] - z, x[1:11], graph.data("places", places, each=True),
                   sigma=graph.data("gps", 0.05), robust=fg.Huber(1.5), name="places")  # fmt: skip
    graph.constrain(moved_by, x[10:-1], u, slip, x[11:], lower=0.0, upper=0.0, name="future")
    graph.minimize(lambda x, z: x[:, :2] - z, x[11:], graph.data("goal", [4.0, 1.0]), sigma=0.5, name="approach")
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=graph.data("effort", [1.0, 0.5]), name="effort")
    graph.bound(u, lower=graph.data("least", [-1.0, -1.0]), upper=graph.data("most", [1.0, 1.0]), name="limits")
    graph.constrain(lambda x, c, r: np.hypot(x[:, 0] - c[0], x[:, 1] - c[1])[:, None] - r, x[11:],
                    graph.data("centre", [2.8, 1.1]), 0.3, lower=0.0, name="disc")  # fmt: skip
    guess = {x: np.vstack([path, np.tile(path[-1], (10, 1))]), u: driven, slip: np.ones((1, 1))}
    return graph, x, u, guess


def moved_by(x: Array, u: Array, slip: Array, y: Array) -> Array:
    """Defect of a step of 0.2 s with wheels that are smaller than they are taken to be."""
    turn = x[:, 2] + 0.1 * slip[:, 0] * u[:, 1]
    way = 0.2 * slip[:, 0] * u[:, 0]
    off = y[:, 2] - x[:, 2] - 0.2 * slip[:, 0] * u[:, 1]
    return np.stack([y[:, 0] - x[:, 0] - way * np.cos(turn), y[:, 1] - x[:, 1] - way * np.sin(turn), off], axis=1)


@pytest.mark.parametrize("data", ["driven", "places", "gps", "goal", "effort", "least", "most", "centre"])
def test_a_joint_graph_of_a_unicycle(data: str) -> None:
    graph, x, u, guess = past_and_future()
    judge = Judge(InteriorPoint(tolerance=TIGHT), graph, guess)
    assert np.abs(judge.solution.dual("disc")).max() > 0.01 and np.abs(judge.solution.dual("limits")).max() > 0.01
    judge.agrees([x, u, graph.families["slip"], "limits", "disc", "future", "cost"], graph._data[data], 3)


def refused(solution: fg.Solution, words: str, of: Any = "x", wrt: Any = "p") -> None:
    """Assert that a question is refused, both ways."""
    with pytest.raises(fg.GraphError, match=words):
        solution.sensitivity(of, wrt)
    with pytest.raises(fg.GraphError, match=words):
        solution.gradient({of: 1.0}, wrt)


def point(state: Callable[[fg.Graph, fg.Family], Any], tolerance: float = 1e-8, begin: Any = 0.1) -> fg.Solution:
    """One point in the plane."""
    graph, x = graph_with(fg.Rn(2))
    state(graph, x)
    guess = {x: np.broadcast_to(np.asarray(begin, dtype=float), (1, 2))}
    return InteriorPoint(tolerance=tolerance).solve(graph, guess)


def test_what_did_not_converge_has_no_sensitivities() -> None:
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(lambda x, p: np.sin(x) - p, x, graph.data("p", [0.3, 0.1]))
    refused(LevenbergMarquardt(max_iterations=1).solve(graph, {x: [[1.0, 1.0]]}), "ITERATION_LIMIT")


@pytest.mark.parametrize("limit", [1.0, 1.0 + 5e-4, 1.0 - 5e-4])
def test_weakly_active_rows_are_refused_by_name(limit: float) -> None:
    """A limit at the free optimum; its derivative from one side is not that from the other."""

    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize(fg.prior, x, graph.data("p", [1.0, 2.0]))
        graph.constrain(lambda x: x, x, upper=[5.0, 5.0], name="far")
        graph.constrain(lambda x: x, x, upper=[limit, 5.0], name="wall")

    refused(point(state), r"'wall', factor 0, row 0, is weakly active.*both below 1.0e-03")


@pytest.mark.parametrize("limits", [(-math.inf, 1.0), (-5.0, 1.0), (1.0, 1.0)], ids=str)
@pytest.mark.parametrize("price", [(1e8, 0.0), (0.0, 3.0), (0.0, 1e8), (0.1, 1e8)], ids=str)
def test_prices_make_no_row_weakly_active(price: tuple[float, float], limits: tuple[float, float]) -> None:
    """Neither large ones the multipliers beside them, nor squares the limits of slacks that nothing pulls at."""

    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize(fg.prior, x, graph.data("p", [1.3, 0.5]))
        lower, upper = limits
        graph.constrain(lambda x: x, x, lower=[lower, -5.0], upper=[upper, 5.0], soft=fg.Soft(*price), name="wall")

    solution = point(state)
    gives = 1.0 / (1.0 + price[1]) if price[1] else 0.0  # of x - p + w + q (x - 1) = 0
    expected = [[gives, 0.0], [0.0, 1.0], [1.0 - gives, 0.0], [0.0, 0.0]]
    np.testing.assert_allclose(solution.sensitivity(["x", "wall"], "p"), expected, atol=1e-6)


@pytest.mark.parametrize("price", [0.3, fg.Soft(0.3, 3.0)], ids=["linear", "both"])
def test_a_row_that_is_about_to_give_way_is_weakly_active(price: Any) -> None:
    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize(fg.prior, x, graph.data("p", [1.3, 0.5]))
        graph.constrain(lambda x: x, x, upper=[1.0, 5.0], soft=price, name="wall")

    refused(point(state), "'wall: slack', factor 0, row 0, is weakly active")


@pytest.mark.parametrize("equal", [False, True])
@pytest.mark.parametrize("each", [False, True])
def test_square_prices_next_to_nothing_have_derivatives(equal: bool, each: bool) -> None:
    """They enter by their root, which has a slope at zero only beside what it is multiplied by."""
    prices, graph = np.array([[0.0, 1e-7], [1e3, 2.0]] if each else [0.0, 2.0]), fg.Graph()
    x, price = graph.variables("x", fg.Rn(2), 2), graph.data("q", prices)
    graph.minimize(fg.prior, x, [3.0, 3.0])
    lower, soft = 1.0 if equal else -math.inf, fg.Soft(0.5, price)
    graph.constrain(lambda x: x, x, lower=lower, upper=1.0, soft=soft, name="wall")
    solution = InteriorPoint(tolerance=1e-10).solve(graph, {x: np.zeros((2, 2))}, check=True)
    gives = 1.5 / (1.0 + np.broadcast_to(prices, (2, 2)))  # of x - 3 + 0.5 + q (x - 1) = 0
    slopes, heights = -gives / (1.0 + np.broadcast_to(prices, (2, 2))), 0.5 * gives**2
    expected = np.diag(slopes.ravel()) if each else np.vstack([np.diag(row) for row in slopes])
    np.testing.assert_allclose(solution.sensitivity(x, price), expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(solution.gradient("cost", price), heights if each else heights.sum(axis=0), rtol=1e-6)


def test_a_refused_question_leaves_no_factor_behind() -> None:
    graph = fg.Graph()
    x, p = graph.variables("x", fg.Rn(2), 1), graph.data("p", [3.0, 2.0])
    graph.minimize(lambda x, p: np.sinh(x - p), x, p)
    graph.constrain(lambda x: x, x, upper=[1.0, 5.0], name="wall")
    run = InteriorPoint(tolerance=1e-8).prepare(graph)
    held = run.solve({x: np.full((1, 2), 0.1)}, check=True)
    expected = held.sensitivity("x", p)
    np.testing.assert_allclose(expected, [[0.0, 0.0], [0.0, 1.0]], atol=1e-9)
    refused(run.solve({x: np.full((1, 2), 0.1)}, data={p: [1.0, 2.0]}), "weakly active")
    np.testing.assert_array_equal(held.sensitivity("x", p), expected)


def test_a_limit_that_acts_and_one_that_does_not_are_told_apart() -> None:
    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize(fg.prior, x, graph.data("p", [1.0, 2.0]))
        graph.constrain(lambda x: x, x, upper=[0.98, 2.02], name="wall")

    solution = point(state)
    np.testing.assert_allclose(solution.sensitivity(["x", "wall"], "p"), [[0, 0], [0, 1], [1, 0], [0, 0]], atol=1e-9)


def test_redundant_equalities_leave_values_and_refuse_multipliers() -> None:
    def state(graph: fg.Graph, x: fg.Family) -> None:
        p, q = graph.data("p", [1.0, 2.0]), graph.data("q", 0.5)
        graph.minimize(fg.prior, x, p)
        for name in ("once", "again"):
            graph.constrain(lambda x: x.sum(axis=1, keepdims=True), x, lower=q, upper=q, name=name)
        graph.constrain(lambda x: x.sum(axis=1, keepdims=True), x, lower=0.5, upper=graph.data("r", 0.5), name="third")

    solution = point(state)
    assert solution.converged
    half = 0.5 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    np.testing.assert_allclose(solution.sensitivity("x", "p"), half, atol=1e-9)
    np.testing.assert_allclose(solution.gradient({"x": [[1.0, 0.0]]}, "p"), half[0], atol=1e-9)
    refused(solution, r"'(once|again|third)', factor 0, row 0, .* multipliers are not unique", "again")
    refused(solution, "contradict each other", "x", "q")
    refused(solution, "one limit of the equality 'third'", "x", "r")


def test_what_rounding_leaves_unsolved_is_no_contradiction(monkeypatch: pytest.MonkeyPatch) -> None:
    """A graph of least squares alone has no constraints that could contradict each other."""

    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize(fg.prior, x, graph.data("p", [1.0, 2.0]))

    solution = point(state)
    assert np.allclose(solution.sensitivity("x", "p"), np.eye(2))
    monkeypatch.setattr(sensitivity, "SOLVED", -1.0)
    monkeypatch.setattr(sensitivity, "_tried", lambda _, right: (right, np.full(len(right), 2.0)))
    with pytest.raises(fg.GraphError, match="lost to rounding: a direction is hardly determined"):
        solution.sensitivity("x", "p")


def test_a_free_gauge_is_refused_by_name() -> None:
    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize(lambda x, p: x[:, :1] - p, x, graph.data("p", 1.0))
        graph.constrain(lambda x: x[:, :1] ** 2 + 0.0 * x[:, 1:], x, upper=4.0, name="wall")

    refused(point(state), r"reduced Hessian is singular: x\[0\] can move")


def test_a_saddle_is_refused() -> None:
    """The KKT conditions hold at the top of a hill."""

    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize_scalar(lambda x, p: np.cos(x[:, 0]) + 0.5 * (x[:, 1] - p) ** 2, x, graph.data("p", 1.0))
        graph.constrain(lambda x: x, x, upper=9.0, name="wall")

    graph, x = graph_with(fg.Rn(2))
    state(graph, x)
    refused(SQP().solve(graph, {x: [[0.0, 1.0]]}, check=True), "reduced Hessian is indefinite")


def test_kinks_flags_losses_and_names_are_refused() -> None:
    class Own:
        held = False

        def value(self, squared: Array) -> Array:
            return np.asarray(np.log1p(squared))

        def weight(self, squared: Array) -> Array:
            return np.asarray(1.0 / (1.0 + squared))

    def state(graph: fg.Graph, x: fg.Family) -> None:
        graph.minimize(lambda x, p: x - np.abs(p), x, graph.data("p", [0.0, 1.0]))
        graph.minimize(fg.prior, x, graph.data("q", [1.0, 1.0]), active=graph.data("flag", [True]), name="prior")

    solution = point(state)
    refused(solution, r"'.*' has a kink or a jump near the present 'p' \(factor 0\)")
    refused(solution, "'flag' are booleans", "x", "flag")
    refused(solution, "'x' is solved for", "x", "x")
    refused(solution, r"called 'y' \(there are: p, q, flag, x\)", "x", "y")
    refused(solution, r"called 'y' \(there are: x, cost\)", "y", "q")
    refused(solution, "(float64|ndarray) is no data", "x", np.zeros(2))
    refused(solution, "does not belong", "x", fg.Graph().data("p", 1.0))
    with pytest.raises(fg.GraphError, match=r"weights of <1 of x> have shape \(3,\), expected \(1, 2\)"):
        solution.gradient({"x": [1.0, 2.0, 3.0]}, "q")
    none: list[tuple[Any, str]] = [([np.nan, 1.0], "finite"), (["a", "b"], "text"), (np.ma.array([1.0, 1.0]), "masked")]
    for weights, why in none:
        with pytest.raises(fg.GraphError, match=f"gradient: weights of .*{why}"):
            solution.gradient({"x": weights}, "q")
    with pytest.raises(fg.GraphError, match="of what"):
        solution.sensitivity([], "q")
    refused(point(lambda g, x: g.minimize(fg.prior, x, g.data("p", [0.0, 1.0]), robust=Own(), name="own")), "'own'")


@pytest.mark.parametrize(("family", "limit"), [("x", "x"), ("x", "cost"), ("cost", "limit")])
def test_a_name_of_two_things_is_refused(family: str, limit: str) -> None:
    graph = fg.Graph()
    x, to = graph.variables(family, fg.Rn(1), 2), graph.data("to", [2.0])
    graph.minimize(fg.prior, x, to, name="there")
    graph.bound(x, upper=1.0, name=limit)
    solution = InteriorPoint(tolerance=1e-9).solve(graph, {x: np.zeros((2, 1))}, check=True)
    shared = "x" if limit == "x" else "cost"
    for ask in (solution.sensitivity, solution.gradient):
        with pytest.raises(fg.GraphError, match=f"'{shared}' is the name of .* and of .*: give the family itself"):
            ask(shared, to)
    assert solution.sensitivity(x, to) == pytest.approx(0.0, abs=1e-9)


def test_rows_between_fixed_variables_say_nothing() -> None:
    """Neither that they are weakly active, nor that they depend on others."""
    graph, x = graph_with(fg.Rn(2), 2)
    p = graph.data("p", [1.0, 2.0])
    graph.fix(x[0], p)
    graph.constrain(lambda x: x, x[0], lower=[1.0, 2.0], upper=[1.0, 9.0], name="kept")
    graph.minimize(fg.difference, x[0], x[1])
    graph.constrain(lambda x, y: y - 2.0 * x, x[0], x[1], lower=0.0, upper=0.0, name="twice")
    solution = InteriorPoint(tolerance=1e-8).solve(graph, {x: np.ones((2, 2))}, check=True)
    expected = np.vstack([2.0 * np.eye(2), np.zeros((2, 2)), -np.eye(2), [[1.0, 2.0]]])
    found = solution.sensitivity([x[1], "kept", "twice", "cost"], p)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_data_that_have_been_replaced_are_noticed() -> None:
    graph, x = graph_with(fg.Rn(2))
    p = graph.data("p", [1.0, 2.0])
    graph.minimize(lambda x, p: np.sinh(x - p * p), x, p)
    run = GaussNewton(tolerance=TIGHT).prepare(graph)
    first, later = (run.solve({x: np.zeros((1, 2))}, data={p: value}) for value in ([1.0, 1.5], [1.2, 1.5]))
    refused(first, "have been replaced")
    np.testing.assert_allclose(later.sensitivity("x", p), np.diag([2.4, 3.0]), rtol=1e-9)
    run.solve({x: np.zeros((1, 2))}, data={p: [1.3, 1.5]})
    np.testing.assert_array_equal(later.gradient("cost", p), 0.0)  # what has been asked is known
    again = run.solve({x: np.zeros((1, 2))}, data={p: [1.2, 1.5]})
    np.testing.assert_allclose(again.sensitivity("x", p), later.sensitivity("x", p), rtol=1e-9)
    many = LevenbergMarquardt(tolerance=TIGHT).prepare(graph)
    single = many.solve({x: np.zeros((1, 2))}, data={p: [1.0, 1.5]})
    batch = many.solve_many({x: np.zeros((1, 2))}, data={p: np.array([[1.0, 1.5], [1.1, 1.5], [1.2, 1.5]])})
    refused(single, "have been replaced")
    np.testing.assert_allclose(batch.solution(1).sensitivity("x", p), np.diag([2.2, 3.0]), rtol=1e-9)
    q = graph.data("q", 0.0)
    graph.minimize_scalar(lambda x, q: q * ((x - 1.44) ** 2).sum(axis=1), x, q, name="bent, and flat at the answer")
    own = InteriorPoint(tolerance=TIGHT).prepare(graph)
    flat = own.solve({x: np.ones((1, 2))}, data={p: [1.2, 1.2], q: 0.0})
    own.solve(flat, data={p: [1.2, 1.2], q: 3.0})
    refused(flat, "have been replaced")


def test_fixed_variables_and_several_questions_at_once() -> None:
    stated = Unicycle("straight", False, 20).formulation()
    solution = InteriorPoint(tolerance=TIGHT).solve(stated.graph, stated.guess, check=True)
    both = solution.sensitivity([stated.x[0], stated.x[3:5], "cost"], [stated.x[0], "end"])
    assert both.shape == (10, 6)
    np.testing.assert_array_equal(both[:3], np.eye(3, 6))
    np.testing.assert_array_equal(
        both[:, :3], solution.sensitivity(["state", "cost"], "start")[[0, 1, 2, *range(9, 15), -1]]
    )
    np.testing.assert_allclose(both[-1, :3], -solution.dual("state fixed")[0], rtol=1e-9)  # what the reaction says
    start, end = (solution.gradient("cost", name) for name in ("start", "end"))
    np.testing.assert_allclose(np.concatenate([start, end]), both[-1], rtol=1e-9)
    gain = solution.gains(stated.x[:1], stated.u[:1])[0]
    np.testing.assert_allclose(solution.sensitivity(stated.u[0], "start"), gain, atol=1e-9)


def test_a_solution_that_was_sent_is_asked_again() -> None:
    solution = point(lambda graph, x: graph.minimize(fg.prior, x, graph.data("p", [1.0, 2.0])))
    expected = solution.sensitivity("x", "p")
    sent = pickle.loads(pickle.dumps(solution))
    np.testing.assert_array_equal(sent.sensitivity("x", "p"), expected)
    assert sent.tolerance == solution.tolerance == 1e-8


def in_python(x: Array, y: Array) -> Array:
    """No trace follows this."""
    return np.array([[math.sin(a[0] * b[1]) + b[0] ** 2, a[1] * b[0] * b[1]] for a, b in zip(x, y, strict=True)])


def product(x: Array, y: Array) -> Array:
    return np.stack([np.sin(x[:, 0]) * y[:, 1], x[:, 1] * y[:, 0] ** 2], axis=1)


BESIDE: dict[str, Callable[[fg.Graph, fg.Family], Any]] = {
    "cost": lambda g, x: g.minimize(product, x[:-1], x[1:], sigma=[0.5, 2.0]),
    "the same variable twice": lambda g, x: g.minimize(lambda x, y, z: x * y * z, x[0], x[1], x[1]),
    "loss": lambda g, x: g.minimize(product, x[:-1], x[1:], sigma=0.3, robust=fg.Cauchy(0.5)),
    "in Python": lambda g, x: g.minimize(in_python, x[:-1], x[1:]),
    "constraint": lambda g, x: g.constrain(product, x[:-1], x[1:], lower=0.3, upper=0.3, name="g"),
    "constraint in Python": lambda g, x: g.constrain(in_python, x[:-1], x[1:], upper=0.2, name="g"),
    "scalar": lambda g, x: g.minimize_scalar(lambda x, y: np.sin(x[:, 0] * y[:, 1]) - x[:, 1] * y[:, 0], x[:-1], x[1:]),
    "scalar in Python": lambda g, x: g.minimize_scalar(lambda x, y: in_python(x, y).sum(axis=1), x[:-1], x[1:]),
}


@pytest.mark.parametrize("kind", BESIDE)
def test_columns_of_fixed_variables_are_those_of_the_problem_without_the_fix(kind: str) -> None:
    graph, x = graph_with(fg.Rn(2), 4)
    graph.fix(x[[0, 2]], [[0.3, -0.5], [0.8, 0.2]])
    graph.minimize(fg.prior, x, np.array([[0.2, 0.1], [1.0, 0.7], [0.4, 0.4], [-0.6, 1.2]]), name="prior")
    BESIDE[kind](graph, x)
    program = graph.compile()
    lin = program.linearize({x: np.array([[0.3, -0.5], [0.9, 0.8], [0.8, 0.2], [-0.7, 1.1]])})
    multipliers = np.linspace(0.5, 1.5, program.constraints.count)
    columns = program.columns.of(x[[0, 2]]).ravel()
    numbers = np.full(program.columns.width, -1)
    numbers[columns] = np.arange(len(columns))
    found = FixedColumns(program, numbers)
    matrix = np.zeros((program.size + len(multipliers), len(columns)))
    matrix[found.rows, found.coordinates] = found.entries(program, lin, multipliers, np.zeros(len(matrix), dtype=bool))
    assert (np.diff(found.coordinates * len(matrix) + found.rows) > 0).all()
    twin, here = unfixed(program, columns, lin)
    upper = twin.normal.matrix(lagrangian_hessian(twin, here, multipliers)).toarray()
    hessian = np.triu(upper) + np.triu(upper, 1).T
    slopes = twin.constraints.matrix(here.constraint_jacobian).toarray()
    rounding = 1e-6 if "Python" in kind else 1e-13
    assert np.abs(matrix).max() > 0.05
    np.testing.assert_allclose(matrix[: program.size], hessian[np.ix_(program.columns.free, columns)], atol=rounding)
    np.testing.assert_allclose(matrix[program.size :], slopes[:, columns], atol=rounding)


def test_structure_is_found_once_and_one_factor_serves_several_solutions(monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory of the factor is borrowed: what another solution left there is replaced."""
    stated = Unicycle("straight", False, 20).formulation()
    run = InteriorPoint(tolerance=TIGHT).prepare(stated.graph)
    starts = np.zeros(3), np.array([0.1, 0.05, -0.1])
    first = run.solve(stated.guess, data={stated._start: starts[0]}, check=True)
    asked: list[Any] = [stated.u[0], "limits"]
    expected = first.sensitivity(asked, stated.x[0])
    with monkeypatch.context() as patch:
        patch.setattr(FixedColumns, "__init__", None)
        patch.setattr(KktStructure, "of", None)
        second = run.solve(stated.guess, data={stated._start: starts[1]}, check=True)
        other = second.sensitivity(asked, stated.x[0])
    assert np.abs(other - expected).max() > 1e-3
    assert first._sensitivities._structure is second._sensitivities._structure
    assert len(first._sensitivities._structure.kkt.spare) == 1
    np.testing.assert_array_equal(first.sensitivity(stated.u[0], stated.x[0]), expected[:2])
    np.testing.assert_array_equal(second.sensitivity(asked, stated.x[0]), other)


def test_few_structures_of_questions_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensitivity, "KEPT", 2)
    known: dict[Any, str] = {}
    found = [sensitivity.remembered(known, key, lambda key=key: key.upper()) for key in "abbca"]  # type: ignore[misc]
    assert found == list("ABBCA") and list(known) == ["c", "a"]
