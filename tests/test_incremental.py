"""Incremental smoothing gives what a batch solve of the same factors gives, and says so when it cannot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from dense import Batch, drive, one_by_one, state
from problems.graphs import smoother_with
from unifg.elimination.symbolic import cliques as find_cliques
from unifg.elimination.symbolic import separators as find_separators
from unifg.errors import GraphError
from unifg.files.g2o import read_g2o
from unifg.smoothing import Incremental


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3, fg.SO3], ids=lambda g: g.name)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.product(2)
def test_every_update_is_a_batch_step(group: Any, seed: int) -> None:
    """Thresholds zero: after each update the estimates are those of a Gauss-Newton step over everything."""
    rng = np.random.default_rng(seed)
    smoother, x = smoother_with(Incremental(relinearize=0.0, wildfire=0.0), group)
    batch = Batch([group])
    for k, statements in enumerate(drive(group, rng, 25)):
        state(smoother, x, statements)
        batch.statements += statements
        start = group.identity() if k == 0 else group.compose(smoother.estimate(x[-1])[0], group.random(rng))
        smoother.update({x: start})
        batch.add(start)
        batch.step()
        assert np.abs(group.local(batch.stack(), smoother.estimate(x))).max() < 1e-8
    for _ in range(20):
        smoother.update()
    for _ in range(20):
        batch.step()
    assert np.abs(group.local(batch.stack(), smoother.estimate(x))).max() < 1e-8
    assert smoother.cost == pytest.approx(batch.cost(), rel=1e-9)
    covariance = np.linalg.inv(batch.hessian()[0])
    np.testing.assert_allclose(smoother.covariance(x), covariance, rtol=1e-7, atol=1e-9 * covariance.max())
    chosen = [17, 3, 8]
    columns = (np.array(chosen)[:, None] * group.dim + np.arange(group.dim)).ravel()
    np.testing.assert_allclose(
        smoother.covariance(x[17], x[[3, 8]]), covariance[np.ix_(columns, columns)], rtol=1e-7, atol=1e-9
    )


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3], ids=lambda g: g.name)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.product(1)
def test_some_points_move_and_others_stay(group: Any, seed: int) -> None:
    """With a threshold the estimates solve the linear problem of the factors at the points the smoother reports."""
    rng = np.random.default_rng(seed)
    smoother, x = smoother_with(Incremental(relinearize=0.05, wildfire=0.0), group)
    batch = Batch([group])
    moved = stayed = 0
    for k, statements in enumerate(drive(group, rng, 50)):
        state(smoother, x, statements)
        batch.statements += statements
        noise = group.exp(0.1 * rng.standard_normal(group.dim))
        start = group.identity() if k == 0 else group.compose(smoother.estimate(x[-1])[0], noise)
        effort = smoother.update({x: start})
        moved += effort.relinearized
        stayed += effort.eliminated < k + 1
        batch.values = [start] * (k + 1)
        batch.values = list(smoother.linearization_point(x))
        batch.step()
        assert np.abs(group.local(batch.stack(), smoother.estimate(x))).max() < 1e-8
    assert moved > 10 and stayed > 10  # or the test has shown nothing


def test_wildfire_leaves_small_changes_alone() -> None:
    rng = np.random.default_rng(0)
    estimates, work = [], []
    for wildfire in (0.0, 1e-3):
        smoother, x = smoother_with(Incremental(relinearize=0.05, wildfire=wildfire), fg.SE2)
        efforts = []
        for statements in drive(fg.SE2, np.random.default_rng(7), 80):
            state(smoother, x, statements)
            efforts.append(smoother.update({x: fg.SE2.random(rng) if len(x) == 0 else smoother.estimate(x[-1])[0]}))
        estimates.append(smoother.estimate(x))
        work.append(sum(effort.substituted for effort in efforts))
    assert work[1] < 0.8 * work[0]
    assert 0.0 < np.abs(fg.SE2.local(*estimates)).max() < 0.02


def test_the_best_estimate_is_that_of_complete_back_substitution() -> None:
    """However little is passed on from update to update, and without a trace in the smoother."""
    found = []
    for wildfire in (0.0, 0.2):
        smoother, x = smoother_with(Incremental(relinearize=np.inf, wildfire=wildfire), fg.SE2)
        for k, statements in enumerate(drive(fg.SE2, np.random.default_rng(7), 80)):
            state(smoother, x, statements)
            smoother.update({x: np.array([0.3 * k, 0.0, 0.02 * k])})
        found.append((smoother.estimate(x), smoother.estimate(x, best=True)))
        np.testing.assert_array_equal(smoother.estimate(x), found[-1][0])
        some = smoother.estimate(x[[70, 3, 3, 41]], best=True)
        np.testing.assert_allclose(some, found[-1][1][[70, 3, 3, 41]], rtol=0.0, atol=1e-14)
    (full, best), (rough, corrected) = found
    np.testing.assert_allclose(best, full, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(corrected, full, rtol=0.0, atol=1e-9)
    assert np.abs(rough - full).max() > 1e-6  # or the test has shown nothing


def test_what_is_missing_is_named_and_may_be_added_later() -> None:
    smoother, x = smoother_with(Incremental(), fg.SE2)
    smoother.minimize(fg.between, x[0], x[1], [1.0, 0.0, 0.0], sigma=0.1)
    with pytest.raises(GraphError, match=r"x\[1\] has no value"):
        smoother.update({x: np.zeros(3)})
    with pytest.raises(GraphError, match="is not determined by its factors") as caught:
        smoother.update({x: np.zeros((2, 3))})
    assert caught.value.family == "x" and caught.value.index in (0, 1)
    with pytest.raises(GraphError, match="last update failed"):
        smoother.covariance(x[0])
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=0.1)
    smoother.minimize(fg.between, x[1], x[2], [1.0, 0.0, 0.0], sigma=0.1)
    smoother.update({x: [2.0, 0.0, 0.0]})
    np.testing.assert_allclose(smoother.estimate(x), [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-9)
    assert len(smoother) == 3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda s, x, y, v: s.minimize(lambda p: p[:, :, None], x[0], sigma=1.0), r"returned shape \(1, 3, 1\)"),
        (lambda s, x, y, v: s.minimize(fg.prior, y[0], np.zeros(3), sigma=1.0), "belongs to another graph"),
        (lambda s, x, y, v: s.minimize(fg.between, x[0], v[0], np.zeros(3), sigma=1.0), "of between is SE2; found"),
        (lambda s, x, y, v: s.minimize(fg.prior, x[0], [np.nan, 0.0, 0.0], sigma=1.0), "not finite"),
        (
            lambda s, x, y, v: s.minimize(fg.prior, x[0], np.zeros(3), information=np.diag([1.0, 1.0, -1.0])),
            "negative eigenvalue",
        ),
        (lambda s, x, y, v: s.minimize(fg.prior, x[0], np.zeros(3), sigma=0.0), "sigma must be positive"),
        (lambda s, x, y, v: s.minimize(fg.prior, x[0], np.zeros(3), sigma=1.0, information=np.eye(3)), "not both"),
        (
            lambda s, x, y, v: s.minimize(fg.between, x[[0, 1]], x[[1, 2, 3]], np.zeros(3), sigma=1.0),
            "number of factors is unclear",
        ),
        (
            lambda s, x, y, v: s.minimize(fg.prior, x[0], np.zeros(3), sigma=1.0, robust=1.0),
            "robust= must be a loss such",
        ),
        (lambda s, x, y, v: s.minimize(fg.prior, x[0], np.zeros(3), sigma=1.0, robust=fg.Huber), "must be a loss such"),
        (lambda s, x, y, v: s.update({x: np.zeros(3)}, iterations=0), "iterations must be at least 1, found 0"),
        (lambda s, x, y, v: s.update({x: np.zeros(3)}, iterations=2.5), "iterations must be a whole number, found 2.5"),
        (lambda s, x, y, v: s.variables("x", fg.SE3), "exists already"),
        (lambda s, x, y, v: s.variables("z", 3), "needs a manifold such as fg.SE2"),
        (lambda s, x, y, v: s.variables("z", fg.Rn), "needs a manifold such as fg.SE2"),
        (lambda s, x, y, v: s.variables("z", fg.Product(count=fg.SO2)), "component 'count' of"),
        (lambda s, x, y, v: s.variables("z", fg.Product(keep=fg.SO2)), "z.keep means something else in a smoother"),
        (lambda s, x, y, v: s.variables(3, fg.SE2), "name of a family must be a text"),
        (lambda s, x, y, v: s.update([0.0, 0.0, 0.0]), "values are given by family, as"),
        (lambda s, x, y, v: s.covariance(), "of what"),
        (lambda s, x, y, v: s.update({x: [0.0, np.inf, 0.0]}), r"x\[0\].*not on SE2"),
        (lambda s, x, y, v: s.update({x: [0.0, 0.0]}), r"have shape \(2,\)"),
        (lambda s, x, y, v: s.update({y: np.zeros(3)}), "not a family of this smoother"),
        (lambda s, x, y, v: s.estimate(x[0]), "has no value yet"),
        (lambda s, x, y, v: Incremental(relinearize=-1.0), "must not be negative"),
    ],
)
def test_refusals_name_term_and_family(wrong: Callable[..., object], message: str) -> None:
    smoother, other = Incremental(), Incremental()
    x, v, y = smoother.variables("x", fg.SE2), smoother.variables("v", fg.Rn(2)), other.variables("y", fg.SE2)
    with pytest.raises(GraphError, match=message):
        wrong(smoother, x, y, v)
    assert len(x) == 0 and len(smoother) == 0


@pytest.mark.parametrize("seed", range(30))
def test_cliques_hold_what_they_must(seed: int) -> None:
    """Any order: every element lies in the clique of its first variable, every separator in the parent's clique."""
    rng = np.random.default_rng(seed)
    n, chronological = int(rng.integers(1, 40)), seed % 3 == 0
    elements = [
        rng.choice(n, size=min(n, int(rng.integers(1, 5))), replace=False) for _ in range(int(rng.integers(1, 90)))
    ]
    weight = rng.integers(1, 7, n)
    pool = np.concatenate(elements)
    pointer = np.cumsum([0, *map(len, elements)])
    given_order = rng.permutation(n) if chronological else np.zeros(0, dtype=np.int64)
    last = int(rng.integers(n))
    stage, alone = np.zeros(n, dtype=np.int64), np.full(n, chronological)
    stage[last], alone[last] = not chronological, True
    order, first, parent, passed, begin, size, lists = find_cliques(
        weight, stage, alone, given_order, False, pool, pointer
    )
    separator, bounds, home = find_separators(order, begin, size, lists, first, pool, pointer)
    assert sorted(order) == list(range(n)) and first[-1] == n
    if chronological:
        assert list(order) == list(given_order) and (np.diff(first) == 1).all()
    else:
        assert order[-1] == last and first[-1] - first[-2] == 1
    place = np.argsort(order)
    cliques = [set(order[first[k] : first[k + 1]]) for k in range(len(parent))]
    separators = [list(separator[bounds[k] : bounds[k + 1]]) for k in range(len(parent))]
    for e, element in enumerate(elements):
        assert element[np.argmin(place[element])] in cliques[home[e]]
        assert set(element) <= cliques[home[e]] | set(separators[home[e]])
    for k, members in enumerate(separators):
        assert passed[k] == weight[members].sum()
        assert (np.diff(place[members]) > 0).all() if len(members) else parent[k] == -1
        if members:
            assert members[0] in cliques[parent[k]] and parent[k] > k
            assert set(members) <= cliques[parent[k]] | set(separators[parent[k]])


