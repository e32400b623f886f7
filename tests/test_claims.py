"""Claims of backends about a few of the problems stated twice, judged by casadi's exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from unifg.solvers import SQP, AugmentedLagrangian
from unifg.solvers.globalize import slow_convergence

pytest.importorskip("casadi", reason="the judge differentiates with casadi, which comes with the extra 'bench'")

from exact_judge import AGREED, Judge, answer, disagreement, infeasible
from problems.twins import KINDS
from problems.twins.twin import Twin
from variants import CONSTRAINED


def stated(kind: str, seed: int = 0, equalities_only: bool = False) -> tuple[Twin, Judge]:
    twin = KINDS[kind](seed, equalities_only)
    return twin, Judge(twin)


@pytest.mark.parametrize("kind", ["parking", "attitude slew", "thrust cone", "two-link arm", "minimum snap"])
@pytest.mark.product(1)
def test_both_statements_are_one_problem(kind: str) -> None:
    """Cost, rows and gradient along the right perturbation agree; the study asserts it of every problem."""
    twin, judge = stated(kind, seed=1)
    np.testing.assert_array_equal(twin.graph.compile().columns.free, np.flatnonzero(~twin.held))
    assert disagreement(twin, judge) < AGREED


def test_two_different_problems_are_told_apart() -> None:
    twin, judge = stated("orbit")
    assert disagreement(twin, judge) < AGREED
    (u,) = (family for family in twin.guess if family.name == "u")
    twin.graph.minimize(fg.prior, u[:1], [0.0, 0.0], sigma=30.0)  # one stage, weak, in one of them
    assert disagreement(twin, judge) > AGREED


CLAIMS = [
    *((name, kind, 0, False) for name in CONSTRAINED for kind in ("hover with drag", "attitude slew")),
    *(("kkt", kind, 0, True) for kind in ("orbit", "attitude slew")),
    ("alm", "parking", 1, False),
    ("sqp", "parking", 1, False),
]


@pytest.mark.parametrize(("name", "kind", "seed", "equalities_only"), CLAIMS)
@pytest.mark.product(4)
def test_converged_is_true(name: str, kind: str, seed: int, equalities_only: bool) -> None:
    twin, judge = stated(kind, seed, equalities_only)
    result = answer(CONSTRAINED[name], twin, judge)
    assert (result.status, result.claim) == ("CONVERGED", "true"), result


@pytest.mark.product(2)
@pytest.mark.parametrize("equalities_only", [False, True])
@pytest.mark.parametrize(
    ("kind", "seed", "limit"), [("pendulum", 1, 130), ("cart-pole", 1, 150), ("two-link arm", 0, 100)]
)
def test_the_augmented_lagrangian_moves_along_curved_dynamics(
    kind: str, seed: int, limit: int, equalities_only: bool
) -> None:
    """Newton steps leave the dynamics by their square: uncorrected, they crept to the limit of 300."""
    twin, judge = stated(kind, seed, equalities_only)
    result = answer(CONSTRAINED["alm"], twin, judge)
    assert (result.status, result.claim) == ("CONVERGED", "true"), result
    assert result.iterations <= limit


@pytest.mark.parametrize("name", ["sqp", "kkt"])
def test_the_judge_measures_what_the_library_measures(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes of gradients belong to the coordinate of a family: by unknown, these answers would be false."""
    monkeypatch.setattr(slow_convergence, "NEAR", 0.0)  # steps of Gauss-Newton end just within the tolerance
    twin, judge = stated("pendulum", 4)
    solution = CONSTRAINED[name].solve(twin.graph, twin.guess)
    assert solution.status is fg.Status.CONVERGED and solution.stationarity > 1e-7
    seen = judge.numbers(solution.values, solution.multipliers)
    assert seen.stationarity == pytest.approx(solution.stationarity, rel=1e-3)


def out_of_reach() -> Twin:
    """A mass that shall go 3 m from rest to rest in the time for 2 m."""
    steps, dt = 8, 0.25
    twin = Twin("out of reach", 0)
    x = twin.variables("x", fg.Rn(2), np.zeros((steps + 1, 2)))
    u = twin.variables("u", fg.Rn(1), np.zeros((steps, 1)))
    twin.fix(x[0], [0.0, 0.0])
    move, push, goal = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2 / 2], [dt]]), np.array([3.0, 0.0])
    twin.minimize(lambda u: u, lambda u: u, u, name="effort")
    twin.equal(
        lambda x, u, y: y - x @ move.T - u @ push.T, lambda x, u, y: y - move @ x - push @ u, x[:-1], u, x[1:],
        name="motion", moves=True,
    )  # fmt: skip
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="there at rest")
    twin.bound(u, lower=-2.0, upper=2.0, name="push")
    return twin


@pytest.mark.product(2)
@pytest.mark.parametrize("name", ["alm", "sqp", "sqp graph", "ipm"])
def test_infeasible_is_true(name: str) -> None:
    twin = out_of_reach()
    judge = Judge(twin)
    result = answer(CONSTRAINED[name], twin, judge)
    assert (result.status, result.claim) == ("LOCALLY_INFEASIBLE", "true"), result
    assert not judge.ipopt(twin.guess, 1e-6).solved
    fatrop = judge.fatrop(twin.guess, 1e-6)
    assert fatrop is not None and not fatrop.solved


def test_the_judge_contradicts_what_is_false() -> None:
    """Wrong points, multipliers of wrong size and of wrong sign, and infeasibility that is none."""
    twin, judge = stated("hover with drag", seed=1)
    solution = SQP().solve(twin.graph, twin.guess, check=True)
    duals = solution.multipliers
    assert judge.numbers(solution.values, duals).worst < 1e-6
    rotors = duals["rotors"]
    assert np.abs(rotors).max() > 1e-2  # active
    assert judge.numbers(solution.values, {**duals, "rotors": 1.001 * rotors}).stationarity > 1e-5
    assert judge.numbers(solution.values, {**duals, "rotors": -rotors}).complementarity > 1e-2
    moved = solution.values
    moved[next(f for f in moved if f.name == "u")] *= 1.01
    assert judge.numbers(moved, duals).violation > 1e-5

    class Lying(fg.Solver):
        """Claims that its last iterate is a point of least violation."""

        def workspace(self, program: object) -> None:
            return None

        def iterate(self, run: object, workspace: None) -> fg.Status:
            return fg.Status.LOCALLY_INFEASIBLE

    assert infeasible(Lying().solve(twin.graph, twin.guess), judge, 1e-6)[0] == "false"
    seen = Lying().solve(twin.graph, solution.values)
    if seen.status is fg.Status.LOCALLY_INFEASIBLE:
        assert infeasible(seen, judge, 1e-6)[0] == "false"


@pytest.mark.product(2)
@pytest.mark.parametrize("seed", [0, 4])
@pytest.mark.parametrize(("kind", "equalities_only"), [("free final time", False), ("thrust cone", True)])
def test_the_augmented_lagrangian_finds_its_way(kind: str, equalities_only: bool, seed: int) -> None:
    """Limits of squares that are flat at the guess, and a valley of no mass, where a small penalty leads."""
    twin, judge = stated(kind, seed, equalities_only)
    result = answer(AugmentedLagrangian(), twin, judge)
    assert (result.status, result.claim) == ("CONVERGED", "true"), result
    assert result.iterations <= 200
    assert result.cost == pytest.approx(judge.ipopt(twin.guess, 1e-6).cost, rel=1e-4)
