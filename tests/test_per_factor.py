"""A user's function of one factor, compiled with Numba."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from scripts import run_script
from unifg.codegen.cache_folder import VARIABLE
from unifg.solvers import AugmentedLagrangian, GaussNewton
from unifg.typing import Array

RNG = np.random.default_rng(5)


@numba.njit  # type: ignore[untyped-decorator]
def relative(x: Array, y: Array, measured: Array, scale: float, r: Array) -> None:
    c, s = np.cos(x[2]), np.sin(x[2])
    dx, dy = y[0] - x[0], y[1] - x[1]
    r[0] = scale * (c * dx + s * dy - measured[0])
    r[1] = scale * (c * dy - s * dx - measured[1])


@numba.njit  # type: ignore[untyped-decorator]
def relative_jacobian(x: Array, y: Array, measured: Array, scale: float, by_x: Array, by_y: Array) -> None:
    c, s = np.cos(x[2]), np.sin(x[2])
    dx, dy = y[0] - x[0], y[1] - x[1]
    turn = y[2] - x[2]
    ct, st = np.cos(turn), np.sin(turn)
    by_x[:] = 0.0
    by_x[0, 0] = by_x[1, 1] = -scale
    by_x[0, 2] = scale * (c * dy - s * dx)
    by_x[1, 2] = -scale * (c * dx + s * dy)
    by_y[:] = 0.0
    by_y[0, 0] = by_y[1, 1] = scale * ct
    by_y[0, 1] = -scale * st
    by_y[1, 0] = scale * st


@numba.njit  # type: ignore[untyped-decorator]
def wrong_jacobian(x: Array, y: Array, measured: Array, scale: float, by_x: Array, by_y: Array) -> None:
    by_x[:] = 1.0
    by_y[:] = 0.0


@numba.njit  # type: ignore[untyped-decorator]
def speed(state: Array, direction: Array, r: Array) -> None:
    r[0] = state[0] * direction[0, 0] + state[2] * direction[1, 1]


def batched(x: Array, y: Array, measured: Array, scale: float) -> Array:
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    d = y - x
    return scale * np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]], axis=1) - scale * measured


def chain(residual: fg.Residual | Callable[..., Array]) -> tuple[fg.Graph, fg.Family, Array]:
    poses = RNG.normal(size=(6, 3))
    graph, x = graph_with(fg.SE2, 6)
    graph.minimize(residual, x[:-1], x[1:], np.full((5, 2), 0.3), 2.0, sigma=0.1)
    graph.minimize(fg.prior, x, poses, sigma=1.0)
    return graph, x, poses


@pytest.mark.parametrize(
    "residual", [fg.residual(relative, rows=2), fg.residual(relative, relative_jacobian, rows=2)], ids=["f", "f, j"]
)
def test_agrees_with_the_batched_function(residual: fg.Residual) -> None:
    global RNG
    RNG = np.random.default_rng(5)
    graph, x, poses = chain(residual)
    RNG = np.random.default_rng(5)
    reference, z, _ = chain(batched)
    assert graph.check({x: poses})
    mine, theirs = GaussNewton().solve(graph, {x: poses}), GaussNewton().solve(reference, {z: poses})
    assert mine.converged
    np.testing.assert_allclose(mine[x], theirs[z], atol=1e-6)
    lin, other = graph.compile().linearize({x: poses}), reference.compile().linearize({z: poses})
    np.testing.assert_allclose(lin.jacobian, other.jacobian, atol=1e-6)
    np.testing.assert_allclose(lin.residual, other.residual, rtol=1e-12)


def test_a_wrong_compiled_jacobian_is_found() -> None:
    graph, x, poses = chain(fg.residual(relative, wrong_jacobian, rows=2))
    assert [finding.kind for finding in graph.check({x: poses}).findings] == ["wrong Jacobian"]


def test_constrains_a_component_of_a_product_with_a_shared_matrix() -> None:
    graph, state = graph_with(fg.Product(p=fg.Rn(3), R=fg.SO2), 4, "state")
    direction = graph.data("direction", np.array([[1.0, 0.0], [0.0, 2.0]]))
    graph.minimize(fg.prior, state.p, np.array([1.0, 2.0, 3.0]))
    graph.minimize(fg.prior, state.R, np.zeros(1))
    graph.constrain(fg.residual(speed, rows=1), state.p, direction, lower=0.0, upper=0.0, name="still")
    solution = AugmentedLagrangian().solve(graph, {state: np.ones((4, 4))}, check=True)
    p = solution[state][:, :3]
    np.testing.assert_allclose(p[:, 0] + 2.0 * p[:, 2], 0.0, atol=1e-6)


def test_differences_reach_every_component_of_a_product() -> None:
    @numba.njit  # type: ignore[untyped-decorator]
    def heading(state: Array, r: Array) -> None:
        r[0] = state[0] * np.cos(state[3]) + state[2]

    graph, state = graph_with(fg.Product(p=fg.Rn(3), R=fg.SO2), 2, "state")
    graph.minimize(fg.residual(heading, rows=1), state)
    point = RNG.normal(size=(2, 4))
    jacobian = graph.compile().linearize({state: point}).jacobian.reshape(2, 4)
    expected = np.stack([np.cos(point[:, 3]), np.zeros(2), np.ones(2), -point[:, 0] * np.sin(point[:, 3])], axis=1)
    np.testing.assert_allclose(jacobian, expected, atol=1e-9)


def test_the_number_of_rows_must_be_told() -> None:
    with pytest.raises(fg.GraphError, match="rows="):
        fg.residual(relative)


def test_a_function_that_cannot_be_compiled_is_refused_by_its_term() -> None:
    @numba.njit  # type: ignore[untyped-decorator]
    def returned(x: Array) -> Array:
        return 2.0 * x

    graph, x = graph_with(fg.Rn(1), 2)
    graph.minimize(fg.residual(returned, rows=1, derivatives="differences"), x, name="doubled")
    with pytest.raises(fg.GraphError, match=r"'doubled': Numba cannot compile.*rows to write to(.|\n)*too many pos"):
        fg.solve(graph, {x: np.zeros((2, 1))})


KEPT = """
import numba, numpy as np
import unifg as fg
from unifg.codegen.compile_counter import counting
from unifg.solvers import GaussNewton
from outside import scaled, helper
OFFSET = 0.5

