"""A drive as a scene: the building, the robot and what it saw, estimated and planned."""

from __future__ import annotations

import math

import numpy as np

from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.log.drive_metrics import episode_metrics, pose_errors
from unifg.scenarios.log.metrics import collision_words
from unifg.typing import Array, IntArray
from unifg.view import shapes
from unifg.view.page import Key, Label, Page, Readout, View
from unifg.view.stage import Stage

__all__ = ["drive_scene", "scan_points"]

_MAX_POINTS = 90_000  # lidar points of the whole file; beyond, every second beam, every third, ...
_WALL = 0.6  # height of walls and obstacles [m]: low enough to look into rooms
_BODY = 0.3  # height of the robot [m]
_NODES = 16  # of the predicted way
_ABOVE = (0.0, -math.cos(1.1), math.sin(1.1))  # where the camera stands


def drive_scene(log: EpisodeLog) -> Stage:
    """The scene of a drive.

    Raises:
        ViewError: the drive has no tick, or meshcat is not installed.
    """
    stage = Stage(log.ticks, log.dt)
    extent = float(np.ptp(shapes.known_corners(log.occupancy), axis=0).max())
    stroke = float(np.clip(0.004 * extent, 0.03, 0.14))  # width of ribbons [m]
    pin = float(np.clip(0.035 * extent, 0.3, 1.4))  # height of pins and flags [m]
    _building(stage, log)
    _route(stage, log, stroke, pin)
    _robots(stage, log, pin)
    _obstacles(stage, log)
    _trail(stage, log, stroke)
    _frames(stage, log, stroke)
    return stage.finish(_page(log, stage.ticks))


def _building(stage: Stage, log: EpisodeLog) -> None:
    occupancy = log.occupancy
    stage.mesh("building/floor", shapes.flat(occupancy, occupancy.free, 0.0), "floor")
    if occupancy.occupied.any():
        stage.mesh("building/walls", shapes.extrude(occupancy, _WALL), "wall", lit=True)


def _route(stage: Stage, log: EpisodeLog, stroke: float, pin: float) -> None:
    """The planned path, the start, and goals with flags."""
    if len(log.path) > 1:
        stage.mesh("plan", shapes.ribbon(log.path, 0.6 * stroke, 0.02), "plan")
    stage.mesh("start", shapes.ring(log.start[:2], 0.0, 1.2 * log.robot_radius, 0.03), "start")
    for index, (x, y, _) in enumerate(log.goals.tolist()):
        path = f"goals/{index}"
        stage.mesh(f"{path}/ring", shapes.ring(np.array([x, y]), 1.3 * log.robot_radius, stroke, 0.03), "goal")
        stage.cylinder(f"{path}/pole", pin, 0.25 * stroke, "pole", (x, y))
        flag = np.array([[x, y, 0.62 * pin], [x, y, pin], [x + 0.55 * pin, y, 0.81 * pin]])
        stage.mesh(f"{path}/flag", (flag, np.array([[0, 1, 2]])), "goal")


def _robots(stage: Stage, log: EpisodeLog, pin: float) -> None:
    """The robot where it truly is, where it believes to be, and where its wheels alone would put it."""
    radius = log.robot_radius
    stage.cylinder("robot/body", _BODY, radius, "robot")
    stage.mesh("robot/heading", shapes.wedge(1.2 * radius, _BODY + 0.02), "heading")
    # A pin hovers above the robot, which would be a few pixels in a whole building.
    stage.cylinder("robot/pin", 0.75 * pin, 0.0, "robot", z=_WALL + 0.05, top=0.25 * pin)
    stage.cylinder("estimate/body", _BODY + 0.12, radius + 0.06, "estimate", opacity=0.3)
    stage.mesh("estimate/heading", shapes.wedge(1.2 * radius, _BODY + 0.14), "estimate", opacity=0.55)
    stage.cylinder("odometry/body", _BODY, radius, "odometry", opacity=0.55)
    stage.mesh("odometry/heading", shapes.wedge(1.2 * radius, _BODY + 0.02), "odometry", opacity=0.8)
    for path, poses in (("robot", log.true_pose), ("estimate", log.estimate), ("odometry", log.dead_reckoning)):
        stage.move(path, shapes.on_ground(poses), poses[:, 2])


def _obstacles(stage: Stage, log: EpisodeLog) -> None:
    for index, moves in enumerate(log.moving().tolist()):
        places, path = log.obstacles[:, index], f"obstacles/{index}"
        x, y, radius = places[0].tolist()
        if moves:
            stage.cylinder(f"{path}/body", _WALL, radius, "moving")
            stage.move(path, shapes.on_ground(places))
        else:
            stage.cylinder(f"{path}/body", _WALL, radius, "fixed", (x, y))


def _trail(stage: Stage, log: EpisodeLog, stroke: float) -> None:
    """The way driven so far."""
    for begin, end in stage.pieces():
        piece = log.true_pose[begin : end + 1]
        if np.ptp(piece[:, :2], axis=0).max() >= 1e-3:
            stage.mesh(f"trail/{begin}", shapes.ribbon(piece, 0.9 * stroke, 0.04), "trail")
            stage.appear(f"trail/{begin}", end)


