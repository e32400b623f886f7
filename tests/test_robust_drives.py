"""Graduated non-convexity on long drives: right closures kept, wrong odometry, groups that agree with themselves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from problems.closures import with_wrong_closures
from problems.drives import Kind, aliased, drive, slipped
from problems.graphs import graph_with, program_of
from unifg.files.g2o import read_g2o, write_g2o
from unifg.pose_graphs import Edges, PoseGraph, chordal, lago, manhattan, odometric, pairwise_consistent
from unifg.scenarios import command
from unifg.solution.outlier_report import Group
from unifg.solvers import GaussNewton, GraduatedNonConvexity, graduated_non_convexity
from unifg.solvers.gating import CHANCE, Innovations, VarianceFactor, groups_of
from unifg.typing import Array, BoolArray

THRESHOLD = 3.37
LOSS = fg.TruncatedLeastSquares(THRESHOLD)
CALM = Kind(drift=0.3)
HEAVY = Kind(drift=0.3, noise=0.1, tail=0.1, tail_noise=1.5)
UNEVEN = Kind(drift=0.1, noise=0.3, tail=0.1, tail_noise=2.0)


def squares(graph: PoseGraph) -> PoseGraph:
    stated, x, guess = graph.graph()
    return graph.with_poses(GaussNewton().solve(stated, guess, check=True)[x])


def robust(graph: PoseGraph, loss: fg.TruncatedLeastSquares = LOSS) -> tuple[fg.Solution, PoseGraph, BoolArray]:
    stated, x, guess = graph.graph(robust=loss)
    solution = GraduatedNonConvexity().solve(stated, guess)
    assert solution.verdict is not None
    return solution, graph.with_poses(solution[x]), solution.verdict.kept["closures"]


def apart(one: PoseGraph, other: PoseGraph) -> float:
    dim = one.group.point_dim
    return float(np.linalg.norm(one.poses[:, :dim] - other.poses[:, :dim], axis=1).max())


@pytest.mark.parametrize(
    ("seed", "kind"),
    [(0, Kind()), (5, Kind(noise=0.05, tail=0.1)), (0, HEAVY), (6, HEAVY), (0, UNEVEN), (6, UNEVEN), (7, UNEVEN)],
)
@pytest.mark.product(1, of="large maps")
def test_a_clean_drive_keeps_every_closure(seed: int, kind: Kind) -> None:
    """Up to 69 of 100 right closures were given up, for a map 56 m off, CONVERGED."""
    graph, _ = drive(seed, kind)
    right = squares(graph)
    assert right.squared_errors()[~graph.edges.odometry].max() < THRESHOLD**2
    solution, found, kept = robust(graph)
    assert solution.converged and kept.all() and apart(found, right) < 1e-6


@pytest.mark.data
@pytest.mark.parametrize("name", ["tinyGrid3D.g2o", "smallGrid3D.g2o", "intel.g2o.gz", "M3500.g2o.gz"])
@pytest.mark.product(1, of="large maps")
def test_a_published_graph_keeps_every_closure(shared_data: Path, name: str) -> None:
    graph = read_g2o(shared_data / "pose_graphs" / name)
    solution, found, kept = robust(graph, fg.TruncatedLeastSquares(THRESHOLD if graph.group is fg.SE2 else 4.1))
    assert solution.converged and kept.all() and apart(found, squares(graph)) < 1e-5


def test_what_is_improbable_as_stated_is_not_kept() -> None:
    """A wrong closure within its threshold at the optimum of squares, where the sum of all is as stated, too."""
    clean = manhattan(100, 1).pose_graph
    dirty, wrong = with_wrong_closures(clean, 0.3, 0, "anywhere")
    chosen = pairwise_consistent(dirty)
    graph, wrong = replace(dirty, edges=dirty.edges[chosen]), wrong[chosen]
    plain = squares(graph)
    assert wrong.sum() == 1 and plain.squared_errors().max() < THRESHOLD**2
    solution, _, kept = robust(graph)
    np.testing.assert_array_equal(kept, ~wrong[~graph.edges.odometry])
    assert solution.cost < 0.5 * plain.chi2()


@pytest.mark.parametrize("share", [0.1, 0.3])
@pytest.mark.product(1, of="large maps")
def test_uneven_closures_are_kept_beside_wrong_ones(share: float) -> None:
    """Two right ones with more noise than the others were given up together with the wrong ones."""
    clean, _ = drive(10, HEAVY)
    dirty, wrong = with_wrong_closures(clean, share, 10, "same place")
    solution, found, kept = robust(dirty)
    assert solution.converged
    np.testing.assert_array_equal(kept, ~wrong[~dirty.edges.odometry])
    assert apart(found, squares(clean)) < 1e-6


@pytest.mark.parametrize(("seed", "count"), [(6, 8), (19, 15)])
def test_a_group_that_contradicts_the_others_is_left_out(seed: int, count: int) -> None:
    """All of it lies within its thresholds at the optimum of squares; the first group even costs less as stated."""
    sim, rng = manhattan(200, seed), np.random.default_rng(seed)
    edges, group, truth = sim.pose_graph.edges, sim.pose_graph.group, sim.truth
    first = rng.integers(0, 60) + np.arange(count)
    second = rng.integers(100, 190 - (count - 8)) + np.arange(count)
    miss = np.array([[0.5, 0.3, 0.1] if count == 8 else [3.0, 2.0, 0.3]])
    move = group.compose(group.compose(truth[first[:1]], group.exp(miss)), group.inverse(truth[second[:1]]))
    seen = group.compose(group.inverse(truth[first]), group.compose(np.repeat(move, count, axis=0), truth[second]))
    seen = group.compose(seen, group.exp(0.02 * rng.standard_normal((count, 3))))
    information = 0.02 * np.concatenate([edges.information, np.repeat(edges.information[-1:], count, axis=0)])
    every = Edges(
        np.concatenate([edges.first, first]), np.concatenate([edges.second, second]),
        np.concatenate([edges.measured, seen]), information,
    )  # fmt: skip
    graph, wrong = replace(sim.pose_graph, edges=every), np.arange(len(every)) >= len(edges)
    plain = squares(graph)
    assert plain.squared_errors()[~every.odometry].max() < THRESHOLD**2
    solution, found, kept = robust(graph)
    np.testing.assert_array_equal(kept, ~wrong[~every.odometry])
    assert (solution.cost > 0.5 * plain.chi2()) == (count == 8)
    assert apart(found, squares(replace(graph, edges=every[~wrong]))) < 1e-4


@pytest.mark.parametrize("seed", [0, 6, 9])
@pytest.mark.product(1, of="large maps")
def test_wrong_odometry_is_found_and_no_start_leads_lower(seed: int) -> None:
    """Each start alone, and its Huber optimum: local descent of the stated objective ends no lower.

    Which edge of a loop slipped is not determined, if it is the only loop.
    """
    clean, _ = drive(seed, CALM)
    graph, which = slipped(clean, 100 + seed)
    keep = np.ones(len(graph.edges), dtype=bool)
    keep[which] = False
    without = replace(graph, edges=graph.edges[keep])
    right = squares(without.with_poses(chordal(without)))
    stated, x, guess = graph.graph(robust=LOSS, robust_on="all")
    solution = GraduatedNonConvexity().solve(stated, guess, check=True)
    assert solution.verdict is not None
    assert solution.verdict.kept["closures"].all()
    assert len(solution.verdict.left_out["odometry"]) <= 3
    milder, y, _ = graph.graph(robust=fg.Huber(1.345), robust_on="all")
    begun: list[Array] = [right.poses, graph.poses, *(method(graph) for method in (odometric, chordal, lago))]
    begun += [GaussNewton().solve(milder, {y: start})[y] for start in begun]
    for start in begun:
        assert solution.cost <= GaussNewton().solve(stated, {x: start}).cost * (1.0 + 1e-9)


def test_a_graph_names_further_starts_where_nothing_is_trusted() -> None:
    graph, _ = drive(0, replace(CALM, count=400))
    assert graph.graph(robust=LOSS)[0].starts == graph.graph(robust_on="all")[0].starts == []
    stated, x, _ = graph.graph(robust=LOSS, robust_on="all")
    found = [start()[x] for start in stated.starts]
    for poses, method in zip(found, (odometric, chordal, lago), strict=True):
        np.testing.assert_array_equal(poses, method(graph))
    copied = stated.snapshot()
    copied.starts.clear()
    assert len(stated.starts) == 3


@pytest.mark.product(1, of="large maps")
def test_the_command_doubts_odometry_when_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean, _ = drive(0, CALM)
    graph, _ = slipped(clean, 100)
    file, out = write_g2o(tmp_path / "drive.g2o", graph), tmp_path / "out"
    options = ["--robust", "gnc", "--robust-on", "all", "--out", str(out)]
    assert command.main(["solve", str(file), *options]) == 0
    found = json.loads((out / "metrics.json").read_text())
    assert found["robust_on"] == "all" and found["outliers"] == 3
    assert all(b - a == 1 for a, b in found["outlier_edges"])
    assert found["groups"] == []
    said = capsys.readouterr().out
    assert "on measurements" in said and "3 of the measurements" in said


@pytest.mark.parametrize(("seed", "miss", "kept"), [(4, (20.0, 5.0, 0.1), True), (0, (20.0, 5.0, 0.1), False)])
def test_a_group_that_agrees_with_itself_alone_is_named(seed: int, miss: tuple[float, ...], kept: bool) -> None:
    """Fifteen aliased closures beside twenty right ones: kept or not, the other reading is handed over."""
    clean, truth = drive(seed, replace(CALM, closures=20))
    graph, wrong = aliased(clean, truth, seed, miss)
    closures = np.flatnonzero(wrong[~graph.edges.odometry])
    solution, found, counts = robust(graph)
    assert solution.verdict is not None and counts[closures].all() == counts[closures].any() == kept
    (group,) = (one for one in solution.verdict.groups if set(one.factors) & set(closures))
    assert group.term == "closures" and group.kept == kept and group.factors.tolist() == closures.tolist()
    other = graph.with_poses(group.other[group.other.families["poses"]])
    without = squares(clean)
    assert apart(other if kept else found, without) < 1e-5 and apart(other, found) > 5.0
    family, member, far = group.moved
    assert family == "poses" and far > 5.0
    assert far == pytest.approx(np.linalg.norm(fg.SE2.local(found.poses[member], other.poses[member])))
    said = solution.verdict.sentence(solution.cost)
    assert f"15 in 'closures' ({', '.join(map(str, closures[:5]))}, ...); {'without' if kept else 'with'} them" in said
    assert f"'poses' {member} by {far:.3g}" in said and group.sentence() in solution.report()


@pytest.mark.product(1, of="large maps")
def test_the_command_names_groups(tmp_path: Path) -> None:
    clean, truth = drive(4, replace(CALM, closures=20))
    graph, wrong = aliased(clean, truth, 4, (20.0, 5.0, 0.1))
    file, out = write_g2o(tmp_path / "drive.g2o", graph), tmp_path / "out"
    assert command.main(["solve", str(file), "--robust", "gnc", "--out", str(out)]) == 0
    (group,) = (one for one in json.loads((out / "metrics.json").read_text())["groups"] if len(one["factors"]) == 15)
    assert group["kept"] and group["term"] == "closures" and group["cost"] > 80.0
    assert group["factors"] == np.flatnonzero(wrong[~graph.edges.odometry]).tolist()


def test_a_group_is_taken_out_as_dense_algebra_does() -> None:
    """The fall of the sum of squares without some closures, at the optimum; the redundancies of all terms."""
    graph = squares(manhattan(60, seed=3).pose_graph)
    stated, _, guess = graph.graph(robust=fg.TruncatedLeastSquares(50.0))
    program = program_of(stated)
    lin = program.linearize(guess)
    jacobian, residual = program.costs.matrix(lin.jacobian).toarray(), lin.residual.copy()
    residual -= jacobian @ np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    lin.residual[:] = residual
    innovations = Innovations(program, program.systems.normal(), lin.hessian)
    term = next(term for term, _ in program.table.robust)
    first = len(residual) - 3 * term.count
    for chosen in (np.array([2, 3, 4]), np.arange(0, term.count, 2)):
        own = (first + 3 * chosen[:, None] + np.arange(3)).ravel()
        rest = np.setdiff1d(np.arange(len(residual)), own)
        moved = residual[rest] - jacobian[rest] @ np.linalg.lstsq(jacobian[rest], residual[rest], rcond=None)[0]
        fall = innovations.joint(term, lin, chosen, np.ones(len(chosen)))
        assert fall == pytest.approx(residual @ residual - moved @ moved, rel=1e-6)
    shares = [innovations.redundancy(one, lin, np.ones(one.count)) for one in program.cost_terms]
    assert sum(shares) == pytest.approx(len(residual) - program.size) and min(shares) > 0.0
    hat = np.diag(jacobian @ np.linalg.pinv(jacobian))
    assert shares[-1] == pytest.approx(3 * term.count - hat[first:].sum())


def test_groups_join_the_same_stretches() -> None:
    ends = [(0, 100), (10, 95), (20, 90), (20, 130), (200, 100), (205, 110), (400, 3), (401, 4), (402, 5), (403, 300)]
    graph, x = graph_with(fg.Rn(1), 500)
    first, second = np.array(ends).T
    graph.minimize(fg.between, x[first], x[second], [0.0], name="pairs")
    graph.minimize(fg.prior, x[np.arange(500)], np.zeros((500, 1)), name="alone")
    terms = {term.name: term for term in graph.compile().cost_terms}
    every = np.ones(len(ends), dtype=bool)
    assert [group.tolist() for group in groups_of(terms["pairs"], every)] == [[0, 1, 2], [6, 7, 8]]
    every[1] = False
    assert [group.tolist() for group in groups_of(terms["pairs"], every)] == [[6, 7, 8]]
    assert groups_of(terms["alone"], np.ones(500, dtype=bool)) == []


@pytest.mark.product(1, of="large maps")
def test_the_size_of_noise_is_that_of_each_term_over_what_either_keeps() -> None:
    """Odometry and closures apart; a closure that one answer leaves out counts as the other one has it."""
    graph, _ = with_wrong_closures(drive(2, replace(CALM, count=600))[0], 0.2, 1, "same place")
    stated, _, guess = graph.graph(robust=LOSS)
    staged, stages = graduated_non_convexity._staged(stated)
    search = graduated_non_convexity._Search(GraduatedNonConvexity(), stated, staged, stages, None, None)
    search.best(guess)
    sparse, dense = (pick(search.found, key=lambda one: one.count) for pick in (min, max))
    assert sparse.count < dense.count
    units = sparse.units_with(dense, search._shares)
    assert units == dense.units_with(sparse, search._shares) and units.keys() == {"odometry", "closures"}
    shares = search._shares
    plain = max(one._plain["odometry"].total for one in (sparse, dense))
    assert units["odometry"] == VarianceFactor(plain, shares["odometry"].total).unit
    both = np.maximum(*(one.weights[0] * one.squared[0] for one in (sparse, dense)))
    rows = 3.0 * float(np.maximum(sparse.weights[0], dense.weights[0]).sum())
    freedom = shares["closures"].total + rows - shares["closures"].rows
    assert units["closures"] == VarianceFactor(float(both.sum()), freedom).unit
    # As stated, every closure left out counts its c^2, and nothing is scaled.
    left = sum(int((~kept).sum()) for kept in sparse.kept)
    inside = float(sparse.squared[0][sparse.kept[0]].sum())
    assert sparse.judged({}) == pytest.approx(2.0 * sparse.solution.cost)
    assert sparse.judged({}) == pytest.approx(sparse._plain["odometry"].total + inside + left * THRESHOLD**2)


def test_noise_that_is_known_needs_no_scatter() -> None:
    known = VarianceFactor(0.0, np.inf)
    from scipy.special import chdtri

    limit = float(chdtri(3, CHANCE / 50))
    assert known.rejects(np.array([0.999, 1.001]) * limit, 3, 50).tolist() == [False, True]


def test_a_group_says_what_depends_on_it() -> None:
    class Other:
        cost = 12.5
        verdict = None

    kept = Group("closures", np.arange(3), True, Other(), ("poses", 7, 49.81))
    assert kept.sentence() == (
        "Kept, though only they agree with each other: 3 in 'closures' (0, 1, 2); "
        "without them, cost 12.5, 'poses' 7 by 49.8."
    )
    assert replace(kept, kept=False).sentence().startswith("Left out, though they agree with each other: 3 in")


@pytest.mark.parametrize("seed", [6, 13])
@pytest.mark.product(1)
def test_scale_does_not_decide_where_nothing_is_trusted(seed: int) -> None:
    """With odometry trusted, the answer gives up a wrong closure that pays; otherwise, the cost as stated decides."""
    sim = manhattan(150, seed, outliers=0.3)
    edges = replace(sim.pose_graph.edges, information=0.02 * sim.pose_graph.edges.information)
    graph = replace(sim.pose_graph, edges=edges)
    for everywhere in ("closures", "all"):
        stated, _, guess = graph.graph(robust=LOSS, robust_on=everywhere)
        staged, stages = graduated_non_convexity._staged(stated)
        search = graduated_non_convexity._Search(GraduatedNonConvexity(), stated, staged, stages, None, None)
        found = search.best(guess)
        cheapest = min(one.solution.cost for one in search.found)
        assert (found.cost > 1.001 * cheapest) == (everywhere == "closures")