def made(weight):
    @numba.njit
    def residual(x, r):
        r[0] = weight * scaled(x[0]) - OFFSET
    return residual

@numba.njit
def unknown(x, r):
    r[0] = helper(x[0])

graph = fg.Graph()
x = graph.variables("x", fg.Rn(1), 1)
graph.minimize(fg.residual(made(2.0), rows=1, derivatives="differences"), x)
with counting() as new:
    solution = GaussNewton().solve(graph, {x: np.ones((1, 1))})
print(len(new.compiled), round(float(solution[x][0, 0]), 9))
"""
OUTSIDE = """
import numba
from numba.extending import register_jitable

@numba.njit
def scaled(x):
    return 2.0 * x

@register_jitable
def helper(x):
    return x - 3.0
"""
SCRIPTS = """
import logging, runpy, shutil, sys
logging.basicConfig(level=logging.INFO, format="%(message)s")
sys.dont_write_bytecode = True  # files change within the second that tells compiled ones apart
sys.path.insert(0, sys.argv[1])
for changed in sys.argv[2:]:
    shutil.copytree(changed, sys.argv[1], dirs_exist_ok=True)
    sys.modules.pop("outside", None)
    runpy.run_path(f"{sys.argv[1]}/script.py")
"""
# What is replaced by what, and the solution.
CHANGES = {
    "nothing": ("", "", 0.125),
    "a comment": ("OFFSET = 0.5", "OFFSET = 0.5  # [m]", 0.125),
    "a captured number": ("made(2.0)", "made(4.0)", 0.0625),
    "a global constant": ("OFFSET = 0.5", "OFFSET = 1.5", 0.375),
    "the formula": ("- OFFSET", "+ OFFSET", -0.125),
    "a callee in another file": ("2.0 * x", "4.0 * x", 0.0625),
    "a callee that no fingerprint covers": ("", "", 3.0),
    "the inside of that": ("- 3.0", "- 4.0", 4.0),
}


def solved(folder: Path, *changes: str) -> tuple[str, list[tuple[int, float]]]:
    """Log of a process that solves with functions of its user; numbers of compiled functions, and solutions."""
    for change in changes:
        (folder / change).mkdir(exist_ok=True)
        before, after, value = CHANGES[change]
        for name, source in (("script.py", KEPT), ("outside.py", OUTSIDE)):
            changed = source.replace("made(2.0)", "unknown") if value >= 3.0 else source
            (folder / change / name).write_text(changed.replace(before, after), encoding="utf-8")
    place = {VARIABLE: str(folder / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    ended = run_script(SCRIPTS, folder / "run", *(folder / change for change in changes), variables=place)
    lines = [line.split() for line in ended.stdout.splitlines()]
    return ended.stderr, [(int(count), float(answer)) for count, answer in lines]


@pytest.mark.product(2, of="processes of their own")
def test_a_differenced_function_is_compiled_once_on_a_machine(tmp_path: Path) -> None:
    """A second process compiles nothing; a change of what the function computes is seen, one of a comment is not."""
    unknown = list(CHANGES)[-2]
    for changes in (["nothing", unknown], [change for change in CHANGES if change != unknown]):
        logged, found = solved(tmp_path, *changes)
        assert logged.count("is compiled in every process: it uses 'helper'") == 1
        for change, (count, answer) in zip(changes, found, strict=True):
            known = change in ("nothing", "a comment") and unknown not in changes
            assert answer == CHANGES[change][2] and (count == 0) == known, change
