"""Certificates of pose graphs: proofs against dense eigenvalues, ways down against folded loops, and what is said."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.errors import BackendError, GraphError
from unifg.files.g2o import read_g2o
from unifg.pose_graphs import Edges, PoseGraph, Priors, best_guess, certify, chordal, judge, manhattan, sphere, starts
from unifg.pose_graphs.certificate import _Judge, _measured_in
from unifg.pose_graphs.descent import Descent
from unifg.pose_graphs.generate import Simulated
from unifg.pose_graphs.information import bounded_below
from unifg.pose_graphs.pose_graph import ResidualName
from unifg.pose_graphs.relaxation import Relaxation
from unifg.solvers import DogLeg, GaussNewton, LevenbergMarquardt
from unifg.typing import Array

GROUPS = {"plane": fg.SE2, "space": fg.SE3}


def lifted(poses: Array) -> Array:
    """Planar poses in space."""
    nothing = np.zeros(len(poses))
    half = 0.5 * poses[:, 2]
    return np.column_stack([poses[:, :2], nothing, np.cos(half), nothing, nothing, np.sin(half)])


def ring(count: int, turns: int, group: fg.LieGroup = fg.SE2, weight: float = 1.0, at: float = 0.0) -> PoseGraph:
    """A loop that turns once, begun where it turns more often: the start lies in the basin of a folded map."""
    rng = np.random.default_rng(0)

    def loop(times: int) -> Array:
        angle = 2.0 * np.pi * times * np.arange(count) / count
        radius = count / (2.0 * np.pi * times)
        places = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + 0.5 * np.pi])
        return fg.SE2.retract(places, np.zeros(3))

    first = np.arange(count)
    second = (first + 1) % count
    truth, begun = loop(1), loop(turns)
    measured = fg.SE2.retract(fg.SE2.between(truth[first], truth[second]), 0.01 * rng.standard_normal((count, 3)))
    begun[:, :2] += at
    diagonal = [100.0, 100.0, 400.0]
    if group is fg.SE3:
        measured, begun, diagonal = lifted(measured), lifted(begun), [100.0] * 3 + [400.0] * 3
    information = np.tile(weight * np.diag(diagonal), (count, 1, 1))
    return PoseGraph(np.arange(count), begun, Edges(first, second, measured, information))


def solved(pose_graph: PoseGraph) -> PoseGraph:
    graph, x, guess = pose_graph.graph()
    return pose_graph.with_poses(LevenbergMarquardt().solve(graph, guess, check=True)[x])


def dense_dual(pose_graph: PoseGraph, poses: Array) -> Array:
    """The dual matrix over positions and frames, positions eliminated, written as SE-Sync's section 3 says."""
    dim, count = pose_graph.group.point_dim, len(poses)
    problem = Relaxation.of(pose_graph)
    size = dim + 1
    whole = np.zeros((count * size, count * size))
    for i, j, A, B in zip(problem.first, problem.second, problem.by_first, problem.by_second, strict=True):
        wide = np.zeros((size, count * size))
        wide[:, i * size : (i + 1) * size] += A
        wide[:, j * size : (j + 1) * size] += B
        whole += wide.T @ wide
    point = problem.lift(pose_graph.with_poses(poses)).reshape(count * size, dim)
    slope = (whole @ point).reshape(count, size, dim)[:, 1:]
    frames = point.reshape(count, size, dim)[:, 1:]
    for k in range(count):
        own = slope[k] @ frames[k].T
        whole[k * size + 1 : (k + 1) * size, k * size + 1 : (k + 1) * size] -= 0.5 * (own + own.T)
    turning = np.tile(np.arange(size) > 0, count)
    places = whole[np.ix_(~turning, ~turning)]
    across = whole[np.ix_(turning, ~turning)]
    # Moving all costs nothing: with the default of 1e-15, rounding decides whether what stands for that is inverted.
    return whole[np.ix_(turning, turning)] - across @ np.linalg.pinv(places, rcond=1e-12, hermitian=True) @ across.T


