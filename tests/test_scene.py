"""Scenes and plots: what is in the files, read back without a browser."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from episodes import HORIZON, episode, room
from scenes import check_offline, commands_of, data_of, tracks_of, without_viewer
from unifg.errors import ViewError
from unifg.scenarios.commands.drives import summary
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.scenes import drive_plot
from unifg.scenarios.scenes.drive_plot import overview, plot_controls, plot_localisation
from unifg.scenarios.scenes.drive_scene import drive_scene
from unifg.scenarios.scenes.panels import plot_times
from unifg.scenarios.scenes.parts import lidar_hits
from unifg.style.figures import write_figure
from unifg.view.recorder import Recorder, viewer_script
from unifg.view.shapes import cover, extrude, flat, known_corners, ribbon
from unifg.view.stage import frame_ticks

umsgpack = pytest.importorskip("umsgpack")


@pytest.fixture(scope="module")
def log() -> EpisodeLog:
    return episode(ticks=12, obstacles=4)


@pytest.fixture(scope="module")
def page(log: EpisodeLog) -> str:
    return drive_scene(log).html()


def test_page_loads_nothing_from_outside(page: str) -> None:
    check_offline(page)
    # The viewer itself names one address, the XHTML namespace, which no browser opens.
    assert set(re.findall(r"https?://[^\"'`\s)]+", viewer_script())) == {"http://www.w3.org/1999/xhtml"}


def test_page_has_no_placeholder_left_and_says_what_it_shows(page: str, log: EpisodeLog) -> None:
    around = without_viewer(page)
    data = data_of(around)
    assert data["title"] == "unifg: navigation on room" and ["solver", "alm (sequential)"] in data["facts"]
    assert data["outcome"] == "1 of 1 goals reached, no collision" and data["good"] is True
    assert any("lidar hits" in key["text"] for key in data["legend"])
    failed = data_of(drive_scene(replace(log, collisions=2, reached=[False])).html())
    assert failed["outcome"] == "0 of 1 goals reached, 2 collisions" and failed["good"] is False
    lost = replace(log, goals=np.tile(log.goals, (2, 1)), reached=[False] * 2, outcomes=["lost: no beam came back"] * 2)
    assert data_of(drive_scene(lost).html())["outcome"].count("lost: no beam came back") == 1
    assert 'good ? "good" : "bad"' in around


def test_a_joint_drive_says_that_one_graph_estimates_and_plans(log: EpisodeLog) -> None:
    joint, words = replace(log, coupling="joint"), "navigation on room, one graph estimates and plans"
    assert drive_scene(joint).title == f"unifg: {words}" and words in summary(joint)
    assert overview(joint).get_suptitle().startswith(f"{words}: 1 of 1 goals reached")


def test_readouts_are_those_of_the_log(page: str, log: EpisodeLog) -> None:
    readouts = {readout["name"]: readout for readout in data_of(page)["readouts"]}
    assert {len(readout["texts"]) for readout in readouts.values()} == {log.ticks}
    assert readouts["speed"]["texts"][3] == "0.50 m/s" and readouts["localisation error"]["texts"][0] == "5.0 cm"
    assert readouts["clearance"]["texts"][0] == "0.60 m" and readouts["goal"]["texts"][0] == "1 of 1"
    assert readouts["plan"]["texts"][-1] == "stalled: stored one driven"
    assert readouts["plan"]["alarms"] == log.emergency.tolist()


@pytest.mark.parametrize("name", ["overview", "follow"])
def test_views_follow_and_labels_name_what_there_is(page: str, name: str) -> None:
    data = data_of(page)
    view = next(view for view in data["views"] if view["name"] == name)
    objects = {c["path"].split("/")[2] for c in commands_of(page) if c["type"] == "set_object"}
    followed = {entry["follows"] for entry in [view, *data["labels"]]} - {None}
    assert followed <= objects and (view["follows"] is not None) == (name == "follow")
    assert np.shape(data["corners"]) == (8, 3)
    assert [label["text"] for label in data["labels"]] == ["start", "goal", "robot", "odometry alone"]


def test_robot_ghost_and_movers_follow_the_log(page: str, log: EpisodeLog) -> None:
    tracks = tracks_of(commands_of(page))
    for name, poses in (("robot", log.true_pose), ("estimate", log.estimate), ("odometry", log.dead_reckoning)):
        track = tracks[name]
        places = np.array([value for _, value in track[".position"]])
        turns = np.array([value for _, value in track[".quaternion"]])
        np.testing.assert_allclose(places[:, :2], poses[:, :2])
        np.testing.assert_allclose(2 * np.arctan2(turns[:, 2], turns[:, 3]), poses[:, 2], atol=1e-12)
    assert log.obstacle_moves.tolist() == [True, False, False, True]
    moved = {path for path in tracks if path.startswith("obstacle")}
    assert moved == {"obstacle 0", "obstacle 3"}


def test_objects_are_packed_as_the_viewer_wants_them(page: str) -> None:
    for command in commands_of(page):
        if command["type"] != "set_object":
            continue
        (geometry,) = command["object"]["geometries"]
        (material,) = command["object"]["materials"]
        drawn = command["object"]["object"]
        assert (drawn["geometry"], drawn["material"]) == (geometry["uuid"], material["uuid"])
        if geometry["type"] == "BufferGeometry":
            position = geometry["data"]["attributes"]["position"]
            values = np.frombuffer(position["array"].data, dtype=np.float32)
            assert position["itemSize"] == 3 and np.isfinite(values).all() and values.size > 0


def test_horizon_ends_where_the_plan_ends(page: str, log: EpisodeLog) -> None:
    for command in commands_of(page):
        if command.get("path") == "/meshcat/horizon/5":
            data = command["object"]["geometries"][0]["data"]["attributes"]["position"]["array"].data
            sides = np.frombuffer(data, dtype=np.float32).reshape(-1, 2, 3)
            assert len(sides) == HORIZON + 1
            np.testing.assert_allclose(sides.mean(axis=1)[[0, -1], :2], log.horizon[5, [0, -1], :2], atol=1e-6)
            return
    pytest.fail("no horizon at tick 5")


def test_covariance_route_and_contacts_are_shown(page: str, log: EpisodeLog) -> None:
    """The ellipse is that of the estimate in the world; a repaired route takes the place of the first from then on."""
    data, tracks = data_of(page), tracks_of(commands_of(page))
    half = log.ticks // 2
    routes = {c["path"] for c in commands_of(page) if c["type"] == "set_object" and "/route/" in c["path"]}
    assert routes == {"/meshcat/route/0", f"/meshcat/route/{half}"}
    shown = dict(tracks[f"route/{half}"][".visible"])
    assert shown[0] is False and shown[half] is True
    scale = dict(tracks["sigma/parts"][".scale"])[0]
    np.testing.assert_allclose(scale[:2], 30.0 * np.sqrt([4e-4, 1e-4]))  # 3 sigma, 10 times enlarged
    readouts = {readout["name"]: readout for readout in data["readouts"]}
    assert readouts["believed \u03c3"]["texts"][0] == "2.0 and 1.0 cm" and readouts["contacts"]["texts"][-1] == "0"
    assert not any(key["text"] == "contact" for key in data["legend"])
    assert [plot["name"] for plot in data["plots"]] == ["localise + plan", "localisation error", "clearance"]
    touched = replace(log, contacts=(np.arange(log.ticks) >= 4).astype(np.intp))
    text = drive_scene(touched).html()
    drawn = {c["path"] for c in commands_of(text) if c["type"] == "set_object" and "/contact/" in c["path"]}
    assert drawn == {"/meshcat/contact/4"}  # from then on, and in one piece
    alarms = {readout["name"]: readout["alarms"] for readout in data_of(text)["readouts"]}["contacts"]
    assert alarms == [tick >= 4 for tick in range(log.ticks)]
    assert any(key["text"] == "contact" for key in data_of(text)["legend"])


def test_scan_points_skip_dropouts_and_misses(log: EpisodeLog) -> None:
    points = lidar_hits(log.true_pose[4], log.scan[4], log.scan_angles, 0.6)
    assert len(points) == len(log.scan_angles) - 2 and (points[:, 2] == 0.6).all()
    points = points[:, :2]
    ranges = np.linalg.norm(points - log.true_pose[4, :2], axis=1)
    np.testing.assert_allclose(ranges, log.scan[4, 2:])
    first = log.true_pose[4, 2] + log.scan_angles[2]
    np.testing.assert_allclose(
        points[0], log.true_pose[4, :2] + log.scan[4, 2] * np.array([np.cos(first), np.sin(first)])
    )


@pytest.mark.product(1, of="scenes and pictures")
def test_long_episodes_are_thinned_and_small() -> None:
    log = episode(ticks=1001)
    ticks = frame_ticks(log.ticks)
    assert ticks[:3].tolist() == [0, 3, 6] and ticks[-1] == 1000 and len(ticks) <= 501
    log.scan, log.scan_angles = np.full((1001, 360), 2.0), np.linspace(-np.pi, np.pi, 360)
    log.horizon = np.repeat(log.horizon[:, -1:], 31, axis=1) + np.linspace(0.0, 1.0, 31)[:, None]
    assert len(drive_scene(log).html()) < 6e6
    assert frame_ticks(500).tolist() == list(range(500))


def test_odd_episodes_are_drawn_too(log: EpisodeLog) -> None:
    single = episode(ticks=1, obstacles=0)
    assert commands_of(drive_scene(single).html())[-1]["type"] == "set_animation"
    overview(single)
    lost = replace(log, horizon=np.full_like(log.horizon, np.nan), scan=np.full_like(log.scan, np.nan))
    paths = {command.get("path") for command in commands_of(drive_scene(lost).html())}
    assert not any(path and path.startswith(("/meshcat/horizon", "/meshcat/scan")) for path in paths)
    with pytest.raises(ViewError, match="no tick"):
        drive_scene(replace(log, plan_ms=log.plan_ms[:0]))


def test_recorder_makes_numpy_and_identifiers_plain() -> None:
    class Command:
        def lower(self) -> dict[str, object]:
            name = "01234567-89ab-cdef-0123-456789abcdef"
            return {"type": "x", "a": np.float32(1.5), "b": [np.bool_(True), name], "c": np.arange(2), "d": (name,)}

    recorder = Recorder()
    recorder.send(Command())
    expected = {"type": "x", "a": 1.5, "b": [True, "000000"], "c": [0, 1], "d": ["000000"]}
    assert recorder.commands == [expected]
    assert umsgpack.unpackb(recorder.packed()[0]) == expected


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_walls_cover_the_map_and_enclose_it(yaw: float) -> None:
    occupancy = room(yaw=yaw)
    occupied = occupancy.occupied
    painted = np.zeros(occupied.shape, dtype=int)
    for low, high, left, right in cover(occupied).tolist():
        painted[low:high, left:right] += 1
    np.testing.assert_array_equal(painted, occupied.astype(int))  # each cell once, nothing else

    vertices, faces = extrude(occupancy, 0.6)
    triangles = vertices[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2.0
    top = np.abs(normals[:, 2]) > 1e-12
    area = occupancy.resolution**2
    assert normals[top, 2].sum() == pytest.approx(occupied.sum() * area)
    padded = np.pad(occupied, 1).astype(int)
    edges = np.abs(np.diff(padded, axis=0)).sum() + np.abs(np.diff(padded, axis=1)).sum()
    assert np.linalg.norm(normals[~top], axis=1).sum() == pytest.approx(edges * occupancy.resolution * 0.6)
    floor, _ = flat(occupancy, occupied, 0.0)
    np.testing.assert_allclose(np.abs(np.ptp(floor, axis=0)[2]), 0.0)
    np.testing.assert_allclose(known_corners(occupancy), occupancy.bounds)


def test_stray_marks_outside_the_rooms_do_not_shrink_the_picture() -> None:
    free, occupied = np.zeros((60, 90), dtype=bool), np.zeros((60, 90), dtype=bool)
    free[20:30, 30:50] = True
    occupied[0, 0] = occupied[-1, -1] = True
    stray = replace(room(), free=free, occupied=occupied)
    low, high = known_corners(stray)[[0, 2]]
    np.testing.assert_allclose([low, high], [[30 - 5 - 10, 20 - 5 - 10], [50 + 5 - 10, 30 + 5 - 10]] * np.array(0.1))
    blank = replace(stray, free=np.zeros_like(free))
    np.testing.assert_allclose(known_corners(blank), blank.bounds)


def test_ribbon_keeps_its_width_also_where_points_coincide() -> None:
    line = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    vertices, faces = ribbon(line, 0.2, 0.5)
    assert np.isfinite(vertices).all() and len(faces) == 6
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [2.0, 0.2, 0.0])


@pytest.mark.product(1, of="scenes and pictures")
def test_overview_is_a_picture_and_deterministic(log: EpisodeLog, tmp_path: Path) -> None:
    from matplotlib.image import imread

    first = write_figure(tmp_path / "a.png", overview(log), 60).read_bytes()
    second = write_figure(tmp_path / "b.png", overview(log), 60).read_bytes()
    assert first == second
    pixels = imread(tmp_path / "a.png")
    assert pixels.shape[:2] == (564, 900) and pixels[..., :3].std() > 0.05


def test_overview_names_everything(log: EpisodeLog) -> None:
    figure = overview(log)
    axes = [ax for part in figure.subfigs for ax in part.axes]
    panels = [ax for ax in axes if ax.get_label() != "<colorbar>"]
    assert len(panels) == 6 and [ax.get_ylabel() for ax in axes if ax not in panels] == ["way driven, at [s]"]
    for ax in panels:
        assert "[" in ax.get_ylabel() and ax.get_title(loc="left")
    legend = {text.get_text() for part in figure.subfigs for box in part.legends for text in box.get_texts()}
    assert {
        "first route, on the map alone", "estimate (lidar)", "wheel odometry alone",
        "obstacle not on the map", "obstacle that moves", "walls and furniture on the map", "goals",
    } <= legend  # fmt: skip
    title = figure.get_suptitle()
    assert "1 of 1 goals reached" in title and "alm" in title and "seed 3" in title


def test_times_stand_on_a_logarithmic_axis_and_ticks_that_compiled_are_marked(log: EpisodeLog) -> None:
    def drawn(log: EpisodeLog) -> Axes:
        return plot_times(log, log.solve_ms, {"localise": (log.localise_ms, "estimate")}, Figure().subplots())

    assert drawn(log).get_yscale() == "log"
    late = episode(ticks=200)
    late.solve_ms[0] = late.localise_ms[0] = 1e-3  # does not leave decades of the picture empty
    assert 0.3 < drawn(late).get_ylim()[0] < 1.0 < late.localise_ms[1]
    assert "compiled" not in [line.get_label() for line in drawn(log).get_lines()]
    compiled = np.zeros(log.ticks, dtype=np.intp)
    compiled[2] = 3
    marked = replace(log, compiled=compiled)
    (marks,) = [line for line in drawn(marked).get_lines() if line.get_label() == "compiled"]
    np.testing.assert_array_equal(np.asarray(marks.get_xdata()), log.time[[2]])
    np.testing.assert_array_equal(np.asarray(marks.get_ydata()), log.solve_ms[[2]])


def test_the_time_per_tick_is_that_of_the_whole_tick(log: EpisodeLog) -> None:
    slow = replace(log, perceive_ms=log.perceive_ms + 70.0)
    panel = overview(slow).subfigs[1].axes[-1]
    assert panel.get_title(loc="left").startswith(f"Time per tick: median {np.median(slow.tick_ms):.1f} ms")
    assert [line.get_label() for line in panel.get_lines()][:2] == ["all", "localise"]


def test_the_speed_sideways_of_a_base_that_slides_is_named(log: EpisodeLog) -> None:
    control = np.column_stack([log.control[:, 0], log.control])
    speed, turning = Figure().subplots(2)
    plot_controls(replace(log, base="omnidirectional", control=control, control_limits=(1.0, 1.0, 1.0)), speed, turning)
    assert [text.get_text() for text in speed.get_legend().get_texts()] == ["forward", "sideways"]


def test_plotted_error_is_the_error(log: EpisodeLog) -> None:
    line = plot_localisation(log, Figure().subplots()).get_lines()[0]
    np.testing.assert_allclose(np.asarray(line.get_ydata()), 5.0)  # [cm]


def test_the_headline_says_once_and_shortly_why_goals_were_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = {"goals_reached": 0, "goals": 2, "path_length_m": 3.1, "duration_s": 23.1}
    monkeypatch.setattr("unifg.scenarios.scenes.drive_plot.episode_metrics", lambda _: numbers)
    log: Any = SimpleNamespace(
        scenario="navigation", occupancy=SimpleNamespace(name="hall"), collisions=0, interrupted=False,
        outcomes=["lost: no beam came back"] * 2, solver="ipm", coupling="sequential", seed=0,
    )  # fmt: skip
    assert "no collision, lost  |" in drive_plot._title(log)
