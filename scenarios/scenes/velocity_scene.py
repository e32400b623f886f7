"""Velocity tracking as a scene: the car on its road, beside a ghost that keeps to the profile."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.scenes.numbers import Number, declare, show
from unifg.scenarios.velocity_tracking import Drive, TrackingSettings, metrics, travelled
from unifg.typing import Array
from unifg.view import Scene, shapes

__all__ = ["velocity_scene", "velocity_stage"]

_LANE = 3.5  # m
_CAR = 4.5  # length [m]
_POST = 50.0  # between posts beside the road [m]


def _force(drive: Drive, k: int) -> float:
    """Force held from a sample on [N]; at the last one, that which led to it."""
    return float(drive.force[min(k, len(drive.force) - 1)])


NUMBERS = (
    Number("speed", lambda d, k: f"{d.speed[k]:.2f} m/s", lambda d, k: d.speed[k], plot={"unit": "m/s"}),
    Number("deviation", None, lambda d, k: d.error[k], plot={"unit": "m/s", "limit": 0.0, "colour": "moving"}),
    Number(
        "profile", lambda d, k: f"{d.profile.speed[k]:.2f} m/s", lambda d, k: d.profile.speed[k],
        plot={"unit": "m/s", "colour": "goal"},
    ),
    Number(
        "force", lambda d, k: f"{_force(d, k):.0f} N, " + ("drives" if _force(d, k) >= 0.0 else "brakes"), _force,
        plot={"unit": "N", "limit": 0.0, "colour": "horizon"},
    ),
    Number("driven", lambda d, k: f"{travelled(d.speed, d.profile.dt)[k]:.0f} m"),
)  # fmt: skip
"""Lines and curves of a drive."""


def velocity_scene(drive: Drive) -> Scene:
    """The scene of one drive along a straight road."""
    way, wanted = (travelled(speed, drive.profile.dt) for speed in (drive.speed, drive.profile.speed))
    height, end = _heights(way, drive), float(max(way[-1], wanted[-1])) + 2.0 * _CAR
    scene = Scene(f"unifg: velocity tracking, {drive.profile.name}", dt=drive.profile.dt)
    scene.ground, scene.speeds = False, (1, 2, 4, 8, 16)
    road = np.array([[-20.0, -1.5 * _LANE], [end, -1.5 * _LANE], [end, 1.5 * _LANE], [-20.0, 1.5 * _LANE]])
    low = float(height.min()) - 0.05
    scene.mesh("road", shapes.quads(np.column_stack([road, np.full(4, low)])[None]), colour="metres", legend="")
    marks = np.arange(0.0, end, 10.0)
    stripes = [shapes.ribbon(np.array([[x, 0.0], [min(x + 4.0, end), 0.0]]), 0.15, low + 0.02) for x in marks]
    scene.mesh("stripes", shapes.merge(stripes), colour="heading", legend="")
    posts = np.arange(0.0, end, _POST)
    scene.discs("posts", np.column_stack([posts, np.full(len(posts), 1.8 * _LANE), np.full(len(posts), 0.12)]),
                height=1.2, base=low, colour="plan", legend=f"posts, {_POST:g} m apart")  # fmt: skip
    for x in posts[:: max(1, round(len(posts) / 8))]:
        scene.label(f"{x:g} m", [x, 1.8 * _LANE, low], minor=True)
    scene.body("car", "car", size=_CAR, colour="robot", legend="the car")
    scene.body("ghost", "car", size=_CAR, colour="goal", legend="a car that kept to the profile exactly")
    scene.label("car", follows="car", above=True)
    scene.view(
        "follow", "Follow the car", (-0.55, -0.9, 0.45), 30.0, follows="car", distance=55.0, ahead=(2.0, 0.0, 0.0)
    )
    scene.view("overview", "Whole road", (-0.15, -0.85, 0.5), 20.0)
    declare(scene, NUMBERS)
    for k in range(len(drive.speed)):
        frame = scene.frame()
        for name, x, lane in (("car", way[k], -0.5), ("ghost", wanted[k], 0.5)):
            frame.place(name, [float(x), lane * _LANE, float(height[k]), 1.0, 0.0, 0.0, 0.0])
        show(frame, drive, k, NUMBERS)
    m = metrics(drive)
    scene.outcome, scene.good = drive.solution.status.value, drive.succeeded
    scene.facts |= {
        "solver": m["solver"],
        "iterations": str(m["iterations"]),
        "cost J": f"{m['cost']:.4f}",
        "speed off by": f"{m['rms_error_m_s']:.3f} m/s rms",
        "limits": "" if drive.settings.force_bounds is None else "kept" if drive.within_bounds else "BROKEN",
    }
    return scene


def velocity_stage(settings: TrackingSettings) -> Scene:
    """The profile as a curve, for a scene of the iterates of a solve: 10 s along and 1 m/s upwards are a metre."""
    profile = settings.speeds()
    scene = Scene(f"unifg: {profile.name}, as it is solved", counts="iteration")
    time = profile.dt * np.arange(len(profile.speed))
    scene.way("profile", np.column_stack([0.1 * time, profile.speed]), colour="goal", legend="profile to follow")
    scene.facts["a metre is"] = "10 s along, 1 m/s upwards"
    return scene


def _heights(way: Array, drive: Drive) -> Array:
    """(N + 1,) height of the road under the car [m]; a profile without slopes is level."""
    slope = drive.profile.slope[: len(way) - 1]
    return np.concatenate([[0.0], np.cumsum(np.diff(way) * np.sin(slope))])
