"""The quadrotor: its physics, its integrators, and what can be learnt about its parameters from a flight."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.errors import GraphError
from unifg.factors.autodiff.stated import StatedKernel
from unifg.models import quadrotor, rkmk
from unifg.models.quadrotor import GRAVITY, STATE, Parameters
from unifg.models.rkmk import Method, step_defect
from unifg.models.tableau import METHODS
from unifg.typing import Array

RNG = np.random.default_rng(11)
COUNT = 20
LEVEL = np.array([0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
CALM = Parameters()
FORMS: tuple[Method, ...] = ("full trapezoid", "simplified trapezoid")
REAL = Parameters(1.3, (0.3, 0.2, 0.5), (0.4, -0.3), 0.2)


def states(count: int = COUNT) -> Array:
    return STATE.random(RNG, (count,))


def controls(count: int = COUNT) -> Array:
    return RNG.normal(size=(count, 4)) * [1.0, 1.0, 1.0, 3.0] + [0.0, 0.0, 0.0, 12.0]


def spread(parameters: Parameters, count: int = COUNT) -> tuple[Array, Array, Array, Array]:
    """Mass, drag, wind and updraft, a row for each factor."""
    packed = np.tile(parameters.packed, (count, 1))
    return packed[:, :1], packed[:, 1:4], packed[:, 4:6], packed[:, 6:]


def velocity(x: Array, u: Array, parameters: Parameters) -> Array:
    """F without noise."""
    return quadrotor.field(x, u, np.zeros((len(x), 6)), *spread(parameters, len(x)))


# ---------------------------------------------------------------- physics


@pytest.mark.parametrize("parameters", [CALM, REAL, Parameters(0.4, (1.0, 1.0, 1.0), (-6.0, 2.0), -3.0)])
def test_hover_stays(parameters: Parameters) -> None:
    start = LEVEL.copy()
    start[3:7] = quadrotor.hover_attitude(parameters)
    held = quadrotor.hover(parameters)
    np.testing.assert_allclose(
        quadrotor.rollout(start, np.tile(held, (100, 1)), 0.05, parameters)[-1], start, atol=1e-13
    )
    np.testing.assert_allclose(quadrotor.fly(start, held, 5.0, parameters, substeps=100), start, atol=1e-13)


def test_level_hover_carries_the_weight() -> None:
    assert quadrotor.hover(Parameters(1.7))[3] == pytest.approx(1.7 * GRAVITY)
    assert quadrotor.hover(Parameters(1.7, updraft=2.0))[3] == pytest.approx(1.7 * (GRAVITY - 2.0))
    np.testing.assert_array_equal(quadrotor.hover_attitude(CALM), [1.0, 0.0, 0.0, 0.0])
    up = fg.SO3.act(quadrotor.hover_attitude(Parameters(wind=(3.0, 0.0))), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(up, np.array([-3.0, 0.0, GRAVITY]) / np.hypot(3.0, GRAVITY), atol=1e-15)  # into the wind


def test_thrust_lifts_along_the_third_axis_of_the_body() -> None:
    x = states()
    x[:, 7:] = 0.0
    found = velocity(x, np.tile([0.0, 0.0, 0.0, 5.0], (COUNT, 1)), Parameters(2.0))[:, 6:]
    expected = 2.5 * fg.SO3.to_matrix(x[:, 3:7])[:, :, 2] - [0.0, 0.0, GRAVITY]
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_drag_dissipates_in_every_attitude() -> None:
    """Its power is -(R'v)' D (R'v), never positive; a drag of R D R v would speed up some of these."""
    x, held = states(200), np.zeros((200, 4))
    bare = Parameters(REAL.mass, wind=REAL.wind, updraft=REAL.updraft)
    by_drag = velocity(x, held, REAL)[:, 6:] - velocity(x, held, bare)[:, 6:]
    power = np.einsum("ni,ni->n", x[:, 7:], by_drag)
    body = np.einsum("nki,nk->ni", fg.SO3.to_matrix(x[:, 3:7]), x[:, 7:])
    np.testing.assert_allclose(power, -np.einsum("ni,i,ni->n", body, REAL.drag, body) / REAL.mass, atol=1e-12)
    assert (power < 0.0).all()


def test_wind_and_noise_are_accelerations_in_the_world() -> None:
    x, u = states(), controls()
    gone = velocity(x, u, REAL) - velocity(x, u, Parameters(REAL.mass, REAL.drag))
    np.testing.assert_allclose(gone[:, 6:], np.tile([0.4, -0.3, 0.2], (COUNT, 1)), atol=1e-14)
    noise = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    pushed = quadrotor.fly(x[0], u[0], 0.5, Parameters(2.0), noise)
    other = quadrotor.fly(x[0], u[0] + [0.1, -0.2, 0.3, 0.0], 0.5, Parameters(2.0, wind=(1.0, 2.0), updraft=3.0))
    np.testing.assert_allclose(pushed, other, atol=1e-14)


# ---------------------------------------------------------------- integrators


def test_fly_is_rk4_of_the_field() -> None:
    """One substep against the general integrator of the same order on the same field."""
    x, u, noise = states(), controls(), RNG.normal(size=(COUNT, 6))
    expected = rkmk.advance(STATE, quadrotor.field, x, u, noise, *spread(REAL), h=0.2, method="rk4")
    found = [quadrotor.fly(a, b, 0.2, REAL, c, substeps=1) for a, b, c in zip(x, u, noise, strict=True)]
    np.testing.assert_allclose(STATE.local(expected, np.stack(found)), 0.0, atol=1e-13)


@pytest.mark.parametrize("parameters", [CALM, REAL])
def test_step_is_the_zero_of_the_defect(parameters: Parameters) -> None:
    x, u = states(), controls()
    reached = quadrotor.step(x, u, 0.3, parameters)
    np.testing.assert_allclose(quadrotor.dynamics(x, u, reached, parameters.packed, 0.3), 0.0, atol=1e-13)


def test_rollout_is_step_after_step() -> None:
    u, dt = controls(7), np.linspace(0.01, 0.1, 7)
    path = quadrotor.rollout(LEVEL, u, dt, REAL)
    for k in range(7):
        np.testing.assert_array_equal(path[k + 1], quadrotor.step(path[k : k + 1], u[k : k + 1], dt[k], REAL)[0])


def noisy_step() -> tuple[Array, ...]:
    """Arguments of the disturbed dynamics, far off a solution."""
    x, u = states(), controls()
    after = STATE.retract(quadrotor.step(x, u, 0.2, REAL), RNG.normal(size=(COUNT, 9)))
    return x, u, RNG.normal(size=(COUNT, 6)), *spread(REAL), after


def test_the_kernel_is_the_simplified_trapezoid_of_the_field() -> None:
    given = noisy_step()
    shipped = quadrotor.disturbed_dynamics.kernel
    assert shipped is not None and quadrotor.disturbed_dynamics.jacobian is not None
    step = partial(step_defect, STATE, quadrotor.field, METHODS["simplified trapezoid"].numbers)
    general = StatedKernel(step, tuple(() if a == 0 else a for a in shipped.arguments), 9)
    weights = RNG.normal(size=(COUNT, 9))
    np.testing.assert_allclose(
        shipped.second_derivatives(weights, *given, 0.2), general.second_derivatives(weights, *given, 0.2), atol=1e-11
    )
    np.testing.assert_allclose(quadrotor.disturbed_dynamics(*given, 0.2), general(*given, 0.2), atol=1e-12)
    for own, other in zip(
        quadrotor.disturbed_dynamics.jacobian(*given, 0.2), general.jacobian(*given, 0.2), strict=True
    ):
        np.testing.assert_allclose(own, other, atol=1e-12)


def test_full_and_simplified_trapezoid_have_the_same_solution() -> None:
    x, u, w, *rho, _ = noisy_step()
    moved = [rkmk.advance(STATE, quadrotor.field, x, u, w, *rho, h=0.2, method=form) for form in FORMS]
    np.testing.assert_allclose(STATE.local(*moved), 0.0, atol=1e-12)
    after = moved[0]
    np.testing.assert_allclose(quadrotor.disturbed_dynamics(x, u, w, *rho, after, 0.2), 0.0, atol=1e-12)


def test_dynamics_is_disturbed_dynamics_without_noise() -> None:
    x, u, w, *rho, after = noisy_step()
    np.testing.assert_allclose(
        quadrotor.dynamics(x, u, after, REAL.packed, 0.2),
        quadrotor.disturbed_dynamics(x, u, 0.0 * w, *rho, after, 0.2),
        atol=1e-15,
    )


# ---------------------------------------------------------------- what a flight tells


# ---------------------------------------------------------------- refusals


def test_parameters_go_round() -> None:
    assert Parameters.unpacked(REAL.packed) == REAL
    assert pickle.loads(pickle.dumps(REAL)) == REAL
    np.testing.assert_array_equal(REAL.packed, [1.3, 0.3, 0.2, 0.5, 0.4, -0.3, 0.2])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mass": 0.0}, "mass must be positive"),
        ({"mass": np.nan}, "finite"),
        ({"drag": (0.1, -0.1, 0.1)}, "drag must not be negative"),
        ({"drag": (0.1, 0.1)}, "found 2 and 2"),
        ({"wind": (0.1, 0.1, 0.1)}, "found 3 and 3"),
        ({"updraft": np.inf}, "finite"),
    ],
)
def test_parameters_that_cannot_fly_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(fg.ModelError, match=message):
        Parameters(**given)