@pytest.mark.product(1, of="large maps")
@pytest.mark.data
def test_manhattan_3500_pose_by_pose(shared_data: Path) -> None:
    """The optimum of the batch problem, 1/2 chi2 = 68.9574391, is reached on the way, not afterwards."""
    graph = read_g2o(shared_data / "pose_graphs" / "M3500.g2o.gz")
    smoother, x = smoother_with(Incremental(relinearize=0.01), fg.SE2)
    for k, (pose, edges) in enumerate(one_by_one(graph)):
        smoother.minimize(fg.prior, x[0], pose, sigma=1e-3) if k == 0 else smoother.minimize(
            fg.between, x[edges.first], x[edges.second], edges.measured, information=edges.information
        )
        smoother.update({x: pose if k == 0 else fg.SE2.compose(smoother.estimate(x[-1])[0], pose)})
    assert smoother.cost == pytest.approx(68.9574391, rel=1e-4)
    assert len(smoother) == len(graph.edges) + 1
    smoother.update(iterations=2)
    assert smoother.cost == pytest.approx(68.9574391, rel=1e-5)


def test_ill_conditioning_is_named_as_what_it_is() -> None:
    """First guesses that are 2.7 rad off, one after the other: all poses are determined, and the numbers are not."""
    smoother, x = smoother_with(fg.Incremental(), fg.SE2)
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=0.1)
    smoother.update({x: np.zeros(3)})
    with pytest.raises(fg.GraphError, match=r"^x\[\d+\] is determined by its factors, but lost to rounding: .*guesses"):
        for k in range(1, 1500):
            smoother.minimize(fg.between, x[k - 1], x[k], [1.0, 0.0, 0.01], sigma=0.1)
            smoother.update({x: fg.SE2.compose(smoother.estimate(x[-1])[0], np.array([1.0, 0.0, 2.7]))})


