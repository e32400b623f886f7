"""Solves that share their work among threads: the same answers, and nothing torn."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from scripts import run_script
from unifg.codegen import threads as crews
from unifg.codegen.jit import compiled
from unifg.codegen.threads import cores, share, threads
from unifg.codegen.vectors import Address, address, advance, present
from unifg.codegen.waiting import first_chunk, next_chunk, wait_for
from unifg.codegen.work_queue import ENTERED, LEFT, POSTED, arguments_at, arrays, empty_mailbox, entrance, lead, serve
from unifg.elimination.factorization import Factorization
from unifg.elimination.fronts import WIDE
from unifg.elimination.plan import PIVOTS, ROWS
from unifg.elimination.sharing import PLAN, row_of
from unifg.elimination.subtrees import PARTS
from unifg.elimination.symmetric import Symmetric
from unifg.errors import UnifgError
from unifg.pose_graphs import PoseGraph, manhattan, sphere
from unifg.problem.evaluation import TERM_ARRAYS
from unifg.problem.table import COUNT, PAIRED, POSITION, WIDTH
from unifg.problem.thread_partition import Shares
from unifg.solvers import GaussNewton
from unifg.typing import Array, IntArray


@pytest.fixture(autouse=True)
def one_thread_afterwards() -> Iterator[None]:
    yield
    fg.use_threads(1)


@pytest.fixture(scope="module")
def lattice() -> PoseGraph:
    ball = sphere(50, 50)
    return ball.pose_graph.with_poses(ball.truth)


def system(pose_graph: PoseGraph) -> tuple[Factorization, Array]:
    """A factorisation, and the Hessian it is of."""
    graph, _, guess = pose_graph.graph()
    program = graph.compile()
    return Factorization(program.normal, program.blocks), program.linearize(guess).hessian.copy()


def test_parts_of_a_tree_are_eliminated_to_the_bit(lattice: PoseGraph) -> None:
    factorization, hessian = system(lattice)
    right = np.random.default_rng(0).normal(size=factorization.pattern.size)
    assert factorization.factor(hessian)
    part, panels, inertia = factorization.plan.part, factorization.plan.numbers.copy(), factorization.inertia
    solved, seen = factorization.solve(right), list[Array]()
    wide = factorization.plan.fronts[:-1][part == PARTS][:, [PIVOTS, ROWS]].sum(axis=1) > WIDE
    assert len(set(part.tolist())) > 3 and wide.any(), "nothing is shared out here"
    for count in (2, 3, 5):
        fg.use_threads(count)
        for _ in range(3):
            factorization.plan.numbers[:] = np.nan
            factorization.plan.numbers[factorization.plan.shape[3] :] = 0.0
            assert factorization.factor(hessian)
            assert factorization.inertia == inertia and factorization.failure == -1
            seen.append(factorization.solve(right))
            held = factorization.plan.shape[3]
            assert np.array_equal(factorization.plan.numbers[:held], panels[:held])
    assert all(np.array_equal(other, solved) for other in seen)


def test_what_fails_fails_at_the_same_pivot(lattice: PoseGraph) -> None:
    """Wherever it stands: a diagonal entry of zero in each of many columns, and an infinite one."""
    factorization, hessian = system(lattice)
    pattern = factorization.pattern
    for column, entry in ((3, 0.0), (700, 0.0), (pattern.size - 2, 0.0), (1500, np.inf)):
        damaged = hessian.copy()
        rows = pattern.indices[pattern.indptr[column] : pattern.indptr[column + 1]]
        damaged[pattern.indptr[column] + int(np.flatnonzero(rows == column)[0])] = entry
        found = []
        for count in (1, 2):
            fg.use_threads(count)
            found.append((factorization.factor(damaged), factorization.inertia, factorization.failure))
        assert found[0] == found[1]


def test_chunks_of_a_triangle_cover_it_once_in_rows_of_eight() -> None:
    for chunks, rows, columns in ((1, 40, 40), (4, 40, 40), (16, 450, 450), (16, 96, 700), (7, 9, 9), (3, 0, 5)):
        rows_of = [row_of(k, chunks, rows, columns) for k in range(chunks + 1)]
        assert rows_of[0] == 0 and rows_of[-1] == rows and rows_of == sorted(rows_of)
        assert all(row % 8 == 0 for row in rows_of[:-1])
    entries = [row_of(k + 1, 4, 400, 400) * (800 - row_of(k + 1, 4, 400, 400)) / 2 for k in range(4)]
    assert np.diff(entries, prepend=0.0) == pytest.approx(20_000, rel=0.1)


@pytest.mark.product(2, of="processes of their own")
def test_two_threads_that_solve_share_one_crew(lattice: PoseGraph) -> None:
    """Each with two more hands, on a graph of its own."""
    graphs = [lattice.graph() for _ in range(2)]
    fg.use_threads(2)
    runs = [GaussNewton().prepare(graph) for graph, _, _ in graphs]
    alone = [run.solve(guess)[x] for run, (_, x, guess) in zip(runs, graphs, strict=True)]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            found = list(pool.map(lambda k: runs[k].solve(graphs[k][2])[graphs[k][1]], range(2)))
            assert all(np.array_equal(a, b) for a, b in zip(found, alone, strict=True))


def hands() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("unifg ")]


def test_threads_that_were_sent_away_leave() -> None:
    for thread in hands():  # of the tests before
        thread.join(5.0)
    fg.use_threads(4)
    assert len(hands()) == 3
    fg.use_threads(1)
    for thread in hands():
        thread.join(5.0)
    assert not hands()


@pytest.mark.product(2, of="processes of their own")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this platform")
def test_a_forked_child_has_threads_of_its_own() -> None:
    script = (
        "import os, threading, warnings, numpy as np, unifg as fg\n"
        "from unifg.pose_graphs import sphere\n"
        "from unifg.solvers import GaussNewton\n"
        "warnings.simplefilter('ignore')\n"
        "fg.use_threads(3)\n"
        "graph, x, guess = sphere(50, 50).pose_graph.graph()\n"
        "run = GaussNewton(max_iterations=1).prepare(graph)\n"
        "here = run.solve(guess)[x]\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    hands = sum(t.name.startswith('unifg ') and t.is_alive() for t in threading.enumerate())\n"
        "    os._exit(0 if np.array_equal(run.solve(guess)[x], here) and hands == 2 else 1)\n"
        "raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
    )
    run_script(script)


def test_little_work_is_not_shared_out() -> None:
    factorization, _ = system(manhattan(40).pose_graph)
    assert not len(factorization.plan.part)
    empty = Factorization(
        Symmetric.of_blocks(np.zeros(1, dtype=np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    )
    assert not len(empty.plan.part)


@numba.njit  # type: ignore[untyped-decorator]
def apart(x: Array, y: Array, r: Array) -> None:
    for k in range(7):
        r[k] = 1e-3 * (y[k] - x[k])


@pytest.mark.parametrize("robust", [None, fg.Huber(1.0)], ids=["squares", "Huber"])
@pytest.mark.product(2, of="processes of their own")
def test_a_solve_with_threads_repeats_itself(lattice: PoseGraph, robust: fg.Loss | None) -> None:
    """With a function of one's own beside the shipped ones, and one factor left out."""
    graph, x, guess = lattice.graph(robust=robust)
    edges = lattice.edges
    active = np.ones(len(edges), dtype=bool)
    active[17] = False
    graph.minimize(fg.residual(apart, rows=7), x[edges.first], x[edges.second], active=active, name="own")
    run = GaussNewton().prepare(graph)
    program = graph.compile()
    alone, single = run.solve(guess), program.linearize(guess)
    fg.use_threads(2)
    first, second, shared = run.solve(guess), run.solve(guess), program.linearize(guess)
    assert np.array_equal(first[x], second[x]) and first.iterations == alone.iterations
    np.testing.assert_allclose(first[x], alone[x], atol=1e-9)
    assert np.array_equal(shared.residual, single.residual) and np.array_equal(shared.jacobian, single.jacobian)
    np.testing.assert_allclose(shared.hessian, single.hessian, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(shared.gradient, single.gradient, rtol=1e-12, atol=1e-8)
    assert shared.cost == pytest.approx(single.cost, rel=1e-12)
    assert shared.norms == pytest.approx(single.norms, rel=1e-12)


def test_entries_that_several_shares_write_to_stand_beside_the_matrix(lattice: PoseGraph) -> None:
    """Each entry is written in place by the first share that has it, and by every other one in a place of its own."""
    graph, _, _ = lattice.graph()
    program = graph.compile()
    table, entries = program.table, program.normal.nnz
    for count in (2, 3):
        shares = Shares(table, program.columns.width, entries, count)
        many = len(shares.contested)
        assert 0 < many < 0.05 * entries
        written: list[list[IntArray]] = [[] for _ in range(count)]
        for row in table.arrays.fields:
            pairs, factors = int(row[WIDTH] * (row[WIDTH] + 1) // 2), int(row[COUNT])
            at = slice(int(row[POSITION]), int(row[POSITION]) + factors * pairs)
            old, new = (places[at].reshape(factors, pairs) for places in (table.arrays.positions, shares.positions))
            for k in range(count):
                own = slice(factors * k // count, factors * (k + 1) // count)
                beside = new[own] >= entries
                ranks = new[own][beside] - entries
                assert (ranks // many == k - 1).all()
                assert np.array_equal(shares.contested[ranks % many], old[own][beside])
                assert np.array_equal(new[own][~beside], old[own][~beside])
                written[k].append(new[own].ravel())
        alone = np.concatenate([np.unique(np.concatenate(places)) for places in written])
        assert np.unique(alone[alone >= 0], return_counts=True)[1].max() == 1


def test_shares_that_meet_in_parts_of_blocks() -> None:
    """Positions alone in another share than the steps: beside the matrix, rows of blocks do not follow each other."""
    count = 9000
    graph, x = graph_with(fg.Product(position=fg.Rn(2), heading=fg.Rn(1)), count)
    here, there = np.arange(count - 1), np.arange(1, count)
    moved = np.tile([0.1, 0.0, 0.01], (count - 1, 1))
    graph.minimize(fg.between, x[here], x[there], graph.data("moved", moved, each=True), sigma=0.1, name="steps")
    graph.minimize(fg.prior, x[::-1].position, np.zeros((count, 2)), sigma=10.0, name="beacons")
    graph.minimize(fg.prior, x[0], np.zeros(3), sigma=1.0, name="start")
    program = graph.compile()
    guess = {x: np.random.default_rng(0).normal(size=(count, 3))}
    single = program.linearize(guess)
    assert program.table.arrays.fields[0, PAIRED] == 3
    fg.use_threads(2)
    shared = program.linearize(guess)
    assert program._shares is not None and len(program._shares.contested) == program.normal.nnz
    np.testing.assert_allclose(shared.hessian, single.hessian, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(shared.gradient, single.gradient, rtol=1e-12, atol=1e-8)
    assert np.array_equal(shared.jacobian, single.jacobian)


def test_the_number_of_threads_is_one_of_some() -> None:
    for wrong in (0, -1, 2.0, True, "2", None):
        with pytest.raises(UnifgError, match="at least 1, got"):
            fg.use_threads(wrong)  # type: ignore[arg-type]
    assert threads() == 1


CHUNKS = 40
_of_counting = arguments_at((arrays(numba.int64), arrays(numba.int64), numba.int64))


@compiled
def counting(where: Address) -> None:
    """Chunks of a pass by two phases, of which the second reads what the first has written."""
    first, second, counters = _of_counting(where)
    k = first_chunk(counters, 0)
    while k < CHUNKS:
        for _ in range(1000):
            first[k] += 1
        k = next_chunk(counters, 0)
    wait_for(counters, 0, CHUNKS)
    k = first_chunk(counters, 1)
    while k < CHUNKS:
        second[k] += first[CHUNKS - 1 - k]
        k = next_chunk(counters, 1)
    wait_for(counters, 1, CHUNKS)


def count(box: IntArray | None = None) -> IntArray:
    """The answer of that pass: a thousand everywhere."""
    first, second, counters = np.zeros(CHUNKS, np.int64), np.zeros(CHUNKS, np.int64), np.zeros(4, np.int64)
    given = first, second, counters.ctypes.data
    if box is None:
        share(entrance(counting), given)
    else:
        lead(box, entrance(counting), given)
    return second


@pytest.mark.parametrize("helpers", [1, 2, 4])
def test_a_pass_is_done_whoever_comes(helpers: int) -> None:
    fg.use_threads(helpers)
    for pause in (0.0, 0.01) * 10:  # threads that look out, and threads that sleep
        time.sleep(pause)
        assert (count() == 1000).all()


def test_threads_that_nobody_calls_sleep_and_are_woken() -> None:
    fg.use_threads(3)
    crew = crews._crew
    assert crew is not None
    for _ in range(2):
        waited = time.monotonic() + 30.0
        while crew.asleep < crew.size and time.monotonic() < waited:
            time.sleep(0.01)
        begin, entered = time.process_time(), int(crew.mailbox[ENTERED])
        time.sleep(0.3)
        assert time.process_time() - begin < 0.1
        while crew.mailbox[ENTERED] == entered and time.monotonic() < waited:
            assert (count() == 1000).all()
        assert crew.mailbox[ENTERED] > entered


def test_passes_of_many_callers_do_not_mix() -> None:
    fg.use_threads(3)
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: count(), range(400)):
            assert (found == 1000).all()


def test_who_finds_a_closed_call_does_nothing() -> None:
    box = empty_mailbox()
    assert (count(box) == 1000).all()
    assert box[POSTED] == 2
    assert serve(box, 0) == 0
    assert box[ENTERED] == box[LEFT] == 0


@compiled
def held_up(box: IntArray, calls: int) -> bool:
    """A helper that enters each call and is held up before it looks whether it is still open.

    Returns:
        Whether nobody returned from a call meanwhile.
    """
    where, seen, alone = address(box), 0, True
    for _ in range(calls):
        while present(where, POSTED) % 2 == 0 or present(where, POSTED) == seen:
            pass
        seen = present(where, POSTED)
        advance(where, ENTERED)
        for _ in range(500_000):
            alone = alone and present(where, POSTED) <= seen + 1
        advance(where, LEFT)
    return alone


def test_nobody_returns_while_somebody_is_inside() -> None:
    """A helper that is held up on its way in: what it looks at would be gone, or another call would be open."""
    box, calls = empty_mailbox(), 8
    held_up(box, 0)
    told = list[bool]()
    helper = threading.Thread(target=lambda: told.append(held_up(box, calls)))
    helper.start()
    while helper.is_alive():
        assert (count(box) == 1000).all()
    helper.join()
    assert told == [True] and box[ENTERED] == box[LEFT] == calls


def test_arguments_have_the_types_they_are_read_by(lattice: PoseGraph) -> None:
    """Compiled code takes what stands at an address for what it expects there."""
    factorization, _ = system(lattice)
    graph, _, _ = lattice.graph()
    assert numba.typeof(factorization.plan) == PLAN
    assert numba.typeof(graph.compile().table.arrays) == TERM_ARRAYS


def test_more_threads_than_cores_are_said(caplog: pytest.LogCaptureFixture) -> None:
    fg.use_threads(1)
    assert not caplog.messages
    fg.use_threads(cores() + 1)
    (said,) = caplog.messages
    assert said.startswith(f"use_threads({cores() + 1}): this process may use {cores()} cores")
    assert threads() == cores() + 1
