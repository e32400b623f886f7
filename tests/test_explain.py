"""``solution.explain()`` on staged problems: the sentence names the culprit."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from problems.cops import PROBLEMS
from problems.graphs import drawn_to, graph_of
from unifg.solvers import AugmentedLagrangian, GaussNewton, InteriorPoint
from unifg.typing import Array


def sentence(solution: fg.Solution, start: str) -> str:
    """The one sentence of an explanation that begins so."""
    found = [line for line in solution.explain().splitlines() if line.startswith(start)]
    assert len(found) == 1, solution.explain()
    return found[0]


def chain(limit: float = 0.8) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """A cart that is pushed towards 4, with limits on the pushes."""
    graph, x, u = graph_of(("x", fg.Rn(1), 6), ("u", fg.Rn(1), 5))
    graph.fix(x[0], [0.0])
    graph.minimize(fg.prior, x[-1], [4.0], sigma=0.5, name="goal")
    graph.minimize(fg.prior, u, [0.0], name="effort")
    graph.constrain(lambda a, u, b: b - a - u, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
    caps = np.full((5, 1), 10.0)
    caps[3] = limit
    graph.bound(u, lower=-10.0, upper=caps, name="limits")
    return graph, {x: np.zeros((6, 1)), u: np.zeros((5, 1))}


def test_the_constraint_that_holds_is_named_with_its_gain() -> None:
    graph, guess = chain(0.2)
    solution = InteriorPoint(tolerance=1e-9).solve(graph, guess, check=True)
    said = sentence(solution, "'limits'")
    gain = abs(float(solution.dual("limits")[3, 0]))
    assert "holds the solution in 1 row, most in factor 3, row 0 (u[3])" in said
    assert f"upper limit is loosened saves about {gain:.3g} of the cost" in said
    looser, guess = chain(0.2 + 1e-4)
    cheaper = InteriorPoint(tolerance=1e-9).solve(looser, guess, check=True)
    assert solution.cost - cheaper.cost == pytest.approx(1e-4 * gain, rel=1e-3)  # what it says is so
    assert "'motion' costs most" in sentence(solution, "The equality")
    free = InteriorPoint(tolerance=1e-9).solve(*chain(5.0), check=True)
    assert "'limits'" not in free.explain()


def test_conditions_stated_twice_are_told_beside_what_loosening_saves() -> None:
    """They may share any multiplier: 184 of cost a unit was promised for a limit whose loosening saves nothing."""
    graph, x = drawn_to([3.0], 3)
    graph.constrain(lambda a, b: b - a, x[0], x[1], lower=0.0, upper=0.0, name="meet")
    graph.constrain(lambda a, b: b - a, x[:-1], x[1:], lower=0.0, name="order")
    graph.constrain(lambda a: a, x[-1], upper=1.0, name="cap")
    solution = InteriorPoint().solve(graph, {x: np.zeros((3, 1))}, check=True)
    assert np.abs(solution.dual("order")).max() > 100.0
    assert "factor 0, depends on other constraints" in sentence(solution, "'meet', factor 0")
    assert "depends on" not in InteriorPoint().solve(*chain(0.2), check=True).explain()


def test_a_cost_that_a_tolerated_violation_saves_is_told() -> None:
    """Rows in units so small that 1e-6 of them are a part in four hundred of the cost."""
    graph, guess = next(problem for problem in PROBLEMS if problem.name == "pinene").build()
    loose, exact = (make().solve(graph, guess, check=True) for make in (AugmentedLagrangian, InteriorPoint))
    said = sentence(loose, "Constraints are violated by up to 1e-06, within the tolerance")
    saved = float(said.split("add about ")[1].split()[0])
    assert exact.cost - loose.cost == pytest.approx(saved, rel=0.03) and saved > 2e-3 * loose.cost
    assert "violated" not in exact.explain()


def test_the_measurement_that_disagrees_is_named() -> None:
    rng = np.random.default_rng(3)
    graph, x, tree = graph_of(("x", fg.SE2, 12), ("tree", fg.Rn(2), 1))
    poses = np.stack([0.3 * np.arange(12), np.zeros(12), np.zeros(12)], axis=1)
    seen = np.array([2.0, 1.0]) - poses[:, :2] + 0.05 * rng.normal(size=(12, 2))
    seen[7] += [0.0, 0.6]
    graph.minimize(fg.prior, x, poses, sigma=0.05, name="gps")
    graph.minimize(lambda x, t, far: t - x[:, :2] - far, x, tree, seen, sigma=0.05, name="seen")
    solution = GaussNewton().solve(graph, {x: poses, tree: [[2.0, 1.0]]}, check=True)
    said = sentence(solution, "Measurement 'seen'")
    assert "factor 7 (x[7], tree[0]) disagrees" in said
    times = float(np.linalg.norm(solution.residuals["seen"][7])) / 2.0**0.5
    assert f"{times:.3g} times as large" in said
    seen[7] -= [0.0, 0.6]
    graph.replace("seen", lambda x, t, far: t - x[:, :2] - far, x, tree, seen)
    assert "disagrees" not in GaussNewton().solve(graph, {x: poses, tree: [[2.0, 1.0]]}).explain()


def test_the_variable_that_is_hardly_determined_is_named() -> None:
    graph, x, tree = graph_of(("x", fg.Rn(2), 3), ("tree", fg.Rn(2), 2))
    poses = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    graph.minimize(fg.prior, x, poses, sigma=0.01, name="gps")

    def bearing(x: Array, tree: Array, angle: Array) -> Array:
        way = tree - x
        return np.arctan2(way[:, 1:], way[:, :1]) - angle

    far = np.array([[1.0, 1.0], [4e4, 3e5]])
    for k in range(2):
        way = far[k] - poses
        graph.minimize(bearing, x, tree[k], np.arctan2(way[:, 1:], way[:, :1]), sigma=0.01, name=f"seen {k}")
    graph.minimize(fg.prior, tree, far, sigma=1e8, name="weak")
    solution = GaussNewton().solve(graph, {x: poses, tree: far}, check=True)
    said = sentence(solution, "Hardly anything")
    assert "determines tree[1]" in said and "most of that is 'weak'" in said
    moved = float(said.split("moved by ")[1].split(" ")[0])
    assert 9e7 < moved < 1e8  # one standard deviation along the line of sight, its larger coordinate


def test_the_slow_term_is_named_with_the_way_to_write_it() -> None:
    def looped(x: Array) -> Array:
        return np.array([[sum(float(f"{v:.17g}") for v in row for _ in range(20))] for row in x])

    graph, x = drawn_to([1.0, 2.0], 30, name="near")
    graph.minimize(looped, x, sigma=10.0, name="looped")
    loop = GaussNewton().prepare(graph)
    loop.solve({x: np.zeros((30, 2))})
    said = loop.solve({x: np.zeros((30, 2))}).explain().splitlines()[-1]
    assert "of the time went into functions in Python, most of it into 'looped' (evaluated by Python" in said
    assert "fg.residual(function, rows=...)" in said


def test_the_reason_for_a_backend_is_named() -> None:
    graph, guess = chain()
    assert sentence(fg.solve(graph, guess), "InteriorPoint") == "InteriorPoint was picked for the inequality 'limits'."
    assert sentence(InteriorPoint().solve(graph, guess), "Inter") == "InteriorPoint was chosen by name."


def test_the_term_that_cannot_be_met_is_named() -> None:
    graph, guess = chain()
    x = graph.families["x"]
    graph.bound(graph.families["u"], lower=-0.1, upper=0.1, name="weak motor")
    graph.constrain(lambda x: x, x[-1], lower=3.0, name="arrive")
    solution = InteriorPoint().solve(graph, guess)
    assert not solution.converged
    said = sentence(solution, "'arrive' is violated most")
    assert "in factor 0 (x[5])" in said


def test_a_soft_constraint_that_gives_way_is_named() -> None:
    graph, guess = chain()
    graph.constrain(lambda x: x, graph.families["x"], upper=1.0, soft=0.1, name="wall")
    said = sentence(InteriorPoint().solve(graph, guess, check=True), "Soft constraint 'wall'")
    assert "gives way in" in said and "in factor 5" in said


@pytest.mark.parametrize("price", [1e2, 1e9])
def test_a_price_hides_nothing_that_holds_the_solution(price: float) -> None:
    graph, guess = chain(0.2)
    graph.constrain(lambda x: x, graph.families["x"], upper=9.0, soft=price, name="far")
    solution = InteriorPoint().solve(graph, guess, check=True)
    assert "holds the solution in 1 row, most in factor 3" in sentence(solution, "'limits'")
    assert "'far'" not in solution.explain()


def test_notebooks_show_solutions_and_histories() -> None:
    solution = InteriorPoint().solve(*chain(), check=True)
    assert solution.table() == str(solution.history)
    assert solution.history._repr_html_() == f"<pre>{solution.table()}</pre>"
    shown = solution._repr_html_()
    assert shown.startswith("<p>InteriorPoint: ") and "<details>" in shown and solution.history._repr_html_() in shown
