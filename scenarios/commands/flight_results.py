"""What a flight leaves in its folder, and the table printed for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from unifg.scenarios.log.drive_metrics import write_metrics
from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.log.flight_metrics import Errors, flight_metrics, has_estimate
from unifg.scenarios.show.control_plot import write_control
from unifg.scenarios.show.estimates_plot import write_estimates
from unifg.scenarios.show.flight_plot import write_overview
from unifg.scenarios.show.flight_scene import flight_scene

__all__ = ["summary", "write_results"]


def write_results(folder: str | Path, log: FlightLog, metrics: Mapping[str, object] | None = None) -> list[Path]:
    """Write log, metrics, pictures and scene of a flight.

    Args:
        folder: existing folder; files of the same names are replaced.
        log: a flight of at least one tick.
        metrics: what to write as metrics; None for `flight_metrics`.

    Returns:
        The files written: ``scene.html``, ``overview.png``, ``estimates.png`` (of a flight with an estimate),
        ``control.png``, ``metrics.json`` and ``flight.npz``, which `FlightLog.load` reads.

    Raises:
        ScenarioError: the flight has no tick, or meshcat is not installed.
    """
    folder = Path(folder)
    # The cheapest and most precious first, in case the user loses patience.
    numbers = write_metrics(folder / "metrics.json", flight_metrics(log) if metrics is None else metrics)
    stored = folder / "flight.npz"
    log.save(stored)
    pictures = [write_overview(folder / "overview.png", log)]
    if has_estimate(log):
        pictures.append(write_estimates(folder / "estimates.png", log))
    pictures.append(write_control(folder / "control.png", log))
    return [flight_scene(log).write(folder / "scene.html"), *pictures, numbers, stored]


def summary(log: FlightLog) -> str:
    """The outcome of a flight as a table of two columns."""
    m = flight_metrics(log)
    settings = m["settings"]
    stopped = " (interrupted)" if m["interrupted"] else ""
    words = [str(settings[key]) for key in ("solver", "coupling", "seed") if settings.get(key) is not None]
    arrival = m["time_to_goal_s"]
    target = f"{m['target_distance_m']:.2f} m away at the end" if arrival is None else f"reached after {arrival:.2f} s"
    tick = m["tick_ms"]
    rows = [
        ("scenario", f"{settings.get('scenario', 'quadrotor')}, {m['layout']}"),
        ("solver, coupling, seed", ", ".join(words)),
        ("target", target + stopped),
        ("collisions", f"{m['collisions']}"),
        ("flown", f"{m['path_length_m']:.2f} m in {m['duration_s']:.2f} s, {m['ticks']} ticks"),
        ("speed", f"mean {m['mean_speed_m_per_s']:.2f} m/s, max {m['max_speed_m_per_s']:.2f}"),
        ("smallest clearance", f"{m['min_clearance_m']:.3f} m"),
        ("position error", _errors(m["position_error_m"], "m")),
        ("velocity error", _errors(m["velocity_error_m_per_s"], "m/s")),
        ("landmark error", _errors(m["landmark_error_m"], "m")),
        ("mass error", _mass(m["mass_error_relative_5s"], m["mass_error_relative"])),
        ("plan status", ", ".join(f"{count} {status}" for status, count in m["statuses"].items())),
        ("stored plans flown", f"{m['emergency_ticks']} ticks"),
        ("estimate + plan", f"median {tick['p50']:.1f} ms, p99 {tick['p99']:.1f}, max {tick['max']:.1f}"),
    ]
    rows = [(name, value) for name, value in rows if value]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _errors(errors: Errors | None, unit: str) -> str:
    return "" if errors is None else f"rms {errors['rms']:.4f} {unit}, max {errors['max']:.4f}"


def _mass(early: float | None, last: float | None) -> str:
    if last is None:
        return ""
    return f"{100.0 * last:.2f} % at the end" + ("" if early is None else f", {100.0 * early:.2f} % after 5 s")
