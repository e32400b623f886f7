"""Choice of the controller's way of avoidance, and the terms it states for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from episodes import room
from maps import field
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.scenarios.ground.drive_control import Controller
from unifg.scenarios.ground.drive_parts import disc_limits, predicted, wall_limits
from unifg.scenarios.ground.drive_settings import AVOIDANCES, ControllerSettings, backend
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array

PLAIN = ControllerSettings()
PLACE = np.array([1.5, 1.0, 0.0])
NONE = np.zeros((2, 2))


@pytest.fixture(scope="module")
def flat() -> DistanceMap:
    return field(room())


def standing(x: float, y: float, radius: float) -> Tracks:
    """One disc that has never moved."""
    still = Tracks.of_movers(np.array([[x, y]]), np.zeros((1, 2)), np.array([radius]))
    return replace(still, mover=np.array([False]))


def ahead(settings: ControllerSettings) -> Array:
    """A straight reference."""
    way = settings.stations
    return np.column_stack([PLACE[0] + way, np.full(len(way), PLACE[1]), np.zeros(len(way))])


def names(controller: Controller) -> dict[str, str]:
    """Terms by name, and their kind."""
    return {found.term.name: type(found.term).__name__ for found in controller.loop.warm.program.terms}


@pytest.mark.parametrize("avoidance", AVOIDANCES)
def test_only_clearance_and_barrier_are_constraints(flat: DistanceMap, avoidance: str) -> None:
    found = names(Controller(flat, "ipm", replace(PLAIN, avoidance=avoidance)))
    constrained = avoidance in ("clearance", "barrier")
    assert (found["walls"] == "Constraint") is (found["discs"] == "Constraint") is constrained
    assert ("wall margin" in found) is constrained


def test_a_barrier_lets_the_gap_to_what_stands_shrink_at_a_rate(flat: DistanceMap) -> None:
    seen, rest = standing(3.0, 1.0, 0.2), np.tile(PLACE, (PLAIN.horizon + 1, 1))
    limits = {}
    for avoidance in ("clearance", "barrier"):
        s = replace(PLAIN, avoidance=avoidance)
        limits[avoidance] = disc_limits(s, PLACE, predicted(s, PLACE, seen), seen, rest, NONE)[:, 0, 0]
    least = PLAIN.robot_radius + PLAIN.disc_clearance
    assert np.allclose(limits["clearance"], least)
    spare = 1.5 - 0.2 - least
    stages = PLAIN.dt * np.arange(1, PLAIN.horizon + 1)
    assert np.allclose(limits["barrier"], least + spare * np.exp(-PLAIN.approach * stages))


def test_a_barrier_holds_for_walls_too(flat: DistanceMap) -> None:
    field, rest = SmoothField(flat), np.tile(PLACE, (PLAIN.horizon + 1, 1))
    plain, barrier = (
        wall_limits(s, field, rest, ahead(s), NONE)[:, 0] for s in (PLAIN, replace(PLAIN, avoidance="barrier"))
    )
    least, here = PLAIN.robot_radius + PLAIN.wall_clearance, float(field.distance(PLACE[None, :2])[0])
    assert np.allclose(plain, least)
    assert barrier[0] == pytest.approx(least + 0.88 * (here - least)) and np.all(np.diff(barrier) < 0.0)
    near = np.tile([-0.6, 1.0, 0.0], (PLAIN.horizon + 1, 1))  # where no barrier is left to shrink
    assert (wall_limits(replace(PLAIN, avoidance="barrier"), field, near, ahead(PLAIN), NONE) <= least).all()


def test_only_the_vortex_searches_with_a_tangent_vector() -> None:
    searching = {name: backend("ipm", replace(PLAIN, avoidance=name)).search_iterations for name in AVOIDANCES}
    assert searching.pop("vortex") > 0 and not any(searching.values())


@pytest.mark.parametrize("avoidance", AVOIDANCES)
def test_every_way_leads_around_a_disc_beside_the_path(flat: DistanceMap, avoidance: str) -> None:
    s = replace(PLAIN, avoidance=avoidance)
    controller, seen = Controller(flat, "ipm", s), standing(3.0, 0.8, 0.2)
    plan = controller.plan(PLACE, ahead(s), seen)
    room_left = np.hypot(*(plan.states[:, :2] - seen.centre[0]).T) - 0.2 - s.robot_radius
    assert plan.source == "solved" and room_left.min() > 0.02
    far = controller.plan(PLACE, ahead(s), standing(3.0, 4.5, 0.2))
    assert np.abs(far.states[:, 1] - plan.states[:, 1]).max() > 0.05, "it is the disc that made the difference"
