"""Layouts of the quadrotor scenarios keep their promises, and the test for a way is exact."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import label

from unifg.errors import ScenarioError
from unifg.scenarios.planning.passage import widest_way
from unifg.scenarios.simulation import layouts
from unifg.scenarios.simulation.layouts import (
    CORRIDOR_SEEDS,
    COURSE_SEEDS,
    TUNING_SEEDS,
    WAY_CLEARANCE,
    Layout,
    corridor,
    obstacle_course,
)
from unifg.typing import Array


@pytest.mark.parametrize("count", [0, 10, 25])
@pytest.mark.product(1, of="studies")
def test_corridors_keep_their_promises(count: int) -> None:
    for seed in range(20):
        layout = corridor(seed, count)
        x, y, radius = layout.cylinders.T
        assert layout.cylinders.shape == (count, 3)
        assert ((radius >= 0.3) & (radius <= 0.6)).all()
        assert ((x >= layout.start[0]) & (x <= layout.target[0])).all()
        assert (np.abs(y) + radius <= 4.0).all()
        for end in (layout.start, layout.target):
            assert (np.hypot(x - end[0], y - end[1]) - radius >= 1.5).all()
        assert grid_way(layout, WAY_CLEARANCE - 0.08, 0.1)


def test_corridor_measures() -> None:
    layout = corridor(3)
    lengths = np.linalg.norm(layout.walls[:, 1] - layout.walls[:, 0], axis=1)
    np.testing.assert_array_equal(lengths, [30.0, 30.0])
    np.testing.assert_array_equal(np.sort(layout.walls[:, :, 1].ravel()), [-4.0, -4.0, 4.0, 4.0])
    np.testing.assert_array_equal(layout.start, [1.0, 0.0, 1.5])
    np.testing.assert_array_equal(layout.target, [29.0, 0.0, 1.5])
    assert len(layout.corners) == 4


@pytest.mark.product(1, of="studies")
def test_corridor_radii_and_centres_are_uniform() -> None:
    every = np.concatenate([corridor(seed).cylinders for seed in range(100)])
    assert every[:, 2].mean() == pytest.approx(0.45, abs=0.01)
    assert every[:, 2].std() == pytest.approx(0.3 / math.sqrt(12.0), rel=0.05)
    assert every[:, 0].mean() == pytest.approx(15.0, abs=0.8)
    assert every[:, 1].mean() == pytest.approx(0.0, abs=0.25)
    assert every[:, 1].std() == pytest.approx(3.55 / math.sqrt(3.0), rel=0.05)


def test_crowded_corridors_are_drawn_again_until_a_way_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = []

    def judge(start: Array, target: Array, cylinders: Array, walls: Array) -> float:
        judged.append(widest_way(start, target, cylinders, walls))
        return judged[-1]

    monkeypatch.setattr(layouts, "widest_way", judge)
    for seed in range(20):
        judged.clear()
        corridor(seed, 50)
        assert judged[-1] >= WAY_CLEARANCE
        assert all(width < WAY_CLEARANCE for width in judged[:-1])
        if len(judged) > 1:
            return
    raise AssertionError("no corridor had to be drawn again: the test shows nothing")


def test_layouts_depend_on_the_seed_alone() -> None:
    """Frozen numbers: a change here changes every study."""
    np.testing.assert_array_equal(corridor(7).cylinders, corridor(7).cylinders)
    assert not np.array_equal(corridor(7).cylinders, corridor(8).cylinders)
    np.testing.assert_allclose(
        corridor(0).cylinders[0], (17.078336277788175, 0.13740195876382783, 0.48472888644072987), rtol=1e-12
    )
    np.testing.assert_allclose(obstacle_course(0).cylinders[0], (3.951001294214226, 2.046204050067634, 0.5), rtol=1e-12)
    wall = ((5.401625048542812, -2.2565680553866914), (7.907669306702189, 0.3279516632740924))
    np.testing.assert_allclose(obstacle_course(0).walls[0], wall, rtol=1e-12)
    assert (len(CORRIDOR_SEEDS), len(COURSE_SEEDS)) == (100, 200)
    assert not set(TUNING_SEEDS) & (set(CORRIDOR_SEEDS) | set(COURSE_SEEDS))


def test_obstacle_courses_leave_start_and_target_free() -> None:
    nominal = obstacle_course()
    assert nominal.walls.shape == (3, 2, 2) and nominal.cylinders.shape == (1, 3)
    assert nominal.widest_way() > 0.25
    lengths = np.linalg.norm(nominal.walls[:, 1] - nominal.walls[:, 0], axis=1)
    straight = np.linspace(nominal.start[:2], nominal.target[:2], 100)
    assert nominal.distance(straight).min() < 0.1  # the straight line is blocked
    for seed in COURSE_SEEDS:
        layout = obstacle_course(seed)
        assert layout.distance(np.stack([layout.start, layout.target])[:, :2]).min() >= 0.5
        np.testing.assert_allclose(np.linalg.norm(layout.walls[:, 1] - layout.walls[:, 0], axis=1), lengths)
        np.testing.assert_array_equal(layout.start, nominal.start)
        np.testing.assert_array_equal(layout.target, nominal.target)


def grid_way(layout: Layout, clearance: float, pitch: float = 0.05, margin: float = 0.0) -> bool:
    """Flood fill from start to target over the layout's ground: an independent judge, exact to the pitch."""
    low, high = layout.size + np.array([[-margin], [margin]])
    x, y = np.arange(low[0], high[0] + pitch, pitch), np.arange(low[1], high[1] + pitch, pitch)
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    free = (layout.distance(points.reshape(-1, 2)) >= clearance).reshape(points.shape[:2])
    begin, end = (tuple(np.rint((p[:2] - low) / pitch).astype(int)) for p in (layout.start, layout.target))
    labels, _ = label(free)
    return bool(free[begin] and free[end] and labels[begin] == labels[end])


