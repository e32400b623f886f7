"""``unifg run quadrotor-mpc``: what a flight leaves in its folder, and the table printed for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from unifg.scenarios import flight
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer, recorded
from unifg.scenarios.commands.watching import Announce, watching_ticks
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics
from unifg.scenarios.logs.metrics import health, table, write_metrics
from unifg.scenarios.scenes.flight_plot import control, estimates, overview
from unifg.scenarios.scenes.flight_scene import flight_frame, flight_scene, flight_stage
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "results", "run", "summary"]

SETTINGS = flight.FlightSettings
REACHED = 0.95  # of the speed asked for, from which nothing is said


def run(settings: flight.FlightSettings, progress: Progress, announce: Announce | None = None) -> Outcome:
    """Fly.

    Raises:
        KeyboardInterrupt: when stopped before the first tick.
        ScenarioError: when the movers do not fit into the corridor.
    """
    with watching_ticks(announce, flight_stage, flight_frame):
        log, error = recorded(lambda: flight.run_flight(settings, progress))
    numbers = flight_metrics(log)
    return Outcome(log.succeeded, log.interrupted, summary(log), numbers, results(log, numbers), {"flight": log}, error)


def results(log: FlightLog, metrics: Mapping[str, object]) -> dict[str, Writer]:
    """Results of a flight of at least one tick: numbers, log, pictures and scene; `FlightLog.load` reads the log.

    Args:
        log: a flight; one without an estimate has no picture of it.
        metrics: what to write as metrics.
    """
    return {
        "metrics.json": lambda path: write_metrics(path, metrics),
        "flight.npz": log.save,
        "overview.png": lambda path: write_figure(path, overview(log), 130),
        "estimates.png": lambda path: write_figure(path, estimates(log), 120),
        "control.png": lambda path: write_figure(path, control(log), 120),
        "scene.html": lambda path: flight_scene(log).save(path),
    }


def summary(log: FlightLog) -> str:
    """The outcome of a flight as a table of two columns."""
    m = flight_metrics(log)
    settings = m["settings"]
    stopped = " (interrupted)" if m["interrupted"] else ""
    arrival = m["time_to_goal_s"]
    target = f"{m['target_distance_m']:.2f} m away at the end" if arrival is None else f"reached after {arrival:.2f} s"
    rows = (
        ("scenario", f"{settings['scenario']}, {m['layout']}"),
        ("solver, coupling, seed", f"{settings['solver']}, {settings['coupling']}, {settings['seed']}"),
        ("target", target + stopped),
        ("outcome", "" if m["outcome"] in ("reached", "interrupted") else m["outcome"]),
        ("health", health(m) if any(log.health) else ""),
        ("samples not let in", ", ".join(f"{count} {what}" for what, count in m["dropped_samples"].items())),
        ("collisions", f"{m['collisions']}"),
        ("flown", f"{m['path_length_m']:.2f} m in {m['duration_s']:.2f} s, {m['ticks']} ticks"),
        ("speed", f"mean {m['mean_speed_m_per_s']:.2f} m/s, max {m['max_speed_m_per_s']:.2f}" + _short_of(m)),
        ("smallest clearance", f"{m['min_clearance_m']:.3f} m"),
        ("position error", _errors(m["position_error_m"], "m")),
        ("velocity error", _errors(m["velocity_error_m_per_s"], "m/s")),
        ("landmark error", _errors(m["landmark_error_m"], "m")),
        ("mass error", _mass(m["mass_error_relative_5s"], m["mass_error_relative"])),
        ("plan status", ", ".join(f"{count} {status}" for status, count in m["statuses"].items())),
        ("stored plans flown", f"{m['emergency_ticks']} ticks"),
        ("estimate + plan", "median {p50:.1f} ms, p99 {p99:.1f}, max {max:.1f}".format(**m["tick_ms"])),
    )
    return table(rows)


def _short_of(m: Mapping[str, Any]) -> str:
    """Words where the speed asked for was not reached, with the reason in a flight that was flown to its target."""
    guide = m["settings"].get("controller", {}).get("guide", {})
    asked = guide.get("speed", 0.0)
    if m["max_speed_m_per_s"] >= REACHED * asked:
        return ""
    why = f": bends and the way's length allow no more at {guide['acceleration']:g} m/s^2" if m["reached"] else ""
    return f" of {asked:g} asked for{why}"


def _errors(errors: Mapping[str, float] | None, unit: str) -> str:
    return "" if errors is None else f"rms {errors['rms']:.4f} {unit}, max {errors['max']:.4f}"


def _mass(early: float | None, last: float | None) -> str:
    if last is None:
        return ""
    return f"{100.0 * last:.2f} % at the end" + ("" if early is None else f", {100.0 * early:.2f} % after 5 s")
