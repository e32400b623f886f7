"""A flight as a scene: what stood there, what was believed of it, and where the vehicle flew and meant to fly.

A flight that nobody estimated, such as a plan flown as it is, has no sigmas, windows, landmarks or sightings; it is
shown without them, and with all cylinders solid from the start.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.log.flight_metrics import estimated_parameters, flight_metrics, has_estimate
from unifg.scenarios.log.metrics import collision_words
from unifg.scenarios.worlds.air import VEHICLE_RADIUS
from unifg.scenarios.worlds.bearing_range import SensorModel
from unifg.typing import Array, IntArray
from unifg.view import drone, shapes
from unifg.view.page import Key, Label, Page, Readout, View
from unifg.view.stage import Stage

__all__ = ["first_sights", "flight_scene", "sensor_reach"]

SIGMAS = 2.0
"""Half axes of ellipses in standard deviations."""

_HEIGHT = 2.0  # of walls, cylinders and movers [m]; there they have no top
_FLOOR = -0.02  # drawn a little lower than it is, clear of what stands on it [m]
_NODES = 16  # of a way that changes from frame to frame
_STILL = (0.002, 0.02)  # an ellipse that moved [m] or grew (share) by less is not told anew


def flight_scene(log: FlightLog) -> Stage:
    """The scene of a flight.

    Raises:
        ViewError: the flight has no tick, or meshcat is not installed.
    """
    stage = Stage(log.ticks, log.dt)
    for layer in (_ground, _walls, _cylinders, _ends, _landmarks, _movers, _drone, _trail, _frames):
        layer(stage, log)
    return stage.finish(_page(log, stage.ticks))


def first_sights(log: FlightLog) -> list[int | None]:
    """Tick at which each cylinder of the layout was first seen; None for never, all 0 in a flight without a sensor."""
    count = len(log.layout.cylinders)
    if not any(len(ids) for ids in log.seen):
        return [0] * count
    first: list[int | None] = [None] * count
    for tick in reversed(range(log.ticks)):
        for name in log.seen[tick].tolist():
            if name < count:
                first[name] = tick
    return first


def sensor_reach(log: FlightLog) -> float | None:
    """Reach of the sensor [m], ``settings["sensor_range"]`` or the usual one; None in a flight without a sensor."""
    if not any(len(ids) for ids in log.seen):
        return None
    return float(log.settings.get("sensor_range", SensorModel().range_max))


def _ground(stage: Stage, log: FlightLog) -> None:
    """The floor, with lines every metre to judge distances by."""
    (left, low), (right, high) = log.layout.size
    floor = np.array([[[left, low, _FLOOR], [right, low, _FLOOR], [right, high, _FLOOR], [left, high, _FLOOR]]])
    stage.mesh("ground/floor", shapes.quads(floor), "floor")
    across = [[[x, low], [x, high]] for x in np.arange(math.ceil(left), right + 1e-9)]
    along = [[[left, y], [right, y]] for y in np.arange(math.ceil(low), high + 1e-9)]
    lines = [shapes.ribbon(np.array(line), 0.02, 0.0) for line in across + along]
    stage.mesh("ground/metres", shapes.merge(lines), "metres")


def _walls(stage: Stage, log: FlightLog) -> None:
    for index, wall in enumerate(log.layout.walls):
        low, high = (np.column_stack([wall, np.full(2, z)]) for z in (0.0, _HEIGHT))
        sheet = np.concatenate([low, high[::-1]])[None]
        stage.mesh(f"walls/{index}/sheet", shapes.quads(sheet), "wall", opacity=0.22)
        frame = [shapes.tube(line, 0.03, 4) for line in (low, high)]
        frame += [shapes.tube(np.stack([low[k], high[k]]), 0.03, 4) for k in range(2)]
        stage.mesh(f"walls/{index}/frame", shapes.merge(frame), "wall", lit=True)


def _cylinders(stage: Stage, log: FlightLog) -> None:
    """Faint until they are seen."""
    for index, first in enumerate(first_sights(log)):
        x, y, radius = log.layout.cylinders[index].tolist()
        unseen, seen = f"cylinders/{index}/unseen", f"cylinders/{index}/seen"
        if first != 0:
            stage.cylinder(unseen, _HEIGHT, radius, "wall", (x, y), opacity=0.22)
            if first is not None:
                stage.appear(unseen, 0, first)
        if first is not None:
            _pillar(stage, seen, radius, "fixed", (x, y))
            if first > 0:
                stage.appear(seen, first)


def _pillar(stage: Stage, path: str, radius: float, colour: str, place: tuple[float, float] = (0.0, 0.0)) -> None:
    stage.cylinder(f"{path}/body", _HEIGHT, radius, colour, place)
    stage.mesh(f"{path}/rim", shapes.ring(np.array(place), radius - 0.03, 0.03, _HEIGHT + 0.01, corners=32), "start")


def _ends(stage: Stage, log: FlightLog) -> None:
    start, target = log.layout.start, log.layout.target
    stage.mesh("start", shapes.ring(start[:2], 0.18, 0.07, 0.012, corners=32), "start")
    rings = [shapes.ring(target[:2], r, 0.07, 0.012, corners=40) for r in (0.12, 0.4)]
    stage.mesh("target/rings", shapes.merge(rings), "goal")
    stage.cylinder("target/pole", float(target[2]), 0.025, "pole", target[:2])
    stage.ball("target/ball", 0.16, "goal", target)


def _landmarks(stage: Stage, log: FlightLog) -> None:
    """One ellipse for each name a landmark was ever given, moved and stretched as it becomes better known."""
    told: dict[int, dict[int, Array]] = {}
    radii: dict[int, float] = {}
    for tick in stage.ticks.tolist():
        row = log.landmarks[tick]
        radii |= dict(zip(row.ids.tolist(), row.radii.tolist(), strict=True))
        for name, mean, covariance in zip(row.ids.tolist(), row.means, row.covariances, strict=True):
            long, short, direction = shapes.ellipse_axes(covariance, SIGMAS)
            earlier = told.setdefault(name, {})
            if earlier:  # a direction and its opposite are the same: the nearer one, lest the ellipse spin
                last = float(next(reversed(earlier.values()))[4])
                direction = last + (direction - last + math.pi / 2.0) % math.pi - math.pi / 2.0
            earlier[tick] = np.array([*mean, long, short, direction])
    for name, ellipses in sorted(told.items()):
        _landmark(stage, f"landmarks/{name}", ellipses, radii[name])


def _landmark(stage: Stage, path: str, ellipses: dict[int, Array], radius: float) -> None:
    """Its ellipse, on top of the cylinder it stands for, and the cylinder's outline as believed."""
    height, middle = _HEIGHT + 0.02 if radius > 0.0 else 0.03, np.zeros(2)
    stage.mesh(f"{path}/ellipse/disc", shapes.ring(middle, 0.0, 1.0, height, corners=32), "estimate", opacity=0.5)
    stage.mesh(f"{path}/ellipse/edge", shapes.ring(middle, 0.86, 0.14, height + 0.005, corners=32), "estimate")
    if radius > 0.0:
        stage.mesh(f"{path}/outline", shapes.ring(middle, radius, 0.05, 0.02, corners=32), "estimate")
    hidden = True
    for tick in stage.ticks.tolist():
        if (tick not in ellipses) != hidden or tick in (0, stage.last):
            hidden = tick not in ellipses
            stage.key(path, tick, visible=not hidden)
    told, previous = -1, -1
    for tick, values in ellipses.items():
        if told < 0 or _changed(ellipses[told], values):
            if previous > told:
                _place_ellipse(stage, path, previous, ellipses[told])  # it has stood still until then
            _place_ellipse(stage, path, tick, values)
            told = tick
        previous = tick


