"""Effect of a plan on the estimate it shares a graph with: -Sigma grad V (docs/results/unification.md)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import solve

import unifg as fg
from problems.graphs import graph_of
from unifg.models import unicycle
from unifg.solvers import KKT, SQP, GaussNewton
from unifg.typing import Array

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
Q, R, WISH = np.diag([1.0, 0.2]), np.array([[0.3]]), np.array([3.0, 0.0])
PAST, AHEAD = 6, 15


def linear(weight: float, seed: int = 0) -> tuple[fg.Graph, fg.Family, fg.Family]:
    """Past of a mass on a line with positions measured; its future is left out where the weight is zero."""
    rng = np.random.default_rng(seed)
    graph, x, u = graph_of(("x", fg.Rn(2), PAST + (AHEAD if weight else 0) + 1), ("u", fg.Rn(1), AHEAD))
    past = x[: PAST + 1]
    graph.minimize(fg.prior, past[0], [0.2, 0.5], sigma=[0.5, 0.3], name="arrival")
    graph.minimize(lambda a, b: b - a @ A.T, past[:-1], past[1:], sigma=[0.02, 0.05], name="drift")
    graph.minimize(lambda a, z: a[:, :1] - z, past, rng.normal(size=(PAST + 1, 1)), sigma=0.4, name="fixes")
    if weight:
        future(graph, x[PAST:], u, weight)
    else:
        graph.fix(u, np.zeros((AHEAD, 1)))
    return graph, x, u


def future(graph: fg.Graph, x: fg.Selection, u: fg.Family, weight: float) -> None:
    """A plan of a mass on a line."""
    graph.minimize(lambda a: a - WISH, x[1:], information=weight * Q, name="wish")
    graph.minimize(lambda u: u, u, information=weight * R, name="effort")
    graph.constrain(lambda a, u, b: b - a @ A.T - u @ B.T, x[:-1], u, x[1:], lower=0, upper=0, name="motion")


def value_function() -> tuple[Array, Array]:
    """P and q of V(x) = x' P x / 2 + q' x + constant, by the Riccati recursion."""
    P, q = np.zeros((2, 2)), np.zeros(2)
    for _ in range(AHEAD):
        P, q = P + Q, q - Q @ WISH
        gain = np.linalg.solve(R + B.T @ P @ B, B.T)
        P, q = A.T @ (P - P @ B @ gain @ P) @ A, A.T @ (q - P @ B @ gain @ q)
    return P, q


@pytest.mark.parametrize("weight", [1e-3, 1.0, 40.0])
def test_a_linear_estimate_moves_by_sigma_times_the_slope_of_the_value(weight: float) -> None:
    alone, xa, ua = linear(0.0)
    past = GaussNewton().solve(alone, {xa: np.zeros((PAST + 1, 2)), ua: np.zeros((AHEAD, 1))}, check=True)
    joint, x, u = linear(weight)
    both = KKT(tolerance=1e-11).solve(joint, {x: np.zeros((len(x), 2)), u: np.zeros((AHEAD, 1))}, check=True)
    P, q = value_function()
    covariance, here = past.covariance(xa), both[x][PAST]
    slope = weight * (P @ here + q)
    np.testing.assert_allclose(
        (both[x][: PAST + 1] - past[xa]).ravel(), -covariance[:, -2:] @ slope, atol=1e-10
    )  # all of the past, by what it shares with the present
    now = past[xa][PAST]
    moved = -solve(np.linalg.inv(covariance[-2:, -2:]) + weight * P, weight * (P @ now + q))
    np.testing.assert_allclose(here - now, moved, atol=1e-10)  # in closed form
    # What measured anything is as informative as before; the covariance of the joint solution counts wishes.
    information = both.information(["arrival", "drift", "fixes"], x[: PAST + 1])
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-9, atol=1e-14)
    assert np.linalg.det(both.covariance(x[PAST])) < np.linalg.det(covariance[-2:, -2:])


class Drive(NamedTuple):
    """A graph of a unicycle: past, future or both."""

    graph: fg.Graph
    x: fg.Family
    u: fg.Family


def drive(past: bool, weight: float, start: Array | None = None) -> Drive:
    """Ten steps behind a unicycle and twenty ahead of it, as the worked problem of the README without its disc."""
    now, ahead, dt = 10, 20, 0.1
    truth = unicycle.rollout(np.zeros(3), np.tile([0.8, 0.6], (now, 1)), dt)
    fixes = truth[:, :2] + 0.05 * np.random.default_rng(3).standard_normal((now + 1, 2))
    graph, x, u = graph_of(("x", fg.SE2, (now if past else 0) + ahead + 1), ("u", fg.Rn(2), ahead))
    here = now if past else 0
    if past:
        moved = fg.SE2.exp([0.08, 0.0, 0.06])
        graph.minimize(lambda pose, fix: pose[:, :2] - fix, x[: now + 1], fixes, sigma=0.05, name="fixes")
        graph.minimize(fg.between, x[:now], x[1 : now + 1], moved, sigma=[0.01, 0.01, 0.02], name="wheels")
    if start is not None:
        graph.fix(x[0], start, name="start")
    if weight:
        scale = 1.0 / np.sqrt(weight)
        graph.minimize(fg.prior, x[-1], [2.0, 2.0, 0.0], sigma=0.5 * scale, name="goal")
        graph.minimize(lambda u: u, u, sigma=scale, name="effort")
        ahead_x = x[here:]
        graph.constrain(unicycle.dynamics, ahead_x[:-1], u, ahead_x[1:], dt, lower=0, upper=0, name="motion")
    else:
        graph.fix(x[here + 1 :], np.zeros((ahead, 3)))
        graph.fix(u, np.zeros((ahead, 2)))
    return Drive(graph, x, u)


def curvature_of_the_past(mean: Array, guess: Array, solver: SQP) -> Array:
    """(3, 3) Hessian of the past's cost over the present, all else at its best: duals of the present, differenced."""
    graph, x, u = drive(past=True, weight=0.0)
    held = graph.data("held", mean)
    graph.fix(x[10], held, name="present")
    run, columns = solver.prepare(graph), []
    for step in 1e-4 * np.eye(3):
        moved = [fg.SE2.retract(mean, sign * step) for sign in (1.0, -1.0)]
        found = [run.solve({x: guess, u: np.zeros((20, 2))}, data={held: pose}) for pose in moved]
        columns.append((found[1].dual("present")[0] - found[0].dual("present")[0]) / 2e-4)
    return np.array(columns)


