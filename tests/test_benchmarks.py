"""The benchmark of the elimination engine runs on tiny inputs; nothing here depends on time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from benchmarks import chains, collection, elimination, gtsam_peer, marginals, own_functions, own_residuals, pose_graphs
from benchmarks.section import Result, goal, met
from benchmarks.timing import Split, interleave, number, shown, spread
from problems.collection import BACKENDS, CASES, attempt
from unifg.pose_graphs import manhattan
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers import GaussNewton, InteriorPoint


@pytest.mark.parametrize("name", elimination.SECTIONS)
def test_a_section_measures_survives_json_and_renders(name: str) -> None:
    section = elimination.SECTIONS[name]
    result = json.loads(json.dumps(section.measure(1, True), allow_nan=False))
    text = section.render(result)
    assert all(line.count("|") == text.splitlines()[0].count("|") for line in text.split("\n\n")[0].splitlines()[1:2])
    assert "nan" not in text
    assert result["goals"] or not gtsam_peer.available()
    store: Result = {}
    elimination.record(store, name, result, 1.0, "code")
    elimination.record(store, name, result, 1.0, "code")
    assert store[name]["previous"]["goals"].keys() == {goal["name"] for goal in result["goals"]}
    assert section.title in elimination.render(store)


def test_the_page_shows_the_run_before(tmp_path: Path) -> None:
    found = goal("it", "times faster than GTSAM", [5.0, 4.0, 6.0], 6.0, 4.0)
    store: Result = {}
    elimination.record(store, "chains", {"goals": [found], "rounds": 15}, 1.0, "code")
    elimination.record(store, "chains", {"goals": [{**found, "value": [3.0, 3.0, 3.5]}], "rounds": 15}, 1.0, "code")
    (row,) = elimination.summary(store).splitlines()[2:]
    assert [cell.strip() for cell in row.split("|")[3:-1]] == [
        "3.00 (3.00 to 3.50)",
        "6 (floor 4)",
        "no",
        "5.00 (4.00 to 6.00)",
    ]
    assert not met({**found, "value": [3.0, 3.0, 3.0]}, "floor")
    assert met({**found, "unit": "ms", "value": [5.0, 5.0, 5.0]})
    (tmp_path / "store.json").write_text(json.dumps({"sections": store}))
    assert elimination.load(tmp_path / "store.json") == store
    assert elimination.load(tmp_path / "none.json") == {}


def test_rounds_are_interleaved_and_the_warm_ones_do_not_count() -> None:
    order: list[str] = []
    counts = {"a": 0, "b": 0}

    def run(name: str) -> float:
        order.append(name)
        counts[name] += 1
        return float(counts[name])

    times = interleave({"a": lambda: run("a"), "b": lambda: run("b")}, 8)
    assert times["a"].tolist() == times["b"].tolist() == list(range(2, 10))
    pairs = [tuple(order[k : k + 2]) for k in range(0, len(order), 2)]
    assert set(pairs) == {("a", "b"), ("b", "a")}


def test_spreads_and_digits() -> None:
    assert spread(np.arange(1.0, 6.0)) == [3.0, 2.0, 4.0]
    assert shown([12.345, 1.0, 123.4]) == "12.3 (1.00 to 123)"
    assert [number(value) for value in (0.0123, 0.0, 4567.0)] == ["0.0123", "0.000", "4567"]


def test_a_split_counts_adds_up_and_puts_back() -> None:
    graph, _, guess = manhattan(20).pose_graph.graph()
    run, original = GaussNewton().prepare(graph), CompiledProblem.linearize
    split = Split({"linearise": (CompiledProblem, "linearize")}, run.solve, per=2.0, setup=lambda: (guess,))
    elapsed = [split(), split()]
    assert CompiledProblem.linearize is original
    assert split.calls["linearise"] == run.solve(guess).iterations + 1
    np.testing.assert_allclose(np.sum(list(split.parts.values()), axis=0), elapsed, rtol=1e-9)
    assert split.milliseconds(1)["linearise"][0] == pytest.approx(1e3 * split.parts["linearise"][1])
    assert min(split.parts["linearise"]) > 0.0


@pytest.mark.parametrize("kind", chains.CASES)
def test_eliminations_are_counted(kind: str) -> None:
    backend, graph, guess = chains.chain(kind, 4)
    run = backend.prepare(graph)
    solution = run.solve(guess)
    assert solution.converged
    count = chains.eliminations(run, guess)
    if kind == "bounded":
        assert count >= solution.iterations
    else:
        assert count == solution.iterations


def test_residuals_written_by_hand_are_the_shipped_one() -> None:
    pose_graph, known = own_residuals.drive(25)
    reference = None
    for name, residual in own_residuals.RESIDUALS.items():
        graph, x = own_residuals.stated(pose_graph, known, residual)
        lin = graph.compile().linearize({x: pose_graph.poses})
        reference = reference or lin
        np.testing.assert_allclose(lin.residual, reference.residual, rtol=1e-9, atol=1e-11)
        tolerance = 1e-9 if name == "derived" else 1e-6  # the others are differentiated numerically
        np.testing.assert_allclose(lin.jacobian, reference.jacobian, rtol=tolerance, atol=tolerance)


def test_marginals_are_blocks_of_the_inverse() -> None:
    pose_graph = manhattan(30).pose_graph
    graph, x = pose_graphs.posed(pose_graph, 0.1)
    solution = GaussNewton().solve(graph, {x: pose_graph.poses})
    program = graph.compile()
    tree = marginals.Tree(program, solution)
    upper = program.normal.matrix(tree.lin.hessian).toarray()
    inverse = np.linalg.inv(upper + upper.T - np.diag(upper.diagonal()))
    expected = np.array([inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(30)])
    np.testing.assert_allclose(tree.blocks(), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_the_peer_solves_the_same_problem(group: str) -> None:
    pytest.importorskip("gtsam")
    pose_graph = pose_graphs.cases(small=True)[group == "SE3"].pose_graph
    peer = gtsam_peer.Peer(pose_graph)
    graph, x, guess = pose_graph.graph()
    start = 2.0 * peer.graph.error(peer.start)
    assert start == pytest.approx(pose_graph.chi2(), rel=1e-9)
    solution = GaussNewton().solve(graph, guess)
    assert isinstance(solution, fg.Solution)
    assert peer.solve("COLAMD")[2] == pytest.approx(pose_graph.with_poses(solution[x]).chi2(), rel=1e-6)


def test_the_page_of_the_collection_counts_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collection, "CASES", {name: CASES[name] for name in ("HS21", "Beale", "no real root")})
    monkeypatch.setattr(collection, "BACKENDS", {name: BACKENDS[name] for name in ("SQP", "GaussNewton")})
    monkeypatch.setattr(collection, "find_spec", lambda name: None)
    results = collection.measure()
    assert results["GaussNewton"].keys() == {"Beale"}
    text = collection.render(results)
    assert "| SQP | 3 | 2 | 0 | 0 | 1 | 0 | 100.0 % |" in text
    assert "| GaussNewton | singular | Beale |" in text
    outcome = attempt("HS21", BACKENDS["SQP"])
    assert outcome is not None and f"| HS21 | {outcome.iterations} |" in text


@pytest.mark.parametrize("title", own_functions.problems())
def test_every_way_to_state_a_problem_is_the_same_problem(title: str) -> None:
    """The same iterations and the same answer; only differences are Python's."""
    problem, found = own_functions.problems()[title], {}
    for way in own_functions.ways(problem):
        stated = own_functions.stated(problem, way)
        solution = InteriorPoint(tolerance=own_functions.TOLERANCE).solve(stated.graph, stated.guess)
        assert solution.converged
        found[way] = solution
        routes = stated.graph.check(stated.guess.values).routes
        own = [routes[name] for name in ("dynamics", "tracking", "discs") if name in routes and way != "shipped"]
        said = "asked to be" if way == "differences" else "traced"
        assert all(said in route for route in own)
    first = next(iter(found.values()))
    for solution in found.values():
        assert solution.iterations == first.iterations
        assert solution.cost == pytest.approx(first.cost, rel=1e-7)
