"""A flight that must keep its distance, as a scene: what stands, what moves, what was planned and what was flown."""

from __future__ import annotations

import math

import numpy as np

from unifg.scenarios.log.safe_log import SafeLog
from unifg.typing import Array, IntArray
from unifg.view import drone, shapes
from unifg.view.page import Key, Label, Page, Readout, View
from unifg.view.stage import Stage

__all__ = ["safe_scene"]

_HEIGHT = 3.0  # of cylinders, which have no end [m]
_FLOOR = -0.02
_STILL = 1e-9  # [m]
_NODES = 16  # of a plan
_BESIDE = 1.0  # around the flight [m]


def safe_scene(log: SafeLog) -> Stage:
    """The scene of one flight.

    Raises:
        ViewError: the flight has no tick, or meshcat is not installed.
    """
    stage = Stage(log.ticks, log.dt)
    low, high = _extent(log)
    _floor(stage, low, high)
    _bodies(stage, log)
    _vehicle(stage, log)
    _ways(stage, log)
    return stage.finish(_page(log, stage.ticks, low, high))


def _extent(log: SafeLog) -> tuple[Array, Array]:
    """Lowest and highest corner (2,) of the ground that is shown [m]."""
    ways = np.concatenate([log.states[:, :2], log.wanted[:, :2], log.bodies[..., :2].reshape(-1, 2)])
    return ways.min(axis=0) - _BESIDE, ways.max(axis=0) + _BESIDE


def _floor(stage: Stage, low: Array, high: Array) -> None:
    """With lines every metre to judge distances by."""
    (left, near), (right, far) = low.tolist(), high.tolist()
    corners = np.array([[[left, near, _FLOOR], [right, near, _FLOOR], [right, far, _FLOOR], [left, far, _FLOOR]]])
    stage.mesh("ground/floor", shapes.quads(corners), "floor")
    across = [[[x, near], [x, far]] for x in np.arange(math.ceil(left), right)]
    along = [[[left, y], [right, y]] for y in np.arange(math.ceil(near), far)]
    stage.mesh("ground/metres", shapes.merge([shapes.ribbon(np.array(w), 0.02, 0.0) for w in across + along]), "metres")


def _bodies(stage: Stage, log: SafeLog) -> None:
    for index, (radius, upright) in enumerate(zip(log.radii.tolist(), log.upright.tolist(), strict=True)):
        path, places = f"bodies/{index}", log.bodies[:, index]
        still = _rests(places)
        colour = "fixed" if still else "moving"
        if upright:
            stage.cylinder(f"{path}/body", _HEIGHT, radius, colour)
            edge = shapes.ring(np.zeros(2), radius + log.hull + log.margin - 0.02, 0.02, 0.014, corners=48)
            stage.mesh(f"{path}/margin", edge, "moving")
            places = shapes.on_ground(places)
        else:
            stage.ball(f"{path}/body", radius, colour, np.zeros(3))
        if still:
            for tick in (0, stage.last):
                stage.key(path, tick, position=places[0])
        else:
            stage.move(path, places)


def _vehicle(stage: Stage, log: SafeLog) -> None:
    """The vehicle and its shadow."""
    stage.mesh("drone/body", drone.body(log.hull), "robot", lit=True)
    stage.mesh("drone/nose", drone.nose(log.hull), "goal", lit=True)
    stage.mesh("drone/arms", drone.arms(log.hull), "dark", lit=True)
    for name, front, colour in (("front", True, "scan"), ("back", False, "dark")):
        stage.mesh(f"drone/{name}/rotors", drone.rotors(log.hull, front=front), colour)
        stage.mesh(f"drone/{name}/swept", drone.swept(log.hull, front=front), colour, opacity=0.4)
    stage.move("drone", log.states[:, :3], log.states[:, 3:7])
    stage.mesh("shadow", shapes.ring(np.zeros(2), 0.0, log.hull, 0.016, corners=24), "start", opacity=0.4)
    stage.move("shadow", shapes.on_ground(log.states))


