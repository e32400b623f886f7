"""A fixed lag forgets factors, not what they knew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from dense import Batch, Model, drive, one_by_one, state
from problems.graphs import smoother_with
from unifg.errors import GraphError
from unifg.files.g2o import read_g2o
from unifg.smoothing import FixedLag, Incremental
from unifg.smoothing.priors import relinearize
from unifg.typing import Array, IntArray

ENDS = ("variable_end", "factor_end", "clique_end", "lists_end", "numbers_end")  # of tables and arenas


def within(statements: list[Model], k: int, lag: int) -> list[Model]:
    return [statement for statement in statements if min(statement[1]) > k - lag]


@pytest.mark.product(1)
@pytest.mark.parametrize("seed", range(4))
def test_linear_problems_lose_nothing(seed: int) -> None:
    """On Rn the window's estimates and covariance are those of a batch solve of the whole history."""
    rng, lag, group = np.random.default_rng(seed), 7, fg.Rn(3)
    smoother = FixedLag(lag, wildfire=0.0)
    x, batch = smoother.variables("x", group), Batch([group])
    for k, statements in enumerate(drive(group, rng, 60)):
        recent = within(statements, k, lag)
        state(smoother, x, recent)
        batch.statements += recent
        start = rng.standard_normal(3)
        smoother.update({x: start})
        batch.add(start)
        batch.step()
        window = smoother.window(x)
        assert list(window.indices) == list(range(max(0, k - lag + 1), k + 1))
        np.testing.assert_allclose(smoother.estimate(window), batch.stack()[window.indices], atol=1e-9)
    covariance = np.linalg.inv(batch.hessian()[0])[-3 * lag :, -3 * lag :]
    np.testing.assert_allclose(smoother.covariance(window), covariance, rtol=1e-8)


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3], ids=lambda g: g.name)
@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_lost_at_fixed_points(group: Any, seed: int) -> None:
    """Without relinearisation every problem is linear: the window agrees with incremental smoothing of everything."""
    rng, lag = np.random.default_rng(seed), 8
    smoother = FixedLag(lag, relinearize=np.inf, wildfire=0.0)
    whole = Incremental(relinearize=np.inf, wildfire=0.0)
    x, y = smoother.variables("x", group), whole.variables("x", group)
    for k, statements in enumerate(drive(group, rng, 60)):
        state(smoother, x, within(statements, k, lag))
        state(whole, y, within(statements, k, lag))
        noise = group.exp(0.1 * rng.standard_normal(group.dim))
        start = group.identity() if k == 0 else group.compose(smoother.estimate(x[-1])[0], noise)
        smoother.update({x: start})
        whole.update({y: start})
        window = smoother.window(x)
        assert np.abs(group.local(whole.estimate(y[window.indices]), smoother.estimate(window))).max() < 1e-9


