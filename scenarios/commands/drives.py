"""``unifg run navigation``: what a drive leaves in its folder, and the table printed for people."""

from __future__ import annotations

from dataclasses import replace

from unifg.errors import ScenarioError
from unifg.files.tum import write_tum
from unifg.scenarios import navigation
from unifg.scenarios.commands import replays
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer, recorded
from unifg.scenarios.commands.watching import Announce, watching_ticks
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.logs.metrics import health, one_graph, table, write_metrics
from unifg.scenarios.options import Unasked
from unifg.scenarios.scenes.drive_plot import overview
from unifg.scenarios.scenes.drive_scene import drive_frame, drive_scene, drive_stage
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "results", "run", "summary"]

SETTINGS = navigation.NavigationSettings


def run(settings: navigation.NavigationSettings, progress: Progress, announce: Announce | None = None) -> Outcome:
    """Drive, or follow a recorded drive.

    Raises:
        KeyboardInterrupt: when stopped before the first tick.
        ScenarioError: when start, goals or obstacles do not fit the map, or there is none for the log, or something is
            asked for that a recorded drive has no use for.
    """
    if settings.log is not None:
        if settings.map is None:
            raise ScenarioError("a recorded drive is followed on a map of its place: give --map")
        taken = {name: getattr(settings, name) for name in ("log", "map", "start", "localiser", "seed")}
        used = navigation.NavigationSettings(**taken)
        if isinstance(settings.obstacles, Unasked):
            used = replace(used, obstacles=settings.obstacles)
        if idle := [name for name, value in vars(used).items() if getattr(settings, name) != value]:
            raise ScenarioError(f"a recorded drive is not simulated, leave out: {', '.join(idle)}")
        return replays.run(replays.SETTINGS(**taken), progress)
    with watching_ticks(announce, drive_stage, drive_frame):
        log, error = recorded(lambda: navigation.run_navigation(settings, progress=progress))
    numbers = episode_metrics(log)
    return Outcome(log.succeeded, log.interrupted, summary(log), numbers, results(log), {"drive": log}, error)


def results(log: EpisodeLog) -> dict[str, Writer]:
    """Results of an episode of at least one tick: numbers, both trajectories, the log, a picture and a scene.

    ``trajectory.tum`` is the truth, `EpisodeLog.load` reads ``drive.npz``.
    """
    return {
        "metrics.json": lambda path: write_metrics(path, episode_metrics(log)),
        "trajectory.tum": lambda path: write_tum(path, log.time, log.true_pose),
        "estimate.tum": lambda path: write_tum(path, log.time, log.estimate),
        "drive.npz": log.save,
        "overview.png": lambda path: write_figure(path, overview(log), 130),
        "scene.html": lambda path: drive_scene(log).save(path),
    }


def summary(log: EpisodeLog) -> str:
    """The outcome of an episode as a table of two columns."""
    m = episode_metrics(log)
    placed, wanted, stopped = m["obstacles"], m["obstacles_wanted"], " (interrupted)" if m["interrupted"] else ""
    spread = "mean {mean:.4f} {unit}, std {std:.4f}, max {max:.4f}"
    rows = (
        ("scenario", f"{m['scenario']} on {m['map']}{one_graph(m['coupling'])}"),
        ("solver, coupling, seed", f"{m['solver']}, {m['coupling']}, {m['seed']}"),
        ("base, body", f"{m['base']}, {m['body']}" if log.body or log.base != "unicycle" else ""),
        ("goals reached", f"{m['goals_reached']} of {m['goals']}{stopped}"),
        *((f"goal {k + 1}", words) for k, words in enumerate(m["outcomes"]) if words != "reached"),
        ("obstacles", f"{placed} of {wanted} found a place that leaves a way" if placed < wanted else ""),
        ("health", health(m)),
        ("samples not let in", ", ".join(f"{count} {what}" for what, count in m["dropped_samples"].items())),
        ("collisions", f"{m['collisions']}"),
        *((f"{each['thing']}, {each['time']:.1f} s", each["cause"]) for each in m["contacts"]),
        ("driven", f"{m['path_length_m']:.2f} m in {m['duration_s']:.1f} s, {m['steps']} ticks"),
        ("planned path", f"{m['planned_length_m']:.2f} m"),
        ("smallest clearance", f"{m['min_clearance_m']:.3f} m"),
        ("localisation error", spread.format(unit="m", **m["localisation_error_m"])),
        ("", spread.format(unit="rad", **m["localisation_error_rad"])),
        ("odometry error", spread.format(unit="m", **m["odometry_error_m"])),
        ("localise + plan", "median {p50:.1f} ms, p99 {p99:.1f}, max {max:.1f}".format(**m["solve_ms"])),
        ("whole tick", "median {p50:.1f} ms, p99 {p99:.1f}, max {max:.1f}".format(**m["tick_ms"])),
        ("solver failures", f"{m['solver_failures']}"),
        ("worst bound violation", f"{m['max_bound_violation']:.1e}"),
    )
    return table(rows)
