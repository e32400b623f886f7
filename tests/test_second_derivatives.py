"""Second derivatives that kernels bring along, against differences of their Jacobians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import unifg as fg
from benchmarks import quadrotor_fixture as quadrotor
from unifg.lie import Manifold
from unifg.models import obstacles, unicycle
from unifg.residuals import Residual, residual
from unifg.second_order import lagrangian_hessian
from unifg.solvers import InteriorPoint
from unifg.typing import Array

SE2, RNG = fg.SE2, np.random.default_rng(5)
POSES, CONTROLS = RNG.standard_normal((4, 3)), RNG.standard_normal((4, 2))
STATES = np.concatenate(
    [RNG.standard_normal((4, 3)), fg.SO3.exp(RNG.standard_normal((4, 3))), RNG.standard_normal((4, 3))], axis=1
)
THRUST = np.column_stack([RNG.standard_normal((4, 3)), np.full(4, 11.0)])
REACHED = np.stack([quadrotor.step(x, u, 0.05) for x, u in zip(STATES, THRUST, strict=True)])
DISCS = RNG.standard_normal((3, 2)), np.array([0.1, 0.2, 0.3])

FEASIBLE = "quadrotor dynamics"  # its second derivatives are exact where the attitude has no defect
# residual, (manifold, values) or parameter per argument, largest difference allowed
CASES: dict[str, tuple[Residual, list[tuple[Manifold, Array] | Array | float], float]] = {
    "unicycle dynamics": (unicycle.dynamics, [(SE2, POSES), (fg.Rn(2), CONTROLS), (SE2, POSES[::-1]), 0.3], 1e-6),
    "unicycle tracking": (unicycle.tracking, [(SE2, POSES), POSES[::-1]], 1e-6),
    "discs": (obstacles.disc_clearance, [(SE2, POSES), *DISCS], 1e-5),
    FEASIBLE: (
        quadrotor.dynamics,
        [(quadrotor.STATE, STATES), (quadrotor.CONTROL, THRUST), (quadrotor.STATE, REACHED), 0.05],
        1e-6,
    ),
    "spheres": (quadrotor.clearance, [(fg.Rn(3), STATES[:, :3]), RNG.standard_normal((3, 3)), DISCS[1]], 1e-4),
}


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


@pytest.mark.parametrize(
    ("name", "soft"), [(name, soft) for name in CASES for soft in (False, True) if not (soft and name == FEASIBLE)]
)
def test_second_derivatives_match_differences(name: str, soft: bool) -> None:
    which, arguments, allowed = CASES[name]
    assert which.kernel is not None
    assert which.kernel.second is not None
    plain = residual(replace(which.kernel, second=None))
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
