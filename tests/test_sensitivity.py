"""Sensitivities: differences of problems that are solved again, and refusals by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.control import Problem, Unicycle, sixteen, problems
from unifg.horizon import Context, ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Window
from unifg.models import bicycle, rkmk, unicycle
from unifg.problem.parameters import datum
from unifg.solvers import SQP, InteriorPoint, LevenbergMarquardt
from unifg.solvers.names import TABLE, backend
from unifg.typing import Array

TIGHT, STEPS = 1e-10, (1e-2, 1e-3, 1e-4, 1e-5)
CASES = list(dict.fromkeys([*problems(), *sixteen()]))


def vector(solution: fg.Solution, of: list[Any], origin: fg.Solution) -> Array:
    """What is asked for, values as steps from those of the origin."""
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

    def __init__(self, solver: fg.Solver, graph: fg.Graph, guess: Any, data: Mapping[fg.Data, Array] | None = None):
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
            elif value.ndim == 3 and value.shape[1] == value.shape[2] or handle.name == "information":
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
        some = np.unique(np.linspace(0, found.shape[1] - 1, count).astype(int))
        for number in some.tolist():
            errors, expected = [], np.zeros(0)
            for step in STEPS:
                expected = self.column(of, handle, number, step)
                errors.append(np.linalg.norm(found[:, number] - expected) / max(np.linalg.norm(expected), 1e-9 * scale))
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
@pytest.mark.product(5)
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
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, 5)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.1, 0.2], sigma=[0.2, 0.3, 0.1], name="steps")
    graph.minimize(fg.prior, x[0], [0.1, 0.0, 0.3], sigma=[0.4, 0.5, 0.3], name="first")
    state(graph, x)
    return graph, x


def place(x: Array, at: Array) -> Array:
    """Position less a place, a little bent."""
    return np.asarray(x[:, :2] - at + 0.1 * np.sin(x[:, :2] * at))


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
    "sigma of each factor": lambda g, x: g.minimize(place, x, AT, sigma=g.data("p", SIGMAS[:, :1])),
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
    "fix": lambda g, x: (g.fix(x[2], g.data("p", [1.0, 0.5, 0.4])), g.minimize(place, x, AT, sigma=0.4)),
    "fix and argument": lambda g, x: (
        p := g.data("p", [1.0, 0.5, 0.4]), g.fix(x[2], p), g.minimize(fg.prior, x[4], p, sigma=0.4)
    ),
    "fixes": lambda g, x: g.fix(x[1:3], g.data("p", [[1.0, 0.5, 0.4], [2.0, 0.4, 0.6]])),
    "huber": lambda g, x: g.minimize(place, x, g.data("p", [0.3, -0.2]), sigma=0.4, robust=fg.Huber(1.0)),
    "cauchy sigma": lambda g, x: g.minimize(place, x, AT[:1] + 1.0, sigma=g.data("p", [0.4, 0.7]), robust=fg.Cauchy(1.0)),
    "robust information": lambda g, x: g.minimize(
        place, x, AT + 0.5, information=g.data("information", [[3.0, 1.0], [1.0, 2.0]]), robust=fg.GemanMcClure(3.0)
    ),
    "truncated": lambda g, x: g.minimize(
        place, x, g.data("p", AT + np.eye(5, 2) * 20.0, each=True), sigma=0.4, robust=fg.TruncatedLeastSquares(5.0)
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", PARAMETERS)
def test_every_kind_of_parameter(kind: str) -> None:
    graph, x = walk(PARAMETERS[kind])
    guess = {x: np.array([[k, 0.1 * k, 0.1 * k] for k in range(5)], dtype=float)}
    for family in graph.families.values():
        guess.setdefault(family, np.zeros((family.count, family.manifold.storage)))
    judge = Judge(InteriorPoint(tolerance=1e-11 if "python" in kind else TIGHT), graph, guess)
    of: list[Any] = [x, "cost", *(["g"] if any(term.name == "g" for term in graph.terms) else [])]
    parameter = next(iter(graph._data.values()))
    judge.agrees(of, parameter, 4, 1e-5)
    judge.agrees([x[-1]], parameter, 2, 1e-5)