@pytest.mark.parametrize("kind", ["incremental", "fixed lag"])
@pytest.mark.parametrize("adrift", [1, 3])
def test_what_is_not_determined_is_still_named_so(adrift: int, kind: str) -> None:
    """Beside many poses that are: too few rows, and a loop of poses that nothing holds in place."""
    smoother: Any = fg.Incremental() if kind == "incremental" else fg.FixedLag(5)
    x, y = smoother.variables("x", fg.SE2), smoother.variables("y", fg.SE2)
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=0.1)
    smoother.update({x: np.zeros(3)})
    for k in range(1, 12):
        smoother.minimize(fg.between, x[k - 1], x[k], [1.0, 0.0, 0.1], sigma=0.1)
        smoother.update({x: fg.SE2.compose(smoother.estimate(x[-1])[0], np.array([1.0, 0.0, 0.1]))})
    for k in range(adrift):
        smoother.minimize(fg.between, y[k], y[(k + 1) % (adrift + 1)], [1.0, 0.0, 0.1], sigma=0.1)
    smoother.minimize(fg.between, y[adrift], y[0], [-adrift, 0.0, 0.0], sigma=0.1)
    with pytest.raises(fg.GraphError, match=r"^y\[\d\] is not determined by its factors"):
        smoother.update({y: np.zeros((adrift + 1, 3)) + np.arange(adrift + 1)[:, None] * [1.0, 0.0, 0.1]})


