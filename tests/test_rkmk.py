"""The implicit trapezoid on Lie groups: exactness, sign, order, and its use as factor and constraint."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.factors.differences import jacobian
from unifg.models import rkmk, unicycle
from unifg.models.rkmk import Method
from unifg.solvers import SQP, LevenbergMarquardt
from unifg.typing import Array

RNG = np.random.default_rng(11)
FORMS: tuple[Method, ...] = ("full trapezoid", "simplified trapezoid")
GROUPS: list[fg.LieGroup] = [fg.SE2, fg.SO2, fg.Rn(2), fg.Product(pose=fg.SE2, v=fg.Rn(2))]


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


def flow(x: Array, u: Array, time: float, steps: int = 2000) -> Array:
    """The same motion by small classical Runge-Kutta steps of world coordinates; uses neither Log nor dexp."""

    def slope(y: Array) -> Array:
        v, c, s = current(y, u), np.cos(y[:, 2]), np.sin(y[:, 2])
        return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]], axis=1)

    h = time / steps
    for _ in range(steps):
        a = slope(x)
        b = slope(x + 0.5 * h * a)
        c = slope(x + 0.5 * h * b)
        d = slope(x + h * c)
        x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return x


START, CONTROL = np.array([[0.3, -0.2, 0.5]]), np.array([[1.0, 0.8]])


@pytest.mark.parametrize("form", FORMS)
def test_held_control_gives_the_exponential(form: Method) -> None:
    """With F constant over the step X Exp(hF) is exact in both forms."""
    x = fg.SE2.random(RNG, (200,))
    u = RNG.normal(size=(200, 2))
    for h in (0.02, 0.1, 0.7):
        exact = fg.SE2.retract(x, h * rkmk.unicycle_field(x, u))
        defect = rkmk.integrator(fg.SE2, rkmk.unicycle_field, form)(x, u, exact, h)
        assert np.abs(defect).max() < 1e-14


@pytest.mark.parametrize("form", FORMS)
def test_the_constraint_leads_to_the_exponential(form: Method) -> None:
    """Solved for the next pose from a guess elsewhere, the answer is X Exp(hF)."""
    x = np.array([[0.2, -0.3, 3.0]])
    u, h = np.array([[0.9, 0.8]]), 0.5
    graph = fg.Graph()
    nodes = graph.variables("x", fg.SE2, 2)
    control = graph.variables("u", fg.Rn(2), 1)
    graph.fix(nodes[0], x[0])
    graph.fix(control, u[0])
    graph.minimize(
        rkmk.integrator(fg.SE2, rkmk.unicycle_field, form),
        nodes[:-1], control, nodes[1:], h,
    )  # fmt: skip
    solution = LevenbergMarquardt(tolerance=1e-15).solve(graph, {nodes: np.tile(x, (2, 1)), control: u})
    exact = fg.SE2.retract(x, h * rkmk.unicycle_field(x, u))
    assert np.abs(fg.SE2.local(exact, solution[nodes[1]])).max() < 1e-14


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


def test_midpoint_model_is_close_but_not_the_same() -> None:
    """Bazzana's kinematics takes the chord v h for the arc: it differs from Exp by v h (1 - sinc(omega h / 2))."""
    x, u, h = np.zeros((1, 3)), np.array([[1.0, 1.0]]), 0.1
    defect = rkmk.integrator(fg.SE2, rkmk.unicycle_field)(x, u, unicycle.step(x, u, h), h)
    assert np.linalg.norm(defect) == pytest.approx(h * (1.0 - np.sin(0.05) / 0.05), rel=1e-2)


@pytest.mark.parametrize("form", FORMS)
def test_second_order_when_the_field_depends_on_the_state(form: Method) -> None:
    time, errors = 1.0, []
    exact = flow(START, CONTROL, time)
    for steps in (8, 16, 32, 64):
        x = START
        for _ in range(steps):
            x = implicit_step(form, x, CONTROL, time / steps)
        errors.append(float(np.linalg.norm(fg.SE2.local(exact, x))))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.abs(orders - 2.0).max() < 0.02, orders


def test_what_the_simplified_form_drops() -> None:
    """Its step differs from the full one by h^3/8 [F, F']: a term of the order of the trapezoid's own error."""
    rate = (flow(START, CONTROL, 1e-5, 1) - flow(START, CONTROL, -1e-5, 1)) / 2e-5
    body = fg.SE2.local(START, START + 1e-6 * rate) / 1e-6
    ahead, behind = (current(fg.SE2.retract(START, s * body), CONTROL) for s in (1e-5, -1e-5))
    bracket = fg.SE2.ad(current(START, CONTROL)[0]) @ ((ahead - behind)[0] / 2e-5)
    for h in (0.01, 0.005):
        full, simplified = (implicit_step(form, START, CONTROL, h) for form in FORMS)
        dropped = fg.SE2.local(simplified, full)[0]
        np.testing.assert_allclose(dropped, h**3 / 8.0 * bracket, atol=0.05 * h**3 * np.abs(bracket).max())


