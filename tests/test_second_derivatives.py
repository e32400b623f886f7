"""Second derivatives that kernels bring along, against differences of their Jacobians."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with, program_of
from test_derive import differences
from test_jacobians import CASES
from unifg.factors.residuals import Residual, residual
from unifg.lie import Manifold
from unifg.models import obstacles, unicycle
from unifg.problem.hessian import lagrangian_hessian
from unifg.solvers import InteriorPoint
from unifg.typing import Array

# Off the solution: the second derivatives hold where the defects, those of an attitude among them, are large.
CURVED = [
    "unicycle.dynamics", "unicycle.tracking", "obstacles.disc_clearance", "quadrotor.dynamics",
    "quadrotor.disturbed_dynamics", "avoidance.sphere_clearance", "avoidance.cylinder_clearance",
    "avoidance.landmark_clearance", "avoidance.segment_clearance", "avoidance.inverse_distance_root",
    "avoidance.inverse_distance_root, landmark", "landmarks.bearing_range", "prior on SE2",
    "prior on Product(pose=SE2, v=Rn(2))", "landmarks.tilt", "sighting on SE3", "inertial.motion", "rkmk.integrator",
    "rkmk.trapezoid, quadrotor", "rkmk.trapezoid, pose and velocity", "bicycle.dynamics", "cart_pole.dynamics",
    "manipulator.dynamics",
]  # fmt: skip


def hessian(which: Residual, points: list[Array], manifolds: list[Manifold], constants: Any, soft: bool) -> Array:
    """Curvature of a term that Gauss-Newton leaves out, in a graph of it alone."""
    graph = fg.Graph()
    families = [graph.variables(f"x{k}", manifold, len(points[k])) for k, manifold in enumerate(manifolds)]
    if soft:
        graph.minimize(which, *families, *constants, sigma=0.5)
    else:
        graph.constrain(which, *families, *constants, lower=0.0, upper=0.0)
    program = program_of(graph)
    lin = program.linearize(program.values_from(dict(zip(families, points, strict=True))))
    multipliers = np.linspace(-1.0, 2.0, program.constraints.count)
    return lagrangian_hessian(program, lin, multipliers) - lin.hessian


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("name", CURVED)
def test_second_derivatives_match_differences(name: str, soft: bool) -> None:
    which, points, manifolds, constants = CASES[name]
    plain = residual(which.function, which.jacobian, derivatives=None if which.jacobian else "differences")
    own, differenced = (hessian(one, points, manifolds, constants, soft) for one in (which, plain))
    assert np.abs(differenced).max() > 1e-2, "a term without curvature tests nothing"
    np.testing.assert_allclose(own, differenced, atol=1e-4 * max(1.0, float(np.abs(differenced).max())))


DERIVED = [name for name, (case, *_) in CASES.items() if case.kernel is not None and case.kernel.derived]


@pytest.mark.parametrize("name", DERIVED)
@pytest.mark.product(20)
def test_second_derivatives_of_kernels_are_those_of_their_jacobians(name: str) -> None:
    case, points, manifolds, constants = CASES[name]
    assert case.kernel is not None
    weights = np.random.default_rng(1).normal(size=case.function(*points, *constants).shape)

    def pull(*moved: Array) -> Array:
        assert case.jacobian is not None
        return np.asarray(np.einsum("nm,nmd->nd", weights, np.concatenate(case.jacobian(*moved, *constants), axis=2)))

    bend = differences(pull, manifolds, points)
    found = case.kernel.second_derivatives(weights, *points, *constants)
    expected = 0.5 * (bend + np.swapaxes(bend, 1, 2))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * (1.0 + np.abs(expected).max()))


def test_a_margin_does_not_inherit_the_curvature_of_its_distance() -> None:
    margin = obstacles.shortfall(obstacles.disc_clearance, 0.5)
    assert margin.kernel is not None
    assert margin.kernel.second is None


def test_second_derivatives_of_what_is_constant_are_left_out() -> None:
    """Controls given as numbers: the kernel still writes their columns."""
    (poses, controls, _), _, (dt,) = CASES["unicycle.dynamics"][1:]
    graph, x = graph_with(fg.SE2, len(poses))
    graph.fix(x[0], poses[0])
    graph.minimize(fg.prior, x[1:], [0.0, 0.0, 0.0], sigma=1.0)
    graph.constrain(unicycle.dynamics, x[:-1], controls[:-1], x[1:], dt, lower=-0.1, upper=0.1)
    InteriorPoint(tolerance=1e-8).solve(graph, {x: poses}, check=True)
