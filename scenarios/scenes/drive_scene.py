"""A drive as a scene: the building, the robot and what it saw, estimated and planned.

The same few functions show a whole log, and a drive while it goes on: they read one tick of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from unifg.lie import SE2
from unifg.models.footprint import Body
from unifg.models.planar import base_of
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.logs.metrics import collision_words, health, one_graph
from unifg.scenarios.scenes.numbers import Number, declare, filled, in_words, metres, show, spent
from unifg.scenarios.scenes.parts import CLEAR, draw_way, lidar_hits, pillar, standing
from unifg.typing import Array
from unifg.view import Scene, shapes
from unifg.view.bodies import Part
from unifg.view.canvas import Frame

__all__ = ["drive_frame", "drive_scene", "drive_stage", "place_movers"]

_MAX_POINTS = 90_000  # lidar points of the whole file; beyond, every second beam, every third, ...
_FRAMES = 500  # that a file shows
_WALL = 0.6  # height of walls and obstacles [m]: low enough to look into rooms
_BODY = 0.3  # height of the robot [m]
_ABOVE = (0.0, -math.cos(1.1), math.sin(1.1))  # where the camera stands
_SIGMAS, _ENLARGED = 3.0, 10.0  # of the ellipse of the estimate: centimetres in a building


def _error(log: Any, k: int) -> float:
    """Localisation error [cm]."""
    return 100.0 * float(np.hypot(*(log.estimate[k] - log.true_pose[k])[:2]))


def _velocity(log: Any, k: int) -> Array:
    """Body velocities that were asked for."""
    return base_of(log.base).of(np.asarray(log.control[k]))


def _deviations(log: Any, k: int) -> str:
    """Believed standard deviations along the axes of the ellipse."""
    greatest, least = 100.0 * np.sqrt(np.linalg.eigvalsh(log.covariance[k][:2, :2])[[1, 0]])
    return f"{greatest:.1f} and {least:.1f} cm"


def _whole(log: Any, k: int) -> str:
    """Time of a tick."""
    return f"{log.perceive_ms[k] + log.route_ms[k] + log.localise_ms[k] + log.plan_ms[k]:.1f} ms"


NUMBERS = (
    Number("speed", lambda log, k: f"{_velocity(log, k)[0]:.2f} m/s"),
    Number("turn", lambda log, k: f"{_velocity(log, k)[-1]:.2f} rad/s"),
    Number("goal", lambda log, k: f"{log.goal_index[k] + 1} of {len(log.goals)}"),
    Number("localise + plan", None, lambda log, k: log.solve_ms[k], plot={"unit": "ms", "log": True}),
    Number(
        "localisation error", lambda log, k: f"{_error(log, k):.1f} cm", _error,
        plot={"unit": "cm", "colour": "estimate"},
    ),
    Number("believed \u03c3", _deviations),
    Number(
        "health", lambda log, k: in_words(log.health[k], log.cause[k]), alarm=lambda log, k: log.health[k] != "ok"
    ),
    Number("fault", lambda log, k: (log.fault[k] or "none now") if any(log.faults) else ""),
    Number(
        "clearance", lambda log, k: metres(log.clearance[k]), lambda log, k: log.clearance[k],
        plot={"unit": "m", "limit": 0.0, "colour": "horizon"},
    ),
    Number("contacts", lambda log, k: str(int(log.contacts[k])), alarm=lambda log, k: log.contacts[k] > 0),
    Number(
        "localise, plan", lambda log, k: spent(log.localise_ms[k], log.plan_ms[k], log.compiled[k]),
        alarm=lambda log, k: log.compiled[k] > 0,
    ),
    Number("whole tick", _whole),
    Number(
        "plan", lambda log, k: log.status[k].replace("_", " ") + ": stored one driven" * bool(log.emergency[k]),
        alarm=lambda log, k: log.emergency[k],
    ),
    Number("iterations of it", lambda log, k: str(int(log.plan_iterations[k]))),
)  # fmt: skip
"""Lines and curves of a drive."""


LAYERS = (
    ("scan", "dots", "scan", "lidar hits", 0.0),
    ("horizon", "line", "horizon", "plan for the next seconds", 1.0),
    ("trail", "line", "trail", "way driven so far", 0.9),
    ("route", "line", "plan", "route it follows, repaired where blocked", 0.6),
    ("detected", "ring", "detected", "obstacle as detected", 0.0),
    ("contact", "block", "moving", "contact", 0.0),
)
"""Names, swatches, colours, words and widths over those of lines of what changes with the ticks."""


def drive_scene(log: EpisodeLog) -> Scene:
    """The scene of a drive.

    Raises:
        ViewError: the drive has no tick.
    """
    frames = min(log.ticks, _FRAMES)
    scene = filled(log, partial(drive_stage, log, log.outcomes), partial(drive_frame, frames=frames))
    m = episode_metrics(log)
    stopped = ", interrupted by the user" if m["interrupted"] else ""
    missed = "".join(f"; {words}" for words in dict.fromkeys(m["outcomes"]) if words != "reached")  # each once
    scene.outcome = (
        f"{m['goals_reached']} of {m['goals']} goals reached, {collision_words(m['collisions'])}{stopped}{missed}"
    )
    scene.good = m["succeeded"]
    scene.facts |= {
        "driven": f"{m['path_length_m']:.1f} m in {m['duration_s']:.1f} s",
        "closest approach": f"{max(0.0, m['min_clearance_m']):.2f} m",
        "localisation error": f"{100 * m['localisation_error_m']['mean']:.1f} cm on average",
        "health": health(m),
        **{f"contact with {each['thing']} at {each['time']:.1f} s": each["cause"] for each in m["contacts"]},
        "odometry error": f"{m['odometry_error_m']['max']:.2f} m at worst",
    }
    return scene


def drive_stage(log: Any, outcomes: Sequence[str] = ()) -> Scene:
    """Static parts of a drive's scene, and the bodies that move in it.

    Args:
        log: an `EpisodeLog`, or one in the making: what is known before the first tick is asked of it.
        outcomes: of the goals, as far as they are known.
    """
    scene = Scene(f"unifg: {log.scenario} on {log.occupancy.name}{one_graph(log.coupling)}", dt=log.dt)
    corners = shapes.known_corners(log.occupancy)
    extent = float(np.ptp(corners, axis=0).max())
    stroke = float(np.clip(0.004 * extent, 0.03, 0.14))  # width of ribbons [m]
    pin = float(np.clip(0.035 * extent, 0.3, 1.4))  # height of pins and flags [m]
    scene.around = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in (0.0, _WALL)])
    scene.speeds = (1, 2, 4, 8)
    scene.facts |= {"solver": f"{log.solver} ({log.coupling})", "seed": str(log.seed)}
    _robots(scene, log.hull, pin)
    for name, swatch, colour, words, width in LAYERS:
        scene.layer(name, swatch, colour, words, width * stroke or None)
    _goals(scene, log, stroke, pin)
    if len(log.path) > 1:
        scene.way(
            "plan", log.path[:, :2], width=0.4 * stroke, colour="odometry", legend="first route, on the map alone"
        )
    _obstacles(scene, log)
    scene.map("building", log.occupancy, height=_WALL, legend="walls and furniture on the map")
    scene.label("start", log.start[:2])
    for index, (goal, word) in enumerate(zip(log.goals, outcomes or ["reached"] * len(log.goals), strict=True)):
        name = "goal" if len(log.goals) == 1 else f"goal {index + 1}"
        scene.label(name + ("" if word == "reached" else " (missed)"), goal[:2])
    scene.label("robot", follows="robot")
    scene.label("odometry alone", follows="odometry", minor=True)
    scene.view("overview", "Whole building", _ABOVE)
    scene.view("follow", "Follow robot", _ABOVE, follows="robot", distance=30.0)
    declare(scene, NUMBERS)
    return scene


def drive_frame(scene: Scene, frame: Frame, log: Any, tick: int, frames: int = 1) -> None:
    """Draw a tick of a drive.

    Args:
        scene: begun by `drive_stage`.
        frame: of it, to be drawn on.
        log: an `EpisodeLog`, or one in the making.
        tick: which.
        frames: how many the file will hold.
    """
    truth, estimate = log.true_pose[tick], log.estimate[tick]
    for name, pose in (("robot", truth), ("estimate", estimate), ("odometry", log.dead_reckoning[tick])):
        frame.place(name, pose)
    rotation = SE2.matrix(estimate)[:2, :2]
    spread = rotation @ log.covariance[tick][:2, :2] @ rotation.T
    frame.ellipse("sigma", estimate[:2], spread, sigmas=_SIGMAS * _ENLARGED, z=_BODY + 0.13)
    frame.trail("trail", truth[:2])
    frame.way("route", log.route[tick][:, :2], colour="plan")
    beams = np.arange(0, len(log.scan_angles), math.ceil(frames * len(log.scan_angles) / _MAX_POINTS))
    frame.points("scan", lidar_hits(truth, log.scan[tick][beams], log.scan_angles[beams], _WALL + 0.02), pixels=4.0)
    draw_way(frame, "horizon", log.horizon[tick][:, :2])
    rings = [shapes.ring(x[:2], float(x[2]) + 0.03, 0.06, _WALL + 0.01, corners=10) for x in log.detected[tick]]
    if rings:
        frame.mesh("detected", shapes.merge(rings))
    place_movers(frame, log, tick)
    _touch(frame, log, tick)
    show(frame, log, tick, NUMBERS)


def place_movers(frame: Frame, log: Any, tick: int) -> None:
    """Place the obstacles that move."""
    for index in np.flatnonzero(log.obstacle_moves).tolist():
        frame.place(f"obstacle {index}", [*log.obstacles[tick][index][:2], 0.0])


def _robots(scene: Scene, hull: Body, pin: float) -> None:
    """The robot where it truly is, where it believes to be, and where its wheels alone would put it."""
    # A pin hovers above the robot, which would be a few pixels in a whole building.
    turned = np.diag([0.25 * pin, 0.25 * pin, 0.75 * pin])[None]
    tip = shapes.copies(shapes.column(bottom=0.0), np.array([[0.0, 0.0, _WALL + 0.05]]), turned)
    for name, higher, wider, opacity, clear, words in (
        ("robot", 0.0, 0.0, 1.0, 1.0, "robot, where it truly is"),
        ("estimate", 0.12, 0.06, 0.3, 0.55, "where it believes it is: lidar localisation"),
        ("odometry", 0.0, 0.0, 0.55, 0.8, "where its wheels alone would put it"),
    ):
        true, height = name == "robot", _BODY + higher
        heading = shapes.wedge(1.2 * hull.radius, height + 0.02)
        parts = [
            standing(hull, height, name, wider)._replace(opacity=opacity),
            Part("heading", heading, "heading" if true else name, False, clear),
            *([Part("pin", tip, "robot")] if true else []),
        ]
        scene.body(name, parts, colour=name, swatch="disc" if true else "ghost", legend=words)
    words = f"how sure it is: {_SIGMAS:g}\u03c3, {_ENLARGED:g} times enlarged"
    scene.body("sigma", "ellipse", colour="estimate", swatch="ring", legend=words)


def _goals(scene: Scene, log: Any, stroke: float, pin: float) -> None:
    """The start, and goals with flags."""
    radius, flags, poles = log.robot_radius, [], []
    scene.mesh("start", shapes.ring(log.start[:2], 0.0, 1.2 * radius, 0.03), colour="start", legend="")
    for x, y, _ in log.goals.tolist():
        flags.append(shapes.ring(np.array([x, y]), 1.3 * radius, stroke, 0.03))
        flag = np.array([[x, y, 0.62 * pin], [x, y, pin], [x + 0.55 * pin, y, 0.81 * pin]])
        flags.append((flag, np.array([[0, 1, 2]])))
        poles.append([x, y, 0.25 * stroke])
    scene.mesh("goals", shapes.merge(flags), colour="goal", swatch="flag", legend="goals")
    scene.discs("poles", poles, height=pin, colour="pole", legend="")
    scene.poses("headings", np.vstack([log.start, log.goals]), length=4.0 * radius, colour="dark", legend="")


def _obstacles(scene: Scene, log: Any) -> None:
    """Those that stand stay; those that move are bodies, switched by one line of the legend."""
    moves, places = log.obstacle_moves, log.obstacles[0]
    if (~moves).any():
        words = "obstacle not on the map"
        scene.discs("obstacles", places[~moves], height=_WALL, colour="fixed", opacity=CLEAR, legend=words)
    for index in np.flatnonzero(moves).tolist():
        parts = [pillar(float(places[index, 2]), _WALL, "moving")]
        scene.body(f"obstacle {index}", parts, colour="moving", legend="obstacle that moves")


def _touch(frame: Frame, log: Any, tick: int) -> None:
    """A pole where each contact so far began."""
    begun = [k for k in range(1, tick + 1) if log.contacts[k] > log.contacts[k - 1]]
    if begun:
        rows = [[*log.true_pose[k][:2], 0.5 * log.robot_radius] for k in begun]
        frame.discs("contact", rows, height=2.0 * _WALL)
