"""A flight that must keep its distance, as a scene: what stands, what moves, what was planned and what was flown."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from unifg.scenarios.logs.safe_log import SafeLog, safe_metrics
from unifg.scenarios.scenes.numbers import Number, declare, filled, show
from unifg.scenarios.scenes.parts import CLEAR, draw_way, floor, pillar, vehicle
from unifg.typing import Array
from unifg.view import Scene, shapes
from unifg.view.bodies import Part, body_of
from unifg.view.canvas import Frame

__all__ = ["place_bodies", "resting", "safe_frame", "safe_scene", "safe_stage"]

_HEIGHT = 3.0  # of cylinders, which have no end [m]
_STILL = 1e-9  # [m]
_BESIDE = 1.0  # around the flight [m]


def _near(log: Any, k: int) -> float:
    """Distance to the nearest surface beyond the margin [m]."""
    return float(log.near[k].min()) - float(log.hull) - float(log.margin)


def _away(log: Any, k: int) -> float:
    """Distance from the path [cm]."""
    return 100.0 * float(np.linalg.norm(log.states[k][:3] - log.wanted[k][:3]))


NUMBERS = (
    Number("speed", lambda log, k: f"{np.linalg.norm(log.states[k][7:]):.2f} m/s"),
    Number("from the path", lambda log, k: f"{_away(log, k):.1f} cm", _away, plot={"unit": "cm", "colour": "estimate"}),
    Number("mass believed", lambda log, k: f"{log.mass[k]:.3f} kg"),
    Number(
        "decided in", lambda log, k: f"{log.decide_ms[k]:.1f} ms", lambda log, k: log.decide_ms[k],
        plot={"unit": "ms", "log": True},
    ),
)  # fmt: skip
"""Lines and curves of every flight."""

NEARNESS = Number(
    "boundary distance", lambda log, k: f"{_near(log, k):.3f} m", _near, lambda log, k: _near(log, k) < 0.0,
    {"unit": "m", "limit": 0.0, "colour": "horizon"},
)  # fmt: skip
"""Line and curve of a flight among obstacles."""


LAYERS = (
    ("flown", "line", "trail", "way flown", 0.05),
    ("path", "line", "plan", "path to follow", 0.024),
    ("plan", "line", "horizon", "plan", 0.07),
)
"""Names, swatches, colours, words and widths [m] of the ways."""


def _numbers(log: Any) -> tuple[Number, ...]:
    return (NEARNESS, *NUMBERS) if len(log.radii) else NUMBERS


def safe_scene(log: SafeLog) -> Scene:
    """The scene of one flight.

    Raises:
        ViewError: the flight has no tick.
    """
    scene = filled(log, partial(_begun, log), safe_frame)
    _words(scene, log)
    return scene


def _begun(log: SafeLog) -> Scene:
    """The scene with floor and path, which are known once the flight is over."""
    scene = safe_stage(log, resting(log))
    low, high = _extent(log)
    corners = [[x, y, z] for z in (0.0, _HEIGHT) for x in (low[0], high[0]) for y in (low[1], high[1])]
    scene.around, scene.ground = np.concatenate([corners, log.states[:, :3]]), False
    floor(scene, low, high)
    if not _rests(log.wanted[:, :3]):
        scene.way("path", shapes.thin(log.wanted[:, :3], 200))
    return scene


def safe_stage(log: Any, still: Sequence[bool] = ()) -> Scene:
    """The bodies of a flight, and words for what changes.

    Args:
        log: a `SafeLog`, or one in the making: what is known before the first tick is asked of it.
        still: which bodies rest, as far as that is known.
    """
    scene = Scene(f"unifg: quadrotor-cbf, {log.settings['case']}", dt=log.dt)
    scene.speeds = (0.1, 0.25, 0.5, 1, 2)
    for row in LAYERS:
        scene.layer(*row)
    vehicle(scene, log.hull)
    _bodies(scene, log, list(still) or [False] * len(log.radii))
    scene.view("overview", "Overview", [-0.55, -0.75, 0.8], 24.0)
    scene.view("follow", "Follow drone", [-1.0, -0.45, 0.7], 30.0, follows="drone", distance=9.0)
    scene.view("top", "From above", [0.0, -0.001, 1.0], 10.0)
    declare(scene, _numbers(log))
    return scene


def _extent(log: SafeLog) -> tuple[Array, Array]:
    """Lowest and highest corner (2,) of the ground that is shown [m]."""
    ways = np.concatenate([log.states[:, :2], log.wanted[:, :2], log.bodies[..., :2].reshape(-1, 2)])
    return ways.min(axis=0) - _BESIDE, ways.max(axis=0) + _BESIDE


def _bodies(scene: Scene, log: Any, still: list[bool]) -> None:
    """Obstacles, with the margin on the ground."""
    for index, (radius, upright) in enumerate(zip(log.radii.tolist(), log.upright.tolist(), strict=True)):
        colour = "fixed" if still[index] else "moving"
        name, words = f"body {index}", {"fixed": "at rest", "moving": "moves"}[colour]
        parts = (
            [pillar(radius, _HEIGHT, colour)]
            if upright
            else [part._replace(opacity=CLEAR) for part in body_of("ball", radius, colour)]
        )
        if upright or still[index]:
            edge = shapes.ring(np.zeros(2), radius + log.hull + log.margin - 0.02, 0.02, 0.014, corners=48)
            parts.append(Part("margin", edge, "moving", False))
        scene.body(name, parts, colour=colour, legend=words)


def safe_frame(scene: Scene, frame: Frame, log: Any, tick: int) -> None:
    """Draw a tick of a `SafeLog`, or of one in the making."""
    state, plan = log.states[tick], log.plans[tick]
    frame.place("drone", state[:7])
    frame.place("shadow", [state[0], state[1], 0.0])
    place_bodies(frame, log, tick)
    frame.trail("flown", state[:3])
    draw_way(frame, "plan", plan)
    show(frame, log, tick, _numbers(log))


def place_bodies(frame: Frame, log: Any, tick: int) -> None:
    """Place the obstacles; cylinders stand on the ground."""
    for index, place in enumerate(log.bodies[tick]):
        z = 0.0 if log.upright[index] else place[2]
        frame.place(f"body {index}", [place[0], place[1], z, 1.0, 0.0, 0.0, 0.0])


def resting(log: SafeLog) -> list[bool]:
    """True for the bodies that rest."""
    return [_rests(log.bodies[:, index]) for index in range(len(log.radii))]


def _rests(points: Array) -> bool:
    """Return True if places (n, 3) are all the same."""
    return bool(np.ptp(points, axis=0).max() < _STILL)


def _words(scene: Scene, log: SafeLog) -> None:
    """Outcome and facts of the flight."""
    words = "kept its distance" if not log.violated else "came TOO NEAR" if not log.touched else "TOUCHED something"
    arrived = "" if log.end is None else ", arrived" if log.arrived else ", did NOT arrive"
    stopped = ", interrupted by the user" if log.interrupted else ""
    error = safe_metrics(log)["tracking_error_m"]
    scene.outcome = (words if len(log.radii) else "nothing in the way") + arrived + stopped
    scene.good = log.succeeded
    scene.facts |= {
        "flight": log.label,
        "controller": str(log.settings["controller"]),
        "least boundary distance": f"{log.boundary.min():.3f} m" if len(log.radii) else "",
        "from the path": f"{100.0 * error['rms']:.1f} cm rms",
        "decided in": f"{np.median(log.decide_ms):.2f} ms median",
    }
