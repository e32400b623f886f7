"""Bounds between nodes: never too narrow, close to the truth with many pieces, and for terms that allow it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.factors.autodiff.intervals import bounds
from unifg.factors.autodiff.rows import traced
from unifg.models import obstacles, unicycle
from unifg.solvers import InteriorPoint
from unifg.typing import Array

FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    "polynomial": lambda x: np.stack([x[:, 0] * x[:, 1] - x[:, 0] ** 2, (x[:, 0] - x[:, 1]) ** 3], axis=1),
    "quotient": lambda x: (x[:, :1] - 1.0) / (2.0 + x[:, 1:] ** 2),
    "waves": lambda x: np.stack([np.sin(4 * x[:, 0]) * np.cos(x[:, 1] - 7.0), np.sin(x[:, 0] / (x[:, 1] + 4))], axis=1),
    "rising": lambda x: np.stack([np.sqrt(1.0 + x[:, 0] ** 2), np.exp(-x[:, 1]), np.tanh(x[:, 0] + x[:, 1])], axis=1),
    "kinks": lambda x: np.stack([np.abs(x[:, 0]) - np.maximum(x[:, 1], 0.3), np.minimum(x[:, 0], x[:, 1])], axis=1),
    "choices": lambda x: np.where(x[:, :1] < x[:, 1:], np.floor(x[:, :1]), np.rint(x[:, 1:] * 3.0)),
    "norm": lambda x: np.linalg.norm(x - 0.2, axis=1, keepdims=True),
    "pole": lambda x: 1.0 / x[:, :1],
    "powers without a rule": lambda x: np.abs(x[:, :1]) ** (x[:, 1:] ** 2),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_value_lies_outside_of_the_bounds(name: str) -> None:
    rng, function = np.random.default_rng(3), FUNCTIONS[name]
    expression = traced(function, [fg.Rn(2)], name=name)
    centre, size = (
        rng.uniform(-2.0, 2.0, (300, 2)),
        rng.uniform(0.0, 1.0, (300, 2)) * 10.0 ** rng.uniform(-9, 0, (300, 1)),
    )
    low, high = bounds(expression, (centre - size, centre + size), (np.zeros((300, 0)), np.zeros((300, 0))))
    for _ in range(200):
        inside = centre + size * np.clip(rng.normal(0.0, 1.0, (300, 2)), -1.0, 1.0)
        with np.errstate(all="ignore"):
            found = function(inside)
        assert ((low <= found) & (found <= high)).all()
    if name not in ("pole", "powers without a rule", "choices"):
        width = (high - low)[size.max(axis=1) < 1e-6]
        assert width.max() < 1e-3, "small boxes have narrow bounds"


def plan(radius: float) -> tuple[fg.Solution, fg.Family]:
    graph, x, u = graph_of(("x", fg.SE2, 6), ("u", fg.Rn(2), 5))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, x[-1], [2.0, 0.0, 0.0], sigma=0.1, name="goal")
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=1.0, name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.4, lower=0.0, upper=0.0, name="motion")
    graph.constrain(obstacles.disc_clearance, x, np.array([[1.0, 0.02]]), np.array([radius]), lower=0.0, name="disc")
    guess: dict[fg.Family, Any] = {x: np.linspace([0.0, 0.0, 0.0], [2.0, 0.0, 0.0], 6), u: np.tile([1.0, 0.0], (5, 1))}
    return InteriorPoint(tolerance=1e-8).solve(graph, guess, check=True), x


def test_a_disc_between_two_nodes_is_seen() -> None:
    """Both nodes are clear of it, what lies between is not; a small one further off is proven clear."""
    solution, x = plan(0.15)
    found = solution.tube("disc", 64)
    assert found.shape == (5, 1, 2)
    shares = np.linspace(0.0, 1.0, 201)[:, None, None]
    path = solution[x][:-1, :2] + shares * np.diff(solution[x][:, :2], axis=0)
    true = np.linalg.norm(path - [1.0, 0.02], axis=2) - 0.15
    assert (found[:, 0, 0] <= true.min(axis=0)).all()
    assert (found[:, 0, 1] >= true.max(axis=0)).all()
    np.testing.assert_allclose(found[:, 0, 0], true.min(axis=0), atol=0.02)
    assert found[2, 0, 0] < -0.05 < solution.violation + 1.0
    assert (found[[0, 1, 3, 4], 0, 0] > -1e-6).all() == (true[:, [0, 1, 3, 4]] > -1e-6).all()
    assert (solution.tube("disc", 4)[:, :, 0] <= found[:, :, 0]).all(), "more pieces never widen them"


def test_headings_go_the_short_way_round() -> None:
    graph, x = graph_with(fg.SE2, 2)
    graph.minimize(lambda x: np.cos(x[:, 2:]), x, name="ahead")
    graph.fix(x, [[0.0, 0.0, 3.1], [0.0, 0.0, -3.1]])
    free = graph.variables("free", fg.Rn(1), 1)
    graph.minimize(lambda y: y, free)
    solution = InteriorPoint().solve(graph, {x: np.zeros((2, 3)), free: [[0.0]]})
    low, high = solution.tube("ahead", 50)[0, 0]
    assert -1.0 - 1e-12 <= low <= high < -0.999


def test_other_terms_are_refused_by_name() -> None:
    graph, q = graph_with(fg.SO3, 2, "q")
    graph.minimize(lambda q: q[:, :3] / q[:, 3:], q, name="lean")
    graph.minimize(fg.prior, q, [0.0, 0.0, 0.0, 1.0], sigma=1.0)
    graph.minimize(fg.between, q[0], q[1], [0.0, 0.0, 0.0, 1.0], sigma=1.0, name="level")
    turned = InteriorPoint().solve(graph, {q: np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))})
    for term, why in (("lean", "leave SO3"), ("level", "has no tape"), ("wall", "no term is called 'wall'")):
        with pytest.raises(fg.GraphError, match=why):
            turned.tube(term)


@pytest.mark.parametrize("pieces", [0, -1, 2.5, "a"])
def test_a_tube_has_whole_pieces(pieces: Any) -> None:
    with pytest.raises(fg.GraphError, match="tube: pieces must be"):
        plan(0.15)[0].tube("disc", pieces)


def test_data_of_a_later_solve_are_refused() -> None:
    graph = fg.Graph()
    p, centre, goal = graph.variables("p", fg.Rn(1), 3), graph.data("centre", [0.0]), graph.data("goal", [1.0])
    graph.minimize(fg.prior, p, goal)
    graph.minimize(lambda p, c: p - c, p, centre, name="off")
    run = InteriorPoint().prepare(graph)
    first = run.solve({p: np.zeros((3, 1))})
    found = first.tube("off")
    run.solve(first, data={goal: [3.0]})
    np.testing.assert_array_equal(first.tube("off"), found)  # those of the term are the same
    run.solve(first, data={centre: [5.0]})
    with pytest.raises(fg.GraphError, match="have been replaced"):
        first.tube("off")
