"""Robots of any base and body: their rows, their wheels, their ways, and drives on two maps."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from maps import building, field, stop_after, walled
from problems.graphs import graph_with
from unifg.errors import ModelError, ScenarioError
from unifg.files.ros_map import OccupancyMap, save_map
from unifg.models import obstacles, unicycle
from unifg.models.distance_map import SmoothField
from unifg.models.footprint import EXCESS, Body, body_of
from unifg.models.planar import Base, base_of
from unifg.scenarios.campaigns.stated_settings import Fields
from unifg.scenarios.command import main
from unifg.scenarios.commands.drives import summary
from unifg.scenarios.commands.flights import _short_of
from unifg.scenarios.ground.drive_control import Controller
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.emergency_stop import EmergencyStop
from unifg.scenarios.ground.stopping import evasions, stopped
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.navigation import Episode, NavigationSettings, run_navigation
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.follow import PathFollower
from unifg.scenarios.planning.grid import SPACING
from unifg.scenarios.planning.lattice import plan_poses
from unifg.scenarios.simulation.drivetrain import COMPUTED, Drivetrain
from unifg.scenarios.simulation.plane import LidarModel, OdometryModel, World
from unifg.typing import Array

DT = 0.1
CAR = "polygon:-0.1,-0.15;0.4,-0.15;0.4,0.15;-0.1,0.15"
NAMES = ("unicycle", "ackermann", "omnidirectional")
QUIET, EXACT = LidarModel(sigma=0.0, dropout=0.0), OdometryModel(0.0, 0.0)


def yard() -> OccupancyMap:
    """Two rooms of 5 m by 6 m, a door of 1 m between them, and a bay of 1 m by 1.2 m in the second one."""
    wall, bay = (slice(0, 120), slice(99, 101)), (slice(1, 30), slice(150, 153))
    room = walled(10.0, 6.0, name="yard", blocks=(wall, bay, (slice(1, 30), slice(173, 176))))
    occupied = room.occupied.copy()
    occupied[70:90, 99:101] = False
    return replace(room, occupied=occupied, free=~occupied)


# ---------------------------------------------------------------------- bodies


@pytest.mark.parametrize("text", ["0.6x0.4", "0.3x0.9", CAR, "polygon:0.3,0;-0.2,0.25;-0.2,-0.25"])
def test_discs_cover_a_polygon_and_stick_out_of_it_by_no_more_than_they_may(text: str) -> None:
    body = body_of(text)
    edges = body.boundary(0.001)
    discs = Body(body.discs)
    assert discs.gap(edges).max() <= 1e-3, "all of the edges is inside of a disc"
    assert body.gap(discs.boundary(0.005)).max() == pytest.approx(EXCESS, abs=1e-3)
    assert np.abs(body.gap(edges)).max() < 1e-9 and body.gap(np.mean(body.outline, axis=0)) < 0.0
    assert body.bound == pytest.approx(float(np.hypot(*edges.T).max()), abs=1e-3)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("polygon:0,0;0.3,0;0.6,0;0.6,0.4;0,0.4", "polygon:0,0;0.6,0;0.6,0.4;0,0.4"),
        ("polygon:0.1,0.1;0.2,0.2;0.3,0.3;0,0.4", "polygon:0.1,0.1;0.3,0.3;0,0.4"),  # straight but for rounding
        ("polygon:0,0.4;0.6,0.4;0.6,0;0.4,0;0.2,0;0,0", "polygon:0,0;0.6,0;0.6,0.4;0,0.4"),  # the other way round
        ("polygon:0,0;0.6,0;0.6,0.4;0,0.4;0,0", "polygon:0,0;0.6,0;0.6,0.4;0,0.4"),  # closed, as in files of maps
    ],
)
def test_corners_on_a_straight_side_are_none(text: str, same: str) -> None:
    found, clean = set(body_of(text).outline), set(body_of(same).outline)
    assert found == clean
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 2))
    np.testing.assert_allclose(body_of(text).gap(points), body_of(same).gap(points), atol=1e-12)


NEEDLE = "polygon:0,0;4,0.02;0,0.04"


@pytest.mark.parametrize("text", [CAR, "2x0.5", "4x0.4", "10x0.3", "5x0.01", NEEDLE, "12x2.5", "0.05x0.01"])
def test_discs_leave_nothing_of_the_edges_however_long_and_thin(text: str) -> None:
    body = body_of(text)
    assert Body(body.discs).gap(body.boundary(0.002)).max() <= 1e-9
    assert body.gap(Body(body.discs).boundary(0.02)).max() <= EXCESS + 1e-9


def test_the_rim_of_a_body_is_where_a_ray_leaves_it() -> None:
    angles = np.linspace(-np.pi, np.pi, 33)
    for body in (body_of("0.6x0.4"), body_of("discs:0.1,0,0.2;-0.15,0,0.18"), Body.disc(0.2)):
        tips = body.rim(angles)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        assert np.abs(body.gap(tips)).max() < body.bound / 60.0
    np.testing.assert_array_equal(Body.disc(0.2).rim(angles), 0.2)


@pytest.mark.parametrize(
    "text",
    [
        "0.6",
        "disc:0",
        "disc:x",
        "polygon:0,0;1,0",
        "polygon:0,0;1,0;0.2,0.2;0,1",
        "polygon:0,0;1,0;2,0",
        "polygon:0,0;0,0;0,0",
        "polygon:0,0;2,0;1,0;1,1",
        "discs:0,0",
        "ball:1",
        "axb",
        "-1x1",
        "1x-1",
        "-1x-1",
        "disc:1,2",
        "disc:1;2",
        "polygon:a,0;1,0;0,1",
        "600x400",
    ],
)
def test_what_is_no_body_is_refused(text: str) -> None:
    with pytest.raises(ModelError):
        body_of(text)
    with pytest.raises(ModelError):
        ControllerSettings(body=text)


@pytest.mark.parametrize("text", ["0.6x0.4", "discs:0.1,0,0.2;-0.15,0,0.12"])
def test_rows_of_a_body_are_those_of_its_discs(text: str) -> None:
    body, rng = body_of(text), np.random.default_rng(0)
    walls = SmoothField(field(yard()))
    x = np.column_stack([rng.uniform([1.0, 1.0], [9.0, 5.0], (20, 2)), rng.uniform(-3.0, 3.0, 20)])
    centres, radii = rng.uniform(0.0, 6.0, (3, 2)), np.array([0.1, 0.2, 0.3])
    to_walls, to_discs = obstacles.wall_distance(walls, body), obstacles.clearance_of(body)
    offset = body.places(x)[:, :, None] - centres
    apart = np.hypot(offset[..., 0], offset[..., 1]) - radii + body.smaller[:, None]
    np.testing.assert_allclose(to_discs(x, centres, radii), apart.reshape(20, -1), atol=1e-12)
    np.testing.assert_allclose(to_walls(x), walls.distance(body.places(x)) + body.smaller, atol=1e-12)
    graph, nodes = graph_with(fg.SE2, 20)
    graph.constrain(to_walls, nodes, lower=0.1)
    graph.constrain(to_discs, nodes, graph.data("centres", centres), graph.data("radii", radii), lower=0.1)
    assert not graph.check({nodes: x}).findings
    assert obstacles.clearance_of(Body.disc(0.2)) is obstacles.disc_clearance


# ----------------------------------------------------------------------- bases


@pytest.mark.parametrize("name", NAMES)
def test_a_step_keeps_the_dynamics_and_goes_along_the_arc(name: str) -> None:
    base, rng = base_of(name), np.random.default_rng(1)
    x, u = rng.uniform(-2.0, 2.0, (9, 3)), rng.uniform(-0.5, 0.5, (9, base.size))
    np.testing.assert_allclose(base.dynamics(x, u, base.step(x, u, DT), DT), 0.0, atol=1e-12)
    np.testing.assert_allclose(base.ramped(x, 0.0 * u, 2.0 * u, base.step(x, u, DT), DT), 0.0, atol=1e-12)
    body = base.velocities(u)
    tangent = np.zeros((9, 3))
    tangent[:, : body.shape[1] - 1], tangent[:, 2] = body[:, :-1], body[:, -1]
    exact = fg.SE2.retract(x, DT * tangent)
    assert np.abs(fg.SE2.local(exact, base.step(x, u, DT))).max() < 1e-5
    for pose, control in ((x[0], u), (x, u[0]), (x[:1], u[0]), (x[0], u[0])):  # one control is no row for each number
        count = max(np.atleast_2d(pose).shape[0], np.atleast_2d(control).shape[0])
        rows, every = np.broadcast_to(pose, (count, 3)), np.broadcast_to(control, (count, u.shape[1]))
        np.testing.assert_array_equal(base.step(pose, control, DT), base.step(rows, every, DT))
    with pytest.raises(ModelError, match="poses and controls of a base are"):
        base.step(x, u[:, :1], DT)
    with pytest.raises(ModelError, match="poses and controls of a base are"):
        base.rollout(x[0], u[0], DT)
    with pytest.raises(ModelError, match=r"each of 9; found shape \(2,\)"):
        base.step(x, u, [DT, DT])
    with pytest.raises(ModelError, match="as many rows, or one; got 2 and 9"):
        base.step(x, u[:2], DT)


def test_a_car_turns_about_its_radius_and_not_on_the_spot() -> None:
    car = base_of("ackermann:0.5,0.4,1.0")
    limit = car.steering
    assert limit == (0.4, 1.0) and car.turning_radius == pytest.approx(0.5 / math.tan(0.4))
    states = car.rollout(np.zeros(3), np.tile([0.5, 0.4], (400, 1)), 0.02)
    assert np.ptp(states[:, 1]) == pytest.approx(2.0 * car.turning_radius, rel=1e-3)
    np.testing.assert_array_equal(car.of(np.array([0.0, 0.4])), 0.0)
    assert base_of("unicycle") is unicycle.BASE


@pytest.mark.parametrize("name", ["tank", "ackermann:0", "ackermann:x", "ackermann:1,2", "unicycle:1"])
def test_what_is_no_base_is_refused(name: str) -> None:
    with pytest.raises(ModelError):
        ControllerSettings(base=name)


@pytest.mark.parametrize("name", NAMES)
def test_wheels_report_what_leads_where_the_robot_went(name: str) -> None:
    base = base_of(name)
    world = World(yard(), (2.0, 3.0, 0.3), rng=np.random.default_rng(0), base=base, lidar=QUIET, odometry=EXACT)
    control = {2: [0.4, 0.3], 3: [0.3, -0.2, 0.4]}[base.size]
    pose = world.pose
    for _ in range(15):
        world.step(*control)
        pose = base.step(pose[None], np.array([world.odometry()]), DT)[0]
    np.testing.assert_allclose(pose, world.pose, atol=2e-3)
    np.testing.assert_allclose(world.odometry(), control, atol=1e-3)
    with pytest.raises(ScenarioError, match="finite"):
        world.step(*control[1:])


def test_a_corner_of_the_hull_touches_where_the_middle_is_far() -> None:
    world = World(
        yard(),
        (4.5, 1.0, np.pi / 2),
        rng=np.random.default_rng(0),
        body=body_of("0.9x0.2"),
        lidar=QUIET,
        odometry=EXACT,
    )
    assert world.clearance() == pytest.approx(0.35, abs=0.011) and world.collisions == 0  # the wall begins at 4.95 m
    for _ in range(16):
        world.step(0.0, 1.0)
    assert world.collisions == 1 and world.clearance() < 0.01


@pytest.mark.parametrize("name", NAMES)
def test_stopping_keeps_the_accelerations_and_ends_at_rest(name: str) -> None:
    s = ControllerSettings(base=name)
    base: Base = s.kind
    last = 0.8 * s.box[1]
    plan = np.tile(last, (s.horizon, 1))
    controls = stopped(last, plan, s.most, s.horizon, base)
    assert np.abs(np.diff(controls, axis=0, prepend=last[None])).max(axis=0) == pytest.approx(s.most, abs=0.3)
    assert np.all(np.abs(np.diff(controls, axis=0, prepend=last[None])) <= s.most + 1e-9)
    assert not controls[-1, base.resting].any() and np.all(controls[-1, ~base.resting] == last[~base.resting])
    for way in evasions(last, s.most, s.box[1], s.horizon, s.dt, base):
        assert np.all(np.abs(np.diff(way, axis=0, prepend=last[None])) <= s.most + 1e-9)
        assert not way[-1, base.resting].any() and np.all(np.abs(way) <= s.box[1] + 1e-9)


def test_a_body_that_turns_is_stopped_where_a_corner_would_touch() -> None:
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    ranges = 0.36 / np.maximum(np.abs(np.sin(angles)), 0.05)  # walls 0.36 m to the left and to the right
    scan, turning = Scan(angles, ranges), np.array([0.0, 1.0])
    long = EmergencyStop(body_of("0.9x0.4"), (2.5, 3.2), DT)
    assert EmergencyStop(Body.disc(0.3), (2.5, 3.2), DT).is_free(turning, scan)
    assert not long.is_free(np.array([0.0, 1.0]), replace(scan, ranges=0.7 * ranges))
    np.testing.assert_array_equal(long.control(turning, turning, replace(scan, ranges=0.7 * ranges))[0], 0.0)
    sideways = EmergencyStop(Body.disc(0.17), (2.5, 3.2), DT, base_of("omnidirectional"))
    assert not sideways.is_free(np.array([0.0, 0.9, 0.0]), scan) and sideways.is_free(np.array([0.9, 0.0, 0.0]), scan)


# ------------------------------------------------------------------------ ways


@pytest.mark.product(2, of="drives and flights")
def test_a_way_of_a_car_has_no_tighter_turns_and_leads_backwards_into_the_bay() -> None:
    occupancy, body, car = yard(), body_of(CAR), base_of("ackermann")
    walls = SmoothField(field(occupancy))
    goal = np.array([8.12, 0.5, np.pi / 2])
    path = plan_poses(occupancy, walls.distance_map, [1.5, 1.5, 0.0], goal, base=car, body=body, gap=0.05)
    np.testing.assert_allclose(path[-1], goal, atol=1e-9)
    way, turn = np.diff(path[1:, :2], axis=0), np.abs(fg.SE2.local(path[1:-1], path[2:])[:, 2])
    length = np.hypot(*way.T)
    assert np.all(turn <= length / car.turning_radius + 1e-6), "nowhere tighter"
    ahead = way[:, 0] * np.cos(path[1:-1, 2]) + way[:, 1] * np.sin(path[1:-1, 2])
    assert ahead[0] > 0.0 and ahead[-1] < 0.0, "it backs in"
    gaps = (walls.distance(body.places(path)) + body.smaller).min(axis=1) - body.radius
    assert gaps.min() > 0.05 - 1e-6
    with pytest.raises(ScenarioError, match="no way"):
        plan_poses(
            occupancy, walls.distance_map, [2.5, 3.0, 0.0], [7.5, 4.0, 0.0], base=car, body=body_of("0.9x1.1"), gap=0.05
        )
    with pytest.raises(ScenarioError, match="the body has"):
        plan_poses(occupancy, walls.distance_map, [0.2, 1.5, 0.0], goal, base=car, body=body_of("0.9x0.5"), gap=0.05)


def test_a_path_leads_on_in_reverse_only_from_where_its_sense_changes() -> None:
    there = np.column_stack([SPACING * np.arange(41), np.zeros(41), np.zeros(41)])
    back = there[::-1][1:21]
    follower = PathFollower(np.concatenate([there, back]), SPACING)
    ahead = SPACING * np.arange(30.0)
    poses, reached = follower.reference([1.5, 0.02, 0.0], ahead)
    assert reached == pytest.approx(1.5) and poses[-1, 0] == pytest.approx(2.0), "it waits there"
    poses, reached = follower.reference([1.95, 0.0, 0.0], ahead, reached)
    assert poses[-1, 0] < 1.1, "and goes back"
    assert follower.reference([1.5, 0.0, 0.0], ahead, reached)[1] == pytest.approx(2.5)


# ---------------------------------------------------------------------- drives


@pytest.mark.parametrize("name", NAMES)
def test_limits_of_the_base_hold_in_every_plan(name: str) -> None:
    s = ControllerSettings(base=name, body=CAR)
    occupancy, _ = building()
    controller = Controller(field(occupancy), "ipm", s)
    pose: Array = np.array([7.0, 14.0, 0.0])
    bent = np.tile([0.6, 0.25], (s.horizon, 1)) if s.kind.size == 2 else np.tile([0.5, 0.2, 0.3], (s.horizon, 1))
    reference = s.kind.rollout(pose, bent, s.dt)
    plan = controller.plan(pose, reference, Tracks.none())
    assert plan.source == "solved" and np.all(np.abs(plan.controls) <= s.box[1] + 1e-6)
    assert np.all(np.abs(np.diff(plan.controls, axis=0, prepend=np.zeros((1, s.kind.size)))) <= s.most + 1e-4)
    np.testing.assert_allclose(
        plan.states, s.kind.followed(pose, np.zeros(s.kind.size), plan.controls, s.dt), atol=2e-3
    )


ROBOTS = [
    ("unicycle", "0.6x0.4"),
    ("unicycle", "discs:0.1,0,0.2;-0.15,0,0.18"),
    ("ackermann", CAR),
    ("omnidirectional", ""),
    ("omnidirectional", "0.6x0.4"),
]


@pytest.mark.product(1, of="drives of bases")
@pytest.mark.parametrize(("base", "body"), ROBOTS)
def test_every_robot_drives_out_of_an_office_and_around_the_corner(base: str, body: str) -> None:
    settings = NavigationSettings(
        start=(10.8, 17.0, -1.57), goals=((16.5, 14.0, 0.0),), obstacles=1, seed=2,
        controller=ControllerSettings(base=base, body=body),
    )  # fmt: skip
    log = run_navigation(settings)
    metrics = episode_metrics(log)
    assert log.succeeded and metrics["min_clearance_m"] > 0.0, log.outcomes
    assert metrics["base"] == base and metrics["solver_failures"] == 0
    assert metrics["localisation_error_m"]["mean"] < 0.05
    assert metrics["localisation_error_m"]["mean"] < 0.5 * metrics["odometry_error_m"]["mean"]


@pytest.mark.product(1, of="drives of bases")
@pytest.mark.parametrize("coupling", ["sequential", "joint"])
@pytest.mark.parametrize(("base", "body"), [*ROBOTS[:1], *ROBOTS[2:]])
def test_every_robot_parks_in_the_bay_of_the_yard(base: str, body: str, coupling: str, tmp_path: Path) -> None:
    save_map(tmp_path / "yard.yaml", yard())
    settings = NavigationSettings(
        map=tmp_path / "yard.yaml", start=(1.5, 1.5, 0.0), goals=((8.12, 0.5, math.pi / 2),), coupling=coupling,
        controller=ControllerSettings(base=base, body=body),
    )  # fmt: skip
    log = run_navigation(settings)
    assert log.succeeded and log.clearance.min() > 0.0, log.outcomes
    if base == "ackermann":
        assert log.control[-1, 0] <= 0.0 and np.abs(log.control[:, 1]).max() <= 0.6 + 1e-6
    if base == "omnidirectional":
        assert np.abs(log.control[:, 1]).max() > 0.1, "it goes sideways"


# --------------------------------------------------------------------- options


@pytest.mark.product(2, of="drives and flights")
@pytest.mark.parametrize("thickness", [2, 3, 4])
def test_a_door_of_half_a_metre_is_passed_by_a_robot_of_a_third(thickness: int, tmp_path: Path) -> None:
    """Its middle line runs between two cells, where the field that the plan keeps to is highest."""

    def behind(cells: int) -> NavigationSettings:
        wall = walled(4.0, 3.0, name="door", blocks=((slice(0, 60), slice(40, 40 + thickness)),))
        occupied = wall.occupied.copy()
        occupied[25 : 25 + cells, 40 : 40 + thickness] = False
        save_map(tmp_path / "door.yaml", replace(wall, occupied=occupied, free=~occupied))
        return NavigationSettings(map=tmp_path / "door.yaml", start=(1.0, 1.5, 0.0), goals=((3.2, 1.5, 0.0),))

    log = run_navigation(behind(10))
    assert log.succeeded and log.clearance.min() > 0.03, log.outcomes
    with pytest.raises(ScenarioError, match="no way"):
        run_navigation(behind(8))


@pytest.mark.product(2, of="drives and flights")
def test_fewer_obstacles_than_asked_for_are_said() -> None:
    settings = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((10.5, 14.1, 0.0),), obstacles=30)
    log = Episode(settings, rehearsal=True).run(stop_after(3))
    metrics = episode_metrics(log)
    assert metrics["obstacles"] < metrics["obstacles_wanted"] == 30
    assert f"{metrics['obstacles']} of 30 found a place" in summary(log)


@pytest.mark.product(2, of="drives and flights")
def test_speed_plant_and_belief_are_those_asked_for() -> None:
    corridor = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((13.5, 14.1, 0.0),))
    fast = run_navigation(replace(corridor, controller=ControllerSettings(speed=1.6)))
    assert fast.succeeded and 1.5 < fast.control[:, 0].max() <= 1.6 + 1e-6
    slow = Episode(replace(corridor, plant="pmb2", drivetrain=Drivetrain(turning=1.5)), rehearsal=True)
    assert slow.controller.accelerations == (1.0, 1.5), "what is given is kept"
    assert Episode(replace(corridor, plant="harsh"), rehearsal=True).settings.drivetrain.lag == 0.1
    usual = Drivetrain(acceleration=2.5, turning=3.2, lag=0.0, latency=0.0, slip=0.0, skid=0.0)
    asked = Episode(replace(corridor, plant="harsh", drivetrain=usual), rehearsal=True).settings.drivetrain
    assert asked == usual, "what is asked for is kept, also where it is what another base has"
    own = replace(corridor, believed=(6.6, 14.0, 0.02), initial_sigma=(0.2, 0.1, 0.1))
    np.testing.assert_array_equal(Episode(own, rehearsal=True).pilot.pose, (6.6, 14.0, 0.02))
    for wrong in ({"plant": "tank"}, {"initial_sigma": (0.0, 0.1, 0.1)}):
        with pytest.raises(ScenarioError):
            Episode(replace(corridor, **wrong), rehearsal=True)


def test_any_setting_is_stated_by_its_name(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    stated = Fields(NavigationSettings, tmp_path).restated(
        NavigationSettings(),
        ["controller.margin=0.3", "base=ackermann", "controller.pull=[0.1, 0.1, 0.2]", "latency=auto"],
    )
    assert stated.controller.margin == 0.3 and stated.controller.kind.name.startswith("ackermann")
    assert stated.controller.pull == (0.1, 0.1, 0.2) and stated.drivetrain.latency == COMPUTED
    for word, why in (
        ("controller.margins=1", "did you mean"),
        ("controller.margin=wide", "does not fit"),
        ("x", "="),
        ("latency=soon", "does not fit"),
        ("seed=3", "--set seed=3: an option states seed, too"),
        ("solver=alm", "an option states solver, too"),
        ("controller.speed=0.4", "an option states controller.speed, too"),
    ):
        options = ["--seed", "4", "--solver", "ipm", "--speed", "0.5"]
        assert main(["run", "navigation", *options, "--set", word, "--out", str(tmp_path)]) == 2
        assert why in capsys.readouterr().err


def test_help_shows_twelve_options_first_and_all_in_groups(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "navigation", "--help"]) == 0
    first = capsys.readouterr().out
    flags = re.findall(r"^  (--[a-z-]+)", first, re.MULTILINE)
    assert len(flags) == 12 and "--base" in flags and "--help all" in first
    assert main(["run", "navigation", "--help", "all"]) == 0
    everything = capsys.readouterr().out
    assert set(flags) < set(re.findall(r"^  (--[a-z-]+)", everything, re.MULTILINE))
    assert {"controller:", "drivetrain:", "lidar:", "--lag"} < set(everything.split())


def test_a_flight_says_where_the_speed_asked_for_is_out_of_reach() -> None:
    settings = {"controller": {"guide": {"speed": 8.0, "acceleration": 2.0}}}
    slow = {"settings": settings, "max_speed_m_per_s": 5.0, "reached": True}
    assert " of 8 asked for: bends" in _short_of(slow)
    assert _short_of({**slow, "reached": False}) == " of 8 asked for"  # what ended it may have kept it slow
    assert _short_of({"settings": settings, "max_speed_m_per_s": 7.9}) == ""
    assert _short_of({"settings": {}, "max_speed_m_per_s": 1.0}) == ""
