"""The implicit trapezoid on Lie groups: exactness, sign, order, and its use as factor and constraint."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of
from unifg.factors.differences import jacobian
from unifg.models import quadrotor, rkmk, unicycle
from unifg.models.rkmk import Method
from unifg.solvers import SQP
from unifg.typing import Array

RNG = np.random.default_rng(11)
FORMS: tuple[Method, ...] = ("full trapezoid", "simplified trapezoid")


def current(x: Array, u: Array) -> Array:
    """A velocity that depends on the whole pose: a vehicle in a current, (n, 3)."""
    return np.stack(
        [
            u[:, 0] * (1.2 + np.sin(x[:, 1])),
            0.4 * np.cos(x[:, 2]) + 0.2 * x[:, 0],
            u[:, 1] + 0.7 * np.sin(x[:, 0] + x[:, 2]),
        ],
        axis=1,
    )


def implicit_step(form: Method, x: Array, u: Array, h: float) -> Array:
    """Solve the trapezoid for the next state by Newton's method."""
    after = rkmk.advance(fg.SE2, current, x, u, h=h, method=form)
    assert np.abs(rkmk.integrator(fg.SE2, current, form)(x, u, after, h)).max() < 1e-13
    return after


START, CONTROL = np.array([[0.3, -0.2, 0.5]]), np.array([[1.0, 0.8]])


def test_arguments_in_another_order_or_without_rows_are_refused() -> None:
    def drifting(x: Array, u: Array, water: Array) -> Array:
        return current(x, u) + np.stack([water[:, 0], water[:, 1], 0.0 * x[:, 0]], axis=1)

    graph, step = fg.Graph(), rkmk.integrator(fg.SE2, drifting, "rk4")
    x, u, water = graph.variables("x", fg.SE2, 4), graph.variables("u", fg.Rn(2), 3), graph.data("water", [0.1, 0.3])
    with pytest.raises(fg.ModelError, match=r"^term 'rk4': .* x, the inputs of its field, x_next and h, in this order"):
        graph.minimize(step, x[:-1], u, x[1:], water, 0.1)
    with pytest.raises(fg.ModelError, match=r"^term 'rk4': inputs of a field have rows, found shape \(2,\): c\[None\]"):
        graph.minimize(step, x[:-1], u, water, x[1:], 0.1)
    graph.minimize(step, x[:-1], u, fg.shared([[0.1, 0.3]]), x[1:], 0.1)


@pytest.mark.parametrize(
    ("velocity", "found"),
    [
        (lambda x, u: u[:, 0], r"\(4,\)"),
        (lambda x, u: u[:, :1], r"\(4, 1\)"),
        (lambda x, u: np.stack([x[:, 1], u[:, 0]]), r"\(2, 4\)"),
        (lambda x, u: np.concatenate([u, u], axis=1), r"\(4, 4\)"),
    ],
)
@pytest.mark.parametrize("form", ["explicit euler", "implicit midpoint", "rk4"])
def test_velocities_of_another_shape_are_refused(velocity: Any, found: str, form: Method) -> None:
    """Broadcasting would give every coordinate the velocity of one of them."""
    plane, u = fg.Rn(2), np.ones((4, 2))
    with pytest.raises(fg.ModelError, match=rf"velocities in Rn\(2\).* \(4, 2\); found shape {found}"):
        rkmk.advance(plane, velocity, np.zeros((4, 2)), u, h=0.1, method=form)
    with pytest.raises(fg.ModelError, match=r"velocities in Rn\(2\)"):
        rkmk.rollout(plane, velocity, [0.0, 0.0], u, h=0.1, method=form)
    graph = fg.Graph()
    x, control = graph.variables("x", plane, 5), graph.variables("u", fg.Rn(2), 4)
    with pytest.raises(fg.ModelError, match=rf"^term '{form}': a field gives velocities in Rn\(2\)"):
        graph.minimize(rkmk.integrator(plane, velocity, form), x[:-1], control, x[1:], 0.1)


