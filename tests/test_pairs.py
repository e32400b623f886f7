"""Factors between two poses: the loops of fixed size do what the general ones do, and know where they may."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.files.g2o import read_g2o
from unifg.lie import LieGroup
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.table import PAIRED
from unifg.typing import Array

GROUPS = (fg.SE2, fg.SE3, fg.Rn(3), fg.Rn(6), fg.SO3)
LOSSES = (None, fg.Huber(1.0), fg.Reweighted(lambda squared: 1.0 / (1.0 + squared)))
KEPT = ("residual", "jacobian", "gradient", "hessian")


def random_information(rng: np.random.Generator, count: int, dim: int) -> Array:
    """(count, dim, dim) positive definite matrices."""
    root = rng.normal(size=(count, dim, dim))
    return root @ np.swapaxes(root, 1, 2) + np.eye(dim)


def web(group: LieGroup, seed: int, **options: Any) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """Twelve poses, edges in both directions, some fixed, another family of variables in front and behind."""
    rng = np.random.default_rng(seed)
    graph, before, x = graph_of(("before", fg.Rn(2), 3), ("poses", group, 12))
    after = graph.variables("after", group, 4)
    first, second = rng.permuted(np.tile(np.arange(12), (40, 1)), axis=1)[:, :2].T
    dim = group.dim
    graph.minimize(
        fg.between, x[first], x[second], group.random(rng, (40,)), information=random_information(rng, 40, dim),
        name="own", **options,
    )  # fmt: skip
    graph.minimize(
        fg.between, after[[0, 1, 2, 3]], x[[7, 0, 11, 3]], group.random(rng, (4,)),
        information=random_information(rng, 1, dim)[0], name="shared", **options,
    )  # fmt: skip
    graph.minimize(fg.between, x[:-1], x[1:], group.random(rng, (11,)), sigma=rng.uniform(0.5, 2.0, dim), name="sigma")
    graph.minimize(fg.prior, before, rng.normal(size=(3, 2)), sigma=1.0)
    guess = {before: rng.normal(size=(3, 2)), x: group.random(rng, (12,)), after: group.random(rng, (4,))}
    for k in (0, 5, 11):
        graph.fix(x[k], guess[x][k])
    return graph, guess


def both(program: CompiledProblem, guess: dict[fg.Family, Array]) -> tuple[list[Array], list[Array]]:
    """Linearizations of a program with and without loops of fixed size."""
    fields = program.arrays.fields
    kept = fields[:, PAIRED].copy()
    found = program.linearize(guess)
    fields[:, PAIRED] = 0
    expected = program.linearize(guess)
    fields[:, PAIRED] = kept
    assert found.cost == pytest.approx(expected.cost, rel=1e-12)
    return [getattr(found, name).copy() for name in KEPT], [getattr(expected, name).copy() for name in KEPT]


def close(found: Array, expected: Array) -> None:
    """Equal to rounding, relative to the largest number."""
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13 * np.abs(expected).max(initial=0.0))


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.name)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("robust", LOSSES, ids=["plain", "compiled loss", "of Python"])
def test_fixed_sizes_add_up_what_general_loops_do(group: LieGroup, seed: int, robust: Any) -> None:
    graph, guess = web(group, seed, robust=robust)
    program = graph.compile()
    by_name = {term.name: int(term.place[PAIRED]) for term in program.terms}
    assert [by_name[name] for name in ("own", "shared", "sigma")] == [group.dim] * 3
    for found, expected in zip(*both(program, guess), strict=True):
        close(found, expected)


def test_factors_that_are_switched_off_add_nothing() -> None:
    on = np.arange(40) % 3 > 0
    rng = np.random.default_rng(5)
    graph, x = graph_with(fg.SE3, 41, "poses")
    graph.minimize(
        fg.between, x[1:], x[:-1], fg.SE3.random(rng, (40,)), information=random_information(rng, 40, 6), active=on,
        name="chain",
    )  # fmt: skip
    graph.minimize(fg.prior, x, fg.SE3.identity(), sigma=1.0)
    program, guess = graph.compile(), {x: fg.SE3.random(rng, (41,))}
    assert program.terms[0].place[PAIRED] == 6
    found, expected = both(program, guess)
    for one, other in zip(found, expected, strict=True):
        close(one, other)
    assert not found[0][: 40 * 6].reshape(40, 6)[~on].any()


def test_one_variable_twice_and_constants_take_the_general_loops() -> None:
    rng = np.random.default_rng(6)
    graph, x = graph_with(fg.SE2, 5, "poses")
    graph.minimize(fg.between, x[[0, 1, 2]], x[[1, 1, 3]], fg.SE2.random(rng, (3,)), sigma=1.0, name="twice")
    graph.minimize(fg.between, x, fg.SE2.random(rng), fg.SE2.random(rng, (5,)), sigma=1.0, name="constant")
    program = graph.compile()
    assert [int(term.place[PAIRED]) for term in program.terms] == [0, 0]
    assert program.linearize({x: fg.SE2.random(rng, (5,))}).finite


@pytest.mark.parametrize("name", ["intel", "M3500", "parking-garage", "sphere2500"])
def test_published_graphs(name: str, shared_data: Path) -> None:
    graph, _, guess = read_g2o(shared_data / "pose_graphs" / f"{name}.g2o.gz").graph()
    program = graph.compile()
    assert all(term.place[PAIRED] for term in program.terms)
    for found, expected in zip(*both(program, guess), strict=True):
        close(found, expected)


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3], ids=lambda group: group.name)
@pytest.mark.parametrize("residual", [fg.between, fg.difference], ids=["between", "difference"])
def test_one_formula_for_poses_says_what_the_functions_of_the_group_say(group: LieGroup, residual: Any) -> None:
    """Far from the origin and close to a half turn, too; the batched functions are the reference."""
    rng = np.random.default_rng(7)
    x, y, measured = (group.random(rng, (400,)) for _ in range(3))
    moved = group.compose(x, measured)
    y[:100] = group.compose(moved[:100], group.exp(1e-9 * rng.normal(size=(100, group.dim))))
    x[100:200, : group.point_dim] *= 1e3
    y[100:200, : group.point_dim] *= 1e3
    turn = np.zeros((100, group.dim))
    turn[:, -1] = np.pi * (1.0 + 1e-6 * rng.normal(size=100))
    y[200:300] = group.compose(moved[200:300], group.exp(turn))
    kernel = residual.on(group)
    given = (x, y, measured) if residual is fg.between else (x, y)
    seen = group.between(x, y)
    expected = group.log(group.between(measured, seen) if residual is fg.between else seen)
    after = group.right_jacobian_inverse(expected)
    first = -after @ group.adjoint(group.between(y, x))
    size = np.abs(first).max()
    np.testing.assert_allclose(kernel(*given), expected, rtol=1e-12, atol=1e-13 * np.abs(expected).max())
    blocks = kernel.jacobian(*given)
    np.testing.assert_allclose(blocks[0], first, rtol=1e-12, atol=1e-13 * size)
    np.testing.assert_allclose(blocks[1], after, rtol=1e-12, atol=1e-13 * size)