@pytest.mark.parametrize("name", GROUPS)
def test_the_cost_is_that_of_the_logarithm_to_second_order(name: str) -> None:
    group, rng = GROUPS[name], np.random.default_rng(1)
    dim, angles = group.point_dim, group.dim - group.point_dim
    turning = np.diag([300.0, 200.0, 250.0][:angles])
    if angles == 3:
        frame = fg.SO3.matrix(fg.SO3.exp(rng.standard_normal((1, 3))))[0]
        turning = frame @ turning @ frame.T
    information = np.zeros((1, group.dim, group.dim))
    information[0, :dim, :dim], information[0, dim:, dim:] = 50.0 * np.eye(dim), turning
    poses = group.exp(rng.standard_normal((2, group.dim)))
    exact = group.between(poses[:1], poses[1:])
    edges = Edges(np.array([0]), np.array([1]), exact, information)
    graph = PoseGraph(np.arange(2), poses, edges)
    problem = Relaxation.of(graph)
    assert problem.caveats == ()
    assert problem.cost(problem.lift(graph)) == pytest.approx(0.0, abs=1e-24)
    for _ in range(5):
        moved = poses.copy()
        moved[1:] = group.retract(poses[1:], 1e-4 * rng.standard_normal((1, group.dim)))
        here = graph.with_poses(moved)
        assert problem.cost(problem.lift(here)) == pytest.approx(here.chi2(), rel=1e-3)


@pytest.mark.parametrize("made", [manhattan(150, seed=3), sphere(5, 8, seed=3)], ids=["plane", "space"])
def test_a_solved_graph_is_certified(made: Simulated) -> None:
    after = solved(made.pose_graph)
    found = certify(after)
    assert found.certified and 0.0 <= found.gap <= 1e-6 * found.chi2
    assert found.better is None and found.better_chi2 is None
    assert found.rank == after.group.point_dim and found.caveats == ()
    assert found.chi2 == pytest.approx(after.chi2(), rel=0.02)
    assert np.linalg.eigvalsh(dense_dual(after, found.poses))[0] > -1e-6
    assert "no map has a lower chordal chi2" in found.sentence()
    assert found.moved[0] < 0.05 and found.moved[1] < 0.02


@pytest.mark.parametrize("name", GROUPS)
@pytest.mark.parametrize(("count", "turns"), [(20, 2), (30, 3)])
def test_a_folded_loop_is_refused_and_unfolded(name: str, count: int, turns: int) -> None:
    folded = solved(ring(count, turns, GROUPS[name]))
    right = solved(ring(count, 1, GROUPS[name]))
    assert folded.chi2() > 100.0 * right.chi2()
    refused = certify(folded)
    assert not refused.certified and "not certified" in refused.sentence()
    # What is proven is proven: no graph lies below the dual.
    assert refused.dual <= certify(right).chi2
    assert refused.gap == pytest.approx(refused.chi2 - refused.dual)
    assert refused.least_eigenvalue == pytest.approx(np.linalg.eigvalsh(dense_dual(folded, refused.poses))[0], rel=1e-3)
    found = certify(folded, staircase=True)
    assert not found.certified and found.dual == pytest.approx(certify(right).dual, rel=1e-4)
    assert found.better is not None and found.better_chi2 == pytest.approx((folded.chi2(), right.chi2()), rel=1e-6)
    assert f"a better map was found: chi2 {right.chi2():.6g}" in found.sentence()
    assert certify(folded.with_poses(found.better)).certified == certify(right).certified
    # Two dimensions more hold a way out and the optimum; a slope that is not small there sends the staircase on.
    assert folded.group.point_dim < found.rank <= folded.group.point_dim + 2
    assert solved(folded.with_poses(found.poses)).chi2() == pytest.approx(right.chi2(), rel=1e-6)
    assert np.array_equal(found.poses[0], folded.poses[0])  # the anchor stays


@pytest.mark.parametrize("weight", [1e-6, 1.0])
@pytest.mark.parametrize("made", [manhattan(120, 1, 0.1), sphere(6, 8, 1, 0.1)], ids=["plane", "space"])
def test_a_descent_from_anywhere_ends_where_the_dual_proves_it(made: Simulated, weight: float) -> None:
    """Wrong closures, and frames drawn at random: over enough dimensions the minimum is the lowest there is."""
    edges = made.pose_graph.edges
    problem = Relaxation.of(replace(made.pose_graph, edges=replace(edges, information=weight * edges.information)))
    above, rank = problem.dim + 1, problem.dim + 5
    start = np.random.default_rng(0).standard_normal((problem.count, above, rank))
    start[:, 1:] = np.swapaxes(np.linalg.qr(np.swapaxes(start[:, 1:], 1, 2))[0], 1, 2)
    judge, descend = _Judge(problem, 1e-6), Descent(problem)
    found = descend(start, 1e-12)
    frames = found[:, 1:] @ np.swapaxes(found[:, 1:], 1, 2)
    assert np.abs(frames - np.eye(problem.dim)).max() < 1e-12
    assert judge(found).proven and problem.cost(found) < 0.1 * problem.cost(start)
    rough = problem.cost(descend(start, 1e-3))
    assert problem.cost(found) * (1.0 + 1e-6) < rough < 1.01 * problem.cost(found)  # ends where it was asked to
    assert np.array_equal(descend(found, 1e-9), found)


