"""Pictures and numbers of flights: what is in the files, read back without a browser."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenes import check_offline, commands_of, data_of, tracks_of, without_viewer
from unifg.errors import ScenarioError, ViewError
from unifg.lie import SO3
from unifg.scenarios.commands import flights as results
from unifg.scenarios.commands.flights import summary
from unifg.scenarios.commands.outcome import Outcome
from unifg.scenarios.episode import silent
from unifg.scenarios.logs.columns import Recorder
from unifg.scenarios.logs.flight_log import FlightLog, landmark_rows
from unifg.scenarios.logs.flight_metrics import flight_metrics, landmark_errors
from unifg.scenarios.scenes.flight_plot import control, estimates, overview, plot_moment
from unifg.scenarios.scenes.flight_scene import flight_scene
from unifg.scenarios.simulation.layouts import Layout
from unifg.style.colours import css
from unifg.view import shapes
from unifg.view.bodies import body_of

umsgpack = pytest.importorskip("umsgpack")

DT, HORIZON = 0.05, 20
OFFSET = np.array([0.03, 0.0, 0.04])  # of the believed position [m]
SHIFT = np.array([0.06, 0.08])  # of the believed landmarks [m]


def layout() -> Layout:
    cylinders = [[3.0, 1.0, 0.4], [6.0, -1.0, 0.5], [9.5, 2.0, 0.3]]
    walls = [[[0.0, 3.0], [12.0, 3.0]], [[0.0, -3.0], [12.0, -3.0]]]
    start, target = np.array([[0.5, 0.0, 1.5], [11.5, 0.0, 1.5]])
    size = np.array([[0.0, -3.0], [12.0, 3.0]])
    return Layout(start, target, np.array(cylinders), np.array(walls), size, "made up 7")


def flight(ticks: int = 24, *, estimated: bool = True, movers: int = 1, reached: bool = True) -> FlightLog:
    """A swerve to the target that leans into its turns; constant errors of known size; cylinder 2 is never seen."""
    things, settings = layout(), {"scenario": "quadrotor-mpc", "solver": "ipm", "coupling": "sequential", "seed": 7}
    limits = {"rate_limits": [4.0, 4.0, 2.0], "thrust_limits": [2.0, 20.0]}
    true = np.array([1.0, 0.1, 0.1, 0.2, 0.3, -0.1, 0.0])
    known = {"layout": things, "settings": {**settings, "controller": limits}, "dt": DT}
    recorder = Recorder(FlightLog, **known)
    share = np.linspace(0.0, 1.0, max(ticks, 2))

    def place(s: float) -> list[float]:
        return [0.5 + 11.0 * s, math.sin(2.0 * math.pi * s), 1.5 + 0.3 * math.sin(math.pi * s)]

    way = np.array([place(float(s)) for s in share])
    for k in range(ticks):
        lean = SO3.exp(np.array([0.3 * math.cos(2.0 * math.pi * share[k]), 0.1, 0.2]))
        truth = np.concatenate([way[k], lean, [2.0, 0.0, 0.0]])
        believed = truth + np.concatenate([OFFSET, np.zeros(7)]) if estimated else truth
        ids = np.array([] if not estimated else [0] if k < 10 else [0, 1], dtype=np.intp)
        covariance = np.diag([0.04, 0.01]) / (1.0 + k)
        mass = 1.05 - 0.05 * min(1.0, 2.0 * share[k])
        ahead = np.array([place(float(share[k] + 0.15 * j / HORIZON)) for j in range(HORIZON + 1)])
        recorder.add(
            truth=truth,
            believed=believed,
            believed_sigma=np.full(9, 0.025) if estimated else np.zeros(9),
            controls=[0.1, -0.2, 0.0, 9.81 + 0.1 * k],
            plans=ahead,
            pasts=way[max(0, k - 9) : k + 1] + OFFSET if estimated else np.zeros((0, 3)),
            landmarks=landmark_rows(
                ids,
                things.cylinders[ids, :2] + SHIFT,
                np.tile(covariance, (len(ids), 1, 1)),
                [0.4, 0.5][: len(ids)],
            ),
            parameters=np.concatenate([[mass], true[1:]]) if estimated else true,
            parameters_sigma=np.array([0.02, 0.1, 0.1, 0.1, 0.1, 0.1, 0.0]) if estimated else np.zeros(7),
            parameters_true=true,
            seen=ids,
            movers=[[8.0 + 0.01 * k, -2.0, 0.4]] * movers,
            estimate_ms=5.0 if estimated else 0.0,
            plan_ms=7.0 + k if estimated else 0.0,
            compiled=0,
            statuses="converged",
            clearance=1.0 + 0.01 * (k - 12) ** 2,
            emergency=estimated and k in (5, 6),
            health=("degraded" if k == 7 else "ok") if estimated else "",
            causes="nothing is seen" if estimated and k == 7 else "",
            fault="",
        )
    return recorder.finish(collisions=0, reached=reached)


@pytest.fixture(scope="module")
def log() -> FlightLog:
    return flight()


@pytest.fixture(scope="module")
def page(log: FlightLog) -> str:
    return flight_scene(log).html()


def _objects(commands: list[dict[str, Any]]) -> set[str]:
    return {c["path"].removeprefix("/meshcat/") for c in commands if c["type"] == "set_object"}


def _vertices(commands: list[dict[str, Any]], path: str) -> Any:
    for command in commands:
        if command["type"] == "set_object" and command["path"] == f"/meshcat/{path}":
            position = command["object"]["geometries"][0]["data"]["attributes"]["position"]
            return np.frombuffer(position["array"].data, dtype=np.float32).reshape(-1, 3)
    pytest.fail(f"no object {path}")


def _shown(keys: list[tuple[int, bool]], tick: int) -> bool:
    return keys[max(index for index, (frame, _) in enumerate(keys) if frame <= tick)][1]


def test_page_loads_nothing_from_outside_and_says_what_it_shows(page: str) -> None:
    check_offline(page)
    around = without_viewer(page)
    data = data_of(around)
    assert data["title"] == "unifg: quadrotor-mpc, made up 7" and ["solver", "ipm (sequential)"] in data["facts"]
    assert data["outcome"] == "target reached, no collision" and data["good"] is True
    assert "reach of the sensor" in [key["text"] for key in data["legend"]]
    assert [view["name"] for view in data["views"]] == ["overview", "follow", "top"]


def test_failure_in_the_page(log: FlightLog) -> None:
    data = data_of(flight_scene(replace(log, reached=False, collisions=2)).html())
    assert data["outcome"] == "0.0 m short of the target, 2 collisions" and data["good"] is False


def test_same_log_same_page(page: str, log: FlightLog, tmp_path: Path) -> None:
    log.save(tmp_path / "flight.npz")
    assert flight_scene(FlightLog.load(tmp_path / "flight.npz")).html() == page


def test_drone_flies_and_leans_as_the_truth(page: str, log: FlightLog) -> None:
    tracks = tracks_of(commands_of(page))
    places = np.array([value for _, value in tracks["drone"][".position"]])
    turns = np.array([value for _, value in tracks["drone"][".quaternion"]])
    np.testing.assert_allclose(places, log.truth[:, :3])
    np.testing.assert_allclose(turns[:, [3, 0, 1, 2]], log.truth[:, 3:7])  # three.js puts w last
    plumb = np.array([value for _, value in tracks["shadow/parts"][".scale"]])
    np.testing.assert_allclose(plumb[:, 2], log.truth[:, 2])
    reach = np.array([value for _, value in tracks["sensor"][".position"]])
    np.testing.assert_allclose(reach[:, :2], log.truth[:, :2])


def test_cylinders_are_faint_until_seen(page: str, log: FlightLog) -> None:
    commands = commands_of(page)
    objects, tracks = _objects(commands), tracks_of(commands)
    assert {path for path in objects if path.startswith(("seen", "unseen"))} == {
        "seen/0", "seen/10", "unseen/0", "unseen/10",
    }  # fmt: skip

    def middles(path: str) -> set[float]:
        rows = _vertices(commands, path).reshape(-1, 48 * 4 + 49, 3)  # of one cylinder
        return {round(float(x), 3) for x in 0.5 * (rows[:, :, 0].min(axis=1) + rows[:, :, 0].max(axis=1))}

    assert middles("seen/0") == {3.0} and middles("seen/10") == {3.0, 6.0}
    assert middles("unseen/0") == {6.0, 9.5} and middles("unseen/10") == {9.5}
    for tick in range(log.ticks):
        assert _shown(tracks["unseen/0"][".visible"], tick) is (tick < 10)
        assert _shown(tracks["seen/10"][".visible"], tick) is (tick >= 10)
    faint = next(c for c in commands if c.get("path") == "/meshcat/unseen/10")["object"]["materials"][0]
    assert faint["transparent"] is True and faint["opacity"] < 0.5


def test_ellipses_have_two_sigmas_and_appear_with_their_landmark(page: str, log: FlightLog) -> None:
    tracks = tracks_of(commands_of(page))
    scales = dict(tracks["landmark 1/parts"][".scale"])
    for tick in (10, log.ticks - 1):
        row = log.landmarks[tick]
        np.testing.assert_allclose(scales[tick][:2], 2.0 * np.sqrt(np.diag(row["covariance"][1])))
    visible = tracks["landmark 1/parts"][".visible"]
    assert not _shown(visible, 9) and _shown(visible, 10)
    np.testing.assert_allclose(tracks["landmark 1"][".position"][0][1][:2], log.layout.cylinders[1, :2] + SHIFT)


def test_a_landmark_that_stands_still_does_not_creep(log: FlightLog) -> None:
    still = [log.landmarks[0]] * 20
    moved = log.landmarks[0].copy()
    moved["mean"] += 0.5
    jumping = replace(log, landmarks=still + [moved] * (log.ticks - 20))
    commands = commands_of(flight_scene(jumping).html())
    assert commands[-1]["type"] == "set_animation"
    keys = dict(tracks_of(commands)["landmark 0"][".position"])
    assert sorted(keys) == [0, 19, 20, jumping.ticks - 1]
    assert keys[19] == keys[0] != keys[20]  # else it would drift there for 20 ticks


def test_horizon_and_past_of_every_frame_are_those_of_the_log(page: str, log: FlightLog) -> None:
    commands = commands_of(page)
    for tick in range(1, log.ticks):
        for name, way in (("horizon", log.plans[tick]), ("past", log.pasts[tick])):
            middle = _vertices(commands, f"{name}/{tick}").reshape(-1, 3, 3).mean(axis=1)
            np.testing.assert_allclose(middle[[0, -1]], way[[0, -1]], atol=1e-6)


def test_the_flown_way_appears_piece_by_piece(page: str, log: FlightLog) -> None:
    """Each piece is hidden until the vehicle has flown it, and stays; together they are the whole way."""
    commands = commands_of(page)
    tracks = tracks_of(commands)
    begun = [int(path.split("/")[1]) for path in tracks if path.startswith("trail/")]
    assert begun == list(range(log.ticks - 1))
    for begin in begun:
        for name, way in (("trail", log.believed), ("truth", log.truth)):
            shown = [_shown(tracks[f"{name}/{begin}"][".visible"], moment) for moment in range(log.ticks)]
            assert shown == [moment > begin for moment in range(log.ticks)]
            points = _vertices(commands, f"{name}/{begin}")
            middle = points.reshape(-1, 3, 3).mean(axis=1)
            np.testing.assert_allclose(middle[[0, -1]], way[[begin, begin + 1], :3], atol=1e-6)


def test_a_flight_without_estimate_is_shown_without_it() -> None:
    plain = flight(estimated=False, movers=0)
    page = flight_scene(plain).html()
    objects, text = _objects(commands_of(page)), without_viewer(page)
    families = {path.split("/")[0] for path in objects}
    assert not families & {"sensor", "landmark 0", "mover 0", "unseen", "past", "truth"}
    assert "seen" in objects and "horizon/0" in objects  # all of them, all the time
    data = data_of(text)
    for words in ("reach of the sensor", "position error", "estimate + plan", "not seen yet"):
        assert words not in json.dumps([data["facts"], data["legend"], data["readouts"]])
    assert [row["name"] for row in data["readouts"]] == ["speed", "height", "clearance", "thrust", "plan"]
    assert "way flown" in [key["text"] for key in data["legend"]]


def test_readouts_are_those_of_the_log(page: str, log: FlightLog) -> None:
    rows = {row["name"]: row for row in data_of(page)["readouts"]}
    assert {len(row["texts"]) for row in rows.values()} == {log.ticks}
    assert rows["position error"]["texts"][0] == "5.0 cm" and rows["speed"]["texts"][0] == "2.00 m/s"
    assert (
        rows["mass \u00b1 \u03c3"]["texts"][0] == "1.050 \u00b1 0.020 kg"
        and rows["true mass"]["texts"][0] == "1.000 kg"
    )
    assert rows["estimate, plan"]["texts"][0] == "5.0 ms, 7.0 ms" and rows["landmarks"]["texts"][-1] == "2"
    assert rows["plan"]["texts"][5] == "converged: stored one flown" and rows["plan"]["alarms"][5] is True


def test_odd_flights_are_drawn_too(log: FlightLog) -> None:
    single = flight(1)
    assert commands_of(flight_scene(single).html())[-1]["type"] == "set_animation"
    overview(single)
    estimates(single)
    control(single)
    lost = replace(log, plans=np.full_like(log.plans, np.nan), clearance=np.full(log.ticks, np.inf))
    assert not any("horizon" in path for path in _objects(commands_of(flight_scene(lost).html())))
    overview(lost)
    control(lost)
    empty = flight(0)
    for draw in (flight_scene, overview, estimates, control, flight_metrics):
        with pytest.raises((ScenarioError, ViewError), match="no tick"):
            draw(empty)


def test_drone_fits_its_radius() -> None:
    parts = {part.name: part.mesh for part in body_of("quadrotor", 0.25, "robot")}
    for vertices, faces in parts.values():
        assert np.hypot(vertices[:, 0], vertices[:, 1]).max() <= 0.25 + 1e-9
        assert faces.min() == 0 and faces.max() == len(vertices) - 1
    rotors = [parts["front/rotors"][0], parts["back/rotors"][0]]
    assert np.hypot(*rotors[0].T[:2]).max() == pytest.approx(0.25, rel=0.01)
    assert rotors[0][:, 0].min() > 0.0 > rotors[1][:, 0].max()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tube_keeps_its_radius_in_every_direction(axis: int) -> None:
    line = np.zeros((5, 3))
    line[:, axis] = [0.0, 1.0, 1.0, 2.0, 3.0]  # two points coincide
    vertices, faces = shapes.tube(line, 0.1, sides=4)
    apart = vertices.reshape(5, 4, 3) - line[:, None]
    np.testing.assert_allclose(np.linalg.norm(apart, axis=2), 0.1)
    np.testing.assert_allclose(apart[..., axis], 0.0, atol=1e-12)
    assert len(faces) == 2 * 4 * 4 and faces.max() == 19


def test_ellipse_axes_and_thinning() -> None:
    turn = np.array([[math.cos(0.4), -math.sin(0.4)], [math.sin(0.4), math.cos(0.4)]])
    long, short, direction = shapes.ellipse_axes(turn @ np.diag([0.09, 0.01]) @ turn.T, 2.0)
    assert (long, short) == pytest.approx((0.6, 0.2))
    assert math.tan(direction) == pytest.approx(math.tan(0.4))
    line = np.column_stack([np.arange(100.0), np.zeros(100), np.zeros(100)])
    assert shapes.thin(line, 4)[:, 0].tolist() == [0.0, 33.0, 66.0, 99.0]
    assert len(shapes.thin(np.zeros((50, 3)), 4)) == 1


def test_metrics_are_those_of_the_made_up_errors(log: FlightLog) -> None:
    metrics = flight_metrics(log)
    assert metrics["succeeded"] and metrics["ticks"] == 24 and metrics["time_to_goal_s"] == pytest.approx(23 * DT)
    position, attitude = metrics["position_error_m"], metrics["attitude_error_rad"]
    assert position is not None and attitude is not None
    assert position == pytest.approx({"rms": 0.05, "max": 0.05}) and attitude["max"] == pytest.approx(0.0, abs=1e-7)
    assert metrics["coverage"] is not None and metrics["parameter_error"] is not None
    assert metrics["coverage"]["position"] == pytest.approx(1.0)  # 3 and 4 cm are within twice 2.5 cm
    assert metrics["coverage"]["mass"] == pytest.approx(np.mean(np.abs(log.parameters[:, 0] - 1.0) <= 0.04))
    assert "updraft" not in metrics["coverage"] and "updraft" not in metrics["parameter_error"]
    assert metrics["parameter_error_5s"] is None and metrics["mass_error_relative"] == pytest.approx(0.0, abs=1e-12)
    wrong = np.flatnonzero(np.abs(log.parameters[:, 0] - 1.0) >= 0.01)
    assert metrics["mass_known_s"] == pytest.approx((wrong[-1] + 1) * DT)
    landmarks = metrics["landmark_error_m"]
    assert landmarks is not None and landmarks == pytest.approx({"rms": 0.1, "max": 0.1})
    assert metrics["min_clearance_m"] == pytest.approx(1.0) and metrics["emergency_ticks"] == 2
    assert metrics["tick_ms"]["max"] == pytest.approx(5.0 + 7.0 + 23.0) and metrics["statuses"] == {"converged": 24}
    assert metrics["path_length_m"] == pytest.approx(np.linalg.norm(np.diff(log.truth[:, :3], axis=0), axis=1).sum())


def test_metrics_at_five_seconds_and_without_an_estimate() -> None:
    metrics = flight_metrics(flight(121))
    assert metrics["parameter_error_5s"] is not None and metrics["mass_error_relative_5s"] is not None
    assert metrics["mass_error_relative_5s"] == pytest.approx(0.0, abs=1e-12)
    longer = flight(301)
    early = flight_metrics(longer)["mass_error_relative_5s"]
    assert early == pytest.approx(0.05 * (1.0 - 2.0 * 100 / 300))  # tick 100 of 300, the mass is right from 150 on
    plain = flight_metrics(flight(estimated=False, reached=False))
    for key in ("position_error_m", "coverage", "parameter_error", "mass_error_relative", "time_to_goal_s"):
        assert plain[key] is None


def test_landmarks_far_from_everything_are_not_counted(log: FlightLog) -> None:
    row = log.landmarks[-1]
    stray = row.copy()
    stray["mean"][0] = [5.0, 0.9]
    assert len(landmark_errors(replace(log, landmarks=[*log.landmarks[:-1], stray]))) == 1


def test_overview_draws_the_moments_it_names(log: FlightLog) -> None:
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    assert len([ax for ax in overview(flight(3)).axes if ax.axison]) == 3
    figure = overview(log)
    times = [ax.get_title(loc="left")[:3] for ax in figure.axes]
    assert times == "0.0 0.2 0.5 0.7 0.9 1.2".split()
    legend = {text.get_text() for box in figure.legends for text in box.get_texts()}
    words = "window that is smoothed", "predicted future", "reach of the sensor", "cylinder that has been seen"
    assert all(any(word in text for text in legend) for word in words)
    ax = plot_moment(log, 12, Figure().subplots())
    faces = {to_hex(np.asarray(c.get_facecolor())[0]): c for c in ax.collections if len(np.asarray(c.get_facecolor()))}
    middles = {round(float(np.asarray(path.vertices).mean(axis=0)[0])) for path in faces[css("fixed")].get_paths()}
    assert 3 in middles and 6 in middles and max(middles) < 8  # cylinders 0 and 1 by then
    assert "stored plan" in plot_moment(log, 5, Figure().subplots()).get_title()


def test_estimates_and_controls_show_what_there_is(log: FlightLog) -> None:
    figure = estimates(log)
    titles = [ax.get_title(loc="left") for ax in figure.axes if ax.get_title(loc="left")]
    assert len(titles) == 6 + 9 and titles[0].startswith("Mass, ends +0.0 %")
    assert "Position error, z, 4.0 cm rms; 100 % within 2\u03c3" in titles
    panels = [ax for part in control(log).subfigs for ax in part.axes]
    assert len(panels) == 8
    lines = {float(np.asarray(line.get_ydata())[0]) for line in panels[3].get_lines()}
    assert {2.0, 20.0} <= lines  # limits of the thrust


def written(folder: Path, log: FlightLog, metrics: dict[str, Any]) -> list[Path]:
    return Outcome(True, False, "", metrics, results.results(log, metrics)).write(folder, silent)


@pytest.mark.product(1, of="scenes and pictures")
def test_results_leave_files_that_can_be_read_again(log: FlightLog, tmp_path: Path) -> None:
    files = written(tmp_path, log, flight_metrics(log))
    names = ["scene.html", "control.png", "estimates.png", "overview.png", "flight.npz", "metrics.json"]
    assert [path.name for path in files] == names and all(path.stat().st_size > 0 for path in files)
    assert json.loads((tmp_path / "metrics.json").read_text())["position_error_m"]["rms"] == pytest.approx(0.05)
    assert flight_metrics(FlightLog.load(tmp_path / "flight.npz")) == flight_metrics(log)
    table = summary(log)
    assert "reached after 1.15 s" in table and "ipm, sequential, 7" in table and "mass error" in table