def _place_ellipse(stage: Stage, path: str, tick: int, ellipse: Array) -> None:
    x, y, long, short, direction = ellipse.tolist()
    stage.key(path, tick, position=(x, y, 0.0))
    turn = (math.cos(direction / 2.0), 0.0, 0.0, math.sin(direction / 2.0))
    stage.key(f"{path}/ellipse", tick, scale=(max(long, 1e-3), max(short, 1e-3), 1.0), quaternion=turn)


def _changed(before: Array, now: Array) -> bool:
    distance, share = _STILL
    moved = float(np.abs(now[:2] - before[:2]).max()) > distance
    return moved or bool((np.abs(now[2:4] - before[2:4]) > share * np.maximum(before[2:4], distance)).any())


def _movers(stage: Stage, log: FlightLog) -> None:
    for index in range(log.movers.shape[1]):
        places = log.movers[:, index]
        _pillar(stage, f"movers/{index}", float(places[0, 2]), "moving")
        stage.move(f"movers/{index}", shapes.on_ground(places))


def _drone(stage: Stage, log: FlightLog) -> None:
    """The vehicle, its shadow with a plumb line, and the circle the sensor reaches."""
    truth, radius, middle = log.truth, VEHICLE_RADIUS, np.zeros(2)
    stage.mesh("drone/body", drone.body(radius), "robot", lit=True)
    stage.mesh("drone/nose", drone.nose(radius), "goal", lit=True)
    stage.mesh("drone/arms", drone.arms(radius), "dark", lit=True)
    for name, front, colour in (("front", True, "scan"), ("back", False, "dark")):
        stage.mesh(f"drone/{name}/rotors", drone.rotors(radius, front=front), colour)
        stage.mesh(f"drone/{name}/swept", drone.swept(radius, front=front), colour, opacity=0.4)
    stage.move("drone", truth[:, :3], truth[:, 3:7])

    stage.mesh("shadow/disc", shapes.ring(middle, 0.0, radius, 0.016, corners=24), "start", opacity=0.4)
    plumb = shapes.tube(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), 0.012)
    stage.mesh("shadow/plumb", plumb, "start", opacity=0.5)
    for tick in stage.ticks.tolist():
        stage.key("shadow/plumb", tick, scale=(1.0, 1.0, max(float(truth[tick, 2]), 1e-3)))
    stage.move("shadow", shapes.on_ground(truth))
    reach = sensor_reach(log)
    if reach is not None:
        stage.mesh("sensor", shapes.ring(middle, reach - 0.07, 0.07, 0.014, corners=96), "scan")
        stage.move("sensor", shapes.on_ground(truth))


