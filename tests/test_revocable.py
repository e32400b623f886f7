"""Closures that may be wrong, in an incremental smoother: accepted, revoked, and taken back into the map."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import smoother_with
from unifg.errors import GraphError
from unifg.files.g2o import read_g2o
from unifg.pose_graphs import manhattan
from unifg.pose_graphs.pose_graph import Edges
from unifg.smoothing import Incremental
from unifg.smoothing.revocable import LEAST
from unifg.typing import Array, BoolArray

STEP, SIGMA = np.array([1.0, 0.0, 0.0]), np.array([0.05, 0.05, 0.02])
C = 4.0


def steps(edges: Edges) -> Iterator[tuple[int, Array, list[int]]]:
    """Pose, odometry that leads to it, and the closures that end there, in the order of time."""
    ends = np.maximum(edges.first, edges.second)
    for k in range(1, int(ends.max()) + 1):
        here = np.flatnonzero(ends == k)
        odometry = next(e for e in here.tolist() if edges.first[e] == k - 1 and edges.second[e] == k)
        yield k, edges.measured[odometry], [e for e in here.tolist() if e != odometry]


def with_wrong(edges: Edges, rng: np.random.Generator, groups: int, size: int) -> tuple[Edges, BoolArray]:
    """The edges and groups of wrong closures that agree with odometry among themselves; which are wrong."""
    count = int(edges.second.max()) + 1
    odometry = {k: measured for k, measured, _ in steps(edges)}
    first, second, measured = [], [], []
    for _ in range(groups):
        a = int(rng.integers(0, count - 3 * size - 20))
        b = int(rng.integers(a + 10 + size, count - size))
        behind, ahead = np.zeros(3), np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(-3.0, 3.0)])
        for k in range(size):
            first.append(a + k)
            second.append(b + k)
            measured.append(fg.SE2.compose(fg.SE2.inverse(behind), ahead))
            behind = fg.SE2.compose(behind, odometry[a + k + 1])
            ahead = fg.SE2.compose(ahead, odometry[min(b + k + 1, count - 1)])
    information = np.tile(np.diag(SIGMA**-2.0), (len(first), 1, 1))
    joined = Edges(
        np.append(edges.first, first), np.append(edges.second, second), np.vstack([edges.measured, measured]),
        np.concatenate([edges.information, information]),
    )  # fmt: skip
    return joined, np.arange(len(joined.first)) >= len(edges.first)


def driven(edges: Edges, closures: Any, revocable: float | None = C) -> Incremental:
    """Smoother that took in odometry and those closures; initial guesses follow the odometry."""
    smoother, x = smoother_with(Incremental(), fg.SE2)
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=1e-3)
    smoother.update({x: np.zeros(3)})
    for k, odometry, found in steps(edges):
        smoother.minimize(fg.between, x[k - 1], x[k], odometry, sigma=SIGMA)
        for e in found:
            if closures[e]:
                ends = x[int(edges.first[e])], x[int(edges.second[e])]
                smoother.minimize(
                    fg.between, *ends, edges.measured[e], information=edges.information[e], revocable=revocable
                )
        smoother.update({x: fg.SE2.compose(smoother.estimate(x[k - 1])[0], odometry)})
    return smoother


def told(smoother: Incremental, edges: Edges, wrong: BoolArray) -> tuple[int, int, int]:
    """Right closures accepted, right ones in all, and wrong ones accepted."""
    order = [e for _, _, found in steps(edges) for e in found]
    accepted = np.array([each.accepted for each in smoother.revocable])
    return int(accepted[~wrong[order]].sum()), int((~wrong[order]).sum()), int(accepted[wrong[order]].sum())


@pytest.mark.product(1)
@pytest.mark.parametrize(("groups", "size"), [(12, 1), (5, 4)])
@pytest.mark.parametrize("seed", [0, 1])
def test_wrong_closures_are_left_out_and_right_ones_are_not(groups: int, size: int, seed: int) -> None:
    """One by one, and in groups of four that agree with each other; the map is that of the right ones."""
    edges, wrong = with_wrong(manhattan(250, seed=seed).pose_graph.edges, np.random.default_rng(seed), groups, size)
    found, best = driven(edges, np.ones(len(wrong))), driven(edges, ~wrong, None)
    accepted, right, bad = told(found, edges, wrong)
    assert right > 30 and accepted == right and bad == 0
    x, y = found.families["x"], best.families["x"]
    assert np.abs(fg.SE2.local(best.estimate(y), found.estimate(x))).max() < 0.02
    assert found.cost == pytest.approx(best.cost, abs=0.5)


@pytest.mark.product(1, of="large maps")
@pytest.mark.data
@pytest.mark.parametrize("size", [1, 4])
def test_wrong_closures_of_a_city(shared_data: Path, size: int) -> None:
    whole = read_g2o(shared_data / "pose_graphs" / "M3500.g2o.gz").edges
    part = np.maximum(whole.first, whole.second) < 700
    edges = Edges(*(getattr(whole, name)[part] for name in ("first", "second", "measured", "information")))
    edges, wrong = with_wrong(edges, np.random.default_rng(5), 40 // size, size)
    accepted, right, bad = told(driven(edges, np.ones(len(wrong))), edges, wrong)
    assert accepted == right and bad == 0


# ------------------------------------------------------------------ decisions


def loop(length: int = 20) -> tuple[Incremental, Any]:
    """A smoother of a straight drive whose heading is worse than its way."""
    smoother, x = smoother_with(Incremental(), fg.SE2)
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=1e-3)
    for k in range(1, length):
        smoother.minimize(fg.between, x[k - 1], x[k], STEP, sigma=SIGMA)
    smoother.update({x: np.arange(float(length))[:, None] * STEP})
    return smoother, x


def closure(smoother: Incremental, x: Any, i: int, j: int, aside: float, **options: Any) -> None:
    """Measure pose j from pose i, off to the left."""
    where = np.array([float(j - i), aside, 0.0])
    smoother.minimize(fg.between, x[i], x[j], where, **{"sigma": SIGMA, "revocable": C, "name": "closure", **options})


def accepted(smoother: Incremental) -> list[bool]:
    return [each.accepted for each in smoother.revocable]


@pytest.mark.parametrize("aside", [0.5, 30.0])
def test_a_new_one_is_judged_by_the_covariance_of_its_prediction(aside: float) -> None:
    """At the end of a long way half a metre is little, and far beyond what one measurement has."""
    smoother, x = loop()
    closure(smoother, x, 0, 19, aside)
    smoother.update()
    (found,) = smoother.revocable
    assert found.name == "closure" and found.members == (("x", 0), ("x", 19))
    assert found.accepted == (aside < 1.0)
    if not found.accepted:
        assert found.squared > (aside / SIGMA[1] / 2.0) ** 2
        assert smoother.estimate(x[19])[0] == pytest.approx([19.0, 0.0, 0.0], abs=1e-4)
        free, _ = loop()
        assert smoother.covariance(x[19]) == pytest.approx(free.covariance(free.families["x"][19]), abs=1e-9)
    else:
        certain, y = loop()
        closure(certain, y, 0, 19, aside, revocable=None)
        certain.update(iterations=2)
        assert smoother.estimate(x[19])[0] == pytest.approx(certain.estimate(y[19])[0], abs=1e-3)


def test_one_that_the_rest_contradicts_later_is_taken_back() -> None:
    """Nothing speaks against it at first; its own residual stays small, for nothing else is at its end."""
    smoother, x = loop(40)
    closure(smoother, x, 0, 39, 3.0)
    smoother.update()
    assert accepted(smoother) == [True] and smoother.revocable[0].squared < 1.0
    for j in (10, 20, 30, 38):
        closure(smoother, x, 0, j, 0.0)
        smoother.update()
    assert accepted(smoother) == [False, True, True, True, True]
    assert smoother.estimate(x[39])[0, 1] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("aside", "last", "counts"), [(1.5, 24, True), (1.5, 28, False), (2.5, 24, False)])
def test_leverage_hides_no_contradiction(aside: float, last: int, counts: bool) -> None:
    """Odometry behind the right closures bears it all: no residual is large, and all fits without the first one."""
    smoother, x = loop(40)
    closure(smoother, x, 0, 39, aside)
    smoother.update()
    assert accepted(smoother) == [True]
    for j in range(3, last, 2):
        closure(smoother, x, 0, j, 0.0)
        smoother.update()
        assert max(each.squared for each in smoother.revocable if each.accepted) < 0.5 * C**2
    first, *others = accepted(smoother)
    assert first is counts and all(others)
    assert (2.0 * smoother.cost < 0.1) is not counts and 2.0 * smoother.cost < C**2


def test_two_that_agree_prevail_over_one_that_was_first() -> None:
    """One alone does not."""
    smoother, x = loop(40)
    closure(smoother, x, 0, 39, 4.0, sigma=SIGMA / 2.0)
    smoother.update()
    assert accepted(smoother) == [True]
    for j, expected in ((33, [True, False]), (31, [False, True, True])):
        closure(smoother, x, 0, j, 0.0, sigma=SIGMA / 2.0)
        smoother.update()
        assert accepted(smoother) == expected
    assert smoother.estimate(x[33])[0, 1] == pytest.approx(0.0, abs=0.1)


def test_one_comes_back_when_the_map_agrees_with_it() -> None:
    """A measurement that always counts speaks against it, until another one outvotes that."""
    smoother, x = loop(40)
    closure(smoother, x, 0, 39, 4.0)
    closure(smoother, x, 0, 38, 0.0, sigma=4.0 * SIGMA, revocable=None)
    smoother.update()
    assert accepted(smoother) == [False]
    for k in (38, 39):
        smoother.minimize(fg.prior, x[k], np.array([float(k), 4.0, 0.0]), sigma=SIGMA / 100.0)
    smoother.update(iterations=4)
    assert accepted(smoother) == [True]


def test_what_is_stated_as_always_counting_is_as_it_was() -> None:
    """The arrays of a smoother without revocable factors are the same bits."""
    edges = manhattan(60, seed=3).pose_graph.edges
    plain, other = driven(edges, np.ones(len(edges.first)), None), driven(edges, np.ones(len(edges.first)), None)
    assert not plain.revocable and np.array_equal(
        plain.estimate(plain.families["x"]), other.estimate(other.families["x"])
    )


def test_one_that_came_with_a_failing_update_is_judged_by_the_next() -> None:
    smoother, x = smoother_with(Incremental(), fg.SE2)
    smoother.minimize(fg.between, x[0], x[1], STEP, sigma=SIGMA)
    smoother.minimize(fg.between, x[0], x[1], STEP + 0.05, sigma=SIGMA, revocable=C)
    with pytest.raises(GraphError, match="not determined"):
        smoother.update({x: [np.zeros(3), STEP]})
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=0.01)
    smoother.update()
    assert accepted(smoother) == [True]


def test_a_trial_that_cannot_be_solved_is_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two closures far off are tried together; when that raises, the map is as it was."""
    smoother, x = loop(40)
    for j in (39, 38):
        closure(smoother, x, 0, j, 0.0)
    smoother.update()
    closure(smoother, x, 0, 37, 30.0)
    smoother.update()
    place, solve, calls = smoother.estimate(x[39]), Incremental._solve, []

    def failing(self: Incremental) -> None:
        solve(self)
        calls.append(1)
        if len(calls) == 2:  # the update itself is the first
            raise GraphError("x[3] is determined by its factors, but lost to rounding")

    monkeypatch.setattr(Incremental, "_solve", failing)
    closure(smoother, x, 0, 36, 30.0)
    smoother.update()
    assert len(calls) > 2 and accepted(smoother) == [True, True, False, False]
    assert smoother.estimate(x[39]) == pytest.approx(place, abs=5e-3)  # where it is linear has moved


