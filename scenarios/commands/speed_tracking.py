"""``unifg run velocity-tracking``: the picture of a drive and its numbers."""

from __future__ import annotations

from pathlib import Path

from unifg.answers.status import Status
from unifg.scenarios import velocity_tracking
from unifg.scenarios.commands.outcome import Outcome, Progress, by_iterations
from unifg.scenarios.show.velocity_plot import picture
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "run"]

SETTINGS = velocity_tracking.TrackingSettings


def run(settings: velocity_tracking.TrackingSettings, progress: Progress) -> Outcome:
    """Solve the whole drive."""
    tell = by_iterations(progress, 0.7, lambda row: f"iteration {row.number}, cost {2.0 * row.cost:.8g}")
    drive = velocity_tracking.run_tracking(settings, progress=tell)
    progress(1.0, "solved")

    def write(folder: Path) -> list[Path]:
        shown = write_figure(folder / "velocity_tracking.png", picture(drive), 105)
        return [shown, velocity_tracking.write_metrics(folder / "metrics.json", drive)]

    interrupted = drive.solution.status is Status.INTERRUPTED
    return Outcome(drive.succeeded, interrupted, velocity_tracking.table(drive), write)