@pytest.mark.parametrize("weight", [1e-6, 1e6])
@pytest.mark.parametrize("at", [0.0, 1e6])
def test_units_and_offsets_decide_nothing(weight: float, at: float) -> None:
    right, folded = (solved(ring(20, turns, weight=weight, at=at)) for turns in (1, 2))
    assert certify(right, tolerance=1e-5).certified
    assert not certify(folded, tolerance=1e-5).certified
    better = certify(folded, tolerance=1e-5, staircase=True).better
    assert better is not None and certify(folded.with_poses(better), tolerance=1e-5).certified


@pytest.mark.parametrize("made", [manhattan(120, seed=3), sphere(5, 12, seed=1)], ids=["plane", "space"])
def test_the_unit_of_length_decides_nothing(made: Simulated) -> None:
    """In kilometres, feet or millimetres: the same proof, the same gap, the same caveats, the same map."""
    graph = solved(made.pose_graph)
    coupled = graph.edges.information.copy()
    dim = graph.group.point_dim
    coupled[:, 0, dim] = coupled[:, dim, 0] = 1e-3 * np.sqrt(coupled[:, 0, 0] * coupled[:, dim, dim])
    bound = replace(graph, edges=replace(graph.edges, information=coupled))
    asked = certify(graph)
    assert asked.certified and 0.0 < asked.gap < 1e-5 * asked.chi2
    for unit in (1000.0, 0.3048, 1e-3, 1e-9):
        found = certify(_measured_in(graph, unit))
        assert found.certified and found.gap == pytest.approx(asked.gap, rel=1e-3)
        assert found.tolerance == pytest.approx(asked.tolerance, rel=1e-9)
        assert found.chi2 == pytest.approx(asked.chi2, rel=1e-9)
        np.testing.assert_allclose(unit * found.poses[:, :dim], asked.poses[:, :dim], atol=1e-6)
        assert certify(_measured_in(bound, unit)).caveats == certify(bound).caveats != ()


INDEFINITE = np.concatenate([np.tile(np.eye(3), (5, 1, 1)), -np.eye(3)[None]])
WRONG: list[tuple[dict[str, Any], Any, str]] = [
    ({"landmark_ids": np.array([99]), "landmarks": np.zeros((1, 2))}, None, "landmarks"),
    ({"fixed_ids": (0, 5)}, None, "two poses"),
    (
        {"edges": replace(ring(6, 1).edges, information=INDEFINITE)},
        None,
        "edge 5 has a negative eigenvalue, of 1 edges",
    ),
    ({"edges": replace(ring(6, 1).edges, information=np.nan * INDEFINITE)}, None, "finite"),
    *(
        ({}, used, rf"used has shape {re.escape(str(used.shape))}.*expected \(6,\) of bool")
        for used in (np.ones(5, dtype=bool), np.ones((6, 1), dtype=bool), np.array(True), np.arange(6))
    ),
]