def test_a_copy_goes_on() -> None:
    smoother, x = loop()
    closure(smoother, x, 0, 19, 30.0)
    smoother.update()
    copy = pickle.loads(pickle.dumps(smoother))
    y = copy.families["x"]
    for each, variable in ((smoother, x), (copy, y)):
        closure(each, variable, 0, 18, 0.1)
        each.update()
    assert accepted(copy) == accepted(smoother) == [False, True]
    assert np.array_equal(copy.estimate(y), smoother.estimate(x))


def test_several_in_one_statement_and_of_one_family_each() -> None:
    smoother, x = loop()
    where = np.array([[19.0, 30.0, 0.0], [18.0, 0.1, 0.0]])
    smoother.minimize(fg.between, x[[0, 0]], x[[19, 18]], where, sigma=SIGMA, revocable=C)
    smoother.minimize(fg.prior, x[10], np.array([10.0, 40.0, 0.0]), sigma=0.1, revocable=C)
    smoother.update()
    assert accepted(smoother) == [False, True, False]
    assert smoother.revocable[2].members == (("x", 10),)


def looped(x: Array, y: Array) -> Array:
    """Residual that no trace can follow."""
    return np.array([[float(a[0]) - float(b[0])] for a, b in zip(x, y, strict=True)])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"revocable": 0.0}, "revocable must be positive, found 0.0"),
        ({"revocable": np.inf}, "positive and finite"),
        ({"revocable": [3.0, 4.0]}, r"term 'closure': revocable must be a number, found \[3.0, 4.0\]"),
        ({"revocable": True}, "term 'closure': revocable must be a number, found True"),
        ({"robust": fg.Huber(1.0)}, "leave robust out"),
        ({"function": looped}, "term 'odd': a revocable factor needs a function that can be traced"),
    ],
)
def test_what_cannot_be_revoked_is_refused(options: dict[str, Any], said: str) -> None:
    smoother, x = loop()
    function, count = options.pop("function", None), len(smoother)
    with pytest.raises(GraphError, match=said):
        if function is None:
            closure(smoother, x, 0, 19, 0.0, **options)
        else:
            smoother.minimize(function, x[0], x[19], revocable=C, name="odd")
    smoother.update()
    assert not smoother.revocable and len(smoother) == count and LEAST < 1e-9


