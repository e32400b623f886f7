"""First guesses of graphs with landmarks: found where least squares from dead reckoning fails."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.files.g2o import read_g2o
from unifg.lie import Product
from unifg.models.odometry import driven, held
from unifg.pose_graphs import starts
from unifg.solvers import LevenbergMarquardt
from unifg.solvers.continuation import _planned
from unifg.typing import Array


def wheels(x: Array, y: Array, scale: Array, step: Array) -> Array:
    """Remainder of a step when its way and its turn are scaled."""
    scaled = np.stack([scale[:, 0] * step[:, 0], scale[:, 0] * step[:, 1], scale[:, 1] * step[:, 2]], axis=1)
    return np.asarray(fg.SE2.local(fg.SE2.compose(x, fg.SE2.exp(scaled)), y))


def seen(x: Array, mark: Array, long: Array, z: Array) -> Array:
    """Bearing and range, the latter too long by a constant."""
    d = fg.SE2.act(fg.SE2.inverse(x), mark)
    return np.stack(
        [fg.wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - z[:, 0]), np.hypot(d[:, 0], d[:, 1]) + long[:, 0] - z[:, 1]],
        axis=1,
    )


class Room:
    """Minutes among tubes, with wheels that say 5 % too little and turns that drift by tens of degrees."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        clock = np.arange(0.0, 300.0, 0.05)
        speed = np.column_stack([0.4 + 0.1 * np.sin(0.3 * clock), 0.25 + 0.2 * np.sin(0.11 * clock)])
        truth = held(clock, speed, clock)
        self.tubes = rng.uniform(-6.0, 6.0, (15, 2)) + truth[:, :2].mean(axis=0)
        truth = truth[::10]
        path = held(clock, speed / [1.05, 0.97] + rng.normal(0.0, [0.02, 0.05], speed.shape), clock[::10])
        local = fg.SE2.act(fg.SE2.inverse(truth)[:, None], self.tubes[None])
        bearing, far = np.arctan2(local[..., 1], local[..., 0]), np.linalg.norm(local, axis=2)
        node, mark = np.nonzero((np.abs(bearing) < 0.9) & (far < 5.0))
        z = np.column_stack([bearing[node, mark], far[node, mark] + 0.08])
        z += rng.normal(0.0, [0.02, 0.04], z.shape)
        known, mark = np.unique(mark, return_inverse=True)
        self.tubes = self.tubes[known]
        self.graph = graph = fg.Graph()
        self.marks, self.x = graph.variables("marks", fg.Rn(2), len(known)), graph.variables("x", fg.SE2, len(path))
        self.scale, self.long = graph.variables("scale", fg.Rn(2), 1), graph.variables("long", fg.Rn(1), 1)
        graph.fix(self.x[0], path[0])
        steps = fg.SE2.local(path[:-1], path[1:])
        self.used = graph.data("used", np.ones(len(node), dtype=bool))
        graph.minimize(wheels, self.x[:-1], self.x[1:], self.scale, steps, sigma=[0.02, 0.02, 0.03], name="wheels")
        graph.minimize(
            seen, self.x[node], self.marks[mark], self.long, z, sigma=[0.02, 0.04], active=self.used, name="seen"
        )
        _, first = np.unique(mark, return_index=True)
        polar = z[first, 1:] * np.column_stack([np.cos(z[first, 0]), np.sin(z[first, 0])])
        start = fg.SE2.act(path[node[first]], polar)
        self.guess: dict[fg.Family, Any] = {self.x: path, self.marks: start, self.scale: [[1, 1]], self.long: [[0]]}
        self.degrees = 3 * (len(path) - 1) + 2 * len(node) - graph.compile().size


@pytest.mark.product(1, of="large maps")
@pytest.mark.parametrize("seed", range(3))
def test_a_map_is_found_where_least_squares_from_dead_reckoning_fails(seed: int) -> None:
    room = Room(seed)
    solver = LevenbergMarquardt()
    assert 2.0 * solver.solve(room.graph, room.guess).cost > 10.0 * room.degrees
    solution = solver.solve(room.graph, fg.best_guess(room.graph, room.guess))
    assert solution.converged and 2.0 * solution.cost < 1.2 * room.degrees
    np.testing.assert_allclose(solution[room.scale], [[1.05, 0.97]], atol=0.01)
    np.testing.assert_allclose(solution[room.long], [[0.08]], atol=0.03)
    assert np.median(np.linalg.norm(solution[room.marks] - room.tubes, axis=1)) < 0.2


def test_data_and_flags_are_those_of_the_caller_and_the_graph_stays_as_it_was() -> None:
    room = Room(0)
    stated, edition = str(room.graph), room.graph.edition
    wrong = room.used.value.copy()
    wrong[::7] = False
    found = fg.best_guess(room.graph, room.guess, along=room.x, data={room.used: wrong})
    solution = LevenbergMarquardt().solve(room.graph, found, data={room.used: wrong})
    assert solution.converged and solution.cost < room.degrees
    assert (str(room.graph), room.graph.edition) == (stated, edition)
    np.testing.assert_array_equal(solution[room.x][0], room.guess[room.x][0])