@pytest.mark.parametrize(("changed", "used", "message"), WRONG)
def test_what_it_cannot_judge_is_refused(changed: dict[str, Any], used: Any, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        certify(replace(ring(6, 1), **changed), used=used)


def test_parts_are_judged_together() -> None:
    one = ring(20, 2)
    both = PoseGraph(
        np.arange(40),
        np.concatenate([one.poses, one.poses + np.array([50.0, 0.0, 0.0])]),
        Edges(*(np.concatenate([a, b]) for a, b in (
            (one.edges.first, one.edges.first + 20),
            (one.edges.second, one.edges.second + 20),
            (one.edges.measured, one.edges.measured),
            (one.edges.information, one.edges.information),
        ))),
    )  # fmt: skip
    folded = solved(both)
    assert not certify(folded).certified
    found = certify(folded, tolerance=1e-5, staircase=True)
    assert found.better is not None
    assert certify(folded.with_poses(found.better), tolerance=1e-5).certified
    assert found.poses[[0, 20]] == pytest.approx(folded.poses[[0, 20]])
    assert judge(folded).parts == 2 and judge(folded).anchors == (0, 20)


def test_only_what_is_used_counts() -> None:
    made = manhattan(150, seed=4, outliers=0.1)
    assert made.outliers.any()
    clean = replace(made.pose_graph, edges=made.pose_graph.edges[~made.outliers])
    after = made.pose_graph.with_poses(solved(clean).poses)
    found = certify(after, used=~made.outliers)
    assert found.certified and found.chi2 == pytest.approx(certify(solved(clean)).chi2)
    assert certify(after).chi2 > 2.0 * found.chi2


def small(seed: int, coupled: bool = False) -> tuple[PoseGraph, Array]:
    """A loop of 5 to 9 random poses with two chords, in the plane or in space, and 100 random starts."""
    rng = np.random.default_rng(seed)
    group, count = (fg.SE2, fg.SE3)[seed % 2], int(rng.integers(5, 10))
    dim, place = group.dim, group.point_dim
    truth = group.exp(3.0 * rng.uniform(-1.0, 1.0, (count, dim)))
    first = np.concatenate([np.arange(count), [0, 1]])
    second = np.concatenate([(np.arange(count) + 1) % count, [count // 2, count - 2]])
    measured = group.retract(group.between(truth[first], truth[second]), 0.1 * rng.standard_normal((len(first), dim)))
    information = np.tile(np.diag([100.0] * place + [400.0] * (dim - place)), (len(first), 1, 1))
    if coupled:
        roots = np.eye(dim) + rng.uniform(0.1, 0.6) * rng.standard_normal((len(first), dim, dim))
        roots = roots * np.sqrt(information[0].diagonal()) * 10.0 ** rng.uniform(0.0, 0.6, (len(first), 1, dim))
        information = np.swapaxes(roots, 1, 2) @ roots
    starts = group.exp(3.0 * rng.uniform(-1.0, 1.0, (100, count, dim)).reshape(-1, dim)).reshape(100, count, -1)
    return PoseGraph(np.arange(count), truth, Edges(first, second, measured, information)), starts


def minima(pose_graph: PoseGraph, starts: Array) -> list[PoseGraph]:
    """Local minima reached from the poses of a graph and from other starts."""
    graph, x, guess = pose_graph.graph()
    prepared = LevenbergMarquardt(max_iterations=300).bound(graph)
    found = [prepared.solve({**guess, x: start}) for start in (pose_graph.poses, *starts)]
    return [pose_graph.with_poses(solution[x]) for solution in found if solution.converged]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.product(2)
def test_a_local_minimum_is_not_certified_and_a_better_map_is_better(seed: int) -> None:
    """The given poses are judged, not those that the certificate walks to: most of these came back certified."""
    graph, starts = small(seed)
    found = minima(graph, starts[:10])
    least = min(one.chi2() for one in found)
    worse = [one for one in found if one.chi2() > 1.05 * least]
    assert len(worse) > 2
    handed = 0
    for one in worse:
        certificate = certify(one)
        assert not certificate.certified and certificate.gap > certificate.tolerance
        assert certificate.chi2 == pytest.approx(Relaxation.of(one).cost(Relaxation.of(one).lift(one)))
        if certificate.better is not None:
            better = one.with_poses(certificate.better)
            assert certificate.better_chi2 == pytest.approx((one.chi2(), better.chi2()))
            assert better.chi2() < one.chi2() and solved(better).chi2() == pytest.approx(better.chi2(), rel=1e-9)
            handed += 1
    assert handed > 0


@pytest.mark.parametrize("name", GROUPS)
def test_the_dual_holds_at_any_point(name: str) -> None:
    """Away from a stationary point, the sum of the multipliers' traces is less than the cost there, and counts."""
    right = solved(ring(20, 1, GROUPS[name]))
    problem = Relaxation.of(right)
    point = Descent(problem).minimize(problem.lift(right))
    least, judge, rng = problem.cost(point), _Judge(problem, 1e-6), np.random.default_rng(0)
    for size in (0.1, 1.0):
        for _ in range(5):
            off = point.copy()
            off[:, 0] += size * rng.standard_normal(off[:, 0].shape)
            assert judge(off).dual <= least * (1.0 + 1e-9) < judge(off).cost


def test_what_a_map_was_moved_by_decides_nothing() -> None:
    """Half a millimetre costs more than it must, and a metre in a soft direction does not."""
    right = solved(ring(20, 1))
    poses = right.poses.copy()
    poses[10, 0] += 5e-4
    near = certify(right.with_poses(poses))
    assert not near.certified and near.moved[0] < 1e-3 and near.gap > 0.5 * (near.chi2 - certify(right).chi2) > 0.0
    information = right.edges.information.copy()
    information[[9, 10]] *= 1e-12  # the two edges of one pose
    soft = solved(replace(right, edges=replace(right.edges, information=information)))
    poses = soft.poses.copy()
    poses[10, 0] += 1.0
    far = certify(soft.with_poses(poses))
    assert far.certified and far.moved[0] > 0.5 and "1 m" in far.sentence()


def test_information_is_bounded_from_below() -> None:
    """diag(tau I, Omega) <= the matrix, in units of its own diagonal; nothing is lost where it has this form."""
    rng = np.random.default_rng(3)
    for dim, turns in ((2, 1), (3, 3)):
        size = dim + turns
        roots = rng.standard_normal((300, size, size)) * 10.0 ** rng.uniform(-2.0, 2.0, (300, size, 1))
        whole = np.swapaxes(roots, 1, 2) @ roots
        whole[:50, dim:] = whole[:50, :, dim:] = 0.0  # nothing is known about the turn
        whole[50:100, :dim] = whole[50:100, :, :dim] = 0.0
        tau, omega = bounded_below(whole, dim)
        below = np.zeros_like(whole)
        below[:, :dim, :dim] = tau[:, None, None] * np.eye(dim)
        below[:, dim:, dim:] = omega
        units = np.sqrt(np.maximum(np.einsum("nii->ni", whole), 1e-300))
        scaled = (whole - below) / units[:, :, None] / units[:, None, :]
        assert np.linalg.eigvalsh(scaled)[:, 0].min() > -1e-9
        assert (tau <= np.linalg.eigvalsh(whole[:, :dim, :dim])[:, 0] * (1.0 + 1e-9) + 1e-12).all()
        assert np.linalg.eigvalsh(omega)[:, 0].min() > -1e-9 * omega.max()
        if turns == 3:
            lengths = np.linalg.eigvalsh(omega)
            assert (lengths[:, 2] <= (lengths[:, 0] + lengths[:, 1]) * (1.0 + 1e-9) + 1e-9).all()
        kept = np.zeros((1, size, size))
        kept[0] = np.diag([7.0] * dim + [2.0, 3.0, 4.0][:turns])
        tau, omega = bounded_below(kept, dim)
        assert tau[0] == 7.0
        np.testing.assert_allclose(omega[0], kept[0, dim:, dim:], rtol=1e-15)


@pytest.mark.product(4)
@pytest.mark.parametrize("seed", range(12))
def test_no_map_falls_below_the_interval(seed: int) -> None:
    """Anisotropic, coupled information: the dual is at most chi2 of the best map found."""
    graph, starts = small(seed, coupled=True)
    found = minima(graph, starts[:15])
    best = min(found, key=lambda one: one.chi2())
    for staircase in (False, True):
        certificate = certify(best, staircase=staircase)
        assert certificate.interval is not None
        least, here = certificate.interval
        assert 0.0 <= least <= best.chi2() == here


def test_an_interval_is_claimed_of_plain_squares_of_the_logarithm_alone() -> None:
    graph, starts = small(1, coupled=True)
    best = min(minima(graph, starts[:15]), key=lambda one: one.chi2())
    plain = certify(best, staircase=True)
    assert plain.interval is not None and plain.no_interval == ""
    least, here = plain.interval
    assert 0.0 < least < here and here / least > 1.001
    assert f"between {least:.6g} and {here:.6g}, {here / least:.3g} times as much" in plain.sentence()
    assert "proven" not in plain.sentence()
    other = certify(best, residual="g2o")
    assert other.interval is None and "no interval is claimed for chi2: the residual is 'g2o'" in other.sentence()
    chosen = certify(best, used=np.ones(len(best.edges), dtype=bool))
    assert chosen.interval is None and "edges were chosen, or have a robust loss" in chosen.sentence()


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "least", "certified"),
    [("M3500", 137.9, True), ("intel", 22.0, False), ("sphere2500", 1351.0, True), ("parking-garage", 1.2, False)],
)
@pytest.mark.product(1, of="large maps")
def test_real_maps_are_certified_and_bounded(shared_data: Path, name: str, least: float, certified: bool) -> None:
    """Two of four are certified; with means for weights the dual of parking-garage lies above its chi2."""
    read = read_g2o(shared_data / "pose_graphs" / f"{name}.g2o.gz")
    graph, x, guess = read.with_poses(best_guess(read)[1]).graph()
    found = certify(read.with_poses(GaussNewton().solve(graph, guess, check=True)[x]))
    assert found.certified == certified and (not certified or found.gap / found.chi2 < 6e-7)
    assert found.interval is not None and least < found.interval[0] < found.interval[1]
    if name == "parking-garage":
        assert found.interval[0] < 1.2683848 < found.dual  # the latter has a mean for a weight


def test_what_the_form_cannot_hold_is_said() -> None:
    graph = solved(sphere(4, 6).pose_graph)
    information = graph.edges.information.copy()
    information[0, 0, 0] *= 3.0
    information[1, 3, 3] *= 30.0
    information[2, 0, 4] = information[2, 4, 0] = 5.0
    found = certify(solved(replace(graph, edges=replace(graph.edges, information=information))))
    assert [word in " ".join(found.caveats) for word in ("directions", "about one axis", "couple")] == [True] * 3
    assert all(caveat in found.sentence() for caveat in found.caveats)


@pytest.mark.parametrize("name", GROUPS)
def test_edges_without_information_say_nothing(name: str) -> None:
    graph = ring(6, 1, GROUPS[name])
    blind = graph.edges.information.copy()
    blind[-1] = 0.0  # of the closure; the chain remains
    chain = replace(graph, edges=replace(graph.edges, information=blind))
    with np.errstate(all="raise"):
        poses = chordal(chain)
    kept = np.arange(len(graph.edges)) < len(graph.edges) - 1
    np.testing.assert_allclose(poses, chordal(replace(graph, edges=graph.edges[kept])), atol=1e-9)
    nothing = replace(graph, edges=replace(graph.edges, information=np.zeros_like(blind)))
    certificate = certify(nothing)
    assert certificate.certified and certificate.chi2 == certificate.gap == certificate.least_eigenvalue == 0.0
    assert judge(nothing).parts == 6, "what no information joins is held where it is"
    np.testing.assert_array_equal(chordal(nothing), nothing.poses)


@pytest.mark.parametrize("tolerance", [-1.0, np.nan])
def test_a_tolerance_below_zero_is_refused(tolerance: float) -> None:
    with pytest.raises(GraphError, match=f"the tolerance must not be negative, found {tolerance}"):
        certify(ring(6, 1), tolerance=tolerance)


def test_odd_graphs_are_certified_rightly() -> None:
    loop = solved(ring(20, 1))
    for fixed in ((7,), (0,)):
        assert certify(replace(loop, fixed_ids=fixed)).certified
    alone = PoseGraph(np.arange(21), np.concatenate([loop.poses, [[50.0, 0.0, 1.0]]]), loop.edges)
    assert certify(alone).certified and certify(alone).poses[20].tolist() == [50.0, 0.0, 1.0]
    nobody = np.zeros(0, dtype=np.intp)
    nothing = Edges(nobody, nobody, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    itself = Edges(np.array([0]), np.array([0]), np.array([[0.1, 0.0, 0.0]]), np.eye(3)[None])
    for edges, said in ((nothing, 0), (itself, 1)):
        one = certify(PoseGraph(np.arange(1), np.zeros((1, 3)), edges))
        assert one.certified and one.chi2 == 0.0 and one.moved == (0.0, 0.0) and len(one.caveats) == said


def test_the_start_that_costs_least_is_taken() -> None:
    folded = solved(ring(20, 2))
    name, poses = best_guess(folded)
    assert name in ("chordal", "lago") and folded.with_poses(poses).chi2() < 0.1 * folded.chi2()
    right = solved(ring(20, 1))
    assert best_guess(right)[0] == "file" and best_guess(right)[1] is right.poses
    made = manhattan(150, seed=4, outliers=0.1)
    truth = made.pose_graph.with_poses(made.truth)
    loss = fg.TruncatedLeastSquares(3.0)
    assert chordal(made.pose_graph) != pytest.approx(made.truth)
    assert best_guess(truth, loss=loss)[0] == "file"  # outliers have no say in what the truth costs


@pytest.mark.parametrize("residual", ["log", "g2o"])
def test_starts_are_compared_by_the_residual_that_was_asked_for(residual: ResidualName) -> None:
    """Priors of poses have it as well."""
    made = sphere(4, 6).pose_graph
    far = Priors(np.array([3, 9]), made.poses[[9, 3]], np.tile(np.eye(6), (2, 1, 1)))
    held = replace(made, priors={"pose": far})
    for start in starts(held, residual):
        assert start.chi2 == pytest.approx(held.with_poses(start.poses).chi2(residual), rel=1e-12)


def test_residuals_are_held_against_what_was_stated() -> None:
    right = solved(ring(20, 1))
    calm = judge(right)
    assert calm.freedom == 3 * 20 - 3 * 19 and not calm.far and calm.sentences() == []
    folded = judge(solved(ring(20, 2)))
    assert folded.far and "times as large" in folded.sentences()[0]
    timid = judge(solved(ring(20, 1, weight=1e-6)))
    assert not timid.far and timid.sentences() == []  # too small is no reason to doubt
    information = right.edges.information.copy()
    information[3] = 0.0
    information[5] = -np.eye(3)
    edges = Edges(right.edges.first, right.edges.second, right.edges.measured, information)
    alone = np.concatenate([right.poses, np.zeros((1, 3))])
    odd = judge(PoseGraph(np.arange(21), alone, edges))
    assert odd.isolated == (20,) and odd.blind.tolist() == [3] and odd.indefinite.tolist() == [5]
    assert odd.parts == 2 and odd.anchors == (0, 20)
    said = " ".join(odd.sentences())
    assert all(word in said for word in ("20", "place 3", "place 5", "2 parts", "not determined"))


def test_poses_that_are_no_numbers_and_edges_of_no_pose_are_named() -> None:
    graph = ring(6, 1)
    lost = graph.poses.copy()
    lost[3] = np.nan
    far = replace(graph.edges, second=graph.edges.second + np.array([0, 0, 6, 0, 0, 0]))
    for wrong, said in (
        (graph.with_poses(lost), "edge 2: r' Omega r is not finite"),
        (replace(graph, edges=far), "an edge, number 2, names position 9"),
    ):
        for judged in (judge, PoseGraph.verdict):
            with pytest.raises(GraphError, match=said):
                judged(wrong)


def test_worst_edges_are_named() -> None:
    graph = solved(ring(20, 1))
    measured = graph.edges.measured.copy()
    measured[7, 0] += 0.5
    named = judge(replace(graph, ids=np.arange(100, 120), edges=replace(graph.edges, measured=measured)))
    assert named.worst[0].tolist() == [107, 108]
    assert named.worst_chi2[0] == named.worst_chi2.max()


@pytest.mark.parametrize("made", [manhattan(150, seed=3), sphere(5, 8, seed=3)], ids=["plane", "space"])
@pytest.mark.parametrize("solver", [GaussNewton, LevenbergMarquardt, DogLeg])
@pytest.mark.parametrize("weight", [1e-6, 1.0, 1e6])
def test_a_map_needs_no_more_digits_than_it_shows(made: Simulated, solver: type[GaussNewton], weight: float) -> None:
    edges = made.pose_graph.edges
    scaled = replace(made.pose_graph, edges=replace(edges, information=weight * edges.information))
    graph, _, guess = scaled.graph()
    exact, near = (solver(**options).solve(graph, guess, check=True) for options in ({}, {"tolerance": "map"}))  # type: ignore[arg-type]
    assert near.iterations < exact.iterations
    assert exact.cost <= near.cost <= (1.0 + 2e-5) * exact.cost
    with pytest.raises(BackendError, match="'map'"):
        solver(tolerance="good")  # type: ignore[arg-type]


def test_equal_weights_are_bounded_as_each_of_them() -> None:
    rng = np.random.default_rng(3)
    for dim, size in ((2, 3), (3, 6)):
        roots = rng.normal(size=(2, size, size))
        both = roots @ np.swapaxes(roots, 1, 2)
        mixed, equal = bounded_below(both, dim), bounded_below(np.repeat(both[1:], 4, axis=0), dim)
        for some, alike in zip(mixed, equal, strict=True):
            np.testing.assert_allclose(alike, np.repeat(some[1:], 4, axis=0), rtol=1e-12)