def test_a_nonlinear_estimate_does_so_to_first_order() -> None:
    """Half the control weight leaves a quarter of what the formula does not say; the dual of the start is the slope.

    Sigma is the inverse of the exact Hessian. Gauss-Newton's, which covariances are of, differs by a tenth here.
    """
    solver = SQP(tolerance=1e-11, hessian="exact", max_iterations=200)
    alone = drive(past=True, weight=0.0)
    guess = {alone.x: unicycle.rollout(np.zeros(3), np.tile([0.8, 0.6], (30, 1)), 0.1), alone.u: np.zeros((20, 2))}
    past = GaussNewton(tolerance=1e-12).solve(alone.graph, guess, check=True)
    mean = past[alone.x][10]
    covariance = np.linalg.inv(curvature_of_the_past(mean, past[alone.x], solver))
    np.testing.assert_allclose(covariance, past.covariance(alone.x[10]), atol=0.1 * covariance.max())
    plan = drive(past=False, weight=1.0, start=mean)
    flat = {plan.x: np.tile(mean, (21, 1)), plan.u: np.zeros((20, 2))}
    ahead = solver.solve(plan.graph, flat, check=True)
    slope = -ahead.dual("start")[0]
    left = []
    for weight in (0.02, 0.01, 0.005):
        both = drive(past=True, weight=weight)
        guess = {both.x: np.vstack([past[alone.x][:10], ahead[plan.x]]), both.u: ahead[plan.u]}
        solution = solver.solve(both.graph, guess, check=True)
        moved = fg.SE2.local(mean, solution[both.x][10])
        left.append(float(np.linalg.norm(moved + weight * covariance @ slope)))
        assert left[-1] < 0.2 * np.linalg.norm(moved)
    np.testing.assert_allclose(np.divide(left[1:], left[:-1]), 0.25, atol=0.02)