@pytest.mark.parametrize("group", GROUPS, ids=lambda g: g.name)
def test_sign_of_dexp(group: fg.LieGroup) -> None:
    """Exp(xi)^-1 Exp(xi + d) = Exp(dexp(xi) d) and dexp_inv undoes it: an order test cannot see this sign."""
    tangent = RNG.normal(size=(50, group.dim))
    small = 1e-7 * RNG.normal(size=(50, group.dim))
    change = group.local(group.exp(tangent), group.exp(tangent + small))
    inverse = group.right_jacobian_inverse(tangent)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", inverse, change), small, atol=3e-14)
    if not isinstance(group, fg.Rn) and group != fg.SO2:
        other = group.left_jacobian_inverse(tangent)  # the sign of the formula Ta cites
        assert np.abs(np.einsum("nij,nj->ni", other, change) - small).max() > 1e-8


def test_series_of_dexp_inverse() -> None:
    tangent = 0.01 * RNG.normal(size=(20, 3))
    ad = fg.SE2.ad(tangent)
    series = np.eye(3) + ad / 2.0 + ad @ ad / 12.0
    np.testing.assert_allclose(fg.SE2.right_jacobian_inverse(tangent), series, atol=1e-9)


def test_sign_inside_the_residual() -> None:
    """The full form minus the simplified one is -h/2 (dexp_inv - I) F, with +ad/2 in front."""
    x = fg.SE2.random(RNG, (20,))
    tangent = 0.01 * RNG.normal(size=(20, 3))
    after, u, h = fg.SE2.retract(x, tangent), RNG.normal(size=(20, 2)), 0.3
    full, simplified = (rkmk.integrator(fg.SE2, current, form)(x, u, after, h) for form in FORMS)
    leading = -0.25 * h * np.einsum("nij,nj->ni", fg.SE2.ad(tangent), current(after, u))
    np.testing.assert_allclose(full - simplified, leading, atol=1e-4 * h)
    assert np.abs(leading).max() > 1e-3 * h


def test_exponential_coordinates_obey_their_equation() -> None:
    """Eq. 17 along the true motion: d/dt Log(x_0^-1 x(t)) = dexp_inv(xi) F."""
    ahead, here, behind = (flow(START, CONTROL, t) for t in (0.8 + 1e-5, 0.8, 0.8 - 1e-5))
    rate = (fg.SE2.local(START, ahead) - fg.SE2.local(START, behind)) / 2e-5
    inverse = fg.SE2.right_jacobian_inverse(fg.SE2.local(START, here))
    np.testing.assert_allclose(rate[0], inverse[0] @ current(here, CONTROL)[0], atol=1e-8)
    assert np.abs(rate[0] - inverse[0].T @ current(here, CONTROL)[0]).max() > 1e-2


@pytest.mark.parametrize("form", FORMS)
def test_vector_spaces_have_the_ordinary_trapezoid(form: Method) -> None:
    space, h = fg.Rn(2), 0.2

    def pendulum(x: Array, u: Array) -> Array:
        return np.stack([x[:, 1], u[:, 0] - np.sin(x[:, 0])], axis=1)

    x, after, u = (RNG.normal(size=(5, n)) for n in (2, 2, 1))
    expected = after - x - 0.5 * h * (pendulum(x, u) + pendulum(after, u))
    np.testing.assert_allclose(rkmk.integrator(space, pendulum, form)(x, u, after, h), expected, atol=1e-15)


@pytest.mark.parametrize("form", FORMS)
def test_drives_as_a_hard_constraint(form: Method) -> None:
    """A vehicle in a current reaches a goal with hard trapezoid dynamics; the defect is met everywhere."""
    count, h = 10, 0.2
    graph = fg.Graph()
    x, u = graph.variables("x", fg.SE2, count + 1), graph.variables("u", fg.Rn(2), count)
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, x[-1], [1.5, 0.5, 0.4], sigma=0.1)
    graph.minimize(fg.prior, u, [0.5, 0.0])
    dynamics = rkmk.integrator(fg.SE2, current, form)
    graph.constrain(dynamics, x[:-1], u, x[1:], h, lower=0.0, upper=0.0, name="dynamics")
    start = {x: np.zeros((count + 1, 3)), u: np.zeros((count, 2))}
    solution = SQP().solve(graph, start)
    assert solution.converged, solution.report()
    nodes = zip(solution[x][:-1], solution[u], strict=True)
    moved = np.concatenate([implicit_step(form, pose[None], control[None], h) for pose, control in nodes])
    assert np.abs(fg.SE2.local(moved, solution[x][1:])).max() < 1e-5


def test_unknown_form_is_refused_and_residuals_pickle() -> None:
    with pytest.raises(fg.ModelError, match=r"'simplified trapezoid'.*found 'half'"):
        rkmk.integrator(fg.SE2, current, "half")  # type: ignore[arg-type]
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
    graph = fg.Graph()
    poses, controls = graph.variables("x", fg.SE2, 5), graph.variables("u", fg.Rn(1), 4)
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


def test_a_field_that_writes_outside_itself_is_run_step_by_step() -> None:
    calls = []

    def counted(x: Array, u: Array) -> Array:
        calls.append(len(x))
        return np.concatenate([u, 0.0 * u, u], axis=1)

    u = np.ones((2, 1))
    rkmk.rollout(fg.SE2, counted, np.zeros(3), u, h=0.01, substeps=rkmk.FEW, method="explicit euler")
    assert calls == [1] * 2 * rkmk.FEW