@pytest.mark.product(1, of="studies")
def test_widest_way_agrees_with_a_flood_fill() -> None:
    """Ragged rings and crossing walls; a decision is asked well above and well below the bottleneck."""
    rng = np.random.default_rng(4)
    ends = np.array([[0.0, 0.0], [4.0, 0.5]])
    blocked = bottlenecks = 0
    for trial in range(20):
        count = 8 + 2 * (trial % 10)
        angles = np.arange(count) * 2.0 * np.pi / count + rng.uniform(-0.1, 0.1, count)
        ring = 1.6 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + rng.uniform(-0.2, 0.2, (count, 2))
        cylinders = np.column_stack([ring, rng.uniform(0.25, 0.6, count)])
        walls = rng.uniform(-2.5, 2.5, (3, 1, 2)) + rng.uniform(-1.5, 1.5, (3, 2, 2))
        layout = Layout(
            np.append(ends[0], 1.0), np.append(ends[1], 1.0), cylinders, walls, np.array([[-4.5, -4.5], [5.5, 4.5]])
        )
        width = layout.widest_way()
        free = float(layout.distance(np.stack([layout.start, layout.target])[:, :2]).min())
        assert width <= free
        blocked += width <= 0.0 < free
        bottlenecks += 0.0 < width < free - 0.01
        if width > 0.1:
            assert grid_way(layout, width - 0.06, 0.05, margin=1.5)
        if free > max(width, 0.0) + 0.07:
            assert not grid_way(layout, max(width, 0.0) + 0.06, 0.05, margin=1.5)
    assert blocked >= 2 and bottlenecks >= 10, (blocked, bottlenecks)


def test_widest_way_of_known_gaps() -> None:
    """A gate, a closed ring, a ring with one gap, and a ring beside both ends."""
    start, target, none = (0.0, 0.0), (10.0, 0.0), np.zeros((0, 3))
    assert widest_way(start, target, none, np.zeros((0, 2, 2))) == math.inf
    box = np.array([[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]])
    sides = np.stack([box, np.roll(box, -1, axis=0)], axis=1)
    assert widest_way(start, target, none, sides) == 0.0
    gate = np.concatenate([sides[[0, 2, 3]], [[[5.0, -5.0], [5.0, 1.0]], [[5.0, 1.5], [5.0, 5.0]]]])
    assert widest_way(start, target, none, gate) == pytest.approx(0.25)
    assert widest_way(start, (1.0, 3.0), none, sides) == pytest.approx(2.0)  # both inside: the target's own wall
    ring = np.array([[2.0 * math.cos(a), 2.0 * math.sin(a), 0.4] for a in np.linspace(0.0, 2.0 * np.pi, 9)[:-1]])
    gap = 4.0 * math.sin(np.pi / 8.0) - 0.8
    assert widest_way(start, target, ring, np.zeros((0, 2, 2))) == pytest.approx(0.5 * gap)
    assert widest_way((2.0, 0.0), target, ring, np.zeros((0, 2, 2))) == pytest.approx(-0.4)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"cylinders": np.zeros((2, 2))}, "cylinders must have shape"),
        ({"start": np.zeros(2)}, "start must have shape"),
        ({"target": np.array([0.0, np.nan, 0.0])}, "not finite"),
        ({"cylinders": np.array([[1.0, 1.0, 0.3], [3.0, 1.0, -0.1]])}, "cylinder 1 has radius"),
    ],
)
def test_bad_layouts_are_refused(change: dict[str, Array], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        replace(corridor(0), **change)  # type: ignore[arg-type]