@pytest.mark.parametrize("order", [1, -1])
def test_right_closures_beside_a_wrong_one_come_back(order: int) -> None:
    """Stated at once, a right and a wrong one side by side are revoked together, and the right one comes back."""
    city, p = smoother_with(Incremental(), fg.SE2)
    city.minimize(fg.prior, p[0], np.zeros(3), sigma=1e-3)
    for k in range(39):
        city.minimize(fg.between, p[k], p[k + 1], STEP, sigma=SIGMA)
    city.update({p: np.arange(40.0)[:, None] * STEP})
    measured = np.array([[39.0, 3.0, 0.0], [10.0, 0.0, 0.0], [20.0, 0.0, 0.0], [30.0, 0.0, 0.0], [38.0, 0.0, 0.0]])
    measured = measured[::order]
    ends = measured[:, 0].astype(int)
    city.minimize(fg.between, p[np.zeros(5, int)], p[ends], measured, sigma=SIGMA, revocable=C)
    city.update()
    assert [each.accepted for each in city.revocable] == (measured[:, 1] == 0.0).tolist()


def test_what_was_left_out_because_of_another_is_looked_at_again_without_it() -> None:
    """Of 13 squared deviations at the estimates, but of one by its innovation: the best of all sets has it."""
    rng, count = np.random.default_rng(5), 20
    truth = np.zeros((count, 3))
    for k in range(1, count):
        truth[k] = fg.SE2.compose(truth[k - 1], [1.0, 0.0, 0.3])
    moved = fg.SE2.retract(fg.SE2.between(truth[:-1], truth[1:]), SIGMA * rng.normal(size=(count - 1, 3)))
    first, second = rng.integers(0, 10, 6), rng.integers(10, count, 6)
    seen = fg.SE2.retract(fg.SE2.between(truth[first], truth[second]), SIGMA * rng.normal(size=(6, 3)))
    wrong = rng.random(6) < 0.5
    aside = rng.normal(size=(int(wrong.sum()), 3)) * np.array([3.0, 3.0, 0.7])
    seen[wrong] = fg.SE2.retract(seen[wrong], aside)
    smoother, x = smoother_with(Incremental(), fg.SE2)
    smoother.minimize(fg.prior, x[0], truth[0], sigma=0.001)
    smoother.update({x: truth[0]})
    order = []
    for k in range(1, count):
        smoother.minimize(fg.between, x[k - 1], x[k], moved[k - 1], sigma=SIGMA)
        smoother.update({x: fg.SE2.compose(smoother.estimate(x[k - 1])[0], moved[k - 1])})
        for j in np.flatnonzero(second == k).tolist():
            ends = x[int(first[j])], x[int(second[j])]
            smoother.minimize(fg.between, *ends, seen[j], sigma=SIGMA, revocable=3.4)
            smoother.update()
            order.append(j)
    np.testing.assert_array_equal([each.accepted for each in smoother.revocable], ~wrong[order])