def test_wrong_shapes_are_refused() -> None:
    x, u = states(3), controls(3)
    wrong: dict[str, Callable[[], object]] = {
        r"states have shape \(n, 10\), found \(10,\)": lambda: quadrotor.step(x[0], u, 0.1, CALM),
        r"controls have shape \(n, 4\)": lambda: quadrotor.rollout(x[0], u[:, :3], 0.1, CALM),
        r"steps have one dt .* each of 3; found shape \(2,\)": lambda: quadrotor.step(x, u, [0.1, 0.1], CALM),
        r"found shape \(3, 1\)": lambda: quadrotor.rollout(x[0], u, np.full((3, 1), 0.1), CALM),
        "as many, or one; found 2 and 3": lambda: quadrotor.step(x, u[:2], 0.1, CALM),
        r"state has shape \(10,\)": lambda: quadrotor.fly(x, u[0], 0.1, CALM),
        r"noise has shape \(6,\)": lambda: quadrotor.fly(x[0], u[0], 0.1, CALM, np.zeros(3)),
        "a whole number of substeps, 1 or more; found 0": lambda: quadrotor.fly(x[0], u[0], 0.1, CALM, substeps=0),
        "1 or more; found 1.5": lambda: quadrotor.fly(x[0], u[0], 0.1, CALM, substeps=1.5),  # type: ignore[arg-type]
        r"7 parameters, found shape \(6,\)": lambda: Parameters.unpacked(np.ones(6)),
        "carries the vehicle": lambda: quadrotor.hover_attitude(Parameters(updraft=10.0)),
        "argument 3 has shape": lambda: quadrotor.dynamics(x, u, x, np.ones(6), 0.1),
    }
    for words, call in wrong.items():
        with pytest.raises((fg.ModelError, GraphError), match=words):
            call()
