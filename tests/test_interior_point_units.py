"""The interior point on problems whose unknowns, rows and costs come in units far apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import graph_with
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
