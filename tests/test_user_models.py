"""Models of which a user writes F alone: fields, their inputs, groups of one's own, rollouts and plans."""

from __future__ import annotations

import math
import pickle
from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest

import unifg as fg
from moving import Carried, compiled_carried
from unifg.lie.functions import functions_of
from unifg.machine.jit import compiled
from unifg.models import rkmk
from unifg.models.compiled_field import CompiledField
from unifg.models.rkmk import Method
from unifg.models.tableau import METHODS, Tableau
from unifg.solvers import SQP
from unifg.typing import Array

RNG = np.random.default_rng(3)
NAMES = cast(list[Method], list(METHODS))
HEUN = Tableau("heun", 2, (0.5, 0.5), ((), (1.0,)))


# ---------------------------------------------------------------- fields


class Turning(fg.LieGroup):
    """A user's group: SO(2) by its batched methods only."""

    name, storage, dim, point_dim, matrix_dim = "Turning", 1, 1, 2, 2

    def identity(self) -> Array:
        return np.zeros(1)

    def __getattribute__(self, name: str) -> object:
        own = {"identity", "name", "storage", "dim"}
        return object.__getattribute__(self if name in own or name.startswith("_") else fg.SO2, name)

    exp = log = inverse = matrix = hat = adjoint = ad = right_jacobian = right_jacobian_inverse = fg.SO2.exp
    compose = act = fg.SO2.compose

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        return fg.SO2.random(rng, shape)


@compiled
def swing(x: Array, u: Array, out: Array) -> None:
    out[0] = u[0] + math.sin(x[0])


@pytest.mark.parametrize("group", [Turning(), fg.Product(a=Turning(), b=fg.SO2)], ids=lambda g: g.name)
def test_compiled_fields_serve_groups_without_compiled_functions(group: fg.LieGroup) -> None:
    @compiled
    def swings(x: Array, u: Array, out: Array) -> None:
        for i in range(len(out)):
            out[i] = u[0] + math.sin(x[i])

    assert functions_of(group) is None
    field = CompiledField(swings, group.dim, 1)
    defect = rkmk.integrator(group, field, "rk4")
    assert defect.kernel is None
    x, u = group.random(RNG, (3,)), RNG.normal(size=(3, 1))
    same = rkmk.integrator(fg.SO2, CompiledField(swing, 1, 1), "rk4")
    np.testing.assert_allclose(defect(x, u, x, 0.1)[:, :1], same(x[:, :1], u, x[:, :1], 0.1), atol=1e-15)


def test_fields_without_inputs() -> None:
    @compiled
    def pendulum(x: Array, u: Array, out: Array) -> None:
        out[0], out[1] = x[1], -math.sin(x[0])

    @compiled
    def derivative(x: Array, u: Array, by_x: Array, by_u: Array) -> None:
        by_x[0, 0], by_x[0, 1], by_x[1, 0], by_x[1, 1] = 0.0, 1.0, -math.cos(x[0]), 0.0

    def batched(x: Array) -> Array:
        return np.stack([x[:, 1], -np.sin(x[:, 0])], axis=1)

    group = fg.Product(angle=fg.SO2, rate=fg.Rn(1))
    x, after = group.random(RNG, (2, 5))
    blocks: list[Sequence[Array]] = []
    for field in (CompiledField(pendulum, 2, ()), CompiledField(pendulum, 2, (), derivative), batched):
        defect = rkmk.integrator(group, field, "rk4")
        assert defect.jacobian is not None
        blocks.append(defect.jacobian(x, after, 0.1))
        assert [block.shape for block in blocks[-1]] == [(5, 2, 2), (5, 2, 2)]
        states = rkmk.rollout(group, field, [0.5, 0.0], h=0.01, count=100)
        energy = 0.5 * states[:, 1] ** 2 - np.cos(states[:, 0])
        assert np.ptp(energy) < 1e-10
    for other in blocks[1:]:
        for block, reference in zip(other, blocks[0], strict=True):
            np.testing.assert_allclose(block, reference, atol=1e-9)
    assert [b.shape for b in CompiledField(pendulum, 2, (), derivative).jacobian(x)] == [(5, 2, 2)]


def test_fields_check_their_inputs() -> None:
    field = compiled_carried(fg.SE2, True)
    assert field.lengths == (3, 3) and field.controls == 6
    x, u = fg.SE2.random(RNG, (4,)), RNG.normal(size=(4, 3))
    assert [block.shape for block in field.jacobian(x, u, u[:1])] == [(4, 3, 3)] * 3
    np.testing.assert_allclose(field(x, u, u[:1]), Carried(fg.SE2)(x, u, u[:1]), atol=1e-15)
    with pytest.raises(fg.ModelError, match="takes 2 inputs, found 1"):
        field(x, u)
    with pytest.raises(fg.ModelError, match=r"input 1 has shape \(4, 2\), expected \(n, 3\)"):
        field(x, u, u[:, :2])
    with pytest.raises(fg.ModelError, match=r"input 1 has shape \(1, 2\), expected \(n, 3\)"):
        rkmk.rollout(fg.SE2, field, x[0], u, u[:, :2], h=0.1)


