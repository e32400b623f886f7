"""Models of which a user writes F alone: fields, their inputs, groups of one's own, rollouts and plans."""

from __future__ import annotations

import pickle
from typing import Any, cast

import numpy as np
import pytest

import unifg as fg
from moving import Carried
from problems.graphs import graph_of
from unifg.models import rkmk
from unifg.models.rkmk import Method
from unifg.models.tableau import METHODS, Tableau
from unifg.solvers import SQP
from unifg.typing import Array

RNG = np.random.default_rng(3)
NAMES = cast(list[Method], list(METHODS))
HEUN = Tableau("heun", 2, (0.5, 0.5), ((), (1.0,)))


# ---------------------------------------------------------------- fields


def test_fields_without_inputs() -> None:
    def pendulum(x: Array) -> Array:
        return np.stack([x[:, 1], -np.sin(x[:, 0])], axis=1)

    group = fg.Product(angle=fg.SO2, rate=fg.Rn(1))
    x, after = group.random(RNG, (2, 5))
    assert rkmk.integrator(group, pendulum, "rk4")(x, after, 0.1).shape == (5, 2)
    states = rkmk.rollout(group, pendulum, [0.5, 0.0], h=0.01, count=100)
    energy = 0.5 * states[:, 1] ** 2 - np.cos(states[:, 0])
    assert np.ptp(energy) < 1e-10


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rkmk.integrator(fg.SE2, Carried(fg.SE2), "rk5"), r"one of 'explicit euler', .* found 'rk5'"),  # type: ignore[arg-type]
        (
            lambda: Tableau("mine", 2, (0.5, 0.5), ((), (1.0, 0.0))),
            r"rows of the matrix have \[0, 2\] numbers, expected \[0, 1\]",
        ),
        (lambda: Tableau("mine", 1, (0.9,), ((),)), r"weights sum to 0.9"),
        (lambda: Tableau("mine", 2, (0.5, 0.5), ((), (1.0,)), (1.0,)), r"1 ends for 2 stages"),
        (lambda: Tableau("mine", 1, (1.0,), ((),), flat=(1,)), r"flat names stages \(1,\), there are 1"),
    ],
)
def test_tableaus_are_checked(make: Any, message: str) -> None:
    with pytest.raises(fg.ModelError, match=message):
        make()


def test_tableaus_pickle() -> None:
    x, after = fg.SE2.random(RNG, (2, 6))
    u, w = RNG.normal(size=(2, 6, 3))
    defect = rkmk.integrator(fg.SE2, Carried(fg.SE2), HEUN)
    copy = pickle.loads(pickle.dumps(defect))
    np.testing.assert_array_equal(copy(x, u, w, after, 0.1), defect(x, u, w, after, 0.1))


def test_newton_says_when_a_step_is_too_long() -> None:
    def stiff(x: Array, u: Array) -> Array:
        return 1.0 + x * x + u

    with pytest.raises(fg.UnifgError, match=r"implicit midpoint: Newton's method found no end of a step of 5 s"):
        rkmk.advance(fg.Rn(1), stiff, np.zeros((1, 1)), np.zeros((1, 1)), h=5.0, method="implicit midpoint")


@pytest.mark.parametrize("method", ["rk4", "implicit midpoint"])
def test_rollouts_agree(method: Method) -> None:
    """In one call and step by step."""
    group, u = fg.SE3, RNG.normal(size=(7, 6))
    start, w = group.random(RNG), RNG.normal(size=6)
    states = rkmk.rollout(group, Carried(group), start, u, w, h=0.2, method=method, substeps=3)
    x = start[None]
    for control in u:
        for _ in range(3):
            x = rkmk.advance(group, Carried(group), x, control[None], w[None], h=0.2 / 3, method=method)
    np.testing.assert_allclose(states[-1:], x, atol=1e-11)
    defect = rkmk.integrator(group, Carried(group), method)
    fine = rkmk.rollout(group, Carried(group), start, u, w, h=0.2, method=method)
    assert np.abs(defect(fine[:-1], u, w[None], fine[1:], 0.2)).max() < 1e-12


# ---------------------------------------------------------------- models of which a user writes F alone

BOAT = fg.Product(pose=fg.SE2, v=fg.Rn(3))


def boat(x: Array, u: Array, current: Array) -> Array:
    """Surge, sway and yaw of a boat with thrust and rudder (n, 2), in water that flows at ``current`` (n, 2) [m/s]."""
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    flow = np.stack([c * current[:, 0] + s * current[:, 1], c * current[:, 1] - s * current[:, 0]], axis=1)
    surge, sway, yaw = x[:, 3:].T
    rates = [u[:, 0] - 0.5 * surge + sway * yaw, -2.0 * sway - surge * yaw, u[:, 1] - 1.5 * yaw]
    return np.concatenate([x[:, 3:5] + flow, x[:, 5:], np.stack(rates, axis=1)], axis=1)


@pytest.mark.parametrize("method", NAMES)
@pytest.mark.product(2, of="drives and flights")
def test_a_boat_finds_the_current_and_plans_with_it(method: Method) -> None:
    """One family of length 1 holds the current; past and future share it."""
    count, past, h = 30, 15, 0.2
    truth = np.array([0.4, -0.3])
    drive = np.stack([np.full(past, 1.0), 0.8 * np.sin(np.arange(past))], axis=1)
    sailed = rkmk.rollout(BOAT, boat, np.zeros(6), drive, truth, h=h, method=method)
    graph, x, u, current = graph_of(("x", BOAT, count + 1), ("u", fg.Rn(2), count), ("current", fg.Rn(2), 1))
    dynamics = rkmk.integrator(BOAT, boat, method)
    graph.constrain(dynamics, x[:-1], u, current, x[1:], h, lower=0.0, upper=0.0, name="dynamics")
    graph.fix(u[:past], drive)
    graph.minimize(fg.prior, x[: past + 1].pose, sailed[:, :3], sigma=0.1)
    graph.minimize(fg.prior, current, np.zeros(2), sigma=10.0)
    graph.minimize(fg.prior, x[-1].pose, [5.0, 0.0, 0.0], sigma=0.01)
    graph.minimize(fg.prior, u[past:], np.zeros(2), sigma=30.0)
    guess = {x: np.concatenate([sailed, np.repeat(sailed[-1:], count - past, axis=0)]), u: np.zeros((count, 2))}
    solution = SQP().solve(graph, guess | {current: np.zeros((1, 2))}, check=True)
    np.testing.assert_allclose(solution[current][0], truth, atol=2e-2)
    again = rkmk.rollout(BOAT, boat, solution[x][0], solution[u], solution[current], h=h, method=method)
    np.testing.assert_allclose(BOAT.local(again, solution[x]), 0.0, atol=1e-4)
