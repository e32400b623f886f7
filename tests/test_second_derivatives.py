"""Second derivatives that kernels bring along, against differences of their Jacobians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import unifg as fg
from unifg.factors.residuals import Residual, residual
from unifg.lie import Manifold
from unifg.models import avoidance, landmarks, obstacles, quadrotor, unicycle, vehicle
from unifg.problem.hessian import lagrangian_hessian
from unifg.solvers import InteriorPoint
from unifg.typing import Array

SE2, RNG = fg.SE2, np.random.default_rng(5)
POSES, CONTROLS = RNG.standard_normal((4, 3)), RNG.standard_normal((4, 2))
STATES = np.concatenate(
    [RNG.standard_normal((4, 3)), fg.SO3.exp(RNG.standard_normal((4, 3))), RNG.standard_normal((4, 3))], axis=1
)
THRUST = np.column_stack([RNG.standard_normal((4, 3)), np.full(4, 11.0)])
VEHICLE = quadrotor.Parameters(1.3, (0.3, 0.2, 0.5), (0.4, -0.3), 0.2)
# Off the solution: the second derivatives hold where the defects, those of the attitude among them, are large.
REACHED = quadrotor.STATE.retract(quadrotor.step(STATES, THRUST, 0.3, VEHICLE), RNG.standard_normal((4, 9)))
DISCS = RNG.standard_normal((3, 2)), np.array([0.1, 0.2, 0.3])
SPREAD = RNG.standard_normal((4, 6))
PLACES, MARKS = (fg.Rn(3), STATES[:, :3]), (fg.Rn(2), RNG.standard_normal((4, 2)))

# residual, (manifold, values) or parameter per argument, largest difference allowed
CASES: dict[str, tuple[Residual, list[tuple[Manifold, Array] | Array | float], float]] = {
    "unicycle dynamics": (unicycle.dynamics, [(SE2, POSES), (fg.Rn(2), CONTROLS), (SE2, POSES[::-1]), 0.3], 1e-6),
    "unicycle tracking": (unicycle.tracking, [(SE2, POSES), POSES[::-1]], 1e-6),
    "discs": (obstacles.disc_clearance, [(SE2, POSES), *DISCS], 1e-5),
    "quadrotor dynamics": (
        quadrotor.dynamics,
        [(quadrotor.STATE, STATES), (quadrotor.CONTROL, THRUST), (quadrotor.STATE, REACHED), VEHICLE.packed, 0.3],
        1e-6,
    ),
    "disturbed quadrotor dynamics": (
        quadrotor.disturbed_dynamics,
        [
            (quadrotor.STATE, STATES),
            (quadrotor.CONTROL, THRUST),
            (quadrotor.NOISE, RNG.standard_normal((4, 6))),
            (quadrotor.MASS, np.array([[1.3]])),  # parameters are shared by all factors
            (quadrotor.DRAG, np.array([[0.3, 0.2, 0.5]])),
            (quadrotor.WIND, np.array([[0.4, -0.3]])),
            (quadrotor.UPDRAFT, np.array([[0.2]])),
            (quadrotor.STATE, REACHED),
            0.3,
        ],
        1e-6,
    ),
    "spheres": (avoidance.sphere_clearance, [PLACES, RNG.standard_normal((3, 3)), DISCS[1]], 1e-4),
    "cylinders": (avoidance.cylinder_clearance, [PLACES, *DISCS], 1e-4),
    "landmark": (avoidance.landmark_clearance, [PLACES, MARKS, 0.2], 1e-4),
    "segments": (avoidance.segment_clearance, [PLACES, RNG.standard_normal((5, 2, 2)), np.full(5, 0.1)], 1e-4),
    "1/d of cylinders": (avoidance.inverse_distance_root(avoidance.cylinder_clearance, 0.5), [PLACES, *DISCS], 1e-4),
    "1/d of a landmark": (avoidance.inverse_distance_root(avoidance.landmark_clearance), [PLACES, MARKS, 0.2], 1e-4),
    "bearing and range": (
        landmarks.bearing_range, [(quadrotor.STATE, STATES), MARKS, RNG.standard_normal((4, 2))], 1e-5,
    ),
    "car": (
        vehicle.dynamics(vehicle.Vehicle(drag=900.0)),
        [(fg.Rn(1), MARKS[1][:, :1]), (fg.Rn(1), MARKS[1][:, 1:]), (fg.Rn(1), MARKS[1][:, 1:]), 1.0, 0.1],
        1e-6,
    ),
    "prior in the plane": (fg.prior.on(SE2), [(SE2, POSES), POSES[::-1]], 1e-6),
    "prior of attitudes": (fg.prior.on(fg.SO3), [(fg.SO3, STATES[:, 3:7]), STATES[::-1, 3:7]], 1e-6),
    "prior of a pose": (
        fg.prior.on(fg.SE3), [(fg.SE3, fg.SE3.exp(SPREAD)), fg.SE3.exp(SPREAD[::-1])], 1e-6,
    ),
    "prior of a product": (fg.prior.on(quadrotor.STATE), [(quadrotor.STATE, STATES), STATES[::-1]], 1e-6),
    "tilt": (landmarks.tilt, [(fg.SO3, STATES[:, 3:7]), RNG.standard_normal(3)], 1e-6),
}  # fmt: skip


def hessian(which: Residual, arguments: list[tuple[Manifold, Array] | Array | float], soft: bool) -> Array:
    """Hessian of the Lagrangian of a graph with one term."""
    graph, guess = fg.Graph(), {}
    given: list[fg.Family | Array | float] = []
    for k, argument in enumerate(arguments):
        if isinstance(argument, tuple):
            family = graph.variables(f"x{k}", argument[0], len(argument[1]))
            guess[family] = argument[1]
            given.append(family)
        else:
            given.append(argument)
    if soft:
        graph.minimize(which, *given, sigma=0.5, name="term")
    else:
        graph.constrain(which, *given, lower=0.0, upper=0.0, name="term")
    program = graph.compile()
    program.bind({})
    lin = program.linearize(program.values_from(guess))
    multipliers = np.linspace(-1.0, 2.0, program.constraints.count)
    return lagrangian_hessian(program, lin, multipliers) - lin.hessian


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_second_derivatives_match_differences(name: str, soft: bool) -> None:
    which, arguments, allowed = CASES[name]
    kernel = which.kernel
    assert kernel is not None
    plain = residual(kernel.__call__, kernel.jacobian) if kernel.derived else residual(replace(kernel, second=None))
    own, differenced = hessian(which, arguments, soft), hessian(plain, arguments, soft)
    assert np.abs(differenced).max() > 1e-2, "a term without curvature tests nothing"
    np.testing.assert_allclose(own, differenced, atol=allowed * max(1.0, float(np.abs(differenced).max())))


def test_a_margin_does_not_inherit_the_curvature_of_its_distance() -> None:
    margin = obstacles.shortfall(obstacles.disc_clearance, 0.5)
    assert margin.kernel is not None
    assert margin.kernel.second is None


def test_second_derivatives_of_what_is_constant_are_left_out() -> None:
    """Controls given as numbers: the kernel still writes their columns."""
    graph = fg.Graph()
    x = graph.variables("x", SE2, 4)
    graph.fix(x[0], POSES[0])
    graph.minimize(fg.prior, x[1:], [0.0, 0.0, 0.0], sigma=1.0)
    graph.constrain(unicycle.dynamics, x[:-1], CONTROLS[:3], x[1:], 0.3, lower=-0.1, upper=0.1)
    solution = InteriorPoint(tolerance=1e-8).solve(graph, {x: POSES})
    assert solution.converged, solution.report()