def _trail(stage: Stage, log: FlightLog) -> None:
    """The way flown so far, as believed and as it truly was."""
    ways = [("believed", log.believed[:, :3], "trail", 0.03)]
    if has_estimate(log):
        ways.append(("truth", log.truth[:, :3], "odometry", 0.014))
    for begin, end in stage.pieces():
        for name, way, colour, radius in ways:
            points = shapes.thin(way[begin : end + 1], 3)
            if len(points) > 1:
                stage.mesh(f"flown/{begin}/{name}", shapes.tube(points, radius), colour)
        stage.appear(f"flown/{begin}", end)


def _frames(stage: Stage, log: FlightLog) -> None:
    """Predicted way, with its shadow, and window of the estimator, of each frame."""
    for tick, ending in stage.turns():
        path, drawn = f"frames/{tick}", False
        for name, way, colour, radius in (
            ("past", log.pasts[tick], "robot", 0.045),
            ("horizon", log.plans[tick], "horizon", 0.05),
        ):
            points = shapes.thin(way, _NODES) if len(way) > 1 and np.isfinite(way).all() else way[:0]
            if len(points) > 1:
                drawn = True
                stage.mesh(f"{path}/{name}", shapes.tube(points, radius), colour)
                if name == "horizon":
                    stage.mesh(f"{path}/below", shapes.ribbon(points, 0.06, 0.018), "horizon", opacity=0.35)
        if drawn:
            stage.appear(path, tick, ending)


def _page(log: FlightLog, ticks: IntArray) -> Page:
    m = flight_metrics(log)
    settings, error, tick = m["settings"], m["position_error_m"], m["tick_ms"]
    name = str(settings.get("scenario", "quadrotor"))
    reached = "target reached" if m["reached"] else f"{m['target_distance_m']:.1f} m short of the target"
    stopped = ", interrupted by the user" if m["interrupted"] else ""
    solver = str(settings.get("solver", ""))
    if solver and settings.get("coupling"):
        solver += f" ({settings['coupling']})"
    (left, low), (right, high) = log.layout.size.tolist()
    corners = [[x, y, z] for z in (0.0, _HEIGHT) for x in (left, right) for y in (low, high)]
    return Page(
        title=f"unifg: {name}" + (f", {log.layout.name}" if log.layout.name else ""),
        outcome=f"{reached}, {collision_words(log.collisions)}{stopped}",
        good=m["succeeded"],
        facts={
            "solver": solver,
            "seed": "" if settings.get("seed") is None else str(settings["seed"]),
            "flown": f"{m['path_length_m']:.1f} m in {m['duration_s']:.1f} s",
            "closest approach": f"{max(0.0, m['min_clearance_m']):.2f} m",
            "position error": "" if error is None else f"{100 * error['rms']:.1f} cm rms",
            "estimate + plan": f"{tick['p50']:.1f} ms median" if tick["max"] > 0.0 else "",
        },
        corners=np.array(corners),
        legend=_legend(log),
        labels=[
            Label("start", [*log.layout.start[:2].tolist(), 0.0]),
            Label("target", log.layout.target.tolist()),
            Label("drone", follows="drone", above=True),
        ],
        readouts=_readouts(log, ticks),
        views=_views(log),
        speeds=(0.25, 0.5, 1, 2, 4),
    )


