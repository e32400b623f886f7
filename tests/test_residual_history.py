"""The residual of each factor, live and afterwards: what it is, when it is at hand, and how it is drawn."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from calls import calls_of
from problems.graphs import drawn_to, graph_of, graph_with
from problems.known import short_drive
from unifg.scenarios.scenes.residual_plot import ResidualMonitor, residual_picture
from unifg.solution import solve_state
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    GraduatedNonConvexity,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
)
from unifg.typing import Array


def everything(scalar: bool) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """A graph with a term of every kind, some of it inactive."""
    graph, x, y = graph_of(("x", fg.Rn(2), 4), ("y", fg.Rn(1), 3))
    graph.minimize(fg.prior, x, np.array([1.0, 2.0]), sigma=[0.5, 2.0], name="prior")
    seen = np.array([True, False, True])
    information = np.array([[2.0, 0.5], [0.5, 1.0]])
    graph.minimize(
        lambda a, b: a**2 - b, x[:-1], x[1:], information=information, robust=fg.Huber(0.3), active=seen, name="robust"
    )
    graph.constrain(lambda a: a[:, :1] * a[:, 1:], x, lower=0.5, upper=1.5, name="product")
    graph.bound(x[1:], lower=[-np.inf, 0.0], upper=[0.7, 1.0], name="box")
    graph.minimize(fg.prior, y, np.zeros(1), name="rest")
    if scalar:
        graph.minimize_scalar(lambda a: np.cosh(a[:, 0] - 1.0) - 2.0, y, name="scalar")
    rng = np.random.default_rng(1)
    return graph, {x: rng.normal(1.0, 0.5, (4, 2)), y: rng.normal(size=(3, 1))}


def expected(guess: dict[fg.Family, Array]) -> dict[str, Array]:
    """The norms written out."""
    x, y = guess.values()
    off = (x[:-1] ** 2 - x[1:]) * np.array([[1.0], [0.0], [1.0]])
    information = np.array([[2.0, 0.5], [0.5, 1.0]])
    product = x[:, 0] * x[:, 1]
    box = np.maximum(x[1:] - [0.7, 1.0], 0.0) + np.maximum([-np.inf, 0.0] - x[1:], 0.0)
    return {
        "prior": np.linalg.norm((x - [1.0, 2.0]) / [0.5, 2.0], axis=1),
        "robust": np.sqrt(np.einsum("ni,ij,nj->n", off, information, off)),
        "product": np.maximum(product - 1.5, 0.0) + np.maximum(0.5 - product, 0.0),
        "box": np.linalg.norm(box, axis=1),
        "rest": np.abs(y[:, 0]),
        "scalar": np.abs(np.cosh(y[:, 0] - 1.0) - 2.0),
    }


@pytest.mark.parametrize("solver", [InteriorPoint, SQP])
def test_norms_are_those_of_every_kind_of_factor(solver: type[fg.Solver]) -> None:
    graph, guess = everything(scalar=True)
    solution = solver(keep_residuals=True, keep_values=True).solve(graph, guess)
    assert len(solution.history) > 3
    for row in solution.history:
        assert row.values is not None
        written = expected(row.values)
        assert list(row.residuals) == [term.name for term in graph.terms] == list(written)
        for name, norms in row.residuals.items():
            np.testing.assert_allclose(norms, written[name], rtol=1e-9, atol=1e-12)
            whole = norms.sum() if name == "scalar" else np.linalg.norm(norms)
            assert whole == pytest.approx(row.terms[name], rel=1e-12, abs=1e-300)
    for name, norms in solution.residuals.items():
        np.testing.assert_allclose(norms, expected(solution.values)[name], rtol=1e-9, atol=1e-12)
    assert len(solution.residuals) == 6 and "prior" in solution.residuals and "priors" not in solution.residuals
    with pytest.raises(fg.GraphError, match="no term is called 'priors'"):
        solution.residuals["priors"]


BACKENDS: list[fg.Solver] = [
    GaussNewton(), LevenbergMarquardt(), DogLeg(), KKT(), SQP(), InteriorPoint(), AugmentedLagrangian(), Penalty(),
]  # fmt: skip


@pytest.mark.parametrize("solver", BACKENDS, ids=lambda solver: solver.name)
def test_every_backend_keeps_them_when_asked_and_nothing_else_changes(solver: fg.Solver) -> None:
    if isinstance(solver, GaussNewton | LevenbergMarquardt | DogLeg | KKT):
        graph, x = graph_with(fg.SE2, 5)
        if isinstance(solver, KKT):
            graph.constrain(fg.prior, x[-1], np.array([1.0, 2.0, 1.0]), lower=0.0, upper=0.0, name="end")
        graph.minimize(fg.prior, x[0], np.zeros(3), name="first")
        graph.minimize(fg.between, x[:-1], x[1:], np.array([1.0, 0.2, 0.7]), robust=fg.Huber(0.5), name="odometry")
        guess = {x: np.zeros((5, 3))}
    else:
        graph, guess = short_drive()
    plain = solver.solve(graph, guess)
    kept = replace(solver, keep_residuals=True).solve(graph, guess)
    assert kept.status is plain.status and kept.iterations == plain.iterations
    assert kept.cost == pytest.approx(plain.cost, rel=1e-9, abs=1e-12)
    for row in kept.history:
        for name, norms in row.residuals.items():
            assert np.linalg.norm(norms) == pytest.approx(row.terms[name], rel=1e-12, abs=1e-300)
    with pytest.raises(fg.UnifgError, match="keep_residuals=True") as caught:
        _ = plain.history[0].residuals
    assert caught.value.index == 0
    again = pickle.loads(pickle.dumps(kept.history))
    assert all(
        np.array_equal(a.residuals[name], b.residuals[name])
        for a, b in zip(kept.history, again, strict=True)
        for name in a.residuals
    )


def test_a_callback_sees_them_live_and_keeps_what_it_asks_for() -> None:
    graph, guess = short_drive()
    seen: dict[int, Array] = {}

    def watch(row: fg.Iteration) -> None:
        if row.number % 2 == 0:
            seen[row.number] = row.residuals["dynamics"]

    solution = InteriorPoint().solve(graph, guess, callback=watch)
    assert len(seen) >= 2
    for row in solution.history:
        if row.number in seen:
            assert row.residuals["dynamics"] is seen[row.number]
        else:
            with pytest.raises(fg.UnifgError, match=f"iteration {row.number} were not kept"):
                _ = row.residuals
    assert seen[0].max() > 1e-3 > seen[max(seen)].max()


def test_nothing_is_worked_out_unless_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    made = calls_of(monkeypatch, solve_state, "factor_norms")
    graph, guess = short_drive()
    SQP(verbose=False).solve(graph, guess, callback=lambda row: None)
    assert not made
    solution = SQP(keep_residuals=True).solve(graph, guess)
    assert len(made) == len(solution.history)


def test_the_data_of_a_row_are_those_of_its_solve() -> None:
    """A prepared solver goes on with other data; what a solution says of its own factors does not move."""
    graph, x = graph_with(fg.Rn(1), 3)
    target, limit = graph.data("target", np.array([1.0])), graph.data("limit", np.array([0.5]))
    graph.minimize(fg.prior, x, target, name="prior")
    graph.constrain(lambda a: a, x[0], upper=limit, name="limit")
    run = InteriorPoint(keep_residuals=True, max_iterations=0).prepare(graph)
    first = run.solve({x: np.full((3, 1), 2.0)})
    start = first.history[0].residuals["limit"].copy()
    end = first.residuals["limit"]
    run.solve({x: np.zeros((3, 1))}, data={target: [5.0], limit: [7.0]})
    assert np.array_equal(first.history[0].residuals["limit"], start) and start[0] == 1.5
    assert np.array_equal(first.residuals["limit"], end) and end[0] > 0.0


def test_stages_of_another_solver_keep_theirs() -> None:
    graph, x = drawn_to([0.0], name="prior")
    measured = graph.data("measured", [[0.1], [0.2], [9.0]], each=True)
    graph.minimize(lambda a, z: a - z, x, measured, robust=fg.TruncatedLeastSquares(1.0), name="range")
    solver = GraduatedNonConvexity(solver=GaussNewton(keep_residuals=True))
    rows = solver.solve(graph, {x: np.zeros((1, 1))}).history
    assert [row.number for row in rows] == list(range(len(rows)))
    assert rows[0].residuals["range"] == pytest.approx([0.1, 0.2, 9.0])


# ---------------------------------------------------------------- drawn


def panels(figure: Any) -> dict[str, Any]:
    return {ax.get_title(loc="left"): ax for ax in figure.axes if ax.get_title(loc="left")}


def test_a_picture_shows_every_factor_at_every_iteration() -> None:
    graph, guess = short_drive()
    solution = SQP(keep_residuals=True).solve(graph, guess)
    figure = residual_picture(solution.history)
    shown = panels(figure)
    assert len(shown) == len(graph.terms) and {"dynamics: 12 factors", "tracking: 1 factor"} <= set(shown)
    (image,) = shown["dynamics: 12 factors"].get_images()
    drawn = image.get_array()
    assert drawn.shape == (12, len(solution.history))
    table = np.stack([row.residuals["dynamics"] for row in solution.history], axis=1)
    np.testing.assert_allclose(np.asarray(drawn), np.maximum(table, image.norm.vmin), rtol=1e-12)
    one = residual_picture(solution.history, ["dynamics"])
    assert list(panels(one)) == ["dynamics: 12 factors"]
    with pytest.raises(fg.GraphError, match="'dynamic'"):
        residual_picture(solution.history, ["dynamic"])
    with pytest.raises(fg.UnifgError, match="keep_residuals"):
        residual_picture(SQP().solve(graph, guess).history)


@pytest.mark.product(2, of="processes of their own")
def test_a_monitor_draws_while_the_solver_goes_on(tmp_path: Path) -> None:
    graph, guess = short_drive()
    sizes: list[int] = []
    monitor, later = ResidualMonitor(["dynamics", "limits"], path=tmp_path / "live.png"), ResidualMonitor()

    def watch(row: fg.Iteration) -> bool:
        stop = monitor(row) or later(row)
        sizes.append((tmp_path / "live.png").stat().st_size)
        return stop

    solution = SQP(max_iterations=4).solve(graph, guess, callback=watch)
    assert len(sizes) == len(solution.history) == len(monitor.rows)
    assert sizes[0] > 1000
    figure = monitor.figure()
    (image,) = panels(figure)["dynamics: 12 factors"].get_images()
    assert image.get_array().shape[1] == len(solution.history)
    assert "dynamics: 12 factors" in panels(later.figure()), "drawn after the solve alone"


def test_what_fits_exactly_can_be_drawn() -> None:
    """Zeros have no logarithm; a term without any error is one even colour."""
    graph, x = drawn_to([0.0], 2, name="prior")
    solution = GaussNewton(keep_residuals=True).solve(graph, {x: np.zeros((2, 1))})
    figure = residual_picture(solution.history)
    (image,) = panels(figure)["prior: 2 factors"].get_images()
    assert np.isfinite(np.asarray(image.get_array())).all()
