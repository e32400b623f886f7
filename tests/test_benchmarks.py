"""Measurements on tiny inputs, the runner, and sentences and pages made from rows; nothing here depends on time."""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from benchmarks import (
    beyond_memory,
    collection,
    derivatives,
    elimination,
    exported,
    fault_search,
    gtsam_peer,
    horizon_and_velocity,
    many_instances,
    marginals,
    moved_goals,
    movers,
    mujoco,
    own_functions,
    pose_graphs,
    runner,
)
from benchmarks.cold import TOLERANCE
from benchmarks.comparison import Row, where
from benchmarks.horizon_and_velocity import Flown
from benchmarks.report import END, begin, put_results
from benchmarks.runner import PAGES, RESULTS, Study, Timing
from benchmarks.section import goal, met
from benchmarks.timing import interleave, number, ratio, shown, spread
from benchmarks.yielding import Yielding
from maps import walled
from problems.collection import BACKENDS, CASES, attempt
from unifg.errors import ScenarioError
from unifg.pose_graphs import manhattan
from unifg.scenarios.campaigns.journal import lines_of
from unifg.scenarios.simulation.faults import Fault
from unifg.scenarios.simulation.plane import World
from unifg.scenarios.simulation.space import Obstacle
from unifg.solvers import GaussNewton, InteriorPoint


@pytest.mark.parametrize("name", elimination.SECTIONS)
def test_a_section_measures_survives_json_and_renders(name: str) -> None:
    section = elimination.SECTIONS[name]
    result = json.loads(json.dumps(section.measure(1, True), allow_nan=False))
    text = section.render(result)
    assert all(line.count("|") == text.splitlines()[0].count("|") for line in text.split("\n\n")[0].splitlines()[1:2])
    assert "nan" not in text
    assert result["goals"] or not gtsam_peer.available()
    assert section.title in elimination.render({name: result})


def test_goals_have_targets_and_floors() -> None:
    found = goal("it", "times faster than GTSAM", [3.0, 3.0, 3.5], 6.0, 4.0)
    (row,) = elimination.render(
        {"chains": {**elimination.SECTIONS["chains"].measure(1, True), "goals": [found]}}
    ).splitlines()[2:3]
    assert [cell.strip() for cell in row.split("|")[3:-1]] == ["3.00 (3.00 to 3.50)", "6 (floor 4)", "no"]
    assert not met(found, "floor")
    assert met({**found, "unit": "ms", "value": [5.0, 5.0, 5.0]})


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
    assert ratio(np.array([2.0, 6.0, 9.0, 1.0]), np.array([1.0, 3.0, 3.0]))[0] == 2.0
    assert shown([12.345, 1.0, 123.4]) == "12.3 (1.00 to 123)"
    assert [number(value) for value in (0.0123, 0.0, 4567.0)] == ["0.0123", "0.000", "4567"]


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


@pytest.mark.product(1, of="studies")
@pytest.mark.parametrize("title", own_functions.problems())
def test_every_way_to_state_a_problem_is_the_same_problem(title: str) -> None:
    """The same iterations and the same answer; only differences are Python's."""
    problem, found = own_functions.problems()[title], {}
    for way in own_functions.ways(problem):
        stated = own_functions.stated(problem, way)
        solution = InteriorPoint(tolerance=TOLERANCE).solve(stated.graph, stated.guess, check=True)
        found[way] = solution
        routes = stated.graph.check(stated.guess.values).routes
        own = [routes[name] for name in ("dynamics", "tracking", "discs") if name in routes and way != "shipped"]
        said = "asked to be" if way == "differences" else "traced"
        assert all(said in route for route in own)
    first = next(iter(found.values()))
    for solution in found.values():
        assert solution.iterations == first.iterations
        assert solution.cost == pytest.approx(first.cost, rel=1e-7)


def doubled(seed: int, alone: bool) -> Row:
    if seed == 9:
        raise ScenarioError("no wind today")
    return {"double": 2 * seed}


