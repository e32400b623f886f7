"""Pairwise consistent loop closures: which are kept, whatever the units, directions and parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
import pytest

from unifg.errors import GraphError
from unifg.lie import SE2
from unifg.pose_graphs import Edges, PoseGraph, consistency, manhattan, pairwise_consistent, sphere
from unifg.pose_graphs.consistency import _agreements, _certain, _classes, _clique, most_consistent
from unifg.pose_graphs.generate import Simulated
from unifg.typing import BoolArray

CITY, GLOBE = manhattan(250, 2, outliers=0.5), sphere(6, 12, seed=2, outliers=0.5)


def kept(made: Simulated, pose_graph: PoseGraph | None = None) -> tuple[float, int]:
    """The share of right closures that is kept, and the number of wrong ones."""
    graph = made.pose_graph if pose_graph is None else pose_graph
    found, closures = pairwise_consistent(graph), ~graph.edges.odometry
    assert found[~closures].all()
    return float(found[closures & ~made.outliers].mean()), int(found[made.outliers].sum())


@pytest.mark.parametrize("made", [CITY, GLOBE], ids=["plane", "space"])
def test_wrong_closures_agree_with_few(made: Simulated) -> None:
    recall, wrong = kept(made)
    assert recall > 0.6 and wrong <= 0.05 * made.outliers.sum()


def turned_round(pose_graph: PoseGraph) -> PoseGraph:
    """Every other edge measured from its other end."""
    edges, group = pose_graph.edges, pose_graph.group
    other = np.arange(len(edges)) % 2 == 1
    first, second = np.where(other, edges.second, edges.first), np.where(other, edges.first, edges.second)
    measured, information = edges.measured.copy(), edges.information.copy()
    back = group.adjoint(edges.measured[other])  # a right error of Z is a left one of its inverse, but for the sign
    seen = np.linalg.inv(back)
    measured[other] = group.inverse(measured[other])
    information[other] = np.swapaxes(seen, 1, 2) @ information[other] @ seen
    return replace(
        pose_graph, edges=Edges(first, second, measured, 0.5 * (information + np.swapaxes(information, 1, 2)))
    )


@pytest.mark.parametrize("made", [CITY, GLOBE], ids=["plane", "space"])
def test_directions_and_places_do_not_matter(made: Simulated) -> None:
    plain = pairwise_consistent(made.pose_graph)
    np.testing.assert_array_equal(pairwise_consistent(turned_round(made.pose_graph)), plain)
    late = replace(made.pose_graph, edges=made.pose_graph.edges[::-1])  # the later closures come first
    np.testing.assert_array_equal(pairwise_consistent(late)[::-1], plain)
    lost = made.pose_graph.with_poses(made.pose_graph.poses[::-1])
    np.testing.assert_array_equal(pairwise_consistent(lost), plain)


def test_drives_that_odometry_does_not_connect() -> None:
    edges = CITY.pose_graph.edges
    cut = (np.minimum(edges.first, edges.second) == 124) & edges.odometry
    graph = replace(CITY.pose_graph, edges=edges[~cut])
    recall, wrong = kept(replace(CITY, outliers=CITY.outliers[~cut]), graph)
    assert recall > 0.5 and wrong <= 0.15 * CITY.outliers.sum()


def test_edges_that_cannot_be_tested_stay() -> None:
    graph = CITY.pose_graph
    information = graph.edges.information.copy()
    blind = np.flatnonzero(CITY.outliers)[:3]
    information[blind, 2, 2] = 0.0
    found = pairwise_consistent(replace(graph, edges=replace(graph.edges, information=information)))
    assert found[blind].all()
    chain = replace(graph, edges=graph.edges[graph.edges.odometry])
    assert pairwise_consistent(chain).all()
    assert pairwise_consistent(replace(graph, edges=graph.edges[:0])).shape == (0,)
    for options in ({"probability": 1.0}, {"tries": 0}):
        with pytest.raises(GraphError, match="must be"):
            pairwise_consistent(graph, **options)
    with pytest.raises(GraphError, match="probability must be a number, found 'a'"):
        pairwise_consistent(graph, probability="a")  # type: ignore[arg-type]
    with pytest.raises(GraphError, match="pose_graph must be of the class PoseGraph, found Simulated"):
        pairwise_consistent(CITY)  # type: ignore[arg-type]


def test_cliques_are_cliques_and_mostly_the_largest(rng: np.random.Generator) -> None:
    found = []
    for _ in range(20):
        agreeing = rng.random((12, 12)) < 0.6
        agreeing = np.triu(agreeing, 1)
        agreeing |= agreeing.T
        chosen = _clique(agreeing, 12)
        assert all(agreeing[a, b] for a, b in combinations(chosen.tolist(), 2))
        assert not any(agreeing[k, chosen].all() for k in range(12))  # nothing could join
        found.append(len(chosen) / largest(agreeing))
    assert min(found) >= 0.6 and np.mean(found) > 0.9
    assert _clique(np.zeros((0, 0), dtype=bool), 3).tolist() == []


def largest(agreeing: BoolArray) -> int:
    """Size of the largest clique, by trying all."""
    for size in range(len(agreeing), 0, -1):
        for chosen in combinations(range(len(agreeing)), size):
            if all(agreeing[a, b] for a, b in combinations(chosen, 2)):
                return size
    return 0


@pytest.mark.parametrize("turned", [False, True])
def test_what_a_closure_is_sure_of_is_carried_to_its_other_end(turned: bool) -> None:
    """Over a lever of ten metres, an error of heading is one of position, seen from the other end.

    Two closures are exact. The third one's heading is off by two deviations, measured from the far end; the same
    measurement is then written down from the near end, with its information carried by the adjoint.
    """
    count = 12
    truth = np.column_stack([np.linspace(0.0, 11.0, count), np.zeros((count, 2))])
    along = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    ends = np.array([[0, 10], [1, 11], [10, 0]])
    pairs = np.concatenate([along, ends])
    measured = SE2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    measured[-1] = SE2.retract(measured[-1], np.array([0.0, 0.0, 0.02]))
    information = np.tile(np.diag([1e8, 1e8, 1e8]), (len(pairs), 1, 1))
    information[-1] = np.diag([1e6, 1e6, 1e4])
    edges = Edges(pairs[:, 0], pairs[:, 1], measured, information)
    graph = PoseGraph(np.arange(count), truth, edges)
    if turned:
        seen = np.linalg.inv(SE2.adjoint(measured[-1:]))[0]
        ends[-1], measured[-1] = ends[-1][::-1], SE2.inverse(measured[-1:])[0]
        carried = seen.T @ information[-1] @ seen
        information[-1] = 0.5 * (carried + carried.T)
        pairs = np.concatenate([along, ends])
        graph = replace(graph, edges=Edges(pairs[:, 0], pairs[:, 1], measured, information))
    assert pairwise_consistent(graph).all()
    # Five times as far off it is not, whichever end it is seen from.
    off = np.array([0.0, 0.0, 0.08]) if not turned else -SE2.adjoint(SE2.inverse(measured[-1:]))[0] @ [0.0, 0.0, 0.08]
    measured[-1] = SE2.retract(measured[-1], off)
    assert not pairwise_consistent(replace(graph, edges=replace(graph.edges, measured=measured)))[-1]


def judged_at_truth(made: Simulated) -> tuple[PoseGraph, BoolArray]:
    """The graph at its true poses, and the edges that are right."""
    return made.pose_graph.with_poses(made.truth), ~made.outliers


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("make", [partial(manhattan, 250), partial(sphere, 6, 12)], ids=["plane", "space"])
def test_hardly_more_closures_are_consistent_than_are_right(make: Callable[..., Simulated], seed: int) -> None:
    graph, right = judged_at_truth(make(seed=seed, outliers=0.4))
    kept = int(right[~graph.edges.odometry].sum())
    most = most_consistent(graph, right)
    assert most is not None and kept <= most <= 1.03 * kept
    assert most_consistent(graph, graph.edges.odometry) == most  # whichever are kept


def test_a_bound_is_one_on_every_set_that_is_consistent() -> None:
    """Closures of which the largest set is known: three groups, each with an error in common, of 5, 4 and 3."""
    count, groups = 30, [0.0] * 5 + [3.0] * 4 + [-3.0] * 3
    truth = np.column_stack([np.arange(float(count)), np.zeros((count, 2))])
    first = np.arange(len(groups))
    pairs = np.concatenate(
        [np.stack([np.arange(count - 1), np.arange(1, count)], axis=1), np.stack([first, first + 15], 1)]
    )
    measured = SE2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    measured[count - 1 :, 1] += groups
    information = np.tile(np.diag([1e4, 1e4, 1e6]), (len(pairs), 1, 1))
    graph = PoseGraph(np.arange(count), truth, Edges(pairs[:, 0], pairs[:, 1], measured, information))
    used = np.ones(len(pairs), dtype=bool)
    used[count + 4 :] = False
    assert most_consistent(graph, used) == 5
    lost = used.copy()
    lost[:3] = False  # odometry is no measure where it is left out
    assert most_consistent(graph, lost) is None
    used[count + 4] = True  # of another group than the rest: kept closures that seem inconsistent
    assert most_consistent(graph, used) is None
    information[-1, 2, 2] = 0.0  # says too little to be compared, and counts
    blind = replace(graph, edges=replace(graph.edges, information=information))
    used[count + 4] = False
    assert most_consistent(blind, used) == 6


def test_the_largest_difference_of_two_right_closures(monkeypatch: pytest.MonkeyPatch) -> None:
    """One pair in a hundred differs by more than 11.3 in chi2, of three degrees of freedom."""
    truth = np.column_stack([np.arange(6.0), np.zeros((6, 2))])
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [0, 4], [1, 5]])
    information = np.tile(np.diag([1e12, 1e12, 1e12]), (7, 1, 1))
    information[5:] = np.diag([100.0, 100.0, 1e12])
    used = np.arange(7) < 6
    for chi2, most in ((11.2, 2), (11.5, 1)):
        measured = SE2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
        measured[6, 0] += np.sqrt(chi2 * 0.02)
        graph = PoseGraph(np.arange(6), truth, Edges(pairs[:, 0], pairs[:, 1], measured, information))
        assert most_consistent(graph, used) == most
    monkeypatch.setattr(consistency, "MOST", 1)
    assert most_consistent(graph, used) is None


def test_poses_at_which_drift_is_linearised_matter_little(rng: np.random.Generator) -> None:
    """Whatever the poses claim, to first order odometry and closures say the same of each other."""
    made = manhattan(200, seed=3, outliers=0.3)
    graph = made.pose_graph
    away = SE2.retract(
        made.truth, np.column_stack([np.sin(np.arange(200) / 20), np.cos(np.arange(200) / 30), np.zeros(200)])
    )
    ((_, at_truth),) = _agreements(graph, *_certain(graph), 0.999, made.truth)
    ((_, at_others),) = _agreements(graph, *_certain(graph), 0.999, away)
    assert 0.3 < at_truth.mean() < 0.9 and (at_truth != at_others).mean() < 0.01


def test_drift_that_is_far_from_linear_is_linearised_at_the_map() -> None:
    """Right closures that odometry alone takes for inconsistent, by its heading, are seen to agree at the poses."""
    made = manhattan(1000, seed=0)
    graph, right = judged_at_truth(made)
    closures = int((~graph.edges.odometry).sum())
    assert most_consistent(graph, right) == closures
    assert most_consistent(made.pose_graph, right) is None  # at odometry once more, not at the map


def test_classes_bound_the_largest_clique(rng: np.random.Generator) -> None:
    found = []
    for share in (0.2, 0.5, 0.8):
        for _ in range(8):
            agreeing = np.triu(rng.random((12, 12)) < share, 1)
            agreeing |= agreeing.T
            most, most_of_all = largest(agreeing), _classes(agreeing)
            assert most <= most_of_all
            found.append(most_of_all / most)
    assert np.mean(found) < 1.2
    assert _classes(np.zeros((0, 0), dtype=bool)) == 0 and _classes(np.zeros((4, 4), dtype=bool)) == 1


def test_a_verdict_on_a_robust_map_bounds_what_could_be_kept() -> None:
    graph, right = judged_at_truth(CITY)
    kept = int(right[~graph.edges.odometry].sum())
    verdict = graph.verdict(used=right)
    assert verdict.closures is not None and verdict.closures[0] == kept
    most = verdict.closures[1]
    bound = f"at most {most} closures are" if most > kept else "no larger set of closures is"
    assert f"{bound} consistent pair by pair; {kept} are kept" in verdict.sentence()
    assert graph.verdict(used=right, effort="cheap").closures is None
    clean = replace(graph, edges=graph.edges[right])
    assert clean.verdict().closures is None
