"""Threads: solves of one graph wait for each other, what cannot be shared is refused, and loops let others run."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import unifg as fg
from at_once import at_once
from backends import BACKENDS, LENGTH, Walk, goal_of
from problems.graphs import graph_with
from test_horizon_hostile import loop_of, window_of
from unifg.codegen.jit import compiled
from unifg.errors import BackendError
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.typing import Array

THREADS, TURNS = 4, 6


@pytest.fixture(autouse=True)
def restless() -> Iterator[None]:
    """Threads take turns far more often than usual."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(usual)


@pytest.mark.product(4)
@pytest.mark.parametrize("name", BACKENDS)
def test_each_thread_gets_the_answer_to_its_own_data(name: str) -> None:
    walk = Walk(name)
    right = [walk.solved(name, number)[walk.x] for number in range(THREADS)]

    def solve(number: int) -> float:
        return max(float(np.abs(walk.solved(name, number)[walk.x] - right[number]).max()) for _ in range(TURNS))

    assert at_once(solve) == [0.0] * THREADS


def test_threads_may_begin_with_a_graph_that_nobody_has_compiled() -> None:
    walk = Walk("ipm")
    found = at_once(lambda number: walk.solved("ipm", number)[walk.x])
    for number, values in enumerate(found):
        np.testing.assert_allclose(values, walk.solved("ipm", number)[walk.x], atol=1e-9)


class Held:
    """A solve that stops at its first iteration until it is released, in a thread of its own."""

    def __init__(self, solve: Callable[..., fg.Solution]) -> None:
        self.inside, self.go = threading.Event(), threading.Event()
        self.solution: fg.Solution | None = None
        self.thread = threading.Thread(target=self._run, args=(solve,))

    def _run(self, solve: Callable[..., fg.Solution]) -> None:
        self.solution = solve(callback=self._wait)

    def _wait(self, row: fg.Iteration) -> None:
        self.inside.set()
        assert self.go.wait(30.0)

    def __enter__(self) -> Held:
        self.thread.start()
        assert self.inside.wait(30.0)
        return self

    def __exit__(self, *raised: object) -> None:
        self.go.set()
        self.thread.join(30.0)


@pytest.mark.parametrize("name", [name for name in BACKENDS if name != "gnc"])
def test_a_prepared_solver_that_is_at_work_is_refused_at_once(name: str) -> None:
    walk = Walk(name)
    prepared = BACKENDS[name].bound(walk.graph)
    right = prepared.solve(walk.guess, data={walk.goal: goal_of(1)})[walk.x]
    with Held(lambda callback: prepared.solve(walk.guess, data={walk.goal: goal_of(1)}, callback=callback)) as held:
        with pytest.raises(BackendError, match=f"prepared {type(BACKENDS[name]).__name__} is at work in another"):
            prepared.solve(walk.guess, data={walk.goal: goal_of(2)})
    assert held.solution is not None
    np.testing.assert_allclose(held.solution[walk.x], right, atol=1e-12)
    again = prepared.solve(walk.guess, data={walk.goal: goal_of(1)})  # it is nobody's now
    np.testing.assert_array_equal(again[walk.x], right)


@pytest.mark.parametrize("name", ["gn", "ipm", "sqp", "alm"])
def test_a_solve_within_a_solve_has_data_of_its_own(name: str) -> None:
    walk = Walk(name)
    right = [walk.solved(name, number)[walk.x] for number in range(2)]
    prepared, inside = BACKENDS[name].bound(walk.graph), []

    def look(row: fg.Iteration) -> None:
        if row.number == 0:
            inside.append(walk.solved(name, 1)[walk.x])
            assert not walk.graph.check(walk.guess, {walk.goal: goal_of(1)}).findings
            with pytest.raises(BackendError, match="from within a solve of its graph"):
                prepared.solve(walk.guess)

    outside = prepared.solve(walk.guess, data={walk.goal: goal_of(0)}, callback=look)
    np.testing.assert_allclose(outside[walk.x], right[0], atol=1e-9)
    np.testing.assert_array_equal(inside[0], right[1])


@pytest.mark.parametrize("name", ["gn", "ipm"])
def test_a_solution_answers_several_threads(name: str) -> None:
    walk = Walk(name)
    solution = walk.solved(name, 3)
    right = solution.marginals(walk.x), solution.covariance(walk.x[1:4])
    other = walk.solved(name, 3)

    def ask(number: int, other: fg.Solution = other, walk: Walk = walk, name: str = name) -> Any:
        if number % 2:
            walk.solved(name, number)
        return [(other.marginals(walk.x), other.covariance(walk.x[1:4])) for _ in range(3)]

    for found in at_once(ask):
        for marginals, covariance in found:
            np.testing.assert_array_equal(marginals, right[0])
            np.testing.assert_array_equal(covariance, right[1])


