"""``unifg run velocity-tracking``: the scene and the picture of a drive, and its numbers."""

from __future__ import annotations

import numpy as np

from unifg.scenarios import velocity_tracking
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer
from unifg.scenarios.commands.watching import Announce, watching_iterates
from unifg.scenarios.logs.metrics import write_metrics
from unifg.scenarios.logs.solved_log import SolvedLog, held
from unifg.scenarios.scenes.velocity_plot import picture
from unifg.scenarios.scenes.velocity_scene import velocity_scene, velocity_stage
from unifg.solution.status import Status
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "run"]

SETTINGS = velocity_tracking.TrackingSettings


def run(settings: velocity_tracking.TrackingSettings, progress: Progress, announce: Announce | None = None) -> Outcome:
    """Solve the whole drive."""
    with watching_iterates(announce, velocity_stage(settings), lambda frame, row: None, progress) as watch:
        drive = velocity_tracking.run_tracking(settings, progress=watch)
    progress(1.0, "solved")

    numbers = velocity_tracking.metrics(drive)

    files: dict[str, Writer] = {
        "metrics.json": lambda path: write_metrics(path, numbers),
        "velocity_tracking.png": lambda path: write_figure(path, picture(drive), 105),
        "scene.html": lambda path: velocity_scene(drive).save(path),
    }
    interrupted = drive.solution.status is Status.INTERRUPTED
    return Outcome(
        drive.succeeded, interrupted, velocity_tracking.table(drive), numbers, files, {"drive": _driven(drive)}
    )


def _driven(drive: velocity_tracking.Drive) -> SolvedLog:
    """The drive along a straight road."""
    ways = [velocity_tracking.travelled(speed, drive.profile.dt) for speed in (drive.speed, drive.profile.speed)]
    pose, wanted = (np.column_stack([way, np.zeros((len(way), 2))]) for way in ways)
    return SolvedLog(
        discs=np.zeros((0, 3)),
        time=drive.time,
        pose=pose,
        wanted=wanted,
        speed=drive.speed,
        control=held(np.reshape(drive.force, (-1, 1))),
    )
