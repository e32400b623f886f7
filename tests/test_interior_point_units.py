"""The interior point on problems whose unknowns, rows and costs come in units far apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import graph_of, graph_with
from unifg.horizon import Constant, ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Window
from unifg.models import unicycle
from unifg.solvers import InteriorPoint
from unifg.typing import Array
from units import COST, OTHER_COST, drive

DRIVES: list[dict[str, Any]] = [
    {"dynamics": 1e-6},
    {"dynamics": 1e-4},
    {"dynamics": 1e6},
    {"clearance": 1e-8},
    {"clearance": 1e-6},
    {"clearance": 1e8},
    {"cost": 1e4},
    {"cost": 1e6},
    {"cost": 1e8},
    {"position": 1e4, "control": 1e-4},
    {"position": 1e-8},
    {"angle": 1e4},
    {"control": 1e8},
    {"dynamics": 1e6, "clearance": 1e-6, "control": 1e4},
]


@pytest.mark.parametrize("units", DRIVES, ids=str)
def test_a_drive_is_solved_in_any_units(units: dict[str, Any]) -> None:
    graph, guess = drive(**units)
    solution = InteriorPoint().solve(graph, guess, check=True)
    assert solution.iterations <= 60
    weight = units.get("cost", 1.0) ** 2
    known = np.array([COST, OTHER_COST]) * weight
    assert np.abs(solution.cost / known - 1.0).min() < 1e-4


@pytest.mark.parametrize("units", [{"clearance": 1e-6}, {"clearance": 1e8}, {"dynamics": 1e6}], ids=str)
def test_multipliers_are_those_of_the_rows_as_stated(units: dict[str, Any]) -> None:
    """Times what a row was multiplied with, they are those of the row itself."""
    found = []
    plain = InteriorPoint(tolerance=1e-8).solve(*drive(), check=True)
    known: list[dict[str, Any]] = [{}, units]
    for given in known:
        graph, _ = drive(**given)
        start = {graph.families[family.name]: plain[family] for family in plain.values}
        solution = InteriorPoint(tolerance=1e-8).solve(graph, start, check=True)
        rows = ("disc", "clearance"), ("dynamics", "dynamics")
        found.append([solution.dual(name) * given.get(unit, 1.0) for name, unit in rows])
    for mine, other in zip(*found, strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-3 * np.abs(mine).max())


@pytest.mark.parametrize("row", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize("unit", [1e-8, 1e-4, 1.0, 1e2])
def test_scalar_costs_in_any_units(unit: float, row: float) -> None:
    """The valley of Rosenbrock within a disc; the unknowns are as large as 1e8 or as small as 1e-2."""

    def valley(v: Array) -> Array:
        p = v * unit
        return np.asarray((1.0 - p[:, 0]) ** 2 + 100.0 * (p[:, 1] - p[:, 0] ** 2) ** 2)

    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(valley, x)
    graph.constrain(lambda v: row * ((v * unit) ** 2).sum(axis=1, keepdims=True), x, upper=row, name="disc")
    solution = InteriorPoint().solve(graph, {x: np.array([[-1.0, 0.5]]) / unit}, check=True)
    if row >= 1.0 and unit >= 1.0:  # elsewhere the tolerance, which is in the units of the problem, asks for less
        np.testing.assert_allclose(solution[x] * unit, [[0.786415, 0.617698]], atol=1e-4)


def test_units_are_an_option() -> None:
    graph, guess = drive(dynamics=1e6)
    assert InteriorPoint().solve(graph, guess).converged
    assert not InteriorPoint(scaling=False, max_iterations=60).solve(graph, guess).converged


def test_the_judge_agrees_on_rows_that_were_scaled() -> None:
    graph, guess = drive(clearance=1e4)
    solution = InteriorPoint(tolerance=1e-7).solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 1e-4


def apart(p: Array, q: Array) -> Array:
    """(n, 1) distances of poses from points."""
    return np.asarray(np.linalg.norm(p[:, :2] - q, axis=1, keepdims=True))


class Pillar:
    """A pillar on the map, uncertain: distances to it are measured, the plan keeps off it and ends at a goal."""

    name = "pillar"

    def __init__(self, metre: float, past: bool) -> None:
        """Say how long a metre is, and whether this is the past or the plan."""
        self.metre, self.past = metre, past
        self.records: dict[str, tuple[int, ...]] = {"distance": (1,)} if past else {}

    def state(self, graph: Any, x: Any, u: Any) -> None:
        """Add the measurements, or the clearance, the limits and the goal."""
        pillar, metre = graph.families["pillar"][0], self.metre
        if self.past:
            seen = graph.data("distance", np.ones((len(x), 1)), each=True)
            known = graph.data("known", np.zeros(len(x), dtype=bool), each=True)
            sigma = 0.05 * metre
            graph.minimize(lambda p, q, z: apart(p, q) - z, x, pillar, seen, sigma=sigma, active=known, name="pillar")
        else:
            graph.constrain(apart, x[1:], pillar, lower=1.1 * metre, name="keep off")
            graph.bound(u, lower=[-metre, -1.0], upper=[metre, 1.0], name="limits")
            sigmas = [0.3 * metre, 0.3 * metre, 0.5]
            graph.minimize(fg.prior, x[-1], [4.0 * metre, metre, 0.3], sigma=sigmas, name="goal")

    def data(self, now: Any) -> dict[str, Any]:
        """Measurements of the past."""
        return dict(zip(("distance", "known"), now.past.recorded("distance"), strict=True)) if self.past else {}


@pytest.mark.parametrize("metre", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_a_joint_window_takes_a_few_iterations_in_any_unit_of_length(metre: float) -> None:
    """Curvatures 1e10 apart, and priors of empty places, once made it a thousand in kilometres and in micrometres."""
    length, sigma = np.array([metre, metre, 1.0]), np.array([0.02, 0.01, 0.02])
    robot = Robot(
        fg.SE2, fg.Rn(2), constants=(Constant("pillar", fg.Rn(2), np.array([[1.0, 1.5]]) * metre, 0.5 * metre),),
        predict=lambda x, u: unicycle.step(x[None], u, 0.2)[0],
    )  # fmt: skip
    fix = Measurement("fix", lambda x, z: x[:, :2] - z, (2,), 0.1 * metre)
    past: list[Any] = [Dynamics(unicycle.dynamics, 0.2, sigma=sigma * length), Pillar(metre, True), fix]
    plan: list[Any] = [
        Dynamics(unicycle.dynamics, 0.2),
        ControlCost([metre, 1.0], change=[0.5 * metre, 0.5]),
        Pillar(metre, False),
    ]
    loop = RecedingHorizon(
        robot, 8, plan, solver=InteriorPoint(feasibility_tolerance=1e-6 * metre), coupling="joint", pull=np.inf,
        window=Window(robot, 5, past, start=[0.0, 0.0, 0.0], sigma=0.1 * length),
    )  # fmt: skip
    controls = np.random.default_rng(3).normal([0.8, 0.0], [0.1, 0.2], (6, 2))
    states = unicycle.rollout(np.zeros(3), controls, 0.2)
    for k, state in enumerate(states):
        seen = {"distance": np.hypot(*(state[:2] - [1.1, 1.4]))[None] * metre, "fix": state[:2] * metre}
        loop.tick(
            None,
            seen if k % 2 else {"distance": seen["distance"]},
            applied=None if k == 0 else controls[k - 1] * length[1:],
        )
        solution = loop.solution
        assert solution is not None and solution.converged and solution.iterations <= (8 if k else 30)


@pytest.mark.parametrize("heading", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3])
def test_a_heading_next_to_nothing_gives_the_way_ahead_no_unit(heading: float) -> None:
    """A lateral error sees the way ahead by the heading alone: its curvature there is no unit of another kind."""
    graph, x, u = graph_of(("x", fg.SE2, 16), ("u", fg.Rn(2), 15))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, u, [1.0, 0.0], sigma=0.5, name="cruise")
    graph.minimize(lambda x: x[:, 1:2], x[1:], sigma=0.5, name="lane")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.2, lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=[0.0, -1.0], upper=[1.0, 1.0], name="limits")
    graph.constrain(fg.difference, u[:-1], u[1:], lower=-0.15, upper=0.15, name="changes")
    graph.constrain(lambda x: 1.0 - x[:, :1], x[4:], lower=0.0, name="stop")
    states = unicycle.rollout(np.array([0.0, 0.0, heading]), np.tile([0.3, 0.0], (15, 1)), 0.2)
    states[0, 2] = 0.0
    solution = InteriorPoint().solve(graph, {x: states, u: np.tile([0.3, 0.0], (15, 1))})
    assert solution.converged and solution.iterations <= 25, (solution.status, solution.iterations)