@pytest.mark.parametrize("kind", ["incremental", "fixed lag"])
def test_smoothers_are_shared(kind: str) -> None:
    smoother: Any = fg.Incremental() if kind == "incremental" else fg.FixedLag(10_000)
    families = [smoother.variables(f"x{k}", fg.SE2) for k in range(THREADS)]

    def drive(number: int) -> Array:
        x = families[number]
        for k in range(40):
            if k == 0:
                smoother.minimize(fg.prior, x[0], [0.0, 0.0, 0.1 * number], sigma=0.1)
            else:
                smoother.minimize(fg.between, x[k - 1], x[k], [1.0, 0.0, 0.1], sigma=0.1)
            smoother.update({x: [np.cos(0.1 * number) * k, 0.0, 0.1 * (number + k)]})
            assert len(smoother) > 0 and np.isfinite(smoother.cost)
            assert np.isfinite(smoother.covariance(x[-1])).all()
        return np.asarray(smoother.estimate(x))

    # Whose update takes the factors of another along must give their members values too: state and update in one turn.
    def alone(number: int) -> Array:
        with turn:
            return drive(number)

    turn = threading.Lock()
    found = at_once(alone)
    for poses in found:
        assert isinstance(poses, np.ndarray), poses
        step = fg.SE2.between(poses[:-1], poses[1:])
        np.testing.assert_allclose(step, np.tile([1.0, 0.0, 0.1], (39, 1)), atol=1e-6)

    def ask(number: int) -> bool:
        for k in range(60):
            if number == 0:
                x = families[0]
                smoother.minimize(fg.between, x[-1], x[len(x)], [1.0, 0.0, 0.1], sigma=0.1)
                smoother.update({x: smoother.estimate(x[-1])[0]})
            elif not np.isfinite(smoother.estimate(families[k % THREADS])).all():
                return False
        return True

    assert at_once(ask) == [True] * THREADS


def test_a_loop_belongs_to_one_thread_at_a_time() -> None:
    loop = loop_of()
    inside, go = threading.Event(), threading.Event()
    judge = loop.judge

    def slow(*arguments: Any) -> Any:
        inside.set()
        assert go.wait(30.0)
        return judge(*arguments)

    loop.judge = slow  # type: ignore[assignment]
    thread = threading.Thread(target=loop.tick)
    thread.start()
    assert inside.wait(30.0)
    try:
        for asked in (loop.tick, lambda: loop.plan([0.0, 0.0]), loop.reset):
            with pytest.raises(BackendError, match="loop is at work in another thread"):
                asked()
    finally:
        go.set()
        thread.join(30.0)
    loop.judge = judge
    loop.reset()
    assert loop.tick().source == "solved"


def test_measurements_come_in_while_a_window_is_estimated() -> None:
    window = window_of()

    def use(number: int) -> bool:
        for _ in range(20):
            if number == 0:
                window.move([0.1])
                window.estimate()
            elif number == 1:
                window.record("p", [0.1])
            elif not np.isfinite(window.covariance).all():
                return False
        return True

    assert at_once(use) == [True] * THREADS


@compiled
def long_sum(count: int) -> float:
    total = 0.0
    for k in range(count):
        total += 1.0 / (1.0 + k * total)
    return total


def test_others_run_while_compiled_loops_do() -> None:
    long_sum(1)
    done, seen = threading.Event(), 0

    def run() -> None:
        long_sum(30_000_000)
        done.set()

    thread = threading.Thread(target=run)
    thread.start()
    while not done.is_set():
        time.sleep(1e-3)
        seen += 1
    thread.join()
    assert seen > 5


def test_graphs_come_and_go_while_others_are_solved() -> None:
    """Machine code of terms goes with its graph; loops of other threads run on."""

    def use(number: int) -> float:
        worst = 0.0
        for k in range(8):
            graph, x = graph_with(fg.Rn(2), LENGTH)
            shift = 1.0 + number + 0.1 * k
            graph.minimize(lambda p, s=shift: 0.3 * np.sin(p - s) + (p - s), x)
            solver = (GaussNewton(), InteriorPoint(), SQP())[k % 3]
            worst = max(worst, np.abs(solver.solve(graph, {x: np.zeros((LENGTH, 2))})[x] - shift).max())
        return worst

    for worst in at_once(use):
        assert worst < 1e-5