@pytest.mark.parametrize("form", ["rk4", "implicit midpoint"])
@pytest.mark.parametrize("count", [3, 150])
def test_a_simulation_takes_a_step_for_each_row(form: Method, count: int) -> None:
    lengths, u = np.linspace(0.01, 0.05, count), RNG.normal(size=(count, 2))
    states = rkmk.rollout(fg.SE2, current, START[0], u, h=lengths, method=form)
    for k in (0, 1, count - 1):
        alone = rkmk.advance(fg.SE2, current, states[k : k + 1], u[k : k + 1], h=lengths[k], method=form)
        assert np.abs(states[k + 1] - alone[0]).max() < 1e-12
    held = rkmk.rollout(fg.SE2, current, START[0], u[0], h=lengths[:2], method=form)
    assert held.shape == (3, 3) and np.abs(held[1] - states[1]).max() < 1e-12
    with pytest.raises(fg.ModelError, match=rf"and h, one or \({count},\); found .* \(2,\)"):
        rkmk.rollout(fg.SE2, current, START[0], u, h=lengths[:2], method=form)


@pytest.mark.parametrize("form", ["rk4", "implicit midpoint"])
def test_what_is_no_step_is_refused(form: Method) -> None:
    """These were errors of NumPy about shapes that nobody had given."""
    take: dict[str, Any] = {"h": 0.1, "method": form}
    moved = rkmk.advance(fg.SE2, current, [[0.0, 0.0, 0.0]], [[1.0, 0.2]], **take)
    same = rkmk.advance(fg.SE2, current, np.zeros((1, 3)), np.array([[1.0, 0.2]]), **take)
    np.testing.assert_array_equal(moved, same)
    for count in (-1, 2.5):
        with pytest.raises(fg.ModelError, match=f"a whole number of steps, 0 or more; found count={count}"):
            rkmk.rollout(fg.SE2, current, START[0], [1.0, 0.2], count=count, **take)  # type: ignore[arg-type]
    for x, u, h, words in (
        (np.zeros(3), np.ones((1, 2)), 0.1, r"have rows, found shape \(3,\)"),
        (np.zeros((3, 3)), np.ones((2, 2)), 0.1, "found 2 beside 3"),
        (np.zeros((3, 4)), np.ones((3, 2)), 0.1, r"states \(n, 3\) of SE2.* found \(3, 4\) and h \(\)"),
        (np.zeros((3, 3)), np.ones((3, 2)), [0.1, 0.1], r"one or \(n,\); found \(3, 3\) and h \(2,\)"),
    ):
        with pytest.raises(fg.ModelError, match=words):
            rkmk.advance(fg.SE2, current, x, u, h=h, method=form)


def test_midpoint_model_is_close_but_not_the_same() -> None:
    """Bazzana's kinematics takes the chord v h for the arc: it differs from Exp by v h (1 - sinc(omega h / 2))."""
    x, u, h = np.zeros((1, 3)), np.array([[1.0, 1.0]]), 0.1
    defect = rkmk.integrator(fg.SE2, rkmk.unicycle_field)(x, u, unicycle.step(x, u, h), h)
    assert np.linalg.norm(defect) == pytest.approx(h * (1.0 - np.sin(0.05) / 0.05), rel=1e-2)


def test_sign_inside_the_residual() -> None:
    """The full form minus the simplified one is -h/2 (dexp_inv - I) F, with +ad/2 in front."""
    x = fg.SE2.random(RNG, (20,))
    tangent = 0.01 * RNG.normal(size=(20, 3))
    after, u, h = fg.SE2.retract(x, tangent), RNG.normal(size=(20, 2)), 0.3
    full, simplified = (rkmk.integrator(fg.SE2, current, form)(x, u, after, h) for form in FORMS)
    leading = -0.25 * h * np.einsum("nij,nj->ni", fg.SE2.ad(tangent), current(after, u))
    np.testing.assert_allclose(full - simplified, leading, atol=1e-4 * h)
    assert np.abs(leading).max() > 1e-3 * h


@pytest.mark.parametrize("form", FORMS)
def test_drives_as_a_hard_constraint(form: Method) -> None:
    """A vehicle in a current reaches a goal with hard trapezoid dynamics; the defect is met everywhere."""
    count, h = 10, 0.2
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, x[-1], [1.5, 0.5, 0.4], sigma=0.1)
    graph.minimize(fg.prior, u, [0.5, 0.0])
    dynamics = rkmk.integrator(fg.SE2, current, form)
    graph.constrain(dynamics, x[:-1], u, x[1:], h, lower=0.0, upper=0.0, name="dynamics")
    start = {x: np.zeros((count + 1, 3)), u: np.zeros((count, 2))}
    solution = SQP().solve(graph, start, check=True)
    nodes = zip(solution[x][:-1], solution[u], strict=True)
    moved = np.concatenate([implicit_step(form, pose[None], control[None], h) for pose, control in nodes])
    assert np.abs(fg.SE2.local(moved, solution[x][1:])).max() < 1e-5


