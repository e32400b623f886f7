"""``unifg run quadrotor-cbf``: what flights past obstacles leave in their folder, and the table for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from unifg.scenarios import safe_flight
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer
from unifg.scenarios.commands.watching import Announce, watching_ticks
from unifg.scenarios.logs.metrics import table, write_metrics
from unifg.scenarios.logs.safe_log import SafeLog, safe_metrics
from unifg.scenarios.scenes.safe_plot import picture
from unifg.scenarios.scenes.safe_scene import safe_frame, safe_scene, safe_stage
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "run", "safe_numbers", "summary"]

SETTINGS = safe_flight.SafeSettings


def run(settings: safe_flight.SafeSettings, progress: Progress, announce: Announce | None = None) -> Outcome:
    """Fly all that is asked for.

    Raises:
        KeyboardInterrupt: when stopped before the first tick.
        ScenarioError: for a case or a controller that is unknown.
    """
    with watching_ticks(announce, safe_stage, safe_frame):
        logs = [log for log in safe_flight.run_safe_flights(settings, progress) if log.ticks]
    if not logs:
        raise KeyboardInterrupt
    numbers = safe_numbers(logs)
    files: dict[str, Writer] = {
        "metrics.json": lambda path: write_metrics(path, numbers),
        "flights.png": lambda path: write_figure(path, picture(logs), 110),
        "scene.html": lambda path: safe_scene(logs[0]).save(path),  # of the first
    }
    flown = {log.label.replace(" ", "-").replace("/", "-per-") or "flight": log for log in logs}
    return Outcome(numbers["succeeded"], logs[-1].interrupted, summary(logs), numbers, files, flown)


def safe_numbers(logs: Sequence[SafeLog]) -> dict[str, Any]:
    """The numbers of flights of one case."""
    return {
        "scenario": "quadrotor-cbf",
        "case": logs[0].settings["case"],
        "succeeded": all(log.succeeded for log in logs),
        "flights": [safe_metrics(log) for log in logs],
    }


def summary(logs: Sequence[SafeLog]) -> str:
    """The outcome for people, one line for each flight."""
    rows = [("flight", "boundary distance", "path kept to", "top speed", "decided in", "outcome")]
    for log in logs:
        m = safe_metrics(log)
        near = m["min_boundary_distance_m"]
        kept = "TOUCHED" if log.touched else "margin NOT KEPT" if log.violated else "kept its distance"
        arrived = "" if log.end is None else "arrived" if log.arrived else "NOT THERE"
        words = [kept if len(log.radii) else "", "interrupted" if log.interrupted else arrived]
        rows.append(
            (
                log.label,
                "-" if near is None else f"{near:.3f} m",
                "{rms:.3f} m rms".format(**m["tracking_error_m"]),
                f"{m['max_speed_m_per_s']:.2f} m/s",
                "{p50:.2f} ms, p99 {p99:.2f}".format(**m["decide_ms"]),
                ", ".join(filter(None, words)) or "flown to the end",
            )
        )
    return table(rows)
