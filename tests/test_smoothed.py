"""Pose graphs of incremental smoothers: the same edges and the same verdict as of the file of the same drive."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.closures import aliased
from problems.graphs import smoother_with
from unifg.errors import GraphError
from unifg.files.g2o import read_g2o, write_g2o
from unifg.pose_graphs import PoseGraph, Sightings, bearing_range, from_smoother, judge, manhattan, sighting, sphere
from unifg.solvers import GaussNewton
from unifg.typing import Array, BoolArray


def grown(made: PoseGraph, revocable: float | None = None) -> fg.Incremental:
    """Smoother that took in the edges of a graph by the later of their poses."""
    edges, group = made.edges, made.group
    smoother, x = smoother_with(fg.Incremental(), group)
    smoother.minimize(fg.prior, x[0], made.poses[0], sigma=1e-3)
    smoother.update({x: made.poses[0]})
    late = np.maximum(edges.first, edges.second)
    for k in range(1, len(made.poses)):
        here = np.flatnonzero(late == k)
        (step,) = here[edges.odometry[here] & (edges.second[here] == k)]
        for e in here.tolist():
            smoother.minimize(
                fg.between, x[int(edges.first[e])], x[int(edges.second[e])], edges.measured[e],
                information=edges.information[e], revocable=None if e == step else revocable,
            )  # fmt: skip
        smoother.update({x: group.compose(smoother.estimate(x[k - 1])[0], edges.measured[step])})
    return smoother


def by_time(made: PoseGraph) -> PoseGraph:
    """The same graph with its edges in the order in which a drive states them."""
    late = np.maximum(made.edges.first, made.edges.second)
    return replace(made, edges=made.edges[np.argsort(late, kind="stable")])


def batch(made: PoseGraph, path: Path) -> PoseGraph:
    """Map of a file."""
    write_g2o(path, made)
    read = read_g2o(path)
    graph, x, guess = read.graph()
    return read.with_poses(GaussNewton().solve(graph, guess, check=True)[x])


def alike(one: PoseGraph, other: PoseGraph, used: BoolArray | None) -> None:
    """Compare the verdicts on two graphs."""
    a, b = one.verdict(effort="cheap", used=used), other.verdict(effort="cheap", used=used)
    assert a.judgement.chi2 == pytest.approx(b.judgement.chi2, rel=1e-7) and a.claim == b.claim
    assert a.judgement.freedom == b.judgement.freedom and a.ended == b.ended
    assert [(c.kind, c.edges.tolist()) for c in a.clusters] == [(c.kind, c.edges.tolist()) for c in b.clusters]
    for c, d in zip(a.clusters, b.clusters, strict=True):
        assert np.array_equal(c.stretches, d.stretches)
        assert c.squared == pytest.approx(d.squared, abs=2e-5 * a.judgement.chi2)  # maps end within 1e-5 of chi2
    assert a.leverage == pytest.approx(b.leverage, abs=1e-3)
    assert a.certificate is not None and b.certificate is not None
    assert a.certificate.dual == pytest.approx(b.certificate.dual, rel=1e-5)


@pytest.mark.parametrize("spatial", [False, True])
def test_a_map_that_grew_has_the_verdict_of_its_file(spatial: bool, tmp_path: Path) -> None:
    made = by_time((sphere(6, 12, 1) if spatial else manhattan(250, 1)).pose_graph)
    solved = batch(made, tmp_path / "city.g2o")
    graph, used = from_smoother(grown(made))
    assert used.all() and graph.group is made.group and not graph.priors and graph.fixed_ids == (0,)
    for name in ("first", "second", "measured"):
        assert np.array_equal(getattr(graph.edges, name), getattr(made.edges, name))
    scale = np.abs(made.edges.information).max()
    assert graph.edges.information == pytest.approx(made.edges.information, rel=1e-12, abs=1e-12 * scale)
    assert np.abs(made.group.local(graph.poses, solved.poses)).max() < 1e-4
    alike(graph, solved, None)
    assert judge(graph).freedom == judge(solved).freedom


@pytest.mark.product(1, of="large maps")
def test_wrong_closures_are_not_used_and_named_as_in_the_file(tmp_path: Path) -> None:
    made = manhattan(250, 3)
    dirty, (fault,) = aliased(made.pose_graph, made.truth, 1, 3)
    wrong = np.isin(np.arange(len(dirty.edges)), fault)
    order = np.argsort(np.maximum(dirty.edges.first, dirty.edges.second), kind="stable")
    dirty, wrong = by_time(dirty), wrong[order]
    smoother = grown(dirty, 4.0)
    graph, used = from_smoother(smoother)
    assert np.array_equal(used, ~wrong) and wrong.sum() == 8
    assert graph.edges.information == pytest.approx(dirty.edges.information, rel=1e-9, abs=1e-6)
    kept = batch(replace(dirty, edges=dirty.edges[used]), tmp_path / "kept.g2o")
    alike(graph, replace(kept, edges=dirty.edges), used)
    # All edges: the map is solved again with those that were left out, as that of the file is.
    every = batch(dirty, tmp_path / "every.g2o")
    named, expected = (one.verdict(effort="cheap").of("contradicted") for one in (graph, every))
    assert [one.edges.tolist() for one in named] == [one.edges.tolist() for one in expected]
    assert np.isin(np.flatnonzero(wrong), np.concatenate([one.edges for one in named])).all()
    # A copy, whose kernels are others.
    copied, again = from_smoother(pickle.loads(pickle.dumps(smoother)))
    assert np.array_equal(again, used) and np.array_equal(copied.poses, graph.poses)


def test_landmarks_and_priors_come_along() -> None:
    """Two priors stay measurements; a sighting that contradicts the rest is not in the graph."""
    smoother = fg.Incremental()
    x, marks = smoother.variables("x", fg.SE2), smoother.variables("marks", fg.Rn(2))
    truth = np.array([[float(k), 0.0, 0.0] for k in range(6)])
    for k in (0, 5):
        smoother.minimize(fg.prior, x[k], truth[k], sigma=[0.1, 0.1, 0.05])
    step = np.array([1.0, 0.0, 0.0])
    smoother.minimize(fg.between, x[[0, 1, 2, 3, 4]], x[[1, 2, 3, 4, 5]], step, sigma=0.05)
    place = np.array([3.0, 2.0])
    seen = [[np.arctan2(2.0, 3.0 - k), np.hypot(2.0, 3.0 - k)] for k in range(6)]
    smoother.minimize(bearing_range, x[[0, 1, 2, 3, 4, 5]], marks[0], seen, sigma=[0.02, 0.1], revocable=4.0)
    smoother.update({x: truth, marks: place}, iterations=3)
    smoother.minimize(bearing_range, x[2], marks[0], [2.0, 9.0], sigma=[0.02, 0.1], revocable=4.0)
    smoother.update()
    graph, used = from_smoother(smoother)
    assert used.shape == (5,) and used.all() and not graph.fixed_ids
    assert np.array_equal(graph.priors["pose"].pose, [0, 5]) and graph.landmarks[0] == pytest.approx(place, abs=1e-6)
    sightings: Sightings = graph.sightings["bearing-range"]
    assert np.array_equal(sightings.pose, range(6)) and not sightings.landmark.any()
    assert sightings.measured == pytest.approx(np.array(seen))
    assert sightings.information == pytest.approx(np.tile(np.diag([2500.0, 100.0]), (6, 1, 1)))
    assert graph.chi2() == pytest.approx(2.0 * smoother.cost, abs=1e-6)
    verdict = graph.verdict(effort="cheap", used=used)
    assert verdict.judgement.freedom == 3 * 5 + 3 * 2 + 2 * 6 - 3 * 6 - 2 and not verdict.clusters


def test_the_pose_of_an_only_prior_is_known_and_no_landmark_is(tmp_path: Path) -> None:
    smoother = fg.Incremental()
    x, marks = smoother.variables("x", fg.SE2), smoother.variables("marks", fg.Rn(2))
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=1e-3)
    smoother.minimize(fg.between, x[0], x[1], [1.0, 0.0, 0.0], sigma=0.1)
    smoother.minimize(sighting, x[[0, 0, 1, 1]], marks[[0, 1, 0, 1]], [[1, 1], [2, 1], [0, 1.1], [1, 1]], sigma=0.1)
    smoother.update({x: [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], marks: [[1.0, 1.0], [2.0, 1.0]]}, iterations=3)
    graph, _ = from_smoother(smoother)
    assert graph.fixed_ids == (0,) and judge(graph).freedom == 3 + 4 * 2 - 3 - 2 * 2
    assert [len(held) for held in graph.anchors()] == [1, 0]
    write_g2o(tmp_path / "map.g2o", graph)
    assert np.array_equal(read_g2o(tmp_path / "map.g2o").landmarks, graph.landmarks)


def own(pose: Array, place: Array) -> Array:
    return pose[:, :2] - place


@pytest.mark.parametrize(
    ("function", "arguments", "options", "said"),
    [
        (own, "xm", {}, r"'own' of x\[1\], marks\[0\] has no place in a pose graph"),
        (fg.between, "xxz", {"robust": fg.Huber(1.0)}, r"'between' of x\[1\], x\[1\], with a robust loss has no place"),
        (fg.prior, "mp", {}, r"'prior' of marks\[0\] has no place"),
        (fg.between, "Zxz", {}, r"a Python function of x\[1\] has no place"),
    ],
)
def test_what_has_no_place_in_a_pose_graph_is_refused(
    function: Any, arguments: str, options: dict[str, Any], said: str
) -> None:
    smoother = fg.Incremental()
    x, marks = smoother.variables("x", fg.SE2), smoother.variables("marks", fg.Rn(2))
    smoother.minimize(fg.prior, x[[0, 1]], np.zeros(3), sigma=1.0)
    smoother.update({x: np.zeros((2, 3))})
    known = {"x": x[1], "m": marks[0], "z": np.zeros(3), "Z": np.zeros(3), "p": np.zeros(2)}
    smoother.minimize(function, *(known[name] for name in arguments), sigma=1.0, **options)
    smoother.update({marks: np.zeros(2)} if "m" in arguments else None)
    with pytest.raises(GraphError, match=said):
        from_smoother(smoother)


def test_families_that_are_no_map_are_refused() -> None:
    smoother = fg.Incremental()
    with pytest.raises(GraphError, match="no family of poses in SE2 or SE3"):
        from_smoother(smoother)
    smoother.variables("x", fg.SE2)
    smoother.variables("y", fg.SE3)
    with pytest.raises(GraphError, match=r"found families \['x', 'y'\], expected one of poses in SE2 or SE3"):
        from_smoother(smoother)
    with pytest.raises(GraphError, match=r"smoother must be of the class Incremental, found .*FixedLag"):
        from_smoother(fg.FixedLag(5))  # type: ignore[arg-type]
