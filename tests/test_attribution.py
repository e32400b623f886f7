"""Causes of contacts: staged drives whose cause is known, and made-up logs at the edge of each decision."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pymunk
import pytest

from episodes import episode
from maps import walled
from unifg.files.ros_map import OccupancyMap, save_map
from unifg.scenarios.commands.drives import summary
from unifg.scenarios.ground.drive_signals import RAMPS
from unifg.scenarios.ground.local_planner import PlannerContext, Situation
from unifg.scenarios.ground.protocols import LocaliserContext
from unifg.scenarios.ground.route import Route
from unifg.scenarios.logs.assumptions import BREAKS, FAULT, judged
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.monitoring.supervisor import Ramp, Supervisor
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.scenes.drive_scene import drive_scene
from unifg.scenarios.simulation.drivetrain import Drivetrain
from unifg.scenarios.simulation.plane import World
from unifg.scenarios.simulation.space import Mover, Obstacle, Space
from unifg.typing import Array

HALL = walled(9.0, 3.0, wall=2)
START, GOAL = (1.0, 1.5, 0.0), (7.5, 1.5, 1.57)  # passed by a robot that drives on
LATER = {"start": (4.5, 1.5, 0.0), "believed": (4.5, 1.5, 0.0)}


class Dashes:
    """Stands, and at a time dashes at the vehicle with a speed."""

    def __init__(self, begin: float, speed: float) -> None:
        self.begin, self.speed = begin, speed

    def velocity(self, mover: Mover, space: Space, dt: float) -> tuple[float, float]:
        if space.time < self.begin:
            return 0.0, 0.0
        way = (space.vehicle.position - mover.body.position).normalized() * self.speed
        return float(way.x), float(way.y)


def with_mover(place: tuple[float, float], begin: float, speed: float) -> type:
    """World with a disc that dashes."""

    class Dashing(World):
        def __init__(self, *args: Any, people: Any = (), **more: Any) -> None:
            super().__init__(*args, people=[*people, Mover(np.array(place), 0.2, Dashes(begin, speed))], **more)

    return Dashing


class Glass(World):
    """A wall across the hall that neither beams nor the map show."""

    def __init__(self, occupancy: OccupancyMap, *args: Any, **more: Any) -> None:
        occupied = occupancy.occupied.copy()
        occupied[2:-2, 80:82] = True
        super().__init__(replace(occupancy, occupied=occupied, free=~occupied), *args, **more)
        for shape in self.engine.shapes:
            if isinstance(shape, pymunk.Poly) and 3.9 < shape.bb.center().x < 4.2:
                shape.filter = pymunk.ShapeFilter(categories=1)  # as queries pass the vehicle


class Runaway(World):
    """Brakes and motors that do not obey after two seconds."""

    def step(self, *control: float, dt: float = 0.1) -> None:
        super().step(*((1.0, 0.0) if self.time > 2.0 else control), dt=dt)

    def power(self, on: bool) -> None:
        """The relay is stuck, too."""


class Pillar(World):
    """A disc in the way that rests."""

    def __init__(self, occupancy: OccupancyMap, start: Array, discs: Any, *args: Any, **more: Any) -> None:
        super().__init__(occupancy, start, [Obstacle(np.array([4.0, 1.5]), 0.2)], *args, **more)


class Onward:
    """Planner that drives on whatever is there."""

    speed = 0.8

    def __init__(self, context: PlannerContext) -> None:
        pass

    def control(self, now: Situation) -> list[float]:
        return [self.speed, 0.0]


class Follows(Onward):
    """Planner that follows its route past whatever is there."""

    def control(self, now: Situation) -> list[float]:
        ahead = now.reference[6, :2] - now.pose[:2]
        turn = float(np.arctan2(ahead[1], ahead[0]) - now.pose[2])
        return [self.speed * max(np.cos(turn), 0.0), 2.0 * turn]


class Waits(Onward):
    """Planner that stays."""

    speed = 0.0


class Wheels:
    """Localiser that believes the wheels to a centimetre."""

    refused, iterations = "", 0

    def __init__(self, context: LocaliserContext) -> None:
        self.base = context.base
        self.reset(context.pose, context.sigma)

    def reset(self, pose: Array, sigma: Array) -> None:
        self.pose, self.covariance = np.array(pose), 1e-4 * np.eye(3)

    def update(self, scan: Scan | None, odometry: Array | None, dt: float) -> None:
        if odometry is not None:
            self.pose = self.base.step(self.pose[None], odometry[None], dt)[0]


class Trusting:
    """Emergency stop that stops nothing."""

    def control(self, asked: Array, last: Array, scan: Scan) -> Array:
        return asked


def staged(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    occupancy: OccupancyMap = HALL,
    trusting: bool = False,
    ticks: int = 90,
    **settings: Any,
) -> EpisodeLog:
    """Log of a drive that ends some ticks after its first contact, without reflexes if it trusts its plan."""
    save_map(folder / "hall.yaml", occupancy)
    usual: dict[str, Any] = {"start": START, "believed": START, "goals": (GOAL,)}
    made = Episode(NavigationSettings(map=folder / "hall.yaml", **{**usual, **settings}), rehearsal=True)
    if trusting:
        made.pilot.emergency_stop = Trusting()  # type: ignore[assignment]
        monkeypatch.setattr(Route, "repair", lambda self, pose, tracks: False)
        made.pilot.supervisor = Supervisor({name: Ramp(name, np.inf, np.inf) for name in RAMPS})
    left = ticks

    def until(done: float, text: str) -> None:
        nonlocal left
        left = min(left - 1, 8 if made.world.collisions else left)
        if left == 0 and done < 1.0:
            raise KeyboardInterrupt

    return made.run(until)


def corner() -> OccupancyMap:
    """A corridor along y = 1 that turns left at its end."""
    return walled(8.0, 6.0, wall=2, blocks=[(slice(40, 120), slice(0, 110))])


def niche() -> OccupancyMap:
    """The hall with a block beside the way, behind which something fits."""
    return walled(9.0, 3.0, wall=2, blocks=[(slice(38, 44), slice(60, 100))])


STAGED: dict[str, tuple[str, str, dict[str, Any]]] = {
    "a mover beyond its bound": ("obstacle 0", f"{BREAKS} (mover)", {"world": with_mover((3.5, 1.8), 1.5, 4.0)}),
    "a wall that no map shows": ("wall", f"{BREAKS} (map)", {"world": Glass}),
    "brakes that disobey": ("wall", f"{BREAKS} (brakes)", {"world": Runaway, **LATER}),
    "wheels that slip": (
        "wall", f"{BREAKS} (pose)",
        {
            "occupancy": corner(), "localiser": Wheels, "planner": Follows, "trusting": True, "start": (1.0, 1.0, 0.0),
            "believed": (1.0, 1.0, 0.0), "goals": ((6.7, 5.0, 1.57),), "drivetrain": Drivetrain(slip=0.35),
            "ticks": 130,
        },
    ),
    "a mover from unseen space": (
        "obstacle 0", f"{BREAKS} (unseen)",
        {"occupancy": niche(), "trusting": True, "world": with_mover((5.2, 2.45), 3.4, 3.0)},
    ),
    "a robot run into at rest": (
        "obstacle 0", f"{BREAKS} (rest)", {"planner": Waits, "world": with_mover((2.6, 1.5), 1.0, 0.6)}
    ),
    "a planner that drives into a known wall": (
        "wall", f"{FAULT}: its way out of", {"planner": Onward, "trusting": True, **LATER}
    ),
    "a planner that drives into a known disc": (
        "obstacle 0", f"{FAULT}: no assumption was broken", {"planner": Onward, "trusting": True, "world": Pillar}
    ),
}  # fmt: skip


@pytest.mark.product(2)
@pytest.mark.parametrize("name", STAGED)
def test_a_staged_contact_has_its_cause(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    thing, begin, settings = STAGED[name]
    log = staged(tmp_path, monkeypatch, **settings)
    contact = judged(log).contacts[0]
    assert contact.thing == thing and contact.cause.startswith(begin), contact
    metrics = episode_metrics(log)
    first = {"tick": contact.tick, "time": contact.time, "thing": thing, "cause": contact.cause}
    assert metrics["contacts"][0] == first
    assert contact.cause in summary(log) and contact.cause in drive_scene(log).facts.values()
    log.save(tmp_path / "drive.npz")
    assert judged(EpisodeLog.load(tmp_path / "drive.npz")) == judged(log)


@pytest.mark.product(2, of="drives and flights")
def test_a_clean_drive_breaks_nothing_and_says_how_often_deviations_were_exceeded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = staged(tmp_path, monkeypatch, goals=((5.5, 1.5, 0.0),), world=Pillar)
    assert log.reached == [True] and judged(log).contacts == ()
    assert judged(log).ticks == {"pose": 0, "brakes": 0, "map": 0, "mover": 0, "overlooked": 1}
    error, covariance = (log.true_pose - log.estimate)[:, :2], log.covariance[:, :2, :2]
    turn = np.array([[[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]] for a in log.estimate[:, 2]])
    spread = turn @ covariance @ turn.transpose(0, 2, 1)
    beyond = [e @ np.linalg.solve(P, e) > log.assumed.sigmas**2 for e, P in zip(error, spread, strict=True)]
    assert episode_metrics(log)["beyond_sigma"] == pytest.approx(np.mean(beyond)) and 0.0 < np.mean(beyond) < 1.0


def made(**changed: Any) -> EpisodeLog:
    """A made-up drive straight ahead at 0.5 m/s whose beliefs are right, with changes."""
    log = episode(obstacles=1)
    count = log.ticks
    pose = np.column_stack([0.05 * np.arange(count), np.zeros((count, 2))])
    place = np.tile([[1.4, 0.6, 0.2]], (count, 1, 1))
    row = np.array([[1.4, 0.6, 0.0, 0.06]])
    usual: dict[str, Any] = {
        "true_pose": pose, "estimate": pose.copy(), "obstacles": place, "detected": [place[0]] * count,
        "expected": [row] * count, "control": np.tile([0.5, 0.0], (count, 1)), "scan": np.full((count, 72), 2.0),
        "way_out": np.repeat(pose[:, None], 11, axis=1), "contacts": (np.arange(count) > 20).astype(np.intp),
        "collisions": 1,
    }  # fmt: skip
    return replace(log, **{**usual, **changed})


def at(log: EpisodeLog, name: str, rows: Any, change: Callable[[Array], None]) -> dict[str, Any]:
    """A column of a log, changed in some rows."""
    column = getattr(log, name).copy()
    part = column[rows]
    change(part)
    column[rows] = part
    return {name: column}


def cause(log: EpisodeLog) -> str:
    (contact,) = judged(log).contacts
    assert contact.thing == "obstacle 0" and contact.tick == 21 and contact.time == pytest.approx(2.1)
    return contact.cause


def test_without_anything_broken_the_robot_is_at_fault() -> None:
    assert cause(made()) == f"{FAULT}: no assumption was broken in the 6 ticks before"


@pytest.mark.parametrize(("step", "broken"), [(0.14, False), (0.16, True)])
def test_brakes_may_err_by_a_tenth_of_a_metre_a_second(step: float, broken: bool) -> None:
    log = made()
    pose = log.true_pose.copy()
    pose[19:, 0] += step * 0.1 - 0.005 + 1e-9  # from 0.5 m/s to 0.45 m/s more than the step
    found = cause(made(true_pose=pose, estimate=pose))
    assert found.startswith(BREAKS + " (brakes) at 1.8 s") is broken and found.startswith(FAULT) is not broken


@pytest.mark.parametrize(("tick", "broken"), [(20, True), (21, False)])
def test_a_push_by_what_was_met_is_no_fault_of_the_brakes(tick: int, broken: bool) -> None:
    """Row 21 has the contact: its speed is that of a robot that was hit."""
    pose = made().true_pose.copy()
    pose[tick + 1 :, 0] += 0.1
    assert cause(made(true_pose=pose, estimate=pose)).startswith(BREAKS + " (brakes)") is broken


@pytest.mark.parametrize(("tick", "broken"), [(14, False), (15, True), (21, True), (22, False)])
def test_only_what_could_still_matter_is_a_cause(tick: int, broken: bool) -> None:
    log = made()
    detected = list(log.detected)
    detected[tick] = np.zeros((0, 3))
    expected = [row if len(seen) else np.zeros((0, 4)) for seen, row in zip(detected, log.expected, strict=True)]
    found = cause(made(detected=detected, expected=expected))
    assert found.startswith(f"{BREAKS} (overlooked) at {0.1 * tick:.1f} s") is broken


@pytest.mark.parametrize(
    ("seen", "kind"), [(2.0, "overlooked"), (np.inf, "overlooked"), (0.2, "unseen"), (np.nan, "unseen")]
)
def test_what_beams_do_not_reach_is_unseen(seen: float, kind: str) -> None:
    log = made()
    nothing = [np.zeros((0, 3))] * log.ticks, [np.zeros((0, 4))] * log.ticks
    blind = made(detected=nothing[0], expected=nothing[1], scan=np.full((log.ticks, 72), seen))
    assert cause(blind).startswith(f"{BREAKS} ({kind}) at 1.5 s")


@pytest.mark.parametrize(("more", "broken"), [(0.05, False), (0.07, True)])
def test_a_disc_is_beyond_its_bound_where_it_is_nearer_than_assumed(more: float, broken: bool) -> None:
    log = made()
    moved = log.obstacles.copy()
    away = moved[21, 0, :2] - log.true_pose[21, :2]  # five ticks after the sixteenth
    moved[21, 0, :2] -= more * away / np.hypot(*away)
    found = cause(made(obstacles=moved))
    assert found.startswith(BREAKS + " (mover) at 1.6 s: 1 cm nearer after 0.5 s than its bound of 0.00") is broken


@pytest.mark.parametrize(("speed", "rest"), [(0.04, True), (0.06, False)])
def test_a_robot_at_rest_is_run_into(speed: float, rest: bool) -> None:
    log = made()
    pose = log.true_pose.copy()
    pose[14:, 0] = pose[14, 0] + 0.1 * speed * np.arange(log.ticks - 14)
    moved = log.obstacles.copy()
    moved[:, 0, 1] = 0.6 - 0.01 * np.arange(log.ticks)  # at 0.1 m/s, as expected
    expected = [np.array([[1.4, y - 0.05, 0.1, 0.11]]) for y in moved[:, 0, 1]]
    near = made(true_pose=pose, estimate=pose, obstacles=moved, detected=list(moved), expected=expected)
    assert cause(near).startswith(f"{BREAKS} (rest)") is rest


@pytest.mark.parametrize(("tick", "kind"), [(16, "overlooked"), (20, "brakes")])
def test_what_was_broken_first_is_the_cause(tick: int, kind: str) -> None:
    log = made()
    pose, detected, expected = log.true_pose.copy(), list(log.detected), list(log.expected)
    pose[19:, 0] += 0.02  # in the tick of 1.8 s
    detected[tick], expected[tick] = np.zeros((0, 3)), np.zeros((0, 4))
    found = cause(made(true_pose=pose, estimate=pose, detected=detected, expected=expected))
    assert found.startswith(f"{BREAKS} ({kind})")


def test_a_second_contact_soon_after_has_the_cause_of_the_first() -> None:
    contacts = made().contacts.copy()
    contacts[24:] = 2
    contacts[33:] = 3
    detected, expected = list(made().detected), list(made().expected)
    detected[16], expected[16] = np.zeros((0, 3)), np.zeros((0, 4))  # too early for the second alone
    found = judged(made(contacts=contacts, collisions=4, detected=detected, expected=expected)).contacts
    assert [each.tick for each in found] == [21, 24, 33, 39]  # that of the last tick has no row
    assert found[0].cause == found[1].cause and found[0].cause.startswith(f"{BREAKS} (overlooked)")
    assert found[2].cause.startswith(FAULT) and found[3].cause.startswith(FAULT)


def test_contacts_that_begin_in_one_tick_are_contacts_with_several_things() -> None:
    """Both began between two rows, and one of them was named: three entries of four collisions."""
    contacts, away = made().contacts.copy(), made().obstacles.copy()
    contacts[21:] = 2
    place = np.concatenate([away, away - [0.0, 0.1, 0.0]], axis=1)
    log = made(contacts=contacts, collisions=2, obstacles=place, obstacle_moves=np.zeros(2, dtype=bool))
    found = judged(log).contacts
    assert [each.thing for each in found] == ["obstacle 1", "obstacle 0"] and {each.tick for each in found} == {21}
    contacts[24:] = 3  # less than 0.5 s later it can be neither
    found = judged(replace(log, contacts=contacts, collisions=3)).contacts
    assert [each.thing for each in found] == ["obstacle 1", "obstacle 0", "wall"]


def test_metrics_are_plain_numbers() -> None:
    assert json.loads(json.dumps(episode_metrics(made())))["contacts"][0]["thing"] == "obstacle 0"