def test_residuals_pickle() -> None:
    copy = pickle.loads(pickle.dumps(rkmk.integrator(fg.SE2, current)))
    assert np.isfinite(copy(START, CONTROL, START, 0.1)).all()


# ---------------------------------------------------------------- traced


def turning(x: Array, u: Array) -> Array:
    """A field on SE(2) that depends on the pose."""
    return np.stack([u[:, 0] * (1.2 + np.sin(x[:, 1])), 0.4 * np.cos(x[:, 2]), u[:, 0] + 0.2 * x[:, 0]], axis=1)


class Turning:
    """The same, of an instance that counts its calls: it is not traced unasked."""

    calls = 0

    def __call__(self, x: Array, u: Array) -> Array:
        self.calls += 1
        return turning(x, u)


@pytest.mark.parametrize(
    ("field", "route"), [(turning, "traced, its derivatives exact"), (Turning(), "by differences")]
)
def test_steps_are_traced_and_differenced_where_f_cannot_be(field: Any, route: str) -> None:
    rng = np.random.default_rng(3)
    x, u = fg.SE2.random(rng, (5,)), rng.normal(size=(4, 1))
    x[1] = x[0]  # where the logarithm is zero
    graph, poses, controls = graph_of(("x", fg.SE2, 5), ("u", fg.Rn(1), 4))
    defect = rkmk.integrator(fg.SE2, field, "hermite-simpson")
    graph.minimize(defect, poses[:-1], controls, poses[1:], 0.3)
    program = graph.compile()
    assert route in program.terms[0].route
    lin = program.linearize({poses: x, controls: u})
    manifolds: list[fg.Manifold] = [fg.SE2, fg.Rn(1), fg.SE2]
    blocks = np.concatenate(jacobian(lambda *p: defect(*p, 0.3), [x[:-1], u, x[1:]], manifolds), axis=2)
    np.testing.assert_allclose(lin.residual.reshape(4, 3), defect(x[:-1], u, x[1:], 0.3), atol=1e-15)
    np.testing.assert_allclose(lin.jacobian.reshape(4, 3, 7), blocks, atol=1e-9)


def test_long_simulations_are_those_of_numpy() -> None:
    rng = np.random.default_rng(4)
    u = rng.normal(size=(30, 1))
    start = np.array([1e6, -2.0, 0.4])
    quick = rkmk.rollout(fg.SE2, turning, start, u, h=0.05, substeps=rkmk.FEW)
    slow = rkmk.rollout(fg.SE2, Turning(), start, u, h=0.05, substeps=rkmk.FEW)
    np.testing.assert_allclose(quick, slow, rtol=1e-13, atol=1e-9)


@pytest.mark.parametrize("substeps", [0, -1, 1.5, "two"])
def test_a_simulation_without_whole_substeps_is_refused(substeps: Any) -> None:
    """None would stay where it is, one and a half would go two thirds of the way."""
    for steps in (2, 2 * rkmk.FEW):
        with pytest.raises(fg.ModelError, match="a whole number of substeps, 1 or more; found"):
            rkmk.rollout(fg.SE2, turning, np.zeros(3), np.ones((steps, 1)), h=0.1, substeps=substeps)
    with pytest.raises(fg.ModelError, match="fly takes a whole number of substeps"):
        quadrotor.fly(quadrotor.STATE.identity(), np.zeros(4), 0.1, quadrotor.Parameters(), substeps=substeps)


def test_a_field_that_writes_outside_itself_is_run_step_by_step() -> None:
    calls = []

    def counted(x: Array, u: Array) -> Array:
        calls.append(len(x))
        return np.concatenate([u, 0.0 * u, u], axis=1)

    u = np.ones((2, 1))
    rkmk.rollout(fg.SE2, counted, np.zeros(3), u, h=0.01, substeps=rkmk.FEW, method="explicit euler")
    assert calls == [1] * 2 * rkmk.FEW