@pytest.mark.parametrize("information", [np.zeros((2, 2)), np.diag([1.0, 0.0])])
def test_rows_without_information_determine_nothing(information: np.ndarray) -> None:
    smoother = fg.Incremental()
    x = smoother.variables("x", fg.Rn(2))
    smoother.minimize(fg.prior, x[0], [1.0, 2.0], information=information)
    with pytest.raises(fg.GraphError, match=r"^x\[0\] is not determined by its factors"):
        smoother.update({x: np.zeros(2)})


@pytest.mark.parametrize("error", [lambda x: np.log(x - 5.0), lambda x: x * np.nan, np.sqrt])
@pytest.mark.parametrize("smoother", [fg.Incremental, lambda: fg.FixedLag(lag=3)])
def test_a_residual_that_is_not_finite_is_no_estimate(smoother: Any, error: Any) -> None:
    live, y = smoother_with(smoother(), fg.Rn(1), "y")
    live.minimize(fg.prior, y[0], [0.0], sigma=1.0)
    live.update({y: [0.0]})
    live.minimize(error, y[0], sigma=1.0)
    for _ in range(2):  # it stays so
        with pytest.raises(GraphError, match=r"y\[0\] cannot be found: a residual or its Jacobian is not finite"):
            live.update()
        with pytest.raises(GraphError, match="the last update failed"):
            live.covariance(y[0])