def _frames(stage: Stage, log: EpisodeLog, stroke: float) -> None:
    """Scan, predicted way and detections of each frame."""
    beams = np.arange(0, len(log.scan_angles), math.ceil(len(stage.ticks) * len(log.scan_angles) / _MAX_POINTS))
    nodes = np.unique(np.linspace(0, log.horizon.shape[1] - 1, _NODES).round().astype(np.intp))
    for tick, ending in stage.turns():
        path = f"frames/{tick}"
        hits = scan_points(log, tick, beams)
        if len(hits):
            stage.points(f"{path}/scan", np.column_stack([hits, np.full(len(hits), _WALL + 0.02)]), "scan", 4.0)
        horizon = log.horizon[tick][nodes]
        if len(horizon) > 1 and np.isfinite(horizon).all():
            stage.mesh(f"{path}/horizon", shapes.ribbon(horizon, stroke, 0.06), "horizon")
        rings = [
            shapes.ring(x[:2], float(x[2]) + 0.03, 0.5 * stroke, _WALL + 0.01, corners=10) for x in log.detected[tick]
        ]
        if rings:
            stage.mesh(f"{path}/detected", shapes.merge(rings), "detected")
        stage.appear(path, tick, ending)


def scan_points(log: EpisodeLog, tick: int, beams: IntArray) -> Array:
    """World points (n, 2) [m] where the chosen beams of a tick really ended; dropouts and misses are left out."""
    ranges = log.scan[tick, beams]
    returned = np.isfinite(ranges)
    x, y, heading = log.true_pose[tick]
    angles = log.scan_angles[beams][returned] + heading
    hits: Array = np.column_stack([np.cos(angles), np.sin(angles)]) * ranges[returned, None] + np.array([x, y])
    return hits


def _page(log: EpisodeLog, ticks: IntArray) -> Page:
    m = episode_metrics(log)
    moving = log.moving()
    stopped = ", interrupted by the user" if m["interrupted"] else ""
    legend = [
        Key("robot", "disc", "robot, where it truly is (pin above it)"),
        Key("estimate", "ghost", "where the robot believes it is: lidar localisation"),
        Key("odometry", "ghost", "where wheel odometry alone would put it"),
        Key("scan", "dots", "lidar hits of this moment"),
        Key("horizon", "line", "way the controller predicts for the next seconds"),
        Key("trail", "line", "way driven so far"),
        Key("plan", "line", "planned path"),
        Key("goal", "flag", "goals"),
    ]
    if (~moving).any():
        legend.append(Key("fixed", "disc", "obstacle that is not on the map"))
    if moving.any():
        legend.append(Key("moving", "disc", "obstacle that moves"))
    if any(len(found) for found in log.detected):
        legend.append(Key("detected", "ring", "obstacle as the robot has detected it"))
    legend.append(Key("wall", "block", "walls and furniture on the map"))
    labels = [Label("start", [*log.start[:2].tolist(), 0.0])]
    for index, goal in enumerate(log.goals):
        labels.append(Label("goal" if len(log.goals) == 1 else f"goal {index + 1}", [*goal[:2].tolist(), 0.0]))
    labels += [Label("robot", follows="robot"), Label("odometry alone", follows="odometry", minor=True)]
    error, _ = pose_errors(log.estimate, log.true_pose)
    corners = shapes.known_corners(log.occupancy)
    return Page(
        title=f"unifg: {log.scenario} on {log.occupancy.name}",
        outcome=f"{m['goals_reached']} of {m['goals']} goals reached, {collision_words(m['collisions'])}{stopped}",
        good=m["succeeded"],
        facts={
            "solver": f"{m['solver']} ({m['coupling']})",
            "seed": str(m["seed"]),
            "driven": f"{m['path_length_m']:.1f} m in {m['duration_s']:.1f} s",
            "closest approach": f"{max(0.0, m['min_clearance_m']):.2f} m",
            "localisation error": f"{100 * m['localisation_error_m']['mean']:.1f} cm on average",
            "odometry error": f"{m['odometry_error_m']['max']:.2f} m at worst",
        },
        corners=np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in (0.0, _WALL)]),
        legend=legend,
        labels=labels,
        readouts=[
            Readout("speed", [f"{v:.2f} m/s" for v in log.control[ticks, 0]]),
            Readout("turn", [f"{omega:.2f} rad/s" for omega in log.control[ticks, 1]]),
            Readout("goal", [f"{goal + 1} of {len(log.goals)}" for goal in log.goal_index[ticks]]),
            Readout("localisation error", [f"{100 * e:.1f} cm" for e in error[ticks]]),
            Readout("clearance", [f"{c:.2f} m" if np.isfinite(c) else "\u2013" for c in log.clearance[ticks]]),
            Readout("localise, plan", _times(log, ticks), (log.compiled[ticks] > 0).tolist()),
            Readout(
                "plan",
                [log.status[k].replace("_", " ") + (": stored one driven" if log.emergency[k] else "") for k in ticks],
                log.emergency[ticks].tolist(),
            ),
        ],
        views=[
            View("overview", "Whole building", _ABOVE, 20.0),
            View("follow", "Follow robot", _ABOVE, 20.0, follows="robot", distance=30.0),
        ],
        speeds=(1, 2, 4, 8),
    )


def _times(log: EpisodeLog, ticks: IntArray) -> list[str]:
    """What both took in each tick, and whether that is more than their work."""
    return [
        f"{log.localise_ms[k]:.1f} ms, {log.plan_ms[k]:.1f} ms" + (" (compiled)" if log.compiled[k] else "")
        for k in ticks
    ]
