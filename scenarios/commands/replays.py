"""``unifg localise`` and ``unifg run navigation --log``: a log followed on a map, with its numbers and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from unifg.files.range_log import aligned
from unifg.files.ros_map import load_map
from unifg.files.tum import write_tum
from unifg.scenarios import log_drive
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer
from unifg.scenarios.logs.metrics import errors, spread, table, write_metrics
from unifg.scenarios.range_logs import FAILED, LogRun
from unifg.scenarios.scenes.log_scene import log_scene, picture
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "outcome_of", "run"]

SETTINGS = log_drive.LocaliseSettings


def run(settings: log_drive.LocaliseSettings, progress: Progress) -> Outcome:
    """Follow a log on a map."""
    return outcome_of(log_drive.localise(settings.opened(), load_map(settings.map), settings, progress))


def outcome_of(made: LogRun, more: Mapping[str, Writer] | None = None) -> Outcome:
    """Outcome of a run over a log, with more files than every run leaves."""
    numbers = metrics(made)
    files: dict[str, Writer] = {
        "metrics.json": lambda path: write_metrics(path, numbers),
        "trajectory.tum": lambda path: write_tum(path, made.log.time[: len(made.poses)], made.poses),
        **(more or {}),
        f"{made.kind}.png": lambda path: write_figure(path, picture(made), 130),
        "scene.html": lambda path: log_scene(made).save(path),
    }
    return Outcome(made.succeeded, made.interrupted, summary(made), numbers, files)


def metrics(made: LogRun) -> dict[str, Any]:
    """Numbers of a run, ready for JSON; errors where the log has corrected poses."""
    steps = np.diff(made.poses[:, :2], axis=0)
    numbers: dict[str, Any] = {
        "log": made.log.name,
        "map": made.occupancy.name,
        "scans": len(made.poses),
        "beams": len(made.log.angles),
        "path_length_m": float(np.hypot(*steps.T).sum()),
        "explained": {"mean": float(made.share.mean()), "least": float(made.share.min()), "end": float(made.share[-1])},
        "interrupted": made.interrupted,
        "seconds": made.seconds,
        "verdict": made.verdict,
        **made.details,
    }
    if made.hypotheses.any():
        numbers["scans_with_hypotheses"] = int((made.hypotheses > 1).sum())
    if made.errors is not None and made.truth is not None:
        away, turned = made.errors
        numbers |= {"end_error_m": float(away[-1]), "error_m": spread(away), "error_rad": spread(turned)}
        numbers["aligned_error_m"] = errors((aligned(made.poses, made.truth) - made.truth)[:, :2])
        if made.covariance is not None:
            numbers["nees"] = float(np.mean(made.nees))
    return numbers


def summary(made: LogRun) -> str:
    """The outcome as a table of two columns."""
    m = metrics(made)
    ratio = m.get("turns_over_wheels", 1.0)
    doubts = {
        FAILED[made.kind]: not made.succeeded,
        f"scans turn by {ratio:.2f} of what the wheels do: are beams or headings mirrored?": not 0.8 < ratio < 1.25,
    }
    known, many = "error_m" in m, "mean {mean:.3f} {unit}, std {std:.3f}, max {max:.3f}"
    rows = (
        ("log", f"{m['log']}: {m['scans']} scans of {m['beams']} beams, {m['path_length_m']:.1f} m"),
        ("map", m["map"]),
        ("keyframes", f"{m['keyframes']}, {m['loop_closures']} loop closures" if "keyframes" in m else ""),
        ("outliers", f"{m['outliers']} closures left out" if m.get("outliers") else ""),
        ("explained by the map", f"{100 * m['explained']['mean']:.1f} % of the beams"),
        ("several hypotheses", f"at {m['scans_with_hypotheses']} scans" if "scans_with_hypotheses" in m else ""),
        *(("scans not taken in", f"{count}: {why}") for why, count in m.get("refused", {}).items()),
        ("end error", f"{m['end_error_m']:.3f} m from the corrected poses" if known else ""),
        ("error", many.format(unit="m", **m["error_m"]) if known else ""),
        ("", many.format(unit="rad", **m["error_rad"]) if known else ""),
        ("aligned", "rms {rms:.3f} m, max {max:.3f}".format(**m["aligned_error_m"]) if known else ""),
        ("NEES", f"{m['nees']:.2f}, of 3 degrees of freedom" if "nees" in m else ""),
        ("time", f"{m['seconds']:.1f} s, {1e3 * m['seconds'] / m['scans']:.1f} ms a scan"),
        ("verdict", m["verdict"]),
        *(("", said) for said, holds in doubts.items() if holds),
    )
    return table(rows)