def _ways(stage: Stage, log: SafeLog) -> None:
    """The path, the way flown so far, and the plan of each frame."""
    if not _rests(log.wanted[:, :3]):
        stage.mesh("path", shapes.tube(shapes.thin(log.wanted[:, :3], 200), 0.012), "plan", opacity=0.6)
    for begin, end in stage.pieces():
        points = shapes.thin(log.states[begin : end + 1, :3], 3)
        if not _rests(points):
            stage.mesh(f"flown/{begin}", shapes.tube(points, 0.025), "trail")
            stage.appear(f"flown/{begin}", end)
    for tick, ending in stage.turns():
        plan = log.plans[tick]
        if len(plan) > 1 and np.isfinite(plan).all() and not _rests(plan):
            stage.mesh(f"frames/{tick}", shapes.tube(shapes.thin(plan, _NODES), 0.035), "horizon")
            stage.appear(f"frames/{tick}", tick, ending)


def _rests(points: Array) -> bool:
    """Whether places (n, 3) are all the same."""
    return bool(np.ptp(points, axis=0).max() < _STILL)


def _page(log: SafeLog, ticks: IntArray, low: Array, high: Array) -> Page:
    words = "kept its distance" if not log.violated else "came TOO NEAR" if not log.touched else "TOUCHED something"
    arrived = "" if log.end is None else ", arrived" if log.arrived else ", did NOT arrive"
    stopped = ", interrupted by the user" if log.interrupted else ""
    corners = [[x, y, z] for z in (0.0, _HEIGHT) for x in (low[0], high[0]) for y in (low[1], high[1])]
    error = np.linalg.norm(log.error, axis=1)
    readouts = [
        Readout("speed", _texts(np.linalg.norm(log.states[ticks, 7:], axis=1), "{:.2f} m/s")),
        Readout("from the path", _texts(100.0 * error[ticks], "{:.1f} cm")),
        Readout("mass believed", _texts(log.mass[ticks], "{:.3f} kg")),
        Readout("decided in", _texts(log.decide_ms[ticks], "{:.1f} ms")),
    ]
    if len(log.radii):
        near = log.boundary[ticks]
        readouts.insert(1, Readout("boundary distance", _texts(near, "{:.3f} m"), (near < 0.0).tolist()))
    keys = (
        (True, Key("trail", "line", "way flown")),
        (not _rests(log.wanted[:, :3]), Key("plan", "line", "path to follow")),
        (log.plans.shape[1] > 1, Key("horizon", "line", "plan")),
        (len(log.radii) > 0, Key("fixed", "disc", "at rest")),
        (len(log.radii) > 0, Key("moving", "disc", "moves")),
    )
    return Page(
        title=f"unifg: quadrotor-cbf, {log.settings['case']}",
        outcome=(words if len(log.radii) else "nothing in the way") + arrived + stopped,
        good=log.succeeded,
        facts={
            "flight": log.label,
            "controller": str(log.settings["controller"]),
            "least boundary distance": f"{log.boundary.min():.3f} m" if len(log.radii) else "",
            "from the path": f"{100.0 * math.sqrt(float(np.mean(error**2))):.1f} cm rms",
            "decided in": f"{np.median(log.decide_ms):.2f} ms median",
        },
        corners=np.array(corners),
        legend=[key for here, key in keys if here],
        labels=[Label("drone", follows="drone", above=True)],
        readouts=readouts,
        views=[
            View("overview", "Overview", [-0.55, -0.75, 0.8], 24.0),
            View("follow", "Follow drone", [-1.0, -0.45, 0.7], 30.0, follows="drone", distance=9.0),
            View("top", "From above", [0.0, -0.001, 1.0], 10.0),
        ],
        speeds=(0.1, 0.25, 0.5, 1, 2),
    )


def _texts(values: Array, form: str) -> list[str]:
    return [form.format(value) for value in values.tolist()]
