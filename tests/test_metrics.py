"""Metrics of an episode whose numbers are known, and the file they end in."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from episodes import DT, episode
from unifg.errors import ScenarioError
from unifg.scenarios.logs.columns import Recorder, column, columns, ragged, words
from unifg.scenarios.logs.drive_metrics import episode_metrics, pose_errors
from unifg.scenarios.logs.metrics import statistics, table, write_metrics
from unifg.scenarios.planning.polyline import path_length
from unifg.typing import Array, IntArray

PROMISED = {
    "reached",
    "collisions",
    "steps",
    "path_length_m",
    "duration_s",
    "min_clearance_m",
    "localisation_error_m",
    "localisation_error_rad",
    "odometry_error_m",
    "solve_ms",
    "solver_failures",
    "max_bound_violation",
    "seed",
    "solver",
    "coupling",
}


def test_known_numbers() -> None:
    log = episode(ticks=40)
    metrics = episode_metrics(log)
    assert metrics.keys() >= PROMISED
    assert metrics["localisation_error_m"] == pytest.approx({"mean": 0.05, "std": 0.0, "max": 0.05})
    assert metrics["localisation_error_rad"] == pytest.approx({"mean": 0.01, "std": 0.0, "max": 0.01})
    drift = np.hypot(0.02, 0.01) * DT * np.arange(40)
    assert metrics["odometry_error_m"] == pytest.approx({"mean": drift.mean(), "std": drift.std(), "max": drift.max()})
    chords = 39 * 2 * 2.4 * np.sin((log.true_pose[1, 2] - log.true_pose[0, 2]) / 2)
    assert metrics["path_length_m"] == pytest.approx(chords)
    assert metrics["planned_length_m"] == pytest.approx(chords)
    assert metrics["duration_s"] == 3.9  # nothing is driven after the last tick
    assert metrics["mean_speed_m_per_s"] == pytest.approx(chords / 3.9)
    alone = episode_metrics(episode(ticks=1))
    assert alone["duration_s"] == alone["mean_speed_m_per_s"] == 0.0
    assert metrics["min_clearance_m"] == log.clearance[-1]
    assert metrics["solver_failures"] == metrics["emergency_ticks"] == 1
    assert metrics["plan_status"] == {"converged": 39, "stalled": 1}
    assert metrics["max_bound_violation"] == 0.0  # negative values are room, not violation
    assert metrics["localisation_iterations"] == {"mean": 2.0, "max": 2}
    assert metrics["plan_iterations"]["max"] == 3
    assert metrics["solve_ms"]["max"] == 11.0
    assert metrics["solve_ms"]["p50"] == pytest.approx(float(np.median(log.solve_ms)))
    assert (metrics["reached"], metrics["succeeded"], metrics["goals"]) == (True, True, 1)


def test_success_needs_every_goal_no_collision_and_an_end() -> None:
    log = episode(ticks=3)
    goals = np.zeros((2, 3))
    assert not episode_metrics(replace(log, collisions=1))["succeeded"]
    assert episode_metrics(replace(log, collisions=1))["reached"]
    assert not episode_metrics(replace(log, goals=goals, reached=[True, False]))["reached"]
    assert episode_metrics(replace(log, goals=goals, reached=[True, False]))["goals_reached"] == 1
    assert not episode_metrics(replace(log, interrupted=True))["succeeded"]
    assert not replace(log, reached=[]).succeeded


def test_violation_is_the_worst_of_all_ticks() -> None:
    log = episode(ticks=5)
    violation = np.array([0.0, 2e-4, -1.0, 1e-5, 0.0])
    assert episode_metrics(replace(log, bound_violation=violation))["max_bound_violation"] == 2e-4


def test_heading_error_is_taken_the_short_way_round() -> None:
    distance, angle = pose_errors(np.array([[0.0, 3.0, 3.1]]), np.array([[4.0, 0.0, -3.1]]))
    assert distance[0] == 5.0
    assert angle[0] == pytest.approx(2 * np.pi - 6.2)


def test_path_length_of_a_square_and_of_a_point() -> None:
    square = np.array([[0, 0, 1], [2, 0, 5], [2, 2, 0], [0, 2, 0], [0, 0, 0]], dtype=np.float64)
    assert path_length(square) == 8.0
    assert path_length(square[:1]) == 0.0


def test_empty_episode_is_refused() -> None:
    log = episode(ticks=3)
    with pytest.raises(ScenarioError, match="no tick"):
        episode_metrics(replace(log, plan_ms=log.plan_ms[:0]))


def test_same_seed_differs_in_timings_only() -> None:
    first, second = episode(), episode()
    second.solve_ms = second.solve_ms + 1.0
    second.localise_ms = 2.0 * second.localise_ms
    second.plan_ms = 3.0 * second.plan_ms
    second.perceive_ms = second.perceive_ms + 1.0
    second.route_ms = second.route_ms + 1.0
    one, other = episode_metrics(first), episode_metrics(second)
    assert one != other
    assert {key for key in one if one[key] != other[key]} <= {key for key in one if key.endswith("_ms")}
    assert one.keys() >= PROMISED


def test_a_recorder_copies_and_wants_every_column_once() -> None:
    @dataclass(kw_only=True)
    class Log:
        name: str
        end: int
        place: Array = column("m", 2)
        way: Array = column("m", None, 3)
        seen: list[IntArray] = ragged(dtype=np.intp)
        tick_ms: Array = column("ms")
        steps: IntArray = column("iterations", dtype=np.intp)
        word: list[str] = words()

    recorder = Recorder(Log, name="x")
    place = np.zeros(2)
    row = {"way": np.zeros((4, 3)), "tick_ms": 2.0, "steps": 3, "word": "ok"}
    for k in range(3):
        place[:] = k
        recorder.add(place=place, seen=range(k), **row)
    log = recorder.finish(end=7)
    assert (log.name, log.end, log.word) == ("x", 7, ["ok"] * 3)
    np.testing.assert_array_equal(log.place, [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])
    assert log.way.shape == (3, 4, 3) and [ids.tolist() for ids in log.seen] == [[], [0], [0, 1]]
    assert statistics(log) == {"tick_ms": {"p50": 2.0, "p99": 2.0, "max": 2.0}, "steps": {"mean": 3.0, "max": 3}}
    assert columns(log)["place"].unit == "m" and "name" not in columns(log)
    for wrong in ({**row, "seen": []}, {**row, "seen": [], "place": place, "more": 1}):
        with pytest.raises(ScenarioError, match=r"place|more"):
            recorder.add(**wrong)
    with pytest.raises(ValueError, match="reshape"):
        recorder.add(place=np.zeros(3), seen=[], **row)
    empty = Recorder(Log, name="y").finish(end=0)
    assert empty.place.shape == (0, 2) and empty.way.shape == (0, 0, 3) and empty.seen == []


def test_file_is_strict_sorted_and_stable(tmp_path: Path) -> None:
    log = episode(ticks=6)
    log.clearance = np.full(6, np.inf)  # nothing around: JSON has no infinity
    metrics = episode_metrics(log)
    path = write_metrics(tmp_path / "metrics.json", metrics)

    def refuse(word: str) -> float:
        raise AssertionError(f"{word} is not JSON")

    read = json.loads(path.read_text(), parse_constant=refuse)
    assert read["min_clearance_m"] is None
    assert read["localisation_error_m"] == metrics["localisation_error_m"]  # floats survive exactly
    assert list(read) == sorted(read)
    assert list(read["solve_ms"]) == ["max", "p50", "p99"]
    assert type(read["seed"]) is int
    reversed_keys = dict(reversed(list(metrics.items())))
    assert write_metrics(tmp_path / "again.json", reversed_keys).read_bytes() == path.read_bytes()


def test_table_aligns_and_leaves_out_what_is_empty() -> None:
    assert table([("a", "1"), ("nothing", ""), ("long name", "2")]) == "a          1\nlong name  2"


@dataclass
class Way:
    """A record with a path that lasts."""

    path: list[Array] = ragged("m", 2, lasting=True)
    seen: list[Array] = ragged("m", 2)


def test_what_lasts_is_kept_once_and_copied_still() -> None:
    recorder, path = Recorder(Way), np.array([[0.0, 1.0], [2.0, 3.0]])
    for _ in range(2):
        recorder.add(path=path, seen=path)
    path[0, 0] = 5.0  # by whoever it belongs to
    recorder.add(path=path, seen=path)
    recorder.add(path=path[:1], seen=path[:1])
    log = recorder.finish()
    assert [len(row) for row in log.path] == [2, 2, 2, 1]
    assert log.path[0] is log.path[1] and log.path[1] is not log.path[2]
    assert [row[0, 0] for row in log.path] == [0.0, 0.0, 5.0, 5.0]
    assert log.seen[0] is not log.seen[1]