def test_a_guess_that_is_the_best_comes_back() -> None:
    room = Room(1)
    solver = LevenbergMarquardt()
    best = solver.solve(room.graph, fg.best_guess(room.graph, room.guess))
    again = fg.best_guess(room.graph, best)
    program = room.graph.compile()
    assert program.evaluate(again.values).cost <= best.cost * (1.0 + 1e-12)


def ranges(seed: int) -> tuple[fg.Graph, dict[fg.Family, Array], int]:
    """Ranges to beacons whose places are unknown, from a curved way; the guess puts them beside its beginning."""
    rng = np.random.default_rng(seed)
    count = 400
    turns = 0.05 + 0.3 * np.sin(0.02 * np.arange(count) + rng.uniform(0, 6))
    moves = 0.5 * np.column_stack([np.ones(count), turns])
    truth = driven(moves)[1:]
    beacons = truth[:, :2].mean(axis=0) + rng.uniform(-25, 25, (6, 2))
    path = driven(moves + rng.normal(0.0, 0.03, moves.shape))[1:]
    which = rng.integers(0, 6, count)
    z = np.linalg.norm(truth[:, :2] - beacons[which], axis=1, keepdims=True) + rng.normal(0.0, 0.3, (count, 1))
    graph, x, b = graph_of(("x", fg.SE2, count), ("b", fg.Rn(2), 6))
    graph.fix(x[0], path[0])
    graph.minimize(fg.between, x[:-1], x[1:], fg.SE2.between(path[:-1], path[1:]), sigma=[0.05, 0.02, 0.03])
    graph.minimize(lambda x, p, z: np.linalg.norm(x[:, :2] - p, axis=1, keepdims=True) - z, x, b[which], z, sigma=0.3)
    return graph, {x: path, b: path[:6, :2] + rng.normal(0.0, 1.0, (6, 2))}, 4 * count


@pytest.mark.product(1, of="large maps")
def test_beacons_are_found_by_ranges_alone() -> None:
    """From the guess itself where that leads to the answer, as with seeds 1 and 4, and else along the trajectory."""
    solver, solved = LevenbergMarquardt(), []
    for seed in (1, 2, 4, 9):
        graph, guess, rows = ranges(seed)
        costs = [solver.solve(graph, start).cost for start in (guess, fg.best_guess(graph, guess))]
        solved.append([2.0 * cost < 1.5 * rows for cost in costs])
    assert solved == [[True, True], [False, True], [True, True], [False, True]]


def test_points_in_space_velocities_and_constraints() -> None:
    """Poses with velocities as one product, points in space, and a constraint that is none of its business."""
    rng, count = np.random.default_rng(2), 60
    state = Product(pose=fg.SE3, speed=fg.Rn(3))
    twist = np.tile([0.3, 0.0, 0.02, 0.0, 0.0, 0.15], (count - 1, 1))
    poses = [fg.SE3.identity()]
    for step in twist:
        poses.append(np.ravel(fg.SE3.retract(poses[-1], step)))
    truth = np.array(poses)
    points = truth[:, -3:].mean(axis=0) + rng.uniform(-3.0, 3.0, (20, 3))
    noisy = [truth[0]]
    for step in twist + rng.normal(0.0, [0.01] * 3 + [0.06] * 3, twist.shape):
        noisy.append(np.ravel(fg.SE3.retract(noisy[-1], step)))
    node, mark = np.nonzero(rng.random((count, 20)) < 0.2)
    z = fg.SE3.act(fg.SE3.inverse(truth[node]), points[mark]) + rng.normal(0.0, 0.02, (len(node), 3))
    graph, x, m, v = graph_of(("x", fg.SE3, count), ("m", fg.Rn(3), 20), ("v", state, 2))
    graph.fix(x[0], truth[0])
    graph.minimize(fg.prior, v, state.identity(), sigma=1.0, name="rest")
    odometry = fg.SE3.between(np.array(noisy)[:-1], np.array(noisy)[1:])
    graph.minimize(fg.between, x[:-1], x[1:], odometry, sigma=[0.02] * 3 + [0.06] * 3, name="odometry")
    graph.minimize(lambda p, x, z: fg.SE3.act(fg.SE3.inverse(x), p) - z, m[mark], x[node], z, sigma=0.02, name="seen")
    graph.bound(m, lower=-1e3, name="somewhere")
    _, first = np.unique(mark, return_index=True)
    start = fg.SE3.act(np.array(noisy)[node[first]], z[first])
    found = fg.best_guess(graph, {x: np.array(noisy), m: start, v: np.tile(state.identity(), (2, 1))})
    assert np.linalg.norm(found.values[m] - points, axis=1).max() < 0.1


