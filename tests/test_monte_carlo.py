"""The adaptive Monte Carlo localiser: it tracks, finds itself, grows and shrinks, leaves out what no map explains."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from maps import field, walled
from unifg.files.ros_map import OccupancyMap
from unifg.lie import wrap_angle
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.perception.monte_carlo import MonteCarlo, MonteCarloSettings, needed
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.simulation.plane import LidarModel, World
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

SIGMA = np.array([0.1, 0.1, 0.05])
START = np.array([1.5, 1.5, 0.0])
OWN = MonteCarloSettings(beams=40)


@functools.cache
def flat() -> tuple[OccupancyMap, DistanceMap]:
    """A room of 6 m by 4 m that looks like itself from no other side."""
    occupancy = walled(6.2, 4.2, 2, (-0.1, -0.1, 0.0), "flat", [np.s_[60:, 30:36], np.s_[10:20, 90:110]])
    return occupancy, field(occupancy)


def localiser(own: MonteCarloSettings = OWN, pose: Array = START, seed: int = 0) -> MonteCarlo:
    return MonteCarlo(*flat(), pose, SIGMA, np.random.default_rng(seed), own)


def drive(own: MonteCarlo, ticks: int, obstacles: tuple[Obstacle, ...] = ()) -> tuple[Array, World]:
    """Errors (ticks, 2) [m, rad] on a circle."""
    world = World(flat()[0], START, obstacles, np.random.default_rng(3), lidar=LidarModel(beams=60))
    errors, odometry = [], None
    for _ in range(ticks):
        own.update(world.scan(), odometry, 0.1)
        apart = own.pose - world.pose
        errors.append([np.hypot(*apart[:2]), abs(float(wrap_angle(apart[2])))])
        world.step(0.5, 0.5)
        odometry = np.array(world.odometry())
    return np.array(errors), world


def test_it_tracks_a_robot_from_a_wrong_start() -> None:
    own = localiser(pose=np.array([1.65, 1.35, 0.08]))
    errors, _ = drive(own, 60)
    assert errors[30:, 0].mean() < 0.05 and errors[30:, 1].mean() < 0.03
    assert own.iterations == 500, "sure of itself, it needs no more than the least"
    assert np.linalg.eigvalsh(own.covariance).min() > 0.0


def test_what_it_draws_is_decided_by_its_generator() -> None:
    first, again, other = (drive(localiser(seed=seed), 5)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_between_updates_the_wheels_carry_the_estimate() -> None:
    own = localiser()
    _, world = drive(own, 1)
    particles, before = own.particles.copy(), own.pose.copy()
    u = np.array([0.5, 0.4])
    own.update(world.scan(), u, 0.1)
    assert np.array_equal(own.particles, particles)
    assert np.allclose(own.pose, unicycle.step(before[None], u[None], 0.1)[0])
    for _ in range(5):  # 0.3 m by now
        own.update(world.scan(), u, 0.1)
    assert not np.array_equal(own.particles, particles)


def test_from_everywhere_it_finds_itself_with_many_particles_first() -> None:
    own = localiser(replace(OWN, particles=(500, 4000)))
    own.everywhere()
    free = flat()[1].distance(own.particles[:, :2])
    assert free.min() > -0.03 and len(own.particles) == 4000
    own.update(Scan(np.array([0.0]), np.array([1.0])), None, 0.1)
    assert own.iterations > 2000, "having seen next to nothing, it is everywhere still"
    world = World(flat()[0], START, (), np.random.default_rng(3), lidar=LidarModel(beams=60))
    odometry = None
    for _ in range(50):
        own.update(world.scan(), odometry, 0.1)
        world.step(0.5, 0.5)
        odometry = np.array(world.odometry())
    own.update(world.scan(), odometry, 0.1)
    assert np.hypot(*(own.pose - world.pose)[:2]) < 0.1
    assert own.iterations == 500


@pytest.mark.product(1, of="studies")
def test_a_kidnapped_robot_is_found_only_with_particles_drawn_anywhere() -> None:
    elsewhere = np.array([4.5, 2.8, 2.0])
    errors = {}
    for slow, fast in ((0.0, 0.0), (0.05, 0.5)):
        own = localiser(replace(OWN, slow=slow, fast=fast, particles=(1500, 4000)))
        drive(own, 20)
        world = World(flat()[0], elsewhere, (), np.random.default_rng(5), lidar=LidarModel(beams=60))
        odometry = np.zeros(2)
        for _ in range(80):
            own.update(world.scan(), odometry, 0.1)
            world.step(0.3, 0.6)
            odometry = np.array(world.odometry())
        own.update(world.scan(), odometry, 0.1)
        errors[fast] = np.hypot(*(own.pose - world.pose)[:2])
    assert errors[0.0] > 0.3 and errors[0.5] < 0.15


def test_beams_that_no_particle_explains_are_left_out() -> None:
    own = localiser()
    distance = np.zeros((500, 10))
    distance[:, 3] = 1.0
    distance[:400, 4] = 0.6  # one particle in five explains it
    assert own._counted(distance).tolist() == [k not in (3, 4) for k in range(10)]
    assert own._counted(np.ones((500, 10))).all(), "a map that explains nothing is no reason to see nothing"
    own.particles = own.particles + 2.0 * np.random.default_rng(0).standard_normal(own.particles.shape)
    assert own._counted(distance).all(), "a cloud that is not gathered cannot judge"


@pytest.mark.parametrize(("cells", "count"), [(0, 2000), (1, 2000), (2, 500), (50, 749), (1000, 2000)])
def test_particles_grow_with_the_cells(cells: int, count: int) -> None:
    """Fox's bound at 0.99 and 0.05; chi-square quantile 74.92 of 49 degrees of freedom, over 2 times 0.05: 749."""
    assert needed(cells, MonteCarloSettings()) == pytest.approx(count, abs=2)


def test_a_scan_without_returns_changes_nothing() -> None:
    own = localiser()
    particles = own.particles
    own.update(Scan(np.linspace(-3.0, 3.0, 20), np.full(20, np.inf)), np.array([5.0, 0.0]), 0.1)
    assert own.particles is particles
    assert np.hypot(*(own.pose - START)[:2] - [0.5, 0.0]) < 0.05, "but the wheels have turned"
