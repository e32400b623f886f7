"""Pose graphs as problems: residual conventions, what is held fixed, first guesses, published optima."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import unifg as fg
from unifg.elimination.components import components
from unifg.errors import GraphError
from unifg.files.pose_graph import read_pose_graph
from unifg.pose_graphs import Edges, PoseGraph, Sightings, chordal, judge, lago, manhattan, odometric, sphere
from unifg.pose_graphs.certificate import certify
from unifg.pose_graphs.residuals import chart_between
from unifg.solvers import GaussNewton, LevenbergMarquardt
from unifg.typing import Array

# chi2 = sum r' Omega r in the file and at the optimum, r the full logarithm.
PUBLISHED = {
    "M3500.g2o.gz": (2634712.545, 137.9148782),
    "intel.g2o.gz": (553.9957956, 45.0042331),
    "sphere2500.g2o.gz": (2611315.424, 1351.4019259),
    "parking-garage.g2o.gz": (16727.2039, 1.2683848),
    "smallGrid3D.g2o": (167788.667, 1035.8506647),
    "tinyGrid3D.g2o": (286.63575, 18.6278189),
    "rpgo_robot_a.g2o": (664.247, 46.4731341),
}


Method = Callable[[PoseGraph], Array]


def solved(graph: PoseGraph, **options: object) -> PoseGraph:
    problem, x, guess = graph.graph(**options)  # type: ignore[arg-type]
    return graph.with_poses(GaussNewton().solve(problem, guess, check=True)[x])


def chain(group: fg.LieGroup, count: int, rng: np.random.Generator) -> tuple[PoseGraph, Array]:
    """Consistent measurements with full information matrices, some backwards, loops among them; and the truth."""
    steps = group.exp(rng.uniform(-0.8, 0.8, (count, group.dim)) + np.eye(group.dim)[0])
    truth = [group.identity()]
    for step in steps[1:]:
        truth.append(group.compose(truth[-1], step))
    poses = np.array(truth)
    first = np.concatenate([np.arange(count - 1), [count - 1, 5, 2]])
    second = np.concatenate([np.arange(1, count), [0, 1, count - 2]])
    backwards = rng.random(len(first)) < 0.4
    first, second = np.where(backwards, second, first), np.where(backwards, first, second)
    root = rng.normal(size=(len(first), group.dim, group.dim))
    information = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(group.dim)
    edges = Edges(first, second, group.between(poses[first], poses[second]), information)
    return PoseGraph(np.arange(count), poses, edges), poses


def distance(group: fg.LieGroup, a: Array, b: Array) -> float:
    return float(np.abs(group.local(a, b)).max())


# ---------------------------------------------------------------- residuals


@pytest.mark.parametrize(("group", "factor"), [(fg.SE2, 1.0), (fg.SE3, 0.5)])
def test_charts_agree_with_logarithms_only_to_first_order_and_half(
    group: Any, factor: float, rng: np.random.Generator
) -> None:
    x, z = group.random(rng, (2, 8))
    d = 1e-5 * rng.normal(size=(8, group.dim))
    y = group.compose(x, group.retract(z, d))
    log, chart = fg.between.on(group)(x, y, z), chart_between.on(group)(x, y, z)
    np.testing.assert_allclose(log, d, atol=1e-10)
    size = group.point_dim
    np.testing.assert_allclose(chart[:, :size], d[:, :size], atol=1e-9)
    np.testing.assert_allclose(chart[:, size:], factor * d[:, size:], atol=1e-9)


def test_the_spatial_chart_does_not_care_for_the_sign_of_a_quaternion(rng: np.random.Generator) -> None:
    x, y, z = fg.SE3.random(rng, (3, 20))
    flipped = y * np.array([1, 1, 1, -1, -1, -1, -1.0])
    chart = chart_between.on(fg.SE3)
    np.testing.assert_allclose(chart(x, flipped, z), chart(x, y, z), atol=1e-14)
    error = fg.SE3.between(z, fg.SE3.between(x, y))
    np.testing.assert_allclose(np.linalg.norm(chart(x, y, z)[:, 3:], axis=1), np.sqrt(1.0 - error[:, 3] ** 2))


def test_the_planar_chart_is_a_difference(rng: np.random.Generator) -> None:
    x, y, z = fg.SE2.random(rng, (3, 20))
    relative = np.linalg.inv(fg.SE2.matrix(z)) @ np.linalg.inv(fg.SE2.matrix(x)) @ fg.SE2.matrix(y)
    chart = chart_between.on(fg.SE2)(x, y, z)
    np.testing.assert_allclose(chart[:, :2], relative[:, :2, 2], atol=1e-12)
    np.testing.assert_allclose(fg.wrap_angle(y - x - z)[:, 2], chart[:, 2], atol=1e-12)


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3])
def test_charts_pickle(group: Any) -> None:

    assert pickle.loads(pickle.dumps(chart_between.on(group))).name == "chart between"


@pytest.mark.parametrize("residual", ["log", "g2o"])
@pytest.mark.parametrize("group", [fg.SE2, fg.SE3], ids=lambda group: group.name)
def test_the_graph_means_what_chi2_says(rng: np.random.Generator, group: fg.LieGroup, residual: str) -> None:
    graph, truth = chain(group, 9, rng)
    size = group.point_dim
    landmarks = rng.normal(size=(2, size))
    seen = Sightings(
        np.array([0, 3, 3, 8]), np.array([0, 0, 1, 1]), rng.normal(size=(4, size)), np.tile(np.eye(size), (4, 1, 1))
    )
    kinds = {"point": seen}
    if group is fg.SE2:
        for kind, width in (("bearing", 1), ("range", 1), ("bearing-range", 2)):
            kinds[kind] = replace(
                seen, measured=rng.normal(size=(4, width)), information=np.tile(np.eye(width), (4, 1, 1))
            )
    graph = replace(
        graph, poses=group.retract(truth, 0.1 * rng.normal(size=(9, group.dim))), landmarks=landmarks,
        landmark_ids=np.array([100, 101]), sightings=kinds,
    )  # fmt: skip
    problem, _, guess = graph.graph(residual=residual)  # type: ignore[arg-type]
    start = LevenbergMarquardt(max_iterations=0).solve(problem, guess)
    np.testing.assert_allclose(2.0 * start.cost, graph.chi2(residual), rtol=1e-12)  # type: ignore[arg-type]
    assert problem.check(guess), problem.check(guess)  # attached Jacobians among them
    assert {term.name for term in problem.terms} == {"odometry", "closures", *kinds}


def test_unknown_words_are_refused(rng: np.random.Generator) -> None:
    graph, _ = chain(fg.SE2, 9, rng)
    with pytest.raises(GraphError, match="residual is 'chordal': expected 'log' or 'g2o'"):
        graph.graph(residual="chordal")  # type: ignore[arg-type]
    with pytest.raises(GraphError, match="robust_on"):
        graph.graph(robust_on="odometry")  # type: ignore[arg-type]
    with pytest.raises(GraphError, match="no measurement"):
        replace(graph, edges=graph.edges[:0]).graph()


def test_a_loss_sits_on_loop_closures_unless_told_otherwise(rng: np.random.Generator) -> None:
    graph, _ = chain(fg.SE2, 9, rng)
    for on, expected in (("closures", {"closures"}), ("all", {"odometry", "closures"})):
        problem, _, _ = graph.graph(fg.Huber(), robust_on=on)  # type: ignore[arg-type]
        assert {term.name for term in problem.terms if getattr(term, "robust", None)} == expected


# ---------------------------------------------------------------- what is held


def test_first_pose_is_held_where_nothing_is_known(rng: np.random.Generator) -> None:
    graph, truth = chain(fg.SE2, 9, rng)
    assert graph.anchors()[0].tolist() == [0]
    assert replace(graph, fixed_ids=(4, 6)).anchors()[0].tolist() == [4, 6]
    held = replace(graph, fixed_ids=(4,), poses=fg.SE2.retract(truth, 0.2 * rng.normal(size=(9, 3))))
    np.testing.assert_array_equal(solved(held).poses[4], held.poses[4])


def test_every_part_gets_an_anchor(rng: np.random.Generator) -> None:
    graph, _ = chain(fg.SE2, 9, rng)
    edges = graph.edges[(graph.edges.first < 4) == (graph.edges.second < 4)]
    parts = replace(graph, edges=edges)
    assert parts.anchors()[0].tolist() == [0, 4]
    assert replace(parts, fixed_ids=(6,)).anchors()[0].tolist() == [0, 6]
    assert solved(parts).chi2() < 1e-12


def test_a_bridge_without_information_joins_nothing(rng: np.random.Generator) -> None:
    graph, truth = chain(fg.SE2, 9, rng)
    across = (graph.edges.first < 4) != (graph.edges.second < 4)  # a step of odometry, and loops
    measured, information = graph.edges.measured.copy(), graph.edges.information.copy()
    measured[across], information[across] = [50.0, 0.0, 1.0], 0.0
    edges = replace(graph.edges, measured=measured, information=information)
    parts = replace(graph, edges=edges)
    assert parts.anchors()[0].tolist() == [0, 4]
    judged = judge(parts)
    assert judged.parts == 2 and judged.anchors == (0, 4)
    assert "2 parts that nothing connects; held are the first poses, 0, 4" in judged.sentences()
    moved = fg.SE2.retract(truth, 0.1 * rng.normal(size=truth.shape))
    moved[[0, 4]] = truth[[0, 4]]
    for found in (solved(replace(parts, poses=moved)).poses, odometric(replace(parts, poses=moved))):
        np.testing.assert_allclose(found, truth, atol=1e-9)


def test_a_landmark_can_be_known(rng: np.random.Generator) -> None:
    graph, truth = chain(fg.SE2, 9, rng)
    graph, edges = graph.with_poses(truth[:3]), graph.edges[:2]
    landmarks = np.array([[3.0, 1.0], [0.0, 2.0]])
    pose = np.repeat(np.arange(3), 2)
    mark = np.tile([0, 1], 3)
    local = fg.SE2.act(fg.SE2.inverse(graph.poses[pose]), landmarks[mark])
    seen = Sightings(pose, mark, local, np.tile(np.eye(2), (6, 1, 1)))
    graph = replace(
        graph, ids=graph.ids[:3], edges=edges, landmarks=landmarks, landmark_ids=np.array([10, 11]),
        sightings={"point": seen}, fixed_ids=(10, 11), poses=fg.SE2.retract(graph.poses, 0.1 * rng.normal(size=(3, 3))),
    )  # fmt: skip
    assert graph.anchors()[0].tolist() == []
    assert solved(graph).chi2() < 1e-12


# ---------------------------------------------------------------- first guesses


@pytest.mark.parametrize("known", [(), (3, 7)])
@pytest.mark.parametrize("method", [odometric, chordal, lago])
@pytest.mark.parametrize("group", [fg.SE2, fg.SE3], ids=lambda group: group.name)
def test_consistent_measurements_give_the_truth(
    method: Method, group: fg.LieGroup, known: tuple[int, ...], rng: np.random.Generator
) -> None:
    """From random poses but for those that are known, which stay; three times around: headings beyond pi."""
    graph, truth = chain(group, 30, rng)
    moved, held = group.compose(group.random(rng), truth), list(known or (0,))
    start = replace(graph, poses=group.random(rng, (30,)), fixed_ids=known)
    start.poses[held] = moved[held]
    if method is lago and group is fg.SE3:
        with pytest.raises(GraphError, match="use chordal"):
            lago(start)
        return
    guess = method(start)
    np.testing.assert_array_equal(guess[held], moved[held])
    assert distance(group, moved, guess) < 1e-8


def test_linear_guesses_are_better_than_odometry() -> None:
    for graph, methods in ((manhattan(400, 1).pose_graph, (lago, chordal)), (sphere(8, 12).pose_graph, (chordal,))):
        best = solved(graph).chi2()
        for method in methods:
            assert graph.with_poses(method(graph)).chi2() < 1.3 * best < 0.1 * graph.chi2()


@pytest.mark.parametrize("seed", range(3))
def test_damping_does_not_stiffen_a_chain(seed: int) -> None:
    graph, _, guess = manhattan(1000, seed).pose_graph.graph()
    bare, damped = (solver().solve(graph, guess, check=True) for solver in (GaussNewton, LevenbergMarquardt))
    assert damped.iterations == bare.iterations < 8
    assert LevenbergMarquardt(damping=1e-3).solve(graph, guess).iterations > damped.iterations


def test_landmarks_alone_do_not_initialise(rng: np.random.Generator) -> None:
    graph, _ = chain(fg.SE2, 6, rng)
    seen = Sightings(np.arange(6), np.zeros(6, np.intp), np.ones((6, 2)), np.tile(np.eye(2), (6, 1, 1)))
    graph = replace(
        graph, edges=graph.edges[:1], landmarks=np.zeros((1, 2)), landmark_ids=np.array([9]), sightings={"point": seen}
    )
    with pytest.raises(GraphError, match="through landmarks only") as error:
        odometric(graph)
    assert error.value.family == "poses"


# ---------------------------------------------------------------- made-up graphs


def test_simulations_repeat_and_say_what_is_wrong() -> None:
    for one, two, other in (
        [manhattan(300, seed, 0.3) for seed in (4, 4, 5)],
        [sphere(6, 10, seed, 0.3) for seed in (4, 4, 5)],
    ):
        np.testing.assert_array_equal(one.pose_graph.edges.measured, two.pose_graph.edges.measured)
        assert not np.array_equal(one.pose_graph.edges.measured[:50], other.pose_graph.edges.measured[:50])
        share = one.outliers.sum() / len(one.pose_graph.closures)
        assert share == pytest.approx(0.3, abs=0.01)
        assert not (one.outliers & one.pose_graph.edges.odometry).any()
        right = one.pose_graph.with_poses(one.truth)
        errors = right.squared_errors()
        dim = right.group.dim
        assert errors[~one.outliers].mean() == pytest.approx(dim, rel=0.15)  # chi-squared: noise is as it says
        assert np.median(errors[one.outliers]) > 100.0 * dim


@pytest.mark.parametrize("bad", [{"count": 1}, {"outliers": 1.0}, {"block": 0}])
def test_simulations_refuse(bad: dict[str, float]) -> None:
    with pytest.raises(fg.ModelError, match=next(iter(bad))):
        manhattan(**bad)  # type: ignore[arg-type]


# ---------------------------------------------------------------- published graphs


@pytest.mark.data
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_optima(shared_data: Path, name: str) -> None:
    graph = read_pose_graph(shared_data / "pose_graphs" / name)
    start, best = PUBLISHED[name]
    assert graph.chi2() == pytest.approx(start, rel=1e-6)
    assert solved(graph).chi2() == pytest.approx(best, abs=2e-7)


@pytest.mark.data
def test_the_other_residual_has_another_optimum(shared_data: Path) -> None:
    graph = read_pose_graph(shared_data / "pose_graphs" / "sphere2500.g2o.gz")
    problem, x, guess = graph.graph(residual="g2o")
    after = graph.with_poses(GaussNewton().solve(problem, guess)[x])
    assert after.chi2("g2o") == pytest.approx(727.1497, abs=1e-3)  # as g2o itself reports
    assert after.chi2() == pytest.approx(1581.38, abs=0.05)


@pytest.mark.product(2)
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("M3500.g2o.gz", lago),
        ("M3500.g2o.gz", chordal),
        ("intel.g2o.gz", lago),  # information matrices are full
        ("gtsam_noisyToyGraph.txt", lago),
        ("sphere2500.g2o.gz", chordal),
        ("parking-garage.g2o.gz", chordal),
        ("smallGrid3D.g2o", chordal),
    ],
)
def test_guesses_from_nothing_lead_to_the_optimum(shared_data: Path, name: str, method: Method) -> None:
    graph = read_pose_graph(shared_data / "pose_graphs" / name)
    nothing = graph.group.random(np.random.default_rng(3), (len(graph.poses),))
    nothing[0] = graph.poses[0]
    guess = graph.with_poses(method(graph.with_poses(nothing)))
    assert guess.chi2() < 2.0 * solved(graph).chi2()
    if name in PUBLISHED:
        assert solved(guess).chi2() == pytest.approx(PUBLISHED[name][1], abs=2e-7)


@pytest.mark.data
def test_gtsam_optimum_of_the_toy_graph(shared_data: Path) -> None:
    folder = shared_data / "pose_graphs"
    before, after = (read_pose_graph(folder / f"gtsam_{name}ToyGraph.txt") for name in ("noisy", "optimizedNoisy"))
    assert distance(fg.SE2, solved(before).poses, after.poses) < 3e-3


@pytest.mark.parametrize("wrong", [-1, 7, 10**12])
def test_a_measurement_of_a_pose_that_is_not_there(wrong: int) -> None:
    """Compiled code would read whatever stands there."""
    pose_graph = manhattan(7).pose_graph
    second = pose_graph.edges.second.copy()
    second[3] = wrong
    damaged = replace(pose_graph, edges=replace(pose_graph.edges, second=second))
    for ask in (damaged.parts, damaged.anchors, lambda: certify(damaged)):
        with pytest.raises(GraphError, match=f"an edge, number 3, names position {wrong}, and there are 7 poses"):
            ask()


def test_parts_are_those_of_a_reference() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        count, pairs = int(rng.integers(1, 60)), int(rng.integers(0, 70))
        first, second = rng.integers(0, count, (2, pairs))
        tied = coo_array((np.ones(pairs), (first, second)), shape=(count, count))
        assert np.array_equal(components(count, first, second), connected_components(tied, directed=False)[1])


def test_lago_follows_the_surest_paths_and_not_the_lightest_tree() -> None:
    """Each step of odometry is surer than any closure, all of them together lose count of whole turns."""
    rng, count = np.random.default_rng(4), 600
    truth = np.zeros((count, 3))
    truth[:, 0] = np.arange(count)
    along = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    back = np.stack([np.zeros(count // 5, dtype=np.intp), np.arange(4, count, 5)], axis=1)
    pairs = np.concatenate([along, back])
    sigma = np.where(np.arange(len(pairs)) < count - 1, 0.2, 0.25)
    measured = fg.SE2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    turn = sigma * rng.standard_normal(len(pairs))
    measured[:, 2] = np.arctan2(np.sin(turn), np.cos(turn))
    information = np.zeros((len(pairs), 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = 100.0
    information[:, 2, 2] = sigma**-2.0
    graph = PoseGraph(np.arange(count), truth, Edges(pairs[:, 0], pairs[:, 1], measured, information))
    drift = np.abs(np.cumsum(measured[: count - 1, 2])).max()
    assert drift > np.pi  # along odometry alone, the lightest tree
    assert np.abs(lago(graph)[:, 2]).max() < 1.5


def correlated(group: fg.LieGroup, seed: int) -> PoseGraph:
    """A loop of eight poses with two chords, every information matrix full."""
    rng = np.random.default_rng(seed)
    truth = group.exp(rng.uniform(-1.0, 1.0, (8, group.dim)))
    first, second = np.array([*range(8), 0, 2]), np.array([*range(1, 8), 0, 4, 6])
    roots = 10.0 * (np.eye(group.dim) + 0.7 * rng.standard_normal((10, group.dim, group.dim)))
    measured = group.retract(group.between(truth[first], truth[second]), 0.05 * rng.standard_normal((10, group.dim)))
    return PoseGraph(np.arange(8), truth, Edges(first, second, measured, np.swapaxes(roots, 1, 2) @ roots))


@pytest.mark.parametrize(("method", "group"), [(lago, fg.SE2), (chordal, fg.SE2), (chordal, fg.SE3)])
def test_positions_of_first_guesses_heed_what_headings_say(
    method: Callable[[PoseGraph], Array], group: fg.LieGroup
) -> None:
    """With rotations as found, no shift lowers the sum over translations and rotations of the errors, correlated."""
    graph = correlated(group, 1)
    dim, edges = group.point_dim, graph.edges

    def cost(poses: Array) -> float:
        error = group.between(edges.measured, group.between(poses[edges.first], poses[edges.second]))
        both = np.concatenate([error[:, :dim], group.log(error)[:, dim:]], axis=1)
        return float(np.einsum("ni,nij,nj->", both, edges.information, both))

    poses = method(graph)
    least = cost(poses)
    for k in range(1, len(poses)):
        for axis in range(dim):
            sides = []
            for step in (-1e-4, 1e-4):
                moved = poses.copy()
                moved[k, axis] += step
                sides.append(cost(moved))
            assert min(sides) > least
            assert abs(sides[1] - sides[0]) < 1e-4 * (sum(sides) - 2.0 * least)


@pytest.mark.parametrize("method", [lago, chordal])
def test_headings_of_first_guesses_are_weighed_by_what_is_left_of_them(
    method: Callable[[PoseGraph], Array],
) -> None:
    """A small gap of heading around a loop is shared out by variances, positions free, not by entries of matrices."""
    graph = correlated(fg.SE2, 2)
    edges = graph.edges[np.arange(8)]
    exact = fg.SE2.between(graph.poses[edges.first], graph.poses[edges.second])
    gap = 1e-4
    exact[3, 2] += gap
    loop = replace(graph, edges=replace(edges, measured=exact))
    found = method(loop)
    turned = fg.SE2.between(found[edges.first], found[edges.second])[:, 2] - exact[:, 2]
    variance = np.linalg.inv(edges.information)[:, 2, 2]
    np.testing.assert_allclose(turned, -gap * variance / variance.sum(), rtol=1e-3)
    diagonal = 1.0 / edges.information[:, 2, 2]
    assert np.abs(diagonal / diagonal.sum() - variance / variance.sum()).max() > 0.05


def test_a_guess_that_is_changed_leaves_the_pose_graph_as_it_is() -> None:
    made = manhattan(20, seed=1).pose_graph
    _, x, guess = made.graph()
    before = made.poses.copy()
    guess[x][5] = 9.0
    np.testing.assert_array_equal(made.poses, before)


def test_measurements_take_any_whole_and_real_numbers() -> None:
    """Differences of unsigned positions wrap around: the odometry of a drive that is listed backwards was closures."""
    edges = manhattan(60, seed=1).pose_graph.edges
    turned = fg.SE2.inverse(edges.measured)
    back = Edges(edges.second.astype(np.uint16), edges.first.astype(np.uint16), turned, edges.information)
    np.testing.assert_array_equal(back.odometry, edges.odometry)
    plain = Edges([0, 1], [1, 2], [[1, 0, 0], [1, 0, 0]], [np.eye(3, dtype=int)] * 2)  # type: ignore[arg-type]
    assert plain.measured.dtype == plain.information.dtype == np.float64 and plain.odometry.all()
    for wrong, what in (
        ({"first": np.array([0.0, 1.5])}, "first must hold whole numbers, found float64"),
        ({"measured": np.zeros((2, 3), dtype=complex)}, "measured must hold real numbers, found complex128"),
        ({"second": np.array([1])}, "Edges need as many rows of each array, found first 2, second 1, measured 2"),
    ):
        with pytest.raises(fg.GraphError, match=what):
            replace(plain, **wrong)
