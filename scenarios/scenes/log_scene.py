"""A log on its map: as one picture, and as a scene that goes along with the scans."""

from __future__ import annotations

import numpy as np

from unifg.plots.shown import every
from unifg.scenarios.range_logs import EXPLAINED, FAILED, LogRun
from unifg.scenarios.scenes.parts import lidar_hits
from unifg.style.colours import css
from unifg.style.figures import face, headline, key_of, new_figure
from unifg.typing import Figure
from unifg.view import Scene, shapes

__all__ = ["log_scene", "picture"]

_FRAMES, _BEAMS = 400, 90  # that a file shows
_WALL = 0.5  # height of walls [m]
_ABOVE = (0.0, -0.45, 0.9)  # where the camera stands


def picture(run: LogRun) -> Figure:
    """The map with the ways on it; below, what the map explains and, where it is known, the error."""
    with new_figure((12.0, 10.5)) as figure:
        grid = figure.add_gridspec(2, 1, height_ratios=(5.0, 1.2))
        above, below = (figure.add_subplot(grid[k]) for k in (0, 1))
        stage(run).draw(above)
        above.set_title("")
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.poses[:, :2], axis=0).T))])
        below.plot(along, 100.0 * run.share, color=css("horizon"), lw=0.9, label="beams explained [%]")
        if run.errors is not None:
            below.plot(along, 100.0 * run.errors[0], color=css("estimate"), lw=1.1, label="error [cm]")
        several = np.flatnonzero(run.hypotheses > 1)
        if len(several):
            below.plot(along[several], np.zeros(len(several)), "|", color=css("outlier"), label="several hypotheses")
        face(below, "Along the way", "")
        below.set_ylim(bottom=-4.0)
        below.set_xlabel("way [m]")
        figure.legend(*key_of((above, below)), loc="outside lower center", ncols=5)
        verb = "a map of" if run.kind == "map" else f"on {run.occupancy.name}, along"
        headline(figure, f"{verb} {run.log.name}: {len(run.poses)} scans, {along[-1]:.0f} m")
    return figure


def stage(run: LogRun) -> Scene:
    """Static parts: the map, the ways, and the loop closures."""
    place = "a map of it" if run.kind == "map" else run.occupancy.name
    scene = Scene(f"unifg: {run.log.name} on {place}", counts="scan")
    corners = shapes.known_corners(run.occupancy)
    width = float(np.clip(0.003 * np.ptp(corners, axis=0).max(), 0.03, 0.12))
    scene.around = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in (0.0, _WALL)])
    scene.map("map", run.occupancy, height=_WALL, legend="walls on the map")
    wheels = run.odometry
    inside = (np.abs(wheels[:, :2] - corners.mean(axis=0)) < 0.75 * np.ptp(corners, axis=0)).all(axis=1)
    dots = wheels[inside][every(int(inside.sum()), 500), :2]
    scene.points("odometry", dots, pixels=2.5, colour="odometry", legend="wheels alone")
    if run.truth is not None:
        scene.way("corrected", run.truth[:, :2], width=width, colour="goal", legend="corrected poses of the log")
    scene.way("found", run.poses[:, :2], width=width, colour="estimate", legend="poses found")
    if len(run.closures):
        scene.lines("closures", run.poses[run.closures][:, :, :2], colour="closure", legend="loop closures")
    scene.view("overview", "Whole map", _ABOVE)
    return scene


def log_scene(run: LogRun) -> Scene:
    """The scene of a log, scan by scan."""
    scene = stage(run)
    scene.body("robot", "disc", size=0.25, colour="robot", legend="robot, where it is believed to be")
    scene.view("follow", "Follow robot", _ABOVE, follows="robot", distance=25.0)
    scene.plot("explained", unit="%", colour="horizon")
    scene.facts |= {"scans": str(len(run.poses)), "took": f"{run.seconds:.1f} s", "verdict": run.verdict}
    scene.numbers = every(len(run.poses), _FRAMES).tolist()
    beams = every(len(run.log.angles), _BEAMS)
    for k in scene.numbers:
        frame = scene.frame()
        frame.place("robot", run.poses[k])
        hits = lidar_hits(run.poses[k], run.log.ranges[k][beams], run.log.angles[beams], _WALL + 0.02)
        frame.points("scan", hits, pixels=4.0, colour="scan", legend="lidar hits")
        frame.value("explained", 100.0 * float(run.share[k]))
        frame.readout("explained", f"{100.0 * run.share[k]:.0f} % of the beams", alarm=bool(run.share[k] < EXPLAINED))
        if len(run.hypotheses):
            frame.readout("hypotheses", str(int(run.hypotheses[k])), alarm=bool(run.hypotheses[k] > 1))
        if run.errors is not None:
            frame.readout("error", f"{100.0 * run.errors[0][k]:.1f} cm")
    scene.outcome, scene.good = ("followed to the end" if run.succeeded else "lost"), run.succeeded
    if run.kind == "map":
        scene.outcome = "interrupted" if run.interrupted else "mapped" if run.succeeded else FAILED["map"]
        scene.good = run.succeeded and not run.interrupted
    return scene
