"""One owner of a program's linear systems: structure once, whoever asks; numbers that nobody else writes to."""

from collections.abc import Iterator

import numpy as np
import pytest

import unifg as fg
from at_once import at_once
from problems.graphs import graph_with
from unifg.elimination import analysis, factorization
from unifg.problem.systems import KEPT
from unifg.solution.warmup_run import rehearse
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
)
from unifg.typing import Array

TICKS = 6
UNCONSTRAINED = [GaussNewton(), LevenbergMarquardt(), DogLeg()]
ALL = [
    AugmentedLagrangian(), Penalty(), SQP(), SQP(qp="graph"), SQP(hessian="exact"), InteriorPoint(), KKT(),
    KKT(globalization="levenberg-marquardt"),
]  # fmt: skip


@pytest.fixture
def analyses(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Sizes of the systems that are analysed while a test runs."""
    found: list[int] = []
    analyse = analysis.analyse

    def counted(indptr, *arguments):  # type: ignore[no-untyped-def]
        found.append(len(indptr) - 1)
        return analyse(indptr, *arguments)

    monkeypatch.setattr(factorization, "analyse", counted)
    yield found


def advance(a: Array, b: Array) -> Array:
    """Distance of the second pose ahead of the first."""
    return np.asarray(b[:, :1] - a[:, :1])


def chain(kind: str, poses: int = 12) -> tuple[fg.Graph, fg.Family, fg.Data]:
    """Poses along a line with measured steps; some distances must be kept, or not exceeded."""
    graph, x = graph_with(fg.SE2, poses)
    start = graph.data("start", np.zeros(3))
    graph.minimize(fg.prior, x[0], start, sigma=0.1)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.1], sigma=[0.1, 0.1, 0.05])
    if kind in ("equalities", "all"):
        graph.constrain(fg.difference, x[3], x[5], lower=[1.9, 0.2, 0.2], upper=[1.9, 0.2, 0.2], name="rod")
    if kind == "all":
        graph.constrain(advance, x[:-1], x[1:], upper=5.0, name="reach")
    return graph, x, start


@pytest.mark.product(4)
@pytest.mark.parametrize(
    ("solver", "kind"),
    [
        *((solver, "free") for solver in UNCONSTRAINED),
        *((solver, "all") for solver in ALL),
    ],
)
def test_structure_is_analysed_once(solver: fg.Solver, kind: str, analyses: list[int]) -> None:
    graph, x, start = chain(kind)
    guess: dict[fg.Family, Array] = {x: np.tile([0.5, 0.1, 0.0], (len(x), 1)) * np.arange(len(x))[:, None]}
    rehearse(solver)  # its small problems have structures of their own
    analyses.clear()
    for _ in range(2):
        prepared = solver.prepare(graph)
        for tick in range(TICKS):
            solution = prepared.solve(guess, data={start: [0.01 * tick, 0.0, 0.0]})
            assert solution.covariance(x[-1]).shape == (3, 3)
            assert solution.covariance(x[2], x[4]).shape == (6, 6)
            assert solution.marginals(x).shape == (len(x), 3, 3)
            assert graph.check(guess)
            assert len(graph.elimination_tree())
    # The normal equations, and the KKT matrix with the equalities held, with all rows, or with the active ones.
    assert len(analyses) == len(set(analyses)) <= 3


def test_covariances_of_many_ticks_make_one_analysis(analyses: list[int]) -> None:
    graph, x, start = chain("free", 40)
    rehearse(GaussNewton())
    del analyses[:]
    prepared = GaussNewton().prepare(graph)
    guess = {x: np.zeros((len(x), 3))}
    found = [prepared.solve(guess, data={start: [0.1 * tick, 0.0, 0.0]}) for tick in range(20)]
    blocks = [solution.covariance(x[-1]) for solution in found]
    assert len(analyses) == 1
    # Every solution has numbers of its own: those asked later have not changed what the first one answers.
    again = [solution.covariance(x[-1]) for solution in found]
    assert all(np.array_equal(one, other) for one, other in zip(blocks, again, strict=True))


def test_structures_of_changing_rows_do_not_pile_up(analyses: list[int]) -> None:
    program = chain("all", 3 * KEPT)[0].compile()
    rows = np.zeros(program.constraints.count, dtype=bool)
    for k in range(2 * KEPT):
        rows[:] = False
        rows[: k + 1] = True
        assert len(program.systems.kkt(rows).factorization.tree)
    assert len(analyses) == 2 * KEPT
    assert len(program.systems.kkt(rows).factorization.tree)
    assert len(analyses) == 2 * KEPT
    assert len(program.systems._held) == KEPT


def test_threads_share_structure_and_nothing_else(analyses: list[int]) -> None:
    graph, x, _ = chain("equalities", 60)
    guesses = [{x: np.tile([k, 0.0, 0.1 * k], (len(x), 1))} for k in range(4)]
    alone = [KKT().solve(graph, guess) for guess in guesses]
    wanted = [(solution[x], solution.marginals(x)) for solution in alone]
    rehearse(KKT())
    del analyses[:]
    graph.compiled = None
    program = graph.compile()

    def work(k: int) -> tuple[Array, Array]:
        prepared = KKT().prepare(graph)
        for _ in range(5):
            solution = prepared.solve(guesses[k])
        return solution[x], solution.marginals(x)

    found = at_once(work, len(guesses))
    assert graph.compile() is program
    assert len(analyses) == len(set(analyses))
    for (values, marginals), own in zip(wanted, found, strict=True):
        assert np.array_equal(own[0], values)
        assert np.array_equal(own[1], marginals)


def test_what_is_handed_out_has_memory_of_its_own() -> None:
    graph, _, _ = chain("equalities")
    program = graph.compile()
    systems = program.systems
    first, second = systems.normal(), systems.normal()
    assert first.structure is second.structure
    for name in ("numbers", "work", "pivots", "signs", "state"):
        assert not np.shares_memory(getattr(first.plan, name), getattr(second.plan, name))
    with systems.borrowed() as one:
        with systems.borrowed() as other:
            assert one is not other
    with systems.borrowed() as again:
        assert again in (one, other)
    kkt, twin = systems.kkt(program.equality), systems.kkt(program.equality)
    assert kkt.factorization.structure is twin.factorization.structure
    assert not np.shares_memory(kkt.arrays.plan.numbers, twin.arrays.plan.numbers)
    assert not np.shares_memory(kkt.saddle.scale, twin.saddle.scale)