def _legend(log: FlightLog) -> list[Key]:
    sensed, estimated = sensor_reach(log) is not None, has_estimate(log)
    window = any(len(past) > 1 for past in log.pasts)
    believed = "estimated past before that" if window or estimated else "way flown"
    marked = any(len(row.ids) for row in log.landmarks)
    keys = (
        (window, Key("robot", "line", "estimated past: the window that is smoothed")),
        (True, Key("trail", "line", believed)),
        (estimated, Key("odometry", "thin", "true way, where it differs")),
        (True, Key("horizon", "line", "predicted future, and its shadow on the ground")),
        (sensed, Key("scan", "ring", "reach of the sensor")),
        (True, Key("fixed", "disc", "cylinder that has been seen" if sensed else "cylinder")),
        (sensed, Key("wall", "ghost", "cylinder not seen yet")),
        (marked, Key("estimate", "ghost", "landmark as believed: outline, and 2\u03c3 ellipse of its axis on top")),
        (log.movers.shape[1] > 0, Key("moving", "disc", "cylinder that moves")),
        (True, Key("goal", "disc", "target")),
    )
    return [key for here, key in keys if here]


def _readouts(log: FlightLog, ticks: IntArray) -> list[Readout]:
    def texts(values: Array, form: str) -> list[str]:
        return [form.format(value) if np.isfinite(value) else "\u2013" for value in values[ticks].tolist()]

    rows = [
        Readout("speed", texts(np.linalg.norm(log.truth[:, 7:], axis=1), "{:.2f} m/s")),
        Readout("height", texts(log.truth[:, 2], "{:.2f} m")),
        Readout("clearance", texts(log.clearance, "{:.2f} m")),
        Readout("thrust", texts(log.controls[:, 3], "{:.1f} N")),
    ]
    if has_estimate(log):
        error = 100.0 * np.linalg.norm(log.believed[:, :3] - log.truth[:, :3], axis=1)
        rows.append(Readout("position error", texts(error, "{:.1f} cm")))
    if estimated_parameters(log)[0]:
        mass, sigma = texts(log.parameters[:, 0], "{:.3f}"), texts(log.parameters_sigma[:, 0], "{:.3f} kg")
        rows.append(Readout("mass \u00b1 \u03c3", [f"{m} \u00b1 {s}" for m, s in zip(mass, sigma, strict=True)]))
        rows.append(Readout("true mass", [f"{log.parameters_true[0]:.3f} kg"] * len(ticks)))
    if any(len(row.ids) for row in log.landmarks):
        rows.append(Readout("landmarks", [str(len(log.landmarks[tick].ids)) for tick in ticks]))
    if (log.estimate_ms + log.plan_ms).max() > 0.0:
        spent = zip(texts(log.estimate_ms, "{:.1f} ms"), texts(log.plan_ms, "{:.1f} ms"), strict=True)
        new = log.compiled[ticks] > 0
        spent_in = [f"{e}, {p}{' (compiled)' * bool(c)}" for (e, p), c in zip(spent, new, strict=True)]
        rows.append(Readout("estimate, plan", spent_in, new.tolist()))
    plans = [log.statuses[k].lower() + (": stored one flown" if log.emergency[k] else "") for k in ticks]
    return [*rows, Readout("plan", plans, log.emergency[ticks].tolist())]


def _views(log: FlightLog) -> list[View]:
    """Overview and follow look along and across the way to the target."""
    way = (log.layout.target - log.layout.start)[:2]
    way = way / max(float(np.linalg.norm(way)), 1e-9)

    def away(back: float, side: float, up: float) -> list[float]:
        return [*(-back * way + side * np.array([way[1], -way[0]])).tolist(), up]

    ahead = [*(2.5 * way).tolist(), 0.0]
    return [
        View("overview", "Overview", away(0.55, 0.75, 0.8), 24.0),
        View("follow", "Follow drone", away(1.0, 0.45, 0.7), 30.0, follows="drone", distance=13.0, ahead=ahead),
        View("top", "From above", away(0.0, 0.001, 1.0), 10.0),
    ]
