"""Maps beyond memory give the answer of the whole graph, one submap at a time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.elimination.factorization import Factorization
from unifg.elimination.reduction import Reduction
from unifg.elimination.symmetric import Symmetric, distinct
from unifg.errors import GraphError
from unifg.pose_graphs import Edges, PoseGraph, Sightings, Submaps, chordal, manhattan, sphere, submaps
from unifg.solution.status import Status
from unifg.solvers import GaussNewton
from unifg.typing import Array, BoolArray

PLANE = manhattan(300, seed=5).pose_graph
SPACE = sphere(8, 12, seed=1).pose_graph
SEEN = Sightings(np.zeros(1, int), np.zeros(1, int), np.zeros((1, 2)), np.eye(2)[None])


def begun(made: PoseGraph) -> PoseGraph:
    """The graph at its chordal guess."""
    return made.with_poses(chordal(made))


def whole(made: PoseGraph) -> tuple[fg.Solution, Array]:
    """Solution of the whole graph, and its poses."""
    graph, x, guess = made.graph()
    solution = GaussNewton(tolerance=1e-11).solve(graph, guess, check=True)
    return solution, solution[x]


@pytest.mark.parametrize("made", [PLANE, SPACE], ids=["plane", "space"])
@pytest.mark.parametrize("largest", [1000, 60, 25])
def test_submaps_find_the_map_and_its_covariances(made: PoseGraph, largest: int, tmp_path: Path) -> None:
    solution, poses = whole(begun(made))
    parted = Submaps.split(begun(made), tmp_path / "map", largest)
    assert (parted.count == 1) == (largest == 1000)
    found = parted.optimize(tolerance=1e-9)
    assert found.status is Status.CONVERGED and found.offset <= 1e-8
    assert found.chi2 == pytest.approx(2.0 * solution.cost, rel=1e-10)
    np.testing.assert_allclose(made.group.local(poses, parted.poses), 0.0, atol=1e-7)
    x = solution.families["poses"]
    again = Submaps(tmp_path / "map")
    for pose in (0, 1, len(poses) // 2, *again._shared[1:3].tolist(), len(poses) - 1):
        expected = solution.covariance(x[pose]) if pose else np.zeros((made.group.dim,) * 2)
        for opened in (parted, again):
            np.testing.assert_allclose(opened.covariance(pose), expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("largest", [1000, 60])
@pytest.mark.parametrize("robust", [fg.Huber(1.0), fg.Cauchy(1.0), fg.GemanMcClure(2.0)])
def test_wrong_closures_count_as_losses_say(robust: fg.Loss, largest: int, tmp_path: Path) -> None:
    """Submaps cut edges anew, but know which of them are loop closures."""
    made = manhattan(300, seed=5, outliers=0.2).pose_graph
    made = made.with_poses(whole(begun(PLANE))[1])
    graph, x, guess = made.graph(robust)
    solution = GaussNewton(tolerance=1e-11).solve(graph, guess)
    parted = Submaps.split(made, tmp_path / "map", largest, robust)
    found = parted.optimize(tolerance=1e-9, max_iterations=200)
    assert found.status is Status.CONVERGED
    assert found.chi2 == pytest.approx(2.0 * solution.cost, rel=1e-8)
    np.testing.assert_allclose(made.group.local(solution[x], parted.poses), 0.0, atol=1e-5)
    again = Submaps(tmp_path / "map", robust)
    np.testing.assert_allclose(again.covariance(200), solution.covariance(x[200]), rtol=1e-5)
    with pytest.raises(GraphError, match=r"optimized with robust=\w+\(.*\), opened with None"):
        Submaps(tmp_path / "map").covariance(200)


@pytest.mark.parametrize(("largest", "moved_away"), [(1000, 0), (60, 0), (60, 37)])
def test_a_step_is_that_of_the_whole_graph(largest: int, moved_away: int, tmp_path: Path) -> None:
    """Its offsets, of the whole and of every pose, and what is left of it at half its length, too."""
    made = begun(PLANE)
    poses = made.poses.copy()
    poses[moved_away] += np.array([3.0, 2.0, 0.5]) * (moved_away > 0)
    made = made.with_poses(poses)
    graph, x, guess = made.graph()
    program = graph.compile()
    lin = program.linearize(program.values_from(guess))
    gradient = lin.gradient[program.columns.free]
    upper = program.normal.matrix(lin.hessian).toarray()
    step = np.linalg.solve(upper + np.triu(upper, 1).T, -gradient)
    parted = Submaps.split(made, tmp_path, largest)
    found = parted.optimize(max_iterations=0)
    assert found.offset == pytest.approx(np.sqrt(-gradient @ step / found.chi2), rel=1e-8)
    jacobian = np.zeros((program.costs.count, program.columns.width))
    jacobian[program.costs.rows, program.costs.columns] = lin.jacobian
    moved = jacobian[:, program.columns.free] @ step
    order = np.argsort(~made.edges.odometry, kind="stable")  # of the terms of the graph
    ends = np.repeat(np.stack([made.edges.first, made.edges.second])[:, order], 3, axis=1).ravel()
    squares = [np.bincount(ends, np.tile(row**2, 2)) for row in (moved, lin.residual)]
    ratios = np.sqrt(squares[0] / squares[1])
    assert (ratios.argmax() in parted._shared) == (moved_away > 0)
    assert parted._eliminated(parted._eliminated().step, 0.5).worst == pytest.approx(ratios.max(), rel=1e-6)
    expected = program.retract(program.values_from(guess), 0.5 * step)[x]
    np.testing.assert_allclose(np.load(tmp_path / submaps.NEXT), expected, atol=1e-9)


def test_a_tolerance_says_when_to_end(tmp_path: Path) -> None:
    taken = [Submaps.split(begun(PLANE), tmp_path, 60).optimize(tolerance=t).iterations for t in (1e-1, 1e-3, 1e-5)]
    assert taken[0] < taken[1] < taken[2]


@pytest.mark.parametrize("largest", [1000, 60])
def test_a_gross_error_hides_no_pose_that_is_off(largest: int, tmp_path: Path) -> None:
    """Beside two exact positions that contradict each other the rest is a millionth of chi2."""
    made = begun(PLANE)
    first, second = np.array([0, 0]), np.array([3, 3])
    measured = np.array([[50.0, 0.0, 0.0], [-50.0, 0.0, 0.0]])
    wrong = Edges(first, second, measured, np.tile(1e12 * np.eye(3), (2, 1, 1)))
    edges = Edges(
        *(np.concatenate([a, b]) for a, b in zip(vars(made.edges).values(), vars(wrong).values(), strict=True))
    )
    made = replace(made, edges=edges)
    _, poses = whole(made)
    parted = Submaps.split(made, tmp_path, largest)
    assert parted.optimize().status is Status.CONVERGED
    np.testing.assert_allclose(fg.SE2.local(poses, parted.poses), 0.0, atol=1e-5)


def test_measurements_without_an_error(tmp_path: Path) -> None:
    made = manhattan(300, seed=1)
    edges, truth = made.pose_graph.edges, made.truth
    exact = replace(edges, measured=fg.SE2.compose(fg.SE2.inverse(truth[edges.first]), truth[edges.second]))
    near = fg.SE2.retract(truth, 0.01 * np.random.default_rng(0).standard_normal(truth.shape))
    parted = Submaps.split(replace(made.pose_graph, poses=near, edges=exact), tmp_path, 60)
    for most in (5, 1):
        found = parted.optimize()
        assert found.status is Status.CONVERGED and found.iterations <= most and found.chi2 < 1e-20


@pytest.mark.parametrize("largest", [1000, 60])
def test_poses_far_from_the_origin_with_loose_ends(largest: int, tmp_path: Path) -> None:
    """Rounding of the whole map is larger than the residuals of edges that nothing contradicts."""
    made = begun(PLANE)
    edges, last = made.edges, len(made.poses) - 1
    ends = np.isin(edges.first, [0, 1, last]) | np.isin(edges.second, [0, 1, last])
    made = replace(made, edges=edges[edges.odometry | ~ends], poses=made.poses + np.array([4e4, -3e4, 0.0]))
    parted = Submaps.split(made, tmp_path, largest)
    found = parted.optimize(tolerance=1e-7)
    assert found.status is Status.CONVERGED and found.iterations < 12


@pytest.mark.parametrize("wrong", [np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan), np.triu(np.ones((3, 3)))])
def test_information_that_is_none_is_refused_by_the_number_of_the_edge(
    wrong: Array, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Submaps count their edges anew: "factor 1" of one of them says nothing to a user."""
    monkeypatch.setattr(submaps, "AT_ONCE", 100)
    made = begun(PLANE)
    information = made.edges.information.copy()
    information[345] = wrong
    with pytest.raises(GraphError, match="edge 345: its information") as caught:
        Submaps.split(replace(made, edges=replace(made.edges, information=information)), tmp_path, 60)
    assert caught.value.index == 345 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tolerance": float("nan")}, "tolerance must be positive, found nan"),
        ({"tolerance": -1.0}, "tolerance must be positive"),
        ({"max_iterations": -1}, "max_iterations must not be negative, found -1"),
    ],
)
def test_an_end_that_cannot_come_is_refused(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    parted = Submaps.split(begun(PLANE), tmp_path, 60)
    with pytest.raises(GraphError, match=words):
        parted.optimize(**options)


def test_known_poses_are_kept(tmp_path: Path) -> None:
    made = replace(begun(PLANE), fixed_ids=(0, 140, 299))
    _, poses = whole(made)
    parted = Submaps.split(made, tmp_path, 60)
    parted.optimize(tolerance=1e-9)
    np.testing.assert_allclose(made.group.local(poses, parted.poses), 0.0, atol=1e-7)
    np.testing.assert_array_equal(parted.poses[[0, 140, 299]], made.poses[[0, 140, 299]])
    assert not parted.covariance(140).any()


def test_two_maps_in_one_graph(tmp_path: Path) -> None:
    """Parts without an edge between them have an anchor each."""
    made = begun(PLANE)
    edges, count = made.edges, len(made.poses)
    first, second = (np.append(end, end + count) for end in (edges.first, edges.second))
    measured, information = (np.concatenate([rows, rows]) for rows in (edges.measured, edges.information))
    poses = np.concatenate([made.poses, made.poses + np.array([5.0, 3.0, 0.0])])
    both = PoseGraph(np.arange(2 * count), poses, Edges(first, second, measured, information))
    _, poses = whole(both)
    parted = Submaps.split(both, tmp_path, 70)
    assert parted.optimize(tolerance=1e-9).status is Status.CONVERGED
    np.testing.assert_allclose(fg.SE2.local(poses, parted.poses), 0.0, atol=1e-7)


def test_steps_are_halved_until_chi2_falls(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(3)
    made = begun(PLANE)
    far = made.with_poses(fg.SE2.retract(made.poses, 0.35 * rng.standard_normal(made.poses.shape)))
    parted = Submaps.split(far, tmp_path, 60)
    with caplog.at_level("INFO", logger="unifg"):
        found = parted.optimize()
    chi2 = [float(record.args[1]) for record in caplog.records if isinstance(record.args, tuple)]  # type: ignore[arg-type]
    assert found.status is Status.CONVERGED
    assert len(chi2) == found.iterations
    assert (np.diff(chi2) <= 1e-9 * chi2[-1]).all()
    assert found.chi2 == pytest.approx(far.with_poses(np.array(parted.poses)).chi2(), rel=1e-9)


def test_a_step_that_raises_chi2_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step is made to lead the wrong way: what was begun with is kept, and its covariances are those there."""
    made, step = begun(PLANE), submaps._Separator.solve

    def backwards(separator: submaps._Separator) -> tuple[Array, float]:
        found, decrease = step(separator)
        return -5.0 * found, decrease

    parted = Submaps.split(made, tmp_path, 60)
    parted.optimize(max_iterations=0)
    expected = parted.covariance(150)
    monkeypatch.setattr(submaps._Separator, "solve", backwards)
    found = parted.optimize()
    assert (found.status, found.iterations) == (Status.STALLED, 0)
    np.testing.assert_array_equal(parted.poses, made.poses)
    np.testing.assert_allclose(parted.covariance(150), expected)


def test_a_limit_and_an_interruption_leave_the_poses_of_the_last_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = begun(PLANE)
    parted = Submaps.split(made, tmp_path, 60)
    first = parted.optimize(max_iterations=1)
    assert (first.status, first.iterations) == (Status.ITERATION_LIMIT, 1)
    reached, passes = np.array(parted.poses), list[int]()
    linearize = submaps._Submap.linearize

    def interrupted(submap: submaps._Submap, poses: Array) -> object:
        passes.append(1)
        if len(passes) == 2 * parted.count:
            raise KeyboardInterrupt
        return linearize(submap, poses)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(submaps._Submap, "linearize", interrupted)
        parted.optimize()
    np.testing.assert_array_equal(parted.poses, reached)
    with pytest.raises(GraphError, match=r"no covariances yet; optimize\(\) comes first"):
        Submaps(tmp_path).covariance(3)
    assert Submaps(tmp_path).optimize().status is Status.CONVERGED


def test_a_folder_is_written_over(tmp_path: Path) -> None:
    Submaps.split(begun(PLANE), tmp_path, 25).optimize(max_iterations=0)
    parted = Submaps.split(begun(SPACE), tmp_path, 40)
    assert len(list(tmp_path.glob("[0-9]*.npz"))) == parted.count
    with pytest.raises(GraphError, match="no covariances yet"):
        parted.covariance(3)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda made, into: Submaps(into / "nothing"), "no submaps here"),
        (lambda made, into: Submaps.split(replace(made, edges=made.edges[:0]), into, 10), "found 0 edges"),
        (lambda made, into: Submaps.split(made, into, 0), "submaps of 0 poses"),
        (lambda made, into: Submaps.split(made, into, 2.5), "largest must be a whole number, found 2.5"),  # type: ignore[arg-type]
        (
            lambda made, into: Submaps.split(
                made.with_poses(np.where(np.arange(300)[:, None] == 7, np.nan, made.poses)), into, 10
            ),
            "pose 7 is not finite",
        ),
        (lambda made, into: Submaps.split(replace(made, sightings={"point": SEEN}), into, 10), "of poses and edges"),
        (
            lambda made, into: Submaps.split(made, into, 60).optimize(max_iterations="many"),  # type: ignore[arg-type]
            "max_iterations must be a whole number, found 'many'",
        ),
        (lambda made, into: Submaps.split(made, into, 60).covariance(-1), "pose -1 of 300"),
        (lambda made, into: Submaps.split(made, into, 60).covariance(300), "pose 300 of 300"),
        (lambda made, into: Submaps.split(made, into, 60).covariance("a"), "pose must be a whole number"),  # type: ignore[arg-type]
    ],
)
def test_refusals(ask: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(GraphError, match=words):
        ask(begun(PLANE), tmp_path)


@pytest.mark.parametrize("poses", [[200], [200, 201, 202]])
@pytest.mark.parametrize("largest", [1000, 60])
def test_poses_that_edges_do_not_determine_are_named(largest: int, poses: list[int], tmp_path: Path) -> None:
    made = begun(PLANE)
    information = made.edges.information.copy()
    alone = np.isin(made.edges.first, poses) != np.isin(made.edges.second, poses)
    information[alone] = 0.0
    loose = replace(made, edges=replace(made.edges, information=information))
    with pytest.raises(GraphError, match="the edges do not determine"):
        Submaps.split(loose, tmp_path, largest).optimize()


@pytest.mark.parametrize("kept", [0, 4, 12])
@pytest.mark.parametrize("apart", [False, True])
def test_reduction_is_the_schur_complement(kept: int, apart: bool) -> None:
    """Also beside a component that touches nothing of what is kept, and where that is not determined."""
    rng, n = np.random.default_rng(kept), 30
    J = rng.standard_normal((60, n)) * (rng.random((60, n)) < 0.15)
    J[:n, :n] += np.diag(np.where(np.arange(n) < n - kept, 3.0, 0.0))
    J[:, n - 1 :] *= kept == 0  # of which nothing is known
    if apart:
        J[:, :8][J[:, 8:].any(axis=1)] = 0.0
        J = np.vstack([J, np.eye(n)[:8], rng.standard_normal((8, 8)) @ np.eye(n)[:8]])
    A, g = J.T @ J, rng.standard_normal(n)
    rows, columns = np.nonzero(np.triu(A))
    pattern = Symmetric(n, [(rows, columns)])
    reduction = Reduction(pattern, kept)
    assert reduction.factor(A[pattern.indices, pattern.columns])
    k = n - kept
    inner = np.linalg.inv(A[:k, :k])
    np.testing.assert_allclose(reduction.matrix, A[k:, k:] - A[k:, :k] @ inner @ A[:k, k:], atol=1e-10)
    left, decrease = reduction.reduce(g)
    np.testing.assert_allclose(left, g[k:] - A[k:, :k] @ inner @ g[:k], atol=1e-10)
    assert decrease == pytest.approx(g[:k] @ inner @ g[:k])
    last = rng.standard_normal(kept)
    step = reduction.step(g, last)
    np.testing.assert_allclose(step[k:], last, atol=1e-9)
    np.testing.assert_allclose(step[:k], -inner @ (g[:k] + A[:k, k:] @ last), atol=1e-9)
    J[:, 2] = 0.0
    A = J.T @ J
    assert not reduction.factor(A[pattern.indices, pattern.columns])


def test_a_schur_complement_of_a_full_matrix_with_both_signs() -> None:
    """All scalars have the same neighbours, and yet those that are kept are nodes of their own."""
    J = np.random.default_rng(1).standard_normal((9, 6))
    A, rows = J.T @ J, np.triu_indices(6)
    pattern = Symmetric(6, [rows])
    reduction = Reduction(pattern, 2)
    assert reduction.factor(A[pattern.indices, pattern.columns])
    inner = np.linalg.inv(A[:4, :4])
    np.testing.assert_allclose(reduction.matrix, A[4:, 4:] - A[4:, :4] @ inner @ A[:4, 4:], atol=1e-12)
    pairs = [(0, 1), (0, 2), (1, 2), *((i, j) for i in (1, 2) for j in range(3, 7)), (4, 5), (4, 6), (5, 6)]
    alike = np.diag(np.full(7, 20.0))  # scalars 1 and 2, of which one is kept, have the same neighbours
    alike[tuple(np.transpose(pairs))] = alike.T[tuple(np.transpose(pairs))] = np.arange(1.0, 1.0 + len(pairs)) / 4.0
    first, second = np.nonzero(np.triu(alike))
    pattern = Symmetric(7, [(first, second)])
    reduction = Reduction(pattern, 5)
    assert reduction.factor(alike[pattern.indices, pattern.columns])
    expected = alike[2:, 2:] - alike[2:, :2] @ np.linalg.inv(alike[:2, :2]) @ alike[:2, 2:]
    np.testing.assert_allclose(reduction.matrix, expected, atol=1e-12)
    pattern = Symmetric(6, [rows])
    A[4:, 4:] -= 50.0 * np.eye(2)
    factorization = Factorization(pattern, np.arange(6), last=2)
    assert factorization.factor(A[pattern.indices, pattern.columns]) and factorization.inertia == (4, 2, 0)
    np.testing.assert_allclose(factorization.last_block(), A[4:, 4:] - A[4:, :4] @ inner @ A[:4, 4:], atol=1e-10)


@pytest.mark.parametrize("dense", [False, True])
def test_a_last_node_comes_last(dense: bool) -> None:
    """Also where another node touches more of them, and where a part of the graph does not touch it."""
    n = 400
    first, second = np.arange(n - 3), np.arange(1, n - 2)
    rows, columns = np.append(first, [0, 200]), np.append(second, [n - 1, n - 1])
    if dense:
        rows, columns = np.append(rows, np.arange(n - 2)), np.append(columns, np.full(n - 2, n - 2))
    factorization = Factorization(Symmetric(n, [(rows, columns)]), np.arange(n), last=1)
    place = np.argsort(factorization.structure.order)
    assert place[n - 1] > place[: n - 2].max()
    assert not dense or place[n - 1] > place[n - 2]


def test_last_nodes_come_last_where_a_graph_is_dissected() -> None:
    n = 12
    k = np.arange(n**3).reshape(n, n, n)
    first = np.concatenate([k[:, :, :-1].ravel(), k[:, :-1].ravel(), k[:-1].ravel()])
    second = np.concatenate([k[:, :, 1:].ravel(), k[:, 1:].ravel(), k[1:].ravel()])
    factorization = Factorization(Symmetric.of_blocks(3 * np.arange(n**3 + 1), first, second), last=3 * n)
    assert factorization.structure.kind == "nested-dissection"
    place = np.argsort(factorization.plan.order)
    assert place[-3 * n :].min() == 3 * (n**3 - n)


@pytest.mark.parametrize("numbers", [[], [3], [5, -2, 5, 5, -2, 0], [-(2**63), 2**63 - 1, 0]])
def test_distinct_numbers(numbers: list[int]) -> None:
    given = np.array(numbers, dtype=np.int64)
    np.testing.assert_array_equal(distinct(given), np.unique(given))


def test_parts_are_of_equal_size() -> None:
    places = np.random.default_rng(0).uniform(0.0, [10.0, 1.0], (1000, 2))
    part = submaps._cut(places, 100)
    sizes: BoolArray = np.bincount(part) <= 100
    assert sizes.all() and np.bincount(part).min() >= 50
    spans = [np.ptp(places[part == k], axis=0) for k in range(part.max() + 1)]
    assert max(span[0] for span in spans) < 1.5  # cut across the longer side


def test_a_refused_split_leaves_what_the_folder_held(tmp_path: Path) -> None:
    """A bridge without information is found before anything is removed."""
    made = begun(PLANE)
    Submaps.split(made, tmp_path, 60)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    information = made.edges.information.copy()
    information[(made.edges.first == 299) | (made.edges.second == 299)] = 0.0
    blind = replace(made, edges=replace(made.edges, information=information))
    with pytest.raises(GraphError, match=r"do not determine pose .*: edge [0-9]+ to it has no information"):
        Submaps.split(blind, tmp_path, 60)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
