"""``unifg run velocity-tracking``: the scene and the picture of a drive, and its numbers."""

from __future__ import annotations

from pathlib import Path

from unifg.scenarios import velocity_tracking
from unifg.scenarios.commands.outcome import Outcome, Progress, by_iterations
from unifg.scenarios.commands.watching import Announce, watching_iterates
from unifg.scenarios.logs.metrics import write_metrics
from unifg.scenarios.scenes.velocity_plot import picture
from unifg.scenarios.scenes.velocity_scene import velocity_scene, velocity_stage
from unifg.solution.status import Status
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "run"]

SETTINGS = velocity_tracking.TrackingSettings


def run(settings: velocity_tracking.TrackingSettings, progress: Progress, announce: Announce | None = None) -> Outcome:
    """Solve the whole drive."""
    tell = by_iterations(progress, 0.7, lambda row: f"iteration {row.number}, cost {2.0 * row.cost:.8g}")
    with watching_iterates(announce, velocity_stage(settings), lambda frame, row: None, tell) as watch:
        drive = velocity_tracking.run_tracking(settings, progress=watch)
    progress(1.0, "solved")

    numbers = velocity_tracking.metrics(drive)

    def write(folder: Path) -> list[Path]:
        shown = write_figure(folder / "velocity_tracking.png", picture(drive), 105)
        scene = velocity_scene(drive).save(folder / "scene.html")
        return [scene, shown, write_metrics(folder / "metrics.json", numbers)]

    interrupted = drive.solution.status is Status.INTERRUPTED
    return Outcome(drive.succeeded, interrupted, velocity_tracking.table(drive), numbers, write)
