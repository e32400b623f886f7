"""A drive as MCAP: read again by mcap's own reader, compared with the log."""

from __future__ import annotations

import base64
import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from episodes import episode
from test_quadrotor_scene import flight
from unifg.scenarios.command import main
from unifg.scenarios.commands import safe_flights
from unifg.scenarios.logs.columns import columns
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.mcap_log import write_mcap
from unifg.scenarios.manoeuvres import CASES, run_manoeuvre
from unifg.scenarios.safe_flight import SafeSettings, run_safe_flights
from unifg.scenarios.velocity_tracking import TrackingSettings, run_tracking

Recorded = dict[str, list[tuple[int, dict[str, Any]]]]


def refuse(word: str) -> Any:
    raise AssertionError(f"{word} is not JSON")


def recorded(path: Path) -> Recorded:
    reader = pytest.importorskip("mcap.reader")
    found: Recorded = {}
    with open(path, "rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            content = json.loads(message.data, parse_constant=refuse)
            declared = json.loads(schema.data)["properties"]
            assert set(content) <= set(declared), (channel.topic, set(content) - set(declared))
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def yaw(pose: dict[str, float]) -> float:
    return 2 * float(np.arctan2(pose["z"], pose["w"]))


def test_every_tick_is_there_at_its_time(tmp_path: Path) -> None:
    log = episode(ticks=6)
    log.horizon[3] = np.nan  # a tick without a plan
    log.obstacles[2, 1] = np.nan  # an obstacle that is nowhere
    write_mcap(tmp_path / "drive.mcap", log)
    found = recorded(tmp_path / "drive.mcap")
    stamps = [round(t * 1e9) for t in log.time]
    for topic in ("/tf", "/scan", "/plan", "/obstacles", "/tracked", "/tick"):
        assert [stamp for stamp, _ in found[topic]] == stamps, topic
    for k in range(log.ticks):
        frames = {frame["child_frame_id"]: frame for frame in found["/tf"][k][1]["transforms"]}
        for name, pose in (("estimate", log.estimate[k]), ("truth", log.true_pose[k])):
            place = frames[name]["translation"]
            turned = yaw(frames[name]["rotation"])
            np.testing.assert_allclose([place["x"], place["y"], turned], pose, atol=1e-12)
        ranges = np.array(found["/scan"][k][1]["ranges"])
        np.testing.assert_array_equal(ranges, np.where(np.isfinite(log.scan[k]), log.scan[k], 0.0))
        tick = found["/tick"][k][1]
        assert tick["control"] == log.control[k].tolist()
        assert tick["status"] == log.status[k]
        assert tick["emergency"] == bool(log.emergency[k])
    assert found["/plan"][3][1]["poses"] == []
    assert len(found["/plan"][0][1]["poses"]) == log.horizon.shape[1]
    discs = [len(message["entities"][0]["cylinders"]) for _, message in found["/obstacles"]]
    assert discs == [2, 2, 1, 2, 2, 2]
    units = {"control": "m/s, rad/s", "solve_ms": "ms"}
    with open(tmp_path / "drive.mcap", "rb") as file:
        summary = pytest.importorskip("mcap.reader").make_reader(file).get_summary()
    declared = next(json.loads(s.data) for s in summary.schemas.values() if s.name == "unifg.Tick")["properties"]
    assert {name: declared[name]["description"] for name in units} == units


def test_the_map_is_where_it_was(tmp_path: Path) -> None:
    log = episode(ticks=1, map_yaw=0.3)
    write_mcap(tmp_path / "drive.mcap", log)
    ((_, grid),) = recorded(tmp_path / "drive.mcap")["/map"]
    cells = np.frombuffer(base64.b64decode(grid["data"]), dtype=np.uint8).reshape(-1, grid["column_count"])
    np.testing.assert_array_equal(cells == 100, log.occupancy.occupied)
    np.testing.assert_array_equal(cells == 0, log.occupancy.free)
    assert (grid["pose"]["position"]["x"], grid["pose"]["position"]["y"]) == log.occupancy.origin[:2]
    assert yaw(grid["pose"]["orientation"]) == pytest.approx(0.3)


def test_a_route_is_told_when_it_changes_also_after_loading(tmp_path: Path) -> None:
    log = episode(ticks=5)
    log.route = [log.path, log.path, log.path[:3], log.path[:3], log.path[:3]]
    log.save(tmp_path / "drive.npz")
    write_mcap(tmp_path / "drive.mcap", EpisodeLog.load(tmp_path / "drive.npz"))
    found = recorded(tmp_path / "drive.mcap")["/route"]
    assert [(stamp, len(message["poses"])) for stamp, message in found] == [(0, len(log.path)), (round(0.2e9), 3)]


def test_an_episode_that_never_began_has_its_map_and_path(tmp_path: Path) -> None:
    log = episode(ticks=1)
    write_mcap(tmp_path / "drive.mcap", replace(log, **{name: getattr(log, name)[:0] for name in columns(log)}))
    assert set(recorded(tmp_path / "drive.mcap")) == {"/map", "/goals", "/route"}


def test_the_command_takes_a_folder_or_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mcap")
    episode(ticks=2).save(tmp_path / "drive.npz")
    assert main(["mcap", str(tmp_path)]) == 0
    assert main(["mcap", str(tmp_path / "drive.npz"), "--out", str(tmp_path / "other.mcap")]) == 0
    assert (tmp_path / "drive.mcap").read_bytes() == (tmp_path / "other.mcap").read_bytes()
    assert main(["mcap", str(tmp_path / "nowhere")]) == 2
    assert main(["mcap", str(tmp_path), "--out", str(tmp_path / "no" / "x.mcap")]) == 2
    said = capsys.readouterr()
    assert "drive.mcap" in said.out
    assert re.search(r"DIR: .*nowhere: no such file; give the results of unifg run", said.err)
    (tmp_path / "empty").mkdir()
    assert main(["mcap", str(tmp_path / "empty")]) == 2
    assert "empty: holds neither drive.npz nor flight.npz; give the results" in capsys.readouterr().err


def test_the_command_takes_the_latest_log_under_any_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mcap")
    flight().save(tmp_path / "flight.npz")
    flight().save(tmp_path / "seed 3.npz")
    episode(ticks=2).save(tmp_path / "drive.npz")
    os.utime(tmp_path / "flight.npz", (1, 1))
    assert main(["mcap", str(tmp_path)]) == 0
    assert capsys.readouterr().out.endswith("drive.mcap\n")
    os.utime(tmp_path / "drive.npz", (0, 0))
    assert main(["mcap", str(tmp_path)]) == main(["mcap", str(tmp_path / "seed 3.npz")]) == 0
    assert (tmp_path / "flight.mcap").read_bytes() == (tmp_path / "seed 3.mcap").read_bytes()


@pytest.mark.parametrize("name", ["drive", "flight"])
def test_a_file_that_is_no_log_is_not_taken_for_one_to_trust(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (tmp_path / f"{name}.npz").write_text('{"kind": "metrics"}', encoding="utf-8")
    assert main(["mcap", str(tmp_path / f"{name}.npz")]) == 2
    said = capsys.readouterr().err
    assert f"is no unifg {name} log" in said and "pickle" not in said


def test_without_mcap_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    episode(ticks=1).save(tmp_path / "drive.npz")
    assert main(["mcap", str(tmp_path)]) == 2
    assert "pip install 'unifg[mcap]'" in capsys.readouterr().err
    assert not (tmp_path / "drive.mcap").exists()


def places(messages: list[tuple[int, dict[str, Any]]], child: str) -> Any:
    """(T, 7) positions and quaternions (w, x, y, z) of a frame."""
    rows = []
    for _, message in messages:
        frame = next(one for one in message["transforms"] if one["child_frame_id"] == child)
        place, turn = frame["translation"], frame["rotation"]
        rows.append([place["x"], place["y"], place["z"], turn["w"], turn["x"], turn["y"], turn["z"]])
    return np.array(rows)


def ways(messages: list[tuple[int, dict[str, Any]]]) -> Any:
    return [[list(pose["position"].values()) for pose in message["poses"]] for _, message in messages]


def test_a_flight_is_read_back(tmp_path: Path) -> None:
    log = flight(6)
    log.save(tmp_path / "flight.npz")
    assert main(["mcap", str(tmp_path)]) == 0
    found = recorded(tmp_path / "flight.mcap")
    np.testing.assert_array_equal(places(found["/tf"], "truth"), log.truth[:, :7])
    np.testing.assert_array_equal(places(found["/tf"], "estimate"), log.believed[:, :7])
    np.testing.assert_array_equal(ways(found["/plan"]), log.plans)
    assert [np.shape(way) for way in ways(found["/past"])] == [np.shape(past) for past in log.pasts]
    solids = found["/obstacles"][0][1]["entities"][0]["cylinders"]
    rows = [[one["pose"]["position"]["x"], one["pose"]["position"]["y"], one["size"]["x"] / 2] for one in solids]
    np.testing.assert_allclose(rows, np.concatenate([log.layout.cylinders, log.movers[0]]))
    for k, (stamp, tick) in enumerate(found["/tick"]):
        assert stamp == round(1e9 * log.time[k]) and tick["controls"] == log.controls[k].tolist()
        assert tick["statuses"] == log.statuses[k] and "landmarks" not in tick


@pytest.mark.product(1, of="scenes and pictures")
def test_a_flight_past_bodies_is_read_back(tmp_path: Path) -> None:
    def stop(done: float, text: str) -> None:
        if done > 0.05:
            raise KeyboardInterrupt

    (log,) = run_safe_flights(SafeSettings(case="ball", controller=("flatness",)), stop)
    write_mcap(tmp_path / "flight.mcap", log)
    found = recorded(tmp_path / "flight.mcap")
    np.testing.assert_allclose(places(found["/tf"], "truth"), log.states[:, :7], atol=1e-12)
    np.testing.assert_allclose(ways(found["/plan"]), log.plans, atol=1e-9)
    for (_, message), bodies in zip(found["/obstacles"], log.bodies, strict=False):
        entity = message["entities"][0]
        solids = [*entity["cylinders"], *entity["spheres"]]
        radii = np.concatenate([log.radii[log.upright], log.radii[~log.upright]])
        np.testing.assert_allclose([one["size"]["x"] / 2 for one in solids], radii)
        x = [one["pose"]["position"]["x"] for one in entity["spheres"]]
        np.testing.assert_allclose(x, bodies[~log.upright, 0], atol=1e-12)


def test_flights_of_several_speeds_have_names_of_files() -> None:
    def stop(done: float, text: str) -> None:
        if done > 1e-3:
            raise KeyboardInterrupt

    outcome = safe_flights.run(SafeSettings(case="figure8", controller=("flatness",)), stop)
    assert list(outcome.logs) == ["1-m-per-s"]


@pytest.mark.product(1, of="scenes and pictures")
@pytest.mark.usefixtures("undrawn")
def test_every_scenario_writes_one(tmp_path: Path) -> None:
    """Numbers of the file are those of the run, which is repeated."""
    pytest.importorskip("mcap")
    assert main(["run", "manoeuvres", "--case", "obstacle", "--mcap", "--out", str(tmp_path)]) == 0
    solved = run_manoeuvre(CASES["obstacle"])
    found = recorded(tmp_path / "obstacle.mcap")
    np.testing.assert_allclose(places(found["/tf"], "truth")[:, :2], solved.states[:, :2], atol=1e-12)
    np.testing.assert_allclose([tick["control"] for _, tick in found["/tick"]][:-1], solved.controls, atol=1e-12)
    assert main(["run", "velocity-tracking", "--length", "20", "--mcap", "--out", str(tmp_path)]) == 0
    drive = run_tracking(TrackingSettings(length=20))
    ticks = [tick for _, tick in recorded(tmp_path / "drive.mcap")["/tick"]]
    np.testing.assert_allclose([tick["speed"] for tick in ticks], drive.speed, atol=1e-12)
    assert main(["run", "quadrotor-obstacles", "--mcap", "--out", str(tmp_path)]) == 0
    assert len(recorded(tmp_path / "flight.mcap")["/plan"]) > 10
