"""A flight as a scene: what stood there, what was believed of it, and where the vehicle flew and meant to fly.

The same few functions show a whole log, and a flight while it goes on: they read one tick of it. A flight without an
estimate, such as a plan flown as it is, has no sigmas, windows, landmarks or sightings; it is shown without them, and
with all cylinders solid from the start.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics, has_estimate
from unifg.scenarios.logs.metrics import collision_words, health, one_graph
from unifg.scenarios.scenes.numbers import Number, declare, filled, in_words, metres, show, spent
from unifg.scenarios.scenes.parts import CLEAR, draw_way, layout, pillar, vehicle
from unifg.scenarios.simulation.air import VEHICLE_RADIUS
from unifg.scenarios.simulation.bearing_range import SensorModel
from unifg.typing import Array
from unifg.view import Scene, shapes
from unifg.view.bodies import Part
from unifg.view.canvas import Frame

__all__ = ["flight_frame", "flight_scene", "flight_stage", "senses"]

SIGMAS = 2.0
"""Half axes of ellipses in standard deviations."""

_REACH = SensorModel().range_max  # [m]
_HEIGHT = 2.0  # of walls, cylinders and movers [m]; there they have no top


def _error(log: Any, k: int) -> float:
    """Position error [cm]."""
    return 100.0 * float(np.linalg.norm(log.believed[k][:3] - log.truth[k][:3]))


def _mass(log: Any, k: int) -> str:
    """Mass as believed, where it is estimated."""
    mass, sigma = log.parameters[k][0], log.parameters_sigma[k][0]
    return f"{mass:.3f} \u00b1 {sigma:.3f} kg" if sigma > 0.0 else ""


NUMBERS_OF_A_PLAN = (
    Number("speed", lambda log, k: f"{np.linalg.norm(log.truth[k][7:]):.2f} m/s"),
    Number("height", lambda log, k: f"{log.truth[k][2]:.2f} m"),
    Number(
        "health", lambda log, k: in_words(log.health[k], log.causes[k]), alarm=lambda log, k: log.health[k] != "ok"
    ),
    Number("fault", lambda log, k: (log.fault[k] or "none now") if log.settings.get("faults") else ""),
    Number(
        "clearance", lambda log, k: metres(log.clearance[k]), lambda log, k: log.clearance[k],
        plot={"unit": "m", "limit": 0.0, "colour": "horizon"},
    ),
    Number("thrust", lambda log, k: f"{log.controls[k][3]:.1f} N"),
    Number("landmarks", lambda log, k: str(len(log.landmarks[k]) or "")),
    Number(
        "plan", lambda log, k: log.statuses[k].lower() + ": stored one flown" * bool(log.emergency[k]),
        alarm=lambda log, k: log.emergency[k],
    ),
)  # fmt: skip
"""Lines and curves of a flight that nothing estimates."""

NUMBERS = (
    *NUMBERS_OF_A_PLAN,
    Number(
        "estimate + plan", None, lambda log, k: log.estimate_ms[k] + log.plan_ms[k], plot={"unit": "ms", "log": True}
    ),
    Number(
        "position error", lambda log, k: f"{_error(log, k):.1f} cm", _error, plot={"unit": "cm", "colour": "estimate"}
    ),
    Number("mass \u00b1 \u03c3", _mass),
    Number("true mass", lambda log, k: f"{log.parameters_true[k][0]:.3f} kg" if _mass(log, k) else ""),
    Number(
        "estimate, plan", lambda log, k: spent(log.estimate_ms[k], log.plan_ms[k], log.compiled[k]),
        alarm=lambda log, k: log.compiled[k] > 0,
    ),
)  # fmt: skip
"""Lines and curves of a flight."""


LAYERS: tuple[tuple[Any, ...], ...] = (
    ("past", "line", "robot", "estimated past: the window that is smoothed", 0.09),
    ("truth", "thin", "odometry", "true way, where it differs", 0.028),
    ("horizon", "line", "horizon", "predicted future, and its shadow on the ground", 0.1),
    ("below", "line", "horizon", "predicted future, and its shadow on the ground"),
    ("unseen", "ghost", "wall", "cylinder not seen yet"),
)
"""Names, swatches, colours, words and widths [m] of what changes with the ticks."""


def flight_scene(log: FlightLog) -> Scene:
    """The scene of a flight.

    Raises:
        ViewError: the flight has no tick.
    """
    sensed, estimated = senses(log), has_estimate(log)
    scene = filled(log, partial(flight_stage, log, sensed=sensed, estimated=estimated), flight_frame)
    if scene.around is not None:
        scene.around = np.concatenate([scene.around, log.truth[:, :3]])
    m = flight_metrics(log)
    settings, error, tick_ms = m["settings"], m["position_error_m"], m["tick_ms"]
    reached = "target reached" if m["reached"] else f"{m['target_distance_m']:.1f} m short of the target"
    stopped = ", interrupted by the user" if m["interrupted"] else ""
    how = "" if log.outcome in ("", "reached", "interrupted") else f"; {log.outcome}"
    scene.outcome, scene.good = f"{reached}, {collision_words(log.collisions)}{stopped}{how}", m["succeeded"]
    scene.facts |= {
        "seed": "" if settings.get("seed") is None else str(settings["seed"]),
        "flown": f"{m['path_length_m']:.1f} m in {m['duration_s']:.1f} s",
        "closest approach": f"{max(0.0, m['min_clearance_m']):.2f} m",
        "health": health(m) if any(log.health) else "",
        "position error": "" if error is None else f"{100 * error['rms']:.1f} cm rms",
        "estimate + plan": f"{tick_ms['p50']:.1f} ms median" if tick_ms["max"] > 0.0 else "",
    }
    return scene


def senses(log: FlightLog) -> bool:
    """Return True for a flight with a sensor."""
    return any(len(ids) for ids in log.seen)


def flight_stage(log: Any, *, sensed: bool = True, estimated: bool = True) -> Scene:
    """Static parts of a flight's scene, and the bodies that move in it.

    Args:
        log: a `FlightLog`, or one in the making: what is known before the first tick is asked of it.
        sensed: whether there is a sensor.
        estimated: True for a flight with an estimate.
    """
    name = str(log.settings.get("scenario", "quadrotor"))
    name += (f", {log.layout.name}" if log.layout.name else "") + one_graph(log.settings.get("coupling"))
    scene = Scene(f"unifg: {name}", dt=log.dt)
    (left, low), (right, high) = log.layout.size.tolist()
    scene.around = np.array([[x, y, z] for z in (0.0, _HEIGHT) for x in (left, right) for y in (low, high)])
    scene.ground, scene.speeds = False, (0.25, 0.5, 1, 2, 4)
    solver = str(log.settings.get("solver", ""))
    if solver and log.settings.get("coupling"):
        solver += f" ({log.settings['coupling']})"
    scene.facts["solver"] = solver
    past = "estimated past before that" if estimated else "way flown"
    seen = "cylinder that has been seen" if sensed else "cylinder"
    for row in (*LAYERS, ("trail", "line", "trail", past, 0.06), ("seen", "disc", "fixed", seen)):
        scene.layer(*row)
    scene.layer("rims", "ring", "start", seen)
    vehicle(scene, VEHICLE_RADIUS, plumb=True)
    if sensed:
        ring = Part("ring", shapes.ring(np.zeros(2), _REACH - 0.07, 0.07, 0.014, corners=96), "scan", False)
        scene.body("sensor", [ring], colour="scan", swatch="ring", legend="reach of the sensor")
    layout(scene, log.layout, _HEIGHT)
    _views(scene, log)
    declare(scene, NUMBERS if estimated else NUMBERS_OF_A_PLAN)
    return scene


def flight_frame(scene: Scene, frame: Frame, log: Any, tick: int) -> None:
    """Draw a tick of a flight.

    Args:
        scene: begun by `flight_stage`.
        frame: of it, to be drawn on.
        log: a `FlightLog`, or one in the making.
        tick: which.
    """
    truth, believed, estimated = log.truth[tick], log.believed[tick], "position error" in scene.plots
    frame.place("drone", truth[:7])
    frame.place("shadow", [truth[0], truth[1], 0.0], scale=(1.0, 1.0, max(float(truth[2]), 1e-3)))
    if "sensor" in scene.bodies:
        frame.place("sensor", [truth[0], truth[1], 0.0])
    frame.trail("trail", believed[:3])
    if estimated:
        frame.trail("truth", truth[:3])
    _cylinders(frame, log, tick, "sensor" in scene.bodies)
    _landmarks(scene, frame, log, tick)
    for index, (x, y, radius) in enumerate(log.movers[tick].tolist()):
        name = f"mover {index}"
        if name not in scene.bodies:
            rim = shapes.ring(np.zeros(2), radius - 0.03, 0.03, _HEIGHT + 0.01, corners=32)
            parts = [pillar(radius, _HEIGHT, "moving"), Part("rim", rim, "start", False)]
            scene.body(name, parts, colour="moving", legend="cylinder that moves")
        frame.place(name, [x, y, 0.0])
    draw_way(frame, "past", log.pasts[tick])
    points = draw_way(frame, "horizon", log.plans[tick])
    if len(points):
        frame.mesh("below", shapes.ribbon(points, 0.06, 0.018), opacity=0.35)
    show(frame, log, tick, NUMBERS if estimated else NUMBERS_OF_A_PLAN)


def _cylinders(frame: Frame, log: Any, tick: int, sensed: bool) -> None:
    """Faint until they are seen."""
    rows = log.layout.cylinders
    known = np.full(len(rows), not sensed)
    for ids in log.seen[: tick + 1]:
        known[ids[ids < len(rows)]] = True
    if known.any():
        frame.discs("seen", rows[known], height=_HEIGHT, opacity=CLEAR)
        rims = [shapes.ring(row[:2], float(row[2]) - 0.03, 0.03, _HEIGHT + 0.01, corners=32) for row in rows[known]]
        frame.mesh("rims", shapes.merge(rims))
    if not known.all():
        frame.discs("unseen", rows[~known], height=_HEIGHT, opacity=0.22)


def _landmarks(scene: Scene, frame: Frame, log: Any, tick: int) -> None:
    """Of every name: an ellipse on top of the cylinder it stands for, and the cylinder's outline as believed."""
    for name, mean, covariance, radius in log.landmarks[tick]:
        ellipse, outline = f"landmark {name}", f"outline {name}"
        if ellipse not in scene.bodies:
            words = "landmark as believed: outline, and 2\u03c3 ellipse of its axis on top"
            scene.body(ellipse, "ellipse", colour="estimate", swatch="ghost", legend=words)
            if radius > 0.0:
                ring = shapes.ring(np.zeros(2), radius, 0.05, 0.02, corners=32)
                scene.body(outline, [Part("ring", ring, "estimate", False)], legend=words)
        frame.ellipse(ellipse, mean, covariance, sigmas=SIGMAS, z=_HEIGHT + 0.02 if radius > 0.0 else 0.03)
        if outline in scene.bodies:
            frame.place(outline, [*mean, 0.0])


def _views(scene: Scene, log: Any) -> None:
    """Overview and follow look along and across the way to the target."""
    way = (log.layout.target - log.layout.start)[:2]
    way = way / max(float(np.linalg.norm(way)), 1e-9)

    def away(back: float, side: float, up: float) -> list[float]:
        along: Array = -back * way + side * np.array([way[1], -way[0]])
        return [*along.tolist(), up]

    ahead = [*(2.5 * way).tolist(), 0.0]
    scene.view("overview", "Overview", away(0.55, 0.75, 0.8), 24.0)
    scene.view("follow", "Follow drone", away(1.0, 0.45, 0.7), 30.0, follows="drone", distance=13.0, ahead=ahead)
    scene.view("top", "From above", away(0.0, 0.001, 1.0), 10.0)
