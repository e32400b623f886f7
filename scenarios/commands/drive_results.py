"""What a run leaves in its folder, and the table printed for people."""

from __future__ import annotations

from pathlib import Path

from unifg.files.tum import write_tum
from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.log.drive_metrics import Spread, Timing, episode_metrics, write_metrics
from unifg.scenarios.show.drive_plot import write_overview
from unifg.scenarios.show.drive_scene import drive_scene

__all__ = ["summary", "write_results"]


def write_results(folder: Path, log: EpisodeLog) -> list[Path]:
    """Write scene, picture, metrics and both trajectories of an episode.

    Args:
        folder: existing folder; files of the same names are replaced.
        log: an episode of at least one tick.

    Returns:
        The files written: ``scene.html``, ``overview.png``, ``metrics.json``, ``trajectory.tum`` (the truth) and
        ``estimate.tum``.

    Raises:
        ScenarioError: the episode has no tick.
    """
    # The cheapest and most precious first, in case the user loses patience.
    metrics = write_metrics(folder / "metrics.json", episode_metrics(log))
    trajectory = write_tum(folder / "trajectory.tum", log.time, log.true_pose)
    estimate = write_tum(folder / "estimate.tum", log.time, log.estimate)
    overview = write_overview(folder / "overview.png", log)
    scene = drive_scene(log).write(folder / "scene.html")
    return [scene, overview, metrics, trajectory, estimate]


def summary(log: EpisodeLog) -> str:
    """The outcome of an episode as a table of two columns."""
    metrics = episode_metrics(log)
    stopped = " (interrupted)" if metrics["interrupted"] else ""
    rows = (
        ("scenario", f"{metrics['scenario']} on {metrics['map']}"),
        ("solver, coupling, seed", f"{metrics['solver']}, {metrics['coupling']}, {metrics['seed']}"),
        ("goals reached", f"{metrics['goals_reached']} of {metrics['goals']}{stopped}"),
        ("collisions", f"{metrics['collisions']}"),
        (
            "driven",
            f"{metrics['path_length_m']:.2f} m in {metrics['duration_s']:.1f} s, {metrics['steps']} ticks",
        ),
        ("planned path", f"{metrics['planned_length_m']:.2f} m"),
        ("smallest clearance", f"{metrics['min_clearance_m']:.3f} m"),
        ("localisation error", _spread(metrics["localisation_error_m"], "m")),
        ("", _spread(metrics["localisation_error_rad"], "rad")),
        ("odometry error", _spread(metrics["odometry_error_m"], "m")),
        ("localise + plan", _timing(metrics["solve_ms"])),
        ("solver failures", f"{metrics['solver_failures']}"),
        ("worst bound violation", f"{metrics['max_bound_violation']:.1e}"),
    )
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _spread(spread: Spread, unit: str) -> str:
    return f"mean {spread['mean']:.4f} {unit}, std {spread['std']:.4f}, max {spread['max']:.4f}"


def _timing(timing: Timing) -> str:
    return f"median {timing['p50']:.1f} ms, p99 {timing['p99']:.1f}, max {timing['max']:.1f}"