def test_members_come_in_when_enough_says_where_they_are() -> None:
    """A point by ranges with the third one, and by what ties it to two poses with the later of them."""
    graph = fg.Graph()
    x, near = graph.variables("x", fg.SE2, 6), graph.variables("near", fg.Rn(2), 1)
    far, long = graph.variables("far", fg.Rn(2), 1), graph.variables("long", fg.Rn(1), 1)
    graph.minimize(fg.between, x[:-1], x[1:], np.zeros((5, 3)), name="steps")
    graph.minimize(
        lambda x, p, c: np.hypot(*(x[:, :2] - p).T)[:, None] + c, x[[4, 1, 3, 5]], near[[0] * 4], long, name="ranges"
    )
    graph.minimize(lambda x, y, p: x[:, :2] + y[:, :2] - p, x[5], x[2], far, name="amid")
    plan = _planned(graph, x)
    assert {family.name: when.tolist() for family, when in plan.members.items() if family is not x} == {
        "near": [4], "far": [5], "long": [5],
    }  # fmt: skip
    assert {name: when.tolist() for name, when in plan.factors.items()} == {
        "steps": [1, 2, 3, 4, 5], "ranges": [4, 4, 4, 5], "amid": [5],
    }  # fmt: skip
    assert plan.held == {long}


def test_no_chain_is_an_error_with_a_remedy() -> None:
    graph, x = drawn_to([0.0, 0.0], 3)
    with pytest.raises(fg.GraphError, match="along="):
        fg.best_guess(graph, {x: np.ones((3, 2))})


@pytest.mark.product(1, of="large maps")
@pytest.mark.data
def test_victoria_park_needs_no_robust_loss(shared_data: Path) -> None:
    path = shared_data / "landmarks" / "victoria_park.txt.gz"
    graph, x, guess = read_g2o(path).graph()
    solution = LevenbergMarquardt().solve(graph, fg.best_guess(graph, guess, along=x))
    assert solution.converged and 2.0 * solution.cost == pytest.approx(6184.12, abs=0.01)


def test_a_file_without_poses_begins_with_a_map_that_grows(tmp_path: Path) -> None:
    room = Room(0)
    path, turned = room.guess[room.x], fg.SE2.local(room.guess[room.x][:-1], room.guess[room.x][1:])
    lines = [
        f"ODOMETRY {k} {k + 1} {x:.9f} {y:.9f} {t:.9f} 0.0025 0 0 0.0025 0 0.01"
        for k, (x, y, t) in enumerate(fg.SE2.exp(turned).tolist())
    ]
    first = np.linalg.norm(path[:, None, :2] - room.tubes, axis=2)
    lines += [
        f"LANDMARK {k} {1000 + m} {x:.9f} {y:.9f} 0.01 0 0.01"
        for k, m in np.argwhere(first < 3.0).tolist()
        for x, y in [np.ravel(fg.SE2.act(fg.SE2.inverse(path[k : k + 1]), room.tubes[m : m + 1])).tolist()]
    ]
    file = tmp_path / "park.txt"
    file.write_text("\n".join(lines))
    unplaced = read_g2o(file)
    found = {start.name: start for start in starts(unplaced)}
    assert found["incremental"].chi2 < 1e-6 + min(start.chi2 for start in found.values())
    assert len(found["incremental"].landmarks) == len(unplaced.landmarks)
    placed = replace(unplaced, placed=True)
    assert "incremental" not in {start.name for start in starts(placed)}


def chain(at: Any = (0.0, 0.0, 0.0)) -> tuple[fg.Graph, fg.Family]:
    """Five poses, a metre apart."""
    graph, x = graph_with(fg.SE2, 5)
    graph.fix(x[0], at(graph) if callable(at) else at)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.0], sigma=0.1)
    return graph, x


def test_a_fixed_pose_has_the_place_that_data_give_it() -> None:
    graph, x = chain(lambda graph: graph.data("at", np.zeros(3)))
    handle = graph.fixes[0].data[0]
    found = fg.best_guess(graph, {x: np.zeros((5, 3))}, data={handle: [7.0, 1.0, 0.0]})
    np.testing.assert_allclose(found.values[x][:, 0], 7.0 + np.arange(5), atol=1e-6)


def test_soft_constraints_and_names_of_the_caller_are_no_obstacle() -> None:
    graph, x = chain()
    place = graph.data("x: place", np.zeros(3))
    graph.minimize(fg.prior, x[0], place, sigma=1.0, name="x: prior")
    graph.constrain(lambda p: p[:, :1], x, upper=2.0, soft=1e-3, name="wall")
    found = fg.best_guess(graph, {x: np.zeros((5, 3))})
    assert list(found.values) == [x]
    assert fg.solve(graph, found).converged