def test_tableaus_are_checked_and_pickle() -> None:
    with pytest.raises(fg.ModelError, match=r"one of 'explicit euler', .* found 'rk5'"):
        rkmk.integrator(fg.SE2, Carried(fg.SE2), "rk5")  # type: ignore[arg-type]
    with pytest.raises(fg.ModelError, match=r"rows of the matrix have \[0, 2\] numbers, expected \[0, 1\]"):
        Tableau("mine", 2, (0.5, 0.5), ((), (1.0, 0.0)))
    with pytest.raises(fg.ModelError, match=r"weights sum to 0.9"):
        Tableau("mine", 1, (0.9,), ((),))
    with pytest.raises(fg.ModelError, match=r"1 ends for 2 stages"):
        Tableau("mine", 2, (0.5, 0.5), ((), (1.0,)), (1.0,))
    with pytest.raises(fg.ModelError, match=r"flat names stages \(1,\), there are 1"):
        Tableau("mine", 1, (1.0,), ((),), flat=(1,))
    x, after = fg.SE2.random(RNG, (2, 6))
    u, w = RNG.normal(size=(2, 6, 3))
    for field in (Carried(fg.SE2), CompiledField(swing, 1, 1)):
        group = fg.SE2 if isinstance(field, Carried) else fg.SO2
        defect = rkmk.integrator(group, field, HEUN)
        copy = pickle.loads(pickle.dumps(defect))
        given = (x, u, w, after) if group == fg.SE2 else (x[:, 2:], u[:, :1], after[:, 2:])
        np.testing.assert_array_equal(copy(*given, 0.1), defect(*given, 0.1))


def test_newton_says_when_a_step_is_too_long() -> None:
    def stiff(x: Array, u: Array) -> Array:
        return 1.0 + x * x + u

    with pytest.raises(fg.UnifgError, match=r"implicit midpoint: Newton's method found no end of a step of 5 s"):
        rkmk.advance(fg.Rn(1), stiff, np.zeros((1, 1)), np.zeros((1, 1)), h=5.0, method="implicit midpoint")


@pytest.mark.parametrize("method", ["rk4", "implicit midpoint"])
def test_rollouts_agree(method: Method) -> None:
    """Compiled and batched, in one call and step by step."""
    group, u = fg.SE3, RNG.normal(size=(7, 6))
    start, w = group.random(RNG), RNG.normal(size=6)
    states = rkmk.rollout(group, compiled_carried(group, True), start, u, w, h=0.2, method=method, substeps=3)
    again = rkmk.rollout(group, Carried(group), start, u, w, h=0.2, method=method, substeps=3)
    np.testing.assert_allclose(states, again, atol=1e-11)
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
def test_a_boat_finds_the_current_and_plans_with_it(method: Method) -> None:
    """One family of length 1 holds the current; past and future share it."""
    count, past, h = 30, 15, 0.2
    truth = np.array([0.4, -0.3])
    drive = np.stack([np.full(past, 1.0), 0.8 * np.sin(np.arange(past))], axis=1)
    sailed = rkmk.rollout(BOAT, boat, np.zeros(6), drive, truth, h=h, method=method)
    graph = fg.Graph()
    x, u = graph.variables("x", BOAT, count + 1), graph.variables("u", fg.Rn(2), count)
    current = graph.variables("current", fg.Rn(2), 1)
    dynamics = rkmk.integrator(BOAT, boat, method)
    graph.constrain(dynamics, x[:-1], u, current, x[1:], h, lower=0.0, upper=0.0, name="dynamics")
    graph.fix(u[:past], drive)
    graph.minimize(fg.prior, x[: past + 1].pose, sailed[:, :3], sigma=0.1)
    graph.minimize(fg.prior, current, np.zeros(2), sigma=10.0)
    graph.minimize(fg.prior, x[-1].pose, [5.0, 0.0, 0.0], sigma=0.01)
    graph.minimize(fg.prior, u[past:], np.zeros(2), sigma=30.0)
    guess = {x: np.concatenate([sailed, np.repeat(sailed[-1:], count - past, axis=0)]), u: np.zeros((count, 2))}
    solution = SQP().solve(graph, guess | {current: np.zeros((1, 2))})
    assert solution.converged, solution.report()
    np.testing.assert_allclose(solution[current][0], truth, atol=2e-2)
    again = rkmk.rollout(BOAT, boat, solution[x][0], solution[u], solution[current], h=h, method=method)
    np.testing.assert_allclose(BOAT.local(again, solution[x]), 0.0, atol=1e-4)
