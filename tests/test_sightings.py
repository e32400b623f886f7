"""Obstacles that are seen with noise, plans that keep off by what is unsure, and a filter below a plan."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from unifg.models import barriers, quadrotor
from unifg.scenarios.planning.flat_path import Flown, Line
from unifg.scenarios.quadrotor.cascade import CascadeSettings, Track
from unifg.scenarios.quadrotor.cbf_mpc import CbfMpc, KeeperSettings, Obstacles, apart
from unifg.scenarios.quadrotor.sightings import Sightings, SightingSettings
from unifg.scenarios.safe_flight import SafeSettings, flights
from unifg.scenarios.simulation.body_rate import Airframe
from unifg.typing import Array

LINE = Line((-4.0, 0.0, 1.5), (4.0, 0.0, 1.5), 2.0, 1.5)
DOWN = np.array([0.0, 0.0, -quadrotor.GRAVITY])


def things(doubt: Array | None = None) -> Obstacles:
    """A pillar that goes along y, and a ball that falls."""
    place, velocity = np.array([[0.4, -0.3, 0.0], [0.0, 3.0, 2.0]]), np.array([[0.0, 0.2, 0.0], [0.0, 1.0, 3.0]])
    return Obstacles(place, velocity, np.array([0.75, 0.4]), np.array([True, False]), np.array([False, True]), doubt)


# ---------------------------------------------------------------- looks


@pytest.mark.parametrize("relative", [False, True])
def test_looks_are_weighed_as_dense_least_squares_weigh_them(relative: bool) -> None:
    """Place, velocity, and how far where they will be is to be believed; before and after the memory is full.

    The vehicle's own place is an unknown of the same problem: what it is beside where it is believed to be adds to the
    distance from what is seen in the world, and drops out of that from what is seen beside the vehicle.
    """
    rng, like, s = np.random.default_rng(0), things(), SightingSettings(noise=0.05, believed=0.04, looks=6, k=2.0)
    sightings, seen, times = Sightings(s, like, relative), [], []
    unsure, reach, turn = 0.02, np.array([1.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    for k in range(9):
        now, here = 0.03 * k, np.array([0.1 * k, 0.0, 1.0])
        fall = DOWN * like.falls[:, None]
        truth = like.position + now * like.velocity + 0.5 * now**2 * fall
        seen.append(truth + s.noise * rng.normal(size=(2, 3)))
        times.append(now)
        found = sightings.see(now, seen[-1] - here * relative, here, unsure)
        since = np.array(times[-s.looks :]) - now
        looks = np.stack([np.ones_like(since), since, -np.full_like(since, relative)], 1) / s.believed
        rows = np.concatenate([looks, [[0.0, 1.0 / s.fast, 0.0], [0.0, 0.0, 1.0 / unsure]]])
        spread = np.linalg.inv(rows.T @ rows)
        for j in range(2):
            looked = np.array([z[j] for z in seen[-s.looks :]]) - 0.5 * since[:, None] ** 2 * fall[j]
            expected = spread @ rows.T @ np.concatenate([looked / s.believed, np.zeros((2, 3))])
            np.testing.assert_allclose(np.stack([found.position[j], found.velocity[j]]), expected[:2], atol=1e-9)
        later = np.array([0.0, 0.1, 0.7])
        sigma = [np.sqrt(row @ spread @ row) for row in (reach + t * turn for t in later)]
        np.testing.assert_allclose(found.off(later), like.keep + s.k * np.array(sigma)[:, None], rtol=1e-7)
        alone = np.linalg.inv(rows[:, :2].T @ rows[:, :2])[0, 0]  # of the place, if the vehicle's were known
        assert sigma[0] ** 2 == pytest.approx(alone + (not relative) * unsure**2)
    np.testing.assert_allclose(found.velocity, like.velocity + now * fall, atol=2.0)


@pytest.mark.parametrize("j", range(2))
def test_what_is_unsure_is_what_the_barrier_of_that_name_takes_away(j: int) -> None:
    """With the root of the covariance of where something will be, the same along every axis."""
    doubt, places, t = np.array([[0.01, -0.02, 0.3], [0.0, 0.0, 0.0]]), np.array([[1.0, 0.5, 1.0]]), np.array([0.4])
    found = things(doubt).clearance(places, t)
    sigma = np.sqrt(doubt[:, 0] + t * doubt[:, 1] + t**2 * doubt[:, 2])
    flat = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    like = things()
    given = like.position[j : j + 1], like.velocity[j : j + 1], like.falls[j] * DOWN[None], like.keep[j : j + 1]
    h = barriers.uncertain(barriers.accelerated(apart, many=True), 1.0)
    expected = h(places, t, sigma[j] * np.eye(3), *given, flat[j : j + 1])
    assert found[0, j] == pytest.approx(expected[0, 0], abs=1e-12)


def test_those_that_are_not_there_are_sure() -> None:
    few = things(np.full((2, 3), 0.1)).nearest(np.zeros(3), 4)
    np.testing.assert_array_equal(few.doubts[2:], 0.0)
    np.testing.assert_array_equal(few.doubts[:2], 0.1)
    assert things().doubts.shape == (2, 3) and not things().doubts.any()


@pytest.mark.parametrize("knowledge", ["estimated", "books"])
def test_what_is_seen_from_the_vehicle_goes_where_it_is_believed_to_be(knowledge: Any) -> None:
    """Half a metre beside where it thinks it is, a vehicle sees things as far beside, unless in the world."""
    wrong = np.array([0.5, -0.2, 0.0])
    cases: tuple[tuple[Any, Array], ...] = ("relative", wrong), ("noisy", np.zeros(3))
    for sight, moved in cases:
        flight = flights(SafeSettings(case="static", sight=sight, knowledge=knowledge))[0]
        truth = flight.situation.bodies.at(np.zeros(1))[0][0, 0]
        believed = flight.plant.state + np.concatenate([wrong, np.zeros(7)])
        seen = flight.look_around(believed)
        np.testing.assert_allclose(seen.position[0] - truth, moved, atol=0.1)
        assert seen.doubts[0, 0] > (3.0 * 0.0199) ** 2


# ---------------------------------------------------------------- plans


def decided(doubt: float, **numbers: Any) -> tuple[CbfMpc, Array]:
    """A plan past a pillar that is seen as well as ``doubt`` says, k sigma [m] and per second; its places."""
    plans = CbfMpc(KeeperSettings(slots=1, alpha=3.0, **numbers), Airframe(), 0.01)
    start = np.array([-1.9, 0.05, 1.5, 1.0, 0.0, 0.0, 0.0, 1.5, 0.0, 0.0])
    steady = np.concatenate([start, np.zeros(6), [quadrotor.GRAVITY]])
    spread = np.array([[doubt**2, 0.0, doubt**2]])
    pillar = Obstacles(
        np.zeros((1, 3)), np.zeros((1, 3)), np.array([0.75]), np.array([True]), np.array([False]), spread
    )
    still = np.zeros((plans.settings.horizon, 3))
    plan = plans.decide(steady, LINE.at(2.0 + plans.nodes), pillar, 0.0, still).plan
    return plans, plan


def test_the_less_sure_the_farther_away() -> None:
    least = [np.linalg.norm(decided(doubt)[1][:, :2], axis=1).min() for doubt in (0.0, 0.1, 0.2, 0.3)]
    assert (np.diff(least) > 0.03).all(), least


def test_plans_may_have_to_end_at_rest() -> None:
    plans, _ = decided(0.0, terminal="rest")
    assert plans.states is not None and np.abs(plans.states[-1, 7:10]).max() < 1e-3
    plans, _ = decided(0.0)
    assert plans.states is not None and np.abs(plans.states[-1, 7:10]).max() > 0.3


# ---------------------------------------------------------------- a filter below


def test_a_track_is_the_plan_between_its_nodes() -> None:
    """With the velocities of the nodes, and the path where the plan has ended."""
    nodes = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0], [0.15, 0.0, 0.0, 2.0, 0.0, 0.0], [0.45, 0.1, 0.0, 4.0, 2.0, 0.0]])
    track, other = Track(3), Flown(*(np.full((1, 3), float(k)) for k in range(4)))
    assert track.due() and track.at(0.0, lambda t: other) is other
    track.lay(np.array([0.1, 0.2, 0.3]), nodes)
    assert [track.due() for _ in range(3)] == [False, False, True]
    for k in range(2):
        begin, end = (track.at(0.1 * (k + 1) + s, lambda t: other) for s in (0.0, 0.1 - 1e-12))
        np.testing.assert_allclose(np.concatenate([begin.position[0], begin.velocity[0]]), nodes[k], atol=1e-12)
        np.testing.assert_allclose(end.velocity[0], nodes[k + 1, 3:], atol=1e-9)
        np.testing.assert_allclose(end.position[0, 0], nodes[k + 1, 0], atol=1e-9)
        np.testing.assert_allclose(begin.acceleration[0], (nodes[k + 1, 3:] - nodes[k, 3:]) / 0.1)
    assert track.at(0.3, lambda t: other) is other


def past_the_pillar(seconds: float = 4.2, **settings: Any) -> Any:
    """A flight past the cylinder, cut short behind it."""
    flight = flights(SafeSettings(case="static", alpha=(3.0,), **settings))[0]
    flight.situation = replace(flight.situation, duration=seconds)
    return flight.run()


@pytest.mark.product(1, of="flights by sightings")
def test_a_filter_below_a_plan_that_sees_gets_past() -> None:
    """A plan at every fifth tick; one that does not see leads into the cylinder, and the filter stands before it."""
    sees, blind = (
        past_the_pillar(controller=("cascade",), cascade=CascadeSettings(5, barriers)) for barriers in (True, False)
    )
    assert sees.boundary.min() > 0.0 and sees.states[-1, 0] > 0.8
    assert not blind.touched and blind.states[-1, 0] < 0.0
    assert sees.statuses[2::5].count("last plan") == sees.statuses[3::5].count("last plan") == 84


@pytest.mark.product(1, of="flights by sightings")
def test_a_sigma_that_is_wrong_is_survived() -> None:
    """Looks four times as noisy as they are believed to be."""
    log = past_the_pillar(sight="noisy", sighting=SightingSettings(noise=0.04, believed=0.01))
    assert not log.touched and log.states[-1, 0] > 0.8