@pytest.mark.parametrize("fixed_points", [False, True])
def test_a_loop_beyond_the_first_guess(fixed_points: bool) -> None:
    """Poor first guesses inside the window are mended by Gauss-Newton; what left it was known to a prior."""
    rng, lag, group = np.random.default_rng(0), 10, fg.SE2
    smoother = FixedLag(lag, relinearize=0.0, wildfire=0.0, fixed_points=fixed_points)
    x, batch = smoother.variables("x", group), Batch([group])
    for k, statements in enumerate(drive(group, rng, 40)):
        recent = within(statements, k, lag)
        state(smoother, x, recent)
        batch.statements += recent
        start = group.identity() if k == 0 else group.compose(smoother.estimate(x[-1])[0], group.random(rng))
        smoother.update({x: start}, iterations=6)
        batch.add(smoother.estimate(x[-1])[0])
    for _ in range(10):
        batch.step()
    # Not equal, because the past was linearised while less was known; close, because little was learned since.
    assert np.abs(group.local(batch.stack()[-lag:], smoother.estimate(x[-lag:]))).max() < 0.02


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3, fg.SO3], ids=lambda g: g.name)
def test_a_prior_is_rewritten_when_a_point_moves(group: Any) -> None:
    """H and g in steps from the new point are those of d(d') = Log(Exp(e) Exp(d')), differentiated numerically."""
    rng, d = np.random.default_rng(1), group.dim
    smoother, x = smoother_with(FixedLag(3), group)
    smoother.minimize(fg.prior, x[0], group.random(rng), sigma=0.5)
    for i, j in ((0, 1), (0, 2), (1, 2), (0, 3), (2, 3)):
        smoother.minimize(fg.between, x[i], x[j], group.random(rng), sigma=rng.uniform(0.2, 1.0, d))
    smoother.update({x: group.random(rng, (4,))})
    assert list(smoother.window(x).indices) == [1, 2, 3]
    state = smoother._state
    clique = state.cliques[np.flatnonzero(state.cliques["prior"])[0]]

    def prior() -> tuple[Array, Array]:
        size, stride = clique["size"], clique["stride"]
        rows = slice(int(clique["pivot_rows"]), int(size))
        block = state.numbers[clique["front"] : clique["front"] + size * stride].reshape(size, stride)
        upper = np.triu(block[rows, rows])
        return upper + np.triu(upper, 1).T, block[rows, size].copy()

    before, gradient = prior()
    row = int(x.rows(np.array([2]))[0])
    at = state.variables["value"][row] + state.variables["storage"][row]
    e = 0.4 * rng.standard_normal(d)
    state.numbers[at : at + d] = e
    relinearize(smoother._memory, row, np.zeros(200))
    h = 1e-6
    J = np.eye(3 * d)
    moved = [group.log(group.compose(group.exp(e), group.exp(s * h * np.eye(d)))) for s in (1.0, -1.0)]
    J[d : 2 * d, d : 2 * d] = (moved[0] - moved[1]).T / (2 * h)
    shift = np.concatenate([np.zeros(d), e, np.zeros(d)])
    after, expected = prior()[0], J.T @ before @ J
    np.testing.assert_allclose(after, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
    expected = J.T @ (gradient - before @ shift)
    np.testing.assert_allclose(prior()[1], expected, atol=1e-7 * np.abs(expected).max())
    assert (state.numbers[at : at + d] == 0.0).all()


def test_memory_and_tables_stay_as_they_are() -> None:
    rng = np.random.default_rng(0)
    smoother, x = smoother_with(FixedLag(6, late="drop"), fg.SE2)
    ends: list[IntArray] = []
    for k, statements in enumerate(drive(fg.SE2, rng, 900)):
        state(smoother, x, statements)
        smoother.update({x: np.zeros(3) if k == 0 else smoother.estimate(x[-1])[0]})
        if k in (450, 899):
            counters = smoother._state.counters
            ends.append(np.array([counters[end][0] for end in ENDS]))
    assert (ends[1] <= 1.2 * ends[0]).all()
    assert smoother.dropped > 100
    assert smoother.window(x).indices[0] == 894 and len(smoother) < 40


def test_kept_landmarks_collect_their_priors() -> None:
    """Poses come and go; what they knew of a landmark that stays adds up in one prior, exactly."""
    rng, group = np.random.default_rng(0), fg.Rn(2)
    smoother = FixedLag(3)
    x, point = smoother.variables("x", group), smoother.variables("l", group, keep=True)
    batch = Batch([group])
    batch.add(np.zeros(2))  # the landmark, then the poses
    for k in range(40):
        seen, fix = rng.standard_normal(2), rng.standard_normal(2)
        smoother.minimize(fg.between, x[k], point[0], seen, sigma=0.3)
        smoother.minimize(fg.prior, x[k], fix, sigma=0.5)
        batch.minimize(fg.between, [k + 1, 0], [seen], 0.3)
        batch.minimize(fg.prior, [k + 1], [fix], 0.5)
        batch.add(np.zeros(2))
        smoother.update({x: np.zeros(2), point: np.zeros(2)} if k == 0 else {x: np.zeros(2)})
    batch.step()
    np.testing.assert_allclose(smoother.estimate(point)[0], batch.values[0], atol=1e-10)
    np.testing.assert_allclose(smoother.estimate(x[-3:]), batch.stack()[-3:], atol=1e-10)
    assert smoother._state.counters["clique_end"][0] < 12  # priors were united, not piled up


def test_a_lag_in_seconds() -> None:
    smoother, x = smoother_with(FixedLag(seconds=1.0), fg.Rn(1))
    for k, time in enumerate([0.0, 0.3, 0.9, 1.0, 1.95, 4.0]):
        smoother.minimize(fg.prior, x[k], [float(k)], sigma=1.0)
        effort = smoother.update({x: [0.0]}, time=time)
        assert effort.marginalized == [0, 0, 0, 1, 2, 2][k]
    assert list(smoother.window(x).indices) == [5]
    smoother.minimize(fg.prior, x[6], [0.0], sigma=1.0)
    with pytest.raises(GraphError, match="needs time="):
        smoother.update({x: [0.0]})


def test_members_older_than_the_lag_are_refused_or_leave_at_once() -> None:
    """They were taken, and the next term on one of them was refused as on a member that had left, without a why."""
    for late in ("refuse", "drop"):
        smoother, x = smoother_with(FixedLag(seconds=2.0, late=late), fg.Rn(1))
        for k, time in enumerate([0.0, 3.0, 1.5]):  # the last is late, and in time
            smoother.minimize(fg.prior, x[k], [0.0], sigma=1.0)
            smoother.update({x: [0.0]}, time=time)
        smoother.minimize(fg.prior, x[3], [0.0], sigma=1.0)
        if late == "refuse":
            with pytest.raises(GraphError, match=r"time 0.1 is 2.9 s before the newest, 3: .* does time run backwards"):
                smoother.update({x: [0.0]}, time=0.1)
            with pytest.raises(GraphError, match="such members leave a lag of 2 s at once"):
                smoother.update({x: [0.0]}, time=1.0)
            smoother.update({x: [0.0]}, time=3.1)
            assert list(smoother.window(x).indices) == [1, 2, 3]
        else:
            smoother.update({x: [0.0]}, time=0.1)
            assert list(smoother.window(x).indices) == [1, 2]


def test_late_factors_are_refused_or_counted() -> None:
    for late in ("refuse", "drop"):
        smoother, x = smoother_with(FixedLag(2, late=late), fg.Rn(1))
        smoother.minimize(fg.prior, x[[0, 1, 2]], [0.0], sigma=1.0)
        smoother.update({x: np.zeros((3, 1))})
        smoother.minimize(fg.between, x[[0, 1, 2]], x[3], [1.0], sigma=1.0)
        if late == "refuse":
            with pytest.raises(GraphError, match=r"x\[0\] was marginalised"):
                smoother.update({x: [0.0]})
            assert len(x) == 3  # nothing happened, and the factor is forgotten
            smoother.minimize(fg.between, x[2], x[3], [1.0], sigma=1.0)
            smoother.update({x: [0.0]})
            assert smoother.estimate(x[3])[0, 0] == pytest.approx(1.0)
        else:
            smoother.update({x: [0.0]})
            assert smoother.dropped == 1
            assert smoother.estimate(x[3])[0, 0] == pytest.approx(1.0)
    with pytest.raises(GraphError, match="was marginalised"):
        smoother.estimate(x[0])
    for wrong in ({}, {"lag": 3, "seconds": 1.0}, {"lag": 0}, {"lag": 3, "late": "perhaps"}):
        with pytest.raises(GraphError, match="FixedLag"):
            FixedLag(**wrong)


def test_a_variable_may_be_older_than_the_newest() -> None:
    """Members of a second family that arrive late, with the age of their number, are eliminated in their turn."""
    rng, group = np.random.default_rng(0), fg.Rn(2)
    smoother = FixedLag(6)
    x, v = smoother.variables("x", group), smoother.variables("v", group)
    batch, rows = Batch([group]), {}
    for k in range(30):
        new = {x: np.zeros(2)}
        rows["x", k] = len(batch.values)
        batch.add(np.zeros(2))
        statements = [(fg.prior, [("x", k)], [rng.standard_normal(2)], 1.0)]
        if k:
            statements.append((fg.between, [("x", k - 1), ("x", k)], [rng.standard_normal(2)], 0.2))
        if k >= 3:  # three steps late
            new[v] = np.zeros(2)
            rows["v", k - 3] = len(batch.values)
            batch.add(np.zeros(2))
            statements.append((fg.between, [("x", k - 3), ("v", k - 3)], [rng.standard_normal(2)], 0.3))
            statements.append((fg.between, [("v", k - 3), ("x", k)], [rng.standard_normal(2)], 0.3))
        for function, names, parameters, sigma in statements:
            smoother.minimize(function, *[{"x": x, "v": v}[n][i] for n, i in names], *parameters, sigma=sigma)
            batch.minimize(function, [rows[name] for name in names], parameters, sigma)
        smoother.update(new)
    batch.step()
    for name, family in (("x", x), ("v", v)):
        for i in smoother.window(family).indices.tolist():
            np.testing.assert_allclose(smoother.estimate(family[i])[0], batch.values[rows[name, i]], atol=1e-10)
    assert list(smoother.window(v).indices) == [24, 25, 26]


@pytest.mark.product(1, of="large maps")
@pytest.mark.data
def test_manhattan_3500_in_a_window(shared_data: Path) -> None:
    """Relative poses inside the window agree with the optimum of the whole graph where the window saw its loops."""
    graph = read_g2o(shared_data / "pose_graphs" / "M3500.g2o.gz")
    smoother, x = smoother_with(FixedLag(50, late="drop"), fg.SE2)
    steps = []
    for k, (pose, edges) in enumerate(one_by_one(graph)):
        if k == 0:
            smoother.minimize(fg.prior, x[0], pose, sigma=1e-3)
        else:
            smoother.minimize(
                fg.between, x[edges.first], x[edges.second], edges.measured, information=edges.information
            )
        smoother.update({x: pose if k == 0 else fg.SE2.compose(smoother.estimate(x[-1])[0], pose)})
        if k % 50 == 49:
            steps.append(fg.SE2.between(*smoother.estimate(x[[k - 49, k]])))
    assert np.isfinite(steps).all() and smoother.dropped > 900
    assert np.abs(np.linalg.norm(np.array(steps)[:, :2], axis=1)).max() < 50.0  # poses are one metre apart


@pytest.mark.parametrize("fixed_points", [False, True])
def test_a_point_that_was_about_to_move_when_a_prior_touched_it(fixed_points: bool) -> None:
    """A step beyond the limit waits for the next update, by when the point is fixed: the whole history is linear."""
    rng, count = np.random.default_rng(0), 12
    window = FixedLag(3, fixed_points=fixed_points)
    x = window.variables("x", fg.Rn(1))
    information, right = np.zeros((count, count)), np.zeros(count)
    for k in range(count):
        seen = rng.normal()
        window.minimize(fg.prior, x[k], [seen], sigma=1.0)
        information[k, k] += 1.0
        right[k] += seen
        if k:
            window.minimize(fg.between, x[k - 1], x[k], [1.0], sigma=0.1)
            information[k - 1 : k + 1, k - 1 : k + 1] += 100.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
            right[k - 1 : k + 1] += [-100.0, 100.0]
        window.update({x: [float(k)]})
        whole = np.linalg.solve(information[: k + 1, : k + 1], right[: k + 1])
        inside = window.window(x)
        np.testing.assert_allclose(window.estimate(inside)[:, 0], whole[inside.indices], atol=1e-10)