def cells(seeds: Sequence[int]) -> list[runner.Cell]:
    return [{"seed": seed, "alone": alone} for seed in seeds for alone in (False, True)]


def told(rows: list[Row]) -> str:
    return ", ".join(str(row.get("double", row.get("refused"))) for row in rows)


class Threads(ThreadPoolExecutor):
    """Threads in the place of processes, which take seconds to start."""

    kill = ThreadPoolExecutor.shutdown


def test_a_study_measures_the_cells_that_are_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two workers measure what is missing, but for cells that are measured alone."""
    monkeypatch.setattr(runner, "OUT", tmp_path)
    monkeypatch.setattr(runner, "Workers", Threads)
    monkeypatch.setattr(runner, "machine", lambda codes: "here")
    study = Study(cells, doubled, told, range(2), alone=lambda cell: bool(cell["alone"]))

    def run(code: str, seeds: range | None = None, workers: int = 1, **chosen: bool) -> str:
        monkeypatch.setattr(runner, "commit", lambda: code)
        options = {"report": False, "any_code": False, "fresh": False, **chosen}
        return study.run("doubles", argparse.Namespace(seeds=seeds, workers=workers, **options))

    store = tmp_path / "doubles.jsonl"
    assert run("old", workers=2) == "0, 0, 2, 2\n\nhere"
    assert run("old", range(3)) == "0, 0, 2, 2, 4, 4\n\nhere"
    assert len(store.read_text().splitlines()) == 6, "nothing is measured twice"
    store.write_text(store.read_text() + '{"cut off')
    assert run("new", range(1)) == "0, 0\n\nhere"
    assert run("new", range(3), report=True) == run("new", range(3), any_code=True)
    assert len(list(lines_of(store))) == 8, "other states of the code stay on file"
    run("new", range(1), fresh=True)
    assert len(list(lines_of(store))) == 10
    assert run("new", range(9, 10)) == "no wind today, no wind today\n\nhere"
    with pytest.raises(SystemExit, match="Nothing on file"):
        run("new", range(20, 21), report=True)


def test_every_measured_section_has_a_study_and_says_commit_date_and_machine() -> None:
    marked = dict[tuple[str, str], str]()
    for path in RESULTS.glob("*.md"):
        text = path.read_text(encoding="utf-8")
        parts = text.split("<!-- results:begin ")[1:]
        marked |= {(path.stem, part.partition(" ")[0]): part.partition(END)[0] for part in parts}
    assert set(marked) == {(page, name) for page, studies in PAGES.items() for name in studies}
    assert [name for name, text in marked.items() if "Measured at commit `" not in text] == []


@pytest.mark.parametrize("name", [name for studies in PAGES.values() for name in studies])
def test_studies_state_their_cells(name: str) -> None:
    """Every cell has a key of its own that JSON gives back."""
    if name == "claims":
        pytest.importorskip("casadi", reason="the judge differentiates with casadi, which comes with the extra 'bench'")
    study = import_module(f"benchmarks.{name}").STUDY
    if isinstance(study, Timing):
        assert study.rounds > 0
        return
    keys = [tuple(cell.values()) for cell in study.cells(study.seeds)]
    assert len(set(keys)) == len(keys) > 0
    assert [tuple(key) for key in json.loads(json.dumps(keys))] == keys


def test_results_replace_what_stands_between_the_markers(tmp_path: Path) -> None:
    page, marker = tmp_path / "notes.md", begin("one")
    page.write_text("# Notes\n")
    put_results(page, "one", "text")
    assert page.read_text() == f"# Notes\n\n{marker}\ntext\n{END}\n"
    page.write_text(page.read_text() + "below\n")
    put_results(page, "two", "more")
    put_results(page, "one", "new")
    assert page.read_text() == f"# Notes\n\n{marker}\nnew\n{END}\nbelow\n\n{begin('two')}\nmore\n{END}\n"
    page.write_text(f"# Notes\n{marker}\n")
    with pytest.raises(ValueError, match="has no"):
        put_results(page, "one", "new")


def test_plants_are_compared_seed_by_seed() -> None:
    """The tracking error is measured ahead; what was not reached is listed beside the medians."""
    line = np.column_stack([np.arange(12.0), np.zeros(12)])
    plans = line[:, None] + np.column_stack([1.1 * np.arange(4.0), np.zeros(4)])
    assert mujoco.tracking(line, plans, 3) == pytest.approx(0.3)
    numbers = dict.fromkeys(mujoco.MEASURES, 1.0) | {"emergency": 0, "causes": {"no plan": 2}}
    rows = [
        {"robot": robot, "world": world, "seed": seed, **numbers, "contacts": seed, "outcome": "reached",
         "tracking_mm": 10.0 + 2.0 * (world == "mujoco")}
        for robot, worlds in mujoco.WORLDS.items() for world in worlds for seed in range(2)
    ]  # fmt: skip
    text = mujoco.render(rows)
    assert text.count("| tracking, rms [mm] | +2 (+2 .. +2) |") == 3
    assert "- drive, mujoco, seed 1: reached, 1 contacts" in text and "seed 0" not in text
    assert "- flight, air: *no plan* in 2 of 2" in text


def test_a_sample_compares_counts_with_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    page = "## Iterations: some\n\n| problem | SQP |\n|---|---:|\n| HS23 | {} |\n| HS35 | {} |\n"
    assert collection.main(["2026-11-24"]) == 0
    assert not collection.repeated(page.format("90", "3 (no)"), "any")
    assert capsys.readouterr().out.count("not the same") == 2


def test_claims_survive_the_file_and_are_counted() -> None:
    pytest.importorskip("casadi", reason="the judge differentiates with casadi, which comes with the extra 'bench'")
    from benchmarks import claims
    from exact_judge import Answer, Peer

    peer = Peer("Solve_Succeeded", True, 9, 1.0, 0.0, 1.0)
    answers = {
        "sqp": Answer("CONVERGED", 5, 0.1, 1.0, 1e-7, 0.0, 0.0, "true"),
        "ipm": Answer("CONVERGED", 5, 0.1, 0.5, 3e-3, 0.0, 0.0, "false", "stationarity is 0.003"),
        "alm": Answer("LOCALLY_INFEASIBLE", 5, 0.1, 2.0, 1.0, 0.1, 0.0, "saddle"),
    }
    case = claims.Case("parking", 3, False, answers, peer, None)
    assert claims.restored(json.loads(json.dumps({"code": "now", **asdict(case)}))) == case
    text = claims.render([case])
    assert "- parking 3, ipm: `CONVERGED`, but stationarity is 0.003." in text
    assert "| alm | 0 / 1 | 0 | 0 | - | 0 / 1 / 0 | 1 | 0 |" in text
    assert "| ipm | 1 / 1 | 0 | 1 | 3.00e-03 | 0 / 0 / 0 | 0 | 0 | 1 / 0 / 0 |" in text


def test_alpha_is_found_between_two_that_were_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    def flown(seed: int, gamma: float, alpha: float) -> Flown:
        return Flown(1.0 + gamma - 0.3 * float(np.log(alpha)), 0.0, 0.0, True)

    monkeypatch.setattr(horizon_and_velocity, "past_the_sphere", flown)
    wanted = [horizon_and_velocity.alpha_for(gamma, 1.0, [1, 2], 5) for gamma in (0.0, 0.2)]
    np.testing.assert_allclose(wanted, np.exp([0.0, 0.2 / 0.3]), rtol=1e-9)


def test_flights_are_compared_seed_by_seed() -> None:
    def some(*errors: float) -> list[Flown]:
        return [Flown(error, 0.0, 0.0, True) for error in errors]

    one: Any = some(0.1, 0.5, 0.9)
    assert horizon_and_velocity.paired(one, one, "error") == "-"
    assert horizon_and_velocity.paired(some(0.102, 0.502, 0.902), one, "error") == "+2 (+2 .. +2)"


@pytest.mark.parametrize("seed", [102, 104])
@pytest.mark.product(1, of="studies")
def test_a_moved_goal_among_discs_costs_no_more_than_with_twenty_starts(seed: int) -> None:
    row = moved_goals.measure(seed)
    assert row["warm, plan"] > 1.5 * row["best"] and row["loop, plan"] <= 1.02 * row["best"]
    assert row["loop, drive"] <= 1.02 * row["20 starts, drive"] and not row["not solved"]
    assert row["more"] < 16, "ordinary ticks try one start"
    text = moved_goals.tables([row])
    assert "| loop, 20 ms |" in text and "1 fields" in text


@pytest.mark.product(2, of="processes of their own")
@pytest.mark.skipif(shutil.which(os.environ.get("CC", "cc")) is None, reason="no C compiler is here")
def test_exported_solvers_are_beside_python() -> None:
    row = exported.measure(None, rounds=1)
    assert row[0] == "README, N = 20" and len(row) == 6
    assert min(map(float, row[1:])) > 0.0


@pytest.mark.product(2, of="processes of their own")
def test_submaps_are_beside_the_whole_map() -> None:
    whole, parted = beyond_memory.measure(2_000, 0), beyond_memory.measure(2_000, 600)
    assert len(whole) == len(parted) == 9 and parted[1] == "4 submaps"
    assert float(parted[5]) == pytest.approx(float(whole[5]), rel=1e-6)


def test_many_instances_are_beside_a_loop() -> None:
    row = many_instances.measure(many_instances.UNICYCLES[0], rounds=1, count=4)
    assert row[:2] == ("unicycle straight, N = 20", "4 of 4") and len(row) == 6
    assert min(map(float, row[2:])) > 0.0


def test_derivatives_are_beside_problems_solved_again() -> None:
    row = derivatives.measure(many_instances.UNICYCLES[1], rounds=1)
    assert row[0] < 1e-6 and len(row) == 7 and min(row[1:]) > 0.0


def test_the_future_is_that_of_the_world() -> None:
    hall = walled(12.0, 12.0, 2)
    discs = [Obstacle(np.array([6.0, 6.0]), 0.2), Obstacle(np.array([3.0, 9.0]), 0.25, np.array([4.3, 8.2]), 0.7)]
    world = World(hall, (2.0, 2.0, 0.0), discs)
    for _ in range(70):
        world.step(0.0, 0.0)
        assert np.allclose(world.discs()[:, :3], movers.future(discs)(world.time), atol=0.01)


@pytest.mark.parametrize(
    ("speeds", "contact", "clearance", "kind"),
    [
        ([1.0] * 12, None, 0.1, ""),
        ([1.0] * 12, 9, 0.1, "moving"),
        ([1.0] * 12, None, -0.01, "moving"),
        ([0.0] * 12, 9, 0.1, "at rest"),
        ([0.0] * 7 + [1.0] * 5, 9, 0.1, "moving"),
    ],
)
def test_contacts_are_told_apart_by_the_motion_before(
    speeds: list[float], contact: int | None, clearance: float, kind: str
) -> None:
    ticks = len(speeds)
    contacts, gaps = np.zeros(ticks, dtype=int), np.full(ticks, 0.1)
    gaps[9] = clearance
    if contact is not None:
        contacts[contact:] = 1
    pose = np.zeros((ticks, 3))
    pose[:, 0] = np.cumsum(np.array(speeds) * 0.1)
    log: Any = SimpleNamespace(contacts=contacts, clearance=gaps, collisions=contacts[-1], true_pose=pose, dt=0.1)
    assert movers.touched(log) == kind


@pytest.mark.product(1, of="studies")
def test_thirty_seeds_are_ten_routes_and_the_next_are_others() -> None:
    routes = [movers.settings(0.3, 2.5, seed).start for seed in (0, 10, 29, 30, 39)]
    assert routes[0] == routes[1] and len({*routes}) == 4


def test_rows_become_a_table() -> None:
    row = {
        "speed": 0.6, "base": 1.0, "futures": "worst", "seed": 0, "reached": True, "touched": "", "arrival": 20.0,
        "time": 30.0, "reverse": 0.1, "tick": 9.0,
    }  # fmt: skip
    rows = [row, {**row, "touched": "at rest"}, {**row, "reached": False}, {**row, "arrival": math.inf}]
    earlier = {**row, "futures": "tree", "time": 27.0}
    lines = movers.render([*rows, earlier, {**earlier, "seed": 1}]).splitlines()
    assert lines[2] == "| 0.6 | 1 | worst | 3 | 1 | 6 .. 79 % | 0 | 1 | 1 | 1.50 | 10 % | 9.0 |"
    assert "No drive with plans for the likeliest has a pair." in lines[-1]
    assert "for the tree the robot arrives -3 (-3 .. -3) s later than" in lines[-1] and "(1 pairs)" in lines[-1]


def test_the_search_finds_the_least_fault_that_harms(monkeypatch: pytest.MonkeyPatch) -> None:
    """A world in which a bias beyond 0.2 m that begins in the first half touches before it is named."""
    asked = []

    def run(robot: str, fault: Fault, seed: int) -> SimpleNamespace:
        size = abs(fault.size or 0.0)
        asked.append(size)
        touches = size > 0.2 and fault.begin < 3.0
        clearance = np.array([0.3, -0.1 if touches else 0.3 - 0.2 * min(size, 0.2), 0.2])
        return SimpleNamespace(
            time=np.array([0.0, 3.5, 4.0]), health=["ok", "ok", "degraded"], clearance=clearance, collisions=touches
        )

    monkeypatch.setattr(fault_search, "run", run)
    row = {"kind": "range-bias", **fault_search.search("range-bias", 0)}
    assert len(asked) == 12 and min(asked) >= 0.03 and max(asked) <= 0.8
    harming = [one for one in row["evaluations"] if one["unnamed"] <= 0.0]
    assert len(harming) > 1 and np.std(np.log(asked[8:])) < 0.5 * np.std(np.log(asked[:4])), "it narrows down"
    assert f"{min(abs(one['size']) for one in harming):.2f} m at " in fault_search.least(harming, "m")
    assert fault_search.least([], "m") == "none"
    page = fault_search.render([row, *({**row, "kind": kind} for kind in fault_search.SPANS if kind != "range-bias")])
    assert f"{12 * len(fault_search.SPANS)} evaluations" in page


def test_discs_of_the_yielding_world_stop_before_a_robot() -> None:
    disc = Obstacle(np.array([8.0, 6.05]), 0.2, np.array([1.0, 6.05]), 1.0)
    here = Yielding(walled(12.0, 12.0), (3.0, 6.0, 0.0), [disc], np.random.default_rng(0))
    for _ in range(60):
        here.step(0.0, 0.0)
    assert here.discs()[0, 0] == pytest.approx(3.0 + 0.17 + 0.2 + 0.5, abs=0.02) and here.collisions == 0
    for _ in range(40):
        here.step(-0.3, 0.0)
    assert here.discs()[0, 0] < 3.0, "it goes on where the robot makes way"


def test_a_measure_of_any_name_is_no_refusal() -> None:
    """An error in metres was taken for the reason of a refusal, and a page without rows said that all was well."""
    flown = runner.row_of(lambda seed: {"error": 0.4 / seed}, 1, {"seed": 2})
    assert where([flown], seed=2) == [flown] and flown["error"] == 0.2

    def refuse(seed: int) -> Row:
        raise fg.GraphError(f"no seed {seed}")

    assert where([runner.row_of(refuse, 1, {"seed": 2})], seed=2) == []
